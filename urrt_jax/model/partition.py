"""Region partition: n branches say to which region a point belongs and whether it lies inside the shape.

One set of branches serves source and target, so that region k means the same part in both. The softmax of the branches
gives the region. The paper also takes the occupancy from that softmax, which cannot say "outside"; here it is the
largest logit (``occupancy_logits``).

There are two kinds of branches. ``PlaceBranches`` are the paper's: they see where a point lies, so that regions stay
where they are while the shape turns beneath them. ``PartBranches`` see what surrounds a point, so that regions turn
with the shape. Both see something of the whole cloud, too, which tells them what shape it is.
"""

from typing import NamedTuple

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud, centroid
from urrt_jax.features.moments import centred_invariants, invariant_count, moment_invariants
from urrt_jax.maxima import masked_max, maximum
from urrt_jax.model.blocks import run
from urrt_jax.model.config import ModelConfig


class Regions(NamedTuple):
    """The regions of one cloud.

    Attributes:
      labels: (N,) int32, the region of every point; padding has label 0 and counts nowhere.
      counts: (n,) float, real points in each region, N_k.
      features: (n, d), the region feature sequence l, and after attention the sequence a; zero for an empty region.
      centroids: (n, 3), the mean of each region's points, in the network's frame; zero for an empty region.
    """

    labels: Array
    counts: Array
    features: Array
    centroids: Array


class BranchInputs(NamedTuple):
    """What the branches are given; the size depends on their kind.

    Attributes:
      points: of Q points on the cloud or off it. Place branches: the coordinates x (Q, 3). Part branches: the centred
        invariants (Q, q) of the surroundings.
      condition: of the whole cloud, the same for all its points. Place branches: its embedding e (d,). Part branches:
        the mean and the maximum of its points' invariants (2q,).
    """

    points: Array
    condition: Array


class PlaceBranches(nn.Module):
    """The functions {h_k} of eq. (1): n perceptrons of [x, e/‖e‖] with one hidden layer, each with weights of its own.

    The hidden layer is split into a part for x and a part for e, which is the same layer, but e's part is computed once
    a shape instead of once a point; the branches' hidden layers run side by side as one wide layer.

    Each branch starts as a blob about an anchor of its own: hidden units that look away from the anchor in all
    directions, summed with negative weights. Started at random, one branch wins everywhere, only winners have a
    gradient, and the partition collapses to a single region.
    """

    config: ModelConfig

    @nn.compact
    def __call__(self, inputs: BranchInputs) -> Array:
        """Branch logits (Q, n) of points (Q, 3), given the shape embedding (d,)."""
        n, width = self.config.regions, self.config.branch_width
        directions = self.param("directions", _unit_columns, (3, n * width))
        offsets = self.param("offsets", lambda _: -jnp.sum(directions * jnp.repeat(anchors(n), width, 0).T, axis=0))
        faint = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        # Only e's direction, as long as x: a step of Adam would move the branches farther through e than through x, all
        # shapes would look alike to them, and few regions would stay in use.
        direction = inputs.condition / jnp.sqrt(jnp.sum(inputs.condition**2) + 1e-6)
        shape = nn.Dense(n * width, use_bias=False, kernel_init=faint, name="shape")(direction)
        # A unit looking along u rises by |x|/4 on average over all directions u: the sum falls by 4 a unit of length.
        out = self.param("out", nn.initializers.constant(-16.0 / width), (n, width, 1))
        bias = self.param("bias", nn.initializers.constant(2.0), (n,))
        hidden = nn.leaky_relu(inputs.points @ directions + offsets + shape, 0.02)
        # One product with a block-diagonal matrix: n small ones are slower on every device tried.
        return hidden @ jax.scipy.linalg.block_diag(*out) + bias


class PartBranches(nn.Module):
    """Functions {h_k} of what surrounds a point: one perceptron with n outputs, whose hidden layers they share.

    What surrounds a point is the same in every pose, and so are the regions. Without the loss of ``losses.agreement``
    few of them stay in use.
    """

    config: ModelConfig

    @nn.compact
    def __call__(self, inputs: BranchInputs) -> Array:
        """Branch logits (Q, n) of the invariants (Q, q) of points, given those of the whole cloud (2q,)."""
        width = 2 * self.config.branch_width
        # Most of what a fresh network sees of the shape is the same for all its points, and must not decide alone.
        faint = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        hidden = nn.Dense(width)(inputs.points) + nn.Dense(width, use_bias=False, kernel_init=faint)(inputs.condition)
        hidden = nn.Dense(width)(nn.leaky_relu(hidden, 0.02))
        return nn.Dense(self.config.regions)(nn.leaky_relu(hidden, 0.02))


def anchors(count: int) -> Array:
    """``count`` points spread evenly over the sphere of radius 0.8 (a golden spiral), (count, 3)."""
    place = jnp.arange(count) + 0.5
    height = 1 - 2 * place / count
    turn = jnp.pi * (1 + jnp.sqrt(5.0)) * place
    ring = jnp.sqrt(1 - height**2)
    return 0.8 * jnp.stack([ring * jnp.cos(turn), ring * jnp.sin(turn), height], axis=1)


def _unit_columns(key: Array, shape: tuple[int, int]) -> Array:
    columns = jax.random.normal(key, shape)
    return columns / jnp.linalg.norm(columns, axis=0)


def branches(config: ModelConfig) -> nn.Module:
    """The branches {h_k} of eq. (1), of the configured kind."""
    return PartBranches(config) if config.partition == "parts" else PlaceBranches(config)


