"""The benchmark of first use: which pairs it takes, how runs become one number, and what its files keep."""

import json

import pytest


@pytest.fixture
def first_use(load_script):
    """The script as a module."""
    return load_script("benchmarks/first_use.py")


def result(title, seconds, **changes):
    return {
        "title": title, "headline": "whole", "asked": {"empty": 8, "filled": 2}, "repeats": 3,
        "empty": {"whole": seconds}, "filled": {"whole": seconds / 4},
        "measured_on": {"processor": "a processor", "cores": 2, "versions": {"jax": "0.10.1"}},
    } | changes  # fmt: skip


def test_chosen_pairs_are_spread_from_the_first_to_the_last(first_use):
    assert first_use.evenly_spread(9, 3) == [0, 4, 8]
    assert first_use.evenly_spread(3, 20) == [0, 1, 2]


def test_median_of_runs_is_taken_number_by_number(first_use):
    runs = [{"whole": whole, "pairs": pairs} for whole, pairs in ((1.0, [5, 1]), (9.0, [4, 7]), (2.0, [3, 2]))]
    assert first_use.medians(runs) == {"whole": 2.0, "pairs": [4, 2]}


def test_saved_cases_keep_the_order_of_the_table(first_use, tmp_path):
    first_use.save(tmp_path, {"help": result("second", 1.0)}, "command")
    first_use.save(tmp_path, first_use.load(tmp_path) | {"pair": result("first", 8.0)}, "command")
    assert list(json.loads((tmp_path / "first_use.json").read_text())["cases"]) == ["pair", "help"]
    assert first_use.load(tmp_path)["help"] == result("second", 1.0)


def test_table_shows_what_was_asked_and_why_open3d_is_missing(first_use):
    pairs = {"whole": 8.0, "import": 1.0, "pairs": [4.0, 3.0], "found": 1}
    case = result("two pairs", 8.0, empty=pairs, pairs=["a", "b"], open3d_not_measured="it is not installed")
    table = first_use.as_markdown({"pair": case})
    assert "| two pairs | 8.00 | ≤ 8 | 2.00 | ≤ 2 |  |" in table
    assert "| – pair of b | 3.00 |  |  |  |  |" in table
    assert "| – pairs within 5° of the truth | 1 of 2 |" in table
    assert "it is not installed" in table
