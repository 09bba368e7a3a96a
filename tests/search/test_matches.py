"""Matched features and the poses they agree on: by hand, with wrong matches, and with too few."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.clouds import make_cloud
from urrt_jax.search.matches import Matches, match_most_similar, poses_from_matches

_COUNT = 100
_ALL = np.ones(_COUNT, bool)


@jax.jit
def _poses(source, target, row, mutual, distance=0.05):
    clouds = make_cloud(source), make_cloud(target)
    return poses_from_matches(*clouds, Matches(row, mutual), distance, seeds=8, count=8, support=8)


def _problem(seed: int, wrong: int, noise: float = 0.0):
    """A cloud, the same one moved, matches of which so many are wrong, and the pose."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(_COUNT, 3)).astype(np.float32)
    rotation, translation = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    target = (source @ rotation.T + translation + noise * rng.normal(size=source.shape)).astype(np.float32)
    shuffled = rng.permutation(_COUNT)
    row = np.argsort(shuffled)
    some = rng.permutation(_COUNT)[:wrong]
    row[some] = (row[some] + rng.integers(1, _COUNT, wrong)) % _COUNT
    return source, target[shuffled], row, rotation, translation


def _match(source, target, source_mask=None, target_mask=None) -> Matches:
    source, target = jnp.asarray(source, jnp.float32), jnp.asarray(target, jnp.float32)
    masks = [
        jnp.ones(len(features), bool) if mask is None else jnp.asarray(mask, bool)
        for features, mask in ((source, source_mask), (target, target_mask))
    ]
    return match_most_similar(source @ target.T, *masks)


def test_match_is_the_most_similar_feature():
    found = _match([[1, 0], [0, 1], [0.8, 0.6]], [[0, 1], [1, 0]])
    assert found.row.tolist() == [1, 0, 1]


def test_match_is_mutual_only_where_both_prefer_each_other():
    found = _match([[1, 0], [0, 1], [0.8, 0.6]], [[0, 1], [1, 0]])
    assert found.mutual.tolist() == [True, True, False]


def test_a_target_is_mutual_with_one_source_at_most():
    features = np.random.default_rng(0).normal(size=(50, 4))
    found = _match(features, features[:20] + 0.1)
    chosen = np.asarray(found.row)[np.asarray(found.mutual)]
    assert len(set(chosen.tolist())) == len(chosen) > 0


def test_equal_features_give_one_mutual_match():
    assert int(_match(np.ones((5, 3)), np.ones((4, 3))).mutual.sum()) == 1


def test_mutual_matches_do_not_depend_on_which_cloud_is_the_source():
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(30, 5)), rng.normal(size=(40, 5))
    forth, back = _match(source, target), _match(target, source)
    pairs = [(i, int(forth.row[i])) for i in np.flatnonzero(forth.mutual)]
    assert pairs == sorted((int(back.row[j]), int(j)) for j in np.flatnonzero(back.mutual))


def test_a_masked_source_is_not_mutual():
    found = _match(np.eye(3), np.eye(3), source_mask=[True, False, True])
    assert found.mutual.tolist() == [True, False, True]


def test_a_masked_source_does_not_take_a_match_from_another():
    found = _match([[1, 0], [0.9, 0.1]], [[1, 0]], source_mask=[False, True])
    assert found.mutual.tolist() == [False, True]


def test_a_masked_target_is_no_match():
    found = _match([[1, 0], [0, 1]], [[1, 0], [0, 1], [0.9, 0.1]], target_mask=[False, True, True])
    assert found.row.tolist() == [2, 1]


def test_a_masked_target_is_no_match_though_all_others_are_opposite():
    """Zeros of padding are more similar than what points the other way."""
    found = _match([[1, 0]], [[0, 0], [-1, 0]], target_mask=[False, True])
    assert (found.row.tolist(), found.mutual.tolist()) == ([1], [True])


@pytest.mark.parametrize("empty", ["source", "target", "both"])
def test_an_empty_cloud_has_no_mutual_match(empty):
    nothing = np.zeros(4, bool)
    masks = [nothing if empty in (name, "both") else None for name in ("source", "target")]
    assert not bool(_match(np.eye(4), np.eye(4), *masks).mutual.any())


