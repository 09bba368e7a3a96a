"""Our own network as what is trained: the paper's unsupervised objective of one pair (its section 2.4)."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.checks import check_positive, check_whole
from urrt_jax.clouds import Cloud, first, shift
from urrt_jax.features import moment_invariants
from urrt_jax.frames import Frame, normalize_pair
from urrt_jax.loops import each_cloud
from urrt_jax.losses import chamfer, occupancy_loss, shell_samples
from urrt_jax.model import Model, ModelConfig, init_model
from urrt_jax.model.encoding import Encoding
from urrt_jax.model.network import estimate_subsampled
from urrt_jax.model.partition import branch_logits, inputs_at_places, inputs_of_parts, occupancy_logits
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.regions import agreement_of_samples, noisy_samples
from urrt_jax.training.trainable import Metrics, Trainable, Variables


@dataclasses.dataclass(frozen=True, kw_only=True)
class URRT(Trainable):
    """3D-URRT, trained without labels: no pose of a pair is read.

    Attributes:
      model: the network.
      occupancy_weight: weight of the occupancy loss against the Chamfer loss.
      agreement_weight: weight of the agreement of regions against the occupancy loss, where regions are parts; it is
        multiplied by ``occupancy_weight``.
      occupancy_queries: points at which occupancy is asked, per pair.
      chamfer_scale: scale of the Chamfer penalty, and of the distance within which points correspond whose regions are
        to agree, in units of the normalised pair.
      loss_points: points of each whole cloud that the Chamfer loss compares.
      unrolled: steps of the network that training runs, at most the model's; later ones see what the last of them saw.
      lookups: points of each cloud that training looks up, at most the model's.
      rounds: of consensus among landmarks in training, at most the model's, and no hypotheses: fresh landmarks agree on
        nothing.
    """

    model: ModelConfig = ModelConfig()
    occupancy_weight: float = 0.02
    agreement_weight: float = 2.0
    occupancy_queries: int = 256
    chamfer_scale: float = 0.1
    loss_points: int = 512
    unrolled: int = 2
    lookups: int = 256
    rounds: int = 4

    def __post_init__(self) -> None:
        check_whole(self, occupancy_queries=1, loss_points=1, unrolled=1, lookups=0, rounds=0)
        check_positive(self, "chamfer_scale")
        for name in ("occupancy_weight", "agreement_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")

    @property
    def name(self) -> str:
        """What ``urrt train --method`` calls it."""
        return "urrt"

    def init(self, key: Array) -> Variables:
        """Random parameters; there is no batch norm."""
        return {"params": init_model(key, self.model).params}

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The paper's objective (section 2.4) of one pair, less the agreement of regions where they are parts."""
        model = Model(self.training_network(), variables["params"])
        source, target, frame = normalize_pair(pair.source, pair.target)
        answer = estimate_subsampled(model, source, target)
        whole = whole_clouds(pair, frame)
        distances = alignment_losses(self, *whole, answer.steps)
        loss, metrics = jnp.mean(distances), {"chamfer": distances[-1], "chamfer_first": distances[0]}
        if self.model.has_regions:
            taught, found = partition_loss(self, model, pair, frame, whole[1], answer.target, key)
            loss, metrics = loss + self.occupancy_weight * taught, metrics | found
        return loss, metrics, {}

    def evaluate(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Rigid]:
        """The Chamfer distance after the last step of the whole network, which needs no labels, and its transform."""
        source, target, frame = normalize_pair(pair.source, pair.target)
        answer = estimate_subsampled(self.as_model(variables), source, target)
        return alignment_losses(self, *whole_clouds(pair, frame), answer.steps)[-1], frame.leave(answer.transform)

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


def whole_clouds(pair: Pair, frame: Frame) -> tuple[Cloud, Cloud]:
    """Source and target before corruption, in the network's frame. Losses compare these, whatever the network sees."""
    return (
        shift(pair.whole_source, frame.source_center, frame.scale),
        shift(pair.whole_target, frame.target_center, frame.scale),
    )


def alignment_losses(method: URRT, source: Cloud, target: Cloud, steps: Rigid) -> Array:
    """The Chamfer distance (K,) of the whole source, moved by the estimate of every step, and the whole target."""
    source, target = first(source, method.loss_points), first(target, method.loss_points)

    def aligned(transform: Rigid) -> Array:
        moved = source._replace(points=rigid.apply(transform, source.points))
        return chamfer(moved, target, penalty="distance", scale=method.chamfer_scale)

    return jax.vmap(aligned)(steps)


def partition_loss(
    method: URRT, model: Model, pair: Pair, frame: Frame, whole: Cloud, target: Encoding, key: Array
) -> tuple[Array, Metrics]:
    """The loss that teaches the partition, (), and what is worth a line in the log.

    Places are asked about: whether they lie inside. Branches by place answer for the target as the network sees it,
    because they see its embedding. Branches of parts answer for a sample of the ``whole`` target, in the network's
    frame; besides, two samples are to be cut alike, which pays by ``method.agreement_weight``.
    """
    config = model.config
    asked, drawn = jax.random.split(key)
    if config.partition == "places":
        cloud, condition, told = target.cloud, target.condition, {}
    else:
        samples = noisy_samples(drawn, whole, config.points)
        describe = lambda cloud: inputs_of_parts(config, cloud, moment_invariants(cloud, config.octaves))  # noqa: E731
        both = each_cloud(describe, *samples)
        cloud, condition = samples[0], both[0].condition
        told = {"agreement": agreement_of_samples(model, samples, both, method.chamfer_scale)}
    places, inside = places_about(method, pair, frame, whole, asked)
    inputs = inputs_at_places(config, cloud, places, condition)
    logits = occupancy_logits(branch_logits(config, model.params["partition"], inputs))
    occupancy, counts = occupancy_loss(logits, inside), target.regions.counts
    told |= {
        "occupancy": occupancy,
        "occupancy_accuracy": jnp.mean((logits > 0) == inside),
        "regions_used": jnp.sum(counts > 0.01 * jnp.sum(counts)).astype(jnp.float32),
    }
    return occupancy - method.agreement_weight * told.get("agreement", 0.0), told


def places_about(method: URRT, pair: Pair, frame: Frame, whole: Cloud, key: Array) -> tuple[Array, Array]:
    """Places (Q, 3) about the whole target, in the network's frame, and whether they lie inside, (Q,) bool.

    Those that come with the pair, else they are drawn about the cloud, inside being near to it.
    """
    if pair.queries is None or pair.inside is None:
        return shell_samples(key, first(whole, method.loss_points), method.occupancy_queries)
    rows = jax.random.choice(key, pair.queries.shape[0], (method.occupancy_queries,))
    return (pair.queries[rows] - frame.target_center) / frame.scale, pair.inside[rows]
