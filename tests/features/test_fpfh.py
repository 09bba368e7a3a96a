"""Point feature histograms: what they are invariant to, and that no cloud gives anything but unit vectors and zeros."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import Cloud, centroid, first, make_cloud
from urrt_jax.clouds.normals import normals
from urrt_jax.features import fpfh, turned_around
from urrt_jax.features.fpfh import BINS, _shares, _turn

_RADIUS = 0.5
_ROWS = 300  # of which all but a cloud's are padding: compiling takes far longer than running
_compiled = jax.jit(fpfh, static_argnames="batch_size")


def _fpfh(cloud: Cloud, directions, radius: float, **options) -> np.ndarray:
    """The features of a cloud's rows, of which one size is compiled."""
    size = len(cloud.mask)
    if size < _ROWS:
        cloud = first(cloud, _ROWS)
        directions = np.pad(np.asarray(directions), ((0, _ROWS - size), (0, 0)), constant_values=0.5)
    return np.asarray(_compiled(cloud, directions, radius, **options))[:size]


@pytest.fixture(scope="module")
def surface(cloud) -> np.ndarray:
    """The cloud's normals, (200, 3)."""
    whole = make_cloud(cloud)
    return np.asarray(jax.jit(normals)(whole.points, whole, 0.3, centroid(whole)))


@pytest.fixture(scope="module")
def expected(cloud, surface) -> np.ndarray:
    """Without any padding."""
    return np.asarray(_compiled(make_cloud(cloud), surface, _RADIUS))


def _random_normals(count: int) -> np.ndarray:
    vectors = np.random.default_rng(1).normal(size=(count, 3))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def test_features_are_unit_vectors(expected):
    np.testing.assert_allclose(np.linalg.norm(expected, axis=1), 1, atol=1e-5)


def test_features_are_not_negative(expected):
    assert expected.min() >= 0


def test_each_of_the_three_histograms_has_the_same_total(expected):
    totals = expected.reshape(-1, 3, BINS).sum(-1)
    np.testing.assert_allclose(totals, totals[:, :1] * np.ones(3), rtol=1e-4)


def test_features_tell_points_apart(expected):
    likeness = expected @ expected.T - 2 * np.eye(len(expected))
    assert np.median(likeness.max(axis=1)) < 0.999


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("of", ["surface", "random"])
def test_rigid_motion_with_the_normals_changes_nothing(cloud, surface, seed, of):
    directions = surface if of == "surface" else _random_normals(len(cloud))
    rotation = Rotation.random(random_state=seed).as_matrix()
    moved = (cloud @ rotation.T + [1.0, -2.0, 0.5]).astype(np.float32)
    found = _fpfh(make_cloud(moved), (directions @ rotation.T).astype(np.float32), _RADIUS)
    np.testing.assert_allclose(found, _fpfh(make_cloud(cloud), directions, _RADIUS), atol=2e-4)


@pytest.mark.parametrize("of", ["surface", "random"])
def test_features_with_all_normals_turned_around_are_known_from_those_without(cloud, surface, of):
    directions = surface if of == "surface" else _random_normals(len(cloud))
    found = turned_around(_fpfh(make_cloud(cloud), directions, _RADIUS))
    np.testing.assert_allclose(found, _fpfh(make_cloud(cloud), -directions, _RADIUS), atol=1e-5)


def test_a_reflection_is_noticed(cloud, surface, expected):
    """Otherwise a shape would match its mirror image."""
    mirror = np.array([1, 1, -1], np.float32)
    found = _fpfh(make_cloud(cloud * mirror), surface * mirror, _RADIUS)
    assert np.max(np.abs(found - expected)) > 0.05


def test_permutation_permutes_the_features(cloud, surface, expected):
    order = np.random.default_rng(0).permutation(len(cloud))
    found = _fpfh(make_cloud(cloud[order]), surface[order], _RADIUS)
    np.testing.assert_allclose(found, expected[order], atol=1e-5)


@pytest.fixture(scope="module")
def padded(cloud, surface):
    """The cloud's rows within 300 rows, and the features of all 300."""
    rows = np.random.default_rng(0).permutation(300)[: len(cloud)]
    points, directions = np.zeros((300, 3), np.float32), np.full((300, 3), 0.5, np.float32)
    points[rows], directions[rows] = cloud, surface
    return rows, _fpfh(make_cloud(points, np.isin(np.arange(300), rows)), directions, _RADIUS)


def test_padding_changes_nothing(expected, padded):
    rows, found = padded
    np.testing.assert_allclose(np.asarray(found)[rows], expected, atol=1e-5)


def test_padding_has_zero_features(padded):
    rows, found = padded
    np.testing.assert_array_equal(np.delete(np.asarray(found), rows, axis=0), 0)


@pytest.mark.parametrize("batch_size", [1, 30])
def test_batch_size_changes_nothing(cloud, surface, batch_size):
    few, directions = make_cloud(cloud[:50]), surface[:50]
    found = _fpfh(few, directions, _RADIUS, batch_size=batch_size)
    np.testing.assert_allclose(found, _fpfh(few, directions, _RADIUS), atol=1e-5)


