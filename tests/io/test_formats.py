"""Each format gives back what was written, by us and by the library that most others use."""

import laspy
import numpy as np
import pytest
import trimesh
from pypcd4.pypcd4 import Encoding
from pypcd4.pypcd4 import PointCloud as Pcd

from urrt_jax.io import (
    MESH_FORMATS,
    READABLE,
    WRITABLE,
    PointCloud,
    holds_colors,
    holds_normals,
    read_cloud,
    read_mesh,
    read_point_cloud,
    write_cloud,
)

UTM = np.array([500_000.123456789, 5_400_000.987654321, 312.000000001])  # map coordinates, which need double precision


@pytest.fixture
def cloud() -> PointCloud:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(rng.normal(size=(50, 3)) + UTM, normals, rng.integers(256, size=(50, 3), dtype=np.uint8))


def assert_same(found: PointCloud, expected: PointCloud, atol: float = 0) -> None:
    for name, one, other in zip(PointCloud._fields, found, expected, strict=True):
        assert (one is None) == (other is None), name
        if one is not None:
            np.testing.assert_allclose(one, other, rtol=0, atol=atol, err_msg=name)


@pytest.mark.parametrize("extension", WRITABLE)
def test_what_is_written_is_read_back_with_all_that_the_format_holds(tmp_path, cloud, extension):
    file = tmp_path / f"cloud{extension}"
    normals = cloud.normals if holds_normals(file) else None
    colors = cloud.colors if holds_colors(file) else None
    write_cloud(file, cloud.points, colors, normals)
    atol = 1e-8 if extension in (".las", ".laz") else 0  # 32 bits for an extent of 6
    atol = 1e-7 if extension == ".pcd" else atol  # normals are in single precision
    assert_same(read_point_cloud(file), PointCloud(cloud.points, normals, colors), atol)


@pytest.mark.parametrize("extension", WRITABLE)
def test_bare_points_come_back_without_normals_and_colors(tmp_path, cloud, extension):
    write_cloud(tmp_path / f"cloud{extension}", cloud.points)
    assert read_point_cloud(tmp_path / f"cloud{extension}")[1:] == (None, None)


@pytest.mark.parametrize("extension", [".npy", ".npz", ".pcd"])
def test_single_precision_is_kept(tmp_path, cloud, extension):
    write_cloud(tmp_path / f"cloud{extension}", cloud.points.astype(np.float32))
    assert read_cloud(tmp_path / f"cloud{extension}").dtype == np.float32


@pytest.mark.parametrize("extension", [".las", ".laz"])
@pytest.mark.parametrize("extent", [1e-6, 1.0, 1e5])
def test_las_keeps_nine_digits_of_any_extent(tmp_path, extent, extension):
    points = np.random.default_rng(0).uniform(size=(50, 3)) * extent
    write_cloud(tmp_path / f"cloud{extension}", points)
    np.testing.assert_allclose(read_cloud(tmp_path / f"cloud{extension}"), points, rtol=0, atol=5e-9 * extent)


def test_pcd_far_from_the_origin_keeps_its_digits(tmp_path, cloud):
    write_cloud(tmp_path / "cloud.pcd", cloud.points)
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.pcd"), cloud.points)


def test_las_of_one_point_is_exact(tmp_path):
    write_cloud(tmp_path / "cloud.las", [UTM])
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.las"), [UTM])


@pytest.mark.parametrize("extension", [".las", ".laz"])
@pytest.mark.parametrize("point_format", [2, 3, 7])
def test_las_of_other_programs_is_read(tmp_path, cloud, point_format, extension):
    las = laspy.create(point_format=point_format)
    las.header.offsets, las.header.scales = np.floor(UTM), [0.001] * 3
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.astype(np.uint16).T * 256
    las.write(tmp_path / f"cloud{extension}")
    found = read_point_cloud(tmp_path / f"cloud{extension}")
    np.testing.assert_allclose(found.points, cloud.points, rtol=0, atol=0.001)
    np.testing.assert_array_equal(found.colors, cloud.colors)


def test_las_colors_of_eight_bits_are_read(tmp_path, cloud):
    las = laspy.create(point_format=2)
    las.x, las.y, las.z = (cloud.points - UTM).T
    las.red, las.green, las.blue = cloud.colors.T
    las.write(tmp_path / "cloud.las")
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "cloud.las").colors, cloud.colors)


