import os
import re

import numpy as np
import pytest

from urrt_jax.atomic import write_atomically
from urrt_jax.io import WRITABLE, check_writable, holds_colors, holds_normals, read_cloud, write_cloud

POINTS = np.arange(12.0).reshape(4, 3)


def test_a_link_stays_and_its_target_is_written(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "link.npy").symlink_to(tmp_path / "folder" / "cloud.npy")
    write_cloud(tmp_path / "link.npy", POINTS)
    assert (tmp_path / "link.npy").is_symlink()
    np.testing.assert_array_equal(read_cloud(tmp_path / "folder" / "cloud.npy"), POINTS)
    assert os.listdir(tmp_path / "folder") == ["cloud.npy"]


def test_a_relative_link_is_followed_from_its_own_folder(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_atomically(tmp_path / "link.txt", "new")
    assert (tmp_path / "real.txt").read_text() == "new"


@pytest.mark.parametrize("where", ["nowhere/a.txt", "file/a.txt", "folder"])
def test_a_failed_write_names_its_file_and_leaves_nothing(tmp_path, where):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError) as failure:
        write_atomically(tmp_path / where, "new")
    assert failure.value.filename == str(tmp_path / where)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_a_name_as_long_as_names_can_be_is_written(tmp_path):
    write_atomically(tmp_path / ("a" * 255), "new")
    assert os.listdir(tmp_path) == ["a" * 255]


@pytest.mark.parametrize("extension", WRITABLE)
def test_what_can_be_written_passes_the_check(tmp_path, extension):
    check_writable(tmp_path / f"cloud{extension}")


def test_a_file_that_exists_may_be_written_again(tmp_path):
    (tmp_path / "cloud.ply").touch()
    check_writable(tmp_path / "cloud.ply")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cloud.docx", "cannot write extension '.docx'; known are .csv, .las"),
        ("cloud", "cannot write extension ''"),
        ("nowhere/cloud.ply", "there is no folder"),
        ("folder.ply", "exists and is not a regular file"),
    ],
)
def test_what_cannot_be_written_is_named_before_any_work(tmp_path, name, message):
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(ValueError, match=f"{re.escape(name)}: {re.escape(message)}"):
        check_writable(tmp_path / name)


def test_a_folder_without_permission_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # the superuser may write anywhere
    with pytest.raises(ValueError, match=r"cloud\.ply: the folder .* is not writable"):
        check_writable(tmp_path / "cloud.ply")


@pytest.mark.parametrize(("extension", "library"), [("pcd", "pypcd4"), ("las", "laspy"), ("laz", "lazrs")])
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, extension, library):
    import sys

    monkeypatch.setitem(sys.modules, library, None)
    reason = rf"cloud\.{extension}: .*need {library}: pip install 'urrt-jax\[data\]'"
    with pytest.raises(ValueError, match=reason):
        check_writable(tmp_path / f"cloud.{extension}")
    with pytest.raises(ImportError, match=reason):
        write_cloud(tmp_path / f"cloud.{extension}", POINTS)
    (tmp_path / f"cloud.{extension}").write_text("anything")
    with pytest.raises(ImportError, match=reason):
        read_cloud(tmp_path / f"cloud.{extension}")


@pytest.mark.parametrize("extension", WRITABLE)
def test_what_a_format_does_not_hold_is_refused(tmp_path, extension):
    file = tmp_path / f"cloud{extension}"
    if not holds_normals(file):
        with pytest.raises(ValueError, match="holds no normals"):
            write_cloud(file, POINTS, normals=POINTS)
    if not holds_colors(file):
        with pytest.raises(ValueError, match="holds no colours"):
            write_cloud(file, POINTS, np.zeros((4, 3), np.uint8))
    assert not file.exists()


@pytest.mark.parametrize("normals", [np.full((4, 3), np.nan), np.zeros((5, 3)), np.zeros(4)])
def test_wrong_normals_are_refused(tmp_path, normals):
    with pytest.raises(ValueError, match=r"cloud\.ply: normals"):
        write_cloud(tmp_path / "cloud.ply", POINTS, normals=normals)
