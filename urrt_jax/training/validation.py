"""How good a method in training is, on shapes held out of the training split."""

import functools

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.training.pairs import Pair, make_batch
from urrt_jax.training.state import TrainConfig
from urrt_jax.training.trainable import Metrics, Variables


def validation_pairs(config: TrainConfig, shapes: dict[str, Array], count: int) -> dict[str, Pair]:
    """The same pairs at every call: ``count`` clean ones, and as many corrupted where the training corrupts at all."""
    key = jax.random.key(config.seed + 3)
    kinds = {"clean": 0.0} | ({"corrupted": 1.0} if config.pairs.corrupted > 0 else {})
    return {kind: make_batch(key, shapes, config.pairs, count, share) for kind, share in kinds.items()}


def validate(variables: Variables, pairs: dict[str, Pair], config: TrainConfig) -> dict[str, float]:
    """The validation metrics of these variables.

    ``validation_loss``, by which checkpoints are chosen, is the mean over the kinds of pairs of the loss that the
    method's ``evaluate`` gives. The rotation errors (degrees; mean and median) are for people to read.
    """
    metrics: dict[str, float] = {}
    for kind, batch in pairs.items():
        values = jax.device_get(_measure(variables, batch, config))
        metrics |= {f"{kind}_{name}": float(value) for name, value in values.items()}
    losses = [metrics[f"{kind}_loss"] for kind in pairs]
    return {"validation_loss": sum(losses) / len(losses)} | metrics


@functools.partial(jax.jit, static_argnames="config")
def _measure(variables: Variables, batch: Pair, config: TrainConfig) -> Metrics:
    keys = jax.random.split(jax.random.key(0), batch.source.points.shape[0])

    def one(each: tuple[Pair, Array]) -> tuple[Array, Array]:
        pair, key = each
        loss, transform = config.method.evaluate(variables, pair, key)
        return loss, rigid.rotation_angle(transform.rotation, pair.transform.rotation)

    losses, angles = jax.lax.map(one, (batch, keys), batch_size=config.batch)
    degrees = jnp.rad2deg(angles)
    return {
        "loss": jnp.mean(losses),
        "rotation_mean": jnp.mean(degrees),
        "rotation_median": jnp.median(degrees),
        "recall_5deg": jnp.mean(degrees < 5.0),
    }
