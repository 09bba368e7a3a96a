"""Moment invariants: the same from any pose, mirrored where they say so, blind to padding, smooth.

Mostly in double precision; one test says what single precision makes of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.features.moments import invariant_count, moment_invariants

OCTAVES = 4
TRIPLES = 4  # the last columns


@jax.jit
def _describe(points, mask=None):
    return moment_invariants(make_cloud(points, mask), OCTAVES)


_of_cloud = jax.jit(lambda cloud: moment_invariants(cloud, OCTAVES))


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).normal(size=(90, 3)) * [1.0, 0.7, 0.4]


@pytest.mark.parametrize("seed", range(4))
def test_turning_and_moving_changes_nothing(points, seed, x64):
    offset = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
    moved = points @ Rotation.random(random_state=seed).as_matrix().T + offset
    np.testing.assert_allclose(_describe(moved), _describe(points), atol=1e-8)


def test_single_precision_is_enough(points):
    with jax.enable_x64(True):
        exact = np.asarray(_describe(points))
    found = _describe((points @ Rotation.random(random_state=0).as_matrix().T).astype(np.float32))
    np.testing.assert_allclose(found, exact, atol=2e-3)


def test_a_mirror_turns_the_sign_of_triple_products_and_of_nothing_else(points, x64):
    before, after = np.asarray(_describe(points)), np.asarray(_describe(points * [-1, 1, 1]))
    np.testing.assert_allclose(after[:, :-TRIPLES], before[:, :-TRIPLES], atol=1e-8)
    np.testing.assert_allclose(after[:, -TRIPLES:], -before[:, -TRIPLES:], atol=1e-8)
    assert np.all(np.abs(before[:, -TRIPLES:]).max(axis=0) > 0.05)


def test_every_invariant_tells_points_apart(points):
    assert np.all(np.asarray(_describe(points)).std(axis=0) > 0.01)


def test_points_keep_their_rows(points, x64):
    order = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_allclose(_describe(points[order]), np.asarray(_describe(points))[order], atol=1e-8)


def test_padding_is_not_seen_and_gets_zeros(points, x64):
    mask = np.arange(90) < 60
    found = _of_cloud(Cloud(jnp.asarray(points), jnp.asarray(mask)))  # padding holds points
    np.testing.assert_allclose(found[:60], _describe(points[:60]), atol=1e-8)
    np.testing.assert_array_equal(found[60:], 0)


def test_an_empty_cloud_has_zeros(points):
    np.testing.assert_array_equal(_describe(points, np.zeros(90, bool)), 0)


@pytest.mark.parametrize("octave", range(OCTAVES))
def test_values_are_those_of_the_weighted_covariance(points, octave, x64):
    """The first five of a width, from eigenvalues and lengths."""
    cloud, width = points, 0.1 * 2**octave
    weights = np.exp(-np.sum((cloud[:, None] - cloud[None]) ** 2, axis=-1) / (2 * width**2))
    expected = []
    for point, weight in zip(cloud, weights, strict=True):
        away = (np.average(cloud, axis=0, weights=weight) - point) / width
        spread = np.cov(cloud.T, aweights=weight, ddof=0) / width**2
        a, b, c = np.linalg.eigvalsh(spread)
        along = away @ spread @ away / (away @ away + 0.0025)
        roots = np.sqrt(a * b + b * c + c * a + 1e-4), np.cbrt(a * b * c + 1e-4), np.sqrt(away @ away + 1e-4)
        expected.append([a + b + c, *roots, along])
    np.testing.assert_allclose(_describe(points)[:, 5 * octave : 5 * octave + 5], expected, atol=1e-8)


def test_a_far_stray_point_leaves_the_invariants_finite(points):
    stray = np.concatenate([points, [[3111.3, -2718.7, 2900.9]]]).astype(np.float32)
    found = _describe(stray)
    assert bool(jnp.all(jnp.isfinite(found)))
    np.testing.assert_allclose(found[:-1], _describe(points), atol=5e-3)


@pytest.mark.parametrize("octaves", range(5))
def test_the_count_is_the_number_of_columns(points, octaves):
    found = jax.eval_shape(lambda p: moment_invariants(make_cloud(p), octaves), points)
    assert found.shape == (90, invariant_count(octaves))


@pytest.fixture(scope="module")
def described_sum():
    """The sum of a cloud's invariants and its gradient, of points and mask."""
    return jax.jit(jax.value_and_grad(lambda p, m: jnp.sum(moment_invariants(make_cloud(p, m), OCTAVES))))


@pytest.mark.parametrize(
    "degenerate",
    [np.zeros((20, 3)), np.outer(np.linspace(-1, 1, 20), [1, 2, 3]), np.repeat(np.eye(3), 7, axis=0), [[5e3, 0, 0]]],
    ids=["one point repeated", "line", "three points repeated", "far alone"],
)
def test_degenerate_clouds_have_finite_invariants_and_derivatives(described_sum, degenerate):
    padded, mask = np.zeros((21, 3), np.float32), np.arange(21) < len(degenerate)
    padded[mask] = degenerate
    total, slope = described_sum(padded, mask)
    assert bool(jnp.isfinite(total))
    assert bool(jnp.all(jnp.isfinite(slope)))


def test_derivatives_are_those_of_finite_differences(points, x64):
    wide = jnp.asarray(points[:40])
    mix = jnp.asarray(np.random.default_rng(2).normal(size=(40, invariant_count(OCTAVES))))
    away = jnp.asarray(np.random.default_rng(3).normal(size=(40, 3)))
    value = jax.jit(lambda p: jnp.sum(mix * moment_invariants(make_cloud(p), OCTAVES)))
    _, slope = jax.jvp(value, (wide,), (away,))
    found = (value(wide + 1e-6 * away) - value(wide - 1e-6 * away)) / 2e-6
    np.testing.assert_allclose(slope, found, rtol=1e-5)


def test_places_on_the_cloud_are_described_as_its_points():
    cloud = make_cloud(np.random.default_rng(0).normal(size=(70, 3)), np.arange(70) < 60)
    described = moment_invariants(cloud, OCTAVES, cloud.points)
    np.testing.assert_allclose(described[:60], moment_invariants(cloud, OCTAVES)[:60], atol=1e-5)


def test_places_off_the_cloud_do_not_depend_on_the_pose(x64):
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    points, places = 0.5 * rng.normal(size=(70, 3)), 0.5 * rng.normal(size=(30, 3))
    places[:5] *= 10  # some of which are far from all points
    still, moved = (
        moment_invariants(make_cloud(points @ each.T + shift), OCTAVES, jnp.asarray(places @ each.T + shift))
        for each, shift in ((np.eye(3), 0.0), (turn, 0.3))
    )
    assert still.shape == (30, invariant_count(OCTAVES))
    assert bool(jnp.all(jnp.abs(still) < 30))
    np.testing.assert_allclose(moved, still, atol=1e-6)
