"""Many registrations in one command: from a table of pairs, or a folder of sources and a target, to a CSV of results.

The results have a row for each pair, in the order of the pairs: ``COLUMNS``. With pandas::

    results = pandas.read_csv("results.csv")
    matrices = results.loc[:, "m00":"m33"].to_numpy().reshape(-1, 4, 4)

With NumPy alone::

    numbers = numpy.loadtxt("results.csv", delimiter=",", skiprows=1, quotechar='"', usecols=range(2, 18))
    matrices = numbers.reshape(-1, 4, 4)

A pair that could not be registered has "nan" for every number, False for ``converged``, and its reason.
"""

from __future__ import annotations

import contextlib
import csv
import functools
import hashlib
import io
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from urrt_jax.atomic import write_atomically
from urrt_jax.batches import LARGEST_IN_BATCHES, pairs_at_once, register_pairs
from urrt_jax.cli.streams import as_sentence, note
from urrt_jax.io import READABLE, read_cloud, read_transform
from urrt_jax.stages import rung

_NUMBERS = ("fitness", "rmse", "overlap_source", "overlap_target", "confidence")
_MATRIX = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
COLUMNS = ("source", "target", *_MATRIX, *_NUMBERS, "converged", "reason", "seconds", "options", "inputs")
"""Of the results. The matrix (4, 4) is m00, m01, …, m33, row by row. ``seconds`` is what the registration took without
reading, in a batch the pair's share. ``options`` says what the pair was registered with, and ``inputs`` is a digest of
the sizes and times of its files and of the initial transform: by these a later run knows what need not be done again.
"""

_ANY_NAME = "surrogateescape"  # how names of files that are no UTF-8 are read and written
_ANY_TEXT = (".csv", ".txt")
_AHEAD = 4  # pairs that are read while others are registered; more large clouds would only take memory
_KEPT = 4  # clouds that stay in memory, because the next pairs may share them
_PATIENCE = 20.0  # a file of many rows takes long to write: saving takes at most one part in so many of the time


class Pair(NamedTuple):
    """Two files to register.

    Attributes:
      source: as it is named in the results.
      target: as it is named in the results.
      files: of source and target, and of the initial transform or None.
      flaw: why the pair can't be registered, where that is known already; else empty.
    """

    source: str
    target: str
    files: tuple[Path, Path, Path | None]
    flaw: str = ""


def pairs_of_table(table: Path) -> list[Pair]:
    """The pairs in a CSV file with columns source, target and, if wanted, initial; other columns are ignored.

    Relative paths are relative to the table's folder.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: it is no such table, or has no rows.
    """
    try:
        text = table.read_text(encoding="utf-8-sig")  # spreadsheets begin a file with a mark
        reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True, strict=True)
        names = [name.strip().lower() for name in reader.fieldnames or ()]
        if not {"source", "target"} <= set(names):
            raise ValueError(
                f"its first line must name columns source and target, separated by a comma; it has {names}"
            )
        reader.fieldnames = names
        pairs = [_pair_of_row(table.parent, row, reader.line_num) for row in reader]
    except FileNotFoundError as error:
        raise FileNotFoundError(f"--pairs: {table}: no such file") from error
    except (ValueError, csv.Error, OSError) as error:
        reason = "it is no UTF-8 text" if isinstance(error, UnicodeError) else as_sentence(error)
        raise ValueError(f"--pairs: {table} is no table of pairs: {reason}") from error
    if not pairs:
        raise ValueError(f"--pairs: {table} names no pairs below its first line")
    return pairs


def _pair_of_row(folder: Path, row: Mapping[Any, Any], line: int) -> Pair:
    source, target, initial = ((row.get(name) or "").strip() for name in ("source", "target", "initial"))
    missing = [name for name, cell in (("source", source), ("target", target)) if not cell]
    flaw = f"line {line} of the table names no {' and no '.join(missing)}" if missing else ""
    if None in row:
        flaw = f"line {line} of the table has more cells than the first line"
    files = [folder / Path(name).expanduser() if name else None for name in (source, target, initial)]
    return Pair(source, target, (files[0] or folder, files[1] or folder, files[2]), flaw)


