"""Checkpoints by Orbax (v1 API): asynchronous saves, the last and the best kept, whole ones only on restart.

This is the only module that knows Orbax. A checkpoint is the whole ``TrainState``; the configuration lies beside the
checkpoints as JSON and must agree at resume. A checksum of the state is kept with each, so that one whose files were
damaged later is never taken for whole.
"""

import dataclasses
import itertools
import json
import math
import os
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from urrt_jax.atomic import write_atomically
from urrt_jax.training.lock import FolderLock
from urrt_jax.training.state import TrainConfig, TrainState

_METRIC, _CHECKSUM = "validation_loss", "crc32"


class Checkpoints:
    """The checkpoints of one training run, in one folder; a context manager that finishes pending saves.

    A save that was cut off leaves a temporary folder, which never counts as a checkpoint and is removed here. The
    folder is locked until the end: two runs would delete each other's checkpoints.

    Args:
      directory: made if missing.
      config: the run's configuration, written on the first start.
      data: what identifies the data, kept and compared with it; None compares the configuration alone.
      keep: how many of the newest checkpoints stay, beside the best one.

    Raises:
      ValueError: the folder holds a run of another method, or with another configuration (the message lists the fields
        that differ), its configuration is damaged or missing, or another process is training there.
    """

    def __init__(
        self, directory: str | Path, config: TrainConfig, data: dict[str, Any] | None = None, *, keep: int = 2
    ) -> None:
        self.directory = Path(directory).absolute()
        self.directory.mkdir(parents=True, exist_ok=True)
        self._lock = FolderLock(self.directory)
        try:
            _agree(self.directory / "config.json", config, data)
            self._checkpointer = self._open(keep)
        except BaseException:
            self._lock.release()
            raise

    def _open(self, keep: int) -> Any:
        policies = ocp.training.preservation_policies
        # ``BestN`` keeps the end of the ascending order, so the smallest loss comes last when reversed.
        best = policies.BestN(get_metric_fn=_loss, reverse=True, n=1, keep_checkpoints_without_metrics=False)
        options: dict[str, Any] = {
            "save_decision_policy": ocp.training.save_decision_policies.FixedIntervalPolicy(1),
            "preservation_policy": policies.AnyPreservationPolicy([policies.LatestN(keep), best]),
            "cleanup_tmp_directories": True,
        }
        self._drop_damaged_metrics()
        return ocp.training.Checkpointer(str(self._folder), **options)

    def _drop_damaged_metrics(self) -> None:
        """Sets aside metrics that are no JSON object, with a warning: Orbax opens no folder that has such."""
        for path in sorted(self._folder.glob("*/metrics/metrics")):
            try:
                whole = isinstance(json.loads(path.read_bytes()), dict)
            except (ValueError, RecursionError):
                whole = False
            if not whole:
                _set_aside(path, self.directory / "damaged")
                warnings.warn(f"{path} is damaged: the validation loss of this checkpoint is not known", stacklevel=4)

    @property
    def _folder(self) -> Path:
        return self.directory / "checkpoints"

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._checkpointer.close()
        finally:
            self._lock.release()

    def save(self, state: TrainState, validation_loss: float | None = None) -> None:
        """Begins to save ``state`` under its step number; returns before it is on disk."""
        step = int(state.step)
        if self._checkpointer.latest is not None and self._checkpointer.latest.step == step:
            return
        validated = {} if validation_loss is None else {_METRIC: float(validation_loss)}
        self._checkpointer.save_async(step, _as_dict(state), metrics={_CHECKSUM: _checksum(state)} | validated)

    def restore_latest(self, like: TrainState) -> TrainState | None:
        """The newest whole checkpoint, or None when there is none; ``like`` gives structure, shapes and devices.

        Newer ones that are damaged are moved out of the way, into the folder ``damaged``, with a warning.

        Raises:
          ValueError: there are checkpoints, but all are damaged.
        """
        self._checkpointer.wait()
        newest_first = self._checkpointer.checkpoints[::-1]
        state, damaged = self._first_whole(newest_first, like)
        if state is None and damaged:
            raise ValueError(f"{self._folder}: no checkpoint is whole ({'; '.join(damaged.values())})")
        if state is not None and damaged:
            # Where they are, they would keep the run from saving these steps again.
            for step in damaged:
                _set_aside(self._folder / str(step), self.directory / "damaged")
            self._checkpointer.reload()
            warnings.warn(
                f"{self._folder}: training goes on from step {int(state.step)}, because newer checkpoints are damaged "
                f"({'; '.join(damaged.values())}); they are now in {self.directory / 'damaged'}",
                stacklevel=2,
            )
        return state

    def restore_best(self, like: TrainState) -> TrainState | None:
        """The whole checkpoint with the smallest validation loss; the newest one when none was validated.

        Better ones that are damaged are passed over, with a warning; None where all are, or there is none.
        """
        self._checkpointer.wait()
        newest_first = self._checkpointer.checkpoints[::-1]
        ranked = sorted(
            (each for each in newest_first if _METRIC in (each.metrics or {})), key=lambda c: _loss(c.metrics)
        )
        state, damaged = self._first_whole(ranked or newest_first, like)
        if damaged:
            instead = "no other is whole" if state is None else f"that of step {int(state.step)} is used instead"
            warnings.warn(
                f"{self._folder}: the best checkpoint is damaged, {instead} ({'; '.join(damaged.values())})",
                stacklevel=2,
            )
        return state

    def _first_whole(self, checkpoints: Sequence[Any], like: TrainState) -> tuple[TrainState | None, dict[int, str]]:
        """The state of the first of these that is whole, and of those before it: their steps and what is wrong."""
        damaged = {}
        for each in checkpoints:
            try:
                state = TrainState(**self._checkpointer.load(each.step, _abstract(like)))
            except Exception as error:  # Orbax and TensorStore raise many kinds for damaged files
                damaged[each.step] = f"step {each.step}: {_brief(error)}"
                continue
            expected = (each.metrics or {}).get(_CHECKSUM)  # none in checkpoints of earlier versions
            if expected is None or expected == _checksum(state):
                return state, damaged
            damaged[each.step] = f"step {each.step}: its checksum is another"
        return None, damaged


