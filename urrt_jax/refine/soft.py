"""Refinement in which every point pairs with every other, by how likely: expectation maximisation.

Where no point of one cloud has its counterpart in the other, the nearest point is a poor stand-in for it. Here each
point is a Gaussian spread along its surface, and pairs count by their probability (EM-ICP: Granger and Pennec 2002;
coherent point drift: Myronenko and Song 2010). The surface is what both clouds together say it is, and the widths along
and across it are estimated with the transform. Time and memory grow with the product of the clouds' sizes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, centroid
from urrt_jax.geometry.normals import normals
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.refine.lanes import while_each
from urrt_jax.refine.step import bounded_step, damped_solve, move

_HIGHEST = jax.lax.Precision.HIGHEST
_BACKGROUND = 0.03  # what lies elsewhere weighs as much as one point 2.6 widths away
_BEGIN = (1.0, 0.45)  # widths along and across the surface, in spacings
_NARROWEST = 0.1  # width, in spacings
_NORMAL_RADIUS = 4.0  # spacings
_EAGER = 1.5  # steps: the weights follow the transform, and every step falls short by what they will add
_STILL = 0.01  # by how much the widths may still change when all has settled, as a share
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
    """What the pairs of all points add up to.

    Attributes:
      matrix: (6, 6), of the Gauss-Newton step.
      gradient: (6,), of half the weighted squared residuals, for a small motion of the source.
      widths: (2,), along and across the surface, as the pairs have them.
      paired: (), how many points of the source found something.
    """

    matrix: Array
    gradient: Array
    widths: Array
    paired: Array


class Softened(NamedTuple):
    """The transform, whether it settled, and the iterations that it took."""

    transform: Rigid
    converged: Array
    iterations: Array


class _Normals(NamedTuple):
    source: Array
    target: Array
    missing: Array


class _Progress(NamedTuple):
    transform: Rigid
    widths: Array
    settled: Array
    iteration: Array


def soften(
    source: Cloud, target: Cloud, initial: Rigid, spacing: Array, *, needed: Array, iterations: int, tolerance: float
) -> Softened:
    """The transform from source to target that explains both clouds best, from ``initial``, a good one.

    Derivatives with respect to both clouds and, by the surface that they make, to ``initial`` are those of the place
    where gradient and widths settle (implicit function theorem).

    Args:
      source: N points.
      target: M points.
      initial: with which both clouds together are a surface.
      spacing: (), of the coarser cloud.
      needed: (), bool; without need ``initial`` comes back after no iteration. Under ``vmap``, too, nothing waits.
      iterations: at most.
      tolerance: radians and lengths that the last step may still move.
    """
    unit = jnp.maximum(spacing, 1e-6)  # points may all coincide
    sides = _sides(source, target, initial, unit)
    # Without need nobody asks for these: what differentiates, below, is computed for derivatives alone.
    loose = _sides_where(needed, source, target, initial, unit)

    def unfinished(now: _Progress) -> Array:
        return ~now.settled & (now.iteration < iterations)

    def step(fixed: tuple[Side, Side, Array], now: _Progress) -> _Progress:
        source, target, unit = fixed
        found = match(source, target, now.transform, now.widths)
        paired = found.paired >= 3
        motion = jnp.where(paired, bounded_step(found.matrix, found.gradient), 0.0)
        still = (jnp.linalg.norm(motion[:3]) < tolerance) & (jnp.linalg.norm(motion[3:]) < tolerance)
        widths = jnp.maximum(found.widths, _NARROWEST * unit)
        steady = jnp.all(jnp.abs(widths - now.widths) < _STILL * widths)
        return _Progress(move(_EAGER * motion, now.transform), widths, still & steady & paired, now.iteration + 1)

    begin = _Progress(initial, jnp.array(_BEGIN, unit.dtype) * unit, ~needed, jnp.array(0))
    end = while_each(unfinished, step, begin, (*loose, unit))

    def imbalance(rest: Array) -> Array:
        widths = end.widths * jnp.exp(rest[6:])
        found = match(*sides, move(rest[:6], end.transform), widths)
        too_wide = jnp.log(widths) - jnp.log(jnp.maximum(found.widths, _NARROWEST * unit))
        return jnp.concatenate([found.gradient, found.paired * too_wide])

    rest = jax.lax.custom_root(
        imbalance,
        jnp.where(end.settled, jnp.zeros(8, unit.dtype), 0.0),
        solve=lambda _, rest: rest,
        tangent_solve=lambda linear, value: damped_solve(jax.jacobian(linear)(value), value),
    )
    return Softened(move(rest[:6], end.transform), end.settled, end.iteration)


def _sides(source: Cloud, target: Cloud, initial: Rigid, unit: Array) -> tuple[Side, Side]:
    return _side(source, target, rigid.inverse(initial), unit), _side(target, source, initial, unit)


def _sides_where(needed: Array, source: Cloud, target: Cloud, initial: Rigid, unit: Array) -> tuple[Side, Side]:
    """``_sides`` without derivatives where they are needed, normals of 0 elsewhere: they take as long as iterations."""

    def look(clouds: tuple[Cloud, Cloud, Rigid, Array], _: _Normals) -> _Normals:
        source, target = _sides(*clouds)
        return _Normals(source.normals, target.normals, jnp.array(False))

    blank = _Normals(jnp.zeros_like(source.points), jnp.zeros_like(target.points), needed)
    found = while_each(lambda now: now.missing, look, blank, (source, target, initial, unit))
    return Side(source, found.source), Side(target, found.target)


def _side(cloud: Cloud, other: Cloud, moved: Rigid, unit: Array) -> Side:
    """The cloud with the normals of the surface that both clouds make, the other one moved to it."""
    other = other._replace(points=rigid.apply(moved, other.points))
    both = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), cloud, other)
    return Side(cloud, normals(cloud.points, both, _NORMAL_RADIUS * unit, centroid(cloud)))


def match(source: Side, target: Side, transform: Rigid, widths: Array) -> Match:
    """One round of expectation maximisation, in the target's frame.

    A pair's weight is the probability of its distance, along and across the surface at both ends, among those of
    either end and of a uniform background.

    Args:
      source: N points.
      target: M points.
      transform: from source to target.
      widths: (2,), the standard deviations of the distances along and across the surface.
    """
    points, others = rigid.apply(transform, source.cloud.points), target.cloud.points
    facing, other_facing = rigid.rotate(transform.rotation, source.normals), target.normals
    along, across = 1 / widths**2
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
    directions = [(steep * total, points, facing, heights_apart[0])]
    directions += [(steep * other_total, others, other_facing, heights_apart[1])]
    for k, axis in enumerate(jnp.eye(3, dtype=points.dtype)):
        directions.append((along * total, (points + mean) / 2, jnp.broadcast_to(axis, points.shape), pull[:, k]))
    matrix, gradient = jnp.zeros((6, 6), points.dtype), jnp.zeros(6, points.dtype)
    for weight, place, direction, residual in directions:
        lever = jnp.concatenate([direction, jnp.cross(place, direction)], axis=-1)
        matrix += jnp.matmul((weight[:, None] * lever).T, lever, precision=_HIGHEST)
        gradient += jnp.matmul(lever.T, weight * residual, precision=_HIGHEST)

    everything = jnp.maximum(jnp.sum(total), _NOTHING)
    whole = jnp.sum(spread[0]) / everything
    height = 0.5 * (jnp.sum(spread[1]) + jnp.sum(other_spread[1])) / everything
    squares = jnp.maximum(jnp.stack([(whole - height) / 2, height]), _TINY)
    # As large as the number of pairs, whatever the unit.
    scale = widths[0] ** 2
    return Match(scale * matrix, scale * gradient, jnp.sqrt(squares), jnp.sum(total > 0.5))


def _moments(weights: Array, others: Array, points: Array, facing: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Of the others, about each of N points with weights (N, M): total, mean, and sums of squares and of heights."""
    x, y, z = others.T
    columns = jnp.stack([jnp.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
    sums = jnp.matmul(weights, columns, precision=_HIGHEST)
    total, first = sums[:, 0], sums[:, 1:4]
    second = sums[:, 4:][:, jnp.array([0, 1, 2, 1, 3, 4, 2, 4, 5])].reshape(-1, 3, 3)
    outer = points[:, :, None] * first[:, None, :]
    spread = second - outer - outer.mT + total[:, None, None] * points[:, :, None] * points[:, None, :]
    heights = jnp.sum(facing * jnp.sum(spread * facing[:, None, :], axis=-1), axis=-1)
    some = total[:, None] > _NOTHING
    mean = jnp.where(some, first / jnp.where(some, total[:, None], 1.0), points)
    return total, mean, (jnp.trace(spread, axis1=1, axis2=2), heights)
