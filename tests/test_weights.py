"""Model files: what is written comes back, and whatever is wrong with a file is said."""

import hashlib
import io
import json
import pickle
import zipfile

import jax
import numpy as np
import pytest

from urrt_jax import Model, available_models, load_model, model_card, save_model


@pytest.fixture
def saved(small_model, tmp_path):
    return save_model(small_model, tmp_path / "net")


def _edit_card(path, **changes):
    card = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(card | changes))


def _rewrite(path, edit):
    """Changes the arrays of a saved model by ``edit`` and keeps the hash in its card right."""
    with np.load(path) as archive:
        arrays = {key: archive[key] for key in archive.files}
    edit(arrays)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    _put(path, buffer.getvalue())


def _put(path, content):
    path.write_bytes(content)
    _edit_card(path, sha256=hashlib.sha256(content).hexdigest())


def _assert_same(model, other):
    assert model.config == other.config
    assert jax.tree.structure(model.params) == jax.tree.structure(other.params)
    jax.tree.map(np.testing.assert_array_equal, model.params, other.params)


def test_saved_model_comes_back(saved, small_model):
    _assert_same(load_model(saved), small_model)


def test_model_may_be_named_by_its_card(saved, small_model):
    _assert_same(load_model(saved.with_suffix(".json")), small_model)


def test_path_may_be_a_string(saved, small_model):
    _assert_same(load_model(str(saved)), small_model)


def test_loaded_model_is_a_pytree_that_jit_takes(saved):
    assert float(jax.jit(lambda model: jax.tree.leaves(model.params)[0].sum())(load_model(saved))) is not None


def test_folder_is_made(small_model, tmp_path):
    assert save_model(small_model, tmp_path / "a" / "b" / "net.npz").is_file()


def test_nothing_else_is_left_in_the_folder(saved):
    assert sorted(path.name for path in saved.parent.iterdir()) == ["net.json", "net.npz"]


def test_same_model_gives_the_same_bytes(small_model, tmp_path):
    first, second = (save_model(small_model, tmp_path / name).read_bytes() for name in ("a", "b"))
    assert first == second


def test_card_carries_what_was_recorded(small_model, tmp_path):
    path = save_model(small_model, tmp_path / "net", {"data": "made-up solids"})
    card = model_card(path)
    assert card["data"] == "made-up solids"
    assert card["config"]["regions"] == 4
    assert card["parameters"] == sum(leaf.size for leaf in jax.tree.leaves(small_model.params))


def test_card_of_another_model_does_not_spoil_the_file(small_model, saved, tmp_path):
    """A loaded model is changed and saved again with the card that it came with."""
    changed = Model(small_model.config, jax.tree.map(lambda leaf: leaf + 1, small_model.params))
    path = save_model(changed, tmp_path / "second", model_card(saved))
    _assert_same(load_model(path), changed)


def test_dotted_names_do_not_collide(small_model, tmp_path):
    paths = {save_model(small_model, tmp_path / name) for name in ("rate0.1", "rate0.5")}
    assert len(paths) == 2


