"""Other poses that fit as well: those of symmetric solids are found, and uneven shapes have none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.assessment import alternatives
from urrt_jax.assessment.alternatives import KEPT, Alternatives, find_alternatives
from urrt_jax.clouds import first, make_cloud, subsample
from urrt_jax.data import symmetric_shapes, symmetry
from urrt_jax.features import constellations
from urrt_jax.neighbors import LEAST_SPACING, spacing
from urrt_jax.prepared import Samples, coarser
from urrt_jax.rigid import Rigid

_ROWS = 512  # of every sample, as in ``register``


@jax.jit
def _samples(points: jax.Array, mask: jax.Array) -> Samples:
    cloud = make_cloud(points, mask)
    even = subsample(cloud, _ROWS)
    none = constellations(first(cloud, 1), jnp.full(1, jnp.inf), spacing(even))
    return Samples(even, jnp.maximum(spacing(even), LEAST_SPACING), cloud, none)


def _sampled(points: np.ndarray, rows: int = _ROWS) -> Samples:
    values = np.full((rows, 3), 9.0, np.float32)
    values[: len(points)] = points
    return _samples(values, np.arange(rows) < len(points))


_find = jax.jit(find_alternatives)


def _found(source: np.ndarray, target: np.ndarray, transform: Rigid | None = None) -> Alternatives:
    return jax.tree.map(np.asarray, _find(_sampled(source), _sampled(target), transform or rigid.identity()))


def _halves(kind: str, points: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Two samples of a symmetric solid."""
    shapes = symmetric_shapes(18, points=2 * points, seed=3)
    cloud = shapes.points[list(shapes.classes).index(kind)]
    return cloud[:points], cloud[points:]


def _degrees(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.asarray(rigid.rotation_angle(jnp.asarray(first), jnp.asarray(second))))


_FINITE = ["prism_3", "prism_5", "prism_6", "propeller_2", "propeller_3", "propeller_5", "cube", "box", "tetrahedron"]


@pytest.mark.parametrize("kind", _FINITE)
def test_the_turns_of_a_symmetric_solid_are_found(kind):
    found, group = _found(*_halves(kind)), symmetry(kind)[1:]
    assert found.significance[0] < 3
    off = _degrees(found.poses.rotation[:1, None].astype(np.float32), group[None].astype(np.float32)).min()
    assert off < 8


@pytest.mark.parametrize("kind", ["cylinder", "cone", "torus", "sphere", "gear_16"])
def test_a_round_solid_fits_in_many_poses(kind):
    assert (_found(*_halves(kind)).significance[:2] < 3).all()


def test_an_alternative_puts_the_source_onto_the_target():
    """Where both clouds are anywhere: it is a transform of the source as it is."""
    source, target = _halves("prism_5")
    turn = Rotation.from_euler("xyz", [30, 60, -100], degrees=True)
    shift = np.array([0.3, -0.2, 0.5])
    pose = Rigid(jnp.asarray(turn.as_matrix(), jnp.float32), jnp.asarray(shift, jnp.float32))
    found = _found(source, turn.apply(target) + shift, pose)
    before = turn.inv().as_matrix() @ found.poses.rotation[0]
    assert _degrees(before[None].astype(np.float32), symmetry("prism_5")[1:].astype(np.float32)).min() < 8
    np.testing.assert_allclose(found.poses.translation[0], shift, atol=0.06)


@pytest.mark.parametrize("seed", range(3))
def test_an_uneven_shape_has_no_other_pose(make_cloud_points, seed):
    found = _found(make_cloud_points(seed, 2), make_cloud_points(seed + 10, 2))
    assert found.significance.min() > 3


def test_the_right_pose_is_the_alternative_of_one_turned_around(make_cloud_points):
    points = make_cloud_points(0, 2)
    centre = points.mean(axis=0)
    axis = np.linalg.eigh(np.cov(points.T))[1][:, 2]
    turn = Rotation.from_rotvec(np.pi * axis).as_matrix()
    wrong = Rigid(jnp.asarray(turn, jnp.float32), jnp.asarray(centre - turn @ centre, jnp.float32))
    found = _found(points, make_cloud_points(7, 2), wrong)
    assert found.significance[0] < -2
    assert _degrees(found.poses.rotation[:1], np.eye(3, dtype=np.float32)[None])[0] < 8


def test_alternatives_are_distinct_rotations_best_first():
    found = _found(*_halves("cube"))
    assert len(found.significance) == KEPT
    assert (np.diff(found.significance) >= 0).all()
    every = np.concatenate([np.eye(3, dtype=np.float32)[None], found.poses.rotation[found.there]])
    between = _degrees(every[:, None], every[None])[np.triu_indices(len(every), 1)]
    assert between.min() > 19
    np.testing.assert_allclose(every @ every.swapaxes(1, 2), np.broadcast_to(np.eye(3), every.shape), atol=1e-4)


