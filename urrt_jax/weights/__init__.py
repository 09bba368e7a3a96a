"""Trained weights: the ones in the package, and reading and writing your own.

A model is two files of one name: ``.npz`` with the parameters under flat keys ("encoder/Perceptron_0/Dense_0/kernel"),
and ``.json``, its card: configuration, training data and command, metrics, and the SHA-256 of the ``.npz``. No pickle.
"""

import functools
import json
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np

from urrt_jax.model import Model, ModelConfig, init_model
from urrt_jax.weights.files import check_arrays, flatten, read_card, read_files, sibling, unflatten, write_files

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
    return _read(sibling(path, ".npz"), sibling(path, ".json"))


def model_card(source: str | Path = DEFAULT) -> dict[str, Any]:
    """What is recorded about a model: its configuration, data, command, log summary and metrics.

    Raises:
      ValueError: no such model, or a file that is no model card.
    """
    if isinstance(source, str) and source in available_models():
        return json.loads((resources.files("urrt_jax.weights") / f"{source}.json").read_text())
    path = sibling(source, ".json")
    if not path.is_file():
        raise ValueError(f"model: {path} does not exist, and no packaged model has this name ({available_models()})")
    return read_card(path)


def save_model(model: Model, path: str | Path, card: dict[str, Any] | None = None) -> Path:
    """Writes the two files of a model and returns the path of the ``.npz``; ``card``: what to record besides."""
    described = {"config": json.loads(model.config.to_json())}
    return write_files(path, jax.tree.map(np.asarray, flatten(model.params)), (card or {}) | described)


@functools.cache
def _packaged(name: str) -> Model:
    folder = resources.files("urrt_jax.weights")
    with resources.as_file(folder / f"{name}.npz") as weights, resources.as_file(folder / f"{name}.json") as card:
        return _read(weights, card)


def _read(weights: Path, card_path: Path) -> Model:
    arrays, card = read_files(weights, card_path)
    config = _config(card, card_path)
    fresh = jax.eval_shape(lambda: init_model(jax.random.key(0), config))
    check_arrays(arrays, flatten(fresh.params), weights, dtype=lambda key: np.float32)
    return Model(config, unflatten(arrays))


def _config(card: dict[str, Any], path: Path) -> ModelConfig:
    """The configuration of a card."""
    try:
        return ModelConfig.from_dict(card["config"])
    except ValueError as error:
        raise ValueError(f"model: {path}: {error}") from error
    except TypeError as error:  # a number in the place of a list
        raise ValueError(f"model: {path}: its configuration holds a value of the wrong type ({error})") from error
