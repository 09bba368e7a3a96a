"""The one call: from two clouds to the transform that aligns them, with honest diagnostics."""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from urrt_jax.assessment import agreement, fit, information, inlier_share, moved_information, well_posed
from urrt_jax.geometry import rigid
from urrt_jax.geometry.clouds import (
    Cloud,
    check_cloud,
    denormalize_translation,
    make_cloud,
    normalize_pair,
    normalize_translation,
    subsample,
)
from urrt_jax.geometry.neighbors import coarser_spacing
from urrt_jax.geometry.prepared import Prepared, prepare
from urrt_jax.geometry.rigid import Rigid
from urrt_jax.model.network import Model, estimate, point_regions
from urrt_jax.origins import between_origins, check_rigid, near_origin
from urrt_jax.refine import ICP, icp
from urrt_jax.search import Search
from urrt_jax.search import search as find_pose
from urrt_jax.weights import load_model

STEPS_BEFORE_REFINEMENT = 2  # of the network, at most: refinement does the rest


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Registration:
    """The transform that carries source onto target, ``target ≈ rotation @ source + translation``, and how well.

    Under ``jax.vmap`` every array has a leading batch axis, and so have ``matrix``, ``transform`` and ``apply``.

    Attributes:
      rotation: (3, 3).
      translation: (3,), in the input's units.
      fitness: (), the share of source points whose nearest target point lies within ``inlier_distance`` after the
        transform (Open3D's definition); over all points, not the subsample.
      rmse: (), the root mean square distance of those inliers, in the input's units; 0 when there are none.
      inlier_distance: (), the distance that was used, in the input's units.
      overlap: (2,), the share of the source's points that lie within 1.5 spacings (the coarser cloud's) of the target,
        and of the target's (up to 4096 of them) that lie as near the source.
      confidence: (), from 0 to 1: how sure it is that the surfaces lie on each other rather than cross, by their
        overlap and by how many of the points that come near touch, and that they do so in no other pose, by how much
        less they agree after quarter and half turns; learned on training shapes. Low for symmetric ones.
      converged: (), bool: the input was finite and not collinear, refinement settled within its iterations (where
        there was refinement), and the confidence is at least 0.5.
      correspondences: (N,) int32, the row of the target's point nearest to every source point, -1 where none lies
        within ``inlier_distance``.
      information: (6, 6), of the pose, from these correspondences: Σ GᵀG, G = [I, −[q]×] at target points q, for small
        motions (translation, rotation vector) about the target's origin; what pose graphs take (Choi et al. 2015).
      source_regions: (N,) int32, the region of every source point (as aligned); 0 for padding and for model A.
      target_regions: (M,) int32, the same for the target.
      coarse: the network's own estimate: after at most two steps where refinement follows, which does the rest, and
        after as many as its configuration says where none does.
      steps: refinement's iterations in its last stage; 0 without refinement.
    """

    rotation: Array
    translation: Array
    fitness: Array
    rmse: Array
    inlier_distance: Array
    overlap: Array
    confidence: Array
    converged: Array
    correspondences: Array
    information: Array
    source_regions: Array
    target_regions: Array
    coarse: Rigid
    steps: Array

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


