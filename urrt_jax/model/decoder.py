"""Region-aware decoding: from the encodings of both clouds to one transform.

Decoder g_k reads the features of region k in both clouds and gives that region's share of the transform; the shares are
weighted by how many points the region holds. The paper does not say what a share is, and a weighted sum of rotation
matrices is no rotation. Here shares are landmarks (``landmarks``), aligned where they agree (``consensus``), or the
nine numbers of a pose (``pose``), as the configuration says.
"""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.features.moments import invariant_count
from urrt_jax.loops import each_cloud
from urrt_jax.model.config import ModelConfig
from urrt_jax.model.consensus import align_landmarks, even_seeds, hypotheses
from urrt_jax.model.encoding import Encoding
from urrt_jax.model.landmarks import (
    key_size,
    landmark_decoders,
    lookup_weights,
    place_keys,
    place_landmarks,
    point_trust,
    region_queries,
    surroundings_keys,
)
from urrt_jax.model.pose import decode_poses, fuse_poses, pose_decoders
from urrt_jax.rigid import Rigid


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
    if config.decoder == "pose":
        poses = decode_poses(config, params, source.regions.features, target.regions.features)
        return fuse_poses(poses, fusion_weights(source.regions.counts, target.regions.counts))
    places, others, trust, (sizes, real) = _match_landmarks(config, params, source, target)
    seeds = even_seeds(sizes, config.hypotheses, real)
    return align_landmarks(places, others, trust, rounds=config.consensus, seeds=seeds)


def decode_hypotheses(config: ModelConfig, params: dict, source: Encoding, target: Encoding, count: int) -> Rigid:
    """About ``count`` transforms, stacked, that landmarks speak for; of decoders that regress the pose, their one."""
    if config.decoder == "pose":
        return jax.tree.map(lambda leaf: leaf[None], decode(config, params, source, target))
    places, others, trust, (sizes, real) = _match_landmarks(config, params, source, target)
    return hypotheses(places, others, trust, even_seeds(sizes, count, real))


def _match_landmarks(
    config: ModelConfig, params: dict, source: Encoding, target: Encoding
) -> tuple[Array, Array, Array, tuple[list[int], list[Array | int]]]:
    """Places (M, 3) of landmarks in both clouds, how much each counts (M,), and the groups they are in.

    A group has a size and a number of landmarks that are no padding.

    Those of the decoders come first, then those of the source's points and of the target's.
    """
    weights = fusion_weights(source.regions.counts, target.regions.counts)
    queries = region_queries(config, params["landmarks"], source.regions.features, target.regions.features, weights)
    asked, trust = len(queries.weights), [queries.weights]
    groups: list[int] = [asked]
    counts: list[Array | int] = [asked]
    if config.lookups:
        keys, real, _ = map(jnp.concatenate, zip(source.lookups, target.lookups, strict=True))
        # As many of either cloud's points, so that swapped clouds have the same ones.
        groups += [len(source.lookups.real), len(target.lookups.real)]
        counts += [jnp.sum(source.lookups.real), jnp.sum(target.lookups.real)]
        trust.append(lookup_weights(config, params["trust"], keys, real))
    here, there = each_cloud(
        lambda side: _find(config, *side),
        (queries.source, target.lookups.keys, source.keys, source.cloud),
        (queries.target, source.lookups.keys, target.keys, target.cloud),
    )
    places = jnp.concatenate([here[:asked], source.lookups.places, here[asked:]])
    return places, jnp.concatenate([there, target.lookups.places]), jnp.concatenate(trust), (groups, counts)


def _find(config: ModelConfig, queries: Array, others: Array, keys: Array, cloud: Cloud) -> Array:
    """Where a cloud has what the decoders ask for, and the other cloud's points with their keys."""
    return place_landmarks(config.sharpness * jnp.concatenate([queries, others]), keys, cloud)


def fusion_weights(source_counts: Array, target_counts: Array) -> Array:
    """N_k/N of eq. (3), (n,), summing to 1, over the regions that both clouds have.

    A region that one cloud lacks has no counterpart and weighs nothing; if no region is shared, plain counts decide.
    """
    counts = source_counts + target_counts
    shared = jnp.where((source_counts > 0) & (target_counts > 0), counts, 0.0)
    weights = jnp.where(jnp.sum(shared) > 0, shared, counts)
    return weights / jnp.maximum(jnp.sum(weights), 1.0)
