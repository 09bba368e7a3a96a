"""The cards of the packaged models: licence, limits, training command, and what was measured. Only reads files."""

import json
from pathlib import Path

import pytest

from experiments.summary import load

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "experiments" / "README.md").read_text()
CARDS = {path.stem: json.loads(path.read_text()) for path in sorted((ROOT / "urrt_jax" / "weights").glob("*.json"))}


@pytest.mark.parametrize("name", CARDS)
def test_card_has_licence_limits_and_measurements(name):
    assert CARDS[name]["licence"] and CARDS[name]["limits"] and CARDS[name]["measured"]


@pytest.mark.parametrize("name", CARDS)
def test_measurements_of_the_card_are_those_of_the_tables(name):
    suffix = "" if name == "modelnet40" else f":{name}"
    for entry in CARDS[name]["measured"]:
        parts = [part for part in load(entry["table"])["parts"] if part["protocol"] == entry["protocol"]]
        same = [part for part in parts if (part["data"], part["items"]) == (entry["data"], entry["items"])]
        found = [row for part in same for row in part["rows"] if row["method"] == entry["method"] + suffix]
        assert any(row["mae_rotation"] == pytest.approx(entry["mae_rotation"], rel=1e-4) for row in found)


@pytest.mark.parametrize("name", CARDS)
def test_page_of_results_shows_the_training_command_and_its_time(name):
    assert CARDS[name]["command"] in PAGE.replace(" \\\n    ", " ")
    assert f"{name}`: {CARDS[name]['seconds'] / 60:.0f} minutes" in PAGE


@pytest.mark.parametrize("name", CARDS)
def test_card_names_its_model_and_its_best_step(name):
    assert CARDS[name]["command"].startswith(f"urrt train --out {name} ")
    assert CARDS[name]["validation"]["step"] <= CARDS[name]["steps"]


def test_network_in_the_papers_setting_is_model_c_applied_once():
    config = CARDS["modelnet40-paper"]["config"]
    assert (config["variant"], config["steps"]) == ("C", 1)
