"""Real scans: `urrt register` on pairs of the Stanford bunny's range scans, against their measured poses.

    python experiments/bunny_scans/run.py --data PATH/bunny_scans.npz

Writes the two scans of every pair to PLY, runs the command on them as a user would, and compares its answer with the
scans' own poses. Pairs: all ordered ones whose true rotation is at most 60 degrees (the network is trained for up to 45
about each axis) and whose overlap is at least 0.4 (share of source points within 3 mm of the target, in the true pose).
"""

import argparse
import contextlib
import io
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np
from scipy.spatial import KDTree

import urrt_jax
from urrt_jax import model_card
from urrt_jax.cli import main as urrt
from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.io import write_cloud

HERE = Path(__file__).parent


def measure(path: Path) -> dict:
    with np.load(path) as scans:
        names = [str(name) for name in scans["names"]]
        poses = dict(zip(names, scans["pose_to_world"], strict=True))
        clouds = {name: np.asarray(scans[f"pts_{name}"], np.float64) for name in names}
    trees = {name: KDTree(cloud) for name, cloud in clouds.items()}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / f"{name}.ply" for name in names}
        for name, file in files.items():
            write_cloud(file, clouds[name])
        for source, target in itertools.permutations(names, 2):
            truth = np.linalg.inv(poses[target]) @ poses[source]
            moved = clouds[source] @ truth[:3, :3].T + truth[:3, 3]
            overlap = float(np.mean(trees[target].query(moved)[0] < 3e-3))
            turn = float(rotation_degrees(truth[:3, :3], np.eye(3)))
            if turn > 60 or overlap < 0.4:
                continue
            found = run_command(files[source], files[target])
            matrix = np.array(found["matrix"])
            rows.append(
                {
                    "source": source,
                    "target": target,
                    "overlap": round(overlap, 3),
                    "true_rotation_deg": round(turn, 2),
                    "rotation_error_deg": round(float(rotation_degrees(matrix[:3, :3], truth[:3, :3])), 3),
                    "translation_error_mm": round(1e3 * float(np.linalg.norm(matrix[:3, 3] - truth[:3, 3])), 3),
                    "fitness": round(found["fitness"], 3),
                    "rmse_mm": round(1e3 * found["rmse"], 3),
                    "converged": found["converged"],
                }
            )
            print(rows[-1], file=sys.stderr)
        seconds = time_command(files["bun000"], files["bun045"])
    return {
        "command": "python experiments/bunny_scans/run.py --data bunny_scans.npz",
        "model_sha256": model_card()["sha256"],
        "versions": {"urrt_jax": urrt_jax.__version__, "jax": jax.__version__},
        "command_line_seconds": seconds,
        "pairs": rows,
    }


def run_command(source: Path, target: Path) -> dict:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = urrt(["register", str(source), str(target), "--json"])
    assert code == 0, code
    return json.loads(printed.getvalue())


def time_command(source: Path, target: Path) -> dict:
    """Whole-process times of the first `urrt register`, which compiles, of the second, and of `--help`."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {k: v for k, v in os.environ.items() if k != "URRT_NO_CACHE"} | {"XDG_CACHE_HOME": cache}

        def seconds(*arguments: str) -> float:
            start = time.perf_counter()
            command = [sys.executable, "-m", "urrt_jax.cli", *arguments]
            subprocess.run(command, env=environment, check=True, capture_output=True)
            return round(time.perf_counter() - start, 2)

        pair = ("register", str(source), str(target), "--json")
        return {"first": seconds(*pair), "second": seconds(*pair), "help": seconds("register", "--help")}


def as_markdown(rows: list[dict]) -> str:
    heads = ["pair", "overlap", "true rotation", "error R", "error t", "fitness", "rmse", "converged"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        lines.append(
            f"| {row['source']} → {row['target']} | {row['overlap']:.2f} | {row['true_rotation_deg']:.1f}° "
            f"| {row['rotation_error_deg']:.2f}° | {row['translation_error_mm']:.2f} mm | {row['fitness']:.2f} "
            f"| {row['rmse_mm']:.2f} mm | {'yes' if row['converged'] else 'no'} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="bunny_scans.npz: names, pose_to_world, pts_<name>")
    results = measure(parser.parse_args().data)
    (HERE / "results.json").write_text(json.dumps(results, indent=2) + "\n")
    (HERE / "table.md").write_text(as_markdown(results["pairs"]))
    print(as_markdown(results["pairs"]), results["command_line_seconds"])
