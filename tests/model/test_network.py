"""The network's invariances, its derivatives, and what each stage does with regions that hold no point.

Invariances are tested in double precision: landmarks that choose sharply and drop what disagrees multiply rounding.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.features import moment_invariants
from urrt_jax.frames import normalize_pair
from urrt_jax.model import Model, ModelConfig, estimate, init_model, network
from urrt_jax.model.attention import attention_weights
from urrt_jax.model.encoder import encode_points, shape_embedding
from urrt_jax.model.network import encode, point_regions, predict, propose
from urrt_jax.model.partition import (
    BranchInputs,
    branch_logits,
    inputs_at_places,
    inputs_of_cloud,
    occupancy_logits,
    pool_by_label,
    region_labels,
    region_scores,
    split_regions,
)
from urrt_jax.training.pairs import PairConfig, make_pair
from urrt_jax.training.trainable import PAIRS
from urrt_jax.training.urrt import URRT

_predict, _estimate, _encode = (jax.jit(each) for each in (predict, estimate, encode))
_init = jax.jit(init_model, static_argnums=1)


def _is_rotation(matrix, atol=1e-5):
    matrix = np.asarray(matrix, np.float64)
    np.testing.assert_allclose(matrix.T @ matrix, np.eye(3), atol=atol)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=atol)


def _close(first, second, atol=1e-5):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), first, second)


@pytest.fixture(scope="module", params=[("A", "landmarks"), ("B", "pose"), ("C", "landmarks")], ids="-".join)
def model(request, small_config, make_model) -> Model:
    variant, decoder = request.param
    return make_model(dataclasses.replace(small_config, variant=variant, decoder=decoder))


@pytest.fixture(scope="module")
def pair(cloud, pose):
    """Two clouds of 60 points, fewer than the network's size, the second one posed."""
    target = cloud[100:160] @ pose[0].T + pose[1]
    return cloud[:60].astype(np.float64), target.astype(np.float64)


def test_aligned_clouds_are_proposed_to_stay(model, pair, x64):
    """Decoders that regress the pose propose what they estimate in one step."""
    cloud = make_cloud(pair[0] - pair[0].mean(axis=0))
    proposed = jax.jit(propose, static_argnums=3)(model, cloud, cloud, 8)
    expected = rigid.identity()
    if model.config.decoder == "pose":
        expected = _estimate(model.at_most(1), cloud, cloud).transform
        assert len(proposed.rotation) == 1
    assert model.config.decoder == "pose" or len(proposed.rotation) >= 8
    _close(proposed, jax.vmap(lambda _: expected)(proposed.translation), atol=1e-4)


@pytest.fixture
def count_calls(monkeypatch):
    """Of the network's functions with these names: how often each runs, as the compiled program runs."""
    counts = {}

    def watch(name):
        inner = getattr(network, name)

        def counted(*arguments):
            jax.debug.callback(lambda: counts.update({name: counts.get(name, 0) + 1}))
            return inner(*arguments)

        monkeypatch.setattr(network, name, counted)

    def run(names, function, *arguments):
        for name in names:
            watch(name)
        answer = jax.block_until_ready(jax.jit(function)(*arguments))
        jax.effects_barrier()
        return answer, counts

    return run


