"""A cloud is (points, mask): checking, padding, normalising and subsampling it.

Every function here takes one cloud (or one pair) with static shapes; ``jax.vmap`` makes batches. Points whose mask is
False are padding: their values never reach a result.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from urrt_jax.geometry.curve import curve_order


class Cloud(NamedTuple):
    """Points of one cloud and which of them are real.

    Attributes:
      points: (N, 3) float, any unit; rows whose mask is False hold zeros.
      mask: (N,) bool, True for real points.
    """

    points: Array
    mask: Array


class Frame(NamedTuple):
    """What ``normalize_pair`` took out: both centres (3,) and the common scale (), in the input's units."""

    source_center: Array
    target_center: Array
    scale: Array


def make_cloud(points: ArrayLike, mask: ArrayLike | None = None) -> Cloud:
    """The cloud of these points, with padding and non-finite rows masked out and set to zero. Traceable.

    Args:
      points: (N, 3).
      mask: (N,) bool; None means that every point is real.
    """
    points = jnp.asarray(points)
    if not jnp.issubdtype(points.dtype, jnp.floating):
        points = points.astype(jnp.float32)
    finite = jnp.all(jnp.isfinite(points), axis=-1)
    mask = finite if mask is None else jnp.asarray(mask, bool) & finite
    return Cloud(jnp.where(mask[:, None], points, 0.0), mask)


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
    points = _as_array(points, name)
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
        kind = _as_array(mask, f"{name}_mask").dtype
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


def _as_array(points: ArrayLike, name: str) -> Array | np.ndarray:
    """The argument itself if it is an array, traced or not; else what NumPy makes of it."""
    if isinstance(points, jax.Array | np.ndarray):
        return points
    try:
        return np.asarray(points)
    except ValueError as error:
        raise ValueError(f"{name}: expected an (N, 3) array, got a ragged {type(points).__name__}") from error


def _has_three_distinct(values: np.ndarray) -> bool:
    """Whether three rows differ, without sorting the cloud."""
    if len(values) == 0:
        return False
    others = values[np.any(values != values[0], axis=1)]
    return bool(len(others) and np.any(np.any(others != others[0], axis=1)))


def pad_clouds(clouds: Sequence[ArrayLike], *, size: int | None = None) -> tuple[Array, Array]:
    """One array for clouds of different sizes: points (B, size, 3) float32 and mask (B, size).

    Clouds at map coordinates lose digits here; subtract an origin from each first.

    Args:
      clouds: B arrays (N_i, 3).
      size: the padded length; the longest cloud's when None.

    Raises:
      ValueError: no clouds, a cloud that is not (N, 3), or one longer than ``size``.
    """
    arrays = [np.asarray(_as_array(cloud, f"clouds[{i}]"), np.float32) for i, cloud in enumerate(clouds)]
    if not arrays:
        raise ValueError("clouds: expected at least one cloud, got an empty list")
    for i, array in enumerate(arrays):
        if array.ndim != 2 or array.shape[1] != 3:
            raise ValueError(f"clouds[{i}]: expected shape (N, 3), got {array.shape}")
    longest = max(len(array) for array in arrays)
    size = longest if size is None else size
    if longest > size:
        raise ValueError(f"size: a cloud of {longest} points does not fit into {size}")
    points = np.zeros((len(arrays), size, 3), np.float32)
    mask = np.zeros((len(arrays), size), bool)
    for i, array in enumerate(arrays):
        points[i, : len(array)] = array
        mask[i, : len(array)] = True
    return jnp.asarray(points), jnp.asarray(mask)


def centroid(cloud: Cloud) -> Array:
    """The mean of the real points, (3,); summed about one of them, so that a far origin costs no digits."""
    anchor = jax.lax.stop_gradient(cloud.points[jnp.argmax(cloud.mask)])
    offsets = jnp.where(cloud.mask[:, None], cloud.points - anchor, 0.0)
    return anchor + jnp.sum(offsets, axis=0) / jnp.maximum(jnp.sum(cloud.mask), 1)


def shift(cloud: Cloud, offset: Array, scale: Array | float = 1.0) -> Cloud:
    """The cloud (points − offset) / scale."""
    return cloud._replace(points=jnp.where(cloud.mask[:, None], (cloud.points - offset) / scale, 0.0))


def mean_square_radius(cloud: Cloud) -> Array:
    """The mean squared distance of the real points from the origin, ()."""
    return jnp.sum(cloud.points**2) / jnp.maximum(jnp.sum(cloud.mask), 1)


