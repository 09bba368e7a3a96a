"""The configuration of an experiment: which methods are measured on which protocols, and the published numbers."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any, Literal, Self

import jax
import numpy as np

import urrt_jax
from experiments.reproduce.tables import heading
from urrt_jax.evaluation import find_method, find_protocol
from urrt_jax.evaluation.scans import LEAST_OVERLAP
from urrt_jax.weights import model_card

EXPERIMENTS = Path(__file__).parents[1]
"""The folder `experiments` of this clone."""


class _Table:
    """A dataclass whose fields are the keys of a TOML table."""

    @classmethod
    def from_toml(cls, values: dict[str, Any]) -> Self:
        """An instance with these values; `ValueError` if a key is unknown or a required one is missing."""
        known = {field.name for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown keys {unknown}; known are {sorted(known)}")
        try:
            return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
        except TypeError as error:
            raise ValueError(str(error).replace("__init__() ", "")) from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part(_Table):
    """One protocol, which gives one Markdown table.

    Attributes:
      title: heading of the table.
      protocol: a name in `urrt_jax.evaluation.protocols.PROTOCOLS`, with its options, such as "outliers share=0.2".
      points: how many points each shape must have.
      data: a file in the data folder to use in place of the folder's own test split.
      unseen: whether to use only the shapes of the second half of the categories, as is usual for unseen categories.
      methods: the methods of this part, if they differ from the experiment's.
      published: published numbers, one row per title: a list in the order of the experiment's `published_columns`, or
        a table of numbers by column.
      columns: the columns of this part, if they differ from the experiment's.
      overlap: of scans, from how much to less than how much pairs overlap.
      stride: measure one item in this many, where all would take too long; the table states it.
      first: measure at most this many of those items, the first ones; None for all.
      note: text under the title.
    """

    title: str
    protocol: str
    points: int = 1024
    data: str | None = None
    unseen: bool = False
    overlap: tuple[float, float] = (LEAST_OVERLAP, np.inf)
    methods: tuple[str, ...] | None = None
    columns: tuple[str, ...] | None = None
    published: dict[str, Any] = dataclasses.field(default_factory=dict)
    stride: int = 1
    first: int | None = None
    note: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sweep(_Table):
    """One protocol at several values of one option, which gives one panel of a figure with a line per method.

    Attributes:
      title: label of the horizontal axis.
      protocol: a name in `PROTOCOLS`, with the options that stay the same.
      option: name of the option that changes.
      values: the values of that option.
      points: how many points each shape must have.
      methods: the methods of this sweep, if they differ from the experiment's.
      stride: measure one item in this many.
    """

    title: str
    protocol: str
    option: str
    values: tuple[float, ...]
    points: int = 1024
    methods: tuple[str, ...] | None = None
    stride: int = 12

    def protocols(self) -> list[str]:
        """The protocol with its options, once per value."""
        return [f"{self.protocol} {self.option}={value}" for value in self.values]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment(_Table):
    """The configuration of one experiment.

    Attributes:
      name: name of its folder.
      title: heading of its Markdown file.
      kind: "table" measures methods over many pairs; "pictures" draws a few pairs.
      methods: method names, as `urrt_jax.evaluation.find_method` takes them.
      columns: columns of the tables, by their names in `Evaluation.summary`. The prefix "asymmetric." leaves out the
        axisymmetric categories.
      published_columns: the columns of the lists in `Part.published`.
      parts: protocols, one table each.
      sweeps: protocols at several values of one option, one panel of a figure each.
      trends: whether to draw the errors against rotation angle and overlap.
      matrix: whether to draw a figure of all methods against all parts.
      note: text under the title.
    """

    name: str
    title: str
    kind: Literal["table", "pictures"] = "table"
    methods: tuple[str, ...]
    columns: tuple[str, ...] = ()
    published_columns: tuple[str, ...] = ()
    parts: tuple[Part, ...]
    sweeps: tuple[Sweep, ...] = ()
    trends: bool = False
    matrix: bool = False
    note: str = ""


def read_experiment(folder: Path) -> Experiment:
    """The experiment that a folder's `config.toml` describes.

    Raises:
      ValueError: the file is missing or damaged, or a key or value in it is not valid; the message names the file.
    """
    path = folder / "config.toml"
    try:
        values = tomllib.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: {error}") from error
    try:
        parts = [Part.from_toml(part) for part in values.pop("parts", [])]
        sweeps = [Sweep.from_toml(sweep) for sweep in values.pop("sweeps", [])]
        experiment = Experiment.from_toml(values | {"name": folder.name, "parts": parts, "sweeps": sweeps})
        _check(experiment)
        return experiment
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _check(experiment: Experiment) -> None:
    """Raises `ValueError` for a mistyped name or value now, rather than after hours of work."""
    lengths = {len(experiment.published_columns)}
    for part in experiment.parts:
        find_protocol(part.protocol)
        for column in (*(part.columns or ()), *experiment.columns, *experiment.published_columns):
            heading(column)
        for title, values in part.published.items():
            if not isinstance(values, dict) and {len(values)} != lengths:
                raise ValueError(f"published: {title!r} has {len(values)} figures, published_columns {lengths.pop()}")
    for sweep in experiment.sweeps:
        for protocol in sweep.protocols():
            find_protocol(protocol)
    for each in (*experiment.parts, *experiment.sweeps):
        if each.stride < 1 or each.points < 1:
            raise ValueError(f"stride and points: expected at least 1, got {each.stride} and {each.points}")
    for part in experiment.parts:
        try:
            least, below = map(float, part.overlap)
        except (TypeError, ValueError):
            least, below = np.nan, np.nan
        if not 0 <= least < below:
            raise ValueError(f"overlap: expected the least, and a larger one that is too much, got {part.overlap}")
        if part.first is not None and part.first < 1:
            raise ValueError(f"first: expected at least 1, got {part.first}")
    for name in {
        *experiment.methods,
        *(name for each in (*experiment.parts, *experiment.sweeps) for name in each.methods or ()),
    }:
        find_method(name)


def list_experiments() -> list[Experiment]:
    """All experiments of this clone, sorted by name."""
    return [read_experiment(path.parent) for path in sorted(EXPERIMENTS.glob("*/config.toml"))]


def find_experiment(name: str) -> Experiment:
    """The experiment of the folder `name`, or the one in this clone whose folder's name begins with `name`.

    Raises:
      ValueError: no experiment fits, or more than one does.
    """
    if (Path(name) / "config.toml").is_file():
        return read_experiment(Path(name).resolve())
    folders = sorted(path.parent for path in EXPERIMENTS.glob("*/config.toml"))
    fitting = [folder for folder in folders if folder.name.startswith(name)]
    if len(fitting) != 1:
        known = ", ".join(folder.name for folder in folders)
        raise ValueError(f"table: expected one of {known}, or a folder with a config.toml, got {name!r}")
    return read_experiment(fitting[0])


def results_header(experiment: Experiment, data: str, model: str, command: str) -> dict[str, Any]:
    """The first entries of every results file: its subject, and what its numbers depend on."""
    return {
        "title": experiment.title,
        "note": experiment.note,
        "command": command,
        "versions": {"urrt_jax": urrt_jax.__version__, "jax": jax.__version__, "numpy": np.__version__},
        "model_sha256": model_card(model)["sha256"],
        "data": Path(data).name,
    }
