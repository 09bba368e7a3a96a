"""Points drawn on the surface of a mesh."""

from __future__ import annotations

import numpy as np

MAX_SAMPLES = 10_000_000
"""The most points that `read_cloud` draws on a mesh: 240 MB of coordinates. The bound stops a mistyped number."""


def check_samples(samples: int, *, name: str = "samples") -> None:
    """Raises a `ValueError` that names the option unless `samples` is a whole number from 1 to `MAX_SAMPLES`."""
    whole = isinstance(samples, int | np.integer) and not isinstance(samples, bool)
    if not whole or not 1 <= samples <= MAX_SAMPLES:
        raise ValueError(f"{name}: expected a whole number from 1 to {MAX_SAMPLES:,}, got {samples!r}")


def sample_surface(triangles: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points drawn area-uniformly on triangles: (count, 3) from `triangles` (F, 3, 3), in random order.

    Faces are drawn by their area, then a point in each by folding the unit square onto the triangle.
    """
    return sample_surface_with_normals(triangles, count, rng)[0]


def sample_surface_with_normals(
    triangles: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """The points (count, 3) that `sample_surface` draws, and the unit normals (count, 3) of the faces they lie on.

    A normal points to the side from which the face's corners go round counter-clockwise.
    """
    corner, one, two = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normals = np.cross(one, two)
    doubled = np.linalg.norm(normals, axis=1)
    area = np.cumsum(doubled)
    # `right` and the clip keep faces without area out, also at the very ends of the range.
    face = np.searchsorted(area, rng.random(count) * area[-1], side="right").clip(max=len(area) - 1)
    along = rng.random((count, 2))
    along = np.where(along.sum(axis=1, keepdims=True) > 1, 1 - along, along)
    points = corner[face] + along[:, :1] * one[face] + along[:, 1:] * two[face]
    return points, normals[face] / doubled[face, None]
