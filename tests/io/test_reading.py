import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from urrt_jax.io import read_cloud, read_mesh, read_transform, sample_surface, write_cloud

UTM = np.array([500_000.123456789, 5_400_000.987654321, 312.000000001])  # map coordinates, which need double precision


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(50, 3)) + UTM


@pytest.fixture
def box() -> trimesh.Trimesh:
    return trimesh.creation.box((1, 2, 3))


def as_off(mesh: trimesh.Trimesh, header: str) -> str:
    rows = [" ".join(map(str, row)) for row in mesh.vertices.tolist()]
    rows += [" ".join(map(str, [3, *row])) for row in mesh.faces.tolist()]
    return "\n".join([header, *rows, ""])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("extension", ["ply", "xyz", "npy", "PLY"])
def test_written_cloud_is_read_back_exactly(tmp_path, points, extension, dtype):
    write_cloud(tmp_path / f"cloud.{extension}", points.astype(dtype))
    np.testing.assert_array_equal(read_cloud(tmp_path / f"cloud.{extension}"), points.astype(dtype))


def test_npy_keeps_single_precision(tmp_path, points):
    write_cloud(tmp_path / "cloud.npy", points.astype(np.float32))
    assert read_cloud(tmp_path / "cloud.npy").dtype == np.float32


def test_repeated_points_are_kept(tmp_path):
    write_cloud(tmp_path / "cloud.ply", np.ones((7, 3)))
    assert read_cloud(tmp_path / "cloud.ply").shape == (7, 3)


def test_ply_holds_colors(tmp_path, points):
    colors = np.random.default_rng(1).integers(256, size=points.shape, dtype=np.uint8)
    write_cloud(tmp_path / "cloud.ply", points, colors)
    loaded = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(loaded.colors[:, :3], colors)
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.ply"), points)


@pytest.mark.parametrize(
    ("name", "cloud", "colors", "message"),
    [
        ("a.obj", np.zeros((4, 3)), None, "extension '.obj'"),
        ("a.xyz", np.zeros((4, 3)), np.zeros((4, 3), np.uint8), ".xyz holds no colours; .csv, .las"),
        ("a.ply", np.zeros((4, 3)), np.zeros((4, 3)), "must be uint8"),
        ("a.ply", np.zeros((4, 3)), np.zeros((5, 3), np.uint8), "must be uint8"),
        ("a.ply", np.zeros((4, 2)), None, r"shape \(N, 3\), got float64 \(4, 2\)"),
        ("a.ply", np.full((4, 3), np.nan), None, "not finite"),
        ("a.ply", np.zeros((0, 3)), None, "empty"),
        ("a.npy", np.array([["a", "b", "c"]]), None, "must be numbers"),
    ],
)
def test_refused_write_says_why_and_leaves_no_file(tmp_path, name, cloud, colors, message):
    with pytest.raises(ValueError, match=message):
        write_cloud(tmp_path / name, cloud, colors)
    assert not list(tmp_path.iterdir())


