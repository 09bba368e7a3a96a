"""What is worth changing in the network and its training: one thing at a time, with a short budget each.

    python experiments/trials/run.py --data PATH [--only NAME ...]

Every trial trains one configuration with one change, for 300 steps of 16 pairs of the usual mixture, and is measured on
the protocols of the tables, network alone, with every second shape held out of the training split; no test shape is
looked at. What changes only in use is measured with the weights of the base. A trial takes some minutes of one core.
Runs are kept in runs/ beside this file: an interrupted command continues where it stopped. Writes results.json and
table.md beside this file, with the trials that are there. Once the base is trained, commands with other names may run
beside each other.
"""

import argparse
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from urrt_jax.atomic import write_atomically
from urrt_jax.data import Shapes, load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.evaluation.methods import Ours
from urrt_jax.model import ModelConfig
from urrt_jax.training.loop import LoopConfig, train
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig
from urrt_jax.training.urrt import URRT

HERE = Path(__file__).parent
PROTOCOLS = {
    "dcp": "clean",
    "incomplete": "D.I.",
    "incomplete_both": "D.I., both",
    "drift": "P.D.",
    "outliers": "D.O.",
    "independent_noise": "independent + noise",
}
BASE = TrainConfig(
    pairs=PairConfig(ramp_share=0.2), steps=300, batch=16, warmup=50, learning_rate=1.5e-3, steps_per_call=10
)
TRIALS: dict[str, dict[str, Any]] = {
    "base: surroundings, look-ups, consensus": {},
    "landmarks of regions alone": {"model": {"sharpness": 1.0, "octaves": 0, "lookups": 0, "consensus": 0}},
    "no surroundings": {"model": {"octaves": 0}},
    "surroundings of 3 widths": {"model": {"octaves": 3}},
    "surroundings of 5 widths": {"model": {"octaves": 5}},
    "no look-ups": {"model": {"lookups": 0}},
    "64 look-ups": {"model": {"lookups": 64}},
    "128 look-ups": {"model": {"lookups": 128}},
    "256 look-ups": {"model": {"lookups": 256}},
    "512 look-ups in training": {"lookups": 512},
    "sharpness 1": {"model": {"sharpness": 1.0}},
    "no consensus": {"model": {"consensus": 0}},
    "4 rounds of consensus in use": {"use": {"consensus": 4}},
    "24 rounds of consensus in use": {"use": {"consensus": 24}},
    "no hypotheses in use": {"use": {"hypotheses": 0}},
    "256 hypotheses in use": {"use": {"hypotheses": 256}},
    "no rounds of consensus in training": {"rounds": 0},
    "12 rounds of consensus in training": {"rounds": 12},
    "decoders that regress the pose": {"model": {"decoder": "pose"}},
    "4 landmarks a region": {"model": {"landmarks": 4}},
    "16 landmarks a region": {"model": {"landmarks": 16}},
    "model A: no regions": {"model": {"variant": "A"}},
    "model B: no position encoding": {"model": {"variant": "B"}},
    "n = 4": {"model": {"regions": 4}},
    "n = 12": {"model": {"regions": 12}},
    "n = 16": {"model": {"regions": 16}},
    "n = 24": {"model": {"regions": 24}},
    "no attention": {"model": {"attention_layers": 0}},
    "two attention layers": {"model": {"attention_layers": 2}},
    "d = 64": {"model": {"width": 64}},
    "d = 256": {"model": {"width": 256}},
    "deeper encoder": {"model": {"encoder_widths": (64, 64, 128, 256)}},
    "K = 1": {"model": {"steps": 1}},
    "K = 3, one trained": {"unrolled": 1},
    "K = 3, all trained": {"unrolled": 3},
    "256 points": {"model": {"points": 256}},
    "occupancy weight 0.005": {"occupancy_weight": 0.005},
    "occupancy weight 0.1": {"occupancy_weight": 0.1},
    "Chamfer scale 0.03": {"chamfer_scale": 0.03},
    "Chamfer scale 0.3": {"chamfer_scale": 0.3},
    "learning rate 7.5e-4": {"learning_rate": 7.5e-4},
    "learning rate 3e-3": {"learning_rate": 3e-3},
    "batches of 8, twice the steps": {"batch": 8, "steps": 600},
    "batches of 32, half the steps": {"batch": 32, "steps": 150},
    "first third clean": {"pairs": {"clean_share": 0.33}},
    "half of the clouds cropped": {"pairs": {"cropped": 0.5}},
    "crops of up to a quarter": {"pairs": {"keep": 0.75}},
    "no signed angles": {"pairs": {"signed": 0.0}},
}


