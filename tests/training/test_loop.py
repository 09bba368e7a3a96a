"""The training loop: it learns, it can be stopped and resumed without a trace, and it says when it cannot go on."""

import dataclasses
import json
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from urrt_jax import ModelConfig
from urrt_jax.data import Shapes
from urrt_jax.training import loop as loop_module
from urrt_jax.training.checkpoints import Checkpoints
from urrt_jax.training.loop import Log, LoopConfig, train
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig, begin_with, init_state
from urrt_jax.training.step import train_steps
from urrt_jax.training.urrt import URRT
from urrt_jax.training.validation import validate, validation_pairs

_METHOD = URRT(
    model=ModelConfig(
        regions=2,
        width=8,
        encoder_widths=(8,),
        branch_width=4,
        position_widths=(4,),
        decoder_widths=(8,),
        sharpness=1.0,
        octaves=2,
        lookups=8,
        consensus=0,
        steps=1,
        points=32,
    ),
    loss_points=32,
    occupancy_queries=16,
)
_CONFIG = TrainConfig(
    method=_METHOD,
    pairs=PairConfig(points=32, corrupted=0.5, clean_share=0.0, ramp_share=0.5),
    batch=4,
    steps=10,
    warmup=2,
)
_init = jax.jit(init_state, static_argnums=0)
_LOOP = LoopConfig(every=5, log_every=1, validation_pairs=4, progress=False)


def _mesh():
    """The mesh that ``train`` makes: under it a step of the same configuration is compiled once for all tests."""
    return jax.make_mesh((jax.device_count(),), ("data",), axis_types=(AxisType.Auto,))


def _with(**changes) -> TrainConfig:
    """The configuration with these changes of the method."""
    return dataclasses.replace(_CONFIG, method=dataclasses.replace(_METHOD, **changes))


def _everywhere(tree):
    return jax.device_put(tree, NamedSharding(_mesh(), PartitionSpec()))


def _fresh(config):
    return _everywhere(_init(config))


def _step(state, arrays, config):
    with jax.set_mesh(_mesh()):
        return train_steps(state, arrays, config)


@pytest.fixture(scope="module")
def shapes(make_cloud_points) -> Shapes:
    points = np.stack([make_cloud_points(seed)[:100] / 1.5 for seed in range(4)]).astype(np.float32)
    return Shapes(points=points, labels=np.zeros(4, np.int32), names=tuple("abcd"), classes=("made up",))


def _lines(directory, kind=None) -> list[dict]:
    lines = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if kind in (None, line["kind"])]


def _last_state(directory, config):
    with Checkpoints(directory, config) as checkpoints:
        return checkpoints.restore_latest(_fresh(config))


@pytest.fixture(scope="module")
def unbroken(shapes, tmp_path_factory):
    """A run of ten steps: its folder, its variables and its last state."""
    directory = tmp_path_factory.mktemp("unbroken")
    variables = train(_CONFIG, shapes, shapes, directory, loop=_LOOP)
    return directory, variables, _last_state(directory, _CONFIG)


def _interrupted(at: int):
    """``train_steps`` during whose step ``at`` Ctrl-C arrives."""

    def steps(state, arrays, config):
        state, metrics = train_steps(state, arrays, config)
        if int(state.step) == at:
            signal.raise_signal(signal.SIGINT)
        return state, metrics

    return steps


@pytest.fixture(scope="module")
def resumed(shapes, tmp_path_factory):
    """The same run, interrupted after step 7 and started again."""
    directory = tmp_path_factory.mktemp("resumed")
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(loop_module, "train_steps", _interrupted(7))
        train(_CONFIG, shapes, shapes, directory, loop=_LOOP)
    stopped = int(_last_state(directory, _CONFIG).step)
    variables = train(_CONFIG, shapes, shapes, directory, loop=_LOOP)
    return directory, variables, _last_state(directory, _CONFIG), stopped


def test_interrupted_run_saves_the_step_it_had_reached(resumed):
    assert resumed[3] == 7


def test_resumed_run_ends_bit_equal_to_an_unbroken_one(resumed, unbroken):
    jax.tree.map(np.testing.assert_array_equal, resumed[2], unbroken[2])


