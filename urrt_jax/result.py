"""What registration returns: the transform, how well it fits, and why it is not to be trusted where it is not."""

import dataclasses
import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from urrt_jax import rigid
from urrt_jax.clouds import CloudLike, as_array
from urrt_jax.rigid import Rigid

UNKNOWN_DEVIATION = 90.0
"""A standard deviation of the rotation, in degrees, from which on nothing is known of it."""


class Outcome(enum.IntEnum):
    """How a registration ended. ``Registration.reason`` says it in words.

    Attributes:
      CONVERGED: the pose may be used.
      DEGENERATE: a cloud has fewer than three usable points, or all of them lie on one line.
      INITIAL: under ``jit``, the initial transform is not finite.
      DIGITS: float32 coordinates lie so far from the origin that they have lost their digits. Pass NumPy float64.
      UNSETTLED: refinement did not come to rest: little overlap, a wrong unit, or round objects.
      MISFIT: too little of the clouds lies on each other: a wrong pose, little overlap, or two objects.
      AMBIGUOUS: another pose fits about as well: the object is symmetric. ``alternatives`` holds other poses.
      REFUSED: ``register`` raises a ``ValueError`` for these clouds; ``reasons`` of ``register_pairs`` has its message.
      UNDETERMINED: too few points touch, or they are too noisy: ``covariance`` says how little is known.
    """

    CONVERGED = 0
    DEGENERATE = 1
    INITIAL = 2
    DIGITS = 3
    UNSETTLED = 4
    MISFIT = 5
    AMBIGUOUS = 6
    REFUSED = 7
    UNDETERMINED = 8


_REASONS = {
    Outcome.CONVERGED: "converged",
    Outcome.DEGENERATE: "a cloud has fewer than three usable points, or all of them lie on one line",
    Outcome.INITIAL: "the initial transform is not finite",
    Outcome.DIGITS: "float32 coordinates this far from the origin have lost their digits: pass float64, or subtract an "
    "origin before you convert",
    Outcome.UNSETTLED: "refinement did not come to rest within its iterations",
    Outcome.MISFIT: "the surfaces do not lie on each other, or too little of them does to tell",
    Outcome.AMBIGUOUS: "another pose fits about as well",
    Outcome.UNDETERMINED: "too few points touch, or they are too noisy, to determine the pose",
    Outcome.REFUSED: "the clouds or the initial transform are not what register takes",
}


