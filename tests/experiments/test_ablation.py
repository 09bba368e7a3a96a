"""The ablation: every model is a training of its own, rows of seeds join, and ratios have honest intervals."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

RUN = Path(__file__).parents[2] / "experiments" / "ablation" / "run.py"


@pytest.fixture
def ablation(tmp_path, monkeypatch):
    """The script as a module that writes elsewhere."""
    spec = importlib.util.spec_from_file_location("ablation", RUN)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "HERE", tmp_path)
    return module


def row(ablation, name, seed, error=1.0, **changes):
    return {
        "model": name, "decoder": ablation.MODELS[name].decoder, "steps": ablation.MODELS[name].steps,
        "training": {"of": name}, "seeds": [seed], "seconds": [10.0 + seed],
        "angles": {protocol: [[error + seed, 2.0]] for protocol in ablation.PROTOCOLS},
    } | changes  # fmt: skip


def test_every_model_and_seed_is_a_training_of_its_own(ablation):
    configs = {repr(ablation.configured(name, seed)) for name in ablation.MODELS for seed in ablation.SEEDS}
    assert len(configs) == len(ablation.MODELS) * len(ablation.SEEDS)


def test_models_of_a_kind_have_as_many_landmarks(ablation):
    for name, (decoder, _, _) in ablation.MODELS.items():
        model = ablation.configured(name, 0).method.model
        assert model.decoder == decoder
        if decoder == "landmarks":
            assert model.landmarks * (model.regions if model.has_regions else 1) == 64


def test_seeds_of_a_model_join_in_order(ablation, tmp_path):
    for seed in (2, 0, 1, 0):
        (kept,) = ablation.keep(row(ablation, "C", seed), seed, "data")
    assert kept["seeds"] == [0, 1, 2]
    assert kept["seconds"] == [10.0, 11.0, 12.0]
    assert [each[0] for each in kept["angles"]["dcp"]] == [1.0, 2.0, 3.0]
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == [kept]


def test_rows_of_another_training_or_other_data_go(ablation):
    ablation.keep(row(ablation, "C", 0), 0, "data")
    (kept,) = ablation.keep(row(ablation, "C", 1, training={"of": "another"}), 1, "data")
    assert kept["seeds"] == [1]
    assert [each["model"] for each in ablation.keep(row(ablation, "A", 0), 0, "other data")] == ["A"]


def test_models_stand_in_the_order_of_the_script(ablation):
    for name in ("C", "A, pose", "A"):
        rows = ablation.keep(row(ablation, name, 0), 0, "data")
    assert [each["model"] for each in rows] == ["A", "C", "A, pose"]


def test_ratio_of_equal_errors_is_one(ablation):
    errors = np.random.default_rng(0).random((3, 50)).tolist()
    middle, low, high = ablation.ratio(errors, errors)
    assert middle == 1
    assert low <= 1 <= high


def test_interval_holds_the_ratio_and_narrows_with_items(ablation):
    draw = np.random.default_rng(0)
    widths = []
    for items in (20, 2000):
        first, second = draw.exponential(1.0, (3, items)), draw.exponential(2.0, (3, items))
        middle, low, high = ablation.ratio(first.tolist(), second.tolist())
        assert low < middle < high
        widths.append(high - low)
    assert widths[1] < widths[0] / 3
    assert 0.4 < middle < 0.6


def test_table_compares_with_model_a_of_the_same_decoders(ablation):
    rows = [row(ablation, name, 0, error) for name, error in (("A", 2.0), ("C", 6.0), ("A, pose", 8.0))]
    lines = ablation.as_markdown(rows).splitlines()
    assert next(line for line in lines if line.startswith("| C | 400 |")).count("4.00°") == len(ablation.PROTOCOLS)
    (compared,) = (line for line in lines if line.startswith("| C | 2.00 ("))
    assert compared.count("2.00 (") == len(ablation.PROTOCOLS)
