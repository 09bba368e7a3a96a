"""The training loop: steps, log, validation, checkpoints; it can be killed at any moment and started again."""

import dataclasses
import json
import signal
import threading
import time
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from tqdm import tqdm

from urrt_jax.atomic import write_atomically
from urrt_jax.checks import check_positive, check_whole
from urrt_jax.data import Shapes
from urrt_jax.training.checkpoints import Checkpoints, ranking_loss
from urrt_jax.training.state import TrainConfig, TrainState, begin_with, init_state
from urrt_jax.training.step import train_steps
from urrt_jax.training.trainable import Variables
from urrt_jax.training.validation import validate, validation_pairs
from urrt_jax.weights.files import digest


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How a run is watched; nothing here changes the weights, except by stopping early.

    Attributes:
      every: steps between validations; each is followed by a checkpoint.
      log_every: steps between lines of the log.
      validation_pairs: pairs of each kind in a validation.
      patience: validations without a better one after which training stops; 0 never stops early.
      minutes: of training in all, stops and continuations included, after which it is validated and stops; they are
        looked at when a line of the log is written. The learning rate follows ``steps`` all the same. None: no limit.
      keep: newest checkpoints that stay, beside the best.
      progress: whether a progress bar is shown.
    """

    every: int = 500
    log_every: int = 50
    validation_pairs: int = 256
    patience: int = 0
    minutes: float | None = None
    keep: int = 2
    progress: bool = True

    def __post_init__(self) -> None:
        check_whole(self, every=1, log_every=1, validation_pairs=1, patience=0, keep=1)
        if self.minutes is not None:
            check_positive(self, "minutes")


def train(
    config: TrainConfig,
    shapes: Shapes,
    validation: Shapes,
    directory: str | Path,
    *,
    start: dict | None = None,
    loop: LoopConfig = LoopConfig(),
) -> Variables:
    """The best variables of a run, by validation loss; the run continues where ``directory`` left off.

    The folder holds ``config.json``, ``metrics.jsonl`` (one object a line: ``kind`` "train", "validation" or "stop",
    ``step`` and the metrics) and ``checkpoints/``. The ``seconds`` of training so far stand in lines of "train" and
    "stop"; they go on where a run is resumed, and validations do not count. A resumed run is bit-equal to one that was
    never stopped. Ctrl-C saves first. Where the newest checkpoint is damaged, the run continues from the last whole
    one, with a warning.

    Args:
      config: what is trained; must agree with the folder's.
      shapes: to train on.
      validation: held out of the same split; checkpoints are chosen by these.
      directory: of the run.
      start: parameters of a trained network that a new run begins with, where they have the names and shapes of its own
        (``begin_with``); the others are random. None: all are.
      loop: how it is watched.

    Raises:
      ValueError: the folder holds a run of another method, configuration, data or start, another process is training
        there, its configuration or all of its checkpoints are damaged, the intervals do not fit ``steps_per_call``, or
        nothing of ``start`` fits.
      FloatingPointError: a whole interval of steps had non-finite gradients.
      KeyboardInterrupt: on Ctrl-C, after the state was saved.
    """
    for name in ("every", "log_every"):
        if getattr(loop, name) % config.steps_per_call:
            raise ValueError(f"{name}: {getattr(loop, name)} is no multiple of steps_per_call, {config.steps_per_call}")
    mesh = jax.make_mesh((jax.device_count(),), ("data",), axis_types=(AxisType.Auto,))
    everywhere = NamedSharding(mesh, PartitionSpec())
    data: dict[str, Any] = {"shapes": _fingerprint(shapes), "validation": _fingerprint(validation)}
    if start is not None:
        data["start"] = digest(start)
    with Checkpoints(directory, config, data, keep=loop.keep) as checkpoints, jax.set_mesh(mesh):
        state = init_state(config)
        state = jax.device_put(state if start is None else begin_with(state, start), everywhere)
        state = checkpoints.restore_latest(state) or state
        arrays = jax.device_put(_arrays(shapes), everywhere)
        held_out = validation_pairs(config, _arrays(validation), loop.validation_pairs)
        log = Log(Path(directory) / "metrics.jsonl", int(state.step))
        with _Interruption() as interruption:
            state = _run(config, loop, state, arrays, held_out, checkpoints, log, interruption)
        if interruption.requested:
            checkpoints.save(state)
            raise KeyboardInterrupt
        best = checkpoints.restore_best(state)
        return jax.device_get((best or state).variables)


class _Interruption:
    """Turns the first Ctrl-C into a request to stop between two steps, when the state is whole; a second one is not
    held back. Outside the main thread, where signals never arrive, it does nothing.
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> "_Interruption":
        self._main = threading.current_thread() is threading.main_thread()
        if self._main:
            self._before = signal.signal(signal.SIGINT, self._request)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._before)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def _run(
    config: TrainConfig,
    loop: LoopConfig,
    state: TrainState,
    arrays: dict[str, jax.Array],
    held_out: dict[str, Any],
    checkpoints: Checkpoints,
    log: "Log",
    interruption: _Interruption,
) -> TrainState:
    """The state at the end of the run, or at the step after which it was interrupted."""
    step = int(state.step)
    clock, pending, skipped = _Clock(step, log.seconds), None, []
    with tqdm(total=config.steps, initial=step, unit="step", disable=not loop.progress, dynamic_ncols=True) as bar:
        while step < config.steps and not _ended(log, loop) and not interruption.requested:
            state, metrics = train_steps(state, arrays, config)
            step += config.steps_per_call
            # The metrics of the interval before are fetched while this step runs on the device.
            if pending is not None:
                _report(log, bar, clock, config.batch, *pending)
            skipped.append(metrics["skipped"])
            pending = None
            if step % loop.log_every == 0 or step == config.steps:
                pending = step, metrics | {"skipped": sum(skipped) / len(skipped)}
                skipped = []
            bar.update(config.steps_per_call)
            if step % loop.every == 0 or step == config.steps or _ended(log, loop):
                if pending is not None:
                    _report(log, bar, clock, config.batch, *pending)
                    pending = None
                with clock.stopped():
                    result = validate(state.variables, held_out, config)
                    log.write("validation", step, result)
                    checkpoints.save(state, result["validation_loss"])
                if loop.progress:
                    bar.write(_sentence(step, result))
        if pending is not None:
            _report(log, bar, clock, config.batch, *pending)
        if interruption.requested:
            jax.block_until_ready(state)
            log.write("stop", step, {"seconds": clock.seconds})
    return state


