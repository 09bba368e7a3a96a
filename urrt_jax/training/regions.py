"""Samples of one shape whose regions are to agree, where regions are parts; no pose needs to be known for it."""

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.losses import region_agreement, region_pairs
from urrt_jax.model import Model
from urrt_jax.model.partition import BranchInputs, branch_logits, region_scores
from urrt_jax.neighbors import nearest
from urrt_jax.training.pairs import add_noise
from urrt_jax.training.trainable import PAIRS

_SHARPNESS = 5.0  # of the scores that are to agree: fresh branches hardly differ, and would stay alike twice as long
_NOISE = 0.03  # largest deviation of the noise of a sample, in the network's frame


def noisy_samples(key: Array, cloud: Cloud, count: int) -> tuple[Cloud, Cloud]:
    """Two samples of a cloud of N points in one pose, each with noise of its own: at most ``count`` points, half of N.

    Args:
      key: random key.
      cloud: in the network's frame.
      count: points of a sample.
    """
    order, level, *noises = jax.random.split(key, 4)
    size = cloud.mask.shape[0]
    rows, count = jax.random.permutation(order, size), min(count, size // 2)
    sigma = jax.random.uniform(level, maxval=_NOISE)

    def sample(noise: Array, chosen: Array) -> Cloud:
        return add_noise(noise, jax.tree.map(lambda leaf: leaf[chosen], cloud), sigma)

    return sample(noises[0], rows[:count]), sample(noises[1], rows[-count:])


def agreement_of_samples(
    model: Model, samples: tuple[Cloud, Cloud], inputs: tuple[BranchInputs, BranchInputs], reach: float
) -> Array:
    """How well the regions of two samples agree (``region_agreement``), (): the mean of this shape and its batch.

    Points correspond that are neighbours. The batch is that of the ``vmap`` whose axis is ``PAIRS``.

    Args:
      model: the network.
      samples: of one shape, in one pose.
      inputs: what its branches are given of them.
      reach: the distance within which points correspond.
    """
    one, other = samples
    here, there = (
        region_scores(_SHARPNESS * branch_logits(model.config, model.params["partition"], each)) for each in inputs
    )
    found = nearest(one.points, other)
    weights = jnp.where(one.mask, jnp.exp(-found.squared / reach**2), 0.0)
    pairs = region_pairs(here, there[found.index], weights)
    return (region_agreement(pairs) + region_agreement(jax.lax.pmean(pairs, PAIRS))) / 2
