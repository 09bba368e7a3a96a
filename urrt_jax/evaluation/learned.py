"""Learned peers as methods: the network of another paper with released or trained weights, in batches."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Self

import jax
import numpy as np

from urrt_jax.clouds import Cloud
from urrt_jax.evaluation.interface import InBatches, Poses
from urrt_jax.peers.learned.network import estimate_batch
from urrt_jax.peers.learned.weights import NETWORKS, RELEASED, Trained, load_network, load_released


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learned(InBatches):
    """A learned peer.

    Every pair gets the same random key, of seed 0: a network that draws at test time (PRNet) gives the same answer
    again, whatever else is in the batch.

    Attributes:
      weights: a trained network, or a name in ``RELEASED`` or ``NETWORKS``, whose weights are read at their first use.
    """

    weights: Trained | str

    @property
    def title(self) -> str:
        """How tables call it."""
        if isinstance(self.weights, Trained):
            return self.weights.title
        return (RELEASED.get(self.weights) or NETWORKS[self.weights]).title

    @functools.cached_property
    def trained(self) -> Trained:
        """The network with its weights.

        Raises:
          ImportError: released weights are not on this machine, or there are none; the message says what to do.
        """
        return self.weights if isinstance(self.weights, Trained) else load_released(self.weights)

    def identity(self) -> dict[str, Any]:
        """Its settings, the digest of its variables and where they are from; ImportError where they are missing."""
        return self.trained.settings

    def for_pairs(self, count: int, batch: int | None) -> Self:
        """The same, with batches of at most ``count`` pairs: unlike ours, its programs are not kept for later runs."""
        return dataclasses.replace(self, batch=min(self.batch if batch is None else batch, count))

    def align(self, sources: Sequence[np.ndarray], targets: Sequence[np.ndarray]) -> Poses:
        """The poses of B pairs of clouds (N, 3) and (M, 3). Pairs of equal N and M share batches."""
        groups: dict[tuple[int, int], list[int]] = {}
        for row, (source, target) in enumerate(zip(sources, targets, strict=True)):
            groups.setdefault((len(source), len(target)), []).append(row)
        unknown = np.full(len(sources), np.nan)
        poses = Poses(np.empty((len(sources), 3, 3)), np.empty((len(sources), 3)), unknown, unknown)
        for rows in groups.values():
            for start in range(0, len(rows), self.batch):
                part = rows[start : start + self.batch]
                filled = part + part[-1:] * (self.batch - len(part))
                clouds = (_stacked([each[row] for row in filled]) for each in (sources, targets))
                found = estimate_batch(self.trained.network, self.trained.variables, *clouds, jax.random.key(0))
                poses.rotation[part] = np.asarray(found.rotation)[: len(part)]
                poses.translation[part] = np.asarray(found.translation)[: len(part)]
        return poses


def find_learned(name: str, path: str | None = None) -> Learned:
    """The learned peer of this name, with released weights or with those in a file that ``urrt train`` wrote.

    Raises:
      ValueError: there is no such method, or the file does not hold weights of that network.
    """
    if path is None:
        network = RELEASED[name].network if name in RELEASED else NETWORKS[name]
        return Learned(weights=name, batch=network.largest_batch)
    if name not in NETWORKS:
        raise ValueError(f"method: expected one of {', '.join(NETWORKS)} before a file of weights, got {name!r}")
    trained = load_network(path)
    if trained.network.name != name:
        raise ValueError(f"method: {path} holds weights of {trained.network.name}, not of {name}")
    return Learned(weights=trained, batch=trained.network.largest_batch)


def _stacked(clouds: Sequence[np.ndarray]) -> Cloud:
    """B clouds of N points each as one with a leading axis, all points real."""
    points: Any = np.stack(clouds).astype(np.float32)
    mask: Any = np.ones(points.shape[:2], bool)
    return Cloud(points, mask)
