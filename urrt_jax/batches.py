"""Registration of many pairs: lists of clouds of any sizes, small ones in batches."""

import dataclasses
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from typing import Any, Literal, overload

import jax
import numpy as np
from jax.typing import ArrayLike
from tqdm import tqdm

from urrt_jax.assessment.alternatives import KEPT
from urrt_jax.checks import check_whole
from urrt_jax.clouds import CloudLike, as_array, check_cloud
from urrt_jax.host import PairOnHost
from urrt_jax.model.network import Model
from urrt_jax.programs import thread_settings
from urrt_jax.refine import ICP
from urrt_jax.registration import check_options, check_rigid, make_options, register_on_host, start_compiling
from urrt_jax.result import OtherPoses, Outcome, Registration
from urrt_jax.rigid import Rigid
from urrt_jax.search import Search
from urrt_jax.stages import Options, register_in_frame, rung

LARGEST_IN_BATCHES = 4096
"""The most points of clouds that are registered in batches: larger ones keep all cores busy by themselves."""

_FEW = 2  # pairs of a rung that are not worth a program of their own
_AT_ONCE = 2  # batches: what one leaves idle, between the steps of its loops and on the host, the other uses
_BATCH_ON_CPU = 32  # twice as many leave the caches of a CPU, and take an eighth longer each
_BATCH = 64  # on an accelerator; a guess, for which two matrices of 4,096² distances a pair fit into 16 GiB
_FILLS = {"correspondences": -1, "source_regions": 0, "target_regions": 0}


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Registrations(Sequence[Registration]):
    """What ``register_pairs`` returns: a sequence of B ``Registration``s in the order of the pairs.

    ``found[i]`` is the result of pair i, whose arrays are NumPy arrays. ``found.results`` is all of them as one
    ``Registration`` with a leading axis, and ``found.rotation``, (B, 3, 3), and the other properties are its arrays.

    Attributes:
      results: each array has a leading axis B. ``correspondences`` and the regions are padded to the longest cloud with
        -1 and 0.
      reasons: for each pair, "converged", or in words why it has not; with a question about units where one cloud is
        more than five times as large as the other. A pair that can't be registered has the outcome
        ``Outcome.REFUSED`` and the message of the ``ValueError`` that ``register`` raises for it.
      sizes: (B, 2) int, how many points the source and the target of each pair have.
    """

    results: Registration
    reasons: list[str]
    sizes: np.ndarray

    def __repr__(self) -> str:
        """A line."""
        return f"Registrations({len(self)} pairs, {int(self.converged.sum())} of them converged)"

    def __len__(self) -> int:
        """The number of pairs."""
        return len(self.reasons)

    @overload
    def __getitem__(self, index: int) -> Registration: ...
    @overload
    def __getitem__(self, index: slice) -> "Registrations": ...
    def __getitem__(self, index: int | slice) -> "Registration | Registrations":
        """The result of one pair, with an entry for each of its points; or some of the pairs."""
        if isinstance(index, slice):
            some = jax.tree.map(lambda leaf: leaf[index], self.results)
            return Registrations(some, self.reasons[index], self.sizes[index])
        one = jax.tree.map(lambda leaf: leaf[index], self.results)
        source, target = self.sizes[index]
        lengths = {"correspondences": source, "source_regions": source, "target_regions": target}
        return dataclasses.replace(one, **{name: getattr(one, name)[:size] for name, size in lengths.items()})

    def __iter__(self) -> Iterator[Registration]:
        """The results one by one."""
        return (self[index] for index in range(len(self)))

    @property
    def rotation(self) -> np.ndarray:
        """(B, 3, 3)."""
        return np.asarray(self.results.rotation)

    @property
    def translation(self) -> np.ndarray:
        """(B, 3) float64, in the input's units."""
        return np.asarray(self.results.translation)

    @property
    def matrix(self) -> np.ndarray:
        """(B, 4, 4) float64."""
        return np.asarray(self.results.matrix)

    @property
    def fitness(self) -> np.ndarray:
        """(B,), in [0, 1]."""
        return np.asarray(self.results.fitness)

    @property
    def confidence(self) -> np.ndarray:
        """(B,), in [0, 1]."""
        return np.asarray(self.results.confidence)

    @property
    def converged(self) -> np.ndarray:
        """(B,) bool."""
        return np.asarray(self.results.converged)


