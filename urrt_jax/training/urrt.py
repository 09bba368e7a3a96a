"""Our own network as what is trained: the paper's unsupervised objective of one pair (its section 2.4)."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.checks import check_positive, check_whole
from urrt_jax.clouds import first, shift
from urrt_jax.frames import normalize_pair
from urrt_jax.losses import chamfer, occupancy_loss, shell_samples
from urrt_jax.model import Model, ModelConfig, init_model
from urrt_jax.model.network import estimate_subsampled, predict
from urrt_jax.model.partition import branch_logits, occupancy_logits
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Trainable, Variables


@dataclasses.dataclass(frozen=True, kw_only=True)
class URRT(Trainable):
    """3D-URRT, trained without labels: no pose of a pair is read.

    Attributes:
      model: the network.
      occupancy_weight: weight of the occupancy loss against the Chamfer loss.
      occupancy_queries: points at which occupancy is asked, per pair.
      chamfer_scale: scale of the Chamfer penalty, in units of the normalised pair.
      loss_points: points of each whole cloud that the Chamfer loss compares.
      unrolled: steps of the network that training runs, at most the model's; later ones see what the last of them saw.
      lookups: points of each cloud that training looks up, at most the model's.
      rounds: of consensus among landmarks in training, at most the model's, and no hypotheses: fresh landmarks agree on
        nothing.
    """

    model: ModelConfig = ModelConfig()
    occupancy_weight: float = 0.02
    occupancy_queries: int = 256
    chamfer_scale: float = 0.1
    loss_points: int = 512
    unrolled: int = 2
    lookups: int = 256
    rounds: int = 4

    def __post_init__(self) -> None:
        check_whole(self, occupancy_queries=1, loss_points=1, unrolled=1, lookups=0, rounds=0)
        check_positive(self, "chamfer_scale")
        if self.occupancy_weight < 0:
            raise ValueError(f"occupancy_weight: expected at least 0, got {self.occupancy_weight}")

    @property
    def name(self) -> str:
        """What ``urrt train --method`` calls it."""
        return "urrt"

    def init(self, key: Array) -> Variables:
        """Random parameters; there is no batch norm."""
        return {"params": init_model(key, self.model).params}

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """``pair_loss`` of the network as training runs it."""
        loss, metrics = pair_loss(Model(self.training_network(), variables["params"]), pair, key, self)
        return loss, metrics, {}

    def evaluate(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Rigid]:
        """The Chamfer distance after the last step of the whole network, which needs no labels, and its transform."""
        model = self.as_model(variables)
        _, metrics = pair_loss(model, pair, key, self)
        return metrics["chamfer"], predict(model, pair.source, pair.target)

    def training_network(self) -> ModelConfig:
        """The network as training runs it: the parameters are the same, but it does less."""
        return dataclasses.replace(
            self.model,
            steps=min(self.unrolled, self.model.steps),
            lookups=min(self.lookups, self.model.lookups),
            consensus=min(self.rounds, self.model.consensus),
            hypotheses=0,
        )

    def as_model(self, variables: Variables) -> Model:
        """The network with trained variables, as ``register`` and ``save_model`` take it."""
        return Model(self.model, variables["params"])


def pair_loss(model: Model, pair: Pair, key: Array, method: URRT) -> tuple[Array, Metrics]:
    """The objective of one pair, (), and its parts: the paper's section 2.4. It never reads ``pair.transform``.

    Alignment is the Chamfer distance between the whole source, moved by the estimate of every step, and the whole
    target, averaged over the steps; the network itself sees the corrupted clouds. Occupancy is asked of the target.
    """
    source, target, frame = normalize_pair(pair.source, pair.target)
    result = estimate_subsampled(model, source, target)

    whole_source = first(shift(pair.whole_source, frame.source_center, frame.scale), method.loss_points)
    whole_target = first(shift(pair.whole_target, frame.target_center, frame.scale), method.loss_points)

    def aligned(transform: Rigid) -> Array:
        moved = whole_source._replace(points=rigid.apply(transform, whole_source.points))
        return chamfer(moved, whole_target, penalty="distance", scale=method.chamfer_scale)

    alignment = jax.vmap(aligned)(result.steps)
    metrics = {"chamfer": alignment[-1], "chamfer_first": alignment[0]}
    loss = jnp.mean(alignment)
    if method.model.has_regions:
        if pair.queries is None or pair.inside is None:
            queries, inside = shell_samples(key, whole_target, method.occupancy_queries)
        else:
            rows = jax.random.choice(key, pair.queries.shape[0], (method.occupancy_queries,))
            queries, inside = (pair.queries[rows] - frame.target_center) / frame.scale, pair.inside[rows]
        logits = branch_logits(method.model, model.params["partition"], queries, result.target.embedding)
        occupancy = occupancy_loss(occupancy_logits(logits), inside)
        counts = result.target.regions.counts
        metrics |= {
            "occupancy": occupancy,
            "occupancy_accuracy": jnp.mean((occupancy_logits(logits) > 0) == inside),
            "regions_used": jnp.sum(counts > 0.01 * jnp.sum(counts)).astype(jnp.float32),
        }
        loss = loss + method.occupancy_weight * occupancy
    return loss, metrics
