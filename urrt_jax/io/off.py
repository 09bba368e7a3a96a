"""OFF: its rows are checked here, its content is read by trimesh."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from urrt_jax.io.cloud import PointCloud
from urrt_jax.io.files import BadFile


def read_off(file: BinaryIO) -> tuple[PointCloud, np.ndarray]:
    """The vertices and the triangles (F, 3), which may be none."""
    from trimesh.exchange.off import load_off

    promised = _check_rows(file)
    file.seek(0)
    found = load_off(file)
    faces = np.asarray(found["faces"], np.int64).reshape(-1, 3)
    if len(faces) < promised:  # a polygon becomes one triangle or more
        raise BadFile("some of its faces have fewer than 3 corners")
    return PointCloud(np.asarray(found["vertices"], np.float64).reshape(-1, 3)), faces


def _check_rows(file: BinaryIO) -> int:
    """How many faces the header promises, once the rows are as many, and as long, as it and they say."""
    numbered = ((number, line.split(b"#")[0].strip()) for number, line in enumerate(file, 1))
    lines = ((number, line) for number, line in numbered if line)
    number, first = next(lines, (1, b""))
    before, keyword, after = first.partition(b"OFF")
    if not keyword or before not in (b"", b"C", b"N", b"ST", b"CN", b"STCN"):
        raise BadFile(f"line {number}: expected the word OFF, got {_quoted(first)}")
    # Many ModelNet files have the keyword and the counts on one line, as "OFF123 456 0".
    if not after.strip():
        number, after = next(lines, (number, b""))
    counts = after.split()
    if not 2 <= len(counts) <= 3 or not all(count.isdigit() for count in counts):
        raise BadFile(f"line {number}: expected the numbers of vertices, faces and edges, got {_quoted(after)}")
    vertices, faces = int(counts[0]), int(counts[1])
    found = 0
    for number, line in lines:
        found += 1
        words = line.split()
        if found <= vertices:
            if len(words) < 3:
                raise BadFile(f"line {number}: expected the 3 coordinates of a vertex, got {_quoted(line)}")
        elif found > vertices + faces:
            raise BadFile(f"line {number}: its header promises {vertices} vertices and {faces} faces, but more follow")
        elif not words[0].isdigit() or not 3 <= int(words[0]) < len(words):
            expected = "a number of corners, from 3 on, and the corners"
            raise BadFile(f"line {number}: expected {expected}, got {_quoted(line)}")
        elif not all(word.isdigit() and int(word) < vertices for word in words[1 : 1 + int(words[0])]):
            raise BadFile(f"line {number}: its faces refer to vertices 0..{vertices - 1}, got {_quoted(line)}")
    if found < vertices + faces:
        raise BadFile(
            f"truncated; its header promises {vertices} vertices and {faces} faces, "
            f"it holds {min(found, vertices)} and {max(found - vertices, 0)}"
        )
    return faces


def _quoted(line: bytes) -> str:
    return repr(line[:60].decode("latin-1"))
