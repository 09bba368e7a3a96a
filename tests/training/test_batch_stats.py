"""Training of a method with batch norm: statistics of the whole batch, kept beside the parameters, never by gradient.

The method is as small as such methods can be; of the loop, what depends on the method is tested here, too.
"""

import dataclasses
import json
import signal
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.data import Shapes
from urrt_jax.training import loop as loop_module
from urrt_jax.training.checkpoints import Checkpoints
from urrt_jax.training.loop import LoopConfig, train
from urrt_jax.training.pairs import PairConfig, make_batch
from urrt_jax.training.state import TrainConfig, TrainState, init_state
from urrt_jax.training.step import train_steps, update
from urrt_jax.training.trainable import PAIRS, Trainable


def _offset(source: Cloud, target: Cloud):
    """The vector (3,) between the means of two clouds."""
    return sum(
        sign * jnp.sum(cloud.points, axis=0) / jnp.sum(cloud.mask) for sign, cloud in ((1, target), (-1, source))
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Shift(Trainable):
    """The translation between two clouds' means, less the mean of all pairs, times a gain that is learned."""

    momentum: float = 0.25

    @property
    def name(self):
        return "shift"

    def init(self, key):
        return {"params": {"gain": jax.random.uniform(key, (3,))}, "batch_stats": {"mean": jnp.zeros(3)}}

    def loss(self, variables, pair, key):
        offset, stored = _offset(pair.source, pair.target), variables["batch_stats"]["mean"]
        mean = jax.lax.pmean(offset, PAIRS)
        found = variables["params"]["gain"] * (offset - mean) + 0.01 * jax.random.normal(key, (3,))
        loss = jnp.mean((found - pair.transform.translation) ** 2)
        return loss, {}, {"mean": stored + self.momentum * (mean - stored)}

    def evaluate(self, variables, pair, key):
        mean = variables["batch_stats"]["mean"]
        found = variables["params"]["gain"] * (_offset(pair.source, pair.target) - mean)
        loss = jnp.mean((found - pair.transform.translation) ** 2)
        return loss, rigid.identity()._replace(translation=found)


class Other(Shift):
    """Another method with the same settings."""

    @property
    def name(self):
        return "other"


_CONFIG = TrainConfig(method=Shift(), pairs=PairConfig(points=16, corrupted=0.5), batch=4, steps=10, warmup=2)
_LOOP = LoopConfig(every=5, log_every=1, validation_pairs=4, progress=False)


@pytest.fixture(scope="module")
def shapes(make_cloud_points) -> Shapes:
    points = np.stack([make_cloud_points(seed)[:40] / 1.5 for seed in range(4)]).astype(np.float32)
    return Shapes(points=points, labels=np.zeros(4, np.int32), names=tuple("abcd"), classes=("made up",))


@pytest.fixture(scope="module")
def batch(shapes):
    return make_batch(jax.random.key(7), {"points": jnp.asarray(shapes.points)}, _CONFIG.pairs, 4, 0.5)


_update = jax.jit(update, static_argnames="config")


def _last_state(directory, config=_CONFIG) -> TrainState:
    with Checkpoints(directory, config) as checkpoints:
        return checkpoints.restore_latest(init_state(config))


def _lines(directory, kind) -> list[dict]:
    lines = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["kind"] == kind]


def test_statistics_are_those_of_the_whole_batch(batch):
    state, _ = _update(init_state(_CONFIG), batch, _CONFIG)
    offsets = jax.vmap(_offset)(batch.source, batch.target)
    np.testing.assert_allclose(state.batch_stats["mean"], 0.25 * np.mean(offsets, axis=0), rtol=1e-5, atol=1e-7)


def test_optimiser_knows_the_parameters_alone(batch):
    state = init_state(_CONFIG)
    moments = [leaf for leaf in jax.tree.leaves(state.opt_state) if leaf.shape == (3,)]
    assert len(moments) == 2  # AdamW's two, of the gain


def test_several_steps_a_call_carry_the_statistics_on(shapes):
    arrays, five = {"points": jnp.asarray(shapes.points)}, dataclasses.replace(_CONFIG, steps_per_call=5)
    together, _ = train_steps(init_state(five), arrays, five)
    alone = init_state(_CONFIG)
    for _ in range(5):
        alone, _ = train_steps(alone, arrays, _CONFIG)
    np.testing.assert_allclose(together.batch_stats["mean"], alone.batch_stats["mean"], rtol=1e-5)


def test_step_with_a_gradient_that_is_not_finite_leaves_the_statistics(batch):
    state = init_state(_CONFIG)
    state = dataclasses.replace(state, params={"gain": jnp.full(3, jnp.inf)}, batch_stats={"mean": jnp.arange(3.0)})
    after, metrics = _update(state, batch, _CONFIG)
    assert float(metrics["skipped"]) == 1
    np.testing.assert_array_equal(after.batch_stats["mean"], [0, 1, 2])


def test_validation_uses_the_stored_statistics(shapes):
    arrays = {"points": jnp.asarray(shapes.points)}
    pairs = loop_module.validation_pairs(_CONFIG, arrays, 4)
    variables = init_state(_CONFIG).variables
    moved = variables | {"batch_stats": {"mean": jnp.ones(3)}}
    one, other = (loop_module.validate(each, pairs, _CONFIG)["clean_loss"] for each in (variables, moved))
    assert one != other


