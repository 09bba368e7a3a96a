"""EM-ICP: refinement in which every source point is matched to all target points, weighted by likelihood.

Where no point of one cloud has its counterpart in the other, the nearest point is a poor stand-in for it. Here each
point is a Gaussian spread along its surface, and a match counts by its probability (Granger and Pennec 2002; coherent
point drift: Myronenko and Song 2010). The normals are those of the surface that both clouds together sample, and the
standard deviations along and across it are estimated with the transform. Time and memory grow with the product of the
clouds' sizes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, centroid, first, normals
from urrt_jax.loops import where_needed, while_each
from urrt_jax.prepared import Prepared, coarser
from urrt_jax.refine.config import ICP
from urrt_jax.refine.icp import Settled
from urrt_jax.refine.solver import accumulate, bounded_step, move, root_at_zero, small_step
from urrt_jax.rigid import Rigid

_HIGHEST = jax.lax.Precision.HIGHEST
# Constants were chosen on training shapes.
_BACKGROUND = 0.03  # the weight of a uniform background: that of one point 2.6 standard deviations away
_BEGIN = (1.0, 0.45)  # standard deviations along and across the surface at the start, in spacings
_NARROWEST = 0.1  # the least standard deviation, in spacings
_NORMAL_RADIUS = 4.0  # spacings
_EAGER = 1.5  # steps are longer than Gauss-Newton's: weights follow the transform, and every step falls short by that
_STILL = 0.01  # the share by which standard deviations may still change when all has settled
_NOTHING = 1e-12  # weight; the square of its inverse is still a number
_TINY = 1e-18  # squared length


class Side(NamedTuple):
    """A cloud of N points in its own frame.

    Attributes:
      cloud: the points.
      normals: (N, 3), of the surface there.
    """

    cloud: Cloud
    normals: Array


class Match(NamedTuple):
    """The sums over all matches of two clouds.

    Attributes:
      matrix: (6, 6), of the Gauss-Newton step.
      gradient: (6,), of half the weighted squared residuals, for a small motion of the source.
      deviations: (2,), the standard deviations along and across the surface, as the matches have them.
      paired: (), how many points of the source found something.
    """

    matrix: Array
    gradient: Array
    deviations: Array
    paired: Array


class _Progress(NamedTuple):
    transform: Rigid
    deviations: Array
    settled: Array
    iteration: Array
    most: Array


def expect(refine: ICP, source: Prepared, target: Prepared, settled: Settled) -> Settled:
    """The end of EM-ICP, from where the fine stage ended, if that found the clouds sparse; if not, that end itself.

    Args:
      refine: how to refine.
      source: N points.
      target: M points.
      settled: with its transform both clouds together sample one surface.
    """
    clouds, unit = jax.lax.stop_gradient(_whole(refine, source, target))
    start, sparse = jax.lax.stop_gradient((settled.transform, settled.sparse))
    flat = jnp.zeros_like(clouds[0].points), jnp.zeros_like(clouds[1].points)
    facing = where_needed(sparse, _facing, (*clouds, start, unit), flat)
    sides = Side(clouds[0], facing[0]), Side(clouds[1], facing[1])

    def unfinished(now: _Progress) -> Array:
        return ~now.settled & (now.iteration < now.most)

    def step(fixed: tuple[Side, Side, Array, Array], now: _Progress) -> _Progress:
        source, target, unit, tolerance = fixed
        found = match(source, target, now.transform, now.deviations)
        paired = found.paired >= 3
        motion = jnp.where(paired, bounded_step(found.matrix, found.gradient), 0.0)
        deviations = jnp.maximum(found.deviations, _NARROWEST * unit)
        steady = jnp.all(jnp.abs(deviations - now.deviations) < _STILL * deviations)
        still = small_step(motion, tolerance) & steady & paired
        return _Progress(move(_EAGER * motion, now.transform), deviations, still, now.iteration + 1, now.most)

    deviations = jnp.array(_BEGIN, unit.dtype) * unit
    begin = _Progress(start, deviations, ~sparse, jnp.array(0), jnp.asarray(refine.iterations))
    end = while_each(unfinished, step, begin, (*sides, unit, jnp.asarray(refine.tolerance, unit.dtype)))
    return Settled(
        transform=end.transform,
        width=settled.width,
        converged=jnp.where(sparse, end.settled, settled.converged),
        iterations=jnp.where(sparse, end.iteration, settled.iterations),
        sparse=sparse,
        deviations=jnp.where(sparse, end.deviations, 0.0),
    )


def expected_pose(refine: ICP, source: Prepared, target: Prepared, start: Rigid, end: Settled) -> Rigid:
    """The transform at which EM-ICP ended, with its derivatives with respect to both clouds and to ``start``.

    Those to ``start`` are there because the surface's normals follow it. Arguments as for ``expect``, and its result.
    """
    clouds, unit = _whole(refine, source, target)
    facing, end = _facing((*clouds, start, unit)), jax.lax.stop_gradient(end)
    sides = Side(clouds[0], facing[0]), Side(clouds[1], facing[1])
    deviations_at_end = jnp.where(end.deviations > 0, end.deviations, unit)

    def imbalance(rest: Array) -> Array:
        deviations = deviations_at_end * jnp.exp(rest[6:])
        found = match(*sides, move(rest[:6], end.transform), deviations)
        too_wide = jnp.log(deviations) - jnp.log(jnp.maximum(found.deviations, _NARROWEST * unit))
        return jnp.concatenate([found.gradient, found.paired * too_wide])

    return move(root_at_zero(imbalance, 8, deviations_at_end[0])[:6], end.transform)


def _whole(refine: ICP, source: Prepared, target: Prepared) -> tuple[tuple[Cloud, Cloud], Array]:
    """Both clouds, padded no further than EM-ICP takes them, and the coarser spacing."""
    size = min(source.cloud.mask.shape[0], max(refine.em_points, 3))
    unit = coarser(source, target)  # never 0
    return (first(source.cloud, size), first(target.cloud, size)), unit


def _facing(pair: tuple[Cloud, Cloud, Rigid, Array]) -> tuple[Array, Array]:
    """The normals (N, 3) and (M, 3), in either cloud's frame, of the surface that both clouds together sample."""
    source, target, transform, unit = pair
    sides = (source, target, rigid.inverse(transform)), (target, source, transform)

    def facing(side: tuple[Cloud, Cloud, Rigid]) -> Array:
        cloud, other, moved = side
        other = other._replace(points=rigid.apply(moved, other.points))
        together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), cloud, other)
        return normals(cloud.points, together, _NORMAL_RADIUS * unit, centroid(cloud))

    return facing(sides[0]), facing(sides[1])


