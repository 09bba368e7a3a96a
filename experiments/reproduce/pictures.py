"""Pictures of pairs, one row per protocol and one column per method: the target and the moved source."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from experiments.reproduce.experiment import Experiment, results_header
from experiments.reproduce.figures import check_drawing
from urrt_jax.atomic import write_atomically
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import Trial, evaluate, find_method, find_protocol, spread

_TARGET, _OFF, _ON, _INK = "#aeb7c2", "#c0392b", "#2a67b0", "#2f3640"
_TOUCHING = 0.04  # source points closer to the target are drawn blue; an arbitrary choice, shapes have radius 1
_FIRST, _STEP = 5, 7  # shapes 5, 12, 19, ... are drawn, one per row; an arbitrary choice
_ELEVATION, _AZIMUTH = 24.0, -56.0  # of the camera, in degrees


def draw_pairs(
    experiment: Experiment,
    data: str,
    out: Path,
    *,
    model: str = "modelnet40",
    limit: int | None = None,
    command: str = "",
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """The rotation errors of an experiment's pairs; writes `figure.png` and `results.json` to `out`.

    The figure has one row per part, with one pair, and one column per method after a first column that shows the input.
    Arguments are as for `reproduce`, but `limit` is the largest number of rows.

    Raises:
      ValueError: the data or the model cannot be used.
      ImportError: Matplotlib is not installed.
    """
    check_drawing()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spread(1, limit)
    parts = experiment.parts[:limit]
    shapes = load_shapes(data, split="test", points=1024)
    columns = ["input", *experiment.methods]
    figure = Figure(figsize=(2.5 * len(columns), 2.4 * len(parts) + 0.4), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    rows = []
    for line, part in enumerate(parts):
        report(part.title)
        item = (_FIRST + _STEP * line) % len(shapes)
        trial = find_protocol(part.protocol)(shapes.points, item)
        for place, name in enumerate(columns):
            axes = figure.add_subplot(len(parts), len(columns), line * len(columns) + place + 1, projection="3d")
            title, pose = _pose(name, part.protocol, shapes.points, item, model, rows, part.title)
            if line == 0:
                axes.set_title(title, fontsize=9, color=_INK)
            if place == 0:
                axes.text2D(-0.02, 0.5, part.title, transform=axes.transAxes, rotation=90, va="center", fontsize=9)
            if pose is not None:
                _draw(axes, trial, *pose, touching=place > 0)
                if place > 0:
                    angle = rows[-1]["rotation_error_deg"]
                    axes.text2D(
                        0.5, 0.0, f"{angle:.2f}°", transform=axes.transAxes, ha="center", fontsize=8, color=_INK
                    )
            axes.set_axis_off()
    figure.subplots_adjust(left=0.03, right=0.99, top=0.93, bottom=0.01, wspace=0.0, hspace=0.02)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "figure.png")
    results = results_header(experiment, data, model, command) | {"pairs": rows}
    write_atomically(out / "results.json", json.dumps(results, indent=1) + "\n")
    return results


def _pose(
    name: str, protocol: str, clouds: np.ndarray, item: int, model: str, rows: list[dict], part: str
) -> tuple[str, tuple[np.ndarray, np.ndarray] | None]:
    """The heading of a column and the method's pose, or None if its library is missing; appends the error to `rows`."""
    if name == "input":
        return "input", (np.eye(3), np.zeros(3))
    method = find_method(name, model=model)
    try:
        found = evaluate(method, protocol, clouds, items=np.array([item]), progress=False)
    except ImportError as error:
        rows.append({"part": part, "item": item, "method": name, "missing": str(error)})
        return f"{method.title}: not installed", None
    angle = float(found.errors()["angle"][0])
    rows.append({"part": part, "item": item, "method": name, "rotation_error_deg": round(angle, 4)})
    return method.title, (found.rotations[0], found.translations[0])


def _draw(axes: Any, trial: Trial, rotation: np.ndarray, translation: np.ndarray, *, touching: bool) -> None:
    """Draws the target in grey and the moved source in red; blue where it touches the target, if `touching` is set."""
    moved = trial.source @ rotation.T + translation
    axes.scatter(*trial.target.T, c=_TARGET, s=2.0, linewidths=0)
    near = KDTree(trial.target).query(moved)[0] < _TOUCHING if touching else np.zeros(len(moved), bool)
    axes.scatter(*moved[~near].T, c=_OFF, s=2.5, linewidths=0)
    axes.scatter(*moved[near].T, c=_ON, s=2.5, linewidths=0)
    centre = trial.target.mean(axis=0)
    axes.set(**{f"{name}lim": (c - 0.75, c + 0.75) for name, c in zip("xyz", centre, strict=True)})
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.set_box_aspect((1, 1, 1), zoom=1.25)
