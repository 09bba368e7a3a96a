"""Peers with ICP after them: on shapes, and on real scans of any unit and tens of thousands of points."""

import dataclasses

import numpy as np

from urrt_jax.peers.iterative import Open3DPeer, open3d_cloud, open3d_icp
from urrt_jax.peers.peer import Peer


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Then(Open3DPeer):
    """Another peer, and Open3D's ICP after it."""

    peer: Peer

    def versions(self) -> dict[str, str]:
        return self.peer.versions() | super().versions()


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThenICP(_Then):
    """A peer whose answer Open3D's point-to-point ICP starts from.

    Attributes:
      peer: with its own settings.
      reach: the largest distance of a correspondence.
      iterations: at most so many.
    """

    reach: float = 0.1
    iterations: int = 50

    @property
    def title(self) -> str:
        return self.peer.title.replace(" (", " + ICP (") if "(" in self.peer.title else f"{self.peer.title} + ICP"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        start = self.peer.align_pair(source, target)
        clouds = open3d_cloud(source), open3d_cloud(target)
        return open3d_icp(*clouds, self.reach, start, self.iterations, plane=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnScans(_Then):
    """A peer on scans: brought to the unit sphere's size, thinned to voxels, then two rounds of point-to-plane ICP.

    Attributes:
      peer: with its own settings, which then hold for scans of any unit.
      voxel: its edge, as a share of the diagonal of the larger cloud's bounding box.
      polish: reaches of the rounds of ICP, in voxels.
    """

    voxel: float = 0.03
    polish: tuple[float, ...] = (1.0, 0.4)

    @property
    def title(self) -> str:
        return f"{self.peer.title}, then point-to-plane ICP"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        # A bounding box of diagonal 2 has about the size of the unit sphere that the peers' lengths refer to.
        scale = 2 / max(np.linalg.norm(np.ptp(cloud, axis=0)) for cloud in (source, target))
        edge = 2 * self.voxel
        small = [open3d_cloud(cloud * scale).voxel_down_sample(edge) for cloud in (source, target)]
        result = self.peer.align_pair(*(np.asarray(cloud.points) for cloud in small))
        finer = [open3d_cloud(cloud * scale).voxel_down_sample(edge / 4) for cloud in (source, target)]
        moved, goal = (open3d_cloud(np.asarray(cloud.points), edge) for cloud in finer)
        for reach in self.polish:
            result = open3d_icp(moved, goal, reach * edge, result, 50, plane=True)
        result = result.copy()
        result[:3, 3] /= scale
        return result
