"""Where the time of a batch of `register_pairs` goes, stage by stage, and how near its hot loop is to the limit.

    python experiments/benchmarks/stages.py --data PATH

Batches of 32 clean pairs of 1,024 points from the test split, without search. Every stage is a program of its own
(urrt_jax/stages.py), timed on what the stages before it give; the whole also copies and pads on the host. Parts of a
stage, marked –, are compiled for themselves. The hot loop, the placing of landmarks, compares
every query with every key: its rate is set against that of one large product of matrices, and what it would move, were
no logit kept in a cache, against that of a copy, both measured in the same run. Writes stages.json and stages.md beside
this file.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from timing import median_seconds

from urrt_jax import ICP, register_pairs
from urrt_jax.clouds import first, normals
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import PROTOCOLS
from urrt_jax.features.moments import moment_invariants
from urrt_jax.host import PairOnHost
from urrt_jax.model.consensus import align_landmarks, even_seeds
from urrt_jax.model.encoding import encode_cloud
from urrt_jax.model.landmarks import place_landmarks
from urrt_jax.programs import Program
from urrt_jax.registration import make_options
from urrt_jax.stages import (
    approach,
    assess,
    compare,
    estimate,
    expect,
    label,
    prepare,
    recognise,
    rung,
    settle,
    sizes_of,
)

HERE = Path(__file__).parent
BATCH = 32


def milliseconds(function: Callable, *inputs: object, repeats: int = 7, batch: int = BATCH) -> float:
    """The median time of a compiled function, a pair."""
    run = jax.jit(function)
    return 1e3 * median_seconds(lambda: jax.block_until_ready(run(*inputs)), repeats) / batch


def measure(data: str) -> dict:
    shapes = load_shapes(data, split="test", points=1024, limit=BATCH)
    trials = [PROTOCOLS["dcp"](shapes.points, item) for item in range(BATCH)]
    pairs = [PairOnHost(trial.source, trial.target) for trial in trials]
    padded = [pair.padded(rung(pair.size)) for pair in pairs]
    source, target, told = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)
    options = make_options(None, ICP(), None)
    model, refine, sizes = options.model, ICP(), sizes_of(options)
    config, params = model.config, model.params

    @jax.vmap
    def surroundings(pair):
        return tuple(moment_invariants(each, config.octaves) for each in pair)

    @jax.vmap
    def encoding(cloud, invariants):
        return encode_cloud(config, params, cloud, invariants)

    @jax.vmap
    def placing(queries, keys, cloud):
        return place_landmarks(queries, keys, cloud)

    @jax.vmap
    def agreeing(here, there, weights):
        seeds = even_seeds([here.shape[0] - 2 * config.lookups, config.lookups, config.lookups], config.hypotheses)
        return align_landmarks(here, there, weights, rounds=config.consensus, seeds=seeds)

    @jax.vmap
    def normal(pair):
        return [normals(each.queries.points, each.queries, 3 * each.spacing, jnp.zeros(3)) for each in pair]

    ready = [prepare.batched(sizes, cloud) for cloud in (source, target)]
    samples = [each.samples for each in ready]
    small = tuple(jax.vmap(lambda cloud: first(cloud, config.points))(each.even) for each in samples)
    invariants = jax.jit(surroundings)(small)
    encoded = jax.jit(encoding)(small[0], invariants[0])
    count = config.regions * config.landmarks + config.lookups
    queries = config.sharpness * jnp.tile(encoded.keys, (1, 2, 1))[:, :count]
    landmarks = jnp.tile(encoded.lookups.places, (1, 3, 1))[:, : count + config.lookups]
    others = landmarks + 0.01 * jax.random.normal(jax.random.key(0), landmarks.shape)
    figures = [each.constellations for each in samples]
    known = recognise.batched(None, *figures)
    unknown = known._replace(sure=jnp.zeros_like(known.sure))
    start = estimate.batched(model, *samples, unknown, told)
    looked = (refine, False, 0.0), *samples, (ready[0].count, ready[1].count), unknown, start.transform
    found = approach.batched(*looked).found
    settled = settle.batched(refine, *ready, found.transform, found.width)
    last = expect.batched(refine, *ready, settled)
    alternatives = compare.batched(None, *samples, last.transform)

    def took(program: Program, *inputs: Any) -> float:
        return 1e3 * median_seconds(lambda: jax.block_until_ready(program.batched(*inputs)), 7) / BATCH

    def whole() -> None:
        register_pairs([trial.source for trial in trials], [trial.target for trial in trials], search=None, batch=BATCH)

    place = milliseconds(placing, queries, encoded.keys, small[0])
    stages = {
        "prepare both clouds": took(prepare, sizes, source) + took(prepare, sizes, target),
        "– normals of both clouds": milliseconds(normal, tuple(ready)),
        "recognise the same points": took(recognise, None, *figures),
        "the network, where all pairs are recognised": took(estimate, model, *samples, known, told),
        "the network's steps": took(estimate, model, *samples, unknown, told),
        "– surroundings of both clouds": milliseconds(surroundings, small),
        "– of a step: encode the source, its own lookups": milliseconds(encoding, small[0], invariants[0]),
        "– of a step: place the other landmarks, in both clouds": 2 * place,
        "– of a step: consensus": milliseconds(agreeing, landmarks, others, jnp.ones(landmarks.shape[:2])),
        "refine on samples": took(approach, *looked),
        "refine on whole clouds": took(settle, refine, *ready, found.transform, found.width),
        "EM-ICP, for the pairs that need it": took(expect, refine, *ready, settled),
        "compare with other poses": took(compare, None, *samples, last.transform),
        "assess": took(assess, True, *ready, last.transform, last.converged, alternatives, told),
        "regions of both clouds": took(label, None, ready[0], start.source) + took(label, None, ready[1], start.target),
        "register": 1e3 * median_seconds(whole, 7) / BATCH,
    }
    side = 2048
    square = jnp.ones((side, side))
    peak = 2 * side**3 / milliseconds(jnp.matmul, square, square, batch=1) / 1e6
    # From and to memory that is warm: a copy in NumPy.
    many, into = np.ones(2**25, np.float32), np.zeros(2**25, np.float32)
    copies = []
    for _ in range(5):
        start = time.perf_counter()
        np.copyto(into, many)
        copies.append(time.perf_counter() - start)
    copy = 2 * many.nbytes / statistics.median(copies) / 1e9
    width = encoded.keys.shape[-1]
    work = 2 * count * config.points * (width + 4) + count * config.points  # two products, and an exponential each
    moved = 4 * 4 * count * config.points  # logits and shares, each written once and read once
    return {
        "command": f"python experiments/benchmarks/stages.py --data {Path(data).name}",
        "cores": os.cpu_count(),
        "device": jax.devices()[0].platform,
        "jax": jax.__version__,
        "batch": BATCH,
        "milliseconds_a_pair": {name: round(value, 3) for name, value in stages.items()},
        "hot_loop": {
            "operations": work,
            "gflops": round(work / place / 1e6, 1),
            "gflops_of_a_large_product": round(peak, 1),
            "bytes_if_nothing_stayed_in_a_cache": moved,
            "gb_per_second": round(moved / place / 1e6, 1),
            "gb_per_second_of_a_copy": round(copy, 1),
        },
    }


def as_markdown(results: dict) -> str:
    times, hot = results["milliseconds_a_pair"], results["hot_loop"]
    lines = ["| stage | ms a pair | share |", "|---|---:|---:|"]
    lines += [f"| {name} | {value:.2f} | {100 * value / times['register']:.0f} % |" for name, value in times.items()]
    share = 100 * hot["gflops"] / hot["gflops_of_a_large_product"]
    lines += [
        "",
        f"The hot loop, which places landmarks, computes {hot['gflops']:.0f} GFLOP/s. That is {share:.0f} % of the "
        f"{hot['gflops_of_a_large_product']:.0f} GFLOP/s that one large matrix product reaches on this machine. If no "
        f"logit stayed in a cache, the loop would move {hot['gb_per_second']:.0f} GB/s; a copy moves "
        f"{hot['gb_per_second_of_a_copy']:.0f} GB/s.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt evaluate' takes it")
    results = measure(parser.parse_args().data)
    (HERE / "stages.json").write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
    (HERE / "stages.md").write_text(as_markdown(results))
    print(as_markdown(results))
