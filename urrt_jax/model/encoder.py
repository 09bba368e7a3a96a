"""Point encoder: an embedding for every point and, by max-pooling, one for the shape.

The paper does not name its encoder. This is PointNet's (Qi et al. 2017). It reads a point's coordinates and, where
decoders give landmarks, the invariants of its surroundings. It has layer normalisation: batch normalisation has a state
and mixes pairs.
"""

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.features.moments import invariant_count
from urrt_jax.maxima import masked_max
from urrt_jax.model.blocks import Perceptron, run
from urrt_jax.model.config import ModelConfig


class PointEncoder(nn.Module):
    """The embedding network of the paper's section 2.1, which it leaves unnamed; here PointNet's (Qi et al. 2017)."""

    config: ModelConfig

    @nn.compact
    def __call__(self, points: Array) -> Array:
        """Point embeddings (N, d) of what is read of each point, (N, ``point_inputs``)."""
        return Perceptron((*self.config.encoder_widths, self.config.width), normalize=True)(points)


def shape_embedding(features: Array, mask: Array) -> Array:
    """e: the maximum of the real points' embeddings, (d,), from (N, d) and (N,); zero for an empty cloud."""
    return jnp.where(jnp.any(mask), masked_max(features, mask), 0.0)


def point_inputs(config: ModelConfig) -> int:
    """How many numbers the encoder reads of a point: its coordinates and, where decoders give landmarks, invariants.

    Decoders that regress the pose see coordinates alone. With invariants they learned much more slowly in a trial.
    """
    return 3 + (invariant_count(config.octaves) if config.decoder == "landmarks" else 0)


def encode_points(config: ModelConfig, params: dict, cloud: Cloud, invariants: Array) -> tuple[Array, Array]:
    """Point embeddings (N, d) and the shape embedding e (d,) of a normalised cloud."""
    described = jnp.concatenate([cloud.points, invariants], axis=1)[:, : point_inputs(config)]
    features = run(PointEncoder(config), params, described)
    return features, shape_embedding(features, cloud.mask)
