"""Agreement of regions: bounds, symmetry, what has nothing to tell, and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.losses import region_agreement, region_pairs


def _scores(seed: int, count: int = 200, regions: int = 5, sharp: float = 1.0):
    return jax.nn.softmax(sharp * jax.random.normal(jax.random.key(seed), (count, regions)))


def test_even_regions_that_agree_have_the_most():
    assert float(region_agreement(jnp.eye(8) * 30)) == pytest.approx(np.log(8), abs=1e-3)


def test_one_region_has_nothing_to_tell():
    everything = jax.nn.one_hot(jnp.zeros(100, int), 8)
    assert float(region_agreement(region_pairs(everything, everything, jnp.ones(100)))) == pytest.approx(0, abs=1e-3)


def test_regions_that_know_nothing_of_each_other_have_none():
    shares = jnp.array([0.1, 0.2, 0.3, 0.4])
    assert float(region_agreement(shares[:, None] * shares)) == pytest.approx(0, abs=1e-4)


def test_uneven_regions_that_agree_have_less():
    shares = np.array([0.7, 0.1, 0.1, 0.1])
    uneven = jnp.diag(jnp.asarray(shares))
    assert float(region_agreement(uneven)) == pytest.approx(-np.sum(shares * np.log(shares)), abs=1e-4)
    assert float(region_agreement(uneven)) < float(region_agreement(jnp.eye(4))) - 0.4


def test_no_points_have_none():
    assert float(region_agreement(jnp.zeros((4, 4)))) == pytest.approx(0, abs=1e-6)


def test_agrees_with_the_sum_of_the_definition():
    joint = np.random.default_rng(0).random((5, 5)) + 0.1
    joint = (joint + joint.T) / (2 * joint.sum())
    row, column = joint.sum(axis=1), joint.sum(axis=0)
    expected = sum(joint[i, j] * np.log(joint[i, j] / (row[i] * column[j])) for i in range(5) for j in range(5))
    assert float(region_agreement(jnp.asarray(7 * joint))) == pytest.approx(expected, abs=1e-4)


def test_order_of_the_clouds_does_not_matter():
    source, target, weights = _scores(0), _scores(1), jnp.ones(200)
    there, back = (region_agreement(region_pairs(*pair, weights)) for pair in ((source, target), (target, source)))
    assert float(there) == pytest.approx(float(back), abs=1e-6)


def test_names_of_regions_do_not_matter():
    source, target, weights = _scores(0, sharp=5.0), _scores(0, sharp=5.0), jnp.ones(200)
    order = jnp.array([3, 0, 4, 1, 2])
    first, second = (
        region_agreement(region_pairs(source[:, rows], target[:, rows], weights)) for rows in (jnp.arange(5), order)
    )
    assert float(first) == pytest.approx(float(second), abs=1e-6)


def test_points_without_weight_do_not_count():
    source, target = _scores(0), _scores(1)
    weights = jnp.asarray(np.arange(200) < 120, jnp.float32)
    np.testing.assert_allclose(
        region_pairs(source, target, weights), region_pairs(source[:120], target[:120], jnp.ones(120)), rtol=1e-5
    )


def test_gradient_agrees_with_finite_differences(x64):
    logits = jax.random.normal(jax.random.key(0), (2, 30, 4), jnp.float64)
    along = jax.random.normal(jax.random.key(1), logits.shape, jnp.float64)

    def told(step):
        source, target = jax.nn.softmax(logits + step * along)
        return region_agreement(region_pairs(source, target, jnp.ones(30)))

    difference = (told(1e-5) - told(-1e-5)) / 2e-5
    assert float(jax.grad(told)(0.0)) == pytest.approx(float(difference), rel=1e-6)


def test_gradient_is_finite_for_certain_regions():
    certain = jax.nn.one_hot(jnp.arange(40) % 3, 8)
    gradient = jax.grad(lambda scores: region_agreement(region_pairs(scores, scores, jnp.ones(40))))(certain)
    assert bool(jnp.all(jnp.isfinite(gradient)))
