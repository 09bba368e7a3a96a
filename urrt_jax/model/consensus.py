"""Consensus: the transform on which landmarks agree, of which many may be misplaced.

First hypotheses: what single landmarks and those compatible with them would say, two landmarks being compatible where
they are as far apart in one cloud as in the other (Leordeanu and Hebert 2005) and have compatible landmarks in common
(Chen et al. 2022, SC2-PCR). The best one is where rounds of weighing and aligning start.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.rigid import Rigid, nearest_rotation, procrustes, quick_rotation

_HIGHEST = jax.lax.Precision.HIGHEST
# Lengths and areas in a frame of unit radius.
_STIFFNESS = 1e-3  # far below the spread of landmarks that mean anything
_TOLERANCE = 0.01  # landmarks this near to each other agree
_MISFIT = 0.05  # of distances between landmarks: a quarter as compatible as without
_BASELINE = 0.3  # landmarks this near to each other, and their misfits, tell half as much as distant ones
_NOTHING = 1e-18  # the squares of smaller numbers are lost
_BRIEF = 2  # rounds, of every hypothesis that is only one among many
_NEAR = 0.05  # a hypothesis gains half of a landmark's weight where it misses it by this


class _Landmarks(NamedTuple):
    """Landmarks as rounds want them: long rows for vector instructions, and products whose weighted sums say all.

    Attributes:
      source: (3, M), coordinate by coordinate.
      target: (3, M).
      products: (M, 17): of every landmark 1, its places s and t, t ⊗ s and |s|² + |t|².
    """

    source: Array
    target: Array
    products: Array


def _landmarks(source: Array, target: Array) -> _Landmarks:
    outer = (target[:, :, None] * source[:, None, :]).reshape(-1, 9)
    lengths = jnp.sum(source**2 + target**2, axis=1, keepdims=True)
    products = jnp.concatenate([jnp.ones_like(lengths), source, target, outer, lengths], axis=1)
    return _Landmarks(source.T, target.T, products)


def align_landmarks(source: Array, target: Array, weights: Array, *, rounds: int, seeds: Array | None = None) -> Rigid:
    """φ: the transform that carries landmarks (M, 3) of the source onto those of the target, with weights (M,).

    In every round, landmarks at distance r after the alignment are weighed down by (1 + r²/s²)⁻², Geman and McClure's
    weight, where s² is the mean of r² under the weights of the round before: it shrinks as what disagrees grows light.
    A round starts from the weights that were given. Were they to multiply, noise would leave a handful of landmarks.

    Args:
      source: places in the source.
      target: places in the target.
      weights: how much each landmark should count, not negative.
      rounds: how many.
      seeds: (S,), rows of landmarks: the first round starts from the best of their hypotheses, or from the given
        weights where these are better.
    """
    given, landmarks = _relative(weights), _landmarks(source, target)
    start = given
    if rounds and seeds is not None and len(seeds):
        start = _best_start(landmarks, given, _hypothetical_weights(source, target, given, seeds))

    def agreeing(weights: Array, _: None) -> tuple[Array, None]:
        return _weigh(landmarks, given, weights, nearest_rotation), None

    weights, _ = jax.lax.scan(agreeing, start, None, length=rounds)
    return procrustes(source, target, weights, stiffness=_STIFFNESS)


def hypotheses(source: Array, target: Array, weights: Array, seeds: Array) -> Rigid:
    """What each of S seeds would say, rotation (S, 3, 3) and translation (S, 3), after a brief consensus of its own.

    Few of them may be right where the clouds look alike in several poses, or share little: who can tell poses apart by
    the clouds themselves (``urrt_jax.search``) will find it among them. Arguments as for ``align_landmarks``.
    """
    given, landmarks = _relative(weights), _landmarks(source, target)

    def said(weights: Array) -> Rigid:
        weights = jax.lax.fori_loop(0, _BRIEF, lambda _, now: _weigh(landmarks, given, now, quick_rotation), weights)
        return procrustes(source, target, weights, stiffness=_STIFFNESS)

    return jax.vmap(said)(_hypothetical_weights(source, target, given, seeds))


def _relative(weights: Array) -> Array:
    """The weights (M,), the largest of which is 1; their common factor has no derivative."""
    largest = jax.lax.stop_gradient(jnp.max(weights))
    return weights / jnp.where(largest > 0, largest, 1.0)


def _weigh(landmarks: _Landmarks, given: Array, weights: Array, turn: Callable[[Array], Array]) -> Array:
    """The weights (M,) after a round, from those before it."""
    squares, mean = _misfits(landmarks, weights, turn)
    return given / (1 + squares / (mean + _TOLERANCE**2)) ** 2


def _misfits(landmarks: _Landmarks, weights: Array, turn: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Squared distances (M,) after the alignment with weights (M,) of any scale, and their mean under these.

    ``turn`` makes a rotation of a moment. All sums over landmarks are one product with a matrix. The distances
    themselves are made coordinate by coordinate: as products they would lose digits.
    """
    sums = jnp.matmul(weights, landmarks.products, precision=_HIGHEST)
    # Weights that sum to less are nothing: the derivative of a quotient divides by the square of their sum.
    enough = sums[0] > _NOTHING
    sums = jnp.where(enough, sums[1:] / jnp.where(enough, sums[0], 1.0), 0.0)
    here, there, lengths = sums[:3], sums[3:6], sums[15]
    moment = sums[6:15].reshape(3, 3) - there[:, None] * here
    rotation = turn(moment + _STIFFNESS * jnp.eye(3, dtype=moment.dtype))
    shift = there - jnp.sum(rotation * here, axis=1)
    x, y, z = landmarks.source
    apart = [
        rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + shift[k] - landmarks.target[k] for k in range(3)
    ]
    squares = apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2
    mean = lengths - jnp.sum(here**2) - jnp.sum(there**2) - 2 * jnp.sum(rotation * moment)
    return squares, jnp.maximum(mean, 0.0)


