"""Checkpoints: whole ones only, the last and the best kept, one configuration a folder, any moment to be killed at."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import ModelConfig
from urrt_jax.training.checkpoints import Checkpoints
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig, TrainState, init_state
from urrt_jax.training.urrt import URRT

# Where a load fails, Orbax leaves other reads unfinished: they end after its event loop, or are never awaited.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning"),
]
_CONFIG = TrainConfig(
    method=URRT(
        model=ModelConfig(
            regions=2, width=4, encoder_widths=(4,), branch_width=4, position_widths=(4,), decoder_widths=(4,)
        ),
        loss_points=16,
    ),
    pairs=PairConfig(points=16),
    steps=10,
)


@pytest.fixture(scope="module")
def state() -> TrainState:
    return jax.jit(init_state, static_argnums=0)(_CONFIG)


def _at(state: TrainState, step: int) -> TrainState:
    """A state that tells which step it is from, in every leaf."""
    params = jax.tree.map(lambda leaf: jnp.full_like(leaf, step), state.params)
    return dataclasses.replace(state, step=jnp.asarray(step, jnp.int32), params=params)


def _assert_same(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def _folders(directory) -> set[str]:
    return {path.name for path in (directory / "checkpoints").iterdir() if path.is_dir()}


def test_nothing_saved_restores_nothing(tmp_path, state):
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        assert checkpoints.restore_latest(state) is None
        assert checkpoints.restore_best(state) is None


def test_saved_state_comes_back_in_another_process_s_place(tmp_path, state):
    saved = _at(state, 3)
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        checkpoints.save(saved, 0.5)
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        _assert_same(checkpoints.restore_latest(state), saved)


def test_last_and_best_are_kept(tmp_path, state):
    with Checkpoints(tmp_path, _CONFIG, keep=2) as checkpoints:
        for step, loss in [(1, 0.5), (2, 0.1), (3, 0.4), (4, 0.3), (5, 0.2)]:
            checkpoints.save(_at(state, step), loss)
    with Checkpoints(tmp_path, _CONFIG, keep=2) as checkpoints:
        assert int(checkpoints.restore_latest(state).step) == 5
        assert int(checkpoints.restore_best(state).step) == 2
    assert len(_folders(tmp_path)) == 3


def test_best_among_losses_that_are_not_numbers_is_a_number(tmp_path, state):
    with Checkpoints(tmp_path, _CONFIG, keep=1) as checkpoints:
        for step, loss in [(1, float("nan")), (2, 0.1), (3, float("nan")), (4, 0.3)]:
            checkpoints.save(_at(state, step), loss)
        assert int(checkpoints.restore_best(state).step) == 2


def test_without_validation_the_best_is_the_last(tmp_path, state):
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        checkpoints.save(_at(state, 1))
        checkpoints.save(_at(state, 2))
        assert int(checkpoints.restore_best(state).step) == 2


def test_same_step_twice_is_saved_once(tmp_path, state):
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        checkpoints.save(_at(state, 1), 0.5)
        checkpoints.save(_at(state, 1), 0.5)
    assert len(_folders(tmp_path)) == 1


def test_another_configuration_is_refused_and_the_fields_are_listed(tmp_path):
    with Checkpoints(tmp_path, _CONFIG):
        pass
    method = dataclasses.replace(_CONFIG.method, model=dataclasses.replace(_CONFIG.method.model, regions=3))
    other = dataclasses.replace(_CONFIG, learning_rate=5e-4, method=method, pairs=PairConfig(points=17))
    with pytest.raises(ValueError, match="another configuration") as caught:
        Checkpoints(tmp_path, other)
    message = str(caught.value)
    regions = "method.model.regions: 2 there, 3 now"
    for said in ("learning_rate: 0.001 there, 0.0005 now", regions, "pairs.points: 16 there"):
        assert said in message
    assert "model.width" not in message


def test_the_configuration_lies_beside_the_checkpoints_as_json(tmp_path):
    with Checkpoints(tmp_path, _CONFIG):
        pass
    assert json.loads((tmp_path / "config.json").read_text())["method"]["model"]["regions"] == 2


def test_a_leftover_temporary_folder_does_not_count(tmp_path, state):
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        checkpoints.save(_at(state, 1), 0.5)
    whole = _folders(tmp_path).pop()
    leftover = tmp_path / "checkpoints" / f"{whole.replace('1', '7')}.orbax-checkpoint-tmp"
    leftover.mkdir()
    (leftover / "half").write_text("written")
    with Checkpoints(tmp_path, _CONFIG) as checkpoints:
        assert int(checkpoints.restore_latest(state).step) == 1


@pytest.fixture(scope="module")
def two_saved(state, tmp_path_factory):
    """The folder of a run with the checkpoints of steps 1 and 2, of which step 1 has the smaller loss."""
    directory = tmp_path_factory.mktemp("run")
    with Checkpoints(directory, _CONFIG) as checkpoints:
        checkpoints.save(_at(state, 1), 0.1)
        checkpoints.save(_at(state, 2), 0.2)
    return directory


@pytest.fixture
def run(two_saved, tmp_path):
    """A copy of ``two_saved``, to be damaged."""
    return Path(shutil.copytree(two_saved, tmp_path / "run"))


def _files(run, step: int, name: str) -> list:
    found = [path for path in (run / "checkpoints" / str(step)).rglob(name) if path.is_file()]
    assert found, f"Orbax names its files otherwise: no {name}"
    return found


def _flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def _cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


# "d" holds the values, in two files: Orbax reads the large one without any check.
_DAMAGES = {
    "flipped values": lambda run, step: [_flip(path) for path in _files(run, step, "d/*")],
    "cut values": lambda run, step: [_cut(path) for path in _files(run, step, "d/*")],
    "no values": lambda run, step: [path.unlink() for path in _files(run, step, "d/*")],
    "flipped index": lambda run, step: [_flip(path) for path in _files(run, step, "manifest.ocdbt")],
    "cut description": lambda run, step: [_cut(path) for path in _files(run, step, "_METADATA")],
    "no state": lambda run, step: shutil.rmtree(run / "checkpoints" / str(step) / "state"),
    "nothing": lambda run, step: [path.unlink() for path in _files(run, step, "*")],
}


@pytest.mark.parametrize("damage", _DAMAGES.values(), ids=_DAMAGES)
def test_damaged_newest_checkpoint_gives_way_to_the_one_before(run, state, damage):
    damage(run, 2)
    with Checkpoints(run, _CONFIG) as checkpoints:
        with pytest.warns(UserWarning, match="training goes on from step 1, because newer checkpoints are damaged"):
            restored = checkpoints.restore_latest(state)
        _assert_same(restored, _at(state, 1))


@pytest.mark.parametrize("damage", ["flipped values", "no state"])
def test_step_of_a_damaged_checkpoint_can_be_saved_again(run, state, damage):
    _DAMAGES[damage](run, 2)
    with Checkpoints(run, _CONFIG) as checkpoints:
        with pytest.warns(UserWarning, match="damaged"):
            checkpoints.restore_latest(state)
        checkpoints.save(_at(state, 2), 0.2)
    with Checkpoints(run, _CONFIG) as checkpoints:
        _assert_same(checkpoints.restore_latest(state), _at(state, 2))


def test_damaged_checkpoint_is_set_aside_not_deleted(run, state):
    _DAMAGES["cut values"](run, 2)
    with Checkpoints(run, _CONFIG) as checkpoints, pytest.warns(UserWarning, match="they are now in .*damaged"):
        checkpoints.restore_latest(state)
    assert (run / "damaged" / "2" / "state").is_dir()


def test_where_no_checkpoint_is_whole_the_folder_is_named_and_nothing_moved(run, state):
    for step in (1, 2):
        _DAMAGES["cut values"](run, step)
    with (
        Checkpoints(run, _CONFIG) as checkpoints,
        pytest.raises(ValueError, match="checkpoints: no checkpoint is whole"),
    ):
        checkpoints.restore_latest(state)
    assert _folders(run) == {"1", "2"}


def test_damaged_best_checkpoint_gives_way_to_the_next_best(run, state):
    _DAMAGES["flipped values"](run, 1)
    with Checkpoints(run, _CONFIG) as checkpoints, pytest.warns(UserWarning, match="that of step 2 is used instead"):
        _assert_same(checkpoints.restore_best(state), _at(state, 2))


def test_without_a_whole_checkpoint_there_is_no_best(run, state):
    for step in (1, 2):
        _DAMAGES["cut values"](run, step)
    with Checkpoints(run, _CONFIG) as checkpoints, pytest.warns(UserWarning, match="no other is whole"):
        assert checkpoints.restore_best(state) is None


def test_values_that_are_readable_but_not_those_saved_are_damage(run, state, monkeypatch):
    """Orbax's own checksums don't cover all that a disk may change."""
    with Checkpoints(run, _CONFIG) as checkpoints:
        load = checkpoints._checkpointer.load

        def changed(step, like):
            found = load(step, like)
            return found | {"step": found["step"] + 1} if step == 2 else found

        monkeypatch.setattr(checkpoints._checkpointer, "load", changed)
        with pytest.warns(UserWarning, match="step 2: its checksum is another"):
            _assert_same(checkpoints.restore_latest(state), _at(state, 1))


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"null", b"\xff", b"[" * 100_000], ids=lambda each: repr(each[:9])
)
def test_damaged_configuration_is_named(run, content):
    (run / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json, which says how .* is damaged"):
        Checkpoints(run, _CONFIG)


def test_missing_configuration_of_saved_checkpoints_is_named(run):
    """What they hold is then unknown, and a new configuration would be taken for theirs."""
    (run / "config.json").unlink()
    with pytest.raises(ValueError, match=r"config\.json, which says how .* is missing"):
        Checkpoints(run, _CONFIG)


def test_second_run_in_a_folder_is_refused_and_the_process_named(tmp_path):
    with (
        Checkpoints(tmp_path, _CONFIG),
        pytest.raises(ValueError, match=f"{tmp_path}: process {os.getpid()} is training"),
    ):
        Checkpoints(tmp_path, _CONFIG)


def test_folder_is_free_after_a_run_that_was_refused(tmp_path):
    with Checkpoints(tmp_path, _CONFIG):
        pass
    with pytest.raises(ValueError, match="another configuration"):
        Checkpoints(tmp_path, dataclasses.replace(_CONFIG, seed=1))
    with Checkpoints(tmp_path, _CONFIG):
        pass


# Saves 16 MB states without end; every leaf of a state holds its step number.
_SAVER = """
    import sys
    import jax.numpy as jnp
    from urrt_jax.training.checkpoints import Checkpoints
    from urrt_jax.training.state import TrainConfig, TrainState

    with Checkpoints(sys.argv[1], TrainConfig()) as checkpoints:
        for step in range(1, 10_000):
            leaf = jnp.full((1024, 1024), step, jnp.float32)
            state = TrainState(jnp.asarray(step, jnp.int32), {"a": leaf, "b": leaf}, {"c": leaf}, (leaf,))
            checkpoints.save(state, 1.0 / step)
            print(step, flush=True)
