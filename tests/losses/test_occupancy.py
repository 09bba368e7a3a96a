"""The occupancy loss by hand, and what a shell calls inside."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from urrt_jax.clouds import make_cloud
from urrt_jax.losses import occupancy_loss, shell_samples

# One number of queries, so that the sampler is compiled once.
_COUNT = 2000
_samples = jax.jit(functools.partial(shell_samples, count=_COUNT))
_LOGITS = np.array([0.0, 2.0, -1.0], np.float32)
_INSIDE = np.array([True, True, False])


def test_occupancy_loss_by_hand():
    expected = np.mean([np.log(2), np.log1p(np.exp(-2)), np.log1p(np.exp(-1))])
    assert float(occupancy_loss(jnp.asarray(_LOGITS), jnp.asarray(_INSIDE))) == pytest.approx(expected, rel=1e-6)


def test_occupancy_loss_counts_only_masked_in_queries():
    mask = jnp.array([True, False, False])
    assert float(occupancy_loss(jnp.asarray(_LOGITS), jnp.asarray(_INSIDE), mask)) == pytest.approx(np.log(2), rel=1e-6)


def test_occupancy_loss_without_queries_is_zero():
    assert float(occupancy_loss(jnp.asarray(_LOGITS), jnp.asarray(_INSIDE), jnp.zeros(3, bool))) == 0


def test_occupancy_loss_and_gradient_are_finite_for_extreme_logits():
    logits = jnp.array([1e4, -1e4, 1e4, -1e4])
    inside = jnp.array([True, True, False, False])
    value, gradient = jax.value_and_grad(occupancy_loss)(logits, inside)
    assert float(value) == pytest.approx(5000)
    np.testing.assert_allclose(gradient, [0, -0.25, 0.25, 0], atol=1e-6)


@pytest.fixture(scope="module", params=[0.5, 1.0, 2.0])
def samples(request, cloud):
    thickness = request.param
    queries, inside = _samples(jax.random.key(0), make_cloud(cloud), thickness=thickness)
    return thickness, np.asarray(queries), np.asarray(inside)


def test_shell_samples_give_both_answers_often(cloud):
    _, inside = _samples(jax.random.key(0), make_cloud(cloud), thickness=1.0)
    assert 0.1 < float(inside.mean()) < 0.9


def test_shell_is_where_the_nearest_point_is_close(samples, cloud):
    thickness, queries, inside = samples
    tree = cKDTree(cloud)
    apart = tree.query(cloud, k=2)[0][:, 1]
    spacing = np.sqrt(np.mean(np.minimum(apart, 3 * np.sort(apart)[len(apart) // 2]) ** 2))
    distance = tree.query(queries)[0]
    clear = np.abs(distance - thickness * spacing) > 1e-5
    np.testing.assert_array_equal(inside[clear], (distance < thickness * spacing)[clear])


def test_shell_samples_are_unchanged_by_the_value_of_padding(cloud):
    mask = np.arange(200) < 120

    def draw(value):
        padded = np.where(mask[:, None], cloud, np.float32(value))
        return _samples(jax.random.key(1), make_cloud(padded, mask), thickness=1.0)

    for one, other in zip(draw(0.0), draw(77.0), strict=True):
        np.testing.assert_array_equal(one, other)


def test_shell_samples_never_lie_about_padding():
    """Padding is stored at the origin, so a cloud far from it shows whether padding was drawn from."""
    rng = np.random.default_rng(0)
    points = (0.1 * rng.normal(size=(200, 3)) + [5, 0, 0]).astype(np.float32)
    queries, _ = _samples(jax.random.key(2), make_cloud(points, np.arange(200) < 40), thickness=1.0)
    assert float(jnp.min(queries[: _COUNT // 2, 0])) > 3


def test_shell_samples_of_another_key_differ(cloud):
    first, second = (_samples(jax.random.key(seed), make_cloud(cloud), thickness=1.0)[0] for seed in (0, 1))
    assert not np.any(np.all(np.asarray(first) == np.asarray(second), axis=1))


def test_shell_samples_have_no_derivative_through_the_labels(cloud):
    total = jax.jit(jax.grad(lambda p: jnp.mean(_samples(jax.random.key(0), make_cloud(p), thickness=1.0)[0])))
    gradient = total(jnp.asarray(cloud))
    assert bool(jnp.all(jnp.isfinite(gradient)))


def test_shell_samples_of_an_empty_cloud_are_finite(cloud):
    queries, inside = _samples(jax.random.key(0), make_cloud(cloud, np.zeros(200, bool)), thickness=1.0)
    assert bool(jnp.all(jnp.isfinite(queries)))
    assert not bool(jnp.any(inside))