def pairs_of_folder(folder: Path, target: Path, initial: Path | None, *, out: Path | None) -> list[Pair]:
    """Every readable file of a folder, by name, with one target.

    The target itself, the results in ``out`` and hidden files are left out. So are .txt and .csv files beside files of
    other formats, because they may hold anything; stderr says how many these are.

    Raises:
      ValueError: the folder holds no such file.
    """
    known = [path.resolve() for path in (target, out) if path is not None]
    files = (path for path in sorted(folder.iterdir()) if path.is_file() and path.resolve() not in known)
    sources = [path for path in files if path.suffix.lower() in READABLE and not path.name.startswith(".")]
    if not sources:
        raise ValueError(f"{folder}: holds no file to register, of {', '.join(READABLE)}")
    clouds = [path for path in sources if path.suffix.lower() not in _ANY_TEXT]
    if clouds and len(clouds) < len(sources):
        note(f"left out, because they may be no clouds: {len(sources) - len(clouds)} .txt or .csv; see --pairs")
        sources = clouds
    return [Pair(str(source), str(target), (source, target, initial)) for source in sources]


class Results:
    """The rows so far, which a file keeps if one is given.

    Attributes:
      pairs: all that is to be registered; one that is named twice is registered once, and has two rows.
      left: those of them that the file did not hold.
    """

    def __init__(self, pairs: Sequence[Pair], options: str, path: Path | None, *, echo: bool) -> None:
        """Reads what an earlier run has left in the file, and says on stderr what becomes of it.

        Args:
          pairs: what is to be registered.
          options: what they are registered with, in words.
          path: of the file.
          echo: whether rows are printed on stdout where there is no file.

        Raises:
          ValueError: the file holds something else, or results of other options.
        """
        self.pairs, self._options, self._path = pairs, options, path
        self._echo = echo and path is None
        self._keys = {pair: (pair.source, pair.target, _digest(pair)) for pair in self.pairs}
        self._rows: dict[tuple[str, str, str], dict[str, str]] = {}
        self._others: list[dict[str, str]] = []
        if path is not None and path.exists():
            self._take_up(path)
        self.left = [pair for pair, key in self._keys.items() if key not in self._rows]
        self._saved, self._took = time.monotonic(), 0.0

    def _take_up(self, path: Path) -> None:
        wanted, changed = set(self._keys.values()), set()
        named = {key[:2] for key in wanted}
        for row in _read_results(path):
            key = row["source"], row["target"], row["inputs"]
            if key[:2] not in named:
                self._others.append(row)
            elif row["options"] != self._options:
                raise ValueError(
                    f"--out: {path} holds results of other options: {row['options']!r}, now {self._options!r}; "
                    "choose another name, or remove it"
                )
            elif key in wanted:
                self._rows[key] = row
            else:
                changed.add(key[:2])
        done = sum(self._keys[pair] in self._rows for pair in self.pairs)
        note(f"already in {path}, not run again: {_pairs(done)} of {len(self.pairs)}")
        if changed:
            note(f"files or initial transform have changed since, run again: {_pairs(len(changed))}")
        if self._others:
            note(f"in {path} but not asked for now, kept below the others: {_pairs(len(self._others))}")

    def add(self, pair: Pair, row: dict[str, str]) -> None:
        """Takes up the row of one pair."""
        key = self._keys[pair]
        row = {"source": pair.source, "target": pair.target, **row, "options": self._options, "inputs": key[2]}
        self._rows[key] = row
        if self._echo:
            print(_as_csv([row]), end="", flush=True)  # where nobody reads on, the command ends

    def save_if_due(self) -> None:
        """Writes the file, unless it was written so lately that writing would take much of the time."""
        if time.monotonic() - self._saved > _PATIENCE * self._took:
            self.save()

    def save(self) -> None:
        """Writes the file, whole or not at all."""
        if self._path is not None:
            start = time.monotonic()
            text = ",".join(COLUMNS) + "\n" + _as_csv([*self.rows(), *self._others])
            write_atomically(self._path, text.encode("utf-8", _ANY_NAME))
            self._saved = time.monotonic()
            self._took = self._saved - start

    def rows(self) -> list[dict[str, str]]:
        """The rows of the pairs so far, in their order."""
        return [self._rows[self._keys[pair]] for pair in self.pairs if self._keys[pair] in self._rows]


