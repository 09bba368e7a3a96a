"""A step on two devices gives what one device gives; in a subprocess, because devices are fixed when JAX starts."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

_STEP = """
    import json, runpy, sys
    import jax, numpy as np
    from jax.sharding import AxisType, NamedSharding, PartitionSpec
    from urrt_jax.model import ModelConfig
    from urrt_jax.training.pairs import PairConfig
    from urrt_jax.training.state import TrainConfig, init_state
    from urrt_jax.training.step import train_steps
    from urrt_jax.training.urrt import URRT

    # Sharp landmarks, looked-up points and consensus would multiply rounding.
    ours = URRT(loss_points=32, model=ModelConfig(
        width=16, encoder_widths=(16,), branch_width=8, decoder_widths=(16,), points=32,
        sharpness=1.0, octaves=2, lookups=0, consensus=0))
    with_batch_stats = runpy.run_path(sys.argv[1])["Shift"]()
    points = np.random.default_rng(0).normal(size=(8, 64, 3)).astype(np.float32)
    found = []
    for count in (1, 2):
        mesh = jax.make_mesh((count,), ("data",), axis_types=(AxisType.Auto,), devices=jax.devices()[:count])
        for method in (ours, with_batch_stats):
            config = TrainConfig(batch=4, pairs=PairConfig(points=64), method=method)
            start = jax.device_get(init_state(config))
            with jax.set_mesh(mesh):
                everywhere = NamedSharding(mesh, PartitionSpec())
                state, shapes = jax.device_put((start, {"points": points}), everywhere)
                state, metrics = train_steps(state, shapes, config)
            devices = len(jax.tree.leaves(state.params)[0].sharding.device_set)
            found.append({"devices": devices} | {name: float(value) for name, value in metrics.items()})
            found[-1]["batch_stats"] = [leaf.tolist() for leaf in jax.tree.leaves(state.batch_stats)]
    print(json.dumps(found))
"""


def test_first_step_on_two_devices_agrees_with_one():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    # In double precision, because devices add up in different orders, and gradients multiply that rounding.
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"}
    command = [sys.executable, "-c", textwrap.dedent(_STEP), str(Path(__file__).with_name("test_batch_stats.py"))]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    one, one_with_stats, two, two_with_stats = json.loads(done.stdout)
    assert [each["devices"] for each in (one, one_with_stats, two, two_with_stats)] == [1, 1, 2, 2]
    for name in ("loss", "chamfer", "occupancy", "gradient_norm"):
        assert two[name] == pytest.approx(one[name], rel=1e-4), name
    for name in ("loss", "gradient_norm"):
        assert two_with_stats[name] == pytest.approx(one_with_stats[name], rel=1e-4), name
    assert two_with_stats["batch_stats"][0] == pytest.approx(one_with_stats["batch_stats"][0], rel=1e-4)
