"""The solver of refinement: Gauss-Newton steps for a rigid motion, and the derivatives of where they end."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array

from urrt_jax import rigid
from urrt_jax.refine.pairs import Pairs
from urrt_jax.rigid import Rigid

_HIGHEST = jax.lax.Precision.HIGHEST
_DAMPING = 1e-6  # of the matrix's mean diagonal: motions that no pair speaks for are not made
_LEAST_DAMPING = 1e-30  # where there is no pair at all: what is divided by it stays finite
_LONGEST = 0.3  # radians and radii, one step


def normal_equations(pairs: Pairs, weights: Array, plane: Array | float) -> tuple[Array, Array]:
    """The matrix A (6, 6) and the gradient b (6,) of the weighted squared residuals for a small motion of the source.

    The residuals are distances along the normals (Chen and Medioni 1991) and distances between the points. A motion is
    (translation, rotation vector) in the target's frame about its origin; the Gauss-Newton step is −A⁻¹ b.

    Args:
      pairs: P correspondences.
      weights: (P,), zero for rows that are none.
      plane: (), the share of the distances along normals, in [0, 1].
    """
    apart = jnp.where(weights[:, None] > 0, pairs.source - pairs.target, 0.0)
    middle = (pairs.source + pairs.target) / 2  # a normal turns with the point that it belongs to: on average, half
    directions = [(plane * weights, pairs.normals, jnp.sum(pairs.normals * apart, axis=-1))]
    for k, axis in enumerate(jnp.eye(3, dtype=apart.dtype)):
        directions.append(((1 - plane) * weights, jnp.broadcast_to(axis, apart.shape), apart[:, k]))
    return accumulate([(weight, middle, direction, residual) for weight, direction, residual in directions])


def accumulate(terms: list[tuple[Array, Array, Array, Array]]) -> tuple[Array, Array]:
    """The matrix (6, 6) and the gradient (6,) of sums of weighted squared residuals, each along a direction at a place.

    Args:
      terms: of each kind of residual: weights (P,), places (P, 3), directions (P, 3) and residuals (P,).
    """
    dtype = terms[0][1].dtype
    matrix, gradient = jnp.zeros((6, 6), dtype), jnp.zeros(6, dtype)
    for weight, place, direction, residual in terms:
        lever = jnp.concatenate([direction, rigid.cross(place, direction)], axis=-1)
        matrix += jnp.matmul((weight[:, None] * lever).T, lever, precision=_HIGHEST)
        gradient += jnp.matmul(lever.T, weight * residual, precision=_HIGHEST)
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


def small_step(motion: Array, tolerance: Array | float) -> Array:
    """Whether a motion (6,) moves and turns by less than ``tolerance``, ()."""
    return (jnp.linalg.norm(motion[:3]) < tolerance) & (jnp.linalg.norm(motion[3:]) < tolerance)


def root_at_zero(imbalance: Callable[[Array], Array], size: int, like: Array) -> Array:
    """Zeros (size,), at which ``imbalance`` (size,) -> (size,) vanishes, with the derivatives of that root.

    An iteration has ended where the imbalance vanishes. How that place moves with what the imbalance depends on is all
    that derivatives need (implicit function theorem); none passes through the iteration.

    Args:
      imbalance: closes over what the derivatives are taken in.
      size: of the root.
      like: an array that depends on the pair: under ``vmap`` the root must be batched with it.
    """
    nothing = jnp.zeros(size, like.dtype) * jax.lax.stop_gradient(jnp.where(jnp.isfinite(like), 0.0, 0.0))
    return jax.lax.custom_root(
        imbalance,
        nothing,
        solve=lambda _, root: root,
        tangent_solve=lambda linear, value: damped_solve(jax.jacobian(linear)(value), value),
    )
