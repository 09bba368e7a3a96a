"""How good a network in training is, on shapes held out of the training split."""

import functools

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.model import Model
from urrt_jax.model.network import predict
from urrt_jax.training.pairs import Pair, make_batch
from urrt_jax.training.state import TrainConfig
from urrt_jax.training.step import pair_loss


def validation_pairs(config: TrainConfig, shapes: dict[str, Array], count: int) -> dict[str, Pair]:
    """The same pairs at every call: ``count`` clean ones, and as many corrupted where the training corrupts at all."""
    key = jax.random.key(config.seed + 3)
    kinds = {"clean": 0.0} | ({"corrupted": 1.0} if config.pairs.corrupted > 0 else {})
    return {kind: make_batch(key, shapes, config.pairs, count, share) for kind, share in kinds.items()}


def validate(params: dict, pairs: dict[str, Pair], config: TrainConfig) -> dict[str, float]:
    """The validation metrics of these parameters.

    ``validation_loss``, by which checkpoints are chosen, is the mean final Chamfer distance over the kinds of pairs:
    like the training it needs no labels. The rotation errors (degrees; mean and median) are for people to read.
    """
    metrics: dict[str, float] = {}
    for kind, batch in pairs.items():
        values = jax.device_get(_measure(params, batch, config))
        metrics |= {f"{kind}_{name}": float(value) for name, value in values.items()}
    losses = [metrics[f"{kind}_chamfer"] for kind in pairs]
    return {"validation_loss": sum(losses) / len(losses)} | metrics


@functools.partial(jax.jit, static_argnames="config")
def _measure(params: dict, batch: Pair, config: TrainConfig) -> dict[str, Array]:
    model, key = Model(config.model, params), jax.random.key(0)

    def one(pair: Pair) -> tuple[Array, Array]:
        _, metrics = pair_loss(model, pair, key, config)
        transform = predict(model, pair.source, pair.target)
        return metrics["chamfer"], rigid.rotation_angle(transform.rotation, pair.transform.rotation)

    chamfer, angle = jax.lax.map(one, batch, batch_size=config.batch)
    degrees = jnp.rad2deg(angle)
    return {
        "chamfer": jnp.mean(chamfer),
        "rotation_mean": jnp.mean(degrees),
        "rotation_median": jnp.median(degrees),
        "recall_5deg": jnp.mean(degrees < 5.0),
    }
