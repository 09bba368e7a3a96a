"""The one call: from two clouds to the transform that aligns them, with honest diagnostics."""

import dataclasses
import warnings
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike

from urrt_jax import rigid
from urrt_jax.assessment import moved_covariance, moved_information
from urrt_jax.clouds import Cloud, CloudLike, as_array, check_cloud, first, make_cloud
from urrt_jax.frames import Frame, normalize_pair
from urrt_jax.host import PairOnHost, abstract_pair, is_exact
from urrt_jax.model.network import Model
from urrt_jax.programs import compile_ahead
from urrt_jax.refine import ICP
from urrt_jax.result import OtherPoses, Registration
from urrt_jax.rigid import Rigid
from urrt_jax.search import Search
from urrt_jax.stages import STEPS_BEFORE_REFINEMENT, Options, Outputs, Told, register_in_frame, rung
from urrt_jax.weights import load_model

_AUTO_PREFERENCE = 0.2  # chosen on training shapes, cropped and noisy ones among them, and on bunny pairs
_HIGHEST = jax.lax.Precision.HIGHEST
_UNEVEN = 1e-3  # what the entries of R Rᵀ may be off the identity's


def register(
    source: CloudLike,
    target: CloudLike,
    *,
    source_mask: ArrayLike | None = None,
    target_mask: ArrayLike | None = None,
    model: Model | None = None,
    refine: ICP | None = ICP(),
    search: Search | Literal["auto"] | None = "auto",
    initial: ArrayLike | None = None,
    inlier_distance: ArrayLike | None = None,
) -> Registration:
    """The rigid transform that carries ``source`` onto ``target``: ``target ≈ R @ source + t``.

    The 3D-URRT network estimates it from a subsample of both clouds, each about its centroid and both in units of their
    common radius; a search over all poses takes over where that does not fit; refinement makes it exact on the full
    clouds. The rotation is the same for any common unit and any origin of either cloud. A pure function: the same input
    gives the same answer, and ``jax.jit``, ``jax.vmap`` and ``jax.grad`` compose with it. Derivatives with respect to
    the clouds and to the numbers in ``refine`` are those of the refined pose, with correspondences held fixed. With
    ``refine=None, search=None`` they pass through the network's last step, and reach the model's parameters, too. The
    pose of a search without refinement has none.

    On arrays, each stage is compiled by itself, once for each rung of a ladder of sizes (256, 1,024, 4,096, 16,384, …
    points): the next pair of any sizes on that rung compiles nothing. ``warm_up`` compiles ahead of time and
    ``use_compilation_cache`` keeps compiled programs on disk. Inside ``jax.jit`` all stages become one program for the
    shapes at hand, which takes far longer to compile.

    Args:
      source: (N, 3) real numbers, any unit. NumPy float64 is centred before it becomes float32, and the translation of
        the result is then NumPy float64: a far origin (map coordinates) costs no digits. A cloud of Open3D, trimesh or
        pyvista is taken by its points, a mesh by its vertices (``urrt_jax.io.read_cloud`` samples its surface instead).
      target: (M, 3), the same unit.
      source_mask: (N,) bool, False for padding; None when every point is real.
      target_mask: (M,) bool.
      model: the network; the packaged one by default (``load_model``).
      refine: how to refine, after at most two of the network's steps; None returns the network's estimate after all of
        them, or the search's.
      search: how to look for the pose among all poses. "auto" searches only where the network's estimate, refined on a
        subsample of 512 points, does not fit; the farther it turns, the better it must fit. This check is cheap. A
        search takes about as long as the rest of the registration, and much longer where it must be compiled first.
        "auto" does nothing where ``refine`` is None. A ``Search`` always searches; None never does. Among poses that
        fit about alike "auto" prefers the one that turns less: a symmetric shape is not turned around. Small clouds
        (4,096 points) that hold the same points are aligned by these, and need no search.
      initial: (4, 4), a rough transform from source to target where one is known, as from odometry or a turntable: the
        network and the search begin with the source moved by it, and largest angles count from it. No derivative
        passes to it.
      inlier_distance: the distance that defines ``fitness`` and ``rmse``, in the input's units; by default 1.5 times
        the coarser cloud's spacing.

    Returns:
      A ``Registration``.

    Raises:
      ValueError: a cloud of the wrong shape or dtype, empty, with fewer than three distinct points or with values that
        are not finite or spread over more than 1e15; a mask of the wrong length; an inlier distance that is not
        positive; an initial transform that is not rigid. Under jit values can't be seen: points that are not finite or
        lie beyond ±1e15 are then ignored, and a cloud left without three points, or an initial transform that is not
        finite, is flagged by ``converged`` and ``outcome``.

    Example:
      >>> import numpy as np
      >>> import urrt_jax
      >>> from urrt_jax.data import demo_shape
      >>> source = demo_shape(200).astype(np.float64)
      >>> turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
      >>> result = urrt_jax.register(source, source @ turn.T + [0.0, 0.0, 5.0])
      >>> bool(result.converged), result.reason
      (True, 'converged')
      >>> np.asarray(result.matrix).round(3) + 0.0
      array([[ 0.8, -0.6,  0. ,  0. ],
             [ 0.6,  0.8,  0. ,  0. ],
             [ 0. ,  0. ,  1. ,  5. ],
             [ 0. ,  0. ,  0. ,  1. ]])

    Warns:
      UserWarning: it has not converged, and one cloud is more than five times as large as the other, as where one is in
        millimetres and the other in metres. Not under jit.
    """
    source, target = as_array(source, "source"), as_array(target, "target")
    check_cloud(source, source_mask, "source")
    check_cloud(target, target_mask, "target")
    check_options(model, refine, search, inlier_distance)
    if initial is not None:
        check_rigid(initial)
    options = make_options(model, refine, search)
    arguments = source, target, source_mask, target_mask, initial, inlier_distance
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((options, arguments))):
        return _register_traced(options, *arguments)
    return _register_arrays(options, *arguments)


