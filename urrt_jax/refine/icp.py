"""Iterative closest points, robust and coarse to fine, with a last step that differentiates.

Besl and McKay 1992, with Geman-McClure weights that tighten step by step while it looks for the basin (as in Zhou et
al. 2016) and a hard inlier distance once it is there.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax import Array

from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, subsample, thin
from urrt_jax.geometry.neighbors import nearest, spacing
from urrt_jax.geometry.rigid import Rigid, procrustes


@dataclasses.dataclass(frozen=True, kw_only=True)
class ICP:
    """How to refine. Lengths are relative to the clouds, so that units do not matter.

    Attributes:
      coarse_points: points of each cloud in the first stage, which looks for the basin; 0 skips that stage.
      coarse_iterations: its iterations at most.
      reach: the first stage's weights fall to a quarter at this distance, in units of the clouds' radius; it shrinks
        from here to the spacing.
      points: source points of the second stage; it compares them with every target point.
      iterations: its iterations at most.
      inlier_distance: second stage: pairs farther apart than this many of the target's spacings are left out; on its
        way there the distance shrinks from the first stage's spacing.
      tolerance: a stage has converged when a step turns by less than this (radians) and moves by less than this share
        of the clouds' radius.
    """

    coarse_points: int = 256
    coarse_iterations: int = 30
    reach: float = 0.4
    points: int = 2048
    iterations: int = 60
    inlier_distance: float = 2.0
    tolerance: float = 2e-5

    def __post_init__(self) -> None:
        for name, least in (("coarse_points", 0), ("coarse_iterations", 1), ("points", 3), ("iterations", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        for name in ("reach", "inlier_distance", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a positive number, got {getattr(self, name)}")


class Refinement(NamedTuple):
    """What refinement found: the transform, whether the last stage converged, and its iterations."""

    transform: Rigid
    converged: Array
    iterations: Array


Weigh = Callable[[Array, Array], Array]
_LEAST_SPACING = 1e-6  # of clouds whose points all coincide


class _Progress(NamedTuple):
    transform: Rigid
    reach: Array
    motion: Array
    settled: Array
    iteration: Array


def icp(source: Cloud, target: Cloud, initial: Rigid, config: ICP = ICP(), *, reach: Array | None = None) -> Refinement:
    """The refined transform from source to target, starting at ``initial``, of clouds in units of their radius.

    Point-to-point, from the source's points to their nearest target points. Stage one works on small even subsamples
    with weights (1 + d²/r²)⁻² and lowers r step by step; stage two on up to ``config.points`` source points and the
    whole target, with the pairs closer than a distance that falls to ``config.inlier_distance`` spacings. The transform
    returned is one closed-form Procrustes step at the correspondences found: its derivatives with respect to both
    clouds are exact while those correspondences hold, and none passes through the loop or to ``initial``.

    Args:
      source: N points.
      target: M points.
      initial: rough transform.
      config: how to refine.
      reach: the distance within which ``initial`` can be trusted, where it is known: the first stage is then left out.
    """
    fixed: tuple[Cloud, Cloud, Rigid] = jax.tree.map(jax.lax.stop_gradient, (source, target, initial))
    transform = fixed[2]
    if reach is None:
        transform, reach = _find_basin(*fixed, config) if config.coarse_points else (transform, jnp.array(config.reach))
    return _settle(thin(source, config.points), target, transform, reach, config)


def refine_from(
    source: Cloud,
    target: Cloud,
    initial: Rigid,
    reach: Array,
    floor: Array,
    *,
    iterations: int,
    tolerance: float = 1e-3,
) -> Rigid:
    """A few steps of robust ICP about ``initial``: weights (1 + d²/r²)⁻² with r falling from ``reach`` to ``floor``."""
    return _iterate(source, target, initial, reach, floor, _geman_mcclure, iterations, tolerance).transform


def _find_basin(source: Cloud, target: Cloud, initial: Rigid, config: ICP) -> tuple[Rigid, Array]:
    """The first stage's transform, and the distance within which it can be trusted: the subsample's spacing."""
    source, target = subsample(source, config.coarse_points), subsample(target, 2 * config.coarse_points)
    floor = jnp.maximum(spacing(target), _LEAST_SPACING)

    reach = jnp.maximum(config.reach, floor)
    end = _iterate(source, target, initial, reach, floor, _geman_mcclure, config.coarse_iterations, config.tolerance)
    return end.transform, end.reach


def _settle(source: Cloud, target: Cloud, initial: Rigid, reach: Array, config: ICP) -> Refinement:
    loose_source, loose_target = jax.tree.map(jax.lax.stop_gradient, (source, target))
    fine = jnp.maximum(spacing(loose_target, sample=thin(loose_target, 1024)), _LEAST_SPACING)
    floor = config.inlier_distance * fine

    def weigh(squared: Array, reach: Array) -> Array:
        return (squared < reach**2).astype(squared.dtype)

    reach = jnp.maximum(reach, floor)
    end = _iterate(loose_source, loose_target, initial, reach, floor, weigh, config.iterations, config.tolerance)
    index, weights = _correspond(loose_source, loose_target, end.transform, end.reach, weigh)
    last = procrustes(source.points, target.points[index], weights)
    paired = jnp.sum(weights) >= 3
    transform = jax.tree.map(lambda new, old: jnp.where(paired, new, old), last, end.transform)
    return Refinement(transform, end.settled & paired, end.iteration)


def _geman_mcclure(squared: Array, reach: Array) -> Array:
    return (1 + squared / reach**2) ** -2


def _correspond(source: Cloud, target: Cloud, transform: Rigid, reach: Array, weigh: Weigh) -> tuple[Array, Array]:
    index, squared = nearest(rigid.apply(transform, source.points), target)
    usable = source.mask & jnp.isfinite(squared)
    return index, jnp.where(usable, weigh(jnp.where(usable, squared, 0.0), reach), 0.0)


def _iterate(
    source: Cloud,
    target: Cloud,
    start: Rigid,
    reach: Array,
    floor: Array,
    weigh: Weigh,
    iterations: int,
    tolerance: float,
) -> _Progress:
    """Alternates correspondences and Procrustes until a step changes nothing, while ``reach`` falls to ``floor``."""

    def unfinished(now: _Progress) -> Array:
        return ~now.settled & (now.iteration < iterations)

    def step(now: _Progress) -> _Progress:
        index, weights = _correspond(source, target, now.transform, now.reach, weigh)
        new = procrustes(source.points, target.points[index], weights)
        # Without three pairs there is nothing to solve; the transform stays and the stage ends unconverged.
        paired = jnp.sum(weights > 0) >= 3
        new = jax.tree.map(lambda a, b: jnp.where(paired, a, b), new, now.transform)
        motion = _logarithm(rigid.compose(new, rigid.inverse(now.transform)))
        still = (jnp.linalg.norm(motion[:3]) < tolerance) & (jnp.linalg.norm(motion[3:]) < tolerance)
        lowest = now.reach <= floor
        ahead = jnp.where(lowest & ~still, _extrapolate(motion, now.motion), 0.0)
        new = rigid.compose(_exponential(ahead * motion), new)
        return _Progress(new, jnp.maximum(now.reach * 0.8, floor), motion, paired & still & lowest, now.iteration + 1)

    nothing = jnp.zeros(6, source.points.dtype)
    return jax.lax.while_loop(unfinished, step, _Progress(start, reach, nothing, jnp.array(False), jnp.array(0)))


def _extrapolate(motion: Array, before: Array) -> Array:
    """How far to go on along this step, in steps: Aitken's limit of a geometric series, where two steps agree.

    Near its end ICP creeps: each step is a fraction of the one before it, in the same direction (Besl and McKay 1992,
    section IV.D). Steps that do not agree are left alone.
    """
    length = jnp.sum(before**2)
    product = jnp.sum(motion * before)
    ratio = product / jnp.maximum(length, 1e-30)
    agree = product > 0.9 * jnp.sqrt(length * jnp.sum(motion**2))
    return jnp.where(agree & (ratio < 1), jnp.minimum(ratio / jnp.maximum(1 - ratio, 1e-3), 8.0), 0.0)


def _logarithm(transform: Rigid) -> Array:
    """The screw motion (6,) of a transform: translation, then rotation vector (jaxlie's order)."""
    rotation = jaxlie.SO3.from_matrix(transform.rotation)
    return jaxlie.SE3.from_rotation_and_translation(rotation, transform.translation).log()


def _exponential(motion: Array) -> Rigid:
    moved = jaxlie.SE3.exp(motion)
    return Rigid(moved.rotation().as_matrix(), moved.translation())
