"""The formats that are read and written, by the extension of a file's name."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from urrt_jax.io import arrays, las, obj, off, pcd, ply, stl, text
from urrt_jax.io.cloud import PointCloud


class Writer(NamedTuple):
    """How a format is written, and what it holds beside the points."""

    write: Callable[[PointCloud], bytes]
    normals: bool = False
    colors: bool = False


MESH_READERS: dict[str, Callable[[BinaryIO], tuple[PointCloud, np.ndarray]]] = {
    ".obj": obj.read_obj,
    ".off": off.read_off,
    ".ply": ply.read_ply,
    ".stl": stl.read_stl,
}
"""Formats that may hold faces; `.obj`, `.off` and `.ply` may also hold bare points."""

CLOUD_READERS: dict[str, Callable[[BinaryIO], PointCloud]] = {
    ".csv": text.read_text,
    ".las": las.read_las,
    ".laz": las.read_las,
    ".npy": arrays.read_npy_cloud,
    ".npz": arrays.read_npz_cloud,
    ".pcd": pcd.read_pcd,
    ".pts": text.read_pts,
    ".txt": text.read_text,
    ".xyz": text.read_text,
}
"""Formats that hold points and no faces."""

WRITERS: dict[str, Writer] = {
    ".csv": Writer(text.write_csv, normals=True, colors=True),
    ".las": Writer(las.write_las, colors=True),
    ".laz": Writer(las.write_laz, colors=True),
    ".npy": Writer(arrays.write_npy),
    ".npz": Writer(arrays.write_npz, normals=True, colors=True),
    ".pcd": Writer(pcd.write_pcd, normals=True, colors=True),
    ".ply": Writer(ply.write_ply, normals=True, colors=True),
    ".txt": Writer(text.write_txt, normals=True, colors=True),
    ".xyz": Writer(text.write_xyz),
}

LIBRARIES = {".pcd": ("pypcd4",), ".las": ("laspy",), ".laz": ("laspy", "lazrs")}
"""The libraries that a format needs beyond those that are always installed; all are in the extra `urrt-jax[data]`."""

MESH_FORMATS = tuple(sorted(MESH_READERS))
"""Extensions of files that may hold faces."""

CLOUD_FORMATS = tuple(sorted(CLOUD_READERS))
"""Extensions of files that hold points and no faces."""

READABLE = tuple(sorted(MESH_READERS | CLOUD_READERS))
"""Extensions of the files that `read_cloud` reads."""

WRITABLE = tuple(sorted(WRITERS))
"""Extensions of the files that `write_cloud` writes."""


def holds_normals(path: str | os.PathLike[str]) -> bool:
    """Whether a file of this name, once written, holds normals."""
    writer = WRITERS.get(extension_of(path))
    return writer is not None and writer.normals


def holds_colors(path: str | os.PathLike[str]) -> bool:
    """Whether a file of this name, once written, holds colours."""
    writer = WRITERS.get(extension_of(path))
    return writer is not None and writer.colors


def extension_of(path: str | os.PathLike[str]) -> str:
    """The extension in small letters, with its dot."""
    return Path(path).suffix.lower()


def require_libraries(path: Path) -> None:
    """Raises an `ImportError` that names the extra where a library for this format is not installed."""
    for library in LIBRARIES.get(extension_of(path), ()):
        try:
            importlib.import_module(library)
        except ImportError as error:
            message = f"{path}: {extension_of(path)} files need {library}: pip install 'urrt-jax[data]'"
            raise ImportError(message) from error
