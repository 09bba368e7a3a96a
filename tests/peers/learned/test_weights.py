"""Weights of learned peers: what is saved comes back, and whatever is wrong or missing is said."""

import dataclasses
import hashlib
import io
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import load_model, save_model
from urrt_jax.peers.learned import weights
from urrt_jax.peers.learned.network import Network
from urrt_jax.peers.learned.weights import NETWORKS, RELEASED, Release, load_network, load_released, save_network


@dataclasses.dataclass(frozen=True, kw_only=True)
class Small(Network):
    """Two layers, one of which has batch norm."""

    widths: tuple[int, ...] = (4, 2)
    margin: float = 0.5
    attention: bool = False

    @property
    def name(self):
        return "small_attention" if self.attention else "small"

    @property
    def title(self):
        return "Small"

    def init(self, key):
        first, second = self.widths
        return {
            "params": {"Dense_0": {"kernel": jax.random.normal(key, (3, first))}, "scale": jnp.ones(second)},
            "batch_stats": {"BatchNorm_0": {"mean": jax.random.normal(key, (second,))}},
        }

    def from_release(self, arrays):
        if "kernel" not in arrays:
            raise ValueError("the released weights lack the array 'kernel'")
        return self.init(jax.random.key(0)) | {"params": {"kernel": arrays["kernel"]}}


@pytest.fixture(autouse=True)
def _known(monkeypatch):
    """The small network is a learned peer with a release of its own."""
    monkeypatch.delenv("URRT_DATA", raising=False)
    monkeypatch.setitem(NETWORKS, "small", Small())
    monkeypatch.setitem(NETWORKS, "small_unreleased", Small())
    facts = {"source": "somebody/small", "licence": "MIT", "trained_on": "nothing"}
    monkeypatch.setitem(RELEASED, "small", Release(network=Small(), file="small.npz", **facts))


@pytest.fixture
def variables():
    return Small().init(jax.random.key(1))


@pytest.fixture
def saved(variables, tmp_path):
    return save_network(Small(), variables, tmp_path / "net", {"command": "urrt train", "seconds": 2520.0})


def _edit_card(path, **changes):
    card = json.loads(path.with_suffix(".json").read_text()) | changes
    path.with_suffix(".json").write_text(json.dumps({key: value for key, value in card.items() if value is not None}))


def _rewrite(path, edit):
    """Changes the arrays of saved weights by ``edit`` and keeps the hash in their card right."""
    with np.load(path) as archive:
        arrays = {key: archive[key] for key in archive.files}
    edit(arrays)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    path.write_bytes(buffer.getvalue())
    _edit_card(path, sha256=hashlib.sha256(buffer.getvalue()).hexdigest())


@pytest.mark.parametrize("name", NETWORKS)
def test_networks_are_known_by_their_own_names(name):
    assert NETWORKS[name].name == name and NETWORKS[name].title


def test_published_networks_are_all_there():
    names = {"dcp_v1", "dcp_v2", "prnet", "rpmnet", "deepgmr", "pointnetlk", "pointnetlk_revisited", "rienet"}
    assert names <= NETWORKS.keys()


@pytest.mark.parametrize("name", list(NETWORKS))
def test_published_networks_come_back_with_their_settings(name, tmp_path):
    shapes = jax.eval_shape(NETWORKS[name].init, jax.random.key(0))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    found = load_network(save_network(NETWORKS[name], zeros, tmp_path / "net"))
    assert found.network == NETWORKS[name]
    assert jax.tree.map(np.shape, found.variables) == jax.tree.map(np.shape, zeros)


@pytest.mark.parametrize("ending", ["", ".npz", ".json"])
def test_saved_weights_come_back_rounded_to_float16(variables, saved, ending):
    found = load_network(saved.with_suffix(ending)).variables
    assert jax.tree.structure(found) == jax.tree.structure(variables)
    half = np.asarray(variables["params"]["Dense_0"]["kernel"], np.float16)
    np.testing.assert_array_equal(found["params"]["Dense_0"]["kernel"], half.astype(np.float32))


def test_statistics_of_batch_norm_keep_their_precision(variables, saved):
    found = load_network(saved).variables["batch_stats"]["BatchNorm_0"]["mean"]
    np.testing.assert_array_equal(found, variables["batch_stats"]["BatchNorm_0"]["mean"])