def make_options(model: Model | None, refine: ICP | None, search: Search | Literal["auto"] | None) -> Options:
    """What the stages are told of the user's choices."""
    model = load_model() if model is None else model
    if refine is not None:
        model, refine = model.at_most(STEPS_BEFORE_REFINEMENT), _with_floats(refine)
    if isinstance(search, Search):
        search = _with_floats(search)
    if search == "auto":
        return Options(model, refine, None if refine is None else Search(preference=_AUTO_PREFERENCE), always=False)
    return Options(model, refine, search, always=search is not None)


def _with_floats(options: Any) -> Any:
    """The same options with 90.0 for 90 where a float is meant: another dtype would compile all stages anew."""
    fields = [each.name for each in dataclasses.fields(options) if each.type is float]
    written = {name: float(getattr(options, name)) for name in fields if type(getattr(options, name)) is int}
    return dataclasses.replace(options, **written)


def _register_arrays(
    options: Options,
    source: Any,
    target: Any,
    source_mask: Any,
    target_mask: Any,
    initial: Any,
    inlier_distance: Any,
) -> Registration:
    """``register`` of arrays: padding is stripped, the frame is made in float64, and stages run on a rung."""
    pair = PairOnHost(source, target, source_mask, target_mask, initial, inlier_distance)
    result = register_on_host(options, pair)
    if not result.converged and (hint := pair.units_hint()):
        warnings.warn(hint, UserWarning, stacklevel=3)
    cast = jax.tree.map(lambda leaf: leaf.astype(pair.dtype) if leaf.dtype == np.float64 else leaf, result)
    device = jax.device_put(cast)  # jnp.asarray compiles a small program for each new shape
    if any(is_exact(points) for points in (source, target)):
        exact = ("translation", "information", "covariance")
        nested = {
            name: getattr(device, name)._replace(translation=getattr(result, name).translation)
            for name in ("coarse", "alternatives")
        }
        return dataclasses.replace(device, **{name: getattr(result, name) for name in exact}, **nested)
    return device