def test_resumed_run_logs_the_same_losses(resumed, unbroken):
    first, second = ([(x["step"], x["loss"]) for x in _lines(run[0], "train")] for run in (unbroken, resumed))
    assert second == first
    assert len(first) == 10


def test_resumed_run_logs_the_same_validations(resumed, unbroken):
    first, second = (_lines(run[0], "validation") for run in (unbroken, resumed))
    assert first == second
    assert [line["step"] for line in first] == [5, 10]


def test_finished_run_started_again_changes_nothing(shapes, unbroken):
    directory, variables, _ = unbroken
    before = (directory / "metrics.jsonl").read_text()
    again = train(_CONFIG, shapes, shapes, directory, loop=_LOOP)
    jax.tree.map(np.testing.assert_array_equal, again, variables)
    assert (directory / "metrics.jsonl").read_text() == before


def test_another_configuration_in_the_folder_is_refused(shapes, unbroken):
    with pytest.raises(ValueError, match="batch: 4 there, 5 now"):
        train(dataclasses.replace(_CONFIG, batch=5), shapes, shapes, unbroken[0], loop=_LOOP)


def _params(seed, **changes):
    return _init(dataclasses.replace(_with(**changes), seed=seed)).params


def test_run_begins_with_the_parameters_it_is_given(shapes, tmp_path):
    config = dataclasses.replace(_CONFIG, steps=5, learning_rate=1e-12, weight_decay=0.0)
    found = train(config, shapes, shapes, tmp_path, start=_params(3), loop=_LOOP)["params"]
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-9), found, _params(3))


def test_run_with_another_start_is_refused(shapes, tmp_path):
    config = dataclasses.replace(_CONFIG, steps=5)
    train(config, shapes, shapes, tmp_path, start=_params(3), loop=_LOOP)
    with pytest.raises(ValueError, match=r"data\.start"):
        train(config, shapes, shapes, tmp_path, start=_params(4), loop=_LOOP)
    with pytest.raises(ValueError, match=r"data\.start"):
        train(config, shapes, shapes, tmp_path, loop=_LOOP)


def test_parameters_of_other_names_or_shapes_stay_as_they_are():
    parts = dataclasses.replace(_METHOD.model, partition="parts")
    state, given = _init(_CONFIG), _params(3, model=parts)
    begun = begin_with(state, given).params
    jax.tree.map(np.testing.assert_array_equal, begun["partition"], state.params["partition"])
    jax.tree.map(np.testing.assert_array_equal, begun["encoder"], given["encoder"])


def test_parameters_of_which_none_fits_are_refused():
    with pytest.raises(ValueError, match="start: none"):
        begin_with(_init(_CONFIG), {"encoder": {"kernel": jnp.zeros((3, 3))}})


@pytest.fixture(scope="module")
def arrays(shapes):
    return _everywhere({"points": jnp.asarray(shapes.points)})


def test_steps_per_call_do_not_change_the_parameters(arrays):
    five = dataclasses.replace(_CONFIG, steps_per_call=5)
    together, _ = _step(_fresh(five), arrays, five)
    alone = _fresh(_CONFIG)
    for _ in range(5):
        alone, _ = _step(alone, arrays, _CONFIG)
    assert int(together.step) == int(alone.step) == 5
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), together.params, alone.params)


def test_training_does_no_more_than_it_is_asked_for(arrays):
    """A network that does more in use learns as one does that never does more."""
    few = _with(model=dataclasses.replace(_METHOD.model, steps=1, consensus=0))
    more = dataclasses.replace(_METHOD.model, steps=3, lookups=16, consensus=8)
    many = _with(model=more, unrolled=1, lookups=8, rounds=0)
    first, _ = _step(_fresh(few), arrays, few)
    second, _ = _step(_fresh(many), arrays, many)
    jax.tree.map(np.testing.assert_array_equal, first.params, second.params)


