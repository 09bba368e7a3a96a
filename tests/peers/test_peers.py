"""Peers give what their papers promise on easy pairs, and say how to install what they need."""

import dataclasses
import importlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.data import demo_shape
from urrt_jax.evaluation import evaluate, find_method, rotation_degrees
from urrt_jax.peers import FGR, PEERS, MultiStartICP, OnScans, Open3DICP, PrincipalAxes

LIBRARIES = {
    "icp": "open3d", "icp_identity": "open3d", "icp_plane": "open3d", "fgr": "open3d", "fgr_icp": "open3d",
    "ransac": "open3d", "ransac_icp": "open3d", "gicp": "small_gicp", "kiss": "kiss_matcher", "goicp": "py_goicp",
    "icp_starts": "open3d", "scan_fgr": "open3d", "scan_icp": "open3d", "scan_ransac": "open3d",
    "scan_kiss": "kiss_matcher",
}  # fmt: skip


@pytest.fixture(scope="module")
def pair(make_cloud_points):
    source = make_cloud_points(0, 5).astype(np.float64)
    source = source / np.linalg.norm(source, axis=1).max()
    rotation = Rotation.from_euler("zyx", [12, -8, 10], degrees=True).as_matrix()
    translation = np.array([0.2, -0.1, 0.3])
    target = np.random.default_rng(0).permutation(source @ rotation.T + translation)
    return source, target, rotation, translation


def test_principal_axes_are_exact_where_points_are_the_same(pair):
    source, target, rotation, translation = pair
    found = PrincipalAxes().align_pair(source, target)
    assert rotation_degrees(found[:3, :3], rotation) < 1e-6
    np.testing.assert_allclose(found[:3, 3], translation, atol=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 90.0, 179.0, 180.0])
def test_principal_axes_find_any_rotation(pair, degrees):
    source, _, _, _ = pair
    rotation = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    found = PrincipalAxes().align_pair(source, source @ rotation.T)
    assert rotation_degrees(found[:3, :3], rotation) < 1e-5


def test_identity_does_nothing(pair):
    np.testing.assert_array_equal(PEERS["identity"].align_pair(*pair[:2]), np.eye(4))


@pytest.mark.parametrize("name", [name for name in PEERS if not name.startswith("scan")])
def test_peers_align_an_easy_pair(pair, name):
    if name in LIBRARIES:
        pytest.importorskip(LIBRARIES[name], exc_type=ImportError)
    source, target, rotation, _ = pair
    found = PEERS[name].align_pair(source, target)
    assert found.shape == (4, 4)
    if name != "identity":
        assert rotation_degrees(found[:3, :3], rotation) < 5.0


@pytest.fixture(scope="module")
def turned_pair():
    """Two samples of one shape, 80° apart, and the rotation."""
    shape = demo_shape(2000).astype(np.float64)
    rotation = Rotation.from_rotvec(np.deg2rad(80) * np.array([0.6, 0.0, 0.8])).as_matrix()
    return shape[:1000], shape[1000:] @ rotation.T + 0.1, rotation


def test_icp_from_many_rotations_finds_a_pose_that_one_start_misses(turned_pair):
    pytest.importorskip("open3d", exc_type=ImportError)
    source, target, rotation = turned_pair
    assert rotation_degrees(Open3DICP().align_pair(source, target)[:3, :3], rotation) > 30.0
    assert rotation_degrees(MultiStartICP().align_pair(source, target)[:3, :3], rotation) < 2.0


def test_icp_from_many_rotations_gives_the_same_answer_again(turned_pair):
    pytest.importorskip("open3d", exc_type=ImportError)
    # After one iteration the answer still shows which rotations were drawn.
    peer = MultiStartICP(starts=4, iterations=1, polish_iterations=1)
    first = peer.align_pair(*turned_pair[:2])
    np.testing.assert_allclose(peer.align_pair(*turned_pair[:2]), first, rtol=0, atol=1e-9)


def test_starting_rotations_are_the_identity_and_others_within_the_angle():
    rotations = MultiStartICP(starts=500, max_angle=60.0).rotations()
    np.testing.assert_array_equal(rotations[0], np.eye(3))
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2) - np.eye(3), 0.0, atol=1e-12)
    angles = rotation_degrees(rotations[1:], np.eye(3))
    assert angles.min() > 0
    assert angles.max() <= 60.0 + 1e-9


def test_starting_rotations_are_uniform():
    """The share of all rotations that turn by at most a is (a - sin a) / π."""
    rotations = MultiStartICP(starts=2000, max_angle=180.0).rotations()
    within = np.mean(rotation_degrees(rotations[1:], np.eye(3)) <= 90.0)
    assert within == pytest.approx((np.pi / 2 - 1) / np.pi, abs=0.03)
    np.testing.assert_allclose(rotations[1:].mean(axis=0), 0.0, atol=0.06)


@pytest.mark.parametrize("unit", [0.01, 1000.0])
def test_peers_on_scans_take_any_unit(pair, unit):
    pytest.importorskip("open3d", exc_type=ImportError)
    source, target, rotation, translation = pair
    found = OnScans(peer=FGR()).align_pair(unit * source, unit * target)
    assert rotation_degrees(found[:3, :3], rotation) < 5.0
    np.testing.assert_allclose(found[:3, 3], unit * translation, atol=0.05 * unit)


def test_a_library_that_ends_its_process_is_an_error_not_our_end(pair):
    pytest.importorskip("kiss_matcher", exc_type=ImportError)
    sparse = np.random.default_rng(0).normal(size=(50, 3))
    sparse /= np.linalg.norm(sparse, axis=1, keepdims=True)
    with pytest.raises(RuntimeError, match=r"crashed|fewer than three"):
        PEERS["kiss"].align_pair(sparse, sparse)
    assert PEERS["kiss"].align_pair(*pair[:2]).shape == (4, 4)


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_missing_library_says_how_to_install_it(name, monkeypatch):
    def missing(module):
        raise ImportError(f"No module named {module!r}")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match="pip install"):
        find_method(name).identity()


@pytest.mark.parametrize("name", PEERS)
def test_settings_are_named_for_results(name):
    peer = PEERS[name]
    assert peer.title
    assert peer.settings.keys() == {field.name for field in dataclasses.fields(peer)}


def test_the_reference_rows_hold_on_shapes_everyone_has():
    """Doing nothing scores the rotation itself; principal axes score nothing but rounding."""
    points = np.random.default_rng(1).normal(size=(4, 200, 3)) * [0.5, 0.3, 0.1]
    clouds = (points + 0.3 * points[..., :1] ** 2).astype(np.float32)
    nothing = evaluate("identity", "dcp", clouds, progress=False)
    np.testing.assert_allclose(nothing.errors()["angle"], rotation_degrees(nothing.true_rotations, np.eye(3)))
    assert evaluate("principal_axes", "dcp", clouds, progress=False).summary()["angle_mean"] < 1e-3
