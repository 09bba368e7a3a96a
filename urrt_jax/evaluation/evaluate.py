"""Evaluation of a method over a protocol, with the values of every item kept, saved and resumed."""

import dataclasses
import hashlib
import json
import os
import time
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from tqdm import tqdm

from urrt_jax.atomic import write_atomically
from urrt_jax.evaluation.interface import InBatches, Method, Poses
from urrt_jax.evaluation.methods import find_method
from urrt_jax.evaluation.metrics import clean_chamfer, pose_errors, summarize, true_overlap
from urrt_jax.evaluation.protocols import Trial, find_protocol
from urrt_jax.rigid import Rigid

_SAVE_EVERY = 20.0  # seconds
_OVERLAP_REACH = 0.1  # scales
_ROTATION_TOLERANCE = 1e-3  # of the entries of R Rᵀ


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The poses a method found for every item, and the truth: every figure and curve can be made from it.

    Attributes:
      method: its title.
      protocol: its name, with its options.
      items: (B,) int, the items evaluated.
      rotations, translations: (B, 3, 3) and (B, 3), float64; the identity where the method failed.
      true_rotations, true_translations: the truth.
      scales: (B,), what recalls compare translations with; 1 for shapes.
      fitness, converged: (B,), what the method says of its result; NaN where it says nothing.
      chamfer: (B,), RPM-Net's clean Chamfer distance; NaN where the clean shape is not known.
      overlap: (B,), the share of source points with a target point within a tenth of the scale, in the true pose.
      seconds: (B,), a pair's share of the time of its batch, without the loading; the first batch compiles.
      failures: item → what went wrong, for each that raised or gave values that are not finite.
      identity: everything the poses depend on, by name.
    """

    method: str
    protocol: str
    items: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    true_rotations: np.ndarray
    true_translations: np.ndarray
    scales: np.ndarray
    fitness: np.ndarray
    converged: np.ndarray
    chamfer: np.ndarray
    overlap: np.ndarray
    seconds: np.ndarray
    failures: dict[int, str]
    identity: dict[str, Any]

    def __len__(self) -> int:
        """The number of items."""
        return len(self.items)

    def take(self, rows: np.ndarray) -> "Evaluation":
        """The evaluation of some of its rows, (K,) int or (B,) bool."""
        values = {name: getattr(self, name)[rows] for name in _ARRAYS}
        kept = set(values["items"].tolist())
        failures = {item: reason for item, reason in self.failures.items() if item in kept}
        return dataclasses.replace(self, **values, failures=failures)

    def errors(self) -> dict[str, np.ndarray]:
        """``pose_errors`` of every item."""
        return pose_errors(self.rotations, self.translations, self.true_rotations, self.true_translations)

    def summary(self) -> dict[str, Any]:
        """The figures over all items, as plain numbers; None where a method or protocol gives none."""
        errors = self.errors()
        wrong = (self.converged > 0) & (errors["angle"] > 5.0)
        known = bool(np.any(np.isfinite(self.converged)))
        return {
            **summarize(errors, self.scales),
            "chamfer_mean": _mean(self.chamfer),
            "fitness_mean": _mean(self.fitness),
            "converged": float(np.mean(self.converged > 0)) if known else None,
            "converged_but_off_by_5deg": float(np.mean(wrong)) if known else None,
            "failures": len(self.failures),
        }

    def save(self, path: str | Path) -> None:
        """Writes every value to a ``.npz``, which ``load_evaluation`` reads."""
        described = {
            "method": self.method,
            "protocol": self.protocol,
            "failures": {str(item): reason for item, reason in self.failures.items()},
            "identity": self.identity,
        }
        content = BytesIO()
        np.savez_compressed(content, **{name: getattr(self, name) for name in _ARRAYS}, described=json.dumps(described))
        write_atomically(path, content.getvalue())


_ARRAYS = tuple(field.name for field in dataclasses.fields(Evaluation) if field.type is np.ndarray)


def load_evaluation(path: str | Path) -> Evaluation:
    """What ``Evaluation.save`` wrote.

    Raises:
      ValueError: the file holds something else, or is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            described = json.loads(str(archive["described"]))
            values = {name: archive[name] for name in _ARRAYS}
        for name in ("method", "protocol"):
            _check_kind(name, described[name], str)
        for name in ("failures", "identity"):
            _check_kind(name, described[name], dict)
        failures = {int(item): str(reason) for item, reason in described["failures"].items()}
        _check_values(values)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # NumPy, zipfile and zlib raise many kinds for damaged archives
        raise ValueError(f"{path}: holds no evaluation, or is damaged ({type(error).__name__}: {error})") from error
    named = {name: described[name] for name in ("method", "protocol", "identity")}
    return Evaluation(**values, **named, failures=failures)