def test_swapped_clouds_have_alternatives_that_fit_alike():
    source, target = _halves("propeller_3")
    one, other = _found(source, target), _found(target, source)
    assert other.significance[0] < 3
    assert abs(one.significance[0] - other.significance[0]) < 2


def test_more_padding_changes_nothing():
    source, target = (each[:200] for each in _halves("prism_6"))
    less = _find(_sampled(source), _sampled(target), rigid.identity())
    more = _find(_sampled(source, 1024), _sampled(target, 1024), rigid.identity())
    np.testing.assert_allclose(less.significance, more.significance, atol=1e-3)


def test_a_batch_is_each_of_its_pairs(make_cloud_points):
    clouds = [_halves("prism_3"), (make_cloud_points(0, 2), make_cloud_points(5, 2))]
    samples = [[_sampled(each) for each in pair] for pair in clouds]
    sources, targets = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *side) for side in zip(*samples, strict=True))
    together = jax.jit(jax.vmap(find_alternatives, (0, 0, None)))(sources, targets, rigid.identity())
    for row, pair in enumerate(clouds):
        np.testing.assert_allclose(together.significance[row], _found(*pair).significance, atol=0.1)


@pytest.mark.parametrize("shape", ["point", "line", "empty", "plane", "three points", "stray"])
def test_alternatives_of_odd_clouds_are_finite(shape):
    draw = np.random.default_rng(0).normal(size=(100, 3))
    points = {
        "point": np.ones((50, 3)),
        "line": np.linspace(0, 1, 50)[:, None] * [1.0, 2.0, 3.0],
        "empty": np.zeros((0, 3)),
        "plane": draw * [1, 1, 0],
        "three points": draw[:3],
        "stray": np.concatenate([draw, [[1e4, 0, 0]]]),
    }[shape]
    found = _found(points, points)
    assert np.isfinite(found.significance).all()
    assert np.isfinite(found.poses.rotation).all() and np.isfinite(found.poses.translation).all()


def test_significance_is_that_of_its_definition():
    """Of a single turn, in standard errors of the mean difference, through the width that tells most."""
    source, target = (_sampled(each[:count]) for each, count in zip(_halves("prism_5"), (150, 40), strict=True))
    turn = Rotation.from_euler("z", 36, degrees=True).as_matrix().astype(np.float32)
    clouds, width = (source.even, target.even), coarser(source, target)
    found = alternatives._compare(Rigid(jnp.asarray(turn)[None], jnp.zeros((1, 3))), clouds, width)
    one, other = (np.asarray(each.points)[np.asarray(each.mask)] for each in clouds)

    def distances(rotation: np.ndarray) -> list[np.ndarray]:
        apart = np.linalg.norm((one @ rotation.T)[:, None] - other[None], axis=-1)
        return [apart.min(axis=1), apart.min(axis=0)]

    expected = []
    for many in (1, 2, 3):
        better = [
            np.maximum(1 - (own / (many * float(width))) ** 2, 0)
            - np.maximum(1 - (far / (many * float(width))) ** 2, 0)
            for own, far in zip(distances(np.eye(3)), distances(turn), strict=True)
        ]
        error = np.sqrt(sum(np.var(each) / len(each) for each in better)) / 2
        expected.append(np.mean([each.mean() for each in better]) / (error + 0.005))
    assert float(found[0]) == pytest.approx(max(expected), rel=1e-3)


def test_turns_that_are_tried_are_rotations_that_leave_no_gap():
    turns = alternatives._TURNS
    np.testing.assert_allclose(turns @ turns.swapaxes(1, 2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-6)
    drawn = Rotation.random(300, random_state=0).as_matrix().astype(np.float32)
    drawn = drawn[_degrees(drawn, np.eye(3, dtype=np.float32)[None]) > 45]
    nearest = _degrees(drawn[:, None], turns[None]).min(axis=1)
    assert nearest.max() < 25


def test_clouds_that_touch_in_no_pose_have_no_alternative():
    points = np.random.default_rng(0).normal(size=(60, 3))
    assert not _found(points, points[:0]).there.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_alternatives_in_double_precision_are_the_same(x64, dtype):
    samples = [_sampled(each[:200].astype(dtype)) for each in _halves("prism_6")]
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype != bool else leaf, samples)
    pose = Rigid(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype))
    assert np.isfinite(jax.jit(find_alternatives)(*cast, pose).significance).all()
