"""``urrt train``: its flags are the library's, and its model has a card. The training itself is stubbed."""

import dataclasses
import json
from importlib.metadata import version
from pathlib import Path

import jax
import pytest

import urrt_jax
from urrt_jax import cli
from urrt_jax.cli.demo import Demo
from urrt_jax.cli.train import NetworkFlags, PairFlags, Train
from urrt_jax.model import ModelConfig
from urrt_jax.training.loop import LoopConfig
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig


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
    assert folder.is_dir() and folder.parent == tmp_path / "urrt_jax" / "programs" / "jax"
    assert version("jaxlib") in folder.name


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
