"""Deep Closest Point (Wang and Solomon 2019): features of every point, a soft match by them, one Procrustes."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.peers.learned import release
from urrt_jax.peers.learned.graph import EdgeConvolutions, neighbor_edges
from urrt_jax.peers.learned.matching import scaled_products, soft_matches, soft_targets
from urrt_jax.peers.learned.network import Network, pose_loss
from urrt_jax.peers.learned.transformer import Transformer
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Variables


@dataclasses.dataclass(frozen=True, kw_only=True)
class DCP(Network):
    """Deep Closest Point: version 1, or with ``attention`` version 2. The defaults are the published network.

    Attributes:
      attention: whether a transformer refines the features of each cloud by those of the other.
      widths: of the four layers over the edges of the neighbour graph.
      width: of the features.
      neighbors: edges of a point, the one to itself included.
      heads: of the attention.
      hidden: width within the transformer's feed-forward layers.
    """

    largest_batch: ClassVar[int] = 16  # 32 pairs of 1,024 points took version 2 to 5 GB, 16 take half of that

    attention: bool = False
    widths: tuple[int, ...] = (64, 64, 128, 256)
    width: int = 512
    neighbors: int = 20
    heads: int = 4
    hidden: int = 1024

    @property
    def name(self) -> str:
        return "dcp_v2" if self.attention else "dcp_v1"

    @property
    def title(self) -> str:
        return "DCPv2" if self.attention else "DCPv1"

    @property
    def module(self) -> "DCPFeatures":
        """The Flax module that makes the features of both clouds."""
        transformer = Transformer(self.heads, self.hidden) if self.attention else None
        return DCPFeatures(self.widths, self.width, self.neighbors, transformer)

    def init(self, key: Array) -> Variables:
        cloud = Cloud(jnp.zeros((self.neighbors, 3)), jnp.ones(self.neighbors, bool))
        return dict(self.module.init(key, cloud, cloud, False))

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        """The transform that carries the source onto the target; ``key`` is not used."""
        # The released version 1 amplifies rounding: TensorFloat-32 is too coarse for it.
        with jax.default_matmul_precision("highest"):
            features: Any = self.module.apply(variables, source, target, False)
        return align(match(features, target.mask), source, target)

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """DCP's loss of the pose; there are no other parts."""
        applied: Any = self.module.apply(variables, pair.source, pair.target, True, mutable=["batch_stats"])
        features, updated = applied
        found = align(match(features, pair.target.mask), pair.source, pair.target)
        return pose_loss(found, pair.transform), {}, updated["batch_stats"]

    def from_release(self, arrays: Mapping[str, np.ndarray]) -> Variables:
        """The variables in the released weights of version 1 (WangYueFt/dcp, ``dcp_v1.t7``); version 2 has none here.

        Subnormal weights become zero: see ``release.array``.

        Raises:
          ValueError: an array is missing or has another shape.
        """
        if self.attention:
            return super().from_release(arrays)
        names = [(f"emb_nn.conv{row}", f"emb_nn.bn{row}") for row in range(1, len(self.widths) + 2)]
        inputs = (6, *self.widths[:-1], sum(self.widths))
        params, stats = release.stack(arrays, names, inputs, (*self.widths, self.width))
        return {"params": {"convolutions": params}, "batch_stats": {"convolutions": stats}}


class DCPFeatures(nn.Module):
    """The features of both clouds by which their points are matched.

    Attributes:
      widths, width, neighbors: as for ``DCP``.
      transformer: whose residuals are added; None for version 1.
    """

    widths: tuple[int, ...]
    width: int
    neighbors: int
    transformer: Transformer | None = None

    def setup(self) -> None:
        # Edges take most of the memory of training, and their layers little of its time: the gradient recomputes them.
        self.convolutions = nn.remat(EdgeConvolutions, static_argnums=(4,))(self.widths, self.width)

    def __call__(self, source: Cloud, target: Cloud, training: bool) -> tuple[Array, Array]:
        """Features (N, width) and (M, width); in training, batch norm sees the source first, then the target."""
        source_features, target_features = self.embed(source, training), self.embed(target, training)
        if self.transformer is None:  # the released code adds its "pointer" here too, which is then the identity
            return 2 * source_features, 2 * target_features
        residuals = self.transformer(source_features, target_features, source.mask, target.mask)
        return source_features + residuals[0], target_features + residuals[1]

    def embed(self, cloud: Cloud, training: bool) -> Array:
        """The embedding (N, width) of one cloud: edge convolutions over one graph of neighbours in space.

        Edges hold absolute coordinates, so the embedding depends on the cloud's place.
        """
        edges, edge_mask = neighbor_edges(cloud.points, cloud.mask, self.neighbors)
        return self.convolutions(edges, edge_mask, cloud.mask, training)


def match(features: tuple[Array, Array], target_mask: Array) -> Array:
    """Soft matches (N, M): the softmax over the target points of the products of features over √C.

    Args:
      features: (N, C) of the source and (M, C) of the target.
      target_mask: (M,) bool, the real target points.
    """
    return soft_matches(scaled_products(*features), target_mask)


def align(matches: Array, source: Cloud, target: Cloud) -> Rigid:
    """The transform that carries the source onto its soft targets, all points with the same weight."""
    counterparts = soft_targets(matches, target.points)
    return rigid.procrustes(source.points, counterparts, source.mask.astype(source.points.dtype))
