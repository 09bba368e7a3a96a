"""How precisely the pose is determined: information and covariance, against their definitions and true errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid, stages
from urrt_jax.assessment.precision import (
    Precision,
    cross_matrix,
    information,
    moved_covariance,
    moved_information,
    precision,
)
from urrt_jax.clouds import make_cloud
from urrt_jax.prepared import Prepared, Sizes
from urrt_jax.refine import ICP, settle
from urrt_jax.rigid import Rigid

_POINTS = np.random.default_rng(0).normal([1.0, -2.0, 0.5], size=(30, 3))
_INLIER = np.arange(30) % 3 > 0


def _summed(points: np.ndarray, inlier: np.ndarray) -> np.ndarray:
    """Σ GᵀG with G = [I, −[q]×], where [q]× p = q × p, by the definition."""
    total = np.zeros((6, 6))
    for q in points[inlier]:
        g = np.concatenate([np.eye(3), -np.cross(q, np.eye(3)).T], axis=1)
        total += g.T @ g
    return total


@pytest.mark.parametrize("inlier", [_INLIER, np.ones(30, bool), np.zeros(30, bool)], ids=["some", "all", "none"])
def test_information_is_the_sum_of_its_definition(inlier):
    found = information(jnp.asarray(_POINTS, jnp.float32), inlier)
    np.testing.assert_allclose(found, _summed(_POINTS, inlier), rtol=1e-5, atol=1e-4)


def test_information_is_how_the_squared_distance_grows_with_a_motion():
    """To first order the points q move by t + ω × q."""
    motion = np.array([0.3, -0.2, 0.1, 0.5, 0.4, -0.6])
    moved = motion[:3] + np.cross(motion[3:], _POINTS[_INLIER])
    matrix = information(jnp.asarray(_POINTS, jnp.float32), _INLIER)
    assert float(motion @ matrix @ motion) == pytest.approx(np.sum(moved**2), rel=1e-5)


def test_values_of_outliers_do_not_reach_the_information():
    strange = np.where(_INLIER[:, None], _POINTS, np.nan).astype(np.float32)
    np.testing.assert_allclose(information(strange, _INLIER), _summed(_POINTS, _INLIER), rtol=1e-5, atol=1e-4)


_OFFSET = np.array([0.7, -1.5, 2.0])


def test_moved_information_is_that_of_the_moved_points():
    matrix = information(jnp.asarray(_POINTS, jnp.float32), _INLIER)
    moved = jax.jit(moved_information)(matrix, jnp.asarray(_OFFSET, jnp.float32))
    np.testing.assert_allclose(moved, _summed(_POINTS + _OFFSET, _INLIER), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_moved_information_by_a_numpy_offset_keeps_its_digits(scale):
    moved = moved_information(_summed(_POINTS, _INLIER), scale * _OFFSET)
    assert moved.dtype == np.float64
    expected = _summed(_POINTS + scale * _OFFSET, _INLIER)
    np.testing.assert_allclose(moved, expected, rtol=1e-12, atol=1e-12 * scale**2)


def test_moved_information_of_a_jax_matrix_by_a_numpy_offset_is_float64():
    matrix = information(jnp.asarray(_POINTS, jnp.float32), _INLIER)
    assert moved_information(matrix, _OFFSET).dtype == np.float64


def test_moved_information_is_traceable_with_a_numpy_offset():
    matrix = information(jnp.asarray(_POINTS, jnp.float32), _INLIER)
    traced = jax.jit(lambda each: moved_information(each, _OFFSET))(matrix)
    np.testing.assert_allclose(traced, moved_information(matrix, _OFFSET), rtol=1e-5)


@pytest.mark.parametrize("arrays", [np, jnp])
def test_cross_matrix_is_the_cross_product_from_the_left(arrays):
    matrix = cross_matrix(arrays.asarray([1.0, -2.0, 3.0]))
    assert isinstance(matrix, np.ndarray) == (arrays is np)
    np.testing.assert_array_equal(matrix @ np.array([4.0, 5.0, -6.0]), np.cross([1.0, -2.0, 3.0], [4.0, 5.0, -6.0]))


def test_moved_covariance_is_the_inverse_of_the_moved_information():
    matrix = _summed(_POINTS, _INLIER)
    moved = moved_covariance(np.linalg.inv(matrix), _OFFSET)
    np.testing.assert_allclose(moved @ moved_information(matrix, _OFFSET), np.eye(6), atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_moved_covariance_by_a_numpy_offset_is_float64_and_comes_back(scale):
    matrix = np.linalg.inv(_summed(_POINTS, _INLIER)).astype(np.float32)
    moved = moved_covariance(matrix, scale * _OFFSET)
    assert moved.dtype == np.float64
    np.testing.assert_allclose(moved_covariance(moved, -scale * _OFFSET), matrix, atol=1e-15 * scale**2 + 1e-9)


_SIZES = Sizes(sample=512, queries=ICP().points, normal_radius=ICP().normal_radius)  # those of ``register``
_precision, _settle = jax.jit(precision), jax.jit(settle)


def _prepared(points: np.ndarray, rows: int = 256) -> Prepared:
    values = np.zeros((rows, 3), np.float32)
    values[: len(points)] = points
    return stages.prepare(_SIZES, make_cloud(values, np.arange(rows) < len(points)))


def _precise(source: np.ndarray, target: np.ndarray, transform: Rigid | None = None) -> Precision:
    return _precision(_prepared(source), _prepared(target), transform or rigid.identity())


def _noisy(points: np.ndarray, noise: float, seed: int) -> np.ndarray:
    return points + np.random.default_rng(seed).normal(scale=noise, size=points.shape)


def test_a_covariance_is_symmetric_and_has_no_negative_direction(cloud):
    found = np.asarray(_precise(_noisy(cloud, 0.02, 0), _noisy(cloud, 0.02, 1)).covariance, np.float64)
    np.testing.assert_allclose(found, found.T, atol=1e-9)
    assert np.linalg.eigvalsh(found).min() > -1e-6 * np.trace(found)


def test_the_covariance_of_a_copy_is_nothing(cloud):
    found = _precise(cloud, cloud)
    assert float(jnp.trace(found.covariance)) < 1e-8
    assert float(found.spread) < 1e-6
    assert float(found.pairs) == pytest.approx(2 * len(cloud), rel=1e-3)


def test_the_deviation_grows_with_the_noise(make_cloud_points):
    deviations = [
        float(_precise(_noisy(make_cloud_points(0), noise, 0), _noisy(make_cloud_points(0), noise, 1)).deviation)
        for noise in (0.001, 0.005, 0.02)
    ]
    assert 2 * deviations[0] < deviations[1] < deviations[2] / 2


def test_a_ball_is_not_determined_and_an_uneven_shape_is(make_cloud_points):
    draw = np.random.default_rng(0).normal(size=(2, 200, 3))
    ball = draw / np.linalg.norm(draw, axis=-1, keepdims=True)
    uneven = _precise(make_cloud_points(0), make_cloud_points(5))
    assert float(_precise(*ball).deviation) > 5 * float(uneven.deviation)


def test_the_covariance_turns_with_the_clouds(cloud):
    source, target = _noisy(cloud, 0.01, 0), _noisy(cloud, 0.01, 1)
    turn = Rotation.from_euler("xyz", [50, -20, 130], degrees=True).as_matrix()
    motion = Rigid(jnp.asarray(turn, jnp.float32), jnp.zeros(3))
    moved = _precise(source, target @ turn.T, motion)
    expected = np.kron(np.eye(2), turn) @ _precise(source, target).covariance @ np.kron(np.eye(2), turn.T)
    np.testing.assert_allclose(moved.covariance, expected, atol=0.05 * np.abs(expected).max())


def test_the_covariance_is_that_of_many_noisy_pairs(make_cloud_points):
    """About an origin far from the clouds, where a turn and a shift depend on each other."""
    errors = []
    for seed in range(30):
        source, target = (
            _noisy(make_cloud_points(seed + way) + np.float32([2, 1, 0]), 0.01, seed + way) for way in (100, 200)
        )
        clouds = _prepared(source), _prepared(target)
        end = _settle(ICP(), *clouds, rigid.identity(), jnp.float32(0.2)).transform
        covariance = np.asarray(_precision(*clouds, end).covariance, np.float64)
        turn = Rotation.from_matrix(np.asarray(end.rotation, np.float64)).inv()
        # The motion that leads from the pose found to the right one, the identity.
        motion = np.concatenate([-turn.apply(end.translation), turn.as_rotvec()])
        errors.append(motion @ np.linalg.solve(covariance, motion) / 6)
    assert 0.3 < np.mean(errors) < 3


def test_swapping_the_clouds_keeps_the_covariance(cloud):
    one, other = _noisy(cloud, 0.01, 0), _noisy(cloud, 0.01, 1)
    np.testing.assert_allclose(_precise(one, other).covariance, _precise(other, one).covariance, rtol=1e-3, atol=1e-7)


def test_padding_changes_no_covariance(cloud):
    clouds = _noisy(cloud, 0.01, 0), _noisy(cloud, 0.01, 1)
    less, more = (_precision(*(_prepared(each, rows) for each in clouds), rigid.identity()) for rows in (256, 1024))
    np.testing.assert_allclose(less.covariance, more.covariance, rtol=1e-2, atol=1e-7)
    assert float(less.pairs) == pytest.approx(float(more.pairs), rel=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_the_precision_of_few_points_is_finite(cloud, count):
    found = _precise(cloud[:count], cloud)
    assert all(np.isfinite(each).all() for each in found)
    assert np.isfinite(float(found.deviation))


def test_the_derivative_of_the_covariance_is_that_of_finite_differences(cloud):
    source, target = (_prepared(_noisy(cloud, 0.01, seed)) for seed in (0, 1))

    def volume(shift: jax.Array) -> jax.Array:
        found = precision(source, target, Rigid(jnp.eye(3), jnp.array([1.0, 0.5, 0.0]) * shift))
        return jnp.log(jnp.trace(found.covariance))

    derivative = float(jax.grad(volume)(0.01))
    step = 2e-4
    quotient = float(volume(0.01 + step) - volume(0.01 - step)) / (2 * step)
    assert derivative == pytest.approx(quotient, rel=0.1)
