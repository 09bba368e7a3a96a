"""The paper's ablation: do regions pay? Models A, B and C, trained for the same time with three seeds each.

    python experiments/ablation/run.py --data PATH [--only NAME ...]

A has one decoder for the whole shape. B has regions, attention between them and a decoder for each region. C is B with
a position encoding of the regions' centroids. They are compared with either kind of decoder:

* landmarks: the network that the package uses, trained on its usual mixture of clean and corrupted pairs. Model A,
  which has no regions, has as many landmarks as the regions of the others together. C is also trained with the
  paper's regions, which depend on where points lie ("places").
* pose: decoders regress the pose, as the paper may mean it. One step, trained on clean pairs, as in the paper.

All models of a kind train for the same time: slower ones for fewer steps. The network alone is measured on every fourth
test shape, and on all shapes of RPM-Net's protocol; checkpoints are chosen on shapes held out of the training split.
Runs are kept in runs/ beside this file: an interrupted command continues where it stopped, and commands with other
names may run beside each other. Writes results.json and table.md beside this file, with the models that are there.
"""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from urrt_jax.atomic import write_atomically
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
STRIDE = 4
PROTOCOLS = {
    "dcp": "clean",
    "incomplete_both": "D.I. two-sided",
    "drift": "P.D.",
    "outliers": "D.O.",
    "independent_noise": "independent + noise",
    "rpmnet": "RPM-Net crops",
}
PARTIAL = ("incomplete_both", "rpmnet")
RPMNET = "modelnet40_2048_normals_subset.npz"
DRAWS = 2000  # of the bootstrap


class Named(NamedTuple):
    """A model of the table: its kind of decoders, what its network has, and steps that take as long as the others'."""

    decoder: str
    model: dict[str, Any]
    steps: int


MODELS = {
    "A": Named("landmarks", {"variant": "A", "landmarks": 64}, 440),
    "B": Named("landmarks", {"variant": "B", "partition": "parts"}, 400),
    "C": Named("landmarks", {"variant": "C", "partition": "parts"}, 400),
    "C, places": Named("landmarks", {"variant": "C", "partition": "places"}, 410),
    "A, pose": Named("pose", {"variant": "A"}, 2_000),
    "B, pose": Named("pose", {"variant": "B", "partition": "parts"}, 1_600),
    "C, pose": Named("pose", {"variant": "C", "partition": "parts"}, 1_600),
    "C, pose, places": Named("pose", {"variant": "C", "partition": "places"}, 1_800),
}
_POSE = {"decoder": "pose", "lookups": 0, "consensus": 0, "hypotheses": 0, "steps": 1, "points": 256}


def configured(name: str, seed: int) -> TrainConfig:
    """How one of the models is trained."""
    decoder, model, steps = MODELS[name]
    if decoder == "landmarks":
        method, pairs, batch = URRT(model=ModelConfig(**model)), PairConfig(ramp_share=0.2), 16
    else:
        method = URRT(model=ModelConfig(**model, **_POSE), loss_points=256)
        pairs, batch = PairConfig(points=512, corrupted=0.0, signed=0.0, both_ways=0.0), 32
    return TrainConfig(
        method=method, pairs=pairs, batch=batch, steps=steps, warmup=50, learning_rate=1.5e-3, steps_per_call=10,
        seed=seed,
    )  # fmt: skip


def folder(name: str, seed: int) -> Path:
    """Where a model's run is kept."""
    return HERE / "runs" / f"{name.replace(', ', '_')}_{seed}"


def trained(name: str, seed: int, shapes: Shapes) -> tuple[Ours, float]:
    """The network of a model, trained if its run is not there yet, and the seconds that its training took."""
    config = configured(name, seed)
    held_in, held_out = shapes.split_validation(0.05, seed)
    run = folder(name, seed)
    variables = train(config, held_in, held_out, run, loop=LoopConfig(every=config.steps, validation_pairs=64))
    log = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    model = config.method.as_model(variables)
    return Ours(model=model, refine=None, name=name), max(entry.get("seconds", 0.0) for entry in log)


def angles(ours: Ours, data: dict[str, np.ndarray], run: Path) -> dict[str, list[float]]:
    """The error of every item in degrees, by protocol."""
    found = {}
    for protocol in tqdm(PROTOCOLS, desc=ours.name, unit="protocol"):
        points = data["rpmnet" if protocol == "rpmnet" else "others"]
        items = np.arange(0, len(points), 1 if protocol == "rpmnet" else STRIDE)
        save = run / f"{protocol}.npz"
        found[protocol] = evaluate(ours, protocol, points, items=items, save=save, progress=False).errors()["angle"]
    return {protocol: np.round(values, 4).tolist() for protocol, values in found.items()}


