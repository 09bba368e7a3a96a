"""Trained weights: the ones in the package, and reading and writing your own.

A model is two files of one name: ``.npz`` with the parameters under flat keys ("encoder/Perceptron_0/Dense_0/kernel"),
and ``.json``, its card: configuration, training data and command, metrics, and the SHA-256 of the ``.npz``. No pickle.
"""

import functools
import hashlib
import io
import json
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from urrt_jax.atomic import write_atomically
from urrt_jax.model import Model, ModelConfig, init_model

DEFAULT = "modelnet40"
"""The packaged model that ``register`` uses."""


def available_models() -> list[str]:
    """The names of the packaged models."""
    return sorted(
        entry.name[:-5] for entry in resources.files("urrt_jax.weights").iterdir() if entry.name.endswith(".json")
    )


def load_model(source: str | Path = DEFAULT) -> Model:
    """The trained model of this name (see ``available_models``), or the one in this file.

    Packaged models are read once a process.

    Args:
      source: a packaged name, or the path of a ``.npz`` or ``.json`` written by ``save_model``.

    Raises:
      ValueError: no such model, a file that is missing, unreadable or not the one its card describes (hash), or
        parameters that do not fit the configuration (missing, unexpected, wrong shape, not finite).
    """
    if isinstance(source, str) and source in available_models():
        return _packaged(source)
    path = Path(source)
    if path.suffix not in (".npz", ".json"):
        raise ValueError(
            f"model: no packaged model is called {str(source)!r} (there are {available_models()}), "
            "and it is no path to a .npz file"
        )
    return _read(_sibling(path, ".npz"), _sibling(path, ".json"))[0]


def model_card(source: str | Path = DEFAULT) -> dict[str, Any]:
    """What is recorded about a model: its configuration, data, command, log summary and metrics.

    Raises:
      ValueError: no such model, or a file that is no model card.
    """
    if isinstance(source, str) and source in available_models():
        return json.loads((resources.files("urrt_jax.weights") / f"{source}.json").read_text())
    path = _sibling(source, ".json")
    if not path.is_file():
        raise ValueError(f"model: {path} does not exist, and no packaged model has this name ({available_models()})")
    return _read_card(path)


def save_model(model: Model, path: str | Path, card: dict[str, Any] | None = None) -> Path:
    """Writes the two files of a model and returns the path of the ``.npz``; ``card``: what to record besides."""
    path = _sibling(path, ".npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    flat = {"/".join(key): np.asarray(leaf) for key, leaf in flatten_dict(model.params).items()}
    np.savez_compressed(buffer, allow_pickle=False, **flat)
    content = buffer.getvalue()
    described = {
        "config": json.loads(model.config.to_json()),
        "parameters": int(sum(leaf.size for leaf in flat.values())),
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    for target, data in ((path, content), (_sibling(path, ".json"), _as_text((card or {}) | described))):
        write_atomically(target, data)
    return path


def _sibling(path: str | Path, ending: str) -> Path:
    """One of a model's two files; only their own endings are replaced, so that "rate0.1" keeps its dot."""
    path = Path(path)
    return path.with_suffix(ending) if path.suffix in (".npz", ".json") else path.with_name(path.name + ending)


def _as_text(card: dict[str, Any]) -> bytes:
    return (json.dumps(card, indent=2) + "\n").encode()


@functools.cache
def _packaged(name: str) -> Model:
    folder = resources.files("urrt_jax.weights")
    with resources.as_file(folder / f"{name}.npz") as weights, resources.as_file(folder / f"{name}.json") as card:
        return _read(weights, card)[0]


def _read(weights: Path, card_path: Path) -> tuple[Model, dict[str, Any]]:
    for path in (weights, card_path):
        if not path.is_file():
            raise ValueError(f"model: {path} does not exist; a model is a .npz and a .json of one name")
    card = _read_card(card_path)
    config, expected_hash = _config(card, card_path), card["sha256"]
    content = _read_bytes(weights)
    found_hash = hashlib.sha256(content).hexdigest()
    if found_hash != expected_hash:
        raise ValueError(
            f"model: {weights} is damaged or not the one its card describes: "
            f"SHA-256 {found_hash[:12]}…, expected {expected_hash[:12]}…"
        )
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            flat = {key: archive[key] for key in archive.files}
    except Exception as error:  # numpy and zipfile raise many kinds for a broken archive
        raise ValueError(f"model: {weights} cannot be read ({type(error).__name__}: {error})") from error
    _check_parameters(flat, config, weights)
    return Model(config, unflatten_dict({tuple(key.split("/")): leaf for key, leaf in flat.items()})), card


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"model: {path} cannot be read ({error.strerror or error})") from error


def _read_card(path: Path) -> dict[str, Any]:
    """The card in this file, with a configuration that is an object and a hash that is one."""
    try:
        card = json.loads(_read_bytes(path).decode())
    except RecursionError:
        raise ValueError(f"model: {path} is no model card: it is nested too deeply") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"model: {path} is no model card: it is no JSON ({error})") from error
    if not isinstance(card, dict):
        raise ValueError(f"model: {path} is no model card: expected an object, got {type(card).__name__}")
    for name, kind, what in (("config", dict, "an object"), ("sha256", str, "text")):
        if not isinstance(card.get(name), kind):
            found = f"got {card[name]!r:.80}" if name in card else "which is missing"
            raise ValueError(f"model: {path} is no model card: expected {what} as {name!r}, {found}")
    return card


def _config(card: dict[str, Any], path: Path) -> ModelConfig:
    """The configuration of a card."""
    try:
        return ModelConfig.from_dict(card["config"])
    except ValueError as error:
        raise ValueError(f"model: {path}: {error}") from error
    except TypeError as error:  # a number in the place of a list
        raise ValueError(f"model: {path}: its configuration holds a value of the wrong type ({error})") from error


def _check_parameters(flat: dict[str, np.ndarray], config: ModelConfig, path: Path) -> None:
    fresh: Any = flatten_dict(jax.eval_shape(lambda: init_model(jax.random.key(0), config)).params)
    expected = {"/".join(key): leaf.shape for key, leaf in fresh.items()}
    missing, unexpected = sorted(expected.keys() - flat.keys()), sorted(flat.keys() - expected.keys())
    if missing or unexpected:
        raise ValueError(f"model: {path} does not fit its configuration: missing {missing}, unexpected {unexpected}")
    for key, leaf in flat.items():
        if leaf.shape != expected[key]:
            raise ValueError(f"model: {path}: {key} has shape {leaf.shape}, expected {expected[key]}")
        if leaf.dtype != np.float32:
            raise ValueError(f"model: {path}: {key} has dtype {leaf.dtype}, expected float32")
        if not np.all(np.isfinite(leaf)):
            raise ValueError(f"model: {path}: {key} holds values that are not finite")
