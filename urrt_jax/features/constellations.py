"""Constellations: points that are known again by the distances to their nearest neighbours.

Where two clouds hold the same points, as copies of one cloud, tracked markers or the vertices of one mesh do, a point
and its neighbours form the same figure in both, whatever the pose. No other two figures agree to within rounding, so
that a few constellations that agree settle the pose. Samples of one surface have no constellation in common.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud, first, take

_COUNT = 128
_NEIGHBORS = 4


class Constellations(NamedTuple):
    """Those K points of a cloud that lie nearest to another one; a cropped or turned cloud has the same ones.

    Attributes:
      cloud: the points.
      distances: (K, 4), to the nearest neighbours, nearest first; points that coincide count once.
      spacing: (), of the whole cloud.
    """

    cloud: Cloud
    distances: Array
    spacing: Array


def constellations(cloud: Cloud, squared: Array, spacing: Array) -> Constellations:
    """The constellations of a cloud; no derivative passes.

    Args:
      cloud: N points.
      squared: (N,), the squared distance from each point to the nearest other one; inf where there is none.
      spacing: (), of the cloud.
    """
    cloud, squared, spacing = jax.lax.stop_gradient((cloud, squared, spacing))
    closest = jnp.where(cloud.mask, squared, jnp.inf)
    _, rows = jax.lax.top_k(-closest, min(_COUNT, len(closest)))
    chosen = first(take(cloud, rows), _COUNT)
    to_all = sum((chosen.points[:, None, k] - cloud.points[None, :, k]) ** 2 for k in range(3))
    to_all = jnp.where(cloud.mask, to_all, jnp.inf)
    last, found = jnp.zeros_like(to_all[:, 0]), []
    for _ in range(_NEIGHBORS):
        last = jnp.min(jnp.where(to_all > last[:, None], to_all, jnp.inf), axis=1)
        found.append(last)
    mask = chosen.mask & jnp.isfinite(last)
    distances = jnp.sqrt(jnp.where(mask[:, None], jnp.stack(found, axis=1), 0.0))
    return Constellations(Cloud(jnp.where(mask[:, None], chosen.points, 0.0), mask), distances, spacing)
