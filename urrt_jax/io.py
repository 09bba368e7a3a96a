"""Reading and writing one point cloud or mesh, and reading a transform.

Coordinates keep their digits: text and PLY are read and written in double precision, because a cloud in map
coordinates (500,000 m) loses centimetres in single precision. Every complaint about a file is a `ValueError` that
names it.
"""

from __future__ import annotations

import io
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from urrt_jax.atomic import write_atomically

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = (".obj", ".off", ".ply", ".stl")
"""Extensions that may hold faces; `.obj`, `.off` and `.ply` may also hold bare points."""

CLOUD_FORMATS = (".npy", ".npz", ".pcd", ".xyz")
"""Extensions that hold points and nothing else."""

MAX_SAMPLES = 10_000_000
"""The most points that `read_cloud` draws on a mesh: 240 MB of coordinates. The bound stops a mistyped number."""


def read_cloud(path: str | os.PathLike[str], *, samples: int = 20_000) -> np.ndarray:
    """The cloud in a file, as (N, 3) coordinates in the file's own units and frame.

    A mesh with faces is sampled area-uniformly on its surface, always in the same way; a file without faces gives its
    vertices, and all of them.

    Args:
        path: a `.ply`, `.obj`, `.off`, `.stl`, `.xyz`, `.npy`, `.npz` or `.pcd` file. `.xyz` gives its first three
            columns (`#` starts a comment); `.npz` its array `points`, else its only array of shape (N, 3).
        samples: how many points to draw on a mesh with faces, from 1 to 10,000,000.

    Returns:
        (N, 3), float32 where the file stores single-precision arrays (`.npy`, `.npz`, `.pcd`), else float64.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: `samples` is not a whole number in that range, or the file's extension is unknown, or the file is
            unreadable, truncated, empty or holds non-finite values.
        ImportError: a `.pcd` file, and `pypcd4` (extra `urrt-jax[data]`) is not installed.
    """
    check_samples(samples)
    geometry = read_geometry(path)
    if isinstance(geometry, np.ndarray):
        return geometry
    return sample_surface(geometry.triangles, samples, np.random.default_rng(0))


def check_samples(samples: int, *, name: str = "samples") -> None:
    """Raises a `ValueError` that names the option unless `samples` is a whole number from 1 to `MAX_SAMPLES`."""
    whole = isinstance(samples, int | np.integer) and not isinstance(samples, bool)
    if not whole or not 1 <= samples <= MAX_SAMPLES:
        raise ValueError(f"{name}: expected a whole number from 1 to {MAX_SAMPLES:,}, got {samples!r}")


def read_mesh(path: str | os.PathLike[str]) -> trimesh.Trimesh:
    """The triangle mesh in a `.ply`, `.obj`, `.off` or `.stl` file, vertices as stored (nothing merged or dropped).

    Raises `FileNotFoundError` and `ValueError` as `read_cloud` does; a file without faces is a `ValueError` too.
    """
    geometry = read_geometry(path)
    if isinstance(geometry, np.ndarray):
        raise ValueError(f"{path}: holds {len(geometry)} points but no faces, so it is not a mesh")
    return geometry


def read_geometry(path: str | os.PathLike[str]) -> trimesh.Trimesh | np.ndarray:
    """The mesh in a file where it has faces with some area, else its (N, 3) points; raises as `read_cloud` does."""
    path = Path(path)
    extension = path.suffix.lower()
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    if extension not in MESH_FORMATS + CLOUD_FORMATS:
        known = ", ".join(sorted(MESH_FORMATS + CLOUD_FORMATS))
        raise ValueError(f"{path}: unknown extension {extension!r}; known are {known}")
    if not path.is_file():
        raise ValueError(f"{path}: not a file")
    if path.stat().st_size == 0:
        raise ValueError(f"{path}: empty, a file of no bytes")
    if extension in MESH_FORMATS:
        vertices, faces = _load_mesh(path)
    else:
        vertices, faces = _load_points(path), np.empty((0, 3), int)

    if len(vertices) == 0:
        raise ValueError(f"{path}: empty, it holds no points")
    broken = int(np.sum(~np.isfinite(vertices).all(axis=1)))
    if broken:
        raise ValueError(f"{path}: {broken} of {len(vertices)} points are not finite (NaN or infinity)")
    if len(faces) == 0:
        return vertices

    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path}: its faces refer to vertices {faces.min()}..{faces.max()} of {len(vertices)}")
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.area > 0:
        raise ValueError(f"{path}: its {len(faces)} faces have no area, so no point can be drawn on them")
    return mesh


