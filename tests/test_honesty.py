"""`register` says so where it can't know: few points, symmetric shapes, and clouds that do not lie on each other."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import register, register_pairs
from urrt_jax.assessment import moved_covariance
from urrt_jax.data import procedural_shapes, symmetric_shapes, symmetry
from urrt_jax.result import Outcome, Registration

_POINTS = 250  # of each cloud: the first rung, which many tests share
_TURN = Rotation.from_euler("xyz", [20, -15, 30], degrees=True)


def _posed(points: np.ndarray) -> np.ndarray:
    return (_TURN.apply(points) + np.array([0.2, -0.1, 0.3])).astype(np.float32)


def _halves(points: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Two halves of a cloud, the second one posed."""
    order = np.random.default_rng(seed).permutation(len(points))
    one, other = np.array_split(points[order], 2)
    return one, _posed(other)


def _degrees_off(result: Registration) -> float:
    turn = Rotation.from_matrix(np.asarray(result.rotation)) * _TURN.inv()
    return float(np.rad2deg(turn.magnitude()))


@pytest.fixture(scope="module")
def uneven() -> np.ndarray:
    """Shapes without symmetry, (12, 2·P, 3)."""
    return procedural_shapes(12, points=2 * _POINTS, seed=5).points


def test_a_right_pose_of_an_uneven_shape_is_called_converged(uneven):
    pairs = [_halves(points) for points in uneven]
    found = register_pairs(*zip(*pairs, strict=True))
    right = np.array([_degrees_off(each) < 5 for each in found])
    assert right.sum() >= 9
    assert found.converged[right].mean() >= 0.8
    assert not found.converged[~right].any()


def test_a_handful_of_points_is_not_called_converged(uneven):
    pairs = [_halves(points) for points in uneven]
    counts = [3, 4, 5, 6, 8]
    sources = [source[:count] for count in counts for source, _ in pairs]
    found = register_pairs(sources, [target for _, target in pairs] * len(counts))
    wrong = np.array([_degrees_off(each) > 5 for each in found])
    assert not found.converged[wrong].any()


def test_confidence_is_low_where_one_cloud_is_a_speck_beside_the_other(uneven):
    """As where one is in millimetres: it lies on the other in any rotation."""
    pairs = [_halves(points) for points in uneven[:8]]
    factors = np.float32([1000, 39.37, 1 / 39.37, 1 / 1000])
    sources = [factor * source for factor in factors for source, _ in pairs]
    found = register_pairs(sources, [target for _, target in pairs] * len(factors))
    assert found.confidence.max() < 0.3


_KINDS = ["cylinder", "prism_3", "prism_5", "prism_6", "propeller_2", "propeller_3", "propeller_5", "cube", "cone"]


@pytest.mark.parametrize("kind", _KINDS)
def test_samples_of_a_symmetric_solid_are_not_called_converged(kind):
    shapes = symmetric_shapes(36, points=2 * _POINTS, seed=4)
    clouds = shapes.points[shapes.labels == list(shapes.classes).index(kind)]
    found = register_pairs(*zip(*(_halves(points) for points in clouds), strict=True))
    assert not found.converged.any()


def test_the_alternatives_of_a_prism_are_its_turns():
    shapes = symmetric_shapes(18, points=2 * _POINTS, seed=4)
    found = register(*_halves(shapes.points[list(shapes.classes).index("prism_3")]))
    assert found.outcome == Outcome.AMBIGUOUS
    assert found.reason.startswith("another pose fits about as well: turned by ")
    others = found.alternatives
    assert 0.2 < float(others.weight.sum()) < 1
    between = np.asarray(others.rotation[0]) @ np.asarray(found.rotation).T
    symmetries = _TURN.as_matrix() @ symmetry("prism_3") @ _TURN.as_matrix().T
    angles = Rotation.from_matrix(between @ symmetries.swapaxes(1, 2)).magnitude()
    assert np.rad2deg(angles[1:].min()) < 12


def _ring(count: int) -> np.ndarray:
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


def _repeated(times: int) -> np.ndarray:
    """A blob beside the axis, turned about it this many times."""
    blob = np.random.default_rng(0).normal(scale=0.2, size=(240 // times, 3)) + np.array([1, 0, 0.2])
    turns = Rotation.from_euler("z", np.arange(times)[:, None] * 360 / times, degrees=True)
    return np.concatenate([turn.apply(blob) for turn in turns])


_REGULAR = {
    "ring": _ring(100),
    "grid": np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3),
    "cylinder": np.concatenate([_ring(24) + np.array([0, 0, z]) for z in np.linspace(-1, 1, 9)]),
    "cube": np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3),
    "3-fold": _repeated(3),
    "5-fold": _repeated(5),
    "7-fold": _repeated(7),
}