def ratio(first: list[list[float]], second: list[list[float]]) -> tuple[float, float, float]:
    """The mean error of the first model over that of the second, and its 95 % interval.

    Args:
      first: (seeds, items), errors.
      second: the same of the other model, on the same items.

    Returns:
      The ratio, and the bounds of a bootstrap over seeds, of either model for itself, and items, of both alike.
    """
    one, other, draw = np.asarray(first), np.asarray(second), np.random.default_rng(0)
    ratios = []
    for _ in range(DRAWS):
        items = draw.integers(0, one.shape[1], one.shape[1])
        sums = [each[draw.integers(0, len(each), len(each))][:, items].mean() for each in (one, other)]
        ratios.append(sums[0] / sums[1])
    low, high = np.quantile(ratios, [0.025, 0.975])
    return float(one.mean() / other.mean()), float(low), float(high)


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Mean errors and their deviation over the seeds, then each model with regions against A of its kind."""
    titles = " | ".join(PROTOCOLS.values())
    lines = [f"| mean error | steps | {titles} |", "|---|---:|" + "---:|" * len(PROTOCOLS)]
    for row in rows:
        means = {protocol: np.mean(each, axis=1) for protocol, each in row["angles"].items()}
        cells = [f"{each.mean():.2f}° ± {each.std(ddof=1) if len(each) > 1 else 0:.2f}" for each in means.values()]
        lines.append(f"| {row['model']} | {row['steps']:,} | " + " | ".join(cells) + " |")
    lines += ["", f"| error, model A = 1 | {titles} |", "|---|" + "---:|" * len(PROTOCOLS)]
    plain = {row["decoder"]: row for row in rows if MODELS[row["model"]].model["variant"] == "A"}
    for row in rows:
        base = plain.get(row["decoder"])
        if base is None or base is row:
            continue
        cells = []
        for protocol in PROTOCOLS:
            middle, low, high = ratio(row["angles"][protocol], base["angles"][protocol])
            cells.append(f"{middle:.2f} ({low:.2f} to {high:.2f})")
        lines.append(f"| {row['model']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def keep(row: dict[str, Any], seed: int, data: str) -> list[dict[str, Any]]:
    """Writes what one model with one seed has reached beside what is there, and returns all rows in order."""
    written = HERE / "results.json"
    command = f"python experiments/ablation/run.py --data {data}"
    before = json.loads(written.read_text()) if written.exists() else {}
    # Read only now: commands may run side by side. Rows of other data or another training would not compare.
    rows = {each["model"]: each for each in before.get("rows", []) if before.get("command") == command}
    old = rows.get(row["model"])
    if old is not None and old["training"] == row["training"]:
        seeds = sorted({*old["seeds"], seed})
        for name in ("angles", "seconds"):
            row[name] = _merged(old[name], old["seeds"], row[name], seed, seeds)
        row["seeds"] = seeds
    rows[row["model"]] = row
    ordered = [rows[name] for name in MODELS if name in rows]
    write_atomically(written, json.dumps({"command": command, "jax": jax.__version__, "rows": ordered}) + "\n")
    write_atomically(HERE / "table.md", as_markdown(ordered))
    return ordered


def _merged(old: Any, old_seeds: list[int], new: Any, seed: int, seeds: list[int]) -> Any:
    """Values by seed, those of ``seed`` taken from the new ones; of every protocol where they are by protocol."""
    if isinstance(new, dict):
        return {name: _merged(old[name], old_seeds, new[name], seed, seeds) for name in new}
    values = dict(zip(old_seeds, old, strict=True)) | {seed: new[0]}
    return [values[each] for each in seeds]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it, and RPM-Net's shapes")
    parser.add_argument("--only", nargs="+", default=list(MODELS), help="names of models", metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=int, choices=SEEDS, default=SEEDS, help="seeds of the training")
    flags = parser.parse_args()
    if unknown := sorted(set(flags.only) - set(MODELS)):
        parser.error(f"no models {unknown}; there are {list(MODELS)}")
    shapes = load_shapes(flags.data, points=1024)
    clouds = {
        "others": load_shapes(flags.data, split="test", points=1024).points,
        "rpmnet": load_shapes(str(Path(flags.data) / RPMNET), split="test", points=2048).points,
    }
    for seed in flags.seeds:
        for name in flags.only:
            ours, seconds = trained(name, seed, shapes)
            row = {
                "model": name,
                "decoder": MODELS[name].decoder,
                "steps": MODELS[name].steps,
                "training": json.loads(json.dumps(dataclasses.replace(configured(name, seed), seed=0).as_dict())),
                "seeds": [seed],
                "seconds": [round(seconds, 1)],
                "angles": {protocol: [each] for protocol, each in angles(ours, clouds, folder(name, seed)).items()},
            }
            jax.clear_caches()  # programs of many models would be too much for the compiler's memory
            print(as_markdown(keep(row, seed, Path(flags.data).name)))
