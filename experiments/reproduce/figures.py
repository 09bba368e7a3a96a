"""Figures drawn from results: recall against the error allowed, and errors against rotation, overlap and options."""

import itertools
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK, _FAINT = "#2f3640", "#8a94a0"
_OURS = {
    "search": "#7b241c",
    "search_all": "#7b241c",
    "search_near": "#2c0b08",
    "register": "#c0392b",
    "plain": "#a93226",
    "network": "#e59866",
}
_COLORS = (
    "#2a67b0", "#26897f", "#7054a8", "#b8860b", "#62a140", "#5d6d7e", "#d65c94", "#12b0c4", "#96582f", "#94284e",
    "#1b2631", "#7fb3d5", "#a9cc6a", "#c39bd3", "#d4ac0d", "#45b39d",
)  # fmt: skip


def draw_recalls(results: dict[str, Any], path: Path) -> None:
    """Draws one panel per part: the share of pairs (vertical) whose rotation error is below an angle (horizontal)."""
    parts = [part for part in results["parts"] if any("recall_curve" in row for row in part["rows"])]
    if not parts:
        return
    figure, panels = _panels(len(parts))
    styles = _styles(results)
    for axes, part in zip(panels, parts, strict=True):
        for row in _measured(part):
            axes.plot(results["thresholds"], row["recall_curve"], label=row["title"], **styles[row["method"]])
        axes.set(xscale="log", xlim=(0.1, 180), ylim=(0, 1.01))
        axes.set_title(textwrap.fill(part["title"], 44), fontsize=8, color=_INK)
        axes.set_xticks([0.1, 1, 5, 30, 180], ["0.1°", "1°", "5°", "30°", "180°"])
    _finish(figure, panels, "rotation error allowed", "share of pairs", path)


def draw_trends(results: dict[str, Any], path: Path) -> None:
    """Draws the median rotation error against the true rotation and against the overlap, one panel each per part."""
    bins, styles = results["trend_bins"], _styles(results)
    parts = [part for part in results["parts"] if any("trends" in row for row in part["rows"])]
    drawn = [(part, name) for part in parts for name in bins if _varies(part, name)]
    if not drawn:
        return
    figure, panels = _panels(len(drawn))
    for axes, (part, name) in zip(panels, drawn, strict=True):
        edges = bins[name]
        middles = [(low + high) / 2 for low, high in itertools.pairwise(edges)]
        for row in _measured(part):
            values = row.get("trends", {}).get(name, [None] * len(middles))
            known = [(x, max(y, 1e-2)) for x, y in zip(middles, values, strict=True) if y is not None]
            if known:
                style = styles[row["method"]]
                axes.plot(*zip(*known, strict=True), marker="o", markersize=2.5, label=row["title"], **style)
        axes.set(yscale="log")
        axes.set_title(textwrap.fill(part["title"], 44), fontsize=8, color=_INK)
        axes.set_xlabel(name, fontsize=8, color=_INK)
    _finish(figure, panels, "", "median rotation error in degrees", path)


def draw_sweeps(results: dict[str, Any], path: Path) -> None:
    """Draws one panel per sweep: the share of pairs within 5° and 0.1 against the value of the swept option."""
    sweeps = [sweep for sweep in results["sweeps"] if sweep["rows"]]
    if not sweeps:
        return
    figure, panels = _panels(len(sweeps))
    styles = _styles(results)
    for axes, sweep in zip(panels, sweeps, strict=True):
        for row in _measured(sweep):
            shown = {"marker": "o", "markersize": 3, "label": row["title"]} | styles[row["method"]]
            axes.plot(sweep["values"], row["recall_5deg_0.1"], **shown)
        axes.set(ylim=(0, 1.01))
        axes.set_xlabel(sweep["title"], fontsize=8, color=_INK)
    _finish(figure, panels, "", "share within 5° and 0.1", path)


def draw_matrix(results: dict[str, Any], path: Path) -> None:
    """Draws a row a method and a column a part: the share of pairs within 5° and 0.1, as colour and number."""
    parts = [part for part in results["parts"] if _measured(part)]
    if not parts:
        return
    titles = {row["method"]: row["title"] for part in parts for row in _measured(part)}
    figure, (axes,) = _panels(1)
    figure.set_size_inches(2.6 + 0.62 * len(parts) + 0.9, 1.5 + 0.24 * len(titles))
    for across, part in enumerate(parts):
        for row in _measured(part):
            share, down = row["recall_5deg_0.1"], list(titles).index(row["method"])
            axes.fill_between([across - 0.5, across + 0.5], down - 0.5, down + 0.5, color=_shade(share), linewidth=0)
            ink = "white" if share > 0.6 else _INK
            axes.text(across, down, f"{share:.2f}", ha="center", va="center", fontsize=7, color=ink)
    axes.set(xlim=(-0.5, len(parts) - 0.5), ylim=(len(titles) - 0.5, -0.5))
    axes.set_xticks(range(len(parts)), [part["title"] for part in parts], rotation=40, ha="left", fontsize=7.5)
    axes.set_yticks(range(len(titles)), list(titles.values()), fontsize=7.5)
    axes.xaxis.tick_top()
    axes.tick_params(length=0, colors=_INK)
    for side in axes.spines.values():
        side.set_visible(False)
    figure.savefig(path)


def _shade(share: float) -> tuple[float, float, float]:
    """From nearly white, where no pair is right, to a dark blue, where all are."""
    low, high = (0.95, 0.965, 0.98), (0.11, 0.31, 0.55)
    return tuple(a + share * (b - a) for a, b in zip(low, high, strict=True))  # type: ignore[return-value]


def _varies(part: dict[str, Any], name: str) -> bool:
    """Whether the pairs of a part fall into more than one bin."""
    return any(sum(value is not None for value in row.get("trends", {}).get(name, [])) > 1 for row in part["rows"])


def _styles(results: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The line style of each method, the same in every panel.

    Our methods are red and drawn on top. Lines are dashed for a method that names its model ("network:NAME").
    """
    names = [row["method"] for part in (*results["parts"], *results["sweeps"]) for row in part["rows"]]
    colors, styles = itertools.cycle(_COLORS), {}
    for name in dict.fromkeys(names):
        stages, _, own = name.partition(":")
        if stages in _OURS:
            dashes = "--" if own else "-"
            styles[name] = {"color": _OURS[stages], "linewidth": 2.2, "linestyle": dashes, "zorder": 3}
        else:
            styles[name] = {"color": next(colors), "linewidth": 1.2, "zorder": 2}
    return styles


def _measured(part: dict[str, Any]) -> list[dict[str, Any]]:
    return [row for row in part["rows"] if "missing" not in row]


def check_drawing() -> None:
    """Raises `ImportError` if Matplotlib is not installed; call it before the long work, not after."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError("figures need Matplotlib: pip install 'urrt-jax[viz]'") from error


def _panels(count: int) -> "tuple[Figure, list[Axes]]":
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(count, 3)
    lines = -(-count // columns)
    figure = Figure(figsize=(3.6 * columns + 0.4, 2.9 * lines + 0.9), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, list(grid[:count])


def _finish(figure: "Figure", panels: "list[Axes]", across: str, up: str, path: Path) -> None:
    named = {}
    for axes in panels:
        axes.grid(color="#e8ebee", linewidth=0.8)
        axes.tick_params(labelsize=7, colors=_FAINT)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, line)
    if across:
        for axes in panels:
            axes.set_xlabel(across, fontsize=8, color=_INK)
    figure.supylabel(up, fontsize=9, color=_INK)
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, fontsize=7.5, frameon=False)
    figure.savefig(path)
