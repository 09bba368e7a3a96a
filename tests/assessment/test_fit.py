"""How well a moved source lies on its target: overlap, inliers and score, against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid, stages
from urrt_jax.assessment.fit import Fit, agreement, fit, fit_samples, inlier_share, score, shares_within, well_posed
from urrt_jax.clouds import Cloud, centroid, make_cloud, shift
from urrt_jax.prepared import Prepared, Sizes, coarser
from urrt_jax.refine import ICP
from urrt_jax.rigid import Rigid

_ROWS = 1024  # all clouds are padded to it, so that one program is compiled
_SIZES = Sizes(sample=512, queries=ICP().points, normal_radius=ICP().normal_radius)  # those of ``register``
_fit_prepared = jax.jit(fit)


def _prepared(cloud: Cloud) -> Prepared:
    return stages.prepare(_SIZES, cloud)


def _fit(source: Cloud, target: Cloud, transform: Rigid, reach: float = 0.0) -> Fit:
    return _fit_prepared(_prepared(source), _prepared(target), transform, reach)


def _padded(points: np.ndarray, rows: int = _ROWS) -> Cloud:
    values = np.full((rows, 3), 9.0, np.float32)
    values[: len(points)] = points
    return make_cloud(values, np.arange(rows) < len(points))


def _sheet(start: float, stop: float) -> Cloud:
    """A plane's grid with one point in each square of 0.1, from ``start`` to ``stop`` along x and over 2 along y."""
    x, y = np.meshgrid(np.arange(start + 0.05, stop, 0.1), np.arange(0.05, 2, 0.1))
    return _padded(np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3))


def _turn(degrees: float) -> Rigid:
    return Rigid(jnp.asarray(Rotation.from_euler("y", degrees, degrees=True).as_matrix(), jnp.float32), jnp.zeros(3))


def test_overlap_of_half_overlapping_planes_is_a_half_of_each():
    overlap = _fit(_sheet(0, 2), _sheet(1, 3), rigid.identity()).overlap
    np.testing.assert_allclose(overlap, [0.55, 0.55], atol=0.01)  # one more column of twenty touches


def test_overlap_of_a_part_is_all_of_it_and_a_half_of_the_whole():
    overlap = _fit(_sheet(0, 1), _sheet(0, 2), rigid.identity()).overlap
    np.testing.assert_allclose(overlap, [1, 0.55], atol=0.01)


def test_overlap_of_clouds_far_apart_is_nothing():
    far = Rigid(jnp.eye(3), jnp.array([0.0, 0.0, 50.0]))
    assert _fit(_sheet(0, 2), _sheet(1, 3), far).shares.tolist() == [[0] * 3] * 2


def test_neighbours_are_looked_for_as_far_as_asked():
    away = Rigid(jnp.eye(3), jnp.array([0.0, 0.0, 0.45]))
    near, far = (_fit(_sheet(0, 2), _sheet(0, 2), away, reach) for reach in (0.0, 0.46))
    real = np.asarray(_prepared(_sheet(0, 2)).cloud.mask)
    assert not np.isfinite(near.squared).any()
    np.testing.assert_allclose(np.sqrt(far.squared[real]), 0.45, rtol=1e-5)
    np.testing.assert_array_equal(near.shares, far.shares)


def test_shares_grow_with_their_distances(cloud):
    shares = _fit(_padded(cloud), _padded(cloud + np.float32(0.05)), _turn(10)).shares
    assert bool(jnp.all(jnp.diff(shares, axis=1) > 0))


def test_swapping_the_clouds_swaps_the_shares(cloud):
    source, target, transform = _padded(cloud[::2]), _padded(cloud[50:]), _turn(5)
    swapped = _fit(target, source, rigid.inverse(transform))
    np.testing.assert_allclose(swapped.shares, _fit(source, target, transform).shares[::-1], atol=1e-6)


