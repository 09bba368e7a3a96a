"""How well two aligned clouds fit: inliers, overlap, the information they hold about the pose, and how sure it is."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, first, thin
from urrt_jax.clouds.normals import least_axis
from urrt_jax.neighbors import Blocks, Neighbors, coarser_spacing, nearest
from urrt_jax.prepared import Prepared, coarser
from urrt_jax.rigid import Rigid, cross, nearest_rotation

_HIGHEST = jax.lax.Precision.HIGHEST
_RINGS = (1.0, 1.5, 3.0)  # spacings of the coarser cloud: close, touching (samples of one surface do), and about
_CLOSE, _TOUCHING, _ABOUT = range(3)
_BEYOND = 1.001  # neighbours are looked for a little farther than the farthest distance that counts
_TURNED, _TURNED_QUERIES = 512, 128  # points of a cloud that is turned, and those of them that look for a neighbour
_AT_ONCE = 16  # poses that are compared at once
_QUARTER = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
_TURNS = np.array([np.linalg.matrix_power(np.roll(_QUARTER, (k, k), (0, 1)), n) for k in range(3) for n in (1, 2, 3)])
ASSESSED = {"overlap": 3.0, "tightness": 4.0, "closeness": 4.2, "uniqueness": 8.3}
"""What confidence is made of, and the weights: a logistic regression on training shapes.

``experiments/confidence`` fits it again and measures these on test shapes and scans."""
BIAS = -9.5
_SURFACES = np.array([ASSESSED[name] for name in ("overlap", "tightness", "closeness")], np.float32)


class Fit(NamedTuple):
    """How a moved source lies on its target.

    Attributes:
      nearest: (N,) int32, the row of the target point nearest to every source point, where there is one.
      squared: (N,), the squared distance to it; inf for padding, and where none is near.
      touching: (), the distance within which points touch: 1.5 spacings of the coarser cloud.
      shares: (2, 3), of the source's points and of the target's: how many lie within 1, 1.5 and 3 spacings.
      uniqueness: (), from -1 to 1: how much better both clouds agree than after the best of some further turns.
    """

    nearest: Array
    squared: Array
    touching: Array
    shares: Array
    uniqueness: Array

    @property
    def overlap(self) -> Array:
        """(2,), the share of the source's points that touch the target, and of the target's that touch the source."""
        return self.shares[:, _TOUCHING]

    @property
    def evidence(self) -> Array:
        """(4,), in the order of ``ASSESSED``: what tells surfaces that lie on each other from surfaces that cross.

        The larger overlap; the share of touching points among those that come near; the share of close points among
        those that touch; the uniqueness.
        """
        close, touching, about = jnp.sum(self.shares, axis=0)
        tightness, closeness = touching / jnp.maximum(about, 1e-3), close / jnp.maximum(touching, 1e-3)
        return jnp.stack([jnp.max(self.overlap), tightness, closeness, self.uniqueness])

    @property
    def score(self) -> Array:
        """(), in [0, 1]: the evidence that surfaces lie on each other, weighed as the confidence does; 1 at best."""
        return self.evidence[:3] @ _SURFACES / _SURFACES.sum()

    @property
    def surfaces(self) -> Array:
        """(), the logit of the confidence less what the uniqueness adds: how well the surfaces lie on each other."""
        return BIAS + _SURFACES.sum() * self.score

    @property
    def confidence(self) -> Array:
        """(), from 0 to 1: how sure it is that surfaces lie on each other rather than cross, and in this pose alone."""
        return jax.nn.sigmoid(self.surfaces + ASSESSED["uniqueness"] * self.uniqueness)


def fit(source: Prepared, target: Prepared, transform: Rigid, reach: Array | float = 0.0) -> Fit:
    """The fit of the source, moved by ``transform``, on the target; no derivative passes.

    Args:
      source: N points.
      target: N points, padded as far as the source; its thinned cloud looks for neighbours in the source.
      transform: source to target.
      reach: (), neighbours of source points are looked for within 3 spacings of the coarser cloud, or within this.
    """
    source, target, transform = jax.lax.stop_gradient((source, target, transform))
    width = coarser(source, target)
    reaches = jnp.stack([jax.lax.stop_gradient(jnp.asarray(reach, width.dtype)), jnp.zeros_like(width)])
    queries = source.cloud, first(target.samples.thinned, source.cloud.mask.shape[0])
    found, shares = _look(
        (source.cloud, target.cloud), queries, transform, width, reaches, source.blocks, target.blocks
    )
    clouds, asked = (
        tuple(thin(each.cloud, count, ordered=True) for each in (source, target))
        for count in (_TURNED, _TURNED_QUERIES)
    )
    far = jnp.where(source.cloud.mask, found.squared[0], jnp.inf)
    uniqueness = _uniqueness(clouds, asked, transform, coarser_spacing(*clouds))
    return Fit(found.index[0], far, _RINGS[_TOUCHING] * width, shares, uniqueness)


def fit_samples(source: Cloud, target: Cloud, transform: Rigid, width: Array) -> Fit:
    """The fit of even samples (``subsample``), which is quick; no derivative passes.

    Args:
      source: N points.
      target: N points.
      transform: source to target.
      width: (), the spacing of the coarser sample.
    """
    source, target, transform, width = jax.lax.stop_gradient((source, target, transform, width))
    clouds = source, target
    found, shares = _look(clouds, clouds, transform, width, jnp.zeros(2, width.dtype))
    # The first points of a farthest-point sample are an even sample, too.
    asked = first(source, _TURNED_QUERIES), first(target, _TURNED_QUERIES)
    far = jnp.where(source.mask, found.squared[0], jnp.inf)
    uniqueness = _uniqueness(clouds, asked, transform, width)
    return Fit(found.index[0], far, _RINGS[_TOUCHING] * width, shares, uniqueness)


def _look(
    clouds: tuple[Cloud, Cloud],
    queries: tuple[Cloud, Cloud],
    transform: Rigid,
    width: Array,
    reaches: Array,
    *blocks: Blocks | None,
) -> tuple[Neighbors, Array]:
    """The neighbours of either cloud's queries in the other cloud (2, Q), and the share within each ring, (2, 3)."""
    rings = width * jnp.array(_RINGS, width.dtype)
    within = _BEYOND * jnp.maximum(rings[_ABOUT], reaches)
    points = rigid.apply(transform, queries[0].points), rigid.apply(rigid.inverse(transform), queries[1].points)
    ours, theirs = ((cloud, block) for cloud, block in zip(clouds, blocks or (None, None), strict=True))
    masks = jnp.stack([each.mask for each in queries])

    def look(side: tuple) -> Neighbors:
        points, (cloud, block), within, count = side
        return nearest(points, cloud, blocks=block, within=within, ordered=True, count=count)

    # A loop over the two directions: the search is compiled once.
    sides = (
        jnp.stack(points),
        jax.tree.map(lambda *leaves: jnp.stack(leaves), theirs, ours),
        within,
        jnp.sum(masks, axis=1),
    )
    found = jax.lax.map(look, sides)
    near = masks[..., None] & (found.squared[..., None] <= rings**2)
    return found, jnp.sum(near, axis=1) / jnp.maximum(jnp.sum(masks, axis=1), 1)[:, None]


