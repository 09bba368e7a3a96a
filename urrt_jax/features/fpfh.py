"""Fast point feature histograms: how the normals about a point lie to each other, whatever the pose."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.clouds import Cloud

BINS = 11


def fpfh(cloud: Cloud, normals: Array, radius: Array | float, *, batch_size: int = 64) -> Array:
    """One unit feature (N, 33) a point: three histograms of angles between its normal and its neighbours'.

    Rusu et al. 2009: the simplified histograms of all points within ``radius``, and the mean of theirs, weighted by the
    inverse distance. Bins are shared linearly, so that small noise changes features little. Turning and moving the
    cloud with its normals changes nothing. Zeros for padding and for points without neighbours.

    Args:
      cloud: N points.
      normals: (N, 3) unit normals.
      radius: of the neighbourhood.
      batch_size: points handled at once, which bounds memory by batch_size · N · 33.
    """

    def squared_distances(point: Array) -> tuple[Array, Array, Array]:
        offset = cloud.points - point
        squared = jnp.sum(offset**2, axis=-1)
        return offset, squared, cloud.mask & (squared < radius**2) & (squared > 0)

    def simple(point: Array, normal: Array) -> Array:
        offset, squared, near = squared_distances(point)
        towards = offset / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[:, None]
        across = jnp.cross(towards, normal)
        across /= jnp.maximum(jnp.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        third = jnp.cross(normal, across)
        tilt = jnp.arctan2(jnp.sum(third * normals, axis=-1), normals @ normal) / jnp.pi
        shares = _shares(jnp.sum(across * normals, axis=-1)), _shares(towards @ normal), _shares(tilt, around=True)
        return jnp.concatenate([near @ each for each in shares]) / jnp.maximum(jnp.sum(near), 1)

    def weighted(point: Array) -> Array:
        _, squared, near = squared_distances(point)
        weight = jnp.where(near, jax.lax.rsqrt(jnp.maximum(squared / radius**2, 1e-12)), 0.0)
        return (weight / jnp.maximum(jnp.sum(weight), 1e-12)) @ histograms

    batch_size = min(batch_size, cloud.points.shape[0])
    histograms = jax.lax.map(lambda each: simple(*each), (cloud.points, normals), batch_size=batch_size)
    features = histograms + jax.lax.map(weighted, cloud.points, batch_size=batch_size)
    length = jnp.linalg.norm(features, axis=-1, keepdims=True)
    return jnp.where(cloud.mask[:, None] & (length > 0), features / jnp.maximum(length, 1e-9), 0.0)


def _shares(values: Array, *, around: bool = False) -> Array:
    """What each of N values in [-1, 1] gives to each bin, (N, BINS); rows sum to 1. ``around``: -1 and 1 are one."""
    place = (values + 1) / 2 * BINS - 0.5
    apart = jnp.abs((place if around else jnp.clip(place, 0.0, BINS - 1.0))[:, None] - jnp.arange(BINS))
    if around:
        apart = jnp.minimum(apart, BINS - apart)
    return jnp.maximum(1 - apart, 0.0)
