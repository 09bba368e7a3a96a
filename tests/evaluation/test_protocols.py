"""The protocols draw what their definitions say, on every machine, and what they do to a pair is what they claim."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation import PROTOCOLS, find_protocol
from urrt_jax.evaluation.protocols import CLIP

SHAPES = [name for name in PROTOCOLS if name != "scans"]

# Of item 1 of the clouds below: the sizes and the first point of the source and of the target.
PINNED = {
    "dcp": (1024, 1024, [0.282158, -0.048155, 0.087813], [-0.371169, -0.398393, 0.190003]),
    "prnet": (768, 768, [0.543366, 0.537549, 0.391021], [0.312681, 0.066389, 0.05627]),
    "prnet_noise": (768, 768, [0.558707, 0.52599, 0.400648], [0.320302, 0.075434, 0.064774]),
    "rpmnet": (717, 717, [-0.787299, -0.389126, -0.506203], [0.123081, -0.443466, 0.172157]),
    "incomplete": (768, 1024, [0.489093, -0.541503, 0.396655], [-0.371169, -0.398393, 0.190003]),
    "incomplete_both": (768, 768, [0.489093, -0.541503, 0.396655], [0.549295, -0.518347, -0.26176]),
    "drift": (1024, 1024, [0.290233, -0.050145, 0.088831], [-0.357318, -0.395486, 0.178053]),
    "drift_target": (1024, 1024, [0.282158, -0.048155, 0.087813], [-0.363093, -0.400384, 0.191021]),
    "outliers": (1024, 1024, [0.282158, -0.048155, 0.087813], [-0.229784, -0.60785, -0.634452]),
    "independent": (512, 512, [0.282158, -0.048155, 0.087813], [0.392613, -0.604245, -0.565965]),
    "independent_noise": (512, 512, [0.280553, -0.042184, 0.108428], [0.382244, -0.600988, -0.573464]),
}


@pytest.fixture(scope="module")
def clouds():
    return np.random.RandomState(123).uniform(-0.57, 0.57, (3, 2048, 3)).astype(np.float32)


def moved_source(trial):
    return trial.source @ trial.rotation.T + trial.translation


def distances(points, others):
    return KDTree(others).query(points)[0]


@pytest.mark.parametrize("name", SHAPES)
def test_draws_are_pinned(clouds, name):
    trial = PROTOCOLS[name](clouds, 1)
    sources, targets, first, goal = PINNED[name]
    assert (len(trial.source), len(trial.target)) == (sources, targets)
    np.testing.assert_allclose(trial.source[0], first, atol=2e-6)
    np.testing.assert_allclose(trial.target[0], goal, atol=2e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_a_protocol_is_a_pure_function_of_the_item(clouds, name):
    before = clouds.copy()
    np.random.seed(7)  # noqa: NPY002 - the global generator is what must not matter
    first, second = PROTOCOLS[name](clouds, 2), PROTOCOLS[name](clouds, 2)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(clouds, before)


@pytest.mark.parametrize("name", SHAPES)
def test_items_differ(clouds, name):
    assert not np.allclose(PROTOCOLS[name](clouds, 0).rotation, PROTOCOLS[name](clouds, 1).rotation)


@pytest.mark.parametrize("name", SHAPES)
def test_truth_is_a_rotation_that_lays_the_source_on_the_clean_shape(clouds, name):
    trial = PROTOCOLS[name](clouds, 0)
    np.testing.assert_allclose(trial.rotation @ trial.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(trial.rotation) == pytest.approx(1.0)
    noise = CLIP * np.sqrt(3) + 1e-4
    for cloud in (moved_source(trial), trial.target):
        assert np.mean(distances(cloud, trial.clean) <= noise) > 0.85  # all but outliers


def test_first_draws_of_dcp_are_the_generators(clouds):
    """Angles and translation of item 0: the first six numbers of MT19937 with seed 0, as DCP's definition has them."""
    trial = PROTOCOLS["dcp"](clouds, 0)
    uniform = np.array([0.5488135039273248, 0.7151893663724195, 0.6027633760716439])
    x, y, z = uniform * np.pi / 4
    np.testing.assert_allclose(trial.rotation, Rotation.from_euler("zyx", [z, y, x]).as_matrix(), atol=1e-12)
    moved = np.array([0.5448831829968969, 0.4236547993389047, 0.6458941130666561]) - 0.5
    np.testing.assert_allclose(trial.translation, moved, atol=1e-12)


