"""Region-aware decoding: from the regions of both clouds to one transform.

Decoder g_k reads what region k knows of both clouds and gives its share of the answer; the shares are fused by how many
points the region holds. What a share is, is the configuration's: landmarks (``landmarks.py``) or a pose (``pose.py``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.clouds import Cloud
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.model.blocks import run
from urrt_jax.model.config import ModelConfig
from urrt_jax.model.landmarks import align_landmarks, key_network, landmark_decoders, place_landmarks
from urrt_jax.model.pose import decode_poses, fuse_poses, pose_decoders


class Parts(NamedTuple):
    """What the decoders read of one cloud: its regions, or for model A the whole shape as a single one.

    Attributes:
      features: (n, d), attended.
      counts: (n,), points in each.
      cloud: N points.
      keys: (N, c), by which landmarks find points; None where decoders give poses.
    """

    features: Array
    counts: Array
    cloud: Cloud
    keys: Array | None


def init_decoder(config: ModelConfig, key: Array) -> dict:
    """Fresh parameters of the decoders."""
    pair = jnp.zeros((config.regions if config.has_regions else 1, 2 * config.width))
    if config.decoder == "pose":
        return dict(pose_decoders(config).init(key, pair)["params"])
    keys, queries = jax.random.split(key)
    embedding = jnp.zeros((1, config.width))
    return {
        "keys": key_network(config).init(keys, embedding)["params"],
        "landmarks": landmark_decoders(config).init(queries, pair)["params"],
    }


def point_keys(config: ModelConfig, params: dict, features: Array) -> Array | None:
    """The keys (N, c) of points from their embeddings (N, d); None where decoders give poses."""
    return None if config.decoder == "pose" else run(key_network(config), params["keys"], features)


def decode(config: ModelConfig, params: dict, source: Parts, target: Parts) -> Rigid:
    """φ of eq. (3): the transform from source to target that the decoders see."""
    weights = fusion_weights(source.counts, target.counts)
    if source.keys is None or target.keys is None:
        return fuse_poses(decode_poses(config, params, source.features, target.features), weights)
    seekers, here, there = params["landmarks"], source.features, target.features
    return align_landmarks(
        place_landmarks(config, seekers, here, there, source.keys, source.cloud),
        place_landmarks(config, seekers, there, here, target.keys, target.cloud),
        weights,
    )


def fusion_weights(source_counts: Array, target_counts: Array) -> Array:
    """N_k/N of eq. (3), (n,), summing to 1, over the regions that both clouds have.

    A region that one cloud lacks has no counterpart and weighs nothing; if no region is shared, plain counts decide.
    """
    counts = source_counts + target_counts
    shared = jnp.where((source_counts > 0) & (target_counts > 0), counts, 0.0)
    weights = jnp.where(jnp.sum(shared) > 0, shared, counts)
    return weights / jnp.maximum(jnp.sum(weights), 1.0)