@pytest.mark.parametrize("sure", [[True, True], [False, True]])
def test_known_poses_are_taken_and_nothing_is_decoded_where_all_are_known(small_model, pair, count_calls, sure):
    clouds = [jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), make_cloud(points)) for points in pair]
    turns = jax.vmap(rigid.rotation_from_6d)(jax.random.normal(jax.random.key(0), (2, 6)))
    transform = rigid.Rigid(turns, jnp.full((2, 3), 0.1))
    batch = jax.vmap(functools.partial(network.estimate, small_model))
    names = ["decode", "encode_cloud"]
    answer, counts = count_calls(names, batch, *clouds, rigid.Known(transform, jnp.array(sure)))
    steps = small_model.config.steps
    assert steps > 1
    # Once for the target, and then for every step; each callback runs once a pair of the batch, or once in all.
    if all(sure):
        assert "decode" not in counts and counts["encode_cloud"] in (2, 4)
    else:
        assert counts["decode"] in (steps, 2 * steps) and counts["encode_cloud"] in (1 + steps, 2 * (1 + steps))
    # Of a batch, too: a pair alone differs from it by the order in which products are summed.
    plain = jax.jit(batch)(*clouds, rigid.Known(transform, jnp.array([False, False])))
    for row, known in enumerate(sure):
        found = jax.tree.map(lambda leaf, row=row: leaf[row], answer)
        expected = jax.tree.map(lambda leaf, row=row: leaf[row], transform if known else plain.transform)
        _close(found.transform, expected, atol=1e-6 if known else 1e-5)
        _close(jax.tree.map(lambda leaf: leaf[-1], found.steps), expected, atol=1e-4)
        assert len(found.steps.translation) == steps
        if known:
            _close(found.seen, expected)
            np.testing.assert_allclose(found.source.cloud.points, rigid.apply(expected, pair[0]), atol=1e-5)


def test_random_model_does_not_answer_the_identity(model, pair):
    answer = _predict(model, *map(make_cloud, pair))
    assert float(rigid.rotation_angle(answer.rotation, jnp.eye(3))) > 0.01


def test_answer_is_a_rotation(model, pair):
    _is_rotation(_predict(model, *map(make_cloud, pair)).rotation)


@pytest.mark.parametrize("which", [0, 1])
def test_answer_does_not_depend_on_the_order_of_points(model, pair, which, x64):
    clouds = list(pair)
    clouds[which] = np.random.default_rng(0).permutation(clouds[which])
    _close(_predict(model, *map(make_cloud, clouds)), _predict(model, *map(make_cloud, pair)), atol=1e-9)


@pytest.mark.parametrize("which", [0, 1])
def test_order_does_not_matter_when_the_cloud_is_subsampled(small_model, cloud, which, x64):
    cloud = cloud.astype(np.float64)
    clouds = [cloud, cloud + 0.1]
    shuffled = list(clouds)
    shuffled[which] = np.random.default_rng(0).permutation(cloud) + 0.1 * which
    _close(
        _predict(small_model, *map(make_cloud, shuffled)), _predict(small_model, *map(make_cloud, clouds)), atol=1e-9
    )


def test_padding_changes_nothing(model, pair, x64):
    padded = [np.concatenate([points, np.full((4, 3), 7.0)]) for points in pair]
    mask = np.arange(64) < 60
    found = _predict(model, *(make_cloud(points, mask) for points in padded))
    _close(found, _predict(model, *map(make_cloud, pair)), atol=1e-9)


def test_jit_agrees_with_eager(small_model, pair, x64):
    clouds = tuple(map(make_cloud, pair))
    _close(_predict(small_model, *clouds), predict(small_model, *clouds), atol=1e-9)


