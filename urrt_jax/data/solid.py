"""Inside and outside of closed meshes, and where to ask: the occupancy samples that teach the region decoder.

The grid of a resolution R is R x R x R cubic voxels over the cube [-h, h]^3 with h = R / (R - 3). So the unit sphere
never reaches the outermost layer, and everything outside the shape is connected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

_NEAR_SURFACE = 0.8  # share of the queries drawn near the surface; the rest keeps the far field from drifting
_CHUNK = 2_000_000  # surface points held at once while voxelising


def grid_half_width(resolution: int) -> float:
    """Half the edge of the cube that a grid covers: the unit sphere and a margin of one and a half voxels."""
    if resolution < 8:
        raise ValueError(f"resolution must be at least 8 voxels, got {resolution}")
    return resolution / (resolution - 3)


def voxel_centres(resolution: int) -> np.ndarray:
    """Centres of a grid's voxels, (R, R, R, 3) float64, indexed x, y, z."""
    half = grid_half_width(resolution)
    axis = (np.arange(resolution) + 0.5) * (2 * half / resolution) - half
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def voxelize_solid(mesh: trimesh.Trimesh, resolution: int = 64) -> np.ndarray:
    """Which voxels the solid inside a closed mesh fills: (R, R, R) bool, True inside and on the surface.

    The mesh is moved and scaled so that its bounding box is centred and it just fits the unit sphere. Its surface is
    voxelised, the outside is flood-filled from a corner, and inside is what the flood does not reach. Holes smaller
    than a voxel do no harm, nor do overlapping parts or wrongly turned faces, as they are common in ModelNet.

    Raises:
        ValueError: the flood leaves nothing but the surface, and the mesh is not watertight: it is not closed at this
            resolution. (A watertight plate thinner than a voxel is fine: it fills its surface voxels.) A mesh of
            several parts of which one is closed passes; the open parts then count as thin sheets.
    """
    from scipy import ndimage

    centre, radius = _bounding_sphere(mesh)
    surface = _voxelize_surface((mesh.triangles - centre) / radius, resolution)
    regions = np.empty(surface.shape, np.int32)
    ndimage.label(~surface, output=regions)  # face-connected; _voxelize_surface lets no such path through
    inside = regions != regions[0, 0, 0]
    if (inside == surface).all() and not _watertight(mesh):
        raise ValueError(f"mesh of {len(mesh.faces)} faces is not closed at a resolution of {resolution} voxels")
    return inside


def sample_occupancy(
    mesh: trimesh.Trimesh, count: int, *, seed: int, resolutions: Sequence[int] = (16, 32, 64)
) -> tuple[np.ndarray, np.ndarray]:
    """Points around a closed mesh and whether each lies inside it, dense near the surface.

    The progressive sampling of IM-NET (Chen and Zhang, "Learning Implicit Fields for Generative Shape Modeling", 2019):
    each resolution gives an equal share; at each, most points come from voxels near the surface (those whose 3 x 3 x 3
    neighbourhood holds both states), the rest from anywhere. Coarse voxels thus give a wide band around the surface
    and fine voxels a narrow one. Unlike there, a point lies anywhere in its voxel, not at its centre, and is always
    labelled by the finest grid.

    Args:
        mesh: a closed mesh, in any units.
        count: how many points.
        seed: the same seed gives the same points.
        resolutions: voxels along an edge; each divides the last and largest.

    Returns:
        queries: (count, 3) float32, in the mesh's own units and frame, in random order.
        inside: (count,) bool, exact to a voxel of the finest grid: the solid is thicker by half a voxel on average,
            because a voxel that the surface crosses counts as inside.

    Raises:
        ValueError: the mesh is not closed (see `voxelize_solid`), or a resolution does not divide the last.
    """
    occupied = voxelize_solid(mesh, resolutions[-1])
    queries = draw_queries(occupied, count, np.random.default_rng(seed), resolutions)
    half = grid_half_width(resolutions[-1])
    index = ((queries + half) * (resolutions[-1] / (2 * half))).astype(int).clip(0, resolutions[-1] - 1)
    centre, radius = _bounding_sphere(mesh)
    return (queries * radius + centre).astype(np.float32), occupied[tuple(index.T)]


