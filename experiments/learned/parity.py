"""Whether the learned peers give here what their authors' own code gave, with the same released weights and pairs.

    python experiments/learned/parity.py --data PATH

PATH also holds the folder `peers` with the released weights. For each protocol: the first items of every 12th item of
the test split, as many as the authors' code was run on. Writes parity.json and parity.md beside this file.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np

from urrt_jax.atomic import write_atomically
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import evaluate, find_method, values_path

HERE = Path(__file__).parent
# Of the authors' networks, run by their own code on a CPU with these weights: method, protocol, items, MSE(R), MAE(R).
AUTHORS: tuple[tuple[str, str, int, float, float], ...] = (
    ("dcp_v1", "dcp", 100, 2.16, 0.977),
    ("dcp_v1", "drift", 100, 81.4, 5.01),
    ("dcp_v1", "prnet signs=3", 100, 1424, 22.1),
    ("dcp_v1", "outliers", 100, 7206, 67.7),
    ("dcp_v1", "independent", 100, 5176, 50.9),
    ("dcp_v1", "incomplete", 100, 3032, 36.8),
    ("rienet", "dcp", 84, 0.0000, 0.00001),
    ("rienet", "drift", 82, 6186, 57.6),
    ("rienet", "prnet", 100, 0.0029, 0.0083),
    ("rienet", "prnet signs=3", 100, 0.0040, 0.0135),
    ("rienet", "outliers", 95, 0.0155, 0.038),
    ("rienet", "independent", 100, 6696, 63.4),
    ("pointnetlk_learning3d", "dcp", 100, 315.6, 6.35),
    ("pointnetlk_learning3d", "drift", 100, 232.1, 5.84),
    ("pointnetlk_learning3d", "prnet signs=3", 100, 844.8, 15.5),
    ("pointnetlk_learning3d", "outliers", 100, 1801, 34.5),
    ("pointnetlk_learning3d", "independent", 100, 390.3, 7.80),
    ("pointnetlk_learning3d", "incomplete", 100, 1463, 21.4),
    ("pointnetlk", "dcp", 100, 227.9, 4.56),
    ("pointnetlk", "drift", 100, 144.5, 4.35),
    ("pointnetlk", "prnet signs=3", 100, 523.8, 11.4),
    ("pointnetlk", "outliers", 100, 1665, 31.4),
    ("pointnetlk", "independent", 100, 258.8, 6.00),
    ("pointnetlk", "incomplete", 100, 893, 17.9),
    ("pointnetlk_revisited", "dcp", 50, 159.8, 2.90),
    ("pointnetlk_revisited", "drift", 25, 218.8, 3.60),
    ("pointnetlk_revisited", "prnet signs=3", 20, 403.9, 7.26),
    ("pointnetlk_revisited", "independent", 25, 221.7, 4.62),
)


def measure(data: str) -> list[dict]:
    """A row for every line of `AUTHORS`, with what is measured here beside it; values are kept in `items`."""
    shapes = load_shapes(data, split="test", points=1024).points
    folder = HERE.parent / "items"
    folder.mkdir(exist_ok=True)
    rows = []
    for name, protocol, count, mse, mae in AUTHORS:
        method, items = find_method(name), np.arange(0, len(shapes), 12)[:100]
        save = values_path(folder, name, method, protocol, shapes, items)
        found = evaluate(method, protocol, shapes, items=items, save=save).take(np.arange(count)).summary()
        rows.append(
            {
                "method": method.title,
                "protocol": protocol,
                "items": count,
                "authors": {"mse_rotation": mse, "mae_rotation": mae},
                "here": {key: found[key] for key in ("mse_rotation", "mae_rotation")},
            }
        )
    return rows


def as_markdown(rows: list[dict]) -> str:
    lines = [
        "| method | protocol | pairs | MSE(R), authors' code | here | MAE(R), authors' code | here |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        cells = [f"{row[whose][key]:.4g}" for key in ("mse_rotation", "mae_rotation") for whose in ("authors", "here")]
        lines.append(f"| {row['method']} | {row['protocol']} | {row['items']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it, with the folder 'peers'")
    given = parser.parse_args()
    os.environ["URRT_DATA"] = given.data  # where released weights are looked for
    rows = measure(given.data)
    command = f"python experiments/learned/parity.py --data {Path(given.data).name}"
    write_atomically(HERE / "parity.json", json.dumps({"command": command, "rows": rows}, indent=1) + "\n")
    write_atomically(HERE / "parity.md", as_markdown(rows))
    print(as_markdown(rows))