def test_vmap_agrees_with_a_loop(model, pair, cloud, x64):
    sources, targets = np.stack([pair[0], cloud[60:120]]), np.stack([pair[1], cloud[120:180]])
    both = jax.vmap(lambda s, t: predict(model, make_cloud(s), make_cloud(t)))
    together = jax.jit(both)(sources, targets)
    for i in range(2):
        alone = _predict(model, make_cloud(sources[i]), make_cloud(targets[i]))
        _close(jax.tree.map(lambda leaf, i=i: leaf[i], together), alone, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_common_scale_keeps_the_rotation_and_scales_the_translation(model, pair, scale, x64):
    plain = _predict(model, *map(make_cloud, pair))
    scaled = _predict(model, *(make_cloud(points * scale) for points in pair))
    np.testing.assert_allclose(scaled.rotation, plain.rotation, atol=1e-9)
    np.testing.assert_allclose(scaled.translation / scale, plain.translation, atol=1e-9)


@pytest.mark.parametrize("which", [0, 1])
def test_moving_a_cloud_moves_the_answer(model, pair, which, x64):
    offset = np.array([1000.0, -500.0, 250.0])
    clouds = list(pair)
    plain = _predict(model, *map(make_cloud, clouds))
    clouds[which] = clouds[which] + offset
    moved = _predict(model, *map(make_cloud, clouds))
    np.testing.assert_allclose(moved.rotation, plain.rotation, atol=1e-9)
    landed = rigid.apply(moved, jnp.asarray(clouds[0][:5]))
    expected = rigid.apply(plain, jnp.asarray(clouds[0][:5] - offset * (which == 0))) + offset * which
    np.testing.assert_allclose(landed, expected, atol=1e-6)


@pytest.mark.parametrize(("steps", "expected"), [(1, 1), (2, 2), (5, 2)])
def test_at_most_never_adds_steps(small_model, steps, expected):
    fewer = small_model.at_most(steps)
    assert fewer.config == dataclasses.replace(small_model.config, steps=expected)
    assert fewer.params is small_model.params


def test_a_second_step_is_a_first_one_of_the_moved_source(small_model, pair, x64):
    source, target, _ = normalize_pair(*map(make_cloud, pair))
    once = _estimate(small_model.at_most(1), source, target).transform
    moved = source._replace(points=rigid.apply(once, source.points))
    twice = rigid.compose(_estimate(small_model.at_most(1), moved, target).transform, once)
    _close(_estimate(small_model.at_most(2), source, target).transform, twice, atol=1e-9)


def test_steps_end_in_the_answer(small_model, pair):
    source, target, _ = normalize_pair(*map(make_cloud, pair))
    answer = _estimate(small_model, source, target)
    assert answer.steps.rotation.shape == (2, 3, 3)
    _close(jax.tree.map(lambda leaf: leaf[-1], answer.steps), answer.transform, atol=0)


def test_second_step_starts_where_the_first_ended(small_model, pair):
    source, target, _ = normalize_pair(*map(make_cloud, pair))
    answer = _estimate(small_model, source, target)
    _close(jax.tree.map(lambda leaf: leaf[0], answer.steps), answer.seen, atol=0)


def _degenerate() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(60, 3))
    cube = np.stack(np.meshgrid(*[[-1.0, 0, 1]] * 3), -1).reshape(-1, 3)
    return {
        "sphere": sphere / np.linalg.norm(sphere, axis=1, keepdims=True),
        "cube": cube,
        "one point repeated": np.ones((60, 3)),
        "at the origin": np.zeros((60, 3)),
        "line": np.outer(np.linspace(-1, 1, 40), [1.0, 2, 3]),
    }


@pytest.fixture(scope="module")
def value_and_gradient(model):
    """Value and gradient, in parameters and clouds, of an answer for clouds of 60 points at most."""

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1, 2))
    def total(params, source, target, masks):
        answer = predict(Model(model.config, params), make_cloud(source, masks[0]), make_cloud(target, masks[1]))
        return jnp.sum(answer.rotation * jnp.arange(9.0).reshape(3, 3)) + jnp.sum(answer.translation)

    def run(*clouds):
        padded = np.zeros((2, 60, 3), np.float32)
        for row, points in zip(padded, clouds, strict=True):
            row[: len(points)] = points
        return total(model.params, *padded, tuple(np.arange(60) < len(points) for points in clouds))

    return run


@pytest.mark.parametrize("name", ["identity", *_degenerate()])
def test_gradient_is_finite_for_equal_clouds(value_and_gradient, pair, name):
    points = pair[0] if name == "identity" else _degenerate()[name]
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(value_and_gradient(points, points)))


