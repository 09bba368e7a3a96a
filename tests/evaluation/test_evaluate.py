"""Evaluation in batches gives what single calls give, for every item once."""

import numpy as np
import pytest

from urrt_jax import ICP, register
from urrt_jax.evaluation import PROTOCOLS, evaluate


@pytest.fixture(scope="module")
def clouds():
    points = np.random.default_rng(0).normal(size=(5, 1024, 3)) * [0.5, 0.3, 0.2]
    points[:, :300] = 0.3 * points[:, :300] + [0.4, 0.2, 0.1]
    return points.astype(np.float32)


@pytest.fixture(scope="module")
def evaluation(small_model, clouds):
    return evaluate(small_model, clouds, batch=2, progress=False)


def test_every_item_is_evaluated_once_though_the_last_batch_is_short(evaluation):
    np.testing.assert_array_equal(evaluation.items, np.arange(5))
    assert evaluation.rotations.shape == (5, 3, 3)


def test_batched_results_agree_with_single_calls(evaluation, small_model, clouds):
    trial = PROTOCOLS["dcp"](clouds, 4)
    single = register(trial.source, trial.target, model=small_model)
    np.testing.assert_allclose(evaluation.rotations[4], single.rotation, atol=1e-4)
    np.testing.assert_allclose(evaluation.coarse_rotations[4], single.coarse.rotation, atol=1e-4)


def test_truth_is_the_protocols(evaluation, clouds):
    np.testing.assert_array_equal(evaluation.true_rotations[3], PROTOCOLS["dcp"](clouds, 3).rotation)


def test_chosen_items_keep_their_own_seeds(small_model, clouds):
    some = evaluate(small_model, clouds, items=np.array([3, 1]), refine=ICP(iterations=1), progress=False)
    np.testing.assert_array_equal(some.true_rotations[0], PROTOCOLS["dcp"](clouds, 3).rotation)


def test_summary_tells_network_and_refinement_apart(evaluation):
    summary = evaluation.summary()
    assert summary["network"]["angle_mean"] > summary["refined"]["angle_mean"]
    assert summary["items"] == 5


def test_unknown_protocol_is_named(small_model, clouds):
    with pytest.raises(ValueError, match=r"protocol.*'dcp'.*'nonesuch'"):
        evaluate(small_model, clouds, protocol="nonesuch")


def test_nothing_to_evaluate_is_an_error(small_model, clouds):
    with pytest.raises(ValueError, match="items"):
        evaluate(small_model, clouds[:0])
