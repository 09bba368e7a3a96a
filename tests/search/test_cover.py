"""Covers of SO(3): groups of rotations from which nothing is farther than stated."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.search import rotation_cover
from urrt_jax.search.cover import COVERING_RADIUS

_COUNTS = sorted(COVERING_RADIUS)


@pytest.mark.parametrize("count", _COUNTS)
def test_cover_has_as_many_members_as_asked(count):
    assert rotation_cover(count).shape == (count, 3, 3)


@pytest.mark.parametrize("count", _COUNTS)
def test_cover_is_single_precision(count):
    assert rotation_cover(count).dtype == np.float32


@pytest.mark.parametrize("count", _COUNTS)
def test_members_are_orthogonal(count):
    members = rotation_cover(count)
    np.testing.assert_allclose(members @ members.transpose(0, 2, 1), np.tile(np.eye(3), (count, 1, 1)), atol=1e-6)


@pytest.mark.parametrize("count", _COUNTS)
def test_members_keep_handedness(count):
    np.testing.assert_allclose(np.linalg.det(rotation_cover(count)), 1, atol=1e-6)


@pytest.mark.parametrize("count", _COUNTS)
def test_identity_comes_first(count):
    np.testing.assert_allclose(rotation_cover(count)[0], np.eye(3), atol=1e-7)


@pytest.mark.parametrize("count", _COUNTS)
def test_members_differ(count):
    members = rotation_cover(count).reshape(count, 9)
    apart = np.linalg.norm(members[:, None] - members, axis=-1) + 9 * np.eye(count)
    assert apart.min() > 0.5


@pytest.mark.parametrize("count", _COUNTS)
def test_members_form_a_group(count):
    members = rotation_cover(count)
    products = np.einsum("aij,bjk->abik", members, members).reshape(-1, 1, 9)
    assert np.max(np.min(np.abs(products - members.reshape(1, count, 9)).max(-1), axis=1)) < 1e-5


@pytest.mark.parametrize("count", _COUNTS)
def test_members_come_in_order_of_their_angle(count):
    angles = Rotation.from_matrix(rotation_cover(count)).magnitude()
    assert np.all(np.diff(angles) > -1e-5)


@pytest.mark.parametrize("count", _COUNTS)
def test_cover_is_the_same_every_time(count):
    np.testing.assert_array_equal(rotation_cover(count), rotation_cover(count))


def _distances(count: int) -> np.ndarray:
    """From random rotations to the nearest member, in degrees."""
    members = Rotation.from_matrix(rotation_cover(count)).as_quat()
    random = Rotation.random(50_000, random_state=0).as_quat()
    return np.rad2deg(2 * np.arccos(np.clip(np.abs(random @ members.T).max(axis=1), 0, 1)))


@pytest.mark.parametrize("count", _COUNTS)
def test_no_rotation_is_farther_than_the_covering_radius(count):
    assert _distances(count).max() <= COVERING_RADIUS[count] + 1e-3


@pytest.mark.parametrize("count", _COUNTS)
def test_some_rotation_is_nearly_as_far_as_the_covering_radius(count):
    assert _distances(count).max() > COVERING_RADIUS[count] - 3


@pytest.mark.parametrize("count", [-1, 0, 2, 12, 23, 48, 120])
def test_unknown_counts_are_refused(count):
    with pytest.raises(ValueError, match=rf"^count: expected one of \[1, 24, 60\], got {count}$"):
        rotation_cover(count)