@pytest.mark.parametrize("source, target", [(0, 60), (60, 0), (0, 0), (1, 60), (60, 1), (1, 1), (2, 2)])
def test_gradient_is_finite_where_a_cloud_has_hardly_a_point(value_and_gradient, pair, source, target):
    """A pair that is left out of a batch's loss must not spoil the gradient of the others: zero times NaN is NaN."""
    found = value_and_gradient(pair[0][:source], pair[1][:target])
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))


def test_gradient_in_the_parameters_agrees_with_finite_differences(model, pair, x64):
    """Of one step: between steps no derivative passes, by design. The partition stays, so that no label switches."""
    one_step = dataclasses.replace(model.config, steps=1)
    leaves, tree = jax.tree.flatten({k: v for k, v in model.params.items() if k != "partition"})
    rng = np.random.default_rng(0)
    along = jax.tree.unflatten(tree, [jnp.asarray(rng.normal(size=leaf.shape)) for leaf in leaves])

    @jax.jit
    @jax.value_and_grad
    def total(step):
        moved = {k: jax.tree.map(lambda a, b: a + step * b, model.params[k], along[k]) for k in along}
        answer = predict(Model(one_step, model.params | moved), *map(make_cloud, pair))
        return jnp.sum(answer.rotation * jnp.arange(9.0).reshape(3, 3)) + jnp.sum(answer.translation)

    step = 1e-7  # consensus bends what it gives: at 1e-6 differences are off by a thousandth
    difference = float(total(step)[0] - total(-step)[0]) / (2 * step)
    assert float(total(0.0)[1]) == pytest.approx(difference, rel=1e-4, abs=1e-6)


def test_estimate_has_no_derivative_in_the_partition(small_model, pair):
    def total(partition):
        params = small_model.params | {"partition": partition}
        return jnp.sum(predict(Model(small_model.config, params), *map(make_cloud, pair)).rotation)

    gradient = jax.jit(jax.grad(total))(small_model.params["partition"])
    assert all(not bool(jnp.any(leaf)) for leaf in jax.tree.leaves(gradient))


@pytest.fixture(scope="module", params=["places", "parts"])
def partition(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def loss_gradient(cloud, small_config, make_model, partition):
    """A function of the occupancy weight: the gradient of the mean training loss of four pairs."""
    model = make_model(dataclasses.replace(small_config, partition=partition))
    pairs = PairConfig(points=64)
    batch = jax.vmap(lambda key: make_pair(key, jnp.asarray(cloud), pairs, 0.0))(jax.random.split(jax.random.key(0), 4))
    method = URRT(model=model.config, loss_points=64, occupancy_queries=64, occupancy_weight=0.0)

    def losses(params):
        loss = lambda one: method.loss({"params": params}, one, jax.random.key(1))[:2]  # noqa: E731
        loss, metrics = jax.vmap(loss, axis_name=PAIRS)(batch)
        return jnp.array([jnp.mean(loss), jnp.mean(metrics["occupancy"] - 2.0 * metrics.get("agreement", 0.0))])

    jacobian = jax.jit(jax.jacrev(losses))(model.params)
    parts = [jax.tree.map(lambda leaf, i=i: leaf[i], jacobian) for i in range(2)]

    def gradient(weight: float):
        return jax.tree.map(lambda a, b: a + weight * b, *parts)

    return gradient


def test_every_parameter_receives_a_gradient_from_the_training_loss(loss_gradient):
    idle = [
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(loss_gradient(1.0))
        if not bool(jnp.any(leaf)) or not bool(jnp.all(jnp.isfinite(leaf)))
    ]
    assert idle == []


def test_partition_learns_from_its_own_losses_alone(loss_gradient):
    assert all(not bool(jnp.any(leaf)) for leaf in jax.tree.leaves(loss_gradient(0.0)["partition"]))


def _region_inputs(seed: int = 0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(4, 8)).astype(np.float32), rng.normal(size=(4, 8)).astype(np.float32)


def test_attention_rows_sum_to_one():
    weights = attention_weights(*map(jnp.asarray, _region_inputs()), jnp.array([True, False, True, True]))
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)


