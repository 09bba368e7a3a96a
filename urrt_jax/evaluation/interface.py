"""What a registration method is to ``evaluate``: its answers, its interface, and how it takes batches."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

BATCH = 32  # pairs: on a CPU, twice as many leave its caches and take an eighth longer each


class Poses(NamedTuple):
    """The answers for B pairs: (B, 3, 3), (B, 3), and what the method says of them, NaN where it says nothing."""

    rotation: np.ndarray
    translation: np.ndarray
    fitness: np.ndarray
    converged: np.ndarray


class Method(Protocol):
    """A registration method as ``evaluate`` runs it.

    One with an attribute ``informed`` that is true is also told what is known of the poses: ``align`` then takes
    ``expected``, of every trial.
    """

    @property
    def title(self) -> str:
        """How tables call it."""
        ...

    @property
    def batch(self) -> int:
        """How many pairs it takes at once, at most."""
        ...

    def identity(self) -> dict[str, Any]:
        """Everything that its answers depend on, for results files.

        Raises:
          ImportError: its library or its weights are missing; the message says how to get them.
        """
        ...

    def align(self, sources: Sequence[np.ndarray], targets: Sequence[np.ndarray]) -> Poses:
        """The poses of B pairs of clouds (N, 3) and (M, 3)."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class InBatches:
    """A method that takes pairs in batches, each filled up with copies, so that one program serves all.

    Attributes:
      batch: pairs at once.
    """

    batch: int = BATCH

    def for_pairs(self, count: int, batch: int | None) -> Self:
        """The method as it takes ``count`` pairs in all, with another size of batches where one is given."""
        return self if batch is None else dataclasses.replace(self, batch=batch)
