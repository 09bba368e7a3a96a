"""What several tests share: an asymmetric cloud, a pose, a small network that does not answer the identity."""

import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings
from scipy.spatial.transform import Rotation

from urrt_jax import Model, ModelConfig
from urrt_jax.model import init_model
from urrt_jax.result import OtherPoses, Outcome, Registration
from urrt_jax.rigid import Rigid

# The first example of a test compiles; deadlines would measure the compiler.
settings.register_profile("urrt", deadline=None, max_examples=25, derandomize=True, database=None)
settings.load_profile("urrt")


def pytest_configure(config: pytest.Config) -> None:
    _compile_in_less_time(config)
    config.addinivalue_line("markers", "slow: takes tens of seconds; leave out with -m 'not slow'")


# Programs of tests run for milliseconds. Compiled like this they take a fifth of the time to compile, and run slower.
_HASTY = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


def _compile_in_less_time(config: pytest.Config) -> None:
    """Tests compile far longer than they run: optimise nothing, and let the workers share what they compile."""
    if hasattr(config, "workerinput"):
        return  # inherits the environment
    flags = f"{os.environ.get('XLA_FLAGS', '')} {_HASTY}".strip()
    # XLA ends a process that sets a flag which another version has and this one has not.
    knows = subprocess.run([sys.executable, "-c", "import jax; jax.devices()"], env=os.environ | {"XLA_FLAGS": flags})
    if knows.returncode == 0:
        os.environ["XLA_FLAGS"] = flags
    shared = tempfile.TemporaryDirectory(prefix="urrt-tests-")
    config.add_cleanup(shared.cleanup)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = shared.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "0"


def _asymmetric_cloud(seed: int = 0, scale: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)

    def sphere(count: int) -> np.ndarray:
        directions = rng.normal(size=(count * scale, 3))
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    body = sphere(110) * np.array([1.0, 0.7, 0.45])
    head = 0.3 * sphere(60) + np.array([0.9, 0.5, 0.35])
    stick = np.outer(rng.uniform(0, 1, 30 * scale), [-0.3, 0.2, 0.9]) + np.array([-0.5, 0, 0.3])
    stick += 0.03 * rng.normal(size=stick.shape)
    return np.concatenate([body, head, stick]).astype(np.float32)


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_programs():
    """Hundreds of compiled functions would otherwise stay in memory until the last test.

    The stages of ``register`` stay: they are few, and all modules use them, for clouds of at most 256 points.
    """
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def make_cloud_points():
    """A function of (seed, scale): an asymmetric cloud of 200·scale points, (N, 3) float32."""
    return _asymmetric_cloud


@pytest.fixture(scope="session")
def cloud() -> np.ndarray:
    """200 points of a shape without any symmetry, (200, 3) float32."""
    points = _asymmetric_cloud()
    points.flags.writeable = False
    return points


@pytest.fixture(scope="session")
def pose() -> tuple[np.ndarray, np.ndarray]:
    """A turn by 10 degrees and a translation, float64."""
    axis = np.array([0.3, -0.5, 0.8])
    return Rotation.from_rotvec(np.deg2rad(10) * axis / np.linalg.norm(axis)).as_matrix(), np.array([0.2, -0.1, 0.3])


@pytest.fixture(scope="session")
def small_config() -> ModelConfig:
    return ModelConfig(
        regions=4,
        width=16,
        encoder_widths=(16,),
        branch_width=8,
        position_widths=(8,),
        decoder_widths=(16,),
        landmarks=5,
        sharpness=4.0,
        octaves=4,
        lookups=16,
        consensus=3,
        hypotheses=8,
        steps=2,
        points=64,
    )


_init = jax.jit(init_model, static_argnums=1)


def _perturbed(config: ModelConfig, seed: int = 0) -> Model:
    model = _init(jax.random.key(seed), config)
    leaves, tree = jax.tree.flatten(model.params)
    keys = jax.random.split(jax.random.key(seed + 100), len(leaves))
    leaves = [leaf + 0.05 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    return Model(config, jax.tree.unflatten(tree, leaves))


@pytest.fixture(scope="session")
def make_model():
    """A function of (config, seed): a model with perturbed parameters."""
    return _perturbed


@pytest.fixture(scope="session")
def small_model(small_config: ModelConfig) -> Model:
    """A network with random parameters whose estimates are not the identity."""
    return _perturbed(small_config)


@pytest.fixture(scope="session")
def parts_model(small_config: ModelConfig) -> Model:
    """The same, with regions that are parts of the shape."""
    return _perturbed(dataclasses.replace(small_config, partition="parts"))


@pytest.fixture
def x64():
    """Double precision within one test, for sharp finite differences."""
    with jax.enable_x64(True):
        yield jnp.float64


def _made_up_registration(
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
    """A function of (source, target) and a matrix: a made-up result, for tests that need no registration."""
    return _made_up_registration
