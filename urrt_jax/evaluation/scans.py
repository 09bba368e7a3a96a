"""Real scans with measured poses: the pairs of them that overlap, as trials of the protocol ``"scans"``."""

import hashlib
import itertools
import os
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from urrt_jax.atomic import write_atomically
from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.evaluation.protocols import Trial

LEAST_OVERLAP = 0.4


def load_scan_pairs(
    path: str | Path, *, reach: float = 3e-3, least_overlap: float = LEAST_OVERLAP, below_overlap: float = np.inf
) -> tuple[list[Trial], list[dict]]:
    """All ordered pairs of scans that overlap enough, and what each is: names, overlap and true rotation in degrees.

    The overlap of a pair is the share of source points within ``reach`` of the target, in the true pose; it is computed
    once for a file and kept in the user's cache folder. A trial's scale is the diagonal of the larger bounding box.

    Args:
      path: a ``.npz`` with ``names`` (S,), ``pose_to_world`` (S, 4, 4), world = R p + t, and ``pts_<name>`` (N, 3).
      reach: in the scans' unit (the default is 3 mm for metres).
      least_overlap: pairs that overlap by less are left out.
      below_overlap: pairs that overlap by this or more are left out.

    Raises:
      ValueError: the file is missing or holds something else, or no pair overlaps enough.
    """
    try:
        content = Path(path).read_bytes()
        with np.load(BytesIO(content), allow_pickle=False) as archive:
            names = [str(name) for name in archive["names"]]
            poses = np.asarray(archive["pose_to_world"], np.float64)
            clouds = [np.asarray(archive[f"pts_{name}"], np.float64) for name in names]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # NumPy, zipfile and zlib raise many kinds for damaged archives
        raise ValueError(
            f"{path}: needs names, pose_to_world and pts_<name> of every scan ({type(error).__name__}: {error})"
        ) from error
    if poses.shape != (len(names), 4, 4):
        raise ValueError(f"{path}: expected pose_to_world of shape ({len(names)}, 4, 4), got {poses.shape}")

    overlaps = _cached_overlaps(hashlib.sha256(content + str(reach).encode()).hexdigest()[:16], clouds, poses, reach)
    trials, about = [], []
    for i, j in itertools.permutations(range(len(names)), 2):
        if not least_overlap <= overlaps[i, j] < below_overlap:
            continue
        truth = np.linalg.inv(poses[j]) @ poses[i]
        scale = max(float(np.linalg.norm(np.ptp(cloud, axis=0))) for cloud in (clouds[i], clouds[j]))
        trials.append(
            Trial(clouds[i].astype(np.float32), clouds[j].astype(np.float32), truth[:3, :3], truth[:3, 3], None, scale)
        )
        about.append(
            {
                "source": names[i],
                "target": names[j],
                "overlap": float(overlaps[i, j]),
                "true_rotation_deg": float(rotation_degrees(truth[:3, :3], np.eye(3))),
            }
        )
    if not trials:
        asked = f"{least_overlap} or more" + (f" but less than {below_overlap}" if below_overlap < np.inf else "")
        raise ValueError(f"{path}: no pair of the {len(names)} scans overlaps by {asked}")
    return trials, about


def _cached_overlaps(digest: str, clouds: list[np.ndarray], poses: np.ndarray, reach: float) -> np.ndarray:
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "urrt_jax"
    kept = folder / f"overlaps_{digest}.npy"
    try:
        cached = np.load(kept, allow_pickle=False)
        if cached.shape == (len(clouds), len(clouds)) and cached.dtype == np.float64:
            return cached
    except (OSError, ValueError, EOFError):
        pass
    overlaps = _overlaps(clouds, poses, reach)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        content = BytesIO()
        np.save(content, overlaps)
        write_atomically(kept, content.getvalue())
    except OSError:  # a cache that can't be written only costs time
        pass
    return overlaps


def _overlaps(clouds: list[np.ndarray], poses: np.ndarray, reach: float) -> np.ndarray:
    """(S, S): row i, column j is the share of cloud i within ``reach`` of cloud j."""
    world = [cloud @ pose[:3, :3].T + pose[:3, 3] for cloud, pose in zip(clouds, poses, strict=True)]
    trees = [KDTree(cloud) for cloud in world]
    result = np.eye(len(clouds))
    for i, j in itertools.permutations(range(len(clouds)), 2):
        distances = trees[j].query(world[i], distance_upper_bound=reach, workers=-1)[0]
        result[i, j] = np.mean(np.isfinite(distances))
    return result