def test_squared_distances_are_those_of_the_nearest_and_infinite_for_padding(cloud):
    source, target, transform = _padded(cloud[::2]), _padded(cloud[50:]), _turn(5)
    found = _fit(source, target, transform, 10.0)
    source, target = (_prepared(each).cloud for each in (source, target))
    apart = rigid.apply(transform, source.points) - target.points[found.nearest]
    expected = np.where(source.mask, np.sum(np.square(apart), axis=1), np.inf)
    np.testing.assert_allclose(found.squared, expected, rtol=1e-4, atol=1e-9)


def test_padding_changes_nothing(cloud):
    clouds = cloud, cloud + np.float32(0.03)
    less, more = (_fit(*(_padded(points, rows) for points in clouds), _turn(5)) for rows in (256, _ROWS))
    np.testing.assert_allclose(less.shares, more.shares, atol=1e-6)
    np.testing.assert_allclose(less.squared[:200], more.squared[:200], rtol=1e-5)
    assert not np.isfinite(more.squared[200:]).any()


@pytest.mark.parametrize("degrees", [0, 40])
def test_fit_of_even_samples_is_that_of_their_prepared_clouds(cloud, degrees):
    """Of clouds that are their own even samples."""
    clouds = [_padded(cloud[:100], 256), _padded(cloud[50:150] + np.float32(0.02), 256)]
    samples = [_prepared(each).samples for each in clouds]
    even = [each.even for each in samples]
    found = jax.jit(fit_samples)(*even, _turn(degrees), coarser(*samples))
    expected = _fit(*clouds, _turn(degrees))
    np.testing.assert_allclose(found.shares, expected.shares, atol=1e-6)
    np.testing.assert_allclose(np.sort(found.squared[:100]), np.sort(expected.squared[:100]), rtol=1e-4)


def _agreement(poses: Rigid, source: np.ndarray, target: np.ndarray, reach: float) -> list[float]:
    """By the definition: the mean over both directions of max(0, 1 − d²/r²)."""
    scores = []
    for rotation, translation in zip(*map(np.asarray, poses), strict=True):
        moved = source @ rotation.T + translation
        squared = np.sum((moved[:, None] - target) ** 2, axis=-1)
        directions = [np.maximum(1 - squared.min(axis=axis) / reach**2, 0).mean() for axis in (0, 1)]
        scores.append(np.mean(directions))
    return scores


@pytest.mark.parametrize("count", [1, 16, 21])
def test_agreement_is_that_of_its_definition_for_any_number_of_poses(cloud, count):
    source, target = cloud[:120], cloud[60:150] + np.float32(0.05)
    turns = Rotation.random(count, random_state=0).as_matrix().astype(np.float32)
    poses = Rigid(jnp.asarray(turns), jnp.asarray(np.random.default_rng(0).normal(0, 0.1, (count, 3)), jnp.float32))
    clouds = make_cloud(source), _padded(target, 120)
    found = agreement(poses, clouds, clouds, jnp.float32(0.4))
    np.testing.assert_allclose(found, _agreement(poses, source, target, 0.4), atol=1e-5)