def test_interrupted_write_leaves_the_old_file(tmp_path, points, monkeypatch):
    write_cloud(tmp_path / "cloud.npy", points)

    def full_disk(file, *_, **__):
        file.write(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(np, "save", full_disk)
    with pytest.raises(OSError, match="no space left"):
        write_cloud(tmp_path / "cloud.npy", points + 1)
    assert [file.name for file in tmp_path.iterdir()] == ["cloud.npy"]
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.npy"), points)


@pytest.mark.parametrize("extension", ["ply", "obj", "off", "stl"])
def test_mesh_is_sampled_on_its_surface(tmp_path, box, extension):
    box.export(tmp_path / f"box.{extension}")
    cloud = read_cloud(tmp_path / f"box.{extension}", samples=500)
    assert cloud.shape == (500, 3)
    np.testing.assert_allclose(np.abs(cloud / [0.5, 1, 1.5]).max(axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal(read_cloud(tmp_path / f"box.{extension}", samples=500), cloud)


@pytest.mark.parametrize("extension", ["ply", "obj", "off", "stl"])
def test_mesh_is_read_with_all_its_faces(tmp_path, box, extension):
    box.export(tmp_path / f"box.{extension}")
    mesh = read_mesh(tmp_path / f"box.{extension}")
    assert len(mesh.faces) == 12
    assert mesh.area == pytest.approx(22)


@pytest.mark.parametrize("samples", [0, -1, 10_000_001, 10**12, 1e3, True, None])
@pytest.mark.parametrize("extension", ["off", "npy"], ids=["mesh", "points"])
def test_samples_out_of_range_are_refused(tmp_path, box, points, extension, samples):
    file = tmp_path / f"file.{extension}"
    box.export(file) if extension == "off" else write_cloud(file, points)
    with pytest.raises(ValueError, match=rf"^samples: expected a whole number from 1 to 10,000,000, got {samples}$"):
        read_cloud(file, samples=samples)


def test_one_sample_is_enough(tmp_path, box):
    box.export(tmp_path / "box.off")
    assert read_cloud(tmp_path / "box.off", samples=1).shape == (1, 3)


def test_surface_samples_are_area_uniform_and_inside_their_triangles():
    # A large, a small and a flat triangle: 9 : 1 : 0 in area, in three planes.
    corners = np.array([[[0, 0, 0], [3, 0, 0], [0, 3, 0]], [[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 0, 2]] * 3], float)
    cloud = sample_surface(corners, 20_000, np.random.default_rng(0))
    large = cloud[:, 2] == 0
    assert not (cloud[:, 2] == 2).any()
    assert large.mean() == pytest.approx(0.9, abs=0.01)
    assert (cloud[large, :2].sum(axis=1) <= 3 + 1e-9).all()
    np.testing.assert_allclose(cloud[large].mean(axis=0), [1, 1, 0], atol=0.03)


@pytest.mark.parametrize("header", ["OFF\n8 12 0", "OFF8 12 0", "OFF 8 12 0", "# a comment\nOFF8 12 0"])
def test_off_header_may_be_glued_to_its_counts(tmp_path, box, header):
    (tmp_path / "box.off").write_text(as_off(box, header))
    mesh = read_mesh(tmp_path / "box.off")
    np.testing.assert_array_equal(mesh.vertices, box.vertices)
    np.testing.assert_array_equal(mesh.faces, box.faces)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("points.off", "OFF\n2 0 0\n1 2 3\n4 5 6\n"),
        ("points.obj", "v 1 2 3\nv 4 5 6\n"),
        ("points.xyz", "# x y z intensity\n1 2 3 0.5\n\n4 5 6 0.5\n"),
    ],
)
def test_file_without_faces_gives_its_points(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    np.testing.assert_array_equal(read_cloud(tmp_path / name), [[1, 2, 3], [4, 5, 6]])


def test_obj_of_several_materials_is_read_whole(tmp_path):
    rows = ["usemtl a", "v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 3"]
    rows += ["usemtl b", "v 0 0 1", "v 1 0 1", "v 0 1 1", "f 4 5 6"]
    (tmp_path / "two.obj").write_text("\n".join(rows))
    assert read_mesh(tmp_path / "two.obj").area == pytest.approx(1)


def test_mesh_without_faces_is_refused(tmp_path, points):
    write_cloud(tmp_path / "cloud.ply", points)
    with pytest.raises(ValueError, match=r"cloud\.ply: holds 50 points but no faces"):
        read_mesh(tmp_path / "cloud.ply")


def test_pcd_is_read(tmp_path, points):
    pypcd4 = pytest.importorskip("pypcd4", reason="needs the extra urrt-jax[data]")
    pypcd4.PointCloud.from_xyz_points(points.astype(np.float32)).save(tmp_path / "cloud.pcd")
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.pcd"), points.astype(np.float32))


def test_pcd_without_its_library_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "cloud.pcd").write_text("anything")
    monkeypatch.setitem(sys.modules, "pypcd4", None)
    with pytest.raises(ImportError, match=r"urrt-jax\[data\]"):
        read_cloud(tmp_path / "cloud.pcd")


def test_npz_prefers_the_key_points(tmp_path, points):
    np.savez(tmp_path / "cloud.npz", normals=np.ones((50, 3)), points=points)
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.npz"), points)


def test_npz_takes_the_only_cloud(tmp_path, points):
    np.savez(tmp_path / "cloud.npz", pose=np.eye(4), scan=points)
    np.testing.assert_array_equal(read_cloud(tmp_path / "cloud.npz"), points)


def test_npz_with_a_choice_of_clouds_lists_its_keys(tmp_path, points):
    np.savez(tmp_path / "cloud.npz", one=points, two=points)
    with pytest.raises(ValueError, match=r"cloud\.npz.*one \(50, 3\), two \(50, 3\)"):
        read_cloud(tmp_path / "cloud.npz")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.ply: no such file"):
        read_cloud(tmp_path / "nowhere.ply")


def test_unknown_extension_lists_the_known_ones(tmp_path):
    (tmp_path / "cloud.docx").write_text("")
    with pytest.raises(ValueError, match=r"cloud\.docx: unknown extension '\.docx'; known are .*\.npy.*\.ply.*\.xyz"):
        read_cloud(tmp_path / "cloud.docx")


def test_folder_is_not_a_cloud(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match="a folder, not a file"):
        read_cloud(tmp_path / "folder.ply")


@pytest.mark.parametrize("extension", ["ply", "obj", "off", "stl", "xyz", "npy", "npz", "pcd"])
@pytest.mark.parametrize(
    "content", [b"", b"\x00\xff" * 400, b"hello world\n1 2 what\n"], ids=["empty", "bytes", "text"]
)
def test_unreadable_file_is_a_value_error_that_names_it(tmp_path, extension, content):
    file = tmp_path / f"bad.{extension}"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\.{extension}: "):
        read_cloud(file)


@pytest.mark.parametrize("extension", ["ply", "off", "stl"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_truncated_mesh_is_refused(tmp_path, box, extension, share):
    file = tmp_path / f"cut.{extension}"
    box.export(file)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(ValueError, match=rf"cut\.{extension}: "):
        read_cloud(file)


def test_truncated_cloud_is_refused(tmp_path):
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "cut.ply").write_text(header + "0 0 0\n")
    with pytest.raises(ValueError, match="truncated; its header promises 3 of 'vertex', a line each, it holds 1 lines"):
        read_cloud(tmp_path / "cut.ply")


@pytest.mark.parametrize("extension", ["npy", "xyz", "off"])
def test_non_finite_points_are_counted(tmp_path, extension):
    rows = np.array([[1, 2, 3], [np.nan, 0, np.nan], [0, np.inf, 0]])
    file = tmp_path / f"cloud.{extension}"
    if extension == "npy":
        np.save(file, rows)
    else:
        text = "\n".join(" ".join(map(str, row)) for row in rows.tolist())
        file.write_text(("OFF\n3 0 0\n" if extension == "off" else "") + text + "\n")
    with pytest.raises(ValueError, match="2 of 3 points are not finite"):
        read_cloud(file)


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("mesh.off", "OFF\n3 1 0"),
        (
            "mesh.ply",
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            "element face 1\nproperty list uchar int vertex_indices\nend_header",
        ),
    ],
)
@pytest.mark.parametrize(
    ("face", "message"), [("3 0 1 7", r"refer to vertices 0\.\.(2, got '3 0 1 7'|7 of 3)"), ("3 0 1 1", "have no area")]
)
def test_impossible_faces_are_refused(tmp_path, name, header, face, message):
    (tmp_path / name).write_text(f"{header}\n0 0 0\n1 0 0\n0 1 0\n{face}\n")
    with pytest.raises(ValueError, match=message):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("array", [np.zeros((4, 2)), np.zeros(3), np.zeros((2, 4, 3)), np.zeros((4, 3), complex)])
