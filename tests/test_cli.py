"""The command line: what it prints, writes and answers to mistakes. Training and evaluation run on a toy scale."""

import dataclasses
import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
import pytest

import urrt_jax
from urrt_jax import cli, io
from urrt_jax.cli.demo import Demo, demo_pair
from urrt_jax.cli.printing import as_dict, as_table
from urrt_jax.cli.train import NetworkFlags, PairFlags, Train
from urrt_jax.data import demo_shape
from urrt_jax.evaluation import load_evaluation
from urrt_jax.model import ModelConfig
from urrt_jax.programs import clear_programs
from urrt_jax.result import Outcome
from urrt_jax.training.loop import LoopConfig
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """No cache folder, no debugging, no data of the developer's."""
    monkeypatch.setenv("URRT_NO_CACHE", "1")
    for name in ("URRT_DEBUG", "URRT_DATA"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def files(tmp_path_factory, small_model) -> dict[str, Path]:
    """Two clouds of 200 points and a small untrained model: enough for everything that is not about accuracy."""
    folder = tmp_path_factory.mktemp("files")
    shape = demo_shape(400).astype(np.float64)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    io.write_cloud(folder / "a.ply", shape[::2])
    io.write_cloud(folder / "b.xyz", shape[1::2] @ turn.T + [0.1, 0.2, 0.3])
    urrt_jax.save_model(small_model, folder / "model.npz")
    return {name: folder / name for name in ("a.ply", "b.xyz", "model.npz")}


@pytest.fixture(scope="module")
def registration(files) -> urrt_jax.Registration:
    """The result for the two clouds."""
    clouds = (io.read_cloud(files[name]) for name in ("a.ply", "b.xyz"))
    return urrt_jax.register(*clouds, model=urrt_jax.load_model(files["model.npz"]))


def register(files: dict[str, Path], *flags: str, source: Path | None = None, target: Path | None = None) -> int:
    clouds = [str(source or files["a.ply"]), str(target or files["b.xyz"])]
    return cli.main(["register", *clouds, "--model", str(files["model.npz"]), *flags])


@pytest.mark.parametrize(
    "command", [[], ["register"], ["demo"], ["train"], ["evaluate"]], ids=lambda c: "".join(c) or "urrt"
)
def test_help_answers_without_importing_jax(command):
    program = (
        "import sys\n"
        "from urrt_jax.cli import main\n"
        "try:\n"
        f"    main({[*command, '--help']})\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "assert not {'jax', 'flax', 'numpy', 'matplotlib', 'trimesh'} & set(sys.modules), 'a heavy import'\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage: urrt" in done.stdout


def test_json_is_one_object_with_exactly_the_promised_keys(files, capsys):
    assert register(files, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    promised = "matrix rotation translation fitness rmse overlap confidence converged reason information"
    assert list(found) == [*promised.split(), "covariance", "alternatives"]
    matrix = np.array(found["matrix"])
    np.testing.assert_array_equal(matrix[:3, :3], found["rotation"])
    np.testing.assert_array_equal(matrix[:3, 3], found["translation"])
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    assert isinstance(found["fitness"], float) and isinstance(found["rmse"], float)
    assert isinstance(found["converged"], bool)
    assert len(found["overlap"]) == 2 and np.shape(found["information"]) == (6, 6)
    assert np.shape(found["covariance"]) == (6, 6) and isinstance(found["alternatives"], list)


@pytest.mark.parametrize("field", ["fitness", "rmse", "overlap", "confidence", "information", "covariance"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_json_has_null_for_a_number_that_is_not_finite(registration, field, value):
    whole = np.asarray(getattr(registration, field))
    first = dataclasses.replace(
        registration, **{field: np.where(np.arange(whole.size).reshape(whole.shape), whole, value)}
    )
    found = json.loads(json.dumps(as_dict(first), allow_nan=False))
    expected = as_dict(registration)
    assert np.ravel(np.array(found[field], object))[0] is None
    np.testing.assert_array_equal(np.ravel(found[field])[1:], np.ravel(expected[field])[1:])
    assert {name: each for name, each in found.items() if name != field} == {
        name: each for name, each in expected.items() if name != field
    }


def test_table_shows_the_transform_and_the_diagnostics(files, capsys):
    assert register(files) == 0
    out = capsys.readouterr().out
    measures = ("fitness", "rmse", "overlap", "confidence", "converged")
    for word in ("a.ply, 200 points", "b.xyz, 200 points", "R, turns by", *measures):
        assert word in out


def test_a_failure_is_said_with_its_reason(registration):
    failed = dataclasses.replace(registration, converged=np.array(False), outcome=np.array(Outcome.AMBIGUOUS))
    assert as_table(failed).endswith("converged    NO       " + failed.reason)
    assert as_dict(failed)["reason"] == failed.reason
    found = dataclasses.replace(registration, converged=np.array(True), outcome=np.array(Outcome.CONVERGED))
    assert as_table(found).endswith("converged    yes")


def test_a_terminal_is_told_once_that_programs_are_compiled(files, capsys, monkeypatch):
    clear_programs()
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    told = []
    for _ in range(2):
        assert register(files, "--json", "--no-refine") == 0
        told.append(capsys.readouterr().err)
    assert told[0].startswith("urrt: compiling, once for clouds of up to 256 points\n") and told[1] == ""


@pytest.mark.parametrize("extension", ["ply", "xyz", "npy"])
def test_out_holds_the_moved_source(files, capsys, tmp_path, extension):
    assert register(files, "--json", "--out", str(tmp_path / f"moved.{extension}")) == 0
    matrix = np.array(json.loads(capsys.readouterr().out)["matrix"])
    expected = io.read_cloud(files["a.ply"]) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(io.read_cloud(tmp_path / f"moved.{extension}"), expected, atol=1e-12)


def test_out_as_ply_is_coloured(files, capsys, tmp_path):
    assert register(files, "--out", str(tmp_path / "moved.ply")) == 0
    assert b"property uchar red" in (tmp_path / "moved.ply").read_bytes()


def test_map_coordinates_cost_no_digits(files, capsys, tmp_path):
    origins = np.array([5e5, 4e6, 100.0]), np.array([4e5, 5e6, -200.0])
    moved = []
    for offsets in ((0, 0), origins):
        for name, file, offset in zip(("a", "b"), ("a.ply", "b.xyz"), offsets, strict=True):
            io.write_cloud(tmp_path / f"{name}.ply", io.read_cloud(files[file]) + offset)
        out = tmp_path / "moved.ply"
        assert register(files, "--out", str(out), source=tmp_path / "a.ply", target=tmp_path / "b.ply") == 0
        moved.append(io.read_cloud(out) - offsets[1])
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-5)


def test_no_refine_gives_the_networks_own_estimate(files, capsys):
    assert register(files, "--no-refine", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    clouds = [io.read_cloud(files[name]) for name in ("a.ply", "b.xyz")]
    expected = urrt_jax.register(*clouds, model=urrt_jax.load_model(files["model.npz"]), refine=None)
    np.testing.assert_allclose(found["rotation"], expected.coarse.rotation, atol=1e-5)


def test_what_json_printed_is_a_rough_transform_to_begin_with(files, capsys, tmp_path):
    assert register(files, "--json", "--no-refine") == 0
    rough = tmp_path / "rough.json"
    rough.write_text(capsys.readouterr().out)
    assert register(files, "--json", "--initial", str(rough)) == 0
    found = json.loads(capsys.readouterr().out)
    clouds = [io.read_cloud(files[name]) for name in ("a.ply", "b.xyz")]
    options = {"model": urrt_jax.load_model(files["model.npz"]), "search": "auto"}
    expected = urrt_jax.register(*clouds, **options, initial=np.array(json.loads(rough.read_text())["matrix"]))
    np.testing.assert_allclose(found["matrix"], expected.matrix, atol=1e-5)


def test_picture_is_a_png(files, capsys, tmp_path):
    assert register(files, "--picture", str(tmp_path / "pair.png")) == 0
    assert (tmp_path / "pair.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("change", "flags"),
    [
        ({"source": Path("missing.ply")}, []),
        ({}, ["--model", "no-such-model"]),
        ({}, ["--out", "moved.docx"]),
        ({}, ["--inlier-distance", "-1"]),
        ({}, ["--out", "no-such-folder/moved.ply"]),
        ({}, ["--initial", "missing.txt"]),
    ],
    ids=["missing file", "unknown model", "unknown extension", "negative distance", "missing folder", "no transform"],
)
def test_a_mistake_is_one_line_on_stderr(files, capsys, tmp_path, monkeypatch, change, flags):
    monkeypatch.chdir(tmp_path)
    assert register(files, "--json", *flags, **change) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("urrt: error: ") and captured.err.count("\n") == 1


def test_a_missing_folder_for_the_output_is_named_before_any_work(files, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("urrt_jax.io.read_cloud", lambda *_, **__: pytest.fail("the clouds were read first"))
    assert register(files, "--out", str(tmp_path / "nowhere" / "moved.ply")) == 2
    assert "nowhere" in capsys.readouterr().err


@pytest.mark.parametrize("samples", ["0", "-1", "10000001", "1000000000000"])
def test_samples_out_of_range_are_named_before_any_work(files, capsys, monkeypatch, samples):
    monkeypatch.setattr("urrt_jax.io.read_cloud", lambda *_, **__: pytest.fail("the clouds were read first"))
    assert register(files, "--samples", samples) == 2
    error = capsys.readouterr().err
    assert error == f"urrt: error: --samples: expected a whole number from 1 to 10,000,000, got {samples}\n"


def test_debugging_shows_the_traceback(files, monkeypatch):
    monkeypatch.setenv("URRT_DEBUG", "1")
    with pytest.raises(FileNotFoundError):
        register(files, source=Path("missing.ply"))


def test_an_unknown_flag_ends_with_code_2(files, capsys):
    with pytest.raises(SystemExit) as end:
        register(files, "--nonsense")
    assert end.value.code == 2
    assert capsys.readouterr().out == ""


def test_compiled_programs_are_kept_and_the_second_run_is_silent_about_it(files, tmp_path):
    # Nor JAX's own cache, which the tests share: what it holds is not kept again.
    left_out = "URRT_NO_CACHE", "JAX_COMPILATION_CACHE_DIR"
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    environment |= {"XDG_CACHE_HOME": str(tmp_path)}
    program = [sys.executable, "-m", "urrt_jax.cli", "register", "--json", "--no-refine"]
    command = [*program, str(files["a.ply"]), str(files["b.xyz"]), "--model", str(files["model.npz"])]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)
    )
    assert list((tmp_path / "urrt_jax" / "programs").glob("*.program"))
    assert not (tmp_path / "urrt_jax" / "jax").exists()
    assert json.loads(first.stdout) == json.loads(second.stdout)
    assert first.stderr == second.stderr == ""


def test_an_unusable_cache_folder_does_not_matter(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.delenv("URRT_NO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = jax.config.jax_compilation_cache_dir
    cli._keep_compiled_programs(Train(out=tmp_path))
    assert jax.config.jax_compilation_cache_dir == before


def test_training_keeps_what_jax_compiles_beside_the_programs(tmp_path, monkeypatch):
    kept = {}
    monkeypatch.delenv("URRT_NO_CACHE")
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "3")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("urrt_jax.program_cache._cache", None)
    monkeypatch.setattr(jax.config, "update", kept.__setitem__)
    cli._keep_compiled_programs(Demo())
    assert not kept
    cli._keep_compiled_programs(Train(out=tmp_path))
    folder = Path(kept["jax_compilation_cache_dir"])
    assert folder.is_dir() and folder.parent == tmp_path / "urrt_jax" / "jax"
    assert version("jaxlib") in folder.name


def test_demo_writes_its_picture_and_says_where(files, capsys, tmp_path):
    out = tmp_path / "demo.png"
    assert cli.main(["demo", "--model", str(files["model.npz"]), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert out.read_bytes().startswith(b"\x89PNG")
    assert "against the truth" in printed and str(out) in printed


def test_demo_pair_without_noise_and_cut_is_aligned_by_its_truth():
    source, target, rotation, translation = demo_pair(1, noise=0.0, keep=1.0)
    assert len(source) == len(target)
    moved = source @ rotation.T + translation
    gaps = np.linalg.norm(moved[:200, None] - target[None], axis=-1).min(axis=1)
    assert np.median(gaps) < 0.05
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_demo_pair_keeps_the_share_asked_for():
    assert len(demo_pair(0, noise=0.0, keep=0.5)[0]) == pytest.approx(1024, abs=2)


@pytest.mark.parametrize("flags", [{"keep": 0.0}, {"keep": 1.1}, {"noise": -1.0}], ids=str)
def test_demo_pair_refuses_nonsense(flags):
    with pytest.raises(ValueError, match="expected"):
        demo_pair(0, **({"noise": 0.0, "keep": 1.0} | flags))


@pytest.mark.parametrize(
    ("flags", "config"),
    [(NetworkFlags(), ModelConfig()), (PairFlags(), PairConfig()), (Train(out=Path("x")), TrainConfig())],
    ids=["model", "pairs", "train"],
)
def test_flags_of_train_have_the_librarys_defaults(flags, config):
    mirrored = {field.name for field in dataclasses.fields(config)} & vars(flags).keys() - {"model", "pairs"}
    assert len(mirrored) >= 6
    assert {name: getattr(flags, name) for name in mirrored} == {name: getattr(config, name) for name in mirrored}


def test_watching_flags_of_train_have_the_librarys_defaults():
    flags, loop = Train(out=Path("x")), LoopConfig()
    for name in ("every", "log_every", "validation_pairs", "patience"):
        assert getattr(flags, name) == getattr(loop, name)


def test_default_flags_make_the_default_configuration():
    assert Train(out=Path("x")).config() == TrainConfig()


def test_command_of_train_names_no_path():
    flags = Train(out=Path("/somewhere/runs/one"), data="/somewhere/shapes.npz", steps=7, pairs=PairFlags(noise=0.1))
    assert flags.command() == "urrt train --out one --data shapes.npz --steps 7 --pairs.noise 0.1"


def test_train_writes_the_model_with_its_card(files, capsys, tmp_path, monkeypatch):
    def fake_train(config, shapes, validation, directory, *, loop):
        assert (config.steps, config.pairs.points, loop.every) == (20, 64, 10)
        directory.mkdir()
        validations = [
            {"kind": "validation", "step": step, "validation_loss": loss} for step, loss in ((10, 0.1), (20, 0.2))
        ]
        lines = [{"kind": "train", "step": 5, "loss": 0.3}, *validations]
        (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return urrt_jax.load_model(files["model.npz"])

    monkeypatch.setattr("urrt_jax.training.loop.train", fake_train)
    flags = "--limit 6 --validation-share 0.3 --steps 20 --loss-points 32 --every 10 --pairs.points 64"
    assert cli.main(["train", "--out", str(tmp_path / "run"), *flags.split()]) == 0
    assert urrt_jax.load_model(tmp_path / "run" / "model.npz").config.width == 16
    card = urrt_jax.model_card(tmp_path / "run" / "model.npz")
    assert card["command"] == f"urrt train --out run {flags}"
    assert (card["data"], card["shapes"], card["validation_shapes"], card["steps"]) == ("procedural", 4, 2, 20)
    assert card["validation"] == {"step": 10, "validation_loss": 0.1}
    assert card["versions"]["urrt_jax"] == urrt_jax.__version__
    assert str(tmp_path) not in json.dumps(card)


def test_train_can_leave_categories_unseen(tmp_path, monkeypatch):
    seen = []

    def fake_train(config, shapes, validation, directory, *, loop):
        seen.extend([*shapes.labels, *validation.labels])
        raise KeyboardInterrupt

    monkeypatch.setattr("urrt_jax.training.loop.train", fake_train)
    flags = ["train", "--out", str(tmp_path), "--limit", "60", "--validation-share", "0.1"]
    cli.main([*flags, "--categories", "2"])
    assert set(seen) == {0, 1}
    assert cli.main([*flags, "--categories", "0"]) == 2


def test_interrupted_training_says_how_to_continue(capsys, tmp_path, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("urrt_jax.training.loop.train", interrupt)
    assert cli.main(["train", "--out", str(tmp_path), "--limit", "4"]) == 130
    assert "the same command continues" in capsys.readouterr().err


def test_evaluate_prints_a_table_and_writes_values_beside_json(files, capsys, tmp_path):
    flags = ["--model", str(files["model.npz"]), "--limit", "3", "--points", "100", "--batch", "2"]
    flags += ["--methods", "identity", "register", "--out", str(tmp_path / "results.json")]
    assert cli.main(["evaluate", *flags]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert (results["data"], results["model"], results["items"]) == ("procedural", "model.npz", 3)
    assert results["figures"].keys() == results["failed_items"].keys() == {"identity", "register"}
    assert "--methods identity register" in results["command"] and "/" not in results["command"]
    out = capsys.readouterr().out
    assert "mae_rotation" in out and "results.json" in out
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
        (["--limit", "0"], "limit: expected at least 1"),
        (["--protocol", "scans", "--data", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_evaluate_refuses_what_it_cannot_do_before_any_work(files, capsys, tmp_path, flags, message):
    common = ["--model", str(files["model.npz"]), "--out", str(tmp_path / "results.json")]
    assert cli.main(["evaluate", *common, *flags]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
