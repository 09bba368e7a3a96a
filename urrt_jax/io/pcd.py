"""PCD: its header is checked here, its content is read and written by pypcd4."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from urrt_jax.io.cloud import PointCloud, as_normals, as_points, check_count
from urrt_jax.io.files import BadFile, size_of

if TYPE_CHECKING:
    from pypcd4.pypcd4 import PointCloud as Pcd

_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_NORMALS = (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
_TYPES = {"F4", "F8"} | {kind + size for kind in "IU" for size in "1248"}
_MAX_LINE, _MAX_FIELDS = 4096, 1000  # no header comes near
_MAX_LZF = 100  # LZF packs at most 264 bytes into 3


def read_pcd(file: BinaryIO) -> PointCloud:
    """The points, with their normals and colours (packed as `rgb` or `rgba`) where there are some."""
    from pypcd4.pypcd4 import PointCloud as Pcd

    count = _check_header(file)
    if count == 0:
        return PointCloud(np.empty((0, 3)))
    file.seek(0)
    found = Pcd.from_fileobj(file)  # pyright: ignore[reportArgumentType]
    if found.pc_data.size != count:
        raise BadFile(f"truncated or damaged; its header promises {count} points, it holds {found.pc_data.size}")
    normals = next((found.numpy(names) for names in _NORMALS if set(names) <= set(found.fields)), None)
    points = as_points(found.numpy(("x", "y", "z")).reshape(-1, 3), "its points")
    return PointCloud(points, as_normals(normals, count), _colors(found))


def write_pcd(cloud: PointCloud) -> bytes:
    """The bytes of a binary PCD, in single precision where that loses less than a millionth of the cloud's extent.

    Open3D and PCL read coordinates of double precision as zeros or not at all, but in single precision a cloud in map
    coordinates would lose half a metre.
    """
    from pypcd4.pypcd4 import Encoding
    from pypcd4.pypcd4 import PointCloud as Pcd

    extent = np.ptp(cloud.points.astype(np.float64), axis=0).max()
    with np.errstate(over="ignore"):  # to infinity, which is a loss
        single = cloud.points.astype(np.float32)
    points = cloud.points if np.abs(single - cloud.points).max() > 1e-6 * extent else single
    columns, fields = [*points.T], ["x", "y", "z"]
    if cloud.normals is not None:
        columns += [*cloud.normals.astype(np.float32).T]
        fields += _NORMALS[0]
    if cloud.colors is not None:
        columns.append(Pcd.encode_rgb(cloud.colors))
        fields.append("rgb")
    buffer = io.BytesIO()
    Pcd.from_points(columns, fields, [column.dtype for column in columns]).save(buffer, Encoding.BINARY)
    return buffer.getvalue()


def _colors(found: Pcd) -> np.ndarray | None:
    for name in ("rgb", "rgba"):
        if name in found.fields:
            packed = np.ascontiguousarray(found.pc_data[name]).reshape(-1)
            if packed.dtype.itemsize == 4:
                return found.decode_rgb(packed)
    return None


def _check_header(file: BinaryIO) -> int:
    """The number of points that the header promises, once the rest of the file is long enough to hold them."""
    entries: dict[str, list[str]] = {}
    while "DATA" not in entries:
        line = file.readline(_MAX_LINE)
        if not line:
            raise BadFile("its header has no line DATA: truncated, or not a PCD file")
        words = line.split(b"#")[0].decode("latin-1").split()
        if not words:
            continue
        key = words[0].upper()
        if key not in _KEYS or key in entries or len(words) == 1:
            problem = "a second" if key in entries else "a wrong"
            raise BadFile(f"its header has {problem} line {line[:80].decode('latin-1').strip()!r}")
        entries[key] = words[1:]
    missing = [key for key in _KEYS if key not in entries and key not in ("VIEWPOINT", "HEIGHT")]
    if missing:
        raise BadFile(f"its header has no line {missing[0]}")
    if entries["VERSION"][0] not in ("0.7", ".7"):
        raise BadFile(f"of version {entries['VERSION'][0]}; only 0.7 is read")

    names = entries["FIELDS"]
    counts = [_number(word, "COUNT") for word in entries["COUNT"]]
    types = [kind + size for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=False)]
    if not len(names) == len(counts) == len(types) == len(entries["TYPE"]) == len(entries["SIZE"]):
        raise BadFile("its header names other numbers of FIELDS, SIZE, TYPE and COUNT")
    unknown = [kind for kind in types if kind not in _TYPES]
    if unknown:
        raise BadFile(f"its header has an unknown TYPE and SIZE, {unknown[0]}")
    if 0 in counts or sum(counts) > _MAX_FIELDS:
        raise BadFile(f"its header promises {sum(counts):,} numbers a point; 1 to {_MAX_FIELDS:,} are read")
    if any(names.count(axis) != 1 or counts[names.index(axis)] != 1 for axis in ("x", "y", "z")):
        raise BadFile(f"its points need one x, one y and one z, and have {' '.join(names)[:80]}")

    points = _number(entries["POINTS"][0], "POINTS")
    width, height = _number(entries["WIDTH"][0], "WIDTH"), _number(entries.get("HEIGHT", ["1"])[0], "HEIGHT")
    if points != width * height:
        raise BadFile(f"its header promises {points} POINTS, but WIDTH times HEIGHT, {width} times {height}")
    check_count(points)
    size = sum(int(kind[1]) * count for kind, count in zip(types, counts, strict=True))
    _check_length(file, entries["DATA"][0], points, size, sum(counts))
    return points


def _check_length(file: BinaryIO, encoding: str, points: int, size: int, columns: int) -> None:
    """A `BadFile` unless the rest of the file holds the points: `size` bytes each, or a line of `columns` numbers."""
    held = size_of(file) - file.tell()
    match encoding:
        case "ascii":
            rows = 0
            for line in file:
                rows += bool(line.strip())
                if line.strip() and len(line.split()) != columns:
                    raise BadFile(f"point {rows} has {len(line.split())} numbers, not the {columns} of its header")
            if rows != points:
                why = "truncated" if rows < points else "damaged"
                raise BadFile(f"{why}; its header promises {points} points, it holds {rows}")
        case "binary":
            if points * size > held:
                raise BadFile(
                    f"truncated; its header promises {points} points of {size} bytes, it holds {held // size} of them"
                )
        case "binary_compressed":
            packed, unpacked = (int.from_bytes(file.read(4), "little") for _ in range(2))
            if unpacked != points * size:
                raise BadFile(
                    f"its header promises {points * size:,} bytes of points, but {unpacked:,} compressed ones"
                )
            if packed > held - 8 or unpacked > _MAX_LZF * packed:
                raise BadFile(f"truncated or damaged; it holds {held:,} bytes for {unpacked:,} of points")
        case _:
            raise BadFile(f"its DATA is {encoding[:20]!r}, not ascii, binary or binary_compressed")


def _number(word: str, key: str) -> int:
    if not word.isdecimal() or len(word) > 12:
        raise BadFile(f"its header's {key} is {word[:40]!r}, not a whole number")
    return int(word)
