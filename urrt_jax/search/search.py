"""The search itself: hypotheses, their scores, the best few refined, the best of those.

Hypotheses come from matched features (``matches``), which partial overlap and any rotation leave alone, and from the
network's landmarks (``model.network.propose``), which sparse and noisy clouds leave alone. Nothing is drawn at random.

The 64 hypotheses in which the clouds agree best, in both directions, are refined briefly on few points. The best four
of these and the plain pose are refined on the whole subsample, and the one that fits best is kept.

Dense clouds, such as scans, get a quick look first, at 512 points and their features alone. Its pose is taken where it
fits well, or where most of the best hypotheses end in it. Otherwise the thorough search refines 19 poses instead of
four. The three best that are far from each other are refined once more, among more points, and the one in which the
whole clouds then fit best is kept.

(These numbers are the defaults of ``Search``.)
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.assessment import agreement, fit_samples
from urrt_jax.clouds import Cloud, face_alike, first, normals, subsample
from urrt_jax.features import fpfh, turned_around
from urrt_jax.loops import only_if
from urrt_jax.model.network import Model, propose
from urrt_jax.neighbors import coarser_spacing
from urrt_jax.prepared import Samples, coarser
from urrt_jax.refine.icp import anneal
from urrt_jax.rigid import Rigid
from urrt_jax.search.config import Search
from urrt_jax.search.matches import match_most_similar, poses_from_matches

_COARSE_POINTS = 256  # the first points of a farthest-point sample are a coarser one
_BRIEF_STEPS, _STEPS = 8, 30
_NEARLY = 1.5  # inlier distances that a pose may be off before it is refined on the whole subsample
_QUICK_MATCHES, _QUICK_TRIED = 32, 16  # hypotheses of the quick look, and those of them that are briefly refined
_RADII = (1.0, 0.6)  # of features, as shares of the search's radius; sparse clouds have those of the first alone
_VOTES = 16  # steps in which neighbours' normals are made to agree
# Groups of poses that a thorough search of dense clouds refines in full, instead of one: where little overlaps, the
# right pose ranks low before that.
_GROUPS = 4
_SEEDS = 4  # poses from matches for each hypothesis that is kept of them
_ALIKE = 5.0  # degrees between poses that are the same
_CHEAPER = 0.1  # what turns cost dense clouds, which tell nearly symmetric poses apart better than sparse ones do
_UNANIMOUSLY = 0.5  # of the confidence that settles it, where most of the hypotheses that were kept end in one pose
_APART = 20.0  # degrees between finalists
FINALISTS = 3
"""Poses that are compared among whole clouds."""
DENSE = 4096
"""Points of each cloud from which on a quick look is taken first: eight times the 512 of the sample that it sees."""


class Found(NamedTuple):
    """The best pose of a search.

    Attributes:
      transform: source to target; no derivative passes.
      score: (), in [0, 1]: how well the subsamples' surfaces lie on each other (``Fit.score``).
      width: (), the distance within which the transform can be trusted: the subsample's spacing.
      pending: (), bool, whether more is called for: a search, a more thorough one, at last a choice among finalists.
      finalists: stacked, this pose and the next best ones, each far from those before it; it again where there is none.
    """

    transform: Rigid
    score: Array
    width: Array
    pending: Array
    finalists: Rigid


def search_quickly(search: Search, source: Samples, target: Samples, plain: Found) -> tuple[Found, Array]:
    """The best pose that matched features of the even samples speak for, and whether most good hypotheses end in it.

    Of dense clouds, as scans are, that is often enough: ``judge_quick_look`` tells.

    Args:
      search: how to search.
      source: samples of the source, in units of the clouds' radius.
      target: samples of the target.
      plain: the pose at hand, which is one more hypothesis.
    """
    source, target, plain = jax.lax.stop_gradient((source, target, plain))
    few, search = (source.even, target.even), _cheaper(search, jnp.array(True))
    width = coarser(source, target)
    guesses = _from_features((source, target), few, width, search, _QUICK_MATCHES, jnp.array(True))
    return _choose([guesses], few, width, plain.transform, search, _QUICK_TRIED)


def judge_quick_look(search: Search, found: Found, unanimous: Array, confidence: Array) -> Found:
    """What a quick look has found; ``pending`` where it is not sure enough.

    Args:
      search: how it was searched.
      found: the best pose.
      unanimous: (), bool, whether most of the best hypotheses ended in it.
      confidence: (), in this pose, once it is refined, as whole clouds show it.
    """
    settled = (confidence >= search.sure) | (unanimous & (confidence >= _UNANIMOUSLY * search.sure))
    return found._replace(pending=~settled)


def search_thoroughly(options: tuple[Search, Model], source: Samples, target: Samples, plain: Found) -> Found:
    """The best pose among all hypotheses.

    They are told apart by how well the subsamples lie on each other in both directions: the best ``tried`` of them as
    they are, the best ``kept`` of these after a brief refinement on few points, the best one after a full one. Of dense
    clouds, of which little may overlap, about four times as many are kept; the pose found is still to be verified.
    Where none turns by less than the largest angle, it is ``plain``, with a score of 0.

    Arguments as for ``search_quickly``, and the network that proposes hypotheses from its landmarks.
    """
    search, model = options
    # It is a choice: derivatives pass through what follows it.
    model, source, target, plain = jax.lax.stop_gradient((model, source, target, plain))
    few = subsample(source.thinned, search.points), subsample(target.thinned, search.points)
    dense = jnp.minimum(*(jnp.sum(each.thinned.mask) for each in (source, target))) >= DENSE
    width, search, guesses = coarser_spacing(*few), _cheaper(search, dense), []
    if search.matches:
        guesses.append(_from_features((source, target), few, width, search, search.matches, dense))
    if search.landmarks:
        seen = first(source.even, model.config.points), first(target.even, model.config.points)
        guesses.append(propose(model, *seen, search.landmarks))
    groups = jnp.where(dense, _GROUPS, 1)
    found, _ = _choose(guesses, few, width, plain.transform, search, search.tried, groups)
    return found._replace(pending=dense)


def choose_finalist(search: Search, found: Found, refined: Rigid, scores: Array) -> Found:
    """Of the finalists of dense clouds, all refined, the one in which these fit best, for how far it turns.

    Where little overlaps, the few points of a search hardly tell surfaces that cross from surfaces that lie on each
    other. Whole clouds do.

    Args:
      search: how it was searched.
      found: what a search has found.
      refined: where refinement of its finalists ends, stacked.
      scores: (F,), how well the whole clouds fit there (``Fit.score``).
    """
    poses, best = _best(refined, scores, 1, _cheaper(search, jnp.array(True)))
    best_pose = jax.tree.map(lambda leaf: leaf[0], poses)
    transform = rigid.choose(best[0] >= 0, best_pose, found.transform)
    return found._replace(transform=transform, score=jnp.maximum(best[0], 0.0), pending=jnp.array(False))


def _choose(
    guesses: list[Rigid],
    few: tuple[Cloud, Cloud],
    width: Array,
    plain: Rigid,
    search: Search,
    tried: int,
    groups: Array | int = 1,
) -> tuple[Found, Array]:
    """The best of ``plain`` and all guesses, in three rounds, and whether several guesses end there, ().

    In the last round ``groups`` times as many are refined as ``search.kept`` says, at most ``_GROUPS`` times.
    """
    reach = search.inlier_distance * width
    fewer = first(few[0], _COARSE_POINTS), first(few[1], _COARSE_POINTS)
    every = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *guesses)
    promising, _ = _best(every, agreement(every, few, fewer, _NEARLY * reach), tried, search)

    coarse = search.inlier_distance * coarser_spacing(*fewer)
    denser = first(few[1], 2 * _COARSE_POINTS)
    brief = jax.vmap(lambda pose: anneal(fewer[0], denser, pose, 3 * coarse, coarse, iterations=_BRIEF_STEPS))(
        promising
    )
    size = search.kept + 1
    kept, _ = _best(brief, agreement(brief, few, fewer, _NEARLY * reach), _GROUPS * size - 1, search)

    # The plain pose is always among them, as it is and refined in full: it stays where none fits better.
    full = _refine(_with_first(plain, kept), few, reach, size, groups)
    full = _with_first(plain, full)
    # Not their agreement: where little overlaps, more points touch in poses in which surfaces cross.
    scores = _scores(full, few, width, groups * size + 1)
    poses, best = _best(full, scores, 1, search)
    found = jax.tree.map(lambda leaf, given: jnp.where(best[0] >= 0, leaf[0], given), poses, plain)
    alike = rigid.rotation_angle(full.rotation, found.rotation) < jnp.deg2rad(_ALIKE)
    guessed = jnp.isfinite(scores).at[:2].set(False)
    unanimous = jnp.sum(alike & guessed) > 0.5 * jnp.sum(guessed)
    finalists = _finalists(found, full, scores, search)
    return Found(found, jnp.maximum(best[0], 0.0), width, jnp.array(False), finalists), unanimous


def _refine(poses: Rigid, few: tuple[Cloud, Cloud], reach: Array, size: int, groups: Array | int) -> Rigid:
    """H poses, of which the first ``groups`` times ``size`` are refined in full, ``size`` at a time."""
    count = len(poses.translation)
    poses = jax.tree.map(lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], -count % size, axis=0)]), poses)

    def refine_group(group: Array, poses: Rigid) -> Rigid:
        some = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, group * size, size), poses)
        ends = jax.vmap(lambda pose: anneal(*few, pose, 3 * reach, reach, iterations=_STEPS))(some)
        put = jax.lax.dynamic_update_slice_in_dim
        return jax.tree.map(lambda leaf, new: put(leaf, new, group * size, axis=0), poses, ends)

    groups = jnp.minimum(groups, len(poses.translation) // size)
    return jax.tree.map(lambda leaf: leaf[:count], jax.lax.fori_loop(0, groups, refine_group, poses))


def _scores(poses: Rigid, few: tuple[Cloud, Cloud], width: Array, count: Array | int) -> Array:
    """How well the clouds fit in the first ``count`` of H poses, (H,); -inf for the others."""

    def score(row: Array, scores: Array) -> Array:
        return scores.at[row].set(fit_samples(*few, jax.tree.map(lambda leaf: leaf[row], poses), width).score)

    rows = len(poses.translation)
    return jax.lax.fori_loop(0, jnp.minimum(count, rows), score, jnp.full(rows, -jnp.inf, width.dtype))


def _with_first(pose: Rigid, poses: Rigid) -> Rigid:
    """The poses, with one more in front."""
    return jax.tree.map(lambda own, others: jnp.concatenate([own[None], others]), pose, poses)


def _finalists(found: Rigid, poses: Rigid, scores: Array, search: Search) -> Rigid:
    """The pose found and those of H others that fit best and do not turn too far, each far from those before it.

    What turns cost is not asked here: the pose found was chosen by it, and ``choose_finalist`` asks again.
    """
    far = rigid.rotation_angle(poses.rotation, found.rotation) > jnp.deg2rad(_APART)
    scores = jnp.where(far & _worth(poses, scores, search)[1], scores, -jnp.inf)
    rows, there = rigid.distinct(poses, scores, count=FINALISTS - 1, apart=_APART)
    others = jax.vmap(lambda row, is_there: rigid.choose(is_there, jax.tree.map(lambda leaf: leaf[row], poses), found))
    return _with_first(found, others(rows, there))


def _best(poses: Rigid, scores: Array, count: int, search: Search) -> tuple[Rigid, Array]:
    """The ``count`` best of H poses and their scores, best first; -1 for those that turn too far."""
    worth, allowed = _worth(poses, scores, search)
    _, rows = jax.lax.top_k(worth, min(count, len(worth)))
    return jax.tree.map(lambda leaf: leaf[rows], poses), jnp.where(allowed, scores, -1.0)[rows]


def _worth(poses: Rigid, scores: Array, search: Search) -> tuple[Array, Array]:
    """What H poses are worth, (H,): their scores less what their turns cost; and whether they may turn so far, (H,)."""
    turn = rigid.rotation_angle(poses.rotation, jnp.eye(3)) / jnp.deg2rad(search.max_angle)
    allowed = turn <= 1 + 1e-4
    # With what turns cost, allowed poses are worth -preference at least.
    return jnp.where(allowed, scores - cost(search.preference, turn), -1.0 - search.preference), allowed


def cost(preference: Array | float, turn: Array) -> Array:
    """What a pose costs that turns by this share of the largest angle, (), in score (``Search.preference``)."""
    return preference * turn**2


def preference_among(preference: Array | float, dense: Array) -> Array:
    """The preference, (), for poses that turn less: smaller among ``dense`` clouds."""
    return preference * jnp.where(dense, _CHEAPER, 1.0)


def _cheaper(search: Search, dense: Array) -> Search:
    return dataclasses.replace(search, preference=preference_among(search.preference, dense))


def _from_features(
    samples: tuple[Samples, Samples], few: tuple[Cloud, Cloud], width: Array, search: Search, matches: int, dense: Array
) -> Rigid:
    """Hypotheses from matched features of ``few``, even samples of the clouds that ``samples`` stand for."""
    matched = match_most_similar(_similarity(samples, few, width, search, dense), *(part.mask for part in few))
    rows = few[0].points.shape[0]
    count, seeds, support = (min(each, rows) for each in (matches, _SEEDS * matches, search.support))
    distance = search.match_distance * width
    return poses_from_matches(*few, matched, distance, seeds=seeds, count=count, support=support)


def _similarity(
    samples: tuple[Samples, Samples], few: tuple[Cloud, Cloud], width: Array, search: Search, dense: Array
) -> Array:
    """How similar the surroundings are of the N points of both samples, (N, N).

    Dense clouds are scans as a rule, open surfaces that overlap in part. Not all of their normals point away from the
    centroid. So neighbours' normals are made to agree, and as a patch may then be the wrong way around as a whole,
    features are compared both ways around. And near the rim of what overlaps only small neighbourhoods are whole. So
    there are two sizes of them.
    """
    wholes = tuple(each.thinned for each in samples)
    clouds, wholes = (jax.tree.map(lambda *each: jnp.stack(each), *both) for both in (few, wholes))

    def orient(side: tuple[Cloud, Cloud]) -> Array:
        part, whole = side
        # The clouds are centred: normals point away from the origin.
        surface = normals(part.points, whole, search.normal_radius * width, jnp.zeros(3, part.points.dtype))
        return only_if(dense, lambda: face_alike(surface, part, width, steps=_VOTES), surface)

    surfaces = jax.lax.map(orient, (clouds, wholes))

    def add(step: Array, similarities: Array) -> Array:
        radius = jnp.array(_RADII, width.dtype)[step] * search.feature_radius * width
        source, target = jax.lax.map(lambda side: fpfh(side[0], side[1], radius), (clouds, surfaces))
        return similarities + jnp.stack([source @ target.T, source @ turned_around(target).T])

    rows = few[0].points.shape[0]
    sizes = jnp.where(dense, len(_RADII), 1)
    alike, turned = jax.lax.fori_loop(0, sizes, add, jnp.zeros((2, rows, rows), width.dtype))
    return jnp.where(dense, jnp.maximum(alike, turned), alike)
