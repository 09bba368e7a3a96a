"""PointNet (Qi et al. 2017) without its transformers: one feature vector of a whole cloud."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.peers.learned.layers import Layer, masked_max


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
        return jnp.where(jnp.any(mask), _largest(features, mask), 0.0)


@jax.custom_jvp
def _largest(features: Array, mask: Array) -> Array:
    """The maximum (C,) over the real rows of features (N, C); its derivative is that of the first row that has it.

    JAX's own derivative looks for the entries that equal the maximum. Where the compiler computes the features twice
    and rounds them differently, it may find none. A row that is picked by its index always has its derivative.
    """
    return masked_max(features, mask)


@_largest.defjvp
def _largest_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (features, mask), (features_dot, _) = primals, tangents
    best = jnp.argmax(jnp.where(mask[:, None], jax.lax.stop_gradient(features), -jnp.inf), axis=0)[None]
    return jnp.take_along_axis(features, best, axis=0)[0], jnp.take_along_axis(features_dot, best, axis=0)[0]
