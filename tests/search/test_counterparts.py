"""Clouds that hold the same points are aligned by these, however flat or symmetric; others are left alone."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import urrt_jax
from urrt_jax.clouds import make_cloud
from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.features import constellations
from urrt_jax.neighbors import nearest, spacing
from urrt_jax.search import find_counterparts

_ROTATION, _TRANSLATION = Rotation.random(random_state=5).as_matrix(), np.array([0.4, -0.2, 0.3])


def _plate(count: int = 600, seed: int = 0) -> np.ndarray:
    """A flat plate, on which samples slide: only its points tell where it is."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-1, -1, -0.01], [1, 1, 0.01], (count, 3)).astype(np.float32)


def _moved(points: np.ndarray) -> np.ndarray:
    return (points @ _ROTATION.T + _TRANSLATION).astype(np.float32)


@jax.jit
def _known(points):
    cloud = make_cloud(points)
    return constellations(cloud, nearest(cloud.points, cloud, distinct=True).squared, spacing(cloud))


_find = jax.jit(find_counterparts)


def _found(source, target):
    return _find(_known(source), _known(target))


def _slid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The halves of the plate that two views see, of which a third is the same."""
    return points[points[:, 0] < 0.33], points[points[:, 0] > -0.33]


def test_pose_of_crops_of_a_plate_is_exact():
    source, target = _slid(_plate())
    found = _found(source, _moved(target))
    assert found.sure
    assert rotation_degrees(found.transform.rotation, _ROTATION) < 0.01
    np.testing.assert_allclose(found.transform.translation, _TRANSLATION, atol=1e-4)


def test_register_finds_where_crops_of_a_plate_belong():
    source, target = _slid(_plate(300))
    found = urrt_jax.register(source, _moved(target))
    assert rotation_degrees(found.rotation, _ROTATION) < 0.01
    np.testing.assert_allclose(found.translation, _TRANSLATION, atol=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_stray_points_do_no_harm(share):
    rng = np.random.default_rng(1)
    source, target = _plate(), _moved(_plate())
    for cloud in (source, target):
        some = rng.permutation(len(cloud))[: round(share * len(cloud))]
        cloud[some] = rng.normal(size=(len(some), 3))
    found = _found(source, target)
    assert found.sure
    assert rotation_degrees(found.transform.rotation, _ROTATION) < 0.01


def test_samples_of_one_surface_have_no_counterparts():
    assert not _found(_plate(), _moved(_plate(seed=1))).sure


def test_noise_leaves_no_counterparts():
    noise = 0.02 * np.random.default_rng(2).normal(size=(600, 3)).astype(np.float32)
    assert not _found(_plate(), _moved(_plate()) + noise).sure


def test_lattices_are_left_alone():
    """Any shift of a lattice by its step brings points together."""
    lattice = np.stack(np.meshgrid(*(np.arange(8),) * 3), axis=-1).reshape(-1, 3).astype(np.float32) / 8
    assert not _found(lattice, _moved(lattice[lattice[:, 0] > 0.2])).sure


def test_mirrored_halves_are_left_alone():
    """Every figure of a symmetric cloud has a twin."""
    half = np.abs(_plate(300)) * [1, 1, 50] + [0.1, 0, 0]
    both = np.concatenate([half, half * [-1, 1, 1]]).astype(np.float32)
    assert not _found(both, _moved(both)).sure


def test_points_on_one_line_do_not_determine_a_pose():
    line = np.outer(np.random.default_rng(3).uniform(-1, 1, 200), [0.3, 0.5, -0.8]).astype(np.float32)
    assert not _found(line, _moved(line)).sure


def test_mirror_image_is_not_taken_for_the_cloud():
    solid = np.random.default_rng(4).normal(size=(300, 3)).astype(np.float32)
    assert not _found(solid, _moved(solid * [1, 1, -1])).sure
    assert _found(solid, _moved(solid)).sure


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_points_are_left_alone(count):
    few = _plate(8)
    mask = np.arange(8) < count
    cloud = make_cloud(few, mask)
    known = constellations(cloud, nearest(cloud.points, cloud, distinct=True).squared, spacing(cloud))
    found = find_counterparts(known, known)
    assert not found.sure
    assert np.all(np.isfinite(found.transform.rotation))
