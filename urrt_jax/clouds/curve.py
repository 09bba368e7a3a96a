"""A space-filling curve through a cloud: neighbours along it are neighbours in space."""

import jax
import jax.numpy as jnp
from jax import Array

_BITS = 10


def curve_order(points: Array, mask: Array) -> Array:
    """The rows (N,) in their order along a Hilbert curve, padding last.

    The curve is laid over the bounding box of the real points with 2^10 cells a side, so the order does not depend on
    that of the points, beyond those that share a cell. Unlike Morton's curve it never jumps: a run of points is compact
    (Hilbert 1891; the index from coordinates as in Skilling 2004, "Programming the Hilbert curve").

    Args:
      points: (N, 3).
      mask: (N,) bool.
    """
    points = jax.lax.stop_gradient(points)
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0)
    extent = jnp.maximum(jnp.max(high - low), jnp.finfo(points.dtype).tiny)
    last = 2**_BITS - 1
    cell = jnp.clip((points - low) / extent * last, 0, last).astype(jnp.uint32)
    return jnp.argsort(jnp.where(mask, _hilbert_index(cell), jnp.uint32(2**31)))


def _hilbert_index(cell: Array) -> Array:
    """The place (N,) uint32 along the curve of cells (N, 3) with ``_BITS`` bits a side."""
    axes = list(cell.T)
    # From the coarsest level down: undo how the curve of that octant is turned and mirrored.
    for level in reversed(range(1, _BITS)):
        bit, below = jnp.uint32(1 << level), jnp.uint32((1 << level) - 1)
        for k in range(3):
            upper = (axes[k] & bit) != 0
            swap = jnp.where(upper, 0, (axes[0] ^ axes[k]) & below)
            axes[0] = jnp.where(upper, axes[0] ^ below, axes[0] ^ swap)
            if k:
                axes[k] ^= swap
    # Then the Gray code of what is left.
    axes[1] ^= axes[0]
    axes[2] ^= axes[1]
    flip = jnp.zeros_like(axes[0])
    for level in reversed(range(1, _BITS)):
        flip ^= jnp.where((axes[2] >> level) & 1 != 0, jnp.uint32((1 << level) - 1), jnp.uint32(0))
    return sum(_spread_bits(axis ^ flip) << (2 - k) for k, axis in enumerate(axes))  # type: ignore[return-value]


def _spread_bits(value: Array) -> Array:
    """The ten low bits of ``value`` with two zeros between neighbours."""
    for shift_by, keep in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | (value << shift_by)) & jnp.uint32(keep)
    return value