def register(
    source: ArrayLike,
    target: ArrayLike,
    *,
    source_mask: ArrayLike | None = None,
    target_mask: ArrayLike | None = None,
    model: Model | None = None,
    refine: ICP | None = ICP(),
    search: Search | Literal["auto"] | None = None,
    initial: ArrayLike | None = None,
    inlier_distance: ArrayLike | None = None,
) -> Registration:
    """The rigid transform that carries ``source`` onto ``target``: ``target ≈ R @ source + t``.

    The 3D-URRT network estimates it from a subsample of both clouds, centred and scaled together; refinement makes it
    exact on the full clouds. The rotation is the same for any common unit and any origin of either cloud. A pure
    function: the same input gives the same answer, and ``jax.jit``, ``jax.vmap`` and ``jax.grad`` compose with it.
    Derivatives with respect to the clouds pass through the last Procrustes step at fixed correspondences, or, without
    refinement, through the network's last step, then also to the model's parameters; a search without refinement has
    none.

    The network was trained on whole shapes turned by up to 45° about each axis: beyond that, and for scans that overlap
    in part, let ``search`` look among all poses.

    Args:
      source: (N, 3) real numbers, any unit. NumPy arrays of float64 or integers are centred before they become float32,
        and the translation of the result is then NumPy float64: a far origin (map coordinates) costs no digits.
      target: (M, 3), the same unit.
      source_mask: (N,) bool, False for padding; None when every point is real.
      target_mask: (M,) bool.
      model: the network; the packaged one by default (``load_model``).
      refine: how to refine, after at most two of the network's steps; None returns the network's estimate after all of
        them, or the search's. Static under jit.
      search: how to look for the pose among all poses (``Search()``); "auto" does so only where the plain result has
        not converged, and always under jit and vmap, where that can't be seen; None never does. Static under jit.
      initial: (4, 4), a rough transform from source to target where one is known, as from odometry or a turntable: the
        network and the search begin with the source moved by it, and largest angles count from it. No derivative
        passes to it.
      inlier_distance: the distance that defines ``fitness`` and ``rmse``, in the input's units; by default 1.5 times
        the coarser cloud's spacing.

    Returns:
      A ``Registration``.

    Raises:
      ValueError: a cloud of the wrong shape or dtype, empty, with fewer than three distinct points or with values that
        are not finite; a mask of the wrong length; an inlier distance that is not positive; an initial transform that
        is not rigid. Under jit values can't be seen: non-finite points are then ignored, and a cloud left without three
        points, or an initial transform that is not finite, is flagged by ``converged``.
    """
    check_cloud(source, source_mask, "source")
    check_cloud(target, target_mask, "target")
    if not (model is None or isinstance(model, Model)):
        raise ValueError(f"model: expected a Model, as load_model gives, got {model!r:.80}")
    if not (refine is None or isinstance(refine, ICP)):
        raise ValueError(f"refine: expected an ICP or None, got {refine!r:.80}")
    if not (search is None or search == "auto" or isinstance(search, Search)):
        raise ValueError(f"search: expected a Search, 'auto' or None, got {search!r:.80}")
    if np.ndim(inlier_distance) != 0:  # type: ignore[arg-type]
        raise ValueError(f"inlier_distance: expected one number, got shape {np.shape(inlier_distance)}")  # type: ignore[arg-type]
    known = inlier_distance is not None and not isinstance(inlier_distance, Tracer)
    if known and not np.all(np.asarray(inlier_distance) > 0):
        raise ValueError(f"inlier_distance: expected a positive length, got {inlier_distance}")
    if initial is not None:
        check_rigid(initial)
    model = load_model() if model is None else model
    if refine is not None:
        model = model.at_most(STEPS_BEFORE_REFINEMENT)
    source, source_origin = near_origin(source, source_mask, "source")
    target, target_origin = near_origin(target, target_mask, "target")
    begin = None if initial is None else between_origins(initial, source_origin, target_origin)

    def attempt(search: Search | None) -> Registration:
        return _register(source, target, source_mask, target_mask, model, begin, refine, search, inlier_distance)

    result = attempt(None if search == "auto" else search)
    if search == "auto" and (isinstance(result.converged, Tracer) or not bool(result.converged)):
        result = attempt(Search())
    return _restore_origins(result, source_origin, target_origin)


def _restore_origins(result: Registration, source: np.ndarray | None, target: np.ndarray | None) -> Registration:
    """The result between the original frames; its translations are then float64, on the host, unless it is traced."""
    if source is None and target is None:
        return result
    origin_in, origin_out = (np.zeros(3) if origin is None else origin for origin in (source, target))
    traced = isinstance(result.translation, Tracer)

    def shifted(rotation: Array, translation: Array) -> Any:
        if traced:
            return translation + (origin_out - rigid.rotate(rotation, jnp.asarray(origin_in, translation.dtype)))
        return np.asarray(translation, np.float64) + origin_out - np.asarray(rotation, np.float64) @ origin_in

    return dataclasses.replace(
        result,
        translation=shifted(result.rotation, result.translation),
        coarse=result.coarse._replace(translation=shifted(*result.coarse)),
        information=moved_information(result.information, origin_out),
    )


