"""Iterative closest points, robust and coarse to fine, whose end differentiates.

The coarse stage finds the basin of convergence on small even samples, point to point (Besl and McKay 1992). The second
makes the pose exact: correspondences in both directions, distances along normals as well as between points. Large
clouds go through it thinned first. Both stages weigh correspondences by Geman and McClure's function, whose width
shrinks step by step (as in Zhou et al. 2016): in the fine stage to the spacing, and from there to the spread of the
correspondences themselves. Where points have counterparts the spread is next to nothing, and points without one do not
pull.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, first
from urrt_jax.loops import while_each
from urrt_jax.neighbors import nearest
from urrt_jax.prepared import THINNED, Prepared, Samples, coarser, thinned_spacing
from urrt_jax.refine.config import ICP
from urrt_jax.refine.pairs import Pairs, Surface, both, find_pairs, pair_up, robust_weights
from urrt_jax.refine.solver import bounded_step, move, normal_equations, root_at_zero, small_step
from urrt_jax.rigid import Rigid, procrustes

# All constants were chosen on training shapes.
_SHRINK, _SHRINK_FINE = 0.8, 0.7  # of the width a step, in the coarse and in the fine stage
_SPREADS = 2.0  # the last width, in root mean square distances of the correspondences that count
_NARROWEST = 0.05  # the least width, in inlier distances
_STEADY, _STEADY_SHARE = 20.0, 1000.0  # a settled width changes by less: tolerances, and floors each
_ONE_IN, _ROUGHLY = 4, 10.0  # thinned: one query in four is used, and iteration stops at ten times the tolerance
_APART = 0.3  # the last width, in inlier distances, above which points have no counterparts
_WHOLE, _TOUCHING = 0.8, 1.5  # clouds overlap as a whole when this share of queries is this near (spacings)
_SEEN = 5.0  # correspondences farther apart than this many widths weigh less than 0.0015 and are not looked for


class Settled(NamedTuple):
    """Where a stage of refinement ended.

    Attributes:
      transform: source to target; no derivative passes.
      width: (), of the weights in the last step.
      converged: (), bool, whether iteration came to rest.
      iterations: (), int.
      sparse: (), bool, whether the clouds are small and overlap as a whole, but their points have no counterparts.
      deviations: (2,), those of EM-ICP along and across the surface; 0 where it did not run.
    """

    transform: Rigid
    width: Array
    converged: Array
    iterations: Array
    sparse: Array
    deviations: Array


class _Progress(NamedTuple):
    transform: Rigid
    width: Array
    settled: Array
    whole: Array
    iteration: Array
    most: Array


def _unfinished(now: _Progress) -> Array:
    return ~now.settled & (now.iteration < now.most)


def _begin(transform: Rigid, width: Array, most: Array | int) -> _Progress:
    return _Progress(transform, width, jnp.array(False), jnp.array(False), jnp.array(0), jnp.asarray(most))


def find_basin(refine: ICP, source: Samples, target: Samples, start: Rigid) -> tuple[Rigid, Array]:
    """The transform after the coarse stage, and the distance, (), within which it can be trusted.

    That is the spacing of the target's sample; where the stage is left out, ``refine.reach``.

    Args:
      refine: how to refine.
      source: samples of the source; the even one has at least twice ``coarse_points`` points.
      target: samples of the target.
      start: rough transform.
    """
    source, target, start = jax.lax.stop_gradient((source, target, start))
    dtype = source.spacing.dtype
    start, reach = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), (start, refine.reach))
    if not refine.coarse_points:
        return start, reach
    # The first points of a farthest-point sample are a coarser one.
    few, more = first(source.even, refine.coarse_points), first(target.even, 2 * refine.coarse_points)
    floor = thinned_spacing(jnp.sum(target.even.mask), target.spacing, 2 * refine.coarse_points)
    return anneal(few, more, start, reach, floor, iterations=refine.coarse_iterations), floor


def anneal(
    source: Cloud,
    target: Cloud,
    start: Rigid,
    width: Array,
    floor: Array,
    *,
    iterations: Array | int,
    tolerance: float = 1e-3,
) -> Rigid:
    """The end of robust point-to-point ICP from ``start``; the weights' width falls from ``width`` to ``floor``."""

    def step(fixed: tuple[Cloud, Cloud, Array], now: _Progress) -> _Progress:
        source, target, floor = fixed
        index, squared = nearest(rigid.apply(now.transform, source.points), target)
        weights = robust_weights(jnp.where(source.mask, squared, jnp.inf), now.width)
        new = procrustes(source.points, target.points[index], weights)
        # Three correspondences determine a pose; with fewer the transform stays.
        paired = jnp.sum(weights > 0) >= 3
        new = jax.tree.map(lambda a, b: jnp.where(paired, a, b), new, now.transform)
        shift = jnp.linalg.norm(new.translation - now.transform.translation)
        still = (shift < tolerance) & (rigid.rotation_angle(new.rotation, now.transform.rotation) < tolerance)
        width = jnp.maximum(now.width * _SHRINK, floor)
        return _Progress(new, width, still & (now.width <= floor), now.whole, now.iteration + 1, now.most)

    begin = _begin(start, jnp.maximum(width, floor), iterations)
    return while_each(_unfinished, step, begin, (source, target, floor)).transform


