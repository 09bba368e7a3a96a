"""RIENet's inlier evaluation: how much each source point counts, judged by how its neighbourhood came across."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.peers.learned.layers import BatchNorm, Layer

SLOPE = 0.2
"""Of the leaky ReLUs below zero."""
ATTENTION, LAST = 16, 8
"""Widths of the layers after the differences of neighbourhoods, and of the last but one."""


class NeighborConvolution(nn.Module):
    """A convolution of kernel 3 along the neighbours of each point, in order of distance; batch norm; leaky ReLU.

    Attributes:
      width: of the result.
    """

    width: int

    @nn.compact
    def __call__(self, edges: Array, edge_mask: Array, training: bool) -> Array:
        """Features (N, k, width) of edges (N, k, C), of which ``edge_mask`` (N, k) are real."""
        # An edge that is not real is the convolution's zero padding.
        edges = jnp.where(edge_mask[..., None], edges, 0.0)
        edges = nn.Conv(self.width, kernel_size=(3,), padding=1)(edges)
        edges = BatchNorm()(edges, edge_mask, training)
        return jnp.where(edges > 0, edges, SLOPE * edges)


class InlierWeights(nn.Module):
    """Weights in [0, 1] of correspondences, by the edges around each point before and after matching.

    RIENet (Shen et al. 2022), eqs. 5 to 7.

    Attributes:
      hidden: width of the first convolution along the neighbours; the second is twice as wide.
    """

    hidden: int

    def setup(self) -> None:
        self.first = NeighborConvolution(self.hidden)
        self.second = NeighborConvolution(2 * self.hidden)
        self.values = [Layer(ATTENTION, bias=True, slope=SLOPE) for _ in range(2)]
        self.scores = [Layer(ATTENTION, bias=True, slope=SLOPE) for _ in range(2)]
        self.last = Layer(LAST, bias=True, slope=SLOPE)
        self.output = nn.Dense(1)

    def __call__(self, source: Array, matched: Array, edge_mask: Array, mask: Array, training: bool) -> Array:
        """The weights (N,), zero for padding.

        Args:
          source: (N, k, 3), centre minus neighbour, nearest neighbour first.
          matched: (N, k, 3), the same differences between the points that these were matched to.
          edge_mask: (N, k) bool, the real edges.
          mask: (N,) bool, the real points.
          training: as for ``BatchNorm``, which sees ``matched`` first.
        """
        matched = self._neighborhood(matched, edge_mask, training)
        difference = matched - self._neighborhood(source, edge_mask, training)
        values = scores = difference
        for layer in self.values:
            values = layer(values, edge_mask, training)
        for layer in self.scores:
            scores = layer(scores, edge_mask, training)
        # A finite number in place of -inf: padding points have no real edge, and NaN would spoil the gradient.
        scores = jnp.where(edge_mask[..., None], scores, jnp.finfo(scores.dtype).min)
        pooled = jnp.sum(values * jax.nn.softmax(scores, axis=1), axis=1)
        error = self.output(self.last(pooled, mask, training))[:, 0]
        return jnp.where(mask, 1.0 - jnp.tanh(jnp.abs(error)), 0.0)

    def _neighborhood(self, edges: Array, edge_mask: Array, training: bool) -> Array:
        return self.second(self.first(edges, edge_mask, training), edge_mask, training)
