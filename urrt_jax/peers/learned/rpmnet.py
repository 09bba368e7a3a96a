"""RPM-Net (Yew and Lee, CVPR 2020): soft matches of learned features by Sinkhorn, sharpened over a few passes."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, centroid, normals
from urrt_jax.maxima import masked_max
from urrt_jax.peers.learned.invariants import point_pair_features, rows_within
from urrt_jax.peers.learned.layers import GroupNorm
from urrt_jax.peers.learned.matching import soft_targets
from urrt_jax.peers.learned.network import Network
from urrt_jax.peers.learned.sinkhorn import sinkhorn
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Variables

_HIGHEST = jax.lax.Precision.HIGHEST
_EPSILON = 1e-5  # of match masses, chosen here
_MASS_WEIGHT, _DISCOUNT = 0.01, 0.5  # of the loss: of the match mass, and of each pass before the last


class _Neighborhoods(NamedTuple):
    """A cloud with what no rigid motion changes: neighbours' rows (N, k) and their features (N, k, 4)."""

    cloud: Cloud
    rows: Array
    invariants: Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class RPMNet(Network):
    """RPM-Net: matches by feature distance with outliers, and a weighted Procrustes fit, over several passes.

    Each pass moves the source by the last pose, but fits its own pose to the original source. No derivative passes from
    one pass to the next. The network needs normals. Chosen here, because pairs are points only: normals are estimated
    from the points (``clouds.normals``), within a radius of 0.15, and point away from the cloud's centroid.

    Attributes:
      widths: of the layers over edges between neighbours.
      head_widths: of the layers over points; the last is the features' width.
      annealing_widths: of the layers over points of the PointNet that predicts β and α.
      annealing_head_widths: of its layers after the maximum.
      groups: of group norm; there are twice as many in the last layer over points of that PointNet and in its head.
      neighbors: the most that a point has, the first by index.
      radius: in which they lie.
      normal_radius: of the neighbourhood that normals are estimated from.
      sinkhorn_steps: normalisations of rows and columns.
      passes: at test time.
      training_passes: in the loss.
    """

    learning_rate: ClassVar[float] = 1e-4

    widths: tuple[int, ...] = (96, 96, 192)
    head_widths: tuple[int, ...] = (192, 96, 96)
    annealing_widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    annealing_head_widths: tuple[int, ...] = (512, 256)
    groups: int = 8
    neighbors: int = 64
    radius: float = 0.3
    normal_radius: float = 0.15
    sinkhorn_steps: int = 5
    passes: int = 5
    training_passes: int = 2

    @property
    def name(self) -> str:
        return "rpmnet"

    @property
    def title(self) -> str:
        return "RPM-Net"

    def init(self, key: Array) -> Variables:
        first, second = jax.random.split(key)
        mask = jnp.ones(2, bool)
        features = _Features(self).init(first, jnp.zeros((2, 1, 10)), mask)["params"]
        annealing = _Annealing(self).init(second, jnp.zeros((2, 4)), mask)["params"]
        return {"params": {"features": features, "annealing": annealing}}

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        """The pose of the last pass. Not for reverse-mode derivatives: those are the loss's."""
        # Edges of one 1,024-point cloud take 50 MB a layer: under vmap, clouds take turns.
        features = jax.custom_batching.sequential_vmap(self._features)
        poses, _, _ = self._run(variables, source, target, self.passes, features)
        return jax.tree.map(lambda each: each[-1], poses)

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The L1 distance of moved points and 0.01 times the shares of points without a match (Yew and Lee 2020)."""
        source, target = pair.source, pair.target
        # Features are computed again for the derivatives: kept, 8 pairs of 512 points take 5.8 GB instead of 2.8 GB.
        features = jax.checkpoint(self._features)
        poses, rows, columns = self._run(variables, source, target, self.training_passes, features)
        found = jax.vmap(rigid.apply, (0, None))(poses, source.points)
        gaps = jnp.mean(jnp.abs(found - rigid.apply(pair.transform, source.points)), axis=-1)
        distance = _masked_mean(gaps, source.mask)
        unmatched = _masked_mean(1 - rows, source.mask) + _masked_mean(1 - columns, target.mask)
        weights = _DISCOUNT ** jnp.arange(self.training_passes - 1, -1, -1)
        total = jnp.sum(weights * (distance + _MASS_WEIGHT * unmatched))
        return total, {"distance": distance[-1], "unmatched": unmatched[-1]}, {}

    def _run(
        self, variables: Variables, source: Cloud, target: Cloud, passes: int, features: Callable[..., Array]
    ) -> tuple[Rigid, Array, Array]:
        """The poses of all passes, and their matches' row sums (passes, N) and column sums (passes, M)."""
        start, goal = self._neighborhoods(source), self._neighborhoods(target)
        # The target never moves: its features are those of every pass.
        target_features = features(variables, goal)
        annealing = {"params": variables["params"]["annealing"]}

        def one(pose: Rigid, _: None) -> tuple[Rigid, tuple[Rigid, Array, Array]]:
            moved = source._replace(points=rigid.apply(pose, source.points))
            source_features = features(variables, start._replace(cloud=moved))
            both = jnp.concatenate([moved.points, target.points])
            flags = jnp.concatenate([jnp.zeros_like(source.points[:, :1]), jnp.ones_like(target.points[:, :1])])
            flagged = jnp.concatenate([both, flags], axis=1)
            predicted: Any = _Annealing(self).apply(annealing, flagged, jnp.concatenate([source.mask, target.mask]))
            beta, alpha = predicted
            # Features have unit length.
            squared = 2 - 2 * jnp.matmul(source_features, target_features.T, precision=_HIGHEST)
            matches = sinkhorn(-beta * (squared - alpha), source.mask, target.mask, self.sinkhorn_steps)
            rows, columns = jnp.sum(matches, axis=1), jnp.sum(matches, axis=0)
            counterparts = soft_targets(matches, target.points) / (rows[:, None] + _EPSILON)
            found = rigid.procrustes(source.points, counterparts, rows)
            return jax.lax.stop_gradient(found), (found, rows, columns)

        still = jax.tree.map(lambda each: each.astype(source.points.dtype), rigid.identity())
        return jax.lax.scan(one, still, length=passes)[1]

    def _neighborhoods(self, cloud: Cloud) -> _Neighborhoods:
        normal = normals(cloud.points, cloud, self.normal_radius, centroid(cloud))
        rows = rows_within(cloud.points, cloud.mask, self.radius, self.neighbors)
        return _Neighborhoods(cloud, rows, point_pair_features(cloud.points, normal, rows))

    def _features(self, variables: Variables, of: _Neighborhoods) -> Array:
        """Features (N, C) of unit length."""
        points = of.cloud.points
        offset = points[of.rows] - points[:, None]
        centre = jnp.broadcast_to(points[:, None], offset.shape)
        edges = jnp.concatenate([centre, offset, of.invariants], axis=-1)
        features: Any = _Features(self).apply({"params": variables["params"]["features"]}, edges, of.cloud.mask)
        return features