def register_on_host(options: Options, pair: PairOnHost) -> Registration:
    """The registration of one pair, as NumPy arrays in the user's frame; the translation is float64."""
    size = rung(pair.size)
    start_compiling(options, size, pair.dtype)
    return pair.restore(jax.device_get(register_in_frame(options, *pair.padded(size))))


def start_compiling(options: Options, size: int, dtype: np.dtype, batch: int | None = None) -> None:
    """Starts to compile the stages that most pairs of a rung need, side by side, if this process has not yet."""
    key = jax.tree.structure(options), size, dtype, batch
    compile_ahead(key, lambda: register_in_frame(options, *abstract_pair(size, dtype, batch), batch=batch))


def _register_traced(
    options: Options,
    source: Any,
    target: Any,
    source_mask: Any,
    target_mask: Any,
    initial: Any,
    inlier_distance: Any,
) -> Registration:
    """``register`` where something is traced: one composition of all stages."""
    source, source_origin = _near_origin(source, source_mask)
    target, target_origin = _near_origin(target, target_mask)
    if initial is not None:
        initial = _between_origins(initial, source_origin, target_origin)
    sizes = len(source), len(target)
    # Inside jit, also where vmap or grad stands between, a new constant is traced; under bare vmap or grad it is not.
    inside_jit = isinstance(jnp.zeros(()), Tracer)
    size = max(sizes) if inside_jit else rung(max(sizes))
    masks = (jnp.ones(len(points), bool) if mask is None else jnp.asarray(mask, bool) for points, mask in
             ((source, source_mask), (target, target_mask)))  # fmt: skip
    clouds = (first(Cloud(points, mask), size) for points, mask in zip((source, target), masks, strict=True))
    asked = jnp.asarray(0.0 if inlier_distance is None else inlier_distance, source.dtype)
    result = _register_padded(options, *clouds, initial, asked)
    forth = jnp.minimum(result.correspondences[: sizes[0]], sizes[1] - 1)
    result = dataclasses.replace(
        result,
        correspondences=forth,
        source_regions=result.source_regions[: sizes[0]],
        target_regions=result.target_regions[: sizes[1]],
    )
    return _from_origins(result, source_origin, target_origin)


@jax.jit
def _register_padded(
    options: Options, source: Cloud, target: Cloud, initial: Rigid | None, inlier_distance: Array
) -> Registration:
    step = jnp.maximum(*(_grid(cloud.points) for cloud in (source, target)))
    rough, usable = _usable(initial)
    source, target, frame = normalize_pair(make_cloud(*source), make_cloud(*target), rough)
    offset = (frame.source_center - frame.target_center) / frame.scale
    told = Told(jnp.array(initial is not None), offset, usable, inlier_distance / frame.scale, step / frame.scale)
    return _leave(frame, register_in_frame(options, source, target, told))


def _grid(points: Array) -> Array:
    """The step between numbers of the size of these coordinates in their dtype, ()."""
    size = jnp.max(jnp.where(jnp.isfinite(points), jnp.abs(points), 0.0))
    return jax.lax.stop_gradient(size * jnp.finfo(points.dtype).eps)


