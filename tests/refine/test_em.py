"""EM-ICP: what it settles on, what it estimates, its derivatives, and clouds that say nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.prepared import Prepared, Sizes, prepare
from urrt_jax.refine import ICP, Settled, expect
from urrt_jax.refine.em import Match, Side, expected_pose, match
from urrt_jax.refine.solver import move
from urrt_jax.rigid import Rigid

TURN = Rotation.from_euler("zyx", [2, -1, 1.5], degrees=True).as_matrix()
SHIFT = np.array([0.02, -0.01, 0.015])
_ROWS = 160


def _egg(count: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """A sample of a bent ellipsoid that no turn maps to itself, (count, 3), with noise."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points *= np.array([1.0, 0.7, 0.45]) / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] += 0.3 * points[:, 0] ** 2 + 0.2 * points[:, 0] * points[:, 1]
    return points + noise * random.normal(size=points.shape)


def _cloud(points: np.ndarray, rows: int = _ROWS) -> Cloud:
    values = np.zeros((rows, 3))
    values[: len(points)] = points
    return make_cloud(jnp.asarray(values, jnp.result_type(float)), np.arange(rows) < len(points))


_SIZES = Sizes(sample=3, queries=3, normal_radius=3.0)  # EM-ICP asks for neither
_FAR = ICP(iterations=300, tolerance=1e-5)


def _settled(start: Rigid, sparse) -> Settled:
    """What the second stage would hand over."""
    nothing = jnp.zeros(2, start.translation.dtype)
    return Settled(start, nothing[0], jnp.array(True), jnp.array(0), jnp.asarray(sparse), nothing)


def _expected(source: Cloud, target: Cloud, start: Rigid, sparse=True, how: ICP = _FAR) -> Settled:
    return expect(how, prepare(_SIZES, source), prepare(_SIZES, target), _settled(start, sparse))


def _differentiable(source: Cloud, target: Cloud, start: Rigid, how: ICP = _FAR) -> Rigid:
    clouds: tuple[Prepared, Prepared] = prepare(_SIZES, source), prepare(_SIZES, target)
    return expected_pose(how, *clouds, start, expect(how, *clouds, _settled(start, True)))


_expect = jax.jit(_expected)


def _start(degrees: float = 1.0) -> Rigid:
    off = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    dtype = jnp.result_type(float)
    return Rigid(jnp.asarray(off @ TURN, dtype), jnp.asarray(SHIFT, dtype))


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    return _egg(150, 1, 0.01), _egg(160, 2, 0.01) @ TURN.T + SHIFT


@pytest.fixture(scope="module")
def found(pair) -> Settled:
    return _expect(*map(_cloud, pair), _start())


def _degrees(first, second) -> float:
    turn = np.asarray(first, np.float64).T @ np.asarray(second, np.float64)
    return float(np.rad2deg(Rotation.from_matrix(turn).magnitude()))


def test_settles(found):
    assert bool(found.converged)
    assert 3 < int(found.iterations) < 200


def test_comes_nearer_than_it_began():
    errors = []
    for seed in range(5):
        target = _egg(150, 10 * seed + 1, 0.01) @ TURN.T + SHIFT
        found = _expect(_cloud(_egg(150, 10 * seed, 0.01)), _cloud(target), _start(3.0))
        errors.append(_degrees(found.transform.rotation, TURN))
    assert np.mean(errors) < 1.5


def test_does_not_depend_on_where_it_began(pair, found):
    other = _expect(*map(_cloud, pair), _start(-1.0))
    assert _degrees(other.transform.rotation, found.transform.rotation) < 0.1  # the surface itself is of the beginning


def test_clouds_that_are_not_sparse_keep_the_end_of_the_second_stage(pair):
    found = _expect(*map(_cloud, pair), _start(), False)
    assert int(found.iterations) == 0 and bool(found.converged)
    np.testing.assert_array_equal(found.deviations, 0)
    for leaf, given in zip(found.transform, _start(), strict=True):
        np.testing.assert_array_equal(leaf, given)


def test_swapping_the_clouds_inverts_the_transform(pair, found):
    back = _expect(*map(_cloud, reversed(pair)), rigid.inverse(_start()))
    assert _degrees(rigid.inverse(back.transform).rotation, found.transform.rotation) < 1e-2


def test_order_of_points_and_place_of_padding_do_not_matter(pair, found):
    rows = np.random.default_rng(0).permutation(_ROWS)
    clouds = (jax.tree.map(lambda leaf: leaf[rows], _cloud(points)) for points in pair)
    for leaf, expected in zip(_expect(*clouds, _start()).transform, found.transform, strict=True):
        np.testing.assert_allclose(leaf, expected, atol=1e-4)


def test_turning_the_target_turns_the_answer(pair, found):
    turn = Rotation.from_rotvec([1.0, 0.5, -2.0]).as_matrix()
    start = rigid.compose(Rigid(jnp.asarray(turn, jnp.float32), jnp.zeros(3)), _start())
    turned = _expect(_cloud(pair[0]), _cloud(pair[1] @ turn.T), start)
    assert _degrees(turned.transform.rotation, turn @ np.asarray(found.transform.rotation, np.float64)) < 1e-2


