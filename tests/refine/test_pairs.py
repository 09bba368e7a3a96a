"""Correspondences: both directions agree with a k-d tree, and the distance keeps what it says and nothing else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.neighbors import make_blocks
from urrt_jax.refine.pairs import Pairs, Surface, both, find_pairs, pair_up, robust_weights
from urrt_jax.rigid import Rigid

_TURN, _SHIFT = Rotation.from_euler("zyx", [40, -20, 65], degrees=True).as_matrix(), np.array([0.3, -0.2, 0.5])
_TRANSFORM = Rigid(jnp.asarray(_TURN, jnp.float32), jnp.asarray(_SHIFT, jnp.float32))
_ROWS, _REAL = 120, (90, 120)  # both surfaces have one size; the source ends in padding
_ASKING, _QUERIES = (40, 55), 55  # of each cloud's points; the first ones
_find = jax.jit(find_pairs)


class _Side:
    """A cloud, which of its rows are real, and the surface of both; its first points are queries."""

    def __init__(self, points: np.ndarray, mask: np.ndarray, asking: int, blocks: bool = False):
        missing = _ROWS - len(points)
        self.points = np.pad(points.astype(np.float64), ((0, missing), (0, 0)), constant_values=0.1)
        self.mask, self.asking = np.pad(mask, (0, missing)), min(asking, _QUERIES)
        cloud = make_cloud(jnp.asarray(self.points, jnp.float32), self.mask)
        normals = np.random.default_rng(1).normal(size=(_QUERIES, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals
        some = jax.tree.map(lambda leaf: leaf[:_QUERIES], cloud)
        some = some._replace(mask=some.mask & (jnp.arange(_QUERIES) < self.asking))
        blocks_of_it = make_blocks(cloud) if blocks else None
        self.surface = Surface(some, jnp.asarray(normals, jnp.float32), cloud, blocks_of_it)

    @property
    def queries(self) -> np.ndarray:
        """Which queries are real, (Q,) bool."""
        return self.mask[:_QUERIES] & (np.arange(_QUERIES) < self.asking)


def _sides(share: float = 1.0, blocks: bool = False) -> tuple[_Side, _Side]:
    """Two clouds that lie among each other once the first is moved."""
    rng = np.random.default_rng(0)
    target, source = rng.normal(size=(_REAL[1], 3)), rng.normal(size=(_REAL[0], 3))
    masks = rng.uniform(size=_REAL[0]) < share, rng.uniform(size=_REAL[1]) < share
    first = _Side((source - _SHIFT) @ _TURN, masks[0], _ASKING[0], blocks)
    return first, _Side(target, masks[1], _ASKING[1], blocks)


def _moved(side: _Side) -> np.ndarray:
    return side.points @ _TURN.T + _SHIFT


def _expected(source: _Side, target: _Side) -> tuple[np.ndarray, np.ndarray]:
    """Row and distance of what each query finds among real points; no distance for a query that is padding."""
    answers = []
    for asks, here, answers_it, there in (
        (source, _moved(source), target, target.points),
        (target, target.points, source, _moved(source)),
    ):
        rows = np.flatnonzero(answers_it.mask)
        distance, nearest = cKDTree(there[rows]).query(here[:_QUERIES])
        answers.append((rows[nearest], np.where(asks.queries, distance, np.inf)))
    (forth, ahead), (back, behind) = answers
    return np.concatenate([forth, back]), np.concatenate([ahead, behind])


def _found(source: _Side, target: _Side, within: float = np.inf) -> Pairs:
    return _find(both(source.surface, target.surface), _TRANSFORM, np.float32(within))


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
    pairs, (rows, distance) = _found(source, target), _expected(source, target)
    moved, real = _moved(source), np.isfinite(distance)
    expected = np.concatenate([moved[:_QUERIES], moved[rows[_QUERIES:]]])
    np.testing.assert_allclose(np.asarray(pairs.source)[real], expected[real], atol=1e-5)
    expected = np.concatenate([target.points[rows[:_QUERIES]], target.points[:_QUERIES]])
    np.testing.assert_allclose(np.asarray(pairs.target)[real], expected[real], atol=1e-5)


def test_normals_are_those_of_the_queries_in_the_target_s_frame():
    source, target = _sides()
    expected = np.concatenate([source.normals @ _TURN.T, target.normals])
    np.testing.assert_allclose(_found(source, target).normals, expected, atol=1e-6)


@pytest.mark.parametrize("side", [0, 1])
def test_padding_of_one_cloud_leaves_no_pair(side):
    sides = list(_sides())
    sides[side].surface = _Side(sides[side].points, np.zeros_like(sides[side].mask), _ASKING[side]).surface
    assert bool(jnp.all(jnp.isinf(_found(*sides).squared)))


@pytest.mark.parametrize("within", [0.0, 0.3, 0.6])
def test_exactly_the_pairs_within_are_left(within):
    sides = _sides(0.8)
    every = np.asarray(_found(*sides).squared)
    expected = np.where(every < within**2, every, np.inf)
    np.testing.assert_allclose(_found(*sides, within).squared, expected, rtol=1e-6)


def test_swapping_the_clouds_swaps_the_directions():
    sides = _sides(0.8)
    forth = _found(*sides)
    back = _find(both(*(side.surface for side in reversed(sides))), rigid.inverse(_TRANSFORM), np.float32(np.inf))
    swapped = np.roll(np.asarray(back.squared), _QUERIES)
    np.testing.assert_allclose(swapped, forth.squared, rtol=1e-4)
    real = np.isfinite(np.asarray(forth.squared))
    np.testing.assert_array_equal(np.roll(np.asarray(back.rows), _QUERIES)[real], np.asarray(forth.rows)[real])


def test_both_stacks_the_surfaces_source_first():
    source, target = _sides()
    stacked = both(source.surface, target.surface)
    for leaf, one, other in zip(*map(jax.tree.leaves, (stacked, source.surface, target.surface)), strict=True):
        np.testing.assert_array_equal(leaf[0], one)
        np.testing.assert_array_equal(leaf[1], other)


def test_vmap_agrees_with_a_loop():
    sides = [_sides(share) for share in (1.0, 0.6)]
    stacked = [both(*(side.surface for side in pair)) for pair in sides]
    together = jax.jit(jax.vmap(find_pairs, in_axes=(0, None, None)))(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked), _TRANSFORM, np.float32(0.6)
    )
    alone = [_find(each, _TRANSFORM, np.float32(0.6)) for each in stacked]
    np.testing.assert_array_equal(together.rows, [each.rows for each in alone])
    np.testing.assert_allclose(together.squared, [each.squared for each in alone], rtol=1e-5)


def test_pairs_of_rows_at_hand_are_the_found_ones():
    source, target = _sides()
    found = _found(source, target)
    jax.tree.map(
        functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6),
        pair_up(both(source.surface, target.surface), _TRANSFORM, found.rows)._replace(squared=0),
        found._replace(squared=0),
    )
    real = np.isfinite(found.squared)
    squared = pair_up(both(source.surface, target.surface), _TRANSFORM, found.rows).squared
    np.testing.assert_allclose(np.asarray(squared)[real], np.asarray(found.squared)[real], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("width", [1e-3, 1.0, 50.0])
@pytest.mark.parametrize(("distance", "weight"), [(0.0, 1.0), (1.0, 0.25), (3.0, 0.01), (np.inf, 0.0)])
def test_robust_weight_at_some_widths(distance, weight, width):
    squared = np.array([(distance * width) ** 2], np.float32)
    assert float(robust_weights(squared, width)[0]) == pytest.approx(weight, rel=1e-5)


@pytest.mark.parametrize("squared", [0.0, 1e-30, 1e30, np.inf])
def test_derivative_of_a_robust_weight_is_finite(squared):
    gradient = jax.grad(lambda s, r: robust_weights(s[None], r)[0], argnums=(0, 1))(jnp.float32(squared), 0.1)
    assert np.isfinite(gradient).all()
