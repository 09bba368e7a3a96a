"""A large cloud cut into compact blocks: exact nearest neighbours without comparing all pairs.

Runs of points along a space-filling curve have small bounding boxes. A tile of queries visits whole blocks, the nearest
box first, until no box can hold a nearer point. Each visit is dense arithmetic on short vectors, which suits XLA.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud, curve_order
from urrt_jax.loops import largest

_MANY = 200_000  # from here on, fewer and larger blocks: each tile looks at all their boxes
_TILE = 64  # queries that visit blocks together
_UNROLL = 16


class Blocks(NamedTuple):
    """Blocks of S points each, B of them, and their bounding boxes.

    Attributes:
      points: (B, 3, S), the points of each block, coordinate by coordinate; padding is infinitely far away.
      rows: (B, S) int32, their rows in the cloud.
      low: (B, 3), the smallest coordinates of each block; inf for a block of padding.
      high: (B, 3), the largest.
    """

    points: Array
    rows: Array
    low: Array
    high: Array


def make_blocks(cloud: Cloud, *, ordered: bool = False) -> Blocks:
    """The cloud's blocks; no derivative passes to them.

    Args:
      cloud: N points.
      ordered: whether the points already lie along ``curve_order``, padding last; if not, they are sorted.
    """
    count = cloud.points.shape[0]
    size = 128 if count < _MANY else 256
    rows = jnp.arange(count) if ordered else curve_order(cloud.points, cloud.mask)
    rows = rows.astype(jnp.int32)
    points = jax.lax.stop_gradient(jnp.where(cloud.mask[:, None], cloud.points, jnp.inf))
    points = points if ordered else points[rows]
    points = jnp.pad(points, ((0, -count % size), (0, 0)), constant_values=jnp.inf).reshape(-1, size, 3)
    rows = jnp.pad(rows, (0, -count % size)).reshape(-1, size)
    high = jnp.max(jnp.where(jnp.isfinite(points), points, -jnp.inf), axis=1)
    return Blocks(jnp.swapaxes(points, 1, 2), rows, jnp.min(points, axis=1), high)


def nearest_in_blocks(
    query: Array, blocks: Blocks, within: Array | float, distinct: bool, *, ordered: bool = False, count: Array
) -> tuple[Array, Array]:
    """The row (N,) of the nearest real point of every query (N, 3) that is closer than ``within``, and whether one is.

    Args:
      query: (N, 3), finite.
      blocks: of M points.
      within: what lies farther is not looked for, which saves most of the work where little lies nearer.
      distinct: pass over points that coincide with the query.
      ordered: whether queries that follow each other are near each other in space; if not, they are sorted.
      count: (), queries from this row on need no answer.
    """
    size = query.shape[0]
    if not size:
        return jnp.zeros(0, jnp.int32), jnp.zeros(0, bool)
    tile = min(_TILE, size)
    wanted = jnp.arange(size) < count
    order = None if ordered else curve_order(query, wanted)
    arranged = query if order is None else query[order]
    tiles = jnp.pad(arranged, ((0, -size % tile), (0, 0)), mode="edge").reshape(-1, tile, 3)
    limit = jnp.full(tile, jnp.square(jnp.asarray(within, query.dtype)))

    def walk(number: Array, places: Array) -> Array:
        return places.at[number].set(_walk(tiles[number], blocks, limit, distinct))

    nowhere = jnp.full(tiles.shape[:2], -1, jnp.int32)
    places = jax.lax.fori_loop(0, (largest(count) + tile - 1) // tile, walk, nowhere).reshape(-1)[:size]
    found = places >= 0
    row = jnp.where(found, blocks.rows.reshape(-1)[jnp.maximum(places, 0)], 0)
    if order is None:
        return row, found
    return jnp.zeros_like(row).at[order].set(row), jnp.zeros_like(found).at[order].set(found)


def _walk(queries: Array, blocks: Blocks, limit: Array, distinct: bool) -> Array:
    """The place (T,) among the blocks' points of the nearest to each query (T, 3), -1 where none is near enough."""
    size = blocks.points.shape[2]
    low, high = jnp.min(queries, axis=0), jnp.max(queries, axis=0)
    # Squared distance from the tile's box to every block's: nothing in the block is nearer to any query.
    beyond = [jnp.maximum(blocks.low[:, k] - high[k], low[k] - blocks.high[:, k]) for k in range(3)]
    gaps = sum(jnp.square(jnp.maximum(each, 0.0)) for each in beyond)
    numbers = jnp.arange(len(blocks.low), dtype=jnp.int32)
    x, y, z = queries.T

    def visit(block: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        points = blocks.points[block]

        def compare(step: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
            smallest, place = best
            some = jax.lax.dynamic_slice(points, (0, step * _UNROLL), (3, _UNROLL))
            for j in range(_UNROLL):
                squared = (x - some[0, j]) ** 2 + (y - some[1, j]) ** 2 + (z - some[2, j]) ** 2
                closer = squared < smallest
                if distinct:
                    closer &= squared > 0
                smallest = jnp.where(closer, squared, smallest)
                place = jnp.where(closer, block * size + step * _UNROLL + j, place)
            return smallest, place

        return jax.lax.fori_loop(0, size // _UNROLL, compare, best)

    def promising(state: tuple) -> Array:
        _, least, best = state
        return least < jnp.max(best[0])

    def step(state: tuple) -> tuple:
        gaps, least, best = state
        # The first equal to the minimum: XLA's argmin is not vectorised on a CPU.
        block = jnp.min(jnp.where(gaps == least, numbers, len(numbers) - 1))
        gaps = gaps.at[block].set(jnp.inf)
        return gaps, jnp.min(gaps), visit(block, best)

    nothing = limit, jnp.full(queries.shape[0], -1, jnp.int32)
    return jax.lax.while_loop(promising, step, (gaps, jnp.min(gaps), nothing))[2][1]
