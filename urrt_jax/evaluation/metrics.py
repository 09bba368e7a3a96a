"""How far a pose is from the truth: DCP's errors of Euler angles, and isotropic ones.

Host-side NumPy in float64, batched: these are counted once, on results.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def euler_angles(rotations: np.ndarray) -> np.ndarray:
    """Extrinsic zyx Euler angles in degrees, (B, 3), of rotations (B, 3, 3): DCP's convention."""
    return Rotation.from_matrix(rotations).as_euler("zyx", degrees=True)


def rotation_degrees(first: ArrayLike, second: ArrayLike) -> np.ndarray:
    """The angle between rotations (..., 3, 3), in degrees, in [0, 180]: 2·asin(‖A − B‖_F / 2√2), exact near zero."""
    chord = np.linalg.norm(np.asarray(first, np.float64) - np.asarray(second, np.float64), axis=(-2, -1))
    return np.degrees(2 * np.arcsin(np.clip(chord / np.sqrt(8), 0.0, 1.0)))


def pose_errors(
    rotations: np.ndarray, translations: np.ndarray, true_rotations: np.ndarray, true_translations: np.ndarray
) -> dict[str, np.ndarray]:
    """The errors of B poses, item by item.

    Args:
      rotations, true_rotations: (B, 3, 3).
      translations, true_translations: (B, 3).

    Returns:
      ``euler`` (B, 3), the differences of Euler angles in degrees, each in [-180, 180); ``offset`` (B, 3), of the
      translations; ``angle`` (B,), the angle of R_trueᵀ R in degrees; ``distance`` (B,), ‖t‖ of T_true⁻¹ T.
    """
    rotations, true_rotations = np.asarray(rotations, np.float64), np.asarray(true_rotations, np.float64)
    offset = np.asarray(translations, np.float64) - np.asarray(true_translations, np.float64)
    euler = euler_angles(rotations) - euler_angles(true_rotations)
    return {
        "euler": (euler + 180.0) % 360.0 - 180.0,
        "offset": offset,
        "angle": rotation_degrees(rotations, true_rotations),
        "distance": np.linalg.norm(offset, axis=-1),
    }


def summarize(errors: dict[str, np.ndarray]) -> dict[str, Any]:
    """The usual figures of ``pose_errors``: DCP's over items and axes, isotropic ones, and recalls."""
    euler, offset, angle, distance = (errors[name] for name in ("euler", "offset", "angle", "distance"))
    mse_rotation, mse_translation = float(np.mean(euler**2)), float(np.mean(offset**2))
    return {
        "items": len(angle),
        "mse_rotation": mse_rotation,
        "rmse_rotation": float(np.sqrt(mse_rotation)),
        "mae_rotation": float(np.mean(np.abs(euler))),
        "mse_translation": mse_translation,
        "rmse_translation": float(np.sqrt(mse_translation)),
        "mae_translation": float(np.mean(np.abs(offset))),
        "angle_mean": float(np.mean(angle)),
        "angle_median": float(np.median(angle)),
        "angle_p95": float(np.percentile(angle, 95)),
        "distance_mean": float(np.mean(distance)),
        "recall_1deg": float(np.mean(angle < 1.0)),
        "recall_1deg_0.05": float(np.mean((angle < 1.0) & (distance < 0.05))),
        "recall_5deg_0.1": float(np.mean((angle < 5.0) & (distance < 0.1))),
    }
