"""What can be evaluated: our network, alone and refined, and learned peers, in batches; the others pair by pair."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from urrt_jax.batches import register_pairs
from urrt_jax.evaluation.interface import InBatches, Method, Poses
from urrt_jax.evaluation.learned import find_learned
from urrt_jax.model import Model
from urrt_jax.peers import PEERS, Peer
from urrt_jax.peers.learned.weights import NETWORKS, RELEASED
from urrt_jax.refine import ICP
from urrt_jax.result import Outcome
from urrt_jax.search import Search
from urrt_jax.weights import load_model
from urrt_jax.weights.files import digest

# What each of ours is told (``Ours``).
_OURS: dict[str, dict[str, Any]] = {
    "network": {"refine": None},
    "register": {},
    "plain": {"search": None},
    "search": {"search": Search(max_angle=90.0)},
    "search_near": {"search": Search(max_angle=45.0, preference=0.2, kept=16), "informed": True},
    "search_all": {"search": Search(), "batch": 1},  # scans, each of which takes a time of its own
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ours(InBatches):
    """``register_pairs`` with a model, refined or the network alone.

    Attributes:
      model: the network.
      refine: as for ``register``.
      search: as for ``register``.
      informed: whether it begins at the rotation that the protocol expects (``Trial.expected``).
      name: of the model, for titles.
    """

    model: Model
    refine: ICP | None = ICP()
    search: Search | Literal["auto"] | None = "auto"
    informed: bool = False
    name: str = "model"

    @property
    def title(self) -> str:
        if isinstance(self.search, Search):
            how = "searched about the middle of the protocol's poses" if self.informed else "searched"
        elif self.refine is None:
            how = "network alone"
        else:
            how = "without search" if self.search is None else "register"
        return f"ours, {how} ({self.name})"

    def identity(self) -> dict[str, Any]:
        return {
            "method": "register",
            "parameters_sha256": digest(self.model.params),
            "config": dataclasses.asdict(self.model.config),
            "refine": _plain(self.refine),
            "search": None if self.refine is None and self.search == "auto" else _plain(self.search),
        } | ({"informed": True} if self.informed else {})

    def align(
        self,
        sources: Sequence[np.ndarray],
        targets: Sequence[np.ndarray],
        expected: Sequence[np.ndarray | None] | None = None,
    ) -> Poses:
        """``Method.align``; where it is informed, ``expected`` are the rotations (3, 3) to begin at."""
        initials = None
        if self.informed and expected is not None:
            initials = [None if turn is None else _turned(turn) for turn in expected]
        options: Any = {"refine": self.refine, "search": self.search, "batch": self.batch}
        found = register_pairs(sources, targets, model=self.model, initials=initials, **options)
        refused = np.asarray(found.results.outcome) == Outcome.REFUSED
        if np.any(refused):
            raise ValueError(found.reasons[np.argmax(refused)])
        return Poses(found.rotation, found.translation, found.fitness, found.converged.astype(float))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairByPair:
    """A function of one pair as a method.

    Attributes:
      function: from a source (N, 3) and a target (M, 3), float64, to the matrix (4, 4) of the pose.
      title: how tables call it.
      settings: what its answers depend on.
      peer: where it is one of ``PEERS``, it.
    """

    function: Callable[[np.ndarray, np.ndarray], np.ndarray]
    title: str
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    peer: Peer | None = None

    @property
    def batch(self) -> int:
        return 1

    def identity(self) -> dict[str, Any]:
        """Its title and settings, and the versions of a peer's libraries."""
        versions = {} if self.peer is None else {"versions": self.peer.versions()}
        return {"method": self.title, "settings": self.settings} | versions

    def align(self, sources: Sequence[np.ndarray], targets: Sequence[np.ndarray]) -> Poses:
        pairs = zip(sources, targets, strict=True)
        found = np.stack(
            [self._matrix(source.astype(np.float64), target.astype(np.float64)) for source, target in pairs]
        )
        unknown = np.full(len(found), np.nan)
        return Poses(found[:, :3, :3], found[:, :3, 3], unknown, unknown)

    def _matrix(self, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        answer = self.function(source, target)
        try:
            matrix = np.asarray(answer, np.float64)
        except (TypeError, ValueError):
            found = type(answer).__name__
        else:
            if matrix.shape == (4, 4):
                return matrix
            found = f"an array of shape {matrix.shape}" if matrix.ndim else type(answer).__name__
        raise ValueError(f"{self.title} gave {found} instead of a matrix (4, 4)")


def find_method(method: "str | Method | Model | Peer | Callable", *, model: str | Path = "modelnet40") -> Method:
    """The method of a name, a model, or a function of one pair that returns the (4, 4) matrix of the pose.

    Args:
      method: ``"network"``, ``"register"``, ``"plain"`` and ``"search"`` are ours: the network alone, ``register`` as
        it is by default, without a search, and always after a search over rotations up to 90°, which hold the
        protocols' own (``"search_all"``: over all rotations, for scans; ``"search_near"``: about the middle of the
        protocol's own, which learned methods know from training); a model of its own may follow, as in
        ``"network:modelnet40-paper"``. Learned peers are the names in ``RELEASED``, with weights that the method reads
        when it is used, and ``"NAME:FILE"`` for a name in ``NETWORKS``, with weights that ``urrt train`` wrote. The
        others are the names in ``PEERS``.
      model: what ours uses where the name says nothing of it: a packaged name or a file.

    Raises:
      ValueError: there is no such method or model, or the file holds no weights of that network.
    """
    if isinstance(method, Model):
        return Ours(model=method)
    if isinstance(method, Peer):
        return PairByPair(function=method.align_pair, title=method.title, settings=method.settings, peer=method)
    if isinstance(method, str):
        stages, colon, own = method.partition(":")
        if stages in _OURS and bool(colon) == bool(own):
            used = own or model
            return Ours(model=load_model(used), name=_short_name(used), **_OURS[stages])
        if stages in NETWORKS | RELEASED and bool(colon) == bool(own):
            return find_learned(stages, own or None)
        if method not in PEERS:
            ours, learned, others = map(", ".join, (_OURS, RELEASED | NETWORKS, PEERS))
            raise ValueError(
                f"method: expected one of {ours} (or one with :MODEL), {learned} (a network's name may have :FILE), "
                f"{others}, got {method!r}"
            )
        return find_method(PEERS[method])
    if hasattr(method, "align"):
        return method  # type: ignore[return-value]
    if not callable(method):
        raise ValueError(f"method: expected a name, a Model, a peer or a function, got {method!r:.80}")
    name = getattr(method, "__name__", "function")
    return PairByPair(function=method, title=name, settings={"function": getattr(method, "__qualname__", name)})


def _short_name(model: str | Path) -> str:
    """What titles call a model: the name of its run, where training wrote "model.npz"."""
    path = Path(model)
    return path.parent.name if path.stem == "model" and path.parent.name else path.stem


def _plain(options: Any) -> Any:
    """A dataclass of options as names and plain numbers, whatever arrays it holds; anything else as it is."""
    if not dataclasses.is_dataclass(options):
        return options
    return {field.name: np.asarray(getattr(options, field.name)).tolist() for field in dataclasses.fields(options)}


def _turned(rotation: np.ndarray) -> np.ndarray:
    """The transform (4, 4) that turns."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    return matrix
