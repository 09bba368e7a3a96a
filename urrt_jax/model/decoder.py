"""Region-aware decoders: one transform a region, fused by how many points the region holds.

A transform is nine numbers on the way: six for the rotation (two columns, before they are made orthonormal) and three
for the translation. Rotation matrices do not average to a rotation; these do, and are projected once, after the fusion.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.rigid import Rigid, rotation_from_6d
from urrt_jax.model.blocks import Perceptron, run
from urrt_jax.model.config import ModelConfig

_IDENTITY_6D = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def decoders(config: ModelConfig) -> nn.Module:
    """The functions {g_k}: n perceptrons with weights of their own, (n, 2d) to (n, 9); a single one for model A."""
    small = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
    kind = Perceptron
    if config.has_regions:
        kind = nn.vmap(Perceptron, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=0, out_axes=0)
    return kind((*config.decoder_widths, 9), normalize=True, output_init=small)


def decode(config: ModelConfig, params: dict, source: Array, target: Array) -> Array:
    """Transform codes: (n, 9) from region features (n, d) of both clouds, or (9,) from shape embeddings (d,).

    The decoders give the difference from the identity's code, so an untrained network hardly moves anything.
    """
    pair = jnp.concatenate([source, target], axis=-1)
    return run(decoders(config), params, pair) + jnp.array((*_IDENTITY_6D, 0.0, 0.0, 0.0), pair.dtype)


def fusion_weights(source_counts: Array, target_counts: Array) -> Array:
    """N_k/N of eq. (3), (n,), summing to 1, over the regions that both clouds have.

    A region that one cloud lacks has no counterpart and weighs nothing; if no region is shared, plain counts decide.
    """
    counts = source_counts + target_counts
    shared = jnp.where((source_counts > 0) & (target_counts > 0), counts, 0.0)
    weights = jnp.where(jnp.sum(shared) > 0, shared, counts)
    return weights / jnp.maximum(jnp.sum(weights), 1.0)


def fuse(codes: Array, weights: Array) -> Rigid:
    """φ of eq. (3): the transform of the weighted mean of codes (n, 9) with weights (n,)."""
    return to_rigid(jnp.einsum("k,kc->c", weights, codes, precision=jax.lax.Precision.HIGHEST))


def to_rigid(code: Array) -> Rigid:
    """The transform of one code (9,)."""
    return Rigid(rotation_from_6d(code[:6]), code[6:])
