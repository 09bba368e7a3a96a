"""The one way to data: a source's name in, shapes out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from urrt_jax.data.arrays import is_shapes_npz, shapes_from_hdf5, shapes_from_npz
from urrt_jax.data.folder import modelnet_files, shape_files, shapes_from_files
from urrt_jax.data.procedural import procedural_shapes
from urrt_jax.data.shapes import Shapes

_PROCEDURAL_COUNT = 256


def find_data(path: str | None = None) -> str:
    """The source to use: `path` if given, else the environment variable `URRT_DATA`, else 'procedural'."""
    return path or os.environ.get("URRT_DATA") or "procedural"


def load_shapes(
    source: str | os.PathLike[str],
    *,
    split: Literal["train", "test"] = "train",
    points: int = 1024,
    seed: int = 0,
    limit: int | None = None,
    progress: bool = False,
    queries: int = 0,
) -> Shapes:
    """The shapes of a source, each of `points` points centred and scaled to the unit sphere.

    The source is the first of these that it fits:

    - the word `'procedural'`: made-up solids, other ones for each split and seed; `limit` says how many (256);
    - a `.npz` file with `points`, `label`, `name`, `classes`, or with `points`, `name`, `category`, `split`;
    - a folder with `*{split}*.npz` files like that; names that begin with `modelnet` come first;
    - the folder of ModelNet40's HDF5 release (`ply_data_{split}0.h5`, ..., `shape_names.txt`), shards in order;
    - a ModelNet tree `<class>/<split>/*.off`;
    - any folder of meshes and clouds; a subfolder `<split>` limits the search to it, else both splits are the same.

    Args:
        source: see above; `find_data` gives a default.
        split: which half of the data. Hold validation shapes out of 'train' with `Shapes.split_validation`.
        points: points in each shape. Stored arrays give their first `points`; meshes and larger clouds are sampled.
        seed: of the sampling; what is drawn from a file depends on its name and the seed alone.
        limit: at most so many shapes, the first ones of the source.
        progress: show a progress bar while reading files.
        queries: if positive, also return as many points of known inside or outside for each shape, where the source is
            procedural or made of closed meshes; else `Shapes.queries` is None.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: nothing in it can be used (the message says what was looked for), stored clouds are smaller than
            `points`, or an argument is out of range. Single bad files are skipped: see `Shapes.skipped`.
        ImportError: the source needs an extra that is not installed.
    """
    if split not in ("train", "test"):
        raise ValueError(f"split must be 'train' or 'test', got {split!r}")
    if points < 1 or queries < 0 or seed < 0 or (limit is not None and limit < 1):
        raise ValueError(
            f"needs points > 0, queries >= 0, seed >= 0 and limit > 0, got {points}, {queries}, {seed} and {limit}"
        )
    if source == "procedural":
        # Twice the seed and one more: no seed's test shapes are another seed's training shapes.
        other = 2 * seed + (split == "test")
        return procedural_shapes(limit or _PROCEDURAL_COUNT, points=points, seed=other, queries=queries)

    folder = Path(source)
    if not folder.exists():
        raise FileNotFoundError(f"{folder}: no such file or folder (nor is it the word 'procedural')")
    if folder.is_file():
        if folder.suffix.lower() != ".npz":
            raise ValueError(f"{folder}: a source that is a file must be a .npz; for single clouds name their folder")
        return shapes_from_npz(folder, split=split, points=points, limit=limit)

    archives = [file for file in folder.glob(f"*{split}*.npz") if is_shapes_npz(file)]
    if archives:
        archive = min(archives, key=lambda file: (not file.name.startswith("modelnet"), file.name))
        return shapes_from_npz(archive, split=split, points=points, limit=limit)
    shards = list(folder.glob(f"*{split}*.h5"))
    if shards:
        return shapes_from_hdf5(shards, points=points, limit=limit)

    files = modelnet_files(folder, split)
    if files:
        # From both splits, so that they number the classes alike.
        classes = sorted({name for each in ("train", "test") for _, name in modelnet_files(folder, each)})
    else:
        files = shape_files(folder, split)
        classes = sorted({name for _, name in files})
    if not files:
        raise ValueError(
            f"{folder}: no shapes found. Looked for *{split}*.npz, *{split}*.h5, <class>/{split}/*.off, "
            "and any mesh or cloud (.npy .npz .obj .off .pcd .ply .stl .xyz) below it"
        )
    return shapes_from_files(
        files, classes, folder=folder, points=points, seed=seed, limit=limit, progress=progress, queries=queries
    )
