"""Reading a rigid transform from a file."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from urrt_jax.io.arrays import read_npy
from urrt_jax.io.files import BadFile, opened

_MAX_BYTES = 2**20  # what `urrt register --json` prints is a few kilobytes
_EXPECTED = "holds no matrix of 4 rows and 4 columns"


def read_transform(path: str | os.PathLike[str]) -> np.ndarray:
    """The matrix (4, 4), float64, in a file: four rows of text (`#` starts a comment), a `.npy`, or a `.json`.

    A `.json` holds the rows, or an object with a `matrix`, as `urrt register --json` prints it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it holds no (4, 4) matrix of finite numbers, or is not a regular file, or larger than 1 MiB.
    """
    path = Path(path)
    with opened(path, most=_MAX_BYTES) as file:
        extension = path.suffix.lower()
        if extension == ".npy":
            matrix = read_npy(file).astype(np.float64)
        elif extension == ".json":
            matrix = _from_json(file.read())
        else:
            try:
                matrix = np.loadtxt(file, ndmin=2, encoding="utf-8-sig")
            except ValueError as error:
                raise BadFile(f"{_EXPECTED}: its rows must be numbers, equally many in each") from error
        if matrix.shape != (4, 4):
            raise BadFile(f"expected a matrix of shape (4, 4), got {matrix.shape}")
        if not np.isfinite(matrix).all():  # `null` in a .json becomes NaN
            raise BadFile(f"expected a matrix of finite numbers, got {matrix.tolist()}")
    return matrix


def _from_json(text: bytes) -> np.ndarray:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadFile(f"{_EXPECTED}: it is not valid JSON") from error
    if isinstance(content, dict):
        if "matrix" not in content:
            raise BadFile(f"{_EXPECTED}: its JSON object has no 'matrix'")
        content = content["matrix"]
    try:
        return np.asarray(content, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise BadFile(f"{_EXPECTED}: its rows must be numbers, equally many in each") from error
