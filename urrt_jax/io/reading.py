"""Reading one point cloud or mesh."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urrt_jax.io.cloud import MAX_POINTS, PointCloud
from urrt_jax.io.files import BadFile, opened
from urrt_jax.io.formats import CLOUD_READERS, MESH_READERS, READABLE, extension_of, require_libraries
from urrt_jax.io.surface import check_samples, sample_surface_with_normals

if TYPE_CHECKING:
    import trimesh


def read_point_cloud(path: str | os.PathLike[str], *, samples: int = 20_000) -> PointCloud:
    """The cloud in a file, in the file's own units and frame, with its normals and colours where it has them.

    A mesh with faces is sampled area-uniformly on its surface, always in the same way, and a point's normal is that of
    its face; a file without faces gives its vertices, and all of them.

    Args:
        path: a file with one of the extensions in `READABLE`. A text (`.csv`, `.pts`, `.txt`, `.xyz`) gives the columns
            that its header names x, y and z, else its first three; `.npz` its array `points`, else its only array of
            shape (N, 3).
        samples: how many points to draw on a mesh with faces, from 1 to 10,000,000.

    Returns:
        `points` (N, 3) are float32 where the file stores single-precision arrays (`.npy`, `.npz`, `.pcd`), else
        float64. `normals` (N, 3) are as stored, None where there are none or some are not finite. `colors` (N, 3) are
        uint8; those of a mesh are not read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: `samples` is not a whole number in that range, or the file's extension is unknown, or the file is
            unreadable, truncated, empty or holds non-finite values, or more than 4 GiB or 100 million points, or it
            is no regular file.
        ImportError: the format needs a library of the extra `urrt-jax[data]` that is not installed.
    """
    check_samples(samples)
    found = _read(path)
    if isinstance(found, PointCloud):
        return found
    points, normals = sample_surface_with_normals(found.triangles, samples, np.random.default_rng(0))
    return PointCloud(points, normals)


def read_cloud(path: str | os.PathLike[str], *, samples: int = 20_000) -> np.ndarray:
    """The points (N, 3) in a file, as `read_point_cloud` gives them; raises as it does."""
    return read_point_cloud(path, samples=samples).points


def read_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """The triangle mesh in a `.ply`, `.obj`, `.off` or `.stl` file, vertices as stored (nothing merged or dropped).

    The objects of a file of several are one mesh. Raises `FileNotFoundError` and `ValueError` as `read_point_cloud`
    does; a file without faces is a `ValueError` too.
    """
    geometry = read_geometry(path)
    if isinstance(geometry, np.ndarray):
        raise ValueError(f"{path}: holds {len(geometry)} points but no faces, so it is not a mesh")
    return geometry


def read_geometry(path: str | os.PathLike[str]) -> trimesh.Trimesh | np.ndarray:
    """The mesh in a file where it has faces with some area, else its (N, 3) points; raises as `read_point_cloud`."""
    found = _read(path)
    return found.points if isinstance(found, PointCloud) else found


def _read(path: str | os.PathLike[str]) -> trimesh.Trimesh | PointCloud:
    """The mesh in a file where it has faces with some area, else its cloud."""
    path = Path(path)
    extension = extension_of(path)
    if path.exists():
        if extension not in READABLE:
            raise ValueError(f"{path}: unknown extension {extension!r}; known are {', '.join(READABLE)}")
        require_libraries(path)
    with opened(path) as file:
        if extension in MESH_READERS:
            cloud, faces = MESH_READERS[extension](file)
        else:
            cloud, faces = CLOUD_READERS[extension](file), np.empty((0, 3), np.int64)
        _check_points(cloud.points)
        if len(faces) == 0:
            return cloud
        return _as_mesh(cloud.points, faces)


def _check_points(points: np.ndarray) -> None:
    if len(points) == 0:
        raise BadFile("empty, it holds no points")
    if len(points) > MAX_POINTS:
        raise BadFile(f"holds {len(points):,} points, more than the {MAX_POINTS:,} that are read")
    broken = int(np.sum(~np.isfinite(points).all(axis=1)))
    if broken:
        raise BadFile(f"{broken} of {len(points)} points are not finite (NaN or infinity)")


def _as_mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise BadFile(f"its faces refer to vertices {faces.min()}..{faces.max()} of {len(vertices)}")
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.area > 0:
        raise BadFile(f"its {len(faces)} faces have no area, so no point can be drawn on them")
    if not np.isfinite(mesh.area):
        raise BadFile(f"its {len(faces)} faces are so large that their area cannot be computed")
    return mesh