def test_attention_passes_over_absent_regions():
    weights = attention_weights(*map(jnp.asarray, _region_inputs()), jnp.array([True, False, True, False]))
    np.testing.assert_array_equal(weights[:, [1, 3]], 0)


def test_attention_without_any_region_is_zero():
    weights = attention_weights(*map(jnp.asarray, _region_inputs()), jnp.zeros(4, bool))
    np.testing.assert_array_equal(weights, 0)


def test_attention_without_any_region_has_a_finite_gradient():
    query, key = map(jnp.asarray, _region_inputs())
    gradient = jax.grad(lambda q: jnp.sum(attention_weights(q, key, jnp.zeros(4, bool))))(query)
    assert bool(jnp.all(jnp.isfinite(gradient)))


def test_attention_is_the_scaled_softmax_of_the_paper():
    query, key = _region_inputs()
    logits = query @ key.T / np.sqrt(8)
    expected = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    np.testing.assert_allclose(
        attention_weights(*map(jnp.asarray, (query, key)), jnp.ones(4, bool)), expected, atol=1e-6
    )


@pytest.fixture(scope="module")
def one_sided(small_config):
    """A model of many regions and a cloud so small that most of them stay empty."""
    config = dataclasses.replace(small_config, regions=12)
    points = np.random.default_rng(0).normal([2, 2, 2], 0.1, size=(20, 3)).astype(np.float32)
    return _init(jax.random.key(0), config), make_cloud(points)


def test_empty_region_has_features_and_centroid_zero(one_sided):
    encoding = _encode(*one_sided)
    empty = np.asarray(encoding.regions.counts) == 0
    assert 0 < empty.sum() < 12
    for values in (encoding.regions.features, encoding.regions.centroids):
        np.testing.assert_array_equal(np.asarray(values)[empty], 0)


def test_empty_regions_leave_the_answer_finite(one_sided):
    model, cloud = one_sided
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(_estimate(model, cloud, cloud)))


def test_empty_cloud_leaves_the_answer_finite(model, pair):
    nothing = make_cloud(pair[0], np.zeros(60, bool))
    answer = _predict(model, nothing, make_cloud(pair[1]))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(answer))


def test_labels_are_regions(small_model, pair):
    cloud = make_cloud(pair[0])
    logits = branch_logits(
        small_model.config, small_model.params["partition"], BranchInputs(cloud.points, jnp.zeros(16))
    )
    labels = region_labels(logits)
    assert labels.dtype == jnp.int32
    assert int(labels.min()) >= 0
    assert int(labels.max()) < 4


def test_label_is_the_region_of_the_highest_score():
    logits = jnp.asarray(_region_inputs()[0])
    np.testing.assert_array_equal(region_labels(logits), np.argmax(region_scores(logits), axis=1))


def test_fresh_partition_uses_every_region(small_config):
    config = dataclasses.replace(small_config, regions=8, branch_width=32)
    fresh = _init(jax.random.key(0), config)
    ball = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    encoding = _encode(fresh, make_cloud(ball))
    assert int(jnp.sum(encoding.regions.counts > 20)) == 8


def test_labels_have_no_derivative(small_model, pair):
    def total(points):
        logits = branch_logits(small_model.config, small_model.params["partition"], BranchInputs(points, jnp.zeros(16)))
        return jnp.sum(region_labels(logits).astype(jnp.float32))

    assert not bool(jnp.any(jax.grad(total)(jnp.asarray(pair[0]))))


def test_branches_read_the_direction_of_the_shape_embedding(small_model, pair):
    def logits(embedding):
        inputs = BranchInputs(jnp.asarray(pair[0]), embedding)
        return branch_logits(small_model.config, small_model.params["partition"], inputs)

    embedding = jax.random.normal(jax.random.key(0), (16,))
    np.testing.assert_allclose(logits(embedding), logits(7 * embedding), atol=1e-4)
    assert float(jnp.max(jnp.abs(logits(embedding) - logits(-embedding)))) > 1e-2
    assert bool(jnp.all(jnp.isfinite(jax.grad(lambda e: jnp.sum(logits(e)))(jnp.zeros(16)))))  # an empty cloud's


