"""``urrt train``: its flags are the library's, and its model has a card. The training itself is stubbed."""

import dataclasses
import json
import sys
import typing
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import urrt_jax
from urrt_jax import cli
from urrt_jax.cli.demo import Demo
from urrt_jax.cli.train import NetworkFlags, PairFlags, Train
from urrt_jax.model import ModelConfig
from urrt_jax.peers.learned.weights import NETWORKS
from urrt_jax.training.loop import LoopConfig
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig
from urrt_jax.training.urrt import URRT


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
    [
        (NetworkFlags(), ModelConfig()),
        (PairFlags(), PairConfig()),
        (Train(out=Path("x")), TrainConfig()),
        (Train(out=Path("x")), URRT()),
    ],
    ids=["model", "pairs", "train", "urrt"],
)
def test_flags_of_train_have_the_librarys_defaults(flags, config):
    others = {"method", "model", "pairs", "learning_rate"}
    mirrored = {field.name for field in dataclasses.fields(config)} & vars(flags).keys() - others
    assert len(mirrored) >= 5
    assert {name: getattr(flags, name) for name in mirrored} == {name: getattr(config, name) for name in mirrored}


def test_watching_flags_of_train_have_the_librarys_defaults():
    flags, loop = Train(out=Path("x")), LoopConfig()
    for name in ("every", "log_every", "validation_pairs", "patience", "minutes"):
        assert getattr(flags, name) == getattr(loop, name)


def test_default_flags_make_the_default_configuration():
    assert Train(out=Path("x")).config() == TrainConfig()


def test_command_of_train_names_no_path():
    flags = Train(out=Path("/somewhere/runs/one"), data="/somewhere/shapes.npz", steps=7, pairs=PairFlags(noise=0.1))
    assert flags.command() == "urrt train --out one --data shapes.npz --steps 7 --pairs.noise 0.1"