def even_seeds(groups: Sequence[int], count: int, real: Sequence[Array | int] | None = None) -> Array:
    """Rows of about ``count`` landmarks that seed hypotheses, evenly spread over groups of landmarks.

    How many a group has depends on its size alone, so that the order of the groups does not matter.

    Args:
      groups: sizes of the groups, whose landmarks follow each other.
      count: how many seeds there are to be.
      real: how many landmarks of each group, its first ones, are no padding; all by default.
    """
    share = min(1.0, count / max(sum(groups), 1))
    rows, begin = [jnp.zeros(0, jnp.int32)], 0
    for size, used in zip(groups, groups if real is None else real, strict=True):
        some = math.ceil(share * size)
        rows.append(begin + jnp.arange(some) * used // max(some, 1))
        begin += size
    return jnp.concatenate(rows).astype(jnp.int32)


def _hypothetical_weights(source: Array, target: Array, given: Array, seeds: Array) -> Array:
    """Weights (S, M) of S hypotheses: a landmark counts as much as it and others back the seed."""
    fits = _compatibility(source, target, seeds)
    backed = fits * jnp.matmul(fits[:, seeds] * given[seeds], fits)
    # Against their own mean, however little speaks for a hypothesis; what is as good as nothing stays nothing.
    mean = jax.lax.stop_gradient(jnp.matmul(backed, given / jnp.maximum(jnp.sum(given), 1.0)))
    return given * (backed / jnp.maximum(mean, _NOTHING)[:, None]) ** 2


def _best_start(landmarks: _Landmarks, given: Array, hypothetical: Array) -> Array:
    """The weights (M,) that say most: those of one of the hypotheses (S, M), or the given ones."""
    start = jnp.concatenate([given[None], hypothetical])
    # Which one is best is a choice, and has no derivative; what the best one says has.
    fixed, trusted, tried = jax.lax.stop_gradient((landmarks, given, start))
    gains = jax.vmap(lambda weights: _gain(fixed, trusted, weights))(tried)
    # A gain that is no number beats nothing, and the given weights win a tie.
    return start[jnp.argmax(jnp.where(gains > gains[0], gains, gains[0]))]


def _gain(landmarks: _Landmarks, given: Array, weights: Array) -> Array:
    """How much of the given weight agrees with the hypothesis of these weights (M,), two rounds after them, ()."""
    squares = _settled_misfits(landmarks, given, weights)
    return jnp.matmul(1 / (1 + jnp.sqrt(squares) / _NEAR), given, precision=_HIGHEST)


def _settled_misfits(landmarks: _Landmarks, given: Array, weights: Array) -> Array:
    """Squared distances (M,) after two rounds; a loop, so that a round is compiled once."""

    def again(_: int, now: tuple[Array, Array]) -> tuple[Array, Array]:
        squares, mean = _misfits(landmarks, now[0], quick_rotation)
        return given / (1 + squares / (mean + _TOLERANCE**2)) ** 2, squares

    return jax.lax.fori_loop(0, 2, again, (weights, weights))[1]


def _compatibility(source: Array, target: Array, seeds: Array) -> Array:
    """How well each landmark agrees with each of S seeds, (S, M) in [0, 1), by their distances in both clouds."""
    # A length of zero has no derivative.
    here, there = (
        jnp.sqrt(jnp.sum((places[seeds, None] - places) ** 2, axis=-1) + 1e-12) for places in (source, target)
    )
    # Landmarks without a place of their own gather in the middle of both clouds, all equally far apart.
    telling = 1 / (1 + (_BASELINE / jnp.minimum(here, there)) ** 2)
    return telling / (1 + ((here - there) / _MISFIT) ** 2) ** 2
