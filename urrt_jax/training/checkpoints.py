"""Checkpoints by Orbax (v1 API): asynchronous saves, the last and the best kept, whole ones only on restart.

This is the only module that knows Orbax. A checkpoint is the whole ``TrainState``; the configuration lies beside the
checkpoints as JSON and must agree at resume.
"""

import dataclasses
import json
import math
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
from orbax.checkpoint import v1 as ocp

from urrt_jax.atomic import write_atomically
from urrt_jax.training.state import TrainConfig, TrainState

_METRIC = "validation_loss"


class Checkpoints:
    """The checkpoints of one training run, in one folder; a context manager that finishes pending saves.

    A save that was cut off leaves a temporary folder, which never counts as a checkpoint and is removed here.

    Args:
      directory: made if missing.
      config: the run's configuration, written on the first start.
      data: what identifies the data, kept and compared with it; None compares the configuration alone.
      keep: how many of the newest checkpoints stay, beside the best one.

    Raises:
      ValueError: the folder holds a run with another configuration; the message lists the fields that differ.
    """

    def __init__(
        self, directory: str | Path, config: TrainConfig, data: dict[str, Any] | None = None, *, keep: int = 2
    ) -> None:
        self.directory = Path(directory).absolute()
        self.directory.mkdir(parents=True, exist_ok=True)
        _agree(self.directory / "config.json", config, data)
        policies = ocp.training.preservation_policies
        # ``BestN`` keeps the end of the ascending order, so the smallest loss comes last when reversed.
        best = policies.BestN(get_metric_fn=_loss, reverse=True, n=1, keep_checkpoints_without_metrics=False)
        options: dict[str, Any] = {
            "save_decision_policy": ocp.training.save_decision_policies.FixedIntervalPolicy(1),
            "preservation_policy": policies.AnyPreservationPolicy([policies.LatestN(keep), best]),
            "cleanup_tmp_directories": True,
        }
        self._checkpointer: Any = ocp.training.Checkpointer(str(self.directory / "checkpoints"), **options)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._checkpointer.close()

    def save(self, state: TrainState, validation_loss: float | None = None) -> None:
        """Begins to save ``state`` under its step number; returns before it is on disk."""
        step = int(state.step)
        if self._checkpointer.latest is not None and self._checkpointer.latest.step == step:
            return
        metrics = None if validation_loss is None else {_METRIC: float(validation_loss)}
        self._checkpointer.save_async(step, _as_dict(state), metrics=metrics)

    def restore_latest(self, like: TrainState) -> TrainState | None:
        """The newest whole checkpoint, or None when there is none; ``like`` gives structure, shapes and devices."""
        latest = self._checkpointer.latest
        return None if latest is None else self._restore(latest.step, like)

    def restore_best(self, like: TrainState) -> TrainState | None:
        """The checkpoint with the smallest validation loss; the newest one when none was validated."""
        self._checkpointer.wait()
        validated = [c for c in self._checkpointer.checkpoints if c.metrics is not None]
        if not validated:
            return self.restore_latest(like)
        return self._restore(min(validated, key=lambda c: _loss(c.metrics)).step, like)

    def _restore(self, step: int, like: TrainState) -> TrainState:
        return TrainState(**self._checkpointer.load(step, _abstract(like)))


def ranking_loss(loss: float) -> float:
    """The loss to rank by: one that is not a number is the worst."""
    return loss if math.isfinite(loss) else math.inf


def _loss(metrics: dict[str, float]) -> float:
    return ranking_loss(metrics[_METRIC])


def _as_dict(state: TrainState) -> dict[str, Any]:
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


def _abstract(state: TrainState) -> dict[str, Any]:
    def describe(leaf: jax.Array) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)

    return jax.tree.map(describe, _as_dict(state))


def _agree(path: Path, config: TrainConfig, data: dict[str, Any] | None) -> None:
    """Writes the configuration and the data's fingerprint, or checks them against those already there."""
    # Through JSON and back, so that tuples and lists compare equal.
    ours = json.loads(json.dumps(dataclasses.asdict(config) | {"data": data}))
    if not path.exists():
        write_atomically(path, json.dumps(ours, indent=2) + "\n")
        return
    try:
        theirs = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}, which says how the checkpoints beside it were made, is damaged: {error}") from error
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
