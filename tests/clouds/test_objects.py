"""Clouds of other libraries, taken by their attributes."""

from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import trimesh

from urrt_jax import pad_clouds
from urrt_jax.clouds import as_array, check_cloud, make_cloud

_POINTS = np.random.default_rng(0).normal(size=(20, 3))


class _Vector:
    """As Open3D's vectors: no array, but NumPy can make one of it."""

    def __init__(self, values):
        self._values = values

    def __len__(self):
        return len(self._values)

    def __getitem__(self, row):
        return self._values[row]


class _Tensor:
    def __init__(self, values):
        self._values = values

    def numpy(self):
        return self._values


@pytest.mark.parametrize(
    "cloud",
    [
        pytest.param(SimpleNamespace(points=_Vector(_POINTS)), id="Open3D's point cloud"),
        pytest.param(SimpleNamespace(point=SimpleNamespace(positions=_Tensor(_POINTS))), id="Open3D's tensor cloud"),
        pytest.param(SimpleNamespace(vertices=_Vector(_POINTS)), id="Open3D's mesh"),
        pytest.param(trimesh.PointCloud(_POINTS), id="trimesh's point cloud"),
        pytest.param(trimesh.Trimesh(_POINTS, [[0, 1, 2]], process=False), id="trimesh's mesh"),
        pytest.param(SimpleNamespace(points=_POINTS, lines=None), id="pyvista's data set"),
    ],
)
def test_a_cloud_of_another_library_is_its_points(cloud):
    check_cloud(as_array(cloud, "source"), None, "source")
    np.testing.assert_array_equal(as_array(cloud, "source"), _POINTS)


def test_real_objects_of_open3d_are_their_points():
    open3d = pytest.importorskip("open3d")
    legacy = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_POINTS))
    tensors = open3d.t.geometry.PointCloud(_POINTS)
    for cloud in (legacy, tensors):
        np.testing.assert_array_equal(as_array(cloud, "source"), _POINTS)


def test_real_objects_of_pyvista_are_their_points():
    pyvista = pytest.importorskip("pyvista")
    np.testing.assert_array_equal(as_array(pyvista.PolyData(_POINTS), "source"), _POINTS)


def test_points_that_are_jax_arrays_stay_on_their_device():
    points = jax.numpy.asarray(_POINTS)
    assert as_array(SimpleNamespace(points=points), "source") is points


def test_a_masked_cloud_of_ours_is_refused_because_not_all_of_its_points_are_real():
    with pytest.raises(ValueError, match="source"):
        check_cloud(make_cloud(_POINTS), None, "source")


def test_what_is_no_cloud_is_refused_with_the_name_of_the_argument():
    with pytest.raises(ValueError, match=r"target: expected shape \(N, 3\), got \(\)"):
        check_cloud(SimpleNamespace(), None, "target")


@pytest.mark.parametrize(
    ("argument", "says"),
    [
        pytest.param("scan.ply", "read_cloud reads files", id="a name"),
        pytest.param(Path("scan.ply"), "read_cloud reads files", id="a path"),
        pytest.param(np.ma.masked_array(_POINTS), "masked array", id="a masked array"),
    ],
)
def test_what_only_looks_like_a_cloud_is_refused_with_what_to_do(argument, says):
    with pytest.raises(ValueError, match=f"source: .*{says}"):
        as_array(argument, "source")


def test_clouds_of_other_libraries_are_padded():
    points, mask = pad_clouds([trimesh.PointCloud(_POINTS), _POINTS[:5]])
    assert points.shape == (2, 20, 3)
    assert mask.sum() == 25
