"""Rigid transforms: group axioms, agreement with SciPy, derivatives that are finite and right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.rigid import (
    Rigid,
    nearest_rotation,
    procrustes,
    quick_rotation,
    rotation_angle,
    rotation_from_6d,
)

_polar, _quick = jax.jit(nearest_rotation), jax.jit(quick_rotation)
_from_6d = jax.jit(rotation_from_6d)
_angle = jax.jit(rotation_angle)
_compose, _inverse, _apply = jax.jit(rigid.compose), jax.jit(rigid.inverse), jax.jit(rigid.apply)

_seeds = st.integers(0, 2**31 - 1)
# Whole turns and turns near the identity.
_sizes = st.sampled_from([1e-7, 1e-4, 1e-2, 1.0, 3.0])


def _random(seed: int, size: float) -> Rigid:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(size * axis / np.linalg.norm(axis)).as_matrix()
    return Rigid(jnp.asarray(turn, jnp.float32), jnp.asarray(size * rng.normal(size=3), jnp.float32))


def _close(first, second, atol=2e-6):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), first, second)


def _is_rotation(matrix, atol=1e-5):
    matrix = np.asarray(matrix, np.float64)
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=atol)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=atol)


@given(_seeds, _sizes)
def test_inverse_composes_to_the_identity(seed, size):
    one = _random(seed, size)
    _close(_compose(one, _inverse(one)), rigid.identity(), atol=5e-6)


@given(_seeds, _sizes)
def test_identity_is_neutral(seed, size):
    one = _random(seed, size)
    _close(_compose(one, rigid.identity()), one)
    _close(_compose(rigid.identity(), one), one)


@given(_seeds, _sizes)
def test_composition_is_associative(seed, size):
    a, b, c = (_random(seed + i, size) for i in range(3))
    _close(_compose(_compose(a, b), c), _compose(a, _compose(b, c)), atol=2e-5)


@given(_seeds, _sizes)
def test_composition_acts_as_one_after_the_other(seed, size):
    outer, inner = _random(seed, size), _random(seed + 1, size)
    points = np.random.default_rng(seed).normal(size=(5, 3)).astype(np.float32)
    _close(_apply(_compose(outer, inner), points), _apply(outer, _apply(inner, points)), atol=1e-5)


@given(_seeds, _sizes)
def test_matrix_acts_as_apply_does(seed, size):
    one = _random(seed, size)
    point = np.random.default_rng(seed).normal(size=3).astype(np.float32)
    _close((rigid.matrix(one) @ np.append(point, 1))[:3], _apply(one, point), atol=5e-6)


def test_rotate_multiplies_from_the_left():
    quarter = jnp.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(rigid.rotate(quarter, jnp.array([[1.0, 0, 0]])), [[0, 1, 0]])


@given(_seeds)
def test_nearest_rotation_agrees_with_scipy(seed):
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 12, 3))
    expected, _ = Rotation.align_vectors(target, source)
    _close(_polar((target.T @ source).astype(np.float32)), expected.as_matrix(), atol=1e-4)


@given(_seeds, _sizes)
def test_nearest_rotation_keeps_a_rotation(seed, size):
    rotation = _random(seed, size).rotation
    _close(_polar(rotation * 0.37), rotation, atol=3e-6)


def _moments() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    random = rng.normal(size=(3, 3))
    turn = Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix()
    if np.linalg.det(random) < 0:
        random = -random
    return {
        "random": random,
        "identity": np.eye(3),
        "equal singular values, turned": 2.0 * turn,
        "two equal": turn @ np.diag([2.0, 2.0, 0.7]),
        "reflection": turn @ np.diag([2.0, 1.0, -0.5]),
        "random with negative determinant": -random,
        "planar": turn @ np.diag([2.0, 1.0, 0.0]),
    }


@pytest.mark.parametrize("name", _moments())
def test_nearest_rotation_derivative_agrees_with_finite_differences(name, x64):
    moment = jnp.asarray(_moments()[name], x64)
    directions = np.random.default_rng(1).normal(size=(6, 3, 3))
    for direction in directions:
        _, tangent = jax.jvp(nearest_rotation, (moment,), (jnp.asarray(direction),))
        step = 1e-6
        difference = (nearest_rotation(moment + step * direction) - nearest_rotation(moment - step * direction)) / (
            2 * step
        )
        np.testing.assert_allclose(tangent, difference, atol=1e-7, rtol=1e-5)


def test_nearest_rotation_has_the_same_derivative_in_reverse(x64):
    moment = jnp.asarray(_moments()["random"], x64)
    forward = jax.jacfwd(nearest_rotation)(moment)
    np.testing.assert_allclose(jax.jacrev(nearest_rotation)(moment), forward, atol=1e-12)


_DEGENERATE = {
    "zero": np.zeros((3, 3)),
    "rank one": np.outer([1, 2, 3], [-1, 0.5, 2]),
    "nan": np.full((3, 3), np.nan),
    "infinite": np.full((3, 3), np.inf),
    "tiny": 1e-30 * np.eye(3),
    "huge": 1e30 * np.eye(3),
    "mirrored with equal values": np.diag([1.0, 1.0, -1.0]),
}


@pytest.mark.parametrize("name", _DEGENERATE)
def test_nearest_rotation_is_a_rotation_for_a_degenerate_moment(name):
    _is_rotation(_polar(_DEGENERATE[name].astype(np.float32)))


@pytest.mark.parametrize("name", _DEGENERATE)
def test_nearest_rotation_has_a_finite_derivative_for_a_degenerate_moment(name):
    jacobian = jax.jacrev(nearest_rotation)(jnp.asarray(_DEGENERATE[name], jnp.float32))
    assert bool(jnp.all(jnp.isfinite(jacobian)))


@given(_seeds, st.sampled_from([1e-6, 1.0, 1e6]), st.sampled_from([-1.0, 0.0, 1.0]))
def test_quick_rotation_is_the_nearest_one_where_that_is_clear(seed, size, last):
    """Whatever the size of the moment; flat and mirrored ones, too."""
    first, second = _random(seed, 3.0).rotation, _random(seed + 1, 3.0).rotation
    moment = np.float32(size) * np.asarray(first) @ np.diag([1.0, 0.7, 0.4 * last]).astype(np.float32) @ second
    np.testing.assert_allclose(_quick(moment), _polar(moment), atol=1e-5)


@pytest.mark.parametrize("name", _DEGENERATE)
def test_quick_rotation_is_a_rotation_for_a_degenerate_moment(name):
    _is_rotation(_quick(_DEGENERATE[name].astype(np.float32)))


@given(st.lists(st.floats(-100, 100, width=32), min_size=6, max_size=6))
def test_rotation_from_6d_is_always_a_rotation(columns):
    _is_rotation(_from_6d(np.array(columns, np.float32)), atol=1e-4)


@pytest.mark.parametrize(
    "columns",
    [
        pytest.param([0, 0, 0, 0, 0, 0], id="zeros"),
        pytest.param([0, 0, 0, 1, 2, 3], id="first zero"),
        pytest.param([1, 2, 3, 0, 0, 0], id="second zero"),
        pytest.param([1, 2, 3, 2, 4, 6], id="parallel"),
        pytest.param([1, 2, 3, -1, -2, -3], id="opposite"),
        pytest.param([1e-7, 0, 0, 0, 1e-7, 0], id="tiny"),
        pytest.param([1, 2, 3, 1, 2, 3.00001], id="nearly parallel"),
        pytest.param([0.1, 0.2, 0.3, 100, 200, 300.0001], id="nearly parallel, one long"),
        pytest.param([0.61, 0.23, 0.71, 61.003, 23.001, 71.002], id="nearly parallel, turned"),
    ],
)
def test_rotation_from_6d_of_degenerate_columns_is_a_rotation(columns):
    _is_rotation(_from_6d(np.array(columns, np.float32)), atol=1e-4)


@pytest.mark.parametrize("columns", [[0.0] * 6, [1.0, 2, 3, 2, 4, 6], [1.0, 0, 0, 0, 1, 0]])
def test_rotation_from_6d_has_a_finite_derivative(columns):
    assert bool(jnp.all(jnp.isfinite(jax.jacrev(rotation_from_6d)(jnp.array(columns)))))


@given(_seeds, _sizes)
def test_rotation_from_6d_keeps_the_columns_of_a_rotation(seed, size):
    rotation = _random(seed, size).rotation
    _close(_from_6d(2.5 * rotation[:, :2].T.ravel()), rotation, atol=3e-6)


@pytest.mark.parametrize("angle", [1e-6, 1e-5, 1e-3, 0.1, 1.0, 3.0, 3.14])
def test_rotation_angle_is_exact_from_a_millionth_to_half_a_turn(angle):
    first = Rotation.from_rotvec([0.2, 0.1, -0.4])
    for axis in np.eye(3):
        turn = jnp.asarray(Rotation.from_rotvec(angle * axis).as_matrix(), jnp.float32)
        assert float(_angle(jnp.eye(3), turn)) == pytest.approx(angle, rel=0.03 if angle < 1e-5 else 2e-3)
    second = (first * Rotation.from_rotvec([0, 0, angle])).as_matrix().astype(np.float32)
    assert float(_angle(first.as_matrix().astype(np.float32), second)) == pytest.approx(angle, rel=2e-3, abs=2e-7)


def test_rotation_angle_of_half_a_turn_is_pi():
    assert float(_angle(jnp.eye(3), jnp.diag(jnp.array([1.0, -1, -1])))) == pytest.approx(np.pi, abs=1e-3)


def test_rotation_angle_is_zero_for_equal_rotations():
    rotation = _random(3, 1.0).rotation
    assert float(_angle(rotation, rotation)) == 0


@pytest.mark.parametrize("other", [np.eye(3), np.diag([1.0, -1, -1]), np.full((3, 3), 0.0)])
def test_rotation_angle_has_a_finite_gradient(other):
    gradient = jax.grad(rotation_angle)(jnp.eye(3), jnp.asarray(other, jnp.float32))
    assert bool(jnp.all(jnp.isfinite(gradient)))


def test_rotation_angle_of_nan_is_not_a_perfect_score():
    assert not float(_angle(jnp.full((3, 3), jnp.nan), jnp.eye(3))) <= 3.14159


def _problem(seed: int = 0, count: int = 20):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(count, 3))
    turn, shift = Rotation.random(rng=seed).as_matrix(), rng.normal(size=3)
    return source, source @ turn.T + shift, turn, shift


@given(_seeds)
def test_procrustes_recovers_the_pose(seed):
    source, target, turn, shift = _problem(seed)
    found = jax.jit(procrustes)(*(np.float32(x) for x in (source, target)), np.ones(20, np.float32))
    _close(found, Rigid(turn, shift), atol=1e-5)


def test_procrustes_weights_agree_with_scipy():
    source, target, _, _ = _problem(1)
    rng = np.random.default_rng(2)
    target = target + 0.3 * rng.normal(size=target.shape)
    weights = rng.uniform(0, 1, 20)
    centred = [x - weights @ x / weights.sum() for x in (target, source)]
    expected, _ = Rotation.align_vectors(*centred, weights=weights)
    found = procrustes(*(jnp.asarray(x, jnp.float32) for x in (source, target, weights)))
    np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-5)


def test_procrustes_ignores_pairs_of_weight_zero():
    source, target, turn, shift = _problem(1)
    target[:5] += 100.0
    found = procrustes(jnp.float32(source), jnp.float32(target), (jnp.arange(20) >= 5).astype(jnp.float32))
    _close(found, Rigid(turn, shift), atol=1e-5)


def test_stiffness_turns_nothing_that_is_smaller_and_hardly_what_is_larger():
    points, turn = np.random.default_rng(0).normal(size=(20, 3)), Rotation.from_rotvec([0.3, -0.4, 0.5]).as_matrix()

    def found(scale: float, stiffness: float) -> jax.Array:
        clouds = (jnp.asarray(scale * x, jnp.float32) for x in (points, points @ turn.T))
        return procrustes(*clouds, jnp.ones(20), stiffness=stiffness).rotation

    np.testing.assert_allclose(found(1e-3, 0.0), turn, atol=1e-5)
    np.testing.assert_allclose(found(1e-3, 1e-2), np.eye(3), atol=1e-3)
    np.testing.assert_allclose(found(1.0, 1e-4), turn, atol=1e-3)


def test_procrustes_without_weight_is_the_identity():
    source, target, _, _ = _problem(1)
    _close(procrustes(jnp.float32(source), jnp.float32(target), jnp.zeros(20)), rigid.identity(), atol=0)


def test_procrustes_without_weight_has_a_finite_gradient():
    source, target, _, _ = _problem(1)
    gradient = jax.grad(lambda w: jnp.sum(procrustes(jnp.float32(source), jnp.float32(target), w).translation))(
        jnp.zeros(20)
    )
    assert bool(jnp.all(jnp.isfinite(gradient)))


@pytest.mark.parametrize(
    "flatten",
    [
        pytest.param([1.0, 1, 0], id="planar"),
        pytest.param([1.0, 0, 0], id="collinear"),
        pytest.param([0.0, 0, 0], id="point"),
    ],
)
def test_procrustes_of_a_flat_cloud_is_a_rotation_that_fits(flatten):
    source, _, turn, shift = _problem(3)
    source = source * flatten
    target = source @ turn.T + shift
    found = procrustes(jnp.float32(source), jnp.float32(target), jnp.ones(20))
    _is_rotation(found.rotation)
    np.testing.assert_allclose(rigid.apply(found, jnp.float32(source)), target, atol=1e-5)


def test_procrustes_never_mirrors():
    source, _, _, _ = _problem(4)
    found = procrustes(jnp.float32(source), jnp.float32(source * [1, 1, -1]), jnp.ones(20))
    _is_rotation(found.rotation)


@pytest.mark.parametrize("mirror", [False, True])
def test_procrustes_derivative_agrees_with_finite_differences(mirror, x64):
    source, target, _, _ = _problem(5)
    if mirror:
        target = target * [1, 1, -1]
    weights = jnp.asarray(np.random.default_rng(0).uniform(0.1, 1, 20))
    direction = np.random.default_rng(1).normal(size=source.shape)

    def solve(step):
        return procrustes(jnp.asarray(source + step * direction), jnp.asarray(target), weights)

    _, tangent = jax.jvp(
        lambda s: procrustes(s, jnp.asarray(target), weights), (jnp.asarray(source),), (jnp.asarray(direction),)
    )
    difference = jax.tree.map(lambda a, b: (a - b) / 2e-6, solve(1e-6), solve(-1e-6))
    _close(tangent, difference, atol=1e-7)


def _products(jaxpr):
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for value in equation.params.values():
            for inner in value if isinstance(value, (list, tuple)) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _products(inner)


def test_procrustes_multiplies_at_the_highest_precision_only():
    """At the default precision a GPU would use TF32, which keeps ten bits of a coordinate."""
    highest = jax.lax.Precision.HIGHEST
    traced = jax.make_jaxpr(procrustes)(jnp.ones((5, 3)), jnp.ones((5, 3)), jnp.ones(5))
    precisions = list(_products(traced.jaxpr))
    assert precisions
    assert all(p in (highest, (highest, highest)) for p in precisions)
