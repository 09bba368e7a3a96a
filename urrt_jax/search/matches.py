"""Poses from matched features: mutual nearest features, pruned by how many others each one agrees with."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.rigid import Rigid, procrustes


class Matches(NamedTuple):
    """A match for every source point: the target's row (N,), and whether it is mutual (N,)."""

    row: Array
    mutual: Array


def match_features(source: Array, target: Array, source_mask: Array, target_mask: Array) -> Matches:
    """The most similar target feature (M, F) of every source feature (N, F), by the scalar product."""
    similarity = jnp.where(source_mask[:, None] & target_mask, source @ target.T, -jnp.inf)
    forth, back = jnp.argmax(similarity, axis=1), jnp.argmax(similarity, axis=0)
    return Matches(forth, source_mask & target_mask[forth] & (back[forth] == jnp.arange(len(forth))))


def poses_from_matches(
    source: Cloud, target: Cloud, matches: Matches, distance: Array | float, *, count: int, support: int
) -> Rigid:
    """``count`` rigid hypotheses, rotation (count, 3, 3) and translation (count, 3), from mutual matches.

    Two matches agree when both clouds have the same length between their ends, up to ``distance``: any rigid motion
    keeps lengths. A pair of matches counts as much as there are third ones that agree with both (second-order spatial
    compatibility, Chen et al. 2022), which wrong matches hardly reach by chance. The matches that count most are seeds;
    each gives a pose with the ``support`` matches that count most beside it, and again with all that agree with that
    pose. Deterministic: nothing is drawn.
    """
    ends = target.points[matches.row]
    lengths = [jnp.sqrt(jnp.sum((each[:, None] - each) ** 2, axis=-1)) for each in (source.points, ends)]
    usable = matches.mutual[:, None] & matches.mutual & ~jnp.eye(len(ends), dtype=bool)
    agree = (usable & (jnp.abs(lengths[0] - lengths[1]) < distance)).astype(jnp.float32)
    common = (agree @ agree) * agree
    _, seeds = jax.lax.top_k(jnp.sum(common, axis=1), count)

    def pose(seed: Array) -> Rigid:
        weight, rows = jax.lax.top_k(common[seed], support)
        rows, weight = jnp.append(rows, seed), jnp.append(weight, jnp.max(weight))
        first = procrustes(source.points[rows], ends[rows], weight)
        offset = jnp.sum((rigid.apply(first, source.points) - ends) ** 2, axis=-1)
        inlier = matches.mutual & (offset < jnp.square(distance))
        second = procrustes(source.points, ends, inlier.astype(jnp.float32))
        return jax.tree.map(lambda new, old: jnp.where(jnp.sum(inlier) >= 3, new, old), second, first)

    return jax.vmap(pose)(seeds)
