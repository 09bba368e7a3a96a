"""Errors of poses against SciPy and hand-made cases, at both ends of the range too."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation import euler_angles, pose_errors, recall_curve, roc_curve, rotation_degrees, summarize
from urrt_jax.evaluation.metrics import clean_chamfer, true_overlap
from urrt_jax.rigid import Rigid


def turn(degrees: float, axis: str = "z") -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def rigid(rotation, translation) -> Rigid:
    return Rigid(jnp.asarray(rotation, jnp.float32), jnp.asarray(translation, jnp.float32))


@pytest.mark.parametrize("degrees", [0.0, 1e-9, 1e-5, 0.5, 90.0, 179.999, 180.0])
def test_angle_is_exact_from_zero_to_half_a_turn(degrees):
    assert rotation_degrees(turn(degrees), np.eye(3)) == pytest.approx(degrees, rel=1e-6, abs=1e-12)


def test_angles_of_a_batch_agree_with_scipy():
    first, second = Rotation.random(50, random_state=0), Rotation.random(50, random_state=1)
    expected = np.degrees((first.inv() * second).magnitude())
    np.testing.assert_allclose(rotation_degrees(first.as_matrix(), second.as_matrix()), expected, rtol=1e-9)


def test_euler_angles_are_extrinsic_zyx_in_degrees():
    x, y, z = 10.0, 20.0, 30.0
    product = turn(x, "x") @ turn(y, "y") @ turn(z, "z")
    np.testing.assert_allclose(euler_angles(product[None]), [[z, y, x]], atol=1e-9)


def test_errors_of_a_hand_made_pose():
    truth, found = turn(10)[None], turn(13)[None]
    errors = pose_errors(found, np.array([[1.0, 2.0, 3.0]]), truth, np.array([[1.0, 2.0, 2.5]]))
    np.testing.assert_allclose(errors["euler"], [[3.0, 0.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(errors["angle"], [3.0])
    np.testing.assert_allclose(errors["offset"], [[0.0, 0.0, 0.5]])
    np.testing.assert_allclose(errors["distance"], [0.5])


def test_distance_is_the_translation_of_the_remaining_transform():
    """‖t‖ of T_true⁻¹ T, composed in full."""
    rng = np.random.default_rng(0)
    found, truth = (Rotation.random(20, random_state=seed).as_matrix() for seed in (0, 1))
    moved, true_move = rng.normal(size=(2, 20, 3))
    rest = np.einsum("bji,bj->bi", truth, moved - true_move)
    np.testing.assert_allclose(pose_errors(found, moved, truth, true_move)["distance"], np.linalg.norm(rest, axis=1))


def test_euler_differences_are_not_wrapped_as_in_dcp():
    errors = pose_errors(turn(179)[None], np.zeros((1, 3)), turn(-179)[None], np.zeros((1, 3)))
    np.testing.assert_allclose(errors["euler"][0, 0], 358.0, atol=1e-6)
    np.testing.assert_allclose(errors["angle"], 2.0, atol=1e-6)


def test_summary_of_two_items_by_hand():
    found = np.stack([turn(3), turn(0.5)])
    errors = pose_errors(
        found, np.array([[0.3, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.stack([np.eye(3)] * 2), np.zeros((2, 3))
    )
    summary = summarize(errors)
    assert summary["items"] == 2
    assert summary["mse_rotation"] == pytest.approx((9 + 0.25) / 6)
    assert summary["rmse_rotation"] == pytest.approx(np.sqrt((9 + 0.25) / 6))
    assert summary["mae_rotation"] == pytest.approx(3.5 / 6)
    assert summary["mae_translation"] == pytest.approx(0.3 / 6)
    assert summary["angle_mean"] == pytest.approx(1.75)
    assert summary["recall_1deg"] == 0.5
    assert summary["recall_5deg_0.1"] == 0.5  # the first turns little enough but moves too far


def test_recalls_compare_translations_with_each_items_scale():
    errors = pose_errors(
        np.stack([turn(1)] * 2), np.full((2, 3), [0.3, 0, 0]), np.stack([np.eye(3)] * 2), np.zeros((2, 3))
    )
    assert summarize(errors, np.array([1.0, 100.0]))["recall_5deg_0.1"] == 0.5


def test_recall_curve_counts_what_is_strictly_below():
    np.testing.assert_allclose(
        recall_curve(np.array([0.5, 1.0, 30.0]), np.array([0.1, 1.0, 2.0, 180.0])), [0, 1 / 3, 2 / 3, 1]
    )


@pytest.fixture(scope="module")
def trial():
    rng = np.random.default_rng(0)
    clean = rng.normal(size=(80, 3)).astype(np.float32)
    rotation, translation = turn(25, "x"), np.array([0.1, -0.2, 0.3])
    source = ((clean[:50] - translation) @ rotation + 0.02 * rng.normal(size=(50, 3))).astype(np.float32)
    return source, clean[20:] + np.float32(0.01), clean, rotation, translation


def test_clean_chamfer_agrees_with_its_definition(trial):
    """RPM-Net's: the source moved as found against the clean target, the target against the shape moved as found."""
    source, target, clean, rotation, translation = trial
    found_turn, found_move = turn(31, "x"), np.array([0.0, -0.1, 0.2])
    shape = (clean - translation) @ rotation
    forth = KDTree(clean).query(source @ found_turn.T + found_move)[0]
    back = KDTree(shape @ found_turn.T + found_move).query(target)[0]
    found, truth = rigid(found_turn, found_move), rigid(rotation, translation)
    measured = clean_chamfer(*map(jnp.asarray, (source, target, clean)), found, truth)
    np.testing.assert_allclose(measured, np.mean(forth**2) + np.mean(back**2), rtol=1e-4)