def match(source: Side, target: Side, transform: Rigid, deviations: Array) -> Match:
    """One round of expectation maximisation, in the target's frame.

    A pair's weight is the probability of its distance, along and across the surface at both ends, among those of
    either end and of a uniform background.

    Args:
      source: N points.
      target: M points.
      transform: from source to target.
      deviations: (2,), the standard deviations of the distances along and across the surface.
    """
    points, others = rigid.apply(transform, source.cloud.points), target.cloud.points
    facing, other_facing = rigid.rotate(transform.rotation, source.normals), target.normals
    along, across = 1 / deviations**2
    apart = [points[:, None, k] - others[None, :, k] for k in range(3)]
    squared = sum(each**2 for each in apart)
    heights = sum(each * facing[:, None, k] for k, each in enumerate(apart)) ** 2
    heights += sum(each * other_facing[None, :, k] for k, each in enumerate(apart)) ** 2
    weights = jnp.exp(-0.5 * (along * squared + (across - along) * (0.5 * heights)))
    weights = jnp.where(source.cloud.mask[:, None] & target.cloud.mask[None, :], weights, 0.0)
    forth = 1 / (jnp.sum(weights, axis=1, keepdims=True) + _BACKGROUND)
    back = 1 / (jnp.sum(weights, axis=0, keepdims=True) + _BACKGROUND)
    weights = weights * (forth + back)

    total, mean, spread = _moments(weights, others, points, facing)
    other_total, other_mean, other_spread = _moments(weights.T, points, others, other_facing)
    pull = points - mean
    steep = 0.5 * (across - along)
    heights_apart = jnp.sum(facing * pull, axis=-1), jnp.sum(other_facing * (other_mean - others), axis=-1)
    terms = [
        (steep * total, points, facing, heights_apart[0]),
        (steep * other_total, others, other_facing, heights_apart[1]),
    ]
    for k, axis in enumerate(jnp.eye(3, dtype=points.dtype)):
        terms.append((along * total, (points + mean) / 2, jnp.broadcast_to(axis, points.shape), pull[:, k]))
    matrix, gradient = accumulate(terms)

    everything = jnp.maximum(jnp.sum(total), _NOTHING)
    whole = jnp.sum(spread[0]) / everything
    height = 0.5 * (jnp.sum(spread[1]) + jnp.sum(other_spread[1])) / everything
    squares = jnp.maximum(jnp.stack([(whole - height) / 2, height]), _TINY)
    # As large as the number of pairs, whatever the unit.
    scale = deviations[0] ** 2
    return Match(scale * matrix, scale * gradient, jnp.sqrt(squares), jnp.sum(total > 0.5))


def _moments(weights: Array, others: Array, points: Array, facing: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Of the others, about each of N points with weights (N, M): total, mean, and sums of squares and of heights."""
    x, y, z = others.T
    columns = jnp.stack([jnp.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
    sums = jnp.matmul(weights, columns, precision=_HIGHEST)
    total, linear = sums[:, 0], sums[:, 1:4]
    second = sums[:, 4:][:, jnp.array([0, 1, 2, 1, 3, 4, 2, 4, 5])].reshape(-1, 3, 3)
    outer = points[:, :, None] * linear[:, None, :]
    spread = second - outer - outer.mT + total[:, None, None] * points[:, :, None] * points[:, None, :]
    heights = jnp.sum(facing * jnp.sum(spread * facing[:, None, :], axis=-1), axis=-1)
    some = total[:, None] > _NOTHING
    mean = jnp.where(some, linear / jnp.where(some, total[:, None], 1.0), points)
    return total, mean, (jnp.trace(spread, axis1=1, axis2=2), heights)