@pytest.mark.parametrize("encoding", list(Encoding)[:3])
def test_pcd_of_pypcd4_is_read(tmp_path, cloud, encoding):
    columns = [*cloud.points.T, *cloud.normals.T, Pcd.encode_rgb(cloud.colors)]
    fields = ["x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb"]
    Pcd.from_points(columns, fields, [column.dtype for column in columns]).save(tmp_path / "cloud.pcd", encoding)
    atol = 1e-6 if encoding == "ascii" else 0
    found = read_point_cloud(tmp_path / "cloud.pcd")
    np.testing.assert_allclose(found.points, cloud.points, rtol=0, atol=atol)
    np.testing.assert_allclose(found.normals, cloud.normals, rtol=0, atol=atol)
    if encoding != "ascii":  # pypcd4 prints packed colours with too few digits
        np.testing.assert_array_equal(found.colors, cloud.colors)


@pytest.mark.parametrize("extension", ["ply", "pcd", "xyz", "pts"])
@pytest.mark.parametrize("ascii", [True, False])
def test_clouds_of_open3d_are_read(tmp_path, cloud, extension, ascii):
    o3d = pytest.importorskip("open3d", reason="needs the extra urrt-jax[peers]")
    written = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points - UTM))
    written.normals = o3d.utility.Vector3dVector(cloud.normals)
    written.colors = o3d.utility.Vector3dVector(cloud.colors / 255)
    assert o3d.io.write_point_cloud(str(tmp_path / f"cloud.{extension}"), written, write_ascii=ascii)
    found = read_point_cloud(tmp_path / f"cloud.{extension}")
    np.testing.assert_allclose(found.points, cloud.points - UTM, atol=1e-5)
    if extension in ("ply", "pcd"):
        np.testing.assert_allclose(found.normals, cloud.normals, atol=1e-5)
    if extension != "xyz":
        np.testing.assert_array_equal(found.colors, cloud.colors)


def test_ply_of_trimesh_is_read_with_colors(tmp_path, cloud):
    trimesh.PointCloud(cloud.points - UTM, cloud.colors).export(tmp_path / "cloud.ply")
    found = read_point_cloud(tmp_path / "cloud.ply")
    np.testing.assert_allclose(found.points, cloud.points - UTM, atol=1e-6)
    np.testing.assert_array_equal(found.colors, cloud.colors)


@pytest.mark.parametrize("extension", ["ply", "pcd"])
def test_open3d_reads_what_is_written(tmp_path, cloud, extension):
    o3d = pytest.importorskip("open3d", reason="needs the extra urrt-jax[peers]")
    points = cloud.points - UTM
    write_cloud(tmp_path / f"cloud.{extension}", points, cloud.colors, cloud.normals)
    found = o3d.io.read_point_cloud(str(tmp_path / f"cloud.{extension}"))
    np.testing.assert_allclose(np.asarray(found.points), points, atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.normals), cloud.normals, atol=1e-6)
    np.testing.assert_array_equal(np.rint(np.asarray(found.colors) * 255), cloud.colors)


def test_normals_that_are_not_finite_are_left_out(tmp_path, cloud):
    np.savez(tmp_path / "cloud.npz", points=cloud.points, normals=np.full((50, 3), np.nan))
    assert read_point_cloud(tmp_path / "cloud.npz").normals is None


def test_obj_of_bare_points_has_normals_and_colors(tmp_path):
    (tmp_path / "cloud.obj").write_text("v 1 2 3 1 0 0\nv 4 5 6 0 0 1\nvn 0 0 1\nvn 0 1 0\n")
    found = read_point_cloud(tmp_path / "cloud.obj")
    assert_same(found, PointCloud([[1, 2, 3], [4, 5, 6]], [[0, 0, 1], [0, 1, 0]], [[255, 0, 0], [0, 0, 255]]))


@pytest.mark.parametrize("extension", MESH_FORMATS)
def test_points_of_a_mesh_have_the_normals_of_their_faces(tmp_path, extension):
    trimesh.creation.box((2, 2, 2)).export(tmp_path / f"box{extension}")
    points, normals, colors = read_point_cloud(tmp_path / f"box{extension}", samples=200)
    assert colors is None
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.sum(points * normals, axis=1), 1, atol=1e-6)  # outwards, on a face at distance 1


def test_obj_of_several_objects_is_one_mesh(tmp_path):
    rows = ["o a", "v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 3", "o b", "v 0 0 5", "v 1 0 5", "v 0 1 5", "f 4 5 6"]
    (tmp_path / "two.obj").write_text("\n".join(rows))
    mesh = read_mesh(tmp_path / "two.obj")
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [1, 1, 5]])
    assert len(mesh.faces) == 2


def test_stl_of_several_solids_is_one_mesh(tmp_path):
    one, two = (trimesh.creation.box((1, 1, 1)).apply_translation([3 * i, 0, 0]) for i in range(2))
    text = "\n".join(mesh.export(file_type="stl_ascii") for mesh in (one, two))
    (tmp_path / "two.stl").write_text(text)
    assert read_mesh(tmp_path / "two.stl").area == pytest.approx(12)


def test_what_is_written_can_be_read():
    assert set(WRITABLE) <= set(READABLE)