def settle_thinned(refine: ICP, source: Prepared, target: Prepared, start: Rigid, width: Array) -> tuple[Rigid, Array]:
    """The transform and the width after the fine stage of two large clouds, thinned: a start for the whole ones.

    Where one of them is not large, they are as they were. Arguments as for ``settle``.
    """
    large = jnp.minimum(source.count, target.count) > THINNED
    rough = both(_thinned(source), _thinned(target))
    unit = jnp.maximum(*(thinned_spacing(each.count, each.spacing) for each in (source, target)))
    end = _iterate(
        refine, rough, start, width, unit, _ROUGHLY * refine.tolerance, jnp.where(large, refine.iterations // 2, 0)
    )
    return end.transform, jnp.where(large, refine.inlier_distance * coarser(source, target), width)


def settle(refine: ICP, source: Prepared, target: Prepared, start: Rigid, width: Array) -> Settled:
    """The end of the fine stage: exact where points have counterparts.

    Args:
      refine: how to refine.
      source: N points, in units of the clouds' radius.
      target: N points.
      start: a transform within ``width`` of the answer.
      width: (), the first width of the weights.
    """
    surfaces = jax.lax.stop_gradient(both(_surface(source), _surface(target)))
    unit = jax.lax.stop_gradient(coarser(source, target))
    floor = refine.inlier_distance * unit
    end = _iterate(refine, surfaces, start, width, unit, refine.tolerance, refine.iterations)
    small = jnp.maximum(source.count, target.count) <= refine.em_points
    sparse = small & end.settled & (end.width > _APART * floor) & end.whole
    return Settled(end.transform, end.width, end.settled, end.iteration, sparse, jnp.zeros(2, unit.dtype))


def settled_pose(refine: ICP, source: Prepared, target: Prepared, end: Settled) -> Rigid:
    """The transform at which the fine stage ended, with its derivatives with respect to both clouds and ``refine``.

    They are exact while correspondences and neighbourhoods hold (implicit function theorem). A normal of fewer than
    three neighbours has no meaning and counts as fixed.
    """
    surfaces, unit = both(_surface(source), _surface(target)), coarser(source, target)
    floor, plane = jnp.asarray(refine.inlier_distance, unit.dtype) * unit, jnp.asarray(refine.plane, unit.dtype)
    end = jax.lax.stop_gradient(end)
    pairs = find_pairs(jax.lax.stop_gradient(surfaces), end.transform, _SEEN * end.width)
    counted = jnp.isfinite(pairs.squared)

    def imbalance(rest: Array) -> Array:
        motion, growth = rest[:6], rest[6]
        here = pair_up(surfaces, move(motion, end.transform), pairs.rows)
        squared = jnp.where(counted, here.squared, jnp.inf)
        weights = robust_weights(squared, end.width * jnp.exp(growth))
        too_wide = growth + jnp.log(end.width) - 0.5 * jnp.log(_squared_width(squared, weights, floor))
        # Both as large as the number of correspondences that count: one damping suits them.
        return jnp.append(normal_equations(here, weights, plane)[1], jnp.sum(counted) * too_wide)

    return move(root_at_zero(imbalance, 7, end.width)[:6], end.transform)


def _iterate(
    refine: ICP, surfaces: Surface, start: Rigid, width: Array, unit: Array, tolerance: Any, most: Any
) -> _Progress:
    """The end of the fine stage's steps among these surfaces, whose spacing is ``unit``."""

    def step(fixed: tuple[Surface, Array, Array, Array, Array], now: _Progress) -> _Progress:
        surfaces, unit, inlier_distance, tolerance, plane = fixed
        floor = inlier_distance * unit
        pairs = find_pairs(surfaces, now.transform, _SEEN * now.width)
        weights = robust_weights(pairs.squared, now.width)
        # With fewer than three correspondences the transform stays and never settles.
        paired = jnp.sum(weights > 0) >= 3
        motion = jnp.where(paired, bounded_step(*normal_equations(pairs, weights, plane)), 0.0)
        narrow = jnp.sqrt(_squared_width(pairs.squared, weights, floor))
        at_floor = now.width <= floor
        width = jnp.where(at_floor, narrow, jnp.maximum(now.width * _SHRINK_FINE, floor))
        change = jnp.abs(width - now.width)
        steady = at_floor & (change < tolerance * jnp.minimum(_STEADY, _STEADY_SHARE * floor))
        still = paired & small_step(motion, tolerance) & steady
        whole = _overlap_whole(pairs, surfaces, _TOUCHING * unit)
        return _Progress(move(motion, now.transform), width, still, whole, now.iteration + 1, now.most)

    dtype = surfaces.normals.dtype
    numbers = [jnp.asarray(each, dtype) for each in (unit, refine.inlier_distance, tolerance, refine.plane)]
    start = jax.tree.map(lambda leaf: leaf.astype(dtype), start)
    begin = _begin(start, jnp.maximum(width, numbers[0] * numbers[1]), most)
    return while_each(_unfinished, step, begin, (surfaces, *numbers))


def _overlap_whole(pairs: Pairs, surfaces: Surface, within: Array) -> Array:
    """Whether nearly all queries of either cloud have a neighbour within this distance, ()."""
    near = jnp.sum((pairs.squared <= within**2).reshape(2, -1), axis=1)
    asked = jnp.sum(surfaces.queries.mask, axis=1)
    return jnp.min(near / jnp.maximum(asked, 1)) >= _WHOLE


def _squared_width(squared: Array, weights: Array, widest: Array) -> Array:
    """The squared width, (), that squared distances (P,) ask for under these weights: a multiple of their mean."""
    distances = jnp.where(weights > 0, squared, 0.0)  # infinite, where there is no correspondence
    mean = jnp.sum(weights * distances) / jnp.maximum(jnp.sum(weights), 1e-9)
    return jnp.clip(_SPREADS**2 * mean, (_NARROWEST * widest) ** 2, widest**2)


def _surface(cloud: Prepared) -> Surface:
    return Surface(cloud.queries, cloud.normals, cloud.cloud, cloud.blocks)


def _thinned(cloud: Prepared) -> Surface:
    """The surface of a thinned cloud: fewer queries, and fewer points among which they search."""
    queries, normals = jax.tree.map(lambda leaf: leaf[::_ONE_IN], (cloud.queries, cloud.normals))
    return jax.lax.stop_gradient(Surface(queries, normals, first(cloud.samples.thinned, THINNED), None))
