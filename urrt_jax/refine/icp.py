"""Iterative closest points, robust and coarse to fine, whose end differentiates.

Stage one looks for the basin on small even subsamples, point to point (Besl and McKay 1992). Stage two makes it exact:
pairs from both directions, distances along normals as well as between points; large clouds go through it thinned first.
Both weigh pairs by Geman and McClure's function, whose width shrinks step by step (as in Zhou et al. 2016): in stage
two to the spacing, and from there to what the pairs that count say of their own distances. Where points have their
counterparts, that is next to nothing, and those without do not pull. Where sparse clouds have none, a third stage pairs
all points (``soft.py``).
"""

import functools
import math
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, centroid, subsample
from urrt_jax.geometry.neighbors import nearest, spacing
from urrt_jax.geometry.normals import normals
from urrt_jax.geometry.prepared import Prepared, prepare
from urrt_jax.geometry.rigid import Rigid, procrustes
from urrt_jax.refine.config import ICP
from urrt_jax.refine.lanes import while_each
from urrt_jax.refine.pairs import Pairs, Surface, find_pairs, pair_up, robust_weights, trimmed
from urrt_jax.refine.soft import soften
from urrt_jax.refine.step import bounded_step, damped_solve, move, normal_equations

_SHRINK, _SHRINK_FINE = 0.8, 0.7
_SPREADS = 2.0  # the last reach, in root mean square distances of the pairs that count
_NARROWEST = 0.05  # the last reach at least, in inlier distances
_STEADY, _STEADY_SHARE = 20.0, 1000.0  # by how much it may still change: tolerances, and as many inlier distances each
_THINNED = 4096  # points of a large cloud, that normals are made from and pairs are looked for at first
_ONE_IN, _ROUGHLY = 4, 10.0  # of those that ask, so many do then, until steps are this many tolerances small
_APART = 0.3  # the last reach, in inlier distances, above which points have no counterparts
_WHOLE, _TOUCHING = (
    0.8,
    1.5,
)  # the share of points with a neighbour this near, in spacings, of clouds that overlap whole
_SEEN = 5.0  # pairs farther apart than this many reaches weigh less than 0.0015 and are not looked for


class _Progress(NamedTuple):
    transform: Rigid
    reach: Array
    settled: Array
    iteration: Array


class Refinement(NamedTuple):
    """What refinement found: the transform, whether the last stage converged, and its iterations."""

    transform: Rigid
    converged: Array
    iterations: Array


def icp(
    source: Cloud | Prepared,
    target: Cloud | Prepared,
    initial: Rigid,
    config: ICP = ICP(),
    *,
    reach: Array | None = None,
    small: tuple[Cloud, Cloud] | None = None,
) -> Refinement:
    """The refined transform from source to target, starting at ``initial``, of clouds in units of their radius.

    No derivative passes through the iterations or to ``initial``; those of the transform with respect to both clouds
    are exact while pairs and neighbourhoods hold, by the implicit function theorem at the end of stage two (a normal
    from fewer than three neighbours has no meaning and counts as fixed).

    Args:
      source: N points.
      target: M points.
      initial: rough transform.
      config: how to refine.
      reach: the distance within which ``initial`` can be trusted, where it is known: the first stage is then left out.
      small: even subsamples of both clouds (``subsample``), at least twice ``config.coarse_points``, if they are there.
    """
    source, target = prepare(source), prepare(target)
    precision = source.cloud.points.dtype
    transform = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf).astype(precision), initial)
    if reach is None and config.coarse_points:
        if small is None:
            size = 2 * config.coarse_points
            small = subsample(source.cloud, size, order=source.order), subsample(target.cloud, size, order=target.order)
        transform, reach = _find_basin(*small, transform, config)
    elif reach is None:
        reach = jnp.array(config.reach, precision)
    settled, sparse = _settle(source, target, transform, reach, config)
    if max(source.cloud.points.shape[0], target.cloud.points.shape[0]) > config.soft_points:
        return settled

    unit = jnp.maximum(source.spacing, target.spacing)
    limits = {"iterations": config.iterations, "tolerance": config.tolerance}
    softly = Refinement(*soften(source.cloud, target.cloud, settled.transform, unit, needed=sparse, **limits))
    return jax.tree.map(lambda soft, hard: jnp.where(sparse, soft, hard), softly, settled)