def test_array_of_another_shape_is_refused(tmp_path, array):
    np.save(tmp_path / "cloud.npy", array)
    with pytest.raises(ValueError, match=r"must be numbers of shape \(N, 3\), got"):
        read_cloud(Path(tmp_path / "cloud.npy"))


def test_pickled_objects_are_never_loaded(tmp_path):
    np.save(tmp_path / "cloud.npy", np.array([[{}, {}, {}]], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="Python objects, which are never loaded"):
        read_cloud(tmp_path / "cloud.npy")


_POSE = np.array([[0, -1, 0, 0.5], [1, 0, 0, -2], [0, 0, 1, 3e5], [0, 0, 0, 1]])


def _write_transform(path):
    match path.suffix:
        case ".npy":
            np.save(path, _POSE)
        case ".json":
            path.write_text(json.dumps({"matrix": _POSE.tolist(), "fitness": 1.0}))
        case _:
            path.write_text("# source to target\n" + "\n".join(" ".join(map(str, row)) for row in _POSE))
    return path


@pytest.mark.parametrize("name", ["pose.txt", "pose.npy", "pose.json"])
def test_a_transform_is_read_back(tmp_path, name):
    np.testing.assert_array_equal(read_transform(_write_transform(tmp_path / name)), _POSE)


def test_a_transform_may_be_rows_of_json(tmp_path):
    (tmp_path / "pose.json").write_text(json.dumps(_POSE.tolist()))
    np.testing.assert_array_equal(read_transform(tmp_path / "pose.json"), _POSE)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("pose.txt", "1 0 0\n0 1 0\n0 0 1\n"),
        ("pose.txt", "one two\n"),
        ("pose.txt", "1 2 3 4\n5 6\n"),
        ("pose.json", '{"fitness": 1}'),
        ("pose.json", "[1, 2"),
        ("pose.json", '[["a"]]'),
        ("pose.json", '{"matrix": [[null, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}'),
        ("pose.txt", "nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        ("pose.npy", "text"),
    ],
)
def test_what_is_no_transform_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=name):
        read_transform(tmp_path / name)


def test_a_missing_transform_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"pose\.txt"):
        read_transform(tmp_path / "pose.txt")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("extension", ["txt", "npy", "json"])
def test_a_transform_is_not_awaited_from_a_pipe(tmp_path, extension):
    os.mkfifo(tmp_path / f"pose.{extension}")
    with pytest.raises(ValueError, match=rf"pose\.{extension}: a pipe or a device, not a regular file"):
        read_transform(tmp_path / f"pose.{extension}")


def test_a_device_without_end_is_no_transform(tmp_path):
    (tmp_path / "pose.txt").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"pose\.txt: a pipe or a device, not a regular file"):
        read_transform(tmp_path / "pose.txt")


def test_a_transform_of_more_than_a_megabyte_is_refused(tmp_path):
    (tmp_path / "pose.txt").write_bytes(b"1 0 0 0\n" * 200_000)
    with pytest.raises(ValueError, match=r"pose\.txt: of 1,600,000 bytes, more than the 1,048,576 that are read"):
        read_transform(tmp_path / "pose.txt")


def test_a_transform_of_deep_json_is_refused(tmp_path):
    (tmp_path / "pose.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match=r"pose\.json: .*not valid JSON"):
        read_transform(tmp_path / "pose.json")
