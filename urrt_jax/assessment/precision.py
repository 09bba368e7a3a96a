"""How precisely two aligned clouds determine the pose: its information and its covariance.

Both are matrices (6, 6) of small motions of the source in the target's frame: translation, then rotation vector, about
the origin of the target's points.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, take, thinned_rows
from urrt_jax.neighbors import nearest
from urrt_jax.prepared import Prepared, thinned_spacing
from urrt_jax.refine.pairs import robust_weights
from urrt_jax.rigid import Rigid

_HIGHEST = jax.lax.Precision.HIGHEST
_POINTS = 512  # points of each cloud whose residuals are looked at
_TWICE = 2.0  # most correspondences are found from both ends, which makes them no more certain
_RIDGE, _LEAST = 1e-3, 1e-20  # of the matrix's mean diagonal, and at least: what no pair speaks for is not singular


class Precision(NamedTuple):
    """How precisely the residuals say that the pose is determined.

    Attributes:
      covariance: (6, 6), in squared radii and radians; it differentiates.
      uncorrected: (), the standard deviation of the rotation, in radians, where the noise of normals is not corrected.
      pairs: (), the sum of the weights of all correspondences.
      spread: (), the mean squared distance between corresponding points, in squared spacings.
    """

    covariance: Array
    uncorrected: Array
    pairs: Array
    spread: Array

    @property
    def deviation(self) -> Array:
        """The standard deviation of the rotation, (), in radians."""
        return _turning(self.covariance)


def _turning(covariance: Array) -> Array:
    return jnp.sqrt(jnp.maximum(jnp.trace(covariance[3:, 3:]), 0.0))


class _Pairs(NamedTuple):
    """P correspondences in the target's frame: of points of both clouds with the nearest point of the other one.

    Attributes:
      middle: (P, 3), half way between the two points.
      apart: (P, 3), from one to the other.
      squared: (P,), their squared distance; inf for a row that is none.
      normals: (P, 3), at one end.
      others: (P, 3), at the other end, of a sign that agrees.
    """

    middle: Array
    apart: Array
    squared: Array
    normals: Array
    others: Array


def precision(source: Prepared, target: Prepared, transform: Rigid) -> Precision:
    """The precision of a pose, from correspondences in both directions; differentiable at fixed neighbours.

    The sandwich H⁻¹ B H⁻¹ of an M-estimator (Huber 1967) of distances along normals: H is what small motions change, B
    the scatter of what each correspondence pulls. Noise of a normal would add to H, as if it held the clouds, but the
    noise at both ends of a pair is independent: H is made of products of the two, to which it adds nothing on average.

    Args:
      source: N points, in units of the clouds' radius.
      target: N points.
      transform: source to target.
    """
    pairs = _correspondences(source, target, transform)
    width = jnp.maximum(*(thinned_spacing(each.count, each.spacing, _POINTS) for each in (source, target)))
    weights = robust_weights(pairs.squared, jax.lax.stop_gradient(width))
    apart = jnp.where(weights[:, None] > 0, pairs.apart, 0.0)
    lever, other = (jnp.concatenate([n, rigid.cross(pairs.middle, n)], axis=1) for n in (pairs.normals, pairs.others))
    weighted = weights[:, None] * lever
    products = jnp.einsum("pi,kpj->kij", weighted, jnp.stack([other, lever]), precision=_HIGHEST)
    stiffness = (products + products.swapaxes(1, 2)) / 2
    ridge = _RIDGE * jnp.mean(jnp.abs(jnp.diagonal(stiffness, axis1=1, axis2=2)), axis=1) + _LEAST
    softness = jnp.linalg.inv(stiffness + ridge[:, None, None] * jnp.eye(6, dtype=ridge.dtype))
    pulls = weighted * jnp.sum(pairs.normals * apart, axis=1, keepdims=True)
    halves = jnp.matmul(pulls, softness, precision=_HIGHEST)
    # All queries were used, and their number makes the pose as much more precise.
    used = jnp.sum(jnp.isfinite(pairs.squared)) / jnp.maximum(
        jnp.sum(source.queries.mask) + jnp.sum(target.queries.mask), 1
    )
    covariances = _TWICE * used * jnp.matmul(halves.swapaxes(1, 2), halves, precision=_HIGHEST)
    total = jnp.sum(weights)
    distances = jnp.where(weights > 0, pairs.squared, 0.0)
    spread = jnp.sum(weights * distances) / jnp.maximum(total, 1e-9) / width**2
    return Precision(covariances[0], _turning(covariances[1]), total / jnp.maximum(used, _LEAST), spread)


def _correspondences(source: Prepared, target: Prepared, transform: Rigid) -> _Pairs:
    """The correspondences of at most ``_POINTS`` points of each cloud."""
    (ours, our_normals), (theirs, their_normals) = _even_queries(source), _even_queries(target)
    ours = ours._replace(points=rigid.apply(transform, ours.points))
    normals = jnp.stack([rigid.rotate(transform.rotation, our_normals), their_normals])
    clouds = jax.tree.map(lambda *leaves: jnp.stack(leaves), ours, theirs)
    others = jax.tree.map(lambda leaf: leaf[::-1], clouds)
    # A loop over the two directions: the search is compiled once.
    rows, squared = jax.lax.map(lambda side: nearest(*side), (clouds.points, others))
    points = jnp.take_along_axis(others.points, rows[..., None], axis=1)
    facing = jnp.take_along_axis(normals[::-1], rows[..., None], axis=1)
    facing = jnp.where(jnp.sum(normals * facing, axis=-1, keepdims=True) < 0, -facing, facing)
    pairs = _Pairs(
        middle=(clouds.points + points) / 2,
        apart=clouds.points - points,
        squared=jnp.where(clouds.mask, squared, jnp.inf),
        normals=normals,
        others=facing,
    )
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), pairs)


def _even_queries(cloud: Prepared) -> tuple[Cloud, Array]:
    """At most ``_POINTS`` of the cloud's queries, evenly along the curve, and their normals."""
    if len(cloud.normals) <= _POINTS:
        return cloud.queries, cloud.normals
    rows = thinned_rows(jnp.sum(cloud.queries.mask), _POINTS)
    return take(cloud.queries, rows), cloud.normals[rows]


