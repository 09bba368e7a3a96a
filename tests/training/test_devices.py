"""A step on two devices gives what one device gives; in a subprocess, because devices are fixed when JAX starts."""

import json
import os
import subprocess
import sys
import textwrap

import pytest

_STEP = """
    import json
    import jax, numpy as np
    from jax.sharding import AxisType, NamedSharding, PartitionSpec
    from urrt_jax.model import ModelConfig
    from urrt_jax.training.pairs import PairConfig
    from urrt_jax.training.state import TrainConfig, init_state
    from urrt_jax.training.step import train_steps

    config = TrainConfig(
        batch=4, pairs=PairConfig(points=64), loss_points=32,
        # Sharp landmarks, looked-up points and consensus would multiply rounding.
        model=ModelConfig(
            width=16, encoder_widths=(16,), branch_width=8, decoder_widths=(16,), points=32,
            sharpness=1.0, octaves=2, lookups=0, consensus=0))
    points = np.random.default_rng(0).normal(size=(8, 64, 3)).astype(np.float32)
    start, found = jax.device_get(init_state(config)), []
    for count in (1, 2):
        mesh = jax.make_mesh((count,), ("data",), axis_types=(AxisType.Auto,), devices=jax.devices()[:count])
        with jax.set_mesh(mesh):
            everywhere = NamedSharding(mesh, PartitionSpec())
            state, shapes = jax.device_put((start, {"points": points}), everywhere)
            state, metrics = train_steps(state, shapes, config)
        devices = len(jax.tree.leaves(state.params)[0].sharding.device_set)
        found.append({"devices": devices} | {name: float(value) for name, value in metrics.items()})
    print(json.dumps(found))
"""


def test_first_step_on_two_devices_agrees_with_one():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    # In double precision, because devices add up in different orders, and gradients multiply that rounding.
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"}
    command = [sys.executable, "-c", textwrap.dedent(_STEP)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    one, two = json.loads(done.stdout)
    assert (one["devices"], two["devices"]) == (1, 2)
    for name in ("loss", "chamfer", "occupancy", "gradient_norm"):
        assert two[name] == pytest.approx(one[name], rel=1e-4), name
