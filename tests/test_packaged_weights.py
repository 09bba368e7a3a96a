"""What the packaged weights promise: real scans aligned, and errors on shapes that they were not trained on."""

import dataclasses
import json
import os
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro

import urrt_jax
from urrt_jax.cli.train import Train
from urrt_jax.data import load_shapes
from urrt_jax.evaluation import evaluate
from urrt_jax.evaluation.metrics import rotation_degrees

DATA = Path(os.environ.get("URRT_DATA", "nowhere"))


@pytest.mark.parametrize("name", urrt_jax.available_models())
def test_card_tells_every_field_of_its_network_and_the_best_step(name):
    """Fields that a card lacks would follow the defaults of later versions."""
    card, model = urrt_jax.model_card(name), urrt_jax.load_model(name)
    assert card["command"].startswith(f"urrt train --out {name} ")
    assert card["validation"]["step"] <= card["steps"]
    assert card["config"] == json.loads(model.config.to_json())


@pytest.mark.parametrize("name", urrt_jax.available_models())
def test_command_of_the_card_trains_what_the_card_says(name):
    """Under the defaults of today, which may have been others when the weights were made."""
    card, model = urrt_jax.model_card(name), urrt_jax.load_model(name)
    config = tyro.cli(Train, args=shlex.split(card["command"])[2:]).config()
    assert json.loads(json.dumps(dataclasses.asdict(config))) == card["training"]
    # How often the network runs, what it looks up, and how it comes to a consensus, can be chosen again after training.
    used = {name: getattr(model.config, name) for name in ("steps", "lookups", "consensus", "hypotheses")}
    assert dataclasses.replace(config.model, **used) == model.config


def test_network_in_the_papers_setting_is_model_c_applied_once():
    config = urrt_jax.load_model("modelnet40-paper").config
    assert (config.variant, config.steps) == ("C", 1)


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