def draw_queries(
    occupied: np.ndarray, count: int, rng: np.random.Generator, resolutions: Sequence[int] = (16, 32, 64)
) -> np.ndarray:
    """Where to ask for occupancy: (count, 3) float64 in the grid's cube, by the scheme of `sample_occupancy`.

    `occupied` is a grid (R, R, R) bool at the last of the `resolutions`, which must be a multiple of all others.
    """
    from scipy import ndimage

    finest = occupied.shape[0]
    if finest != resolutions[-1] or any(resolution < 1 or finest % resolution for resolution in resolutions):
        raise ValueError(f"resolutions must each divide the last, the grid's {finest}, got {tuple(resolutions)}")
    half = grid_half_width(finest)
    queries = []
    for share, resolution in enumerate(resolutions):
        size = (count + share) // len(resolutions)  # the sizes differ by at most one and add up to count
        blocks = occupied.reshape((resolution, finest // resolution) * 3)
        some = ndimage.maximum_filter(blocks.any(axis=(1, 3, 5)), size=3)
        every = ndimage.minimum_filter(blocks.all(axis=(1, 3, 5)), size=3)
        near = np.argwhere(some > every)
        voxel = rng.integers(resolution, size=(size, 3))
        if len(near):
            chosen = near[rng.integers(len(near), size=size)]
            voxel = np.where(rng.random((size, 1)) < _NEAR_SURFACE, chosen, voxel)
        queries.append((voxel + rng.random((size, 3))) * (2 * half / resolution) - half)
    return rng.permutation(np.concatenate(queries))


def _voxelize_surface(triangles: np.ndarray, resolution: int) -> np.ndarray:
    """Voxels that hold a point of a lattice laid on every triangle (F, 3, 3): (R, R, R) bool without gaps.

    Where the surface cuts the line between the centres of two neighbouring voxels, every surface point within half a
    voxel of the cut lies in one of the two. So a lattice with no hole wider than that lets no face-connected path
    through. Splitting a triangle's edges in n leaves no point further than (longest edge) / (n sqrt 3) from a node.
    """
    half = grid_half_width(resolution)
    voxel = 2 * half / resolution
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    splits = np.floor(edges * (2 / np.sqrt(3) * 1.01) / voxel).astype(int) + 1

    surface = np.zeros((resolution,) * 3, bool)
    for n in np.unique(splits):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
        i, j = i[i + j <= n], j[i + j <= n]
        weights = np.stack([i, j, n - i - j], axis=1) / n
        same = triangles[splits == n]
        for start in range(0, len(same), step := max(1, _CHUNK // len(weights))):
            lattice = np.einsum("kc,fcd->fkd", weights, same[start : start + step]).reshape(-1, 3)
            index = ((lattice + half) / voxel).astype(int)
            surface[tuple(index.T)] = True
    return surface


def _bounding_sphere(mesh: trimesh.Trimesh) -> tuple[np.ndarray, float]:
    """Centre of the bounding box of the faces, and the radius around it that holds them all."""
    corners = mesh.triangles.reshape(-1, 3)  # not mesh.vertices: some belong to no face
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.linalg.norm(corners - centre, axis=1).max())
    if not radius > 0:
        raise ValueError(f"mesh of {len(mesh.faces)} faces has no extent")
    return centre, radius


def _watertight(mesh: trimesh.Trimesh) -> bool:
    """Whether every edge has two faces once equal vertices are merged (STL stores each one several times)."""
    import trimesh

    return bool(trimesh.Trimesh(mesh.vertices, mesh.faces, process=True).is_watertight)
