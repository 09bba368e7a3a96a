"""The search itself: hypotheses, their scores, the best few refined, the best of those."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.assessment import agreement, fit
from urrt_jax.features import fpfh
from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, centroid, subsample
from urrt_jax.geometry.neighbors import coarser_spacing
from urrt_jax.geometry.normals import normals
from urrt_jax.geometry.prepared import Prepared, prepare
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.model.network import Model, estimate, propose
from urrt_jax.refine.icp import anneal
from urrt_jax.search.config import Search
from urrt_jax.search.cover import rotation_cover
from urrt_jax.search.matches import match_features, poses_from_matches

_NORMAL_POINTS = 4096  # of a large cloud, for the normals at its subsample
_COARSE_POINTS = 256  # the first of a farthest-point sample are a coarser one
_BRIEF_STEPS, _STEPS = 8, 30
_NEARLY = 1.5  # inlier distances that a pose may be off before it is refined in full
_AT_ONCE = 16  # poses
_DENSE = 8  # points of a dense cloud for each that the quick look takes, at least
_QUICK_MATCHES, _QUICK_TRIED = 32, 16  # hypotheses of the quick look, and those of them that are briefly refined


class Found(NamedTuple):
    """The best pose of a search.

    Attributes:
      transform: source to target.
      score: (), in [0, 1]: the mean over both directions of max(0, 1 − d²/r²), r the inlier distance.
      reach: (), the distance within which the transform can be trusted: the subsample's spacing.
    """

    transform: Rigid
    score: Array
    reach: Array


def search(
    model: Model,
    source: Cloud | Prepared,
    target: Cloud | Prepared,
    config: Search,
    plain: Rigid,
    *,
    small: tuple[Cloud, Cloud] | None = None,
) -> Found:
    """The best pose among all hypotheses, of two clouds normalised together (``normalize_pair``).

    Hypotheses come from matched features (``poses_from_matches``), which partial overlap and any rotation leave alone,
    and from the network's landmarks (``propose``), which sparse and noisy clouds leave alone; where asked for, also
    from a step of the network at every member of a cover of SO(3). ``plain``, the estimate at hand, is one more. They
    are told apart by how well the subsamples lie on each other in both directions: the best ``config.tried`` as they
    are, the best ``config.kept`` of these after a brief refinement on few points, the best one after a full one. Where
    none turns by less than the largest angle, it is ``plain``, with a score of 0.

    Dense clouds, as scans are, are first looked at through ``config.quick`` points and their features alone; where the
    fit of what these find is sure, nothing else is done. A pure function: nothing is drawn.

    Args:
      model: the network.
      source: N points.
      target: M points.
      config: how to search.
      plain: the estimate at hand, source to target.
      small: even subsamples of both clouds (``subsample``), at least ``config.quick``, if they are there.
    """
    # It is a choice: derivatives pass through what follows it.
    model, plain = jax.tree.map(jax.lax.stop_gradient, (model, plain))
    clouds: tuple[Prepared, Prepared] = jax.tree.map(jax.lax.stop_gradient, (prepare(source), prepare(target)))

    def thorough() -> Found:
        both = _subsample(clouds[0], config.points), _subsample(clouds[1], config.points)
        seen = _first(both[0], model.config.points), _first(both[1], model.config.points)
        guesses = []
        if config.matches:
            guesses.append(_from_features(clouds, both, config, config.matches))
        if config.landmarks:
            guesses.append(propose(model, *seen, config.landmarks))
        if config.rotations:
            guesses.append(_from_network(model, *seen, config.rotations))
        return _choose(guesses, both, plain, config, config.tried)

    size = min(cloud.cloud.points.shape[0] for cloud in clouds)
    if not (config.quick and config.matches) or size < _DENSE * config.quick:
        return thorough()
    if small is None:
        small = _subsample(clouds[0], config.quick), _subsample(clouds[1], config.quick)
    few: tuple[Cloud, Cloud] = _first(small[0], config.quick), _first(small[1], config.quick)
    found = _choose([_from_features(clouds, few, config, _QUICK_MATCHES)], few, plain, config, _QUICK_TRIED)
    return jax.lax.cond(fit(*few, found.transform).confidence >= config.sure, lambda: found, thorough)


def _choose(guesses: list[Rigid], small: tuple[Cloud, Cloud], plain: Rigid, config: Search, tried: int) -> Found:
    """The best of ``plain`` and all guesses, in three rounds; ``plain`` where all turn too far."""
    width = coarser_spacing(*small)
    reach = config.inlier_distance * width
    some = _first(small[0], _COARSE_POINTS), _first(small[1], _COARSE_POINTS)
    every = jax.tree.map(lambda own, *others: jnp.concatenate([own[None], *others]), plain, *guesses)
    promising, _ = _best(every, lambda pose: agreement(pose, small, some, _NEARLY * reach), tried, config)

    coarse = config.inlier_distance * coarser_spacing(*some)
    denser = _first(small[1], 2 * _COARSE_POINTS)
    brief = _each(lambda pose: anneal(some[0], denser, pose, 3 * coarse, coarse, iterations=_BRIEF_STEPS), promising)
    kept, _ = _best(brief, lambda pose: agreement(pose, small, some, _NEARLY * reach), config.kept, config)

    full = _each(lambda pose: anneal(*small, pose, 3 * reach, reach, iterations=_STEPS), kept)
    poses, scores = _best(full, lambda pose: agreement(pose, small, small, reach), 1, config)
    found = jax.tree.map(lambda leaf, given: jnp.where(scores[0] >= 0, leaf[0], given), poses, plain)
    return Found(found, jnp.maximum(scores[0], 0.0), width)


def _each(function: Callable[[Rigid], Any], poses: Rigid) -> Any:
    return jax.lax.map(function, poses, batch_size=_AT_ONCE)


def _best(poses: Rigid, score: Callable[[Rigid], Array], count: int, config: Search) -> tuple[Rigid, Array]:
    """The ``count`` best of H poses and their scores, best first; -1 for those that turn too far."""
    turn = rigid.rotation_angle(poses.rotation, jnp.eye(3)) / jnp.deg2rad(config.max_angle)
    allowed, scores = turn <= 1 + 1e-4, _each(score, poses)
    # With what they cost, allowed poses are worth -preference at least.
    worth = jnp.where(allowed, scores - config.preference * turn**2, -1.0 - config.preference)
    _, rows = jax.lax.top_k(worth, min(count, len(worth)))
    return jax.tree.map(lambda leaf: leaf[rows], poses), jnp.where(allowed, scores, -1.0)[rows]


def _subsample(cloud: Prepared, count: int) -> Cloud:
    return subsample(cloud.cloud, count, order=cloud.order)


def _first(cloud: Cloud, count: int) -> Cloud:
    return jax.tree.map(lambda leaf: leaf[:count], cloud)


def _from_features(
    clouds: tuple[Prepared, Prepared], small: tuple[Cloud, Cloud], config: Search, matches: int
) -> Rigid:
    width, features = coarser_spacing(*small), []
    for cloud, part in zip(clouds, small, strict=True):
        dense = cloud.thin(_NORMAL_POINTS)
        surface = normals(part.points, dense, config.normal_radius * width, centroid(cloud.cloud))
        features.append(fpfh(part, surface, config.feature_radius * width))
    matched = match_features(*features, *(part.mask for part in small))
    count, support = (min(each, small[0].points.shape[0]) for each in (matches, config.support))
    return poses_from_matches(*small, matched, config.match_distance * width, count=count, support=support)


def _from_network(model: Model, source: Cloud, target: Cloud, rotations: int) -> Rigid:
    """The network's estimates after one step, with the source turned by every member of the cover."""
    once = model.at_most(1)

    def at(rotation: Array) -> Rigid:
        return estimate(once, source, target, Rigid(rotation, jnp.zeros(3))).transform

    return jax.lax.map(at, jnp.asarray(rotation_cover(rotations)), batch_size=8)
