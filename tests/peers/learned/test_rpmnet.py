"""RPM-Net: the published size, and what must not matter (padding, order, batches) does not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.data.procedural import procedural_shapes
from urrt_jax.peers.learned.rpmnet import RPMNet
from urrt_jax.training.pairs import PairConfig, make_batch

_NETWORK = RPMNet(
    widths=(8, 8),
    head_widths=(8, 8),
    annealing_widths=(8, 8),
    annealing_head_widths=(8,),
    groups=2,
    normal_radius=0.3,
    passes=3,
    training_passes=1,
)
_KEY = jax.random.key(0)
_estimate = jax.jit(_NETWORK.estimate)
_loss = jax.jit(jax.value_and_grad(lambda variables, pair: _NETWORK.loss(variables, pair, _KEY)[:2], has_aux=True))
"""((loss, metrics), derivatives) of one pass, because derivatives do not go through the pose of the pass before."""
pytestmark = pytest.mark.usefixtures("x64")


@pytest.fixture(scope="module")
def variables():
    return _double(jax.jit(_NETWORK.init)(_KEY))


@pytest.fixture(scope="module")
def pairs():
    """Three clean pairs of 60 points: no point can have more neighbours than the network takes."""
    shapes = {"points": jnp.asarray(procedural_shapes(4, points=60).points)}
    config = PairConfig(points=60, signed=0.0)
    return _double(jax.jit(make_batch, static_argnums=(2, 3))(jax.random.key(1), shapes, config, 3, 0.0))


def _pair(pairs, index=0):
    return jax.tree.map(lambda each: each[index], pairs)


def _double(tree):
    with jax.enable_x64(True):
        return jax.tree.map(lambda each: each.astype(jnp.float64) if each.dtype == jnp.float32 else each, tree)


def _assert_same(found, expected, atol):
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


def test_published_network_has_the_published_number_of_parameters():
    params = jax.eval_shape(RPMNet().init, _KEY)["params"]
    counts = {name: sum(leaf.size for leaf in jax.tree.leaves(part)) for name, part in params.items()}
    assert counts == {"annealing": 809_922, "features": 905_154 - 809_922}


def test_estimate_is_not_the_identity_and_is_a_rotation(variables, pairs):
    pair = _pair(pairs)
    rotation = np.asarray(_estimate(variables, pair.source, pair.target, _KEY).rotation, np.float64)
    assert np.linalg.norm(rotation - np.eye(3)) > 1e-3
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(rotation) > 0


def test_padding_changes_nothing(variables, pairs):
    pair = _pair(pairs)
    padded = [
        Cloud(jnp.pad(cloud.points, ((0, more), (0, 0))), jnp.pad(cloud.mask, (0, more)))
        for cloud, more in ((pair.source, 7), (pair.target, 12))
    ]
    expected = _estimate(variables, pair.source, pair.target, _KEY)
    _assert_same(_estimate(variables, *padded, _KEY), expected, atol=1e-8)


@pytest.mark.parametrize("which", ["source", "target"])
def test_order_of_points_changes_nothing_with_few_neighbours(variables, pairs, which):
    pair = _pair(pairs)
    rows = np.random.default_rng(0).permutation(60)
    clouds = {"source": pair.source, "target": pair.target}
    expected = _estimate(variables, *clouds.values(), _KEY)
    clouds[which] = make_cloud(clouds[which].points[rows])
    _assert_same(_estimate(variables, *clouds.values(), _KEY), expected, atol=1e-8)


def test_source_is_moved_to_where_the_target_is(variables, pairs):
    pair = _pair(pairs)
    found = _estimate(variables, pair.source, pair.target, _KEY)
    moved = rigid.apply(found, pair.source.points)
    low, high = jnp.min(pair.target.points, axis=0), jnp.max(pair.target.points, axis=0)
    centre = jnp.mean(moved, axis=0)
    assert bool(jnp.all((low < centre) & (centre < high)))


def test_loss_of_a_padded_pair_has_finite_derivatives(variables, pairs):
    def padded(cloud):
        mask = cloud.mask.at[40:].set(False)
        return Cloud(jnp.where(mask[:, None], cloud.points, 0.0), mask)

    pair = _pair(pairs)
    pair = pair._replace(source=padded(pair.source), target=padded(pair.target))
    assert all(np.isfinite(each).all() for each in jax.tree.leaves(_loss(variables, pair)))


def test_derivative_agrees_with_finite_differences_along_a_direction(variables, pairs):
    pair = _pair(pairs)
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), variables)

    def along(step):
        return _loss(jax.tree.map(lambda leaf, way: leaf + step * way, variables, direction), pair)[0][0]

    derivatives = jax.tree.map(lambda each, way: jnp.sum(each * way), _loss(variables, pair)[1], direction)
    step = 1e-6
    expected = (along(step) - along(-step)) / (2 * step)
    np.testing.assert_allclose(sum(jax.tree.leaves(derivatives)), expected, rtol=1e-5)


def test_forward_derivative_of_the_estimate_agrees_with_finite_differences(variables, pairs):
    pair = _pair(pairs)
    # Of one pass: no derivative goes from one to the next.
    estimate = jax.jit(dataclasses.replace(_NETWORK, passes=1).estimate)

    def along(step):
        moved = jax.tree.map(lambda leaf: leaf * (1 + step), variables)
        return estimate(moved, pair.source, pair.target, _KEY).translation

    step = 1e-6
    _, slope = jax.jvp(along, (0.0,), (1.0,))
    np.testing.assert_allclose(slope, (along(step) - along(-step)) / (2 * step), rtol=1e-4, atol=1e-7)


def test_true_pose_has_no_distance(variables, pairs):
    """The loss compares with the true pose: with the estimate as truth, only the unmatched mass is left."""
    pair = _pair(pairs)
    run = jax.jit(_NETWORK._run, static_argnums=(3, 4))
    poses, rows, columns = run(variables, pair.source, pair.target, 1, _NETWORK._features)
    (loss, metrics), _ = _loss(variables, pair._replace(transform=_pair(poses)))
    np.testing.assert_allclose(metrics["distance"], 0, atol=1e-12)
    np.testing.assert_allclose(loss, 0.01 * (2 - jnp.mean(rows) - jnp.mean(columns)), rtol=1e-8)
