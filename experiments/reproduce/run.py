"""Measures every method of an experiment on every protocol, then writes the results, the table and the figures.

The errors of every pair are saved as they are found, so that a run that was stopped continues where it was.
"""

import itertools
import json
import os
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.reproduce.experiment import Experiment, Part, Sweep, results_header
from experiments.reproduce.figures import check_drawing, draw_matrix, draw_recalls, draw_sweeps, draw_trends
from experiments.reproduce.tables import as_markdown
from urrt_jax.atomic import write_atomically
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import (
    Evaluation,
    Method,
    data_digest,
    evaluate,
    find_method,
    load_scan_pairs,
    recall_curve,
    rotation_degrees,
    spread,
    values_path,
)

AXISYMMETRIC = ("bottle", "bowl", "cone", "cup", "flower_pot", "lamp", "tent", "vase")
"""Categories of ModelNet40 most of whose shapes are axisymmetric: a rotation about the axis does not change them."""
FIRST_UNSEEN_LABEL = 20
"""Protocols for unseen categories train on the first 20 of ModelNet40's 40 categories and test on the others."""
THRESHOLDS = np.round(np.geomspace(0.1, 180, 61), 4)
"""Rotation errors, in degrees, at which recall curves are drawn."""
TREND_BINS = {
    "true rotation in degrees": (0, 15, 25, 35, 45, 55, 90),
    "overlap": (0, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 1.01),
}
"""Edges of the bins in which median errors are given. An arbitrary choice."""


def reproduce(
    experiment: Experiment,
    data: str,
    out: Path,
    *,
    model: str = "modelnet40",
    limit: int | None = None,
    only: Sequence[str] | None = None,
    command: str = "",
    progress: bool = True,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """The results of an experiment, which are also written to `out`: `results.json`, `table.md` and figures.

    The errors of every pair are saved in the folder `items` beside `out`, in one file per method, protocol and
    settings. An interrupted run continues from these files, and experiments share them. A method whose library is not
    installed gets a row that says so, and so do all methods of a part whose data is missing.

    Args:
      experiment: the configuration.
      data: the shapes, as `load_shapes` takes them. Files that parts name are looked for in this folder.
      out: the folder to write to.
      model: our network: the name of a packaged model, or a file.
      limit: at most this many items per part, evenly spread over the data; all by default.
      only: names of the methods to measure anew; all by default. The rows of the other methods are copied from the
        results in `out`, where those have them, for the same items and settings.
      command: the command to record in the results.
      progress: whether to show progress bars.
      report: called with the title of every part before it is measured.

    Raises:
      ValueError, OSError: the data, the model or the limit cannot be used; `only` is empty or names a method that the
        experiment does not have; or the results in `out` are of other data or items, or a row there has other settings.
      ImportError: Matplotlib is not installed.
    """
    check_drawing()
    runner = _Runner(data, out.parent / "items", model, limit, progress, _earlier_rows(experiment, out, only))
    results: dict[str, Any] = results_header(experiment, data, model, command) | {
        "device": jax.devices()[0].platform,
        "processor": f"{os.cpu_count()} cores, {platform.processor() or platform.machine()}",
        "model": Path(model).stem,
        "seed": "the number of each item",
        "columns": list(experiment.columns),
        "published_columns": list(experiment.published_columns),
        "thresholds": THRESHOLDS.tolist(),
        "trend_bins": {name: list(edges) for name, edges in TREND_BINS.items()},
        "measured_anew": None if only is None else sorted(only),
        "parts": [],
        "sweeps": [],
    }
    for part in experiment.parts:
        report(part.title)
        results["parts"].append(runner.part(part, part.methods or experiment.methods, trends=experiment.trends))
    for sweep in experiment.sweeps:
        report(sweep.title)
        results["sweeps"].append(runner.sweep(sweep, sweep.methods or experiment.methods))
    results = json.loads(json.dumps(results))
    # Written last, so that an interrupted run does not touch the earlier results.
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "results.json", json.dumps(results, indent=1) + "\n")
    write_atomically(out / "table.md", as_markdown(results))
    draw_recalls(results, out / "recall.png")
    if experiment.trends:
        draw_trends(results, out / "trends.png")
    if experiment.matrix:
        draw_matrix(results, out / "matrix.png")
    if experiment.sweeps:
        draw_sweeps(results, out / "sweeps.png")
    return results


class _Earlier(NamedTuple):
    """The parts and sweeps of earlier results, and the methods that are measured anew rather than copied from them."""

    sections: list[dict[str, Any]]
    anew: frozenset[str]


# A row may be copied from an earlier part or sweep if these entries are equal in both.
_SAME = ("title", "protocol", "option", "values", "data_digest", "items", "subset")


