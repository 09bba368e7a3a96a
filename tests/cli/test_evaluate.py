"""``urrt evaluate`` on a toy scale."""

import json

import pytest

from urrt_jax import cli
from urrt_jax.evaluation import load_evaluation


def test_evaluate_prints_a_table_and_writes_values_beside_json(files, capsys, tmp_path):
    flags = ["--model", str(files["model.npz"]), "--limit", "3", "--points", "100", "--batch", "2"]
    flags += ["--methods", "identity", "register", "--out", str(tmp_path / "results.json")]
    assert cli.main(["evaluate", *flags]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert (results["data"], results["model"], results["items"]) == ("procedural", "model.npz", 3)
    assert results["figures"].keys() == results["failed_items"].keys() == {"identity", "register"}
    assert "--methods identity register" in results["command"] and "/" not in results["command"]
    captured = capsys.readouterr()
    assert "mae_rotation" in captured.out and "results.json" in captured.err
    assert "results.json" not in captured.out
    (values,) = (tmp_path / "items").glob("dcp-register-*.npz")
    assert len(load_evaluation(values)) == 3
    before = values.read_bytes()
    assert cli.main(["evaluate", *flags]) == 0  # again: nothing is left to do
    assert cli.main(["evaluate", *flags, "--protocol", "drift"]) == 0  # another one disturbs nothing
    assert values.read_bytes() == before and len(list((tmp_path / "items").iterdir())) == 4


@pytest.mark.parametrize(
    "flags, message",
    [
        (["--protocol", "guess"], "protocol: expected one of"),
        (["--protocol", "drift loud=1"], "options sigma, target_only"),
        (["--methods", "guess"], "method: expected one of"),
        (["--methods", "dcp_v1"], "set the environment variable URRT_DATA to a folder that holds peers/dcp_v1.npz"),
        (["--methods", "dcp_v2"], "train it with 'urrt train --method dcp_v2 --out DIR'"),
        (["--methods", "dcp_v2:nowhere.npz"], "nowhere.npz does not exist"),
        (["--limit", "0"], "limit: expected at least 1"),
        (["--protocol", "scans", "--data", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_evaluate_refuses_what_it_cannot_do_before_any_work(files, capsys, tmp_path, flags, message):
    common = ["--model", str(files["model.npz"]), "--out", str(tmp_path / "results.json")]
    assert cli.main(["evaluate", *common, *flags]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_evaluate_refuses_a_model_of_ours_as_weights_of_another_network(files, capsys, tmp_path):
    flags = ["--methods", f"dcp_v2:{files['model.npz']}", "--out", str(tmp_path / "results.json")]
    assert cli.main(["evaluate", *flags]) == 2
    assert "model.json is the card of no learned peer" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
