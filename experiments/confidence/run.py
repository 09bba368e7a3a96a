"""How honest `Registration.confidence` is at every number of points, and how its numbers are fitted.

    python experiments/confidence/run.py --data PATH [--fit]

Pairs of 32 to 4,096 points a cloud: ModelNet40 by the published protocols, made-up solids without symmetry and views of
them, symmetric solids, different shapes, and sources of 3 to 16 points; many of them turned by any rotation, which
calls for a search; and real scans. A pose is right within 5° and 0.1 (scans: 0.05 diagonals), also about the axis of an
axisymmetric shape, where nothing can be seen of it. With --fit the numbers behind the checks
(`urrt_jax/assessment/confidence.py`) are fitted to pairs of training shapes, and printed: by maximum likelihood, where
a right pose of a symmetric solid counts as one that can't be known, and a wrong pose as much as OVERCAUTION right ones.
(The packaged ones were fitted to these kinds in other proportions.) Without it the packaged numbers are measured on
pairs of test shapes, other solids and scans. Writes results.json, table.md and confidence.png beside this file.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax import Array
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from experiments.reproduce.run import AXISYMMETRIC
from urrt_jax import ICP, Registrations, load_model, model_card, register_pairs, use_compilation_cache
from urrt_jax.assessment import find_alternatives, fit, measure, precision
from urrt_jax.assessment.confidence import CHECKS, MEASURED
from urrt_jax.clouds import Cloud
from urrt_jax.data import load_shapes, procedural_shapes, symmetric_shapes
from urrt_jax.evaluation import Trial, find_protocol, load_scan_pairs, pose_errors, roc_curve
from urrt_jax.evaluation.protocols import draw_pose
from urrt_jax.host import PairOnHost
from urrt_jax.prepared import Sizes, prepare
from urrt_jax.registration import make_options
from urrt_jax.rigid import Rigid
from urrt_jax.stages import rung, sizes_of

HERE = Path(__file__).parent
SUBSET = "modelnet40_2048_normals_subset.npz"
SCANS = "bunny_scans.npz"
SIZES = (32, 64, 128, 256, 512, 1024, 2048, 4096)
FEW = (3, 4, 5, 6, 8, 12, 16)
MODELNET_POINTS, RPMNET_KEPT = 1024, 0.7
SEEDS: dict[str, int] = {"train": 11, "test": 0}
COUNTS = {128: 100, 512: 40, 4096: 20}  # pairs of a protocol, of clouds of at most so many points
FEW_COUNT = 10  # pairs of few points, of each number
OVERCAUTION = 3.0  # chosen on training pairs: those of every size then keep within 1 % and 5 %, nearly
RIDGE = 1e-4
Split = Literal["train", "test"]


class Group(NamedTuple):
    """Pairs of one kind and size.

    Attributes:
      kind: what they are.
      points: of each cloud; of scans 0, of few points those of the source.
      trials: the pairs.
      known: (B,) bool, whether a right pose can be told from others: not of symmetric solids.
      asymmetric: (B,) bool, whether the shape is known to have no symmetry of rotation.
      reach: the distance within which a translation is right.
      search: as for ``register``; without one, poses far off are wrong.
    """

    kind: str
    points: int
    trials: Sequence[Trial]
    known: np.ndarray
    asymmetric: np.ndarray
    reach: float = 0.1
    search: Literal["auto"] | None = "auto"


class Answers(NamedTuple):
    """Of B pairs; ``measured`` is (B, 5) for a fit, else empty, and ``normalized`` the error in standard deviations."""

    kind: np.ndarray
    points: np.ndarray
    angle: np.ndarray
    right: np.ndarray
    known: np.ndarray
    asymmetric: np.ndarray
    measured: np.ndarray
    confidence: np.ndarray
    converged: np.ndarray
    normalized: np.ndarray


def groups(data: str, split: Split) -> Iterator[Group]:
    """The pairs of a split; scans are test pairs."""
    modelnet, subset = (
        load_shapes(data, split=split, points=MODELNET_POINTS),
        load_shapes(str(Path(data) / SUBSET), split=split, points=2048),
    )
    for points in SIZES:
        count = next(count for most, count in COUNTS.items() if points <= most)
        yield from modelnet_groups(modelnet, subset, points, count)
        yield from procedural_groups(points, count, SEEDS[split])
        if points >= 256:
            seeds = (SEEDS[split], SEEDS[split] + 50_000)[: 2 if split == "train" else 1]  # they are hard to tell
            for seed in seeds:
                yield from partial_groups(points, count, seed)
        yield from symmetric_groups(points, 2, SEEDS[split])
        if points <= 512:
            yield different_shapes(modelnet, points, count // 2)
            yield different_shapes(procedural_shapes(count // 2, points=points, seed=SEEDS[split]), points, count // 2)
    yield from few_points_groups(SEEDS[split])
    if split == "test":
        trials, _ = load_scan_pairs(Path(data) / SCANS)
        seen = np.ones(len(trials), bool)
        yield Group("real scans", 0, trials, seen, seen, 0.05)
        yield Group("real scans, without search", 0, trials, seen, seen, 0.05, None)


def modelnet_groups(modelnet: Any, subset: Any, points: int, count: int) -> Iterator[Group]:
    kept = 3 * points // 4
    wanted = {
        "clean": "dcp",
        "outliers": "outliers share=0.2",
        "incomplete": f"incomplete_both kept={kept}",
        "PRNet crops": f"prnet_noise kept={kept}",
    }
    if points <= MODELNET_POINTS:
        for kind, protocol in wanted.items():
            yield shape_group(kind, modelnet, protocol, points, count, modelnet.points[:, :points])
    if 2 * points <= MODELNET_POINTS:
        for kind, protocol in {"independent": "independent", "independent, noise": "independent_noise"}.items():
            group = shape_group(kind, modelnet, f"{protocol} points={2 * points}", points, count)
            yield group
            yield any_rotation(group)
    whole = int(points / RPMNET_KEPT)
    if whole <= MODELNET_POINTS:
        group = shape_group("RPM-Net crops", subset, f"rpmnet points={whole}", points, count // 2)
        yield group
        yield any_rotation(group)


def shape_group(
    kind: str, shapes: Any, protocol: str, points: int, count: int, clouds: np.ndarray | None = None
) -> Group:
    """Pairs of evenly spread shapes."""
    draw, items = find_protocol(protocol), np.unique(np.linspace(0, len(shapes) - 1, count).astype(int))
    asymmetric = ~np.isin(np.array(shapes.classes)[shapes.labels[items]], AXISYMMETRIC)
    trials = [draw(shapes.points if clouds is None else clouds, int(item)) for item in items]
    return Group(kind, points, trials, np.ones(len(items), bool), asymmetric)


def procedural_groups(points: int, count: int, seed: int) -> Iterator[Group]:
    shapes = procedural_shapes(count, points=2 * points, seed=seed)
    for kind, protocol in {"solids": "independent", "solids, noise": "independent_noise"}.items():
        draw = find_protocol(f"{protocol} points={2 * points}")
        seen = np.ones(count, bool)
        group = Group(kind, points, [draw(shapes.points, item) for item in range(count)], seen, seen)
        yield group
        yield any_rotation(group)


def partial_groups(points: int, count: int, seed: int) -> Iterator[Group]:
    """Independent samples of which each is cut by a plane of its own, as views are: 70 % are kept."""
    shapes = procedural_shapes(count, points=2 * points, seed=seed + 200)
    draw = find_protocol(f"independent points={2 * points}")
    trials = []
    for item in range(count):
        trial = draw(shapes.points, item)
        along = np.random.default_rng(item).normal(size=(2, 3))
        source, target = (
            cloud[np.argsort(cloud @ direction)[: int(0.7 * points)]]
            for cloud, direction in zip((trial.source, trial.target), along, strict=True)
        )
        trials.append(trial._replace(source=source, target=target))
    seen = np.ones(count, bool)
    group = Group("views of solids", points, trials, seen, seen)
    yield group
    yield any_rotation(group)


def symmetric_groups(points: int, rounds: int, seed: int) -> Iterator[Group]:
    kinds = len(symmetric_shapes(1, points=1).classes)
    shapes = symmetric_shapes(rounds * kinds, points=2 * points, seed=seed)
    for kind, noise, exact in (
        ("symmetric", 0.0, False),
        ("symmetric, noise", 0.01, False),
        ("symmetric, copies", 0.0, True),
    ):
        trials = []
        for item, cloud in enumerate(shapes.points):
            random = np.random.RandomState(item)
            turn, move = draw_pose(random)
            halves = cloud[:points], cloud[:points] if exact else cloud[points:]
            source, target = (half + noise * random.normal(size=half.shape) for half in halves)
            target = random.permutation(target) @ turn.T + move
            trials.append(Trial(source.astype(np.float32), target.astype(np.float32), turn, move))
        known = np.full(len(trials), exact)
        yield Group(kind, points, trials, known, np.zeros(len(trials), bool))


def different_shapes(shapes: Any, points: int, count: int) -> Group:
    """Pairs of two shapes, the second one turned by any rotation: no pose is right."""
    trials = []
    for item in np.linspace(0, len(shapes) - 1, count).astype(int):
        turn = Rotation.from_quat(np.random.default_rng(int(item)).normal(size=4)).as_matrix()
        source, target = shapes.points[item, :points], shapes.points[item - 1, :points]
        nowhere = np.full(3, np.nan)
        trials.append(Trial(source, (target @ turn.T).astype(np.float32), turn, nowhere))
    return Group("different shapes", points, trials, np.zeros(count, bool), np.zeros(count, bool))


def few_points_groups(seed: int) -> Iterator[Group]:
    for whole in (64, 500):
        shapes = procedural_shapes(FEW_COUNT, points=2 * whole, seed=seed + 100)
        draw = find_protocol(f"independent points={2 * whole}")
        for points in FEW:
            trials = [draw(shapes.points, item) for item in range(len(shapes))]
            trials = [trial._replace(source=trial.source[:points]) for trial in trials]
            seen = np.ones(len(trials), bool)
            yield Group(f"few points against {whole}", points, trials, seen, seen)


def any_rotation(group: Group) -> Group:
    """Every other pair of a group, turned by any rotation."""
    every = {name: getattr(group, name)[::2] for name in ("known", "asymmetric")}
    trials = turned(group.trials[::2], group.points)
    return group._replace(kind=f"{group.kind}, any rotation", trials=trials, **every)


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


@jax.jit
def look(sizes: Sizes, source: Cloud, target: Cloud, pose: Rigid) -> Array:
    """What is measured of a pose, (5,), of clouds in their frame."""
    clouds = prepare(sizes, source), prepare(sizes, target)
    others = find_alternatives(clouds[0].samples, clouds[1].samples, pose)
    return measure(fit(*clouds, pose), others, precision(*clouds, pose))


def measured_of(group: Group, found: Registrations) -> np.ndarray:
    """What is measured of the poses that were found, (B, 5)."""
    sizes, measured = sizes_of(make_options(load_model(), ICP(), group.search)), []
    for trial, result in zip(group.trials, found, strict=True):
        pair = PairOnHost(trial.source, trial.target)
        turn: Any = np.asarray(result.rotation, np.float64)
        pose = pair.frame.enter(Rigid(turn, result.translation))
        pose = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), pose)
        measured.append(look(sizes, *pair.padded(rung(pair.size))[:2], pose))
    return np.stack(measured)


def answers(group: Group, fitting: bool) -> Answers:
    """The answers for the pairs of a group; what is measured of them only where it is wanted, for a fit."""
    sources, targets = [trial.source for trial in group.trials], [trial.target for trial in group.trials]
    found = register_pairs(sources, targets, search=group.search)
    truth = [np.stack([getattr(trial, name) for trial in group.trials]) for name in ("rotation", "translation")]
    errors = pose_errors(found.rotation, found.translation, *truth)
    scales = np.array([trial.scale for trial in group.trials])
    count = len(group.trials)
    return Answers(
        kind=np.full(count, group.kind, object),
        points=np.full(count, group.points),
        angle=np.where(np.isnan(errors["distance"]), 180.0, errors["angle"]),
        right=(errors["angle"] < 5) & (errors["distance"] < group.reach * scales),
        known=group.known,
        asymmetric=group.asymmetric,
        measured=measured_of(group, found) if fitting else np.zeros((count, 0)),
        confidence=found.confidence,
        converged=np.asarray(found.converged),
        normalized=normalized_errors(found, *truth),
    )


def normalized_errors(found: Registrations, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """eᵀ C⁻¹ e / 6 of each pair: of the motion e (6,) that is missing and the covariance C; about 1 if C is right."""
    turn = rotation @ found.rotation.swapaxes(1, 2).astype(np.float64)
    move = translation - np.einsum("nij,nj->ni", turn, found.translation)
    motion = np.concatenate([move, Rotation.from_matrix(turn).as_rotvec()], axis=1)
    covariance = np.asarray(found.results.covariance)
    usable: Any = np.isfinite(covariance).all(axis=(1, 2))
    covariance = np.where(usable[:, None, None], covariance, np.eye(6)) + 1e-12 * np.eye(6)
    return np.where(usable, np.einsum("ni,nij,nj->n", motion, np.linalg.inv(covariance), motion) / 6, np.nan)


def measure_all(data: str, split: Split) -> Answers:
    """The answers for all pairs of a split."""
    found = [answers(group, split == "train") for group in tqdm(list(groups(data, split)), desc=split, unit="group")]
    return Answers(*(np.concatenate(each) for each in zip(*found, strict=True)))


def confidences(parameters: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """The logarithm of the confidence, (B,), under these parameters: bias and weights of each check, in order."""
    total, rest = np.zeros(len(measured)), list(parameters)
    for check in CHECKS.values():
        logit = np.full(len(measured), rest.pop(0))
        for name in list(check)[1:]:
            logit = logit + rest.pop(0) * measured[:, MEASURED.index(name)]
        total -= np.logaddexp(0, -logit)
    return total


def regress(found: Answers) -> dict[str, dict[str, float]]:
    """The numbers of all checks that make the answers most likely; all sizes count as the root of how many they are."""
    centre, spread = found.measured.mean(axis=0), found.measured.std(axis=0)
    scaled, known = (found.measured - centre) / spread, found.right & found.known
    _, sizes, counts = np.unique(found.points, return_inverse=True, return_counts=True)
    weights = (counts**-0.5)[sizes] * np.where(known, 1.0, OVERCAUTION)

    def loss(parameters: np.ndarray) -> float:
        right = confidences(parameters, scaled)
        wrong = np.log1p(-np.exp(np.minimum(right, -1e-9)))
        return -float(np.average(np.where(known, right, wrong), weights=weights)) + RIDGE * float(
            parameters @ parameters
        )

    signs = {"score": 1.0, "significance": 1.0, "deviation": -1.0, "uncorrected": -1.0, "spread": 0.0}
    start = [2.0 if name == "bias" else signs[name] for check in CHECKS.values() for name in check]
    rest = list(minimize(loss, np.array(start), method="L-BFGS-B").x)
    numbers = {}
    for check, names in CHECKS.items():
        bias, weights_of = rest.pop(0), {}
        for name in list(names)[1:]:
            k = MEASURED.index(name)
            weights_of[name] = rest.pop(0) / spread[k]
            bias -= weights_of[name] * centre[k]
        numbers[check] = {name: round(float(value), 2) for name, value in {"bias": bias, **weights_of}.items()}
    return numbers


def as_row(name: str, found: Answers) -> dict:
    """What a table says of some answers."""
    called, right = found.converged, found.right
    uneven = right & found.asymmetric
    both = right.any() and not right.all()

    def share(part: np.ndarray, of: np.ndarray) -> float | None:
        return float(np.mean(part[of])) if of.any() else None

    return {
        "pairs_of": name,
        "pairs": len(called),
        "right": float(np.mean(right)),
        "called": int(called.sum()),
        "beyond_5": share(found.angle > 5, called),
        "beyond_45": share(found.angle > 45, called),
        "right_called": share(called, right),
        "right_asymmetric_called": share(called, uneven),
        "auc": roc_curve(right, found.confidence)[2] if both else None,
    }


def as_rows(found: Answers) -> dict[str, list[dict]]:
    """The rows by number of points, by kind, and of the covariance."""

    def part(rows: np.ndarray) -> Answers:
        return Answers(*(values[rows] for values in found))

    shapes = ~np.char.startswith(found.kind.astype(str), "few") & (found.points > 0)
    by_points = [as_row(f"{points} points", part(shapes & (found.points == points))) for points in SIZES]
    solids = np.char.startswith(found.kind.astype(str), "solids")
    for row, points in zip(by_points, SIZES, strict=True):
        row["right_solids_called"] = as_row("", part(solids & (found.points == points)))["right_asymmetric_called"]
    kinds = list(dict.fromkeys(found.kind))
    by_kind = [as_row(kind, part(found.kind == kind)) for kind in kinds]
    noisy = np.isin(found.kind, ["independent, noise", "solids, noise", "PRNet crops"])
    covariance = []
    for points in SIZES:
        errors = found.normalized[noisy & found.right & found.asymmetric & (found.points == points)]
        if len(errors):
            covariance.append({"points": points, "pairs": len(errors), "mean": float(np.mean(errors)),
                               "median": float(np.median(errors))})  # fmt: skip
    return {"by_points": by_points, "by_kind": by_kind, "covariance": covariance}


def as_markdown(results: dict) -> str:
    def per_cent(value: float | None) -> str:
        return "" if value is None else f"{100 * value:.1f}"

    lines = []
    for title, rows in (("points a cloud", results["by_points"]), ("pairs", results["by_kind"])):
        lines += [
            f"| {title} | pairs | right, % | called converged | of these > 5°, % | > 45°, % "
            "| right ones called, % | right ones of asymmetric shapes called, % | AUC |",
            "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        ]
        for row in rows:
            auc = "" if row["auc"] is None else f"{row['auc']:.3f}"
            name = row["pairs_of"].removesuffix(" points")
            lines.append(
                f"| {name} | {row['pairs']} | {per_cent(row['right'])} | {row['called']} | {per_cent(row['beyond_5'])} "
                f"| {per_cent(row['beyond_45'])} | {per_cent(row['right_called'])} "
                f"| {per_cent(row['right_asymmetric_called'])} | {auc} |"
            )
        lines.append("")
    lines += ["| points a cloud | right poses, noise | mean of eᵀC⁻¹e/6 | median |", "|---|---:|---:|---:|"]
    for row in results["covariance"]:
        lines.append(f"| {row['points']} | {row['pairs']} | {row['mean']:.2f} | {row['median']:.2f} |")
    return "\n".join(lines) + "\n"


def draw(results: dict, path: Path) -> None:
    """Left: of the poses called converged, how many are wrong. Right: how many of the right ones are called so."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), dpi=150)
    rows = results["by_points"]
    for key, label, color in (("beyond_5", "more than 5° off", "#d1495b"), ("beyond_45", "more than 45° off", "#222")):
        left.plot(SIZES, [100 * (row[key] or 0) for row in rows], "o-", color=color, label=label)
    for key, label, color in (
        ("right_solids_called", "solids without symmetry", "#1b7f79"),
        ("right_asymmetric_called", "all but axisymmetric shapes", "#7a9cc6"),
    ):
        values = [np.nan if row[key] is None else 100 * row[key] for row in rows]
        right.plot(SIZES, values, "o-", color=color, label=label)
    left.set(title="wrong, of those called converged, %", ylim=(0, 10))
    right.set(title="called converged, of right ones, %", ylim=(0, 102))
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(SIZES, [str(size) for size in SIZES])
        axes.set_xlabel("points a cloud")
        axes.legend(frameon=False, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40, with the subset and the scans beside it")
    parser.add_argument("--fit", action="store_true", help="only fit the numbers to training shapes, and print them")
    flags = parser.parse_args()
    use_compilation_cache()
    found = measure_all(flags.data, "train" if flags.fit else "test")
    if flags.fit:
        print(json.dumps(regress(found), indent=1))
        raise SystemExit
    results = {
        "command": f"python experiments/confidence/run.py --data {Path(flags.data).name}",
        "model_sha256": model_card()["sha256"],
        "jax": jax.__version__,
        "checks": CHECKS,
        **as_rows(found),
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "table.md").write_text(as_markdown(results))
    draw(results, HERE / "confidence.png")
    print(as_markdown(results))
