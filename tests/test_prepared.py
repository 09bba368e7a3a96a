"""Prepared clouds: sorted and sampled as the shape alone decides, whatever the padding and the order of the points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import Cloud, curve_order, make_cloud, subsample, take, thin
from urrt_jax.neighbors import LARGE, make_blocks, spacing
from urrt_jax.prepared import THINNED, Prepared, Sizes, prepare, thinned_spacing

_COUNT, _PADDED = 500, (700, 4096, 5000)  # more rows than the sample's candidates, than a thinned cloud's, and blocks
_SIZES = Sizes(sample=128, queries=256, normal_radius=3.0)
_prepare, _spacing = jax.jit(prepare), jax.jit(spacing)


def _points(count: int, seed: int = 0) -> np.ndarray:
    """Points of a bent sheet, (count, 3) float32."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    return np.stack([x, y, 0.3 * x**2 + 0.1 * y], 1).astype(np.float32)


def _padded(points: np.ndarray, size: int) -> Cloud:
    """The points in the same order, scattered among padding that holds other values."""
    rows = np.sort(np.random.default_rng(3).permutation(size)[: len(points)])
    values, mask = np.full((size, 3), 5.0, np.float32), np.zeros(size, bool)
    values[rows], mask[rows] = points, True
    return make_cloud(values, mask)


def _real(cloud: Cloud) -> np.ndarray:
    return np.asarray(cloud.points)[np.asarray(cloud.mask)]


@functools.cache
def _prepared(size: int) -> Prepared:
    return _prepare(_SIZES, _padded(_points(_COUNT), size))


@pytest.fixture(scope="module", params=_PADDED)
def prepared(request) -> Prepared:
    return _prepared(request.param)


@pytest.fixture(scope="module")
def expected() -> Prepared:
    """Of the cloud with hardly any padding."""
    return _prepared(512)


@pytest.fixture(scope="module", autouse=True)
def _forget():
    yield
    _prepared.cache_clear()


def test_padding_does_not_change_the_order_along_the_curve(prepared, expected):
    np.testing.assert_array_equal(prepared.cloud.points[:_COUNT], expected.cloud.points[:_COUNT])
    np.testing.assert_array_equal(prepared.cloud.mask, np.arange(len(prepared.cloud.mask)) < _COUNT)
    assert int(prepared.count) == _COUNT


def test_padding_does_not_change_the_spacing(prepared, expected):
    assert float(prepared.spacing) == pytest.approx(float(expected.spacing), rel=1e-6)


@pytest.mark.parametrize("sample", ["even", "thinned"])
def test_padding_does_not_change_the_samples(prepared, expected, sample):
    found, alone = (getattr(each.samples, sample) for each in (prepared, expected))
    np.testing.assert_array_equal(found.mask, alone.mask)
    np.testing.assert_array_equal(found.points, alone.points)


def test_padding_does_not_change_the_constellations(prepared, expected):
    found, alone = prepared.samples.constellations, expected.samples.constellations
    np.testing.assert_array_equal(found.cloud.points, alone.cloud.points)
    np.testing.assert_array_equal(found.distances, alone.distances)
    assert np.all(found.cloud.mask)


@pytest.mark.parametrize(("count", "known"), [(THINNED, True), (THINNED + 1, False)])
def test_only_small_clouds_have_constellations(count, known):
    assert np.any(_prepare(_SIZES, make_cloud(_points(count))).samples.constellations.cloud.mask) == known


def test_padding_does_not_change_the_queries(prepared, expected):
    np.testing.assert_array_equal(_real(prepared.queries), _real(expected.queries))


def test_padding_does_not_change_the_normals(prepared, expected):
    found, alone = (np.asarray(each.normals)[np.asarray(each.queries.mask)] for each in (prepared, expected))
    np.testing.assert_allclose(found, alone, atol=1e-4)


def test_rows_say_where_each_point_stood(prepared):
    size = len(prepared.rows)
    np.testing.assert_array_equal(np.sort(prepared.rows), np.arange(size))
    given = _padded(_points(_COUNT), size)
    np.testing.assert_array_equal(np.asarray(given.points)[prepared.rows], prepared.cloud.points)


def test_the_order_of_the_points_changes_nothing_but_the_rows(expected):
    order = np.random.default_rng(1).permutation(_COUNT)
    found = _prepare(_SIZES, _padded(_points(_COUNT)[order], 512))
    places = np.flatnonzero(_padded(_points(_COUNT), 512).mask)  # the rows of the points among padding
    rows = [np.searchsorted(places, each.rows[:_COUNT]) for each in (found, expected)]
    np.testing.assert_array_equal(order[rows[0]], rows[1])
    np.testing.assert_allclose(found.normals, expected.normals, atol=1e-4)
    for one, other in zip(jax.tree.leaves(found.samples), jax.tree.leaves(expected.samples), strict=True):
        np.testing.assert_array_equal(one, other)


def test_samples_are_those_of_the_clouds_module():
    cloud = _padded(_points(_COUNT), 700)
    even, queries = jax.jit(lambda each: (subsample(each, _SIZES.sample), thin(each, _SIZES.queries)))(cloud)
    found = _prepared(700)
    np.testing.assert_array_equal(found.samples.even.points, even.points)
    np.testing.assert_array_equal(found.queries.points, queries.points)


