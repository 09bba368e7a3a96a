"""How well `Registration.confidence` tells right poses from wrong ones, and how its five numbers are fitted.

    python experiments/confidence/run.py --data PATH [--fit]

The numbers are a logistic regression on training shapes: pairs of the hard protocols as they are, the same pairs turned
by any rotation (half of which the network misses), and searched ones. "regression" in the results is this run's, as the
packaged ones were once; "left out" says which of the two to prefer: the mean log loss on each protocol, of a regression
on the others, and of the packaged numbers. With --fit only these are found, and printed. The curves are of test shapes
and real scans that no number was fitted to. A pose is right within 5° and 0.1 (scans: 0.05 diagonals), which for
axisymmetric shapes is not decided by what can be seen: the curve without these stands beside that of all. Writes
results.json, table.md and roc.png beside this file.
"""

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import numpy as np
from jax import Array
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.reproduce.run import AXISYMMETRIC
from urrt_jax import ICP, Search, load_model, model_card, register_pairs
from urrt_jax.assessment import ASSESSED, BIAS, fit
from urrt_jax.clouds import Cloud
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import Trial, find_protocol, load_scan_pairs, pose_errors, roc_curve
from urrt_jax.host import PairOnHost
from urrt_jax.model import Model
from urrt_jax.prepared import Sizes, prepare
from urrt_jax.registration import make_options
from urrt_jax.rigid import Rigid
from urrt_jax.stages import rung, sizes_of

HERE = Path(__file__).parent
PROTOCOLS = ("incomplete_both", "outliers share=0.2", "independent_noise", "prnet_noise", "drift", "rpmnet")
SUBSET = "modelnet40_2048_normals_subset.npz"
SCANS = "bunny_scans.npz"
PAIRS, SEARCHED = 80, 40
RIDGE = 3e-4


class Answers(NamedTuple):
    """Of B pairs: whether the pose is right, what it was told by (B, 4), the confidence, and whether turns are seen."""

    right: np.ndarray
    told_by: np.ndarray
    confidence: np.ndarray
    asymmetric: np.ndarray


@jax.jit
def evidence(sizes: Sizes, source: Cloud, target: Cloud, pose: Rigid) -> Array:
    """What the confidence in a pose is made of, (4,), of clouds in their frame."""
    return fit(prepare(sizes, source), prepare(sizes, target), pose).evidence


def answers(
    model: Model, trials: Sequence[Trial], asymmetric: np.ndarray, search: Search | None, reach: float
) -> Answers:
    sources, targets = [trial.source for trial in trials], [trial.target for trial in trials]
    found = register_pairs(sources, targets, model=model, search=search, progress=True)
    sizes, told_by = sizes_of(make_options(model, ICP(), search)), []
    for source, target, result in zip(sources, targets, found, strict=True):
        pair = PairOnHost(source, target)
        clouds = pair.padded(rung(pair.size))[:2]
        told_by.append(evidence(sizes, *clouds, pair.frame.enter(Rigid(result.rotation, result.translation))))
    truth = [np.stack([getattr(trial, name) for trial in trials]) for name in ("rotation", "translation")]
    errors = pose_errors(found.rotation, found.translation, *truth)
    scales = np.array([trial.scale for trial in trials])
    right = (errors["angle"] < 5) & (errors["distance"] < reach * scales)
    return Answers(right, np.stack(told_by), found.confidence, asymmetric)


def trials_of(protocol: str, data: str, split: Literal["train", "test"], count: int) -> tuple[list[Trial], np.ndarray]:
    """Pairs of a protocol, evenly spread, and which of them are of categories that are not axisymmetric."""
    rpmnet = protocol == "rpmnet"
    source = str(Path(data) / SUBSET) if rpmnet else data
    shapes = load_shapes(source, split=split, points=2048 if rpmnet else 1024)
    draw, items = find_protocol(protocol), np.unique(np.linspace(0, len(shapes) - 1, count).astype(int))
    asymmetric = ~np.isin(np.array(shapes.classes)[shapes.labels[items]], AXISYMMETRIC)
    return [draw(shapes.points, int(item)) for item in items], asymmetric


def turned(trials: Sequence[Trial], seed: int) -> list[Trial]:
    """The same pairs with targets turned by any rotation."""
    draw = np.random.default_rng(seed)
    turns = Rotation.from_quat(draw.normal(size=(len(trials), 4))).as_matrix()
    return [
        trial._replace(
            target=(trial.target @ turn.T).astype(np.float32),
            rotation=turn @ trial.rotation,
            translation=turn @ trial.translation,
            expected=None,
        )
        for trial, turn in zip(trials, turns, strict=True)
    ]


