"""Region-aware decoding: from the encodings of both clouds to one transform.

Decoder g_k reads what region k knows of both clouds and gives its share of the answer; the shares are fused by how many
points the region holds. What a share is, is the configuration's: landmarks (``landmarks.py``), aligned where they agree
(``consensus.py``), or a pose (``pose.py``).
"""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.features.moments import invariant_count
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.model.config import ModelConfig
from urrt_jax.model.consensus import align_landmarks, even_seeds
from urrt_jax.model.encoding import Encoding
from urrt_jax.model.landmarks import (
    Queries,
    key_size,
    landmark_decoders,
    place_keys,
    place_landmarks,
    point_queries,
    point_trust,
    region_queries,
    surroundings_keys,
)
from urrt_jax.model.pose import decode_poses, fuse_poses, pose_decoders


def init_decoder(config: ModelConfig, key: Array) -> dict:
    """Fresh parameters of the decoders."""
    pair = jnp.zeros((config.regions if config.has_regions else 1, 2 * config.width))
    if config.decoder == "pose":
        return dict(pose_decoders(config).init(key, pair)["params"])
    keys = jax.random.split(key, 4)
    params = {
        "keys": place_keys(config).init(keys[0], jnp.zeros((1, config.width)))["params"],
        "landmarks": landmark_decoders(config).init(keys[1], pair)["params"],
    }
    if config.octaves:
        invariants = jnp.zeros((1, invariant_count(config.octaves)))
        params["surroundings"] = surroundings_keys(config).init(keys[2], invariants)["params"]
    if config.lookups:
        params["trust"] = point_trust().init(keys[3], jnp.zeros((1, key_size(config))))["params"]
    return params


def decode(config: ModelConfig, params: dict, source: Encoding, target: Encoding) -> Rigid:
    """φ of eq. (3): the transform from source to target that the decoders see."""
    weights = fusion_weights(source.regions.counts, target.regions.counts)
    features = source.regions.features, target.regions.features
    if config.decoder == "pose":
        return fuse_poses(decode_poses(config, params, *features), weights)
    queries = region_queries(config, params["landmarks"], *features, weights)
    groups = [len(queries.weights)]
    if config.lookups:
        some = [_some_points(encoding, config.lookups) for encoding in (source, target)]
        groups += [len(keys) for keys, _ in some]
        asked = point_queries(config, params["trust"], *map(jnp.concatenate, zip(*some, strict=True)))
        queries = Queries(*(jnp.concatenate(both) for both in zip(queries, asked, strict=True)))
    places = place_landmarks(config.sharpness * queries.source, source.keys, source.cloud)
    others = place_landmarks(config.sharpness * queries.target, target.keys, target.cloud)
    # As many of either cloud's points, so that swapped clouds have the same ones.
    seeds = even_seeds(groups, config.hypotheses)
    return align_landmarks(places, others, queries.weights, rounds=config.consensus, seeds=seeds)


def _some_points(encoding: Encoding, count: int) -> tuple[Array, Array]:
    """The keys and the mask of ``count`` points, evenly spread: outliers are first among farthest ones."""
    keys, mask = encoding.keys, encoding.cloud.mask
    rows, real = jnp.arange(min(count, mask.shape[0])), jnp.sum(mask)
    rows = jnp.where(real > rows.shape[0], rows * real // rows.shape[0], rows)
    return keys[rows], mask[rows]


def fusion_weights(source_counts: Array, target_counts: Array) -> Array:
    """N_k/N of eq. (3), (n,), summing to 1, over the regions that both clouds have.

    A region that one cloud lacks has no counterpart and weighs nothing; if no region is shared, plain counts decide.
    """
    counts = source_counts + target_counts
    shared = jnp.where((source_counts > 0) & (target_counts > 0), counts, 0.0)
    weights = jnp.where(jnp.sum(shared) > 0, shared, counts)
    return weights / jnp.maximum(jnp.sum(weights), 1.0)