def register_pairs(
    sources: Sequence[CloudLike],
    targets: Sequence[CloudLike],
    *,
    model: Model | None = None,
    refine: ICP | None = ICP(),
    search: Search | Literal["auto"] | None = "auto",
    initials: Sequence[ArrayLike | None] | None = None,
    inlier_distance: float | None = None,
    batch: int | None = None,
    progress: bool = False,
) -> Registrations:
    """The registrations of B pairs, in their order: ``targets[i] ≈ R[i] @ sources[i] + t[i]``.

    Each is what ``register`` returns for that pair, up to rounding. Clouds of at most 4,096 points are registered in
    batches of one rung of the ladder of sizes (256, 1,024, 4,096), larger ones one by one. A pair that can't be
    registered, because a cloud holds NaN, say, never stops the others: it gets the identity, confidence 0, and its
    reason in words.

    Args:
      sources: B clouds (N_i, 3), as for ``register``.
      targets: B clouds (M_i, 3).
      model: as for ``register``.
      refine: as for ``register``.
      search: as for ``register``. Pairs of a batch that need a search are searched one by one.
      initials: for each pair a rough transform (4, 4) or None, as ``initial`` of ``register``; None for no pair.
      inlier_distance: as for ``register``, for all pairs.
      batch: pairs at once, 1 for one by one; by default 32 on a CPU and 64 on an accelerator. A batch that is not full
        takes as long as a full one.
      progress: shows a bar on stderr.

    Returns:
      A sequence of B ``Registration``s, and their arrays with a leading axis: ``found[0].rotation`` is (3, 3), and
      ``found.rotation`` (B, 3, 3).

    Example:
      >>> import numpy as np
      >>> import urrt_jax
      >>> from urrt_jax.data import demo_shape
      >>> source = demo_shape(200)
      >>> found = urrt_jax.register_pairs([source, source[:2]], [source + 5.0, source])
      >>> found
      Registrations(2 pairs, 1 of them converged)
      >>> found.translation.round(2) + 0.0
      array([[5., 5., 5.],
             [0., 0., 0.]])
      >>> found.reasons
      ['converged', 'source: a pose needs at least 3 distinct points, got 2 among 2']

    Raises:
      ValueError: the lists are empty or of different lengths, or an option is wrong.
    """
    sources, targets = list(sources), list(targets)
    starts = [None] * len(sources) if initials is None else list(initials)
    lengths = {"sources": len(sources), "targets": len(targets), "initials": len(starts)}
    if not sources or len(set(lengths.values())) > 1:
        raise ValueError(f"sources, targets and initials: expected lists of one length, at least 1, got {lengths}")
    check_options(model, refine, search, inlier_distance)
    if batch is None:
        batch = pairs_at_once()
    check_whole(_Asked(batch), batch=1)
    options = make_options(model, refine, search)

    found: dict[int, Registration] = {}
    reasons: dict[int, str] = {}
    waiting: dict[tuple[int, np.dtype], dict[int, PairOnHost]] = {}  # for a batch of their rung and dtype to be full
    in_batches = set()
    bar = tqdm(total=len(sources), desc="registering", unit="pair", file=sys.stderr, disable=not progress)
    with bar, _Workers(bar.update) as workers:

        def run(pairs: dict[int, PairOnHost], size: int, together: bool) -> int:
            each = (
                _register_batch(options, list(pairs.values()), size, batch)
                if together
                else (register_on_host(options, pair) for pair in pairs.values())
            )
            for index, result in zip(pairs, each, strict=True):
                found[index] = result
                if not result.converged and (hint := pairs[index].units_hint()):
                    reasons[index] = f"{result.reason}; {hint}"
            return len(pairs)

        for index, given in enumerate(zip(sources, targets, starts, strict=True)):
            try:
                pair = _check_pair(*given, inlier_distance)
            except ValueError as error:
                reasons[index] = str(error)
                found[index] = _refused(*map(_length, given[:2]))
                bar.update()
                continue
            key = size, _ = rung(pair.size), pair.dtype
            if size > LARGEST_IN_BATCHES or batch == 1:
                bar.update(run({index: pair}, size, together=False))
                continue
            group = waiting.setdefault(key, {})
            group[index] = pair
            if len(group) == batch:
                workers.start(run, waiting.pop(key), size, together=True)
                in_batches.add(key)
        for key, group in waiting.items():
            workers.start(run, group, key[0], together=key in in_batches or len(group) > _FEW)

    ordered = [found[index] for index in range(len(sources))]
    sizes = np.array([[len(each.source_regions), len(each.target_regions)] for each in ordered])
    said = [reasons.get(index) or str(each.reason) for index, each in enumerate(ordered)]
    return Registrations(_stack(ordered), said, sizes)


def pairs_at_once() -> int:
    """How many pairs a batch has by default, on the device in use."""
    return _BATCH_ON_CPU if jax.default_backend() == "cpu" else _BATCH


