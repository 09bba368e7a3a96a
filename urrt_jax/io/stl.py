"""STL: its length is checked here, its content is read by trimesh."""

from __future__ import annotations

import re
from typing import BinaryIO

import numpy as np

from urrt_jax.io.cloud import PointCloud
from urrt_jax.io.files import BadFile, size_of
from urrt_jax.io.obj import merge


def read_stl(file: BinaryIO) -> tuple[PointCloud, np.ndarray]:
    """The vertices, three a triangle, and the triangles (F, 3) of all its solids."""
    from trimesh.exchange.stl import load_stl

    promised = _check_length(file)
    file.seek(0)
    found = load_stl(file)
    vertices, faces = merge(list(found["geometry"].values()) if "geometry" in found else [found])
    if len(faces) != promised:
        raise BadFile(f"only {len(faces)} of its {promised} triangles could be read")
    return PointCloud(vertices), faces


def _check_length(file: BinaryIO) -> int:
    """The number of triangles that it says it holds, once it is long enough for them."""
    header, size = file.read(84), size_of(file)
    count = int.from_bytes(header[80:84], "little")
    if size == 84 + 50 * count:  # binary; its first 80 bytes may well begin with 'solid'
        return count
    if not header.lstrip().lower().startswith(b"solid"):
        raise BadFile(
            f"truncated or damaged; it says that it holds {count:,} triangles, which are {84 + 50 * count:,} bytes, "
            f"and holds {size:,}"
        )
    file.seek(0)
    text = file.read().lower()
    facets, vertices = (len(re.findall(rb"^\s*%s\b" % word, text, re.MULTILINE)) for word in (b"facet", b"vertex"))
    ends = len(re.findall(rb"^\s*endsolid\b", text, re.MULTILINE))
    if ends == 0 or vertices != 3 * facets:
        raise BadFile(
            f"truncated or damaged; it holds {facets} triangles, {vertices} corners and {ends} complete solids"
        )
    return facets