@pytest.mark.parametrize("seed", range(6))
def test_pose_is_exact_with_forty_percent_wrong_matches(seed):
    source, target, row, rotation, translation = _problem(seed, wrong=40)
    found = _poses(source, target, row, _ALL)
    np.testing.assert_allclose(found.rotation[0], rotation, atol=1e-5)
    np.testing.assert_allclose(found.translation[0], translation, atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_pose_is_near_with_seventy_percent_wrong_matches_and_noise(seed):
    source, target, row, rotation, _ = _problem(seed, wrong=70, noise=0.01)
    found = _poses(source, target, row, _ALL)
    apart = Rotation.from_matrix(np.asarray(found.rotation[0], np.float64) @ rotation.T).magnitude()
    assert np.rad2deg(apart) < 2


def test_matches_that_are_not_mutual_are_left_out():
    source, target, row, rotation, _ = _problem(0, wrong=0)
    row[:80] = np.roll(row[:80], 1)
    found = _poses(source, target, row, np.arange(_COUNT) >= 80)
    np.testing.assert_allclose(found.rotation, np.tile(rotation, (8, 1, 1)), atol=1e-5)


def test_matches_that_are_not_mutual_are_left_out_though_they_agree():
    """A second motion that more matches follow, none of which may vote."""
    source, target, row, rotation, _ = _problem(0, wrong=0)
    target[row[:70]] = source[:70]
    found = _poses(source, target, row, np.arange(_COUNT) >= 70)
    np.testing.assert_allclose(found.rotation[0], rotation, atol=1e-5)


def test_matches_that_are_not_mutual_are_left_out_though_they_are_near():
    source, target, row, rotation, _ = _problem(0, wrong=0)
    skewed = source[:80] @ np.array([[0, 0.01, 0], [0, 0, 0.01], [0, 0, 0]]) @ rotation.T
    target[row[:80]] += skewed.astype(np.float32)
    found = _poses(source, target, row, np.arange(_COUNT) >= 80)
    np.testing.assert_allclose(found.rotation, np.tile(rotation, (8, 1, 1)), atol=1e-5)


def test_the_motion_that_most_matches_follow_comes_first():
    source, target, row, rotation, _ = _problem(0, wrong=0)
    target[row[:30]] = source[:30]
    np.testing.assert_allclose(_poses(source, target, row, _ALL).rotation[0], rotation, atol=1e-5)


def test_poses_are_the_same_every_time():
    problem = _problem(3, wrong=60, noise=0.02)[:3]
    first, second = _poses(*problem, _ALL), _poses(*problem, _ALL)
    np.testing.assert_array_equal(first.rotation, second.rotation)
    np.testing.assert_array_equal(first.translation, second.translation)


def test_order_of_matches_does_not_change_the_best_pose():
    source, target, row = _problem(3, wrong=40)[:3]
    order = np.random.default_rng(0).permutation(_COUNT)
    np.testing.assert_allclose(
        _poses(source[order], target, row[order], _ALL).rotation[0],
        _poses(source, target, row, _ALL).rotation[0],
        atol=1e-5,
    )


_TURN = Rotation.from_rotvec([0.4, 2.0, -1.0]).as_matrix().astype(np.float32)
_OFFSET = np.array([2.0, -1.0, 3.0], np.float32)


def test_moving_the_target_moves_the_pose():
    source, target, row, rotation, translation = _problem(1, wrong=40)
    found = _poses(source, target @ _TURN.T + _OFFSET, row, _ALL)
    np.testing.assert_allclose(found.rotation[0], _TURN @ rotation, atol=1e-5)
    np.testing.assert_allclose(found.translation[0], _TURN @ translation + _OFFSET, atol=1e-5)


def test_moving_the_source_moves_the_pose_back():
    source, target, row, rotation, translation = _problem(1, wrong=40)
    found = _poses(source @ _TURN.T + _OFFSET, target, row, _ALL)
    np.testing.assert_allclose(found.rotation[0], rotation @ _TURN.T, atol=1e-5)
    np.testing.assert_allclose(found.translation[0], translation - rotation @ _TURN.T @ _OFFSET, atol=2e-5)


def test_common_scale_scales_the_translation_alone():
    source, target, row, rotation, translation = _problem(1, wrong=40)
    found = _poses(source * 50, target * 50, row, _ALL, 0.05 * 50)
    np.testing.assert_allclose(found.rotation[0], rotation, atol=1e-5)
    np.testing.assert_allclose(found.translation[0] / 50, translation, atol=1e-5)


def _assert_rigid(found) -> None:
    gram = found.rotation @ jnp.swapaxes(found.rotation, -1, -2)
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (8, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1, atol=1e-5)
    assert bool(jnp.all(jnp.isfinite(found.translation)))


@pytest.mark.parametrize("true", [0, 1, 2])
def test_poses_from_fewer_than_three_matches_are_rigid(true):
    source, target, row, _, _ = _problem(0, wrong=0)
    _assert_rigid(_poses(source, target, row, np.arange(_COUNT) < true))


@pytest.mark.parametrize("true", [0, 2])
def test_poses_from_wrong_matches_are_rigid(true):
    source, target, row, _, _ = _problem(0, wrong=_COUNT - true)
    _assert_rigid(_poses(source, target, row, _ALL))


@pytest.mark.parametrize("shape", ["line", "coincident"])
def test_poses_of_degenerate_clouds_are_rigid(shape):
    along = np.linspace(-1, 1, _COUNT) if shape == "line" else np.ones(_COUNT)
    points = np.outer(along, [0.3, -0.5, 0.8]).astype(np.float32)
    _assert_rigid(_poses(points, points @ _TURN.T, np.arange(_COUNT), _ALL))


def test_pose_of_three_points_is_exact():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(3, 3)).astype(np.float32)
    target = source @ _TURN.T + _OFFSET
    matches = Matches(jnp.arange(3), jnp.ones(3, bool))
    found = poses_from_matches(make_cloud(source), make_cloud(target), matches, 0.05, seeds=1, count=1, support=3)
    np.testing.assert_allclose(found.rotation[0], _TURN, atol=1e-5)


