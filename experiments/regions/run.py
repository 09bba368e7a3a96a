"""Whether regions mean something: how many are used, how evenly, and whether both clouds of a pair are cut alike.

    python experiments/regions/run.py --data PATH [--model FILE.npz]

There are two networks: the packaged one, whose regions are by place, and the one in parts.npz beside this file, whose
regions are parts. Pairs are of test shapes. Consistency is the share of points whose counterpart in the other cloud has
the same region: before anything is aligned, on four protocols, and in the last step of the network on clean pairs. A
point's counterpart is the nearest one under the true pose, if it lies within 0.1. Centroids of regions correspond as
far as regions do: the error of the pose that aligns them (Procrustes, each region weighing what eq. 3 gives it, nothing
else of the network) tells how far that goes. Occupancy accuracy is the share of places about the clean target that the
branches call inside or outside rightly. Writes results.json, table.md, places.png and parts.png beside this file; with
--model it measures another network and prints only.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax import load_model, model_card, rigid
from urrt_jax.clouds import first, make_cloud, subsample
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import find_protocol
from urrt_jax.frames import normalize_pair
from urrt_jax.losses import shell_samples
from urrt_jax.model import Model
from urrt_jax.model.decoder import fusion_weights
from urrt_jax.model.encoding import Encoding
from urrt_jax.model.network import encode, estimate_subsampled, point_regions
from urrt_jax.model.partition import branch_logits, inputs_at_places, occupancy_logits
from urrt_jax.neighbors import nearest
from urrt_jax.rigid import Rigid, procrustes
from urrt_jax.viewer import region_colors
from urrt_jax.weights import DEFAULT

HERE = Path(__file__).parent
STRIDE, BATCH, QUERIES = 4, 64, 256
NEAR = 0.1  # in units of the shape's bounding sphere
NETWORKS = {"places": DEFAULT, "parts": HERE / "parts.npz"}
PROTOCOLS = {
    "dcp": "clean",
    "drift": "P.D.",
    "independent_noise": "independent + noise",
    "incomplete_both": "D.I. two-sided",
}
SHOWN = (
    "airplane", "bed", "bench", "bookshelf", "car", "chair", "guitar", "monitor", "person", "piano", "sofa", "toilet",
)  # fmt: skip


class Cut(NamedTuple):
    """The regions of one pair.

    Attributes:
      source: (N,) label of every source point in its own pose.
      aligned: (N,) its label as the network's last step sees it.
      target: (M,) label of every target point.
      counterpart: (N,) the target point nearest to each source point.
      near: (N,) bool, whether that is near enough to be its counterpart.
      right: (Q,) bool, whether each place about the target is rightly called inside or outside.
      off: (), the degrees between the true rotation and that which aligns the regions' centroids.
    """

    source: Array
    aligned: Array
    target: Array
    counterpart: Array
    near: Array
    right: Array
    off: Array


def labels_of(points: Array, encoding: Encoding) -> Array:
    """The regions (N,) of points (N, 3) of an encoded cloud."""
    return point_regions(points, encoding.cloud, encoding.regions.labels)


@jax.jit
def cut(model: Model, sources: Array, targets: Array, rotations: Array, translations: Array) -> Cut:
    """The regions of B pairs of clouds (B, N, 3) and (B, M, 3), whose true pose is known."""

    def one(source_points: Array, target_points: Array, rotation: Array, translation: Array) -> Cut:
        source, target, frame = normalize_pair(make_cloud(source_points), make_cloud(target_points))
        truth = frame.enter(Rigid(rotation, translation))
        before = encode(model, subsample(source, model.config.points))
        answer = estimate_subsampled(model, source, target)
        found = nearest(rigid.apply(truth, source.points), target)
        places, inside = shell_samples(jax.random.key(0), first(target, QUERIES * 2), QUERIES)
        inputs = inputs_at_places(model.config, answer.target.cloud, places, answer.target.condition)
        occupancy = occupancy_logits(branch_logits(model.config, model.params["partition"], inputs))
        ours, theirs = before.regions, answer.target.regions
        aligned = procrustes(ours.centroids, theirs.centroids, fusion_weights(ours.counts, theirs.counts))
        return Cut(
            source=labels_of(source.points, before),
            aligned=labels_of(rigid.apply(answer.seen, source.points), answer.source),
            target=labels_of(target.points, answer.target),
            counterpart=found.index,
            near=found.squared < (NEAR / frame.scale) ** 2,
            right=(occupancy > 0) == inside,
            off=jnp.rad2deg(rigid.rotation_angle(aligned.rotation, truth.rotation)),
        )

    return jax.vmap(one)(sources, targets, rotations, translations)


def entropy(shares: np.ndarray) -> np.ndarray:
    """The entropy in bits of shares (..., n)."""
    return -np.sum(shares * np.log2(np.maximum(shares, 1e-12)), axis=-1)


def cut_all(model: Model, points: np.ndarray, protocol: str, stride: int) -> tuple[Cut, np.ndarray, np.ndarray]:
    """The regions of every ``stride``-th shape's pair, and the clouds of these pairs."""
    pair = find_protocol(protocol)
    trials = [pair(points, item) for item in range(0, len(points), stride)]
    fields = [np.stack([getattr(trial, name) for trial in trials]).astype(np.float32) for name in trials[0]._fields[:4]]
    parts = [
        cut(model, *(jnp.asarray(field[at : at + BATCH]) for field in fields)) for at in range(0, len(trials), BATCH)
    ]
    return jax.tree.map(lambda *each: np.concatenate(each), *parts), fields[0], fields[1]


