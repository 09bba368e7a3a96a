"""Prepared clouds: made once, and the same as what they are made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.geometry.blocks import Blocks
from urrt_jax.geometry.clouds import Cloud, make_cloud, thin
from urrt_jax.geometry.neighbors import LARGE, spacing
from urrt_jax.geometry.prepared import prepare

# Every test uses clouds of 600, 1500 or 5000 rows, so that few programs are compiled: all at once, thinned, in blocks.
_prepare, _spacing = jax.jit(prepare), jax.jit(spacing)


def _points(count: int, seed: int = 0) -> np.ndarray:
    """Points of a bent sheet, (count, 3) float32."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    return np.stack([x, y, 0.3 * x**2 + 0.1 * y], 1).astype(np.float32)


def _padded(points: np.ndarray, size: int) -> Cloud:
    """The points in the same order, scattered among padding."""
    rows = np.sort(np.random.default_rng(3).permutation(size)[: len(points)])
    values, mask = np.full((size, 3), 5.0, np.float32), np.zeros(size, bool)
    values[rows], mask[rows] = points, True
    return make_cloud(values, mask)


def _same(first: Cloud, second: Cloud) -> None:
    np.testing.assert_array_equal(first.mask, second.mask)
    np.testing.assert_array_equal(first.points, second.points)


@pytest.mark.parametrize("size", [600, 1500, 5000])
def test_a_prepared_cloud_is_returned_as_it_is(size):
    prepared = _prepare(_padded(_points(500), size))
    assert prepare(prepared) is prepared


@pytest.mark.parametrize(("size", "blocks"), [(50, False), (LARGE, False), (LARGE + 1, True)])
def test_only_large_clouds_are_cut_into_blocks(size, blocks):
    cloud = Cloud(jax.ShapeDtypeStruct((size, 3), jnp.float32), jax.ShapeDtypeStruct((size,), bool))
    assert isinstance(jax.eval_shape(prepare, cloud).reference, Blocks) == blocks


@pytest.mark.parametrize("size", [600, 1500, 5000])
@pytest.mark.parametrize("count", [100, 1024])
def test_thin_is_that_of_the_cloud(size, count):
    _same(*jax.jit(lambda cloud: (prepare(cloud).thin(count), thin(cloud, count)))(_padded(_points(500), size)))


@pytest.mark.parametrize("count", [2, 100, 600])
def test_spacing_of_a_small_cloud_is_that_of_all_its_points(count):
    cloud = _padded(_points(count), 600)
    assert float(_prepare(cloud).spacing) == pytest.approx(float(_spacing(cloud)), rel=1e-6)


def test_spacing_of_a_large_cloud_is_about_that_of_all_its_points():
    cloud = make_cloud(_points(5000))
    assert float(_prepare(cloud).spacing) == pytest.approx(float(_spacing(cloud)), rel=0.05)


@pytest.mark.parametrize("size", [600, 1500, 5000])
@pytest.mark.parametrize("real", [0, 1, 500])
def test_spacing_of_coincident_points_is_not_zero(real, size):
    assert float(_prepare(_padded(np.ones((real, 3), np.float32), size)).spacing) > 0


@pytest.mark.parametrize(("count", "size"), [(600, 1500), (600, 5000), (1500, 5000)])
def test_padding_does_not_change_the_spacing(count, size):
    points = _points(count)
    expected = float(_prepare(make_cloud(points)).spacing)
    assert float(_prepare(_padded(points, size)).spacing) == pytest.approx(expected, rel=1e-6)


def test_padding_does_not_change_the_thinned_cloud():
    points = _points(1500)
    thinned = jax.jit(lambda cloud: prepare(cloud).thin(300))
    _same(thinned(_padded(points, 5000)), thinned(make_cloud(points)))


def test_vmap_agrees_with_a_loop():
    clouds = [_padded(_points(1500 - 300 * seed, seed), 1500) for seed in range(3)]
    together = jax.jit(jax.vmap(prepare))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds))
    alone = [_prepare(each) for each in clouds]
    np.testing.assert_array_equal(together.order, [each.order for each in alone])
    np.testing.assert_allclose(together.spacing, [each.spacing for each in alone], rtol=1e-6)
