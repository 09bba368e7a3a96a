"""Pairs: both directions agree with a k-d tree, and each rule keeps what it says and nothing else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from urrt_jax.geometry.blocks import make_blocks
from urrt_jax.geometry.clouds import make_cloud
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.refine.pairs import Pairs, Surface, find_pairs, pair_up, robust_weights, trimmed

_TURN, _SHIFT = Rotation.from_euler("zyx", [40, -20, 65], degrees=True).as_matrix(), np.array([0.3, -0.2, 0.5])
_TRANSFORM = Rigid(jnp.asarray(_TURN, jnp.float32), jnp.asarray(_SHIFT, jnp.float32))
_ASKING = (40, 55)  # of each cloud's points
_find = functools.partial(jax.jit, static_argnames="mutual")(find_pairs)


class _Side:
    """A cloud, which of its rows are real, and the surface of both; the first points ask."""

    def __init__(self, points: np.ndarray, mask: np.ndarray, asking: int, blocks: bool = False):
        self.points, self.mask, self.asking = points.astype(np.float64), mask, asking
        cloud = make_cloud(jnp.asarray(points, jnp.float32), mask)
        normals = np.random.default_rng(1).normal(size=(asking, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals
        some = jax.tree.map(lambda leaf: leaf[:asking], cloud)
        self.surface = Surface(some, jnp.asarray(normals, jnp.float32), make_blocks(cloud) if blocks else cloud)


def _sides(share: float = 1.0, blocks: bool = False) -> tuple[_Side, _Side]:
    """Two clouds that lie among each other once the first is moved."""
    rng = np.random.default_rng(0)
    target, source = rng.normal(size=(120, 3)), rng.normal(size=(90, 3))
    masks = rng.uniform(size=90) < share, rng.uniform(size=120) < share
    first = _Side((source - _SHIFT) @ _TURN, masks[0], _ASKING[0], blocks)
    return first, _Side(target, masks[1], _ASKING[1], blocks)


def _moved(side: _Side) -> np.ndarray:
    return side.points @ _TURN.T + _SHIFT


def _expected(source: _Side, target: _Side) -> tuple[np.ndarray, np.ndarray]:
    """Row and distance of what each asking point finds among real points; no distance for padding that asks."""
    answers = []
    for asks, here, answers_it, there in (
        (source, _moved(source), target, target.points),
        (target, target.points, source, _moved(source)),
    ):
        rows = np.flatnonzero(answers_it.mask)
        distance, nearest = cKDTree(there[rows]).query(here[: asks.asking])
        answers.append((rows[nearest], np.where(asks.mask[: asks.asking], distance, np.inf)))
    (forth, ahead), (back, behind) = answers
    return np.concatenate([forth, back]), np.concatenate([ahead, behind])


def _found(source: _Side, target: _Side, within: float = np.inf, mutual: bool = False) -> Pairs:
    return _find(source.surface, target.surface, _TRANSFORM, np.float32(within), mutual=mutual)


@pytest.mark.parametrize("blocks", [False, True])
@pytest.mark.parametrize("share", [1.0, 0.7, 0.1])
def test_pairs_agree_with_a_kd_tree(share, blocks):
    sides = _sides(share, blocks)
    rows, distance = _expected(*sides)
    pairs = _found(*sides)
    real = np.isfinite(distance)
    np.testing.assert_array_equal(np.asarray(pairs.rows)[real], rows[real])
    np.testing.assert_allclose(np.sqrt(pairs.squared), distance, rtol=1e-4)


def test_ends_of_pairs_are_those_points():
    source, target = _sides()
    pairs, (rows, _) = _found(source, target), _expected(source, target)
    ahead, behind = _ASKING
    moved = _moved(source)
    np.testing.assert_allclose(pairs.source, np.concatenate([moved[:ahead], moved[rows[ahead:]]]), atol=1e-5)
    expected = np.concatenate([target.points[rows[:ahead]], target.points[:behind]])
    np.testing.assert_allclose(pairs.target, expected, atol=1e-5)


def test_normals_are_those_of_the_asking_points_in_the_target_s_frame():
    source, target = _sides()
    expected = np.concatenate([source.normals @ _TURN.T, target.normals])
    np.testing.assert_allclose(_found(source, target).normals, expected, atol=1e-6)


@pytest.mark.parametrize("side", [0, 1])
def test_padding_of_one_cloud_leaves_no_pair(side):
    sides = list(_sides())
    sides[side].surface = _Side(sides[side].points, np.zeros_like(sides[side].mask), _ASKING[side]).surface
    assert bool(jnp.all(jnp.isinf(_found(*sides).squared)))


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize("within", [0.0, 0.3, 0.6])
def test_exactly_the_pairs_within_are_left(within, mutual):
    sides = _sides(0.8)
    every = np.asarray(_found(*sides, mutual=mutual).squared)
    expected = np.where(every < within**2, every, np.inf)
    np.testing.assert_allclose(_found(*sides, within, mutual).squared, expected, rtol=1e-6)


def _are_mutual(source: _Side, target: _Side) -> np.ndarray:
    """Whether the nearest asking point of the found end is the one that asked."""
    rows, distance = _expected(source, target)
    ahead = source.asking
    asking = [np.flatnonzero(side.mask[: side.asking]) for side in (source, target)]
    back = asking[0][cKDTree(_moved(source)[asking[0]]).query(target.points[rows[:ahead]])[1]]
    forth = asking[1][cKDTree(target.points[asking[1]]).query(_moved(source)[rows[ahead:]])[1]]
    returned = np.concatenate([back, forth])
    return (returned == np.concatenate([np.arange(each.asking) for each in (source, target)])) & np.isfinite(distance)


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_mutual_keeps_exactly_the_mutual_pairs(share):
    sides = _sides(share)
    expected = _are_mutual(*sides)
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(np.isfinite(_found(*sides, mutual=True).squared), expected)


def test_mutual_changes_nothing_else():
    sides = _sides()
    mutual, every = _found(*sides, mutual=True), _found(*sides)
    jax.tree.map(np.testing.assert_array_equal, mutual._replace(squared=0), every._replace(squared=0))


def test_coincident_points_are_mutual():
    points = np.repeat(np.random.default_rng(2).normal(size=(20, 3)), 2, axis=0)
    target = _Side(points, np.ones(40, bool), 40)
    source = _Side((points - _SHIFT) @ _TURN, np.ones(40, bool), 40)
    assert bool(jnp.all(jnp.isfinite(_found(source, target, mutual=True).squared)))


def test_pairs_of_rows_at_hand_are_the_found_ones():
    source, target = _sides()
    found = _found(source, target)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6),
        pair_up(source.surface, target.surface, _TRANSFORM, found.rows),
        found,
    )


@pytest.mark.parametrize("reach", [1e-3, 1.0, 50.0])
@pytest.mark.parametrize(("distance", "weight"), [(0.0, 1.0), (1.0, 0.25), (3.0, 0.01), (np.inf, 0.0)])
def test_robust_weight_at_some_reaches(distance, weight, reach):
    squared = np.array([(distance * reach) ** 2], np.float32)
    assert float(robust_weights(squared, reach)[0]) == pytest.approx(weight, rel=1e-5)


@pytest.mark.parametrize("squared", [0.0, 1e-30, 1e30, np.inf])
def test_derivative_of_a_robust_weight_is_finite(squared):
    gradient = jax.grad(lambda s, r: robust_weights(s[None], r)[0], argnums=(0, 1))(jnp.float32(squared), 0.1)
    assert np.isfinite(gradient).all()


_trimmed = jax.jit(trimmed)


def _distances(near: int, far: int, none: int = 0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances of pairs that overlap, that are far and that are none, mixed, and which of them overlap.

    What overlaps does so up to a noise of 0.01 a coordinate; what is far is at 0.3 to 1.
    """
    rng = np.random.default_rng(seed)
    noise = np.sum(rng.normal(scale=0.01, size=(near, 3)) ** 2, axis=1)
    squared = np.concatenate([noise, rng.uniform(0.3, 1, far) ** 2, np.full(none, np.inf)])
    order = rng.permutation(len(squared))
    return squared[order].astype(np.float32), (np.arange(len(squared)) < near)[order]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("near", "far"), [(450, 550), (600, 400), (950, 50), (1000, 0)])
