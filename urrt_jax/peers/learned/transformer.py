"""The transformer of Deep Closest Point (Wang and Solomon 2019), which PRNet has too: each cloud attends to the other.

One encoder and one decoder block after Vaswani et al. 2017, with the norm before each sublayer, without positions and
without dropout.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.peers.learned.matching import soft_matches

_EPSILON = 1e-6  # beside the standard deviation, not within its root

# PyTorch's default, uniform in ±1/√C_in: the published networks began with it.
_Dense = functools.partial(nn.Dense, kernel_init=nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform"))


class Transformer(nn.Module):
    """What each cloud's features learn from the other's: residuals that the networks add to the features.

    Attributes:
      heads: of every attention; they share the features' width.
      hidden: width within the feed-forward layers.
      slope: of their ReLU below zero.
    """

    heads: int
    hidden: int
    slope: float = 0.0

    def setup(self) -> None:
        self.encoder = _Block(self.heads, self.hidden, self.slope)
        self.decoder = _Block(self.heads, self.hidden, self.slope)

    def __call__(self, source: Array, target: Array, source_mask: Array, target_mask: Array) -> tuple[Array, Array]:
        """The residuals (N, C) and (M, C) of the features (N, C) and (M, C), by the same weights for both clouds.

        A cloud's residual is the decoder's output for its features, with the other's encoded features as memory.
        """
        source_memory = self.encoder(source, source_mask), source_mask
        target_memory = self.encoder(target, target_mask), target_mask
        return self.decoder(source, source_mask, target_memory), self.decoder(target, target_mask, source_memory)


class _Block(nn.Module):
    """Self-attention, attention to a memory if there is one, and a feed-forward layer; then a norm."""

    heads: int
    hidden: int
    slope: float

    @nn.compact
    def __call__(self, features: Array, mask: Array, memory: tuple[Array, Array] | None = None) -> Array:
        normed = _Norm()(features)
        features = features + _Attention(self.heads)(normed, normed, mask)
        if memory is not None:
            features = features + _Attention(self.heads)(_Norm()(features), *memory)
        hidden = _Dense(self.hidden)(_Norm()(features))
        hidden = jnp.where(hidden > 0, hidden, self.slope * hidden)
        return _Norm()(features + _Dense(features.shape[-1])(hidden))


class _Attention(nn.Module):
    """Multi-head attention (Vaswani et al. 2017, section 3.2) of queries (N, C) to the real rows of a memory (M, C)."""

    heads: int

    @nn.compact
    def __call__(self, queries: Array, memory: Array, memory_mask: Array) -> Array:
        width = queries.shape[-1]

        def project(features: Array) -> Array:
            return _Dense(width)(features).reshape(-1, self.heads, width // self.heads)

        query, key, value = project(queries), project(memory), project(memory)
        logits = jnp.einsum("nhc,mhc->hnm", query, key) / jnp.sqrt(query.shape[-1])
        attention = jax.vmap(soft_matches, (0, None))(logits, memory_mask)
        mixed = jnp.einsum("hnm,mhc->nhc", attention, value)
        return _Dense(width)(mixed.reshape(-1, width))


class _Norm(nn.Module):
    """Layer norm that divides by the standard deviation without bias, plus 1e-6."""

    @nn.compact
    def __call__(self, features: Array) -> Array:
        width = features.shape[-1:]
        scale = self.param("scale", nn.initializers.ones, width)
        bias = self.param("bias", nn.initializers.zeros, width)
        centred = features - jnp.mean(features, axis=-1, keepdims=True)
        variance = jnp.sum(centred**2, axis=-1, keepdims=True) / (features.shape[-1] - 1)
        varies = variance > 0  # the root has no derivative at zero, and rows of padding may be constant
        deviation = jnp.where(varies, jnp.sqrt(jnp.where(varies, variance, 1.0)), 0.0)
        return scale * centred / (deviation + _EPSILON) + bias
