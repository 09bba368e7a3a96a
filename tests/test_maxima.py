"""Maxima: padding, ties, the derivative of one row in both modes, and what an evaluation computes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.maxima import masked_max, maximum


@pytest.mark.parametrize("axis", [0, 1])
def test_masked_max_ignores_padding_and_derives_to_one_row(axis):
    features = jnp.array([[[1.0, 5.0], [3.0, 5.0]], [[9.0, 0.0], [2.0, 5.0]]])
    mask = jnp.array([[True, True], [False, True]])
    found, pull = jax.vjp(lambda features: masked_max(features, mask, axis), features)
    expected = {0: [[1.0, 5.0], [3.0, 5.0]], 1: [[3.0, 5.0], [2.0, 5.0]]}[axis]
    np.testing.assert_array_equal(found, expected)
    (gradient,) = pull(jnp.ones_like(found))
    assert not gradient[1, 0].any()
    np.testing.assert_array_equal(jnp.sum(gradient, axis=axis), jnp.ones((2, 2)))
    assert set(np.unique(gradient)) == {0.0, 1.0}


def test_masked_max_has_derivatives_in_both_modes(x64):
    features = jax.random.normal(jax.random.key(0), (6, 5, 4))
    mask = jax.random.uniform(jax.random.key(1), (6, 5)) > 1 / 3

    def total(features):
        return jnp.sum(jnp.sin(masked_max(features, mask, 1)))

    _, forward = jax.jvp(total, (features,), (weights := jnp.cos(features),))
    np.testing.assert_allclose(forward, jnp.sum(jax.grad(total)(features) * weights), rtol=1e-9)


def test_evaluation_seeks_no_place_of_the_maximum():
    """On a CPU it takes several times as long to find as the maximum does, and only derivatives need it."""
    program = jax.jit(masked_max).lower(jnp.ones((64, 8)), jnp.ones(64, bool)).compile().as_text()
    assert "s32[64" not in program
    place = jax.jit(jax.grad(lambda features: jnp.sum(masked_max(features, jnp.ones(64, bool)))))
    assert "s32[64" in place.lower(jnp.ones((64, 8))).compile().as_text()


def test_of_equal_rows_the_first_gets_the_derivative():
    gradient = jax.grad(lambda row: maximum(row, -1))(jnp.array([1.0, 4.0, 4.0]))
    np.testing.assert_array_equal(gradient, [0.0, 1.0, 0.0])


def test_no_real_row_has_no_maximum_and_no_derivative():
    found, pull = jax.vjp(lambda features: masked_max(features, jnp.zeros(3, bool)), jnp.ones((3, 2)))
    np.testing.assert_array_equal(found, -np.inf)
    np.testing.assert_array_equal(pull(jnp.ones(2))[0], 0.0)