def read_transform(path: str | os.PathLike[str]) -> np.ndarray:
    """The matrix (4, 4), float64, in a file: four rows of text (`#` starts a comment), a `.npy`, or a `.json`.

    A `.json` holds the rows, or an object with a `matrix`, as `urrt register --json` prints it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it holds no (4, 4) matrix of finite numbers.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if path.suffix.lower() == ".npy":
            found = np.load(path, allow_pickle=False)
        elif path.suffix.lower() == ".json":
            content = json.loads(path.read_text())
            found = content["matrix"] if isinstance(content, dict) else content
        else:
            found = np.loadtxt(path, ndmin=2)
        matrix = np.asarray(found, np.float64)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: holds no matrix of 4 rows and 4 columns ({error})") from error
    if matrix.shape != (4, 4):
        raise ValueError(f"{path}: expected a matrix of shape (4, 4), got {matrix.shape}")
    if not np.isfinite(matrix).all():  # `null` in a .json becomes NaN
        raise ValueError(f"{path}: expected a matrix of finite numbers, got {matrix.tolist()}")
    return matrix


def sample_surface(triangles: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points drawn area-uniformly on triangles: (count, 3) from `triangles` (F, 3, 3), in random order.

    Faces are drawn by their area, then a point in each by folding the unit square onto the triangle.
    """
    corner, one, two = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = np.cumsum(np.linalg.norm(np.cross(one, two), axis=1))
    # `right` and the clip keep faces without area out, also at the very ends of the range.
    face = np.searchsorted(area, rng.random(count) * area[-1], side="right").clip(max=len(area) - 1)
    along = rng.random((count, 2))
    along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)
    return corner[face] + along[:, :1] * one[face] + along[:, 1:] * two[face]


def write_cloud(path: str | os.PathLike[str], points: ArrayLike, colors: ArrayLike | None = None) -> None:
    """Nothing; the file appears whole or not at all (written beside its place, then moved there).

    Args:
        path: a `.ply` (binary), `.xyz` or `.npy` file. All three give back exactly the numbers written.
        points: (N, 3), finite.
        colors: (N, 3) uint8 red, green, blue; `.ply` only.

    Raises:
        ValueError: another extension, or points or colours of another shape or type, empty or non-finite.
    """
    path = Path(path)
    writers: dict[str, Callable[[BinaryIO, np.ndarray, np.ndarray | None], None]] = {
        ".npy": lambda file, points, _: np.save(file, points, allow_pickle=False),
        ".ply": _write_ply,
        ".xyz": lambda file, points, _: np.savetxt(file, points, "%.17g"),
    }
    extension = path.suffix.lower()
    if extension not in writers:
        raise ValueError(f"{path}: cannot write extension {extension!r}; known are {', '.join(writers)}")
    points = _as_points(np.asarray(points), f"{path}: points to write")
    if len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"{path}: points to write are empty or not finite, of shape {points.shape}")
    if colors is not None:
        colors = np.asarray(colors)
        if extension != ".ply":
            raise ValueError(f"{path}: only .ply holds colours")
        if colors.shape != points.shape or colors.dtype != np.uint8:
            raise ValueError(f"{path}: colours must be uint8 {points.shape}, got {colors.dtype} {colors.shape}")

    buffer = io.BytesIO()
    writers[extension](buffer, points, colors)
    write_atomically(path, buffer.getvalue())


