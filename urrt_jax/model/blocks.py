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


def region_perceptrons(widths: tuple[int, ...], output_init: nn.initializers.Initializer) -> nn.Module:
    """Normalised perceptrons with weights of their own, one a region: (n, any) to (n, widths[-1])."""
    kind = nn.vmap(Perceptron, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=0, out_axes=0)
    return kind(widths, normalize=True, output_init=output_init)


def run(block: nn.Module, params: dict, *inputs: Any) -> Array:
    """The output of a block with these parameters."""
    return cast(Array, block.apply({"params": params}, *inputs))
