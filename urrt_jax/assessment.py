"""How well two aligned clouds fit: inliers, overlap, the information they hold about the pose, and how sure it is."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud
from urrt_jax.geometry.neighbors import coarser_spacing, nearest
from urrt_jax.geometry.normals import least_axis
from urrt_jax.geometry.prepared import Prepared, prepare
from urrt_jax.geometry.rigid import Rigid, nearest_rotation

_HIGHEST = jax.lax.Precision.HIGHEST
_RINGS = (1.0, 1.5, 3.0)  # spacings of the coarser cloud: close, touching (samples of one surface do), and about
_CLOSE, _TOUCHING, _ABOUT = range(3)
_BEYOND = 1.001  # times the farthest distance that counts: what lies just there is seen
_ASKED = 4096  # points of a large target
_TURNED, _TURNED_ASKED = 512, 128  # points of a cloud that is turned, and of those that ask
_QUARTER = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
_TURNS = np.array([np.linalg.matrix_power(np.roll(_QUARTER, (k, k), (0, 1)), n) for k in range(3) for n in (1, 2, 3)])
ASSESSED = {"overlap": 3.0, "tightness": 4.0, "closeness": 4.2, "uniqueness": 8.3}
"""What confidence is made of, and the weights: a logistic regression on training shapes.

