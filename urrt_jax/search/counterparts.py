"""The pose of two clouds that hold the same points: where surfaces slide, only these tell it."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.assessment.fit import trace_and_products
from urrt_jax.features import Constellations
from urrt_jax.rigid import Known
from urrt_jax.search.matches import Matches, poses_from_matches

_ALIKE = 0.01  # spacings by which distances of the same constellation may differ
_COINCIDE = 0.05  # spacings within which counterparts coincide
_SUPPORT = 8
_LEAST, _SHARE = 6, 0.5  # of the matches, that must agree with a pose


def match_constellations(source: Constellations, target: Constellations) -> Matches:
    """The constellation of the target, if it is just one, that is alike to just one of the source."""
    unit = jnp.minimum(source.spacing, target.spacing)
    apart = jnp.max(jnp.abs(source.distances[:, None] - target.distances), axis=-1)
    alike = (apart < _ALIKE * unit) & source.cloud.mask[:, None] & target.cloud.mask
    only = alike & (jnp.sum(alike, axis=1, keepdims=True) == 1) & (jnp.sum(alike, axis=0) == 1)
    return Matches(jnp.argmax(only, axis=1), jnp.any(only, axis=1))


def find_counterparts(source: Constellations, target: Constellations) -> Known:
    """The pose in which the constellations of two clouds coincide, known where enough do; no derivative passes.

    Args:
      source: K constellations of the source.
      target: K of the target.
    """
    unit = jnp.minimum(source.spacing, target.spacing)
    matches = match_constellations(source, target)
    support = min(_SUPPORT, len(matches.row))
    best = poses_from_matches(source.cloud, target.cloud, matches, _COINCIDE * unit, seeds=1, count=1, support=support)
    best = jax.tree.map(lambda leaf: leaf[0], best)
    offsets = rigid.apply(best, source.cloud.points) - target.cloud.points[matches.row]
    there = matches.mutual & (jnp.sum(offsets**2, axis=-1) < (_COINCIDE * unit) ** 2)
    count = jnp.sum(there)
    enough = (count >= _LEAST) & (count >= _SHARE * jnp.sum(matches.mutual))
    return Known(best, enough & _off_one_line(source.cloud.points, there, unit))


def _off_one_line(points: Array, chosen: Array, unit: Array) -> Array:
    """Whether the chosen ones of N points determine a rotation: they lie a spacing off any line, on average."""
    weights = chosen / jnp.maximum(jnp.sum(chosen), 1)
    offsets = points - weights @ points
    moments = jnp.einsum("n,ni,nj->ij", weights, offsets, offsets, precision="highest")
    trace, products = trace_and_products(moments)
    return products > trace * unit**2