def _load_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64 and faces (F, 3), which may be none."""
    import trimesh

    try:
        # process=False: merging vertices would drop the repeated points of a cloud.
        # skip_materials, because we have no use for an OBJ's textures and they may be missing.
        loaded = trimesh.load(path, process=False, skip_materials=True)
        parts = list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]
        vertices = [np.asarray(getattr(part, "vertices", ()), np.float64).reshape(-1, 3) for part in parts]
        faces = [np.asarray(getattr(part, "faces", ()), np.int64).reshape(-1, 3) for part in parts]
        offsets = np.cumsum([0, *map(len, vertices)])
        faces = [face + offset for face, offset in zip(faces, offsets, strict=False)]
    except Exception as error:  # a parser fed with anything may raise anything
        # A damaged binary STL is tried as text, and an optional library to guess its alphabet may be missing.
        reason = "damaged or of another format" if isinstance(error, ImportError) else error
        raise ValueError(f"{path}: cannot be read as {path.suffix[1:].upper()}: {reason}") from error
    if not parts:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    _check_complete(path, sum(map(len, vertices)), sum(map(len, faces)))
    return np.concatenate(vertices), np.concatenate(faces)


def _check_complete(path: Path, vertices: int, faces: int) -> None:
    """Nothing, or a ValueError where a PLY or OFF header promises more than was read: the parser does not say so."""
    promised_vertices = promised_faces = 0
    with open(path, "rb") as file:
        if path.suffix.lower() == ".ply":
            for line in file:
                words = line.split()
                if words[:1] == [b"end_header"]:
                    break
                if words[:2] == [b"element", b"vertex"]:
                    promised_vertices = int(words[2])
                if words[:2] == [b"element", b"face"]:
                    promised_faces = int(words[2])
        elif path.suffix.lower() == ".off":
            lines = (line.split(b"#")[0].strip() for line in file)
            # Many ModelNet files have the keyword and the counts on one line, as "OFF123 456 0".
            counts = b" ".join(next((line for line in lines if line), b"").upper().partition(b"OFF")[2].split())
            words = (counts or next((line for line in lines if line), b"")).split()
            if len(words) >= 2 and all(word.isdigit() for word in words[:2]):
                promised_vertices, promised_faces = int(words[0]), int(words[1])
    # A polygon becomes one triangle or more, never none.
    if vertices < promised_vertices or faces < promised_faces:
        raise ValueError(
            f"{path}: truncated; its header promises {promised_vertices} vertices and {promised_faces} faces, "
            f"it holds {vertices} and {faces}"
        )


def _load_points(path: Path) -> np.ndarray:
    """Points (N, 3) of a format without faces."""
    extension = path.suffix.lower()
    try:
        if extension == ".xyz":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # an empty file gets our own, clearer error
                points = np.loadtxt(path, comments="#", ndmin=2, encoding="utf-8")
            points = points[:, :3]
        elif extension == ".pcd":
            from pypcd4.pypcd4 import PointCloud

            points = PointCloud.from_path(path).numpy(("x", "y", "z"))
        else:
            points = np.load(path, allow_pickle=False)
            if extension == ".npz":
                with points as archive:
                    points = _only_cloud({key: archive[key] for key in archive.files})
    except ImportError as error:
        raise ImportError(f"{path}: reading .pcd needs pypcd4: pip install 'urrt-jax[data]'") from error
    except Exception as error:  # as above
        raise ValueError(f"{path}: cannot be read as {extension[1:].upper()}: {error}") from error
    return _as_points(points, f"{path}: its points") if points.size else np.empty((0, 3))


def _only_cloud(arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The array `points`, else the only one of shape (N, 3)."""
    if "points" in arrays:
        return arrays["points"]
    clouds = [key for key, array in arrays.items() if array.ndim == 2 and array.shape[1] == 3]
    if len(clouds) != 1:
        held = ", ".join(f"{key} {array.shape}" for key, array in arrays.items())
        raise ValueError(f"needs an array 'points' or exactly one of shape (N, 3); it holds: {held or 'nothing'}")
    return arrays[clouds[0]]


def _as_points(points: np.ndarray, what: str) -> np.ndarray:
    """Points (N, 3) as float32 or float64, whichever holds the stored numbers."""
    if points.ndim != 2 or points.shape[1] != 3 or not np.can_cast(points.dtype, np.float64, "same_kind"):
        raise ValueError(f"{what} must be numbers of shape (N, 3), got {points.dtype} {points.shape}")
    return points.astype(np.float32 if points.dtype in (np.float16, np.float32) else np.float64)


def _write_ply(file: BinaryIO, points: np.ndarray, colors: np.ndarray | None) -> None:
    """Binary PLY in the points' own precision (trimesh would write single precision)."""
    kind, name = ("<f4", "float") if points.dtype == np.float32 else ("<f8", "double")
    fields = [(axis, kind, name) for axis in "xyz"]
    if colors is not None:
        fields += [(color, "u1", "uchar") for color in ("red", "green", "blue")]
    rows = np.empty(len(points), [(field, kind) for field, kind, _ in fields])
    for i, axis in enumerate("xyz"):
        rows[axis] = points[:, i]
    if colors is not None:
        for i, color in enumerate(("red", "green", "blue")):
            rows[color] = colors[:, i]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property {name} {field}" for field, _, name in fields]
    file.write("\n".join([*header, "end_header", ""]).encode())
    file.write(rows.tobytes())
