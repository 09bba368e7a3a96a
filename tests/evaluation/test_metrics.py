"""Errors of poses against SciPy and hand-made cases, at both ends of the range too."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from urrt_jax.evaluation import euler_angles, pose_errors, summarize
from urrt_jax.evaluation.metrics import rotation_degrees


def turn(degrees: float, axis: str = "z") -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


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


def test_euler_differences_wrap_at_half_a_turn():
    errors = pose_errors(turn(179)[None], np.zeros((1, 3)), turn(-179)[None], np.zeros((1, 3)))
    np.testing.assert_allclose(np.abs(errors["euler"][0, 0]), 2.0, atol=1e-6)


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
