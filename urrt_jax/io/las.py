"""LAS and LAZ: the header is checked here, the content is read and written by laspy."""

from __future__ import annotations

import io
import math
from typing import BinaryIO

import numpy as np

from urrt_jax.io.cloud import PointCloud, as_colors, check_count
from urrt_jax.io.files import MAX_RATIO, BadFile, size_of

_COMPRESSED = 0x80  # this bit of the point format marks LAZ


def read_las(file: BinaryIO) -> PointCloud:
    """The points in float64, with scale and offset applied, and their colours where there are some."""
    import laspy

    count = _check_header(file)
    if count == 0:
        return PointCloud(np.empty((0, 3)))
    file.seek(0)
    try:
        # Not the extended records, which may be as many as a false header says and are no use here.
        reader = laspy.LasReader(file, closefd=False, read_evlrs=False)
        found = reader.read_points(count)
    except BaseException as error:
        # A panic of the decompressor, which is written in Rust, is not an Exception.
        if type(error).__name__ != "PanicException":
            raise
        raise BadFile("its compressed points are damaged") from error
    if len(found) != count:
        raise BadFile(f"truncated; its header promises {count} points, it holds {len(found)}")
    points = np.stack([np.asarray(found[axis], np.float64) for axis in ("x", "y", "z")], axis=1)
    colors = None
    if {"red", "green", "blue"} <= set(reader.header.point_format.dimension_names):
        colors = as_colors(np.stack([np.asarray(found[name]) for name in ("red", "green", "blue")], axis=1), count)
    return PointCloud(points, colors=colors)


def write_las(cloud: PointCloud) -> bytes:
    """The bytes of a LAS file, with coordinates rounded to the finest power of ten that 32 bits hold for its extent."""
    return _write(cloud, compressed=False)


def write_laz(cloud: PointCloud) -> bytes:
    """The bytes of a LAZ file, with coordinates as in a LAS file."""
    return _write(cloud, compressed=True)


def _write(cloud: PointCloud, *, compressed: bool) -> bytes:
    import laspy

    points = cloud.points.astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    offset = low / 2 + high / 2
    extent = np.abs(points - offset).max(axis=0)
    if not np.isfinite(extent).all():
        raise BadFile("the points to write are too far apart for .las")
    scale = np.array([10.0 ** math.ceil(math.log10(max(reach, 1e-290) / (2**31 - 1))) for reach in extent])
    # Point format 2 has colours, 0 has not; both are of the first LAS version that every program reads.
    header = laspy.LasHeader(point_format=0 if cloud.colors is None else 2, version="1.2")
    header.offsets, header.scales = offset, scale
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = np.rint((points - offset) / scale).astype(np.int32).T
    if cloud.colors is not None:
        las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * 257  # all of 16 bits, as the format asks
    buffer = io.BytesIO()
    las.write(buffer, do_compress=compressed)
    return buffer.getvalue()


def _check_header(file: BinaryIO) -> int:
    """The number of points that the header promises, once the rest of the file is long enough to hold them."""
    header, size = file.read(375), size_of(file)

    def field(start: int, length: int) -> int:
        return int.from_bytes(header[start : start + length], "little")

    if header[:4] != b"LASF" or len(header) < 227:
        raise BadFile("damaged, or not a LAS file: it does not begin with LASF and a whole header")
    minor, header_size, start, records = field(25, 1), field(94, 2), field(96, 4), field(100, 4)
    compressed, point_size = bool(field(104, 1) & _COMPRESSED), field(105, 2)
    points = field(247, 8) if minor >= 4 else field(107, 4)
    if header_size + 54 * records > start or start > size:
        raise BadFile(f"truncated or damaged; its header puts the points at byte {start:,} of {size:,}")
    if point_size < 20:
        raise BadFile(f"its header promises points of {point_size} bytes; the format's smallest have 20")
    check_count(points)
    held = size - start
    if compressed:
        _check_chunks(file, start, size, points)
        if points * point_size > max(2**24, MAX_RATIO * held):
            raise BadFile(f"its header promises {points:,} points, more than its {held:,} bytes can hold")
    elif points * point_size > held:
        raise BadFile(f"truncated; its header promises {points} points, it holds {held // point_size}")
    return points


def _check_chunks(file: BinaryIO, start: int, size: int, points: int) -> None:
    """A `BadFile` where the table of compressed chunks is not in the file, or longer than it can be."""
    file.seek(start)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # written to a stream; then the place is at the file's end
        file.seek(size - 8)
        table = int.from_bytes(file.read(8), "little", signed=True)
    if not start + 8 <= table <= size - 8:
        raise BadFile(f"truncated; it says that its table of chunks is at byte {table:,} of {size:,}")
    file.seek(table + 4)
    chunks = int.from_bytes(file.read(4), "little")
    if 20 * chunks > size or chunks > points:  # each begins with one whole point
        raise BadFile(f"damaged; it says that it has {chunks:,} chunks of points")
