"""The packaged models' cards: what was measured with each, its licence and its limits.

    python experiments/cards.py

Figures come from the results of the tables: run it after them.
"""

import json
from pathlib import Path
from typing import Any

from urrt_jax import available_models
from urrt_jax.atomic import write_atomically

HERE = Path(__file__).parent
WEIGHTS = HERE.parent / "urrt_jax" / "weights"
TABLES = ("table1_ablation", "table2_noise", "beyond", "unseen")
FIGURES = ("rmse_rotation", "mae_rotation", "rmse_translation", "mae_translation", "recall_1deg", "recall_5deg_0.1")
DEFAULT = "modelnet40"
LICENCE = "Apache-2.0. Trained on ModelNet40, whose shapes are for research use and are not included."
LIMITS = {
    "modelnet40": "Whole shapes within 45° about each axis, with noise, crops and outliers: beyond that, a search.",
    "modelnet40-paper": "Clean pairs that hold the same points, turned by 0° to 45° about each axis: for comparison.",
    "modelnet40-unseen": "As modelnet40, but from the first 20 categories, in fewer steps: for tests on the other 20.",
}


def measured(name: str) -> list[dict[str, Any]]:
    """What the tables say of a model: an entry for each protocol, of the network alone and without a search."""
    suffix = "" if name == DEFAULT else f":{name}"
    entries = []
    for table in TABLES:
        for part in json.loads((HERE / table / "results.json").read_text())["parts"]:
            for row in part["rows"]:
                if row["method"] in (f"network{suffix}", f"plain{suffix}"):
                    stages = row["method"].removesuffix(suffix) if suffix else row["method"]
                    figures = {figure: float(f"{row[figure]:.6g}") for figure in FIGURES}
                    about = {"protocol": part["protocol"], "data": part["data"], "items": part["items"]}
                    entries.append({"table": table, **about, "method": stages, **figures})
    return entries


if __name__ == "__main__":
    for name in available_models():
        path = WEIGHTS / f"{name}.json"
        card = json.loads(path.read_text()) | {
            "licence": LICENCE,
            "limits": LIMITS[name],
            "measured": measured(name),
        }
        write_atomically(path, json.dumps(card, indent=2) + "\n")
        print(f"wrote {path.name}: {len(card['measured'])} rows")
