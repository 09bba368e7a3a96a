"""Solids that some rotations map onto themselves: data to test whether a registration is honest about symmetry.

Two clouds of such a solid determine their pose only up to these rotations. A registration of them should therefore
report low confidence, and its pose is right if it equals the true one after any rotation of `symmetry`.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np

from urrt_jax.data.shapes import Shapes
from urrt_jax.io import sample_surface

if TYPE_CHECKING:
    from trimesh import Trimesh  # imported where it is used: reading a cloud does not need it

_PRISMS = ("prism_3", "prism_4", "prism_5", "prism_6", "prism_8", "prism_12")
_ROUND = ("cylinder", "cone", "torus", "sphere")
_BLOCKS = ("cube", "box", "tetrahedron")
_KINDS = (*_PRISMS, *_ROUND, *_BLOCKS, "propeller_2", "propeller_3", "propeller_5", "gear_7", "gear_16")

_AXIS_TURNS = 72  # turns of 5 degrees stand for all turns about a full axis; the meshes have as many sections
_HUB_SECTIONS = 60  # a multiple of every number of blades, so that the hub has the propeller's symmetry


def symmetric_shapes(count: int = len(_KINDS), *, points: int = 1024, seed: int = 0) -> Shapes:
    """Solids that rotations map onto themselves, as clouds drawn area-uniformly on their surface.

    The i-th shape depends on `seed` and i alone, not on `count`; its form does not depend on `points`. Shapes take
    turns among the 18 kinds of solid, which are the classes: regular prisms ("prism_3", ..., named by their number of
    sides), "cylinder", "cone", "torus", "sphere", "cube", "box" (three different edges), "tetrahedron", propellers
    ("propeller_2", ..., by blades) and gears ("gear_7" and "gear_16", by teeth). `symmetry` gives their rotations.

    The proportions of a solid are random, within limits that give it no further symmetry by accident: no prism of four
    sides is nearly a cube. A prism of twelve sides remains close to a cylinder, though: 1000 points hardly tell it from
    itself turned by half a step. Cube, sphere and tetrahedron have only one form. Round solids are meshes, true to
    about a thousandth of their size.

    The axis of symmetry is z. The mean of the solid's surface is the origin, which is its centre of symmetry, and its
    farthest corner has distance 1. Both are taken from the solid, not from the sample: a cloud's own mean is therefore
    only near the origin, and its farthest point may lie a little inside the unit sphere. Where parts of a propeller
    overlap, at the hub, points are drawn on the covered surface as well.

    Example:
        >>> shapes = symmetric_shapes(3, points=100)
        >>> shapes.points.shape, shapes.names
        ((3, 100, 3), ('prism_3_0000', 'prism_4_0001', 'prism_5_0002'))
        >>> len(symmetry("prism_4"))
        8

    Args:
        count: how many shapes.
        points: points in each.
        seed: another seed gives other proportions and other points.

    Raises:
        ValueError: `count` or `points` is not positive, or `seed` is negative.
    """
    if count < 1 or points < 1 or seed < 0:
        raise ValueError(f"needs count > 0, points > 0 and seed >= 0, got {count}, {points} and {seed}")
    labels = np.arange(count, dtype=np.int32) % len(_KINDS)
    clouds = np.empty((count, points, 3), np.float32)
    for i, label in enumerate(labels):
        triangles = _triangles(_KINDS[label], np.random.default_rng([seed, i, 0]))
        clouds[i] = sample_surface(triangles, points, np.random.default_rng([seed, i, 1]))
    return Shapes(
        points=clouds,
        labels=labels,
        names=tuple(f"{_KINDS[label]}_{i:04d}" for i, label in enumerate(labels)),
        classes=_KINDS,
    )


def symmetry(kind: str) -> np.ndarray:
    """The rotations (S, 3, 3) about the origin that map a solid of this kind onto itself, the identity first.

    `points @ rotation.T` for points in the frame of `symmetric_shapes`. The rotations are a group. It is the
    solid's whole group, but for the kinds with infinitely many rotations: turns about z in steps of 5 degrees stand
    for those of cylinder, cone and torus (with half turns about axes across z for cylinder and torus), and the 24
    rotations of the cube for those of the sphere.

    Args:
        kind: a class of `symmetric_shapes`.

    Raises:
        ValueError: an unknown kind.
    """
    if kind not in _KINDS:
        raise ValueError(f"unknown kind {kind!r}; known are {', '.join(_KINDS)}")
    form, _, number = kind.partition("_")
    if form in ("cube", "sphere"):
        return _cube_rotations()
    if form == "tetrahedron":
        cube = _cube_rotations()
        # The tetrahedron's corners are those of the cube whose coordinates have product 1, so signs must have it too.
        return cube[cube.sum(axis=2).prod(axis=1) > 0]
    if form == "cone":
        return _dihedral(_AXIS_TURNS)[:_AXIS_TURNS]
    if form in ("cylinder", "torus"):
        return _dihedral(_AXIS_TURNS)
    return _dihedral(2 if form == "box" else int(number))


def _cube_rotations() -> np.ndarray:
    """The 24 rotations of the cube [-1, 1]^3: permutations of the axes with signs, of determinant 1."""
    signed = [
        np.eye(3)[list(order)] * signs for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array([matrix for matrix in signed if np.linalg.det(matrix) > 0])


def _dihedral(order: int) -> np.ndarray:
    """First `order` turns about z, then as many half turns about axes across z, the first of them about x."""
    angles = 2 * np.pi / order * np.arange(order)
    turns = np.tile(np.eye(3), (order, 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0], turns[:, 0, 1] = np.sin(angles), -np.sin(angles)
    return np.concatenate([turns, turns @ np.diag([1.0, -1.0, -1.0])])


def _triangles(kind: str, rng: np.random.Generator) -> np.ndarray:
    """The triangles (F, 3, 3) of a solid of this kind with random proportions, centred, its farthest corner at 1."""
    mesh = _mesh(kind, rng)
    triangles = np.array(mesh.triangles) - mesh.centroid  # the mean of the surface, which every symmetry keeps
    return triangles / np.linalg.norm(triangles, axis=2).max()


def _mesh(kind: str, rng: np.random.Generator) -> Trimesh:
    """A solid of this kind with random proportions, its axis along z, of any size and at any height."""
    from trimesh import Trimesh, creation

    # All limits of proportions here and below are guesses at what looks like a real thing and is clearly this kind.
    form, _, number = kind.partition("_")
    if form in ("prism", "cylinder"):
        # Flat or tall, as a height near the width would make four sides nearly a cube.
        height = 2 * (rng.uniform(0.25, 0.5) if rng.random() < 0.5 else rng.uniform(1.2, 2))
        return creation.cylinder(1, height, sections=int(number or _AXIS_TURNS))
    if form == "cone":
        return creation.cone(1, rng.uniform(1, 2.5), sections=_AXIS_TURNS)
    if form == "torus":
        return creation.torus(1, rng.uniform(0.2, 0.5), major_sections=_AXIS_TURNS, minor_sections=48)
    if form == "sphere":
        return creation.icosphere(subdivisions=4)
    if form == "cube":
        return creation.box((1, 1, 1))
    if form == "box":
        return creation.box(np.cumprod([1.0, *rng.uniform(1.4, 1.8, size=2)]))
    if form == "tetrahedron":  # every other corner of a cube
        return Trimesh([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], [(0, 1, 2), (0, 2, 3), (0, 3, 1), (1, 3, 2)])
    return _propeller(int(number), rng) if form == "propeller" else _gear(int(number), rng)


def _propeller(blades: int, rng: np.random.Generator) -> Trimesh:
    """Thin flat blades about a hub, the first along x. A half turn about a blade's long axis keeps the propeller."""
    from trimesh import creation
    from trimesh.transformations import rotation_matrix

    hub_radius, width, thickness = rng.uniform(0.12, 0.2), rng.uniform(0.2, 0.35), rng.uniform(0.02, 0.04)
    low, high = (hub_radius / 2, -width / 2, -thickness / 2), (1, width / 2, thickness / 2)
    tilt = rotation_matrix(np.radians(rng.uniform(20, 40)), (1, 0, 0))
    propeller = creation.cylinder(hub_radius, rng.uniform(0.15, 0.3), sections=_HUB_SECTIONS)
    for k in range(blades):
        blade = creation.box(bounds=(low, high))
        blade.apply_transform(rotation_matrix(2 * np.pi * k / blades, (0, 0, 1)) @ tilt)
        propeller += blade
    return propeller


def _gear(teeth: int, rng: np.random.Generator) -> Trimesh:
    """A flat wheel of outer radius 1 with straight-sided teeth, the first centred on x."""
    from trimesh import creation

    # Half the angle that a tooth takes at its root and at its tip, as a share of the angle from tooth to tooth.
    root, tip = rng.uniform(0.25, 0.32), rng.uniform(0.12, 0.2)
    angles = 2 * np.pi / teeth * (np.arange(teeth)[:, None] + [-root, -tip, tip, root]).ravel()
    root_radius = 1 - rng.uniform(0.15, 0.3)
    radii = np.tile([root_radius, 1, 1, root_radius], teeth)
    outline = radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    around = np.arange(len(outline))
    fan = np.column_stack([np.zeros_like(around), 1 + around, 1 + (around + 1) % len(around)])  # from the centre
    return creation.extrude_triangulation(np.vstack([np.zeros(2), outline]), fan, rng.uniform(0.2, 0.5))
