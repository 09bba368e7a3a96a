"""How sure a pose is: each check follows what was measured, and any of them can veto."""

import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.assessment import Alternatives, Fit, Precision, confidence, measure, odds
from urrt_jax.assessment.confidence import CHECKS, MEASURED
from urrt_jax.rigid import Rigid

_SURE = {"score": 0.95, "significance": 8.0, "spread": 1e-3, "deviation": 0.05, "uncorrected": 0.05}


def _measured(**changes: float) -> jnp.ndarray:
    values = _SURE | changes
    score = values["score"]
    shares = jnp.array([[score**2, score, 1.0]] * 2)  # overlap, tightness and closeness are all the score
    fit = Fit(jnp.zeros(1, int), jnp.zeros(1), jnp.ones(()), shares)
    poses = Rigid(jnp.broadcast_to(jnp.eye(3), (2, 3, 3)), jnp.zeros((2, 3)))
    others = Alternatives(poses, jnp.array([values["significance"], 9.0]))
    covariance = jnp.diag(jnp.array([0, 0, 0, 1, 0, 0]) * jnp.deg2rad(values["deviation"]) ** 2)
    precision = Precision(
        covariance, jnp.deg2rad(values["uncorrected"]), jnp.float32(100), jnp.float32(values["spread"])
    )
    return measure(fit, others, precision)


def test_what_is_measured_comes_in_its_order():
    found = _measured()
    assert found.shape == (len(MEASURED),)
    logarithms = [np.log(_SURE[name] + 1e-3) for name in MEASURED[2:]]
    np.testing.assert_allclose(found, [_SURE["score"], _SURE["significance"], *logarithms], rtol=1e-4)


def test_a_pose_that_nothing_speaks_against_is_sure():
    assert float(confidence(_measured()).total) > 0.9


@pytest.mark.parametrize(
    ("changes", "check"),
    [
        ({"score": 0.3}, "surfaces"),
        ({"significance": -2.0}, "unique"),
        ({"spread": 0.5, "deviation": 40.0, "uncorrected": 20.0}, "determined"),
    ],
)
def test_each_check_can_veto(changes, check):
    found = confidence(_measured(**changes))
    assert float(found.total) < 0.5
    assert min(found._fields, key=lambda name: float(getattr(found, name))) == check


@pytest.mark.parametrize(
    ("name", "less", "more"),
    [
        ("score", 0.6, 0.9),
        ("significance", 0.0, 4.0),
        ("deviation", 20.0, 1.0),
        ("uncorrected", 20.0, 1.0),
        ("spread", 0.6, 0.1),
    ],
)
def test_confidence_grows_with_what_speaks_for_a_pose(name, less, more):
    few, many = (confidence(_measured(**{name: value})).total for value in (less, more))
    assert float(few) < float(many)


def test_confidence_is_the_product_of_three_probabilities():
    found = confidence(_measured(score=0.7, significance=1.0, spread=0.4, deviation=20.0, uncorrected=5.0))
    assert all(0 < float(each) < 1 for each in found)
    assert float(found.total) == pytest.approx(float(found.surfaces * found.unique * found.determined))


def test_checks_name_what_is_measured():
    assert set().union(*CHECKS.values()) == {"bias", *MEASURED}


def test_odds_are_even_where_both_fit_alike_and_turn_when_both_are_swapped():
    found = odds(Alternatives(rigid.identity(), jnp.array([-2.0, 0.0, 2.0, 10.0])))
    assert float(found[1]) == 1
    assert float(found[0] * found[2]) == pytest.approx(1)
    assert float(found[0]) > 1
    assert float(found[3]) == 0  # there is no such pose