def _two_motions(second: np.ndarray, shift: float) -> tuple:
    """Matches of which the first 60 follow one motion and the other 40 a second one."""
    source, target, row, rotation, translation = _problem(0, wrong=0)
    target[row[60:]] = source[60:] @ (second @ rotation).T.astype(np.float32) + translation + np.float32(shift)
    return source, target.astype(np.float32), row, rotation, second @ rotation


@pytest.mark.parametrize(("degrees", "shift"), [(90.0, 0.0), (30.0, 0.0), (0.0, 1.0)])
def test_hypotheses_are_all_motions_that_matches_follow_and_each_one_once(degrees, shift):
    second = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(degrees)]).as_matrix()
    source, target, row, *rotations = _two_motions(second, shift)
    clouds = make_cloud(source), make_cloud(target)
    found = poses_from_matches(*clouds, Matches(row, jnp.asarray(_ALL)), 0.05, seeds=_COUNT, count=2, support=8)
    np.testing.assert_allclose(found.rotation, rotations, atol=1e-4)


def test_where_matches_follow_one_motion_all_hypotheses_are_that_one():
    source, target, row, rotation, _ = _problem(0, wrong=0)
    clouds = make_cloud(source), make_cloud(target)
    found = poses_from_matches(*clouds, Matches(row, jnp.asarray(_ALL)), 0.05, seeds=_COUNT, count=4, support=8)
    np.testing.assert_allclose(found.rotation, np.tile(rotation, (4, 1, 1)), atol=1e-4)


def test_vmap_agrees_with_a_loop():
    problems = [_problem(seed, wrong=40)[:3] for seed in range(3)]
    together = jax.vmap(lambda s, t, r: _poses(s, t, r, _ALL))(*(np.stack(x) for x in zip(*problems, strict=True)))
    alone = np.stack([_poses(*problem, _ALL).rotation for problem in problems])
    np.testing.assert_allclose(together.rotation[:, 0], alone[:, 0], atol=1e-5)
