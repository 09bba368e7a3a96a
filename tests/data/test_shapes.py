import os
import sys
import zipfile

import numpy as np
import pytest
import trimesh

from urrt_jax.data import Shapes, find_data, load_shapes
from urrt_jax.io import write_cloud


def unit_clouds(count: int, points: int = 64, seed: int = 0) -> np.ndarray:
    clouds = np.random.default_rng(seed).normal(size=(count, points, 3))
    clouds -= clouds.mean(axis=1, keepdims=True)
    return (clouds / np.linalg.norm(clouds, axis=2).max(axis=1)[:, None, None]).astype(np.float32)


def fields(count: int = 6, **changes) -> dict:
    labels = np.arange(count, dtype=np.int32) % 2
    names = tuple(f"shape_{i}" for i in range(count))
    return {"points": unit_clouds(count), "labels": labels, "names": names, "classes": ("a", "b"), **changes}


def save_npz(file, clouds: np.ndarray, **changes) -> None:
    count = len(clouds)
    labels = np.arange(count) % 2
    names = [f"{file.stem}_{i}" for i in range(count)]
    np.savez(
        file, **{"points": clouds, "label": labels.astype(np.int8), "name": names, "classes": ["x", "y"], **changes}
    )


# The set of shapes itself.


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": np.zeros((6, 64), np.float32)}, r"points must be float32 of shape \(any, any, 3\), got.*\(6, 64\)"),
        ({"points": np.zeros((6, 64, 3))}, "points must be float32.*got float64"),
        ({"points": np.zeros((0, 64, 3), np.float32)}, "at least one shape"),
        ({"points": np.full((6, 64, 3), np.nan, np.float32)}, "points of 6 shapes are not finite"),
        ({"labels": np.zeros(5, np.int32)}, r"labels must be int32 of shape \(6\), got int32 \(5,\)"),
        ({"labels": np.full(6, 2, np.int32)}, r"labels must lie in 0\.\.1"),
        ({"labels": np.full(6, -1, np.int32)}, r"labels must lie in 0\.\.1"),
        ({"names": ("only one",)}, "names must be 6, one a shape, got 1"),
        ({"queries": np.zeros((6, 9, 3), np.float32)}, "queries and inside come together"),
        (
            {"queries": np.zeros((6, 9, 3), np.float32), "inside": np.zeros((6, 8), bool)},
            r"inside must be bool.*\(6, 9\)",
        ),
    ],
)
def test_fields_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Shapes(**fields(**changes))


def test_take_keeps_everything_about_a_shape_together():
    queries, inside = np.zeros((6, 9, 3), np.float32), np.zeros((6, 9), bool)
    queries[:], inside[4] = np.arange(6)[:, None, None], True
    shapes = Shapes(**fields(queries=queries, inside=inside, skipped=(("bad.off", "why"),)))
    taken = shapes.take([4, 1])
    assert len(taken) == 2 and taken.names == ("shape_4", "shape_1")
    np.testing.assert_array_equal(taken.points, shapes.points[[4, 1]])
    np.testing.assert_array_equal(taken.labels, [0, 1])
    np.testing.assert_array_equal(taken.queries[:, 0, 0], [4, 1])
    np.testing.assert_array_equal(taken.inside[:, 0], [True, False])
    assert taken.skipped == shapes.skipped


@pytest.mark.parametrize("indices", [[], [6], [-1], [0.5], [[0]], [True, False]])
def test_take_refuses_other_indices(indices):
    with pytest.raises(ValueError, match="indices must"):
        Shapes(**fields()).take(indices)


@pytest.mark.parametrize(("fraction", "held"), [(0.01, 1), (0.34, 2), (0.99, 5)])
def test_validation_share_is_disjoint_and_complete(fraction, held):
    train, validation = Shapes(**fields()).split_validation(fraction, seed=0)
    assert len(validation) == held
    assert sorted(train.names + validation.names) == [f"shape_{i}" for i in range(6)]