@functools.partial(jax.jit, static_argnames=("refine", "search"))
def _register(
    source_points: Array,
    target_points: Array,
    source_mask: Array | None,
    target_mask: Array | None,
    model: Model,
    initial: Rigid | None,
    refine: ICP | None,
    search: Search | None,
    inlier_distance: Array | None,
) -> Registration:
    begin, known = _usable(initial)
    if initial is not None:
        source_points = rigid.apply(begin, source_points)
    raw_source, raw_target = make_cloud(source_points, source_mask), make_cloud(target_points, target_mask)
    source, target, frame = normalize_pair(raw_source, raw_target)
    prepared = prepare(source), prepare(target)
    small = _even_samples(*prepared, model, refine, search)
    answer = estimate(model, *(jax.tree.map(lambda leaf: leaf[: model.config.points], cloud) for cloud in small))
    start, trusted = answer.transform, None
    if initial is not None:
        start = _better(start, Rigid(jnp.eye(3), normalize_translation(jnp.eye(3), jnp.zeros(3), frame)), small)
    if search is not None:
        start, _, trusted = find_pose(model, *prepared, search, start, small=small)
    if refine is None:
        transform, settled, steps = start, jnp.array(True), jnp.array(0)
    else:
        transform, settled, steps = icp(*prepared, start, refine, reach=trusted, small=small)

    asked = jnp.asarray(0.0 if inlier_distance is None else inlier_distance) / frame.scale
    found = fit(*prepared, transform, asked)
    reach = found.touching if inlier_distance is None else asked
    fitness, rmse = inlier_share(source.mask, found.squared, reach)
    inlier = source.mask & (found.squared <= reach**2)
    usable = known & well_posed(source) & well_posed(target) & jnp.all(jnp.isfinite(transform.translation))
    seen = rigid.apply(answer.seen, source.points)
    final, coarse = (
        rigid.compose(Rigid(each.rotation, denormalize_translation(*each, frame)), begin)
        for each in (transform, answer.transform)
    )
    return Registration(
        rotation=final.rotation,
        translation=final.translation,
        fitness=fitness,
        rmse=rmse * frame.scale,
        inlier_distance=reach * frame.scale,
        overlap=found.overlap,
        confidence=jnp.where(usable, found.confidence, 0.0),
        converged=usable & settled & (found.confidence >= 0.5),
        correspondences=jnp.where(inlier, found.nearest, -1),
        information=information(raw_target.points[found.nearest], inlier),
        source_regions=jnp.where(source.mask, point_regions(model, seen, answer.source), 0),
        target_regions=jnp.where(target.mask, point_regions(model, target.points, answer.target), 0),
        coarse=coarse,
        steps=steps,
    )


def _usable(initial: Rigid | None) -> tuple[Rigid, Array]:
    """The transform, without derivatives, and whether it is finite; the identity where it is not, or there is none."""
    nothing = rigid.identity()
    if initial is None:
        return nothing, jnp.array(True)
    finite = jnp.all(jnp.isfinite(initial.rotation)) & jnp.all(jnp.isfinite(initial.translation))
    rotation, translation = jax.tree.map(
        lambda leaf, other: jax.lax.stop_gradient(jnp.where(finite, leaf, other)), initial, nothing
    )
    return Rigid(rigid.nearest_rotation(rotation), translation), finite


def _better(first: Rigid, second: Rigid, small: tuple[Cloud, Cloud]) -> Rigid:
    """The one of two transforms after which the samples lie better on each other."""
    reach = coarser_spacing(*small)
    worse = agreement(first, small, small, reach) < agreement(second, small, small, reach)
    return jax.tree.map(lambda one, other: jnp.where(worse, other, one), first, second)


def _even_samples(
    source: Prepared, target: Prepared, model: Model, refine: ICP | None, search: Search | None
) -> tuple[Cloud, Cloud]:
    """Both clouds' farthest-point samples: large enough for the network, for refinement's and search's first stages."""
    count = max(
        model.config.points,
        0 if refine is None else 2 * refine.coarse_points,
        0 if search is None else search.quick,
    )
    return subsample(source.cloud, count, order=source.order), subsample(target.cloud, count, order=target.order)
