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
from urrt_jax.losses import chamfer, occupancy_loss, region_agreement, region_pairs, shell_samples
from urrt_jax.model import Model, ModelConfig, init_model
from urrt_jax.model.network import Estimate, estimate_subsampled
from urrt_jax.model.partition import branch_logits, inputs_at_places, inputs_of_parts, occupancy_logits, region_scores
from urrt_jax.neighbors import nearest
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair, add_noise
from urrt_jax.training.trainable import PAIRS, Metrics, Trainable, Variables

_SHARPNESS = 5.0  # of the scores that are to agree: fresh branches hardly differ, and would stay alike twice as long
_NOISE = 0.03  # largest deviation of the noise of samples whose regions are to agree, in the network's frame


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
            occupancy, found = occupancy_of_target(self, model, pair, frame, whole[1], answer, key)
            loss, metrics = loss + self.occupancy_weight * occupancy, metrics | found
            if self.model.partition == "parts":
                agreement = agreement_of_samples(self, model, whole[1], jax.random.fold_in(key, 1))
                loss = loss - self.occupancy_weight * self.agreement_weight * agreement
                metrics |= {"agreement": agreement}
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


def occupancy_of_target(
    method: URRT, model: Model, pair: Pair, frame: Frame, whole: Cloud, answer: Estimate, key: Array
) -> tuple[Array, Metrics]:
    """The loss of occupancy, asked of the target, (), and what is worth a line in the log.

    Where the pair has no queries, they are drawn about the ``whole`` target.
    """
    if pair.queries is None or pair.inside is None:
        queries, inside = shell_samples(key, first(whole, method.loss_points), method.occupancy_queries)
    else:
        rows = jax.random.choice(key, pair.queries.shape[0], (method.occupancy_queries,))
        queries, inside = (pair.queries[rows] - frame.target_center) / frame.scale, pair.inside[rows]
    inputs = inputs_at_places(model.config, answer.target.cloud, queries, answer.target.condition)
    logits = occupancy_logits(branch_logits(model.config, model.params["partition"], inputs))
    counts = answer.target.regions.counts
    loss = occupancy_loss(logits, inside)
    return loss, {
        "occupancy": loss,
        "occupancy_accuracy": jnp.mean((logits > 0) == inside),
        "regions_used": jnp.sum(counts > 0.01 * jnp.sum(counts)).astype(jnp.float32),
    }


def agreement_of_samples(method: URRT, model: Model, cloud: Cloud, key: Array) -> Array:
    """How well the regions of two noisy samples agree (``region_agreement``), (): the mean of this cloud and its batch.

    Points of two random halves of the cloud correspond that are neighbours. Each half has noise of its own. Both are in
    one pose, so that none needs to be known. The batch is that of the ``vmap`` whose axis is ``PAIRS``.

    Args:
      method: what is trained.
      model: the network.
      cloud: N points, in the network's frame, from which the samples are drawn.
      key: random key.
    """
    order, level, *noises = jax.random.split(key, 4)
    rows = jax.random.permutation(order, cloud.mask.shape[0])
    count = min(model.config.points, cloud.mask.shape[0] // 2)
    sigma = jax.random.uniform(level, maxval=_NOISE)
    one, other = (
        add_noise(noise, jax.tree.map(lambda leaf, chosen=chosen: leaf[chosen], cloud), sigma)
        for noise, chosen in zip(noises, (rows[:count], rows[-count:]), strict=True)
    )
    here, there = each_cloud(lambda sample: _sample_scores(model, sample), one, other)
    found = nearest(one.points, other)
    weights = jnp.where(one.mask, jnp.exp(-found.squared / method.chamfer_scale**2), 0.0)
    pairs = region_pairs(here, there[found.index], weights)
    return (region_agreement(pairs) + region_agreement(jax.lax.pmean(pairs, PAIRS))) / 2


def _sample_scores(model: Model, cloud: Cloud) -> Array:
    """The sharpened scores (N, n) of the regions of a cloud whose branches see surroundings."""
    inputs = inputs_of_parts(model.config, cloud, moment_invariants(cloud, model.config.octaves))
    return region_scores(_SHARPNESS * branch_logits(model.config, model.params["partition"], inputs))