def test_clean_chamfer_of_a_clean_pair_in_its_true_pose_is_zero(trial):
    _, _, clean, rotation, translation = trial
    truth = rigid(rotation, translation)
    source = jnp.asarray((clean - translation) @ rotation, jnp.float32)
    assert float(clean_chamfer(source, jnp.asarray(clean), jnp.asarray(clean), truth, truth)) < 1e-10


def test_overlap_is_the_share_with_a_counterpart():
    source = jnp.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    target = jnp.array([[5.0, 0.05, 0], [6, 0, 0.05]])
    assert float(true_overlap(source, target, rigid(np.eye(3), [5.0, 0, 0]), 0.1)) == 0.5


def test_area_under_the_curve_is_the_chance_that_a_right_pose_is_surer():
    """Against its definition, over all pairs of a right and a wrong pose; confidences are few, so that many tie."""
    rng = np.random.default_rng(0)
    right, confidence = rng.random(60) < 0.4, rng.integers(0, 6, 60) / 5
    surer = np.sign(confidence[right][:, None] - confidence[~right])
    assert roc_curve(right, confidence)[2] == pytest.approx(np.mean((surer + 1) / 2), abs=1e-12)


@pytest.mark.parametrize(
    ("confidence", "area"), [([0.9, 0.8, 0.2, 0.1], 1), ([0.1, 0.2, 0.8, 0.9], 0), ([0.5] * 4, 0.5)]
)
def test_area_under_the_curve_of_a_perfect_a_reversed_and_a_blind_confidence(confidence, area):
    assert roc_curve(np.array([True, True, False, False]), np.array(confidence))[2] == area


def test_roc_curve_goes_from_none_to_all():
    wrong, right, _ = roc_curve(np.array([True, False, True, False]), np.array([0.9, 0.6, 0.6, 0.1]))
    np.testing.assert_array_equal(wrong, [0, 0, 0.5, 1])
    np.testing.assert_array_equal(right, [0, 0.5, 1, 1])


@pytest.mark.parametrize("right", [True, False])
def test_area_under_the_curve_is_not_known_where_all_poses_are_alike(right):
    assert np.isnan(roc_curve(np.full(5, right), np.linspace(0, 1, 5))[2])
