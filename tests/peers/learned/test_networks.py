"""Every learned peer, made small, is trained by the training step of this project."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.data.procedural import procedural_shapes
from urrt_jax.peers.learned.weights import NETWORKS
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig, init_state
from urrt_jax.training.step import train_steps

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


@pytest.fixture(scope="module")
def shapes():
    return {"points": jnp.asarray(procedural_shapes(4, points=32).points)}


@pytest.fixture(scope="module", params=NETWORKS)
def training(request, shapes):
    """The states before and after four steps, and the steps' mean metrics."""
    config = TrainConfig(
        method=dataclasses.replace(NETWORKS[request.param], **_SMALL[request.param]),
        pairs=PairConfig(points=32, corrupted=1.0, ramp_share=0.0),
        steps=4,
        steps_per_call=4,
        batch=4,
        warmup=0,
        weight_decay=0.0,  # so that only a derivative can change a weight
    )
    before = jax.device_get(init_state(config))
    after, metrics = train_steps(jax.device_put(before), shapes, config)
    return before, jax.device_get(after), metrics


def _unchanged(before, after):
    """The names of the arrays in which every value is as before."""
    same = jax.tree.map(np.array_equal, before, after)
    return [jax.tree_util.keystr(path) for path, equal in jax.tree_util.tree_leaves_with_path(same) if equal]


def test_loss_is_finite_and_no_step_is_skipped(training):
    _, _, metrics = training
    assert np.isfinite(metrics["loss"])
    assert metrics["skipped"] == 0


def test_every_parameter_is_trained(training):
    before, after, _ = training
    assert _unchanged(before.params, after.params) == []


def test_every_statistic_of_batch_norm_is_updated(training):
    before, after, _ = training
    assert _unchanged(before.batch_stats, after.batch_stats) == []
