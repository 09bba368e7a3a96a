"""What is refused of a user's cloud, in words that name the argument."""

import os
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike


class _HasPoints(Protocol):
    @property
    def points(self) -> Any: ...


class _HasVertices(Protocol):
    @property
    def vertices(self) -> Any: ...


class _HasTensors(Protocol):
    @property
    def point(self) -> Any: ...


CloudLike = ArrayLike | _HasPoints | _HasVertices | _HasTensors
"""What users pass as a cloud: (N, 3) numbers, or another library's cloud (``as_array`` says which)."""


def check_cloud(points: ArrayLike, mask: ArrayLike | None, name: str) -> None:
    """Nothing, if ``points`` and ``mask`` make a usable cloud; values are looked at only where they are concrete.

    Args:
      points: (N, 3) numbers.
      mask: (N,) or None.
      name: how the caller calls this argument; it opens every message.

    Raises:
      ValueError: wrong rank or last dimension, no points, a dtype that is no real number, integers too large for
        float32, NaN or infinite values, a mask of another length, or fewer than three distinct real points.
    """
    points = as_array(points, name)
    shape, dtype = points.shape, points.dtype
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(f"{name}: expected shape (N, 3), got {shape}")
    if shape[0] == 0:
        raise ValueError(f"{name}: the cloud is empty, shape {shape}")
    if not (jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)):
        raise ValueError(f"{name}: expected real numbers, got dtype {dtype}")
    if mask is not None and np.shape(mask) != shape[:1]:
        raise ValueError(f"{name}_mask: expected shape {shape[:1]} to match {name}, got {np.shape(mask)}")
    if mask is not None:
        kind = as_array(mask, f"{name}_mask").dtype
        if kind.kind != "b":
            raise ValueError(f"{name}_mask: expected booleans, True for real points, got dtype {kind}")
    if isinstance(points, Tracer) or isinstance(mask, Tracer):
        return
    values = np.asarray(points)
    real = np.ones(shape[0], bool) if mask is None else np.asarray(mask, bool)
    values = values[real]
    if jnp.issubdtype(dtype, jnp.integer):
        too_large = int(np.sum(np.abs(values.astype(np.float64)) > 2**24))
        if too_large:
            raise ValueError(
                f"{name}: {too_large} integers of dtype {dtype} lie beyond ±2**24, where float32 no longer tells "
                "neighbours apart; subtract an origin or pass float64"
            )
    bad = int(np.sum(~np.isfinite(values)))
    if bad:
        nans = int(np.sum(np.isnan(values)))
        raise ValueError(f"{name}: {bad} values are not finite ({nans} NaN, {bad - nans} infinite), shape {shape}")
    if not _has_three_distinct(values):
        distinct = len(np.unique(values, axis=0))
        raise ValueError(f"{name}: a pose needs at least 3 distinct points, got {distinct} among {len(values)}")


def as_array(points: CloudLike, name: str) -> Array | np.ndarray:
    """The array itself, traced or not; the points of another library's cloud; else what NumPy makes of the argument.

    A cloud of another library is known by its attributes, and nothing is imported: ``points`` (Open3D's point cloud,
    pyvista's data sets, ``urrt_jax.io.PointCloud``), ``point.positions`` (Open3D's tensor cloud) or ``vertices``
    (trimesh, and Open3D's meshes).

    Args:
      points: an array, nested lists, or such an object.
      name: how the caller calls this argument.

    Raises:
      ValueError: rows of different lengths, a masked array, or a file name.
    """
    if isinstance(points, np.ma.MaskedArray):
        raise ValueError(f"{name}: got a masked array; pass its data, and which rows are real as a mask")
    if isinstance(points, jax.Array | np.ndarray):
        return points
    if isinstance(points, str | os.PathLike):
        raise ValueError(f"{name}: expected an (N, 3) array, got a file name; urrt_jax.io.read_cloud reads files")
    held: Any = points
    if hasattr(held, "point"):
        held = held.point.positions.numpy()
    elif hasattr(held, "points") and not hasattr(held, "mask"):  # the points of our Cloud are not all real
        held = held.points
    elif hasattr(held, "vertices"):
        held = held.vertices
    if isinstance(held, jax.Array):
        return held
    try:
        return np.asarray(held)
    except ValueError as error:
        raise ValueError(f"{name}: expected an (N, 3) array, got a ragged {type(points).__name__}") from error


def _has_three_distinct(values: np.ndarray) -> bool:
    """Whether three rows differ, without sorting the cloud."""
    if len(values) == 0:
        return False
    others = values[np.any(values != values[0], axis=1)]
    return bool(len(others) and np.any(np.any(others != others[0], axis=1)))
