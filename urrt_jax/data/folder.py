"""Shapes from files of one shape each: the ModelNet tree, or any folder of meshes and clouds."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from urrt_jax.data.shapes import Shapes, unit_sphere
from urrt_jax.data.solid import sample_occupancy
from urrt_jax.io import CLOUD_FORMATS, MESH_FORMATS, read_geometry, sample_surface


def modelnet_files(folder: Path, split: str) -> list[tuple[Path, str]]:
    """(file, class) of every `<class>/<split>/*.off` in a folder, sorted; empty where it is no such tree."""
    return [(file, file.parent.parent.name) for file in sorted(folder.glob(f"*/{split}/*.off"))]


def shape_files(folder: Path, split: str) -> list[tuple[Path, str]]:
    """(file, class) of every mesh or cloud below a folder, sorted; the class is the name of the file's own folder.

    A folder `<split>` right inside limits the search to it; without one, every split is the whole folder.
    """
    if (folder / split).is_dir():
        folder = folder / split
    known = MESH_FORMATS + CLOUD_FORMATS
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in known and file.is_file())
    return [(file, file.absolute().parent.name) for file in files]


def shapes_from_files(
    files: list[tuple[Path, str]],
    classes: Iterable[str],
    *,
    folder: Path,
    points: int,
    seed: int,
    limit: int | None,
    progress: bool,
    queries: int,
) -> Shapes:
    """The shapes of up to `limit` readable files; the others are skipped and named in the result.

    A mesh is sampled area-uniformly; of a larger cloud a random subset is taken; a smaller cloud is skipped. What is
    drawn depends on `seed` and the file's name below `folder` alone, not on which other files there are.
    With `queries`, inside and outside are asked of every mesh; if one has none, `queries` of the result is None and a
    warning says for which file and why. Raises `ValueError` where no file can be used.
    """
    classes = tuple(classes)
    clouds, labels, names, asked, inside = [], [], [], [], []
    skipped: list[tuple[str, str]] = []
    unclosed: list[tuple[str, str]] = []
    for file, label in _with_progress(files, progress):
        if limit is not None and len(clouds) == limit:
            break
        name = file.relative_to(folder).as_posix()
        # A checksum of the name, since Python's own hash changes from run to run.
        key = zlib.crc32(name.encode())
        try:
            geometry = read_geometry(file)
            rng = np.random.default_rng([seed, key])
            if isinstance(geometry, np.ndarray):
                if len(geometry) < points:
                    raise ValueError(f"{file}: {points} points were asked for, but it holds {len(geometry)}")
                cloud = rng.permutation(geometry.astype(np.float64))[:points]
            else:
                cloud = sample_surface(geometry.triangles, points, rng)
            cloud, centre, scale = unit_sphere(cloud)
        except (ValueError, OSError, ImportError) as error:
            skipped.append((name, str(error)))
            continue
        clouds.append(cloud.astype(np.float32))
        labels.append(classes.index(label))
        names.append(name)
        if queries and not unclosed:
            try:
                if isinstance(geometry, np.ndarray):
                    raise ValueError("a cloud without faces has no inside")
                where, states = sample_occupancy(geometry, queries, seed=zlib.crc32(b"%d" % seed, key))
                asked.append(((where - centre) / scale).astype(np.float32))
                inside.append(states)
            except ValueError as error:
                unclosed.append((name, str(error)))

    if not clouds:
        first = f"; the first of {len(skipped)}, {skipped[0][0]}: {skipped[0][1]}" if skipped else ""
        raise ValueError(f"{folder}: none of its files could be used{first}")
    if unclosed:
        warnings.warn(f"inside and outside are left out, {unclosed[0][0]}: {unclosed[0][1]}", stacklevel=3)
    return Shapes(
        points=np.stack(clouds),
        labels=np.array(labels, np.int32),
        names=tuple(names),
        classes=classes,
        queries=np.stack(asked) if queries and not unclosed else None,
        inside=np.stack(inside) if queries and not unclosed else None,
        skipped=tuple(skipped),
    )


def _with_progress(files: list[tuple[Path, str]], progress: bool) -> Iterable[tuple[Path, str]]:
    """The files, behind a progress bar if one is wanted."""
    if not progress:
        return files
    from tqdm import tqdm

    return tqdm(files, desc="reading shapes", unit="file")
