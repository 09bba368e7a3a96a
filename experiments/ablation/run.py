"""The paper's ablation: models A, B and C trained alike, three seeds each, one step, without refinement.

    python experiments/ablation/run.py --data PATH [--decoder landmarks pose]

Training pairs follow DCP's clean protocol, as in the paper, and every model sees the same ones. The models are compared
with either kind of decoder:

* pose: as the paper may mean it. Points are known by their coordinates alone, and decoders regress the pose.
* landmarks: points see their surroundings, and decoders answer by landmarks, aligned after three rounds of consensus.
  Points are not looked up, which needs no regions and would hide what they are for. Model A, which has none, has as
  many landmarks as the regions of the others together.

Checkpoints are chosen on shapes held out of the training split; the table is over all test shapes. Runs are kept in
runs/ beside this file: an interrupted command continues where it stopped. Writes results.json and table.md beside this
file.
"""

import argparse
import itertools
import json
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from tqdm import tqdm

from urrt_jax.data import Shapes, load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.evaluation.methods import Ours
from urrt_jax.model import ModelConfig
from urrt_jax.training.loop import LoopConfig, train
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig
from urrt_jax.training.urrt import URRT

HERE = Path(__file__).parent
SEEDS = (0, 1, 2)
METRICS = ("rmse_rotation", "mae_rotation", "rmse_translation", "mae_translation", "recall_1deg")
PAPER = {
    "A": (1.2891, 1.0016, 0.0170, 0.0128),
    "B": (0.6237, 0.5337, 0.0097, 0.0074),
    "C": (0.5526, 0.4328, 0.0080, 0.0060),
}
Variant = Literal["A", "B", "C"]
Decoder = Literal["landmarks", "pose"]
VARIANTS: tuple[Variant, ...] = ("A", "B", "C")
DECODERS: tuple[Decoder, ...] = ("pose", "landmarks")


def configured(variant: Variant, decoder: Decoder, seed: int) -> tuple[URRT, TrainConfig]:
    """One of the models, and how it is trained."""
    if decoder == "pose":
        model = ModelConfig(
            variant=variant, decoder="pose", octaves=0, lookups=0, consensus=0, hypotheses=0, steps=1, points=256
        )
        steps, points, loss_points = 1_500, 512, 256
    else:
        landmarks = 64 if variant == "A" else 8
        model = ModelConfig(variant=variant, landmarks=landmarks, lookups=0, consensus=3, hypotheses=0, steps=1)
        steps, points, loss_points = 300, 1024, 512
    method = URRT(model=model, loss_points=loss_points)
    return method, TrainConfig(
        method=method,
        pairs=PairConfig(points=points, corrupted=0.0, signed=0.0, both_ways=0.0),
        steps=steps,
        steps_per_call=10,
        seed=seed,
    )


def measured(variant: Variant, decoder: Decoder, shapes: Shapes, test: Shapes) -> dict[str, Any]:
    """The row of one model: its figures over all test shapes, for every seed."""
    found, configs = [], [configured(variant, decoder, seed) for seed in SEEDS]
    for method, config in configs:
        held_in, held_out = shapes.split_validation(0.05, config.seed)
        run = HERE / "runs" / f"{variant}_{decoder}_{config.seed}_{config.steps}"
        variables = train(config, held_in, held_out, run, loop=LoopConfig(every=config.steps // 2))
        ours = Ours(model=method.as_model(variables), refine=None)
        found.append(evaluate(ours, "dcp", test.points, progress=False).summary())
    values = {name: [one[name] for one in found] for name in METRICS}
    return {"variant": variant, "decoder": decoder, "steps": configs[0][1].steps} | values


def as_markdown(results: dict[str, Any]) -> str:
    """The models' means and deviations over the seeds, and the paper's figures."""
    lines = ["| model, one step | RMSE(R) | MAE(R) | RMSE(t) | MAE(t) | within 1° |", "|---|---:|---:|---:|---:|---:|"]
    for row in results["rows"]:
        cells = []
        for name in METRICS:
            values, digits = np.array(row[name]), 4 if name.endswith("translation") else 3
            unit = "°" if name.endswith("rotation") else ""
            cells.append(f"{values.mean():.{digits}f}{unit} ± {values.std(ddof=1):.{digits}f}")
        lines.append(f"| {row['variant']}, {row['decoder']}, {row['steps']:,} steps | " + " | ".join(cells) + " |")
    for variant, (rmse, mae, rmse_t, mae_t) in PAPER.items():
        lines.append(f"| *{variant} (paper)* | *{rmse:.3f}°* | *{mae:.3f}°* | *{rmse_t:.4f}* | *{mae_t:.4f}* | |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it")
    parser.add_argument("--decoder", nargs="+", choices=DECODERS, default=DECODERS, help="what decoders give")
    flags = parser.parse_args()
    shapes, test = load_shapes(flags.data, points=1024), load_shapes(flags.data, split="test", points=1024)
    written = HERE / "results.json"
    before = json.loads(written.read_text())["rows"] if written.exists() else []
    rows = {(row["decoder"], row["variant"]): row for row in before}
    for decoder in flags.decoder:
        for variant in tqdm(VARIANTS, desc=decoder, unit="model"):
            rows[decoder, variant] = measured(variant, decoder, shapes, test)
            results = {
                "command": f"python experiments/ablation/run.py --data {Path(flags.data).name}",
                "jax": jax.__version__,
                "seeds": SEEDS,
                "rows": [rows[each] for each in itertools.product(DECODERS, VARIANTS) if each in rows],
            }
            written.write_text(json.dumps(results, indent=1) + "\n")
            (HERE / "table.md").write_text(as_markdown(results))
    print((HERE / "table.md").read_text())
