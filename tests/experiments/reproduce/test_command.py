"""The command `python -m experiments.reproduce`: its flags, what it writes, and how it reports mistakes."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.reproduce.__main__ import main
from urrt_jax.weights import save_model

ROOT = Path(__file__).parents[3]


@pytest.fixture
def flags(small_model, tmp_path, monkeypatch) -> list[str]:
    """Arguments that measure two methods on two shapes, with an untrained model, and write to the folder `out`."""
    monkeypatch.delenv("URRT_DEBUG", raising=False)
    monkeypatch.delenv("URRT_DATA", raising=False)
    save_model(small_model, tmp_path / "model.npz")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "config.toml").write_text(
        'title = "Mine"\nmethods = ["identity", "register"]\ncolumns = ["mae_rotation"]\n'
        '[[parts]]\ntitle = "clean"\nprotocol = "dcp"\npoints = 100\n'
    )
    model, out = str(tmp_path / "model.npz"), str(tmp_path / "out")
    return [str(tmp_path / "own"), "--model", model, "--limit", "2", "--out", out]


def test_help_does_not_import_jax():
    program = (
        "import sys\n"
        "from experiments.reproduce.__main__ import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules), 'a slow import'\n"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage: python -m experiments.reproduce" in done.stdout


def test_an_experiment_of_ones_own_is_measured(flags, capsys, tmp_path):
    assert main(flags) == 0
    assert "# Mine" in capsys.readouterr().out
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [row["method"] for row in results["parts"][0]["rows"]] == ["identity", "register"]


def test_results_record_the_command_without_folders(flags, tmp_path):
    assert main(flags) == 0
    content = (tmp_path / "out" / "results.json").read_text()
    assert json.loads(content)["command"] == (
        "python -m experiments.reproduce own --data procedural --out out --limit 2 --model model.npz"
    )
    assert str(tmp_path) not in content


def test_only_copies_the_rows_of_the_other_methods(flags, tmp_path):
    assert main(flags) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    for row in results["parts"][0]["rows"]:
        row["mae_rotation"] = 123.0
    (tmp_path / "out" / "results.json").write_text(json.dumps(results))
    assert main([*flags, "--only", "register"]) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    np.testing.assert_array_equal([row["mae_rotation"] == 123.0 for row in results["parts"][0]["rows"]], [True, False])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["figure4", "--only", "register"], "--only: figure4_qualitative is a figure"),
        (["table9"], "table3_comparison"),
        (["table1", "--data", "nowhere"], "nowhere: no such file"),
    ],
    ids=["part of a figure", "unknown table", "missing data"],
)
def test_a_mistake_is_one_line_on_stderr(capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.delenv("URRT_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert message in captured.err
