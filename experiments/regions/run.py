"""Whether regions mean something: how many are used, how evenly, and whether both clouds of a pair are cut alike.

    python experiments/regions/run.py --data PATH

Clean pairs of DCP's protocol, test shapes, the network's points. Consistency is the share of points whose counterpart
in the other cloud has the same region: before anything is aligned, and in the last step of the network. Writes
results.json, table.md and regions.png beside this file.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax import load_model, model_card, rigid
from urrt_jax.clouds import make_cloud, subsample
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import find_protocol
from urrt_jax.frames import normalize_pair
from urrt_jax.model import Model
from urrt_jax.model.network import encode, estimate_subsampled, point_regions
from urrt_jax.neighbors import nearest
from urrt_jax.rigid import Rigid
from urrt_jax.viewer import region_colors

HERE = Path(__file__).parent
STRIDE, BATCH = 4, 64
SHOWN = (
    "airplane", "bed", "bench", "bookshelf", "car", "chair", "guitar", "monitor", "person", "piano", "sofa", "toilet",
)  # fmt: skip


class Cut(NamedTuple):
    """The regions of one pair.

    Attributes:
      source: (N,) label of every source point in its own pose.
      aligned: (N,) its label as the network's last step sees it.
      target: (N,) label of every target point.
      counterpart: (N,) the target point that each source point is.
    """

    source: Array
    aligned: Array
    target: Array
    counterpart: Array


@jax.jit
def cut(model: Model, sources: Array, targets: Array, rotations: Array, translations: Array) -> Cut:
    """The regions of B pairs of clean clouds (B, N, 3), whose true pose is known."""

    def one(source_points: Array, target_points: Array, rotation: Array, translation: Array) -> Cut:
        source, target, frame = normalize_pair(make_cloud(source_points), make_cloud(target_points))
        truth = frame.enter(Rigid(rotation, translation))
        answer = estimate_subsampled(model, source, target)
        return Cut(
            source=point_regions(model, source.points, encode(model, subsample(source, model.config.points))),
            aligned=point_regions(model, rigid.apply(answer.seen, source.points), answer.source),
            target=point_regions(model, target.points, answer.target),
            counterpart=nearest(rigid.apply(truth, source.points), target).index,
        )

    return jax.vmap(one)(sources, targets, rotations, translations)


def entropy(shares: np.ndarray) -> np.ndarray:
    """The entropy in bits of shares (..., n)."""
    return -np.sum(shares * np.log2(np.maximum(shares, 1e-12)), axis=-1)


def measure(model: Model, points: np.ndarray) -> tuple[dict[str, float], Cut, np.ndarray, np.ndarray]:
    """The numbers, the labels of all pairs, and their clouds."""
    draw = find_protocol("dcp")
    trials = [draw(points, item) for item in range(0, len(points), STRIDE)]
    fields = [np.stack([getattr(trial, name) for trial in trials]).astype(np.float32) for name in trials[0]._fields[:4]]
    parts = [
        cut(model, *(jnp.asarray(field[at : at + BATCH]) for field in fields)) for at in range(0, len(trials), BATCH)
    ]
    found: Cut = jax.tree.map(lambda *each: np.concatenate(each), *parts)
    matched = np.take_along_axis(np.asarray(found.target), np.asarray(found.counterpart), axis=1)
    shares = np.stack([np.mean(found.target == k, axis=1) for k in range(model.config.regions)], axis=-1)
    numbers = {
        "pairs": len(trials),
        "consistency before alignment": np.mean(found.source == matched),
        "consistency in the last step": np.mean(found.aligned == matched),
        "regions with more than 1 % of all points": np.sum(shares.mean(axis=0) > 0.01),
        "regions with more than 1 % of a shape's points, mean": np.mean(np.sum(shares > 0.01, axis=1)),
        "entropy of the sizes, bits, all shapes together": entropy(shares.mean(axis=0)),
        "entropy of the sizes, bits, mean over shapes": np.mean(entropy(shares)),
    }
    return {name: round(float(value), 4) for name, value in numbers.items()}, found, fields[0], fields[1]


def draw(found: Cut, sources: np.ndarray, targets: np.ndarray, rows: dict[str, int], path: Path) -> None:
    """For one pair of each category, the source and the target side by side, every point in its region's colour."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 8, figsize=(12, 4.8), dpi=150)
    view = np.asarray(rigid.rotation_from_6d(jnp.array([0.83, 0.25, -0.5, 0.0, 0.9, 0.45])))
    panels = [(name, row, side) for name, row in rows.items() for side in ("source", "target")]
    for axis, (name, row, side) in zip(axes.flat, panels, strict=True):
        cloud = (sources if side == "source" else targets)[row]
        shown = (cloud - cloud.mean(axis=0)) @ view
        nearer = np.argsort(shown[:, 2])
        colors = region_colors(np.asarray(getattr(found, side)[row]))[nearer] / 255
        axis.scatter(shown[nearer, 0], shown[nearer, 1], s=2.5, c=colors, linewidths=0)
        axis.set(aspect="equal", title=f"{name.replace('_', ' ')}, {side}")
        axis.title.set_fontsize(8)
        axis.axis("off")
    figure.tight_layout(pad=0.4)
    figure.savefig(path)
    plt.close(figure)


def as_markdown(results: dict) -> str:
    lines = ["| clean test pairs | |", "|---|---:|"]
    return "\n".join(lines + [f"| {name} | {value:g} |" for name, value in results["numbers"].items()]) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it")
    flags = parser.parse_args()
    shapes = load_shapes(flags.data, split="test", points=1024)
    names = np.asarray(shapes.classes)[shapes.labels][::STRIDE]
    numbers, found, sources, targets = measure(load_model(), shapes.points)
    results = {
        "command": f"python experiments/regions/run.py --data {Path(flags.data).name}",
        "model_sha256": model_card()["sha256"],
        "jax": jax.__version__,
        "numbers": numbers,
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "table.md").write_text(as_markdown(results))
    draw(found, sources, targets, {name: int(np.flatnonzero(names == name)[0]) for name in SHOWN}, HERE / "regions.png")
    print(as_markdown(results))
