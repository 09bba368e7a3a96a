"""What the tests of the command line share: two small files, a small model, and a call of the command."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import urrt_jax
from urrt_jax import cli, io
from urrt_jax.data import demo_shape
from urrt_jax.rigid import Rigid


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """No cache folder, no debugging, no data of the developer's."""
    monkeypatch.setenv("URRT_NO_CACHE", "1")
    for name in ("URRT_DEBUG", "URRT_DATA"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def files(tmp_path_factory, small_model) -> dict[str, Path]:
    """Two clouds of 200 points and a small untrained model: enough for everything that is not about accuracy."""
    folder = tmp_path_factory.mktemp("files")
    shape = demo_shape(400).astype(np.float64)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    io.write_cloud(folder / "a.ply", shape[::2])
    io.write_cloud(folder / "b.xyz", shape[1::2] @ turn.T + [0.1, 0.2, 0.3])
    urrt_jax.save_model(small_model, folder / "model.npz")
    return {name: folder / name for name in ("a.ply", "b.xyz", "model.npz")}


@pytest.fixture
def answer() -> urrt_jax.Registration:
    """A made-up result for two clouds of 200 points, for tests that need no registration."""
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    others = np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)), np.zeros(4)
    fields: dict = dict(
        rotation=turn,
        translation=np.array([0.1, 1 / 3, 0.3]),
        fitness=np.array(0.9),
        rmse=np.array(0.012345678),
        inlier_distance=np.array(0.05),
        overlap=np.array([0.9, 0.8]),
        confidence=np.array(0.95),
        converged=np.array(True),
        outcome=np.array(0),
        correspondences=np.zeros(200, np.int32),
        information=np.eye(6),
        covariance=np.eye(6) * 1e-6,
        alternatives=urrt_jax.OtherPoses(*others),
        source_regions=np.zeros(200, np.int32),
        target_regions=np.zeros(200, np.int32),
        coarse=Rigid(turn, np.zeros(3)),
        steps=np.array(3),
    )
    return urrt_jax.Registration(**fields)


@pytest.fixture(scope="module")
def register(files) -> Callable[..., int]:
    """A function that runs ``urrt register`` on the two clouds with more flags, and returns the exit code."""

    def run(*flags: str, source: Path | None = None, target: Path | None = None) -> int:
        clouds = [str(source or files["a.ply"]), str(target or files["b.xyz"])]
        return cli.main(["register", *clouds, "--model", str(files["model.npz"]), *flags])

    return run
