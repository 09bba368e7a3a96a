"""The search itself: hypotheses, their scores, the best few refined, the best of those."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.assessment import agreement
from urrt_jax.features import fpfh
from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import Cloud, centroid, subsample
from urrt_jax.geometry.neighbors import spacing
from urrt_jax.geometry.normals import normals
from urrt_jax.geometry.prepared import Prepared, prepare
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.model.network import Model, estimate
from urrt_jax.refine.icp import anneal
from urrt_jax.search.config import Search
from urrt_jax.search.cover import rotation_cover
from urrt_jax.search.matches import match_features, poses_from_matches

_NORMAL_POINTS = 4096  # of a large cloud, for the normals at its subsample
_SCORED_POINTS = 256  # the first of a farthest-point sample are a coarser one
_STEPS = 30


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


def search(model: Model, source: Cloud | Prepared, target: Cloud | Prepared, config: Search, plain: Rigid) -> Found:
    """The best pose among all hypotheses, of two clouds normalised together (``normalize_pair``).

    Hypotheses come from matched features (``poses_from_matches``), which partial overlap and any rotation leave alone,
    and from a step of the network at every member of a cover of SO(3), which sparse and noisy clouds leave alone;
    ``plain``, the estimate at hand, is one more. All are scored by how well the subsamples lie on each other in both
    directions, the best ``config.kept`` refined, and the best of those returned; ``plain``, with a score of 0, where
    none turns by less than the largest angle. A pure function: nothing is drawn.
    """
    # It is a choice: derivatives pass through what follows it.
    model, plain = jax.tree.map(jax.lax.stop_gradient, (model, plain))
    clouds: tuple[Prepared, Prepared] = jax.tree.map(jax.lax.stop_gradient, (prepare(source), prepare(target)))
    small = _subsample(clouds[0], config.points), _subsample(clouds[1], config.points)
    width = jnp.maximum(jnp.maximum(*map(spacing, small)), 1e-6)
    guesses = [jax.tree.map(lambda leaf: leaf[None], plain)]
    if config.matches:
        guesses.append(_from_features(clouds, small, width, config))
    if config.rotations:
        guesses.append(_from_network(model, *small, config.rotations))
    every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *guesses)

    reach = config.inlier_distance * width
    some = _first(small[0]), _first(small[1])
    # Before refinement a hypothesis may be a few spacings off.
    first = jax.lax.map(lambda pose: agreement(pose, small, some, 3 * reach), every, batch_size=16)
    first = jnp.where(_allowed(every, config), first, -1.0)
    _, best = jax.lax.top_k(first, min(config.kept, len(first)))

    def refined(pose: Rigid) -> tuple[Rigid, Array]:
        better = anneal(*small, pose, 3 * reach, reach, iterations=_STEPS)
        return better, agreement(better, small, small, reach)

    poses, scores = jax.vmap(refined)(jax.tree.map(lambda leaf: leaf[best], every))
    scores = jnp.where(_allowed(poses, config), scores, -1.0)
    winner = jnp.argmax(scores)
    found = jax.tree.map(lambda leaf, given: jnp.where(scores[winner] >= 0, leaf[winner], given), poses, plain)
    return Found(found, jnp.maximum(scores[winner], 0.0), width)


def _subsample(cloud: Prepared, count: int) -> Cloud:
    return subsample(cloud.cloud, count, order=cloud.order)


def _first(cloud: Cloud) -> Cloud:
    return jax.tree.map(lambda leaf: leaf[:_SCORED_POINTS], cloud)


def _allowed(poses: Rigid, config: Search) -> Array:
    """Which of H poses turn by no more than the largest angle, (H,)."""
    angles = rigid.rotation_angle(poses.rotation, jnp.eye(3))
    return angles <= jnp.deg2rad(config.max_angle) + 1e-4


def _from_features(
    clouds: tuple[Prepared, Prepared], small: tuple[Cloud, Cloud], width: Array, config: Search
) -> Rigid:
    features = []
    for cloud, part in zip(clouds, small, strict=True):
        dense = cloud.thin(_NORMAL_POINTS)
        surface = normals(part.points, dense, config.normal_radius * width, centroid(cloud.cloud))
        features.append(fpfh(part, surface, config.feature_radius * width))
    matches = match_features(*features, *(part.mask for part in small))
    count = min(config.matches, small[0].points.shape[0])
    support = min(config.support, small[0].points.shape[0])
    return poses_from_matches(*small, matches, config.match_distance * width, count=count, support=support)


def _from_network(model: Model, source: Cloud, target: Cloud, rotations: int) -> Rigid:
    """The network's estimates after one step, with the source turned by every member of the cover."""
    once = dataclasses.replace(model, config=dataclasses.replace(model.config, steps=1))
    # Farthest-point samples: their first points are a coarser one.
    source, target = (jax.tree.map(lambda leaf: leaf[: model.config.points], cloud) for cloud in (source, target))

    def at(rotation: Array) -> Rigid:
        return estimate(once, source, target, Rigid(rotation, jnp.zeros(3))).transform

    return jax.lax.map(at, jnp.asarray(rotation_cover(rotations)), batch_size=8)
