"""DeepGMR: equal points are assigned equally, whatever the pose, so clean pairs are exact before any training."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, centroid, make_cloud
from urrt_jax.data.procedural import procedural_shapes
from urrt_jax.peers.learned.deepgmr import DeepGMR, align, mixture
from urrt_jax.peers.learned.invariants import centred_features
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair, PairConfig, make_batch
from urrt_jax.training.trainable import PAIRS

_NETWORK = DeepGMR(local_widths=(16,), global_widths=(16, 32), head_widths=(16,), components=8, neighbors=6)
_KEY = jax.random.key(0)
_estimate = jax.jit(_NETWORK.estimate)
_assignments = jax.jit(_NETWORK.assignments)
_features = jax.jit(centred_features, static_argnums=2)
pytestmark = pytest.mark.usefixtures("x64")


@jax.jit
@jax.value_and_grad
def _loss(params, batch_stats, pairs):
    """The mean loss of a batch, and its derivatives."""
    of_pair = functools.partial(_NETWORK.loss, {"params": params, "batch_stats": batch_stats})
    losses, _, _ = jax.vmap(of_pair, (0, None), axis_name=PAIRS, out_axes=(0, 0, None))(pairs, _KEY)
    return jnp.mean(losses)


@pytest.fixture(scope="module")
def variables():
    return _double(jax.jit(_NETWORK.init)(_KEY))


@pytest.fixture(scope="module")
def cloud(cloud):
    """60 points of a shape without any symmetry."""
    return cloud[:60]


@pytest.fixture(scope="module")
def pairs():
    """Three pairs of 60 points: noisy, because the loss of clean pairs is zero from the start."""
    shapes = {"points": jnp.asarray(procedural_shapes(4, points=60).points)}
    config = PairConfig(points=60, noise=0.05, keep=0.9, outliers=0.0)
    return _double(jax.jit(make_batch, static_argnums=(2, 3))(jax.random.key(1), shapes, config, 3, 1.0))


def _turned(cloud, degrees):
    """A cloud in double precision, a copy that is turned and moved, and the pose between them."""
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    pose = Rigid(
        jnp.asarray(Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()),
        jnp.array([0.2, -0.1, 0.3]),
    )
    source = jnp.asarray(cloud, jnp.float64)
    return make_cloud(source), make_cloud(rigid.apply(pose, source)), pose


def _double(tree):
    with jax.enable_x64(True):
        return jax.tree.map(lambda each: each.astype(jnp.float64) if each.dtype == jnp.float32 else each, tree)


def _at(index, tree):
    return jax.tree.map(lambda each: each[index], tree)


def _assert_same(found, expected, atol):
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


def test_features_do_not_change_with_the_rotation(cloud):
    source, target, _ = _turned(cloud, 130)
    first, second = (_features(each.points - centroid(each), each.mask, 6) for each in (source, target))
    np.testing.assert_allclose(first, second, atol=1e-8)


def test_features_tell_a_cloud_from_its_mirror_image(cloud):
    points = jnp.asarray(cloud - cloud.mean(axis=0), jnp.float64)
    every = jnp.ones(len(cloud), bool)
    mirrored = points * jnp.array([-1.0, 1.0, 1.0])
    assert np.abs(_features(points, every, 6) - _features(mirrored, every, 6)).max() > 0.1


def test_features_of_a_neighbour_are_those_worked_out_by_hand():
    """p = z, with neighbours at 90° to each other about the z axis, in this order of distance: x + z, 2y + z."""
    points = jnp.array([[0.0, 0, 1], [1, 0, 1], [0, 2, 1]])
    found = _features(points, jnp.ones(3, bool), 2)[0]
    expected = [1, np.sqrt(2), np.pi / 4, np.pi / 2, np.sqrt(5), np.arctan(2), 3 * np.pi / 2]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("degrees", [5, 60, 179])
def test_turned_cloud_has_the_same_assignments(variables, cloud, degrees):
    source, target, _ = _turned(cloud, degrees)
    first, second = _assignments(variables, source, target)
    np.testing.assert_allclose(first, second, atol=1e-8)


@pytest.mark.parametrize("degrees", [0, 5, 60, 179])
def test_clean_pair_is_exact_with_random_weights(variables, cloud, degrees):
    source, target, pose = _turned(cloud, degrees)
    _assert_same(_estimate(variables, source, target, _KEY), pose, atol=1e-6)


def test_clean_pair_of_differently_ordered_clouds_is_exact(variables, cloud):
    source, target, pose = _turned(cloud, 60)
    target = make_cloud(target.points[np.random.default_rng(0).permutation(len(cloud))])
    _assert_same(_estimate(variables, source, target, _KEY), pose, atol=1e-6)


def test_padding_changes_nothing(variables, pairs):
    pair = _at(0, pairs)
    padded = [
        Cloud(jnp.pad(cloud.points, ((0, more), (0, 0))), jnp.pad(cloud.mask, (0, more)))
        for cloud, more in ((pair.source, 7), (pair.target, 12))
    ]
    expected = _estimate(variables, pair.source, pair.target, _KEY)
    _assert_same(_estimate(variables, *padded, _KEY), expected, atol=1e-8)


def test_cloud_with_fewer_points_than_neighbours_gives_a_finite_pose(variables):
    points = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    found = _estimate(variables, make_cloud(points), make_cloud(points + 1), _KEY)
    assert all(np.isfinite(each).all() for each in found)


def test_assignments_are_shares(variables, cloud):
    shares, _ = _assignments(variables, make_cloud(cloud), make_cloud(cloud))
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-5)


def test_hard_assignments_give_the_means_and_variances_of_their_points():
    rng = np.random.default_rng(0)
    points, labels = rng.normal(size=(30, 3)).astype(np.float32), np.arange(30) % 2
    cloud = Cloud(jnp.asarray(points).at[25:].set(0.0), jnp.arange(30) < 25)
    found = mixture(cloud, jax.nn.one_hot(labels, 2))
    parts = [points[:25][labels[:25] == label] for label in (0, 1)]
    np.testing.assert_allclose(found.weights, [13 / 25, 12 / 25], rtol=1e-6)
    np.testing.assert_allclose(found.means, [part.mean(axis=0) for part in parts], atol=1e-6)
    np.testing.assert_allclose(found.variances, [part.var(axis=0).mean() for part in parts], rtol=1e-5)


def test_empty_component_does_not_move_the_pose(cloud):
    source, target, pose = _turned(cloud, 30)
    shares = jax.nn.one_hot(np.arange(len(cloud)) % 5, 6)
    _assert_same(align(mixture(source, shares), mixture(target, shares)), pose, atol=1e-4)


def test_derivative_agrees_with_finite_differences_along_a_direction(variables, pairs):
    params, stats = variables["params"], variables["batch_stats"]
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), params)

    def along(step):
        return _loss(jax.tree.map(lambda leaf, way: leaf + step * way, params, direction), stats, pairs)[0]

    derivatives = jax.tree.map(lambda each, way: jnp.sum(each * way), _loss(params, stats, pairs)[1], direction)
    step = 1e-6
    expected = (along(step) - along(-step)) / (2 * step)
    np.testing.assert_allclose(sum(jax.tree.leaves(derivatives)), expected, rtol=1e-4)


def test_loss_of_clean_pairs_is_nearly_zero_without_training(variables, cloud):
    source, target, pose = _turned(cloud, 60)
    pairs = jax.tree.map(lambda each: jnp.stack([each] * 3), Pair(source, target, source, target, pose))
    assert float(_loss(variables["params"], variables["batch_stats"], pairs)[0]) < 1e-10


def test_published_network_has_about_a_million_parameters():
    params = jax.eval_shape(DeepGMR().init, _KEY)["params"]
    assert 0.8e6 < sum(leaf.size for leaf in jax.tree.leaves(params)) < 2e6