def _check_kind(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        raise ValueError(f"{name}: expected {kind.__name__}, got {type(value).__name__}")


def _check_values(values: dict[str, np.ndarray]) -> None:
    """Refuses arrays of other shapes or kinds than ``Evaluation`` says."""
    rows = values["items"].shape
    shapes = dict.fromkeys(_ARRAYS, ()) | {"rotations": (3, 3), "true_rotations": (3, 3)}
    shapes |= {"translations": (3,), "true_translations": (3,)}
    for name, value in values.items():
        expected = (*rows, *shapes[name])
        if len(rows) != 1 or value.shape != expected:
            raise ValueError(f"{name}: expected shape {expected if len(rows) == 1 else '(B,)'}, got {value.shape}")
        if value.dtype.kind not in ("iu" if name == "items" else "iuf"):
            raise ValueError(f"{name}: expected numbers, got dtype {value.dtype}")


def evaluate(
    method: Any,
    protocol: str,
    data: Any,
    *,
    items: np.ndarray | None = None,
    save: str | Path | None = None,
    batch: int | None = None,
    progress: bool = True,
) -> Evaluation:
    """The evaluation of a method over the items of a protocol.

    Our methods and learned peers run in batches, others pair by pair. An item on which the method raises, or gives
    values that are not finite, is scored as the identity and listed in ``failures``. With ``save`` the values are kept
    in a ``.npz`` all along, also when the run is interrupted, and the same call continues after the last item there.
    Where that file can't be read, it is renamed, and all items are evaluated anew, with a warning.

    Args:
      method: a name as ``find_method`` takes it, a ``Model``, or a function from a source (N, 3)
        and a target (M, 3) to the matrix (4, 4) of the pose.
      protocol: a name in ``PROTOCOLS``, with options: ``"drift sigma=0.02"``.
      data: (S, P, 3) shapes in the unit sphere, item i being shape i; for ``"scans"``, the trials of
        ``load_scan_pairs``.
      items: which items; all by default.
      save: a ``.npz`` to keep the values in.
      batch: pairs at once; the method's own by default.
      progress: whether a progress bar is shown.

    Raises:
      ValueError: an unknown method or protocol, no items, items out of range, or ``save`` holds another evaluation.
      ImportError: the method needs a library or weights that are not there; the message says how to get them.
    """
    method, make = find_method(method), find_protocol(protocol)
    _check_data(protocol, data)
    chosen = np.arange(len(data)) if items is None else np.asarray(items)
    if chosen.ndim != 1 or (len(chosen) and chosen.dtype.kind not in "iu"):
        raise ValueError(f"items: expected whole numbers, (B,), got shape {chosen.shape} and dtype {chosen.dtype}")
    if len(chosen) == 0:
        raise ValueError("items: there is nothing to evaluate")
    if chosen.min() < 0 or chosen.max() >= len(data):
        raise ValueError(f"items: expected indices in 0..{len(data) - 1}, got {chosen.min()}..{chosen.max()}")
    if batch is not None and batch < 1:
        raise ValueError(f"batch: expected at least 1, got {batch}")
    # As JSON has it, so that what is read back compares equal.
    identity = json.loads(json.dumps(method.identity() | {"protocol": protocol, "data": data_digest(data)}))

    parts, kept = [], 0
    before = None if save is None or not Path(save).exists() else _load_or_set_aside(Path(save))
    if before is not None:
        if before.identity != identity or not np.array_equal(before.items, chosen[: len(before)]):
            raise ValueError(f"{save}: holds another evaluation; remove it or choose another name")
        parts, kept = [before], len(before)
    done = kept

    if isinstance(method, InBatches):
        method = method.for_pairs(len(chosen), batch)
    size = min(method.batch if batch is None else batch, len(chosen))
    saved = time.monotonic()
    try:
        with tqdm(total=len(chosen), initial=done, unit="pair", desc=method.title, disable=not progress) as bar:
            while done < len(chosen):
                part = chosen[done : done + size]
                parts.append(_evaluate_part(method, protocol, identity, part, size, make, data))
                done += len(part)
                bar.update(len(part))
                if save is not None and time.monotonic() - saved > _SAVE_EVERY:
                    parts = [_join(parts)]
                    parts[0].save(save)
                    saved = time.monotonic()
    finally:
        if save is not None and done > kept:
            _join(parts).save(save)
    return _join(parts)


def _check_data(protocol: str, data: Any) -> None:
    found = getattr(data, "shape", type(data).__name__)
    if protocol.split()[0] == "scans":
        if not (isinstance(data, Sequence) and all(isinstance(each, Trial) for each in data)):
            raise ValueError(f"data: expected the trials of load_scan_pairs, got {found}")
    elif not (isinstance(data, np.ndarray) and data.ndim == 3 and data.shape[2] == 3):
        raise ValueError(f"data: expected an array (S, P, 3) of shapes, got {found}")


def _load_or_set_aside(path: Path) -> Evaluation | None:
    """The evaluation in a file; None where it can't be read: then it is renamed, with a warning."""
    try:
        return load_evaluation(path)
    except ValueError as error:
        aside = path.with_name(path.name + ".damaged")
        os.replace(path, aside)
        warnings.warn(f"{error}; all items are evaluated anew, and the file is now {aside.name}", stacklevel=3)
        return None


def values_path(folder: Path, name: str, method: Method, protocol: str, data: Any, items: np.ndarray) -> Path:
    """A file for the values of an evaluation, named by the method, the protocol and a digest of all they depend on."""
    described = json.dumps([method.identity(), protocol, data_digest(data), items.tolist()], sort_keys=True)
    digest = hashlib.sha256(described.encode()).hexdigest()[:10]
    stages, _, own = name.partition(":")
    name = f"{stages}-{Path(own).stem}" if own else name
    return folder / f"{protocol.replace(' ', '_')}-{name}-{digest}.npz"


def spread(count: int, limit: int | None, stride: int = 1) -> np.ndarray:
    """At most ``limit`` of so many items, evenly spread: every k-th from the first, k at least ``stride``."""
    if limit is not None and limit < 1:
        raise ValueError(f"limit: expected at least 1, got {limit}")
    return np.arange(0, count, stride if limit is None else max(stride, -(-count // limit)))


def data_digest(data: Any) -> str:
    """A short digest of the values of shapes (S, P, 3) or scans, so that results are never mixed up."""
    state = hashlib.sha256()
    for each in [data] if isinstance(data, np.ndarray) else [array for trial in data for array in trial[:4]]:
        # The poses of scans are computed: machines may round them differently. Adding 0 leaves no negative zero.
        values = each if isinstance(data, np.ndarray) else np.round(np.asarray(each, np.float64), 6) + 0.0
        state.update(np.ascontiguousarray(values).tobytes())
    return state.hexdigest()[:16]


def _evaluate_part(
    method: Method, protocol: str, identity: dict, part: np.ndarray, size: int, make: Any, data: Any
) -> Evaluation:
    trials = [make(data, int(item)) for item in part]
    start = time.perf_counter()
    poses, failures = _align(method, trials, [int(item) for item in part])
    seconds = (time.perf_counter() - start) / len(part)
    chamfer, overlap = _compare(trials, poses, size)
    return Evaluation(
        method=method.title,
        protocol=protocol,
        items=part,
        rotations=poses.rotation,
        translations=poses.translation,
        true_rotations=np.stack([trial.rotation for trial in trials]),
        true_translations=np.stack([trial.translation for trial in trials]),
        scales=np.array([trial.scale for trial in trials]),
        fitness=poses.fitness,
        converged=poses.converged,
        chamfer=chamfer,
        overlap=overlap,
        seconds=np.full(len(part), seconds),
        failures=failures,
        identity=identity,
    )


def _align(method: Method, trials: Sequence[Trial], items: Sequence[int]) -> tuple[Poses, dict[int, str]]:
    """The poses of all trials, the identity where there is none, and the failures by item."""
    poses, reasons = _try(method, trials)
    rotation, translation = poses.rotation.copy(), poses.translation.copy()
    finite = np.asarray(np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1))
    rotation[~finite] = 0.0
    off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2))
    broken = np.logical_not(finite & (off < _ROTATION_TOLERANCE) & (np.linalg.det(rotation) > 0))
    rotation[broken], translation[broken] = np.eye(3), 0.0
    failures = {
        item: reasons.get(row, "no rotation" if finite[row] else "values that are not finite")
        for row, item in enumerate(items)
        if broken[row]
    }
    return Poses(rotation, translation, poses.fitness, poses.converged), failures


def _try(method: Method, trials: Sequence[Trial]) -> tuple[Poses, dict[int, str]]:
    """The poses, NaN where the method raised, and why, by row; a batch that raises is tried again one by one."""
    try:
        informed = {"expected": [trial.expected for trial in trials]} if getattr(method, "informed", False) else {}
        poses = method.align([trial.source for trial in trials], [trial.target for trial in trials], **informed)
        return _checked_poses(poses, len(trials)), {}
    except Exception as error:  # a method may raise anything; it is counted, not hidden
        if len(trials) == 1:
            nothing = np.full(1, np.nan)
            poses = Poses(np.full((1, 3, 3), np.nan), np.full((1, 3), np.nan), nothing, nothing)
            return poses, {0: f"{type(error).__name__}: {str(error) or 'without a message'}"}
    singles = [_try(method, [trial]) for trial in trials]
    poses = Poses(*(np.concatenate(values) for values in zip(*(pose for pose, _ in singles), strict=True)))
    return poses, {row: reasons[0] for row, (_, reasons) in enumerate(singles) if reasons}


def _checked_poses(poses: Any, count: int) -> Poses:
    """The poses in float64, if they are ``count``."""
    if not (isinstance(poses, tuple) and len(poses) == 4):
        raise ValueError(f"the method gave {type(poses).__name__}, expected Poses")
    checked = Poses(*(np.asarray(each, np.float64) for each in poses))
    shapes, expected = [each.shape for each in checked], [(count, 3, 3), (count, 3), (count,), (count,)]
    if shapes != expected:
        raise ValueError(f"the method gave arrays of shapes {shapes}, expected {expected}")
    return checked


def _compare(trials: Sequence[Trial], poses: Poses, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Clean Chamfer distances, NaN where there is no clean shape, and overlaps."""
    count = len(trials)
    if trials[0].clean is None:
        # Scans: their overlap is known to the protocol, and their sizes differ.
        return np.full(count, np.nan), np.full(count, np.nan)
    rows = np.arange(size) % count  # the last batch is filled up with copies, so that one program serves all

    def stacked(values: Any) -> Array:
        return jnp.asarray(np.stack(values)[rows], jnp.float32)

    source, target, rotation, translation, clean = map(stacked, zip(*(trial[:5] for trial in trials), strict=True))
    found, truth = Rigid(stacked(poses.rotation), stacked(poses.translation)), Rigid(rotation, translation)
    chamfer, overlap = _compare_all(source, target, clean, found, truth)
    return np.asarray(chamfer, np.float64)[:count], np.asarray(overlap, np.float64)[:count]


@jax.jit
@jax.vmap
def _compare_all(source: Array, target: Array, clean: Array, found: Rigid, truth: Rigid) -> tuple[Array, Array]:
    return clean_chamfer(source, target, clean, found, truth), true_overlap(source, target, truth, _OVERLAP_REACH)


def _join(parts: Sequence[Evaluation]) -> Evaluation:
    values = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    failures = {item: reason for part in parts for item, reason in part.failures.items()}
    return dataclasses.replace(parts[0], **values, failures=failures)


def _mean(values: np.ndarray) -> float | None:
    """The mean of the values that are there (a failure gives none), or None."""
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else None
