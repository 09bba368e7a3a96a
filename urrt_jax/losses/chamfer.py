"""Chamfer distance between two clouds: masked, plain, trimmed or robust."""

from typing import Literal

import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.neighbors import nearest

Penalty = Literal["squared", "distance", "geman_mcclure"]


def chamfer(
    source: Cloud,
    target: Cloud,
    *,
    penalty: Penalty = "squared",
    scale: float = 0.1,
    trim: float = 0.0,
    block: int | None = 16,
) -> Array:
    """The mean penalty of every point's distance to the other cloud, averaged over both directions, ().

    Differentiable in both clouds at fixed nearest neighbours; zero for an empty cloud.

    Args:
      source: N points.
      target: M points, same frame and unit.
      penalty: "squared", d² (the usual Chamfer distance, in squared units); "distance",
        √(d² + (scale/100)²) − scale/100, which is d with a smooth tip; "geman_mcclure", d²/(d² + scale²), which
        saturates at 1 for points without a counterpart.
      scale: in the clouds' unit; see ``penalty``.
      trim: share of each cloud's points, those farthest from the other cloud, that is left out (0 ≤ trim < 1):
        for pairs that overlap only in part.
      block: see ``nearest``.

    Example:
      >>> import jax.numpy as jnp
      >>> from urrt_jax.clouds import make_cloud
      >>> corners = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
      >>> float(chamfer(make_cloud(corners), make_cloud(corners + jnp.array([0.0, 0.0, 2.0]))))
      4.0

    Raises:
      ValueError: an unknown penalty, a scale that is not positive, or a trim outside [0, 1).
    """
    if penalty not in ("squared", "distance", "geman_mcclure"):
        raise ValueError(f"penalty: expected 'squared', 'distance' or 'geman_mcclure', got {penalty!r}")
    if not scale > 0:
        raise ValueError(f"scale: expected a positive length, got {scale}")
    if not 0 <= trim < 1:
        raise ValueError(f"trim: expected a share in [0, 1), got {trim}")

    def one_way(query: Cloud, reference: Cloud) -> Array:
        squared = nearest(query.points, reference, block=block).squared
        kept = query.mask & jnp.isfinite(squared)
        if trim:
            kept &= _closest_share(jnp.where(kept, squared, jnp.inf), jnp.sum(kept), 1 - trim)
        values = _penalize(jnp.where(kept, squared, 0.0), penalty, scale)
        return jnp.sum(jnp.where(kept, values, 0.0)) / jnp.maximum(jnp.sum(kept), 1)

    return (one_way(source, target) + one_way(target, source)) / 2


def _closest_share(squared: Array, count: Array, share: float) -> Array:
    """Which of the ``count`` finite distances are among the smallest ``share`` of them (at least one)."""
    keep = jnp.maximum(jnp.ceil(share * count).astype(jnp.int32), 1)
    return squared <= jnp.sort(squared)[keep - 1]


def _penalize(squared: Array, penalty: Penalty, scale: float) -> Array:
    if penalty == "squared":
        return squared
    if penalty == "distance":
        tip = scale / 100
        return jnp.sqrt(squared + tip**2) - tip
    return squared / (squared + scale**2)
