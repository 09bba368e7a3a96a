"""PLY: its header is checked here, its content is read by trimesh, and clouds are written in full precision."""

from __future__ import annotations

from typing import BinaryIO, NamedTuple

import numpy as np

from urrt_jax.io.cloud import PointCloud, as_colors, as_normals
from urrt_jax.io.files import BadFile, size_of

_BYTES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_BYTES |= {f"{kind}{8 * size}": size for kind in ("int", "uint") for size in (1, 2, 4, 8)}
_BYTES |= {f"float{8 * size}": size for size in (2, 4, 8)}

_MAX_LINE, _MAX_LINES = 4096, 10_000  # no header comes near


class _Element(NamedTuple):
    name: str
    count: int
    properties: dict[str, tuple[int, bool]]
    """Of each property, the bytes of its number in a binary file, and whether that is the length of a list."""


def read_ply(file: BinaryIO) -> tuple[PointCloud, np.ndarray]:
    """The vertices, with their normals and colours, and the triangles (F, 3), which may be none."""
    from trimesh.exchange.ply import load_ply
    from trimesh.geometry import triangulate_quads

    promised = {element.name: element.count for element in _check_header(file)}
    file.seek(0)
    try:
        # Not to split vertices that have several texture coordinates: we have no use for textures.
        found = load_ply(file, fix_texture=False, skip_materials=True)
    except ValueError as error:
        if "unexpected length" not in str(error):
            raise
        raise BadFile(
            "its data are longer or shorter than its header says: truncated, damaged, or a binary file of faces with "
            "different numbers of corners, which is not read"
        ) from error
    if not promised.get("vertex"):
        return PointCloud(np.empty((0, 3))), np.empty((0, 3), np.int64)
    points = np.asarray(found["vertices"], np.float64)
    faces = np.empty((0, 3), np.int64)
    if promised.get("face"):
        _check_corners(found["metadata"]["_ply_raw"]["face"]["data"])
        faces = np.asarray(triangulate_quads(found["faces"]), np.int64).reshape(-1, 3)
        if len(faces) < promised["face"]:  # a polygon becomes one triangle or more
            raise BadFile("some of its faces have fewer than 3 corners")
    normals, colors = found.get("vertex_normals"), found.get("vertex_colors")
    colors = None if colors is None else np.asarray(colors)[:, :3]
    return PointCloud(points, as_normals(normals, len(points)), as_colors(colors, len(points))), faces


def write_ply(cloud: PointCloud) -> bytes:
    """The bytes of a binary PLY, in the points' own precision (trimesh would write single precision)."""
    kind, name = ("<f4", "float") if cloud.points.dtype == np.float32 else ("<f8", "double")
    columns = [(axis, kind, name, cloud.points[:, i]) for i, axis in enumerate(("x", "y", "z"))]
    if cloud.normals is not None:
        columns += [(axis, kind, name, cloud.normals[:, i]) for i, axis in enumerate(("nx", "ny", "nz"))]
    if cloud.colors is not None:
        columns += [(color, "u1", "uchar", cloud.colors[:, i]) for i, color in enumerate(("red", "green", "blue"))]
    rows = np.empty(len(cloud.points), [(field, kind) for field, kind, _, _ in columns])
    for field, _, _, values in columns:
        rows[field] = values
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {name} {field}" for field, _, name, _ in columns]
    return "\n".join([*header, "end_header", ""]).encode() + rows.tobytes()


def _check_header(file: BinaryIO) -> list[_Element]:
    """The elements that the header promises, once the rest of the file is long enough to hold them."""
    if file.readline(_MAX_LINE).strip() != b"ply":
        raise BadFile("damaged, or not a PLY file: its first line is not 'ply'")
    form, elements = None, list[_Element]()
    for _ in range(_MAX_LINES):
        line = file.readline(_MAX_LINE)
        words = line.decode("latin-1").split()
        match words:
            case ["end_header"]:
                break
            case ["comment" | "obj_info", *_]:
                pass
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, _] if not elements:
                pass
            case ["element", name, count] if count.isdecimal() and name not in [element.name for element in elements]:
                elements.append(_Element(name, int(count), {}))
            case ["property", kind, name] if elements and kind in _BYTES and name not in elements[-1].properties:
                elements[-1].properties[name] = _BYTES[kind], False
            case ["property", "list", count, kind, name] if (
                elements and count in _BYTES and kind in _BYTES and name not in elements[-1].properties
            ):
                elements[-1].properties[name] = _BYTES[count], True
            case _:
                raise BadFile(f"its header has a wrong line: {line.decode('latin-1').strip()[:80]!r}")
    else:
        raise BadFile("its header has no end")
    if form is None:
        raise BadFile("its header does not say whether it is ascii or binary")
    for element in elements:
        if element.name == "vertex" and not {"x", "y", "z"} <= element.properties.keys():
            raise BadFile(f"its vertices have no x, y and z, but {', '.join(element.properties) or 'nothing'}")
        if element.count and not element.properties:
            raise BadFile(f"its header promises {element.count:,} of '{element.name}', without saying of what")
    _check_length(file, form, elements)
    return elements


def _check_length(file: BinaryIO, form: str, elements: list[_Element]) -> None:
    start = file.tell()
    held = size_of(file) - start
    promise = " and ".join(f"{element.count:,} of '{element.name}'" for element in elements) or "nothing"
    if form == "ascii":
        expected = (element for element in elements for _ in range(element.count))
        rows = 0
        for line in filter(bytes.strip, file):
            rows += 1
            element = next(expected, None)
            if element is not None and not _is_row(line.split(), element):
                row = line[:60].decode("latin-1").strip()
                raise BadFile(f"line {rows} after its header does not hold the properties of '{element.name}': {row!r}")
        promised = sum(element.count for element in elements)
        if rows != promised:
            why = "truncated" if rows < promised else "damaged"
            raise BadFile(f"{why}; its header promises {promise}, a line each, it holds {rows:,} lines")
    else:
        least = sum(element.count * size for element in elements for size, _ in element.properties.values())
        if held < least:
            raise BadFile(f"truncated; its header promises {promise}, so {least:,} bytes or more, it holds {held:,}")


def _is_row(words: list[bytes], element: _Element) -> bool:
    """Whether a line has as many numbers as the properties need, and the lists in it say."""
    used = 0
    for _, is_list in element.properties.values():
        if used >= len(words):
            return False
        if is_list:
            if not words[used].isdigit():
                return False
            used += int(words[used])
        used += 1
    return used == len(words)


def _check_corners(faces: object) -> None:
    """A `BadFile` where a binary file's faces differ in their number of corners: trimesh takes that of the first."""
    if isinstance(faces, np.ndarray) and faces.dtype.names:
        for name in faces.dtype.names:
            counts = faces[name]["f0"] if faces.dtype[name].names else faces[name][:0]
            if len(counts) and counts.min() != counts.max():
                raise BadFile(f"its faces have {counts.min()} to {counts.max()} corners; only equal numbers are read")
