"""Region-aware decoders by landmarks: every region names the same few places in both clouds, and these are aligned.

Decoder g_k of region k reads the region's features in both clouds and asks for C landmarks. A landmark is a soft choice
among all points of a cloud, their mean under attention weights (keypoints as in Suwajanakorn et al. 2018, KeypointNet).
The landmarks of all regions are matched by their number, weighed as in eq. (3), and aligned in closed form. Two clouds
that lie on each other have the same landmarks, so the aligned pose is an exact fixed point of every step.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.clouds import Cloud
from urrt_jax.geometry.rigid import Rigid, procrustes
from urrt_jax.model.blocks import Perceptron, region_perceptrons, run
from urrt_jax.model.config import ModelConfig

_STIFFNESS = 1e-3  # in a frame of unit radius: far below the spread of landmarks that mean anything


class Landmarks(NamedTuple):
    """The landmarks of one cloud.

    Attributes:
      places: (n, C, 3), in the network's frame.
      trust: (n, C), how much each should count, before it is made positive.
    """

    places: Array
    trust: Array


def key_network(config: ModelConfig) -> nn.Module:
    """What makes the keys (N, c) of points from their embeddings (N, d)."""
    return Perceptron((2 * config.key_width, config.key_width), normalize=True)


def landmark_decoders(config: ModelConfig) -> nn.Module:
    """The functions {g_k}: perceptrons with weights of their own, (n, 2d) to (n, C·(c + 1))."""
    large = nn.initializers.he_normal()  # from nearly equal queries all landmarks would be the centroid
    return region_perceptrons((*config.decoder_widths, config.landmarks * (config.key_width + 1)), large)


def place_landmarks(
    config: ModelConfig, params: dict, own: Array, other: Array, keys: Array, cloud: Cloud
) -> Landmarks:
    """The landmarks of a cloud of N points.

    Args:
      config: the network's.
      params: of ``landmark_decoders``.
      own: (n, d), features of the regions of this cloud.
      other: (n, d), of those of the other cloud.
      keys: (N, c), of the points.
      cloud: the points.
    """
    asked = run(landmark_decoders(config), params, jnp.concatenate([own, other], axis=-1))
    queries, trust = jnp.split(asked, [config.landmarks * config.key_width], axis=-1)
    logits = queries.reshape(-1, config.key_width) @ keys.T / jnp.sqrt(config.key_width)
    attention = jax.nn.softmax(jnp.where(cloud.mask, logits, -1e9), axis=-1)
    places = jnp.matmul(attention, cloud.points, precision=jax.lax.Precision.HIGHEST)
    return Landmarks(places.reshape(*trust.shape, 3), trust)


def align_landmarks(source: Landmarks, target: Landmarks, weights: Array) -> Rigid:
    """φ: the transform that carries the landmarks of the source onto those of the target, regions weighed by (n,)."""
    share = jax.nn.softplus(source.trust + target.trust) * weights[:, None]
    return procrustes(source.places.reshape(-1, 3), target.places.reshape(-1, 3), share.ravel(), stiffness=_STIFFNESS)
