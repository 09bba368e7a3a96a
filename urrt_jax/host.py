"""A pair of clouds on the host: stripped of padding, in its frame, padded to a rung, and the way back.

What happens here is NumPy in float64, so that a far origin (map coordinates) costs no digits.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from urrt_jax.assessment import moved_covariance, moved_information
from urrt_jax.clouds import Cloud
from urrt_jax.clouds.cloud import FARTHEST
from urrt_jax.frames import normalize_on_host
from urrt_jax.result import OtherPoses, Registration
from urrt_jax.rigid import Rigid
from urrt_jax.stages import Outputs, Told

_ALIKE = 5.0  # a guess: parts of one object that overlap by a fifth seldom differ more in size
_UNITS = {"centimetres": 100.0, "millimetres": 1000.0, "inches": 39.37}  # how many of them make a metre
_NEAR = 0.3  # of the logarithm: two scans of one object differ by up to a third in size


class PairOnHost:
    """One pair as NumPy arrays, in its frame, and the way back to the arrays that were given.

    Attributes:
      frame: the frame.
      size: how many real points the larger cloud has.
      dtype: of the arrays that the stages get: float32, unless JAX arrays of float64 were given.
      told: what else is known of the pair.
    """

    def __init__(
        self,
        source: Any,
        target: Any,
        source_mask: Any = None,
        target_mask: Any = None,
        initial: Any = None,
        inlier_distance: Any = None,
    ) -> None:
        """Arguments as for ``register``, of which all but the extent of the clouds has been checked.

        Raises:
          ValueError: a cloud is too large for float32.
        """
        arrays = np.asarray(source), np.asarray(target)
        masks = source_mask, target_mask
        self._lengths = len(arrays[0]), len(arrays[1])
        self._rows = [None if mask is None else np.flatnonzero(np.asarray(mask)) for mask in masks]
        real = [array if rows is None else array[rows] for array, rows in zip(arrays, self._rows, strict=True)]
        for points, name in zip(real, ("source", "target"), strict=True):
            _refuse_far(points, name)
        matrix: Any = np.eye(4) if initial is None else np.asarray(initial, np.float64)
        left, _, right = np.linalg.svd(matrix[:3, :3])
        turn: Any = left @ right  # as given, it may be rounded
        *self._points, self.frame = normalize_on_host(real[0], real[1], Rigid(turn, matrix[:3, 3]))
        self.size = max(map(len, real))
        given = (each.dtype for each in (source, target) if isinstance(each, jax.Array))
        self.dtype = np.dtype(np.float64 if any(each == np.float64 for each in given) else np.float32)
        step = max(np.spacing(np.abs(points).max().astype(np.float32)) if is_short(points) else 0.0 for points in real)
        asked = 0.0 if inlier_distance is None else float(np.asarray(inlier_distance))
        self.told = Told(
            has_initial=np.bool_(initial is not None),
            offset=((self.frame.source_center - self.frame.target_center) / self.frame.scale).astype(self.dtype),
            initial_is_finite=np.bool_(True),
            inlier_distance=self.dtype.type(asked / self.frame.scale),
            grid=self.dtype.type(step / self.frame.scale),
        )

    def padded(self, size: int) -> tuple[Cloud, Cloud, Told]:
        """Both clouds in the frame, padded to ``size`` rows, and what else is known."""
        clouds = []
        for points in self._points:
            padded: Any = np.zeros((size, 3), self.dtype)
            padded[: len(points)] = points
            mask: Any = np.arange(size) < len(points)
            clouds.append(Cloud(padded, mask))
        return clouds[0], clouds[1], self.told

    def units_hint(self) -> str | None:
        """A question about units where one cloud is more than five times as large as the other, else None."""
        source, target = map(_radius, self._points)
        larger, smaller = ("source", "target") if source > target else ("target", "source")
        ratio = max(source, target) / max(min(source, target), 1e-30)
        if ratio <= _ALIKE:
            return None
        unit = next((name for name, size in _UNITS.items() if abs(np.log(ratio / size)) < _NEAR), "another unit")
        return f"the {larger} is far larger than the {smaller}, scale ratio {ratio:.4g}: is one in {unit}?"

    def restore(self, outputs: Outputs) -> Registration:
        """The result, as NumPy arrays, in the user's frame and rows; float64 where it depends on an origin."""
        scale, report = self.frame.scale, outputs.report
        *alternatives, weight = report.alternatives
        poses = outputs.transform, outputs.coarse, Rigid(*alternatives)
        poses = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), poses)
        pose, coarse, others = (self._rounded(self.frame.leave(each)) for each in poses)
        stretch = np.array([1.0, 1.0, 1.0, scale, scale, scale])
        matrix: Any = np.asarray(report.information, np.float64) * stretch * stretch[:, None]
        units = stretch[::-1]
        covariance: Any = np.asarray(report.covariance, np.float64) * units * units[:, None]
        center = np.asarray(self.frame.target_center)
        found = report.correspondences[: len(self._points[0])]
        if self._rows[1] is not None:
            found = np.where(found >= 0, self._rows[1][found], -1)

        def plain(value: Any) -> Any:
            return np.asarray(value, self.dtype)

        return Registration(
            rotation=pose.rotation,
            translation=pose.translation,
            fitness=plain(report.fitness),
            rmse=plain(report.rmse * scale),
            inlier_distance=plain(report.inlier_distance * scale),
            overlap=plain(report.overlap),
            confidence=plain(report.confidence),
            converged=np.asarray(report.converged),  # type: ignore[arg-type]
            outcome=np.asarray(report.outcome),  # type: ignore[arg-type]
            correspondences=self._in_given_rows(found, 0, -1),
            information=moved_information(matrix, center),
            covariance=moved_covariance(covariance, center),
            alternatives=OtherPoses(*others, plain(weight)),
            source_regions=self._in_given_rows(outputs.source_regions, 0, 0),
            target_regions=self._in_given_rows(outputs.target_regions, 1, 0),
            coarse=coarse,
            steps=np.asarray(outputs.steps),  # type: ignore[arg-type]
        )

    def _rounded(self, pose: Rigid) -> Rigid:
        """The transform with a rotation of the given dtype, which carries the source's centroid to the same place.

        Far from the origin the translation has to be that of the rounded rotation.
        """
        rough, turn = self.frame.rough, np.asarray(pose.rotation, self.dtype)
        centroid = rough.rotation.T @ (self.frame.source_center - rough.translation)
        return Rigid(turn, pose.translation + (pose.rotation - turn.astype(np.float64)) @ centroid)  # type: ignore[arg-type]

    def _in_given_rows(self, values: Any, side: int, fill: int) -> Any:
        """The values of the real points, (N,) int32, where these stood in the cloud as it was given."""
        values, rows = np.asarray(values[: len(self._points[side])], np.int32), self._rows[side]
        if rows is None:
            return values
        whole = np.full(self._lengths[side], fill, np.int32)
        whole[rows] = values
        return whole


