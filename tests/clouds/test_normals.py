"""Normals: known surfaces, their sign, what they are invariant to, and the eigenvector against LAPACK's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import Cloud, centroid, first, make_cloud
from urrt_jax.clouds.normals import face_alike, least_axis, normals

_RADIUS = 0.3
_ROWS = 400  # of which all but a cloud's are padding: compiling takes far longer than running
_compiled = jax.jit(normals)
_least_axes = jax.jit(jax.vmap(least_axis))


def _normals(points, cloud: Cloud, radius: float, centre) -> jax.Array:
    """The normals of at most a few hundred points, of which one size is compiled."""
    count = len(points)
    cloud = first(cloud, max(_ROWS, len(cloud.mask)))
    padded = jnp.pad(jnp.asarray(points), ((0, max(_ROWS - count, 0)), (0, 0)))
    return _compiled(padded, cloud, radius, centre)[:count]


def _sphere(count: int = 1500) -> np.ndarray:
    """Points spread evenly over the unit sphere along a spiral, (count, 3)."""
    height = 1 - (2 * np.arange(count) + 1) / count
    around = np.pi * (1 + 5**0.5) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(around), ring * np.sin(around), height], 1).astype(np.float32)


def _plane(normal: np.ndarray, count: int = 200) -> np.ndarray:
    """Points of a plane through the origin, (count, 3)."""
    flat = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3))
    return (flat - np.outer(flat @ normal, normal)).astype(np.float32)


def _well_determined(points: np.ndarray) -> np.ndarray:
    """Where the neighbourhood varies clearly least in one direction, and is not seen edge-on, (N,) bool."""
    chosen = []
    for point in points.astype(np.float64):
        near = points[np.sum((points - point) ** 2, axis=1) < _RADIUS**2].astype(np.float64)
        widths, axes = np.linalg.eigh(np.cov(near.T, bias=True) if len(near) > 3 else np.zeros((3, 3)))
        edge_on = abs(axes[:, 0] @ (point - points.mean(0))) < 1e-3
        chosen.append(widths[1] - widths[0] > 0.01 * _RADIUS**2 and not edge_on)
    return np.array(chosen)


@pytest.fixture(scope="module")
def points(make_cloud_points) -> np.ndarray:
    return make_cloud_points(0, 2)


@pytest.fixture(scope="module")
def expected(points) -> np.ndarray:
    cloud = make_cloud(points)
    return np.asarray(_normals(points, cloud, _RADIUS, centroid(cloud)))


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, -0.8), (1, 1, 1), (-3, 1e-3, 2)])
def test_normals_of_a_plane_are_the_plane_s(normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    points = _plane(normal)
    found = _normals(points, make_cloud(points), _RADIUS, jnp.asarray(-normal, jnp.float32))
    np.testing.assert_allclose(found, np.broadcast_to(normal, points.shape), atol=1e-4)


def test_normals_of_a_sphere_are_radial():
    points = _sphere()
    found = np.asarray(_normals(points, make_cloud(points), _RADIUS, jnp.zeros(3)))
    # The neighbourhood of a spiral is not quite round; the worst is next to a pole.
    assert np.min(np.sum(found * points, axis=1)) > np.cos(np.deg2rad(2))


@pytest.mark.parametrize("outside", [(0, 0, 0), (0.9, 0.2, -0.3), (5, 5, 5)])
def test_normals_point_away_from_outside(points, outside):
    outside = np.array(outside, np.float32)
    found = _normals(points, make_cloud(points), _RADIUS, outside)
    assert np.min(np.sum(np.asarray(found) * (points - outside), axis=1)) >= -1e-6


def test_outside_changes_nothing_but_the_sign(points, expected):
    found = _normals(points, make_cloud(points), _RADIUS, jnp.array([5.0, -4.0, 3.0]))
    np.testing.assert_array_equal(np.abs(found), np.abs(expected))


def test_normals_are_unit_vectors(expected):
    np.testing.assert_allclose(np.linalg.norm(expected, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_normals_turn_with_the_cloud(points, expected, seed):
    rotation = Rotation.random(random_state=seed).as_matrix()
    turned = (points @ rotation.T).astype(np.float32)
    cloud = make_cloud(turned)
    found = np.asarray(_normals(turned, cloud, _RADIUS, centroid(cloud)))
    clear = _well_determined(points)
    assert clear.mean() > 0.8
    np.testing.assert_allclose(found[clear], (expected @ rotation.T)[clear], atol=1e-4)


@pytest.mark.parametrize("offset", [(0.5, -2.0, 8.0), (100.0, 0.0, -50.0)])
def test_normals_do_not_change_when_the_cloud_moves(points, expected, offset):
    moved = points + np.array(offset, np.float32)
    cloud = make_cloud(moved)
    found = np.asarray(_normals(moved, cloud, _RADIUS, centroid(cloud)))
    clear = _well_determined(points)
    # Coordinates near 100 are rounded to 8e-6, against a neighbourhood of 0.3.
    np.testing.assert_allclose(found[clear], expected[clear], atol=5e-3)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_normals_do_not_depend_on_the_unit(points, expected, scale):
    scaled = points * np.float32(scale)
    cloud = make_cloud(scaled)
    found = np.asarray(_normals(scaled, cloud, _RADIUS * scale, centroid(cloud)))
    clear = _well_determined(points)
    np.testing.assert_allclose(found[clear], expected[clear], atol=1e-3)


def test_order_of_points_does_not_change_normals(points, expected):
    order = np.random.default_rng(0).permutation(len(points))
    cloud = make_cloud(points[order])
    found = np.asarray(_normals(points, cloud, _RADIUS, centroid(cloud)))
    clear = _well_determined(points)
    np.testing.assert_allclose(found[clear], expected[clear], atol=1e-4)


def test_padding_does_not_change_normals(points):
    outside = jnp.array([0.1, 0.2, 0.0])
    points = points - points[0]  # padding holds zeros, which are then near real points
    rows = np.random.default_rng(0).permutation(2 * len(points))[: len(points)]
    padded, mask = np.zeros((2 * len(points), 3), np.float32), np.zeros(2 * len(points), bool)
    padded[rows], mask[rows] = points, True
    found = np.asarray(_normals(points, make_cloud(padded, mask), _RADIUS, outside))
    expected = np.asarray(_normals(points, make_cloud(points), _RADIUS, outside))
    clear = _well_determined(points)
    np.testing.assert_allclose(found[clear], expected[clear], atol=1e-4)


@pytest.mark.parametrize("row", [0, -1])
@pytest.mark.parametrize("far", [1e3, 1e6, np.nan])
def test_a_stray_query_does_not_change_the_other_normals(points, expected, row, far):
    cloud = make_cloud(points)
    among = np.insert(points, row % (len(points) + 1), far, axis=0)
    found = np.delete(_normals(among, cloud, _RADIUS, centroid(cloud)), row, axis=0)
    good = _well_determined(points)
    np.testing.assert_allclose(found[good], expected[good], atol=1e-4)


@pytest.mark.parametrize("row", [0, -1])
def test_a_stray_point_does_not_change_normals_far_from_it(points, expected, row):
    among = np.insert(points, row % (len(points) + 1), 1e3, axis=0)
    found = np.delete(_normals(among, make_cloud(among), _RADIUS, points.mean(axis=0)), row, axis=0)
    good = _well_determined(points)
    np.testing.assert_allclose(found[good], expected[good], atol=1e-4)


def test_vmap_agrees_with_a_loop():
    clouds = np.stack([_sphere(80) * scale for scale in (1.0, 0.9, 0.8)]).astype(np.float32)
    together = jax.vmap(lambda p: normals(p, make_cloud(p), 0.6, jnp.zeros(3)))(clouds)
    alone = [_normals(p, make_cloud(p), 0.6, jnp.zeros(3)) for p in clouds]
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-5)


_LINE = np.outer(np.linspace(-1, 1, 30), [0.3, -0.5, 0.8])


@pytest.mark.parametrize(
    "degenerate",
    [
        pytest.param(np.array([[1.0, 2, 3]]), id="one point"),
        pytest.param(np.array([[1.0, 2, 3], [1, 2, 3.1]]), id="two points"),
        pytest.param(_LINE, id="a line"),
        pytest.param(_LINE + 100, id="a line far away"),
        pytest.param(np.outer(np.linspace(-1, 1, 30), [1, 0, 0]), id="a line along an axis"),
        pytest.param(np.ones((20, 3)), id="coincident"),
        pytest.param(np.zeros((20, 3)), id="coincident at the origin"),
        pytest.param(10 * np.eye(3), id="isolated"),
    ],
)
@pytest.mark.parametrize("radius", [1e-6, 0.3, 1e3])
def test_normals_of_a_degenerate_cloud_are_unit_vectors(degenerate, radius):
    degenerate = degenerate.astype(np.float32)
    cloud = make_cloud(degenerate)
    found = _normals(degenerate, cloud, radius, centroid(cloud))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_normals_where_nothing_is_near_are_unit_vectors():
    points = _sphere(20)
    found = _normals(points + 50, make_cloud(points), _RADIUS, jnp.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_normals_of_an_empty_cloud_are_unit_vectors():
    points = _sphere(20)
    found = _normals(points, make_cloud(points, np.zeros(20, bool)), _RADIUS, jnp.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def _symmetric(widths, count: int = 500) -> np.ndarray:
    """Matrices (count, 3, 3) of these eigenvalues in random frames, float32."""
    frames = Rotation.random(count, random_state=0).as_matrix()
    return ((frames * np.asarray(widths)) @ frames.transpose(0, 2, 1)).astype(np.float32)


def _excess(spread: np.ndarray, axes) -> np.ndarray:
    """By how much the spread along the axes is more than the least, as a share of the largest."""
    spread, axes = spread.astype(np.float64), np.asarray(axes, np.float64)
    widths = np.linalg.eigvalsh(spread)
    return (np.einsum("ni,nij,nj->n", axes, spread, axes) - widths[:, 0]) / np.abs(widths).max(axis=1)


@pytest.mark.parametrize(
    "widths",
    [(1, 2, 3), (0, 1, 2), (0, 1, 1), (0, 1, 1.0001), (1e-6, 0.2, 0.25), (1e-4, 2e-3, 0.2), (-3, -2, -1), (-1, 0, 1)],
)
def test_least_axis_is_lapack_s(widths):
    spread = _symmetric(widths)
    expected = np.linalg.eigh(spread.astype(np.float64))[1][:, :, 0]
    found = np.asarray(_least_axes(spread))
    assert np.min(np.abs(np.sum(found * expected, axis=1))) > 1 - 1e-5


@pytest.mark.parametrize("gap", [1e-2, 1e-3])
@pytest.mark.parametrize("least", [0.0, 1.0])
def test_least_axis_of_nearly_equal_widths_varies_least(least, gap):
    """The vector is not determined well then, what it is for is."""
    spread = _symmetric((least, least + gap, least + 1))
    assert np.max(_excess(spread, _least_axes(spread))) < 2e-5


@pytest.mark.parametrize("widths", [(1, 1, 1), (1, 1.0001, 1.0002), (1, 1.01, 1.02), (0.1, 0.1, 0.1)])
def test_least_axis_of_a_nearly_round_spread_varies_least(widths):
    spread = _symmetric(widths)
    assert np.max(_excess(spread, _least_axes(spread))) < 2e-6


def test_least_axis_of_random_moments_varies_least():
    factors = np.random.default_rng(0).normal(size=(2000, 3, 3))
    spread = (factors @ factors.transpose(0, 2, 1)).astype(np.float32)
    assert np.max(_excess(spread, _least_axes(spread))) < 1e-5


@pytest.mark.parametrize("multiple", [0.0, 0.125, 1.0, 64.0])
def test_least_axis_of_a_multiple_of_one_is_z(multiple):
    assert least_axis(multiple * jnp.eye(3)).tolist() == [0, 0, 1]


@pytest.mark.parametrize("widths", [(0, 0, 0), (0, 0, 1), (1, 1, 2), (0, 1, 1), (5, 5, 5)])
def test_least_axis_is_a_unit_vector(widths):
    np.testing.assert_allclose(np.linalg.norm(_least_axes(_symmetric(widths)), axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("widths", [(1, 2, 3), (0, 1, 2), (0, 1, 1), (1e-6, 0.2, 0.25), (-3, -2, -1), (0, 0.01, 1)])
def test_derivative_of_least_axis_agrees_with_finite_differences(widths, x64):
    spread = jnp.asarray(_symmetric(widths, 20), x64)
    spread = (spread + jnp.swapaxes(spread, 1, 2)) / 2
    change = jnp.asarray(_symmetric((1, -0.5, 0.7), 40)[20:], x64)
    change = (change + jnp.swapaxes(change, 1, 2)) / 2
    _, slope = jax.jvp(_least_axes, (spread,), (change,))
    expected = (_least_axes(spread + 1e-6 * change) - _least_axes(spread - 1e-6 * change)) / 2e-6
    np.testing.assert_allclose(slope, expected, atol=1e-6 * float(jnp.max(jnp.abs(expected))))


@pytest.mark.parametrize("widths", [(0, 0, 0), (0, 0, 1), (1, 1, 2), (0, 1, 1), (5, 5, 5), (0, 1e-8, 1)])
def test_derivative_of_least_axis_is_finite(widths):
    spread = jnp.asarray(_symmetric(widths, 20))
    _, slope = jax.jvp(_least_axes, (spread,), (jnp.ones_like(spread),))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("both", [False, True])
def test_derivative_of_normals_agrees_with_finite_differences(points, both, x64):
    """When the cloud moves, and when the places move too; while neighbourhoods hold, these alone change nothing."""
    points = jnp.asarray(points[_well_determined(points)], x64)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=points.shape))

    @jax.jit
    def at(step):
        moved = points + step * direction
        return _normals(moved if both else points, make_cloud(moved), _RADIUS, jnp.zeros(3))

    _, slope = jax.jvp(at, (0.0,), (1.0,))
    expected = (at(1e-7) - at(-1e-7)) / 2e-7
    np.testing.assert_allclose(slope, expected, atol=1e-5 * float(jnp.max(jnp.abs(expected))))


def _shell(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Points of an open, wavy sheet, as a scan sees it, about their centroid, and normals that all face one way."""
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, count))
    points = np.stack([x, y, 0.2 * np.sin(4 * x)], axis=1)
    facing = np.stack([-0.8 * np.cos(4 * x), np.zeros(count), np.ones(count)], axis=1)
    points, facing = points - points.mean(axis=0), facing / np.linalg.norm(facing, axis=1, keepdims=True)
    return points.astype(np.float32), facing.astype(np.float32)


