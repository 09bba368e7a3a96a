"""Corresponding points of two clouds, looked for in both directions, and how much each pair counts."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry import rigid
from urrt_jax.geometry.blocks import Blocks
from urrt_jax.geometry.clouds import Cloud
from urrt_jax.geometry.neighbors import nearest
from urrt_jax.geometry.rigid import Rigid

_COINCIDING = 1e-12  # squared: where all pairs coincide, none is left out
_TRIM_POWER = 3  # of the overlap in the trimmed distance, for surfaces (Phillips et al. 2007, section 4)


class Surface(NamedTuple):
    """What refinement knows of a cloud.

    Attributes:
      asking: K of its points, which look for their neighbours.
      normals: (K, 3), the unit normals there.
      answering: all of its points, among which the other cloud's neighbours are found.
    """

    asking: Cloud
    normals: Array
    answering: Cloud | Blocks


class Pairs(NamedTuple):
    """Pairs of points, in the target's frame: first those that the source asked for, then the target's.

    Attributes:
      source: (P, 3), the source's points where the transform puts them.
      target: (P, 3).
      normals: (P, 3), at the one that asked.
      squared: (P,), the squared distance; inf for a pair that is none.
      rows: (P,) int32, of the one that was found in its cloud.
    """

    source: Array
    target: Array
    normals: Array
    squared: Array
    rows: Array


def find_pairs(source: Surface, target: Surface, transform: Rigid, within: Array | float, *, mutual: bool) -> Pairs:
    """The pairs closer than ``within`` when the source is moved by ``transform``."""
    moved = rigid.apply(transform, source.asking.points)
    forth = nearest(moved, target.answering, within=within)
    asked = rigid.apply(rigid.inverse(transform), target.asking.points)
    back = nearest(asked, source.answering, within=within)
    pairs = pair_up(source, target, transform, jnp.concatenate([forth.index, back.index]))
    squared = jnp.concatenate([forth.squared, back.squared])
    # Padding and pairs beyond the limit are none; mutual pairs are as near as the nearest to either end.
    usable = jnp.isfinite(squared) & jnp.concatenate([source.asking.mask, target.asking.mask])
    if mutual:
        usable &= _mutual(pairs, source, target, transform, within)
    return pairs._replace(squared=jnp.where(usable, pairs.squared, jnp.inf))


def pair_up(source: Surface, target: Surface, transform: Rigid, rows: Array) -> Pairs:
    """The pairs whose found ends are these rows (P,), differentiable in both clouds and the transform."""
    count = source.asking.points.shape[0]
    forth, back = rows[:count], rows[count:]
    moved = rigid.apply(transform, jnp.concatenate([source.asking.points, _points(source)[back]]))
    fixed = jnp.concatenate([_points(target)[forth], target.asking.points])
    normals = jnp.concatenate([rigid.rotate(transform.rotation, source.normals), target.normals])
    return Pairs(moved, fixed, normals, jnp.sum((moved - fixed) ** 2, axis=-1), rows)


def _points(surface: Surface) -> Array:
    answering = surface.answering
    return (answering.cloud if isinstance(answering, Blocks) else answering).points


def _mutual(pairs: Pairs, source: Surface, target: Surface, transform: Rigid, within: Array | float) -> Array:
    """Which pairs (P,) are such that the found end's own nearest asking point is the one that asked."""
    count = source.asking.points.shape[0]
    moved = source.asking._replace(points=rigid.apply(transform, source.asking.points))
    forth = nearest(pairs.target[:count], moved, within=within)
    back = nearest(pairs.source[count:], target.asking, within=within)
    # Points that coincide are as near as each other.
    return jnp.concatenate([forth.squared, back.squared]) >= pairs.squared * (1 - 1e-5)


def robust_weights(squared: Array, reach: Array) -> Array:
    """Geman and McClure's weights (1 + d²/r²)⁻² of squared distances (P,): a quarter at ``reach``, 0 at infinity."""
    return jnp.where(jnp.isfinite(squared), (1 + jnp.where(jnp.isfinite(squared), squared, 0.0) / reach**2) ** -2, 0.0)


def trimmed(squared: Array) -> Array:
    """Which pairs (P,) the overlap is estimated to hold: the nearest, as many as minimise the fractional distance.

    The root mean square of the nearest share f of distances, over f³ (Phillips, Liu and Tomasi 2007, eq. 2, squared
    here): leaving pairs out must pay.
    """
    order = jnp.argsort(squared)
    ordered = squared[order]
    finite = jnp.isfinite(ordered)
    number = jnp.arange(1, len(ordered) + 1)
    share = number / jnp.maximum(jnp.sum(finite), 1)
    mean = jnp.cumsum(jnp.where(finite, ordered, 0.0)) / number
    # Below a tenth there is always a handful of pairs that coincide.
    cost = jnp.where(finite & (share >= 0.1), (mean + _COINCIDING) / share ** (2 * _TRIM_POWER), jnp.inf)
    kept = jnp.arange(len(ordered)) <= jnp.argmin(cost)
    return jnp.zeros(len(ordered), bool).at[order].set(kept & finite)