def _write_log(directory) -> None:
    """The log of a run of 20 steps, stopped once, whose first validation was the better one."""
    directory.mkdir()
    lines = [
        {"kind": "train", "step": 5, "loss": 0.3, "seconds": 60.0},
        {"kind": "stop", "step": 7, "seconds": 61.5},
        {"kind": "validation", "step": 10, "validation_loss": 0.1},
        {"kind": "train", "step": 20, "loss": 0.3, "seconds": 90.5},
        {"kind": "validation", "step": 20, "validation_loss": 0.2},
    ]
    (directory / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_train_writes_the_model_with_its_card(capsys, tmp_path, monkeypatch):
    def fake_train(config, shapes, validation, directory, *, start, loop):
        assert (config.steps, config.pairs.points, loop.every, start) == (20, 64, 10, None)
        _write_log(directory)
        return jax.jit(config.method.init)(jax.random.key(0))

    monkeypatch.setattr("urrt_jax.training.loop.train", fake_train)
    network = "--model.regions 2 --model.width 16 --model.landmarks 2"
    flags = f"--limit 6 --validation-share 0.3 --steps 20 --loss-points 32 --every 10 {network} --pairs.points 64"
    assert cli.main(["train", "--out", str(tmp_path / "run"), *flags.split()]) == 0
    assert urrt_jax.load_model(tmp_path / "run" / "model.npz").config.width == 16
    card = urrt_jax.model_card(tmp_path / "run" / "model.npz")
    assert card["command"] == f"urrt train --out run {flags}"
    assert (card["data"], card["shapes"], card["validation_shapes"], card["steps"]) == ("procedural", 4, 2, 20)
    assert card["seconds"] == 90.5
    assert card["occupancy"] == "a shell around each cloud"
    assert card["training"]["method"]["name"] == "urrt"
    assert card["validation"] == {"step": 10, "validation_loss": 0.1}
    assert card["versions"]["urrt_jax"] == urrt_jax.__version__
    assert str(tmp_path) not in json.dumps(card)


def test_train_begins_with_the_weights_it_is_given(capsys, tmp_path, monkeypatch):
    packaged, given = urrt_jax.load_model(), {}

    def fake_train(config, shapes, validation, directory, *, start, loop):
        given.update(start)
        _write_log(directory)
        return {"params": packaged.params}

    monkeypatch.setattr("urrt_jax.training.loop.train", fake_train)
    file = urrt_jax.save_model(packaged, tmp_path / "mine.npz")
    flags = f"--start {file} --limit 6 --validation-share 0.3 --model.partition parts"
    assert cli.main(["train", "--out", str(tmp_path / "run"), *flags.split()]) == 0
    jax.tree.map(np.testing.assert_array_equal, given, packaged.params)
    assert f"51 of the 56 arrays of {file} have their place in this network" in capsys.readouterr().err
    card = urrt_jax.model_card(tmp_path / "run" / "model.npz")
    assert card["start"] == {"model": "mine", "sha256": urrt_jax.model_card(file)["sha256"]}
    assert "--start mine.npz" in card["command"]
    assert str(tmp_path) not in json.dumps(card)


def test_train_refuses_a_start_that_is_no_model(capsys, tmp_path):
    assert cli.main(["train", "--out", str(tmp_path / "run"), "--start", "modelnet41"]) == 2
    assert "no packaged model is called 'modelnet41'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_train_can_leave_categories_unseen(tmp_path, monkeypatch):
    seen = []

    def fake_train(config, shapes, validation, directory, *, start, loop):
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


@dataclasses.dataclass(frozen=True)
class Peer:
    """What the command knows of another learned method."""

    neighbors: int = 20
    name: typing.ClassVar[str] = "dcp_v2"
    learning_rate: typing.ClassVar[float] = 2e-4


@pytest.fixture
def peers(monkeypatch) -> list:
    """One other method in the place of all; the list gets what is saved of it."""
    saved = []

    def save_network(network, variables, path, card):
        saved.append((network, variables, path, card))
        return path

    module = SimpleNamespace(NETWORKS={"dcp_v2": Peer()}, save_network=save_network)
    monkeypatch.setitem(sys.modules, "urrt_jax.peers.learned.weights", module)
    return saved


def test_train_offers_every_learned_peer():
    offered = typing.get_args(typing.get_type_hints(Train, vars(sys.modules[Train.__module__]))["method"])
    assert set(offered) == {"urrt", *NETWORKS}


def test_other_method_is_trained_at_its_published_learning_rate_unless_told(peers):
    flags = Train(out=Path("x"), method="dcp_v2")
    assert flags.config() == TrainConfig(method=Peer(), learning_rate=2e-4)
    assert dataclasses.replace(flags, learning_rate=5e-4).config().learning_rate == 5e-4


@pytest.mark.parametrize(
    "flags",
    ["--model.width 64", "--occupancy-weight 0.1", "--loss-points 64", "--unrolled 1", "--lookups 8", "--rounds 2",
     "--queries 100", "--start modelnet40"],
)  # fmt: skip
def test_flag_of_our_network_with_another_method_is_wrong_use(peers, capsys, tmp_path, flags):
    assert cli.main(["train", "--out", str(tmp_path / "run"), "--method", "dcp_v2", *flags.split()]) == 2
    name = flags.split()[0]
    assert f"error: {name}: only for our own network, not for --method dcp_v2" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_other_method_is_saved_with_a_card_that_says_nothing_of_regions(peers, capsys, tmp_path, monkeypatch):
    variables = {"params": {}, "batch_stats": {}}

    def fake_train(config, shapes, validation, directory, *, start, loop):
        assert (config.method, loop.minutes) == (Peer(), 1.5)
        _write_log(directory)
        return variables

    monkeypatch.setattr("urrt_jax.training.loop.train", fake_train)
    flags = "--method dcp_v2 --limit 6 --validation-share 0.3 --minutes 1.5 --pairs.points 64"
    assert cli.main(["train", "--out", str(tmp_path / "run"), *flags.split()]) == 0
    ((network, saved, path, card),) = peers
    assert (network, saved, path) == (Peer(), variables, tmp_path / "run" / "model.npz")
    assert card["command"] == f"urrt train --out run {flags}"
    assert card["training"]["method"] == {"name": "dcp_v2", "neighbors": 20}
    assert (card["steps"], card["seconds"]) == (20, 90.5)
    assert "occupancy" not in card
    assert "regions" not in capsys.readouterr().err
