"""From a configuration to results, table and figures: no row is left out, and nothing is measured twice."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from experiments.reproduce.experiment import Experiment, Part, Sweep, find_experiment, list_experiments, read_experiment
from experiments.reproduce.figures import _styles
from experiments.reproduce.pictures import draw_pairs
from experiments.reproduce.run import reproduce
from experiments.reproduce.tables import as_markdown
from urrt_jax.weights import save_model


@pytest.fixture(scope="module")
def files(small_model, tmp_path_factory):
    """A folder with a small model and ten shapes of two categories, one of them axisymmetric."""
    folder = tmp_path_factory.mktemp("reproduce")
    save_model(small_model, folder / "small.npz")
    points = np.random.default_rng(0).normal(size=(10, 200, 3)) * [0.5, 0.3, 0.2]
    points -= points.mean(axis=1, keepdims=True)
    points /= np.linalg.norm(points, axis=2).max(axis=1)[:, None, None]
    label = np.arange(10) % 2
    np.savez(
        folder / "shapes_test.npz", points=points.astype(np.float32), label=label, classes=np.array(["chair", "vase"])
    )
    return folder


@pytest.fixture(scope="module")
def many(files, tmp_path_factory):
    """The same with forty shapes, enough for trends."""
    folder = tmp_path_factory.mktemp("many")
    with np.load(files / "shapes_test.npz") as few:
        values = {"points": np.tile(few["points"], (4, 1, 1)), "label": np.tile(few["label"], 4)}
        np.savez(folder / "shapes_test.npz", **values, classes=few["classes"])
    return folder


@pytest.fixture
def experiment():
    return Experiment(
        name="small", title="A small table", methods=("identity", "principal_axes", "register"),
        columns=("mae_rotation", "recall_1deg", "asymmetric.recall_1deg"), published_columns=("mae_rotation",),
        trends=True,
        parts=(
            Part(title="clean", protocol="dcp", points=100, published={"paper": [0.4328]}),
            Part(title="unseen", protocol="dcp", points=100, unseen=True),
            Part(title="scans", protocol="scans", data="nowhere.npz"),
        ),
        sweeps=(
            Sweep(
                title="noise", protocol="independent", option="noise", values=(0.0, 0.01), points=100,
                methods=("identity",), stride=5,
            ),
        ),
    )  # fmt: skip


def run(experiment, files, out, **options):
    return reproduce(experiment, str(files), out, model=str(files / "small.npz"), progress=False, **options)


def test_results_table_and_pictures_are_written(experiment, files, tmp_path):
    results = run(experiment, files, tmp_path / "out", command="python -m experiments.reproduce small")
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"results.json", "table.md", "recall.png", "sweeps.png"}  # ten pairs are too few for trends
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == json.loads(json.dumps(results))
    assert (tmp_path / "out" / "table.md").read_text() == as_markdown(results)
    clean = results["parts"][0]
    assert (clean["items"], clean["subset"]) == (10, "all 10 items")
    assert [row["method"] for row in clean["rows"]] == ["identity", "principal_axes", "register"]
    assert clean["rows"][1]["recall_1deg"] == 1.0
    assert clean["rows"][0]["asymmetric"]["items"] == 5
    assert results["sweeps"][0]["rows"][0]["recall_5deg_0.1"] == [0.0, 0.0]
    assert str(files) not in json.dumps(results)


def test_trends_show_errors_against_what_makes_pairs_hard(files, many, tmp_path):
    hard = Experiment(
        name="hard", title="Hard", methods=("identity", "principal_axes"), columns=("mae_rotation",), trends=True,
        parts=(Part(title="cropped", protocol="incomplete_both kept=60", points=100),),
    )  # fmt: skip
    results = reproduce(hard, str(many), tmp_path / "out", model=str(files / "small.npz"), progress=False)
    turns = results["parts"][0]["rows"][0]["trends"]["true rotation in degrees"]
    known = [value for value in turns if value is not None]
    assert len(known) >= 2 and known == sorted(known)  # doing nothing is as wrong as the rotation is large
    assert (tmp_path / "out" / "trends.png").exists()


def test_a_method_has_one_colour_in_all_panels():
    rows = [{"method": "identity"}, {"method": "icp"}], [{"method": "icp"}, {"method": "fgr"}, {"method": "register"}]
    styles = _styles({"parts": [{"rows": each} for each in rows], "sweeps": []})
    assert len({style["color"] for style in styles.values() if style["zorder"] == 2}) == 3
    assert styles["register"]["zorder"] > styles["icp"]["zorder"]


def test_mistyped_data_is_an_error_and_older_results_stay(experiment, files, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "results.json").write_text("older")
    with pytest.raises(OSError, match="nowhere"):
        reproduce(experiment, str(tmp_path / "nowhere"), tmp_path / "out", model=str(files / "small.npz"))
    assert (tmp_path / "out" / "results.json").read_text() == "older"


def test_the_table_names_data_weights_and_settings(experiment, files, tmp_path):
    results = run(experiment, files, tmp_path / "out", command="python -m experiments.reproduce small")
    table = as_markdown(results)
    assert "all 10 items of " in table and "test split" in table
    assert results["model_sha256"][:12] in table and "`python -m experiments.reproduce small`" in table


def test_no_row_is_left_out(experiment, files, tmp_path):
    table = as_markdown(run(experiment, files, tmp_path / "out"))
    assert "| *paper* | *0.4328* |" in table
    assert "no data" in table  # neither the scans nor a 21st category are there
    assert table.count("## ") == 3


def test_a_missing_library_is_a_row_that_says_how_to_get_it(experiment, files, tmp_path, monkeypatch):
    def missing(self):
        raise ImportError("nobodys is not usable: pip install nobodys")

    monkeypatch.setattr("urrt_jax.peers.simple.PrincipalAxes.versions", missing)
    table = as_markdown(run(experiment, files, tmp_path / "out"))
    assert "| principal axes | nobodys is not usable: pip install nobodys |" in table


def test_a_limit_is_spread_over_the_items_and_stated(experiment, files, tmp_path):
    results = run(experiment, files, tmp_path / "out", limit=4)
    assert results["parts"][0]["items"] == 4
    assert results["parts"][0]["subset"] == "every 3rd item, 4 of 10"


def test_what_is_done_is_not_done_again(experiment, files, tmp_path, monkeypatch):
    first = run(experiment, files, tmp_path / "out")
    monkeypatch.setattr("urrt_jax.peers.simple.Identity.align_pair", lambda *pair: pytest.fail("aligned again"))
    monkeypatch.setattr("urrt_jax.evaluation.methods.register_pairs", lambda *pair: pytest.fail("registered again"))
    assert run(experiment, files, tmp_path / "out") == first


@pytest.fixture
def measured(experiment, files, tmp_path):
    """An experiment of one part and one sweep, run, with a mark on the rows that can be kept; the items are gone."""
    experiment = dataclasses.replace(experiment, parts=experiment.parts[:1])
    results = run(experiment, files, tmp_path / "out")
    for row in results["parts"][0]["rows"]:
        row["mae_rotation"] = 123.0
    results["sweeps"][0]["rows"][0]["title"] = "marked"
    (tmp_path / "out" / "results.json").write_text(json.dumps(results))
    shutil.rmtree(tmp_path / "items")
    return experiment, tmp_path / "out"


def test_only_some_methods_are_measured_anew(measured, files):
    experiment, out = measured
    results = run(experiment, files, out, only=["register"])
    assert [row["mae_rotation"] == 123.0 for row in results["parts"][0]["rows"]] == [True, True, False]
    assert results["sweeps"][0]["rows"][0]["title"] == "marked"
    assert json.loads((out / "results.json").read_text()) == results


def _other_settings(results):
    results["parts"][0]["rows"][1]["identity"]["method"] = "another"


def _other_data(results):
    results["parts"][0]["data_digest"] = "0"


def _sweep_of_other_settings(results):
    results["sweeps"][0]["rows"][0]["identity"]["method"] = "another"


def _sweep_of_unknown_settings(results):
    del results["sweeps"][0]["rows"][0]["identity"]


def _sweep_of_other_data(results):
    results["sweeps"][0]["data_digest"] = "0"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_other_settings, "'principal_axes' of 'clean' has other settings"),
        (_other_data, "'clean' is of other items or data"),
        (_sweep_of_other_settings, "'identity' of 'noise' has other settings"),
        (_sweep_of_unknown_settings, "'identity' of 'noise' has other settings"),
        (_sweep_of_other_data, "'noise' is of other items or data"),
    ],
)
def test_rows_of_something_else_are_not_kept(measured, files, change, message):
    experiment, out = measured
    results = json.loads((out / "results.json").read_text())
    change(results)
    changed = json.dumps(results)
    (out / "results.json").write_text(changed)
    with pytest.raises(ValueError, match=f"^only: .*{message}"):
        run(experiment, files, out, only=["register"])
    assert (out / "results.json").read_text() == changed


def test_a_row_that_the_earlier_results_lack_is_measured(measured, files):
    experiment, out = measured
    results = json.loads((out / "results.json").read_text())
    del results["parts"][0]["rows"][1]
    (out / "results.json").write_text(json.dumps(results))
    wider = dataclasses.replace(experiment, parts=(*experiment.parts, Part(title="new", protocol="drift", points=100)))
    rows = [part["rows"] for part in run(wider, files, out, only=["register"])["parts"]]
    assert [row["mae_rotation"] == 123.0 for row in rows[0]] == [True, False, False]
    assert [row["method"] for row in rows[1]] == ["identity", "principal_axes", "register"]


def test_a_part_may_be_of_the_first_items(experiment, files, tmp_path):
    part = Part(title="first", protocol="dcp", points=100, stride=2, first=3)
    few = dataclasses.replace(experiment, parts=(part,), sweeps=(), methods=("identity",), matrix=True)
    found = run(few, files, tmp_path / "out")["parts"][0]
    assert (found["items"], found["subset"]) == (3, "the first 3 of every 2nd item, 10 in all")
    assert (tmp_path / "out" / "matrix.png").exists()


def test_only_names_methods_of_the_experiment_and_needs_earlier_results(experiment, files, tmp_path):
    with pytest.raises(ValueError, match=r"^only: expected some of identity, principal_axes, register, got icp"):
        run(experiment, files, tmp_path / "out", only=["icp"])
    with pytest.raises(ValueError, match=r"^only: expected some of .*, got none"):
        run(experiment, files, tmp_path / "out", only=[])
    with pytest.raises(FileNotFoundError, match=r"results\.json"):
        run(experiment, files, tmp_path / "nothing", only=["register"])
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(ValueError, match=r"^only: .*results\.json holds no table"):
        run(experiment, files, tmp_path, only=["register"])


def test_other_weights_are_evaluated_anew(experiment, files, tmp_path, small_model):
    import jax

    first = run(experiment, files, tmp_path / "out")
    other = jax.tree.map(lambda leaf: leaf + 0.01, small_model)
    save_model(other, files / "other.npz")
    second = reproduce(experiment, str(files), tmp_path / "out", model=str(files / "other.npz"), progress=False)
    assert first["parts"][0]["rows"][2]["identity"] != second["parts"][0]["rows"][2]["identity"]


def test_pictures_show_every_part(files, tmp_path):
    shown = Experiment(
        name="shown", title="Pairs", kind="pictures", methods=("identity",),
        parts=(Part(title="clean", protocol="dcp"), Part(title="noisy", protocol="drift")),
    )  # fmt: skip
    results = draw_pairs(shown, "procedural", tmp_path / "out", model=str(files / "small.npz"))
    assert (tmp_path / "out" / "figure.png").stat().st_size > 10_000
    assert [row["part"] for row in results["pairs"]] == ["clean", "noisy"]


@pytest.mark.parametrize("experiment", list_experiments(), ids=lambda each: each.name)
def test_every_committed_experiment_shows_what_nothing_is_worth(experiment):
    """Reading it has already checked every name; no table is without the rows that put it into proportion."""
    assert experiment.parts
    if experiment.name == "default_call":  # which compares two calls of ours
        assert experiment.methods == ("plain", "register")
    elif experiment.kind == "table":
        assert {"identity", "network", "plain"} <= set(experiment.methods)


@pytest.mark.parametrize("name", ["table1", "table2", "table3", "figure4", "beyond"])
def test_the_papers_names_find_their_folders(name):
    assert find_experiment(name).name.startswith(name)


def test_unknown_tables_are_named():
    with pytest.raises(ValueError, match=r"table: expected one of .*table1_ablation.*'table9'"):
        find_experiment("table9")


PART = 'title = "x"\nmethods = []\n[[parts]]\ntitle = "y"\nprotocol = "dcp"\n'


@pytest.mark.parametrize(
    "content, message",
    [
        ("title = ", "config.toml"),
        ('title = "x"\nmethods = []\nsurprise = 1', r"unknown keys \['surprise'\]"),
        ('title = "x"\nmethods = []\n[[parts]]\ntitle = "no protocol"', "protocol"),
        ('title = "x"\nmethods = ["nobody"]\nparts = []', "method: expected one of"),
        (PART + 'columns = ["mse"]', "columns: expected"),
        (PART + "stride = 0", "stride"),
        (PART + "overlap = [0.4, 0.2]", "overlap"),
        (PART + "overlap = 0.2", "overlap: expected the least"),
        (PART + 'overlap = ["some", "more"]', "overlap: expected the least"),
        (PART + "[parts.published]\nA = [1]", "published"),
    ],
)
def test_bad_configurations_are_named(tmp_path, content, message):
    (tmp_path / "config.toml").write_text(content)
    with pytest.raises(ValueError, match=message):
        read_experiment(tmp_path)


def test_a_bad_limit_is_named(experiment, files, tmp_path):
    with pytest.raises(ValueError, match="limit"):
        run(experiment, files, tmp_path / "out", limit=0)
