"""What the training loop can train: any registration method with initial variables, a loss and an evaluation."""

from typing import Any, Protocol

from jax import Array

from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair

Variables = dict[str, Any]
"""A method's arrays, as Flax keeps them: "params", and "batch_stats" where it has batch norm."""
Metrics = dict[str, Array]
PAIRS = "pairs"
"""The name of the axis of a batch's pairs under ``vmap``: batch norm takes its statistics over it."""


class Trainable(Protocol):
    """A registration method with parameters: a frozen dataclass of its settings, so that it is static under ``jit``.

    Its functions take one pair; the training step applies ``vmap`` with the axis name ``PAIRS``.
    """

    @property
    def name(self) -> str:
        """What ``urrt train --method`` calls it."""
        ...

    def init(self, key: Array) -> Variables:
        """The variables before the first step."""
        ...

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The loss of one pair, (), its parts by name, and "batch_stats" after this batch ({} where there are none)."""
        ...

    def evaluate(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Rigid]:
        """The loss by which checkpoints are chosen, (), and the transform that the method finds."""
        ...
