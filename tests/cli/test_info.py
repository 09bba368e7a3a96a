"""``urrt info``: what it says, and the cache that it clears."""

import json
import platform

import jaxlib
import pytest

import urrt_jax
from urrt_jax import cli


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder with two programs, one thing of training, and one file that is none of ours."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    root = tmp_path / "urrt_jax"
    for name in ("programs/a.program", "programs/b.program", "programs/jax/0.10-abc/step", "programs/notes.txt"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(bytes(500))
    return root


def test_json_has_versions_devices_models_cache_and_extras(cache, capsys):
    assert cli.main(["info", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["versions", "devices", "models", "cache", "extras"]
    assert found["versions"]["urrt_jax"] == urrt_jax.__version__
    assert found["versions"]["jaxlib"] == jaxlib.__version__
    assert found["versions"]["python"] == platform.python_version()
    assert found["devices"]
    assert list(found["models"]) == urrt_jax.available_models()
    assert found["cache"] == {"folder": str(cache / "programs"), "programs": 3, "bytes": 1500}
    assert found["extras"].keys() == {"viz", "data", "peers"}


def test_text_says_how_to_get_what_is_missing(capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "matplotlib" else object())
    assert cli.main(["info"]) == 0
    out = capsys.readouterr().out
    assert "missing matplotlib: pip install 'urrt-jax[viz]'" in out
    assert "3 compiled programs" in out and str(urrt_jax.model_card()["limits"]) in out


def test_clear_cache_removes_what_was_compiled_and_nothing_else(cache, capsys):
    assert cli.main(["info", "--clear-cache", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["cache"]["programs"] == 0
    assert "removed 3 compiled programs" in captured.err
    assert [path.name for path in cache.rglob("*") if path.is_file()] == ["notes.txt"]


def test_an_empty_machine_has_an_empty_cache(cache, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "none"))
    assert cli.main(["info", "--json", "--clear-cache"]) == 0
    assert json.loads(capsys.readouterr().out)["cache"]["programs"] == 0
