"""What the figure and the page both show: the points of two clouds, and where the source starts and ends."""

from dataclasses import dataclass

import numpy as np
from jax.typing import ArrayLike

from urrt_jax.clouds import CloudLike, as_array
from urrt_jax.result import Registration


@dataclass(frozen=True)
class DrawnCloud:
    """The points of a cloud that are drawn.

    Attributes:
      points: (N, 3) float64, about ``centre``; finite, and always the same ones of a cloud.
      centre: (3,), the mean of the cloud's finite points; zero if it has none.
      labels: (N,) the regions of these points.
      count: how many points the whole cloud has.
    """

    points: np.ndarray
    centre: np.ndarray
    labels: np.ndarray
    count: int


@dataclass(frozen=True)
class Scene:
    """Both clouds, in a frame whose origin is the target's centre.

    Attributes:
      source: about its own centre.
      target: about the origin.
      start: (3,), where the source's centre is drawn before registration.
      closer: whether that is nearer the target than it truly is: clouds in far frames would be two specks.
    """

    source: DrawnCloud
    target: DrawnCloud
    start: np.ndarray
    closer: bool

    @staticmethod
    def of(source: CloudLike, target: CloudLike, result: Registration, *, points: int) -> "Scene":
        """The scene with at most so many points of each cloud.

        Raises:
          ValueError: a batch, or clouds of other sizes than the ones registered.
        """
        if np.ndim(result.rotation) != 2:
            raise ValueError(f"result: a picture shows one pair, got a batch of shape {np.shape(result.rotation)[:-2]}")
        moving = _cloud("source", source, result.source_regions, points)
        fixed = _cloud("target", target, result.target_regions, points)
        gap = moving.centre - fixed.centre
        distance = float(np.linalg.norm(gap))
        reach = _radius(moving.points) + _radius(fixed.points)
        closer = distance > 1.5 * reach > 0
        return Scene(moving, fixed, gap * (reach / distance) if closer else gap, closer)

    def end(self, rotation: ArrayLike, translation: ArrayLike) -> np.ndarray:
        """Where this transform puts the source's centre, (3,) float64."""
        moved = np.asarray(rotation, np.float64) @ self.source.centre + np.asarray(translation, np.float64)
        return moved - self.target.centre


def _cloud(name: str, points: CloudLike, labels: ArrayLike, most: int) -> DrawnCloud:
    points, labels = np.asarray(as_array(points, name), np.float64), np.asarray(labels)
    if points.shape != (len(labels), 3):
        raise ValueError(f"{name}: expected the ({len(labels)}, 3) points registered, got {points.shape}")
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    centre = points[rows].mean(axis=0) if len(rows) else np.zeros(3)
    if len(rows) > most:
        # Random rows, because every k-th point of ordered scan lines would show stripes.
        rows = np.sort(np.random.default_rng(0).choice(rows, most, replace=False))
    return DrawnCloud(points[rows] - centre, centre, labels[rows], len(points))


def _radius(points: np.ndarray) -> float:
    return float(np.linalg.norm(points, axis=1).max(initial=0.0))
