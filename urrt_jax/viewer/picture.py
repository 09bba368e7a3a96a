"""The Matplotlib figure: two clouds before and after, the source coloured by the network's regions."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urrt_jax.atomic import write_atomically
from urrt_jax.clouds import CloudLike
from urrt_jax.result import Registration
from urrt_jax.viewer.colors import TARGET, region_colors
from urrt_jax.viewer.scene import Scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 3000  # of each cloud; more only blur a picture of this size
_INK, _FAINT, _WARNING = "#2f3640", "#8a94a0", "#c0392b"
_ELEVATION, _AZIMUTH = 24.0, -56.0  # where the eye is, in degrees
_FOG = 0.5  # how far the points farthest from the eye fade into the paper


def plot_registration(
    source: CloudLike,
    target: CloudLike,
    result: Registration,
    *,
    path: str | os.PathLike[str] | None = None,
    title: str | None = None,
) -> Figure:
    """A Matplotlib figure of both clouds before and after registration, in equal scale and from the same side.

    The target is grey, the source coloured by region. It touches no global state of Matplotlib and needs no display.
    In a notebook, ``%matplotlib inline`` shows the figure.

    Args:
      source: (N, 3), without padding; at most 3000 points of each cloud are drawn, always the same ones.
      target: (M, 3).
      result: what ``register(source, target)`` returned.
      path: where to save the picture too, whole or not at all; the extension chooses the format, PNG without one.
      title: over the picture.

    Raises:
      ValueError: a batch, or clouds of other sizes than the ones registered.
      ImportError: Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError(f"pictures need Matplotlib: pip install 'urrt-jax[viz]' ({error})") from error

    scene = Scene.of(source, target, result, points=_POINTS)
    rotation = np.asarray(result.rotation, np.float64)
    before = scene.source.points + scene.start
    after = scene.source.points @ rotation.T + scene.end(rotation, result.translation)
    names = "before (moved closer to fit)" if scene.closer else "before", "after"
    seen = [_look(np.concatenate([scene.target.points, moving])) for moving in (before, after)]
    low, high = np.min([view.min(axis=0) for view in seen], axis=0), np.max([view.max(axis=0) for view in seen], axis=0)
    grey = np.broadcast_to(TARGET, scene.target.points.shape)
    colors = np.concatenate([grey, region_colors(scene.source.labels)]) / 255
    sizes = np.repeat([5.0, 9.0], [len(grey), len(after)])

    figure = Figure(figsize=(10.0, 5.0), dpi=160, facecolor="white")
    FigureCanvasAgg(figure)
    top = 0.90 if title is None else 0.84
    for left, view, name in zip((0.02, 0.52), seen, names, strict=True):
        axes = figure.add_axes((left, 0.15, 0.46, top - 0.16))
        fog = _FOG * (high[2] - view[:, 2:]) / max(high[2] - low[2], 1e-12)
        order = np.argsort(view[:, 2])  # the nearest points are painted last
        paint = colors * (1 - fog) + fog
        axes.scatter(*view[order, :2].T, c=paint[order], s=sizes[order], linewidths=0, clip_on=False)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_axis_off()
        figure.text(left + 0.23, top + 0.03, name, ha="center", color=_INK, fontsize=11)
    if title is not None:
        figure.text(0.5, 0.935, title, ha="center", color=_INK, fontsize=14)
    note, color = _caption(result)
    figure.text(0.5, 0.075, note, ha="center", color=color, fontsize=11)
    figure.text(0.5, 0.03, "source in colours, one a region; target in grey", ha="center", color=_FAINT, fontsize=9)
    if path is not None:
        picture = io.BytesIO()
        figure.savefig(picture, format=Path(path).suffix[1:] or None)
        write_atomically(path, picture.getvalue())
    return figure


def _look(points: np.ndarray) -> np.ndarray:
    """The points as a far eye above the x-y plane sees them, (N, 3): right, up, and towards the eye; z stays up."""
    up, around = np.deg2rad([_ELEVATION, _AZIMUTH])
    right = [-np.sin(around), np.cos(around), 0.0]
    towards = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
    return points @ np.stack([right, np.cross(towards, right), towards], axis=1)


def _caption(result: Registration) -> tuple[str, str]:
    """The diagnostics in a line, and its colour."""
    numbers = f"fitness {float(result.fitness):.3f}    rmse {float(result.rmse):.3g}"
    if bool(result.converged):
        return f"{numbers}    converged", _FAINT
    return f"{numbers}    not converged", _WARNING