def normalize_pair(source: Cloud, target: Cloud) -> tuple[Cloud, Cloud, Frame]:
    """Both clouds about their own centroid and over one common scale, and the frame that undoes it.

    The scale is the root mean square of both clouds' radii: unlike the largest radius it is smooth and no single
    outlier sets it. A pair without extent keeps scale 1.
    """
    frame = Frame(centroid(source), centroid(target), jnp.ones(()))
    source, target = shift(source, frame.source_center), shift(target, frame.target_center)
    square = (mean_square_radius(source) + mean_square_radius(target)) / 2
    scale = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 1.0)
    return shift(source, jnp.zeros(3), scale), shift(target, jnp.zeros(3), scale), frame._replace(scale=scale)


def denormalize_translation(rotation: Array, translation: Array, frame: Frame) -> Array:
    """The translation (3,) in the input's units, given the one between normalised clouds; the rotation is the same."""
    turned = jnp.matmul(rotation, frame.source_center, precision=jax.lax.Precision.HIGHEST)
    return frame.target_center - turned + frame.scale * translation


def normalize_translation(rotation: Array, translation: Array, frame: Frame) -> Array:
    """The translation (3,) between normalised clouds, given the one in the input's units."""
    turned = jnp.matmul(rotation, frame.source_center, precision=jax.lax.Precision.HIGHEST)
    return (translation - frame.target_center + turned) / frame.scale


def take(cloud: Cloud, index: Array) -> Cloud:
    """The rows ``index`` (K,) of the cloud."""
    return Cloud(cloud.points[index], cloud.mask[index])


def farthest_points(cloud: Cloud, count: int) -> tuple[Array, Array]:
    """Indices (count,) of points that cover the cloud evenly, and which of them are new points, (count,) bool.

    Farthest-point sampling (Eldar et al. 1997), started at the point farthest from the centroid: it depends on the
    shape alone, so turning, moving, scaling or permuting the cloud picks the same points (up to exact ties), and both
    clouds of a pair are sampled alike. Repeated points are picked once; when the cloud has fewer than ``count``
    distinct points, the rest is flagged False.
    """
    points = jax.lax.stop_gradient(cloud.points)
    rows = jnp.arange(points.shape[0])

    def first_largest(distance: Array) -> tuple[Array, Array]:
        largest = jnp.max(distance)
        return largest, jnp.min(jnp.where(distance == largest, rows, points.shape[0] - 1))

    def pick(distance: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        largest, index = first_largest(distance)
        chosen = points[index]
        nearer = sum((points[:, k] - chosen[k]) ** 2 for k in range(3))
        return jnp.minimum(distance, nearer), (index, largest > 0)

    start = jnp.where(cloud.mask, jnp.sum((points - centroid(cloud)) ** 2, axis=-1), -1.0)
    _, first = first_largest(start)
    from_first = jnp.sum((points - points[first]) ** 2, axis=-1)
    distance = jnp.where(cloud.mask, from_first, -1.0)
    _, (index, new) = jax.lax.scan(pick, distance, None, length=count - 1)
    return jnp.concatenate([first[None], index]), jnp.concatenate([cloud.mask[first][None], new])


def subsample(cloud: Cloud, count: int, *, order: Array | None = None) -> Cloud:
    """At most ``count`` points that cover the cloud evenly, farthest first (``farthest_points``).

    Any first part of them covers the cloud evenly too. A cloud far larger than ``count`` is first thinned to 8·count
    points along a space-filling curve, whose ``order`` may be at hand.
    """
    size = cloud.points.shape[0]
    if size > 16 * count:
        cloud = thin(cloud, 8 * count, order=order)
    index, new = farthest_points(cloud, min(size, count))
    chosen = take(cloud, index)
    return Cloud(jnp.where(new[:, None], chosen.points, 0.0), new)


def thin(cloud: Cloud, count: int, *, order: Array | None = None) -> Cloud:
    """Every k-th real point along a space-filling curve: ``count`` points whose density follows the cloud's own.

    The choice does not depend on the order of the points (``curve_order``). Costs one sort, unless ``order`` is that
    curve's; a cloud of ``count`` points or fewer is returned as it is.
    """
    size = cloud.points.shape[0]
    if size <= count:
        return cloud
    order = curve_order(cloud.points, cloud.mask) if order is None else order
    real = jnp.sum(cloud.mask)
    # Integer strides while there are more real points than places; otherwise all of them, then padding. The remainder's
    # share is a quotient of floats, because slots · rest overflows; whole strides keep the places distinct.
    slots = jnp.arange(count)
    whole, rest = real // count, real % count
    strided = slots * whole + jnp.minimum(jnp.floor(slots * (rest / count)).astype(slots.dtype), rest)
    return take(cloud, order[jnp.where(real > count, strided, slots)])