def test_loaded_variables_are_float32(saved):
    assert {leaf.dtype for leaf in jax.tree.leaves(load_network(saved).variables)} == {np.dtype(np.float32)}


def test_weights_that_were_loaded_are_saved_as_they_are(saved, tmp_path):
    found = load_network(saved)
    again = load_network(save_network(found.network, found.variables, tmp_path / "again"))
    assert again.sha256 == found.sha256


def test_settings_come_back(variables, tmp_path):
    network = Small(margin=0.25)
    assert load_network(save_network(network, variables, tmp_path / "net")).network == network


def test_weights_of_other_values_have_another_digest(variables, saved, tmp_path):
    other = save_network(Small(), jax.tree.map(lambda leaf: 2 * leaf, variables), tmp_path / "other")
    assert load_network(other).sha256 != load_network(saved).sha256


def test_settings_for_results_say_what_answers_depend_on(saved):
    found = load_network(saved)
    settings = json.loads(json.dumps(found.settings))
    assert settings["method"] == "small" and settings["settings"]["widths"] == [4, 2]
    assert settings["variables_sha256"] == found.sha256
    assert settings["trained"] == {"command": "urrt train", "seconds": 2520.0}


@pytest.mark.parametrize(
    "card, title",
    [
        ({}, "Small (trained here)"),
        ({"seconds": None}, "Small (trained here)"),
        ({"seconds": 2520.0}, "Small (trained here: 42 min)"),
        ({"seconds": 4320.0, "training": {"pairs": {"points": 512}}}, "Small (trained here: 512 points, 1.2 h)"),
        ({"steps": 500, "training": {"batch": 16}}, "Small (trained here: 8,000 pairs)"),
        ({"steps": 500, "training": {}}, "Small (trained here)"),
        ({"training": {"pairs": 512}}, "Small (trained here)"),
    ],
)
def test_title_says_how_the_weights_were_trained(variables, tmp_path, card, title):
    assert load_network(save_network(Small(), variables, tmp_path / "net", card)).title == title


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e5])
def test_value_that_float16_cannot_hold_is_not_saved(variables, tmp_path, value):
    variables["params"]["scale"] = jnp.array([1.0, value])
    with pytest.raises(ValueError, match="params/scale holds values that are not finite numbers of float16"):
        save_network(Small(), variables, tmp_path / "net")
    assert not list(tmp_path.iterdir())


def test_large_statistics_are_saved(variables, tmp_path):
    variables["batch_stats"]["BatchNorm_0"]["mean"] = jnp.array([1e5, 0.0])
    found = load_network(save_network(Small(), variables, tmp_path / "net"))
    assert found.variables["batch_stats"]["BatchNorm_0"]["mean"][0] == 1e5


def test_damaged_file_is_refused(saved):
    content = bytearray(saved.read_bytes())
    content[len(content) // 2] ^= 1
    saved.write_bytes(content)
    with pytest.raises(ValueError, match=r"damaged.*SHA-256"):
        load_network(saved)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"nothing\.npz does not exist"):
        load_network(tmp_path / "nothing.npz")