def _matched(points: np.ndarray, others: np.ndarray, normals: np.ndarray, deviations) -> Match:
    sides = [Side(_cloud(each), jnp.asarray(np.resize(normals, (_ROWS, 3)), jnp.float32)) for each in (points, others)]
    return jax.jit(match)(*sides, rigid.identity(), jnp.asarray(deviations, jnp.float32))


def test_estimates_how_far_points_lie_along_and_across_the_surface():
    """Points of a plane, each with one partner that is off by known amounts, far from all others."""
    random = np.random.default_rng(0)
    points = np.stack([*np.meshgrid(np.arange(12.0), np.arange(12.0)), np.zeros((12, 12))], -1).reshape(-1, 3)
    off = random.normal(size=points.shape) * [0.05, 0.05, 0.02]
    found = _matched(points, points + off, np.array([0.0, 0.0, 1.0]), (0.2, 0.1))
    expected = [np.sqrt(np.mean(off[:, :2] ** 2)), np.sqrt(np.mean(off[:, 2] ** 2))]
    np.testing.assert_allclose(found.deviations, expected, rtol=0.05)
    assert int(found.paired) == len(points)


def test_points_without_partners_say_nothing():
    points = _egg(100, 0)
    found = _matched(points, points + np.array([0.0, 0.0, 50.0]), np.array([0.0, 0.0, 1.0]), (0.1, 0.05))
    assert int(found.paired) == 0
    np.testing.assert_array_equal(found.gradient, 0.0)
    assert np.isfinite(found.deviations).all()


def test_few_iterations_are_not_called_converged(pair):
    found = _expect(*map(_cloud, pair), _start(), True, ICP(iterations=2, tolerance=1e-5))
    assert int(found.iterations) == 2 and not bool(found.converged)


def test_deviations_across_the_surface_are_those_of_the_noise(found):
    """About 0.01 across, on either side; along it, points of independent samples are as far apart as the spacing."""
    along, across = (float(each) for each in found.deviations)
    assert 0.005 < across < 0.03 < along


def test_derivatives_agree_with_finite_differences(pair, x64):
    """Of the place where everything settles, in either cloud and in the start, which says where the surface is."""
    weights = jnp.asarray(np.random.default_rng(5).normal(size=(3, 4)))
    directions = [np.random.default_rng(7).normal(size=each.shape) for each in pair]
    motion = jnp.asarray(np.random.default_rng(8).normal(size=6))

    def total(steps):
        clouds = map(_cloud, pair)
        moved = [
            cloud._replace(points=cloud.points.at[: len(direction)].add(step * direction))
            for cloud, step, direction in zip(clouds, steps[:2], directions, strict=True)
        ]
        found = _differentiable(*moved, move(steps[2] * motion, _start()), ICP(iterations=300, tolerance=1e-11))
        return jnp.sum(weights * jnp.concatenate([found.rotation, found.translation[:, None]], axis=1))

    both = jax.jit(jax.value_and_grad(total))
    expected = [float(both(step)[0] - both(-step)[0]) / 2e-6 for step in 1e-6 * jnp.eye(3)]
    np.testing.assert_allclose(both(jnp.zeros(3))[1], expected, rtol=2e-3)


_POOR = {
    "empty": np.zeros((0, 3)),
    "one point": np.ones((1, 3)),
    "coincident": np.ones((40, 3)),
    "a line": np.outer(np.linspace(-1, 1, 40), [0.3, -0.5, 0.8]),
    "far away": _egg(40, 0) + 100.0,
}


@pytest.fixture(scope="module")
def gradient_of(pair):
    """A function of a source: the gradient in its points of a pose's sum, and the pose."""

    def total(points, mask):
        found = _differentiable(Cloud(points, mask), _cloud(pair[1]), _start())
        return jnp.sum(found.rotation) + jnp.sum(found.translation), found

    return jax.jit(jax.grad(total, has_aux=True))


@pytest.mark.parametrize("kind", _POOR)
def test_poor_clouds_give_finite_poses_and_derivatives(kind, gradient_of):
    gradient, transform = gradient_of(*_cloud(_POOR[kind]))
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(transform.rotation @ transform.rotation.T, np.eye(3), atol=1e-4)
    assert np.isfinite(transform.translation).all()


def test_vmap_agrees_with_one_by_one(pair, found):
    clouds = [jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), _cloud(points)) for points in pair]
    starts = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), _start())
    together = jax.jit(jax.vmap(_expected))
    many = together(*clouds, starts, jnp.array([True, False, True]))
    np.testing.assert_array_equal(np.asarray(many.iterations) > 0, [True, False, True])
    for row in (0, 2):
        np.testing.assert_allclose(many.transform.rotation[row], found.transform.rotation, atol=1e-5)