def _scores(model: Model, points) -> np.ndarray:
    """The scores (N, n) of the regions of a cloud's own points."""
    cloud = make_cloud(points - points.mean(axis=0))
    invariants = moment_invariants(cloud, model.config.octaves)
    inputs = inputs_of_cloud(model.config, cloud, encode(model, cloud).embedding, invariants)
    return np.asarray(region_scores(branch_logits(model.config, model.params["partition"], inputs)))


def test_parts_do_not_depend_on_the_pose(parts_model, cloud, pose, x64):
    first, second = (_scores(parts_model, points) for points in (cloud[:60], cloud[:60] @ pose[0].T + pose[1]))
    np.testing.assert_allclose(second, first, atol=1e-4)
    assert np.std(first, axis=0).max() > 0.01


def test_places_do_depend_on_the_pose(small_model, cloud, pose, x64):
    first, second = (_scores(small_model, points) for points in (cloud[:60], cloud[:60] @ pose[0].T + pose[1]))
    assert np.max(np.abs(second - first)) > 0.01


def test_parts_of_a_place_are_those_of_a_point_there(parts_model, pair):
    config, cloud = parts_model.config, make_cloud(pair[0], np.arange(60) < 50)
    encoding = _encode(parts_model, cloud)
    inputs = inputs_at_places(config, cloud, cloud.points, encoding.condition)
    logits = branch_logits(config, parts_model.params["partition"], inputs)
    np.testing.assert_array_equal(region_labels(logits)[:50], encoding.regions.labels[:50])


def test_padding_does_not_change_parts(parts_model, pair):
    padded = make_cloud(np.concatenate([pair[0], 9 + pair[1]]), np.arange(120) < 60)
    short, long = _encode(parts_model, make_cloud(pair[0])), _encode(parts_model, padded)
    np.testing.assert_allclose(long.condition, short.condition, atol=1e-5)
    np.testing.assert_array_equal(long.regions.labels[:60], short.regions.labels)


def test_decoders_of_poses_see_no_invariants(small_config, make_model, pair):
    config = dataclasses.replace(small_config, decoder="pose")
    model, cloud = make_model(config), make_cloud(pair[0])
    first = encode_points(config, model.params["encoder"], cloud, jnp.zeros((60, 33)))
    _close(first, encode_points(config, model.params["encoder"], cloud, jnp.ones((60, 33))), atol=0)


def test_occupancy_can_say_outside():
    assert float(occupancy_logits(jnp.array([-3.0, -5.0]))) == -3


def test_point_regions_are_those_that_the_network_used(small_model, pair):
    cloud = make_cloud(pair[0])
    encoding = encode(small_model, cloud)
    labels = encoding.regions.labels
    np.testing.assert_array_equal(point_regions(cloud.points, encoding.cloud, labels), labels)


def test_point_regions_off_the_cloud_are_those_of_the_nearest_point(small_model, pair):
    encoding = encode(small_model, make_cloud(pair[0], np.arange(60) < 50))
    places = np.random.default_rng(0).normal(size=(90, 3))
    near = np.argmin(np.linalg.norm(places[:, None] - pair[0][:50], axis=-1), axis=1)
    labels = encoding.regions.labels
    np.testing.assert_array_equal(point_regions(jnp.asarray(places), encoding.cloud, labels), labels[near])


def _labelled(seed: int = 0):
    rng = np.random.default_rng(seed)
    features, labels = rng.normal(size=(50, 6)).astype(np.float32), rng.integers(0, 4, 50)
    labels[labels == 2] = 4  # region 2 stays empty, label 4 is dropped
    return features, labels


