"""Nearest neighbours, ours against others, on two samples of one surface that lie roughly on each other.

    python experiments/benchmarks/neighbors.py

Every way finds the nearest of N points for each of N others, with whatever it builds for that included: comparing all
with all point by point (`nearest` on small clouds) or through a matrix, compact blocks (`nearest` on large clouds),
jaxkd's k-d tree in JAX, and SciPy's k-d tree, which neither compiles nor differentiates. A figure is the median of the
repeats after a warm-up that compiles, in milliseconds a pair of clouds; small clouds go in batches of 64 pairs. All
are compared with SciPy's distances. jaxkd comes with the peers, pip install 'urrt-jax[peers]'. Writes
neighbors.json and neighbors.md beside this file.
"""

import argparse
import functools
import importlib
import importlib.metadata
import json
import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from timing import median_seconds
from tqdm import tqdm

from urrt_jax.clouds import make_cloud
from urrt_jax.data import demo_shape
from urrt_jax.neighbors import LARGE, make_blocks, nearest

HERE = Path(__file__).parent
BATCH = 64
SIZES = (1_024, 4_096, 16_384, 40_000, 200_000, 1_000_000)
MATRIX_LIMIT, DENSE_LIMIT, TREE_LIMIT = 16_384, 40_000, 200_000  # beyond, a run takes minutes or all memory


def point_by_point(query: jax.Array, points: jax.Array) -> jax.Array:
    """Squared distances (N,) by the loop that small clouds take, whatever the size."""
    return nearest(query, make_cloud(points)).squared if len(points) <= LARGE else _slices(query, points)


def _slices(query: jax.Array, points: jax.Array) -> jax.Array:
    found = [nearest(query, make_cloud(points[at : at + LARGE])).squared for at in range(0, len(points), LARGE)]
    return functools.reduce(jnp.minimum, found)


def by_matrix(query: jax.Array, points: jax.Array) -> jax.Array:
    return jnp.min(sum((query[:, None, k] - points[None, :, k]) ** 2 for k in range(3)), axis=1)


def in_blocks(query: jax.Array, points: jax.Array) -> jax.Array:
    cloud = make_cloud(points)
    return nearest(query, cloud, blocks=make_blocks(cloud)).squared


def with_jaxkd(query: jax.Array, points: jax.Array) -> jax.Array:
    return importlib.import_module("jaxkd").build_and_query(points, query, k=1)[1][:, 0] ** 2


WAYS: dict[str, tuple[Callable, int]] = {
    "point by point": (point_by_point, DENSE_LIMIT),
    "matrix": (by_matrix, MATRIX_LIMIT),
    "blocks": (in_blocks, SIZES[-1]),
    "jaxkd": (with_jaxkd, TREE_LIMIT),
}


def clouds(size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two disjoint samples (N, 3) of one surface, the first one turned by 5 degrees."""
    points = demo_shape(2 * size)
    points = points[np.random.default_rng(seed).permutation(len(points))].astype(np.float32)
    turn = Rotation.from_rotvec(np.deg2rad([3, 4, 0])).as_matrix().astype(np.float32)
    return points[::2] @ turn.T, points[1::2]


def measure(size: int, repeats: int) -> dict:
    batch = BATCH if size <= LARGE else 1
    pairs = [clouds(size, seed) for seed in range(batch)]
    query, points = (jnp.asarray(np.stack(each)) for each in zip(*pairs, strict=True))
    truth = np.stack([KDTree(there).query(here)[0] for here, there in pairs]) ** 2
    row: dict = {"points": size, "batch": batch, "milliseconds": {}, "largest_error": {}}
    for name, (way, limit) in WAYS.items():
        if size > limit:
            continue
        run = jax.jit(jax.vmap(way) if batch > 1 else lambda q, p, way=way: way(q[0], p[0])[None])
        try:
            found = np.asarray(run(query, points))
        except ImportError:
            continue
        row["largest_error"][name] = float(np.max(np.abs(np.sqrt(found) - np.sqrt(truth))))
        took = median_seconds(lambda run=run: jax.block_until_ready(run(query, points)), repeats)
        row["milliseconds"][name] = 1e3 * took / batch
    took = median_seconds(lambda: [KDTree(there).query(here, workers=-1) for here, there in pairs], repeats)
    row["milliseconds"]["SciPy"] = 1e3 * took / batch
    return row


def _short(milliseconds: float) -> str:
    return f"{milliseconds:,.0f}" if milliseconds >= 100 else f"{milliseconds:.3g}"


def as_markdown(rows: list[dict]) -> str:
    names = [*WAYS, "SciPy"]
    lines = ["| points | " + " | ".join(names) + " |", "|---:|" + "---:|" * len(names)]
    for row in rows:
        times = [row["milliseconds"].get(name) for name in names]
        best = min(each for name, each in row["milliseconds"].items() if name != "SciPy")
        cells = ["" if each is None else f"**{_short(each)}**" if each == best else _short(each) for each in times]
        title = f"{row['points']:,}" + (f", batches of {row['batch']}" if row["batch"] > 1 else "")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5, help="timed repeats")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, choices=SIZES, help="points of a cloud")
    flags = parser.parse_args()
    rows = [measure(size, flags.repeats) for size in tqdm(flags.sizes, unit="size")]
    versions = {}
    for package in ("jax", "jaxkd", "scipy"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None
    results = {
        "command": "python experiments/benchmarks/neighbors.py",
        "repeats": flags.repeats,
        "cores": os.cpu_count(),
        "device": jax.devices()[0].platform,
        "versions": versions,
        "unit": "milliseconds a pair of clouds",
        "rows": rows,
    }
    (HERE / "neighbors.json").write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "neighbors.md").write_text(as_markdown(rows))
    print(as_markdown(rows))
