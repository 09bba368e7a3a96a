"""PointNet (Qi et al. 2017) without its transformers: one feature vector of a whole cloud."""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from urrt_jax.maxima import masked_max
from urrt_jax.peers.learned.layers import Layer


class PointNet(nn.Module):
    """Layers applied to each point alone, then the maximum over the real points.

    Attributes:
      widths: of the layers. Each, the last one included, is a linear map with bias, then batch norm, then ReLU.
    """

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, points: Array, mask: Array, training: bool) -> Array:
        """The feature (widths[-1],) of a cloud; zero where it has no real point.

        Args:
          points: (N, 3).
          mask: (N,) bool, the real points.
          training: whether batch norm takes the statistics of the batch, as for ``BatchNorm``.
        """
        features = points
        for width in self.widths:
            features = Layer(width, bias=True)(features, mask, training)
        return jnp.where(jnp.any(mask), masked_max(features, mask), 0.0)
