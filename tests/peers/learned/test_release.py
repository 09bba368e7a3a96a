"""Released arrays become the variables of our layers, and arrays that do not fit are named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.peers.learned import release
from urrt_jax.peers.learned.layers import Layer


def _arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"conv.weight": (4, 3, 1, 1), "conv.bias": (4,), "bn.weight": (4,), "bn.bias": (4,)}
    shapes |= {"bn.running_mean": (4,), "bn.running_var": (4,)}
    return {name: rng.uniform(0.5, 1.5, shape).astype(np.float32) for name, shape in shapes.items()}


def test_a_layer_computes_the_convolution_and_the_batch_norm_of_its_arrays():
    arrays = _arrays()
    params, stats = release.layer(arrays, "conv", "bn", (3, 4), bias=True)
    points = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
    variables = {"params": params, "batch_stats": stats}
    ours = Layer(4, bias=True).apply(variables, jnp.asarray(points), jnp.ones(5, bool), False)
    linear = points @ arrays["conv.weight"][:, :, 0, 0].T + arrays["conv.bias"]
    scale = arrays["bn.weight"] / np.sqrt(arrays["bn.running_var"] + 1e-5)
    expected = np.maximum((linear - arrays["bn.running_mean"]) * scale + arrays["bn.bias"], 0)
    np.testing.assert_allclose(ours, expected, atol=1e-5)


@pytest.mark.parametrize("bias", [False, True])
def test_variables_have_the_tree_that_a_layer_initialises(bias):
    params, stats = release.layer(_arrays(), "conv", "bn", (3, 4), bias=bias)
    fresh = Layer(4, bias=bias).init(jax.random.key(0), jnp.zeros((5, 3)), jnp.ones(5, bool), False)
    assert jax.tree.map(jnp.shape, {"params": params, "batch_stats": stats}) == jax.tree.map(jnp.shape, dict(fresh))


@pytest.mark.parametrize("name", ["conv.weight", "conv.bias", "bn.weight", "bn.bias", "bn.running_mean"])
def test_a_missing_array_is_named(name):
    arrays = _arrays()
    del arrays[name]
    with pytest.raises(ValueError, match=f"lack the array '{name}'"):
        release.layer(arrays, "conv", "bn", (3, 4), bias=True)


@pytest.mark.parametrize("shape", [(4, 3, 1, 2), (3, 4, 1, 1), (4,), (4, 3, 3), ()])
def test_an_array_of_another_shape_is_named(shape):
    arrays = _arrays() | {"conv.weight": np.zeros(shape, np.float32)}
    with pytest.raises(ValueError, match=r"'conv.weight': expected shape \(4, 3\)"):
        release.layer(arrays, "conv", "bn", (3, 4))


def test_subnormal_numbers_become_zero():
    tiny = np.finfo(np.float32).tiny
    values = release.array({"a": np.array([tiny / 2, -tiny / 2, tiny, -1.0], np.float32)}, "a", (4,))
    assert values.tolist() == [0.0, 0.0, float(tiny), -1.0]