def test_validation_runs_the_steps_that_use_runs(arrays):
    """However few of them are trained."""
    model = dataclasses.replace(_METHOD.model, steps=3)
    config = _with(model=model, unrolled=1)
    variables, pairs = _fresh(config).variables, validation_pairs(config, arrays, 4)
    found = validate(variables, pairs, config)
    assert found == validate(variables, pairs, _with(model=model, unrolled=3))
    one_step = _with(model=dataclasses.replace(model, steps=1), unrolled=1)
    assert found["clean_loss"] != validate(variables, pairs, one_step)["clean_loss"]


def test_a_step_changes_the_parameters(arrays):
    state = _fresh(_CONFIG)
    before = jax.device_get(state.params)
    for _ in range(2):
        state, _ = _step(state, arrays, _CONFIG)
    assert any(
        np.any(a != np.asarray(b)) for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(state.params), strict=True)
    )


def test_loss_falls(arrays):
    config = dataclasses.replace(
        _CONFIG, steps=200, batch=8, learning_rate=5e-3, pairs=dataclasses.replace(_CONFIG.pairs, corrupted=0.0)
    )
    state, losses = _fresh(config), []
    for _ in range(200):
        state, metrics = _step(state, arrays, config)
        losses.append(float(metrics["loss"]))
    assert np.mean(losses[-20:]) < 0.93 * np.mean(losses[:20])


def _with_skips(at):
    """``train_steps`` whose steps ``at`` report that their gradient was not finite."""

    def steps(state, arrays, config):
        state, metrics = train_steps(state, arrays, config)
        return state, metrics | {"skipped": jnp.float32(int(state.step) in at)}

    return steps


def test_gradients_that_are_never_finite_raise(shapes, tmp_path, monkeypatch):
    monkeypatch.setattr(loop_module, "train_steps", _with_skips(range(1, 11)))
    with pytest.raises(FloatingPointError, match="every gradient up to step 5 was not finite"):
        train(_CONFIG, shapes, shapes, tmp_path, loop=dataclasses.replace(_LOOP, log_every=5))


def test_one_skipped_step_does_not_end_the_run(shapes, tmp_path, monkeypatch):
    """Only "a whole interval of steps" does; here it is one step, the one that happens to be logged."""
    monkeypatch.setattr(loop_module, "train_steps", _with_skips({5}))
    train(_CONFIG, shapes, shapes, tmp_path, loop=dataclasses.replace(_LOOP, log_every=5))
    assert int(_last_state(tmp_path, _CONFIG).step) == 10


def test_step_with_a_gradient_that_is_not_finite_changes_only_the_step_number(arrays):
    state = _fresh(_CONFIG)
    state = dataclasses.replace(state, params=jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e30), state.params))
    before = jax.device_get((state.params, state.opt_state))
    state, metrics = _step(state, arrays, _CONFIG)
    assert float(metrics["skipped"]) == 1
    assert int(state.step) == 1
    jax.tree.map(np.testing.assert_array_equal, before, (state.params, state.opt_state))