def init_branches(config: ModelConfig, key: Array) -> dict:
    """Fresh parameters of the branches."""
    q = invariant_count(config.octaves)
    points, condition = (3, config.width) if config.partition == "places" else (q, 2 * q)
    return dict(branches(config).init(key, BranchInputs(jnp.zeros((1, points)), jnp.zeros(condition)))["params"])


def inputs_of_cloud(config: ModelConfig, cloud: Cloud, embedding: Array, invariants: Array) -> BranchInputs:
    """What the branches are given of all points of a cloud.

    Args:
      config: the network's.
      cloud: N points.
      embedding: (d,), its shape embedding e, which place branches are given.
      invariants: (N, q), of its points' surroundings, which part branches are given.
    """
    if config.partition == "places":
        return BranchInputs(cloud.points, embedding)
    return inputs_of_parts(config, cloud, invariants)


def inputs_of_parts(config: ModelConfig, cloud: Cloud, invariants: Array) -> BranchInputs:
    """What part branches are given of all N points of a cloud with these invariants (N, q)."""
    points, real = centred_invariants(invariants, config.octaves), cloud.mask[:, None]
    mean = jnp.sum(jnp.where(real, points, 0.0), axis=0) / jnp.maximum(jnp.sum(cloud.mask), 1)
    most = jnp.where(jnp.any(cloud.mask), masked_max(points, cloud.mask), 0.0)
    return BranchInputs(points, jnp.concatenate([mean, most]))


def inputs_at_places(config: ModelConfig, cloud: Cloud, places: Array, condition: Array) -> BranchInputs:
    """What the branches are given of places (Q, 3) that need not lie on the cloud; ``condition``: the cloud's."""
    if config.partition == "places":
        return BranchInputs(places, condition)
    return BranchInputs(centred_invariants(moment_invariants(cloud, config.octaves, places), config.octaves), condition)


def branch_logits(config: ModelConfig, params: dict, inputs: BranchInputs) -> Array:
    """h_k of eq. (1) for all k: (Q, n), of the inputs of Q points."""
    return run(branches(config), params, inputs)


def region_scores(logits: Array) -> Array:
    """s_k of eq. (1): the probability (..., n) of every region."""
    return jax.nn.softmax(logits, axis=-1)


def region_labels(logits: Array) -> Array:
    """The region label o (...,): the region of the highest score. Hard; no derivative passes."""
    return jnp.argmax(jax.lax.stop_gradient(logits), axis=-1).astype(jnp.int32)


def occupancy_logits(logits: Array) -> Array:
    """The logit (...,) of lying inside the shape: the largest branch logit.

    The paper max-pools the softmax, whose maximum cannot fall below 1/n and so cannot say "outside"; the branches'
    own logits can (Chen et al. 2019, BAE-NET).
    """
    return maximum(logits, -1)


def whole_region(cloud: Cloud, embedding: Array) -> Regions:
    """The whole cloud of N points as one region, whose feature is the shape embedding (d,)."""
    labels = jnp.zeros(cloud.mask.shape, jnp.int32)
    real = jnp.sum(cloud.mask).astype(cloud.points.dtype)
    return Regions(labels, real[None], embedding[None], centroid(cloud)[None])


@jax.custom_jvp
def pool_by_label(features: Array, labels: Array, groups: Array) -> Array:
    """The maximum of ``features`` (N, d) over each label; ``groups`` is arange(n + 1), and label n is dropped: (n, d).

    A label without points gives −inf. The derivative goes to the first point that reaches the maximum.
    """
    return jax.ops.segment_max(features, labels, groups.shape[0])[:-1]


@pool_by_label.defjvp
def _pool_by_label_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    features, labels, groups = primals
    # Computed once: a second time, with another rounding, no feature would equal the maximum.
    features = jax.lax.optimization_barrier(features)
    pooled = pool_by_label(features, labels, groups)
    size = features.shape[0]
    rows = jnp.arange(size)[:, None]
    reaches = features == jnp.concatenate([pooled, jnp.full_like(pooled[:1], jnp.inf)])[labels]
    winner = jax.ops.segment_min(jnp.where(reaches, rows, size), labels, groups.shape[0])[:-1]
    tangent = jnp.take_along_axis(tangents[0], jnp.clip(winner, 0, size - 1), axis=0)
    return pooled, jnp.where(jnp.isfinite(pooled), tangent, 0.0)


def split_regions(cloud: Cloud, features: Array, logits: Array) -> Regions:
    """The regions of a cloud: labels, counts, max-pooled features (the sequence l) and centroids.

    Args:
      cloud: N points.
      features: (N, d) point embeddings.
      logits: (N, n), of the branches.
    """
    chex.assert_shape(logits, (*cloud.mask.shape, None))
    chex.assert_shape(features, (*cloud.mask.shape, None))
    regions = logits.shape[1]
    labels = jnp.where(cloud.mask, region_labels(logits), 0)
    kept = jnp.where(cloud.mask, labels, regions)
    member = (kept[:, None] == jnp.arange(regions)).astype(cloud.points.dtype)
    counts = jnp.sum(member, axis=0)
    sums = jnp.matmul(member.T, cloud.points, precision=jax.lax.Precision.HIGHEST)
    pooled = pool_by_label(features, kept, jnp.arange(regions + 1))
    return Regions(
        labels=labels,
        counts=counts,
        features=jnp.where(counts[:, None] > 0, pooled, 0.0),
        centroids=sums / jnp.maximum(counts, 1.0)[:, None],
    )