def test_vmap_agrees_with_a_loop(cloud, surface):
    points, directions = cloud[:180].reshape(3, 60, 3), surface[:180].reshape(3, 60, 3)
    together = jax.jit(jax.vmap(lambda p, n: fpfh(make_cloud(p), n, _RADIUS)))(points, directions)
    alone = [_fpfh(make_cloud(p), n, _RADIUS) for p, n in zip(points, directions, strict=True)]
    np.testing.assert_allclose(together, np.stack(alone), atol=1e-5)


def test_small_noise_changes_features_little(cloud, surface, expected):
    moved = cloud + 1e-4 * np.random.default_rng(0).normal(size=cloud.shape).astype(np.float32)
    found = np.asarray(_fpfh(make_cloud(moved), surface, _RADIUS))
    assert np.median(np.sum(found * expected, axis=1)) > 0.999


def test_points_beyond_reach_do_not_matter(cloud, surface, expected):
    far = np.concatenate([cloud, cloud + np.float32(20)])
    found = np.asarray(_fpfh(make_cloud(far), np.concatenate([surface, -surface]), _RADIUS))
    np.testing.assert_allclose(found[: len(cloud)], expected, atol=1e-5)


def test_an_isolated_point_has_a_zero_feature(cloud, surface):
    points = np.concatenate([cloud, [[9, 9, 9]]]).astype(np.float32)
    found = _fpfh(make_cloud(points), np.concatenate([surface, [[0, 0, 1]]]).astype(np.float32), _RADIUS)
    np.testing.assert_array_equal(found[-1], 0)


@pytest.mark.parametrize("count", [1, 2, 12])
def test_coincident_points_have_zero_features(count):
    found = _fpfh(make_cloud(np.ones((count, 3), np.float32)), _random_normals(count), _RADIUS)
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize(
    "degenerate",
    [
        pytest.param(np.array([[0.0, 0, 0], [0, 0, 0.1]]), id="two points along the normal"),
        pytest.param(np.outer(np.linspace(-1, 1, 20), [0, 0, 1]), id="a line along the normal"),
        pytest.param(np.outer(np.linspace(-1, 1, 20), [1, 0, 0]), id="a line across the normal"),
        pytest.param(np.repeat(np.outer(np.linspace(0, 1, 5), [0, 1, 0]), 2, axis=0), id="every point twice"),
        pytest.param(np.outer(np.linspace(-1, 1, 20), [1e-9, 0, 0]), id="nearly coincident"),
    ],
)
def test_degenerate_clouds_have_unit_or_zero_features(degenerate):
    up = np.tile(np.array([0, 0, 1], np.float32), (len(degenerate), 1))
    length = np.linalg.norm(_fpfh(make_cloud(degenerate.astype(np.float32)), up, _RADIUS), axis=1)
    assert np.all((np.abs(length - 1) < 1e-5) | (length == 0))


def test_an_empty_cloud_has_zero_features(cloud, surface):
    found = _fpfh(make_cloud(cloud, np.zeros(len(cloud), bool)), surface, _RADIUS)
    np.testing.assert_array_equal(found, 0)


def test_a_plane_s_features_have_one_bin_each():
    """All angles are zero there, which the middle bins hold."""
    flat = np.concatenate([np.random.default_rng(0).uniform(-1, 1, (100, 2)), np.zeros((100, 1))], 1).astype(np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (100, 1))
    expected = np.zeros((3, BINS))
    expected[:, BINS // 2] = 3**-0.5
    np.testing.assert_allclose(_fpfh(make_cloud(flat), up, 0.7), np.tile(expected.ravel(), (100, 1)), atol=1e-5)


def _sums_to_one(values) -> None:
    np.testing.assert_allclose(_shares(jnp.asarray(values, jnp.float32)).sum(axis=0), 1, atol=1e-5)


@given(st.lists(st.floats(-1, 1, width=32), min_size=8, max_size=8))
def test_shares_sum_to_one(values):
    _sums_to_one(values)


def test_shares_at_the_edges_of_bins_sum_to_one():
    _sums_to_one(np.linspace(-1, 1, 2 * BINS + 1))


@pytest.mark.parametrize("value", [1.0000002, -1.0000002, 1.5, -7.0])
def test_shares_of_values_beyond_the_ends_sum_to_one(value):
    """Rounding brings scalar products of unit vectors there."""
    _sums_to_one([value])


@pytest.mark.parametrize(("value", "full"), [(-1.0, 0), (0.0, BINS // 2), (1.0, BINS - 1)])
def test_shares_at_the_ends_and_the_middle_go_to_one_bin(value, full):
    np.testing.assert_allclose(_shares(jnp.array([value]))[:, 0], np.eye(BINS)[full], atol=1e-5)


def test_turn_rises_with_the_angle_and_meets_itself_at_half_a_turn():
    angles = np.linspace(-np.pi, np.pi, 721)[1:-1]
    places = np.asarray(_turn(jnp.sin(angles), jnp.cos(angles)))
    assert np.all(np.diff(places) > 0)
    np.testing.assert_allclose(places[[0, 180, 360, 540, -1]], [-1, -0.5, 0, 0.5, 1], atol=0.01)


def test_shares_are_not_negative():
    assert float(_shares(jnp.linspace(-1.1, 1.1, 301)).min()) >= 0