def test_log_drops_lines_of_a_run_that_was_killed_later(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = Log(path, 0)
    for step in (1, 2, 3, 4):
        log.write("train", step, {"loss": 1.0 / step})
    Log(path, 2)
    assert [line["step"] for line in _lines(tmp_path)] == [1, 2]


def test_log_drops_a_line_that_was_cut_short(tmp_path):
    path = tmp_path / "metrics.jsonl"
    log = Log(path, 0)
    log.write("train", 1, {"loss": 1.0})
    with path.open("a") as file:
        file.write('{"kind": "train", "st')
    Log(path, 5).write("train", 2, {"loss": 0.5})
    assert [line["step"] for line in _lines(tmp_path)] == [1, 2]


@pytest.mark.parametrize(
    "line",
    [
        b"no JSON",
        b"\xff\xfe",
        b"7",
        b"null",
        b'["train", 1]',
        b"{}",
        b'{"kind": "train"}',
        b'{"step": 1}',
        b'{"kind": "train", "step": "1"}',
        b'{"kind": "train", "step": null}',
        b'{"kind": ["train"], "step": 1}',
        b'{"kind": "validation", "step": 1}',
        b'{"kind": "validation", "step": 1, "validation_loss": "low"}',
        b"[" * 100_000,
    ],
    ids=lambda line: repr(line[:60]),
)
def test_log_drops_a_foreign_line_and_says_so(tmp_path, line):
    path = tmp_path / "metrics.jsonl"
    Log(path, 0).write("train", 1, {"loss": 1.0})
    path.write_bytes(line + b"\n" + path.read_bytes())
    with pytest.warns(UserWarning, match=r"metrics\.jsonl: 1 lines that are no entries .* the first is line 1$"):
        Log(path, 5).write("train", 2, {"loss": 0.5})
    assert [entry["step"] for entry in _lines(tmp_path)] == [1, 2]


@pytest.mark.parametrize(
    ("losses", "patience", "stalled"),
    [
        pytest.param([], 2, False, id="nothing yet"),
        pytest.param([1.0, 1.1, 1.2], 2, True, id="no better for two"),
        pytest.param([1.0, 1.1], 2, False, id="no better for one"),
        pytest.param([1.0, 1.1, 0.9], 2, False, id="better at last"),
        pytest.param([0.5, 1.0, 0.9], 2, True, id="falling, but not below the best"),
        pytest.param([1.0, 1.0, 1.0, 1.0], 0, False, id="never"),
    ],
)
def test_log_knows_whether_validation_has_stalled(tmp_path, losses, patience, stalled):
    log = Log(tmp_path / "metrics.jsonl", 0)
    for step, loss in enumerate(losses):
        log.write("validation", step, {"validation_loss": loss})
    assert log.stalled(patience) is stalled
    assert Log(tmp_path / "metrics.jsonl", 100).stalled(patience) is stalled


def test_run_stops_early_and_returns_the_best_variables(shapes, tmp_path, monkeypatch):
    losses = iter([0.5, 0.3, 0.4, 0.6, 0.1])
    seen = []

    def worsening(variables, pairs, config):
        seen.append(jax.device_get(variables))
        return {"validation_loss": next(losses)}

    monkeypatch.setattr(loop_module, "validate", worsening)
    loop = dataclasses.replace(_LOOP, every=2, log_every=2, patience=2)
    best = train(_CONFIG, shapes, shapes, tmp_path, loop=loop)
    assert [line["step"] for line in _lines(tmp_path, "validation")] == [2, 4, 6, 8]
    jax.tree.map(np.testing.assert_array_equal, best, seen[1])


@pytest.mark.parametrize("name", ["every", "log_every"])
def test_interval_that_does_not_fit_the_steps_per_call_is_named(shapes, tmp_path, name):
    config = dataclasses.replace(_CONFIG, steps_per_call=5)
    loop = LoopConfig(**({"every": 5, "log_every": 5, "progress": False} | {name: 7}))
    with pytest.raises(ValueError, match=f"^{name}: 7 is no multiple of steps_per_call, 5"):
        train(config, shapes, shapes, tmp_path, loop=loop)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"steps": 0}, "^steps: .*0"),
        ({"batch": 0}, "^batch: .*0"),
        ({"learning_rate": 0.0}, "^learning_rate: .*0.0"),
        ({"clip": float("nan")}, "^clip: .*nan"),
        ({"warmup": -1}, "^warmup: .*-1"),
        ({"steps": 10, "steps_per_call": 3}, "^steps_per_call: 3 does not divide steps, 10"),
        ({"method": URRT(loss_points=2000)}, "^loss_points: 2000 exceeds"),
    ],
)
def test_train_config_refuses_and_names_the_field(fields, says):
    with pytest.raises(ValueError, match=says):
        TrainConfig(**fields)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"unrolled": 0}, "^unrolled: .*0"),
        ({"rounds": -1}, "^rounds: .*-1"),
        ({"lookups": -1}, "^lookups: .*-1"),
        ({"chamfer_scale": 0.0}, "^chamfer_scale: .*0.0"),
        ({"occupancy_weight": -0.1}, "^occupancy_weight: .*-0.1"),
        ({"agreement_weight": -0.1}, "^agreement_weight: .*-0.1"),
    ],
)
def test_our_method_refuses_and_names_the_field(fields, says):
    with pytest.raises(ValueError, match=says):
        URRT(**fields)
