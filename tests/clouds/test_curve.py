"""The curve: a permutation that is Hilbert's, that padding does not disturb and that only the shape decides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.clouds.curve import curve_order

_order = jax.jit(curve_order)
_LAST = 1023.0  # cells are 0 to 1023 along each side of the bounding box


def _grid(side: int) -> np.ndarray:
    """All points with coordinates 0 to side − 1, (side³, 3) float32, shuffled."""
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3), -1).reshape(-1, 3).astype(np.float32)
    return np.random.default_rng(0).permutation(points)


def _in_a_large_box(block: np.ndarray) -> np.ndarray:
    """A block of points with the corners of a box of 1024 cells, whose size is 1, around it."""
    return np.concatenate([[[0.0] * 3, [_LAST] * 3], block]).astype(np.float32)


def _walk(points: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    mask = np.ones(len(points), bool) if mask is None else mask
    return points[np.asarray(_order(points, mask))[: mask.sum()]]


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(1).normal(size=(512, 3)).astype(np.float32)


@pytest.mark.parametrize(
    "degenerate",
    [
        pytest.param(np.ones((512, 3)), id="coincident"),
        pytest.param(np.zeros((512, 3)), id="coincident at the origin"),
        pytest.param(np.outer(np.linspace(-1, 1, 512), [1, 0, 0]), id="a line"),
        pytest.param(np.full((512, 3), 1e30), id="coincident far away"),
        pytest.param(np.repeat(np.random.default_rng(0).normal(size=(4, 3)), 128, axis=0), id="four points repeated"),
        pytest.param(1e-30 * np.random.default_rng(0).normal(size=(512, 3)), id="tiny"),
        pytest.param(np.ones((1, 3)), id="one point"),
    ],
)
@pytest.mark.parametrize("real", [1.0, 0.5, 0.0])
def test_order_is_a_permutation(degenerate, real):
    mask = np.arange(len(degenerate)) % 100 < 100 * real
    order = _order(degenerate.astype(np.float32), mask)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(degenerate)))


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_padding_comes_last(points, share):
    mask = np.random.default_rng(2).uniform(size=len(points)) < share
    in_order = mask[np.asarray(_order(points, mask))]
    np.testing.assert_array_equal(in_order, np.arange(len(points)) < mask.sum())


@pytest.mark.parametrize("value", [0.0, -50.0, np.nan, np.inf])
def test_values_of_padding_change_nothing(points, value):
    mask = np.arange(len(points)) % 3 > 0
    disturbed = np.where(mask[:, None], points, np.float32(value))
    np.testing.assert_array_equal(_walk(disturbed, mask), _walk(points, mask))


@pytest.mark.parametrize("seed", range(3))
def test_order_of_points_changes_nothing(seed):
    grid = _grid(8)
    np.testing.assert_array_equal(_walk(np.random.default_rng(seed + 5).permutation(grid)), _walk(grid))


@pytest.mark.parametrize("side", [2, 4, 8, 16])
def test_consecutive_points_of_a_full_grid_are_face_neighbours(side):
    """A grid of 2^k points a side has one point in each of 2^k cells a side: 1023·i / (2^k − 1) is within the i-th."""
    steps = np.abs(np.diff(_walk(_grid(side)), axis=0))
    np.testing.assert_array_equal(np.sort(steps, axis=1), np.broadcast_to([0, 0, 1], steps.shape))


@pytest.mark.parametrize("corner", [(0, 0, 0), (512, 512, 512), (48, 512, 992), (1008, 0, 496), (1008, 1008, 1008)])
def test_consecutive_points_of_the_finest_cells_are_face_neighbours(corner):
    walk = _walk(_in_a_large_box(_grid(16) + np.array(corner) + 0.5))
    inside = walk[~np.all((walk == 0) | (walk == _LAST), axis=1)]
    steps = np.abs(np.diff(inside, axis=0))
    np.testing.assert_array_equal(np.sort(steps, axis=1), np.broadcast_to([0, 0, 1], steps.shape))


@pytest.mark.parametrize("part", [2, 4, 8])
def test_the_curve_leaves_a_cube_only_when_it_is_full(part):
    """Runs of part³ points are the aligned cubes of that side."""
    cubes = (_walk(_grid(16)) // part).reshape(-1, part**3, 3)
    np.testing.assert_array_equal(cubes, np.broadcast_to(cubes[:, :1], cubes.shape))


@pytest.mark.parametrize("factor", [2.0**-60, 0.25, 2.0**50])
def test_the_unit_changes_nothing(points, factor):
    """A power of two rounds nothing, so every point keeps its cell."""
    mask = np.ones(len(points), bool)
    np.testing.assert_array_equal(_order(points * np.float32(factor), mask), _order(points, mask))


@pytest.mark.parametrize("factor", [1e-10, 0.3, 7e8])
@pytest.mark.parametrize("offset", [0.0, -3.7, 100.0])
def test_scale_and_shift_change_nothing_away_from_the_edges_of_cells(factor, offset):
    grid, mask = _grid(8), np.ones(512, bool)
    np.testing.assert_array_equal(_order((grid + offset) * np.float32(factor), mask), _order(grid, mask))


def test_derivatives_pass_through_the_points_in_order(points):
    weights = np.arange(1.0, 1537.0, dtype=np.float32).reshape(512, 3)
    mask = np.ones(len(points), bool)
    gradient = jax.grad(lambda p: jnp.sum(weights * p[_order(p, mask)]))(points)
    np.testing.assert_array_equal(gradient[_order(points, mask)], weights)


def test_vmap_agrees_with_a_loop(points):
    clouds = points.reshape(4, 128, 3)
    masks = np.random.default_rng(3).uniform(size=(4, 128)) < 0.7
    alone = [_order(*each) for each in zip(clouds, masks, strict=True)]
    np.testing.assert_array_equal(jax.jit(jax.vmap(curve_order))(clouds, masks), alone)
