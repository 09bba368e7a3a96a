"""Registration inside a learned pipeline: a range sensor's error is found through the derivative of the pose."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import ICP, register
from urrt_jax.clouds import make_cloud
from urrt_jax.data import demo_shape
from urrt_jax.losses import chamfer

SCALE, BIAS = 0.85, 0.25  # of the readings: reading = SCALE · range + BIAS


@pytest.fixture(scope="module")
def pairs():
    """Six pairs of scans (6, 512, 3) by that sensor, each in its own frame, and how far it travelled between them."""
    random = np.random.default_rng(0)

    def scan(points, centre, axes):
        seen = (points - centre) @ axes.T
        distance = np.linalg.norm(seen, axis=1, keepdims=True)
        return seen / distance * (SCALE * distance + BIAS + random.normal(scale=0.005, size=distance.shape))

    def pair():
        shape = random.permutation(demo_shape(1024).astype(np.float64))
        axes = Rotation.from_quat(random.normal(size=4)).as_matrix()
        around = Rotation.from_rotvec(np.radians(30) * axes[1]).as_matrix()
        near, far = 1.5 * axes[0], 3.0 * around @ axes[0]
        return scan(shape[:512], near, axes), scan(shape[512:], far, axes @ around.T), np.linalg.norm(near - far)

    return tuple(jnp.asarray(np.stack(part), jnp.float32) for part in zip(*(pair() for _ in range(6)), strict=True))


def _correct(parameters, points):
    scale, bias = parameters
    reading = jnp.linalg.norm(points, axis=-1, keepdims=True)
    return points / reading * (reading - bias) / scale


def _loss(parameters, pairs, through_pose):
    """The misfit, relative to the clouds' size, that shrinking can't lower; and the error of the distance travelled."""

    def one(source, target, travel):
        source, target = _correct(parameters, source), _correct(parameters, target)
        # Neither a search nor EM-ICP, which these pairs do not need, and which take long to compile.
        result = register(source, target, search=None, refine=ICP(em_points=0))
        # A traced switch: both ways are one compiled program.
        result = jax.tree.map(lambda leaf: jnp.where(through_pose, leaf, jax.lax.stop_gradient(leaf)), result)
        size = jnp.linalg.norm(jnp.std(target, axis=0))
        moved, goal = make_cloud(result.apply(source) / size), make_cloud(target / size)
        misfit = chamfer(moved, goal, penalty="geman_mcclure", scale=0.3)
        return misfit + (jnp.linalg.norm(result.translation) / travel - 1) ** 2

    return jnp.mean(jax.vmap(one)(*pairs))


@pytest.fixture(scope="module")
def value_and_grad(pairs):
    """A function of (parameters, through_pose): the loss and its gradient."""
    # It runs for minutes when it is compiled as hastily as other tests are (conftest.py).
    fast = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
    compiled = jax.jit(jax.value_and_grad(_loss), compiler_options=fast)
    return lambda parameters, through_pose: compiled(jnp.array(parameters), pairs, through_pose)


@pytest.fixture(scope="module")
def learned(value_and_grad):
    """The parameters (2,) after 24 steps from a sensor without an error."""
    optimizer = optax.adam(optax.cosine_decay_schedule(0.06, 24))
    parameters = jnp.array([1.0, 0.0])
    state = optimizer.init(parameters)
    for _ in range(24):
        updates, state = optimizer.update(value_and_grad(parameters, True)[1], state)
        parameters = optax.apply_updates(parameters, updates)
    return parameters


def test_sensor_error_is_learned_through_registration(learned):
    scale, bias = learned
    assert scale == pytest.approx(SCALE, abs=0.02)
    assert bias == pytest.approx(BIAS, abs=0.04)


def test_loss_falls_to_that_of_the_true_sensor(value_and_grad, learned):
    """It can't vanish, since two scans share no point; what is above the truth's is what there is to learn."""
    first, last, least = (value_and_grad(p, True)[0] for p in ([1.0, 0.0], learned, [SCALE, BIAS]))
    assert first > 1.3 * least
    assert last - least < 0.1 * (first - least)


def test_distance_travelled_differentiates_through_the_pose(value_and_grad):
    """With the true bias, scans of a wrong scale still fit, and the travel is SCALE / scale of what it should be."""
    derivative = value_and_grad([1.0, BIAS], True)[1][0]
    assert derivative == pytest.approx(2 * (SCALE - 1) * -SCALE, rel=0.1)


def test_without_the_derivative_of_the_pose_hardly_anything_pulls_the_scale(value_and_grad):
    """Otherwise the tests above would say nothing of the pose."""
    through, without = (value_and_grad([1.0, BIAS], way)[1][0] for way in (True, False))
    assert abs(without) < 0.5 * through
