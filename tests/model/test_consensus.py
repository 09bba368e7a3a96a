"""Consensus: the transform on which landmarks agree, however many of them are misplaced."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.model.consensus import align_landmarks, even_seeds, hypotheses


@functools.partial(jax.jit, static_argnames=("rounds", "hypotheses"))
def _align(source, target, weights, *, rounds, hypotheses=0):
    seeds = even_seeds([len(weights)], hypotheses)
    return align_landmarks(source, target, weights, rounds=rounds, seeds=seeds)


def _close(first, second, atol=1e-5):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), first, second)


def _landmarks(seed: int = 0) -> jnp.ndarray:
    return jnp.asarray(np.random.default_rng(seed).normal(size=(20, 3)), jnp.float32)


def _weights() -> jnp.ndarray:
    return jnp.asarray(np.random.default_rng(9).uniform(0.2, 1, 20), jnp.float32)


@pytest.mark.parametrize(("rounds", "hypotheses"), [(0, 0), (3, 0), (3, 8)])
def test_matching_landmarks_give_their_motion(pose, rounds, hypotheses):
    source = _landmarks()
    found = _align(source, source @ pose[0].T + pose[1], _weights(), rounds=rounds, hypotheses=hypotheses)
    _close(found, rigid.Rigid(pose[0], pose[1]), atol=1e-3)


@pytest.mark.parametrize(("rounds", "hypotheses"), [(0, 0), (3, 0), (3, 8)])
def test_landmarks_without_weight_do_not_count(pose, rounds, hypotheses):
    source, weights = _landmarks(), _weights().at[3].set(0.0)
    target = source @ pose[0].T + pose[1]
    found = _align(source, target.at[3].add(7.0), weights, rounds=rounds, hypotheses=hypotheses)
    _close(found, _align(source, target, weights, rounds=rounds, hypotheses=hypotheses))


def test_landmarks_that_disagree_lose_their_weight(pose):
    source = _landmarks()
    target = (source @ pose[0].T + pose[1]).at[:6].set(_landmarks(5)[:6])
    truth = jnp.asarray(pose[0], jnp.float32)
    errors = [
        float(rigid.rotation_angle(_align(source, target, _weights(), rounds=k).rotation, truth)) for k in (0, 3, 8)
    ]
    assert errors[0] > 0.1
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 2e-3


def test_noise_leaves_the_weight_to_many_landmarks(pose):
    """Weights that multiply over the rounds end with three landmarks, and with many times the error."""
    truth, errors = jnp.asarray(pose[0], jnp.float32), []
    for seed in range(10):
        source = _landmarks(seed)
        target = source @ pose[0].T + pose[1] + 0.05 * _landmarks(seed + 100)
        found = [_align(source, target, _weights(), rounds=k).rotation for k in (0, 40)]
        errors.append([float(rigid.rotation_angle(rotation, truth)) for rotation in found])
    plain, agreed = np.mean(errors, axis=0)
    assert agreed < 3 * plain


@pytest.mark.parametrize("hypotheses", [0, 8])
def test_landmarks_in_one_place_turn_nothing(hypotheses):
    """Rounding alone would otherwise choose the rotation."""
    source, target = (jnp.ones((20, 3)) + 1e-6 * _landmarks(k) for k in (1, 2))
    found = _align(source, target, _weights(), rounds=3, hypotheses=hypotheses)
    _close(found.rotation, jnp.eye(3), atol=1e-5)


@pytest.mark.parametrize("hypotheses", [0, 8])
def test_landmarks_that_weigh_nothing_move_nothing(hypotheses):
    found = _align(_landmarks(1), _landmarks(2), jnp.zeros(20), rounds=3, hypotheses=hypotheses)
    _close(found, rigid.identity())


def _misplaced(pose, seed: int, share: float, count: int = 200) -> tuple[jnp.ndarray, jnp.ndarray, jnp.ndarray]:
    """Landmarks in both clouds, of which a share is anywhere in the target, and how much each counts."""
    random = np.random.default_rng(seed)
    source = random.normal(size=(count, 3)) / 2
    target = source @ pose[0].T + pose[1] + 0.005 * random.normal(size=(count, 3))
    wrong = random.random(count) < share
    target[wrong] = random.normal(size=(wrong.sum(), 3)) / 2
    return tuple(jnp.asarray(each, jnp.float32) for each in (source, target, random.uniform(0.2, 1, count)))


def _error(found, pose) -> float:
    return float(jnp.rad2deg(rigid.rotation_angle(found.rotation, jnp.asarray(pose[0], jnp.float32))))


def _mistaken(pose, seed: int) -> tuple[jnp.ndarray, jnp.ndarray, jnp.ndarray]:
    """Landmarks of which six in ten take the shape for itself turned by 90 degrees, and are scattered about it."""
    random = np.random.default_rng(seed)
    source = random.normal(size=(200, 3)) / 2
    turned = source @ Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix().T + 0.1 * random.normal(size=(200, 3))
    target = np.where(random.random((200, 1)) < 0.6, turned, source) @ pose[0].T + pose[1]
    target += 0.005 * random.normal(size=(200, 3))
    return tuple(jnp.asarray(each, jnp.float32) for each in (source, target, random.uniform(0.2, 1, 200)))


def test_hypotheses_find_the_few_that_agree_exactly(pose):
    """Rounds that start from the given weights follow the many that agree roughly."""
    alone, with_hypotheses = (
        [_error(_align(*_mistaken(pose, seed), rounds=12, hypotheses=k), pose) for seed in range(10)] for k in (0, 64)
    )
    assert np.median(alone) > 80
    assert max(with_hypotheses) < 0.5


def test_a_hypothesis_that_hardly_anything_speaks_for_is_one():
    """Weights are shares of what counts, however little that is."""
    source, target, weights = _mistaken((np.eye(3), np.zeros(3)), 1)
    turn = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    for size in (1.0, 1e-12):
        found = _align(source, target @ turn.T, size * weights, rounds=12, hypotheses=64)
        assert _error(found, (turn, np.zeros(3))) < 0.5


def test_hypotheses_do_not_replace_what_is_given_where_nothing_is_misplaced(pose):
    """The given weights are one of the hypotheses, and the end of the rounds is the same."""
    landmarks = _misplaced(pose, 0, 0.0)
    plain, started = (_align(*landmarks, rounds=30, hypotheses=k) for k in (0, 64))
    _close(plain, started, atol=1e-4)


def test_landmarks_without_a_place_of_their_own_do_not_decide(pose):
    """Soft choices that could not decide lie in the middle of both clouds, all at the same distances."""
    source, target, weights = _misplaced(pose, 1, 0.0)
    blurred = jnp.arange(len(weights)) % 10 < 6
    middle, other = 0.01 * _misplaced(pose, 2, 0.0)[0], 0.01 * _misplaced(pose, 3, 0.0)[0]
    source, target = jnp.where(blurred[:, None], middle, source), jnp.where(blurred[:, None], other, target)
    assert _error(_align(source, target, weights, rounds=12, hypotheses=64), pose) < 1


def test_swapped_landmarks_give_the_inverse(pose):
    source, target, weights = _misplaced(pose, 4, 0.6)
    forth, back = (_align(*pair, weights, rounds=12, hypotheses=64) for pair in ((source, target), (target, source)))
    _close(forth, rigid.inverse(back), atol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_landmarks_than_hypotheses(count):
    source = _landmarks(6)[:count]
    found = _align(source, source + 0.3, jnp.ones(count), rounds=3, hypotheses=64)
    _close(rigid.apply(found, source), source + 0.3, atol=1e-5)


def test_derivatives_are_those_of_the_rounds(pose):
    """Where the rounds have settled, where they started has no part in the derivative."""
    source, target, weights = _misplaced(pose, 5, 0.3)

    def height(shift, hypotheses):
        seeds = even_seeds([len(weights)], hypotheses)
        return align_landmarks(source, target + shift * source**2, weights, rounds=40, seeds=seeds)[1][2]

    slope, plain = (float(jax.jit(jax.grad(height), static_argnums=1)(0.0, k)) for k in (64, 0))
    assert np.isfinite(slope)
    assert slope == pytest.approx(plain, rel=1e-2)


def test_derivatives_at_coinciding_landmarks_are_finite():
    same = jnp.zeros((20, 3)).at[0].set(1.0)
    seeds = even_seeds([20], 8)

    def total(places):
        return jnp.sum(align_landmarks(places, same, _weights(), rounds=3, seeds=seeds)[1])

    slopes = jax.jit(jax.grad(total))(same)
    assert np.all(np.isfinite(slopes))


def test_derivatives_are_finite_where_nothing_speaks_for_any_hypothesis():
    """The landmarks of an empty cloud lie in one place: weights of hypotheses are then as good as zero, not zero."""

    def total(source, target, weights):
        seeds = even_seeds([20], 8)
        found = align_landmarks(source, target, weights, rounds=3, seeds=seeds)
        return jnp.sum(found.rotation * jnp.arange(9.0).reshape(3, 3)) + jnp.sum(found.translation)

    slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(jnp.zeros((20, 3)), _landmarks(), _weights())
    assert all(np.all(np.isfinite(slope)) for slope in slopes)


def test_seeds_are_spread_evenly_and_as_many_of_swapped_groups():
    seeds = even_seeds([64, 256, 256], 64)
    groups = np.searchsorted([64, 320], seeds, side="right")
    np.testing.assert_array_equal(np.bincount(groups), [8, 29, 29])
    np.testing.assert_array_equal(seeds[groups == 1] - 64, seeds[groups == 2] - 320)
    assert np.diff(seeds[groups == 1]).max() <= 9


def test_few_landmarks_are_all_seeds():
    np.testing.assert_array_equal(even_seeds([3, 0, 2], 64), np.arange(5))


@pytest.mark.parametrize("groups", [[], [0, 0], [7]])
def test_no_seeds(groups):
    assert len(even_seeds(groups or [0], 0)) == 0


_every = np.arange(20)
_say = jax.jit(lambda source, target, weights: hypotheses(source, target, weights, _every))


def test_every_hypothesis_of_matching_landmarks_is_their_motion(pose):
    source = _landmarks()
    found = _say(source, source @ pose[0].T + pose[1], _weights())
    _close(found, jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (20, *leaf.shape)), rigid.Rigid(*pose)), atol=1e-3)


def test_two_motions_at_once_have_a_hypothesis_each(pose):
    """Consensus has to choose; hypotheses leave the choice to others."""
    source, truth = _landmarks(), jnp.asarray(pose[0], jnp.float32)
    other = jnp.asarray(Rotation.from_rotvec([0.4, -1.5, 1.0]).as_matrix(), jnp.float32)
    target = jnp.concatenate([source[:10] @ truth.T, source[10:] @ other.T + 0.3])
    rotations = _say(source, target, _weights()).rotation
    for rows, expected in ((slice(0, 10), truth), (slice(10, 20), other)):
        errors = jax.vmap(lambda rotation, expected=expected: rigid.rotation_angle(rotation, expected))(rotations[rows])
        assert float(jnp.min(errors)) < 1e-2
        assert float(jnp.median(errors)) < 0.1


def test_swapped_clouds_have_the_inverse_hypotheses(pose):
    source = _landmarks()
    target = source @ pose[0].T + pose[1] + 0.05 * _landmarks(7)
    back = jax.vmap(rigid.inverse)(_say(target, source, _weights()))
    _close(back, _say(source, target, _weights()), atol=1e-4)


@pytest.mark.parametrize("weights", [np.zeros(20), np.eye(20)[3]], ids=["none", "of one landmark"])
def test_hypotheses_without_weight_are_rigid(weights):
    found = _say(_landmarks(1), _landmarks(2), jnp.asarray(weights, jnp.float32))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in found)
    turned = jnp.einsum("sij,skj->sik", found.rotation, found.rotation)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-4)


def test_without_seeds_there_are_no_hypotheses():
    found = jax.eval_shape(hypotheses, _landmarks(1), _landmarks(2), _weights(), np.zeros(0, int))
    assert found.rotation.shape == (0, 3, 3)
