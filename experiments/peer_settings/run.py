"""The grid that the peers' settings were chosen from, on training shapes: no test pair is looked at.

    python experiments/peer_settings/run.py --data PATH

Share of 40 pairs within 5° and 0.1, for four protocols. Writes results.json and table.md beside this file.
"""

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
from tqdm import tqdm

from urrt_jax.data import load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.peers import FGR, GICP, RANSAC, KISSMatcher, Open3DICP, Peer, PointToPlaneICP

HERE = Path(__file__).parent
PROTOCOLS = ("dcp", "incomplete_both", "independent_noise", "outliers")
PAIRS = 40


def grid() -> list[tuple[str, Peer]]:
    """Every peer with every setting that was tried."""
    tried: list[tuple[str, Peer]] = []
    for reach in (0.1, 0.2, 0.5):
        for kind in (Open3DICP, PointToPlaneICP, GICP):
            tried.append((f"reach {reach}", kind(reach=reach)))
    for normal, feature in itertools.product((0.15, 0.25), (0.3, 0.5)):
        radii = f"radii {normal}, {feature}"
        tried.append((radii, FGR(normal_radius=normal, feature_radius=feature)))
        for reach in (0.03, 0.05, 0.1):
            tried.append((f"{radii}, reach {reach}", RANSAC(normal_radius=normal, feature_radius=feature, reach=reach)))
    tried += [(f"voxel {voxel}", KISSMatcher(voxel=voxel)) for voxel in (0.02, 0.03, 0.05, 0.08, 0.1, 0.15)]
    return sorted(tried, key=lambda each: each[1].title)


def measure(data: str) -> list[dict]:
    shapes = load_shapes(data, split="train", points=1024)
    items = np.linspace(0, len(shapes) - 1, PAIRS).astype(int)
    rows = []
    for name, peer in tqdm(grid(), unit="setting"):
        found = [evaluate(peer, protocol, shapes.points, items=items, progress=False) for protocol in PROTOCOLS]
        recalls = [each.summary()["recall_5deg_0.1"] for each in found]
        rows.append({"peer": peer.title, "setting": name, **dict(zip(PROTOCOLS, recalls, strict=True))})
    return rows


def as_markdown(rows: list[dict]) -> str:
    lines = ["| peer | setting | " + " | ".join(PROTOCOLS) + " | mean |", "|---|---|" + "---:|" * (len(PROTOCOLS) + 1)]
    for row in rows:
        recalls = [row[protocol] for protocol in PROTOCOLS]
        cells = [f"{value:.3f}" for value in (*recalls, np.mean(recalls))]
        lines.append(f"| {row['peer']} | {row['setting']} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it")
    given = parser.parse_args()
    rows = measure(given.data)
    command = f"python experiments/peer_settings/run.py --data {Path(given.data).name}"
    (HERE / "results.json").write_text(json.dumps({"command": command, "pairs": PAIRS, "rows": rows}, indent=1) + "\n")
    (HERE / "table.md").write_text(as_markdown(rows))
    print(as_markdown(rows))