@pytest.mark.parametrize("name", _REGULAR)
def test_a_copy_of_a_regular_cloud_is_ambiguous(name):
    """Every point has a counterpart, in each of several poses."""
    points = _REGULAR[name].astype(np.float32)
    found = register(points, _posed(points))
    assert not found.converged
    assert found.outcome in (Outcome.AMBIGUOUS, Outcome.DEGENERATE)


def test_a_copy_of_a_random_sample_is_sure_however_symmetric_the_solid():
    """Its points are not symmetric: one pose puts all of them onto each other."""
    shapes = symmetric_shapes(18, points=_POINTS, seed=4)
    cloud = shapes.points[list(shapes.classes).index("prism_5")]
    found = register(cloud, _posed(cloud))
    assert _degrees_off(found) < 1
    assert found.converged


def test_different_objects_do_not_lie_on_each_other():
    """One pair in 24 may look as if: solids of one family are alike now and then."""
    objects = procedural_shapes(24, points=_POINTS, seed=5).points
    turns = Rotation.random(len(objects), random_state=0)
    targets = [turn.apply(points) for turn, points in zip(turns, np.roll(objects, 1, axis=0), strict=True)]
    assert register_pairs(list(objects), targets).converged.sum() <= 1


def test_the_covariance_is_about_the_targets_origin_and_in_its_unit(uneven):
    source, target = _halves(uneven[0])
    plain, scaled = register(source, target), register(100 * source, 100 * target)
    stretch = np.array([100.0] * 3 + [1.0] * 3)
    expected = np.asarray(plain.covariance) * stretch * stretch[:, None]
    np.testing.assert_allclose(scaled.covariance, expected, rtol=0.05, atol=1e-3 * expected.max())
    offset = np.array([5.0, -3.0, 2.0])
    away = np.asarray(register(source, target + offset.astype(np.float32)).covariance)
    expected = moved_covariance(np.asarray(plain.covariance, np.float64), offset)
    np.testing.assert_allclose(away, expected, rtol=0.05, atol=0.01 * expected.max())


def test_traced_and_plain_calls_say_the_same():
    """Also of float64 clouds away from the origin, which a traced call brings near it first."""
    shapes = symmetric_shapes(18, points=2 * _POINTS, seed=4)
    source, target = (each.astype(np.float64) for each in _halves(shapes.points[2]))
    source, target = source - 30, target + 20
    plain = register(source, target, search=None)
    traced = jax.jit(lambda reach: register(source, target, search=None, inlier_distance=reach))(0.1)
    assert float(traced.confidence) == pytest.approx(float(plain.confidence), abs=0.02)
    scale = np.abs(plain.covariance).max()
    np.testing.assert_allclose(traced.covariance, plain.covariance, rtol=0.05, atol=1e-3 * scale)
    np.testing.assert_allclose(traced.alternatives.weight, plain.alternatives.weight, atol=0.05)
    np.testing.assert_allclose(traced.alternatives.rotation, plain.alternatives.rotation, atol=0.02)
    np.testing.assert_allclose(traced.alternatives.translation, plain.alternatives.translation, atol=0.02 * 60)


_FAR = np.array([4e6, -2e6, 1e6])  # map coordinates


@pytest.mark.parametrize("way", ["arrays", "pairs", "initial"])
def test_an_alternative_carries_the_source_onto_the_target(way):
    """Whatever the frame of either cloud, and however they are registered."""
    shapes = symmetric_shapes(18, points=2 * _POINTS, seed=4)
    source, target = (each.astype(np.float64) for each in _halves(shapes.points[2]))
    source, target = source - _FAR, target + _FAR
    if way == "pairs":
        others = register_pairs([source], [target])[0].alternatives
    else:
        initial = np.eye(4)
        initial[:3, :3] = _TURN.as_matrix()
        initial[:3, 3] = _FAR + _TURN.apply(_FAR)
        others = register(source, target, initial=initial if way == "initial" else None).alternatives
    assert others.weight[0] > 0.1
    moved = source @ others.matrix[0, :3, :3].T + others.matrix[0, :3, 3]
    distances = np.linalg.norm(moved[:, None] - target[None], axis=-1).min(axis=1)
    spacing = np.sort(np.linalg.norm(target[:, None] - target[None], axis=-1), axis=1)[:, 1].mean()
    assert distances.mean() < 1.5 * spacing


def test_few_points_are_told_apart_from_symmetry_in_words(uneven):
    pairs = [_halves(points[:100], seed) for seed, points in enumerate(uneven)]
    found = register_pairs(*zip(*pairs, strict=True))
    reasons = [each.reason for each in found if each.outcome == Outcome.UNDETERMINED]
    assert reasons
    assert all("too few points touch" in reason for reason in reasons)