def test_validation_share_depends_on_the_seed_alone():
    shapes = Shapes(**fields(40))
    held = [shapes.split_validation(0.25, seed)[1].names for seed in (0, 0, 1)]
    assert held[0] == held[1] != held[2]


@pytest.mark.parametrize("fraction", [0, 1, -0.5, float("nan")])
def test_validation_share_outside_its_range_is_refused(fraction):
    with pytest.raises(ValueError, match="fraction in"):
        Shapes(**fields()).split_validation(fraction, seed=0)


# Where shapes come from.


def test_explicit_path_comes_before_the_environment(monkeypatch):
    monkeypatch.setenv("URRT_DATA", "elsewhere")
    assert (find_data("here"), find_data(None)) == ("here", "elsewhere")
    monkeypatch.delenv("URRT_DATA")
    assert find_data(None) == "procedural"


def test_procedural_splits_differ_for_all_seeds():
    clouds = [
        load_shapes("procedural", split=s, seed=i, limit=1, points=32).points
        for s in ("train", "test")
        for i in range(3)
    ]
    assert len({cloud.tobytes() for cloud in clouds}) == 6


@pytest.mark.parametrize("wrong", [{"points": 0}, {"limit": 0}, {"queries": -1}, {"seed": -1}, {"split": "val"}])
def test_arguments_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        load_shapes("procedural", **wrong)


def test_missing_source_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_shapes(tmp_path / "nowhere")


def test_single_cloud_is_not_a_source(tmp_path):
    write_cloud(tmp_path / "cloud.ply", np.eye(3))
    with pytest.raises(ValueError, match=r"cloud\.ply: a source that is a file must be a \.npz"):
        load_shapes(tmp_path / "cloud.ply")


def test_folder_without_shapes_says_what_was_looked_for(tmp_path):
    (tmp_path / "README.md").write_text("nothing")
    with pytest.raises(ValueError, match=r"no shapes found. Looked for \*train\*\.npz.*<class>/train/\*\.off"):
        load_shapes(tmp_path)


# Arrays.


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_npz_keeps_stored_unit_clouds_and_takes_their_first_points(tmp_path, dtype):
    clouds = unit_clouds(5).astype(dtype)
    save_npz(tmp_path / "set.npz", clouds)
    shapes = load_shapes(tmp_path / "set.npz", points=40)
    np.testing.assert_array_equal(shapes.points, clouds[:, :40].astype(np.float32))
    assert shapes.classes == ("x", "y") and shapes.names[3] == "set_3"
    np.testing.assert_array_equal(shapes.labels, [0, 1, 0, 1, 0])
    assert shapes.queries is None and shapes.inside is None


def test_npz_of_other_units_is_centred_and_scaled(tmp_path):
    clouds = unit_clouds(3)
    save_npz(tmp_path / "set.npz", 1000 * clouds + 50)
    np.testing.assert_allclose(load_shapes(tmp_path / "set.npz", points=64).points, clouds, atol=1e-5)


def test_npz_of_too_small_clouds_is_refused(tmp_path):
    save_npz(tmp_path / "set.npz", unit_clouds(3))
    with pytest.raises(ValueError, match="100 points a shape were asked for, but it stores 64"):
        load_shapes(tmp_path / "set.npz", points=100)


def test_npz_without_its_keys_lists_what_it_holds(tmp_path):
    np.savez(tmp_path / "set.npz", points=unit_clouds(3), what=1)
    with pytest.raises(ValueError, match=r"set\.npz: needs the keys points .*; it holds points, what"):
        load_shapes(tmp_path / "set.npz")


def test_damaged_npz_is_refused(tmp_path):
    save_npz(tmp_path / "set.npz", unit_clouds(3))
    (tmp_path / "set.npz").write_bytes((tmp_path / "set.npz").read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"set\.npz: cannot be read as NPZ"):
        load_shapes(tmp_path / "set.npz")
    assert not zipfile.is_zipfile(tmp_path / "set.npz")


