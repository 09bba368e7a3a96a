"""Smaller clouds for larger ones: farthest-point samples, and clouds thinned along a space-filling curve."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds.cloud import Cloud, centroid, first, take
from urrt_jax.clouds.curve import curve_order

_CANDIDATES = 8  # points of a thinned cloud from which each point of an even subsample is chosen


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
    _, farthest = first_largest(start)
    from_farthest = jnp.sum((points - points[farthest]) ** 2, axis=-1)
    distance = jnp.where(cloud.mask, from_farthest, -1.0)
    _, (index, new) = jax.lax.scan(pick, distance, None, length=count - 1)
    return jnp.concatenate([farthest[None], index]), jnp.concatenate([cloud.mask[farthest][None], new])


def subsample(cloud: Cloud, count: int) -> Cloud:
    """``count`` rows that cover the cloud evenly, farthest first (``farthest_points``); padding where it has fewer.

    Any first part of them covers the cloud evenly too. A cloud of more than 8·count points is thinned to as many first.
    """
    cloud = thin(cloud, _CANDIDATES * count)
    index, new = farthest_points(cloud, min(cloud.mask.shape[0], count))
    chosen = take(cloud, index)
    return first(Cloud(jnp.where(new[:, None], chosen.points, 0.0), new), count)


def thin(cloud: Cloud, count: int, *, ordered: bool = False) -> Cloud:
    """Every k-th real point along a space-filling curve: ``count`` points whose density follows the cloud's own.

    The choice does not depend on the order of the points (``curve_order``), nor on padding. A cloud of ``count`` rows
    or fewer is returned as it is.

    Args:
      cloud: N points.
      count: how many are kept, at most.
      ordered: whether the points already lie along the curve, padding last, as those of a prepared cloud do; if not,
        they are sorted.
    """
    if cloud.points.shape[0] <= count:
        return cloud
    rows = thinned_rows(jnp.sum(cloud.mask), count)
    return take(cloud, rows if ordered else curve_order(cloud.points, cloud.mask)[rows])


def thinned_rows(real: Array, count: int) -> Array:
    """The rows (count,) that ``thin`` keeps of a cloud along the curve with ``real`` () points, padding last."""
    # Integer strides while there are more real points than places; otherwise all of them, then padding. The remainder's
    # share is a quotient of floats, because slots · rest overflows; whole strides keep the places distinct.
    slots = jnp.arange(count)
    whole, rest = real // count, real % count
    strided = slots * whole + jnp.minimum(jnp.floor(slots * (rest / count)).astype(slots.dtype), rest)
    return jnp.where(real > count, strided, slots)
