"""How far a pose is from the truth: DCP's errors of Euler angles, isotropic ones, recalls and clean Chamfer distances.

Host-side NumPy in float64, batched: these are counted once, on results. Chamfer distances are JAX functions of a pair.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from urrt_jax import rigid
from urrt_jax.clouds import make_cloud
from urrt_jax.neighbors import nearest
from urrt_jax.rigid import Rigid

RECALLS = ((1.0, 0.05), (2.0, 0.02), (5.0, 0.05), (5.0, 0.1))
"""Recall counts a pose whose angle is below so many degrees and whose distance is below so many scales."""


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
      ``euler`` (B, 3), the differences of Euler angles in degrees, as DCP counts them: not wrapped at half a turn;
      ``offset`` (B, 3), of the translations; ``angle`` (B,), the angle of R_trueᵀ R in degrees; ``distance`` (B,),
      ‖t‖ of T_true⁻¹ T.
    """
    rotations, true_rotations = np.asarray(rotations, np.float64), np.asarray(true_rotations, np.float64)
    offset = np.asarray(translations, np.float64) - np.asarray(true_translations, np.float64)
    return {
        "euler": euler_angles(rotations) - euler_angles(true_rotations),
        "offset": offset,
        "angle": rotation_degrees(rotations, true_rotations),
        "distance": np.linalg.norm(offset, axis=-1),
    }


def clean_chamfer(source: Array, target: Array, clean: Array, found: Rigid, truth: Rigid) -> Array:
    """RPM-Net's modified Chamfer distance, (), squared: each cloud against the whole shape without noise.

    The mean squared distance of the moved source (N, 3) to ``clean`` (P, 3), given in the target's frame, plus that of
    the target (M, 3) to the clean shape as the found pose moves it from the source's frame (Yew and Lee 2020, eq. 10).
    """
    moved = rigid.apply(rigid.compose(found, rigid.inverse(truth)), clean)
    forth = nearest(rigid.apply(found, source), make_cloud(clean)).squared
    back = nearest(target, make_cloud(moved)).squared
    return jnp.mean(forth) + jnp.mean(back)


def true_overlap(source: Array, target: Array, truth: Rigid, reach: Array | float) -> Array:
    """The share of source points (N, 3) that have a target point (M, 3) within ``reach`` in the true pose, ()."""
    return jnp.mean(
        nearest(rigid.apply(truth, source), make_cloud(target)).squared < jax.lax.square(jnp.asarray(reach))
    )


def summarize(errors: dict[str, np.ndarray], scales: ArrayLike = 1.0) -> dict[str, Any]:
    """The usual figures of ``pose_errors``: DCP's over items and axes, isotropic ones, and recalls.

    Args:
      errors: of B poses.
      scales: () or (B,), the length that recalls compare the distance with.
    """
    euler, offset, angle, distance = (errors[name] for name in ("euler", "offset", "angle", "distance"))
    mse_rotation, mse_translation = float(np.mean(euler**2)), float(np.mean(offset**2))
    relative = distance / np.asarray(scales)
    recalls = {
        f"recall_{degrees:g}deg_{share:g}": float(np.mean((angle < degrees) & (relative < share)))
        for degrees, share in RECALLS
    }
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
        "distance_median": float(np.median(distance)),
        "distance_p95": float(np.percentile(distance, 95)),
        "recall_1deg": float(np.mean(angle < 1.0)),
        **recalls,
    }


def recall_curve(angles: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The share of angles (B,) below each threshold (T,), in degrees; (T,)."""
    return np.searchsorted(np.sort(angles), thresholds, side="left") / len(angles)


def roc_curve(right: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """How well a confidence (B,) tells right poses from wrong ones, ``right`` (B,) bool: the curve and its area.

    The shares (K,) of wrong and of right poses at or above each confidence, from none to all, and the area under the
    curve: the chance that a right pose is surer than a wrong one (ties count half). NaN where all are right, or none.
    """
    order = np.argsort(-confidence, kind="stable")
    last = np.append(np.diff(confidence[order]) != 0, True)
    shares = [np.append(0.0, np.cumsum(kind[order])[last] / max(np.sum(kind), 1)) for kind in (~right, right)]
    area = float(np.trapezoid(shares[1], shares[0])) if right.any() and not right.all() else float("nan")
    return shares[0], shares[1], area
