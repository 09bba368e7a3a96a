"""Nearest neighbours by direct differences: masked, exact, differentiable in the distances.

Small clouds are compared point by point; large ones, on a CPU, through compact blocks (``blocks.py``). Squared
distances are sums of squared differences, never |x|² + |y|² − 2xy: in float32 that form is wrong by 2 % for the
smallest distances of a unit cloud and by a factor of five at an offset of 10.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.loops import largest
from urrt_jax.neighbors.blocks import Blocks, make_blocks, nearest_in_blocks

_QUERY_CHUNK = 16_384
LEAST_SPACING = 1e-6  # of clouds whose points all coincide
LARGE = 4096
"""Clouds beyond it are searched through blocks: 40,000 points against as many take 25 ms instead of 200."""


class Neighbors(NamedTuple):
    """For each query: the index of its neighbour in the reference, and the squared distance (inf if there is none)."""

    index: Array
    squared: Array


def nearest(
    query: Array,
    reference: Cloud,
    *,
    blocks: Blocks | None = None,
    within: Array | float = jnp.inf,
    distinct: bool = False,
    block: int | None = 16,
    ordered: bool = False,
    count: Array | None = None,
) -> Neighbors:
    """The nearest real reference point of every query: index (N,) and squared distance (N,).

    Exact for every size. Distances are differentiable in both clouds at fixed neighbours. Of equally near points any
    may be named; the first one, where the reference is small. Memory is O(N + M).

    Args:
      query: (N, 3), finite.
      reference: cloud of M points.
      blocks: ``make_blocks`` of the reference, where it is large and searched again and again.
      within: neighbours must be closer than this, (); large clouds are searched faster for it.
      distinct: pass over reference points that coincide with the query.
      block: small clouds: reference points per step of the loop; None compares all at once, through an (N, M) matrix.
      ordered: whether queries that follow each other are near each other in space, as those of a prepared cloud are,
        however it was moved; saves a sort where the reference is large.
      count: (), the queries from this row on are padding, whose answers mean nothing; None where all are wanted.
    """
    if blocks is None and reference.points.shape[0] > LARGE:
        blocks = make_blocks(reference)
    fixed = jax.lax.stop_gradient(query)
    within = jax.lax.stop_gradient(jnp.asarray(within, query.dtype))
    anchors = jax.lax.stop_gradient(jnp.where(reference.mask[:, None], reference.points, jnp.inf))
    rows = jnp.arange(1, reference.points.shape[0] + 1, dtype=jnp.int32)
    used = largest(jax.lax.stop_gradient(jnp.max(jnp.where(reference.mask, rows, 0))))
    wanted = jnp.array(query.shape[0]) if count is None else jax.lax.stop_gradient(count)

    def compare_all() -> tuple[Array, Array]:
        if block is None:
            return _nearest_dense(fixed, anchors, distinct)
        if query.shape[0] <= 2 * _QUERY_CHUNK:
            return _nearest_scan(fixed, anchors, used, distinct, block)

        size, at_once = query.shape[0], block
        chunks = jnp.pad(fixed, ((0, -size % _QUERY_CHUNK), (0, 0))).reshape(-1, _QUERY_CHUNK, 3)

        def visit(number: Array, answers: tuple[Array, Array]) -> tuple[Array, Array]:
            found = _nearest_scan(chunks[number], anchors, used, distinct, at_once)
            return answers[0].at[number].set(found[0]), answers[1].at[number].set(found[1])

        nothing = jnp.zeros(chunks.shape[:2], jnp.int32), jnp.zeros(chunks.shape[:2], bool)
        needed = (largest(wanted) + _QUERY_CHUNK - 1) // _QUERY_CHUNK
        index, found = jax.lax.fori_loop(0, needed, visit, nothing)
        return index.reshape(-1)[:size], found.reshape(-1)[:size]

    if blocks is not None:
        # Walking over blocks is a loop of small steps: right for a CPU, while accelerators compare all sooner.
        index, found = jax.lax.platform_dependent(
            cpu=lambda: nearest_in_blocks(fixed, blocks, within, distinct, ordered=ordered, count=wanted),
            default=compare_all,
        )
    else:
        index, found = compare_all()
    squared = jnp.sum((query - reference.points[index]) ** 2, axis=-1)
    return Neighbors(index, jnp.where(found & (squared < within**2), squared, jnp.inf))


def _nearest_dense(query: Array, anchors: Array, distinct: bool) -> tuple[Array, Array]:
    squared = sum((query[:, None, k] - anchors[None, :, k]) ** 2 for k in range(3))
    if distinct:
        squared = jnp.where(squared > 0, squared, jnp.inf)
    smallest = jnp.min(squared, axis=1, keepdims=True)
    # The first column equal to the minimum: a fraction of the time of XLA's argmin on a CPU.
    index = jnp.min(jnp.where(squared == smallest, jnp.arange(anchors.shape[0]), anchors.shape[0] - 1), axis=1)
    return index, jnp.isfinite(smallest[:, 0])


def _nearest_scan(query: Array, anchors: Array, used: Array, distinct: bool, block: int) -> tuple[Array, Array]:
    """Goes over the first ``used`` reference points in blocks and keeps the best so far for all queries at once.

    XLA turns it into vector instructions: on a CPU this is far faster than the minimum of a distance matrix.
    """
    count = anchors.shape[0]
    block = min(block, count)
    anchors = jnp.pad(anchors, ((0, -count % block), (0, 0)), constant_values=jnp.inf)
    x, y, z = query.T

    def visit(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        smallest, index = best
        start = step * block
        points = jax.lax.dynamic_slice_in_dim(anchors, start, block)
        for j in range(block):
            squared = (x - points[j, 0]) ** 2 + (y - points[j, 1]) ** 2 + (z - points[j, 2]) ** 2
            closer = squared < smallest
            if distinct:
                closer &= squared > 0
            smallest = jnp.where(closer, squared, smallest)
            index = jnp.where(closer, start + j, index)
        return smallest, index

    nothing = (jnp.full_like(x, jnp.inf), jnp.zeros(x.shape, jnp.int32))
    smallest, index = jax.lax.fori_loop(0, (used + block - 1) // block, visit, nothing)
    return index, jnp.isfinite(smallest)


def k_nearest(query: Array, reference: Cloud, k: int, *, batch_size: int | None = 1024) -> Neighbors:
    """The k nearest real reference points of every query, nearest first: index (N, k), squared distance (N, k).

    Args:
      query: (N, 3).
      reference: cloud of M ≥ k points; where fewer than k are real, the rest has an infinite distance.
      k: neighbours a query.
      batch_size: queries handled at once, which bounds memory by batch_size · M; None for all.

    Raises:
      ValueError: k is not in 1..M.
    """
    if not 1 <= k <= reference.points.shape[0]:
        raise ValueError(f"k: expected 1 to {reference.points.shape[0]}, got {k}")
    anchors = jax.lax.stop_gradient(jnp.where(reference.mask[:, None], reference.points, jnp.inf))

    def one(point: Array) -> Array:
        x, y, z = ((point[i] - anchors[:, i]) ** 2 for i in range(3))
        return top_rows(-(x + y + z), k)

    fixed = jax.lax.stop_gradient(query)
    if batch_size is None:
        index = jax.vmap(one)(fixed)
    else:
        index = jax.lax.map(one, fixed, batch_size=min(batch_size, max(1, query.shape[0])))
    squared = jnp.sum((query[:, None] - reference.points[index]) ** 2, axis=-1)
    return Neighbors(index, jnp.where(reference.mask[index], squared, jnp.inf))


def top_rows(values: Array, k: int) -> Array:
    """Where the k largest values of every row are, largest first and the first of equals first: (..., k).

    No derivative passes.

    Args:
      values: (..., M), float32.
      k: at most M.
    """
    rows = jax.lax.top_k(jax.lax.stop_gradient(values), k)[1]
    # Without the barrier the compiler merges a slice of the rows with the selection, and the CPU sorts all M instead.
    return jax.lax.optimization_barrier(rows)


def coarser_spacing(source: Cloud, target: Cloud) -> Array:
    """The larger of both clouds' spacings, (), never 0: points may all coincide. The clouds have the same shape."""
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), source, target)
    return jnp.maximum(jnp.max(jax.lax.map(spacing, both)), LEAST_SPACING)


def spacing(cloud: Cloud) -> Array:
    """The root-mean-square distance from a real point to its nearest other point, (): the cloud's own resolution.

    Points that coincide say nothing about it and are passed over; distances count as three times their median at most,
    so that stray points don't set it. 0 for fewer than two distinct points.
    """
    return typical_distance(nearest(cloud.points, cloud, distinct=True).squared, cloud.mask)


def typical_distance(squared: Array, mask: Array) -> Array:
    """The spacing, (), of a cloud, some of whose points (N,) have their nearest other point at these squared distances.

    Args:
      squared: (N,), inf where there is none.
      mask: (N,) bool, False for padding.
    """
    usable = mask & jnp.isfinite(squared)
    count = jnp.sum(usable)
    median = jnp.sort(jnp.where(usable, squared, jnp.inf))[count // 2]
    mean = jnp.sum(jnp.where(usable, jnp.minimum(squared, 9.0 * median), 0.0)) / jnp.maximum(count, 1)
    return jnp.where(mean > 0, jnp.sqrt(jnp.where(mean > 0, mean, 1.0)), 0.0)