def _at_odds(found, points: np.ndarray) -> float:
    """The share of points whose normal faces away from that of their nearest neighbour."""
    found, nearest = np.asarray(found), KDTree(points).query(points, k=2)[1][:, 1]
    return np.mean(np.sum(found * found[nearest], axis=1) < 0)


def test_normals_of_patches_of_an_open_sheet_are_made_to_agree():
    points, facing = _shell()
    rough = facing * np.where(np.random.default_rng(1).uniform(size=(400, 1)) < 0.2, -1, 1).astype(np.float32)
    rough = np.where(points[:, :1] > 0, rough, -rough)  # two halves that face opposite ways
    found = face_alike(rough, make_cloud(points), 0.1, steps=16)
    assert _at_odds(rough, points) > 0.25
    assert _at_odds(found, points) < 0.04  # where the halves meet


def test_a_few_normals_that_are_the_wrong_way_around_are_turned():
    outward = _sphere(400)
    wrong = outward.copy()
    wrong[np.random.default_rng(0).permutation(400)[:40]] *= -1
    np.testing.assert_array_equal(face_alike(wrong, make_cloud(outward), 0.2, steps=16), outward)


def test_normals_whose_neighbours_are_not_asked_point_outward():
    points, facing = _shell()
    outward = np.where(np.sum(points * facing, axis=1, keepdims=True) < 0, -facing, facing)
    np.testing.assert_array_equal(face_alike(outward, make_cloud(points), 0.2, steps=0), outward)


def test_padding_does_not_vote():
    points, facing = _shell()
    outward = np.where(np.sum(points * facing, axis=1, keepdims=True) < 0, -facing, facing)
    alone = face_alike(outward, make_cloud(points), 0.1, steps=16)
    cloud = make_cloud(np.concatenate([points, points]), np.arange(800) < 400)
    padded = face_alike(np.concatenate([outward, -facing]), cloud, 0.1, steps=16)
    np.testing.assert_array_equal(padded[:400], alone)
