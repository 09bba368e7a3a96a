"""Markdown tables drawn from results. Imports neither JAX nor urrt_jax, so that checks of results are quick."""

from typing import Any

# Per column: its heading, its number format, and whether a smaller value is better.
_COLUMNS: dict[str, tuple[str, str, bool]] = {
    "mse_rotation": ("MSE(R)", ".4f", True),
    "rmse_rotation": ("RMSE(R)", ".4f", True),
    "mae_rotation": ("MAE(R)", ".4f", True),
    "mse_translation": ("MSE(t)", ".6f", True),
    "rmse_translation": ("RMSE(t)", ".4f", True),
    "mae_translation": ("MAE(t)", ".6f", True),
    "angle_mean": ("mean angle", ".3f", True),
    "angle_median": ("median angle", ".3f", True),
    "angle_p95": ("95 % angle", ".2f", True),
    "distance_mean": ("mean ‖t‖", ".4f", True),
    "distance_median": ("median ‖t‖", ".4f", True),
    "recall_1deg": ("recall 1°", ".3f", False),
    "recall_1deg_0.05": ("recall 1° / 0.05", ".3f", False),
    "recall_2deg_0.02": ("recall 2° / 0.02", ".3f", False),
    "recall_5deg_0.05": ("recall 5° / 0.05", ".3f", False),
    "recall_5deg_0.1": ("recall 5° / 0.1", ".3f", False),
    "chamfer_mean": ("Chamfer", ".5f", True),
    "converged": ("called converged", ".3f", False),
    "converged_but_off_by_5deg": ("converged, but off by 5°", ".3f", True),
    "failures": ("failures", "d", True),
}


def as_markdown(results: dict[str, Any]) -> str:
    """The Markdown of an experiment's results: one table per part, with the best measured value of a column in bold."""
    lines = [f"# {results['title']}", ""]
    if results["note"]:
        lines += [results["note"], ""]
    device = f"{results['device']}, {results['processor']}"
    lines += [
        f"Written by `{results['command']}`, with the weights {results['model']} ({results['model_sha256'][:12]}); "
        f"{device}; the seed of an item is its number. Bold: the best measured value.",
        "",
    ]
    for part in results["parts"]:
        lines += [part_markdown(results, part), ""]
    lines += settings_markdown(results)
    return "\n".join(lines)


def part_markdown(results: dict[str, Any], part: dict[str, Any]) -> str:
    """The table of one part with its heading. Published rows come first, in italics."""
    columns = part["columns"] or results["columns"]
    where = f"{part['subset']} of {part['data']}" if part["data"] else part["missing"]
    about = f"Protocol `{part['protocol']}`, {where}. {part['note']}"
    lines = [f"## {part['title']}", "", about.strip(), ""]
    lines += ["| method | " + " | ".join(map(_heading, columns)) + " |", "|---|" + "---:|" * len(columns)]
    for title, values in part["published"].items():
        figures = values if isinstance(values, dict) else dict(zip(results["published_columns"], values, strict=True))
        lines.append(f"| *{title}* | " + " | ".join(_published(figures.get(column)) for column in columns) + " |")
    best = {column: _best(part["rows"], column) for column in columns}
    for row in part["rows"]:
        if "missing" in row:
            lines.append(f"| {row['title']} | {row['missing']} |" + " |" * (len(columns) - 1))
            continue
        cells = [_cell(_value(row, column), column, best[column]) for column in columns]
        failed = f" ({row['failures']} failed)" if row["failures"] else ""
        lines.append(f"| {row['title']}{failed} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def heading(column: str) -> str:
    """The heading of a column; `ValueError` for an unknown column."""
    return _look_up(column)[0]


def _look_up(column: str) -> tuple[str, str, bool]:
    if column.removeprefix("asymmetric.") not in _COLUMNS:
        raise ValueError(f"columns: expected some of {', '.join(_COLUMNS)}, got {column!r}")
    return _COLUMNS[column.removeprefix("asymmetric.")]


def _heading(column: str) -> str:
    return heading(column) + (" †" if column.startswith("asymmetric.") else "")


def _value(row: dict[str, Any], column: str) -> Any:
    name = column.removeprefix("asymmetric.")
    return (row if name == column else row.get("asymmetric", {})).get(name)


def _best(rows: list[dict[str, Any]], column: str) -> str | None:
    """The best value of a column, as printed; None if fewer than two rows have a value or all values are equal."""
    _, style, less = _look_up(column)
    values = [_value(row, column) for row in rows if "missing" not in row and _value(row, column) is not None]
    if len(values) < 2 or min(values) == max(values):
        return None
    return format(min(values) if less else max(values), style)


def _cell(value: Any, column: str, best: str | None) -> str:
    if value is None:
        return ""
    text = format(value, _look_up(column)[1])
    return f"**{text}**" if text == best else text


def settings_markdown(results: dict[str, Any]) -> list[str]:
    """The section with the settings of every other library's method, one line per method; empty if there are none."""
    lines = {}
    for part in results["parts"]:
        for row in part["rows"]:
            settings = row.get("identity", {}).get("settings")
            if settings:
                lines[row["title"]] = f"- {row['title']}: {_flat(settings)}"
    return (
        ["## Settings of the peers", "", "Lengths in units of the unit sphere.", "", *lines.values(), ""]
        if lines
        else []
    )


def _flat(settings: dict[str, Any]) -> str:
    pairs = [(key, f"({_flat(value)})" if isinstance(value, dict) else value) for key, value in settings.items()]
    return ", ".join(f"{key} {value}" for key, value in pairs)


def _published(value: Any) -> str:
    return "" if value is None else f"*{value}*"