def _ended(log: "Log", loop: LoopConfig) -> bool:
    """Whether training ends before its last step."""
    return log.stalled(loop.patience) or (loop.minutes is not None and log.seconds >= 60 * loop.minutes)


class _Clock:
    """How long a run has trained, without its validations, and how fast; ``seconds`` were trained before it began."""

    def __init__(self, step: int, seconds: float) -> None:
        self._start = time.perf_counter() - seconds
        self._before = step, seconds

    @property
    def seconds(self) -> float:
        """Of training so far."""
        return time.perf_counter() - self._start

    def rate(self, step: int) -> float:
        """Steps a second since the last call, or since the clock was made."""
        (step_before, seconds_before), self._before = self._before, (step, self.seconds)
        return (step - step_before) / (self._before[1] - seconds_before)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """What is done inside does not count."""
        start = time.perf_counter()
        yield
        self._start += time.perf_counter() - start


def _report(log: "Log", bar: tqdm, clock: _Clock, batch: int, step: int, metrics: dict[str, jax.Array]) -> None:
    values = {name: float(value) for name, value in jax.device_get(metrics).items()}
    if values["skipped"] == 1.0:
        raise FloatingPointError(f"every gradient up to step {step} was not finite; lower the learning rate")
    pairs = clock.rate(step) * batch
    log.write("train", step, values | {"pairs_per_second": round(pairs, 1), "seconds": clock.seconds})
    bar.set_postfix(loss=f"{values['loss']:.4f}", pairs_s=f"{pairs:.0f}")


def _sentence(step: int, result: dict[str, float]) -> str:
    parts = [f"{name} {value:.4g}" for name, value in result.items() if not name.endswith("recall_5deg")]
    return f"step {step}: " + ", ".join(parts)


def _fingerprint(shapes: Shapes) -> dict[str, int]:
    """How many shapes these are, and a checksum of their points and occupancy samples."""
    checksum = 0
    for array in (shapes.points, shapes.queries, shapes.inside):
        if array is not None:
            checksum = zlib.crc32(array.tobytes(), checksum)
    return {"count": len(shapes), "crc32": checksum}


def _arrays(shapes: Shapes) -> dict[str, jax.Array]:
    arrays = {"points": jnp.asarray(shapes.points)}
    if shapes.queries is not None and shapes.inside is not None:
        arrays |= {"queries": jnp.asarray(shapes.queries), "inside": jnp.asarray(shapes.inside)}
    return arrays


def _entry(line: str) -> dict[str, Any] | None:
    """What a line of the log says, or None if it is no such line."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(entry, dict) or type(entry.get("step")) is not int or not isinstance(entry.get("kind"), str):
        return None
    if entry["kind"] == "validation" and type(entry.get("validation_loss")) not in (int, float):
        return None
    return entry


class Log:
    """The run's metrics as JSON lines; lines beyond ``step``, from a run that was killed later, are dropped.

    Lines that are no entries, as a damaged file has, are dropped with a warning.

    Attributes:
      seconds: of training so far, as the last line that tells them says.
    """

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        self.seconds = 0.0
        self._losses: list[float] = []
        kept, foreign = [], []
        lines = path.read_bytes().decode(errors="replace").split("\n") if path.exists() else []
        for number, line in enumerate(lines, start=1):
            entry = _entry(line)
            # What follows the last line's end is nothing, or a line that a kill cut short.
            if entry is None and number < len(lines):
                foreign.append(number)
            elif entry is not None and entry["step"] <= step:
                kept.append(line)
                self._note(entry)
        if foreign:
            warnings.warn(
                f"{path}: {len(foreign)} lines that are no entries of this log were dropped, the first is line "
                f"{foreign[0]}",
                stacklevel=2,
            )
        write_atomically(path, "".join(line + "\n" for line in kept))

    def write(self, kind: str, step: int, values: dict[str, float]) -> None:
        """Appends one line."""
        entry = {"kind": kind, "step": step, **{name: float(f"{value:.6g}") for name, value in values.items()}}
        self._note(entry)
        with self._path.open("a") as file:
            file.write(json.dumps(entry) + "\n")

    def stalled(self, patience: int) -> bool:
        """Whether the last ``patience`` validations brought nothing better than those before."""
        before = self._losses[: len(self._losses) - patience]
        return patience > 0 and bool(before) and min(self._losses[-patience:]) >= min(before)

    def _note(self, entry: dict[str, Any]) -> None:
        if entry["kind"] == "validation":
            self._losses.append(ranking_loss(entry["validation_loss"]))
        if type(entry.get("seconds")) in (int, float):
            self.seconds = float(entry["seconds"])
