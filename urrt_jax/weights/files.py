"""The two files of a model: ``.npz`` with arrays under flat keys, and ``.json``, its card. No pickle.

The card says what the arrays are: the configuration, what was recorded of the training, and the SHA-256 of the
``.npz``.
"""

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from urrt_jax.atomic import write_atomically

Arrays = dict[str, np.ndarray]
"""The arrays of a tree by flat keys: "encoder/Dense_0/kernel"."""


def flatten(tree: Any) -> dict[str, Any]:
    """The leaves of a tree of dictionaries, by flat keys."""
    return {"/".join(key): leaf for key, leaf in flatten_dict(tree).items()}


def unflatten(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The tree of dictionaries with these leaves: the inverse of ``flatten``."""
    return unflatten_dict({tuple(key.split("/")): leaf for key, leaf in arrays.items()})


def digest(tree: Any) -> str:
    """The SHA-256 of the values of all arrays of a tree, in hexadecimal digits."""
    state = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        state.update(np.ascontiguousarray(leaf).tobytes())
    return state.hexdigest()


def sibling(path: str | Path, ending: str) -> Path:
    """One of a model's two files; only their own endings are replaced, so that "rate0.1" keeps its dot."""
    path = Path(path)
    return path.with_suffix(ending) if path.suffix in (".npz", ".json") else path.with_name(path.name + ending)


def write_files(path: str | Path, arrays: Arrays, card: dict[str, Any]) -> Path:
    """Writes the two files and returns the path of the ``.npz``.

    Args:
      path: of either file, or of both without the ending; its folder is made.
      arrays: what the ``.npz`` holds, by flat keys.
      card: what the ``.json`` says; the number of parameters and the hash are added.
    """
    path = sibling(path, ".npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    content = buffer.getvalue()
    counted = {
        "parameters": int(sum(leaf.size for leaf in arrays.values())),
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    text = json.dumps(card | counted, indent=2) + "\n"
    write_atomically(path, content)
    write_atomically(sibling(path, ".json"), text)
    return path


def read_files(weights: Path, card_path: Path) -> tuple[Arrays, dict[str, Any]]:
    """The arrays and the card of a model.

    Raises:
      ValueError: a file is missing, unreadable or not the one that the card describes.
    """
    for path in (weights, card_path):
        if not path.is_file():
            raise ValueError(f"model: {path} does not exist; a model is a .npz and a .json of one name")
    card = read_card(card_path)
    content = _read_bytes(weights)
    found_hash, expected_hash = hashlib.sha256(content).hexdigest(), card["sha256"]
    if found_hash != expected_hash:
        raise ValueError(
            f"model: {weights} is damaged or not the one its card describes: "
            f"SHA-256 {found_hash[:12]}…, expected {expected_hash[:12]}…"
        )
    return _read_archive(content, weights), card


def read_archive(path: Path) -> Arrays:
    """The arrays in a ``.npz``.

    Raises:
      ValueError: the file cannot be read, or is no archive of arrays.
    """
    return _read_archive(_read_bytes(path), path)


def read_card(path: Path) -> dict[str, Any]:
    """The card in this file, with a configuration that is an object and a hash that is one.

    Raises:
      ValueError: the file is no such card.
    """
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


def check_arrays(
    arrays: Arrays, expected: Mapping[str, jax.ShapeDtypeStruct], path: Path, dtype: Callable[[str], Any]
) -> None:
    """Refuses arrays that are not the expected ones.

    Args:
      arrays: as read.
      expected: the shapes that the configuration asks for, by flat keys.
      path: the file, for messages.
      dtype: how the array of a key is stored.

    Raises:
      ValueError: arrays are missing or unexpected, or one has another shape or dtype, or is not finite.
    """
    missing, unexpected = sorted(expected.keys() - arrays.keys()), sorted(arrays.keys() - expected.keys())
    if missing or unexpected:
        raise ValueError(f"model: {path} does not fit its configuration: missing {missing}, unexpected {unexpected}")
    for key, leaf in arrays.items():
        if leaf.shape != expected[key].shape:
            raise ValueError(f"model: {path}: {key} has shape {leaf.shape}, expected {expected[key].shape}")
        if leaf.dtype != dtype(key):
            raise ValueError(f"model: {path}: {key} has dtype {leaf.dtype}, expected {np.dtype(dtype(key))}")
        if not np.all(np.isfinite(leaf)):
            raise ValueError(f"model: {path}: {key} holds values that are not finite")


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"model: {path} cannot be read ({error.strerror or error})") from error


def _read_archive(content: bytes, path: Path) -> Arrays:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except Exception as error:  # numpy and zipfile raise many kinds for a broken archive
        raise ValueError(f"model: {path} cannot be read ({type(error).__name__}: {error})") from error
