"""The type of a cloud, points and mask, and what is done with all of its points at once.

Every function takes one cloud with a static shape; ``jax.vmap`` makes batches. Points whose mask is False are padding:
their values never reach a result.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from urrt_jax.clouds.checks import CloudLike, as_array

FARTHEST = 1e15
"""Larger coordinates are refused, or masked out under jit: their squares would not be float32 numbers."""


class Cloud(NamedTuple):
    """Points of one cloud and which of them are real.

    Attributes:
      points: (N, 3) float, any unit; rows whose mask is False hold zeros.
      mask: (N,) bool, True for real points.
    """

    points: Array
    mask: Array


def make_cloud(points: ArrayLike, mask: ArrayLike | None = None) -> Cloud:
    """The cloud of these points, with padding and unusable rows masked out and set to zero. Traceable.

    A row is unusable where a coordinate is not finite or lies beyond ±``FARTHEST``.

    Args:
      points: (N, 3).
      mask: (N,) bool; None means that every point is real.
    """
    points = jnp.asarray(points)
    if not jnp.issubdtype(points.dtype, jnp.floating):
        points = points.astype(jnp.float32)
    usable = jnp.all(jnp.abs(points) <= FARTHEST, axis=-1)  # False for NaN
    mask = usable if mask is None else jnp.asarray(mask, bool) & usable
    return Cloud(jnp.where(mask[:, None], points, 0.0), mask)


def pad_clouds(clouds: Sequence[CloudLike], *, size: int | None = None) -> tuple[Array, Array]:
    """One array for clouds of different sizes: points (B, size, 3) float32 and mask (B, size).

    Clouds at map coordinates lose digits here; subtract an origin from each first.

    Args:
      clouds: B clouds (N_i, 3), as for ``register``.
      size: the padded length; the longest cloud's when None.

    Example:
      >>> import numpy as np
      >>> points, mask = pad_clouds([np.ones((2, 3)), np.ones((5, 3))])
      >>> points.shape, mask.sum(axis=1).tolist()
      ((2, 5, 3), [2, 5])

    Raises:
      ValueError: no clouds, a cloud that is not (N, 3), or one longer than ``size``.
    """
    arrays = [np.asarray(as_array(cloud, f"clouds[{i}]"), np.float32) for i, cloud in enumerate(clouds)]
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


def take(cloud: Cloud, index: Array) -> Cloud:
    """The rows ``index`` (K,) of the cloud."""
    return Cloud(cloud.points[index], cloud.mask[index])


def first(cloud: Cloud, count: int) -> Cloud:
    """The first ``count`` rows of the cloud, filled up with padding where it has fewer."""
    missing = max(count - cloud.mask.shape[0], 0)
    head = Cloud(cloud.points[:count], cloud.mask[:count])
    return Cloud(jnp.pad(head.points, ((0, missing), (0, 0))), jnp.pad(head.mask, (0, missing)))
