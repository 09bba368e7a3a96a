"""The committed results, trials and cards were made with the settings that the code has today.

Reads files and compares them with the code's configurations: imports JAX, compiles nothing.
"""

import dataclasses
import json
import runpy
import shlex
from pathlib import Path

import pytest
import tyro

from experiments.learned.train import RATES, flags
from experiments.summary import HERE, load
from urrt_jax import available_models, load_model, model_card
from urrt_jax.cli.train import Train
from urrt_jax.evaluation import find_method
from urrt_jax.neighbors import LARGE

# The rows were measured before some options were renamed, removed or added; `quick` is a constant of the code today.
_RENAMED = {"soft_points": "em_points"}
_REMOVED = {"mutual": False, "trim": False, "rotations": 0, "quick": 512}
_ADDED = {"partition": "places"}  # what networks had before there was a choice


def _in_todays_words(identity):
    parts = {}
    for part in ("refine", "search"):
        options = identity[part]
        if isinstance(options, dict):
            assert all(options[name] == off for name, off in _REMOVED.items() if name in options)
            options = {_RENAMED.get(name, name): each for name, each in options.items() if name not in _REMOVED}
        parts[part] = options
    return identity | parts | {"config": _ADDED | identity["config"]}


@pytest.mark.parametrize(
    "name", ["table1_ablation", "table2_noise", "table3_comparison", "beyond", "unseen", "default_call"]
)
def test_our_rows_were_measured_with_todays_settings(name):
    ours = [row for part in load(name)["parts"] for row in part["rows"] if row["title"].startswith("ours")]
    assert ours
    for row in ours:
        assert _in_todays_words(row["identity"]) == json.loads(json.dumps(find_method(row["method"]).identity()))


@pytest.mark.parametrize("name", available_models())
def test_card_has_every_field_of_its_network(name):
    """A field that a card lacks would follow the defaults of later versions."""
    assert model_card(name)["config"] == json.loads(load_model(name).config.to_json())


@pytest.mark.parametrize("name", available_models())
def test_training_command_of_the_card_gives_its_configuration(name):
    """With today's defaults, which may have been others when the weights were trained."""
    card, model = model_card(name), load_model(name)
    config = tyro.cli(Train, args=shlex.split(card["command"])[2:]).config()
    assert json.loads(json.dumps(config.as_dict())) == card["training"]
    # These four may be chosen again after training.
    chosen = {field: getattr(model.config, field) for field in ("steps", "lookups", "consensus", "hypotheses")}
    assert dataclasses.replace(config.method.model, **chosen) == model.config


def test_trials_are_those_of_the_script():
    script = runpy.run_path(str(HERE / "trials" / "run.py"))
    results = load("trials")
    assert results["base"] == script["_as_json"](script["BASE"].as_dict())
    for row in results["rows"]:
        assert row["changes"] == script["_as_json"](script["TRIALS"][row["trial"]])
    assert (HERE / "trials" / "table.md").read_text() == script["as_markdown"](results["rows"])


def test_neighbour_search_in_use_is_the_fastest_of_those_in_jax():
    for row in json.loads((HERE / "benchmarks/neighbors.json").read_text())["rows"]:
        times = {method: time for method, time in row["milliseconds"].items() if method != "SciPy"}
        assert min(times, key=times.__getitem__) == ("point by point" if row["points"] <= LARGE else "blocks")


@pytest.mark.parametrize("name", RATES)
def test_learned_peers_were_trained_by_the_command_of_their_page(name):
    card = json.loads((HERE / "learned" / "weights" / f"{name}.json").read_text())
    assert json.loads(json.dumps(flags(name, "modelnet40", Path(), 8).config().as_dict())) == card["training"]
    assert (HERE / "learned" / "weights" / f"{name}.npz").stat().st_size <= 12e6