@pytest.mark.parametrize("item", [0, 1, 2])
def test_dcp_target_holds_the_moved_source_points_in_another_order(clouds, item):
    trial = PROTOCOLS["dcp"](clouds, item)
    moved = moved_source(trial)
    assert not np.allclose(moved, trial.target, atol=1e-2)
    np.testing.assert_allclose(np.sort(moved, axis=0), np.sort(trial.target, axis=0), atol=1e-5)


def test_dcp_uses_the_first_1024_points(clouds):
    source = PROTOCOLS["dcp"](clouds, 1).source
    np.testing.assert_array_equal(np.sort(source, axis=0), np.sort(clouds[1, :1024], axis=0))


@pytest.mark.parametrize("item", [0, 1, 2])
def test_prnet_keeps_what_is_nearest_to_one_far_place(clouds, item):
    """The place is far along ±(1, 1, 1), the same for both clouds: nearest first."""
    trial, whole = PROTOCOLS["prnet"](clouds, item), PROTOCOLS["dcp"](clouds, item)
    sides = []
    for kept, every in ((trial.source, whole.source), (trial.target, whole.target)):
        height, heights = kept.sum(axis=1), every.sum(axis=1)
        sides.append(np.sign(height[0] - height[-1]))
        ends = np.sort(sides[-1] * heights)[-768:]
        assert abs(np.mean(sides[-1] * height) - np.mean(ends)) < 2e-3
    assert sides[0] == sides[1]


@pytest.mark.parametrize("item", [0, 1, 2])
def test_prnet_with_three_signs_keeps_what_is_nearest_to_a_place_with_a_sign_for_each_axis(clouds, item):
    state = np.random.RandomState(item)
    state.uniform(size=6), state.permutation(1024), state.permutation(1024)
    place = state.random_sample((1, 3)) + 500.0 * state.choice([1, -1, 1, -1], (1, 3))
    whole, trial = PROTOCOLS["dcp"](clouds, item).source, find_protocol("prnet signs=3")(clouds, item)
    order = np.argsort(np.linalg.norm(whole - place, axis=1))[:768]
    np.testing.assert_array_equal(trial.source, whole[order])


def test_prnet_has_one_sign_unless_asked_for_three(clouds):
    one, default = find_protocol("prnet signs=1")(clouds, 0), PROTOCOLS["prnet"](clouds, 0)
    np.testing.assert_array_equal(one.source, default.source)
    assert not np.array_equal(find_protocol("prnet signs=3")(clouds, 0).source, default.source)


@pytest.mark.parametrize("signs", [0, 2, 4])
def test_prnet_refuses_other_numbers_of_signs(clouds, signs):
    with pytest.raises(ValueError, match=f"signs: expected 1, .*, or 3, .*, got {signs}"):
        find_protocol(f"prnet signs={signs}")(clouds, 0)


def test_prnet_with_three_signs_gives_the_pairs_of_a_published_comparison():
    """The inputs on which RIENet's released weights were run, of ModelNet40's test set."""
    data = Path(os.environ.get("URRT_DATA", "nowhere"))
    paths = data / "modelnet40_test_1024.npz", data / "peers" / "golden_rienet_modelnet.npz"
    if not all(path.exists() for path in paths):
        pytest.skip("needs ModelNet40 and peers/golden_rienet_modelnet.npz: URRT_DATA names no folder with them")
    with np.load(paths[0]) as shapes, np.load(paths[1]) as golden:
        clouds = shapes["points"]
        for row, item in enumerate(golden["items"]):
            trial = find_protocol("prnet signs=3")(clouds, int(item))
            np.testing.assert_array_equal(trial.source, golden["prnet_source"][row])
            np.testing.assert_array_equal(trial.target, golden["prnet_target"][row])


