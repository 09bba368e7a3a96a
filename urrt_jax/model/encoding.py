"""What the network knows of one cloud in one pose: embeddings, regions, attended features, keys, lookups."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.model.attention import attend_regions
from urrt_jax.model.config import ModelConfig
from urrt_jax.model.encoder import encode_points
from urrt_jax.model.landmarks import Lookups, look_up, point_keys
from urrt_jax.model.partition import Regions, branch_logits, inputs_of_cloud, split_regions, whole_region


class Encoding(NamedTuple):
    """One cloud as the decoders see it.

    Attributes:
      cloud: N points, normalised.
      embedding: (d,), the shape embedding e.
      condition: what the branches know of the whole cloud (``BranchInputs``); e for model A, which has no branches.
      regions: its regions, with the attended features a; for model A a single one with the shape embedding.
      keys: (N, c), by which landmarks find points; (N, 0) where decoders give poses.
      lookups: its points that are looked up in both clouds, already found in this one.
    """

    cloud: Cloud
    embedding: Array
    condition: Array
    regions: Regions
    keys: Array
    lookups: Lookups


def encode_cloud(
    config: ModelConfig, params: dict, cloud: Cloud, invariants: Array, decoded: Array | bool = True
) -> Encoding:
    """The encoding of a normalised cloud of N points with the invariants (N, q) of their surroundings.

    Where it will not be ``decoded``, (), nothing is looked up, and places of look-ups are zero.
    """
    features, embedding = encode_points(config, params["encoder"], cloud, invariants)
    if config.has_regions:
        inputs = inputs_of_cloud(config, cloud, embedding, invariants)
        condition = inputs.condition
        regions = split_regions(cloud, features, branch_logits(config, params["partition"], inputs))
        regions = regions._replace(features=attend_regions(config, params["attention"], regions))
    else:
        condition, regions = embedding, whole_region(cloud, embedding)
    if config.decoder == "pose":
        keys = jnp.zeros((features.shape[0], 0), features.dtype)
    else:
        keys = point_keys(config, params["decoder"], features, invariants)
    return Encoding(cloud, embedding, condition, regions, keys, look_up(config, keys, cloud, decoded))