``experiments/confidence`` fits it again and measures these on test shapes and scans."""
BIAS = -9.5


class Fit(NamedTuple):
    """How a moved source lies on its target.

    Attributes:
      squared: (N,), from every source point to the nearest target point; inf for padding, and where none is near.
      nearest: (N,) int32, that point's row, where there is one.
      touching: (), the distance within which points touch: 1.5 spacings of the coarser cloud.
      shares: (2, 3), of the source's points and of the target's: how many lie within 1, 1.5 and 3 spacings.
      uniqueness: (), from -1 to 1: how much more of both clouds agrees than after the best of some turns.
    """

    squared: Array
    nearest: Array
    touching: Array
    shares: Array
    uniqueness: Array

    @property
    def overlap(self) -> Array:
        """(2,), the share of the source's points that touch the target, and of the target's that touch the source."""
        return self.shares[:, _TOUCHING]

    @property
    def evidence(self) -> Array:
        """(4,), in the order of ``ASSESSED``: what surfaces do that lie on each other, and in no other way.

        The larger overlap; the share of the points that come near which touch; the share of those which are close; the
        uniqueness.
        """
        close, touching, about = jnp.sum(self.shares, axis=0)
        tightness, closeness = touching / jnp.maximum(about, 1e-3), close / jnp.maximum(touching, 1e-3)
        return jnp.stack([jnp.max(self.overlap), tightness, closeness, self.uniqueness])

    @property
    def confidence(self) -> Array:
        """(), from 0 to 1: how sure it is that surfaces lie on each other rather than cross, and in this pose alone."""
        return jax.nn.sigmoid(BIAS + self.evidence @ jnp.array(list(ASSESSED.values())))


def fit(source: Cloud | Prepared, target: Cloud | Prepared, transform: Rigid, reach: Array | float = 0.0) -> Fit:
    """The fit of the source, moved by ``transform``, on the target.

    Neighbours are looked for within 3 spacings of the coarser cloud, or within ``reach``, where that is more.
    """
    source, target = prepare(source), prepare(target)
    width = jax.lax.stop_gradient(jnp.maximum(source.spacing, target.spacing))
    mask = source.cloud.mask
    rings = width * jnp.array(_RINGS)
    within = _BEYOND * jnp.maximum(rings[_ABOUT], reach)
    moved = rigid.apply(transform, source.cloud.points)
    index, squared = nearest(moved, target.reference, within=within, order=source.order)
    some = target.thin(_ASKED)
    asked = rigid.apply(rigid.inverse(transform), some.points)
    back = nearest(asked, source.reference, within=_BEYOND * rings[_ABOUT]).squared
    shares = [
        jax.vmap(lambda ring, mask=mask, squared=squared: inlier_share(mask, squared, ring)[0])(rings)
        for mask, squared in ((mask, squared), (some.mask, back))
    ]
    far = jnp.where(mask, squared, jnp.inf)
    return Fit(far, index, _RINGS[_TOUCHING] * width, jnp.stack(shares), _uniqueness(source, target, transform))


def _uniqueness(source: Prepared, target: Prepared, transform: Rigid) -> Array:
    """By how much the agreement after ``transform`` exceeds that after further turns, (), from -1 to 1.

    Shapes are mistaken for themselves turned by a half or a quarter, about an axis of symmetry or nearly so, which is a
    principal one: the nine such turns about the principal axes of both clouds together, through their centre.
    """
    source, target, transform = jax.tree.map(jax.lax.stop_gradient, (source, target, transform))
    clouds = source.thin(_TURNED), target.thin(_TURNED)
    asked = source.thin(_TURNED_ASKED), target.thin(_TURNED_ASKED)
    moved = clouds[0]._replace(points=rigid.apply(transform, clouds[0].points))
    together = Cloud(*(jnp.concatenate(both) for both in zip(moved, clouds[1], strict=True)))
    share = together.mask / jnp.maximum(jnp.sum(together.mask), 1)
    centre = jnp.matmul(share, together.points, precision=_HIGHEST)
    centred = jnp.where(together.mask[:, None], together.points - centre, 0.0)
    axes = _principal_axes(jnp.matmul(centred.T, centred, precision=_HIGHEST))

    turned = jnp.matmul(axes, jnp.matmul(_TURNS, axes.T, precision=_HIGHEST), precision=_HIGHEST)
    rotations = jnp.concatenate([jnp.eye(3)[None], turned])
    turns = Rigid(rotations, centre - rigid.rotate(rotations, centre))
    reach = coarser_spacing(*clouds)
    agreements = jax.vmap(lambda turn: agreement(rigid.compose(turn, transform), clouds, asked, reach))(turns)
    return agreements[0] - jnp.max(agreements[1:])


def _principal_axes(moment: Array) -> Array:
    """Principal axes of a symmetric matrix (3, 3), the columns of a rotation; any where it has none."""
    least, greatest = least_axis(moment), least_axis(jnp.trace(moment) * jnp.eye(3) - moment)
    return nearest_rotation(jnp.stack([greatest, jnp.cross(least, greatest), least], axis=1))


def agreement(transform: Rigid, clouds: tuple[Cloud, Cloud], asked: tuple[Cloud, Cloud], reach: Array) -> Array:
    """How well two clouds lie on each other, (): the mean over both directions of max(0, 1 − d²/r²), in [0, 1].

    Args:
      transform: source to target.
      clouds: source and target.
      asked: some of their points, whose distances d to the other cloud are counted.
      reach: r, ().
    """

    def share(points: Array, mask: Array, other: Cloud) -> Array:
        squared = nearest(points, other).squared
        closeness = jnp.where(mask & jnp.isfinite(squared), jnp.maximum(1 - squared / reach**2, 0.0), 0.0)
        return jnp.sum(closeness) / jnp.maximum(jnp.sum(mask), 1)

    (source, target), (ask_source, ask_target) = clouds, asked
    forth = share(rigid.apply(transform, ask_source.points), ask_source.mask, target)
    back = share(rigid.apply(rigid.inverse(transform), ask_target.points), ask_target.mask, source)
    return (forth + back) / 2


def inlier_share(mask: Array, squared: Array, reach: Array) -> tuple[Array, Array]:
    """The share of real points whose squared distance (N,) is within ``reach``, and the rmse of those, in its unit."""
    inlier = mask & (squared <= reach**2)
    count = jnp.sum(inlier)
    mean = jnp.sum(jnp.where(inlier, squared, 0.0)) / jnp.maximum(count, 1)
    rmse = jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0)
    return count / jnp.maximum(jnp.sum(mask), 1), rmse


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
    return shift.T @ arrays.asarray(matrix, shift.dtype) @ shift


def cross_matrix(vector: Array | np.ndarray) -> Any:
    """The matrix (3, 3) of the cross product with ``vector`` (3,) from the left."""
    arrays = np if isinstance(vector, np.ndarray) else jnp
    x, y, z = vector
    return arrays.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def well_posed(cloud: Cloud) -> Array:
    """Whether a centred cloud determines a rotation, (): at least three points, not all on one line."""
    points = jax.lax.stop_gradient(cloud.points)
    # Rounding alone gives points on a line a second moment of about 1e-7 of the first.
    moments = jnp.matmul(points.T, points, precision=_HIGHEST)
    # On a line all but one eigenvalue vanish, and with them the sum of their products, the second invariant. (LAPACK's
    # batched eigenvalues of two clouds may wait for each other for ever on a CPU.)
    trace = jnp.trace(moments)
    products = (trace**2 - jnp.sum(moments**2)) / 2
    return (jnp.sum(cloud.mask) >= 3) & (products > 1e-6 * trace**2)
