"""Samples whose regions are to agree: how they are drawn, and what their agreement rises and falls with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.clouds import Cloud, make_cloud
from urrt_jax.features import moment_invariants
from urrt_jax.model import Model
from urrt_jax.model.partition import inputs_of_parts
from urrt_jax.training.regions import agreement_of_samples, noisy_samples
from urrt_jax.training.trainable import PAIRS


@pytest.fixture
def no_noise(monkeypatch):
    monkeypatch.setattr("urrt_jax.training.regions._NOISE", 0.0)


@pytest.fixture(scope="module")
def clouds(cloud) -> np.ndarray:
    """A batch of two."""
    return np.stack([cloud - cloud.mean(axis=0), 0.5 * cloud[:, ::-1]])


def _agreement(model: Model, clouds: np.ndarray) -> jax.Array:
    """Of a batch of whole clouds (B, N, 3)."""

    def one(points: jax.Array, key: jax.Array) -> jax.Array:
        samples = noisy_samples(key, make_cloud(points), model.config.points)
        octaves = model.config.octaves
        first, second = (inputs_of_parts(model.config, each, moment_invariants(each, octaves)) for each in samples)
        return agreement_of_samples(model, samples, (first, second), 0.1)

    return jax.jit(jax.vmap(one, axis_name=PAIRS))(clouds, jax.random.split(jax.random.key(0), len(clouds)))


def _rows(cloud: Cloud) -> set[tuple]:
    return set(map(tuple, np.asarray(cloud.points)[np.asarray(cloud.mask)].tolist()))


@pytest.mark.parametrize("count", [10, 10_000])
def test_samples_share_no_point(cloud, count, no_noise):
    whole = make_cloud(cloud)
    first, second = noisy_samples(jax.random.key(0), whole, count)
    assert len(first.mask) == len(second.mask) == min(count, len(cloud) // 2)
    assert not _rows(first) & _rows(second)
    assert _rows(first) | _rows(second) <= _rows(whole)


def test_padding_stays_padding(cloud):
    whole = make_cloud(cloud, np.arange(len(cloud)) < 20)
    samples = noisy_samples(jax.random.key(0), whole, len(cloud))
    assert 18 <= sum(int(each.mask.sum()) for each in samples) <= 20
    assert all(not np.any(each.points[~each.mask]) for each in samples)


def test_each_sample_has_noise_of_its_own_and_both_have_as_much(monkeypatch):
    monkeypatch.setattr("urrt_jax.training.regions._NOISE", 0.01)
    whole = make_cloud(np.tile([[1.0, 2.0, 3.0]], (2_000, 1)))
    noises = [np.asarray(each.points) - [1, 2, 3] for each in noisy_samples(jax.random.key(0), whole, 1_000)]
    first, second = (float(np.std(each)) for each in noises)
    assert first == pytest.approx(second, rel=0.1) and 0 < first < 0.0105
    assert abs(np.corrcoef(noises[0].ravel(), noises[1].ravel())[0, 1]) < 0.1


def test_agreement_rises_along_its_gradient(parts_model, clouds):
    def total(partition):
        model = Model(parts_model.config, parts_model.params | {"partition": partition})
        return jnp.mean(_agreement(model, clouds))

    partition = parts_model.params["partition"]
    before, gradient = jax.value_and_grad(total)(partition)
    length = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    after = total(jax.tree.map(lambda leaf, step: leaf + 0.01 * step / length, partition, gradient))
    assert float(after - before) == pytest.approx(0.01 * float(length), rel=0.2)


def test_one_region_for_all_points_has_no_agreement(parts_model, clouds):
    last = parts_model.params["partition"]["Dense_3"]
    partition = parts_model.params["partition"] | {"Dense_3": last | {"bias": last["bias"].at[0].add(100.0)}}
    collapsed = Model(parts_model.config, parts_model.params | {"partition": partition})
    assert float(jnp.max(_agreement(collapsed, clouds))) < 0.001
    assert float(jnp.min(_agreement(parts_model, clouds))) > 0.005


def test_agreement_does_not_depend_on_the_pose(parts_model, clouds, pose, no_noise):
    """Without noise, which has directions of its own."""
    still, turned = (_agreement(parts_model, clouds @ turn.T) for turn in (np.eye(3, dtype=np.float32), pose[0]))
    np.testing.assert_allclose(turned, still, atol=1e-4)
