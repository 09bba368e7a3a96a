"""Pictures of a registration: two clouds before and after, the source coloured by the network's regions.

Needs the extra ``viz``; Matplotlib and Plotly are imported only when a picture is drawn.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from urrt_jax.result import Registration

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as InteractiveFigure

_POINTS = 3000  # of each cloud in a picture; more only blur it
_INK, _FAINT, _WARNING = "#2f3640", "#8a94a0", "#c0392b"
_ELEVATION, _AZIMUTH = 24.0, -56.0  # where the eye is, in degrees
_FOG = 0.5  # how far the points farthest from the eye fade into the paper
_TARGET = (140, 158, 180)
_REGIONS = np.array(
    [
        (230, 92, 71), (38, 138, 135), (240, 168, 48), (112, 84, 168), (98, 161, 64), (214, 92, 148),
        (42, 103, 176), (150, 92, 52), (18, 176, 196), (172, 166, 36), (148, 40, 78), (236, 138, 110),
    ],
    np.uint8,
)  # fmt: skip


def region_colors(labels: ArrayLike) -> np.ndarray:
    """One colour for every point, (N, 3) uint8 red, green, blue, by its region.

    Args:
      labels: (N,) non-negative integers, as ``Registration.source_regions``; from region 12 on the colours repeat.

    Raises:
      ValueError: labels that are not (N,) non-negative integers.
    """
    labels = np.asarray(labels)
    if labels.ndim != 1 or not np.issubdtype(labels.dtype, np.integer) or np.any(labels < 0):
        raise ValueError(f"labels: expected (N,) non-negative integers, got {labels.dtype} of shape {labels.shape}")
    return _REGIONS[labels % len(_REGIONS)]


def plot_registration(
    source: ArrayLike,
    target: ArrayLike,
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
      path: where to save the picture too; the extension chooses the format.
      title: over the picture.

    Raises:
      ValueError: a batch, or clouds of other sizes than the ones registered.
      ImportError: Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("pictures need Matplotlib: pip install 'urrt-jax[viz]'") from error

    scene = _scene(source, target, result)
    seen = [_look(np.concatenate([scene.target, moving])) for _, moving in scene.panels()]
    low, high = np.min([view.min(axis=0) for view in seen], axis=0), np.max([view.max(axis=0) for view in seen], axis=0)
    colors = np.concatenate([np.broadcast_to(_TARGET, scene.target.shape), scene.colors]) / 255
    sizes = np.repeat([5.0, 9.0], [len(scene.target), len(scene.after)])

    figure = Figure(figsize=(10.0, 5.0), dpi=160, facecolor="white")
    FigureCanvasAgg(figure)
    top = 0.90 if title is None else 0.84
    for left, view, (name, _) in zip((0.02, 0.52), seen, scene.panels(), strict=True):
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
        figure.savefig(path)
    return figure


def _look(points: np.ndarray) -> np.ndarray:
    """The points as a far eye above the x-y plane sees them, (N, 3): right, up, and towards the eye; z stays up."""
    up, around = np.deg2rad([_ELEVATION, _AZIMUTH])
    right = [-np.sin(around), np.cos(around), 0.0]
    towards = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
    return points @ np.stack([right, np.cross(towards, right), towards], axis=1)


def show_registration(source: ArrayLike, target: ArrayLike, result: Registration) -> InteractiveFigure:
    """An interactive Plotly figure of both clouds before and after registration; the last line of a cell shows it.

    Arguments and errors are those of ``plot_registration``; the colours mean the same.
    """
    try:
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots
    except ImportError as error:
        raise ImportError("interactive pictures need Plotly: pip install 'urrt-jax[viz]'") from error

    scene = _scene(source, target, result)
    panels = scene.panels()
    figure = make_subplots(
        rows=1,
        cols=2,
        specs=[[{"type": "scene"}] * 2],
        subplot_titles=[name for name, _ in panels],
        horizontal_spacing=0.0,
    )
    colors = [f"rgb({r},{g},{b})" for r, g, b in scene.colors]
    everything = np.concatenate([scene.before, scene.after, scene.target])
    low, high = everything.min(axis=0), everything.max(axis=0)  # of both panels, so that they have one scale
    axis = {"visible": False}
    for column, (_, moving) in enumerate(panels, start=1):
        clouds = (("target", scene.target, f"rgb{_TARGET}"), ("source", moving, colors))
        for name, points, color in clouds:
            x, y, z = points.T
            figure.add_trace(
                go.Scatter3d(
                    x=x, y=y, z=z, mode="markers", name=name, hoverinfo="name", marker={"size": 2, "color": color}
                ),
                row=1,
                col=column,
            )
        ranges = {f"{name}axis": axis | {"range": [a, b]} for name, a, b in zip("xyz", low, high, strict=True)}
        figure.update_scenes({"aspectmode": "data"} | ranges, row=1, col=column)
    figure.update_layout(
        title={"text": _caption(result)[0], "x": 0.5, "y": 0.03, "font": {"size": 14, "color": _caption(result)[1]}},
        showlegend=False,
        height=480,
        margin={"l": 0, "r": 0, "t": 40, "b": 40},
        paper_bgcolor="white",
    )
    return figure


class _Scene(NamedTuple):
    """What a picture shows; the points are few and lie about the target's centre."""

    before: np.ndarray
    after: np.ndarray
    target: np.ndarray
    colors: np.ndarray
    nearer: bool

    def panels(self) -> list[tuple[str, np.ndarray]]:
        return [("before (moved closer to fit)" if self.nearer else "before", self.before), ("after", self.after)]


def _scene(source: ArrayLike, target: ArrayLike, result: Registration) -> _Scene:
    rotation, translation = np.asarray(result.rotation, np.float64), np.asarray(result.translation, np.float64)
    if rotation.ndim != 2:
        raise ValueError(f"result: a picture shows one pair, got a batch of shape {rotation.shape[:-2]}")
    clouds = {}
    for name, cloud, labels in (("source", source, result.source_regions), ("target", target, result.target_regions)):
        clouds[name] = np.asarray(cloud, np.float64)
        if clouds[name].shape != (len(labels), 3):
            raise ValueError(f"{name}: expected the ({len(labels)}, 3) points registered, got {clouds[name].shape}")
    source_rows, target_rows = _thin(len(clouds["source"])), _thin(len(clouds["target"]))
    before, fixed = clouds["source"][source_rows], clouds["target"][target_rows]
    after = before @ rotation.T + translation

    # Clouds in far frames would be two specks: the gap between them is closed to a width.
    origin = fixed.mean(axis=0)
    gap = before.mean(axis=0) - origin
    reach = sum(np.linalg.norm(points - points.mean(axis=0), axis=1).max() for points in (before, fixed))
    distance = float(np.linalg.norm(gap))
    far = distance > 1.5 * reach > 0
    shift = gap * (1 - reach / distance) if far else np.zeros(3)
    return _Scene(
        before=before - origin - shift,
        after=after - origin,
        target=fixed - origin,
        colors=region_colors(np.asarray(result.source_regions)[source_rows]),
        nearer=far,
    )


def _thin(count: int) -> np.ndarray:
    """Rows to draw: random ones, because a stride through ordered scan lines would show stripes; always the same."""
    if count <= _POINTS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, _POINTS, replace=False))


def _caption(result: Registration) -> tuple[str, str]:
    """The diagnostics in a line, and its colour."""
    numbers = f"fitness {float(result.fitness):.3f}    rmse {float(result.rmse):.3g}"
    if bool(result.converged):
        return f"{numbers}    converged", _FAINT
    return f"{numbers}    not converged", _WARNING
