"""What tests of pictures share: a pair of clouds and a pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


@pytest.fixture(scope="session")
def pair() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    return random.normal(size=(500, 3)), random.normal(size=(400, 3)) * [2, 1, 1]


@pytest.fixture(scope="session")
def matrix() -> np.ndarray:
    """A turn by 50 degrees and a translation, (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.deg2rad(50) * np.array([0.6, 0.0, 0.8])).as_matrix()
    matrix[:3, 3] = [1.5, -1.0, 0.5]
    return matrix
