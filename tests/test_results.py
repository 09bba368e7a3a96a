"""The results that the README shows belong to the packaged weights, and the README shows what the files say."""

import json
from pathlib import Path

import pytest

from urrt_jax import model_card

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
FILES = ("clean_dcp/results.json", "bunny_scans/results.json", "benchmarks/speed.json")
README = (ROOT / "README.md").read_text()


@pytest.mark.parametrize("name", FILES)
def test_results_come_from_the_packaged_weights(name):
    assert json.loads((EXPERIMENTS / name).read_text())["model_sha256"] == model_card()["sha256"]


@pytest.mark.parametrize("name", ["bunny_scans/table.md", "benchmarks/speed.md"])
def test_readme_shows_the_tables_that_were_written(name):
    assert (EXPERIMENTS / name).read_text().strip() in README


def test_readme_shows_the_measured_errors_of_the_clean_protocol():
    results = json.loads((EXPERIMENTS / "clean_dcp/results.json").read_text())
    for group in ("network", "refined"):
        figures = results[group]
        row = f"{figures['mse_rotation']:.2f} | {figures['mae_rotation']:.3f}° | {figures['mse_translation']:.6f}"
        assert row in README, group


def test_readme_shows_the_training_command():
    assert model_card()["command"] in README.replace(" \\\n    ", " ")


def test_clean_protocol_results_keep_their_promise():
    """The promise of the first version: network alone at most 3.0°, refined within 1° on 95 %, over the whole set."""
    results = json.loads((EXPERIMENTS / "clean_dcp/results.json").read_text())
    assert results["items"] == 2468
    assert results["network"]["mae_rotation"] <= 3.0
    assert results["refined"]["recall_1deg"] >= 0.95
