"""The protocols draw what their definitions say, on every machine."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation import PROTOCOLS


@pytest.fixture(scope="module")
def clouds():
    return np.random.default_rng(0).normal(size=(3, 1100, 3)).astype(np.float32)


def test_first_draws_of_dcp_are_pinned(clouds):
    """Angles and translation of item 0: the first six numbers of MT19937 with seed 0, as DCP's definition has them."""
    trial = PROTOCOLS["dcp"](clouds, 0)
    uniform = np.array([0.5488135039273248, 0.7151893663724195, 0.6027633760716439])
    x, y, z = uniform * np.pi / 4
    np.testing.assert_allclose(trial.rotation, Rotation.from_euler("zyx", [z, y, x]).as_matrix(), atol=1e-12)
    moved = np.array([0.5448831829968969, 0.4236547993389047, 0.6458941130666561]) - 0.5
    np.testing.assert_allclose(trial.translation, moved, atol=1e-12)


@pytest.mark.parametrize("item", [0, 1, 2])
def test_dcp_target_holds_the_moved_source_points_in_another_order(clouds, item):
    trial = PROTOCOLS["dcp"](clouds, item)
    moved = trial.source @ trial.rotation.T + trial.translation
    assert not np.allclose(moved, trial.target, atol=1e-2)
    np.testing.assert_allclose(np.sort(moved, axis=0), np.sort(trial.target, axis=0), atol=1e-5)


def test_dcp_uses_the_first_1024_points(clouds):
    source = PROTOCOLS["dcp"](clouds, 1).source
    assert source.shape == (1024, 3)
    np.testing.assert_array_equal(np.sort(source, axis=0), np.sort(clouds[1, :1024], axis=0))


def test_dcp_is_a_pure_function_of_the_item(clouds):
    np.random.seed(7)  # noqa: NPY002 - the global generator is what must not matter
    first = PROTOCOLS["dcp"](clouds, 2)
    second = PROTOCOLS["dcp"](clouds, 2)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