def test_trimming_keeps_the_true_overlap(near, far, seed):
    squared, overlap = _distances(near, far, seed=seed)
    assert np.mean(np.asarray(_trimmed(squared)) == overlap) > 0.99


def test_trimming_does_not_count_pairs_that_are_none():
    squared, overlap = _distances(400, 200, none=400)
    assert np.mean(np.asarray(_trimmed(squared)) == overlap) > 0.99


@pytest.mark.parametrize("value", [0.0, 1e-12, 1e-3, 1.0, 1e6])
def test_trimming_keeps_all_pairs_that_are_equally_near(value):
    assert bool(jnp.all(_trimmed(np.full(1000, value, np.float32))))


def test_trimming_keeps_none_of_no_pairs():
    assert not bool(jnp.any(_trimmed(np.full(1000, np.inf, np.float32))))


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_trimming_does_not_depend_on_the_unit(factor):
    squared, _ = _distances(600, 400)
    np.testing.assert_array_equal(_trimmed(squared * np.float32(factor)), _trimmed(squared))


def test_trimming_does_not_depend_on_the_order():
    squared, _ = _distances(600, 400)
    order = np.random.default_rng(1).permutation(1000)
    np.testing.assert_array_equal(_trimmed(squared[order]), _trimmed(squared)[order])