def ranking_loss(loss: float) -> float:
    """The loss to rank by: one that is not a number is the worst."""
    return loss if math.isfinite(loss) else math.inf


def _loss(metrics: dict[str, Any]) -> float:
    loss = metrics.get(_METRIC)
    return ranking_loss(loss) if isinstance(loss, int | float) else math.inf


def _checksum(state: TrainState) -> int:
    """Of the bytes of all leaves."""
    checksum = 0
    for leaf in jax.device_get(jax.tree.leaves(_as_dict(state))):
        checksum = zlib.crc32(np.ascontiguousarray(leaf).tobytes(), checksum)
    return checksum


def _brief(error: Exception) -> str:
    """The kind of an error and the beginning of what it says; Orbax's messages are pages long."""
    said = " ".join(str(error).split())
    return f"{type(error).__name__}: {said if len(said) <= 100 else said[:100] + '…'}"


def _set_aside(path: Path, folder: Path) -> None:
    """Moves a file or folder into a folder, under a name that is free there."""
    folder.mkdir(exist_ok=True)
    names = (f"{path.name}{'' if number == 0 else f'-{number}'}" for number in itertools.count())
    os.replace(path, next(folder / name for name in names if not (folder / name).exists()))


def _as_dict(state: TrainState) -> dict[str, Any]:
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


def _abstract(state: TrainState) -> dict[str, Any]:
    def describe(leaf: jax.Array) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)

    return jax.tree.map(describe, _as_dict(state))


def _agree(path: Path, config: TrainConfig, data: dict[str, Any] | None) -> None:
    """Writes the configuration and the data's fingerprint, or checks them against those already there."""
    # Through JSON and back, so that tuples and lists compare equal.
    ours = json.loads(json.dumps(config.as_dict() | {"data": data}))
    if not path.exists():
        checkpoints = path.parent / "checkpoints"
        if checkpoints.is_dir() and any(each.name.isdigit() for each in checkpoints.iterdir()):
            raise ValueError(f"{path}, which says how the checkpoints beside it were made, is missing")
        write_atomically(path, json.dumps(ours, indent=2) + "\n")
        return
    try:
        theirs = json.loads(path.read_bytes().decode())
        if not isinstance(theirs, dict):
            raise ValueError(f"expected an object, got {type(theirs).__name__}")
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}, which says how the checkpoints beside it were made, is damaged: {error}") from error
    method = theirs.get("method")
    if not isinstance(method, dict):
        raise ValueError(f"{path.parent} holds a run of an earlier version of urrt_jax, which cannot be continued")
    if method.get("name") != config.method.name:
        raise ValueError(f"{path.parent} holds a run of the method {method.get('name')!r}, not {config.method.name!r}")
    if data is None:
        ours["data"] = theirs.get("data")
    before, now = _flatten(theirs), _flatten(ours)
    differing = [
        f"{name}: {before.get(name)!r} there, {now.get(name)!r} now"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name)
    ]
    if differing:
        raise ValueError(f"{path.parent} holds a run with another configuration ({'; '.join(differing)})")


def _flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict):
        return {prefix: tree}
    return {
        k: v for name, sub in tree.items() for k, v in _flatten(sub, f"{prefix}.{name}" if prefix else name).items()
    }
