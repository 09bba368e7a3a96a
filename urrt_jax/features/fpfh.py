"""Fast point feature histograms: how the normals about a point lie to each other, whatever the pose."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud

BINS = 11

_BLOCK = 4  # neighbours a step of the loop


def fpfh(cloud: Cloud, normals: Array, radius: Array | float, *, batch_size: int = 128) -> Array:
    """One unit feature (N, 33) a point: three histograms of angles between its normal and its neighbours'.

    Rusu et al. 2009: the simplified histograms of all points within ``radius``, and the mean of theirs, weighted by the
    inverse distance. Bins are shared linearly, so that small noise changes features little; the angle between the
    normals in the plane across the line of sight is binned by a diamond's perimeter instead of a circle's, which needs
    no arc tangent. Turning and moving the cloud with its normals changes nothing. Zeros for padding and for points
    without neighbours.

    Args:
      cloud: N points.
      normals: (N, 3) unit normals.
      radius: of the neighbourhood.
      batch_size: points whose neighbours' histograms are averaged at once, which bounds memory by batch_size · N.
    """
    count = cloud.points.shape[0]
    # In radii, padding far away.
    points = jnp.where(cloud.mask[:, None], cloud.points / radius, 1e6)
    histograms = _simple(points, normals)

    def weighted(point: Array) -> Array:
        squared = jnp.sum((points - point) ** 2, axis=-1)
        weight = jnp.where((squared < 1) & (squared > 0), jax.lax.rsqrt(jnp.maximum(squared, 1e-12)), 0.0)
        return (weight / jnp.maximum(jnp.sum(weight), 1e-12)) @ histograms

    features = histograms + jax.lax.map(weighted, points, batch_size=min(batch_size, count))
    length = jnp.linalg.norm(features, axis=-1, keepdims=True)
    return jnp.where(cloud.mask[:, None] & (length > 0), features / jnp.maximum(length, 1e-9), 0.0)


def turned_around(features: Array) -> Array:
    """The features (N, 33) of the same points, all normals turned around: two of the three histograms are mirrored."""
    across, towards, turn = jnp.split(features, 3, axis=-1)
    return jnp.concatenate([across, towards[:, ::-1], turn[:, ::-1]], axis=-1)


def _simple(points: Array, normals: Array) -> Array:
    """The simplified histograms (N, 33): a loop over the neighbours, for all points at once."""
    count = points.shape[0]
    here, normal = points.T, normals.T
    others = jnp.pad(jnp.concatenate([points, normals], axis=1), ((0, -count % _BLOCK), (0, 0)), constant_values=1e6)

    def visit(sums: tuple[Array, ...], some: Array) -> tuple[tuple[Array, ...], None]:
        for neighbor in some:
            offset = neighbor[:3, None] - here
            squared = jnp.sum(offset**2, axis=0)
            near = ((squared < 1) & (squared > 0)).astype(points.dtype)
            towards = offset * jax.lax.rsqrt(jnp.maximum(squared, 1e-12))
            across = _cross(towards, normal)
            across *= jax.lax.rsqrt(jnp.maximum(jnp.sum(across**2, axis=0), 1e-18))
            third = _cross(normal, across)
            its_own = neighbor[3:, None]
            angles = (
                _shares(jnp.sum(across * its_own, axis=0)),
                _shares(jnp.sum(towards * normal, axis=0)),
                _shares(_turn(jnp.sum(third * its_own, axis=0), jnp.sum(normal * its_own, axis=0)), around=True),
            )
            sums = tuple(old + near * share for old, share in zip(sums, (*angles, 1.0), strict=True))
        return sums, None

    empty = jnp.zeros((BINS, count), points.dtype)
    blocks = others.reshape(-1, _BLOCK, 6)
    (*sums, number), _ = jax.lax.scan(visit, (empty, empty, empty, jnp.zeros(count, points.dtype)), blocks)
    return (jnp.concatenate(sums) / jnp.maximum(number, 1)).T


def _cross(first: Array, second: Array) -> Array:
    """The cross products (3, N) of columns; written out, because XLA fuses it then."""
    (a, b, c), (x, y, z) = first, second
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _turn(sine: Array, cosine: Array) -> Array:
    """The direction (sine, cosine) as a place on a diamond's perimeter, from −1 to 1 like an angle over π."""
    part = sine / jnp.maximum(jnp.abs(sine) + jnp.abs(cosine), 1e-12)
    return jnp.where(cosine >= 0, part / 2, jnp.where(sine < 0, -1.0, 1.0) - part / 2)


def _shares(values: Array, *, around: bool = False) -> Array:
    """What each of N values in [-1, 1] gives to each bin, (BINS, N); columns sum to 1. ``around``: -1 and 1 are one."""
    place = (values + 1) / 2 * BINS - 0.5
    apart = jnp.abs((place if around else jnp.clip(place, 0.0, BINS - 1.0)) - jnp.arange(BINS)[:, None])
    if around:
        apart = jnp.minimum(apart, BINS - apart)
    return jnp.maximum(1 - apart, 0.0)
