"""Poses from matched features: mutual nearest features, pruned by how many others each one agrees with."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.rigid import Rigid, procrustes

_ALIKE = 2.0  # degrees between poses that are nearly the same, if they do not shift


class Matches(NamedTuple):
    """A match for every source point: the target's row (N,), and whether it is mutual (N,)."""

    row: Array
    mutual: Array


def match_most_similar(similarity: Array, source_mask: Array, target_mask: Array) -> Matches:
    """The most similar target point of every source point, by the similarity of their features (N, M)."""
    similarity = jnp.where(source_mask[:, None] & target_mask, similarity, -jnp.inf)
    forth, back = jnp.argmax(similarity, axis=1), jnp.argmax(similarity, axis=0)
    return Matches(forth, source_mask & target_mask[forth] & (back[forth] == jnp.arange(len(forth))))


def poses_from_matches(
    source: Cloud, target: Cloud, matches: Matches, distance: Array | float, *, seeds: int, count: int, support: int
) -> Rigid:
    """``count`` rigid hypotheses, rotation (count, 3, 3) and translation (count, 3), from mutual matches.

    Two matches agree when both clouds have the same length between their ends, up to ``distance``: any rigid motion
    keeps lengths. A pair of matches counts as much as there are third ones that agree with both (second-order spatial
    compatibility, Chen et al. 2022), which wrong matches hardly reach by chance. The matches that count most are the
    ``seeds``; each gives a pose with the ``support`` matches that count most beside it, and again with all that agree
    with that pose. Of these poses those with which most matches agree are the hypotheses, one of poses that are nearly
    the same. Deterministic: nothing is drawn.
    """
    ends = target.points[matches.row]
    lengths = [jnp.sqrt(jnp.sum((each[:, None] - each) ** 2, axis=-1)) for each in (source.points, ends)]
    usable = matches.mutual[:, None] & matches.mutual & ~jnp.eye(len(ends), dtype=bool)
    agree = (usable & (jnp.abs(lengths[0] - lengths[1]) < distance)).astype(jnp.float32)
    common = (agree @ agree) * agree
    _, starts = jax.lax.top_k(jnp.sum(common, axis=1), seeds)

    def agreeing(pose: Rigid) -> Array:
        offset = jnp.sum((rigid.apply(pose, source.points) - ends) ** 2, axis=-1)
        return matches.mutual & (offset < jnp.square(distance))

    def pose(seed: Array) -> tuple[Rigid, Array]:
        weight, rows = jax.lax.top_k(common[seed], support)
        rows, weight = jnp.append(rows, seed), jnp.append(weight, jnp.max(weight))
        first = procrustes(source.points[rows], ends[rows], weight)
        inlier = agreeing(first)
        second = procrustes(source.points, ends, inlier.astype(jnp.float32))
        better = rigid.choose(jnp.sum(inlier) >= 3, second, first)
        return better, jnp.sum(agreeing(better))

    poses, number = jax.vmap(pose)(starts)
    if count == seeds:
        return poses
    # Where there are fewer poses that differ, the best one stands for those that are wanting.
    rows, there = rigid.distinct(poses, number.astype(source.points.dtype), count=count, apart=_ALIKE, shift=distance)
    return jax.tree.map(lambda leaf: leaf[jnp.where(there, rows, rows[0])], poses)
