"""RIENet (Shen et al. 2022): matches refined by those of the neighbours, weighted by how well neighbourhoods agree."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.peers.learned import inliers, release
from urrt_jax.peers.learned.network import Network
from urrt_jax.peers.learned.rienet_loss import alignment_loss, consensus_loss, keypoints, match_loss
from urrt_jax.peers.learned.rienet_passes import Pass, Passes, total
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Variables

_PUBLISHED_BATCH = 16
_NORMS = "BatchNorm_0"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RIENet(Network):
    """RIENet, unsupervised. The defaults are the network that its authors trained on ModelNet40.

    The released code assumes clouds of one size. Here sizes may differ: nothing in the method needs them to agree.

    Attributes:
      widths: of the four layers over the edges of the neighbour graph.
      width: of the features.
      neighbors: edges of a point, the one to itself included.
      match_neighbors: neighbours that refine a match, the point itself included (though it takes no part).
      margin: matches whose neighbours match less than this are made less likely.
      hidden: width of the first layer of the inlier weights.
      passes: the source is moved and matched again as often, with the same parameters.
      keypoints: source points of largest weight that the loss looks at.
    """

    widths: tuple[int, ...] = (32, 32, 64, 128)
    width: int = 256
    neighbors: int = 5
    match_neighbors: int = 5
    margin: float = 0.7
    hidden: int = 8
    passes: int = 3
    keypoints: int = 256

    def __post_init__(self) -> None:
        for name, least in (("neighbors", 1), ("match_neighbors", 2), ("passes", 1), ("keypoints", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")

    @property
    def name(self) -> str:
        """What commands call it."""
        return "rienet"

    @property
    def title(self) -> str:
        """What tables call it."""
        return "RIENet"

    @property
    def module(self) -> Passes:
        """The Flax module that makes all passes."""
        graph = self.neighbors, self.match_neighbors
        return Passes(self.widths, self.width, *graph, self.margin, self.hidden, self.passes)

    def init(self, key: Array) -> Variables:
        """Random variables."""
        cloud = Cloud(jnp.zeros((2, 3)), jnp.ones(2, bool))
        return dict(dataclasses.replace(self, passes=1).module.init(key, cloud, cloud, False))

    def stages(self, variables: Variables, source: Cloud, target: Cloud) -> tuple[Pass, ...]:
        """What every pass computes, in evaluation mode."""
        # Its answers are exact where the clouds are: TensorFloat-32 would cost them three digits.
        with jax.default_matmul_precision("highest"):
            passes: Any = self.module.apply(variables, source, target, False)
        return passes

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        """The transform that carries the source onto the target; ``key`` is not used."""
        return total(self.stages(variables, source, target))

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The published loss, ``objective``, and its parts. It never reads ``pair.transform``."""
        applied: Any = self.module.apply(variables, pair.source, pair.target, True, mutable=["batch_stats"])
        passes, updated = applied
        return *self.objective(passes, pair.target), updated["batch_stats"]

    def evaluate(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Rigid]:
        """The network's own loss in evaluation mode, so that checkpoints are chosen without labels; the estimate."""
        passes = self.stages(variables, pair.source, pair.target)
        return self.objective(passes, pair.target)[0], total(passes)

    def objective(self, passes: tuple[Pass, ...], target: Cloud) -> tuple[Array, Metrics]:
        """The loss of one pair, (), and its three parts: alignment, consensus, match; summed over the passes.

        Alignment and consensus count 16-fold, because the released code adds them up over its batch of 16 pairs, while
        of the match loss it takes the mean.
        """
        alignment = consensus = match = jnp.zeros(())
        for each in passes:
            source = each.source
            moved = source._replace(points=rigid.apply(each.transform, source.points))
            rows, real = keypoints(each.weights, source.mask, self.keypoints)
            neighbors = each.source_neighbors[:, : self.neighbors][rows]
            edge_mask = source.mask[neighbors] & real[:, None]
            share = 1 / self.match_neighbors  # as released: of the match's neighbours, though edges are the graph's
            alignment += alignment_loss(moved, target)
            consensus += consensus_loss(source.points, each.matched, rows, neighbors, edge_mask, each.transform, share)
            match += match_loss(each.refined[rows], real)
        parts = {"alignment": alignment, "consensus": consensus, "match": match}
        return _PUBLISHED_BATCH * (alignment + consensus) + match, parts

    def from_release(self, arrays: Mapping[str, np.ndarray]) -> Variables:
        """The variables in the released weights (supersyq/RIENet, ``pretrained``); see ``RELEASES`` for the settings.

        The arrays ``single_point_embed.*`` and ``forwards.fuse.*`` are ignored, as the released code never uses them.

        Raises:
          ValueError: an array is missing or has another shape.
        """
        layer = functools.partial(release.layer, arrays, bias=True)
        names = [(f"emb_nn.model.conv{row}", f"emb_nn.model.bn{row}") for row in range(1, len(self.widths) + 2)]
        inputs = (3, *self.widths[:-1], sum(self.widths))
        convolutions = release.stack(arrays, names, inputs, (*self.widths, self.width))
        prefix, wide, attention = "forwards.weight_function.model", 2 * self.hidden, inliers.ATTENTION
        weights = {
            "first": _convolution(arrays, f"{prefix}1.0", f"{prefix}1.1", (3, self.hidden)),
            "second": _convolution(arrays, f"{prefix}1.3", f"{prefix}1.4", (self.hidden, wide)),
            "last": layer(f"{prefix}4.0", f"{prefix}4.1", (attention, inliers.LAST)),
        }
        for name, number in (("values", 2), ("scores", 3)):
            weights[f"{name}_0"] = layer(f"{prefix}{number}.0", f"{prefix}{number}.1", (wide, attention))
            weights[f"{name}_1"] = layer(f"{prefix}{number}.3", f"{prefix}{number}.4", (attention, attention))
        params, stats = (
            {"convolutions": convolutions[which], "inliers": {name: pair[which] for name, pair in weights.items()}}
            for which in (0, 1)
        )
        params["inliers"]["output"] = release.dense(arrays, f"{prefix}4.3", (inliers.LAST, 1))
        return {"params": params, "batch_stats": stats}


def _convolution(
    arrays: Mapping[str, np.ndarray], conv: str, bn: str, widths: tuple[int, int]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The "params" and "batch_stats" of a ``NeighborConvolution``: PyTorch's kernel is (C_out, C_in, 3, 1)."""
    params, stats = release.norm(arrays, bn, widths[1])
    kernel = release.array(arrays, f"{conv}.weight", (*widths[::-1], 3)).transpose(2, 1, 0)
    bias = release.array(arrays, f"{conv}.bias", widths[1:])
    return {"Conv_0": {"kernel": kernel, "bias": bias}, _NORMS: params}, {_NORMS: stats}


RELEASES = {
    "modelnet": RIENet(),
    "unseen": RIENet(hidden=16),
    "7scenes": RIENet(margin=0.5, neighbors=8, match_neighbors=8),
    "icl": RIENet(hidden=16, margin=0.5, neighbors=32, match_neighbors=10),
}
"""The settings of the four released sets of weights: of ModelNet40, half of its categories, 7Scenes and ICL-NUIM."""