@pytest.fixture(scope="module")
def unbroken(shapes, tmp_path_factory):
    """The folder of a run of ten steps, and the variables that it gave."""
    directory = tmp_path_factory.mktemp("unbroken")
    return directory, train(_CONFIG, shapes, shapes, directory, loop=_LOOP)


def _stop_at_seven(shapes, directory) -> None:
    """A run in this folder that Ctrl-C stops after its seventh step."""

    def steps(state, arrays, config):
        state, metrics = train_steps(state, arrays, config)
        if int(state.step) == 7:
            signal.raise_signal(signal.SIGINT)
        return state, metrics

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop_module, "train_steps", steps)
        train(_CONFIG, shapes, shapes, directory, loop=_LOOP)


def test_trained_variables_hold_the_statistics(unbroken):
    assert set(unbroken[1]) == {"params", "batch_stats"}


def test_resumed_run_ends_bit_equal_to_an_unbroken_one(shapes, unbroken, tmp_path):
    _stop_at_seven(shapes, tmp_path)
    assert int(_last_state(tmp_path).step) == 7
    variables = train(_CONFIG, shapes, shapes, tmp_path, loop=_LOOP)
    jax.tree.map(np.testing.assert_array_equal, _last_state(tmp_path), _last_state(unbroken[0]))
    jax.tree.map(np.testing.assert_array_equal, variables, unbroken[1])


def test_folder_of_another_method_is_refused_though_its_settings_are_the_same(shapes, unbroken):
    with pytest.raises(ValueError, match=r"holds a run of the method 'shift', not 'other'$"):
        train(dataclasses.replace(_CONFIG, method=Other()), shapes, shapes, unbroken[0], loop=_LOOP)


def test_folder_of_an_earlier_version_is_refused(tmp_path):
    (tmp_path / "config.json").write_text('{"model": {"regions": 8}, "steps": 10}')
    with pytest.raises(ValueError, match="holds a run of an earlier version of urrt_jax"):
        Checkpoints(tmp_path, _CONFIG)


def test_seconds_go_on_where_a_run_is_resumed(shapes, tmp_path):
    _stop_at_seven(shapes, tmp_path)
    path = tmp_path / "metrics.jsonl"
    before = path.read_text().splitlines()
    assert json.loads(before[-1]) == {"kind": "stop", "step": 7, "seconds": json.loads(before[-1])["seconds"]}
    path.write_text("\n".join([*before[:-1], json.dumps({"kind": "stop", "step": 7, "seconds": 5000.0})]) + "\n")
    train(_CONFIG, shapes, shapes, tmp_path, loop=_LOOP)
    seconds = [line["seconds"] for line in _lines(tmp_path, "train")]
    assert seconds == sorted(seconds)
    assert seconds[6] < 1000 and 5000 <= seconds[7] < 6000


def test_seconds_do_not_count_validations(shapes, tmp_path, monkeypatch):
    times = iter(range(1000))
    clock, late = SimpleNamespace(perf_counter=lambda: float(next(times)) + late[0]), [0.0]

    def slow(variables, pairs, config):
        late[0] += 1e5
        return {"validation_loss": 1.0}

    monkeypatch.setattr(loop_module, "time", clock)
    monkeypatch.setattr(loop_module, "validate", slow)
    train(_CONFIG, shapes, shapes, tmp_path, loop=_LOOP)
    seconds = [line["seconds"] for line in _lines(tmp_path, "train")]
    assert len(seconds) == 10 and seconds[-1] < 100


def test_run_stops_with_a_validation_when_its_minutes_are_over(shapes, tmp_path):
    loop = dataclasses.replace(_LOOP, log_every=3, every=10, minutes=1e-9)
    train(_CONFIG, shapes, shapes, tmp_path, loop=loop)
    stopped = [line["step"] for line in _lines(tmp_path, "validation")]
    assert stopped == [int(_last_state(tmp_path).step)] == [4]  # one step after the line: it was on its way already


def test_run_whose_minutes_were_over_goes_on_with_more(shapes, unbroken, tmp_path):
    train(_CONFIG, shapes, shapes, tmp_path, loop=dataclasses.replace(_LOOP, minutes=1e-9))
    train(_CONFIG, shapes, shapes, tmp_path, loop=_LOOP)
    jax.tree.map(np.testing.assert_array_equal, _last_state(tmp_path), _last_state(unbroken[0]))


def test_run_whose_minutes_are_over_is_not_trained_again(shapes, tmp_path):
    loop = dataclasses.replace(_LOOP, minutes=1e-9)
    train(_CONFIG, shapes, shapes, tmp_path, loop=loop)
    before = (tmp_path / "metrics.jsonl").read_text()
    train(_CONFIG, shapes, shapes, tmp_path, loop=loop)
    assert (tmp_path / "metrics.jsonl").read_text() == before


@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan")])
def test_minutes_that_are_none_are_refused(minutes):
    with pytest.raises(ValueError, match=r"^minutes: "):
        LoopConfig(minutes=minutes)
