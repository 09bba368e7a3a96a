"""What training carries from step to step, and the configuration that fixes how."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from urrt_jax.checks import check_positive, check_whole
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.trainable import Trainable, Variables
from urrt_jax.training.urrt import URRT
from urrt_jax.weights.files import flatten, unflatten


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run. With the shapes it fixes the weights; both are identified beside the checkpoints.

    Attributes:
      method: what is trained, with its own settings.
      pairs: how pairs are drawn and corrupted.
      steps: optimiser steps.
      batch: pairs a step.
      learning_rate: its peak, after ``warmup`` steps; then a cosine down to a hundredth of it.
      warmup: steps of linear warm-up.
      weight_decay: AdamW's, on matrices only.
      clip: largest global norm of the gradient.
      steps_per_call: steps that run as one dispatch (``lax.scan``).
      seed: of the initial weights and of every pair.
    """

    method: Trainable = URRT()
    pairs: PairConfig = PairConfig()
    steps: int = 8_000
    batch: int = 32
    learning_rate: float = 1e-3
    warmup: int = 200
    weight_decay: float = 1e-4
    clip: float = 1.0
    steps_per_call: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        check_whole(self, steps=1, batch=1, steps_per_call=1, seed=0)
        check_positive(self, "learning_rate", "clip")
        for name in ("warmup", "weight_decay"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: expected at least 0, got {getattr(self, name)}")
        if self.steps % self.steps_per_call:
            raise ValueError(f"steps_per_call: {self.steps_per_call} does not divide steps, {self.steps}")
        if isinstance(self.method, URRT) and self.method.loss_points > self.pairs.points:
            raise ValueError(f"loss_points: {self.method.loss_points} exceeds the {self.pairs.points} points of a pair")

    def as_dict(self) -> dict[str, Any]:
        """All fields, for JSON; the method's begin with its name, because other methods may have the same fields."""
        fields = dataclasses.asdict(self)
        return fields | {"method": {"name": self.method.name} | fields["method"]}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """Step number, parameters, statistics of batch norm ({} without) and optimiser state: all of a checkpoint."""

    step: Array
    params: dict
    batch_stats: dict
    opt_state: Any

    @property
    def variables(self) -> Variables:
        """The method's variables: "params", and "batch_stats" where it has batch norm."""
        return {"params": self.params} | ({"batch_stats": self.batch_stats} if self.batch_stats else {})


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
    variables = config.method.init(jax.random.key(config.seed))
    params = variables["params"]
    return TrainState(
        jnp.zeros((), jnp.int32), params, variables.get("batch_stats", {}), optimizer(config).init(params)
    )


def begin_with(state: TrainState, params: dict) -> TrainState:
    """The state before the first step, with these parameters in the place of its own (``counterparts``).

    Raises:
      ValueError: none of them has the name and shape of one of the state's.
    """
    taken = counterparts(state.params, params)
    if not taken:
        raise ValueError("start: none of its parameters has the name and shape of one of this network's")
    return dataclasses.replace(state, params=unflatten(flatten(state.params) | taken))


def counterparts(own: dict, given: dict) -> dict[str, Any]:
    """Those of the given parameters, by flat keys, whose names and shapes are those of a network's own.

    A network that differs in a part, for example in how it cuts clouds, finds the rest of a trained one here.
    """
    expected, found = flatten(own), flatten(given)
    return {key: found[key] for key in expected if key in found and found[key].shape == expected[key].shape}