def abstract_pair(size: int, dtype: DTypeLike = np.float32, batch: int | None = None) -> tuple[Cloud, Cloud, Told]:
    """What ``PairOnHost.padded`` returns, without values; of a batch, if one is asked for."""
    lead = () if batch is None else (batch,)

    def array(shape: tuple[int, ...], kind: DTypeLike) -> Any:
        return jax.ShapeDtypeStruct((*lead, *shape), kind)

    cloud = Cloud(array((size, 3), dtype), array((size,), bool))
    return cloud, cloud, Told(array((), bool), array((3,), dtype), array((), bool), array((), dtype), array((), dtype))


def _radius(points: np.ndarray) -> float:
    """The median distance of the points from their median: stray points do not change it."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def is_exact(points: Any) -> bool:
    """Whether these are host numbers of more digits than float32."""
    return not isinstance(points, jax.Array) and not is_short(points)


def is_short(points: Any) -> bool:
    """Whether these are an array of float32 or shorter numbers."""
    dtype = getattr(points, "dtype", None)
    return dtype is not None and jnp.issubdtype(dtype, jnp.floating) and jnp.finfo(dtype).bits <= 32


def _refuse_far(points: np.ndarray, name: str) -> None:
    """Raises a ``ValueError`` where coordinates lie too far from their middle for float32 to hold their squares."""
    extent = np.ptp(points.astype(np.float64), axis=0).max()
    if not extent < FARTHEST:
        raise ValueError(
            f"{name}: the points spread over {extent:.3g}, more than the {FARTHEST:g} that float32 can hold"
        )
