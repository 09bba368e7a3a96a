"""Go-ICP, through ``py-goicp``: branch and bound over SO(3) × R³ (Yang et al. 2016)."""

import contextlib
import dataclasses
import os
import sys
from collections.abc import Iterator
from importlib.metadata import version

import numpy as np

from urrt_jax.peers.peer import Peer, matrix, require

_INSTALL = (
    "it needs a compiler and old tools: pip install 'setuptools<70' 'cython<3' 'autowrap==0.22.10' wheel && "
    "pip install --no-build-isolation py-goicp"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GoICP(Peer):
    """Go-ICP: the global optimum of the point-to-point error, up to a threshold.

    Both clouds are centred and scaled into the unit sphere; translations are searched within ±0.25 of the centroids.

    Attributes:
      points: of the source, drawn at random with a fixed seed.
      grid: cells along an edge of the distance transform of the target.
      threshold: of the mean squared error, in the unit sphere; the search stops within it.
    """

    points: int = 200
    grid: int = 50
    threshold: float = 5e-4

    @property
    def title(self) -> str:
        return "Go-ICP"

    def versions(self) -> dict[str, str]:
        require("py_goicp", _INSTALL)
        return {"py_goicp": version("py_goicp")}

    def align_pair(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        goicp = require("py_goicp", _INSTALL)
        start, goal = source.mean(axis=0), target.mean(axis=0)
        scale = max(np.linalg.norm(source - start, axis=1).max(), np.linalg.norm(target - goal, axis=1).max())
        rows = np.random.RandomState(0).permutation(len(source))[: self.points]
        model = [goicp.POINT3D(*map(float, point)) for point in (target - goal) / scale]
        moved = [goicp.POINT3D(*map(float, point)) for point in (source[rows] - start) / scale]
        search = goicp.GoICP()
        with _quiet():
            search.loadModelAndData(len(model), model, len(moved), moved)
            search.setDTSizeAndFactor(self.grid, 2.0)
            turns, moves = goicp.ROTNODE(), goicp.TRANSNODE()
            turns.a = turns.b = turns.c = -np.pi
            turns.w = 2 * np.pi
            moves.x = moves.y = moves.z = -0.25
            moves.w = 0.5
            search.setInitNodeRot(turns)
            search.setInitNodeTrans(moves)
            search.MSEThresh, search.trimFraction, search.doTrim = self.threshold, 0.0, False
            search.BuildDT()
            search.Register()
        rotation = np.array(search.optimalRotation())
        return matrix(rotation, goal + scale * np.array(search.optimalTranslation()) - rotation @ start)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The library prints every step from C++: this sends the process's standard output nowhere meanwhile."""
    sys.stdout.flush()
    kept = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
