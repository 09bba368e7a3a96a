"""The two peers that need no library: doing nothing, and principal axes. They say what a protocol is worth."""

import dataclasses

import numpy as np
from scipy.spatial import KDTree

from urrt_jax.peers.peer import Peer, matrix


@dataclasses.dataclass(frozen=True, kw_only=True)
class Identity(Peer):
    """Doing nothing."""

    @property
    def title(self) -> str:
        return "identity"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.eye(4)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrincipalAxes(Peer):
    """The principal axes of one cloud laid on those of the other: of the four rotations, the best by Chamfer distance.

    Exact, up to exact symmetries, wherever both clouds hold the same points.
    """

    @property
    def title(self) -> str:
        return "principal axes"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        start, goal = source - source.mean(axis=0), target - target.mean(axis=0)
        axes_in, axes_out = (np.linalg.eigh(cloud.T @ cloud)[1] for cloud in (start, goal))
        tree_in, tree_out = KDTree(start), KDTree(goal)
        best, least = np.eye(3), np.inf
        for signs in ((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)):
            rotation = axes_out @ np.diag(signs) @ axes_in.T
            rotation *= np.sign(np.linalg.det(rotation))
            forth, back = tree_out.query(start @ rotation.T)[0], tree_in.query(goal @ rotation)[0]
            distance = np.mean(forth**2) + np.mean(back**2)
            if distance < least:
                best, least = rotation, distance
        return matrix(best, target.mean(axis=0) - best @ source.mean(axis=0))
