"""Normals of clouds: masked local principal component analysis."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.clouds import Cloud

_SINGULAR = 1e-4  # what rounding leaves of a cross product of rows of size 1 that should vanish


def normals(points: Array, cloud: Cloud, radius: Array | float, centre: Array, *, batch_size: int = 256) -> Array:
    """Unit normals (N, 3) of the surface that ``cloud`` samples, at ``points`` (N, 3).

    The direction in which the cloud's points within ``radius`` vary least (Hoppe et al. 1992). Its sign is the one that
    points away from ``centre`` (3,), the cloud's centroid, say: scans and solids are oriented alike then, wherever they
    are not seen edge-on. Where fewer than three points are near, it is still a unit vector, of no meaning.

    Args:
      points: where.
      cloud: M points.
      radius: of the neighbourhood.
      centre: what normals point away from.
      batch_size: points handled at once, which bounds memory by batch_size · M.
    """

    def one(point: Array) -> Array:
        offset = cloud.points - point
        near = cloud.mask & (jnp.sum(offset**2, axis=-1) < radius**2)
        weight = near / jnp.maximum(jnp.sum(near), 1)
        centred = (offset - weight @ offset) / radius
        spread = jnp.matmul(centred.T * weight, centred, precision=jax.lax.Precision.HIGHEST)
        normal = least_axis(spread)
        return jnp.where(jnp.dot(normal, point - centre) < 0, -normal, normal)

    return jax.lax.map(one, points, batch_size=min(batch_size, points.shape[0]))


def least_axis(spread: Array) -> Array:
    """A unit eigenvector (3,) of the smallest eigenvalue of a symmetric matrix (3, 3) of any scale, in closed form.

    The eigenvalue by Smith's trigonometric formula (1961), the vector as the longest cross product of two rows of what
    then is singular. Where the two smallest eigenvalues agree, that vanishes, and any direction across the longest row
    will do; z for a multiple of the identity.
    """
    largest = jnp.max(jnp.abs(spread))
    spread = spread / jnp.where(largest > 0, largest, 1.0)
    mean = jnp.trace(spread) / 3
    rest = spread - mean * jnp.eye(3)
    size = jnp.sqrt(jnp.maximum(jnp.sum(rest**2) / 6, 1e-30))
    rest = rest / size
    angle = jnp.arccos(jnp.clip(jnp.linalg.det(rest) / 2, -1.0, 1.0)) / 3
    rows = rest - 2 * jnp.cos(angle + 2 * jnp.pi / 3) * jnp.eye(3)
    crosses = jnp.stack([jnp.cross(rows[0], rows[1]), jnp.cross(rows[1], rows[2]), jnp.cross(rows[2], rows[0])])
    longest = crosses[jnp.argmax(jnp.sum(crosses**2, axis=-1))]
    row = rows[jnp.argmax(jnp.sum(rows**2, axis=-1))]
    across = jnp.cross(row, jnp.eye(3)[jnp.argmin(jnp.abs(row))])
    vector = jnp.where(jnp.linalg.norm(longest) > _SINGULAR, longest, across)
    length = jnp.linalg.norm(vector)
    return jnp.where(length > _SINGULAR, vector / jnp.maximum(length, _SINGULAR), jnp.array([0.0, 0.0, 1.0]))
