"""Peers that match local features first: FGR and RANSAC of Open3D, and KISS-Matcher."""

import dataclasses
import functools
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib.metadata import version
from typing import Any

import numpy as np

from urrt_jax.peers.iterative import Open3DPeer, open3d_cloud
from urrt_jax.peers.peer import Peer, matrix, require


@dataclasses.dataclass(frozen=True, kw_only=True)
class _OnFeatures(Open3DPeer):
    """FPFH features (Rusu et al. 2009) of Open3D; normals and features from the neighbours within two radii."""

    normal_radius: float = 0.15
    feature_radius: float = 0.3
    normal_neighbors: int = 30
    feature_neighbors: int = 100

    def _cloud_and_features(self, points: np.ndarray) -> tuple[Any, Any]:
        open3d = require("open3d")
        cloud = open3d_cloud(points, self.normal_radius, self.normal_neighbors)
        search = open3d.geometry.KDTreeSearchParamHybrid(radius=self.feature_radius, max_nn=self.feature_neighbors)
        return cloud, open3d.pipelines.registration.compute_fpfh_feature(cloud, search)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FGR(_OnFeatures):
    """Fast Global Registration (Zhou et al. 2016) on FPFH, Open3D's.

    Attributes:
      reach: the largest distance of a correspondence at the end.
    """

    reach: float = 0.025

    @property
    def title(self) -> str:
        return "FGR (Open3D)"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        open3d = require("open3d")
        method = open3d.pipelines.registration
        open3d.utility.random.seed(0)
        (moved, moved_features), (goal, goal_features) = map(self._cloud_and_features, (source, target))
        option = method.FastGlobalRegistrationOption(maximum_correspondence_distance=self.reach)
        found = method.registration_fgr_based_on_feature_matching(moved, goal, moved_features, goal_features, option)
        return np.asarray(found.transformation)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RANSAC(_OnFeatures):
    """RANSAC over mutual FPFH matches (Fischler and Bolles 1981), Open3D's; seeded, but its threads may race.

    Attributes:
      reach: the largest distance of an inlier.
      edge_similarity: least ratio of the edges of a sample.
      iterations: at most so many samples.
      confidence: at which sampling stops.
    """

    normal_radius: float = 0.25
    feature_radius: float = 0.5
    reach: float = 0.05
    edge_similarity: float = 0.9
    iterations: int = 100_000
    confidence: float = 0.999

    @property
    def title(self) -> str:
        return "RANSAC (Open3D)"

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        open3d = require("open3d")
        method = open3d.pipelines.registration
        open3d.utility.random.seed(0)
        (moved, moved_features), (goal, goal_features) = map(self._cloud_and_features, (source, target))
        checks = [
            method.CorrespondenceCheckerBasedOnEdgeLength(self.edge_similarity),
            method.CorrespondenceCheckerBasedOnDistance(self.reach),
        ]
        found = method.registration_ransac_based_on_feature_matching(
            moved, goal, moved_features, goal_features, True, self.reach,
            method.TransformationEstimationPointToPoint(), 3, checks,
            method.RANSACConvergenceCriteria(self.iterations, self.confidence),
        )  # fmt: skip
        if found.fitness == 0:
            raise RuntimeError("no sample had an inlier")
        return np.asarray(found.transformation)


@dataclasses.dataclass(frozen=True, kw_only=True)
class KISSMatcher(Peer):
    """KISS-Matcher (Lim et al. 2025): Faster-PFH, ROBIN's pruning and a graduated non-convex solver.

    Attributes:
      voxel: the resolution that all of its radii follow from.
    """

    voxel: float = 0.02

    @property
    def title(self) -> str:
        return "KISS-Matcher"

    def versions(self) -> dict[str, str]:
        require("kiss_matcher")
        return {"kiss_matcher": version("kiss_matcher")}

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        require("kiss_matcher")
        try:
            return _worker().submit(_kiss_pose, self.voxel, source, target).result()
        except BrokenProcessPool as error:
            _worker.cache_clear()
            raise RuntimeError("the library crashed") from error


@functools.cache
def _worker() -> ProcessPoolExecutor:
    """A process of its own: on sparse clouds the library may end its process, which must not be ours."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def _kiss_pose(voxel: float, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    kiss = require("kiss_matcher")
    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(voxel))
    found = matcher.estimate(np.asarray(source, np.float32), np.asarray(target, np.float32))
    if matcher.get_num_final_inliers() < 3:  # it would say identity
        raise RuntimeError("fewer than three matches are left")
    return matrix(np.asarray(found.rotation), np.asarray(found.translation).reshape(3))
