"""Rigid transforms: rotations from matrices and 6-vectors, Procrustes, angles. jaxlie carries the Lie groups.

Rotations act on columns from the left: ``target ≈ rotation @ source + translation``. Every product that touches a
rotation runs at ``Precision.HIGHEST``: TF32 would move points of a unit cube by 4e-4.
"""

from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax import Array

_HIGHEST = jax.lax.Precision.HIGHEST


class Rigid(NamedTuple):
    """A rotation (3, 3) and a translation (3,): x ↦ rotation @ x + translation."""

    rotation: Array
    translation: Array


class Known(NamedTuple):
    """A transform, and whether it is known, (), bool; where it is not, it means nothing."""

    transform: Rigid
    sure: Array


def identity() -> Rigid:
    """The transform that moves nothing."""
    return Rigid(jnp.eye(3), jnp.zeros(3))


def choose(flag: Array, transform: Rigid, otherwise: Rigid) -> Rigid:
    """The transform where the flag () is set, else the other one."""
    return jax.tree.map(lambda one, other: jnp.where(flag, one, other), transform, otherwise)


def rotate(rotation: Array, points: Array) -> Array:
    """The product rotation @ p for every row p of ``points`` (..., 3)."""
    return jnp.matmul(points, jnp.swapaxes(rotation, -1, -2), precision=_HIGHEST)


def cross(first: Array, second: Array) -> Array:
    """The cross product of the last axes (..., 3), written out: ``jnp.cross`` compiles to several times as much."""
    (a, b, c), (x, y, z) = (jnp.moveaxis(each, -1, 0) for each in (first, second))
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


def apply(transform: Rigid, points: Array) -> Array:
    """The moved points (..., 3)."""
    return rotate(transform.rotation, points) + transform.translation


def compose(outer: Rigid, inner: Rigid) -> Rigid:
    """The transform x ↦ outer(inner(x))."""
    rotation = jnp.matmul(outer.rotation, inner.rotation, precision=_HIGHEST)
    return Rigid(rotation, apply(outer, inner.translation))


def inverse(transform: Rigid) -> Rigid:
    """The transform that undoes this one.

    Example:
      >>> import jax.numpy as jnp
      >>> quarter = Rigid(jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), jnp.array([1.0, 0.0, 0.0]))
      >>> points = jnp.array([[1.0, 2.0, 3.0]])
      >>> apply(quarter, points).tolist()
      [[-1.0, 1.0, 3.0]]
      >>> apply(inverse(quarter), apply(quarter, points)).tolist()
      [[1.0, 2.0, 3.0]]
    """
    back = transform.rotation.T
    return Rigid(back, -rotate(back, transform.translation))


