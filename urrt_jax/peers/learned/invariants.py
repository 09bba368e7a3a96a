"""Neighbourhoods of points, and features of them that no rotation changes. They carry no derivatives."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.neighbors import top_rows
from urrt_jax.peers.learned.graph import neighbor_rows
from urrt_jax.rigid import cross, normalize


def rows_within(points: Array, mask: Array, radius: float, k: int) -> Array:
    """The rows (N, k) of every point's first k real neighbours, by index, within a radius.

    A point is not its own neighbour. Where it has fewer than k, its own row fills the rest.

    Args:
      points: (N, 3).
      mask: (N,) bool, the real points.
      radius: of the neighbourhood.
      k: neighbours of a point.
    """
    points = jax.lax.stop_gradient(points)
    count = points.shape[0]
    own = jnp.arange(count)
    squared = sum((points[:, None, i] - points[None, :, i]) ** 2 for i in range(3))
    near = mask[None, :] & (squared <= radius**2) & (own[:, None] != own[None, :])
    # Indices as float32, because the CPU selects the largest of those in much less time than of integers.
    rows = top_rows(jnp.where(near, -own.astype(jnp.float32), -jnp.inf), min(k, count))
    rows = jnp.where(jnp.take_along_axis(near, rows, axis=1), rows, own[:, None])
    return jnp.concatenate([rows, jnp.broadcast_to(own[:, None], (count, k - rows.shape[1]))], axis=1)


def point_pair_features(points: Array, normals: Array, rows: Array) -> Array:
    """The angles (n, d), (n', d) and (n, n') and the length of d, for every point and neighbour: (N, k, 4), radians.

    n and n' are the normals of the point and of its neighbour, and d leads from the one to the other (Drost et al.
    2010). A point and itself have zeros.

    Args:
      points: (N, 3).
      normals: (N, 3), of unit length.
      rows: (N, k), the neighbours of every point.
    """
    points, normals = jax.lax.stop_gradient((points, normals))
    offset = points[rows] - points[:, None]
    own, other = jnp.broadcast_to(normals[:, None], offset.shape), normals[rows]
    angles = [_angle(own, offset), _angle(other, offset), _angle(own, other)]
    return jnp.stack([*angles, jnp.linalg.norm(offset, axis=-1)], axis=-1)


def centred_features(points: Array, mask: Array, k: int) -> Array:
    """Features (N, 1 + 3k) of every point and its k nearest neighbours, in a cloud about the origin.

    The rigorously rotation-invariant representation of ClusterNet (Chen et al. 2019). A point p has its
    distance from the origin. Each neighbour q, the nearest one first, has three features: its distance from the origin,
    the angle between p and q, and the smallest turn about p, counter-clockwise, that leads from q to another neighbour.
    Angles are in radians. Neighbours that do not exist, in small clouds, have zeros.

    Args:
      points: (N, 3), the centroid at the origin.
      mask: (N,) bool, the real points.
      k: neighbours of a point.
    """
    points = jax.lax.stop_gradient(points)
    count = points.shape[0]
    rows = neighbor_rows(points, mask, min(k + 1, count))[:, 1:]
    found, others = mask[rows], points[rows]
    axes = jax.vmap(normalize, (0, None))(points, jnp.array([0.0, 0.0, 1.0], points.dtype))[:, None]
    across = others - jnp.sum(others * axes, axis=-1, keepdims=True) * axes
    sine = jnp.sum(cross(across[:, :, None], across[:, None, :]) * axes[:, None], axis=-1)
    cosine = jnp.sum(across[:, :, None] * across[:, None, :], axis=-1)
    turns = jnp.mod(jnp.arctan2(sine, cosine), 2 * jnp.pi)
    usable = found[:, None, :] & ~jnp.eye(rows.shape[1], dtype=bool)
    turn = jnp.min(jnp.where(usable, turns, 2 * jnp.pi), axis=-1, initial=2 * jnp.pi)
    angle = _angle(jnp.broadcast_to(points[:, None], others.shape), others)
    each = jnp.stack([jnp.linalg.norm(others, axis=-1), angle, turn], axis=-1)
    each = jnp.where(found[..., None], each, 0.0)
    each = jnp.pad(each, ((0, 0), (0, k - rows.shape[1]), (0, 0)))
    return jnp.concatenate([jnp.linalg.norm(points, axis=-1, keepdims=True), each.reshape(count, 3 * k)], axis=-1)


def _angle(first: Array, second: Array) -> Array:
    """The angle between vectors (..., 3), in [0, π]; zero where one of them is."""
    return jnp.arctan2(jnp.linalg.norm(cross(first, second), axis=-1), jnp.sum(first * second, axis=-1))
