"""What the packaged weights promise: real scans aligned, and errors on shapes that they were not trained on."""

import os
from pathlib import Path

import numpy as np
import pytest

import urrt_jax
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.evaluation.metrics import rotation_degrees

DATA = Path(os.environ.get("URRT_DATA", "nowhere"))


def test_network_alone_turns_procedural_shapes_most_of_the_way():
    """Shapes of a kind that training never saw: what remains of rotations of some 40 degrees."""
    shapes = load_shapes("procedural", split="test", limit=32)
    errors = evaluate("network", "dcp", shapes.points, progress=False).errors()
    assert np.median(errors["angle"]) < 10.0


def test_refinement_is_exact_on_most_procedural_shapes():
    shapes = load_shapes("procedural", split="test", limit=32)
    errors = evaluate("register", "dcp", shapes.points, progress=False).errors()
    assert np.mean(errors["angle"] < 1.0) >= 0.9


@pytest.mark.skipif(not (DATA / "bunny_scans.npz").exists(), reason="needs bunny_scans.npz: URRT_DATA names no folder")
def test_bunny_scans_are_aligned_within_one_degree_and_two_millimetres():
    with np.load(DATA / "bunny_scans.npz") as scans:
        source, target = scans["pts_bun000"], scans["pts_bun045"]
        poses = dict(zip(map(str, scans["names"]), scans["pose_to_world"], strict=True))
    truth = np.linalg.inv(poses["bun045"]) @ poses["bun000"]
    result = urrt_jax.register(source, target)
    assert rotation_degrees(result.rotation, truth[:3, :3]) < 1.0
    assert np.linalg.norm(np.asarray(result.translation) - truth[:3, 3]) < 2e-3
    assert bool(result.converged)