def test_npz_with_splits_is_filtered_and_numbers_classes_alike(tmp_path):
    category = np.array(["car", "bed", "car", "arm"])
    split = np.array(["train", "test", "test", "train"])
    clouds = unit_clouds(4)
    np.savez(tmp_path / "set.npz", points=clouds, normals=clouds, name=list("abcd"), category=category, split=split)
    train, test = (load_shapes(tmp_path / "set.npz", split=which, points=64) for which in ("train", "test"))
    assert train.names == ("a", "d") and test.names == ("b", "c")
    assert train.classes == test.classes == ("arm", "bed", "car")
    np.testing.assert_array_equal(train.labels, [2, 0])
    np.testing.assert_array_equal(test.labels, [1, 2])


def test_npz_that_lacks_the_split_is_refused(tmp_path):
    np.savez(tmp_path / "set.npz", points=unit_clouds(2), category=["a", "b"], split=["train", "train"])
    with pytest.raises(ValueError, match="holds no split 'test', only train"):
        load_shapes(tmp_path / "set.npz", split="test")


def test_folder_of_npz_prefers_modelnet(tmp_path):
    for name in ("a_train", "modelnet40_train_64", "modelnet40_test_64"):
        save_npz(tmp_path / f"{name}.npz", unit_clouds(3))
    np.savez(tmp_path / "modelnet0_train.npz", other=1)  # not a set of shapes
    assert load_shapes(tmp_path, points=64, limit=2).names == ("modelnet40_train_64_0", "modelnet40_train_64_1")
    assert load_shapes(tmp_path, split="test", points=64).names[0] == "modelnet40_test_64_0"


@pytest.fixture
def release(tmp_path):
    """A folder like ModelNet40's HDF5 release, with eleven training shards of two shapes, and its clouds in order."""
    h5py = pytest.importorskip("h5py", reason="needs the extra urrt-jax[data]")
    clouds = unit_clouds(22)
    for shard in reversed(range(11)):
        with h5py.File(tmp_path / f"ply_data_train{shard}.h5", "w") as file:
            file["data"] = clouds[2 * shard : 2 * shard + 2]
            file["label"] = np.array([[0], [1]], np.uint8)
    (tmp_path / "shape_names.txt").write_text("airplane\nbathtub\n")
    return tmp_path, clouds


def test_hdf5_shards_are_read_in_the_order_of_their_numbers(release):
    folder, clouds = release
    shapes = load_shapes(folder, points=64)
    np.testing.assert_array_equal(shapes.points, clouds)
    np.testing.assert_array_equal(shapes.labels, [0, 1] * 11)
    assert shapes.classes == ("airplane", "bathtub")


def test_hdf5_without_names_numbers_its_classes(release):
    folder, _ = release
    (folder / "shape_names.txt").unlink()
    assert load_shapes(folder, points=64, limit=3).classes == ("class_0", "class_1")


def test_damaged_hdf5_shard_is_never_left_out(release):
    folder, _ = release
    (folder / "ply_data_train3.h5").write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match=r"ply_data_train3\.h5: cannot be read"):
        load_shapes(folder, points=64)


def test_hdf5_without_its_library_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "ply_data_train0.h5").write_text("anything")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match=r"urrt-jax\[data\]"):
        load_shapes(tmp_path)


# Files of one shape each.


@pytest.fixture
def tree(tmp_path):
    """A ModelNet tree of two classes; 'table' has no training shape."""
    for name in ("chair/train/chair_1", "chair/train/chair_0", "chair/test/chair_2", "table/test/table_0"):
        file = tmp_path / f"{name}.off"
        file.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1, 2, 1 + len(name) % 3)).export(file)
    return tmp_path


def test_modelnet_tree_is_read_by_split(tree):
    train, test = (load_shapes(tree, split=split, points=128) for split in ("train", "test"))
    assert train.names == ("chair/train/chair_0.off", "chair/train/chair_1.off")
    assert train.classes == test.classes == ("chair", "table")
    np.testing.assert_array_equal(test.labels, [0, 1])
    np.testing.assert_allclose(np.linalg.norm(test.points, axis=2).max(axis=1), 1, atol=1e-6)


