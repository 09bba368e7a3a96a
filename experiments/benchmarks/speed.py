"""Speed on the CPU, in one run: the network alone, `register` batched, single and large, peers, and the command line.

    python experiments/benchmarks/speed.py [--data PATH] [--pairs 256]

Pairs follow the clean DCP protocol, 1,024 points, on the test split of PATH (procedural shapes by default). Each figure
is taken after a warm-up that compiles: for ours in batches, and for peers on the same pairs, the median of rounds in
which each takes its turn; for the large pairs one run in a process of its own, with its peak of memory. Where PATH
holds the scans, register with search and the peers for scans are timed on the same 12 pairs (the last column is their
share within 1°). The command line is timed as whole processes on two files of 40,000 points: the first run compiles.
Peers are optional: `pip install 'urrt-jax[peers]'`; Debian: libusb-1.0-0 libgl1 libegl1 libgomp1.
"""

import argparse
import functools
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from timing import median_seconds
from tqdm import tqdm

from urrt_jax import Search, load_model, model_card, register, register_pairs
from urrt_jax.clouds import make_cloud
from urrt_jax.data import demo_shape, find_data, load_shapes
from urrt_jax.evaluation import PROTOCOLS, load_scan_pairs, pose_errors, rotation_degrees, summarize
from urrt_jax.io import write_cloud
from urrt_jax.model.network import predict
from urrt_jax.peers import PEERS

HERE = Path(__file__).parent
BATCH = 32  # twice as many leave the caches of a CPU, and take an eighth longer each
LARGE = (40_000, 200_000, 1_000_000)
PEERS_TIMED = ("icp", "gicp", "fgr", "fgr_icp", "icp_starts")
SCANS = "bunny_scans.npz"
SCAN_PEERS_TIMED = ("scan_ransac", "scan_kiss")
SCAN_PAIRS = 12


def command_line_seconds() -> dict[str, float]:
    """Whole-process times of the first `urrt register`, which compiles, of the second, and of `--help`."""
    with tempfile.TemporaryDirectory() as folder:
        cloud = demo_shape(80_000)
        files = [str(Path(folder) / name) for name in ("source.ply", "target.ply")]
        for file, points in zip(files, (cloud[::2], cloud[1::2]), strict=True):
            write_cloud(file, points)
        environment = {k: v for k, v in os.environ.items() if k != "URRT_NO_CACHE"} | {"XDG_CACHE_HOME": folder}

        def whole_process(*arguments: str) -> float:
            start = time.perf_counter()
            command = [sys.executable, "-m", "urrt_jax.cli", *arguments]
            subprocess.run(command, env=environment, check=True, capture_output=True)
            return round(time.perf_counter() - start, 2)

        pair = ("register", *files, "--json")
        return {
            "first": whole_process(*pair),
            "second": whole_process(*pair),
            "help": whole_process("register", "--help"),
        }


def measure_large(size: int) -> dict:
    """The time of one large pair, and the process's peak of memory, compilation included."""
    cloud = demo_shape(2 * size)
    turn = Rotation.from_euler("zyx", [10, 20, 30], degrees=True).as_matrix()
    pair = jnp.asarray(cloud[::2]), jnp.asarray((cloud[1::2] @ turn.T + 0.1).astype(np.float32))
    took = median_seconds(lambda: jax.block_until_ready(register(pair[0], pair[1])), 1)
    # Not ru_maxrss: a child inherits that from the process that started it.
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return {"seconds": took, "peak_gib": int(peak.split()[1]) / 2**20}


def measure_scans(path: Path) -> list[dict]:
    """`register` with search, and peers, on the same pairs of scans of some 40,000 points, one pair a call."""
    data, _ = load_scan_pairs(path)
    trials = data[:SCAN_PAIRS]
    single, errors = [], []
    for trial in tqdm([trials[0], *trials], desc="scans"):
        start = time.perf_counter()
        found = jax.block_until_ready(register(trial.source, trial.target, search=Search()))
        single.append(time.perf_counter() - start)
        errors.append(float(rotation_degrees(found.rotation, trial.rotation)))
    share = float(np.mean(np.array(errors[1:]) < 1))
    rows = [row("scans of 40,000 points: register with search", statistics.median(single[1:]), share)]
    for name in SCAN_PEERS_TIMED:
        peer = PEERS[name]
        try:
            peer.versions()
        except ImportError as error:
            rows.append({"method": f"{peer.title}: not measured, {error}"})
            continue
        single, errors = [], []
        for trial in tqdm(trials, desc=peer.title):
            start = time.perf_counter()
            try:
                matrix = peer.align_pair(trial.source.astype(np.float64), trial.target.astype(np.float64))
            except RuntimeError:  # too few matches: a pair that is not found
                matrix = np.eye(4)
            single.append(time.perf_counter() - start)
            errors.append(float(rotation_degrees(matrix[:3, :3], trial.rotation)))
        rows.append(row(f"scans: {peer.title}", statistics.median(single), float(np.mean(np.array(errors) < 1))))
    return rows


