"""The layers that all learned peers share: batch norm over the points of a batch, and layers applied to each point."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.training.trainable import PAIRS

_EPSILON, _MOMENTUM = 1e-5, 0.1  # PyTorch's defaults, which every one of these networks was published with


class BatchNorm(nn.Module):
    """Batch norm (Ioffe and Szegedy 2015) of the real rows of one pair's features.

    In evaluation the stored statistics are used. In training those of the batch are, over all real rows of all pairs,
    and the stored ones move towards them by a tenth, the variance without bias. Rows that are not real are normalised
    like the others and mean nothing.
    """

    @nn.compact
    def __call__(self, features: Array, mask: Array, training: bool) -> Array:
        """Normalised features (..., C).

        Args:
          features: (..., C).
          mask: (...,) bool, the real rows; it may lack trailing axes, which are then real throughout.
          training: whether the statistics are the batch's; then the caller is under ``vmap`` with the axis ``PAIRS``.
        """
        width = features.shape[-1:]
        scale = self.param("scale", nn.initializers.ones, width)
        bias = self.param("bias", nn.initializers.zeros, width)
        stored_mean = self.variable("batch_stats", "mean", jnp.zeros, width)
        stored_variance = self.variable("batch_stats", "variance", jnp.ones, width)
        mean, variance = stored_mean.value, stored_variance.value
        if training:
            mask = mask.reshape(mask.shape + (1,) * (features.ndim - 1 - mask.ndim))
            weight = jnp.broadcast_to(mask, features.shape[:-1]).reshape(-1).astype(features.dtype)
            rows = features.reshape(-1, *width)

            def total(values: Array) -> Array:
                # As a product: the CPU takes several times as long to reduce so many rows.
                return jax.lax.psum(jnp.matmul(weight, values, precision=jax.lax.Precision.HIGHEST), PAIRS)

            count = jnp.maximum(jax.lax.psum(jnp.sum(weight), PAIRS), 1.0)
            mean = total(rows) / count
            # The variance does not change with the mean in the first order, so its derivative need not be taken.
            variance = total((rows - jax.lax.stop_gradient(mean)) ** 2) / count
            unbiased = variance * count / jnp.maximum(count - 1.0, 1.0)
            stored_mean.value += _MOMENTUM * (jax.lax.stop_gradient(mean) - stored_mean.value)
            stored_variance.value += _MOMENTUM * (jax.lax.stop_gradient(unbiased) - stored_variance.value)
        return (features - mean) * jax.lax.rsqrt(variance + _EPSILON) * scale + bias


class Layer(nn.Module):
    """A linear map of every row's features, then batch norm, then (leaky) ReLU: a 1×1 convolution in other words.

    Attributes:
      width: of the result.
      bias: whether the linear map has one.
      slope: of the ReLU below zero.
    """

    width: int
    bias: bool = False
    slope: float = 0.0

    @nn.compact
    def __call__(self, features: Array, mask: Array, training: bool) -> Array:
        """Features (..., width) of features (..., C); ``mask`` and ``training`` as for ``BatchNorm``."""
        features = nn.Dense(self.width, use_bias=self.bias)(features)
        features = BatchNorm()(features, mask, training)
        return jnp.where(features > 0, features, self.slope * features)


def masked_max(features: Array, mask: Array, axis: int = 0) -> Array:
    """The maximum over the real rows along an axis; ``mask`` has the shape of ``features`` without the last axis.

    Its derivative goes to one row. That of ``jnp.max`` goes to the rows that equal the maximum, and is wrong where the
    compiler computes them a second time with another rounding.
    """
    real = jnp.where(mask[..., None], features, -jnp.inf)
    largest = jnp.argmax(jax.lax.stop_gradient(real), axis=axis, keepdims=True)
    return jnp.squeeze(jnp.take_along_axis(real, largest, axis=axis), axis)
