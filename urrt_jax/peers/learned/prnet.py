"""PRNet (Wang and Solomon 2019): each of three passes aligns hard matches of the keypoints of two partial clouds."""

import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.maxima import masked_max
from urrt_jax.neighbors import top_rows
from urrt_jax.peers.learned.graph import neighbor_edges
from urrt_jax.peers.learned.layers import Layer
from urrt_jax.peers.learned.matching import hard_matches, scaled_products, soft_targets
from urrt_jax.peers.learned.network import Network, pose_loss
from urrt_jax.peers.learned.transformer import Transformer
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Variables

_SLOPE = 0.2  # of every ReLU below zero but the temperature's
_COLDEST, _HOTTEST = 0.01, 100.0
_DISCOUNT, _DIFFERENCE_WEIGHT, _CYCLE_WEIGHT = 0.9, 0.1, 0.1


@dataclasses.dataclass(frozen=True, kw_only=True)
class PRNet(Network):
    """PRNet. The defaults are the published network.

    Attributes:
      widths: of the four layers over edges, each with a graph of its own.
      width: of the features.
      neighbors: edges of a point, the one to itself included.
      heads: of the attention.
      hidden: width within the transformer's feed-forward layers.
      temperature_width: of the layers that predict the temperature of the matches.
      passes: estimates, each of which moves the source for the next one.
    """

    largest_batch: ClassVar[int] = 16  # 32 pairs of 1,024 points took 5 GB, 16 take half of that

    widths: tuple[int, ...] = (64, 64, 128, 256)
    width: int = 512
    neighbors: int = 20
    heads: int = 4
    hidden: int = 1024
    temperature_width: int = 128
    passes: int = 3

    @property
    def name(self) -> str:
        return "prnet"

    @property
    def title(self) -> str:
        return "PRNet"

    @property
    def module(self) -> "PRNetFeatures":
        """The Flax module of one pass, as far as it is learned."""
        transformer = Transformer(self.heads, self.hidden, _SLOPE)
        return PRNetFeatures(self.widths, self.width, self.neighbors, self.temperature_width, transformer)

    def init(self, key: Array) -> Variables:
        cloud = Cloud(jnp.zeros((self.neighbors, 3)), jnp.ones(self.neighbors, bool))
        return dict(self.module.init(key, cloud, cloud, False))

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        """The transform that carries the source onto the target; ``key`` draws the noise of the matches."""
        pose = rigid.identity()
        with jax.default_matmul_precision("highest"):
            for found, _ in self._passes(variables, source, target, key, training=False):
                pose = rigid.compose(found.forward, pose)
        return pose

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The published loss and, by name, the sums of its three parts over the passes.

        A pass adds DCP's loss of the pose so far, a tenth of the mean difference of the clouds' mean features, and a
        tenth of how far its estimates there and back are from inverse to each other. Each pass counts nine tenths of
        the one before.
        """
        pose, discount = rigid.identity(), 1.0
        parts = {name: jnp.zeros(()) for name in ("pose", "feature_difference", "cycle")}
        stats = {}
        for found, stats in self._passes(variables, pair.source, pair.target, key, training=True):  # noqa: B007
            pose = rigid.compose(found.forward, pose)
            parts["pose"] += discount * pose_loss(pose, pair.transform)
            parts["feature_difference"] += discount * jnp.mean(found.difference)
            parts["cycle"] += discount * _cycle_loss(found)
            discount *= _DISCOUNT
        loss = parts["pose"] + _DIFFERENCE_WEIGHT * parts["feature_difference"] + _CYCLE_WEIGHT * parts["cycle"]
        return loss, parts, stats

    def _passes(
        self, variables: Variables, source: Cloud, target: Cloud, key: Array, training: bool
    ) -> Iterator[tuple["Pass", Variables]]:
        """The estimates of every pass, and the "batch_stats" after it."""
        for pass_key in jax.random.split(key, self.passes):
            applied: Any = self.module.apply(variables, source, target, training, mutable=["batch_stats"])
            features, updated = applied
            variables = {**variables, **updated}
            found = align(features, pass_key)
            yield found, variables["batch_stats"]
            moved = rigid.apply(found.forward, source.points)
            source = source._replace(points=jnp.where(source.mask[:, None], moved, 0.0))


class Keypoints(NamedTuple):
    """The keypoints of a cloud and their features (K, width)."""

    cloud: Cloud
    features: Array


class Matchable(NamedTuple):
    """What one pass matches.

    Attributes:
      source, target: keypoints of both clouds.
      difference: (width,), how far the means of their features are apart, without sign.
      temperature: (), of the matches.
    """

    source: Keypoints
    target: Keypoints
    difference: Array
    temperature: Array


class Pass(NamedTuple):
    """One pass' transforms of source onto target and of target onto source, and the features' difference (width,)."""

    forward: Rigid
    backward: Rigid
    difference: Array


def keypoints(cloud: Cloud, features: Array) -> Keypoints:
    """Two thirds of the real points, those with the largest features (Euclidean norm), largest first.

    The paper takes 512 of 768; for other clouds this is the same share, rounded down.
    """
    norms = jnp.where(cloud.mask, jnp.sum(features**2, axis=1), -jnp.inf)
    count = 2 * cloud.mask.shape[0] // 3
    rows = top_rows(norms, count)
    mask = jnp.arange(count) < 2 * jnp.sum(cloud.mask) // 3
    return Keypoints(Cloud(jnp.where(mask[:, None], cloud.points[rows], 0.0), mask), features[rows])


def align(features: Matchable, key: Array) -> Pass:
    """The transforms from hard matches of the keypoints, drawn for both directions, all keypoints weighing the same."""

    def one_way(key: Array, source: Keypoints, target: Keypoints) -> Rigid:
        logits = scaled_products(source.features, target.features)
        matches = hard_matches(key, logits, target.cloud.mask, features.temperature)
        counterparts = soft_targets(matches, target.cloud.points)
        return rigid.procrustes(source.cloud.points, counterparts, source.cloud.mask.astype(counterparts.dtype))

    there, back = jax.random.split(key)
    forward = one_way(there, features.source, features.target)
    return Pass(forward, one_way(back, features.target, features.source), features.difference)


def _cycle_loss(found: Pass) -> Array:
    """How far both transforms are from inverse, (); translations are compared unrotated, as the released code does."""
    turn = jnp.matmul(found.backward.rotation, found.forward.rotation, precision=jax.lax.Precision.HIGHEST)
    shift = found.forward.translation + found.backward.translation
    return jnp.mean((turn - jnp.eye(3)) ** 2) + jnp.mean(shift**2)


class PRNetFeatures(nn.Module):
    """The keypoints of both clouds, their features and the temperature of their matches.

    Attributes:
      widths, width, neighbors, temperature_width: as for ``PRNet``.
      transformer: whose residuals are added to the features.
    """

    widths: tuple[int, ...]
    width: int
    neighbors: int
    temperature_width: int
    transformer: Transformer

    def setup(self) -> None:
        # Edges take most of the memory of training: the gradient recomputes them.
        embedding = nn.remat(_Embedding, static_argnums=(3,))
        self.embedding = embedding(self.widths, self.width, self.neighbors)
        self.temperature = _Temperature(self.temperature_width)

    def __call__(self, source: Cloud, target: Cloud, training: bool) -> Matchable:
        """What one pass matches; in training, batch norm sees the source first, then the target."""
        source_features = self.embedding(source.points, source.mask, training)
        target_features = self.embedding(target.points, target.mask, training)
        residuals = self.transformer(source_features, target_features, source.mask, target.mask)
        source_keypoints = keypoints(source, source_features + residuals[0])
        target_keypoints = keypoints(target, target_features + residuals[1])
        difference = jnp.abs(_mean(source_keypoints) - _mean(target_keypoints))
        return Matchable(source_keypoints, target_keypoints, difference, self.temperature(difference, training))


def _mean(found: Keypoints) -> Array:
    """The mean features (width,) of the keypoints."""
    weight = found.cloud.mask[:, None].astype(found.features.dtype)
    return jnp.sum(weight * found.features, axis=0) / jnp.maximum(jnp.sum(weight), 1.0)


class _Embedding(nn.Module):
    """DGCNN (Wang et al. 2019): edge convolutions whose graph joins neighbours in the features of the layer before."""

    widths: tuple[int, ...]
    width: int
    neighbors: int

    @nn.compact
    def __call__(self, features: Array, mask: Array, training: bool) -> Array:
        """Features (N, width) of points (N, 3)."""
        maxima = []
        for width in self.widths:
            edges, edge_mask = neighbor_edges(features, mask, self.neighbors)
            edges = Layer(width, slope=_SLOPE)(edges, edge_mask, training)
            features = jnp.where(mask[:, None], masked_max(edges, edge_mask, axis=1), 0.0)
            maxima.append(features)
        return Layer(self.width, slope=_SLOPE)(jnp.concatenate(maxima, axis=-1), mask, training)


class _Temperature(nn.Module):
    """The temperature (), from how far the mean features of both clouds are apart."""

    width: int

    @nn.compact
    def __call__(self, difference: Array, training: bool) -> Array:
        features, real = difference, jnp.ones((), bool)
        for _ in range(3):
            features = Layer(self.width, bias=True)(features, real, training)
        return jnp.clip(nn.relu(nn.Dense(1)(features)[0]), _COLDEST, _HOTTEST)
