"""Region-aware decoders by pose: one transform a region, fused by how many points the region holds.

A transform is nine numbers on the way: six for the rotation (two columns, before they are made orthonormal) and three
for the translation. Rotation matrices do not average to a rotation; these do, and are projected once, after the fusion.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.model.blocks import region_perceptrons, run
from urrt_jax.model.config import ModelConfig
from urrt_jax.rigid import Rigid, rotation_from_6d

_IDENTITY_6D = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def pose_decoders(config: ModelConfig) -> nn.Module:
    """The functions {g_k}: n perceptrons with weights of their own, (n, 2d) to (n, 9)."""
    small = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
    return region_perceptrons((*config.decoder_widths, 9), small)


def decode_poses(config: ModelConfig, params: dict, source: Array, target: Array) -> Array:
    """Transform codes (n, 9) from the region features (n, d) of both clouds.

    The decoders give the difference from the identity's code, so an untrained network hardly moves anything.
    """
    pair = jnp.concatenate([source, target], axis=-1)
    return run(pose_decoders(config), params, pair) + jnp.array((*_IDENTITY_6D, 0.0, 0.0, 0.0), pair.dtype)


def fuse_poses(codes: Array, weights: Array) -> Rigid:
    """φ of eq. (3): the transform of the weighted mean of codes (n, 9) with weights (n,)."""
    code = jnp.einsum("k,kc->c", weights, codes, precision=jax.lax.Precision.HIGHEST)
    return Rigid(rotation_from_6d(code[:6]), code[6:])
