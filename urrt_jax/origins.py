"""Clouds near an origin of their own: a far one, as map coordinates have, would cost float32 its digits."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from urrt_jax.geometry.rigid import Rigid

_LARGEST = 1e15
_UNEVEN = 1e-3  # what the entries of R Rᵀ may be off the identity's


def near_origin(points: ArrayLike, mask: ArrayLike | None, name: str) -> tuple[Array, np.ndarray | None]:
    """The points as float32 and the origin (3,) that was subtracted; only host arrays of more digits need one."""
    if isinstance(points, jax.Array) or getattr(points, "dtype", None) == np.float32:
        near = jnp.asarray(points)
        return near.astype(jnp.promote_types(near.dtype, jnp.float32)), None  # one program for all short dtypes
    values = np.asarray(points, np.float64)
    real = values if mask is None or isinstance(mask, Tracer) else values[np.asarray(mask, bool)]
    origin = real[np.all(np.isfinite(real), axis=-1)].mean(axis=0)
    centred = values - origin
    if not np.all(np.abs(centred[np.isfinite(centred)]) < _LARGEST):
        raise ValueError(f"{name}: coordinates beyond ±{_LARGEST:g} about their mean are too large for float32")
    return jnp.asarray(centred.astype(np.float32)), origin


def check_rigid(initial: ArrayLike) -> None:
    """Nothing, if ``initial`` is a rigid transform (4, 4); values are looked at only where they are concrete.

    Raises:
      ValueError: another shape, values that are not finite, or no rotation.
    """
    if np.shape(initial) != (4, 4):
        raise ValueError(f"initial: expected shape (4, 4), got {np.shape(initial)}")
    if isinstance(initial, Tracer):
        return
    values = np.asarray(initial, np.float64)
    turn, bottom = values[:3, :3], values[3]
    rigid_enough = np.all(np.abs(turn @ turn.T - np.eye(3)) < _UNEVEN) and np.linalg.det(turn) > 0
    if not (np.all(np.isfinite(values)) and rigid_enough and np.allclose(bottom, [0, 0, 0, 1])):
        raise ValueError(f"initial: expected a rotation and a translation above [0, 0, 0, 1], got {values.tolist()}")


def between_origins(initial: ArrayLike, source: np.ndarray | None, target: np.ndarray | None) -> Rigid:
    """A transform (4, 4) from source to target, as one between the clouds about these origins."""
    arrays = jnp if isinstance(initial, Tracer) else np
    values = arrays.asarray(initial, None if arrays is jnp else np.float64)
    origin_in, origin_out = (np.zeros(3) if origin is None else origin for origin in (source, target))
    shift = values[:3, 3] + values[:3, :3] @ origin_in - origin_out
    return Rigid(jnp.asarray(values[:3, :3], jnp.float32), jnp.asarray(shift, jnp.float32))
