"""One step: the equations are those of the energy they stand for, and no system makes a step run away."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.assessment.precision import cross_matrix
from urrt_jax.refine.pairs import Pairs
from urrt_jax.refine.solver import bounded_step, damped_solve, move, normal_equations
from urrt_jax.rigid import Rigid

_equations, _move, _step = jax.jit(normal_equations), jax.jit(move), jax.jit(bounded_step)


def _pairs(apart: float = 0.1, count: int = 50) -> Pairs:
    """Random pairs about a place that is not the origin; arrays are float64 where that is switched on."""
    rng = np.random.default_rng(0)
    target = rng.normal([0.5, -1.0, 2.0], size=(count, 3))
    source = target + apart * rng.normal(size=(count, 3))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    squared = np.sum((source - target) ** 2, axis=1)
    return Pairs(*(jnp.asarray(each) for each in (source, target, normals, squared, np.zeros(count, np.int32))))


def _weights(count: int = 50) -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).uniform(size=count))


def _nudged(points, motion, turns: float):
    """The points after the small motion, exact to second order; only ``turns`` of the rotation, for directions."""
    shift, turn = motion[:3], turns * motion[3:]
    once = jnp.cross(turn, points)
    return points + once + shift + jnp.cross(turn, once + shift) / 2


def _energy(motion, pairs, weights, plane):
    """Σ w (plane (n·r)² + (1 − plane) |r|²), where normals turn half as much as the source."""
    apart = _nudged(pairs.source, motion, 1.0) - pairs.target
    directions = _nudged(pairs.normals, jnp.concatenate([jnp.zeros(3), motion[3:]]), 0.5)
    along = jnp.sum(directions * apart, axis=-1)
    return jnp.sum(weights * (plane * along**2 + (1 - plane) * jnp.sum(apart**2, axis=-1)))


_half_gradient = jax.jit(lambda *args: jax.grad(_energy)(jnp.zeros(6), *args) / 2)
_half_hessian = jax.jit(lambda *args: jax.hessian(_energy)(jnp.zeros(6), *args) / 2)


@pytest.mark.parametrize("plane", [0.0, 0.3, 0.97, 1.0])
def test_gradient_is_half_that_of_the_energy(plane, x64):
    pairs, weights = _pairs(), _weights()
    expected = _half_gradient(pairs, weights, plane)
    np.testing.assert_allclose(_equations(pairs, weights, plane)[1], expected, rtol=1e-9)


@pytest.mark.parametrize("plane", [0.0, 0.97, 1.0])
def test_matrix_is_half_the_hessian_of_the_energy_where_pairs_coincide(plane, x64):
    pairs, weights = _pairs(apart=0.0), _weights()
    expected = _half_hessian(pairs, weights, plane)
    np.testing.assert_allclose(_equations(pairs, weights, plane)[0], expected, rtol=1e-9, atol=1e-12)


def test_matrix_of_points_differs_from_half_the_hessian_by_a_quarter_of_the_square_of_what_is_apart(x64):
    """Levers are taken in the middle of a pair, which makes all of it but Σ w |ω × r|² / 4 exact."""
    pairs, weights = _pairs(), _weights()
    levers = jax.vmap(cross_matrix)(pairs.source - pairs.target)
    more = jnp.zeros((6, 6)).at[3:, 3:].set(jnp.einsum("n,nki,nkj->ij", weights, levers, levers) / 4)
    expected = _half_hessian(pairs, weights, 0.0) + more
    np.testing.assert_allclose(_equations(pairs, weights, 0.0)[0], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("plane", [0.0, 0.5, 1.0])
def test_pairs_without_weight_change_nothing(plane):
    pairs, weights = _pairs(), _weights().at[::3].set(0.0)
    strange = pairs._replace(source=pairs.source.at[::3].set(1e18))
    for found, expected in zip(_equations(strange, weights, plane), _equations(pairs, weights, plane), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def _apart(angle: float, plane: float) -> tuple[Pairs, Rigid]:
    """Pairs on a curved surface, where the target is the source moved, and that motion."""
    turn = Rotation.from_rotvec(angle * np.array([0.6, -0.64, 0.48])).as_matrix()
    shift = angle * np.array([0.3, 0.2, -0.4])
    target = _pairs().target
    source = (target - jnp.asarray(shift)) @ jnp.asarray(turn)
    return _pairs()._replace(source=source, target=target), Rigid(jnp.asarray(turn), jnp.asarray(shift))


@pytest.mark.parametrize("plane", [0.0, 0.97, 1.0])
@pytest.mark.parametrize(("steps", "error"), [(1, 2e-3), (2, 2e-7)])
def test_a_small_motion_is_found(steps, error, plane, x64):
    pairs, motion = _apart(0.05, plane)
    start, found = pairs.source, Rigid(jnp.eye(3), jnp.zeros(3))
    for _ in range(steps):
        here = pairs._replace(source=rigid.apply(found, start))
        found = _move(_step(*_equations(here, _weights(), plane)), found)
    np.testing.assert_allclose(found.rotation, motion.rotation, atol=error)
    np.testing.assert_allclose(found.translation, motion.translation, atol=error)


@pytest.mark.parametrize("plane", [0.0, 0.97, 1.0])
def test_a_step_is_nothing_where_pairs_coincide(plane):
    assert float(jnp.max(jnp.abs(_step(*_equations(_pairs(apart=0.0), _weights(), plane))))) == 0


def test_a_step_is_never_long():
    assert float(jnp.linalg.norm(_step(jnp.eye(6), 100 * jnp.ones(6)))) == pytest.approx(0.3, rel=1e-5)


def test_a_short_step_is_that_of_gauss_and_newton():
    matrix = jnp.diag(jnp.array([1.0, 2.0, 4.0, 1.0, 2.0, 4.0]))
    gradient = jnp.array([0.1, 0.0, 0.0, 0.0, -0.1, 0.0])
    np.testing.assert_allclose(_step(matrix, gradient), [-0.1, 0, 0, 0, 0.05, 0], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", [0, 1])
def test_no_step_is_made_from_what_is_not_finite(place, value):
    system = [jnp.eye(6), jnp.ones(6)]
    system[place] = system[place].at[0].set(value)
    assert _step(*system).tolist() == [0] * 6


_ROWS = np.random.default_rng(3).normal(size=(6, 6))
_SINGULAR = [
    pytest.param(np.diag([1.0, 1, 1, 0, 0, 0]), id="half"),
    pytest.param(_ROWS[:, :1] @ _ROWS[:, :1].T, id="rank one"),
    pytest.param(_ROWS[:, :3] @ _ROWS[:, :3].T, id="rank three"),
    pytest.param(1e20 * _ROWS[:, :5] @ _ROWS[:, :5].T, id="rank five, large"),
    pytest.param(1e-20 * _ROWS[:, :1] @ _ROWS[:, :1].T, id="rank one, small"),
]
_MOTION = np.arange(1.0, 7.0)


@pytest.mark.parametrize("matrix", _SINGULAR)
def test_a_motion_that_no_pair_speaks_for_is_not_made(matrix, x64):
    wanted = np.linalg.pinv(matrix, rcond=1e-10) @ matrix @ _MOTION
    np.testing.assert_allclose(damped_solve(jnp.asarray(matrix), jnp.asarray(matrix @ _MOTION)), wanted, rtol=1e-3)


@pytest.mark.parametrize("matrix", [*_SINGULAR, pytest.param(np.zeros((6, 6)), id="zero")])
@pytest.mark.parametrize("vector", [np.zeros(6), np.ones(6), -1e6 * _MOTION])
def test_the_step_of_a_singular_system_is_finite(matrix, vector):
    assert np.isfinite(_step(jnp.asarray(matrix, jnp.float32), jnp.asarray(vector, jnp.float32))).all()


@pytest.mark.parametrize("matrix", _SINGULAR)
def test_the_solution_of_a_singular_system_is_finite(matrix):
    matrix = jnp.asarray(matrix, jnp.float32)
    assert np.isfinite(damped_solve(matrix, matrix @ jnp.asarray(_MOTION, jnp.float32))).all()


def test_a_regular_system_is_solved():
    matrix = jnp.asarray(_ROWS @ _ROWS.T + np.eye(6), jnp.float32)
    np.testing.assert_allclose(damped_solve(matrix, matrix @ _MOTION), _MOTION, rtol=1e-3)


def test_a_system_of_nothing_has_the_solution_nothing():
    assert damped_solve(jnp.zeros((6, 6)), jnp.zeros(6)).tolist() == [0] * 6


_HERE = Rigid(
    jnp.asarray(Rotation.from_euler("zyx", [50, 20, -110], degrees=True).as_matrix(), jnp.float32),
    jnp.array([1.0, -2.0, 3.0]),
)


def test_no_motion_changes_nothing():
    jax.tree.map(np.testing.assert_array_equal, move(jnp.zeros(6), _HERE), _HERE)


def test_a_motion_follows_the_transform_as_se3_s_exponential():
    motion = jnp.array([0.1, -0.2, 0.3, 0.5, -0.4, 0.2])
    here = jaxlie.SE3.from_matrix(rigid.matrix(_HERE))
    np.testing.assert_allclose(
        rigid.matrix(move(motion, _HERE)), (jaxlie.SE3.exp(motion) @ here).as_matrix(), atol=1e-5
    )


def test_derivative_of_no_motion_is_its_generators(x64):
    """What the derivatives of refinement rest on: d move / d motion at zero."""
    here = jax.tree.map(lambda leaf: leaf.astype(x64), _HERE)
    found = jax.jit(jax.jacobian(lambda motion: rigid.matrix(move(motion, here))))(jnp.zeros(6))
    generators = np.zeros((6, 4, 4))
    generators[[0, 1, 2], [0, 1, 2], 3] = 1
    generators[3:, :3, :3] = jax.vmap(cross_matrix)(jnp.eye(3))
    np.testing.assert_allclose(np.moveaxis(found, -1, 0), generators @ rigid.matrix(here), atol=1e-12)
