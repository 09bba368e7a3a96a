"""Do regions pay? Models A, B and C, trained for equal time on all kinds of pairs and measured on six protocols.

    python experiments/ablation/equal_time.py --data PATH [--only NAME ...] [--seeds 0 1 2] [--minutes 6]

The other ablation (run.py) follows the paper, on clean pairs. Here clouds are also cropped, noisy and full of stray
points, which is where regions should help: a region may be seen in both clouds although the shape is not.

* places: regions by place, the paper's h_k([x, e]); parts: by what surrounds a point, so that they turn with the shape.
* landmarks: decoders answer by landmarks, after three rounds of consensus. Points are not looked up, which needs no
  regions. Model A, which has none, has as many landmarks as the regions of the others together. pose: decoders regress
  the pose, and points are known by their coordinates alone.

Every model trains for the same time on one processor, by which its steps are chosen: how fast each is, is measured
first, and kept with the results, so that a model trains for as many steps wherever the command goes on. Checkpoints are
chosen on shapes held out of the training split. Errors are over every fourth test shape (RPM-Net's crops: all of its
subset), one step, without refinement. A model's ratio to A is that of the mean errors, with an interval that holds 95 %
of resampled sets of pairs and seeds.

Writes equal_time.json and equal_time.md with the models that are there. An interrupted command continues where it
stopped: finished models are in equal_time.json, the one at work in runs/, both beside this file.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from urrt_jax.atomic import write_atomically
from urrt_jax.data import Shapes, load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.evaluation.methods import Ours
from urrt_jax.model import ModelConfig
from urrt_jax.training.loop import LoopConfig, train
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig, init_state
from urrt_jax.training.step import train_steps
from urrt_jax.training.urrt import URRT

HERE = Path(__file__).parent
BATCH, STRIDE, RESAMPLED = 32, 4, 2_000
PROTOCOLS = {
    "dcp": "clean",
    "incomplete_both": "D.I. two-sided",
    "drift": "P.D.",
    "outliers": "D.O. 10 %",
    "rpmnet": "RPM-Net crops",
    "independent_noise": "independent + noise",
}
PARTIAL = ("incomplete_both", "rpmnet")
RPMNET = "modelnet40_2048_normals_subset.npz"
_LANDMARKS: dict[str, Any] = {"lookups": 0, "consensus": 3, "hypotheses": 0, "steps": 1}
_POSE: dict[str, Any] = _LANDMARKS | {"decoder": "pose", "octaves": 0, "consensus": 0, "points": 256}
_DECODERS = {"landmarks": _LANDMARKS, "pose": _POSE}
_PARTS: dict[str, Any] = {"partition": "parts", "octaves": 4}
_VARIANTS: dict[str, dict[str, Any]] = {
    "A": {"variant": "A"},
    "B, parts": {"variant": "B"} | _PARTS,
    "C, places": {"variant": "C"},
    "C, parts": {"variant": "C"} | _PARTS,
}
_WIDER: dict[tuple[str, str], dict[str, Any]] = {("A", "landmarks"): {"landmarks": 64}}  # as many as eight regions have
MODELS = {
    f"{variant}, {decoder}": ModelConfig(**_DECODERS[decoder] | changes | _WIDER.get((variant, decoder), {}))
    for decoder in _DECODERS
    for variant, changes in _VARIANTS.items()
}
BASES = {name: f"A, {name.rpartition(', ')[2]}" for name in MODELS}
"""The model without regions that each one is compared with."""


def configured(name: str, steps: int, seed: int) -> TrainConfig:
    """How a model is trained."""
    model = MODELS[name]
    method = URRT(model=model, loss_points=256)
    pairs = PairConfig(points=2 * model.points)
    return TrainConfig(method=method, pairs=pairs, batch=BATCH, steps=steps, warmup=steps // 10, seed=seed)


def folder(name: str) -> Path:
    """Where the runs of a model are kept."""
    return HERE / "runs" / name.replace(", ", "_")


def speed(name: str, shapes: Shapes) -> float:
    """The steps that a model trains in a second here."""
    config, arrays = configured(name, 100, 0), {"points": jnp.asarray(shapes.points[:256])}
    state, _ = train_steps(init_state(config), arrays, config)  # compiles
    jax.block_until_ready(state)
    start = time.perf_counter()
    for _ in range(8):
        state, _ = train_steps(state, arrays, config)
    jax.block_until_ready(state)
    return 8 / (time.perf_counter() - start)


def begin(path: Path, settings: dict[str, Any], shapes: Shapes) -> dict[str, Any]:
    """What the results file holds; where there is none, one without rows, for which speeds are measured.

    Raises:
      ValueError: the results are of other settings. They took hours, so they are not overwritten.
    """
    if path.exists():
        results = json.loads(path.read_text())
        if results["settings"] != settings:
            raise ValueError(
                f"{path.name}: holds results of {results['settings']}, not of {settings}; move it away first"
            )
        return results
    speeds = {name: round(speed(name, shapes), 3) for name in tqdm(MODELS, desc="speeds", unit="model")}
    command = f"python experiments/ablation/equal_time.py --data {settings['data']} --minutes {settings['minutes']:g}"
    results = {"command": command, "jax": jax.__version__, "settings": settings, "speeds": speeds, "rows": []}
    write_atomically(path, json.dumps(results) + "\n")
    return results


def measured(name: str, seed: int, steps: int, shapes: Shapes, test: dict[str, np.ndarray]) -> dict[str, Any]:
    """The row of one model and seed: the angle in degrees of every pair of every protocol, of whose shapes ``test``."""
    config = configured(name, steps, seed)
    held_in, held_out = shapes.split_validation(0.05, 0)
    run = folder(name) / f"{seed}_{steps}"
    variables = train(config, held_in, held_out, run, loop=LoopConfig(every=max(10, steps // 2)))
    log = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    ours = Ours(model=URRT(model=MODELS[name]).as_model(variables), refine=None)
    found = {each: evaluate(ours, each, test[each], progress=False).errors()["angle"] for each in PROTOCOLS}
    seconds = max(entry.get("seconds", 0.0) for entry in log)
    angles = {each: np.round(values, 4).tolist() for each, values in found.items()}
    return {"model": name, "seed": seed, "steps": steps, "seconds": round(seconds), "angles": angles}


def ratio(rows: list[dict], bases: list[dict], protocols: tuple[str, ...]) -> tuple[float, float, float]:
    """A model's mean error as a share of its base's, and where 95 % of resampled ratios lie.

    Protocols count alike; pairs are resampled together for both models, seeds for each by itself.
    """
    random = np.random.default_rng(0)
    errors = [[np.array([row["angles"][each] for row in some]) for each in protocols] for some in (rows, bases)]

    def drawn() -> float:
        """The ratio in a resampled set."""
        seeds = [random.integers(0, len(some), len(some)) for some in (rows, bases)]
        shares = []
        for ours, theirs in zip(*errors, strict=True):
            pairs = random.integers(0, ours.shape[1], ours.shape[1])
            shares.append(ours[seeds[0]][:, pairs].mean() / theirs[seeds[1]][:, pairs].mean())
        return float(np.mean(shares))

    low, high = np.quantile([drawn() for _ in range(RESAMPLED)], (0.025, 0.975))
    found = np.mean([ours.mean() / theirs.mean() for ours, theirs in zip(*errors, strict=True)])
    return float(found), float(low), float(high)


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Mean angles with their deviation over seeds, and the ratio to model A on the partial protocols."""
    heads = " | ".join(PROTOCOLS.values())
    lines = [
        f"| mean angle | {heads} | error on partial pairs, of A's | pairs seen |",
        "|---|" + "---:|" * (len(PROTOCOLS) + 2),
    ]
    grouped = {name: [row for row in rows if row["model"] == name] for name in MODELS}
    for name, some in grouped.items():
        if not some:
            continue
        cells = []
        for protocol in PROTOCOLS:
            means = np.array([np.mean(row["angles"][protocol]) for row in some])
            cells.append(f"{means.mean():.2f}°" + (f" ± {means.std(ddof=1):.2f}" if len(means) > 1 else ""))
        bases = grouped[BASES[name]]
        if name == BASES[name] or not bases:
            cells.append("1" if bases else "–")
        else:
            cells.append("{:.2f} ({:.2f} to {:.2f})".format(*ratio(some, bases, PARTIAL)))
        cells.append(f"{BATCH * some[0]['steps']:,}")
        lines.append(f"| {name}, {len(some)} seed{'s' * (len(some) > 1)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def keep(path: Path, row: dict[str, Any]) -> None:
    """Writes a row beside those that are there, and the table of all."""
    results = json.loads(path.read_text())
    rows = {(each["model"], each["seed"]): each for each in [*results["rows"], row]}
    order = list(MODELS)
    results["rows"] = sorted(rows.values(), key=lambda each: (order.index(each["model"]), each["seed"]))
    write_atomically(path, json.dumps(results) + "\n")
    write_atomically(path.with_suffix(".md"), as_markdown(results["rows"]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it, with RPM-Net's shapes")
    parser.add_argument("--only", nargs="+", choices=MODELS, default=list(MODELS), help="these models")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of weights and pairs")
    parser.add_argument("--minutes", type=float, default=6.0, help="of training each")
    flags = parser.parse_args()
    shapes = load_shapes(flags.data, points=1024)
    test = dict.fromkeys(PROTOCOLS, load_shapes(flags.data, split="test", points=1024).points[::STRIDE])
    test["rpmnet"] = load_shapes(str(Path(flags.data) / RPMNET), split="test", points=2048).points
    path, settings = HERE / "equal_time.json", {"data": Path(flags.data).name, "minutes": flags.minutes}
    try:
        results = begin(path, settings, shapes)
    except ValueError as error:
        parser.error(str(error))
    there = {(row["model"], row["seed"]) for row in results["rows"]}
    todo = [(name, seed) for seed in flags.seeds for name in flags.only if (name, seed) not in there]
    for name, seed in tqdm(todo, desc="models", unit="run"):
        steps = max(20, round(60 * flags.minutes * results["speeds"][name]))
        keep(path, measured(name, seed, steps, shapes, test))
    print(path.with_suffix(".md").read_text())
