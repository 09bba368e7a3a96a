"""What registration returns: the transform, how well it fits, and why it is not to be trusted where it is not."""

import dataclasses
import enum

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from urrt_jax import rigid
from urrt_jax.rigid import Rigid


class Outcome(enum.IntEnum):
    """How a registration ended; ``Registration.reason`` says what each of these means."""

    CONVERGED = 0
    DEGENERATE = 1
    INITIAL = 2
    DIGITS = 3
    UNSETTLED = 4
    MISFIT = 5
    AMBIGUOUS = 6
    REFUSED = 7


_REASONS = {
    Outcome.CONVERGED: "converged",
    Outcome.DEGENERATE: "a cloud has fewer than three usable points, or all of them lie on one line",
    Outcome.INITIAL: "the initial transform is not finite",
    Outcome.DIGITS: "float32 coordinates this far from the origin have lost their digits: pass float64, or subtract an "
    "origin before you convert",
    Outcome.UNSETTLED: "refinement did not come to rest within its iterations",
    Outcome.MISFIT: "the surfaces do not lie on each other, or too little of them does to tell",
    Outcome.AMBIGUOUS: "another pose fits about as well: the shape is symmetric, or nearly so",
    Outcome.REFUSED: "the clouds or the initial transform are not what register takes",
}


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
      confidence: (), in [0, 1]: how sure it is that the surfaces lie on each other rather than cross, and that they do
        so in no other pose. Learned on training shapes, from overlap, from distances, and from how much worse the
        clouds agree after quarter and half turns. Low for symmetric shapes.
      converged: (), bool: the input was finite, not collinear, and not so far from the origin that float32 lost its
        digits; refinement came to rest within its iterations (where there was refinement); and the confidence is at
        least 0.5.
      outcome: () int32, an ``Outcome``; ``reason`` says it in words.
      correspondences: (N,) int32, the row of the target's point nearest to every source point, -1 where none lies
        within ``inlier_distance``.
      information: (6, 6), of the pose, from these correspondences: Σ GᵀG, G = [I, −[q]×] at target points q, for small
        motions (translation, rotation vector) about the target's origin; what pose graphs take (Choi et al. 2015).
      source_regions: (N,) int32, the network's region of every source point; 0 for padding, and for a network
        without regions (model A).
      target_regions: (M,) int32, the same for the target.
      coarse: the network's own estimate: after at most two steps where refinement follows, and after as many as its
        configuration says where none does.
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
    source_regions: Array
    target_regions: Array
    coarse: Rigid
    steps: Array

    @property
    def reason(self) -> str | list[str]:
        """Why ``converged`` is False, in words, or "converged"; of a batch, a list. Not under a trace."""
        codes = np.asarray(self.outcome)
        return _REASONS[Outcome(int(codes))] if codes.ndim == 0 else [_REASONS[Outcome(int(code))] for code in codes]

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

    def apply(self, points: ArrayLike) -> Array:
        """The moved points, (..., 3); in float64, on the host, where the translation is."""
        shift = self.translation[..., None, :] if self.translation.ndim > 1 else self.translation
        if isinstance(self.translation, np.ndarray):
            turn = np.swapaxes(np.asarray(self.rotation, np.float64), -1, -2)
            return np.asarray(points, np.float64) @ turn + shift  # type: ignore[return-value]
        return rigid.rotate(self.rotation, jnp.asarray(points)) + shift
