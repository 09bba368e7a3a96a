"""Consensus: the transform on which landmarks agree, of which many may be misplaced.

First hypotheses: what single landmarks and those compatible with them would say, two landmarks being compatible where
they are as far apart in one cloud as in the other (Leordeanu and Hebert 2005) and have compatible landmarks in common
(Chen et al. 2022, SC2-PCR). The best one is where rounds of weighing and aligning start.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax.geometry import rigid
from urrt_jax.geometry.rigid import Rigid, procrustes, quick_rotation

_HIGHEST = jax.lax.Precision.HIGHEST
# Lengths and areas in a frame of unit radius.
_STIFFNESS = 1e-3  # far below the spread of landmarks that mean anything
_TOLERANCE = 0.01  # landmarks this near to each other agree
_MISFIT = 0.05  # of distances between landmarks: a quarter as compatible as without
_BASELINE = 0.3  # landmarks this near to each other, and their misfits, tell half as much as distant ones
_NEAR = 0.05  # a hypothesis gains half of a landmark's weight where it misses it by this


def align_landmarks(
    source: Array, target: Array, weights: Array, *, rounds: int, seeds: np.ndarray | None = None
) -> Rigid:
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
    given = _shares(weights)
    share = given
    if rounds and seeds is not None and len(seeds):
        share = _best_hypothesis(source, target, given, seeds)

    def agreeing(share: Array, _: None) -> tuple[Array, None]:
        return _weigh(source, target, given, share), None

    share, _ = jax.lax.scan(agreeing, share, None, length=rounds)
    return procrustes(source, target, share, stiffness=_STIFFNESS)


def _shares(weights: Array) -> Array:
    """The weights over their sum, however small; zeros stay."""
    largest = jax.lax.stop_gradient(jnp.max(weights))
    weights = weights / jnp.where(largest > 0, largest, 1.0)
    return weights / jnp.maximum(jnp.sum(weights), 1.0)


def _weigh(source: Array, target: Array, given: Array, share: Array) -> Array:
    """The shares (M,) after a round, from those before it."""
    found = procrustes(source, target, share, stiffness=_STIFFNESS)
    square = jnp.sum((rigid.apply(found, source) - target) ** 2, axis=-1)
    return _shares(given / (1 + square / (jnp.sum(share * square) + _TOLERANCE**2)) ** 2)


def even_seeds(groups: Sequence[int], count: int) -> np.ndarray:
    """Rows of about ``count`` landmarks that speak for hypotheses, evenly spread over groups of these sizes.

    How many a group has depends on its size alone, so that the order of the groups does not matter.
    """
    share = min(1.0, count / max(sum(groups), 1))
    ends, chosen = np.cumsum(groups), [math.ceil(share * size) for size in groups]
    rows = [
        end - size + np.arange(some) * size // max(some, 1)
        for end, size, some in zip(ends, groups, chosen, strict=True)
    ]
    return np.concatenate(rows)


def _best_hypothesis(source: Array, target: Array, given: Array, seeds: np.ndarray) -> Array:
    """The shares (M,) of the hypothesis that misses the fewest landmarks by the least, the given shares being one."""
    fits = _compatibility(source, target, seeds)
    backed = fits * jnp.matmul(fits[:, seeds] * given[seeds], fits)
    start = jnp.concatenate([given[None], jax.vmap(_shares)(given * backed**2)])
    # Which one is best is a choice, and has no derivative; what the best one says has.
    gains = _gains(*jax.lax.stop_gradient((source, target, given, start)))
    return start[jnp.argmax(gains)]


def _gains(source: Array, target: Array, given: Array, start: Array) -> Array:
    """How much of the landmarks' weight agrees with each hypothesis (H,), two rounds after its shares (H, M).

    Moments are linear in the products of two places, which are made once.
    """
    outer = (target[:, :, None] * source[:, None, :]).reshape(-1, 9)
    products = jnp.concatenate([source, target, outer], axis=1)

    def squares(share: Array) -> Array:
        mean = jnp.matmul(share, products, precision=_HIGHEST)
        here, there, moment = mean[:3], mean[3:6], mean[6:].reshape(3, 3)
        rotation = quick_rotation(moment - there[:, None] * here + _STIFFNESS * jnp.eye(3))
        shift = there - jnp.sum(rotation * here, axis=1)
        # Coordinate by coordinate, so that no moved places are kept of every hypothesis.
        x, y, z = (jnp.sum(rotation[k] * source, axis=1) + shift[k] - target[:, k] for k in range(3))
        return x**2 + y**2 + z**2

    def gain(share: Array) -> Array:
        square = squares(share)
        square = squares(_shares(given / (1 + square / (jnp.sum(share * square) + _TOLERANCE**2)) ** 2))
        return jnp.sum(given / (1 + jnp.sqrt(square) / _NEAR))

    return jax.vmap(gain)(start)


def _compatibility(source: Array, target: Array, seeds: np.ndarray) -> Array:
    """How well each landmark agrees with each of S seeds, (S, M) in [0, 1), by their distances in both clouds."""
    # A length of zero has no derivative.
    here, there = (
        jnp.sqrt(jnp.sum((places[seeds, None] - places) ** 2, axis=-1) + 1e-12) for places in (source, target)
    )
    # Landmarks without a place of their own gather in the middle of both clouds, all equally far apart.
    telling = 1 / (1 + (_BASELINE / jnp.minimum(here, there)) ** 2)
    return telling / (1 + ((here - there) / _MISFIT) ** 2) ** 2
