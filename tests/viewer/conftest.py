"""What tests of pictures share: made-up results, and a pair of clouds."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.result import OtherPoses, Outcome, Registration
from urrt_jax.rigid import Rigid


def _registration(
    source: np.ndarray,
    target: np.ndarray,
    *,
    matrix: np.ndarray | None = None,
    others: tuple[tuple[np.ndarray, float], ...] = (),
    converged: bool = True,
) -> Registration:
    """A result with this pose, the identity by default, these others, and regions by octant."""
    octants = [((cloud > cloud.mean(axis=0)) @ [1, 2, 4]).astype(np.int32) for cloud in (source, target)]
    matrix = np.eye(4) if matrix is None else matrix
    others = others or ((np.eye(4), 0.0),)
    return Registration(
        rotation=matrix[:3, :3],
        translation=matrix[:3, 3],
        fitness=jnp.array(0.75),
        rmse=jnp.array(0.0125),
        inlier_distance=jnp.array(0.05),
        overlap=jnp.array([0.75, 0.8]),
        confidence=jnp.array(0.9),
        converged=jnp.array(converged),
        outcome=jnp.array(Outcome.CONVERGED if converged else Outcome.MISFIT, jnp.int32),
        correspondences=jnp.zeros(len(source), jnp.int32),
        information=jnp.eye(6),
        covariance=1e-6 * jnp.eye(6),
        alternatives=OtherPoses(
            np.stack([other[:3, :3] for other, _ in others]),
            np.stack([other[:3, 3] for other, _ in others]),
            np.array([weight for _, weight in others]),
        ),
        source_regions=jnp.asarray(octants[0]),
        target_regions=jnp.asarray(octants[1]),
        coarse=Rigid(jnp.eye(3), jnp.zeros(3)),
        steps=jnp.array(3),
    )


@pytest.fixture(scope="session")
def registration() -> Callable[..., Registration]:
    """A function of (source, target): a made-up result."""
    return _registration


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
