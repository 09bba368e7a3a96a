"""Refinement on its own: what it recovers, what it resists, and that it says when it did not finish."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, make_cloud, normalize_pair
from urrt_jax.geometry.neighbors import spacing
from urrt_jax.refine import ICP, icp

TURN = Rotation.from_euler("zyx", [8, -5, 6], degrees=True).as_matrix()


@pytest.fixture(scope="module")
def surface():
    """Points of an asymmetric surface: a bent ellipsoid with a bump."""
    points = np.random.default_rng(0).normal(size=(1200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= [1.0, 0.7, 0.45]
    points[:, 2] += 0.3 * points[:, 0] ** 2
    return points + 0.35 * np.exp(-8 * np.sum((points - [0.7, 0.4, 0.3]) ** 2, axis=1))[:, None] * [0.5, 1.0, 0.2]


def refine(source: np.ndarray, target: np.ndarray, config: ICP = ICP()) -> tuple[float, bool]:
    """The rotation error in degrees against TURN, from the identity, and whether it converged."""
    clouds = normalize_pair(make_cloud(jnp.asarray(source, jnp.float32)), make_cloud(jnp.asarray(target, jnp.float32)))
    result = icp(clouds[0], clouds[1], rigid.identity(), config)
    return float(rotation_degrees(result.transform.rotation, TURN)), bool(result.converged)


def test_same_points_are_aligned_exactly(surface):
    error, converged = refine(surface, surface @ TURN.T)
    assert error < 1e-3
    assert converged


def test_points_without_counterparts_are_aligned_within_their_spacing(surface):
    source = surface[::2]
    error, converged = refine(source, surface[1::2] @ TURN.T)
    radius = np.sqrt(np.mean(np.sum((source - source.mean(axis=0)) ** 2, axis=1)))
    assert error < np.degrees(float(spacing(make_cloud(jnp.asarray(source, jnp.float32)))) / radius)
    assert converged


def test_gross_outliers_do_not_pull(surface):
    stray = np.random.default_rng(1).uniform(-1.5, 1.5, size=(120, 3))
    error, _ = refine(np.concatenate([surface, stray]), surface @ TURN.T)
    assert error < 0.1


def test_a_cropped_source_is_aligned(surface):
    error, _ = refine(surface[surface[:, 0] < 0.5], surface @ TURN.T)
    assert error < 0.1


def test_too_few_iterations_are_not_called_converged(surface):
    _, converged = refine(surface[::2], surface[1::2] @ TURN.T, ICP(iterations=2))
    assert not converged


def test_clouds_out_of_reach_are_not_called_converged(surface):
    source = make_cloud(jnp.asarray(surface, jnp.float32))
    far = rigid.Rigid(jnp.eye(3), jnp.array([50.0, 0.0, 0.0]))
    assert not bool(icp(source, source, far, ICP(coarse_points=0)).converged)


def test_an_empty_cloud_keeps_the_initial_transform(surface):
    source = make_cloud(jnp.asarray(surface, jnp.float32))
    empty = Cloud(jnp.zeros_like(source.points), jnp.zeros_like(source.mask))
    initial = rigid.Rigid(jnp.asarray(TURN, jnp.float32), jnp.array([1.0, 2.0, 3.0]))
    result = icp(source, empty, initial)
    np.testing.assert_allclose(result.transform.rotation, TURN, atol=1e-6)
    assert not bool(result.converged)


@pytest.mark.parametrize(
    "options", [{"points": 2}, {"iterations": 0}, {"reach": 0.0}, {"tolerance": float("nan")}, {"coarse_points": -1}]
)
def test_unusable_options_are_named(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        ICP(**options)