def test_the_thinned_sample_of_a_small_cloud_is_the_cloud(expected):
    assert expected.samples.thinned.points.shape == (THINNED, 3)
    np.testing.assert_array_equal(_real(expected.samples.thinned), expected.cloud.points[:_COUNT])


@pytest.mark.parametrize(("size", "blocks"), [(50, False), (LARGE, False), (LARGE + 1, True)])
def test_only_large_clouds_are_cut_into_blocks(size, blocks):
    cloud = Cloud(jax.ShapeDtypeStruct((size, 3), jnp.float32), jax.ShapeDtypeStruct((size,), bool))
    assert (jax.eval_shape(prepare, _SIZES, cloud).blocks is not None) == blocks


def test_blocks_are_those_of_the_sorted_cloud():
    found = _prepared(5000)
    jax.tree.map(np.testing.assert_array_equal, found.blocks, jax.jit(make_blocks)(found.cloud))


def test_normals_point_away_from_the_centroid_across_the_surface():
    normals, queries = _prepared(512).normals, _prepared(512).queries
    x = np.asarray(queries.points)[:, 0]
    true = np.stack([-0.6 * x, np.full_like(x, -0.1), np.ones_like(x)], 1)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    mask = np.asarray(queries.mask)
    assert np.median(np.abs(np.sum(np.asarray(normals) * true, axis=1))[mask]) > np.cos(np.deg2rad(3))
    outward = np.sum(np.asarray(normals) * (np.asarray(queries.points) - _points(_COUNT).mean(0)), axis=1)
    assert outward[mask].min() >= -1e-5


def test_normals_turn_with_the_cloud():
    """The curve is laid along the axes, so that the order is another: every normal is compared where its point is."""
    points, turn = _points(_SIZES.queries), Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    back = []
    for cloud in (_padded(each.astype(np.float32), 512) for each in (points, points @ turn.T)):
        found = _prepare(_SIZES, cloud)
        places = np.searchsorted(np.flatnonzero(cloud.mask), found.rows[: len(points)])
        back.append(np.asarray(found.normals)[np.argsort(places)])
    agreement = np.sum(back[0] @ turn.T * back[1], axis=1)
    # Their sign is open where the surface is seen edge-on from the centroid.
    assert np.quantile(np.abs(agreement), 0.02) > 1 - 1e-5
    assert np.mean(agreement > 0) > 0.98


def test_the_radius_of_normals_compiles_nothing_anew(expected):
    before = _prepare._cache_size()
    other = _prepare(dataclasses.replace(_SIZES, normal_radius=5.0), _padded(_points(_COUNT), 512))
    assert _prepare._cache_size() == before
    assert float(jnp.max(jnp.abs(other.normals - expected.normals))) > 1e-3


@pytest.mark.parametrize("count", [2, 100, 512])
def test_spacing_of_a_small_cloud_is_that_of_all_its_points(count):
    cloud = _padded(_points(count), 512)
    assert float(_prepare(_SIZES, cloud).spacing) == pytest.approx(float(_spacing(cloud)), rel=1e-6)


def test_spacing_of_a_large_cloud_is_about_that_of_all_its_points():
    cloud = make_cloud(_points(5000))
    assert float(_prepare(_SIZES, cloud).spacing) == pytest.approx(float(_spacing(cloud)), rel=0.05)


@pytest.mark.parametrize("size", [512, 5000])
@pytest.mark.parametrize("real", [0, 1, 500])
def test_spacing_of_coincident_points_is_not_zero(real, size):
    assert float(_prepare(_SIZES, _padded(np.ones((real, 3), np.float32), size)).spacing) > 0


@pytest.mark.parametrize("count", [0, 3, 500, THINNED])
def test_the_thinned_spacing_of_a_small_cloud_is_its_own(count):
    assert float(thinned_spacing(jnp.array(count), jnp.float32(0.25))) == 0.25


def test_the_thinned_spacing_of_a_large_cloud_is_about_that_of_the_thinned_cloud():
    cloud = make_cloud(_points(20_000))
    whole, thinned = _spacing(cloud), _spacing(jax.jit(lambda each: thin(each, THINNED))(cloud))
    assert float(thinned_spacing(jnp.array(20_000), whole)) == pytest.approx(float(thinned), rel=0.2)


def test_vmap_agrees_with_a_loop():
    clouds = [_padded(_points(500 - 150 * seed, seed), 512) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)
    together = jax.jit(jax.vmap(prepare, in_axes=(None, 0)))(_SIZES, stacked)
    alone = jax.tree.map(lambda *leaves: np.stack(leaves), *(_prepare(_SIZES, each) for each in clouds))
    np.testing.assert_array_equal(together.rows, alone.rows)
    np.testing.assert_allclose(together.spacing, alone.spacing, rtol=1e-6)
    np.testing.assert_array_equal(together.samples.even.points, alone.samples.even.points)
    real = alone.queries.mask
    # Sparse neighbourhoods of three or four points enlarge the rounding, which differs from program to program.
    np.testing.assert_allclose(np.asarray(together.normals)[real], alone.normals[real], atol=1e-3)


def test_a_prepared_cloud_is_sorted_along_the_curve():
    cloud = _padded(_points(_COUNT), 700)
    found = _prepared(700)
    expected = take(cloud, jax.jit(curve_order)(*cloud))
    np.testing.assert_array_equal(found.cloud.points, expected.points)
