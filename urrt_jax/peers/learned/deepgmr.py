"""DeepGMR (Yuan et al., ECCV 2020): clouds as Gaussian mixtures with like components, aligned in closed form."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, centroid
from urrt_jax.maxima import masked_max
from urrt_jax.peers.learned.invariants import centred_features
from urrt_jax.peers.learned.layers import Layer
from urrt_jax.peers.learned.network import Network
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Variables

_HIGHEST = jax.lax.Precision.HIGHEST
_LEAST_VARIANCE = 1e-6  # a guess: a spread of 1e-3 of the bounding sphere, below which a component weighs no more


class Mixture(NamedTuple):
    """A Gaussian mixture of J isotropic components.

    Attributes:
      weights: (J,), add to 1.
      means: (J, 3).
      variances: (J,), along any direction.
    """

    weights: Array
    means: Array
    variances: Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeepGMR(Network):
    """DeepGMR: a network assigns points to the components of a Gaussian mixture, and like components are aligned.

    Written from the paper alone. The authors' code was not read, and how this differs from it is not known, so a
    comparison with it is one of the method as described. Chosen here: the widths of PointNet's segmentation network
    (Qi et al. 2017) without its input transforms; 20 neighbours; features about the cloud's centroid; batch norm of
    each cloud by itself in training; and a loss in both directions.

    Attributes:
      local_widths: of the first layers over points, whose result is a point's own feature.
      global_widths: of the further ones, whose maximum over points is the cloud's feature.
      head_widths: of the layers over both features together.
      components: of the mixture.
      neighbors: whose rotation-invariant features a point has.
    """

    local_widths: tuple[int, ...] = (64, 64)
    global_widths: tuple[int, ...] = (64, 128, 1024)
    head_widths: tuple[int, ...] = (512, 256, 128, 128)
    components: int = 16
    neighbors: int = 20

    @property
    def name(self) -> str:
        return "deepgmr"

    @property
    def title(self) -> str:
        return "DeepGMR"

    def init(self, key: Array) -> Variables:
        cloud = Cloud(jnp.zeros((2, 3)), jnp.ones(2, bool))
        variables = _Assignments(self).init(key, cloud, cloud, training=False)
        return {"params": variables["params"], "batch_stats": variables["batch_stats"]}

    def assignments(self, variables: Variables, source: Cloud, target: Cloud) -> tuple[Array, Array]:
        """The share (N, J) of every source point, and (M, J) of every target point, that each component has."""
        shares: Any = _Assignments(self).apply(variables, source, target, training=False)
        return shares

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        shares, target_shares = self.assignments(variables, source, target)
        return align(mixture(source, shares), mixture(target, target_shares))

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """‖T·T_gt⁻¹ − I‖² (Frobenius) of the pose from source to target, and of the one from target to source."""
        module = _Assignments(self)
        applied: Any = module.apply(variables, pair.source, pair.target, training=True, mutable=["batch_stats"])
        shares, updated = applied
        first, second = mixture(pair.source, shares[0]), mixture(pair.target, shares[1])
        forth = _pose_error(align(first, second), pair.transform)
        back = _pose_error(align(second, first), rigid.inverse(pair.transform))
        return forth + back, {"forth": forth, "back": back}, updated["batch_stats"]


def mixture(cloud: Cloud, shares: Array) -> Mixture:
    """The mixture of a cloud whose points (N, 3) belong to components by ``shares`` (N, J), in closed form.

    Rows of ``shares`` add to 1; those of padding are not used.
    """
    shares = jnp.where(cloud.mask[:, None], shares, 0.0)
    mass = jnp.sum(shares, axis=0)
    shares = shares / jnp.maximum(mass, jnp.finfo(shares.dtype).tiny)
    means = jnp.matmul(shares.T, cloud.points, precision=_HIGHEST)
    squared = jnp.sum((cloud.points[:, None] - means) ** 2, axis=-1)
    return Mixture(mass / jnp.maximum(jnp.sum(mass), 1.0), means, jnp.sum(shares * squared, axis=0) / 3)


def align(source: Mixture, target: Mixture) -> Rigid:
    """The pose T that minimises Σ π_j/σ_j² ‖T(μ_j) − μ'_j‖², by weighted SVD.

    π and μ are weights and means of the source's components, σ² and μ' variances and means of the target's.
    """
    weights = source.weights / jnp.maximum(target.variances, _LEAST_VARIANCE)
    return rigid.procrustes(source.means, target.means, weights)


def _pose_error(found: Rigid, truth: Rigid) -> Array:
    error = rigid.matrix(rigid.compose(found, rigid.inverse(truth))) - jnp.eye(4)
    return jnp.sum(error**2)


class _Assignments(nn.Module):
    """The shares that components have in the points of two clouds, by one network."""

    of: DeepGMR

    @nn.compact
    def __call__(self, source: Cloud, target: Cloud, training: bool) -> tuple[Array, Array]:
        network = _SegmentationNetwork(self.of)
        return network(source, training), network(target, training)


class _SegmentationNetwork(nn.Module):
    """PointNet's segmentation network (Qi et al. 2017) on rotation-invariant features."""

    of: DeepGMR

    @nn.compact
    def __call__(self, cloud: Cloud, training: bool) -> Array:
        """The shares (N, J) of every point; rows add to 1."""
        mask = cloud.mask

        def layers(widths: Sequence[int], features: Array) -> Array:
            for width in widths:
                features = Layer(width)(features, mask, training)
            return features

        features = centred_features(cloud.points - centroid(cloud), mask, self.of.neighbors)
        local = layers(self.of.local_widths, features)
        whole = masked_max(layers(self.of.global_widths, local), mask)
        both = jnp.concatenate([local, jnp.broadcast_to(whole, (mask.shape[0], *whole.shape))], axis=-1)
        logits = nn.Dense(self.of.components)(layers(self.of.head_widths, both))
        return nn.softmax(logits)