def measure(model: Model, data: str, split: Literal["train", "test"]) -> dict[str, Answers]:
    """The answers for every protocol: as the pairs are, turned by any rotation, and these searched."""
    found = {}
    for protocol in tqdm(PROTOCOLS, desc=split):
        trials, asymmetric = trials_of(protocol, data, split, PAIRS)
        anyhow, every = turned(trials, 1), PAIRS // SEARCHED
        parts = [
            answers(model, trials, asymmetric, None, 0.1),
            answers(model, anyhow, asymmetric, None, 0.1),
            answers(model, anyhow[::every], asymmetric[::every], Search(), 0.1),
        ]
        found[protocol] = together(parts)
    return found


def log_loss(weights: np.ndarray, found: Answers) -> float:
    """Of right against wrong, under a bias and one weight for each of ``ASSESSED``."""
    logit = found.told_by @ weights[1:] + weights[0]
    return float(np.mean(np.logaddexp(0, np.where(found.right, -logit, logit))))


def regress(found: list[Answers]) -> np.ndarray:
    """The logistic regression: bias and one weight for each of ``ASSESSED``."""
    every = together(found)
    return minimize(lambda x: log_loss(x, every) + RIDGE * np.sum(x[1:] ** 2), np.zeros(1 + len(ASSESSED))).x


def left_out(found: dict[str, Answers]) -> dict[str, float]:
    """The mean log loss on each protocol, of regressions on the others and of the packaged numbers."""
    packaged = np.array([BIAS, *ASSESSED.values()])
    others = {name: regress([each for other, each in found.items() if other != name]) for name in found}
    return {
        "regressions": float(np.mean([log_loss(others[name], each) for name, each in found.items()])),
        "packaged": float(np.mean([log_loss(packaged, each) for each in found.values()])),
    }


def together(found: Iterable[Answers]) -> Answers:
    return Answers(*(np.concatenate(each) for each in zip(*found, strict=True)))


def draw_curves(rows: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(5.4, 4.2), dpi=150)
    for row in rows:
        wide = 2.4 if row["pairs_of"].startswith("all") else 1.1
        axes.plot(
            row["false_positives"], row["true_positives"], linewidth=wide, label=f"{row['pairs_of']}  {row['auc']:.3f}"
        )
    axes.plot([0, 1], [0, 1], color="#c9d0d6", linewidth=0.8, zorder=0)
    axes.set(xlim=(0, 1), ylim=(0, 1.01), xlabel="wrong poses taken for right", ylabel="right poses taken for right")
    axes.legend(title="area under the curve", fontsize=7, title_fontsize=7, frameon=False, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def as_row(name: str, found: Answers) -> dict:
    false, true, area = roc_curve(found.right, found.confidence)
    kept = np.unique(np.linspace(0, len(false) - 1, 200).astype(int))
    said = found.confidence >= 0.5
    return {
        "pairs_of": name,
        "pairs": len(said),
        "right": float(np.mean(found.right)),
        "auc": area,
        "said_right_of_right": float(np.mean(said[found.right])),
        "said_right_of_wrong": float(np.mean(said[~found.right])) if not found.right.all() else None,
        "false_positives": np.round(false[kept], 4).tolist(),
        "true_positives": np.round(true[kept], 4).tolist(),
    }


def as_markdown(results: dict) -> str:
    lines = [
        "| pairs | number | right | AUC | right ones called converged | wrong ones |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for row in results["rows"]:
        wrong = "" if row["said_right_of_wrong"] is None else f"{row['said_right_of_wrong']:.3f}"
        lines.append(
            f"| {row['pairs_of']} | {row['pairs']} | {row['right']:.3f} | {row['auc']:.3f} "
            f"| {row['said_right_of_right']:.3f} | {wrong} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40, with the subset and the scans beside it")
    parser.add_argument("--fit", action="store_true", help="only fit the numbers, and print them")
    flags = parser.parse_args()
    model = load_model()
    training = measure(model, flags.data, "train")
    weights = dict(zip(("bias", *ASSESSED), np.round(regress(list(training.values())), 1).tolist(), strict=True))
    fitted = {"regression": weights, "left out": left_out(training)}
    if flags.fit:
        print(json.dumps(fitted))
        raise SystemExit
    test = measure(model, flags.data, "test")
    scans, _ = load_scan_pairs(Path(flags.data) / SCANS)
    seen = np.ones(len(scans), bool)
    test["real scans"] = together([answers(model, scans, seen, search, 0.05) for search in (None, Search())])
    test["all"] = together(test.values())
    test["all but axisymmetric shapes"] = Answers(*(values[test["all"].asymmetric] for values in test["all"]))
    results = {
        "command": f"python experiments/confidence/run.py --data {Path(flags.data).name}",
        "model_sha256": model_card()["sha256"],
        "jax": jax.__version__,
        **fitted,
        "rows": [as_row(name, found) for name, found in test.items()],
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "table.md").write_text(as_markdown(results))
    draw_curves(results["rows"], HERE / "roc.png")
    print(as_markdown(results))
