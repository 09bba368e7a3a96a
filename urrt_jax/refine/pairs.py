"""Correspondences of two clouds: every query point of either cloud with its nearest neighbour in the other one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.neighbors import Blocks, nearest
from urrt_jax.rigid import Rigid


class Surface(NamedTuple):
    """What refinement knows of a cloud of N points.

    Attributes:
      queries: Q of its points, which look for their nearest neighbours in the other cloud.
      normals: (Q, 3), the unit normals there.
      cloud: all of its points, among which the other cloud's queries find theirs.
      blocks: of a large cloud (``neighbors.make_blocks``).
    """

    queries: Cloud
    normals: Array
    cloud: Cloud
    blocks: Blocks | None


class Pairs(NamedTuple):
    """P = 2·Q correspondences in the target's frame: first those of the source's queries, then those of the target's.

    Attributes:
      source: (P, 3), the source's points where the transform puts them.
      target: (P, 3).
      normals: (P, 3), at the query's end.
      squared: (P,), the squared distance; inf for a row that is no correspondence.
      rows: (P,) int32, the row of the neighbour in its cloud.
    """

    source: Array
    target: Array
    normals: Array
    squared: Array
    rows: Array


def both(source: Surface, target: Surface) -> Surface:
    """The surfaces of both clouds as one, with a leading axis: source, target. They must have the same sizes."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), source, target)


def find_pairs(surfaces: Surface, transform: Rigid, within: Array | float) -> Pairs:
    """The correspondences closer than ``within`` when the source is moved by ``transform``.

    Args:
      surfaces: of ``both`` clouds.
      transform: from source to target.
      within: ().
    """
    moved = rigid.apply(transform, surfaces.queries.points[0])
    back = rigid.apply(rigid.inverse(transform), surfaces.queries.points[1])
    placed = jnp.stack([moved, back])

    def search(side: Array) -> tuple[Array, Array]:
        cloud, blocks = jax.tree.map(lambda leaf: leaf[1 - side], (surfaces.cloud, surfaces.blocks))
        return nearest(placed[side], cloud, blocks=blocks, within=within, ordered=True)

    # A loop over the two directions: the search is compiled once.
    rows, squared = jax.lax.map(search, jnp.arange(2))
    usable = jnp.isfinite(squared) & surfaces.queries.mask
    pairs = pair_up(surfaces, transform, rows.ravel())
    return pairs._replace(squared=jnp.where(usable.ravel(), pairs.squared, jnp.inf))


def pair_up(surfaces: Surface, transform: Rigid, rows: Array) -> Pairs:
    """The correspondences with these neighbours (P,), differentiable in both clouds and the transform."""
    forth, back = rows.reshape(2, -1)
    queries, points, normals = surfaces.queries.points, surfaces.cloud.points, surfaces.normals
    moved = rigid.apply(transform, jnp.concatenate([queries[0], points[0][back]]))
    fixed = jnp.concatenate([points[1][forth], queries[1]])
    normals = jnp.concatenate([rigid.rotate(transform.rotation, normals[0]), normals[1]])
    return Pairs(moved, fixed, normals, jnp.sum((moved - fixed) ** 2, axis=-1), rows)


def robust_weights(squared: Array, width: Array) -> Array:
    """Geman and McClure's weights (1 + d²/w²)⁻² of squared distances (P,): a quarter at the width, 0 at infinity."""
    finite = jnp.isfinite(squared)
    return jnp.where(finite, (1 + jnp.where(finite, squared, 0.0) / width**2) ** -2, 0.0)
