"""RIENet is its authors' network, by the numbers that theirs gave; its loss needs no label; padding changes nothing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.peers.learned.rienet import RELEASES, RIENet
from urrt_jax.peers.learned.rienet_loss import alignment_loss, consensus_loss, keypoints, match_loss
from urrt_jax.peers.learned.rienet_passes import feature_distance, sum_over_neighbors, total
from urrt_jax.rigid import Rigid

_SMALL = RIENet(
    widths=(4, 4, 8, 8), width=8, neighbors=4, match_neighbors=3, hidden=2, passes=2, keypoints=12, margin=0.7
)
_KEY = jax.random.key(0)
_stages = jax.jit(
    lambda network, variables, source, target: network.stages(variables, source, target), static_argnums=0
)

# (released set, kind of pairs): the smaller, cropped pairs for all, and both kinds for ModelNet40.
_SETS = [("modelnet", "clean"), ("modelnet", "prnet"), ("unseen", "prnet"), ("7scenes", "prnet"), ("icl", "prnet")]
_ITEMS = (0, 3)
_STAGES = {  # by the golden file's name: how far float32, which it holds, is from float64
    "embedding_source": 1e-4,
    "embedding_target": 1e-4,
    "distance": 2e-4,
    "match": 2e-6,
    "neighbour_match": 5e-6,
    "refined_match": 1e-6,
    "refined_max": 1e-4,
    "soft_target": 2e-5,
    "weight": 1e-4,
}


@pytest.fixture(scope="module")
def released(peer_file):
    """A function of (set, kind, item, dtype): what every pass computes with the released weights, as NumPy arrays."""

    @functools.cache
    def run(name, kind, item, dtype):
        variables = RELEASES[name].from_release(peer_file(f"rienet_{name}.npz"))
        inputs = peer_file("golden_rienet_modelnet.npz")
        with jax.enable_x64(dtype == np.float64):
            clouds = (make_cloud(inputs[f"{kind}_{which}"][item].astype(dtype)) for which in ("source", "target"))
            passes = _stages(RELEASES[name], variables, *clouds)
            return jax.tree.map(np.asarray, (passes, total(passes)))

    return run


@pytest.mark.parametrize("item", _ITEMS)
@pytest.mark.parametrize(("name", "kind"), _SETS)
def test_released_weights_give_the_authors_poses_in_double_precision(released, peer_file, name, kind, item):
    found, golden = released(name, kind, item, np.float64)[1], peer_file(f"golden_rienet_{name}.npz")
    np.testing.assert_allclose(found.rotation, golden[f"{kind}_R_f64"][item], rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.translation, golden[f"{kind}_t_f64"][item], rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["modelnet", "icl"])
def test_released_weights_give_the_authors_rotations_in_single_precision(released, peer_file, name):
    for item in _ITEMS:
        found = released(name, "prnet", item, np.float32)[1]
        golden = peer_file(f"golden_rienet_{name}.npz")["prnet_R"][item]
        np.testing.assert_allclose(found.rotation, golden, rtol=0, atol=3e-6)


@pytest.mark.parametrize(("name", "kind"), _SETS)
def test_every_pass_gives_the_authors_transform(released, peer_file, name, kind):
    passes, golden = released(name, kind, 0, np.float64)[0], peer_file(f"golden_rienet_{name}.npz")
    found = np.stack([each.transform.rotation for each in passes])
    np.testing.assert_allclose(found, golden[f"{kind}_R_iterations"][0], rtol=0, atol=3e-6)
    found = np.stack([each.transform.translation for each in passes])
    np.testing.assert_allclose(found, golden[f"{kind}_t_iterations"][0], rtol=0, atol=3e-6)


@pytest.mark.parametrize("stage", _STAGES)
@pytest.mark.parametrize(("name", "kind"), [("modelnet", "clean"), ("modelnet", "prnet"), ("icl", "prnet")])
def test_first_pass_agrees_with_the_authors_stage_by_stage(released, peer_file, name, kind, stage):
    first, golden = released(name, kind, 0, np.float64)[0][0], peer_file(f"golden_rienet_{name}.npz")
    if f"item0_{kind}_{stage}" not in golden:
        assert name != "modelnet", "the golden file of this set holds every stage"
        return
    some, few = golden[f"item0_{kind}_rows"], golden[f"item0_{kind}_rows"][:32]
    found = {
        "embedding_source": first.source_features[some],
        "embedding_target": first.target_features[some],
        "distance": first.distance[few],
        "match": first.match[few],
        "neighbour_match": first.neighbor_match[few],
        "refined_match": first.refined[few],
        "refined_max": first.refined.max(axis=1),
        "soft_target": first.matched,
        "weight": first.weights,
    }[stage]
    np.testing.assert_allclose(found, golden[f"item0_{kind}_{stage}"], rtol=0, atol=_STAGES[stage])


@pytest.mark.parametrize("which", ["source", "target"])
@pytest.mark.parametrize(("name", "kind"), [("modelnet", "clean"), ("icl", "prnet")])
def test_graph_has_the_authors_neighbors(released, peer_file, name, kind, which):
    first, golden = released(name, kind, 0, np.float64)[0][0], peer_file(f"golden_rienet_{name}.npz")
    found = getattr(first, f"{which}_neighbors")[:, : RELEASES[name].neighbors]
    np.testing.assert_array_equal(found, golden[f"item0_{kind}_knn_{which}"])


def test_most_likely_targets_are_the_authors(released, peer_file):
    refined = released("modelnet", "prnet", 0, np.float64)[0][0].refined
    golden = peer_file("golden_rienet_modelnet.npz")["item0_prnet_refined_argmax"]
    np.testing.assert_array_equal(refined.argmax(axis=1), golden)


@pytest.mark.parametrize(
    ("name", "count"), [("modelnet", 79825), ("unseen", 81633), ("7scenes", 79825), ("icl", 81633)]
)
def test_networks_have_the_published_number_of_parameters(name, count):
    params = jax.eval_shape(RELEASES[name].init, _KEY)["params"]
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == count


@pytest.mark.parametrize("name", RELEASES)
def test_released_variables_have_the_tree_of_fresh_ones(peer_file, name):
    fresh = jax.eval_shape(RELEASES[name].init, _KEY)
    read = RELEASES[name].from_release(peer_file(f"rienet_{name}.npz"))
    assert jax.tree.map(jnp.shape, read) == jax.tree.map(jnp.shape, fresh)


def _made_up_release(network: RIENet) -> dict[str, np.ndarray]:
    """Arrays with the released names and shapes."""
    arrays = {}

    def add(conv, bn, *shape, bias):
        arrays[f"{conv}.weight"] = np.ones(shape, np.float32)
        if bias:
            arrays[f"{conv}.bias"] = np.ones(shape[0], np.float32)
        if bn:
            for name in ("weight", "bias", "running_mean", "running_var"):
                arrays[f"{bn}.{name}"] = np.ones(shape[0], np.float32)

    inputs = (3, *network.widths[:-1], sum(network.widths))
    for row, (before, after) in enumerate(zip(inputs, (*network.widths, network.width), strict=True), 1):
        add(f"emb_nn.model.conv{row}", f"emb_nn.model.bn{row}", after, before, 1, 1, bias=False)
    model, d = "forwards.weight_function.model", network.hidden
    add(f"{model}1.0", f"{model}1.1", d, 3, 3, 1, bias=True)
    add(f"{model}1.3", f"{model}1.4", 2 * d, d, 3, 1, bias=True)
    for number in (2, 3):
        add(f"{model}{number}.0", f"{model}{number}.1", 16, 2 * d, 1, 1, bias=True)
        add(f"{model}{number}.3", f"{model}{number}.4", 16, 16, 1, 1, bias=True)
    add(f"{model}4.0", f"{model}4.1", 8, 16, 1, bias=True)
    add(f"{model}4.3", None, 1, 8, 1, bias=True)
    return arrays


@pytest.mark.parametrize("name", _made_up_release(_SMALL))
def test_a_missing_released_array_is_named(name):
    arrays = _made_up_release(_SMALL)
    del arrays[name]
    with pytest.raises(ValueError, match=f"'{name}'"):
        _SMALL.from_release(arrays)


@pytest.mark.parametrize("name", ["emb_nn.model.conv5.weight", "forwards.weight_function.model1.3.weight"])
def test_a_released_array_of_another_width_is_named(name):
    arrays = _made_up_release(_SMALL)
    arrays[name] = np.concatenate([arrays[name]] * 2)
    with pytest.raises(ValueError, match=f"'{name}'"):
        _SMALL.from_release(arrays)


@pytest.mark.parametrize(
    "setting", [{"neighbors": 0}, {"match_neighbors": 1}, {"passes": 0}, {"keypoints": 0}], ids=lambda s: next(iter(s))
)
def test_settings_without_meaning_are_refused(setting):
    with pytest.raises(ValueError, match=next(iter(setting))):
        RIENet(**setting)


# A tiny network.


@pytest.fixture(scope="module")
def variables():
    """Random ones of the tiny network, batch norm's included, so that none of them is neutral."""
    leaves, tree = jax.tree.flatten(_SMALL.init(_KEY))
    keys = jax.random.split(jax.random.key(1), len(leaves))
    return jax.tree.unflatten(
        tree, [leaf + 0.3 * jax.random.uniform(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    )


def _clouds(dtype=np.float64, sizes=(40, 32)):
    """Two different clouds of different sizes."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(64, 3)) * [1.0, 0.7, 0.4]
    turn = Rotation.from_euler("zyx", [20, -15, 30], degrees=True).as_matrix()
    return points[: sizes[0]].astype(dtype), (points[-sizes[1] :] @ turn.T + 0.1).astype(dtype)


def _estimate(variables, source: Cloud, target: Cloud) -> Rigid:
    return total(_stages(_SMALL, variables, source, target))


def _assert_same(found: Rigid, expected: Rigid, atol: float) -> None:
    np.testing.assert_allclose(found.rotation, expected.rotation, rtol=0, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, rtol=0, atol=atol)


@pytest.mark.parametrize("sizes", [(40, 32), (40, 3), (3, 32)], ids=str)
def test_padding_changes_nothing(variables, sizes, x64):
    source, target = _clouds(sizes=sizes)
    plain = _estimate(variables, make_cloud(source), make_cloud(target))
    padded = (
        make_cloud(
            np.concatenate([np.full((2, 3), 9.0), points, np.full((3, 3), 7.0)]),
            np.isin(np.arange(len(points) + 5), 2 + np.arange(len(points))),
        )
        for points in (source, target)
    )
    _assert_same(_estimate(variables, *padded), plain, 1e-10)


@pytest.mark.parametrize("which", [0, 1], ids=["source", "target"])
def test_order_of_points_changes_nothing(variables, which, x64):
    clouds = list(_clouds())
    plain = _estimate(variables, *map(make_cloud, clouds))
    clouds[which] = np.random.default_rng(3).permutation(clouds[which])
    _assert_same(_estimate(variables, *map(make_cloud, clouds)), plain, 1e-10)


@pytest.mark.parametrize("which", [0, 1], ids=["source", "target"])
def test_moving_a_cloud_moves_the_answer(variables, which, x64):
    clouds, offset = list(_clouds()), np.array([0.4, -0.2, 0.9])
    plain = _estimate(variables, *map(make_cloud, clouds))
    clouds[which] = clouds[which] + offset
    moved = plain.translation + (offset if which else -plain.rotation @ offset)
    _assert_same(_estimate(variables, *map(make_cloud, clouds)), Rigid(plain.rotation, moved), 1e-10)


def test_matches_between_neighbors_are_summed(x64):
    rng = np.random.default_rng(0)
    match, rows, columns = rng.uniform(size=(7, 5)), rng.integers(0, 7, (7, 3)), rng.integers(0, 5, (5, 2))
    expected = [[match[np.ix_(rows[i], columns[j])].sum() for j in range(5)] for i in range(7)]
    found = sum_over_neighbors(*map(jnp.asarray, (match, rows, columns)))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_feature_distance_is_euclidean(x64):
    first, second = np.random.default_rng(0).normal(size=(2, 6, 4))
    expected = np.linalg.norm(first[:, None] - second[None], axis=-1)
    np.testing.assert_allclose(feature_distance(jnp.asarray(first), jnp.asarray(second)), expected, rtol=1e-10)


# The loss.


def test_alignment_is_the_sum_of_robust_squared_distances_both_ways():
    # Squared distances: 0.0025 (quadratic) and 0.25 (linear) to the target, 0.0025 back.
    source = make_cloud(np.array([[0.05, 0, 0], [0.5, 0, 0], [9, 9, 9]], np.float32), np.array([True, True, False]))
    target = make_cloud(np.zeros((1, 3), np.float32))
    expected = 2 * 0.0025**2 / 2 + 0.01 * 0.25 - 0.01**2 / 2
    assert float(alignment_loss(source, target)) == pytest.approx(expected, rel=1e-5)


def test_consensus_is_zero_where_the_transform_explains_the_match(x64):
    points = jnp.asarray(np.random.default_rng(0).normal(size=(6, 3)))
    pose = Rigid(jnp.asarray(Rotation.from_rotvec([0.3, 0.2, -0.4]).as_matrix()), jnp.array([1.0, 2.0, 3.0]))
    rows, edges = jnp.arange(4), jnp.arange(8).reshape(4, 2) % 6
    loss = consensus_loss(points, rigid.apply(pose, points), rows, edges, jnp.ones((4, 2), bool), pose, 0.5)
    assert float(loss) == pytest.approx(0, abs=1e-24)


def test_consensus_sums_residuals_of_real_keypoints_and_of_their_edges():
    source = jnp.zeros((3, 3))
    matched = jnp.array([[1.0, 0, 0], [0, 2.0, 0], [9, 9, 9]])
    rows, edges = jnp.array([0, 2]), jnp.array([[0, 1], [2, 0]])
    mask = jnp.array([[True, True], [False, False]])
    # The keypoint misses by 1, its edge to the other point by 1 and 2.
    loss = consensus_loss(source, matched, rows, edges, mask, rigid.identity(), 0.5)
    assert float(loss) == pytest.approx(1 + 0.5 * (1 + 4))


def test_match_loss_is_the_mean_over_real_keypoints():
    matches = jnp.array([[0.5, 0.25, 0.25], [0.1, 0.1, 0.8], [1.0, 0.0, 0.0]])
    loss = match_loss(matches, jnp.array([True, True, False]))
    assert float(loss) == pytest.approx(-(np.log(0.5) + np.log(0.8)) / 2, rel=1e-6)


def test_keypoints_are_the_real_points_of_largest_weight():
    weights, mask = jnp.array([0.2, 0.9, 0.5, 0.7]), jnp.array([True, False, True, True])
    rows, real = keypoints(weights, mask, 2)
    assert (rows.tolist(), real.tolist()) == ([3, 2], [True, True])


def test_fewer_points_than_keypoints_are_all_used():
    rows, real = keypoints(jnp.array([0.2, 0.9, 0.5]), jnp.array([True, False, True]), 256)
    assert (sorted(rows[:2].tolist()), real.tolist()) == ([0, 2], [True, True, False])


@pytest.fixture(scope="module")
def loss_and_gradient(batch_loss):
    """A function of (variables, batch): the mean loss in training mode and its gradient in the parameters."""

    @jax.jit
    def run(variables, batch):
        def loss(params):
            return batch_loss(_SMALL, variables | {"params": params}, batch, _KEY)[0]

        return jax.value_and_grad(loss)(variables["params"])

    return run


def _as_double(tree):
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, tree)


def test_gradient_of_the_loss_agrees_with_finite_differences(variables, clean_batch, loss_and_gradient, x64):
    variables, batch = _as_double(variables), _as_double(clean_batch(2, 24))
    leaves, tree = jax.tree.flatten(variables["params"])
    rng = np.random.default_rng(5)
    along = jax.tree.unflatten(tree, [rng.normal(size=leaf.shape) for leaf in leaves])

    def moved(step):
        return {**variables, "params": jax.tree.map(lambda leaf, way: leaf + step * way, variables["params"], along)}

    step = 1e-6
    difference = (loss_and_gradient(moved(step), batch)[0] - loss_and_gradient(moved(-step), batch)[0]) / (2 * step)
    gradient = loss_and_gradient(variables, batch)[1]
    slope = sum(float(jnp.sum(g * a)) for g, a in zip(jax.tree.leaves(gradient), jax.tree.leaves(along), strict=True))
    assert slope == pytest.approx(float(difference), rel=1e-5)


@pytest.mark.parametrize("case", ["coincide", "padded", "one point"])
def test_gradient_of_the_loss_is_finite(variables, clean_batch, loss_and_gradient, case):
    batch = clean_batch(2, 24)
    cloud = batch.source
    if case == "padded":
        mask = cloud.mask & (jnp.arange(24) < 3)
        cloud = Cloud(jnp.where(mask[..., None], cloud.points, 0.0), mask)
    if case == "one point":
        cloud = cloud._replace(points=jnp.broadcast_to(cloud.points[:, :1], cloud.points.shape))
    loss, gradient = loss_and_gradient(variables, batch._replace(source=cloud, target=cloud))
    assert np.isfinite(loss)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(gradient))


def test_loss_never_reads_the_label(variables, clean_batch, loss_and_gradient):
    batch = clean_batch(2, 24)
    unknown = batch._replace(transform=jax.tree.map(lambda leaf: leaf * jnp.nan, batch.transform))
    assert float(loss_and_gradient(variables, unknown)[0]) == float(loss_and_gradient(variables, batch)[0])


def test_loss_is_the_weighted_sum_of_its_parts(variables, clean_batch, batch_loss):
    loss, (parts, _) = jax.jit(lambda batch: batch_loss(_SMALL, variables, batch, _KEY))(clean_batch(2, 24))
    assert float(loss) == pytest.approx(
        16 * float(parts["alignment"] + parts["consensus"]) + float(parts["match"]), 1e-5
    )


def test_checkpoints_are_chosen_without_labels(variables, clean_batch):
    pair = jax.tree.map(lambda leaf: leaf[0], clean_batch(2, 24))
    unknown = pair._replace(transform=jax.tree.map(lambda leaf: leaf * jnp.nan, pair.transform))
    loss, found = jax.jit(_SMALL.evaluate)(variables, unknown, _KEY)
    assert np.isfinite(loss)
    _assert_same(found, _estimate(variables, pair.source, pair.target), 1e-5)
