"""Writing one point cloud."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from urrt_jax.atomic import check_place, write_atomically
from urrt_jax.io.cloud import PointCloud, as_points
from urrt_jax.io.files import BadFile
from urrt_jax.io.formats import WRITABLE, WRITERS, extension_of, holds_colors, holds_normals, require_libraries


def write_cloud(
    path: str | os.PathLike[str],
    points: ArrayLike,
    colors: ArrayLike | None = None,
    normals: ArrayLike | None = None,
) -> None:
    """Nothing; the file appears whole or not at all (written beside its place, then moved there).

    Args:
        path: a file with one of the extensions in `WRITABLE`. All give back exactly the numbers written, but `.las` and
            `.laz` keep 9 digits of the cloud's extent and `.pcd` at least 6, because other programs read no more.
        points: (N, 3), finite.
        colors: (N, 3) uint8 red, green, blue; for a file that `holds_colors`.
        normals: (N, 3), finite; for a file that `holds_normals`.

    Raises:
        ValueError: another extension, or points, colours or normals of another shape or type, empty or non-finite, or
            that the format does not hold.
        ImportError: the format needs a library of the extra `urrt-jax[data]` that is not installed.
    """
    path = Path(path)
    _check_extension(path)
    try:
        cloud = PointCloud(as_points(np.asarray(points), "points to write"))
        if len(cloud.points) == 0 or not np.isfinite(cloud.points).all():
            raise BadFile(f"points to write are empty or not finite, of shape {cloud.points.shape}")
        if normals is not None:
            cloud = cloud._replace(normals=_checked_normals(path, cloud.points, np.asarray(normals)))
        if colors is not None:
            cloud = cloud._replace(colors=_checked_colors(path, cloud.points, np.asarray(colors)))
        require_libraries(path)
        content = WRITERS[extension_of(path)].write(cloud)
    except BadFile as error:
        raise ValueError(f"{path}: {error}") from error
    write_atomically(path, content)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raises a `ValueError` that says why, where `write_cloud` would refuse to write a file of this name.

    The reason is an unknown extension, a library that is not installed, a folder that is missing or not writable, or
    that the name is that of a folder, a pipe or a device.
    """
    path = Path(path)
    _check_extension(path)
    try:
        require_libraries(path)
    except ImportError as error:
        raise ValueError(str(error)) from error
    check_place(path)


def _check_extension(path: Path) -> None:
    if extension_of(path) not in WRITABLE:
        raise ValueError(f"{path}: cannot write extension {extension_of(path)!r}; known are {', '.join(WRITABLE)}")


def _checked_normals(path: Path, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    if not holds_normals(path):
        known = ", ".join(extension for extension in WRITABLE if WRITERS[extension].normals)
        raise BadFile(f"{extension_of(path)} holds no normals; {known} do")
    normals = as_points(normals, "normals to write")
    if normals.shape != points.shape or not np.isfinite(normals).all():
        raise BadFile(f"normals must be finite, of shape {points.shape}, got {normals.shape}")
    return normals


def _checked_colors(path: Path, points: np.ndarray, colors: np.ndarray) -> np.ndarray:
    if not holds_colors(path):
        known = ", ".join(extension for extension in WRITABLE if WRITERS[extension].colors)
        raise BadFile(f"{extension_of(path)} holds no colours; {known} do")
    if colors.shape != points.shape or colors.dtype != np.uint8:
        raise BadFile(f"colours must be uint8 {points.shape}, got {colors.dtype} {colors.shape}")
    return colors