def anneal(
    source: Cloud, target: Cloud, start: Rigid, reach: Array, floor: Array, *, iterations: int, tolerance: float = 1e-3
) -> Rigid:
    """Robust point-to-point ICP about ``start``, with weights whose width falls from ``reach`` to ``floor``."""

    def unfinished(now: _Progress) -> Array:
        return ~now.settled & (now.iteration < iterations)

    def step(fixed: tuple[Cloud, Cloud, Array], now: _Progress) -> _Progress:
        source, target, floor = fixed
        index, squared = nearest(rigid.apply(now.transform, source.points), target)
        weights = robust_weights(jnp.where(source.mask, squared, jnp.inf), now.reach)
        new = procrustes(source.points, target.points[index], weights)
        # Without three pairs there is nothing to solve; the transform stays.
        paired = jnp.sum(weights > 0) >= 3
        new = jax.tree.map(lambda a, b: jnp.where(paired, a, b), new, now.transform)
        shift = jnp.linalg.norm(new.translation - now.transform.translation)
        still = (shift < tolerance) & (rigid.rotation_angle(new.rotation, now.transform.rotation) < tolerance)
        return _Progress(new, jnp.maximum(now.reach * _SHRINK, floor), still & (now.reach <= floor), now.iteration + 1)

    begin = _Progress(start, jnp.maximum(reach, floor), jnp.array(False), jnp.array(0))
    return while_each(unfinished, step, begin, (source, target, floor)).transform


def _find_basin(source: Cloud, target: Cloud, initial: Rigid, config: ICP) -> tuple[Rigid, Array]:
    """The first stage's transform, and the distance within which it can be trusted: the subsample's spacing."""
    # Farthest-point samples: their first points are a coarser one.
    source, target = _first(source, config.coarse_points), _first(target, 2 * config.coarse_points)
    floor = jnp.maximum(spacing(target), 1e-6)  # points may all coincide
    reach = jnp.array(config.reach, floor.dtype)
    found = anneal(source, target, initial, reach, floor, iterations=config.coarse_iterations)
    return found, floor


def _first(cloud: Cloud, count: int) -> Cloud:
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf[:count]), cloud)