def test_prnet_noise_is_drawn_as_in_the_released_code(clouds):
    """There clouds are (3, N): the whole protocol again, in other words."""
    state = np.random.RandomState(0)
    angles = [state.uniform() * np.pi / 4 for _ in range(3)]
    shift = [state.uniform(-0.5, 0.5) for _ in range(3)]
    source = clouds[0, :1024]
    target = Rotation.from_euler("zyx", angles[::-1]).apply(source).T + np.reshape(shift, (3, 1))
    source, target = state.permutation(source).T, state.permutation(target.T).T
    source += np.clip(0.01 * state.randn(*source.shape), -0.05, 0.05)
    target += np.clip(0.01 * state.randn(*target.shape), -0.05, 0.05)
    place = state.random_sample((1, 3)) + np.array([[500, 500, 500]]) * state.choice([1, -1, 1, -1])
    kept = [cloud.T[np.argsort(np.linalg.norm(cloud.T - place, axis=1))[:768]] for cloud in (source, target)]
    trial = PROTOCOLS["prnet_noise"](clouds, 0)
    np.testing.assert_allclose(trial.source, kept[0], atol=1e-6)
    np.testing.assert_allclose(trial.target, kept[1], atol=1e-6)


def test_rpmnet_is_drawn_as_in_the_released_code(clouds):
    """Crops, pose and samples each from a fresh seed; noise and order go on from the samples; target first at last."""
    state = np.random.RandomState(1)
    parts = []
    for _ in range(2):
        phi, cosine = state.uniform(0.0, 2 * np.pi), state.uniform(-1.0, 1.0)
        theta = np.arccos(cosine)
        normal = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
        height = (clouds[1] - clouds[1].mean(axis=0)) @ np.array(normal)
        parts.append(clouds[1][height > np.percentile(height, 30)])
    state = np.random.RandomState(1)
    angles = [state.uniform() * np.pi / 4 for _ in range(3)]
    shift = state.uniform(-0.5, 0.5, 3)
    source = Rotation.from_euler("zyx", angles[::-1]).apply(parts[0]) + shift
    state = np.random.RandomState(1)
    source = source[state.choice(len(source), 717, replace=False)]
    target = parts[1][state.choice(len(parts[1]), 717, replace=False)]
    source = source + np.clip(state.normal(0.0, 0.01, (717, 3)), -0.05, 0.05)
    target = target + np.clip(state.normal(0.0, 0.01, (717, 3)), -0.05, 0.05)
    target, source = state.permutation(target), state.permutation(source)
    trial = PROTOCOLS["rpmnet"](clouds, 1)
    np.testing.assert_allclose(trial.source, source, atol=2e-6)
    np.testing.assert_allclose(trial.target, target, atol=2e-6)


def test_rpmnet_source_is_the_cloud_that_moves(clouds):
    """Moving back by the pose that DCP would draw lays the source on the stored shape, where the target is already."""
    trial = PROTOCOLS["rpmnet"](clouds, 2)
    np.testing.assert_allclose(trial.rotation, PROTOCOLS["dcp"](clouds, 2).rotation.T, atol=1e-12)
    np.testing.assert_array_equal(trial.clean, clouds[2])
    assert np.all(distances(trial.target, clouds[2]) <= CLIP * np.sqrt(3) + 1e-6)


@pytest.mark.parametrize("name", ["incomplete", "incomplete_both"])
def test_incomplete_source_is_a_ball_about_one_place(clouds, name):
    """Kept points are the nearest to a place, so that some sphere holds them and none of the others: by convexity of
    the power distance a linear function of (x, |x|²) separates them."""
    trial, whole = PROTOCOLS[name](clouds, 1), PROTOCOLS["dcp"](clouds, 1).source
    random = np.random.RandomState(1)
    random.uniform(size=6), random.permutation(1024), random.permutation(1024)
    place = random.uniform(-1, 1, 3)
    order = np.linalg.norm(whole - place, axis=1)
    np.testing.assert_allclose(np.sort(np.linalg.norm(trial.source - place, axis=1)), np.sort(order)[:768], atol=1e-6)


