"""OBJ: its rows are checked here, its content is read by trimesh."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from urrt_jax.io.cloud import PointCloud, as_colors, as_normals
from urrt_jax.io.files import BadFile


def read_obj(file: BinaryIO) -> tuple[PointCloud, np.ndarray]:
    """The vertices and the triangles (F, 3) of all its objects; of bare points also their normals and colours."""
    from trimesh.exchange.obj import load_obj

    faces_promised = _check_rows(file.read().replace(b"\\\r\n", b" ").replace(b"\\\n", b" "))
    file.seek(0)
    # Without materials, because we have no use for textures and they may be missing.
    found = load_obj(file, skip_materials=True)
    if "vertices" in found:
        points = np.asarray(found["vertices"], np.float64).reshape(-1, 3)
        normals, colors = found.get("vertex_normals"), found.get("vertex_colors")
        if colors is not None and np.max(colors) <= 1:  # fractions of 1, though they may all be whole numbers
            colors = np.rint(np.asarray(colors) * 255)
        cloud = PointCloud(points, as_normals(normals, len(points)), as_colors(colors, len(points)))
        return cloud, np.empty((0, 3), np.int64)
    vertices, faces = merge(list(found["geometry"].values()))
    if len(faces) < faces_promised:
        raise BadFile(f"only {len(faces)} of its {faces_promised} faces could be read")
    return PointCloud(vertices), faces


def merge(parts: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of meshes, each of them as trimesh's loaders give it, as one mesh."""
    vertices = [np.asarray(part["vertices"], np.float64).reshape(-1, 3) for part in parts]
    faces = [np.asarray(part["faces"], np.int64).reshape(-1, 3) for part in parts]
    offsets = np.cumsum([0, *map(len, vertices)])
    faces = [face + offset for face, offset in zip(faces, offsets, strict=False)]
    return np.concatenate([np.empty((0, 3)), *vertices]), np.concatenate([np.empty((0, 3), np.int64), *faces])


def _check_rows(text: bytes) -> int:
    """The number of faces, once every face refers to vertices that there are."""
    vertices = faces = 0
    least, most, relative = 1, 0, set[int]()
    for number, line in enumerate(text.split(b"\n"), 1):
        words = line.split(b"#")[0].split()
        if words[:1] == [b"v"]:
            vertices += 1
            if len(words) < 4:
                raise BadFile(f"line {number}: expected the 3 coordinates of a vertex, got {_quoted(line)}")
        elif words[:1] == [b"f"]:
            faces += 1
            try:
                corners = [int(word.split(b"/")[0]) for word in words[1:]]
            except ValueError:
                corners = []
            if len(corners) < 3 or 0 in corners:
                raise BadFile(f"line {number}: expected the 3 or more corners of a face, got {_quoted(line)}")
            most = max(most, *corners)
            if min(corners) < 0:
                relative.add(vertices)
                least = min(least, vertices + 1 + min(corners))
    if least < 1 or most > vertices:
        raise BadFile(f"its faces refer to vertices {least}..{max(most, least)} of {vertices}")
    if relative - {vertices}:
        # trimesh counts them from the last vertex of all.
        raise BadFile("its faces count vertices backwards, before all vertices are listed; such files are not read")
    return faces


def _quoted(line: bytes) -> str:
    return repr(line[:60].decode("latin-1").strip())
