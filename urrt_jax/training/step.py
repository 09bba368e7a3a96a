"""One training step: the loss of a batch of pairs, its gradient, one update."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import PartitionSpec

from urrt_jax.training.pairs import Pair, corruption_share, make_batch
from urrt_jax.training.state import TrainConfig, TrainState, optimizer
from urrt_jax.training.trainable import PAIRS, Metrics, Variables


def batch_loss(
    variables: Variables, batch: Pair, key: Array, config: TrainConfig
) -> tuple[Array, tuple[Metrics, Variables]]:
    """The mean loss of a batch, (), the means of its parts, and "batch_stats" after it; ``vmap`` over pairs is here."""
    keys = jax.random.split(key, batch.source.points.shape[0])
    each = jax.vmap(functools.partial(config.method.loss, variables), axis_name=PAIRS, out_axes=(0, 0, None))
    losses, metrics, batch_stats = each(batch, keys)
    return jnp.mean(losses), ({"loss": jnp.mean(losses)} | jax.tree.map(jnp.mean, metrics), batch_stats)


def update(state: TrainState, batch: Pair, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """The state after one step on ``batch``, and the step's metrics.

    A step with a non-finite gradient changes nothing but the step number, and says so in the metric ``skipped``.
    """
    key = jax.random.fold_in(jax.random.key(config.seed + 1), state.step)

    def objective(params: dict) -> tuple[Array, tuple[Metrics, Variables]]:
        return batch_loss(dataclasses.replace(state, params=params).variables, batch, key, config)

    (_, (metrics, batch_stats)), gradient = jax.value_and_grad(objective, has_aux=True)(state.params)
    norm = optax.tree.norm(gradient)
    updates, opt_state = optimizer(config).update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    after = dataclasses.replace(state, params=params, batch_stats=batch_stats, opt_state=opt_state)
    healthy = jnp.isfinite(norm)
    after = jax.tree.map(lambda new, old: jnp.where(healthy, new, old), after, state)
    metrics |= {"gradient_norm": norm, "skipped": 1.0 - healthy}
    return dataclasses.replace(after, step=state.step + 1), metrics


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
