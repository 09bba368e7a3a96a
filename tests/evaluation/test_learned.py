"""Learned peers in batches: an answer depends on its pair alone, and files and names say what is wrong with them."""

import dataclasses
import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.evaluation import Learned, evaluate, find_method, load_evaluation, values_path
from urrt_jax.peers.learned.network import Network
from urrt_jax.peers.learned.weights import NETWORKS, RELEASED, Trained, save_network
from urrt_jax.rigid import Rigid, identity

compiled = []


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawing(Network):
    """Lays one centroid on the other, beside which it draws: as PRNet does at test time."""

    @property
    def name(self):
        return "drawing"

    @property
    def title(self):
        return "Drawing"

    def init(self, key):
        return {"params": {"scale": jnp.ones(3)}, "batch_stats": {}}

    def estimate(self, variables, source, target, key):
        compiled.append((source.points.shape, target.points.shape))
        shift = target.points.mean(axis=0) - source.points.mean(axis=0)
        drawn = 0.1 * jax.random.normal(key, (3,))
        return Rigid(identity().rotation, variables["params"]["scale"] * (shift + drawn))


@pytest.fixture(scope="module")
def trained():
    return Trained(network=Drawing(), variables=Drawing().init(jax.random.key(0)), title="Drawing", origin={})


@pytest.fixture(scope="module")
def pairs():
    """Nine pairs of three sizes, mixed."""
    random = np.random.default_rng(0)
    sizes = [(8, 8), (8, 5), (5, 8)] * 3
    clouds = [[random.normal(size=(size, 3)).astype(np.float32) for size in both] for both in sizes]
    return [source for source, _ in clouds], [target for _, target in clouds]


@pytest.fixture(scope="module")
def single(trained, pairs):
    """The translations of the pairs, one by one."""
    method = Learned(weights=trained, batch=1)
    return np.concatenate([method.align([source], [target]).translation for source, target in zip(*pairs, strict=True)])


@pytest.fixture
def files(monkeypatch, trained, tmp_path):
    """A file of trained weights, and the network among the known ones."""
    monkeypatch.setitem(NETWORKS, "drawing", Drawing())
    return save_network(Drawing(), trained.variables, tmp_path / "mine.npz", {"data": "made-up solids"})


@pytest.mark.parametrize("batch", [2, 3, 9, 32])
def test_answers_do_not_depend_on_the_size_of_batches(trained, pairs, single, batch):
    found = Learned(weights=trained, batch=batch).align(*pairs)
    np.testing.assert_allclose(found.translation, single, atol=1e-6)
    np.testing.assert_array_equal(found.rotation, np.broadcast_to(np.eye(3), (9, 3, 3)))


def test_answers_do_not_depend_on_the_order_of_pairs(trained, pairs, single):
    order = np.random.default_rng(1).permutation(9)
    found = Learned(weights=trained, batch=2).align(*([each[row] for row in order] for each in pairs))
    np.testing.assert_allclose(found.translation, single[order], atol=1e-6)


def test_batches_that_are_not_full_need_no_program_of_their_own(trained, pairs):
    jax.clear_caches()
    compiled.clear()
    Learned(weights=trained, batch=2).align(*pairs)  # of three pairs of each size, the second batch has one
    assert sorted(compiled) == [((5, 3), (8, 3)), ((8, 3), (5, 3)), ((8, 3), (8, 3))]


def test_nothing_is_said_of_an_answer(trained, pairs):
    found = Learned(weights=trained).align(*pairs)
    assert np.isnan(found.fitness).all() and np.isnan(found.converged).all()


def test_a_pair_without_a_finite_answer_is_a_failure_of_that_item_alone(trained):
    clouds = np.random.default_rng(0).normal(size=(5, 40, 3)).astype(np.float32)
    expected = evaluate(Learned(weights=trained), "dcp", clouds, progress=False)
    clouds[3, 0, 0] = np.nan
    found = evaluate(Learned(weights=trained), "dcp", clouds, progress=False)
    assert found.failures == {3: "values that are not finite"}
    np.testing.assert_array_equal(found.translations[[0, 1, 2, 4]], expected.translations[[0, 1, 2, 4]])


