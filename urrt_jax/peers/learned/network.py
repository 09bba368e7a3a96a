"""What every learned peer is: a network of a paper, with a loss to train it by; and its estimates in batches."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair
from urrt_jax.training.trainable import Metrics, Trainable, Variables


@dataclasses.dataclass(frozen=True, kw_only=True)
class Network(Trainable):
    """A learned registration network of another paper. Its settings are its fields.

    Functions take one pair; ``vmap`` is applied at the edge. Clouds are in the frame they come in, in the unit of the
    shapes' bounding sphere: what a network centres or scales, it does itself, as published.

    Attributes:
      learning_rate: of its published recipe.
      largest_batch: how many pairs are estimated at once, so that they fit into memory.
    """

    learning_rate: ClassVar[float] = 1e-3
    largest_batch: ClassVar[int] = 32

    @property
    def name(self) -> str:
        """What commands call it: ``urrt train --method NAME``, ``urrt evaluate --methods NAME``."""
        raise NotImplementedError

    @property
    def title(self) -> str:
        """What tables call it."""
        raise NotImplementedError

    def init(self, key: Array) -> Variables:
        """Random variables: "params", and "batch_stats" where the network has batch norm."""
        raise NotImplementedError

    def estimate(self, variables: Variables, source: Cloud, target: Cloud, key: Array) -> Rigid:
        """The transform that carries the source onto the target; ``key`` for networks that draw at test time."""
        raise NotImplementedError

    def loss(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Metrics, Variables]:
        """The published loss of one pair in training mode, with its parts and the new "batch_stats"."""
        raise NotImplementedError

    def evaluate(self, variables: Variables, pair: Pair, key: Array) -> tuple[Array, Rigid]:
        """DCP's loss of the estimate, by which checkpoints are chosen, and the estimate."""
        found = self.estimate(variables, pair.source, pair.target, key)
        return pose_loss(found, pair.transform), found

    def from_release(self, arrays: Mapping[str, np.ndarray]) -> Variables:
        """The variables in the authors' released weights: flat names, as PyTorch has them, to arrays.

        Raises:
          ValueError: an array is missing or has another shape.
        """
        raise ValueError(f"{self.title}: its authors have released no weights that can be read here")


def pose_loss(found: Rigid, truth: Rigid) -> Array:
    """DCP's loss (Wang and Solomon 2019, eq. 9), (): mean squared entries of R_gtᵀ R - I, and of t - t_gt."""
    turn = jnp.matmul(truth.rotation.T, found.rotation, precision=jax.lax.Precision.HIGHEST)
    return jnp.mean((turn - jnp.eye(3)) ** 2) + jnp.mean((found.translation - truth.translation) ** 2)


@functools.partial(jax.jit, static_argnames="network")
def estimate_batch(network: Network, variables: Variables, sources: Cloud, targets: Cloud, key: Array) -> Rigid:
    """The transforms of B pairs, with a leading axis: points (B, N, 3) and (B, M, 3), masks (B, N) and (B, M).

    All pairs get the same ``key``, so that the answer for a pair does not depend on its place in a batch.
    """
    return jax.vmap(network.estimate, in_axes=(None, 0, 0, None))(variables, sources, targets, key)