def matrix(transform: Rigid) -> Array:
    """The homogeneous matrix (..., 4, 4)."""
    top = jnp.concatenate([transform.rotation, transform.translation[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


def rotation_angle(first: Array, second: Array) -> Array:
    """The angle in radians between two rotations (..., 3, 3), in [0, π].

    2·asin(‖A − B‖_F / 2√2), exact near zero, where arccos of the trace has lost its digits; its derivative is taken as
    zero where the angle is zero or π. NaN for NaN.
    """
    square = jnp.sum((first - second) ** 2, axis=(-2, -1)) / 8
    inside = (square > 0) & (square < 1)
    sine = jnp.sqrt(jnp.where(inside, square, 0.25))
    end = jnp.where(square >= 1, jnp.pi, jnp.where(square == 0, 0.0, jnp.nan))
    return jnp.where(inside, 2 * jnp.arcsin(sine), end)


def distinct(
    poses: Rigid, worth: Array, *, count: int, apart: float, shift: Array | float | None = None
) -> tuple[Array, Array]:
    """The rows (count,) of the best of N poses, best first, and whether there is one, (count,).

    Args:
      poses: rotation (N, 3, 3) and translation (N, 3).
      worth: (N,); -inf for those that are not considered.
      count: how many are wanted.
      apart: degrees; none of them turns by less than this from one before it, unless it is farther off than ``shift``.
      shift: by default translations do not matter.
    """

    def same(one: Rigid) -> Array:
        turned = rotation_angle(one.rotation, poses.rotation) < jnp.deg2rad(apart)
        if shift is None:
            return turned
        return turned & (jnp.linalg.norm(one.translation - poses.translation, axis=-1) < shift)

    alike = jax.vmap(same)(poses)

    def pick(worth: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        best = jnp.argmax(worth)
        return jnp.where(alike[best], -jnp.inf, worth), (best, worth[best] > -jnp.inf)

    return jax.lax.scan(pick, worth, None, length=count)[1]


def normalize(vector: Array, fallback: Array) -> Array:
    """The vector (3,) over its length; ``fallback`` (3,), with a zero derivative, where its length is nearly zero."""
    square = jnp.sum(vector**2)
    usable = square > 1e-24
    return jnp.where(usable, vector / jnp.sqrt(jnp.where(usable, square, 1.0)), fallback)


def rotation_from_6d(columns: Array) -> Array:
    """The rotation (3, 3) whose first two columns are those of ``columns`` (6,) made orthonormal.

    Zhou et al. 2019, "On the continuity of rotation representations", eq. 15. Vanishing or parallel columns are
    replaced by coordinate axes, so the result is a rotation for every input.
    """
    axes = jnp.eye(3, dtype=columns.dtype)
    first = normalize(columns[:3], axes[0])
    second = normalize(columns[3:], first)
    # The coordinate axis least aligned with the first column can never be parallel to it.
    spare = axes[jnp.argmin(jnp.abs(jax.lax.stop_gradient(first)))]
    spare = normalize(spare - jnp.sum(spare * first) * first, axes[1])
    rest = second - jnp.sum(second * first) * first
    # Of nearly parallel unit columns only rounding is left, which is no direction.
    rest = jnp.where(jnp.sum(rest**2) > 1e-8, rest, spare)
    rest = rest - jnp.sum(rest * first) * first
    second = normalize(rest, spare)
    return jnp.stack([first, second, cross(first, second)], axis=1)


@jax.custom_jvp
def nearest_rotation(moment: Array) -> Array:
    """The rotation (3, 3) that maximises trace(Rᵀ moment): the polar factor of ``moment`` (3, 3) within SO(3).

    Its derivative is written out, because the SVD's own is infinite at equal singular values, which every symmetric
    shape has. With moment = U diag(s) Vᵀ, R = U diag(1, 1, d) Vᵀ and p = (s₁, s₂, d·s₃), the derivative is R V W Vᵀ
    with W_ij = [Vᵀ(Rᵀ dM − dMᵀ R)V]_ij / (p_i + p_j): only sums of singular values appear. Where such a sum vanishes
    (a collinear cloud) the rotation is not determined and that component is taken as zero.
    """
    return _polar(moment)[0]


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (moment,), (moment_dot,) = primals, tangents
    rotation, basis, stretch = _polar(moment)
    turned = jnp.matmul(rotation.T, moment_dot, precision=_HIGHEST)
    skew = jnp.matmul(basis.T, jnp.matmul(turned - turned.T, basis, precision=_HIGHEST), precision=_HIGHEST)
    sums = stretch[:, None] + stretch[None, :]
    usable = sums > 1e-6 * jnp.maximum(stretch[0], jnp.finfo(moment.dtype).tiny)
    spin = jnp.where(usable, skew / jnp.where(usable, sums, 1.0), 0.0)
    spin = jnp.matmul(basis, jnp.matmul(spin, basis.T, precision=_HIGHEST), precision=_HIGHEST)
    return rotation, jnp.matmul(rotation, spin, precision=_HIGHEST)


def _polar(moment: Array) -> tuple[Array, Array, Array]:
    """The rotation, the right singular vectors V and the signed stretches p of a 3×3 matrix; identity for NaN."""
    left, stretch, right = jnp.linalg.svd(_finite(moment))
    # Both factors are orthogonal, so the product of determinants is ±1; rounding it keeps the sign exact.
    sign = jnp.where(jnp.linalg.det(left) * jnp.linalg.det(right) < 0, -1.0, 1.0).astype(moment.dtype)
    signs = jnp.array([1.0, 1.0, 0.0], moment.dtype) + jnp.array([0.0, 0.0, 1.0], moment.dtype) * sign
    rotation = jnp.matmul(left * signs, right, precision=_HIGHEST)
    return rotation, right.T, stretch * signs


def _finite(moment: Array) -> Array:
    return jnp.where(jnp.all(jnp.isfinite(moment)), moment, jnp.eye(3, dtype=moment.dtype))


def quick_rotation(moment: Array) -> Array:
    """``nearest_rotation`` of a moment (3, 3), nearly, and several times faster under ``vmap``; without a derivative.

    The unit quaternion of the rotation is the first eigenvector of a symmetric matrix (Horn 1987, section 4), found by
    squaring that nine times. Components along eigenvectors whose values are nearly the first one's remain, so where the
    moment hardly decides between two rotations, it is one between them.
    """
    moment = _finite(jax.lax.stop_gradient(moment))
    moment = moment / jnp.maximum(jnp.max(jnp.abs(moment)), jnp.finfo(moment.dtype).tiny)
    moment = moment / jnp.maximum(jnp.sqrt(jnp.sum(moment**2)), 1e-6)
    trace, symmetric = jnp.trace(moment), moment + moment.T
    turn = jnp.stack([moment[2, 1] - moment[1, 2], moment[0, 2] - moment[2, 0], moment[1, 0] - moment[0, 1]])
    power = jnp.block([[trace, turn], [turn[:, None], symmetric - trace * jnp.eye(3, dtype=moment.dtype)]])
    # Eigenvalues are within √3 of zero: the first becomes the largest in size.
    power = power + 2 * jnp.eye(4, dtype=moment.dtype)

    def square(_: int, power: Array) -> Array:
        power = jnp.sum(power[:, :, None] * power[None], axis=1)
        return power / jnp.trace(power)

    power = jax.lax.fori_loop(0, 9, square, power)
    # Every column tends to a multiple of the eigenvector; the longest one is never zero.
    column = power[:, jnp.argmax(jnp.diagonal(power))]
    w, x, y, z = column / jnp.sqrt(jnp.sum(column**2))
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def procrustes(
    source: Array,
    target: Array,
    weights: Array,
    *,
    stiffness: float = 0.0,
    turn: Callable[[Array], Array] = nearest_rotation,
) -> Rigid:
    """The rigid transform that minimises Σ wᵢ ‖R sᵢ + t − tᵢ‖² (Kabsch 1976; Umeyama 1991 without scale).

    Args:
      source: (N, 3).
      target: (N, 3), row by row the counterparts of ``source``.
      weights: (N,) non-negative; zero leaves a pair out, and an all-zero vector gives the identity.
      stiffness: a small area that is added to the moment's diagonal: pairs that spread over less than it, in any
        direction, are not turned about the others.
      turn: what makes the rotation of the moment: ``nearest_rotation`` or ``quick_rotation``.
    """
    chex.assert_equal_shape([source, target])
    chex.assert_shape(weights, source.shape[:1])
    total = jnp.sum(weights)
    share = weights / jnp.where(total > 0, total, 1.0)
    source_mean = jnp.matmul(share, source, precision=_HIGHEST)
    target_mean = jnp.matmul(share, target, precision=_HIGHEST)
    moment = jnp.einsum("n,ni,nj->ij", share, target - target_mean, source - source_mean, precision=_HIGHEST)
    still = jnp.eye(3, dtype=moment.dtype)
    rotation = turn(jnp.where(total > 0, moment + stiffness * still, still))
    translation = jnp.where(total > 0, target_mean - rotate(rotation, source_mean), jnp.zeros_like(target_mean))
    return Rigid(rotation, translation)