def _leave(frame: Frame, outputs: Outputs) -> Registration:
    """The result in the user's coordinates, under a trace (``PairOnHost.restore`` on arrays)."""
    scale, report = frame.scale, outputs.report
    pose, coarse = frame.leave(outputs.transform), frame.leave(outputs.coarse)
    *others, weight = report.alternatives
    alternatives = OtherPoses(*frame.leave(Rigid(*others)), weight)
    stretch = jnp.concatenate([jnp.ones(3, scale.dtype), jnp.full(3, scale)])
    matrix = moved_information(report.information * stretch * stretch[:, None], frame.target_center)
    units = stretch[::-1]
    covariance = moved_covariance(report.covariance * units * units[:, None], frame.target_center)
    lengths = {name: getattr(report, name) * scale for name in ("rmse", "inlier_distance")}
    return Registration(
        rotation=pose.rotation,
        translation=pose.translation,
        coarse=coarse,
        source_regions=outputs.source_regions,
        target_regions=outputs.target_regions,
        steps=jnp.asarray(outputs.steps),
        **{
            **report._asdict(),
            **lengths,
            "information": matrix,
            "covariance": covariance,
            "alternatives": alternatives,
        },
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


def _near_origin(points: Any, mask: Any) -> tuple[Array, np.ndarray | None]:
    """The points as they are traced, and the origin (3,) that was subtracted from host arrays of more digits."""
    if isinstance(points, jax.Array) or not is_exact(points):
        near = jnp.asarray(points)
        return near.astype(jnp.promote_types(near.dtype, jnp.float32)), None
    values = np.asarray(points, np.float64)
    real = values if mask is None or isinstance(mask, Tracer) else values[np.asarray(mask, bool)]
    origin = real.mean(axis=0)
    return jnp.asarray((values - origin).astype(np.float32)), origin


def _between_origins(initial: Any, source: np.ndarray | None, target: np.ndarray | None) -> Rigid:
    """A transform (4, 4) from source to target, as one between the clouds about these origins."""
    arrays = jnp if isinstance(initial, Tracer) else np
    values = arrays.asarray(initial, None if arrays is jnp else np.float64)
    origin_in, origin_out = (np.zeros(3) if origin is None else origin for origin in (source, target))
    shift = values[:3, 3] + values[:3, :3] @ origin_in - origin_out
    return Rigid(jnp.asarray(values[:3, :3], jnp.float32), jnp.asarray(shift, jnp.float32))


def _from_origins(result: Registration, source: np.ndarray | None, target: np.ndarray | None) -> Registration:
    """The result between the original coordinates, of one between the clouds about these origins."""
    if source is None and target is None:
        return result
    origin_in, origin_out = (np.zeros(3) if origin is None else origin for origin in (source, target))

    def shifted(pose: Registration | Rigid | OtherPoses) -> Array:
        return pose.translation + (
            origin_out - jnp.matmul(pose.rotation, jnp.asarray(origin_in, jnp.float32), precision=_HIGHEST)
        )

    return dataclasses.replace(
        result,
        translation=shifted(result),
        coarse=result.coarse._replace(translation=shifted(result.coarse)),
        alternatives=result.alternatives._replace(translation=shifted(result.alternatives)),
        information=moved_information(result.information, origin_out),
        covariance=moved_covariance(result.covariance, origin_out),
    )


def check_options(model: Any, refine: Any, search: Any, inlier_distance: Any) -> None:
    """Refuses, with a ``ValueError`` that names the argument, options of another kind."""
    if not (model is None or isinstance(model, Model)):
        raise ValueError(f"model: expected a Model, as load_model gives, got {model!r:.80}")
    if not (refine is None or isinstance(refine, ICP)):
        raise ValueError(f"refine: expected an ICP or None, got {refine!r:.80}")
    if not (search is None or isinstance(search, Search) or (isinstance(search, str) and search == "auto")):
        raise ValueError(f"search: expected a Search, 'auto' or None, got {search!r:.80}")
    if np.ndim(inlier_distance) != 0:
        raise ValueError(f"inlier_distance: expected one number, got shape {np.shape(inlier_distance)}")
    known = inlier_distance is not None and not isinstance(inlier_distance, Tracer)
    if known and not np.all(np.asarray(inlier_distance) > 0):
        raise ValueError(f"inlier_distance: expected a positive length, got {inlier_distance}")


def check_rigid(initial: ArrayLike) -> None:
    """Refuses, with a ``ValueError``, what is no rigid transform (4, 4); values are looked at if they are concrete."""
    if np.shape(initial) != (4, 4):
        raise ValueError(f"initial: expected shape (4, 4), got {np.shape(initial)}")
    if isinstance(initial, Tracer):
        return
    values = np.asarray(initial, np.float64)
    turn, bottom = values[:3, :3], values[3]
    rigid_enough = np.all(np.abs(turn @ turn.T - np.eye(3)) < _UNEVEN) and np.linalg.det(turn) > 0
    if not (np.all(np.isfinite(values)) and rigid_enough and np.allclose(bottom, [0, 0, 0, 1])):
        raise ValueError(f"initial: expected a rotation and a translation above [0, 0, 0, 1], got {values.tolist()}")
