"""Region attention: every region attends to every other, with its centroid as its position.

Eq. (2) of the paper sums α(f_i), which the softmax weights, adding to 1, would leave as it is. Here it sums α(f_j).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.model.blocks import Perceptron, run
from urrt_jax.model.config import ModelConfig
from urrt_jax.model.partition import Regions


class PositionEncoding(nn.Module):
    """δ: ℝ³ → ℝᵈ, a trained perceptron of a region's centroid (section 2.2)."""

    config: ModelConfig

    @nn.compact
    def __call__(self, centroids: Array) -> Array:
        """The encoding (n, d) of centroids (n, 3)."""
        return Perceptron((*self.config.position_widths, self.config.width))(centroids)


class RegionAttention(nn.Module):
    """One self-attention layer of eq. (2), with α applied to f_j: as printed, α(f_i), the sum would do nothing.

    The attended features are added to the region's own and normalised, so that layers can be stacked.
    """

    config: ModelConfig

    @nn.compact
    def __call__(self, features: Array, present: Array) -> Array:
        """Attended features (n, d) of region features (n, d); absent regions, (n,) False, are not attended to."""
        width = self.config.width
        query = nn.Dense(width, use_bias=False, name="phi")(features)
        key = nn.Dense(width, use_bias=False, name="psi")(features)
        value = nn.Dense(width, use_bias=False, name="alpha")(features)
        weights = attention_weights(query, key, present)
        return nn.LayerNorm()(features + weights @ value)


def attention_weights(query: Array, key: Array, present: Array) -> Array:
    """Softmax(φ(f_i)ᵀ ψ(f_j)/√d) over the regions j that are present: (n, n), rows sum to 1; zero if none is."""
    logits = query @ key.T / jnp.sqrt(query.shape[-1])
    logits = jnp.where(present[None, :], logits, -jnp.inf)
    logits = jnp.where(jnp.any(present), logits, 0.0)
    return jax.nn.softmax(logits, axis=-1) * jnp.any(present)


class RegionTransformer(nn.Module):
    """The 3D transformer module: position encoding (model C), then the attention layers."""

    config: ModelConfig

    @nn.compact
    def __call__(self, features: Array, centroids: Array, present: Array) -> Array:
        """Attended features (n, d) of region features (n, d) with centroids (n, 3); ``present``: (n,) bool."""
        if self.config.variant == "C":
            features = features + PositionEncoding(self.config, name="position")(centroids)
        for _ in range(self.config.attention_layers):
            features = RegionAttention(self.config)(features, present)
        return features


def attend_regions(config: ModelConfig, params: dict, regions: Regions) -> Array:
    """The region transformer feature sequence a (n, d); zero for empty regions."""
    present = regions.counts > 0
    attended = run(RegionTransformer(config), params, regions.features, regions.centroids, present)
    return jnp.where(present[:, None], attended, 0.0)
