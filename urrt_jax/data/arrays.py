"""Shapes from arrays that hold a whole split: `.npz` files and the HDF5 release of ModelNet40."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from urrt_jax.data.shapes import Shapes, unit_sphere

_NPZ_KEYS = "points with label and classes, or points with category (and split)"


def shapes_from_npz(path: Path, *, split: str, points: int, limit: int | None) -> Shapes:
    """The shapes of a `.npz` file, the stored float16 or float32 as float32, in the file's order.

    Its keys are `points` (S, P, 3) and `label` (S,) with `classes`, or `category` (S,); optional are `name` (S,) and
    `split` (S,), by which the rows are then filtered. Raises `ValueError` where keys, shapes or the split are missing.
    """
    try:
        archive = np.load(path, allow_pickle=False)
        held = {key: archive[key] for key in archive.files if key != "normals"}
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"{path}: cannot be read as NPZ: {error}") from error
    if not is_shapes_npz(path):
        raise ValueError(f"{path}: needs the keys {_NPZ_KEYS}; it holds {', '.join(held) or 'nothing'}")

    if {"label", "classes"} <= held.keys():
        classes, labels = held["classes"], held["label"]
    else:
        # Before the filter, so that both splits number the classes alike.
        classes, labels = np.unique(held["category"], return_inverse=True)
    names = held.get("name", np.array([f"{path.stem}_{i}" for i in range(len(labels))]))
    if not len(held["points"]) == len(labels) == len(names):
        raise ValueError(f"{path}: {len(held['points'])} clouds, {len(labels)} labels and {len(names)} names differ")
    rows = np.arange(len(labels))
    if "split" in held:
        rows = np.flatnonzero(held["split"] == split)
        if not len(rows):
            raise ValueError(f"{path}: holds no split {split!r}, only {', '.join(np.unique(held['split']))}")
    rows = rows[:limit]
    return _shapes(path, held["points"][rows], labels[rows], names[rows], classes, points)


def is_shapes_npz(path: Path) -> bool:
    """Whether a `.npz` file holds a set of shapes, by its keys alone."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            keys = set(archive.files)
    except Exception:  # as above; whoever reads the file will say what is wrong
        return False
    return keys >= {"points", "label", "classes"} or keys >= {"points", "category"}


def shapes_from_hdf5(shards: list[Path], *, points: int, limit: int | None) -> Shapes:
    """The shapes of HDF5 shards, in the order of their numbers, as the usual protocols count them.

    Each holds the datasets `data` (S, P, 3) and `label` (S, 1); the classes are the lines of `shape_names.txt` beside
    them, where there is one. A shard that cannot be read is a `ValueError`, since leaving it out would make another
    test set. Raises `ImportError` where h5py (extra `urrt-jax[data]`) is not installed.
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError("the HDF5 release needs h5py: pip install 'urrt-jax[data]'") from error

    clouds, labels, names = [], [], []
    for shard in sorted(shards, key=_numbered):
        try:
            with h5py.File(shard, "r") as file:
                clouds.append(np.asarray(file["data"]))
                labels.append(np.asarray(file["label"]).reshape(-1))
        except Exception as error:  # as above
            raise ValueError(f"{shard}: cannot be read as a shard with 'data' and 'label': {error}") from error
        names += [f"{shard.stem}_{row:04d}" for row in range(len(labels[-1]))]
    folder = shards[0].parent
    shapes = {cloud.shape[1:] for cloud in clouds}
    if len(shapes) > 1 or sum(map(len, clouds)) != len(names):
        raise ValueError(f"{folder}: shards disagree, data are {[c.shape for c in clouds]} for {len(names)} labels")
    label = np.concatenate(labels)[:limit].astype(int)
    listed = folder / "shape_names.txt"
    classes = listed.read_text().split() if listed.is_file() else [f"class_{i}" for i in range(label.max() + 1)]
    return _shapes(folder, np.concatenate(clouds)[:limit], label, np.array(names[:limit]), np.array(classes), points)


def _numbered(path: Path) -> tuple[str | int, ...]:
    """A sort key that puts shard 2 before shard 10, and never trusts the file system's order."""
    return tuple(int(word) if i % 2 else word for i, word in enumerate(re.split(r"(\d+)", path.name)))


def _shapes(
    source: Path, stored: np.ndarray, labels: np.ndarray, names: np.ndarray, classes: np.ndarray, points: int
) -> Shapes:
    """Shapes of the first `points` points of stored clouds (S, P, 3)."""
    if stored.ndim != 3 or stored.shape[2] != 3 or not np.issubdtype(stored.dtype, np.floating):
        raise ValueError(f"{source}: points must be floats of shape (S, P, 3), got {stored.dtype} {stored.shape}")
    if stored.shape[1] < points:
        raise ValueError(f"{source}: {points} points a shape were asked for, but it stores {stored.shape[1]}")
    clouds = stored.astype(np.float32)
    if not np.isfinite(clouds).all():
        raise ValueError(f"{source}: {int(np.sum(~np.isfinite(clouds)))} stored coordinates are not finite")
    # Clouds that are centred and scaled already keep their exact coordinates, as published numbers were measured on
    # them; "already" allows for half precision.
    mean = np.abs(clouds.mean(axis=1)).max(axis=1)
    reach = np.linalg.norm(clouds, axis=2).max(axis=1)
    for i in np.flatnonzero((mean > 1e-3) | (np.abs(reach - 1) > 1e-2)):
        clouds[i] = unit_sphere(clouds[i])[0]
    return Shapes(
        points=np.ascontiguousarray(clouds[:, :points]),
        labels=labels.astype(np.int32),
        names=tuple(map(str, names)),
        classes=tuple(map(str, classes)),
    )
