"""The learned block that every stage is built from, and how a block runs: as a pure function of its parameters."""

from typing import Any, cast

import flax.linen as nn
from jax import Array


class Perceptron(nn.Module):
    """Dense layers with ReLU between them, and layer normalisation before each ReLU where asked.

    Attributes:
      widths: the hidden layers' widths and then the output's.
      normalize: whether hidden layers are normalised (LayerNorm: no state, no mixing of pairs).
      output_init: initializer of the last layer's kernel.
    """

    widths: tuple[int, ...]
    normalize: bool = False
    output_init: nn.initializers.Initializer = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Outputs (..., widths[-1]) of inputs (..., any)."""
        for width in self.widths[:-1]:
            inputs = nn.Dense(width)(inputs)
            inputs = nn.relu(nn.LayerNorm()(inputs) if self.normalize else inputs)
        return nn.Dense(self.widths[-1], kernel_init=self.output_init)(inputs)


def run(block: nn.Module, params: dict, *inputs: Any) -> Array:
    """The output of a block with these parameters."""
    return cast(Array, block.apply({"params": params}, *inputs))
