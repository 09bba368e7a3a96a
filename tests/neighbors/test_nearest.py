"""Nearest neighbours: every way of computing them agrees, with SciPy's k-d tree too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.neighbors import (
    LEAST_SPACING,
    coarser_spacing,
    k_nearest,
    make_blocks,
    nearest,
    spacing,
    top_rows,
    typical_distance,
)

_nearest = jax.jit(nearest, static_argnames="block")
_k_nearest = jax.jit(k_nearest, static_argnames=("k", "batch_size"))


def _pair(queries: int, references: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(queries, 3)).astype(np.float32), rng.normal(size=(references, 3)).astype(np.float32)


@pytest.mark.parametrize("block", [None, 1, 7, 32, 1000])
@pytest.mark.parametrize("references", [1, 31])
def test_nearest_agrees_with_a_kd_tree(block, references):
    query, reference = _pair(83, references)
    distance, index = cKDTree(reference).query(query)
    found = _nearest(jnp.asarray(query), make_cloud(reference), block=block)
    np.testing.assert_array_equal(found.index, index)
    np.testing.assert_allclose(found.squared, distance**2, rtol=1e-5)


def test_nearest_in_chunks_agrees_with_a_kd_tree():
    query, reference = _pair(2 * 16_384 + 5, 40)
    _, index = cKDTree(reference).query(query)
    found = _nearest(query, make_cloud(reference))
    assert np.mean(np.asarray(found.index) != index) < 1e-4  # near ties may fall either way in float32


@pytest.mark.parametrize("offset", [0.0, 10.0, 1000.0])
def test_nearest_keeps_small_distances_far_from_the_origin(offset):
    _, reference = _pair(1, 50)
    reference = reference + np.float32(offset)
    query = (reference + np.float32(2.0**-10)).astype(np.float32)
    expected = np.sum((query.astype(np.float64) - reference) ** 2, -1)
    found = _nearest(query, make_cloud(reference))
    np.testing.assert_array_equal(found.index, np.arange(50))
    np.testing.assert_allclose(found.squared, expected, rtol=1e-5)


@pytest.mark.parametrize("block", [None, 8])
def test_nearest_never_finds_padding(block):
    query, reference = _pair(50, 60)
    mask = np.arange(60) % 3 == 1
    _, index = cKDTree(reference[mask]).query(query)
    padded = make_cloud(np.where(mask[:, None], reference, 0), mask)
    found = _nearest(jnp.asarray(query), padded, block=block)
    np.testing.assert_array_equal(found.index, np.flatnonzero(mask)[index])


@pytest.mark.parametrize("block", [None, 1, 4, 32])
def test_nearest_gives_ties_to_the_first(block):
    reference = np.repeat(np.eye(3, dtype=np.float32), 5, axis=0)
    found = _nearest(jnp.eye(3), make_cloud(reference), block=block)
    assert found.index.tolist() == [0, 5, 10]


@pytest.mark.parametrize("block", [None, 32])
def test_nearest_of_an_empty_reference_is_infinitely_far(block):
    query, reference = _pair(5, 9)
    found = _nearest(jnp.asarray(query), make_cloud(reference, np.zeros(9, bool)), block=block)
    assert bool(jnp.all(jnp.isinf(found.squared)))


def test_nearest_of_an_empty_reference_has_a_finite_gradient():
    query, reference = _pair(5, 9)
    empty = make_cloud(reference, np.zeros(9, bool))

    def total(points):
        squared = nearest(points, empty).squared
        return jnp.sum(jnp.where(jnp.isfinite(squared), squared, 0.0))

    assert bool(jnp.all(jnp.isfinite(jax.jit(jax.grad(total))(query))))


@pytest.mark.parametrize("moves", ["query", "reference"])
def test_nearest_gradient_agrees_with_finite_differences(moves, x64):
    query, reference = (jnp.asarray(x, x64) for x in _pair(20, 25))
    direction = jnp.asarray(np.random.default_rng(3).normal(size=(query if moves == "query" else reference).shape))

    @jax.jit
    def total(step):
        q, r = (query + step * direction, reference) if moves == "query" else (query, reference + step * direction)
        return jnp.sum(jnp.sqrt(nearest(q, make_cloud(r)).squared))

    assert float(jax.grad(total)(0.0)) == pytest.approx(float(total(1e-6) - total(-1e-6)) / 2e-6, rel=1e-6)


@pytest.mark.parametrize("count", [5, 5000])
def test_no_queries_have_no_neighbours(count):
    reference, nothing = make_cloud(np.random.default_rng(0).normal(size=(count, 3))), jnp.zeros((0, 3))
    for found in (nearest(nothing, reference), k_nearest(nothing, reference, 2)):
        assert len(found.index) == len(found.squared) == 0


def test_nearest_jit_agrees_with_eager():
    query, reference = _pair(83, 100)
    eager, jitted = nearest(jnp.asarray(query), make_cloud(reference)), _nearest(query, make_cloud(reference))
    np.testing.assert_array_equal(eager.index, jitted.index)
    np.testing.assert_allclose(eager.squared, jitted.squared, rtol=1e-6)


def test_nearest_vmap_agrees_with_a_loop():
    pairs = [_pair(30, 40, seed) for seed in range(3)]
    queries, references = (np.stack(x) for x in zip(*pairs, strict=True))
    together = jax.jit(jax.vmap(lambda q, r: nearest(q, make_cloud(r)).index))(queries, references)
    alone = [_nearest(q, make_cloud(r)).index for q, r in pairs]
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize(("batch_size", "k"), [(None, 1), (None, 60), (1, 4), (16, 1), (16, 4), (16, 60), (1024, 4)])
def test_k_nearest_agrees_with_a_kd_tree(batch_size, k):
    query, reference = _pair(33, 60)
    distance, index = cKDTree(reference).query(query, k=[*range(1, k + 1)])
    found = _k_nearest(query, make_cloud(reference), k, batch_size=batch_size)
    np.testing.assert_array_equal(found.index, index)
    np.testing.assert_allclose(found.squared, distance**2, rtol=1e-5)


def test_k_nearest_is_infinitely_far_beyond_the_real_points():
    query, reference = _pair(6, 20)
    found = k_nearest(jnp.asarray(query), make_cloud(reference, np.arange(20) < 3), 5)
    assert jnp.isinf(found.squared).sum(axis=1).tolist() == [2] * 6
    assert bool(jnp.all(found.index[:, :3] < 3))


@pytest.mark.parametrize("k", [0, -1, 61])
def test_k_nearest_refuses_an_impossible_k(k):
    query, reference = _pair(3, 60)
    with pytest.raises(ValueError, match=f"^k: expected 1 to 60, got {k}"):
        k_nearest(jnp.asarray(query), make_cloud(reference), k)


def test_top_rows_are_the_largest_and_the_first_of_equals():
    values = jnp.array([[1.0, 7.0, 3.0, 7.0], [-jnp.inf, 0.0, -jnp.inf, -1.0]])
    np.testing.assert_array_equal(top_rows(values, 3), [[1, 3, 2], [1, 3, 0]])


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
def test_a_slice_of_the_nearest_sorts_no_rows(batch):
    """The CPU selects a few of many in much less time than it sorts them all."""
    points = jnp.ones((*batch, 64, 3))

    def others(points):
        return k_nearest(points, Cloud(points, jnp.ones(64, bool)), 8, batch_size=None).index[:, 1:]

    for _ in batch:
        others = jax.vmap(others)
    program = jax.jit(others).lower(points).compile().as_text()
    assert "TopK" in program
    assert " sort(" not in program


_spacing, _coarser = jax.jit(spacing), jax.jit(coarser_spacing)


def _grid(step: float) -> np.ndarray:
    return step * np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("step", [1e-3, 1.0, 1e3])
def test_spacing_of_a_grid_is_its_step(step):
    assert float(_spacing(make_cloud(_grid(step)))) == pytest.approx(step, rel=1e-5)


def test_spacing_passes_over_some_repeated_points():
    grid = _grid(0.5)
    assert float(_spacing(make_cloud(np.concatenate([grid, grid[:40]])))) == pytest.approx(0.5, rel=1e-5)


def test_spacing_passes_over_repeated_points_when_every_point_is_repeated():
    """The corners of a triangle soup come like this."""
    assert float(_spacing(make_cloud(np.repeat(_grid(0.5), 2, axis=0)))) == pytest.approx(0.5, rel=1e-5)


def test_spacing_ignores_padding():
    grid = np.concatenate([_grid(0.5), _grid(0.01)])
    assert float(_spacing(make_cloud(grid, np.arange(250) < 125))) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("count", [1, 7])
def test_spacing_of_one_repeated_point_is_zero(count):
    assert float(_spacing(make_cloud(np.ones((count, 3), np.float32)))) == 0


@pytest.mark.parametrize("swapped", [False, True])
def test_the_coarser_spacing_is_the_larger_one(swapped):
    fine, coarse = make_cloud(_grid(0.25)), make_cloud(_grid(0.5))
    pair = (coarse, fine) if swapped else (fine, coarse)
    assert float(_coarser(*pair)) == pytest.approx(0.5, rel=1e-5)


def test_the_coarser_spacing_of_coincident_points_is_not_zero():
    points = make_cloud(np.ones((125, 3), np.float32))
    assert float(_coarser(points, points)) == np.float32(LEAST_SPACING)


def test_spacing_through_blocks_is_that_of_comparing_all():
    cloud = make_cloud(np.random.default_rng(0).normal(size=(700, 3)).astype(np.float32))
    far = jax.jit(lambda each: nearest(each.points, each, blocks=make_blocks(each), distinct=True).squared)(cloud)
    through = typical_distance(far, cloud.mask)
    assert float(through) == pytest.approx(float(_spacing(cloud)), rel=1e-6)


def test_spacing_of_a_sample_is_asked_in_the_whole_cloud():
    cloud = make_cloud(_grid(0.5))
    sample = make_cloud(_grid(0.5)[::31])
    squared = nearest(sample.points, cloud, distinct=True).squared
    assert float(typical_distance(squared, sample.mask)) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("distance", [10.0, 1e3, 1e6])
def test_spacing_is_not_set_by_a_stray_point(distance):
    stray = np.array([[distance, 0.0, 0.0]], np.float32)
    assert float(_spacing(make_cloud(np.concatenate([_grid(0.5), stray])))) == pytest.approx(0.5, rel=0.05)


def test_spacing_has_a_finite_gradient():
    gradient = jax.jit(jax.grad(lambda p: spacing(make_cloud(p))))(jnp.ones((6, 3)))
    assert bool(jnp.all(jnp.isfinite(gradient)))


@pytest.mark.parametrize("count", [0, 1, 20_000, 40_000])
def test_many_queries_of_a_small_cloud_skip_padding(count):
    """In chunks: those that hold nothing but padding are not compared, and name no neighbour."""
    rng = np.random.default_rng(0)
    query, reference = rng.normal(size=(40_000, 3)), rng.normal(size=(50, 3))
    found = jax.jit(lambda count: nearest(jnp.asarray(query), make_cloud(reference), count=count))(jnp.array(count))
    expected = cKDTree(reference).query(query[:count])[1]
    np.testing.assert_array_equal(found.index[:count], expected)
    compared = -(-count // 16_384) * 16_384  # the size of a chunk
    assert not np.isfinite(found.squared[compared:]).any()
