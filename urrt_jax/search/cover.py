"""Covers of SO(3) by the rotation groups of regular solids: no rotation is far from a member."""

import numpy as np
from scipy.spatial.transform import Rotation

COVERING_RADIUS = {1: 180.0, 24: 62.8, 60: 44.48}
"""The largest angle, in degrees, between any rotation and the nearest of so many members."""


def rotation_cover(count: int) -> np.ndarray:
    """Rotations (count, 3, 3) float32 that cover SO(3) evenly, the identity first.

    1: the identity; 24: the rotations of the cube; 60: those of the icosahedron. ``COVERING_RADIUS`` says how well.

    Raises:
      ValueError: another count.
    """
    if count not in COVERING_RADIUS:
        raise ValueError(f"count: expected one of {sorted(COVERING_RADIUS)}, got {count}")
    if count == 1:
        return np.eye(3, dtype=np.float32)[None]
    members = Rotation.create_group("O" if count == 24 else "I").as_matrix()
    order = np.argsort(-np.trace(members, axis1=1, axis2=2), kind="stable")
    return members[order].astype(np.float32)