def test_pool_by_label_agrees_with_numpy():
    features, labels = _labelled()
    pooled = pool_by_label(jnp.asarray(features), jnp.asarray(labels), jnp.arange(5))
    for k in (0, 1, 3):
        np.testing.assert_array_equal(pooled[k], features[labels == k].max(axis=0))
    assert bool(jnp.all(pooled[2] == -jnp.inf))


def test_pool_by_label_gradient_goes_to_the_first_maximum():
    features, labels = _labelled()
    features[labels == 1, 0] = 9.0  # ties
    weights = np.arange(1.0, 25.0).reshape(4, 6)

    def total(values):
        pooled = pool_by_label(values, jnp.asarray(labels), jnp.arange(5))
        return jnp.sum(jnp.where(jnp.isfinite(pooled), pooled, 0.0) * weights)

    expected = np.zeros_like(features)
    for k in (0, 1, 3):
        rows = np.flatnonzero(labels == k)
        for c in range(6):
            expected[rows[np.argmax(features[rows, c])], c] += weights[k, c]
    np.testing.assert_allclose(jax.jit(jax.grad(total))(jnp.asarray(features)), expected)


def test_split_regions_agrees_with_numpy(cloud):
    mask = np.arange(200) % 4 != 0
    rng = np.random.default_rng(0)
    features, labels = rng.normal(size=(200, 5)).astype(np.float32), rng.integers(0, 3, 200)
    logits = jax.nn.one_hot(labels, 4)
    regions = split_regions(make_cloud(cloud, mask), jnp.asarray(features), logits)
    np.testing.assert_array_equal(regions.labels, np.where(mask, labels, 0))
    for k in range(3):
        mine = mask & (labels == k)
        assert float(regions.counts[k]) == mine.sum()
        np.testing.assert_allclose(regions.centroids[k], cloud[mine].mean(0), atol=1e-5)
        np.testing.assert_array_equal(regions.features[k], features[mine].max(0))


def test_shape_embedding_of_an_empty_cloud_is_zero():
    np.testing.assert_array_equal(shape_embedding(jnp.ones((5, 3)), jnp.zeros(5, bool)), 0)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"variant": "D"}, "^variant: .*'D'"),
        ({"partition": "pieces"}, "^partition: .*'pieces'"),
        ({"partition": "parts", "octaves": 0}, "^octaves: "),
        ({"decoder": "9D"}, "^decoder: .*'9D'"),
        ({"landmarks": 0}, "^landmarks: .*0"),
        ({"octaves": -1}, "^octaves: .*-1"),
        ({"lookups": -1}, "^lookups: .*-1"),
        ({"consensus": -1}, "^consensus: .*-1"),
        ({"hypotheses": -1}, "^hypotheses: .*-1"),
        ({"key_width": 1.5}, "^key_width: .*1.5"),
        ({"regions": 0}, "^regions: .*0"),
        ({"width": -1}, "^width: .*-1"),
        ({"steps": 0}, "^steps: .*0"),
        ({"points": 2}, "^points: .*2"),
        ({"attention_layers": -1}, "^attention_layers: .*-1"),
        ({"decoder_widths": (8, 0)}, "^decoder_widths: .*0"),
    ],
)
def test_config_refuses_and_names_the_field(fields, says):
    with pytest.raises(ValueError, match=says):
        ModelConfig(**fields)


@pytest.mark.parametrize(
    "fields",
    [
        {"regions": 1, "landmarks": 1, "key_width": 1},
        {"octaves": 0, "encoder_widths": (), "decoder_widths": (), "position_widths": ()},
        {"octaves": 0, "decoder": "pose", "decoder_widths": ()},
        {"octaves": 1, "lookups": 1, "attention_layers": 0},
        {"variant": "B", "attention_layers": 0, "lookups": 0, "consensus": 0},
    ],
)
def test_smallest_networks_work(small_config, pair, fields):
    model = _init(jax.random.key(0), dataclasses.replace(small_config, **fields))
    _is_rotation(_predict(model, *map(make_cloud, pair)).rotation)