def _earlier_rows(experiment: Experiment, out: Path, only: Sequence[str] | None) -> _Earlier | None:
    """The results in `out` from which rows are copied; None if every method is measured."""
    if only is None:
        return None
    sections = (*experiment.parts, *experiment.sweeps)
    known = {*experiment.methods, *(name for section in sections for name in section.methods or ())}
    unknown = sorted(set(only) - known)
    if unknown or not only:
        raise ValueError(f"only: expected some of {', '.join(sorted(known))}, got {', '.join(unknown) or 'none'}")
    earlier = json.loads((out / "results.json").read_text())
    if earlier.get("thresholds") != THRESHOLDS.tolist():
        raise ValueError(f"only: {out / 'results.json'} holds no table, or one of other thresholds; measure all")
    return _Earlier([*earlier["parts"], *earlier["sweeps"]], frozenset(only))


class _Runner:
    """Measures the parts and sweeps of one experiment, with the data loaded once and the errors saved in a folder."""

    def __init__(
        self, data: str, items: Path, model: str, limit: int | None, progress: bool, earlier: _Earlier | None
    ) -> None:
        spread(1, limit)
        # A mistyped path is an error; only a file that a part names may be missing.
        if data != "procedural" and not Path(data).exists():
            raise FileNotFoundError(f"{data}: no such file or folder (nor is it the word 'procedural')")
        self.data, self.folder, self.model, self.limit, self.progress = data, items, model, limit, progress
        self.earlier = earlier
        self._loaded: dict[tuple, tuple[Any, np.ndarray, list[dict], str]] = {}

    def part(self, part: Part, methods: Sequence[str], *, trends: bool) -> dict[str, Any]:
        """The results of one part: one row per method."""
        result: dict[str, Any] = {
            "title": part.title, "protocol": part.protocol, "note": part.note, "published": part.published,
            "columns": None if part.columns is None else list(part.columns),
        }  # fmt: skip
        try:
            data, symmetric, about, source = self._load(part)
        except (ValueError, OSError) as error:
            if self.earlier is not None or (part.data is None and not part.unseen):
                raise
            rows = [{"method": name, "title": self._find(name).title, "missing": "no data"} for name in methods]
            return result | {"items": 0, "subset": "", "missing": self._no_data(error), "data": None, "rows": rows}
        result |= {"data": source, "data_digest": data_digest(data)}
        items, subset = self._items(len(data), part.stride, part.first)
        result |= {"items": len(items), "subset": subset}
        rows = [
            self._kept(name, result) or self._row(name, part.protocol, data, items, symmetric, about, trends=trends)
            for name in methods
        ]
        return result | {"rows": rows}

    def sweep(self, sweep: Sweep, methods: Sequence[str]) -> dict[str, Any]:
        """The results of one sweep: one row per method, with the median error and the 5° recall at each value."""
        part = Part(title="", protocol=sweep.protocol, points=sweep.points)
        data, symmetric, about, _ = self._load(part)
        result: dict[str, Any] = {
            "title": sweep.title, "protocol": sweep.protocol, "option": sweep.option, "values": list(sweep.values),
            "data_digest": data_digest(data),
        }  # fmt: skip
        items, subset = self._items(len(data), sweep.stride)
        result |= {"items": len(items), "subset": subset}
        rows = []
        for name in methods:
            if kept := self._kept(name, result):
                rows.append(kept)
                continue
            points = [self._row(name, each, data, items, symmetric, about) for each in sweep.protocols()]
            if "missing" in points[0]:
                rows.append(points[0])
                continue
            lines = {key: [point[key] for point in points] for key in ("angle_median", "recall_5deg_0.1")}
            rows.append({"method": name, "title": points[0]["title"], **lines, "identity": points[0]["identity"]})
        return result | {"rows": rows}

    def _kept(self, name: str, result: dict[str, Any]) -> dict[str, Any] | None:
        """The method's row of the earlier results; None if the method is to be measured, or has none there."""
        if self.earlier is None or name in self.earlier.anew:
            return None
        titled = [each for each in self.earlier.sections if each["title"] == result["title"]]
        found = [each for each in titled if all(each.get(key) == result.get(key) for key in _SAME)]
        if titled and not found:
            raise ValueError(f"only: the earlier {result['title']!r} is of other items or data; measure all methods")
        row = next((row for each in found for row in each["rows"] if row["method"] == name), None)
        if row is None:  # a new part, or a new method
            return None
        try:
            identity = json.loads(json.dumps(self._find(name).identity()))
        except ImportError:  # without the library its settings cannot be compared
            return row
        if row.get("identity") != identity:  # the row of a method that was not installed has no identity
            raise ValueError(f"only: the earlier {name!r} of {result['title']!r} has other settings; measure it, too")
        return row

    def _no_data(self, error: Exception) -> str:
        """The text of a row whose data is missing, without the folder, which is of no use to other readers."""
        return f"no data: {error}".replace(str(Path(self.data).parent) + "/", "")

    def _find(self, name: str) -> Method:
        return find_method(name, model=self.model)

    def _items(self, count: int, stride: int, first: int | None = None) -> tuple[np.ndarray, str]:
        """The indices of the items to measure, and which share of all they are, in words."""
        items = spread(count, self.limit, stride)
        if len(items) == count and (first is None or first >= count):
            return items, f"all {count:,} items"
        subset = f"every {_ordinal(int(items[1] if len(items) > 1 else count))} item"
        if first is not None and first < len(items):
            return items[:first], f"the first {first:,} of {subset}, {count:,} in all"
        return items, f"{subset}, {len(items):,} of {count:,}"

    def _load(self, part: Part) -> tuple[Any, np.ndarray, list[dict], str]:
        """The part's data, whether each item is axisymmetric (S,), facts about each pair of scans, and a name."""
        key = (part.data, part.points, part.unseen, part.overlap, part.protocol == "scans")
        if key not in self._loaded:
            self._loaded[key] = self._read(part)
        return self._loaded[key]

    def _read(self, part: Part) -> tuple[Any, np.ndarray, list[dict], str]:
        """As `_load`, from the files."""
        source, unseen = Path(self.data) / part.data if part.data else Path(self.data), part.unseen
        if part.protocol == "scans":
            pairs, about = load_scan_pairs(source, least_overlap=part.overlap[0], below_overlap=part.overlap[1])
            return pairs, np.zeros(len(pairs), bool), about, source.name
        if part.data and not source.exists():
            # The folder itself may have enough points: the HDF5 release of ModelNet40 has 2,048 per shape. Parts that
            # name a file are protocols for unseen categories, so the others are left out.
            source, unseen = Path(self.data), True
        shapes = load_shapes(str(source), split="test", points=part.points)
        if unseen:
            rows = np.flatnonzero(shapes.labels >= FIRST_UNSEEN_LABEL)
            if not len(rows):
                raise ValueError(f"{source.name} has no category from the {FIRST_UNSEEN_LABEL + 1}st on")
            shapes = shapes.take(rows)
        symmetric = np.isin(np.array(shapes.classes)[shapes.labels], AXISYMMETRIC)
        name = f"{source.name}, test split" + (", second half of the categories" if unseen else "")
        return shapes.points, symmetric, [], name

    def _row(
        self,
        name: str,
        protocol: str,
        data: Any,
        items: np.ndarray,
        symmetric: np.ndarray,
        about: list[dict],
        *,
        trends: bool = False,
    ) -> dict[str, Any]:
        """The row of one method: summary, recall curve and failed items; or why the method cannot be measured."""
        method = self._find(name)
        try:
            identity = method.identity()
        except ImportError as error:
            return {"method": name, "title": method.title, "missing": str(error)}
        self.folder.mkdir(parents=True, exist_ok=True)
        save = values_path(self.folder, name, method, protocol, data, items)
        found = evaluate(method, protocol, data, items=items, save=save, progress=self.progress)
        angles = found.errors()["angle"]
        row = {"method": name, "title": method.title, **found.summary()}
        unsymmetric = ~symmetric[items]
        if 0 < unsymmetric.sum() < len(items):
            row["asymmetric"] = found.take(unsymmetric).summary()
        row["recall_curve"] = np.round(recall_curve(angles, THRESHOLDS), 4).tolist()
        row["failed_items"] = {str(item): reason for item, reason in found.failures.items()}
        row["identity"] = identity
        if trends and np.all(np.isfinite(found.overlap)):
            row["trends"] = _trends(found, angles)
        if about:
            row["pairs"] = [
                about[item] | {"rotation_error_deg": round(float(angle), 3), "translation_error": round(float(far), 6)}
                for item, angle, far in zip(found.items, angles, found.errors()["distance"], strict=True)
            ]
        return row


def _trends(found: Evaluation, angles: np.ndarray) -> dict[str, list[float | None]]:
    """The median rotation error, in degrees, in each bin of `TREND_BINS`; None for a bin of fewer than 10 pairs."""
    turns = rotation_degrees(found.true_rotations, np.eye(3))
    result = {}
    for (name, edges), values in zip(TREND_BINS.items(), (turns, found.overlap), strict=True):
        inside = [(values >= low) & (values < high) for low, high in itertools.pairwise(edges)]
        result[name] = [round(float(np.median(angles[some])), 4) if some.sum() >= 10 else None for some in inside]
    return result


def _ordinal(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"
