"""The tables that compare methods over all protocols, from the results of the experiments.

    python experiments/summary.py

writes a `summary_NAME.md` here for every table of `TABLES`; `python -m experiments.pages` then puts them into the
pages. Imports neither JAX nor urrt_jax.
"""

import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
METHODS = (
    "identity", "principal_axes", "icp", "fgr", "fgr_icp", "ransac", "ransac_icp", "kiss", "network", "plain",
)  # fmt: skip
# Heading, experiment, protocol.
PROTOCOLS = (
    ("clean", "table3_comparison", "dcp"),
    ("D.I. one-sided", "table2_noise", "incomplete"),
    ("D.I. two-sided", "table2_noise", "incomplete_both"),
    ("P.D.", "table2_noise", "drift"),
    ("D.O. 10 %", "table2_noise", "outliers"),
    ("D.O. 20 %", "table2_noise", "outliers share=0.2"),
    ("independent", "beyond", "independent"),
    ("independent + noise", "beyond", "independent_noise"),
    ("PRNet + noise", "beyond", "prnet_noise"),
    ("RPM-Net crops", "beyond", "rpmnet"),
)
PAPER = ("3D-URRT (paper)", "C (paper)")
# As above, and the model that stands in the columns of the network alone and without a search.
AGAINST_THE_PAPER = (
    ("clean, as the paper: one step, trained on clean pairs", "table1_ablation", "dcp", ":modelnet40-paper"),
    *((*protocol, "") for protocol in PROTOCOLS[:6]),
)
# Heading, experiment, protocol and recall.
SHORT = (
    ("clean pairs", "table3_comparison", "dcp", "recall_5deg_0.1"),
    ("both clouds cropped (D.I.)", "table2_noise", "incomplete_both", "recall_5deg_0.1"),
    ("20 % outliers (D.O.)", "table2_noise", "outliers share=0.2", "recall_5deg_0.1"),
    ("independent samples, noise", "beyond", "independent_noise", "recall_5deg_0.1"),
    ("RPM-Net's noisy crops", "beyond", "rpmnet", "recall_5deg_0.1"),
    ("real scans", "beyond", "scans", "recall_5deg_0.05"),
)
# Title; the methods whose recalls a row shows, the first that was measured on the pairs of a column; and how the rows
# begin that hold its times for 1,024 points and for scans.
SHORT_ROWS = (
    ("`register`", ("register", "plain"), "register, one pair a call", "scans of 40,000 points: register"),
    ("`register(search=None)`", ("plain",), None, None),
    ("the network alone", ("network",), None, None),
    ("RANSAC + ICP (Open3D)", ("ransac_icp", "scan_ransac"), None, "scans: RANSAC"),
    ("RANSAC (Open3D)", ("ransac",), None, None),
    ("FGR + ICP (Open3D)", ("fgr_icp", "scan_fgr"), "FGR + ICP", None),
    ("ICP (Open3D)", ("icp", "scan_icp"), "ICP from the centroids", None),
    ("KISS-Matcher", ("kiss", "scan_kiss"), None, "scans: KISS"),
)


def load(name: str) -> dict[str, Any]:
    return json.loads((HERE / name / "results.json").read_text())


def find_part(results: dict[str, Any], protocol: str) -> dict[str, Any]:
    return next(part for part in results["parts"] if part["protocol"] == protocol)


