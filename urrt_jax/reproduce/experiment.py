"""What an experiment is: which methods on which protocols, and what others have published."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any, Literal, Self

import jax
import numpy as np

import urrt_jax
from urrt_jax.evaluation import find_method, find_protocol
from urrt_jax.reproduce.tables import heading
from urrt_jax.weights import model_card


class _Table:
    """A dataclass that is read from a table of TOML."""

    @classmethod
    def from_toml(cls, values: dict[str, Any]) -> Self:
        """The same with these values; ``ValueError`` for a key that it does not know or lacks."""
        known = {field.name for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown keys {unknown}; known are {sorted(known)}")
        try:
            return cls(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
        except TypeError as error:
            raise ValueError(str(error).replace("__init__() ", "")) from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part(_Table):
    """One protocol, one table.

    Attributes:
      title: over the table.
      protocol: a name in ``PROTOCOLS``, with its options.
      points: that every shape needs.
      data: a file in the data folder that is used in place of the folder's own test split.
      unseen: only shapes of the second half of the categories, as protocols for unseen categories count them.
      methods: in place of the experiment's.
      published: a row of others' figures by its title, in the order of the experiment's ``published_columns``, or a
        table of figures by column.
      columns: in place of the experiment's.
      stride: every so many items, where all would take too long; stated in the table.
      note: under the title.
    """

    title: str
    protocol: str
    points: int = 1024
    data: str | None = None
    unseen: bool = False
    methods: tuple[str, ...] | None = None
    columns: tuple[str, ...] | None = None
    published: dict[str, Any] = dataclasses.field(default_factory=dict)
    stride: int = 1
    note: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sweep(_Table):
    """One protocol at several values of an option: a line in a figure for every method.

    Attributes:
      title: of the axis.
      protocol: with its fixed options.
      option: the one that changes.
      values: that it takes.
      points: that every shape needs.
      methods: in place of the experiment's.
      stride: every so many items.
    """

    title: str
    protocol: str
    option: str
    values: tuple[float, ...]
    points: int = 1024
    methods: tuple[str, ...] | None = None
    stride: int = 12

    def protocols(self) -> list[str]:
        """The protocol at each value."""
        return [f"{self.protocol} {self.option}={value}" for value in self.values]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Experiment(_Table):
    """An experiment.

    Attributes:
      name: its folder's.
      title: of its table.
      kind: whether it measures methods or shows pairs.
      methods: names as ``find_method`` takes them.
      columns: figures of a summary; "asymmetric." before one leaves out the axisymmetric categories.
      published_columns: what ``Part.published`` lists.
      not_built: rows of learned systems that this project has not built yet.
      parts: protocols.
      sweeps: protocols whose strength changes.
      trends: whether a figure shows errors against rotation angle and overlap.
      note: under the title.
    """

    name: str
    title: str
    kind: Literal["table", "pictures"] = "table"
    methods: tuple[str, ...]
    columns: tuple[str, ...] = ()
    published_columns: tuple[str, ...] = ()
    not_built: tuple[str, ...] = ()
    parts: tuple[Part, ...]
    sweeps: tuple[Sweep, ...] = ()
    trends: bool = False
    note: str = ""


def read_experiment(folder: Path) -> Experiment:
    """The experiment of a folder.

    Raises:
      ValueError: there is no ``config.toml``, or it is not one of an experiment; the message names it.
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
    """Nothing, or a ValueError: what is mistyped should be known before hours of work."""
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
    for name in {
        *experiment.methods,
        *(name for each in (*experiment.parts, *experiment.sweeps) for name in each.methods or ()),
    }:
        find_method(name)


def experiments_folder() -> Path:
    """The folder ``experiments`` of this clone: the current one's, else the one beside the package.

    Raises:
      ValueError: there is none, as where the package was installed without its repository.
    """
    for root in (Path.cwd(), Path(urrt_jax.__file__).parents[1]):
        if list(root.glob("experiments/*/config.toml")):
            return root / "experiments"
    raise ValueError("no folder 'experiments' here: tables are reproduced in a clone of the repository")


def list_experiments() -> list[Experiment]:
    """Every experiment of this clone, by name."""
    return [read_experiment(path.parent) for path in sorted(experiments_folder().glob("*/config.toml"))]


def find_experiment(name: str) -> Experiment:
    """The experiment whose folder's name begins with ``name``, or of a folder of one's own.

    Raises:
      ValueError: no such experiment, or more than one.
    """
    if (Path(name) / "config.toml").is_file():
        return read_experiment(Path(name).resolve())
    folders = sorted(path.parent for path in experiments_folder().glob("*/config.toml"))
    fitting = [folder for folder in folders if folder.name.startswith(name)]
    if len(fitting) != 1:
        known = ", ".join(folder.name for folder in folders)
        raise ValueError(f"table: expected one of {known}, or a folder with a config.toml, got {name!r}")
    return read_experiment(fitting[0])


def results_header(experiment: Experiment, data: str, model: str, command: str) -> dict[str, Any]:
    """What every results file says of itself first: its subject, and what its numbers depend on."""
    return {
        "title": experiment.title,
        "note": experiment.note,
        "command": command,
        "versions": {"urrt_jax": urrt_jax.__version__, "jax": jax.__version__, "numpy": np.__version__},
        "model_sha256": model_card(model)["sha256"],
        "data": Path(data).name,
    }