def _settle(source: Prepared, target: Prepared, initial: Rigid, reach: Array, config: ICP) -> tuple[Refinement, Array]:
    """The second stage, the derivatives of its end, and whether it leaves whole clouds without counterparts, ()."""
    surfaces = _surface(source, config), _surface(target, config)
    loose: tuple[Surface, Surface] = jax.tree.map(jax.lax.stop_gradient, surfaces)
    floor = config.inlier_distance * jnp.maximum(source.spacing, target.spacing)

    def weigh(squared: Array, reach: Array) -> Array:
        return robust_weights(jnp.where(trimmed(squared), squared, jnp.inf) if config.trim else squared, reach)

    def step(fixed: tuple[Surface, Surface, Array], now: _Progress, tolerance: float) -> _Progress:
        source, target, floor = fixed
        pairs = find_pairs(source, target, now.transform, _SEEN * now.reach, mutual=config.mutual)
        weights = weigh(pairs.squared, now.reach)
        # With fewer than three pairs the transform stays and never settles.
        paired = jnp.sum(weights > 0) >= 3
        motion = jnp.where(paired, bounded_step(*normal_equations(pairs, weights, config.plane)), 0.0)
        still = (jnp.linalg.norm(motion[:3]) < tolerance) & (jnp.linalg.norm(motion[3:]) < tolerance)
        narrow = jnp.sqrt(_squared_reach(pairs.squared, weights, floor))
        reach = jnp.where(now.reach <= floor, narrow, jnp.maximum(now.reach * _SHRINK_FINE, floor))
        change = jnp.abs(reach - now.reach)
        steady = (now.reach <= floor) & (change < tolerance * jnp.minimum(_STEADY, _STEADY_SHARE * floor))
        return _Progress(move(motion, now.transform), reach, paired & still & steady, now.iteration + 1)

    def advance(
        begin: _Progress, surfaces: Iterable[Surface], floor: Array, *, iterations: int, tolerance: float
    ) -> _Progress:
        def unfinished(now: _Progress) -> Array:
            return ~now.settled & (now.iteration < iterations)

        begin = begin._replace(reach=jnp.maximum(begin.reach, floor), settled=jnp.array(False))
        return while_each(unfinished, functools.partial(step, tolerance=tolerance), begin, (*surfaces, floor))

    least = jax.lax.stop_gradient(floor)
    now = _Progress(initial, reach, jnp.array(False), jnp.array(0))
    if min(source.cloud.points.shape[0], target.cloud.points.shape[0]) > _THINNED:
        rough = _thinned(source, loose[0]), _thinned(target, loose[1])
        wide = jax.lax.stop_gradient(config.inlier_distance * jnp.maximum(*map(_thinned_spacing, (source, target))))
        limits = {"iterations": config.iterations // 2, "tolerance": _ROUGHLY * config.tolerance}
        now = advance(now, rough, wide, **limits)._replace(reach=least)
    end = advance(now, loose, least, iterations=config.iterations, tolerance=config.tolerance)

    pairs = find_pairs(*loose, end.transform, _SEEN * end.reach, mutual=config.mutual)
    counted = weigh(pairs.squared, end.reach) > 0

    def imbalance(rest: Array) -> Array:
        motion, growth = rest[:6], rest[6]
        here = pair_up(*surfaces, move(motion, end.transform), pairs.rows)
        squared = jnp.where(counted, here.squared, jnp.inf)
        weights = robust_weights(squared, end.reach * jnp.exp(growth))
        too_wide = growth + jnp.log(end.reach) - 0.5 * jnp.log(_squared_reach(squared, weights, floor))
        # Both as large as the number of pairs that count: one damping suits them.
        return jnp.append(normal_equations(here, weights, config.plane)[1], jnp.sum(counted) * too_wide)

    # The end is where this vanishes; how that place moves with the points is all that derivatives need.
    rest = jax.lax.custom_root(
        imbalance,
        # Depends on the pair: custom_root's guess must be batched with it.
        jnp.where(end.settled, jnp.zeros(7, floor.dtype), 0.0),
        solve=lambda _, rest: rest,
        tangent_solve=lambda linear, value: damped_solve(jax.jacobian(linear)(value), value),
    )
    sparse = end.settled & (end.reach > _APART * floor) & _overlap_whole(pairs, *loose, floor / config.inlier_distance)
    return Refinement(move(rest[:6], end.transform), end.settled, end.iteration), sparse


def _overlap_whole(pairs: Pairs, source: Surface, target: Surface, spacing: Array) -> Array:
    """Whether nearly all points that ask, of either cloud, found a neighbour, ()."""
    near = pairs.squared <= (_TOUCHING * spacing) ** 2
    count = source.asking.points.shape[0]
    shares = [
        jnp.sum(found) / jnp.maximum(jnp.sum(asking.mask), 1)
        for found, asking in ((near[:count], source.asking), (near[count:], target.asking))
    ]
    return jnp.minimum(*shares) >= _WHOLE


def _squared_reach(squared: Array, weights: Array, widest: Array) -> Array:
    """The squared reach, (), that the pairs' squared distances (P,) ask for under these weights; never 0."""
    distances = jnp.where(weights > 0, squared, 0.0)  # infinite, where a pair is none
    mean = jnp.sum(weights * distances) / jnp.maximum(jnp.sum(weights), 1e-9)
    return jnp.clip(_SPREADS**2 * mean, (_NARROWEST * widest) ** 2, widest**2)


def _surface(cloud: Prepared, config: ICP) -> Surface:
    """The points that ask, their normals, and the cloud prepared to answer."""
    asking = cloud.thin(config.points)
    if not config.plane:
        return Surface(asking, jnp.zeros_like(asking.points), cloud.reference)
    radius = config.normal_radius * _thinned_spacing(cloud)
    return Surface(asking, normals(asking.points, cloud.thin(_THINNED), radius, centroid(cloud.cloud)), cloud.reference)


def _thinned(cloud: Prepared, surface: Surface) -> Surface:
    """The surface of a large cloud, thinned: fewer points ask, and fewer answer."""
    asking = jax.tree.map(lambda leaf: leaf[::_ONE_IN], surface.asking)
    answering = jax.tree.map(jax.lax.stop_gradient, cloud.thin(_THINNED))
    return Surface(asking, surface.normals[::_ONE_IN], answering)


def _thinned_spacing(cloud: Prepared) -> Array:
    """The spacing, (), of a thinned cloud: on a surface, it grows as the square root of the points left out."""
    return math.sqrt(max(1.0, cloud.cloud.points.shape[0] / _THINNED)) * cloud.spacing
