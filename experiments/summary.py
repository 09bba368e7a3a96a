"""The tables of the README, from the results of all experiments: `python experiments/summary.py` writes summary.md."""

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


def load(name: str) -> dict[str, Any]:
    return json.loads((HERE / name / "results.json").read_text())


def find_part(results: dict[str, Any], protocol: str) -> dict[str, Any]:
    return next(part for part in results["parts"] if part["protocol"] == protocol)


def recalls() -> list[str]:
    """Share of pairs within 5° and 0.1: a row a method, a column a protocol; the best of a column in bold."""
    columns = []
    for _, experiment, protocol in PROTOCOLS:
        rows = {row["method"]: row for row in find_part(load(experiment), protocol)["rows"] if "missing" not in row}
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
    for row in part["rows"]:
        if "missing" not in row:
            figures = (
                f"{row['recall_5deg_0.05']:.3f}",
                f"{row['recall_2deg_0.02']:.3f}",
                f"{row['angle_median']:.2f}°",
            )
            lines.append(f"| {row['title']} | " + " | ".join(figures) + " |")
    return lines


def as_markdown() -> str:
    """The three tables of summary.md."""
    return "\n\n".join("\n".join(table) for table in (recalls(), against_the_paper(), real_scans()))


if __name__ == "__main__":
    (HERE / "summary.md").write_text(as_markdown() + "\n")
    print(as_markdown())