def test_agreement_of_a_cloud_with_itself_is_one_and_with_nothing_zero(cloud):
    poses = Rigid(jnp.stack([jnp.eye(3)] * 2), jnp.array([[0.0, 0, 0], [50, 0, 0]]))
    clouds = (make_cloud(cloud),) * 2
    np.testing.assert_allclose(agreement(poses, clouds, clouds, jnp.float32(0.1)), [1, 0], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_score_of_another_sample_of_the_surface_is_high(make_cloud_points, seed):
    source, target = (_padded(make_cloud_points(each, 4)) for each in (seed, seed + 10))
    assert float(_fit(source, target, rigid.identity()).score) > 0.8


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("degrees", [-40, 40])
def test_score_of_a_cloud_turned_about_its_centre_is_low(make_cloud_points, axis, degrees):
    points = make_cloud_points(0, 4)
    points = points - points.mean(axis=0)
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    wrong = Rigid(jnp.asarray(turn, jnp.float32), jnp.zeros(3))
    assert float(_fit(_padded(points), _padded(points), wrong).score) < 0.7


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_score_is_nothing_where_nothing_and_one_where_all_is_near(share):
    assert float(score(jnp.full((2, 3), share))) == pytest.approx(share, abs=1e-6)


def test_score_of_an_empty_cloud_is_nothing(cloud):
    assert float(_fit(_padded(cloud), _padded(cloud[:0]), rigid.identity()).score) == 0


def test_shares_within_are_those_of_real_points():
    squared = jnp.array([0.0, 1.0, 2.0, 9.0, 9.1, jnp.inf, 0.0])
    found = shares_within(squared, jnp.arange(7) < 6, jnp.float32(1))
    np.testing.assert_allclose(found, np.array([2, 3, 4]) / 6)


def test_inlier_share_and_rmse_are_those_of_real_points_within_reach():
    squared = jnp.array([0.0, 1.0, 4.0, 4.0001, 1e9, jnp.inf, 1.0, 0.0])
    mask = jnp.arange(8) < 6
    share, rmse = inlier_share(mask, squared, jnp.float32(2))
    assert float(share) == pytest.approx(3 / 6)
    assert float(rmse) == pytest.approx(np.sqrt(5 / 3))


@pytest.mark.parametrize(("real", "squared"), [(0, 1.0), (3, 9.0)])
def test_inlier_share_and_rmse_of_no_inliers_are_zero(real, squared):
    assert [float(each) for each in inlier_share(jnp.arange(5) < real, jnp.full(5, squared), jnp.float32(2))] == [0, 0]


@pytest.mark.parametrize("squared", [0.0, 9.0, np.inf])
def test_derivative_of_the_rmse_is_finite(squared):
    gradient = jax.grad(lambda each: inlier_share(jnp.ones(5, bool), each, jnp.float32(2))[1])(jnp.full(5, squared))
    assert np.isfinite(gradient).all()


_LINE = np.outer(np.linspace(-1, 1, 30), [0.3, -0.5, 0.8])
_TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        pytest.param(_TRIANGLE, True, id="three points"),
        pytest.param(1e-5 * _TRIANGLE, True, id="three points, tiny"),
        pytest.param(1e5 * _TRIANGLE, True, id="three points, large"),
        pytest.param(_TRIANGLE * [1, 0.01, 1], True, id="a flat triangle"),
        pytest.param(_TRIANGLE[[0, 1, 1]], False, id="two points, one twice"),
        pytest.param(_TRIANGLE[:2], False, id="two points"),
        pytest.param(np.ones((5, 3)), False, id="coincident points"),
        pytest.param(_LINE, False, id="a line"),
        pytest.param(_LINE[:3], False, id="three points on a line"),
        pytest.param(100 + _LINE, False, id="a line far away"),
        pytest.param(np.outer(np.linspace(-1, 1, 30), [0, 1, 0]), False, id="a line along an axis"),
        pytest.param(np.concatenate([_LINE, [[0.02, 0.0, 0.0]]]), True, id="a line and one point beside it"),
        pytest.param(np.random.default_rng(0).uniform(-1, 1, (30, 3)) * [1, 1, 0], True, id="a plane"),
    ],
)
def test_well_posed_is_what_determines_a_rotation(points, expected):
    cloud = make_cloud(jnp.asarray(points, jnp.float32))
    assert bool(well_posed(shift(cloud, centroid(cloud)))) == expected


def test_padding_does_not_make_a_cloud_well_posed():
    cloud = make_cloud(jnp.asarray(_TRIANGLE - _TRIANGLE.mean(axis=0), jnp.float32), np.arange(3) < 2)
    assert not bool(well_posed(cloud))