@pytest.mark.parametrize(
    "edit, message",
    [
        (lambda arrays: arrays.pop("params/scale"), r"missing \['params/scale'\]"),
        (lambda arrays: arrays.update(more=np.ones(2)), r"unexpected \['more'\]"),
        (lambda arrays: arrays.update({"params/scale": np.ones(3, np.float16)}), r"shape \(3,\), expected \(2,\)"),
        (lambda arrays: arrays.update({"params/scale": np.ones(2, np.float32)}), "float32, expected float16"),
        (lambda arrays: arrays["params/scale"].fill(np.nan), "params/scale holds values that are not finite"),
    ],
)
def test_arrays_that_do_not_fit_the_network_are_named(saved, edit, message):
    _rewrite(saved, edit)
    with pytest.raises(ValueError, match=message):
        load_network(saved)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"method": None}, "card of no learned peer: .* which is missing"),
        ({"method": "nonesuch"}, "card of no learned peer: .* got 'nonesuch'"),
        ({"method": ["small"]}, "card of no learned peer"),
        ({"config": []}, "expected an object as 'config'"),
        ({"config": {"colour": "blue"}}, r"Small has no settings \['colour'\]"),
        ({"config": {"margin": "wide"}}, "margin expects float, got 'wide'"),
        ({"config": {"attention": 0}}, "attention expects bool, got 0"),
        ({"config": {"widths": [4, 2.5]}}, "widths expects int, got 2.5"),
        ({"config": {"widths": [True, 2]}}, "widths expects int, got True"),
        ({"config": {"widths": []}}, "widths expects tuple, got "),
        ({"config": {"widths": [4]}}, "no network has this configuration"),
        ({"config": {"widths": [4, -2]}}, "no network has this configuration"),
        ({"config": {"widths": [4, 3]}}, r"params/scale has shape \(2,\), expected \(3,\)"),
        ({"config": {"attention": True}}, "settings are those of small_attention, not of small"),
    ],
)
def test_card_that_does_not_fit_is_refused(saved, changes, message):
    _edit_card(saved, **changes)
    with pytest.raises(ValueError, match=rf"^model: .*{message}"):
        load_network(saved)


def test_whole_number_is_a_margin(saved):
    _edit_card(saved, config={"margin": 1})
    assert load_network(saved).network == Small(margin=1.0)


def test_file_of_our_network_is_no_learned_peer(small_model, tmp_path):
    with pytest.raises(ValueError, match=r"net\.json is the card of no learned peer"):
        load_network(save_model(small_model, tmp_path / "net"))


def test_file_of_a_learned_peer_is_no_model_of_ours(saved):
    with pytest.raises(ValueError, match=r"net\.json: .*unknown fields"):
        load_model(saved)


def _release(folder, **arrays):
    (folder / "peers").mkdir()
    np.savez(folder / "peers" / "small.npz", **arrays)


def test_released_weights_are_read_from_the_data_folder(monkeypatch, tmp_path):
    _release(tmp_path, kernel=np.full(3, 7.0))
    monkeypatch.setenv("URRT_DATA", str(tmp_path))
    found = load_released("small")
    np.testing.assert_array_equal(found.variables["params"]["kernel"], 7.0)
    assert found.title == "Small (released weights)"
    assert found.settings["released"]["source"] == "somebody/small"


@pytest.mark.parametrize("name", RELEASED)
def test_released_weights_without_a_data_folder_say_where_to_put_them(name):
    with pytest.raises(ImportError, match=f"set the environment variable URRT_DATA .* peers/{RELEASED[name].file}"):
        load_released(name)


def test_released_weights_that_the_data_folder_lacks_say_where_they_are_from(monkeypatch, tmp_path):
    monkeypatch.setenv("URRT_DATA", str(tmp_path))
    with pytest.raises(ImportError, match=r"no file peers/small\.npz: set .*github\.com/somebody/small"):
        load_released("small")


def test_network_without_a_release_says_how_to_train_it():
    message = "urrt train --method small_unreleased --out DIR', and name the method small_unreleased:DIR/model.npz"
    with pytest.raises(ImportError, match=message):
        load_released("small_unreleased")


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"expected one of dcp_v1, .*got 'nonesuch'"):
        load_released("nonesuch")


def test_file_of_another_release_is_named(monkeypatch, tmp_path):
    _release(tmp_path, other=np.ones(3))
    monkeypatch.setenv("URRT_DATA", str(tmp_path))
    with pytest.raises(ValueError, match=r"small\.npz: holds no released weights of Small \(.*'kernel'"):
        load_released("small")


def test_released_file_that_is_no_archive_is_named(monkeypatch, tmp_path):
    _release(tmp_path)
    (tmp_path / "peers" / "small.npz").write_bytes(b"no archive")
    monkeypatch.setenv("URRT_DATA", str(tmp_path))
    with pytest.raises(ValueError, match=r"small\.npz: holds no released weights of Small \(.*cannot be read"):
        load_released("small")


@pytest.mark.parametrize("name", RELEASED)
def test_what_is_known_of_released_weights_is_said(name):
    release = RELEASED[name]
    assert release.source and release.licence and release.trained_on
    assert release.title.startswith(release.network.title)
    assert weights.NETWORKS[release.network.name].title == release.network.title
