"""A point cloud as files hold it: points, and normals and colours where there are some."""

from typing import NamedTuple

import numpy as np

from urrt_jax.io.files import BadFile

MAX_POINTS = 100_000_000
"""The most points that are read from a file: 2.4 GB of coordinates. The bound stops a false header; it is a guess."""


class PointCloud(NamedTuple):
    """The content of a file without faces, or points drawn on a mesh."""

    points: np.ndarray
    """(N, 3), float32 or float64, in the file's own units and frame."""
    normals: np.ndarray | None = None
    """(N, 3), float32 or float64, as stored: not necessarily of length 1. None where the file has none."""
    colors: np.ndarray | None = None
    """(N, 3) uint8 red, green and blue. None where the file has none."""


def as_points(values: np.ndarray, what: str) -> np.ndarray:
    """Points (N, 3) as float32 or float64, whichever holds the stored numbers; a `BadFile` where they are no points."""
    if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "iuf":
        raise BadFile(f"{what} must be numbers of shape (N, 3), got {values.dtype} {values.shape}")
    return values.astype(np.float32 if values.dtype in (np.float16, np.float32) else np.float64)


def as_normals(values: np.ndarray | None, count: int) -> np.ndarray | None:
    """Normals (count, 3) as float32 or float64; None where some are not finite, so that they can't be used."""
    if values is None or values.shape != (count, 3) or values.dtype.kind != "f" or not np.isfinite(values).all():
        return None
    return values.astype(np.float32 if values.dtype in (np.float16, np.float32) else np.float64)


def as_colors(values: np.ndarray | None, count: int) -> np.ndarray | None:
    """Colours (count, 3) as uint8, from any usual scale: 0 to 255, fractions of 1, or 16 bits; None for others."""
    if values is None or values.shape != (count, 3) or values.dtype.kind not in "iuf" or count == 0:
        return None
    if values.dtype == np.uint8:
        return values
    if not np.isfinite(values).all() or values.min() < 0:
        return None
    most, whole = values.max(), values.dtype.kind in "iu" or not (values % 1).any()
    if whole and most < 2**8:
        return values.astype(np.uint8)
    if most <= 1:
        return np.rint(values * 255).astype(np.uint8)
    if whole and most < 2**16:
        return (values // 256).astype(np.uint8)
    return None


def check_count(points: int) -> None:
    """A `BadFile` where a header promises more than `MAX_POINTS` points."""
    if points > MAX_POINTS:
        raise BadFile(f"its header promises {points:,} points, more than the {MAX_POINTS:,} that are read")
