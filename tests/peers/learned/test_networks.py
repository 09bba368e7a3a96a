"""Every learned peer, made small, is trained by the training step of this project."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.data.procedural import procedural_shapes
from urrt_jax.peers.learned.network import estimate_batch
from urrt_jax.peers.learned.weights import NETWORKS
from urrt_jax.training.pairs import PairConfig, make_batch
from urrt_jax.training.state import TrainConfig, init_state
from urrt_jax.training.step import train_step

_DCP = dict(widths=(8,), width=8, neighbors=4, heads=2, hidden=8)
_SMALL = {
    "dcp_v1": _DCP,
    "dcp_v2": _DCP,
    "prnet": _DCP | dict(temperature_width=8, passes=1),
    "rpmnet": dict(
        widths=(8,), head_widths=(8, 8), annealing_widths=(8, 8), annealing_head_widths=(8,), groups=2, neighbors=8
    ),
    "deepgmr": dict(local_widths=(8,), global_widths=(8,), head_widths=(8,), components=4, neighbors=4),
    "pointnetlk": dict(widths=(8,), iterations=2),
    "pointnetlk_revisited": dict(widths=(8,), iterations=2),
    "rienet": dict(widths=(8,), width=8, neighbors=4, match_neighbors=4, hidden=2, passes=1, keypoints=8),
}
"""Settings that make every network small: what it has several of, as layers and passes, it has once or twice."""


_PAIRS = PairConfig(points=32, outliers=0.0)


def _batch(spoiled: float):
    """Four pairs, of which this share has noise and crops."""
    shapes = {"points": jnp.asarray(procedural_shapes(4, points=32).points)}
    return jax.jit(make_batch, static_argnums=(2, 3))(jax.random.key(0), shapes, _PAIRS, 4, spoiled)


@pytest.fixture(scope="module")
def spoiled():
    return _batch(1.0)


@pytest.fixture(scope="module", params=NETWORKS)
def network(request):
    return dataclasses.replace(NETWORKS[request.param], **_SMALL[request.param])


@pytest.fixture(scope="module")
def training(network, spoiled):
    """The states before and after sixty steps on one batch and one on spoiled pairs, and the metrics of every step."""
    # PRNet draws its matches: of spoiled pairs its loss falls too unevenly for so few steps.
    clean = network.name == "prnet"
    config = TrainConfig(
        method=network,
        pairs=_PAIRS,
        steps=61,
        learning_rate=3e-3 if clean else 1e-2,
        batch=4,
        warmup=0,
        weight_decay=0.0,  # so that only a derivative can change a weight
    )
    before = jax.device_get(init_state(config))
    state, metrics = jax.device_put(before), []
    for batch in [_batch(0.0) if clean else spoiled] * 60 + [spoiled]:
        state, of_step = train_step(state, batch, config)
        metrics.append(of_step)
    return before, jax.device_get(state), jax.device_get(metrics)


def _unchanged(before, after):
    """The names of the arrays in which every value is as before."""
    same = jax.tree.map(np.array_equal, before, after)
    return [jax.tree_util.keystr(path) for path, equal in jax.tree_util.tree_leaves_with_path(same) if equal]


def test_no_step_is_skipped(training):
    _, _, metrics = training
    assert all(np.isfinite(each["loss"]) and each["skipped"] == 0 for each in metrics)


def test_loss_of_the_batch_falls(network, training):
    if network.name.startswith("pointnetlk"):
        pytest.skip("its loss rises before it falls: see test_pointnetlk.py")
    _, _, metrics = training
    losses = [each["loss"] for each in metrics[:60]]
    assert np.mean(losses[-3:]) < 0.7 * np.mean(losses[:3])


def test_every_parameter_is_trained(training):
    before, after, _ = training
    assert _unchanged(before.params, after.params) == []


def test_every_statistic_of_batch_norm_is_updated(training):
    before, after, _ = training
    assert _unchanged(before.batch_stats, after.batch_stats) == []


def test_a_batch_gives_what_its_pairs_give_alone(network, training, spoiled, x64):
    _, after, _ = training
    variables, clouds = jax.tree.map(
        lambda values: values.astype(x64) if values.dtype == jnp.float32 else values,
        (after.variables, (spoiled.source, spoiled.target)),
    )
    together = estimate_batch(network, variables, *clouds, jax.random.key(0))
    alone = jax.jit(network.estimate)
    for row in range(4):
        pair, expected = jax.tree.map(lambda values, row=row: values[row], (clouds, together))
        found = alone(variables, *pair, jax.random.key(0))
        np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-8)
        np.testing.assert_allclose(found.translation, expected.translation, atol=1e-8)
