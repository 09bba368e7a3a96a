"""Made-up solids: data for trials, tests and demonstrations that needs no download.

A shape is the union of two to six parts. A part is a simple solid in canonical coordinates under an affine map, so one
formula tells whether a point is inside it, and the union's outer surface is what no other part covers.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from urrt_jax.data.shapes import Shapes, unit_sphere
from urrt_jax.data.solid import draw_queries, grid_half_width, voxel_centres
from urrt_jax.io import sample_surface

_RESOLUTIONS = (16, 32, 64)
_TRIAL_POINTS = 640  # points on which a shape is judged before it is accepted

# Whether canonical points (..., 3) are inside. All solids fit the cube [-1, 1]^3 and touch its top and bottom.
_INSIDE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "box": lambda p: np.abs(p).max(axis=-1) < 1,
    "wedge": lambda p: (np.abs(p).max(axis=-1) < 1) & (p[..., 0] + p[..., 2] < 0),
    "ball": lambda p: (p**2).sum(axis=-1) < 1,
    "cylinder": lambda p: (p[..., 0] ** 2 + p[..., 1] ** 2 < 1) & (np.abs(p[..., 2]) < 1),
    "cone": lambda p: (np.hypot(p[..., 0], p[..., 1]) < (1 - p[..., 2]) / 2) & (np.abs(p[..., 2]) < 1),
    "capsule": lambda p: p[..., 0] ** 2 + p[..., 1] ** 2 + (np.abs(p[..., 2]) - 0.5).clip(0) ** 2 < 0.25,
    "torus": lambda p: (np.hypot(p[..., 0], p[..., 1]) - 0.7) ** 2 + p[..., 2] ** 2 < 0.09,
}

_FAMILIES: dict[str, tuple[str, ...]] = {
    "blocks": ("box", "wedge"),
    "turned": ("cylinder", "cone", "torus"),
    "round": ("ball", "capsule", "torus"),
    "mixed": tuple(_INSIDE),
}


class _Part(NamedTuple):
    """A solid under the affine map x -> linear @ x + centre."""

    solid: str
    linear: np.ndarray
    centre: np.ndarray

    def triangles(self) -> np.ndarray:
        return _template(self.solid) @ self.linear.T + self.centre

    def contains(self, points: np.ndarray) -> np.ndarray:
        return _INSIDE[self.solid]((points - self.centre) @ np.linalg.inv(self.linear).T)


def procedural_shapes(count: int = 256, *, points: int = 1024, seed: int = 0, queries: int = 0) -> Shapes:
    """Varied solids without rotational symmetry, as clouds drawn area-uniformly on their outer surface.

    The i-th shape depends on `seed` and i alone, not on `count`; its form does not depend on `points` or `queries`
    either. Shapes take turns among four families (blocks, turned, round, mixed), which are the classes.
    Every shape has distinct principal moments, and half a turn about a principal axis visibly moves it, so no rotation
    maps it onto itself.

    Args:
        count: how many shapes.
        points: points in each.
        seed: another seed gives other shapes.
        queries: if positive, as many points in each with their exact inside or outside, drawn as in
            `urrt_jax.data.solid.sample_occupancy`.

    Raises:
        ValueError: `count` or `points` is not positive, or `queries` or `seed` is negative.
    """
    if count < 1 or points < 1 or queries < 0 or seed < 0:
        raise ValueError(
            f"needs count > 0, points > 0, queries >= 0 and seed >= 0, got {count}, {points}, {queries} and {seed}"
        )
    families = list(_FAMILIES)
    labels = np.arange(count, dtype=np.int32) % len(families)
    clouds = np.empty((count, points, 3), np.float32)
    asked = np.empty((count, queries, 3), np.float32)
    inside = np.empty((count, queries), bool)
    for i in range(count):
        parts = _asymmetric_parts(families[labels[i]], np.random.default_rng([seed, i, 0]))
        clouds[i], centre, scale = unit_sphere(_outer_surface(parts, points, np.random.default_rng([seed, i, 1])))
        if queries:
            asked[i], inside[i] = _occupancy(parts, centre, scale, queries, np.random.default_rng([seed, i, 2]))
    return Shapes(
        points=clouds,
        labels=labels,
        names=tuple(f"{families[label]}_{i:04d}" for i, label in enumerate(labels)),
        classes=tuple(families),
        queries=asked if queries else None,
        inside=inside if queries else None,
    )


def demo_shape(points: int = 2048, *, seed: int = 9) -> np.ndarray:
    """One object to show, without symmetry: (points, 3) float32 in the unit sphere.

    Example:
        >>> demo_shape(500).shape
        (500, 3)
    """
    parts = _asymmetric_parts("mixed", np.random.default_rng([seed, 0, 0]))
    return unit_sphere(_outer_surface(parts, points, np.random.default_rng([seed, 0, 1])))[0].astype(np.float32)


def _asymmetric_parts(family: str, rng: np.random.Generator) -> list[_Part]:
    """Parts drawn until their union has no rotational symmetry and none of them is buried."""
    while True:
        parts = _random_parts(family, rng)
        owners, surface = _visible(parts, _TRIAL_POINTS, rng)
        shares = np.bincount(owners, minlength=len(parts)) / len(owners)
        if shares.min() > 0.03 and _asymmetric(surface):
            return parts


def _random_parts(family: str, rng: np.random.Generator) -> list[_Part]:
    """Two to six parts: a body, then smaller ones, each centred on the surface of one before, so all hang together."""
    parts: list[_Part] = []
    for number in range(rng.integers(2, 7)):
        solid = str(rng.choice(_FAMILIES[family]))
        half_axes = rng.uniform(0.2, 1.0, size=3) * (1.0 if number == 0 else rng.uniform(0.4, 0.9))
        centre = np.zeros(3)
        if parts:
            base = parts[rng.integers(len(parts))]
            centre = base.linear @ sample_surface(_template(base.solid), 1, rng)[0] + base.centre
        # Man-made things are mostly square to each other; some parts lean.
        turn = np.eye(3)[rng.permutation(3)] if rng.random() < 0.6 else _random_rotation(rng)
        parts.append(_Part(solid, turn * half_axes, centre))
    return parts


def _asymmetric(points: np.ndarray) -> bool:
    """Whether no rotation maps a cloud onto itself, as far as its own sampling noise can tell.

    With distinct principal moments only half turns about the principal axes could. So one half of the cloud is turned
    each way and must then lie clearly farther from the other half than it did before.
    """
    from scipy.spatial import KDTree

    points = points - points.mean(axis=0)
    moments, axes = np.linalg.eigh(np.cov(points.T))
    one, other = np.array_split(points @ axes, 2)
    tree = KDTree(one)
    noise = tree.query(other)[0].mean()
    turned = min(tree.query(other * signs)[0].mean() for signs in [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    return bool((moments[1:] > 1.1 * moments[:-1]).all() and turned > 1.4 * noise)


def _visible(parts: list[_Part], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Those of `count` points drawn area-uniformly on all parts that no other part covers; and whose they are."""
    triangles = [part.triangles() for part in parts]
    areas = np.array([np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum() for t in triangles])
    owners = rng.choice(len(parts), size=count, p=areas / areas.sum())
    points = np.empty((count, 3))
    for i, part in enumerate(triangles):
        points[owners == i] = sample_surface(part, int(np.sum(owners == i)), rng)
    covered = np.zeros(count, bool)
    for i, part in enumerate(parts):
        covered |= part.contains(points) & (owners != i)
    return owners[~covered], points[~covered]


