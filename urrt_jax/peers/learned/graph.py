"""Neighbour graphs, in space or among features, and the edge convolutions of DGCNN (Wang et al. 2019) over them."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.maxima import masked_max
from urrt_jax.neighbors import k_nearest, top_rows
from urrt_jax.peers.learned.layers import Layer


def neighbor_rows(features: Array, mask: Array, k: int) -> Array:
    """The rows (N, k) of the k nearest real points of every point, nearest first: itself, then its neighbours.

    Where fewer than k points are real, the rest are rows that are not.

    Args:
      features: (N, C), coordinates or features.
      mask: (N,) bool.
      k: at most N.
    """
    if features.shape[1] == 3:
        return k_nearest(features, Cloud(features, mask), k, batch_size=None).index
    fixed = jax.lax.stop_gradient(features)
    # Differences of so many channels would take too long.
    norms = jnp.sum(fixed**2, axis=1)
    squared = norms[:, None] + norms - 2 * jnp.matmul(fixed, fixed.T, precision=jax.lax.Precision.HIGHEST)
    return top_rows(jnp.where(mask[None, :], -squared, -jnp.inf), k)


def neighbor_edges(features: Array, mask: Array, k: int) -> tuple[Array, Array]:
    """Edges (N, k, 2C), each [neighbor, centre], to the k nearest real points, and which are real, (N, k).

    A point is its own first neighbor. Where a cloud has fewer than k points, there are as many edges as points.

    Args:
      features: (N, C), coordinates or features.
      mask: (N,) bool.
      k: edges of a point.
    """
    rows = neighbor_rows(features, mask, min(k, features.shape[0]))
    neighbors = features[rows]
    centres = jnp.broadcast_to(features[:, None], neighbors.shape)
    return jnp.concatenate([neighbors, centres], axis=-1), mask[rows] & mask[:, None]


class EdgeConvolutions(nn.Module):
    """Layers over the edges of one graph; the maxima over the edges of a point, after each, are its features.

    Attributes:
      widths: of the layers over edges.
      width: of the last layer, over points, which takes all maxima.
      slope: of the ReLUs below zero.
    """

    widths: Sequence[int]
    width: int
    slope: float = 0.0

    @nn.compact
    def __call__(self, edges: Array, edge_mask: Array, mask: Array, training: bool) -> Array:
        """Features (N, width) of edges (N, k, C), of which ``edge_mask`` (N, k) are real; ``mask`` (N,): points."""
        maxima = []
        for width in self.widths:
            edges = Layer(width, slope=self.slope)(edges, edge_mask, training)
            maxima.append(masked_max(edges, edge_mask, axis=1))
        # A point without a real edge is padding.
        features = jnp.where(mask[:, None], jnp.concatenate(maxima, axis=-1), 0.0)
        return Layer(self.width, slope=self.slope)(features, mask, training)
