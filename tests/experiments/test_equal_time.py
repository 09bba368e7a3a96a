"""The ablation at equal time: its ratios and intervals, and that rows are kept while they compare."""

import numpy as np
import pytest


@pytest.fixture
def ablation(load_script, monkeypatch):
    """The script as a module that writes elsewhere."""
    module = load_script("ablation/equal_time.py")
    monkeypatch.setattr(module, "RESAMPLED", 400)
    return module


def _row(ablation, name, seed=0, scale=1.0, pairs=60):
    random = np.random.default_rng(seed)
    angles = {each: (scale * random.exponential(size=pairs)).tolist() for each in ablation.PROTOCOLS}
    return {"model": name, "seed": seed, "steps": 100, "seconds": 360, "angles": angles}


def test_models_differ_and_each_has_its_base(ablation):
    configs = [ablation.configured(name, 100, 0) for name in ablation.MODELS]
    assert len(set(map(repr, configs))) == len(ablation.MODELS) == 8
    for name, base in ablation.BASES.items():
        assert ablation.MODELS[base].variant == "A"
        assert ablation.MODELS[base].decoder == ablation.MODELS[name].decoder
    landmarks = [
        each.landmarks * (each.regions if each.has_regions else 1)
        for each in ablation.MODELS.values()
        if each.decoder == "landmarks"
    ]
    assert set(landmarks) == {64}


def test_ratio_of_a_model_to_itself_is_one(ablation):
    rows = [_row(ablation, "A, pose", seed) for seed in range(3)]
    mean, low, high = ablation.ratio(rows, rows, ablation.PARTIAL)
    assert mean == 1
    assert low < 1 < high


def test_interval_holds_the_true_ratio_and_narrows_with_pairs(ablation):
    widths = []
    for pairs in (20, 2_000):
        base = [_row(ablation, "A, pose", seed, 1.0, pairs) for seed in range(3)]
        rows = [_row(ablation, "C, parts, pose", seed + 3, 0.7, pairs) for seed in range(3)]
        mean, low, high = ablation.ratio(rows, base, ablation.PARTIAL)
        assert low < 0.7 < high and low < mean < high
        widths.append(high - low)
    assert widths[1] < widths[0] / 3


def test_rows_are_kept_beside_each_other_while_data_and_time_are_the_same(ablation, tmp_path, monkeypatch):
    measured = []
    monkeypatch.setattr(ablation, "speed", lambda name, _: measured.append(name) or 1.5)
    path, settings = tmp_path / "rows.json", {"data": "data", "minutes": 6.0}
    speeds = ablation.begin(path, settings, None)["speeds"]
    assert speeds == dict.fromkeys(ablation.MODELS, 1.5)
    for name, seed in (("C, parts, pose", 1), ("A, pose", 0), ("C, parts, pose", 0), ("A, pose", 0)):
        ablation.keep(path, _row(ablation, name, seed))
    results = ablation.begin(path, settings, None)
    assert [(row["model"], row["seed"]) for row in results["rows"]] == [
        ("A, pose", 0), ("C, parts, pose", 0), ("C, parts, pose", 1)
    ]  # fmt: skip
    assert "C, parts, pose, 2 seeds" in path.with_suffix(".md").read_text()
    assert measured == list(ablation.MODELS)  # once: the same models train for as many steps on another machine
    with pytest.raises(ValueError, match=r"rows.json: holds results of .*6.0.*, not of .*7.0"):
        ablation.begin(path, settings | {"minutes": 7.0}, None)


def test_table_of_a_model_whose_base_is_missing_has_no_ratio(ablation):
    (line,) = ablation.as_markdown([_row(ablation, "B, parts, pose")]).splitlines()[2:]
    assert "| – |" in line
