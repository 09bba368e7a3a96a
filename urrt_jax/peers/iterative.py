"""Peers that iterate from a start, or from many: ICP of Open3D, point to point and to plane, and GICP of small_gicp."""

import dataclasses
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from urrt_jax.peers.peer import Peer, centroid_start, matrix, require


def open3d_cloud(points: np.ndarray, normal_radius: float | None = None, neighbors: int = 30) -> Any:
    """Open3D's cloud of points (N, 3), with normals from the neighbours within a radius where one is given."""
    open3d = require("open3d")
    cloud = open3d.geometry.PointCloud()
    cloud.points = open3d.utility.Vector3dVector(np.asarray(points, np.float64))
    if normal_radius is not None:
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=normal_radius, max_nn=neighbors))
    return cloud


def open3d_icp(
    source: Any, target: Any, reach: float, start: np.ndarray, iterations: int, *, plane: bool
) -> np.ndarray:
    """The matrix (4, 4) of Open3D's ICP, which stops early where neither fitness nor rmse change by 1e-6."""
    method = require("open3d").pipelines.registration
    estimation = (
        method.TransformationEstimationPointToPlane() if plane else method.TransformationEstimationPointToPoint()
    )
    criteria = method.ICPConvergenceCriteria(max_iteration=iterations)
    return np.asarray(method.registration_icp(source, target, reach, start, estimation, criteria).transformation)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Open3DPeer(Peer):
    """A peer that needs Open3D."""

    def versions(self) -> dict[str, str]:
        return {"open3d": require("open3d").__version__}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Open3DICP(Open3DPeer):
    """Point-to-point ICP (Besl and McKay 1992), Open3D's.

    Attributes:
      start: from the given positions, or from the centroids laid on each other.
      reach: the largest distance of a correspondence.
      iterations: at most so many.
    """

    start: Literal["identity", "centroids"] = "centroids"
    reach: float = 0.5
    iterations: int = 200

    @property
    def title(self) -> str:
        return f"ICP from the {self.start} (Open3D)"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        start = np.eye(4) if self.start == "identity" else centroid_start(source, target)
        clouds = open3d_cloud(source), open3d_cloud(target)
        return open3d_icp(*clouds, self.reach, start, self.iterations, plane=False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MultiStartICP(Open3DPeer):
    """Point-to-point ICP, Open3D's, from many rotations about the centroids laid on each other; the best is refined.

    Among the answers the best is the one with the highest score: the mean of max(0, 1 - d²/r²) over the points of both
    clouds, each cloud counting half, with d the distance to the nearest point of the other cloud. All is deterministic.

    Attributes:
      starts: how many rotations: the identity, then some drawn with a fixed seed, uniformly among those that turn by at
        most ``max_angle``.
      max_angle: in degrees, at most 180.
      reach: the largest distance of a correspondence.
      iterations: at most so many from each start.
      score_distance: r of the score.
      polish_reach: the largest distance of a correspondence in the ICP that the best goes through at the end.
      polish_iterations: at most so many then.
    """

    starts: int = 32
    max_angle: float = 90.0
    reach: float = 0.5
    iterations: int = 50
    score_distance: float = 0.1
    polish_reach: float = 0.1
    polish_iterations: int = 50

    @property
    def title(self) -> str:
        return f"ICP from {self.starts} rotations (Open3D)"

    def rotations(self) -> np.ndarray:
        """The rotations that it starts from (starts, 3, 3), the identity first."""
        random = np.random.default_rng(0)
        axes = random.normal(size=(self.starts - 1, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        # Uniform over rotations, an angle a has the density 1 - cos a, which a - sin a integrates.
        angles = np.linspace(0, np.deg2rad(self.max_angle), 2001)
        shares = angles - np.sin(angles)
        drawn = np.interp(random.uniform(0, shares[-1], self.starts - 1), shares, angles)
        return np.concatenate([np.eye(3)[None], Rotation.from_rotvec(drawn[:, None] * axes).as_matrix()])

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        clouds = open3d_cloud(source), open3d_cloud(target)
        trees = KDTree(source), KDTree(target)
        middle, goal = source.mean(axis=0), target.mean(axis=0)
        best, highest = np.eye(4), -np.inf
        for rotation in self.rotations():
            start = matrix(rotation, goal - rotation @ middle)
            found = open3d_icp(*clouds, self.reach, start, self.iterations, plane=False)
            score = self._score(found, source, target, *trees)
            if score > highest:
                best, highest = found, score
        return open3d_icp(*clouds, self.polish_reach, best, self.polish_iterations, plane=False)

    def _score(
        self, pose: np.ndarray, source: np.ndarray, target: np.ndarray, source_tree: KDTree, target_tree: KDTree
    ) -> float:
        rotation, translation = pose[:3, :3], pose[:3, 3]
        # A point without a neighbour within r is infinitely far, and scores 0.
        forth = target_tree.query(source @ rotation.T + translation, distance_upper_bound=self.score_distance)[0]
        back = source_tree.query((target - translation) @ rotation, distance_upper_bound=self.score_distance)[0]
        return sum(np.mean(np.maximum(0, 1 - (far / self.score_distance) ** 2)) for far in (forth, back)) / 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointToPlaneICP(Open3DPeer):
    """Point-to-plane ICP (Chen and Medioni 1991) from the centroids, Open3D's.

    Attributes:
      reach: the largest distance of a correspondence.
      iterations: at most so many.
      normal_radius: normals of the target come from the neighbours within it, at most 30.
    """

    reach: float = 0.2
    iterations: int = 200
    normal_radius: float = 0.15

    @property
    def title(self) -> str:
        return "point-to-plane ICP (Open3D)"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        clouds = open3d_cloud(source), open3d_cloud(target, self.normal_radius)
        return open3d_icp(*clouds, self.reach, centroid_start(source, target), self.iterations, plane=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GICP(Peer):
    """Generalised ICP (Segal et al. 2009) from the centroids, of small_gicp.

    Attributes:
      reach: the largest distance of a correspondence.
      iterations: at most so many.
      neighbors: points that a covariance is estimated from.
    """

    reach: float = 0.2
    iterations: int = 200
    neighbors: int = 20

    @property
    def title(self) -> str:
        return "GICP (small_gicp)"

    def versions(self) -> dict[str, str]:
        require("small_gicp")
        return {"small_gicp": version("small_gicp")}

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        gicp = require("small_gicp")
        clouds = []
        for points in (target, source):
            cloud = gicp.PointCloud(np.asarray(points, np.float64))
            tree = gicp.KdTree(cloud)
            gicp.estimate_covariances(cloud, tree, num_neighbors=self.neighbors)
            clouds.append((cloud, tree))
        (goal, tree), (moved, _) = clouds
        found = gicp.align(
            goal, moved, tree, init_T_target_source=centroid_start(source, target), registration_type="GICP",
            max_correspondence_distance=self.reach, max_iterations=self.iterations,
            rotation_epsilon=1e-5, translation_epsilon=1e-6,
        )  # fmt: skip
        return np.asarray(found.T_target_source)