def consistency(labels: np.ndarray, found: Cut) -> float:
    """The share of points with a counterpart whose counterpart has the same label; ``labels``: (B, N), the source's."""
    matched = np.take_along_axis(np.asarray(found.target), np.asarray(found.counterpart), axis=1)
    return float(np.mean((labels == matched)[np.asarray(found.near)]))


def measure(
    model: Model, points: np.ndarray, stride: int = STRIDE
) -> tuple[dict[str, float], Cut, np.ndarray, np.ndarray]:
    """The numbers, and of the clean pairs the labels and the clouds."""
    all_found = {protocol: cut_all(model, points, protocol, stride) for protocol in PROTOCOLS}
    numbers = {
        f"consistency before alignment, {PROTOCOLS[protocol]}": consistency(np.asarray(found.source), found)
        for protocol, (found, _, _) in all_found.items()
    }
    found, sources, targets = all_found["dcp"]
    shares = np.stack([np.mean(found.target == k, axis=1) for k in range(model.config.regions)], axis=-1)
    numbers = (
        {"pairs": len(sources)}
        | numbers
        | {
            "consistency in the last step, clean": consistency(np.asarray(found.aligned), found),
        }
        | {
            f"degrees off by the regions' centroids, {PROTOCOLS[protocol]}, {name}": summary(cuts.off)
            for protocol, (cuts, _, _) in all_found.items()
            for name, summary in {"median": np.median, "mean": np.mean}.items()
        }
        | {
            "regions with more than 1 % of all points": np.sum(shares.mean(axis=0) > 0.01),
            "regions with more than 1 % of a shape's points, mean": np.mean(np.sum(shares > 0.01, axis=1)),
            "entropy of the sizes, bits, all shapes together": entropy(shares.mean(axis=0)),
            "entropy of the sizes, bits, mean over shapes": np.mean(entropy(shares)),
            "occupancy accuracy": np.mean(found.right),
        }
    )
    return {name: round(float(value), 4) for name, value in numbers.items()}, found, sources, targets


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


def as_markdown(networks: dict[str, dict[str, float]]) -> str:
    """The numbers of each network, side by side."""
    lines = [f"| test pairs | {' | '.join(networks)} |", "|---|" + "---:|" * len(networks)]
    names = next(iter(networks.values()))
    rows = [[name, *(f"{numbers[name]:g}" for numbers in networks.values())] for name in names]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it")
    parser.add_argument("--model", help="a .npz file of 'urrt train', measured instead of the two networks")
    flags = parser.parse_args()
    shapes = load_shapes(flags.data, split="test", points=1024)
    if flags.model:
        print(as_markdown({Path(flags.model).stem: measure(load_model(flags.model), shapes.points)[0]}))
        sys.exit()
    names = np.asarray(shapes.classes)[shapes.labels][::STRIDE]
    shown = {name: int(np.flatnonzero(names == name)[0]) for name in SHOWN}
    networks, cards = {}, {name: model_card(source) for name, source in NETWORKS.items()}
    for name, source in NETWORKS.items():
        networks[name], found, sources, targets = measure(load_model(source), shapes.points)
        draw(found, sources, targets, shown, HERE / f"{name}.png")
    results = {
        "command": f"python experiments/regions/run.py --data {Path(flags.data).name}",
        "model_sha256": cards["places"]["sha256"],
        "parts_sha256": cards["parts"]["sha256"],
        "jax": jax.__version__,
        "numbers": networks,
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "table.md").write_text(as_markdown(networks))
    print(as_markdown(networks))
