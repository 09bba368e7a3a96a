"""Constellations: the same ones in whatever pose, order and padding, and none where a point has too few neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from urrt_jax.clouds import make_cloud
from urrt_jax.features import Constellations, constellations
from urrt_jax.neighbors import nearest, spacing


@jax.jit
def _constellations(points, mask=None) -> Constellations:
    cloud = make_cloud(points, mask)
    return constellations(cloud, nearest(cloud.points, cloud, distinct=True).squared, spacing(cloud))


def _rows(found: Constellations) -> np.ndarray:
    """The places and distances of its real constellations, (K, 7)."""
    return np.column_stack([found.cloud.points, found.distances])[np.asarray(found.cloud.mask)]


def _assert_same(one: np.ndarray, other: np.ndarray) -> None:
    """Both have the same rows in any order; of two points next to each other, equally near, either may be the last."""
    assert len(one) == len(other) > 100
    apart, _ = cKDTree(one).query(other)
    assert np.sum(apart > 1e-4) <= 1


def test_distances_are_those_of_a_tree_search(cloud):
    found = _constellations(cloud)
    expected, _ = cKDTree(cloud).query(np.asarray(found.cloud.points), k=5)
    np.testing.assert_allclose(found.distances, expected[:, 1:], rtol=1e-4, atol=1e-6)


def test_points_are_those_nearest_to_another_one(cloud):
    found = _constellations(cloud)
    closest = np.sort(cKDTree(cloud).query(cloud, k=2)[0][:, 1])[: len(found.cloud.mask)]
    np.testing.assert_allclose(np.sort(found.distances[:, 0]), closest, rtol=1e-4)


def test_pose_and_order_change_nothing(cloud, pose):
    rotation, translation = pose
    moved = (cloud @ rotation.T + translation).astype(np.float32)
    moved = np.random.default_rng(0).permutation(moved)
    there = _rows(_constellations(moved))
    there[:, :3] = (there[:, :3] - translation) @ rotation
    _assert_same(there, _rows(_constellations(cloud)))


def test_padding_changes_nothing(cloud):
    padded = np.concatenate([cloud, np.zeros((50, 3), np.float32)])
    _assert_same(_rows(_constellations(padded, np.arange(250) < 200)), _rows(_constellations(cloud)))


def test_points_that_coincide_count_once(cloud):
    one, twice = _constellations(cloud), _constellations(np.concatenate([cloud, cloud[:40]]))
    found = np.unique(np.round(np.asarray(twice.distances)[:, 0], 5))
    assert np.isin(found, np.round(np.asarray(one.distances)[:, 0], 5)).all()


@pytest.mark.parametrize("count", [0, 1, 4])
def test_fewer_than_five_points_have_none(cloud, count):
    found = _constellations(cloud[:30], np.arange(30) < count)
    assert not np.any(found.cloud.mask)
    assert np.all(np.isfinite(found.distances))
    assert np.any(_constellations(cloud[:30], np.arange(30) < 5).cloud.mask)


def test_no_derivative_passes(cloud):
    gradient = jax.grad(lambda points: jnp.sum(_constellations(points).distances))(jnp.asarray(cloud))
    np.testing.assert_array_equal(gradient, 0.0)
