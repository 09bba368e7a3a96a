"""Region-aware decoders by landmarks: the same places are named in both clouds, and these are aligned.

A landmark is a soft choice among all points of a cloud, their mean under attention weights (keypoints as in
Suwajanakorn et al. 2018, KeypointNet). A query says what is chosen; the points' keys are compared with it. It comes

* from decoder g_k, which reads the features of region k in both clouds and asks for C landmarks, or
* from a point, whose own key is looked up in both clouds.

Landmarks are weighed (the regions' as in eq. (3)), and those that agree are aligned (``consensus.py``). Two clouds that
lie on each other have the same landmarks, so the aligned pose is an exact fixed point of every step, and swapped clouds
give the inverse.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.loops import only_if
from urrt_jax.model.blocks import Perceptron, region_perceptrons, run
from urrt_jax.model.config import ModelConfig

_BLOCK = 64  # queries


class Queries(NamedTuple):
    """What is asked for: M landmarks.

    Attributes:
      source: (M, c), compared with the keys of the source's points.
      target: (M, c), compared with those of the target's.
      weights: (M,), how much each landmark should count.
    """

    source: Array
    target: Array
    weights: Array


class Lookups(NamedTuple):
    """L points of a cloud, which are looked up in both clouds.

    Attributes:
      keys: (L, c), theirs, which are what is asked for.
      real: (L,) bool, False for padding.
      places: (L, 3), where they are found in their own cloud.
    """

    keys: Array
    real: Array
    places: Array


def place_keys(config: ModelConfig) -> nn.Module:
    """What makes keys (N, key_width) of where points lie, from their embeddings (N, d)."""
    return Perceptron((2 * config.key_width, config.key_width), normalize=True)


def surroundings_keys(config: ModelConfig) -> nn.Module:
    """What makes keys (N, key_width) of what surrounds points, from the invariants (N, q) of that."""
    return Perceptron((2 * config.key_width, 2 * config.key_width, config.key_width), normalize=True)


def point_keys(config: ModelConfig, params: dict, features: Array, invariants: Array) -> Array:
    """The keys (N, ``key_size``) of points, by which landmarks find them.

    Args:
      config: the network's.
      params: of the decoder.
      features: (N, d), embeddings.
      invariants: (N, q), of the points' surroundings.
    """
    place = run(place_keys(config), params["keys"], features)
    if not config.octaves:
        return place
    return jnp.concatenate([place, run(surroundings_keys(config), params["surroundings"], invariants)], axis=1)


def key_size(config: ModelConfig) -> int:
    """The dimension c of keys and queries."""
    return (2 if config.octaves else 1) * config.key_width


def landmark_decoders(config: ModelConfig) -> nn.Module:
    """The functions {g_k}: perceptrons with weights of their own, (n, 2d) to (n, C·(c + 1))."""
    large = nn.initializers.he_normal()  # from nearly equal queries all landmarks would be the centroid
    return region_perceptrons((*config.decoder_widths, config.landmarks * (key_size(config) + 1)), large)


def region_queries(config: ModelConfig, params: dict, source: Array, target: Array, weights: Array) -> Queries:
    """The n·C queries of the decoders.

    Args:
      config: the network's.
      params: of ``landmark_decoders``.
      source: (n, d), features of the source's regions.
      target: (n, d), of the target's.
      weights: (n,), of the regions.
    """
    (here, trust_here), (there, trust_there) = (
        _ask(config, params, own, other) for own, other in ((source, target), (target, source))
    )
    # Surroundings look the same from any pose, so that both clouds are asked for the same ones.
    alike = (here + there)[:, config.key_width :] / 2
    first, second = (jnp.concatenate([asked[:, : config.key_width], alike], axis=1) for asked in (here, there))
    return Queries(first, second, jax.nn.softplus(trust_here + trust_there) * jnp.repeat(weights, config.landmarks))


def _ask(config: ModelConfig, params: dict, own: Array, other: Array) -> tuple[Array, Array]:
    """Queries (n·C, c) for a cloud and their trust (n·C,), from the regions' features (n, d) in it and in the other."""
    asked = run(landmark_decoders(config), params, jnp.concatenate([own, other], axis=-1))
    queries, trust = jnp.split(asked, [config.landmarks * key_size(config)], axis=-1)
    return queries.reshape(-1, key_size(config)), trust.ravel()


def point_trust() -> nn.Module:
    """From the key (…, c) of a point, how much its landmark should count (…, 1), before it is made positive."""
    return Perceptron((32, 1), normalize=True)


def look_up(config: ModelConfig, keys: Array, cloud: Cloud, needed: Array | bool = True) -> Lookups:
    """The points of a cloud, with their keys (N, c), that are looked up: evenly spread.

    Outliers are first among farthest ones. Where this is not ``needed``, (), places are zero.
    """
    rows, real = jnp.arange(min(config.lookups, cloud.mask.shape[0])), jnp.sum(cloud.mask)
    rows = jnp.where(real > rows.shape[0], rows * real // max(rows.shape[0], 1), rows)
    asked = keys[rows]
    blank = jnp.zeros((rows.shape[0], 3), cloud.points.dtype)
    places = only_if(needed, lambda: place_landmarks(config.sharpness * asked, keys, cloud), blank)
    return Lookups(asked, cloud.mask[rows], places)


def lookup_weights(config: ModelConfig, params: dict, keys: Array, real: Array) -> Array:
    """How much the landmarks of points of either cloud, with keys (L, c), should count, (L,); padding does not.

    Together they count as much as the decoders' where all are equally trusted.

    Args:
      config: the network's.
      params: of ``point_trust``.
      keys: (L, c).
      real: (L,) bool.
    """
    trust = jnp.where(real, jax.nn.softplus(run(point_trust(), params, keys)[:, 0]), 0.0)
    return trust * config.landmarks / jnp.maximum(jnp.sum(real), 1)


def place_landmarks(queries: Array, keys: Array, cloud: Cloud) -> Array:
    """Places (M, 3) in a cloud of N points, from queries (M, c) and the points' keys (N, c).

    Queries go through in blocks, so that a block's logits stay in a processor's cache however many pairs there are.
    """
    count = queries.shape[0]
    # Padding has the key of a real point, so that it changes no maximum, and adds nothing to what is summed.
    keys = jnp.where(cloud.mask[:, None], keys, keys[jnp.argmax(cloud.mask)])
    summed = jnp.where(cloud.mask[:, None], jnp.concatenate([cloud.points, jnp.ones_like(cloud.points[:, :1])], 1), 0.0)
    blocks = jnp.pad(queries, ((0, -count % _BLOCK), (0, 0))).reshape(-(-count // _BLOCK), _BLOCK, keys.shape[1])
    return jax.lax.map(jax.checkpoint(lambda block: _place(block, keys, summed)), blocks).reshape(-1, 3)[:count]


def _place(queries: Array, keys: Array, summed: Array) -> Array:
    """Places (B, 3) of queries (B, c) among the points that ``summed`` (N, 4) holds, with a 1 each; 0 of none."""
    logits = (queries / jnp.sqrt(keys.shape[1])) @ keys.T
    shares = jnp.exp(logits - jax.lax.stop_gradient(jnp.max(logits, axis=-1, keepdims=True)))
    # A softmax, but its sums are made with those of the points: one passage over the matrix less.
    places = jnp.matmul(shares, summed, precision=jax.lax.Precision.HIGHEST)
    return places[:, :3] / jnp.where(places[:, 3:] > 0, places[:, 3:], 1.0)
