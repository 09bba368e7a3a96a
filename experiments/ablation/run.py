"""The paper's ablation: models A, B and C trained alike, three seeds each, one step, without refinement.

    python experiments/ablation/run.py --data PATH [--steps 400] [--decoder landmarks]

Training pairs follow DCP's clean protocol, as in the paper, and every model sees the same ones. All see the
surroundings of points and answer by the landmarks of their regions, after three rounds of consensus (or regress the
pose, with --decoder pose); points are not looked up, which needs no regions and would hide what they are for. Model A,
which has none, has as many landmarks as the regions of the others together. Checkpoints are chosen on shapes held out
of the training split; the table is over all test shapes. Runs are kept in runs/ beside this file: an interrupted
command continues where it stopped. Writes results.json and table.md beside this file.
"""

import argparse
import json
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from tqdm import tqdm

from urrt_jax.data import load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.evaluation.methods import Ours
from urrt_jax.model import ModelConfig
from urrt_jax.training.loop import LoopConfig, train
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig

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


def configured(variant: Variant, decoder: Decoder, seed: int, steps: int) -> TrainConfig:
    """How one of the models is trained."""
    landmarks = 64 if variant == "A" else 8
    return TrainConfig(
        model=ModelConfig(
            variant=variant,
            decoder=decoder,
            landmarks=landmarks,
            lookups=0,
            consensus=3,
            hypotheses=0,
            steps=1,
            points=512,
        ),
        pairs=PairConfig(corrupted=0.0, signed=0.0, both_ways=0.0),
        steps=steps,
        steps_per_call=10,
        seed=seed,
    )


def as_markdown(results: dict[str, Any]) -> str:
    """The models' means and deviations over the seeds, and the paper's figures."""
    lines = ["| model, one step | RMSE(R) | MAE(R) | RMSE(t) | MAE(t) | within 1° |", "|---|---:|---:|---:|---:|---:|"]
    for row in results["rows"]:
        cells = []
        for name in METRICS:
            values, digits = np.array(row[name]), 4 if name.endswith("translation") else 3
            unit = "°" if name.endswith("rotation") else ""
            cells.append(f"{values.mean():.{digits}f}{unit} ± {values.std(ddof=1):.{digits}f}")
        lines.append(f"| {row['variant']}, {row['decoder']} | " + " | ".join(cells) + " |")
    for variant, (rmse, mae, rmse_t, mae_t) in PAPER.items():
        lines.append(f"| *{variant} (paper)* | *{rmse:.3f}°* | *{mae:.3f}°* | *{rmse_t:.4f}* | *{mae_t:.4f}* | |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it")
    parser.add_argument("--steps", type=int, default=400, help="of every run")
    parser.add_argument("--decoder", choices=("landmarks", "pose"), default="landmarks", help="what decoders give")
    flags = parser.parse_args()
    if flags.steps < 100 or flags.steps % 100:
        parser.error(f"--steps: expected a multiple of 100, got {flags.steps}")
    shapes, test = load_shapes(flags.data, points=1024), load_shapes(flags.data, split="test", points=1024)
    rows: list[dict[str, Any]] = []
    results = {
        "command": f"python experiments/ablation/run.py --data {Path(flags.data).name} "
        f"--steps {flags.steps} --decoder {flags.decoder}",
        "jax": jax.__version__,
        "steps": flags.steps,
        "seeds": SEEDS,
        "rows": rows,
    }
    for variant in tqdm(VARIANTS, unit="model"):
        found = []
        for seed in SEEDS:
            config = configured(variant, flags.decoder, seed, flags.steps)
            held_in, held_out = shapes.split_validation(0.05, seed)
            run = HERE / "runs" / f"{variant}_{flags.decoder}_{seed}_{flags.steps}"
            model = train(config, held_in, held_out, run, loop=LoopConfig(every=flags.steps // 2))
            found.append(evaluate(Ours(model=model, refine=None), "dcp", test.points, progress=False).summary())
        rows.append(
            {"variant": variant, "decoder": flags.decoder} | {name: [one[name] for one in found] for name in METRICS}
        )
        (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
        (HERE / "table.md").write_text(as_markdown(results))
    print(as_markdown(results))
