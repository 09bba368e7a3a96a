"""Sinkhorn with slack: matches are shares, padding has none, and it agrees with the plain loop over entries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.peers.learned.sinkhorn import sinkhorn

_SOURCE, _TARGET = np.arange(9) < 7, np.arange(8) < 5
_sinkhorn = jax.jit(sinkhorn, static_argnums=3)


def _logits(scale=1.0):
    return scale * np.random.default_rng(0).normal(size=(9, 8)).astype(np.float32)


def _matches(scale=1.0, steps=5):
    return np.asarray(_sinkhorn(_logits(scale), _SOURCE, _TARGET, steps), np.float64)


def test_agrees_with_the_plain_loop():
    matches = np.ones((8, 6))
    matches[:7, :5] = np.exp(_logits().astype(np.float64)[:7, :5])
    for _ in range(5):
        for row in range(7):
            matches[row] /= matches[row].sum()
        for column in range(5):
            matches[:, column] /= matches[:, column].sum()
    np.testing.assert_allclose(_matches()[:7, :5], matches[:7, :5], rtol=2e-5)


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0, 1e4])
def test_columns_of_matches_add_to_at_most_one(scale):
    assert _matches(scale).sum(axis=0).max() <= 1 + 1e-5


def test_rows_of_matches_add_to_at_most_one_in_the_end():
    assert _matches(3.0, steps=30).sum(axis=1).max() <= 1 + 1e-4


def test_clear_matches_are_found_and_an_outlier_has_none():
    logits = jnp.full((3, 3), -20.0).at[0, 1].set(20.0).at[1, 0].set(20.0)
    every = jnp.ones(3, bool)
    expected = np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    # The slack row keeps a share of 1 / (steps + 1).
    np.testing.assert_allclose(_sinkhorn(logits, every, every, 30), expected, atol=0.04)


def test_padding_has_no_match():
    matches = _matches()
    assert not matches[~_SOURCE].any()
    assert not matches[:, ~_TARGET].any()


def test_padding_changes_no_match_of_real_points():
    every = np.ones(9, bool)
    bare = _sinkhorn(_logits()[:7, :5], every[:7], every[:5], 5)
    np.testing.assert_allclose(_matches()[:7, :5], bare, rtol=1e-6)


@pytest.mark.parametrize("scale", [1e4, 1e30])
def test_huge_logits_give_finite_matches(scale):
    matches = _matches(scale)
    assert np.isfinite(matches).all()
    assert matches.max() > 0.1


@jax.jit
def _total(logits):
    return jnp.sum(jnp.sin(3 * sinkhorn(logits, _SOURCE, _TARGET, 5)))


_slope = jax.jit(jax.grad(_total))


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_derivatives_are_finite(scale):
    assert np.isfinite(_slope(_logits(scale))).all()


def test_derivative_agrees_with_finite_differences_along_a_direction(x64):
    logits = jnp.asarray(_logits(), x64)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=(9, 8)), x64)
    step = 1e-5
    expected = (_total(logits + step * direction) - _total(logits - step * direction)) / (2 * step)
    np.testing.assert_allclose(jnp.sum(_slope(logits) * direction), expected, rtol=1e-7)
