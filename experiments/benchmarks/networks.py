"""What every registration network takes for a pair of 1,024 points, in batches of 32, and how many parameters it has.

    python experiments/benchmarks/networks.py [--repeats 5] [--methods dcp_v1 rienet ...]

All take turns in one run, on procedural shapes with noise; weights are random, since times do not depend on them. Ours
is timed alone and refined, with its packaged weights; ICP and FGR of Open3D, where it is installed, pair by pair.
Writes networks.json and networks.md beside this file.
"""

import argparse
import functools
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from urrt_jax import load_model, register_pairs
from urrt_jax.clouds import Cloud
from urrt_jax.data import procedural_shapes
from urrt_jax.evaluation import PROTOCOLS
from urrt_jax.peers import PEERS
from urrt_jax.peers.learned.network import Network, estimate_batch
from urrt_jax.peers.learned.weights import NETWORKS

HERE = Path(__file__).parent
BATCH, POINTS = 32, 1024
CLASSICAL = ("icp", "fgr_icp")


def parameters(network: Network) -> int:
    """How many parameters a network has, those of batch norm included, its running statistics not."""
    variables = jax.eval_shape(network.init, jax.random.key(0))
    return sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))


class Contender(NamedTuple):
    """What is timed: a function that registers all pairs; and how many parameters it has, where it is a network."""

    title: str
    run: Callable
    parameters: int | None


def contenders(names: list[str], sources: np.ndarray, targets: np.ndarray) -> dict[str, Contender]:
    """What is timed, by its name in `urrt evaluate --methods`."""
    real = jnp.ones(sources.shape[:2], bool)
    clouds = Cloud(jnp.asarray(sources), real), Cloud(jnp.asarray(targets), real)
    found: dict[str, Contender] = {}
    for name in names:
        network = NETWORKS[name]
        variables, key = network.init(jax.random.key(0)), jax.random.key(0)
        run = functools.partial(estimate_batch, network, variables, *clouds, key)
        found[name] = Contender(network.title, run, parameters(network))
    model = load_model()
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(model.params))
    ours: dict[str, tuple[str, dict[str, Any]]] = {
        "network": ("ours, network alone", {"refine": None}),
        "plain": ("ours, without search", {"search": None}),
        "register": ("ours, register", {}),
    }
    for name, (title, told) in ours.items():
        run = functools.partial(register_pairs, sources, targets, model=model, batch=BATCH, **told)
        found[name] = Contender(title, run, size)
    for name in CLASSICAL:
        peer = PEERS[name]
        try:
            peer.versions()
        except ImportError:
            continue
        pairs = list(zip(sources.astype(np.float64), targets.astype(np.float64), strict=True))
        found[name] = Contender(peer.title, lambda peer=peer, pairs=pairs: [peer.align_pair(*x) for x in pairs], None)
    return found


def measure(names: list[str], repeats: int) -> dict:
    shapes = procedural_shapes(BATCH, points=POINTS, seed=0).points
    trials = [PROTOCOLS["drift"](shapes, item) for item in range(BATCH)]
    sources, targets = (
        np.stack(clouds) for clouds in zip(*((each.source, each.target) for each in trials), strict=True)
    )
    timed = contenders(names, sources, targets)
    times: dict[str, list[float]] = {name: [] for name in timed}
    for each in tqdm(timed.values(), desc="compiling"):
        jax.block_until_ready(each.run())
    for _ in tqdm(range(repeats), desc="rounds"):
        for name, each in timed.items():
            start = time.perf_counter()
            jax.block_until_ready(each.run())
            times[name].append(time.perf_counter() - start)
    rows = [
        {
            "name": name,
            "method": each.title,
            "milliseconds_a_pair": round(1e3 * statistics.median(times[name]) / BATCH, 2),
            "parameters": each.parameters,
        }
        for name, each in timed.items()
    ]
    return {
        "command": f"python experiments/benchmarks/networks.py --repeats {repeats}",
        "batch": BATCH,
        "points": POINTS,
        "cores": os.cpu_count(),
        "processor": platform.processor() or platform.machine(),
        "device": str(jax.devices()[0].platform),
        "jax": jax.__version__,
        "rows": rows,
    }


def as_markdown(result: dict) -> str:
    lines = ["| method | ms a pair | parameters |", "|---|---:|---:|"]
    for each in result["rows"]:
        count = "" if each["parameters"] is None else f"{each['parameters']:,}"
        lines.append(f"| {each['method']} | {each['milliseconds_a_pair']:,.1f} | {count} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5, help="rounds in which all take turns")
    parser.add_argument("--methods", nargs="+", choices=[*NETWORKS], default=[*NETWORKS], help="only these networks")
    given = parser.parse_args()
    result = measure(given.methods, given.repeats)
    (HERE / "networks.json").write_text(json.dumps(result, indent=2) + "\n")
    (HERE / "networks.md").write_text(as_markdown(result))
    print(as_markdown(result))