def measured(part: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The rows of a part that were measured, by method."""
    return {row["method"]: row for row in part["rows"] if "missing" not in row}


def short() -> list[str]:
    """The best of ours and of other libraries' methods on six protocols, and what they take."""
    columns = [
        (head, _short_recalls(experiment, protocol, recall), max) for head, experiment, protocol, recall in SHORT
    ]
    columns += [(f"ms, {what}", _milliseconds(place), min) for place, what in ((2, "1,024 points"), (3, "scans"))]
    best = [pick(value for value in values if value is not None) for _, values, pick in columns]
    lines = ["| | " + " | ".join(head for head, _, _ in columns) + " |", "|---|" + "---:|" * len(columns)]
    for place, (title, *_) in enumerate(SHORT_ROWS):
        cells = []
        for (_, values, pick), top in zip(columns, best, strict=True):
            value, style = values[place], ".3f" if pick is max else ".0f"
            text = "–" if value is None else format(value, style)
            cells.append(f"**{text}**" if text == format(top, style) else text)
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    batched = next(row for row in _speed() if row["method"].startswith("register, batches"))["milliseconds_a_pair"]
    legend = (
        "Recall: the share of pairs within 5° and 0.1 of the true pose (scans: 5° and 0.05 of their diagonal). Bold: "
        "the best of a column; –: not measured. `register` is the default call where it was measured on all pairs of a "
        "column (RPM-Net's crops, scans); its other recalls are those of the row below. ms: one pair a call, on two "
        f"CPU cores; `register` takes {batched:.0f} ms a pair in batches of 32. On scans `register` is timed with a "
        "search of every pair, and the other libraries' methods end in point-to-plane ICP."
    )
    return [*lines, "", legend]


def _short_recalls(experiment: str, protocol: str, recall: str) -> list[float | None]:
    part = find_part(load(experiment), protocol)
    rows = measured(part)
    default = [each for each in load("default_call")["parts"] if each["protocol"] == protocol]
    if default and all(default[0][key] == part[key] for key in ("data", "items")):
        rows |= {"register": measured(default[0])["register"]}
    found = [next((rows[name] for name in names if name in rows), None) for _, names, *_ in SHORT_ROWS]
    return [None if row is None else row[recall] for row in found]


def _milliseconds(place: int) -> list[float | None]:
    """What the rows take, in milliseconds a pair; ``place`` is where they name the beginning of their times' title."""
    times = {row["method"]: row.get("milliseconds_a_pair") for row in _speed()}
    begins = [row[place] for row in SHORT_ROWS]
    return [
        None if begin is None else next(time for method, time in times.items() if method.startswith(begin))
        for begin in begins
    ]


def _speed() -> list[dict[str, Any]]:
    return json.loads((HERE / "benchmarks" / "speed.json").read_text())["rows"]


def recalls() -> list[str]:
    """Share of pairs within 5° and 0.1: a row a method, a column a protocol; the best of a column in bold."""
    columns = []
    for _, experiment, protocol in PROTOCOLS:
        rows = measured(find_part(load(experiment), protocol))
        columns.append({name: f"{row['recall_5deg_0.1']:.3f}" for name, row in rows.items()})
    best = [max(values.values()) for values in columns]
    titles = {
        row["method"]: row["title"]
        for name in ("table3_comparison", "beyond")
        for part in load(name)["parts"]
        for row in part["rows"]
    }
    lines = ["| within 5° and 0.1 | " + " | ".join(head for head, _, _ in PROTOCOLS) + " |"]
    lines.append("|---|" + "---:|" * len(PROTOCOLS))
    for name in METHODS:
        cells = [values.get(name, "–") for values in columns]
        cells = [f"**{cell}**" if cell == top else cell for cell, top in zip(cells, best, strict=True)]
        lines.append(f"| {titles[name]} | " + " | ".join(cells) + " |")
    return lines


def against_the_paper() -> list[str]:
    """MAE(R) and MAE(t) of the paper's protocols: its own figures, our network alone, and refined without a search."""
    lines = ["| MAE(R), MAE(t) | the paper's network | ours, network alone | ours, without search | FGR (Open3D) |"]
    lines.append("|---|---:|---:|---:|---:|")
    for head, experiment, protocol, suffix in AGAINST_THE_PAPER:
        part = find_part(load(experiment), protocol)
        paper = next((part["published"][name] for name in PAPER if name in part["published"]), None)
        cells = ["" if paper is None else f"{paper[1]:.3f}°, {paper[3]:.4f}"]
        rows = {row["method"]: row for row in part["rows"]}
        for name in (f"network{suffix}", f"plain{suffix}", "fgr"):
            row = rows[name]
            cells.append(
                "not installed" if "missing" in row else f"{row['mae_rotation']:.3f}°, {row['mae_translation']:.4f}"
            )
        lines.append(f"| {head} | " + " | ".join(cells) + " |")
    return lines


def real_scans() -> list[str]:
    """Success on the pairs of real scans."""
    part = find_part(load("beyond"), "scans")
    lines = ["| real scans | within 5°, 0.05 | within 2°, 0.02 | median error |", "|---|---:|---:|---:|"]
    for row in measured(part).values():
        figures = (f"{row['recall_5deg_0.05']:.3f}", f"{row['recall_2deg_0.02']:.3f}", f"{row['angle_median']:.2f}°")
        lines.append(f"| {row['title']} | " + " | ".join(figures) + " |")
    return lines


def learned() -> list[str]:
    """All against all: recall and MAE(R) of every method on every protocol, its parameters and its time."""
    parts, networks = load("learned")["parts"], json.loads((HERE / "benchmarks" / "networks.json").read_text())
    costs = {row["name"]: row for row in networks["rows"]}
    heads = [part["title"] for part in parts]
    lines = ["| recall, MAE(R) | " + " | ".join(heads) + " | ms a pair | parameters |"]
    lines.append("|---|" + "---:|" * (len(heads) + 2))
    rows = [measured(part) for part in parts]
    best = [max(f"{row['recall_5deg_0.1']:.2f}" for row in each.values()) for each in rows]
    for name in dict.fromkeys(name for each in rows for name in each):
        cells = []
        for each, top in zip(rows, best, strict=True):
            if name not in each:
                cells.append("–")
                continue
            recall = f"{each[name]['recall_5deg_0.1']:.2f}"
            cells.append(f"{f'**{recall}**' if recall == top else recall}, {each[name]['mae_rotation']:.1f}°")
        cost = costs.get(name.partition(":")[0], {})
        time, size = cost.get("milliseconds_a_pair"), cost.get("parameters")
        cells += ["–" if time is None else f"{time:,.0f}", "–" if size is None else f"{size:,}"]
        title = next(each[name]["title"] for each in rows if name in each)
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return lines


def trained() -> list[str]:
    """Learned methods on clean pairs, trained here and with released weights, beside the paper's figures."""
    (part,) = (part for part in load("table3_comparison")["parts"] if part["title"].endswith("learned methods"))
    rows, networks = measured(part), json.loads((HERE / "benchmarks" / "networks.json").read_text())
    paper = {name.removesuffix(" (paper)"): values for name, values in part["published"].items()}
    lines = [
        "| MSE(R), MAE(R) | pairs seen | trained here | released weights | the paper |",
        "|---|---:|---:|---:|---:|",
    ]
    for network in networks["rows"]:
        own = rows.get(f"{network['name']}:experiments/learned/weights/{network['name']}.npz")
        if own is None:
            continue
        released, published = rows.get(network["name"]), paper.get(network["method"])
        cells = [_both(own["mse_rotation"], own["mae_rotation"])]
        cells.append("–" if released is None else _both(released["mse_rotation"], released["mae_rotation"]))
        cells.append("–" if published is None else _both(*published[:2]))
        card = json.loads((HERE / "learned" / "weights" / f"{network['name']}.json").read_text())
        seen = card["steps"] * card["training"]["batch"]
        lines.append(f"| {network['method']} | {seen:,} | " + " | ".join(cells) + " |")
    return lines


def _both(mse: float, mae: float) -> str:
    return f"{mse:.2f}, {mae:.3f}°"


TABLES = {
    "short": short,
    "recalls": recalls,
    "paper": against_the_paper,
    "scans": real_scans,
    "learned": learned,
    "trained": trained,
}
"""What draws each table, `summary_NAME.md`, line by line."""

if __name__ == "__main__":
    for name, draw in TABLES.items():
        (HERE / f"summary_{name}.md").write_text("\n".join(draw()) + "\n")
        print(f"wrote summary_{name}.md")
