"""Weights of learned peers: those that were released, and those that were trained by ``urrt train``.

Released weights are not part of the package. They are read from the folder ``peers`` of the folder that the environment
variable URRT_DATA names. Trained ones are two files of the format of ``urrt_jax.weights``, with parameters in float16.
"""

import dataclasses
import functools
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from urrt_jax.peers.learned.dcp import DCP
from urrt_jax.peers.learned.deepgmr import DeepGMR
from urrt_jax.peers.learned.network import Network
from urrt_jax.peers.learned.pointnetlk import PointNetLK, PointNetLKRevisited
from urrt_jax.peers.learned.prnet import PRNet
from urrt_jax.peers.learned.rienet import RELEASES, RIENet
from urrt_jax.peers.learned.rpmnet import RPMNet
from urrt_jax.training.trainable import Variables
from urrt_jax.weights import files

NETWORKS: dict[str, Network] = {
    network.name: network
    for network in (
        DCP(), DCP(attention=True), PRNet(), RPMNet(), DeepGMR(), PointNetLK(), PointNetLKRevisited(), RIENet()
    )
}  # fmt: skip
"""Every learned peer by its name, with its published settings."""

_ESSENTIALS = ("command", "data", "shapes", "steps", "seconds")
"""What results files repeat of a card."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Release:
    """Weights that somebody has published.

    Attributes:
      network: whose weights they are.
      file: their name in the folder ``peers``: a ``.npz`` with the arrays under the names of the release.
      note: what tables say of them.
      source: the repository on GitHub that holds them.
      licence: of the weights.
      trained_on: what is known of their training.
    """

    network: Network
    file: str
    note: str = "released weights"
    source: str
    licence: str = "MIT"
    trained_on: str

    @property
    def title(self) -> str:
        """How tables call the network with these weights."""
        return f"{self.network.title} ({self.note})"


_RIENET = functools.partial(Release, source="supersyq/RIENet")
_SARODE = functools.partial(Release, network=PointNetLK())

RELEASED: dict[str, Release] = {
    "dcp_v1": Release(
        network=DCP(), file="dcp_v1.npz", source="WangYueFt/dcp", licence="MIT, by its readme",
        trained_on="ModelNet40, clean pairs",
    ),
    "rienet": _RIENET(
        network=RELEASES["modelnet"], file="rienet_modelnet.npz", note="released weights, trained without noise",
        trained_on="ModelNet40, PRNet's crops without noise",
    ),
    "rienet_unseen": _RIENET(
        network=RELEASES["unseen"], file="rienet_unseen.npz", note="released weights, trained on 20 categories",
        trained_on="the first 20 categories of ModelNet40, PRNet's crops without noise",
    ),
    "rienet_7scenes": _RIENET(
        network=RELEASES["7scenes"], file="rienet_7scenes.npz",
        note="released weights, trained on 7Scenes", trained_on="7Scenes",
    ),
    "rienet_icl": _RIENET(
        network=RELEASES["icl"], file="rienet_icl.npz",
        note="released weights, trained on ICL-NUIM", trained_on="ICL-NUIM",
    ),
    "pointnetlk": _SARODE(
        file="pnlk_sarode.npz", note="re-trained by V. Sarode", source="vinits5/PointNetLK",
        trained_on="ModelNet40, by V. Sarode: the authors have released none",
    ),
    "pointnetlk_learning3d": _SARODE(
        file="pnlk_learning3d.npz", note="re-trained for learning3d", source="vinits5/learning3d",
        trained_on="ModelNet40, by V. Sarode: the authors have released none",
    ),
    "pointnetlk_revisited": Release(
        network=PointNetLKRevisited(), file="pnlk_revisited.npz", source="Lilac-Lee/PointNetLK_Revisited",
        trained_on="ModelNet40",
    ),
}  # fmt: skip
"""Released weights by the name of the method. A network without a method of its name has none that can be read here."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Trained:
    """A network with trained variables.

    Attributes:
      network: the settings.
      variables: float32 arrays, as ``network.init`` makes them.
      title: how tables call it.
      origin: where the variables are from, for results files.
    """

    network: Network
    variables: Variables
    title: str
    origin: dict[str, Any]

    @functools.cached_property
    def sha256(self) -> str:
        """The digest of the variables."""
        return files.digest(self.variables)

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that its answers depend on, for results files."""
        return {
            "method": self.network.name,
            "settings": dataclasses.asdict(self.network),
            "variables_sha256": self.sha256,
        } | self.origin


def load_released(name: str) -> Trained:
    """The network with the released weights of this name in ``RELEASED``.

    Raises:
      ImportError: there are none, or they are not on this machine; the message says what to do.
      ValueError: there is no such method, or the file does not hold its weights.
    """
    if name not in RELEASED:
        if name not in NETWORKS:
            raise ValueError(f"method: expected one of {', '.join(NETWORKS | RELEASED)}, got {name!r}")
        raise ImportError(
            f"{NETWORKS[name].title} has no released weights that can be read here: train it with "
            f"'urrt train --method {name} --out DIR', and name the method {name}:DIR/model.npz"
        )
    release = RELEASED[name]
    place = f"set the environment variable URRT_DATA to a folder that holds peers/{release.file}"
    folder = os.environ.get("URRT_DATA")
    if not folder:
        raise ImportError(f"the released weights of {release.network.title} are not in the package: {place}")
    path = Path(folder) / "peers" / release.file
    if not path.is_file():
        raise ImportError(f"URRT_DATA has no file peers/{release.file}: {place} (from github.com/{release.source})")
    try:
        variables = release.network.from_release(files.read_archive(path))
    except ValueError as error:
        raise ValueError(f"{path}: holds no released weights of {release.network.title} ({error})") from error
    about = {each: getattr(release, each) for each in ("file", "source", "licence", "trained_on")}
    return Trained(network=release.network, variables=variables, title=release.title, origin={"released": about})


def save_network(network: Network, variables: Variables, path: str | Path, card: dict[str, Any] | None = None) -> Path:
    """Writes the two files of a trained network and returns the path of the ``.npz``.

    Parameters are rounded to float16, which halves the file; the statistics of batch norm are kept in float32.

    Args:
      network: the settings.
      variables: as ``network.init`` makes them.
      path: of either file, or of both without the ending.
      card: what to record besides.

    Raises:
      ValueError: a value is not finite, or too large for float16.
    """
    arrays = {}
    for key, leaf in files.flatten(variables).items():
        with np.errstate(over="ignore"):  # said below, with the name of the array
            arrays[key] = np.asarray(leaf).astype(_stored(key))
        if not np.all(np.isfinite(arrays[key])):
            raise ValueError(f"variables: {key} holds values that are not finite numbers of {arrays[key].dtype}")
    described = {"method": network.name, "config": dataclasses.asdict(network)}
    return files.write_files(path, arrays, (card or {}) | described)


def load_network(path: str | Path) -> Trained:
    """The trained network in these files, which ``save_network`` wrote; ``path``: of either.

    Raises:
      ValueError: a file is missing, unreadable or not the one its card describes (hash), or holds other arrays than
        the network of its configuration.
    """
    weights, card_path = files.sibling(path, ".npz"), files.sibling(path, ".json")
    arrays, card = files.read_files(weights, card_path)
    network = _network(card, card_path)
    try:
        expected = files.flatten(jax.eval_shape(network.init, jax.random.key(0)))
    except Exception as error:  # a configuration of impossible numbers fails anywhere
        raise ValueError(f"model: {card_path}: no network has this configuration ({error})") from error
    files.check_arrays(arrays, expected, weights, dtype=_stored)
    variables = files.unflatten({key: leaf.astype(np.float32) for key, leaf in arrays.items()})
    about = {key: card[key] for key in _ESSENTIALS if key in card}
    return Trained(network=network, variables=variables, title=_title(network, card), origin={"trained": about})


def _stored(key: str) -> type:
    """How the array of a flat key is stored."""
    return np.float16 if key.startswith("params/") else np.float32


def _title(network: Network, card: dict[str, Any]) -> str:
    """The title of a network that was trained by the loop of this project, as far as its card tells."""
    training = card.get("training")
    training = training if isinstance(training, dict) else {}
    pairs = training.get("pairs")
    steps, batch = card.get("steps"), training.get("batch")
    facts = []
    if isinstance(pairs, dict) and isinstance(pairs.get("points"), int):
        facts.append(f"{pairs['points']} points")
    if isinstance(steps, int) and isinstance(batch, int):
        facts.insert(0, f"{steps * batch:,} pairs")
    if isinstance(seconds := card.get("seconds"), int | float):
        facts.append(f"{seconds / 60:.0f} min" if seconds < 3600 else f"{seconds / 3600:.1f} h")
    return f"{network.title} (trained here{': ' if facts else ''}{', '.join(facts)})"


def _network(card: dict[str, Any], path: Path) -> Network:
    """The network that a card names, with the settings of its configuration."""
    method, config = card.get("method"), card["config"]
    if not isinstance(method, str) or method not in NETWORKS:
        found = f"got {method!r:.80}" if "method" in card else "which is missing"
        raise ValueError(
            f"model: {path} is the card of no learned peer: expected one of {', '.join(NETWORKS)} as 'method', {found}"
        )
    default = NETWORKS[method]
    known = dataclasses.asdict(default)
    if unknown := sorted(config.keys() - known.keys()):
        raise ValueError(f"model: {path}: {default.title} has no settings {unknown}")
    values = {name: _as_setting(value, known[name], f"model: {path}: {name}") for name, value in config.items()}
    try:
        network = dataclasses.replace(default, **values)
    except ValueError as error:
        raise ValueError(f"model: {path}: {error}") from error
    if network.name != method:
        raise ValueError(f"model: {path}: its settings are those of {network.name}, not of {method}")
    return network


def _as_setting(value: Any, default: Any, name: str) -> Any:
    """The value as JSON has it, as a setting of the kind of its default."""
    if isinstance(default, tuple) and isinstance(value, list) and value:
        return tuple(_as_setting(each, default[0], name) for each in value)
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if type(value) is not type(default):
        raise ValueError(f"{name} expects {type(default).__name__}, got {value!r:.80}")
    return value
