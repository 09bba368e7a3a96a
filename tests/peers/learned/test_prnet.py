"""PRNet has the published size, draws its matches as it says, and behaves as a network of point sets must."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.peers.learned import prnet
from urrt_jax.peers.learned.matching import hard_matches, soft_matches
from urrt_jax.peers.learned.prnet import Keypoints, Matchable, Pass, PRNet
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import euler_rotation

_NETWORK = PRNet(widths=(8, 16), width=16, neighbors=6, heads=2, hidden=24, temperature_width=8, passes=2)
_KEY = jax.random.key(0)
_estimate = jax.jit(_NETWORK.estimate)


def _padded(cloud: Cloud, count: int) -> Cloud:
    return Cloud(jnp.pad(cloud.points, ((0, count), (0, 0))), jnp.pad(cloud.mask, (0, count)))


def _assert_same(found, expected, atol=2e-5):
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


def _with_temperature(variables, value: float):
    """The variables with which the last layer of the temperature gives this value before it is clamped."""
    params = variables["params"]
    last = {"kernel": jnp.zeros((8, 1)), "bias": jnp.full(1, value)}
    return variables | {"params": params | {"temperature": params["temperature"] | {"Dense_0": last}}}


@pytest.fixture(scope="module")
def variables():
    """Random ones, with statistics that are not those of a fresh network."""
    leaves, form = jax.tree.flatten(jax.jit(_NETWORK.init)(_KEY))
    keys = jax.random.split(jax.random.key(1), len(leaves))
    draw = [leaf + 0.2 * jax.random.uniform(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(form, draw)


def test_parameters_are_as_many_as_published():
    fresh = jax.eval_shape(PRNet().init, _KEY)["params"]
    # The published count includes ten numbers that are no parameters: a constant reflection and an unused temperature.
    assert sum(values.size for values in jax.tree.leaves(fresh)) == 5_713_547 - 10


# Hard matches


@pytest.fixture(scope="module")
def logits():
    return 2 * jax.random.normal(jax.random.key(3), (5, 7))


_MASK = jnp.arange(7) < 6


def test_every_row_of_hard_matches_is_a_one_and_zeros(logits):
    matches = np.asarray(hard_matches(_KEY, logits, _MASK, jnp.array(0.5)))
    np.testing.assert_allclose(np.sort(matches), np.eye(7)[[6] * 5], atol=1e-6)


def test_draws_follow_the_softmax_of_the_logits_whatever_the_temperature():
    row = jnp.array([0.0, 1.0, 2.0, -1.0, 0.5, 1.5, 9.0])
    matches = hard_matches(_KEY, jnp.tile(row, (20_000, 1)), _MASK, jnp.array(5.0))
    expected = soft_matches(row[None], _MASK)[0]
    np.testing.assert_allclose(matches.mean(0), expected, atol=0.015)  # four standard deviations


def test_derivative_of_hard_matches_is_that_of_the_softmax_with_the_same_noise(logits, x64):
    logits, weights = jnp.asarray(logits, x64), jax.random.normal(jax.random.key(4), (5, 7), x64)
    temperature = jnp.asarray(0.7, x64)
    noise = jnp.stack([jax.random.gumbel(jax.random.fold_in(_KEY, row), (7,), x64) for row in range(5)])

    def value(match, logits, temperature):
        return jnp.sum(weights * match(logits, temperature))

    def soft(logits, temperature):
        return soft_matches((logits + noise) / temperature, _MASK)

    def hard(logits, temperature):
        return hard_matches(_KEY, logits, _MASK, temperature)

    found = jax.grad(value, argnums=(1, 2))(hard, logits, temperature)
    expected = jax.grad(value, argnums=(1, 2))(soft, logits, temperature)
    assert float(jnp.abs(expected[1])) > 1e-3
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), found, expected)


# One pass


def test_keypoints_are_the_two_thirds_of_the_real_points_with_the_largest_features():
    norms = np.array([3.0, 1.0, 5.0, 2.0, 4.0, 6.0, 9.0, 9.0, 9.0])
    cloud = Cloud(jnp.asarray(np.arange(27.0).reshape(9, 3)), jnp.arange(9) < 6)
    found = prnet.keypoints(cloud, jnp.asarray(norms)[:, None] * jnp.array([[0.6, -0.8]]))
    np.testing.assert_array_equal(found.cloud.mask, np.arange(6) < 4)
    np.testing.assert_array_equal(found.cloud.points[:4], cloud.points[jnp.array([5, 2, 4, 0])])


@pytest.mark.parametrize(("value", "expected"), [(-3.0, 0.01), (7.0, 7.0), (1e4, 100.0)])
def test_temperature_is_clamped(variables, value, expected):
    module = prnet._Temperature(8)
    variables = {name: tree["temperature"] for name, tree in _with_temperature(variables, value).items()}
    assert module.apply(variables, jnp.ones(16), False) == pytest.approx(expected)


def _distinct(points) -> Keypoints:
    """Keypoints whose features leave no doubt about their counterparts in a cloud of the same order."""
    return Keypoints(Cloud(points, jnp.ones(len(points), bool)), 100 * jnp.eye(len(points)))


@pytest.fixture(scope="module")
def pose():
    return Rigid(euler_rotation(jnp.array([0.3, -0.5, 0.4])), jnp.array([0.2, 0.1, -0.4]))


def _align(source, target) -> Pass:
    return prnet.align(Matchable(source, target, jnp.zeros(1), jnp.array(1.0)), _KEY)


def test_unmistakable_features_give_the_pose_in_both_directions(pose):
    source = jax.random.normal(_KEY, (9, 3))
    found = _align(_distinct(source), _distinct(rigid.apply(pose, source)))
    _assert_same(found.forward, pose)
    _assert_same(found.backward, rigid.inverse(pose))


def test_cycle_loss_of_a_pair_with_itself_is_zero():
    points = _distinct(jax.random.normal(_KEY, (9, 3)))
    assert prnet._cycle_loss(_align(points, points)) < 1e-10


def test_cycle_loss_compares_translations_without_rotating_them(pose):
    there_and_back = Pass(pose, rigid.inverse(pose), jnp.zeros(1))
    expected = jnp.mean((pose.translation - pose.rotation.T @ pose.translation) ** 2)
    assert prnet._cycle_loss(there_and_back) == pytest.approx(float(expected), rel=1e-5)


def test_each_pass_sees_the_source_where_the_passes_before_have_moved_it(monkeypatch, pair, pose):
    other = Rigid(euler_rotation(jnp.array([-0.6, 0.1, 0.2])), jnp.array([0.0, 0.3, 0.1]))
    canned, seen = iter((pose, other)), []

    class Recorder:
        def apply(self, variables, source, target, training, mutable):
            seen.append(source.points)
            return None, {"batch_stats": {}}

    monkeypatch.setattr(PRNet, "module", Recorder())
    monkeypatch.setattr(prnet, "align", lambda features, key: Pass(next(canned), pose, jnp.zeros(1)))
    found = _NETWORK.estimate({}, pair.source, pair.target, _KEY)
    np.testing.assert_allclose(seen[1], rigid.apply(pose, pair.source.points), atol=1e-6)
    _assert_same(found, rigid.compose(other, pose))


# The network


def test_padding_changes_nothing(variables, pair):
    padded = _estimate(variables, _padded(pair.source, 5), _padded(pair.target, 9), _KEY)
    _assert_same(padded, _estimate(variables, pair.source, pair.target, _KEY))


def test_order_of_points_changes_nothing(variables, pair):
    """Not even the noise: a keypoint gets it by its rank, and ranks are by the features."""
    order = np.random.default_rng(0).permutation(24)
    shuffled = [jax.tree.map(lambda values: values[order], cloud) for cloud in (pair.source, pair.target)]
    _assert_same(_estimate(variables, *shuffled, _KEY), _estimate(variables, pair.source, pair.target, _KEY))


def test_another_key_draws_other_matches(variables, pair):
    found = [_estimate(variables, pair.source, pair.target, jax.random.key(seed)) for seed in (0, 1)]
    assert rigid.rotation_angle(found[0].rotation, found[1].rotation) > 1e-3


@pytest.fixture(scope="module")
def loss_and_gradient(batch_loss):
    """A function of variables and a batch: (loss, (metrics, statistics)) and the gradient in the parameters."""

    def loss(params, stats, batch):
        return batch_loss(_NETWORK, {"params": params, "batch_stats": stats}, batch, _KEY)

    gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))
    return lambda variables, batch: gradient(variables["params"], variables["batch_stats"], batch)


def test_gradient_is_finite_for_identical_clouds(loss_and_gradient, variables, batch):
    _, gradient = loss_and_gradient(variables, batch._replace(target=batch.source))
    assert all(bool(jnp.all(jnp.isfinite(values))) for values in jax.tree.leaves(gradient))


def test_loss_is_the_weighted_sum_of_its_parts(loss_and_gradient, variables, batch):
    (loss, (parts, _)), _ = loss_and_gradient(variables, batch)
    expected = parts["pose"] + 0.1 * parts["feature_difference"] + 0.1 * parts["cycle"]
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)


def test_gradient_with_soft_matches_agrees_with_finite_differences(monkeypatch, batch_loss, variables, batch, x64):
    """The straight-through gradient is no derivative of the loss; with the softmax in place of the draw it is."""
    monkeypatch.setattr(
        prnet, "hard_matches", lambda key, logits, mask, temperature: soft_matches(logits / temperature, mask)
    )
    variables, batch = jax.tree.map(
        lambda values: values.astype(x64) if values.dtype == jnp.float32 else values, (variables, batch)
    )
    leaves, form = jax.tree.flatten(variables["params"])
    keys = jax.random.split(jax.random.key(2), len(leaves))
    direction = [jax.random.normal(key, leaf.shape, x64) for key, leaf in zip(keys, leaves, strict=True)]

    @jax.jit
    @jax.value_and_grad
    def loss(step):
        params = jax.tree.unflatten(form, [leaf + step * d for leaf, d in zip(leaves, direction, strict=True)])
        return batch_loss(_NETWORK, variables | {"params": params}, batch, _KEY)[0]

    slope = loss(jnp.zeros((), x64))[1]
    step = jnp.asarray(1e-6, x64)
    assert abs(slope) > 1e-3
    assert (loss(step)[0] - loss(-step)[0]) / (2 * step) == pytest.approx(float(slope), rel=1e-5)
