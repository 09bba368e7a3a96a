"""The table of trials: rows are kept in the order of the trials while base, data and changes stay the same."""

import json

import pytest


@pytest.fixture
def trials(load_script):
    """The script as a module that writes elsewhere."""
    return load_script("trials/run.py")


def row(trials, name, **changes):
    errors = dict.fromkeys(trials.PROTOCOLS, 1.0)
    return {
        "trial": name, "changes": trials._as_json(trials.TRIALS[name]), "errors": errors, "pairs_per_second": 20.0,
        "parameters": 1000,
    } | changes  # fmt: skip


def test_every_trial_is_a_configuration_of_its_own(trials):
    configs = [trials.configured(changes) for changes in trials.TRIALS.values() if "use" not in changes]
    assert len({repr(config) for config in configs}) == len(configs)
    for changes in trials.TRIALS.values():
        if "use" in changes:
            assert trials.configured(changes) == trials.BASE


def test_rows_are_kept_beside_each_other_in_order(trials, tmp_path):
    first, second, third = list(trials.TRIALS)[:3]
    for name in (second, first, third, first):
        rows = trials.keep(row(trials, name), "data")
    assert [each["trial"] for each in rows] == [first, second, third]
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == rows
    assert (tmp_path / "table.md").read_text() == trials.as_markdown(rows)


def test_rows_that_no_longer_compare_go(trials, tmp_path):
    first, second, third = list(trials.TRIALS)[:3]
    trials.keep(row(trials, first), "data")
    trials.keep(row(trials, second, changes={"model": {"octaves": 17}}), "data")
    assert [each["trial"] for each in trials.keep(row(trials, third), "data")] == [first, third]
    assert [each["trial"] for each in trials.keep(row(trials, second), "other data")] == [second]
    results = json.loads((tmp_path / "results.json").read_text())
    results["base"]["steps"] += 1
    (tmp_path / "results.json").write_text(json.dumps(results))
    assert [each["trial"] for each in trials.keep(row(trials, third), "other data")] == [third]
