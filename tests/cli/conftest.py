"""What the tests of the command line share: two small files, a small model, and a call of the command."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import urrt_jax
from urrt_jax import cli, io
from urrt_jax.data import demo_shape


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
def answer(registration) -> urrt_jax.Registration:
    """A made-up result for two clouds of 200 points, with numbers of many digits."""
    matrix = np.eye(4)
    matrix[:3] = [[0.8, -0.6, 0.0, 0.1], [0.6, 0.8, 0.0, 1 / 3], [0.0, 0.0, 1.0, 0.3]]
    cloud = np.zeros((200, 3))
    return dataclasses.replace(registration(cloud, cloud, matrix=matrix), rmse=np.array(0.012345678))


@pytest.fixture(scope="module")
def register(files) -> Callable[..., int]:
    """A function that runs ``urrt register`` on the two clouds with more flags, and returns the exit code."""

    def run(*flags: str, source: Path | None = None, target: Path | None = None) -> int:
        clouds = [str(source or files["a.ply"]), str(target or files["b.xyz"])]
        return cli.main(["register", *clouds, "--model", str(files["model.npz"]), *flags])

    return run
