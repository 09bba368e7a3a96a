"""The frame in which a pair is registered: both clouds about their centroids, in units of their common radius.

The source is moved by a rough transform first, where one is known. Network, refinement and search see this frame alone.
A ``Frame`` is invertible: poses enter and leave through it, and its ``scale`` turns lengths into the input's units.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from urrt_jax import rigid
from urrt_jax.clouds import Cloud, centroid, mean_square_radius, shift
from urrt_jax.rigid import Rigid


class Frame(NamedTuple):
    """Where a pair was before it was normalised. NumPy float64 arrays on the host, JAX arrays under a trace.

    Attributes:
      rough: the transform that moves the source before anything else; the identity where none is known.
      source_center: (3,), the centroid of the source as moved by ``rough``, in the input's units.
      target_center: (3,), the centroid of the target.
      scale: (), the length of the input that is 1 in the frame: the root mean square radius of both clouds.
    """

    rough: Any
    source_center: Any
    target_center: Any
    scale: Any

    def leave(self, transform: Rigid) -> Rigid:
        """The transform between the clouds as they were given, of one between the normalised clouds."""
        turn, move = transform
        offset = self.target_center - _product(turn, self.source_center) + self.scale * move
        return Rigid(_product(turn, self.rough.rotation), _product(turn, self.rough.translation) + offset)

    def enter(self, transform: Rigid) -> Rigid:
        """The transform between the normalised clouds, of one between the clouds as they were given."""
        turn = _product(transform.rotation, self.rough.rotation.T)
        moved = transform.translation - _product(turn, self.rough.translation)
        return Rigid(turn, (moved - self.target_center + _product(turn, self.source_center)) / self.scale)


def _product(first: Any, second: Any) -> Any:
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return first @ second
    return jnp.matmul(first, second, precision=jax.lax.Precision.HIGHEST)


def normalize_pair(source: Cloud, target: Cloud, rough: Rigid | None = None) -> tuple[Cloud, Cloud, Frame]:
    """Both clouds in their frame, and the frame. Traceable.

    The scale is the root mean square of both clouds' radii: unlike the largest radius it is smooth and no single
    outlier sets it. A pair without extent keeps scale 1.

    Args:
      source: N points.
      target: M points.
      rough: what the source is moved by first.
    """
    rough = rigid.identity() if rough is None else rough
    source = source._replace(points=jnp.where(source.mask[:, None], rigid.apply(rough, source.points), 0.0))
    centers = centroid(source), centroid(target)
    source, target = shift(source, centers[0]), shift(target, centers[1])
    square = (mean_square_radius(source) + mean_square_radius(target)) / 2
    scale = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 1.0)
    frame = Frame(rough, *centers, scale)
    return shift(source, jnp.zeros(3), scale), shift(target, jnp.zeros(3), scale), frame


def normalize_on_host(source: np.ndarray, target: np.ndarray, rough: Rigid) -> tuple[np.ndarray, np.ndarray, Frame]:
    """``normalize_pair`` of real points (N, 3) and (M, 3), in NumPy float64: a far origin costs no digits."""
    rough = jax.tree.map(lambda part: np.asarray(part, np.float64), rough)
    turn, move = (np.asarray(part) for part in rough)
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if not np.array_equal(turn, np.eye(3)) or np.any(move):
        source = source @ turn.T + move
    centers = source.mean(axis=0), target.mean(axis=0)
    source, target = source - centers[0], target - centers[1]
    square = (np.mean(np.sum(source**2, axis=1)) + np.mean(np.sum(target**2, axis=1))) / 2
    scale = np.sqrt(square) if square > 0 else np.float64(1.0)
    return source / scale, target / scale, Frame(rough, *centers, scale)