def test_incomplete_target_is_whole_unless_both_are_cropped(clouds):
    assert len(PROTOCOLS["incomplete"](clouds, 0).target) == 1024
    both = PROTOCOLS["incomplete_both"](clouds, 0)
    assert 0.3 < np.mean(distances(moved_source(both), both.target) < 1e-4) < 0.95


def test_drift_is_independent_clipped_and_of_its_size(clouds):
    trial, clean = PROTOCOLS["drift"](clouds, 0), PROTOCOLS["dcp"](clouds, 0)
    source, target = trial.source - clean.source, trial.target - clean.target
    for noise in (source, target):
        assert np.abs(noise).max() <= CLIP + 1e-6
        assert np.std(noise) == pytest.approx(0.01, rel=0.05)
    assert abs(np.corrcoef(source.ravel(), target.ravel())[0, 1]) < 0.05


def test_one_sided_drift_leaves_the_source_alone(clouds):
    trial, clean = PROTOCOLS["drift_target"](clouds, 0), PROTOCOLS["dcp"](clouds, 0)
    np.testing.assert_array_equal(trial.source, clean.source)
    assert not np.allclose(trial.target, clean.target, atol=1e-3)


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_outliers_replace_their_share_of_both_clouds(clouds, share):
    trial = find_protocol(f"outliers share={share}")(clouds, 0)
    for cloud in (moved_source(trial), trial.target):
        assert len(cloud) == 1024
        assert np.sum(distances(cloud, trial.clean) > 1e-4) == round(share * 1024)


@pytest.mark.parametrize("name", ["independent", "independent_noise"])
def test_independent_halves_share_no_point(clouds, name):
    trial = PROTOCOLS[name](clouds, 0)
    assert np.mean(distances(moved_source(trial), trial.target) < 1e-4) < 0.01
    if name == "independent":
        both = np.concatenate([moved_source(trial), trial.target])
        np.testing.assert_allclose(np.sort(both, axis=0), np.sort(trial.clean, axis=0), atol=1e-5)


def test_options_follow_the_name(clouds):
    trial = find_protocol("incomplete_both kept=500")(clouds, 0)
    assert (len(trial.source), len(trial.target)) == (500, 500)


@pytest.mark.parametrize(
    "name, message",
    [
        ("nonesuch", "expected one of dcp"),
        ("", "expected one of dcp"),
        ("drift strength=1", "options sigma, target_only"),
        ("drift sigma=much", "sigma expects a number"),
        ("drift sigma", "sigma expects a number"),
        ("incomplete kept=600.5", "kept expects a whole number"),
    ],
)
def test_mistyped_protocols_are_named(name, message):
    with pytest.raises(ValueError, match=message):
        find_protocol(name)


@pytest.mark.parametrize(
    "name, points, message",
    [
        ("rpmnet", 1024, "more than 1024 points"),
        ("rpmnet keep=0", 2048, "keep"),
        ("incomplete", 500, "kept: expected 3 to 500"),
        ("incomplete kept=0", 2048, "kept: expected 3 to 2048"),
        ("prnet kept=-5", 2048, "kept"),
        ("outliers share=2", 2048, "share"),
    ],
)
def test_a_protocol_refuses_data_that_would_make_it_milder(clouds, name, points, message):
    with pytest.raises(ValueError, match=message):
        find_protocol(name)(clouds[:, :points], 0)


@pytest.mark.parametrize("name", SHAPES)
def test_all_rotations_are_within_45_degrees_of_the_expected_one(clouds, name):
    many = np.broadcast_to(clouds[:1], (300, *clouds.shape[1:]))
    trials = [PROTOCOLS[name](many, item) for item in range(0, 300, 5)]
    turns = np.stack([trial.expected.T @ trial.rotation for trial in trials])
    angles = np.rad2deg(Rotation.from_matrix(turns).magnitude())
    assert angles.max() < 45 and 15 < angles.mean() < 28