def _outer_surface(parts: list[_Part], count: int, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) drawn area-uniformly on the union's surface, in random order."""
    found = np.empty((0, 3))
    while len(found) < count:
        found = np.concatenate([found, _visible(parts, 2 * count, rng)[1]])
    return found[:count]


def _occupancy(
    parts: list[_Part], centre: np.ndarray, scale: float, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Queries (count, 3) in the cloud's unit sphere, and whether each is inside the union."""
    placed = [_Part(part.solid, part.linear / scale, (part.centre - centre) / scale) for part in parts]
    grid = voxel_centres(_RESOLUTIONS[-1])
    voxel = 2 * grid_half_width(_RESOLUTIONS[-1]) / _RESOLUTIONS[-1]
    occupied = np.zeros(grid.shape[:3], bool)
    for part in placed:
        # Only the voxels in the part's bounding box are asked: a tenfold saving.
        reach = np.abs(part.linear).sum(axis=1)
        low = np.floor((part.centre - reach - grid[0, 0, 0]) / voxel).astype(int).clip(0)
        high = np.ceil((part.centre + reach - grid[0, 0, 0]) / voxel).astype(int).clip(0) + 1
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        occupied[box] |= part.contains(grid[box])
    queries = draw_queries(occupied, count, rng, _RESOLUTIONS).astype(np.float32)
    return queries, np.any([part.contains(queries) for part in placed], axis=0)


def _random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation (3, 3), uniform: the orthogonal factor of a Gaussian matrix with its signs fixed."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.array([1, 1, np.linalg.det(q)])


@lru_cache
def _template(solid: str) -> np.ndarray:
    """Triangles (F, 3, 3) of a canonical solid, curved ones true to a few thousandths of their size."""
    from trimesh import Trimesh, creation

    meshes: dict[str, Callable[[], Trimesh]] = {
        "box": lambda: creation.box((2, 2, 2)),
        "wedge": lambda: Trimesh(
            [(-1, -1, -1), (1, -1, -1), (-1, -1, 1), (-1, 1, -1), (1, 1, -1), (-1, 1, 1)],
            [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (0, 2, 5), (0, 5, 3), (1, 4, 5), (1, 5, 2)],
        ),
        "ball": lambda: creation.icosphere(subdivisions=3),
        "cylinder": lambda: creation.cylinder(1, 2, sections=64),
        "cone": lambda: creation.cone(1, 2, sections=64),
        "capsule": lambda: creation.capsule(1, 0.5, count=[32, 32]),
        "torus": lambda: creation.torus(0.7, 0.3, major_sections=64, minor_sections=24),
    }
    mesh = meshes[solid]()
    mesh.vertices = mesh.vertices - mesh.bounds.mean(axis=0)  # trimesh puts some of them on their foot
    return np.array(mesh.triangles)
