"""Programs for accelerators, which need none to be made: what the compilers of CUDA and TPU are given."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from urrt_jax import load_model, register
from urrt_jax.clouds import Cloud
from urrt_jax.neighbors import LARGE, nearest
from urrt_jax.training.pairs import PairConfig
from urrt_jax.training.state import TrainConfig, init_state
from urrt_jax.training.step import train_steps
from urrt_jax.training.urrt import URRT

PLATFORMS = ("cuda", "tpu")


def _points(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((*shape, 3), jnp.float32)


def _lowered(function, *arguments, platforms=PLATFORMS) -> jax.export.Exported:
    """A function of abstract values as the compilers of these platforms get it."""
    return jax.export.export(jax.jit(function), platforms=platforms)(*arguments)


def test_registration_of_a_batch_of_large_pairs_is_lowered():
    """Large, so that samples are compared at once and whole clouds are thinned first; of two sizes, so padded."""
    model = load_model()

    def one(source, target):
        found = register(source, target, model=model)
        return found.rotation, found.translation, found.confidence

    lowered = _lowered(jax.vmap(one), _points(2, LARGE + 1), _points(2, LARGE + 300))
    assert lowered.platforms == PLATFORMS
    assert [out.shape for out in lowered.out_avals] == [(2, 3, 3), (2, 3), (2,)]


@pytest.mark.parametrize("partition", ["places", "parts"])
def test_training_step_is_lowered(small_config, partition):
    model = dataclasses.replace(small_config, partition=partition)
    config = TrainConfig(method=URRT(model=model, loss_points=64), pairs=PairConfig(points=64), batch=2)
    state = jax.eval_shape(init_state, config)
    shapes = {"points": jax.ShapeDtypeStruct((4, 100, 3), jnp.float32)}
    lowered = _lowered(lambda state, shapes: train_steps(state, shapes, config), state, shapes)
    assert len(lowered.out_avals) > len(jax.tree.leaves(state))  # the next state, and metrics


@pytest.mark.parametrize("platform", ["cpu", *PLATFORMS])
def test_only_a_cpu_searches_large_clouds_block_by_block(platform):
    """Accelerators compare all points, in a single loop; walking from block to block needs more of them."""
    count = LARGE + 1

    def search(query, points):
        return nearest(query, Cloud(points, jnp.ones(count, bool)))

    module = _lowered(search, _points(100), _points(count), platforms=(platform,)).mlir_module()
    loops = module.count("stablehlo.while")
    assert loops > 1 if platform == "cpu" else loops == 1
