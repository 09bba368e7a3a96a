"""The objective of our own network: what agreement of regions is told, and that no true pose is read."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.model import Model
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair, PairConfig, make_pair
from urrt_jax.training.trainable import PAIRS
from urrt_jax.training.urrt import URRT, agreement_of_samples


@pytest.fixture(scope="module")
def batch(cloud) -> Pair:
    """Two corrupted pairs."""
    keys = jax.random.split(jax.random.key(0), 2)
    return jax.vmap(lambda key: make_pair(key, jnp.asarray(cloud), PairConfig(points=64), 1.0))(keys)


@pytest.fixture(scope="module", params=["places", "parts"])
def model(request, small_model, parts_model) -> Model:
    return {"places": small_model, "parts": parts_model}[request.param]


def _agreement(model: Model, clouds: np.ndarray) -> jax.Array:
    """Of a batch of whole clouds (B, N, 3)."""
    method = URRT(model=model.config)
    one = lambda points, key: agreement_of_samples(method, model, make_cloud(points), key)  # noqa: E731
    return jax.jit(jax.vmap(one, axis_name=PAIRS))(clouds, jax.random.split(jax.random.key(0), len(clouds)))


@pytest.fixture(scope="module")
def clouds(cloud) -> np.ndarray:
    return np.stack([cloud - cloud.mean(axis=0), 0.5 * cloud[:, ::-1]])


def test_agreement_rises_along_its_gradient(parts_model, clouds):
    def total(partition):
        model = Model(parts_model.config, parts_model.params | {"partition": partition})
        return jnp.mean(_agreement(model, clouds))

    partition = parts_model.params["partition"]
    before, gradient = jax.value_and_grad(total)(partition)
    length = jnp.sqrt(sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(gradient)))
    after = total(jax.tree.map(lambda leaf, step: leaf + 0.01 * step / length, partition, gradient))
    assert float(after - before) == pytest.approx(0.01 * float(length), rel=0.2)


def test_loss_is_the_sum_of_its_parts(model, batch):
    method = URRT(model=model.config, loss_points=64, occupancy_queries=64, occupancy_weight=0.5, agreement_weight=3.0)
    one = lambda pair: method.loss({"params": model.params}, pair, jax.random.key(1))[:2]  # noqa: E731
    loss, told = jax.jit(jax.vmap(one, axis_name=PAIRS))(batch)
    alignment = (told["chamfer"] + told["chamfer_first"]) / 2  # of two steps
    np.testing.assert_allclose(
        loss, alignment + 0.5 * (told["occupancy"] - 3.0 * told.get("agreement", 0.0)), rtol=1e-5
    )
    assert ("agreement" in told) == (model.config.partition == "parts")


def test_one_region_for_all_points_has_no_agreement(parts_model, clouds):
    last = parts_model.params["partition"]["Dense_3"]
    partition = parts_model.params["partition"] | {"Dense_3": last | {"bias": last["bias"].at[0].add(100.0)}}
    collapsed = Model(parts_model.config, parts_model.params | {"partition": partition})
    assert float(jnp.max(_agreement(collapsed, clouds))) < 0.01 < float(jnp.min(_agreement(parts_model, clouds)))


def test_agreement_does_not_depend_on_the_pose(parts_model, clouds, pose, monkeypatch):
    """Without noise, which has directions of its own."""
    monkeypatch.setattr("urrt_jax.training.urrt._NOISE", 0.0)
    still, turned = (_agreement(parts_model, clouds @ turn.T) for turn in (np.eye(3, dtype=np.float32), pose[0]))
    np.testing.assert_allclose(turned, still, atol=1e-4)


def test_no_loss_reads_the_true_pose(model, batch):
    method = URRT(model=model.config, loss_points=64, occupancy_queries=64)
    wrong = jax.vmap(rigid.inverse)(jax.tree.map(lambda leaf: leaf[::-1], batch.transform))

    @jax.jit
    def losses(transform: Rigid) -> jax.Array:
        one = lambda pair: method.loss({"params": model.params}, pair, jax.random.key(1))[0]  # noqa: E731
        return jax.vmap(one, axis_name=PAIRS)(batch._replace(transform=transform))

    np.testing.assert_array_equal(losses(batch.transform), losses(wrong))