class _Features(nn.Module):
    """Features of points from their edges; padded neighbours, which are the point itself, count as edges too."""

    of: RPMNet

    @nn.compact
    def __call__(self, edges: Array, mask: Array) -> Array:
        """Features (N, C) of unit length, of edges (N, k, 10) and a mask (N,) of the real points."""
        edges = _layers(self.of.widths, self.of.groups, edges, mask)
        nearby = masked_max(edges, jnp.ones(edges.shape[:2], bool), axis=1)
        features = _layers(self.of.head_widths[:-1], self.of.groups, nearby, mask)
        features = nn.Dense(self.of.head_widths[-1])(features)
        return features * jax.lax.rsqrt(jnp.sum(features**2, axis=-1, keepdims=True) + 1e-12)


class _Annealing(nn.Module):
    """A PointNet on both clouds at once that predicts how sharp matches are, and from where on points are outliers."""

    of: RPMNet

    @nn.compact
    def __call__(self, points: Array, mask: Array) -> tuple[Array, Array]:
        """β and α, positive, of points (N + M, 4), whose last coordinate tells source (0) from target (1)."""
        *widths, last = self.of.annealing_widths
        features = _layers(widths, self.of.groups, points, mask)
        features = _layers([last], 2 * self.of.groups, features, mask)
        feature = masked_max(features, mask)
        feature = _layers(self.of.annealing_head_widths, 2 * self.of.groups, feature, jnp.array(True))
        beta, alpha = nn.softplus(nn.Dense(2)(feature))
        return beta, alpha


def _layers(widths: Sequence[int], groups: int, features: Array, mask: Array) -> Array:
    """Linear maps, each followed by group norm and ReLU; to be called within a compact module."""
    for width in widths:
        features = nn.relu(GroupNorm(groups)(nn.Dense(width)(features), mask))
    return features


def _masked_mean(values: Array, mask: Array) -> Array:
    """The mean over the real entries of the last axis."""
    return jnp.sum(jnp.where(mask, values, 0.0), axis=-1) / jnp.maximum(jnp.sum(mask), 1)