def _pairs(count: int) -> str:
    return "1 pair" if count == 1 else f"{count} pairs"


def _digest(pair: Pair) -> str:
    """What differs if a file of the pair has changed."""
    source, target, initial = pair.files
    state = repr((pair.flaw, _state(source), _state(target))).encode()
    with contextlib.suppress(OSError, ValueError):
        # Small files, which one program may write within the resolution of times.
        state += b"" if initial is None else initial.read_bytes()
    return hashlib.sha256(state).hexdigest()[:12]


def _state(path: Path) -> tuple[int, int] | None:
    """The size of a file and when it was changed; None where there is no such file."""
    try:
        status = path.stat()
    except (OSError, ValueError):  # a name with a null byte is a ValueError
        return None
    return status.st_size, status.st_mtime_ns


def _read_results(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", errors=_ANY_NAME, newline="") as file:
            reader = csv.DictReader(file, strict=True)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise ValueError("its first line is another one")
            rows = list(reader)
        if any(None in row or None in row.values() for row in rows):
            raise ValueError("a row has another number of cells than the first line")
    except (ValueError, csv.Error) as error:
        reason = "it is no UTF-8 text" if isinstance(error, UnicodeError) else error
        raise ValueError(f"--out: {path} exists and is no results file of this command: {reason}") from error
    return rows


def _as_csv(rows: Sequence[dict[str, str]]) -> str:
    text = io.StringIO(newline="")
    csv.DictWriter(text, COLUMNS, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _failed(reason: str) -> dict[str, str]:
    """The row of a pair that could not be registered."""
    return dict.fromkeys((*_MATRIX, *_NUMBERS, "seconds"), "nan") | {"converged": "False", "reason": reason}


def _row(result: Any, reason: str, seconds: float) -> dict[str, str]:
    """The row of a ``Registration``."""
    from urrt_jax import Outcome

    reason = " ".join(reason.split())
    if int(result.outcome) == Outcome.REFUSED:
        return _failed(reason)
    measures = result.fitness, result.rmse, *np.asarray(result.overlap), result.confidence
    return {
        **{name: repr(float(value)) for name, value in zip(_MATRIX, np.ravel(result.matrix), strict=True)},
        **{name: f"{float(value):.6g}" for name, value in zip(_NUMBERS, measures, strict=True)},
        "converged": str(bool(result.converged)),
        "reason": reason,
        "seconds": f"{seconds:.4f}",
    }


class _Loaded(NamedTuple):
    pair: Pair
    source: np.ndarray
    target: np.ndarray
    initial: np.ndarray | None


def register_many(results: Results, *, samples: int, options: Mapping[str, Any]) -> None:
    """Registers the pairs that are left, and saves after each chunk; a pair that fails never stops the others.

    Args:
      results: what is to be done, and where the rows go.
      samples: points to draw on a mesh.
      options: as ``register_pairs`` takes them.
    """
    results.save()  # a file that can't be written is found out before any work
    total, left, at_once = len(results.pairs), len(results.left), pairs_at_once()
    waiting: dict[int, list[_Loaded]] = {}
    bar = tqdm(total=total, initial=total - left, desc="registering", unit="pair", file=sys.stderr, disable=None)

    def add(*rows: tuple[Pair, dict[str, str]]) -> None:
        for pair, row in rows:
            results.add(pair, row)
        results.save_if_due()
        bar.update(len(rows))

    def run(chunk: list[_Loaded]) -> None:
        add(*zip((loaded.pair for loaded in chunk), _register_chunk(chunk, at_once, options), strict=True))

    try:
        with bar, ThreadPoolExecutor(2, thread_name_prefix="urrt reading") as readers:
            for pair, loaded in _read(results.left, readers, samples):
                if isinstance(loaded, str):
                    add((pair, _failed(loaded)))
                    continue
                size = rung(max(len(loaded.source), len(loaded.target)))
                if size > LARGEST_IN_BATCHES:
                    run([loaded])
                    continue
                group = waiting.setdefault(size, [])
                group.append(loaded)
                if len(group) == at_once:
                    run(waiting.pop(size))
            for group in waiting.values():
                run(group)
    finally:
        results.save()


def _register_chunk(chunk: list[_Loaded], batch: int, options: Mapping[str, Any]) -> list[dict[str, str]]:
    """The rows of these pairs, of which so many make a batch."""
    _, sources, targets, initials = zip(*chunk, strict=True)
    start = time.perf_counter()
    try:
        found = register_pairs(sources, targets, initials=initials, batch=batch, **options)
    except Exception as error:  # memory runs out, say: the others may still be registered
        if len(chunk) == 1:
            return [_failed(as_sentence(error))]
        return [row for each in chunk for row in _register_chunk([each], batch, options)]
    seconds = (time.perf_counter() - start) / len(chunk)
    return [_row(result, reason, seconds) for result, reason in zip(found, found.reasons, strict=True)]


def _read(pairs: Sequence[Pair], readers: ThreadPoolExecutor, samples: int) -> Iterator[tuple[Pair, _Loaded | str]]:
    """Each pair with its clouds, or with the reason why they can't be read; the next ones are read meanwhile."""

    @functools.lru_cache(_KEPT)
    def cloud(path: Path) -> Future[np.ndarray]:
        return readers.submit(read_cloud, path, samples=samples)

    def begin(pair: Pair) -> Callable[[], _Loaded | str]:
        if pair.flaw:
            return lambda: pair.flaw
        *clouds, initial = pair.files
        source, target = map(cloud, clouds)

        def finish() -> _Loaded | str:
            try:
                return _Loaded(
                    pair, source.result(), target.result(), None if initial is None else read_transform(initial)
                )
            except Exception as error:  # a damaged file may raise anything
                return as_sentence(error)

        return finish

    begun: deque[tuple[Pair, Callable[[], _Loaded | str]]] = deque()
    for pair in pairs:
        begun.append((pair, begin(pair)))
        if len(begun) > _AHEAD:
            first, finish = begun.popleft()
            yield first, finish()
    for pair, finish in begun:
        yield pair, finish()


def summary(rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    """How many pairs converged, how many did not for which reason, and which could not be registered."""
    failed = [row for row in rows if row["m00"] == "nan"]
    unsure = [row for row in rows if row["m00"] != "nan" and row["converged"] != "True"]
    # What follows a colon is about the one pair, and so is a ratio of scales.
    reasons = Counter(re.sub(r"scale ratio [\d.e+]+: ", "", row["reason"]).partition(": ")[0] for row in unsure)
    return {
        "pairs": len(rows),
        "converged": len(rows) - len(failed) - len(unsure),
        "not_converged": dict(reasons.most_common()),
        "failed": [{name: row[name] for name in ("source", "target", "reason")} for row in failed],
    }


def print_summary(found: Mapping[str, Any]) -> None:
    """Prints a ``summary`` on stderr."""
    for each in found["failed"]:
        note(f"failed: {each['source']} to {each['target']}: {each['reason']}")
    unsure, failed = sum(found["not_converged"].values()), len(found["failed"])
    note(
        f"{_pairs(found['pairs'])}: {found['converged']} converged, {unsure} did not, "
        f"{failed} could not be read or registered"
    )
    for reason, count in found["not_converged"].items():
        note(f"  {count} did not converge: {reason}")


def as_object(row: Mapping[str, str]) -> dict[str, Any]:
    """A row as JSON has it: with the matrix as nested lists, and None for what is not known."""
    failed = row["m00"] == "nan"
    matrix = None if failed else [[float(row[f"m{i}{j}"]) for j in range(4)] for i in range(4)]
    numbers = {name: None if row[name] == "nan" else float(row[name]) for name in (*_NUMBERS, "seconds")}
    return {
        "source": row["source"],
        "target": row["target"],
        "matrix": matrix,
        **numbers,
        "converged": row["converged"] == "True",
        "reason": row["reason"],
    }
