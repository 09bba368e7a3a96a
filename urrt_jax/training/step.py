"""One training step: the unsupervised objective of a batch of pairs, its gradient, one update."""

import functools

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import PartitionSpec

from urrt_jax import rigid
from urrt_jax.clouds import first, shift
from urrt_jax.frames import normalize_pair
from urrt_jax.losses import chamfer, occupancy_loss, shell_samples
from urrt_jax.model import Model
from urrt_jax.model.network import estimate_subsampled
from urrt_jax.model.partition import branch_logits, occupancy_logits
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair, corruption_share, make_batch
from urrt_jax.training.state import TrainConfig, TrainState, optimizer

Metrics = dict[str, Array]


def pair_loss(model: Model, pair: Pair, key: Array, config: TrainConfig) -> tuple[Array, Metrics]:
    """The objective of one pair, (), and its parts: the paper's section 2.4. It never reads ``pair.transform``.

    Alignment is the Chamfer distance between the whole source, moved by the estimate of every step, and the whole
    target, averaged over the steps; the network itself sees the corrupted clouds. Occupancy is asked of the target.
    """
    source, target, frame = normalize_pair(pair.source, pair.target)
    result = estimate_subsampled(model, source, target)

    whole_source = first(shift(pair.whole_source, frame.source_center, frame.scale), config.loss_points)
    whole_target = first(shift(pair.whole_target, frame.target_center, frame.scale), config.loss_points)

    def aligned(transform: Rigid) -> Array:
        moved = whole_source._replace(points=rigid.apply(transform, whole_source.points))
        return chamfer(moved, whole_target, penalty="distance", scale=config.chamfer_scale)

    alignment = jax.vmap(aligned)(result.steps)
    metrics = {"chamfer": alignment[-1], "chamfer_first": alignment[0]}
    loss = jnp.mean(alignment)
    if config.model.has_regions:
        if pair.queries is None or pair.inside is None:
            queries, inside = shell_samples(key, whole_target, config.occupancy_queries)
        else:
            rows = jax.random.choice(key, pair.queries.shape[0], (config.occupancy_queries,))
            queries, inside = (pair.queries[rows] - frame.target_center) / frame.scale, pair.inside[rows]
        logits = branch_logits(config.model, model.params["partition"], queries, result.target.embedding)
        occupancy = occupancy_loss(occupancy_logits(logits), inside)
        counts = result.target.regions.counts
        metrics |= {
            "occupancy": occupancy,
            "occupancy_accuracy": jnp.mean((occupancy_logits(logits) > 0) == inside),
            "regions_used": jnp.sum(counts > 0.01 * jnp.sum(counts)).astype(jnp.float32),
        }
        loss = loss + config.occupancy_weight * occupancy
    return loss, {"loss": loss} | metrics


def batch_loss(params: dict, batch: Pair, key: Array, config: TrainConfig) -> tuple[Array, Metrics]:
    """The mean objective of a batch, (), and the means of its parts; ``vmap`` over pairs happens here."""
    keys = jax.random.split(key, batch.source.points.shape[0])
    model = Model(config.training_network(), params)
    losses, metrics = jax.vmap(lambda pair, pair_key: pair_loss(model, pair, pair_key, config))(batch, keys)
    return jnp.mean(losses), jax.tree.map(jnp.mean, metrics)


def update(state: TrainState, batch: Pair, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """The state after one step on ``batch``, and the step's metrics.

    A step with a non-finite gradient changes nothing but the step number, and says so in the metric ``skipped``.
    """
    key = jax.random.fold_in(jax.random.key(config.seed + 1), state.step)
    (_, metrics), gradient = jax.value_and_grad(batch_loss, has_aux=True)(state.params, batch, key, config)
    norm = optax.tree.norm(gradient)
    updates, opt_state = optimizer(config).update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    healthy = jnp.isfinite(norm)
    params, opt_state = jax.tree.map(
        lambda new, old: jnp.where(healthy, new, old), (params, opt_state), (state.params, state.opt_state)
    )
    metrics |= {"gradient_norm": norm, "skipped": 1.0 - healthy}
    return TrainState(state.step + 1, params, opt_state), metrics


train_step = jax.jit(update, static_argnames="config", donate_argnames="state")
"""``update``, jitted, with the state's buffers donated."""


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def train_steps(state: TrainState, shapes: dict[str, Array], config: TrainConfig) -> tuple[TrainState, Metrics]:
    """The state after ``config.steps_per_call`` steps in one dispatch, and the mean of their metrics.

    Every batch is a pure function of (seed, step), made on the device from ``shapes`` (see ``make_batch``), and split
    over the devices of the current mesh's axis "data" where there is one that divides it.
    """

    def one(state: TrainState, _: None) -> tuple[TrainState, Metrics]:
        key = jax.random.fold_in(jax.random.key(config.seed + 2), state.step)
        share = corruption_share(config.pairs, state.step / config.steps)
        batch = make_batch(key, shapes, config.pairs, config.batch, share)
        return update(state, _spread(batch, config.batch), config)

    if config.steps_per_call == 1:
        return one(state, None)
    state, metrics = jax.lax.scan(one, state, None, length=config.steps_per_call)
    return state, jax.tree.map(jnp.mean, metrics)


def _spread(batch: Pair, size: int) -> Pair:
    """The batch, split over the mesh's axis "data" where there is one that divides it."""
    mesh = jax.sharding.get_abstract_mesh()
    if "data" not in mesh.axis_names or size % mesh.shape["data"]:
        return batch
    return jax.lax.with_sharding_constraint(batch, PartitionSpec("data"))
