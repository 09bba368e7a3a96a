"""What training carries from step to step, and the configuration that fixes how."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from urrt_jax.checks import check_positive, check_whole
from urrt_jax.model import ModelConfig, init_model
from urrt_jax.training.pairs import PairConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run. With the shapes it fixes the weights; both are identified beside the checkpoints.

    Attributes:
      model: the network.
      pairs: how pairs are drawn and corrupted.
      steps: optimiser steps.
      batch: pairs a step.
      learning_rate: its peak, after ``warmup`` steps; then a cosine down to a hundredth of it.
      warmup: steps of linear warm-up.
      weight_decay: AdamW's, on matrices only.
      clip: largest global norm of the gradient.
      occupancy_weight: weight of the occupancy loss against the Chamfer loss.
      occupancy_queries: points at which occupancy is asked, per pair.
      chamfer_scale: scale of the Chamfer penalty, in units of the normalised pair.
      loss_points: points of each whole cloud that the Chamfer loss compares.
      unrolled: steps of the network that training runs, at most the model's; later ones see what the last of them saw.
      lookups: points of each cloud that training looks up, at most the model's.
      rounds: of consensus among landmarks in training, at most the model's, and no hypotheses: fresh landmarks agree on
        nothing.
      steps_per_call: steps that run as one dispatch (``lax.scan``).
      seed: of the initial weights and of every pair.
    """

    model: ModelConfig = ModelConfig()
    pairs: PairConfig = PairConfig()
    steps: int = 8_000
    batch: int = 32
    learning_rate: float = 1e-3
    warmup: int = 200
    weight_decay: float = 1e-4
    clip: float = 1.0
    occupancy_weight: float = 0.02
    occupancy_queries: int = 256
    chamfer_scale: float = 0.1
    loss_points: int = 512
    unrolled: int = 2
    lookups: int = 256
    rounds: int = 4
    steps_per_call: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        check_whole(self, steps=1, batch=1, occupancy_queries=1, loss_points=1)
        check_whole(self, unrolled=1, lookups=0, rounds=0, steps_per_call=1, seed=0)
        check_positive(self, "learning_rate", "clip", "chamfer_scale")
        for name in ("warmup", "weight_decay", "occupancy_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
        if self.steps % self.steps_per_call:
            raise ValueError(f"steps_per_call: {self.steps_per_call} does not divide steps, {self.steps}")
        if self.loss_points > self.pairs.points:
            raise ValueError(f"loss_points: {self.loss_points} exceeds the {self.pairs.points} points of a pair")

    def training_network(self) -> ModelConfig:
        """The network as training runs it: the parameters are the same, but it does less."""
        return dataclasses.replace(
            self.model,
            steps=min(self.unrolled, self.model.steps),
            lookups=min(self.lookups, self.model.lookups),
            consensus=min(self.rounds, self.model.consensus),
            hypotheses=0,
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """Step number, parameters and optimiser state: all that a checkpoint holds."""

    step: Array
    params: dict
    opt_state: Any


def optimizer(config: TrainConfig) -> optax.GradientTransformation:
    """AdamW with a global-norm clip, linear warm-up and cosine decay."""
    schedule = optax.warmup_cosine_decay_schedule(
        0.0,
        config.learning_rate,
        min(config.warmup, config.steps // 2),
        config.steps,
        config.learning_rate / 100,
    )
    return optax.chain(
        optax.clip_by_global_norm(config.clip),
        optax.adamw(
            schedule,
            weight_decay=config.weight_decay,
            mask=lambda params: jax.tree.map(lambda leaf: leaf.ndim > 1, params),
        ),
    )


@functools.partial(jax.jit, static_argnames="config")
def init_state(config: TrainConfig) -> TrainState:
    """The state before the first step: a pure function of the configuration."""
    params = init_model(jax.random.key(config.seed), config.model).params
    return TrainState(jnp.zeros((), jnp.int32), params, optimizer(config).init(params))
