"""How well a moved source lies on its target: inliers, overlap, and a score."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, first
from urrt_jax.neighbors import Blocks, Neighbors, nearest
from urrt_jax.prepared import Prepared, coarser
from urrt_jax.rigid import Rigid

_HIGHEST = jax.lax.Precision.HIGHEST
_RINGS = (1.0, 1.5, 3.0)  # spacings of the coarser cloud: close, touching (samples of one surface do), and about
_, _TOUCHING, _ABOUT = range(3)
_BEYOND = 1.001  # neighbours are looked for a little farther than the farthest distance that counts
_AT_ONCE = 16  # poses that are compared at once
# Of overlap, tightness and closeness: a logistic regression on training shapes.
_WEIGHTS = np.array([3.0, 4.0, 4.2], np.float32) / 11.2


class Fit(NamedTuple):
    """How a moved source lies on its target.

    Attributes:
      nearest: (N,) int32, the row of the target point nearest to every source point, where there is one.
      squared: (N,), the squared distance to it; inf for padding, and where none is near.
      touching: (), the distance within which points touch: 1.5 spacings of the coarser cloud.
      shares: (2, 3), of the source's points and of the target's: how many lie within 1, 1.5 and 3 spacings.
    """

    nearest: Array
    squared: Array
    touching: Array
    shares: Array

    @property
    def overlap(self) -> Array:
        """(2,), the share of the source's points that touch the target, and of the target's that touch the source."""
        return self.shares[:, _TOUCHING]

    @property
    def score(self) -> Array:
        """(), in [0, 1]: how well the surfaces lie on each other (``score``)."""
        return score(self.shares)


def score(shares: Array) -> Array:
    """What tells surfaces that lie on each other from surfaces that cross, (), in [0, 1].

    A weighted mean of the larger overlap, of the share of touching points among those that come near, and of the share
    of close points among those that touch.

    Args:
      shares: (2, 3), as of a ``Fit``.
    """
    close, touching, about = jnp.sum(shares, axis=0)
    tightness, closeness = touching / jnp.maximum(about, 1e-3), close / jnp.maximum(touching, 1e-3)
    return jnp.stack([jnp.max(shares[:, _TOUCHING]), tightness, closeness]) @ _WEIGHTS


def shares_within(squared: Array, mask: Array, width: Array) -> Array:
    """The shares (3,) of the real points (N,) whose squared distance is within 1, 1.5 and 3 widths."""
    near = mask[:, None] & (squared[:, None] <= (width * jnp.array(_RINGS, width.dtype)) ** 2)
    return jnp.sum(near, axis=0) / jnp.maximum(jnp.sum(mask), 1)


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
    return _look((source.cloud, target.cloud), queries, transform, width, reaches, source.blocks, target.blocks)


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
    return _look(clouds, clouds, transform, width, jnp.zeros(2, width.dtype))


def _look(
    clouds: tuple[Cloud, Cloud],
    queries: tuple[Cloud, Cloud],
    transform: Rigid,
    width: Array,
    reaches: Array,
    *blocks: Blocks | None,
) -> Fit:
    """The fit that the queries of either cloud see, which look for neighbours in the other one within ``reaches``."""
    within = _BEYOND * jnp.maximum(_RINGS[_ABOUT] * width, reaches)
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
    shares = jax.vmap(shares_within, (0, 0, None))(found.squared, masks, width)
    far = jnp.where(masks[0], found.squared[0], jnp.inf)
    return Fit(found.index[0], far, _RINGS[_TOUCHING] * width, shares)


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
    masks = jnp.stack([each.mask for each in asked])

    def compare(some: Rigid) -> Array:
        squared = squared_distances(some, clouds, asked)
        close = jnp.where(jnp.isfinite(squared), jnp.maximum(1 - squared / reach**2, 0.0), 0.0)
        totals = jnp.sum(jnp.where(masks[:, None], close, 0.0), axis=2)
        return jnp.mean(totals / jnp.maximum(jnp.sum(masks, axis=1), 1)[:, None], axis=0)

    return jax.lax.map(compare, chunks).reshape(-1)[:count]


def squared_distances(poses: Rigid, clouds: tuple[Cloud, ...], asked: tuple[Cloud, ...]) -> Array:
    """The squared distance from every query to the other cloud in each of H poses, (2, H, Q); inf where that is empty.

    Arguments as for ``agreement``.
    """
    forth = jax.vmap(rigid.apply, (0, None))(poses, asked[0].points)
    back = jax.vmap(rigid.apply, (0, None))(jax.vmap(rigid.inverse)(poses), asked[1].points)
    others = jax.tree.map(lambda *leaves: jnp.stack(leaves), clouds[1], clouds[0])
    # A loop over the two directions: the search is compiled once.
    sides = jnp.stack([forth, back]).reshape(2, -1, 3), others
    return jax.lax.map(lambda side: nearest(*side).squared, sides).reshape(2, *forth.shape[:2])


def inlier_share(mask: Array, squared: Array, reach: Array) -> tuple[Array, Array]:
    """The share of real points whose squared distance (N,) is within ``reach``, and the rmse of those, in its unit."""
    inlier = mask & (squared <= reach**2)
    count = jnp.sum(inlier)
    mean = jnp.sum(jnp.where(inlier, squared, 0.0)) / jnp.maximum(count, 1)
    rmse = jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0)
    return count / jnp.maximum(jnp.sum(mask), 1), rmse


def well_posed(cloud: Cloud) -> Array:
    """Whether a centred cloud determines a rotation, (): at least three points, not all on one line."""
    points = jax.lax.stop_gradient(cloud.points)
    # Rounding alone gives points on a line a second moment of about 1e-7 of the first.
    moments = jnp.matmul(points.T, points, precision=_HIGHEST)
    trace, products = trace_and_products(moments)
    return (jnp.sum(cloud.mask) >= 3) & (products > 1e-6 * trace**2)


def trace_and_products(moments: Array) -> tuple[Array, Array]:
    """The sum of the eigenvalues of second moments (3, 3), and the sum of the products of two, the second invariant.

    On a line all but one eigenvalue vanish, and with them the products. (LAPACK's batched eigenvalues of two clouds may
    wait for each other for ever on a CPU.)
    """
    trace = jnp.trace(moments)
    return trace, (trace**2 - jnp.sum(moments**2)) / 2