def test_what_is_drawn_from_a_file_does_not_depend_on_the_others(tree):
    before = load_shapes(tree, points=128).points[1]
    (tree / "chair/train/chair_0.off").unlink()
    np.testing.assert_array_equal(load_shapes(tree, points=128).points[0], before)
    assert (load_shapes(tree, points=128, seed=1).points[0] != before).any()


def test_bad_files_are_skipped_and_named(tree):
    (tree / "chair/train/broken.off").write_text("OFF\n8 12")
    (tree / "chair/train/empty.off").write_text("")
    shapes = load_shapes(tree, points=128, progress=True)
    assert len(shapes) == 2
    assert [name for name, _ in shapes.skipped] == ["chair/train/broken.off", "chair/train/empty.off"]
    assert "empty" in shapes.skipped[1][1]


def test_folder_of_bad_files_alone_is_refused(tmp_path):
    (tmp_path / "bad.ply").write_text("no")
    with pytest.raises(ValueError, match=r"none of its files could be used; the first of 1, bad\.ply: .*damaged"):
        load_shapes(tmp_path)


def test_any_folder_of_clouds_and_meshes_is_read(tmp_path):
    (tmp_path / "scans").mkdir()
    cloud = np.random.default_rng(0).normal(size=(200, 3)) + 1e6
    write_cloud(tmp_path / "scans" / "one.xyz", cloud)
    write_cloud(tmp_path / "scans" / "small.npy", cloud[:50])
    trimesh.creation.capsule().export(tmp_path / "mesh.stl")
    (tmp_path / "notes.md").write_text("not a shape, and not worth a word")
    shapes = load_shapes(tmp_path, points=100)
    assert shapes.names == ("mesh.stl", "scans/one.xyz")
    assert [shapes.classes[label] for label in shapes.labels] == [tmp_path.name, "scans"]
    assert [name for name, _ in shapes.skipped] == ["scans/small.npy"]
    # A large offset costs no digits, and the points are the file's own, picked at random.
    rows = shapes.points[1] @ np.ones(3)
    assert len(np.unique(rows)) == 100


def test_split_folder_limits_the_search(tmp_path):
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        trimesh.creation.box((1, 2, 3)).export(tmp_path / split / f"{split}.stl")
    assert load_shapes(tmp_path, split="test", points=64).names == ("test/test.stl",)


def test_limit_stops_reading(tree):
    assert load_shapes(tree, points=64, limit=1).names == ("chair/train/chair_0.off",)


def test_queries_of_closed_meshes_are_in_the_frame_of_the_cloud(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=40)
    ball.apply_translation([300, 0, 0])
    ball.export(tmp_path / "ball.off")
    shapes = load_shapes(tmp_path, points=2000, queries=1000)
    radius = np.linalg.norm(shapes.queries[0], axis=1)
    assert shapes.inside[0][radius < 0.9].all()
    assert not shapes.inside[0][radius > 1.1].any()


def test_queries_are_left_out_with_a_warning_where_a_mesh_is_open(tmp_path):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "closed.off")
    box = trimesh.creation.box((1, 2, 3))
    trimesh.Trimesh(box.vertices, box.faces[2:]).export(tmp_path / "open.off")
    with pytest.warns(UserWarning, match=r"open\.off: .*not closed"):
        shapes = load_shapes(tmp_path, points=64, queries=32)
    assert len(shapes) == 2 and shapes.queries is None and shapes.inside is None


def test_real_modelnet_loads_in_the_order_of_the_release():
    folder = os.environ.get("URRT_DATA")
    if not folder or not os.path.isdir(folder):
        pytest.skip("needs ModelNet40: the environment variable URRT_DATA names no folder")
    shapes = load_shapes(folder, split="test", points=1024, limit=100)
    assert shapes.points.shape == (100, 1024, 3)
    assert len(shapes.classes) == 40
    assert np.linalg.norm(shapes.points, axis=2).max() < 1.01
