"""Shapes: a set of equally large point clouds with labels, whatever they were read from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class Shapes:
    """A set of S shapes of P points each, every one centred and scaled to the unit sphere.

    Attributes:
        points: (S, P, 3) float32.
        labels: (S,) int32, an index into `classes`.
        names: S names, one a shape.
        classes: the names of the classes.
        queries: (S, Q, 3) float32 points around each shape, in its frame; None where inside and outside are unknown.
        inside: (S, Q) bool, whether each query lies inside the solid.
        skipped: (file, reason) of every file that could not be used.

    Raises `ValueError` where these do not fit together.
    """

    points: np.ndarray
    labels: np.ndarray
    names: tuple[str, ...]
    classes: tuple[str, ...]
    queries: np.ndarray | None = None
    inside: np.ndarray | None = None
    skipped: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        _check("points", self.points, np.float32, (None, None, 3))
        count = len(self.points)
        if self.points.size == 0:
            raise ValueError(f"points must hold at least one shape of one point, got shape {self.points.shape}")
        if not np.isfinite(self.points).all():
            broken = np.flatnonzero(~np.isfinite(self.points).all(axis=(1, 2)))
            raise ValueError(f"points of {len(broken)} shapes are not finite, the first is shape {broken[0]}")
        _check("labels", self.labels, np.int32, (count,))
        if self.labels.min() < 0 or self.labels.max() >= len(self.classes):
            raise ValueError(
                f"labels must lie in 0..{len(self.classes) - 1}, the indices of the {len(self.classes)} classes, "
                f"got {self.labels.min()}..{self.labels.max()}"
            )
        if len(self.names) != count:
            raise ValueError(f"names must be {count}, one a shape, got {len(self.names)}")
        if (self.queries is None) != (self.inside is None):
            raise ValueError("queries and inside come together: one of them is None")
        if self.queries is not None and self.inside is not None:
            _check("queries", self.queries, np.float32, (count, None, 3))
            _check("inside", self.inside, np.bool_, self.queries.shape[:2])

    def __len__(self) -> int:
        """The number of shapes."""
        return len(self.points)

    def take(self, indices: Sequence[int] | np.ndarray) -> Shapes:
        """The shapes at these indices, in this order; `ValueError` where there are none or one is out of range."""
        indices = np.asarray(indices)
        if indices.ndim != 1 or indices.size == 0 or not np.issubdtype(indices.dtype, np.integer):
            raise ValueError(f"indices must be integers of shape (K,), K > 0, got {indices.dtype} {indices.shape}")
        if indices.min() < 0 or indices.max() >= len(self):
            raise ValueError(f"indices must lie in 0..{len(self) - 1}, got {indices.min()}..{indices.max()}")
        return replace(
            self,
            points=self.points[indices],
            labels=self.labels[indices],
            names=tuple(self.names[i] for i in indices),
            queries=None if self.queries is None else self.queries[indices],
            inside=None if self.inside is None else self.inside[indices],
        )

    def first_categories(self, count: int) -> Shapes:
        """The shapes of the first `count` categories, by label; `ValueError` where these are none, or all."""
        rows = np.flatnonzero(self.labels < count)
        if not 0 < len(rows) < len(self):
            raise ValueError(f"categories: expected some of the {len(self.classes)} here, and not all, got {count}")
        return self.take(rows)

    def split_validation(self, fraction: float, seed: int) -> tuple[Shapes, Shapes]:
        """Two disjoint sets (train, validation): a share held out to choose models by, the same for the same seed.

        Call it on the training split; models must not be chosen by their test loss. `fraction` in (0, 1) is the share
        of the validation set, at least one shape; at least one is left to train on. Both keep the original order.
        """
        if not 0 < fraction < 1 or len(self) < 2:
            raise ValueError(f"needs a fraction in (0, 1) and two shapes or more, got {fraction} of {len(self)}")
        held = int(np.clip(round(fraction * len(self)), 1, len(self) - 1))
        order = np.random.default_rng(seed).permutation(len(self))
        return self.take(np.sort(order[held:])), self.take(np.sort(order[:held]))


def unit_sphere(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """A cloud (N, 3) moved to its mean and scaled into the unit sphere, with that centre (3,) and scale.

    `points == result * scale + centre`. Raises `ValueError` where all points coincide.
    """
    centre = points.mean(axis=0)
    centred = points - centre
    scale = float(np.linalg.norm(centred, axis=1).max())
    if not scale > 0:
        raise ValueError(f"all {len(points)} points coincide")
    return centred / scale, centre, scale


def _check(name: str, array: np.ndarray, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Nothing, or a ValueError where an array is not of this type and shape (None: any length)."""
    fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits or array.dtype != dtype:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must be {np.dtype(dtype)} of shape ({wanted}), got {array.dtype} {array.shape}")
