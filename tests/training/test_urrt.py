"""The objective of our own network: its parts, what each of them teaches, and that no true pose is read."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax import rigid
from urrt_jax.model import Model
from urrt_jax.rigid import Rigid
from urrt_jax.training.pairs import Pair, PairConfig, make_pair
from urrt_jax.training.trainable import PAIRS
from urrt_jax.training.urrt import URRT


@pytest.fixture(scope="module")
def batch(cloud) -> Pair:
    """Two corrupted pairs."""
    keys = jax.random.split(jax.random.key(0), 2)
    return jax.vmap(lambda key: make_pair(key, jnp.asarray(cloud), PairConfig(points=64), 1.0))(keys)


@pytest.fixture(scope="module", params=["places", "parts"])
def model(request, small_model, parts_model) -> Model:
    return {"places": small_model, "parts": parts_model}[request.param]


def test_loss_is_the_sum_of_its_parts(model, batch):
    method = URRT(model=model.config, loss_points=64, occupancy_queries=64, occupancy_weight=0.5, agreement_weight=3.0)
    one = lambda pair: method.loss({"params": model.params}, pair, jax.random.key(1))[:2]  # noqa: E731
    loss, told = jax.jit(jax.vmap(one, axis_name=PAIRS))(batch)
    alignment = (told["chamfer"] + told["chamfer_first"]) / 2  # of two steps
    np.testing.assert_allclose(
        loss, alignment + 0.5 * (told["occupancy"] - 3.0 * told.get("agreement", 0.0)), rtol=1e-5
    )
    assert ("agreement" in told) == (model.config.partition == "parts")


def test_places_teach_the_encoder_and_parts_do_not(model, batch):
    """Branches by place see the embedding; what parts see has no parameters."""
    method = URRT(model=model.config, loss_points=64, occupancy_queries=64)

    def taught(encoder):
        params = model.params | {"encoder": encoder}
        told = lambda pair: method.loss({"params": params}, pair, jax.random.key(1))[1]  # noqa: E731
        metrics = jax.vmap(told, axis_name=PAIRS)(batch)
        return jnp.mean(metrics["occupancy"]) - jnp.mean(metrics.get("agreement", 0.0))

    gradient = jax.jit(jax.grad(taught))(model.params["encoder"])
    taught_any = any(bool(jnp.any(leaf)) for leaf in jax.tree.leaves(gradient))
    assert taught_any == (model.config.partition == "places")


def test_no_loss_reads_the_true_pose(model, batch):
    method = URRT(model=model.config, loss_points=64, occupancy_queries=64)
    wrong = jax.vmap(rigid.inverse)(jax.tree.map(lambda leaf: leaf[::-1], batch.transform))

    @jax.jit
    def losses(transform: Rigid) -> jax.Array:
        one = lambda pair: method.loss({"params": model.params}, pair, jax.random.key(1))[0]  # noqa: E731
        return jax.vmap(one, axis_name=PAIRS)(batch._replace(transform=transform))

    np.testing.assert_array_equal(losses(batch.transform), losses(wrong))
