"""Speed on one GPU or TPU: the network and `register` in batches, one large pair, neighbours, and a profile.

    python experiments/benchmarks/accelerator.py [--data PATH] [--pairs 4096] [--large 1000000] [--profile DIR]

Pairs follow the clean DCP protocol, 1,024 points, on the test split of PATH (procedural shapes by default). Clouds lie
in the device's memory before the clock starts, and each figure is the median of a few calls after one that compiles.
Pairs beyond the number of shapes use shapes again. Writes accelerator.json and accelerator.md beside this file; on a
CPU, where the command can be tried with fewer pairs, it only prints.
"""

import argparse
import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from timing import median_seconds
from tqdm import tqdm

from urrt_jax import load_model, model_card, register
from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.data import demo_shape, find_data, load_shapes
from urrt_jax.evaluation import find_protocol, pose_errors, summarize
from urrt_jax.model.network import predict
from urrt_jax.neighbors import nearest

HERE = Path(__file__).parent
REPEATS = 5
BATCHES = (64, 256, 1024, 4096)


def timed(
    name: str, function: Callable, arguments: tuple, count: int, profile: str | None = None
) -> tuple[dict[str, Any], Any]:
    """The row of a function of ``count`` pairs, and its answer, of which ``profile`` keeps a profile."""
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds = median_seconds(lambda: jax.block_until_ready(compiled(*arguments)), REPEATS)
    row = {
        "what": name,
        "pairs_per_second": round(count / seconds, 2),
        "milliseconds_a_pair": round(1e3 * seconds / count, 4),
    }
    with contextlib.nullcontext() if profile is None else jax.profiler.trace(profile):
        answer = jax.block_until_ready(compiled(*arguments))
    return row, answer


def batched(pairs: int, shapes: np.ndarray, profile: str | None) -> list[dict[str, Any]]:
    """The network alone and ``register``, in batches of all sizes; ``profile``: where to keep one of the last batch."""
    model, draw = load_model(), find_protocol("dcp")
    trials = [draw(shapes, item % len(shapes)) for item in tqdm(range(pairs), desc="pairs")]
    source, target, rotation, translation = (
        np.stack([getattr(trial, name) for trial in trials]).astype(np.float32) for name in trials[0]._fields[:4]
    )

    def network(one: jax.Array, other: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = predict(model, make_cloud(one), make_cloud(other))
        return found.rotation, found.translation

    def refined(one: jax.Array, other: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = register(one, other, model=model)
        return found.rotation, found.translation

    rows = []
    for name, function in {"network alone": network, "register": refined}.items():
        for batch in sorted({*(each for each in BATCHES if each < pairs), pairs}):
            clouds = jax.device_put((source[:batch], target[:batch]))
            kept = profile if batch == pairs and function is refined else None
            row, (turns, moves) = timed(f"{name}, a batch of {batch:,}", jax.vmap(function), clouds, batch, kept)
            errors = pose_errors(np.asarray(turns), np.asarray(moves), rotation[:batch], translation[:batch])
            rows.append(row | {"recall_1deg": round(summarize(errors)["recall_1deg"], 4)})
    return rows


def large(points: int) -> list[dict[str, Any]]:
    """``register`` of one pair of so many points, and its nearest neighbours found by comparing all."""
    cloud = demo_shape(2 * points)
    pair = jax.device_put((cloud[::2], cloud[1::2] + np.float32(0.1)))

    def pose(one: jax.Array, other: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = register(one, other)
        return found.rotation, found.translation

    def neighbors(one: jax.Array, other: jax.Array, block: int) -> jax.Array:
        return nearest(one, Cloud(other, jnp.ones(other.shape[0], bool)), block=block).index

    return [
        timed(f"register, one pair of {points:,} points", pose, pair, 1)[0],
        *(
            timed(
                f"nearest neighbours of {points:,} points, {block} at a time",
                lambda one, other, block=block: neighbors(one, other, block),
                pair,
                1,
            )[0]
            for block in (16, 64)
        ),
    ]


def as_markdown(result: dict[str, Any]) -> str:
    lines = ["| what | pairs/s | ms a pair | recall at 1° |", "|---|---:|---:|---:|"]
    for row in result["rows"]:
        recall = f"{row['recall_1deg']:.3f}" if "recall_1deg" in row else ""
        numbers = f"{row['pairs_per_second']:,} | {row['milliseconds_a_pair']:,}"
        lines.append(f"| {row['what']} | {numbers} | {recall} |")
    return "\n".join(lines) + f"\n\n{result['device']}, jax {result['jax']}.\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", help="ModelNet40 as 'urrt evaluate' takes it; by default $URRT_DATA, else procedural")
    parser.add_argument("--pairs", type=int, default=4096, help="pairs of the largest batch")
    parser.add_argument("--large", type=int, default=1_000_000, help="points of each large cloud")
    parser.add_argument("--profile", metavar="DIR", help="keep a profile of the largest batch there, for TensorBoard")
    flags = parser.parse_args()
    shapes = load_shapes(find_data(flags.data), split="test", points=1024, limit=flags.pairs)
    rows = batched(flags.pairs, shapes.points, flags.profile)
    device = jax.devices()[0]
    result = {
        "command": f"python experiments/benchmarks/accelerator.py --data {Path(find_data(flags.data)).name} "
        f"--pairs {flags.pairs} --large {flags.large}",
        "device": device.device_kind,
        "jax": jax.__version__,
        "model_sha256": model_card()["sha256"],
        "rows": rows + large(flags.large),
    }
    if device.platform != "cpu":
        (HERE / "accelerator.json").write_text(json.dumps(result, indent=1) + "\n")
        (HERE / "accelerator.md").write_text(as_markdown(result))
    print(as_markdown(result))