def test_evaluation_takes_another_size_of_batches(trained):
    clouds = np.random.default_rng(0).normal(size=(5, 40, 3)).astype(np.float32)
    found = [evaluate(Learned(weights=trained), "dcp", clouds, batch=batch, progress=False) for batch in (None, 2)]
    np.testing.assert_allclose(found[0].translations, found[1].translations, atol=1e-6)


@pytest.mark.parametrize(
    "count, batch, expected", [(100, None, 8), (5, None, 5), (100, 64, 64), (100, 2, 2), (5, 64, 5)]
)
def test_a_batch_is_no_larger_than_all_pairs(trained, count, batch, expected):
    assert Learned(weights=trained, batch=8).for_pairs(count, batch).batch == expected


def test_trained_weights_are_a_method(files, trained):
    method = find_method(f"drawing:{files}")
    assert method.title == "Drawing (trained here)"
    said = json.loads(json.dumps(method.identity()))
    assert said == {
        "method": "drawing", "settings": {}, "variables_sha256": trained.sha256, "trained": {"data": "made-up solids"}
    }  # fmt: skip


def test_batches_of_a_method_are_those_that_the_network_asks_for(files, monkeypatch):
    monkeypatch.setattr(Drawing, "largest_batch", 4)
    assert find_method(f"drawing:{files}").batch == 4


def test_values_of_trained_weights_are_kept_and_not_measured_again(files, tmp_path):
    clouds = np.random.default_rng(0).normal(size=(5, 40, 3)).astype(np.float32)
    name = f"drawing:{files}"
    method = find_method(name)
    path = values_path(tmp_path, name, method, "dcp", clouds, np.arange(5))
    evaluate(method, "dcp", clouds, save=path, progress=False)
    assert path.name.startswith("dcp-drawing-mine-")
    again = evaluate(name, "dcp", clouds, save=path, progress=False)
    np.testing.assert_array_equal(again.seconds, load_evaluation(path).seconds)


@pytest.mark.parametrize("name", sorted(NETWORKS | RELEASED))
def test_a_learned_peer_has_a_title_before_its_weights_are_there(name, monkeypatch):
    monkeypatch.delenv("URRT_DATA", raising=False)
    method = find_method(name)
    assert method.title
    with pytest.raises(ImportError, match=r"URRT_DATA|urrt train"):
        method.identity()


def test_weights_of_another_network_are_refused(files, monkeypatch):
    with pytest.raises(ValueError, match=r"mine\.npz holds weights of drawing, not of dcp_v1"):
        find_method(f"dcp_v1:{files}")


def test_a_release_takes_no_file(files):
    with pytest.raises(ValueError, match="before a file of weights, got 'rienet_unseen'"):
        find_method(f"rienet_unseen:{files}")


@pytest.mark.parametrize("name", ["nonesuch", "dcp_v1:", "icp:dcp_v1"])
def test_unknown_names_list_the_learned_peers(name):
    with pytest.raises(ValueError, match=r"expected one of .*dcp_v1, .*dcp_v2.*:FILE"):
        find_method(name)


@pytest.mark.parametrize("name", RELEASED)
def test_released_weights_are_a_method(name):
    path = Path(os.environ.get("URRT_DATA", "nowhere")) / "peers" / RELEASED[name].file
    if not path.exists():
        pytest.skip(f"needs peers/{path.name}: URRT_DATA names no folder with it")
    method = find_method(name)
    said = json.loads(json.dumps(method.identity()))
    assert said["released"]["file"] == path.name and len(said["variables_sha256"]) == 64
    network, variables = method.trained.network, method.trained.variables  # type: ignore[attr-defined]
    expected = jax.eval_shape(network.init, jax.random.key(0))
    assert jax.tree.map(jnp.shape, variables) == jax.tree.map(jnp.shape, expected)