def side_by_side(batched: dict[str, Callable], batches: list, trials: list, repeats: int) -> list[dict]:
    """Ours in batches and the peers pair by pair, on the same pairs; in every round each once, many starts only first.

    A machine is not always equally fast: what takes turns is slowed alike.
    """
    truth = np.stack([trial.rotation for trial in trials]), np.stack([trial.translation for trial in trials])
    rows, peers = [], {}
    for name in PEERS_TIMED:
        try:
            versions = PEERS[name].versions()
        except ImportError as error:
            rows.append({"method": f"{PEERS[name].title}: not measured, {error}"})
            continue
        peers[f"{PEERS[name].title} {' '.join(versions.values())}, one pair a call"] = PEERS[name]
    ours = {f"{name}, batches of {BATCH}": function for name, function in batched.items()}
    for function in ours.values():
        jax.block_until_ready(function(*batches[0]))
    times: dict[str, list[float]] = {name: [] for name in (*ours, *peers)}
    poses: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for _ in tqdm(range(repeats), desc="rounds"):
        for name, function in ours.items():
            start = time.perf_counter()
            found = jax.block_until_ready([function(*batch) for batch in batches])
            times[name].append(time.perf_counter() - start)
            rotations, translations = zip(*((one.rotation, one.translation) for one in found), strict=True)
            poses[name] = np.concatenate(rotations), np.concatenate(translations)
        for name, peer in peers.items():
            if times[name] and peer is PEERS["icp_starts"]:
                continue  # many times slower than all others together: once is enough
            start = time.perf_counter()
            found = np.stack(
                [peer.align_pair(each.source.astype(np.float64), each.target.astype(np.float64)) for each in trials]
            )
            times[name].append(time.perf_counter() - start)
            poses[name] = found[:, :3, :3], found[:, :3, 3]
    measured = [
        row(name, statistics.median(took) / len(trials), summarize(pose_errors(*poses[name], *truth))["recall_1deg"])
        for name, took in times.items()
    ]
    return measured + rows


def measure(data: str, pairs: int, repeats: int) -> dict:
    shapes = load_shapes(data, split="test", points=1024, limit=pairs)
    trials = [PROTOCOLS["dcp"](shapes.points, item) for item in range(len(shapes))]
    sources, targets = (np.stack(values) for values in list(zip(*trials, strict=True))[:2])
    model = load_model()

    network = jax.jit(jax.vmap(lambda a, b: predict(model, make_cloud(a), make_cloud(b))))
    refined = functools.partial(register_pairs, model=model, batch=BATCH)
    batches = [
        (sources[start : start + BATCH], targets[start : start + BATCH])
        for start in range(0, len(sources) - BATCH + 1, BATCH)
    ]
    count = BATCH * len(batches)

    rows = side_by_side({"network alone": network, "register": refined}, batches, trials[:count], repeats)

    single, pair = [], (jnp.asarray(sources[0]), jnp.asarray(targets[0]))
    jax.block_until_ready(register(pair[0], pair[1]))
    for item in tqdm(range(min(count, 64)), desc="one pair a call"):
        pair = jnp.asarray(sources[item]), jnp.asarray(targets[item])
        start = time.perf_counter()
        jax.block_until_ready(register(pair[0], pair[1]))
        single.append(time.perf_counter() - start)
    rows.append(row("register, one pair a call", statistics.median(single), None))

    for size in LARGE:
        # A process of its own, so that its peak of memory is this pair's.
        done = subprocess.run([sys.executable, __file__, "--large", str(size)], check=True, capture_output=True)
        large = json.loads(done.stdout)
        rows.append(row(f"register, one pair of {size:,} points: {large['peak_gib']:.2f} GiB", large["seconds"], None))

    if (Path(data) / SCANS).is_file():
        rows += measure_scans(Path(data) / SCANS)
    return {
        "command": "python experiments/benchmarks/speed.py "
        f"--data {Path(data).name} --pairs {pairs} --repeats {repeats}",
        "data": Path(data).name,
        "pairs": count,
        "points": 1024,
        "cores": os.cpu_count(),
        "processor": platform.processor() or platform.machine(),
        "device": str(jax.devices()[0].platform),
        "jax": jax.__version__,
        "model_sha256": model_card()["sha256"],
        "command_line_seconds": command_line_seconds(),
        "rows": rows,
    }


def row(method: str, seconds_a_pair: float, recall: float | None) -> dict:
    return {
        "method": method,
        "milliseconds_a_pair": round(1e3 * seconds_a_pair, 3),
        "pairs_per_second": round(1 / seconds_a_pair, 1),
        "recall_1deg": None if recall is None else round(recall, 4),
    }


def as_markdown(result: dict) -> str:
    lines = ["| method | pairs/s | ms a pair | recall at 1° |", "|---|---|---|---|"]
    for each in result["rows"]:
        if "pairs_per_second" not in each:
            lines.append(f"| {each['method']} | | | |")
            continue
        recall = "" if each["recall_1deg"] is None else f"{each['recall_1deg']:.3f}"
        lines.append(f"| {each['method']} | {each['pairs_per_second']} | {each['milliseconds_a_pair']} | {recall} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", help="ModelNet40 as 'urrt evaluate' takes it; by default $URRT_DATA, else procedural")
    parser.add_argument("--pairs", type=int, default=256, help="how many pairs, a multiple of 32")
    parser.add_argument("--repeats", type=int, default=5, help="rounds in which ours and peers take turns")
    parser.add_argument("--large", type=int, help="measure only one pair of so many points and print it as JSON")
    given = parser.parse_args()
    if given.large:
        print(json.dumps(measure_large(given.large)))
        sys.exit()
    if given.pairs < BATCH:
        parser.error(f"--pairs: expected at least {BATCH}, got {given.pairs}")
    result = measure(find_data(given.data), given.pairs, given.repeats)
    (HERE / "speed.json").write_text(json.dumps(result, indent=2) + "\n")
    (HERE / "speed.md").write_text(as_markdown(result))
    print(as_markdown(result))