_METHOD = {field.name for field in dataclasses.fields(URRT)}


def method(changes: dict[str, Any]) -> URRT:
    """What a trial trains: our network with those of the changes that are its own."""
    own = {name: value for name, value in changes.items() if name in _METHOD - {"model"}}
    return URRT(model=ModelConfig(**changes.get("model", {})), **own)


def configured(changes: dict[str, Any]) -> TrainConfig:
    """How a trial is trained: the base with these changes; "model" and "pairs" change its parts, "use" nothing yet."""
    others = {name: value for name, value in changes.items() if name not in _METHOD | {"pairs", "use"}}
    pairs = dataclasses.replace(BASE.pairs, **changes.get("pairs", {}))
    return dataclasses.replace(BASE, method=method(changes), pairs=pairs, **others)


def run_trial(name: str, shapes: Shapes, validation: Shapes) -> dict[str, Any]:
    """The row of one trial: trained, if its run is not there yet, and measured as all are."""
    config = configured(TRIALS[name])
    digest = hashlib.sha256(repr(config).encode()).hexdigest()[:8]
    folder = HERE / "runs" / digest
    variables = train(config, shapes, validation, folder, loop=LoopConfig(every=config.steps, validation_pairs=16))
    model = method(TRIALS[name]).as_model(variables)
    model = dataclasses.replace(model, config=dataclasses.replace(model.config, **TRIALS[name].get("use", {})))
    log = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    rates = [entry["pairs_per_second"] for entry in log if "pairs_per_second" in entry]
    ours = Ours(model=model, refine=None)
    return {
        "trial": name,
        "changes": _as_json(TRIALS[name]),
        "errors": {
            protocol: evaluate(ours, protocol, validation.points[::2], progress=False).summary()["mae_rotation"]
            for protocol in PROTOCOLS
        },
        "pairs_per_second": float(np.median(rates[1:] or rates)),
        "parameters": int(sum(leaf.size for leaf in jax.tree.leaves(model.params))),
    }


def as_markdown(rows: list[dict[str, Any]]) -> str:
    heads = "".join(f" {title} |" for title in PROTOCOLS.values())
    lines = [f"| MAE(R) |{heads} pairs/s in training | parameters |", "|---|" + "---:|" * (len(PROTOCOLS) + 2)]
    for row in rows:
        errors = "".join(f" {row['errors'][protocol]:.2f}° |" for protocol in PROTOCOLS)
        lines.append(f"| {row['trial']} |{errors} {row['pairs_per_second']:.0f} | {row['parameters']:,} |")
    return "\n".join(lines) + "\n"


def _as_json(value: Any) -> Any:
    return json.loads(json.dumps(value))


def keep(row: dict[str, Any], data: str) -> list[dict[str, Any]]:
    """Writes a trial's row beside those that are there, of the same base, and returns them all in order."""
    written, base = HERE / "results.json", _as_json(BASE.as_dict())
    before = json.loads(written.read_text()) if written.exists() else {}
    # Of another base or other data they would not compare. Read only now: commands may run side by side.
    command = f"python experiments/trials/run.py --data {data}"
    rows = before["rows"] if (before.get("base"), before.get("command")) == (base, command) else []
    rows = {each["trial"]: each for each in rows if each["changes"] == _as_json(TRIALS.get(each["trial"]))}
    rows[row["trial"]] = row
    ordered = [rows[name] for name in TRIALS if name in rows]
    results = {"command": command, "jax": jax.__version__, "base": base, "rows": ordered}
    write_atomically(written, json.dumps(results, indent=1) + "\n")
    write_atomically(HERE / "table.md", as_markdown(ordered))
    return ordered


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="ModelNet40 as 'urrt train' takes it")
    parser.add_argument("--only", nargs="+", default=list(TRIALS), help="names of trials", metavar="NAME")
    flags = parser.parse_args()
    if unknown := sorted(set(flags.only) - set(TRIALS)):
        parser.error(f"no trials {unknown}; there are {list(TRIALS)}")
    shapes, validation = load_shapes(flags.data, points=BASE.pairs.points).split_validation(0.05, BASE.seed)
    for name in flags.only:
        row = run_trial(name, shapes, validation)
        jax.clear_caches()  # dozens of trials' programs would be too many for the compiler's memory
        print(as_markdown(keep(row, Path(flags.data).name)))
