"""Points in NumPy's own files, `.npy` and `.npz`."""

from __future__ import annotations

import io
import zipfile
from typing import IO, BinaryIO

import numpy as np

from urrt_jax.io.cloud import PointCloud, as_colors, as_normals, as_points, check_count
from urrt_jax.io.files import MAX_RATIO, BadFile, size_of

_SMALL = 16 * 2**20  # an array of at most so many bytes does no harm, however well it was compressed


def read_npy_cloud(file: BinaryIO) -> PointCloud:
    """The cloud in a `.npy`: one array of shape (N, 3)."""
    return PointCloud(as_points(read_npy(file), "its points"))


def read_npy(file: BinaryIO) -> np.ndarray:
    """The array of numbers in a `.npy`, after its header is compared with the file's length."""
    shape, dtype, start = _header(file)
    promised, held = _nbytes(shape, dtype), size_of(file) - start
    if promised > held:
        raise BadFile(f"truncated; its header promises {promised:,} bytes of numbers, it holds {held:,}")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)


def read_npz_cloud(file: BinaryIO) -> PointCloud:
    """The cloud in a `.npz`: the array `points`, else its only array of shape (N, 3); of the other arrays none is read.

    `normals` and `colors` of the same shape as `points` are taken too.
    """
    with zipfile.ZipFile(file) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        if "points" in members:
            key = "points"
        else:
            # Headers only: whether an array is a cloud is known before its numbers are read.
            shapes = {key: _member_header(archive, name)[0] for key, name in members.items()}
            clouds = [key for key, shape in shapes.items() if len(shape) == 2 and shape[1] == 3]
            if len(clouds) != 1:
                held = ", ".join(f"{key} {shape}" for key, shape in shapes.items()) or "nothing"
                raise BadFile(f"needs an array 'points' or exactly one of shape (N, 3); it holds: {held}")
            key = clouds[0]
        points = as_points(_member(archive, members[key]), "its points")
        others = {}
        for other in ("normals", "colors"):
            if key == "points" and other in members and _member_header(archive, members[other])[0] == points.shape:
                others[other] = _member(archive, members[other])
    normals = as_normals(others.get("normals"), len(points))
    return PointCloud(points, normals, as_colors(others.get("colors"), len(points)))


def write_npy(cloud: PointCloud) -> bytes:
    """The bytes of a `.npy` with the points."""
    buffer = io.BytesIO()
    np.save(buffer, cloud.points, allow_pickle=False)
    return buffer.getvalue()


def write_npz(cloud: PointCloud) -> bytes:
    """The bytes of a `.npz` with `points`, and `normals` and `colors` where there are some."""
    buffer = io.BytesIO()
    np.savez(buffer, **{key: array for key, array in cloud._asdict().items() if array is not None})
    return buffer.getvalue()


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype, int]:
    """Shape and type of the array that a file of NumPy's holds, and where its numbers begin."""
    try:
        version = np.lib.format.read_magic(file)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, _, dtype = read(file)
    except Exception as error:  # NumPy evaluates the header as Python, which may fail in any way
        # Version 3 is only for field names beyond Latin-1, so never for plain numbers.
        raise BadFile("has no valid header of NumPy's: damaged, or not an array") from error
    if dtype.hasobject:
        raise BadFile("holds Python objects, which are never loaded")
    if dtype.kind not in "iuf":
        raise BadFile(f"its points must be numbers of shape (N, 3), got {dtype} {shape}")
    if any(length < 0 for length in shape):
        raise BadFile(f"its header promises an array of shape {shape}")
    check_count(shape[0] if shape else 1)
    return shape, dtype, file.tell()


def _nbytes(shape: tuple[int, ...], dtype: np.dtype) -> int:
    count = dtype.itemsize
    for length in shape:
        count *= length  # in Python's own numbers, which don't overflow
    return count


def _member_header(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype | None]:
    """Shape and type of one array of an archive; an empty shape and None for what holds no numbers."""
    _check_ratio(archive, name)
    with archive.open(name) as file:
        try:
            return _header(file)[:2]
        except BadFile:
            return (), None


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One array of an archive."""
    _check_ratio(archive, name)
    with archive.open(name) as file:
        shape, dtype, start = _header(file)
        promised, held = _nbytes(shape, dtype), archive.getinfo(name).file_size - start
        if promised > held:
            raise BadFile(f"truncated; '{name}' promises {promised:,} bytes of numbers, it holds {held:,}")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)


def _check_ratio(archive: zipfile.ZipFile, name: str) -> None:
    """A `BadFile` where a member is large and compressed so well that it must be a bomb."""
    member = archive.getinfo(name)
    if member.file_size > max(_SMALL, MAX_RATIO * member.compress_size):
        raise BadFile(
            f"'{name}' would unpack from {member.compress_size:,} to {member.file_size:,} bytes, more than {MAX_RATIO} "
            "times as many"
        )