def test_damaged_file_is_refused(saved):
    content = bytearray(saved.read_bytes())
    content[len(content) // 2] ^= 1
    saved.write_bytes(content)
    with pytest.raises(ValueError, match=r"damaged.*SHA-256"):
        load_model(saved)


def test_file_cut_short_is_refused(saved):
    saved.write_bytes(saved.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"damaged.*SHA-256"):
        load_model(saved)


def test_missing_parameter_is_named(saved):
    _rewrite(saved, lambda arrays: arrays.pop("partition/bias"))
    with pytest.raises(ValueError, match=r"missing \['partition/bias'\], unexpected \[\]"):
        load_model(saved)


def test_unexpected_parameter_is_named(saved):
    _rewrite(saved, lambda arrays: arrays.update({"encoder/more": np.ones(2)}))
    with pytest.raises(ValueError, match=r"missing \[\], unexpected \['encoder/more'\]"):
        load_model(saved)


def test_parameter_of_another_shape_is_named(saved):
    _rewrite(saved, lambda arrays: arrays.update({"partition/bias": np.zeros(5, np.float32)}))
    with pytest.raises(ValueError, match=r"partition/bias has shape \(5,\), expected \(4,\)"):
        load_model(saved)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_parameter_that_is_not_finite_is_named(saved, value):
    _rewrite(saved, lambda arrays: arrays.update({"partition/bias": np.array([0, value, 0, 0], np.float32)}))
    with pytest.raises(ValueError, match="partition/bias holds values that are not finite"):
        load_model(saved)


@pytest.mark.parametrize("dtype", [np.complex64, "U1", bool, np.float64])
def test_parameter_of_another_dtype_is_named(saved, dtype):
    _rewrite(saved, lambda arrays: arrays.update({"partition/bias": np.zeros(4).astype(dtype)}))
    with pytest.raises(ValueError, match="partition/bias"):
        load_model(saved)


def test_file_that_is_no_archive_is_refused(saved):
    _put(saved, b"no archive at all")
    with pytest.raises(ValueError, match="cannot be read"):
        load_model(saved)


def test_archive_of_something_else_is_refused(saved):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("readme.txt", "hello")
    _put(saved, buffer.getvalue())
    with pytest.raises(ValueError, match=r"^model: "):
        load_model(saved)


class _Bomb:
    """Pickled, it calls ``fail`` when it is read."""

    def __reduce__(self):
        return (_explode, ())


def _explode():
    raise AssertionError("a pickle was executed")


def test_pickled_array_is_refused_and_not_executed(saved):
    array = np.empty(4, object)
    array[:] = [_Bomb()] * 4
    buffer = io.BytesIO()
    # NumPy would pickle the object; what matters is that reading it back never does.
    with zipfile.ZipFile(buffer, "w") as archive:
        inner = io.BytesIO()
        np.lib.format.write_array_header_1_0(inner, {"descr": "|O", "fortran_order": False, "shape": (4,)})
        inner.write(pickle.dumps([_Bomb()] * 4))
        archive.writestr("partition/bias.npy", inner.getvalue())
    _put(saved, buffer.getvalue())
    with pytest.raises(ValueError, match="cannot be read"):
        load_model(saved)


def test_pickle_in_place_of_the_archive_is_refused_and_not_executed(saved):
    _put(saved, pickle.dumps(_Bomb()))
    with pytest.raises(ValueError, match="cannot be read"):
        load_model(saved)


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_missing_file_is_named(saved, suffix):
    saved.with_suffix(suffix).unlink()
    with pytest.raises(ValueError, match=rf"net\{suffix} does not exist"):
        load_model(saved)


_DAMAGED_CARDS = {
    "cut": "{",
    "no object": "[]",
    "text": '"text"',
    "empty": "{}",
    "no hash": '{"config": {}}',
    "configuration that is text": '{"config": "x", "sha256": "0"}',
    "hash that is no text": '{"config": {}, "sha256": 7}',
    "hash that is nothing": '{"config": {}, "sha256": null}',
    "a thousand deep": "[" * 100_000,
    "no UTF-8": b"\xff\xfe{}",
}


@pytest.mark.parametrize("read", [load_model, model_card])
@pytest.mark.parametrize("content", _DAMAGED_CARDS.values(), ids=_DAMAGED_CARDS)
def test_card_that_is_none_is_refused(saved, content, read):
    saved.with_suffix(".json").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=r"^model: .*net\.json is no model card: "):
        read(saved)


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"no packaged model is called 'nonesuch' \(there are \["):
        load_model("nonesuch")


def test_unknown_config_field_is_named(saved):
    config = model_card(saved)["config"]
    _edit_card(saved, config=config | {"colour": "blue"})
    with pytest.raises(ValueError, match=r"net\.json: .*unknown fields \['colour'\]"):
        load_model(saved)


@pytest.mark.parametrize(
    "change",
    [
        {"regions": 0},
        {"regions": "many"},
        {"regions": 2.5},
        {"variant": "Z"},
        {"variant": []},
        {"encoder_widths": 3},
        {"encoder_widths": [True]},
        {"encoder_widths": [[1]]},
    ],
    ids=str,
)
def test_impossible_config_is_refused_and_its_file_is_named(saved, change):
    config = model_card(saved)["config"]
    _edit_card(saved, config=config | change)
    with pytest.raises(ValueError, match=r"^model: .*net\.json: "):
        load_model(saved)


def test_config_of_another_network_is_refused(saved):
    config = model_card(saved)["config"]
    _edit_card(saved, config=config | {"regions": 5})
    with pytest.raises(ValueError, match="shape"):
        load_model(saved)


def test_card_of_an_unknown_model_is_refused():
    with pytest.raises(ValueError, match="nonesuch"):
        model_card("nonesuch")


@pytest.mark.parametrize("name", available_models() or [pytest.param("", marks=pytest.mark.skip("none packaged"))])
def test_packaged_models_load_and_are_small(name):
    model = load_model(name)
    assert 4 * sum(leaf.size for leaf in jax.tree.leaves(model.params)) < 5 * 2**20
