"""The layers that learned peers share: batch and group norm, and dense layers with them, applied to each point."""

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
            rows, weight = _rows(features, mask)

            def total(values: Array) -> Array:
                return jax.lax.psum(_sum_rows(weight, values), PAIRS)

            count = jnp.maximum(jax.lax.psum(jnp.sum(weight), PAIRS), 1.0)
            mean = total(rows) / count
            # The variance does not change with the mean in the first order, so its derivative need not be taken.
            variance = total((rows - jax.lax.stop_gradient(mean)) ** 2) / count
            unbiased = variance * count / jnp.maximum(count - 1.0, 1.0)
            stored_mean.value += _MOMENTUM * (jax.lax.stop_gradient(mean) - stored_mean.value)
            stored_variance.value += _MOMENTUM * (jax.lax.stop_gradient(unbiased) - stored_variance.value)
            factor = jax.lax.rsqrt(variance + _EPSILON) * scale
            return _scaled(rows, weight, mean, factor, bias).reshape(features.shape)
        return (features - mean) * jax.lax.rsqrt(variance + _EPSILON) * scale + bias


class GroupNorm(nn.Module):
    """Group norm (Wu and He 2018) over the real rows of one cloud; rows that are not real mean nothing.

    Attributes:
      groups: of channels, each normalised as a whole.
    """

    groups: int

    @nn.compact
    def __call__(self, features: Array, mask: Array) -> Array:
        """Normalised features (..., C); ``mask`` may lack trailing axes, which are then real throughout."""
        width = features.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (width,))
        bias = self.param("bias", nn.initializers.zeros, (width,))
        rows, weight = _rows(features, mask)
        count = jnp.maximum(jnp.sum(weight), 1.0) * (width // self.groups)

        def mean_of(values: Array) -> Array:
            groups = jnp.sum(_sum_rows(weight, values).reshape(self.groups, -1), axis=1) / count
            return jnp.repeat(groups, width // self.groups)

        mean = mean_of(rows)
        # The variance does not change with the mean in the first order, so its derivative need not be taken.
        variance = mean_of((rows - jax.lax.stop_gradient(mean)) ** 2)
        factor = jax.lax.rsqrt(variance + _EPSILON) * scale
        # Not _scaled, which has no forward-mode derivative: estimates are made with this norm, too.
        return ((rows - mean) * factor + bias).reshape(features.shape)


def _rows(features: Array, mask: Array) -> tuple[Array, Array]:
    """Features (..., C) as rows (N, C), and 1 where a row is real, 0 elsewhere: (N,)."""
    mask = mask.reshape(mask.shape + (1,) * (features.ndim - 1 - mask.ndim))
    weight = jnp.broadcast_to(mask, features.shape[:-1]).reshape(-1).astype(features.dtype)
    return features.reshape(-1, features.shape[-1]), weight


def _sum_rows(weight: Array, rows: Array) -> Array:
    """The weighted sum (C,) of rows (N, C), as a product: the CPU takes several times as long to reduce so many."""
    return jnp.matmul(weight, rows, precision=jax.lax.Precision.HIGHEST)


@jax.custom_vjp
def _scaled(rows: Array, weight: Array, mean: Array, factor: Array, bias: Array) -> Array:
    """Rows (N, C), less their mean, times a factor, plus a bias, (C,) each; sums in its derivative are products.

    The derivative counts the rows whose weight is 1; the others, of weight 0, mean nothing.
    """
    return (rows - mean) * factor + bias


def _scaled_forward(rows: Array, weight: Array, mean: Array, factor: Array, bias: Array) -> tuple[Array, tuple]:
    return _scaled(rows, weight, mean, factor, bias), (rows, weight, mean, factor)


def _scaled_backward(kept: tuple, gradient: Array) -> tuple[Array | None, ...]:
    rows, weight, mean, factor = kept
    total = _sum_rows(weight, gradient)
    along = _sum_rows(weight, gradient * (rows - mean))
    return gradient * factor, None, -factor * total, along, total


_scaled.defvjp(_scaled_forward, _scaled_backward)


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
