"""The committed results and the tables drawn from them agree with each other.

The tests of this folder only read files: `pytest tests/results` takes seconds. All but `test_settings.py` need neither
JAX nor `urrt_jax`; `pytest -n 0 --noconftest --ignore tests/results/test_settings.py tests/results` runs them without.
"""

import json
import tomllib
from pathlib import Path

import pytest

from experiments import summary
from experiments.reproduce.tables import as_markdown
from experiments.summary import load

ROOT = Path(__file__).parents[2]
EXPERIMENTS, WEIGHTS = ROOT / "experiments", ROOT / "urrt_jax" / "weights"
TABLES = ("table1_ablation", "table2_noise", "table3_comparison", "beyond", "unseen", "default_call")
OTHERS = ("figure4_qualitative", "confidence", "regions")
FILES = (*(f"{name}/results.json" for name in (*TABLES, *OTHERS)), "benchmarks/speed.json")
MODELNET40_TEST = 2468  # shapes in the test split


def configuration(name: str) -> dict:
    return tomllib.loads((EXPERIMENTS / name / "config.toml").read_text())


@pytest.mark.parametrize("name", FILES)
def test_results_were_measured_with_the_packaged_weights(name):
    card = json.loads((WEIGHTS / "modelnet40.json").read_text())
    assert json.loads((EXPERIMENTS / name).read_text())["model_sha256"] == card["sha256"]


@pytest.mark.parametrize("name", TABLES)
def test_results_have_the_parts_and_rows_of_the_configuration(name):
    experiment, results = configuration(name), load(name)
    assert [part["protocol"] for part in experiment["parts"]] == [part["protocol"] for part in results["parts"]]
    for part, measured in zip(experiment["parts"], results["parts"], strict=True):
        assert [row["method"] for row in measured["rows"]] == part.get("methods", experiment["methods"])
        assert measured["published"].keys() == part.get("published", {}).keys()


@pytest.mark.parametrize("name", ["table1_ablation", "table2_noise", "table3_comparison"])
def test_the_papers_tables_are_over_all_items_of_their_parts(name):
    for part, configured in zip(load(name)["parts"], configuration(name)["parts"], strict=True):
        every = -(-MODELNET40_TEST // configured.get("stride", 1))
        assert part["items"] == min(every, configured.get("first", every))
        assert all(row["items"] == part["items"] for row in part["rows"])


@pytest.mark.parametrize("name", TABLES)
def test_tables_are_drawn_from_their_results(name):
    assert (EXPERIMENTS / name / "table.md").read_text() == as_markdown(load(name))


@pytest.mark.parametrize("name", summary.TABLES)
def test_summaries_are_drawn_from_the_results(name):
    assert (EXPERIMENTS / f"summary_{name}.md").read_text() == "\n".join(summary.TABLES[name]()) + "\n"