class OtherPoses(NamedTuple):
    """K other poses in which the clouds lie on each other, best first; K is 4, and unused entries have weight 0.

    Attributes:
      rotation: (K, 3, 3).
      translation: (K, 3), in the input's units.
      weight: (K,), in [0, 1], how probable each is, if it is certain that one of them or the pose itself is right: what
        is missing from 1 is the weight of the pose itself.
    """

    rotation: Array
    translation: Array
    weight: Array

    @property
    def matrix(self) -> np.ndarray:
        """The homogeneous matrices (..., 4, 4), NumPy float64."""
        top = np.concatenate([self.rotation, np.asarray(self.translation, np.float64)[..., None]], axis=-1)
        bottom = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*top.shape[:-2], 1, 4))
        return np.concatenate([top, bottom], axis=-2)

    def likely(self, weight: float = 0.01) -> list[tuple[np.ndarray, float]]:
        """Matrix (4, 4) and weight of those that weigh at least this much, of one pair.

        Raises:
          ValueError: these are the poses of a batch.
        """
        if np.ndim(self.weight) != 1:
            raise ValueError(f"expected the poses of one pair, got weights of shape {np.shape(self.weight)}")
        every = zip(self.matrix, np.asarray(self.weight).tolist(), strict=True)
        return [(matrix, each) for matrix, each in every if each >= weight]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Registration:
    """The transform that carries source onto target, ``target ≈ rotation @ source + translation``, and how well.

    Under ``jax.vmap`` every array has a leading batch axis, and so have ``matrix``, ``transform`` and ``apply``.

    Attributes:
      rotation: (3, 3).
      translation: (3,), in the input's units.
      fitness: (), the share of source points whose nearest target point lies within ``inlier_distance`` after the
        transform (Open3D's definition), over all points.
      rmse: (), the root mean square distance of those inliers, in the input's units; 0 when there are none.
      inlier_distance: (), the distance that was used, in the input's units.
      overlap: (2,), the share of the source's points that lie within 1.5 spacings (the coarser cloud's) of the target,
        and of the target's (up to 4096 of them) that lie as near the source.
      confidence: (), in [0, 1], the estimated probability that the rotation is within 5° of the true one: the product
        of three probabilities, learned on training shapes. Surfaces lie on each other rather than cross; no other pose
        fits as well; the points are enough to determine the pose. Low for symmetric shapes and for few points.
      converged: (), bool: the input was finite, not collinear, and not so far from the origin that float32 lost its
        digits; refinement came to rest within its iterations (where there was refinement); and the confidence is at
        least 0.5.
      outcome: () int32, an ``Outcome``; ``reason`` says it in words.
      correspondences: (N,) int32, the row of the target's point nearest to every source point, -1 where none lies
        within ``inlier_distance``.
      information: (6, 6), of the pose, from these correspondences: Σ GᵀG, G = [I, −[q]×] at target points q, for small
        motions (translation, rotation vector) about the target's origin; what pose graphs take (Choi et al. 2015).
      covariance: (6, 6), of the pose, for the same motions, in squared units and squared radians: how far noise and
        sampling may have moved it, as the distances along normals show. It knows nothing of other poses. Motions that
        nothing holds have a large variance, not an infinite one; where a pose can't be determined at all it is the
        clouds' radius and π, squared.
      alternatives: other poses that fit, with weights; for a symmetric shape some of those that look alike.
      source_regions: (N,) int32, the network's region of every source point; 0 for padding, and for a network
        without regions (model A).
      target_regions: (M,) int32, the same for the target.
      coarse: the network's own estimate: after at most two steps where refinement follows, and after as many as its
        configuration says where none does. Where both clouds hold the same points, the pose that these tell.
      steps: (), the iterations of refinement's last stage; 0 without refinement.
    """

    rotation: Array
    translation: Array
    fitness: Array
    rmse: Array
    inlier_distance: Array
    overlap: Array
    confidence: Array
    converged: Array
    outcome: Array
    correspondences: Array
    information: Array
    covariance: Array
    alternatives: OtherPoses
    source_regions: Array
    target_regions: Array
    coarse: Rigid
    steps: Array

    @property
    def reason(self) -> str | list[str]:
        """Why ``converged`` is False, in words, or "converged"; of a batch, a list. Not under a trace."""
        if np.ndim(self.outcome) == 0:
            return _in_words(self)
        results = jax.tree.map(np.asarray, self)
        return [_in_words(jax.tree.map(lambda leaf, row=row: leaf[row], results)) for row in range(len(self.outcome))]

    @property
    def matrix(self) -> Array:
        """The homogeneous matrix (4, 4); NumPy float64 where the translation is."""
        if isinstance(self.translation, np.ndarray):
            bottom = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (*self.translation.shape[:-1], 1, 4))
            top = np.concatenate([self.rotation, self.translation[..., None]], axis=-1)
            return np.concatenate([top, bottom], axis=-2)  # type: ignore[return-value]
        return rigid.matrix(Rigid(self.rotation, self.translation))

    @property
    def transform(self) -> jaxlie.SE3:
        """The transform as an element of SE(3), in float32."""
        return jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(self.rotation), self.translation)

    def apply(self, points: CloudLike) -> Array:
        """The moved points, (..., 3), of an array or another library's cloud; NumPy float64 if the translation is."""
        points = as_array(points, "points")
        shift = self.translation[..., None, :] if self.translation.ndim > 1 else self.translation
        if isinstance(self.translation, np.ndarray):
            turn = np.swapaxes(np.asarray(self.rotation, np.float64), -1, -2)
            return np.asarray(points, np.float64) @ turn + shift  # type: ignore[return-value]
        return rigid.rotate(self.rotation, jnp.asarray(points)) + shift


def _in_words(result: Registration) -> str:
    """The reason of one pair."""
    outcome = Outcome(int(result.outcome))
    reason = _REASONS[outcome]
    if outcome == Outcome.AMBIGUOUS:
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(np.asarray(result.alternatives.rotation[0]) @ np.asarray(result.rotation).T)
        angle = turn.magnitude()
        axis = ", ".join(f"{value:.2f}" for value in turn.as_rotvec() / max(angle, 1e-9))
        return f"{reason}: turned by {np.rad2deg(angle):.0f}° about the direction ({axis})"
    if outcome == Outcome.UNDETERMINED:
        deviation = rotation_deviation(result.covariance)
        known = 2 < deviation < UNKNOWN_DEVIATION
        return f"{reason}: the standard deviation of its rotation is {deviation:.1f}°" if known else reason
    return reason


def rotation_deviation(covariance: ArrayLike) -> float:
    """The standard deviation of the rotation, in degrees, of a pose with this covariance (6, 6); at most 180."""
    return min(float(np.rad2deg(np.sqrt(np.trace(np.asarray(covariance)[3:, 3:])))), 180.0)
