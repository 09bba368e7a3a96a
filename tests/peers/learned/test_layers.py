"""Layers of learned peers: normalised features and their derivatives are those of the plain formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.peers.learned.layers import BatchNorm, GroupNorm
from urrt_jax.training.trainable import PAIRS

_EPSILON = 1e-5


@pytest.fixture
def features(x64):
    """Of 3 pairs, 6 points, 5 edges and 4 channels, far from zero."""
    return 5 + 2 * jax.random.normal(jax.random.key(0), (3, 6, 5, 4))


@pytest.fixture
def mask():
    """Of the edges; a third of them is padding."""
    return jax.random.uniform(jax.random.key(1), (3, 6, 5)) > 1 / 3


@pytest.fixture
def weights(x64, mask):
    """What the loss weighs the normalised features by; padding has no part in it."""
    return jnp.where(mask[..., None], jax.random.normal(jax.random.key(2), (*mask.shape, 4)), 0.0)


@pytest.fixture
def params(x64):
    return {"scale": jnp.array([1.0, 2.0, -0.5, 3.0]), "bias": jnp.array([0.0, 1.0, -1.0, 2.0])}


def _normalised(values, mask, axes, params):
    """The formula, through NumPy's way of a masked mean; ``values`` may have its channels in groups."""
    mean = jnp.mean(values, axes, where=mask, keepdims=True)
    variance = jnp.mean((values - mean) ** 2, axes, where=mask, keepdims=True)
    flat = ((values - mean) / jnp.sqrt(variance + _EPSILON)).reshape(*values.shape[:3], -1)
    return flat * params["scale"] + params["bias"]


def _assert_equal_with_derivatives(one, other, *arguments):
    for found, expected in zip(
        jax.tree.leaves(jax.value_and_grad(one, (0, 1))(*arguments)),
        jax.tree.leaves(jax.value_and_grad(other, (0, 1))(*arguments)),
        strict=True,
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_batch_norm_and_its_derivatives_are_those_of_the_formula(features, mask, weights, params):
    stats = {"mean": jnp.zeros(4), "variance": jnp.ones(4)}

    def layer(params, features):
        def one(features, mask):
            variables = {"params": params, "batch_stats": stats}
            return BatchNorm().apply(variables, features, mask, True, mutable=["batch_stats"])[0]

        return jnp.sum(jnp.sin(jax.vmap(one, axis_name=PAIRS)(features, mask)) * weights)

    def formula(params, features):
        return jnp.sum(jnp.sin(_normalised(features, mask[..., None], (0, 1, 2), params)) * weights)

    _assert_equal_with_derivatives(layer, formula, params, features)


def test_group_norm_and_its_derivatives_are_those_of_the_formula(features, mask, weights, params):
    def layer(params, features):
        one = jax.vmap(lambda features, mask: GroupNorm(2).apply({"params": params}, features, mask))
        return jnp.sum(jnp.sin(one(features, mask)) * weights)

    def formula(params, features):
        grouped = features.reshape(3, 6, 5, 2, 2)
        return jnp.sum(jnp.sin(_normalised(grouped, mask[..., None, None], (1, 2, 4), params)) * weights)

    _assert_equal_with_derivatives(layer, formula, params, features)


def test_group_norm_takes_a_mask_without_trailing_axes(features, params):
    whole = jnp.array([True, True, False, True, True, False])
    layer = GroupNorm(2)
    variables = {"params": params}
    few = layer.apply(variables, features[0], whole)
    many = layer.apply(variables, features[0], jnp.broadcast_to(whole[:, None], (6, 5)))
    np.testing.assert_array_equal(few, many)


def test_derivatives_of_batch_norm_reduce_no_rows():
    """On a CPU a sum over many rows is a tree of windows, which takes several times as long as a product."""

    def loss(features):
        def one(features):
            layer, mask = BatchNorm(), jnp.ones(features.shape[:-1], bool)
            variables = layer.init(jax.random.key(0), features, mask, False)
            return layer.apply(variables, features, mask, True, mutable=["batch_stats"])[0]

        return jnp.sum(jnp.square(jax.vmap(one, axis_name=PAIRS)(features)), axis=(0, 3)).mean()

    program = jax.jit(jax.grad(loss)).lower(jnp.ones((4, 512, 20, 8))).compile().as_text()
    assert "reduce-window" not in program
