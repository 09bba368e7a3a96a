"""Decoding: what one application of the decoders must give, whatever their parameters."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from urrt_jax import frames, rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.model import estimate, init_model
from urrt_jax.model.decoder import fusion_weights
from urrt_jax.model.landmarks import (
    landmark_decoders,
    lookup_weights,
    place_landmarks,
    point_trust,
    region_queries,
)
from urrt_jax.model.pose import fuse_poses

_estimate = jax.jit(estimate)
_normalize_pair = jax.jit(frames.normalize_pair)


def _close(first, second, atol=1e-5):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), first, second)


@pytest.fixture(scope="module", params=["A", "C"])
def one_step(request, small_config, make_model):
    """A function of the key: a network of one step with perturbed parameters."""
    config = dataclasses.replace(small_config, variant=request.param, steps=1)
    return lambda seed: make_model(config, seed)


@pytest.fixture(scope="module")
def turned(cloud, pose):
    """Two clouds of 60 points, the second one turned."""
    return cloud[:60].astype(np.float64), cloud[60:120] @ pose[0].T


def _shapes() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "blob": rng.normal(size=(40, 3)),
        "line": np.outer(np.linspace(-1, 1, 40), [1.0, 2, 3]),
        "one point repeated": np.ones((40, 3)),
        "two points": np.repeat(np.eye(3)[:2], 20, axis=0),
        "box": np.stack(np.meshgrid([-1.0, 1], [-2.0, -1, 1, 2], [-2.0, -1, 0, 1, 2]), -1).reshape(-1, 3),
    }


@pytest.mark.parametrize("name", _shapes())
@pytest.mark.parametrize("seed", [0, 1])
def test_aligned_clouds_stay_where_they_are(one_step, name, seed):
    """Whatever the parameters: equal clouds have equal landmarks, so the truth is a fixed point."""
    points = _shapes()[name].astype(np.float32)
    source, target, _ = _normalize_pair(make_cloud(points), make_cloud(points[::-1].copy()))
    _close(_estimate(one_step(seed), source, target).transform, rigid.identity(), atol=1e-4)


def test_swapped_clouds_give_the_inverse(one_step, turned, x64):
    source, target, _ = _normalize_pair(*map(make_cloud, turned))
    there, back = (_estimate(one_step(0), *pair).transform for pair in ((source, target), (target, source)))
    assert float(rigid.rotation_angle(there.rotation, jnp.eye(3))) > 0.01
    _close(rigid.compose(there, back), rigid.identity(), atol=1e-9)


@pytest.fixture(scope="module")
def place():
    """A function of (points, mask, shift of all keys): landmarks under fixed random queries and keys."""
    queries, keys = jax.random.split(jax.random.key(0))
    queries, keys = jax.random.normal(queries, (20, 8)), 3 * jax.random.normal(keys, (60, 8))
    return jax.jit(lambda p, m, k=0.0: place_landmarks(queries, keys + k, make_cloud(p, m)))


def test_landmarks_lie_among_the_points_and_apart(place, cloud):
    mask = np.arange(60) < 40
    places = np.asarray(place(cloud[:60], mask))
    assert np.all(places >= cloud[:40].min(0) - 1e-6)
    assert np.all(places <= cloud[:40].max(0) + 1e-6)
    assert np.min(places.std(axis=0)) > 0.05


def test_landmarks_do_not_see_padding(place, cloud):
    mask = np.arange(60) < 40
    other = np.where(mask[:, None], cloud[:60], np.float32(9))
    np.testing.assert_array_equal(place(other, mask), place(cloud[:60], mask))


def test_keys_of_padding_choose_nothing(cloud):
    """However large: the largest logit, which all are compared with, is a real point's."""
    queries, keys = (jax.random.normal(jax.random.key(k), (60, 8)) for k in (0, 1))
    mask = np.arange(60) < 40
    loud = jnp.where(mask[:, None], keys, 1e4 * keys)
    found = [place_landmarks(queries, each, make_cloud(cloud[:60], mask)) for each in (keys, loud)]
    np.testing.assert_array_equal(*found)


def test_landmarks_move_with_points_whose_keys_stay(place, cloud, pose):
    mask = np.ones(60, bool)
    moved = place((cloud[:60] @ pose[0].T + pose[1]).astype(np.float32), mask)
    np.testing.assert_allclose(moved, place(cloud[:60], mask) @ pose[0].T + pose[1], atol=1e-5)


def test_what_all_keys_share_moves_no_landmark(place, cloud):
    mask = np.arange(60) < 40
    np.testing.assert_allclose(place(cloud[:60], mask, 0.7), place(cloud[:60], mask), atol=1e-4)