def _uniqueness(clouds: tuple[Cloud, ...], asked: tuple[Cloud, ...], transform: Rigid, width: Array) -> Array:
    """By how much the agreement after ``transform`` exceeds that after further turns, (), from -1 to 1.

    A shape is mistaken for itself turned by a half or a quarter about an axis of symmetry, exact or nearly so, which is
    a principal axis. Tried are the nine such turns about the principal axes of both clouds together, through their
    centre.
    """
    moved = clouds[0]._replace(points=rigid.apply(transform, clouds[0].points))
    together = Cloud(*(jnp.concatenate(both) for both in zip(moved, clouds[1], strict=True)))
    share = together.mask / jnp.maximum(jnp.sum(together.mask), 1)
    centre = jnp.matmul(share, together.points, precision=_HIGHEST)
    centred = jnp.where(together.mask[:, None], together.points - centre, 0.0)
    axes = _principal_axes(jnp.matmul(centred.T, centred, precision=_HIGHEST))

    turned = jnp.matmul(axes, jnp.matmul(_TURNS, axes.T, precision=_HIGHEST), precision=_HIGHEST)
    rotations = jnp.concatenate([jnp.eye(3)[None], turned])
    turns = Rigid(rotations, centre - rigid.rotate(rotations, centre))
    poses = jax.vmap(lambda turn: rigid.compose(turn, transform))(turns)
    agreements = agreement(poses, clouds, asked, width)
    return agreements[0] - jnp.max(agreements[1:])


def _principal_axes(moment: Array) -> Array:
    """Principal axes of a symmetric matrix (3, 3), the columns of a rotation; any where it has none."""
    least, greatest = jax.vmap(least_axis)(jnp.stack([moment, jnp.trace(moment) * jnp.eye(3) - moment]))
    return nearest_rotation(jnp.stack([greatest, cross(least, greatest), least], axis=1))


def agreement(poses: Rigid, clouds: tuple[Cloud, ...], asked: tuple[Cloud, ...], reach: Array) -> Array:
    """How well two clouds lie on each other in each of H poses, (H,): the mean of max(0, 1 − d²/r²), in [0, 1].

    The mean is over the queries of both directions. Poses are compared a few at a time, which bounds memory.

    Args:
      poses: source to target, rotation (H, 3, 3) and translation (H, 3).
      clouds: source and target, of N rows each.
      asked: queries, Q points of each cloud, whose distances d to the other cloud count.
      reach: r, ().
    """
    count = poses.rotation.shape[0]
    few = min(_AT_ONCE, count)
    # Whole chunks only: what is left over would be compiled a second time.
    filled = jax.tree.map(lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], -count % few, axis=0)]), poses)
    chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, few, *leaf.shape[1:]), filled)
    sides = jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)
    masks = jnp.stack([each.mask for each in asked])

    def compare(some: Rigid) -> Array:
        moved = jax.vmap(rigid.apply, (0, None))(some, asked[0].points)
        back = jax.vmap(rigid.apply, (0, None))(jax.vmap(rigid.inverse)(some), asked[1].points)
        placed = jnp.stack([moved, back]).reshape(2, -1, 3)

        def look(side: Array) -> Array:
            other = jax.tree.map(lambda leaf: leaf[1 - side], sides)
            return nearest(placed[side], other).squared

        squared = jax.lax.map(look, jnp.arange(2)).reshape(2, few, -1)
        close = jnp.where(jnp.isfinite(squared), jnp.maximum(1 - squared / reach**2, 0.0), 0.0)
        totals = jnp.sum(jnp.where(masks[:, None], close, 0.0), axis=2)
        return jnp.mean(totals / jnp.maximum(jnp.sum(masks, axis=1), 1)[:, None], axis=0)

    return jax.lax.map(compare, chunks).reshape(-1)[:count]


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
