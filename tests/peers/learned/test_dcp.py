"""Deep Closest Point is the published one, stage by stage, and behaves as a network of point sets must."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.maxima import masked_max
from urrt_jax.peers.learned import dcp
from urrt_jax.peers.learned.dcp import DCP
from urrt_jax.peers.learned.graph import neighbor_rows
from urrt_jax.peers.learned.matching import soft_targets
from urrt_jax.peers.learned.network import estimate_batch

_SMALL = dict(widths=(8, 16), width=16, neighbors=6, heads=2, hidden=24)
_KEY = jax.random.key(0)


def _cloud(points, dtype=jnp.float32) -> Cloud:
    return Cloud(jnp.asarray(points, dtype), jnp.ones(len(points), bool))


def _padded(cloud: Cloud, count: int) -> Cloud:
    return Cloud(jnp.pad(cloud.points, ((0, count), (0, 0))), jnp.pad(cloud.mask, (0, count)))


# The released version 1


@pytest.fixture(scope="module")
def golden(peer_file):
    return peer_file("golden_dcp_v1.npz")


@pytest.fixture(scope="module")
def released(peer_file):
    return DCP().from_release(peer_file("dcp_v1.npz"))


@pytest.fixture(scope="module")
def stages(golden, released):
    """What every stage gives of item 0 in double precision; the layers' maxima are the source's."""
    with jax.enable_x64(True):
        variables = jax.tree.map(lambda values: jnp.asarray(values, jnp.float64), released)
        source, target = (_cloud(golden[name][0], jnp.float64) for name in ("source", "target"))
        found = {}
        for name, cloud in (("source", source), ("target", target)):
            found[f"neighbors_{name}"] = neighbor_rows(cloud.points, cloud.mask, 20)
            found[f"embedding_{name}"], captured = DCP().module.apply(
                variables, cloud, False, method="embed", mutable=["intermediates"], capture_intermediates=True
            )
            layers = captured["intermediates"]["convolutions"]
            maxima = [masked_max(layers[f"Layer_{i}"]["__call__"][0], jnp.ones((1024, 20), bool), 1) for i in range(4)]
            found[f"maxima_{name}"] = maxima
        features = DCP().module.apply(variables, source, target, False)
        found["scores"] = dcp.match(features, target.mask)
        found["soft_target"] = soft_targets(found["scores"], target.points)
    return jax.tree.map(np.asarray, found)


@pytest.fixture(scope="module")
def poses(golden, released):
    """A function of the precision: rotations (3, 3, 3) and translations (3, 3) of the first three items."""

    def find(dtype):
        with jax.enable_x64(dtype == jnp.float64):
            variables = jax.tree.map(lambda values: jnp.asarray(values, dtype), released)
            source, target = (
                Cloud(jnp.asarray(golden[name][:3], dtype), jnp.ones((3, 1024), bool)) for name in ("source", "target")
            )
            return jax.tree.map(np.asarray, estimate_batch(DCP(), variables, source, target, _KEY))

    return find


def test_released_network_gives_the_authors_poses_in_double_precision(golden, poses):
    found = poses(jnp.float64)
    np.testing.assert_allclose(found.rotation, golden["R_f64"][:3], atol=1e-9)
    np.testing.assert_allclose(found.translation, golden["t_f64"][:3], atol=1e-9)


def test_released_network_gives_the_authors_poses_within_a_tenth_of_a_degree(golden, poses):
    found = poses(jnp.float32)
    angles = rigid.rotation_angle(found.rotation, golden["R_f64"][:3].astype(np.float32))
    assert np.rad2deg(angles).max() < 0.1
    np.testing.assert_allclose(found.translation, golden["t_f64"][:3], atol=1e-4)


@pytest.mark.parametrize("name", ["source", "target"])
def test_neighbors_are_those_of_the_authors_network(golden, stages, name):
    rows = stages[f"neighbors_{name}"]
    np.testing.assert_array_equal(np.sort(rows), np.sort(golden[f"item0_knn_{name}_f64"]))
    np.testing.assert_array_equal(rows[:, 0], np.arange(1024))


@pytest.mark.parametrize("layer", range(4))
def test_maxima_of_each_layer_are_those_of_the_authors_network(golden, stages, layer):
    found = stages["maxima_source"][layer][golden["item0_rows"]]
    np.testing.assert_allclose(found, golden[f"item0_x{layer + 1}"], atol=1e-4)


@pytest.mark.parametrize("name", ["source", "target"])
def test_embedding_is_that_of_the_authors_network(golden, stages, name):
    found = stages[f"embedding_{name}"][golden["item0_rows"]]
    np.testing.assert_allclose(found, golden[f"item0_embedding_{name}"], atol=1e-4)


def test_embedding_of_every_point_is_that_of_the_authors_network(peer_file, stages):
    expected = peer_file("golden_dcp_v1_embedding.npz")["embedding_source"]
    np.testing.assert_allclose(stages["embedding_source"], expected, atol=1e-4)


def test_scores_are_those_of_the_authors_network(golden, stages):
    rows = golden["item0_rows"][:64]
    np.testing.assert_allclose(stages["scores"][rows], golden["item0_scores"], rtol=1e-4)
    np.testing.assert_allclose(stages["scores"].max(1), golden["item0_score_max"], rtol=1e-4)
    np.testing.assert_array_equal(stages["scores"].argmax(1), golden["item0_score_argmax"])


def test_soft_target_is_that_of_the_authors_network(golden, stages):
    np.testing.assert_allclose(stages["soft_target"], golden["soft_target"][0], atol=2e-5)


def test_released_variables_have_the_tree_of_the_network(released):
    fresh = jax.eval_shape(DCP().init, _KEY)
    assert jax.tree.map(np.shape, released) == jax.tree.map(np.shape, fresh)


def _made_up_release() -> dict[str, np.ndarray]:
    """Ones in the names and shapes of a release with the small widths."""
    arrays = {}
    for i, (inputs, width) in enumerate(((6, 8), (8, 16), (24, 16)), start=1):
        arrays[f"emb_nn.conv{i}.weight"] = np.ones((width, inputs, 1, 1), np.float32)
        for name in ("weight", "bias", "running_mean", "running_var"):
            arrays[f"emb_nn.bn{i}.{name}"] = np.ones(width, np.float32)
    return arrays


def test_a_release_without_an_array_is_refused_by_name():
    arrays = _made_up_release()
    del arrays["emb_nn.bn2.running_var"]
    with pytest.raises(ValueError, match=r"emb_nn\.bn2\.running_var"):
        DCP(**_SMALL).from_release(arrays)


def test_a_release_of_other_widths_is_refused_by_name():
    arrays = _made_up_release() | {"emb_nn.conv3.weight": np.ones((16, 16, 1, 1), np.float32)}
    with pytest.raises(ValueError, match=r"emb_nn\.conv3\.weight"):
        DCP(**_SMALL).from_release(arrays)


def test_version_2_has_no_release():
    with pytest.raises(ValueError, match="DCPv2"):
        DCP(attention=True).from_release(_made_up_release())


# Any weights


def test_parameters_are_as_many_as_published():
    counts = [
        sum(values.size for values in jax.tree.leaves(jax.eval_shape(DCP(attention=attention).init, _KEY)["params"]))
        for attention in (False, True)
    ]
    # The published count of version 2 includes the nine entries of a constant reflection, which are no parameters.
    assert counts == [309_632, 5_568_905 - 9]


@pytest.fixture(scope="module", params=[False, True], ids=["v1", "v2"])
def network(request):
    return DCP(attention=request.param, **_SMALL)


def _perturbed(tree, key, size: float = 0.2):
    leaves, form = jax.tree.flatten(tree)
    keys = jax.random.split(key, len(leaves))
    draw = [leaf + size * jax.random.uniform(k, leaf.shape) for leaf, k in zip(leaves, keys, strict=True)]
    return jax.tree.unflatten(form, draw)


@pytest.fixture(scope="module")
def variables(network):
    """Random ones, with statistics that are not those of a fresh network."""
    return _perturbed(jax.jit(network.init)(_KEY), jax.random.key(1))


@pytest.fixture(scope="module")
def estimate(network):
    return jax.jit(network.estimate)


def _assert_same(found, expected, atol=2e-5):
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=atol)
    np.testing.assert_allclose(found.translation, expected.translation, atol=atol)


def test_padding_changes_nothing(estimate, variables, pair):
    padded = estimate(variables, _padded(pair.source, 5), _padded(pair.target, 9), _KEY)
    _assert_same(padded, estimate(variables, pair.source, pair.target, _KEY))


def test_a_cloud_of_fewer_points_than_neighbors_may_be_padded(estimate, variables, pair):
    few = jax.tree.map(lambda values: values[:4], pair.source)
    _assert_same(estimate(variables, _padded(few, 20), pair.target, _KEY), estimate(variables, few, pair.target, _KEY))


def test_order_of_points_changes_nothing(estimate, variables, pair):
    order = np.random.default_rng(0).permutation(24)
    shuffled = [jax.tree.map(lambda values: values[order], cloud) for cloud in (pair.source, pair.target)]
    _assert_same(estimate(variables, *shuffled, _KEY), estimate(variables, pair.source, pair.target, _KEY))


def test_features_of_the_source_see_the_target_in_version_2_only(network, variables, pair):
    moved = pair.target._replace(points=pair.target.points + 0.3)
    features = [network.module.apply(variables, pair.source, target, False)[0] for target in (pair.target, moved)]
    assert bool(jnp.any(features[0] != features[1])) == network.attention


def test_the_pointer_of_version_1_doubles_the_embedding():
    network = DCP(**_SMALL)
    variables = network.init(_KEY)
    cloud = _cloud(np.random.default_rng(0).normal(size=(12, 3)))
    embedding = network.module.apply(variables, cloud, False, method="embed")
    np.testing.assert_array_equal(network.module.apply(variables, cloud, cloud, False)[1], 2 * embedding)


@pytest.fixture(scope="module")
def loss_and_gradient(network, batch_loss):
    """A function of variables and a batch: (loss, (metrics, statistics)) and the gradient in the parameters."""

    def loss(params, stats, batch):
        return batch_loss(network, {"params": params, "batch_stats": stats}, batch, _KEY)

    gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))
    return lambda variables, batch: gradient(variables["params"], variables["batch_stats"], batch)


def test_padding_changes_no_loss_no_gradient_and_no_statistics(loss_and_gradient, variables, batch):
    pad = jax.vmap(lambda cloud: _padded(cloud, 5))
    padded = batch._replace(source=pad(batch.source), target=pad(batch.target))
    expected, found = loss_and_gradient(variables, batch), loss_and_gradient(variables, padded)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-3), found, expected)


def test_gradient_agrees_with_finite_differences(loss_and_gradient, variables, batch, x64):
    variables, batch = jax.tree.map(
        lambda values: values.astype(x64) if values.dtype == jnp.float32 else values, (variables, batch)
    )
    _, gradient = loss_and_gradient(variables, batch)
    direction = _perturbed(jax.tree.map(jnp.zeros_like, gradient), jax.random.key(2))

    def moved(step):
        params = jax.tree.map(lambda values, change: values + step * change, variables["params"], direction)
        return loss_and_gradient(variables | {"params": params}, batch)[0][0]

    slope = sum(jnp.sum(a * b) for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True))
    assert (moved(1e-6) - moved(-1e-6)) / 2e-6 == pytest.approx(float(slope), rel=1e-5)


def test_gradient_is_finite_for_identical_clouds(loss_and_gradient, variables, batch):
    _, gradient = loss_and_gradient(variables, batch._replace(target=batch.source))
    assert all(bool(jnp.all(jnp.isfinite(values))) for values in jax.tree.leaves(gradient))


def test_batch_norm_sees_the_source_and_then_the_target():
    """As in PyTorch with shared weights: the stored mean moves by a tenth towards the source's, then the target's."""
    network = DCP(**_SMALL)
    clouds = [_cloud(np.random.default_rng(seed).normal(seed, 1, (24, 3))) for seed in (1, 2)]
    variables = network.init(_KEY)
    kernel = variables["params"]["convolutions"]["Layer_0"]["Dense_0"]["kernel"]
    expected = 0.0
    for cloud in clouds:
        neighbors = cloud.points[neighbor_rows(cloud.points, cloud.mask, network.neighbors)]
        edges = jnp.concatenate([neighbors, jnp.broadcast_to(cloud.points[:, None], neighbors.shape)], axis=-1)
        expected = expected + 0.1 * (jnp.mean(edges @ kernel, (0, 1)) - expected)

    def train(source, target):
        return network.module.apply(variables, source, target, True, mutable=["batch_stats"])[1]["batch_stats"]

    one_pair = [jax.tree.map(lambda values: values[None], cloud) for cloud in clouds]
    stats = jax.vmap(train, axis_name="pairs", out_axes=None)(*one_pair)
    np.testing.assert_allclose(stats["convolutions"]["Layer_0"]["BatchNorm_0"]["mean"], expected, atol=1e-5)
