"""What every peer is, and how its library is found."""

import dataclasses
import importlib
import sys
from types import ModuleType
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Peer:
    """A registration method of another library: its settings are its fields, one pair at a time is its work."""

    @property
    def title(self) -> str:
        """How tables call it."""
        raise NotImplementedError

    @property
    def settings(self) -> dict[str, Any]:
        """The settings by name, for results files."""
        return dataclasses.asdict(self)

    def versions(self) -> dict[str, str]:
        """The versions of the libraries it needs.

        Raises:
          ImportError: one of them is not installed; the message says how to install it.
        """
        return {}

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """The matrix (4, 4) that carries the source (N, 3) onto the target (M, 3), both float64."""
        raise NotImplementedError


def require(module: str, install: str = "pip install 'urrt-jax[peers]'") -> ModuleType:
    """An optional library; an ImportError that says how to install it where it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        limit = ", which needs Python 3.12 or older" if module == "open3d" and sys.version_info >= (3, 13) else ""
        raise ImportError(f"{module} is not usable ({error}): {install}{limit}") from error


def matrix(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """The homogeneous matrix (4, 4)."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, translation
    return result


def centroid_start(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The matrix (4, 4) that lays one centroid on the other."""
    return matrix(np.eye(3), target.mean(axis=0) - source.mean(axis=0))
