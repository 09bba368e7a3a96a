"""What tests of learned peers share: files of released weights, and training pairs with their loss."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.data.procedural import procedural_shapes
from urrt_jax.training.pairs import PairConfig, make_batch
from urrt_jax.training.trainable import PAIRS


@pytest.fixture(scope="session")
def peer_file():
    """A function of a file's name: its arrays from ``$URRT_DATA/peers``. The test is skipped where it is not there."""

    def read(name: str) -> dict[str, np.ndarray]:
        path = Path(os.environ.get("URRT_DATA", "nowhere")) / "peers" / name
        if not path.exists():
            pytest.skip(f"needs {name}: $URRT_DATA names no folder with peers/{name}")
        with np.load(path) as arrays:
            return dict(arrays)

    return read


@pytest.fixture(scope="session")
def clean_batch():
    """A function of (size, points, seed): clean pairs of procedural shapes, turned by up to 45° about three axes."""
    shapes = {"points": jnp.asarray(procedural_shapes(8, points=256).points)}

    def make(size: int, points: int, seed: int = 0):
        return make_batch(jax.random.key(seed), shapes, PairConfig(points=points), size, 0.0)

    return make


@pytest.fixture(scope="module")
def batch(clean_batch):
    """Three clean pairs of 24 points."""
    return clean_batch(3, 24)


@pytest.fixture(scope="module")
def pair(batch):
    """The first of them."""
    return jax.tree.map(lambda values: values[0], batch)


def _batch_loss(network, variables, batch, key):
    """The mean loss of a batch, as the training step takes it, and (metrics, "batch_stats")."""
    keys = jax.random.split(key, batch.source.points.shape[0])
    losses, metrics, stats = jax.vmap(
        lambda pair, pair_key: network.loss(variables, pair, pair_key), axis_name=PAIRS, out_axes=(0, 0, None)
    )(batch, keys)
    return losses.mean(), (jax.tree.map(lambda values: values.mean(), metrics), stats)


@pytest.fixture(scope="session")
def batch_loss():
    """A function of (network, variables, batch, key): the mean loss, and (mean metrics, new "batch_stats")."""
    return _batch_loss