def information(points: Array, inlier: Array) -> Array:
    """The information matrix (6, 6) of a pose from corresponding points (N, 3) of the target, those of ``inlier`` (N,).

    Σ GᵀG with G = [I, −[q]×] (Choi, Zhou and Koltun 2015, section 4; Open3D's has both blocks swapped): how much the
    sum of squared distances grows with a small motion (translation, rotation vector) about the origin of the points.
    """
    points = jnp.where(inlier[:, None], points, 0.0)
    count = jnp.sum(inlier).astype(points.dtype)
    total = jnp.sum(points, axis=0)
    second = jnp.matmul(points.T, points, precision=_HIGHEST)
    turning = jnp.trace(second) * jnp.eye(3) - second
    return jnp.block([[count * jnp.eye(3), -cross_matrix(total)], [cross_matrix(total), turning]])


def moved_information(matrix: Array, offset: Array | np.ndarray) -> Any:
    """The information matrix (6, 6) when the target's points move by ``offset`` (3,); NumPy float64 where that is."""
    arrays = np if isinstance(offset, np.ndarray) and not isinstance(matrix, Tracer) else jnp
    shift = arrays.block([[arrays.eye(3), -cross_matrix(offset)], [arrays.zeros((3, 3)), arrays.eye(3)]])
    return _product(_product(shift.T, arrays.asarray(matrix, shift.dtype)), shift)


def moved_covariance(matrix: Array, offset: Array | np.ndarray) -> Any:
    """The covariance (6, 6) when the target's points move by ``offset`` (3,); NumPy float64 where that is."""
    arrays = np if isinstance(offset, np.ndarray) and not isinstance(matrix, Tracer) else jnp
    shift = arrays.block([[arrays.eye(3), cross_matrix(offset)], [arrays.zeros((3, 3)), arrays.eye(3)]])
    return _product(_product(shift, arrays.asarray(matrix, shift.dtype)), shift.T)


def _product(first: Any, second: Any) -> Any:
    """The product of two matrices, at full precision."""
    return first @ second if isinstance(first, np.ndarray) else jnp.matmul(first, second, precision=_HIGHEST)


def cross_matrix(vector: Array | np.ndarray) -> Any:
    """The matrix (3, 3) of the cross product with ``vector`` (3,) from the left."""
    arrays = np if isinstance(vector, np.ndarray) else jnp
    x, y, z = vector
    return arrays.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
