"""One step of refinement: the small motion that brings pairs together, and small motions themselves."""

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array

from urrt_jax.geometry import rigid
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.refine.pairs import Pairs

_HIGHEST = jax.lax.Precision.HIGHEST
_DAMPING = 1e-6  # of the matrix's mean diagonal: motions that no pair speaks for are not made
_LEAST_DAMPING = 1e-30  # where there is no pair at all: what is divided by it stays finite
_LONGEST = 0.3  # radians and radii, one step


def normal_equations(pairs: Pairs, weights: Array, plane: float) -> tuple[Array, Array]:
    """The matrix A (6, 6) and the gradient b (6,) of the weighted squared residuals for a small motion of the source.

    Residuals are the distances along the normals (Chen and Medioni 1991), which count ``plane``, and those between the
    points, which count the rest. A motion is (translation, rotation vector) in the target's frame about its origin; the
    Gauss-Newton step is −A⁻¹ b.

    Args:
      pairs: P pairs.
      weights: (P,), zero for pairs that are none.
      plane: from 0 to 1.
    """
    apart = jnp.where(weights[:, None] > 0, pairs.source - pairs.target, 0.0)
    middle = (pairs.source + pairs.target) / 2  # a normal turns with the point that it belongs to: on average, half
    directions = [(plane, pairs.normals)] if plane else []
    if plane < 1:
        directions += [(1 - plane, jnp.broadcast_to(axis, apart.shape)) for axis in jnp.eye(3, dtype=apart.dtype)]
    matrix, gradient = jnp.zeros((6, 6), apart.dtype), jnp.zeros(6, apart.dtype)
    for share, direction in directions:
        lever = jnp.concatenate([direction, jnp.cross(middle, direction)], axis=-1)
        weighted = (share * weights)[:, None] * lever
        matrix += jnp.matmul(weighted.T, lever, precision=_HIGHEST)
        gradient += jnp.matmul(weighted.T, jnp.sum(direction * apart, axis=-1), precision=_HIGHEST)
    return matrix, gradient


def damped_solve(matrix: Array, vector: Array) -> Array:
    """The solution (D,) of a linear system whose matrix (D, D) may be singular, as degenerate clouds make it."""
    damping = _DAMPING * jnp.mean(jnp.abs(jnp.diagonal(matrix))) + _LEAST_DAMPING
    return jnp.linalg.solve(matrix + damping * jnp.eye(len(vector), dtype=matrix.dtype), vector)


def bounded_step(matrix: Array, gradient: Array) -> Array:
    """The Gauss-Newton step (6,), shortened where it is longer than linearisation bears; 0 where it is not finite."""
    motion = -damped_solve(matrix, gradient)
    motion = jnp.where(jnp.all(jnp.isfinite(motion)), motion, 0.0)
    return motion * jnp.minimum(1.0, _LONGEST / jnp.maximum(jnp.linalg.norm(motion), 1e-9))


def move(motion: Array, transform: Rigid) -> Rigid:
    """The transform followed by a motion (6,): translation and rotation vector, by SE(3)'s exponential map."""
    moved = jaxlie.SE3.exp(motion)
    moved = Rigid(moved.rotation().as_matrix(), moved.translation())
    # jaxlie answers in double precision wherever that is on.
    return rigid.compose(jax.tree.map(lambda leaf: leaf.astype(motion.dtype), moved), transform)