"""


@pytest.mark.parametrize("wait", [0.0, 0.013, 0.05, 0.21])
def test_a_save_killed_in_the_middle_leaves_whole_checkpoints_only(tmp_path, wait):
    saver = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(_SAVER), str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    try:
        begun = 0
        while begun < 3:
            line = saver.stdout.readline()
            assert line, "the saver ended by itself"
            begun = int(line)
        with pytest.raises(ValueError, match=f"process {saver.pid} is training here"):
            Checkpoints(tmp_path, TrainConfig())
        time.sleep(wait)
    finally:
        os.kill(saver.pid, signal.SIGKILL)
        begun = max([begun, *map(int, saver.stdout.read().split())])
        saver.wait()
        saver.stdout.close()
    leaf = jnp.zeros((1024, 1024))
    like = TrainState(jnp.zeros((), jnp.int32), {"a": leaf, "b": leaf}, {"c": leaf}, (leaf,))
    with Checkpoints(tmp_path, TrainConfig()) as checkpoints:
        restored = checkpoints.restore_latest(like)
        assert restored is not None
        step = int(restored.step)
        # Saves are one behind at most: the next one waits for the one before.
        assert begun - 2 <= step <= begun
        assert all(bool(jnp.all(leaf == step)) for leaf in jax.tree.leaves((restored.variables, restored.opt_state)))
        checkpoints.save(dataclasses.replace(restored, step=jnp.asarray(step + 1, jnp.int32)), 0.0)
    assert not [name for name in _folders(tmp_path) if "tmp" in name]