def test_landmarks_of_no_point_are_finite(place, cloud):
    assert bool(jnp.all(jnp.isfinite(place(cloud[:60], np.zeros(60, bool)))))


def test_both_clouds_are_asked_for_the_same_surroundings(small_config):
    """Only where a landmark lies may be asked differently: surroundings look the same from any pose."""
    own, other, key = jax.random.split(jax.random.key(0), 3)
    params = landmark_decoders(small_config).init(key, jnp.zeros((4, 32)))["params"]
    features = jax.random.normal(own, (4, 16)), jax.random.normal(other, (4, 16))
    queries = region_queries(small_config, params, *features, jnp.full(4, 0.25))
    width = small_config.key_width
    assert queries.source.shape == (4 * small_config.landmarks, 2 * width)
    np.testing.assert_array_equal(queries.source[:, width:], queries.target[:, width:])
    assert float(jnp.max(jnp.abs(queries.source[:, :width] - queries.target[:, :width]))) > 0.1


def test_padding_that_is_looked_up_weighs_nothing(small_config):
    keys = jax.random.normal(jax.random.key(0), (6, 2 * small_config.key_width))
    params = point_trust().init(jax.random.key(1), keys)["params"]
    weights = lookup_weights(small_config, params, keys, jnp.array([1, 0, 1, 1, 1, 0], bool))
    np.testing.assert_array_equal(weights > 0, [1, 0, 1, 1, 1, 0])


def test_landmarks_of_equal_surroundings_are_matched_from_any_pose(small_config, make_model):
    """With queries from surroundings alone one step is exact, whatever the parameters."""
    model = make_model(dataclasses.replace(small_config, steps=1, points=200), 0)
    decoder = model.params["decoder"]
    for part, layer, factor in (("keys", "Dense_1", 0.0), ("surroundings", "Dense_2", 30.0)):
        decoder[part][layer] = jax.tree.map(lambda leaf, by=factor: by * leaf, decoder[part][layer])
    points = np.random.default_rng(0).normal(size=(200, 3)) * [1.0, 0.7, 0.4]
    turn = Rotation.from_rotvec([0.5, -0.9, 0.4]).as_matrix()
    source, target, _ = _normalize_pair(
        make_cloud(points.astype(np.float32)), make_cloud((points @ turn.T)[::-1].astype(np.float32))
    )
    found = _estimate(model, source, target).transform
    assert float(jnp.rad2deg(rigid.rotation_angle(found.rotation, jnp.asarray(turn, jnp.float32)))) < 2


def test_untrained_pose_decoders_hardly_move_anything(small_config, turned):
    model = init_model(jax.random.key(0), dataclasses.replace(small_config, decoder="pose"))
    source, target, _ = _normalize_pair(*map(make_cloud, turned))
    assert float(rigid.rotation_angle(_estimate(model, source, target).transform.rotation, jnp.eye(3))) < 0.3


def test_fusion_weighs_regions_by_their_points():
    weights = fusion_weights(jnp.array([10.0, 20, 30]), jnp.array([20.0, 20, 0]))
    np.testing.assert_allclose(weights, [30 / 70, 40 / 70, 0], atol=1e-6)


def test_fusion_without_a_shared_region_falls_back_to_counts():
    weights = fusion_weights(jnp.array([10.0, 0]), jnp.array([0.0, 30]))
    np.testing.assert_allclose(weights, [0.25, 0.75], atol=1e-6)


def test_fusion_of_nothing_is_finite():
    np.testing.assert_array_equal(fusion_weights(jnp.zeros(3), jnp.zeros(3)), 0)


@given(st.integers(0, 2**31 - 1))
def test_fused_poses_are_a_rotation(seed):
    rng = np.random.default_rng(seed)
    codes = jnp.asarray(rng.normal(size=(4, 9)), jnp.float32)
    rotation = np.asarray(fuse_poses(codes, jnp.asarray(rng.dirichlet(np.ones(4)), jnp.float32)).rotation)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-4)
    assert np.linalg.det(rotation) > 0


def test_fusion_of_equal_poses_is_that_pose():
    turn = Rotation.from_rotvec([0.3, 0.2, -0.1]).as_matrix()
    code = np.concatenate([turn[:, 0], turn[:, 1], [1, 2, 3]]).astype(np.float32)
    fused = fuse_poses(jnp.tile(code, (3, 1)), jnp.array([0.2, 0.5, 0.3]))
    _close(fused, rigid.Rigid(turn, np.array([1.0, 2, 3])), atol=1e-6)