class _Workers:
    """A few threads, in which batches are registered at once; their results are passed to ``done``.

    Settings of JAX that a context manager makes belong to one thread: where there are any, all is done in this one.
    """

    def __init__(self, done: Callable[[Any], Any]) -> None:
        self._done = done
        self._running: set[futures.Future] = set()
        self._pool = futures.ThreadPoolExecutor(_AT_ONCE)
        self._alike = self._pool.submit(thread_settings).result() == thread_settings()

    def __enter__(self) -> "_Workers":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, where: Any) -> None:
        try:
            if error is None:
                self._wait(0)
        finally:
            self._pool.shutdown(cancel_futures=True)

    def start(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> None:
        """Calls the function in a thread, when one is free; raises what an earlier call raised."""
        if not self._alike:
            self._done(function(*arguments, **named))
            return
        self._wait(_AT_ONCE - 1)
        self._running.add(self._pool.submit(function, *arguments, **named))

    def _wait(self, most: int) -> None:
        """Returns when at most so many calls are running."""
        while len(self._running) > most:
            # Short waits let Ctrl-C through on every system.
            done, self._running = futures.wait(self._running, timeout=0.1, return_when=futures.FIRST_COMPLETED)
            for each in done:
                self._done(each.result())


@dataclasses.dataclass(frozen=True)
class _Asked:
    batch: Any


def _check_pair(source: Any, target: Any, initial: Any, inlier_distance: float | None) -> PairOnHost:
    source, target = as_array(source, "source"), as_array(target, "target")
    check_cloud(source, None, "source")
    check_cloud(target, None, "target")
    if initial is not None:
        check_rigid(initial)
    return PairOnHost(source, target, initial=initial, inlier_distance=inlier_distance)


def _register_batch(options: Options, pairs: list[PairOnHost], size: int, batch: int) -> Iterator[Registration]:
    """The results of at most ``batch`` pairs of one rung."""
    start_compiling(options, size, pairs[0].dtype, batch)
    # Copies fill the batch up, so that one program serves all.
    padded = [pair.padded(size) for pair in pairs + pairs[-1:] * (batch - len(pairs))]
    source, target, told = jax.tree.map(lambda *leaves: np.stack(leaves), *padded)
    outputs = jax.device_get(register_in_frame(options, source, target, told, batch=len(pairs)))
    for row, pair in enumerate(pairs):
        # A leaf without axes is the same for all pairs.
        yield pair.restore(jax.tree.map(lambda leaf, row=row: leaf[row] if np.ndim(leaf) else leaf, outputs))


def _refused(source: int, target: int) -> Registration:
    """The result for a pair that can't be registered, of clouds of so many points."""
    zero: Any = np.float32(0.0)
    turn: Any = np.eye(3, dtype=np.float32)
    shift: Any = np.zeros(3)
    others: Any = np.broadcast_to(turn, (KEPT, 3, 3)), np.zeros((KEPT, 3)), np.zeros(KEPT, np.float32)
    fields: dict[str, Any] = dict(
        rotation=turn,
        translation=shift,
        fitness=zero,
        rmse=zero,
        inlier_distance=zero,
        overlap=np.zeros(2, np.float32),
        confidence=zero,
        converged=np.bool_(False),
        outcome=np.int32(Outcome.REFUSED),
        correspondences=np.full(source, -1, np.int32),
        information=np.zeros((6, 6)),
        covariance=np.diag(np.full(6, np.inf)),
        alternatives=OtherPoses(*others),
        source_regions=np.zeros(source, np.int32),
        target_regions=np.zeros(target, np.int32),
        coarse=Rigid(turn, shift),
        steps=np.int32(0),
    )
    return Registration(**fields)


def _length(cloud: Any) -> int:
    """How many points a cloud has that need not be one."""
    try:
        return len(as_array(cloud, "cloud"))
    except (ValueError, TypeError):
        return 0


def _stack(results: list[Registration]) -> Registration:
    """One ``Registration`` with a leading axis, in which shorter arrays are padded."""
    padded = {}
    for name, fill in _FILLS.items():
        values = [np.asarray(getattr(each, name)) for each in results]
        whole = np.full((len(values), max(map(len, values))), fill, np.int32)
        for row, value in zip(whole, values, strict=True):
            row[: len(value)] = value
        padded[name] = whole
    same = [dataclasses.replace(each, **dict.fromkeys(_FILLS, np.zeros(0, np.int32))) for each in results]
    return dataclasses.replace(jax.tree.map(lambda *leaves: np.stack(leaves), *same), **padded)
