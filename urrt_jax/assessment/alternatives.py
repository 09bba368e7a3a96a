"""Other poses in which two clouds lie on each other about as well: what symmetry looks like, exact or nearly so.

The source, where registration has put it, is turned about the centre of both clouds: by rotations that cover all of
them evenly, and in fine steps about the principal axes, which an axis of symmetry is one of. Each turn is rated through
a coarse grid that holds how near every place is to a cloud. The best few are refined and compared with the pose itself,
point by point.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax import rigid
from urrt_jax.assessment.fit import squared_distances
from urrt_jax.clouds import Cloud, first
from urrt_jax.clouds.normals import least_axis
from urrt_jax.neighbors import LEAST_SPACING, nearest
from urrt_jax.prepared import Samples, coarser, thinned_spacing
from urrt_jax.refine.pairs import robust_weights
from urrt_jax.rigid import Rigid, cross, nearest_rotation, procrustes, quick_rotation

_HIGHEST = jax.lax.Precision.HIGHEST
# All numbers were chosen on training shapes and symmetric solids, for what they cost.
_EVENLY = 576  # rotations that cover all of them, about 25° apart
_LEAST = 30.0  # degrees: of these, smaller ones are left out
_ABOUT = np.arange(12.0, 349.0, 8.0)  # turns about a principal axis, in degrees: fine enough for a gear of 16 teeth
_CELLS = 16  # of the grid along each edge
_RATED = 32  # points of each cloud that rate a turn
_FIELD = 128  # points of each cloud that make its grid
_NEAR = 1.5  # spacings of these points within which a place counts as near
_REFINED, _DISTINCT = 6, 12.0  # turns that are refined, and the degrees between any two of them
_STEPS, _FEW = 8, 96  # of refinement, and the points of the source in it; the target has twice as many
_WIDTHS = 2.0, 0.75  # of refinement's weights at first and last, in spacings
_COMPARED = 256  # points of each cloud whose distances are compared
_SEEN = 1.0, 2.0, 3.0  # spacings within which they are
_SAME = 20.0  # degrees between poses that count as one; finer symmetries are found as multiples of their turn
_ALIKE = 0.005  # what is added to a standard error, so that poses of next to no difference are not told apart
_BLOCK = 8  # of neighbour searches for so many queries: larger ones are hardly faster, and compile longer
_MOST = 10.0  # significance is clipped to plus and minus this
KEPT = 4
"""Alternatives that are returned."""


class Alternatives(NamedTuple):
    """K other poses, best first.

    Attributes:
      poses: source to target, rotations (K, 3, 3) and translations (K, 3).
      significance: (K,), by how many standard errors the pose itself agrees better, from -10 to 10; 10 where there is
        no such pose. Agreement is the mean of max(0, 1 − d²/w²) over the points of a cloud, and of both clouds, d being
        the distance to the other cloud and w one, two or three spacings: whichever tells the two poses apart best.
    """

    poses: Rigid
    significance: Array

    @property
    def there(self) -> Array:
        """(K,), bool, whether there is such a pose."""
        return self.significance < _MOST


def find_alternatives(source: Samples, target: Samples, transform: Rigid) -> Alternatives:
    """Other poses in which the even samples of two clouds agree best; no derivative passes.

    Args:
      source: samples of the source, in units of the clouds' radius.
      target: samples of the target.
      transform: the pose itself, source to target.
    """
    source, target, transform = jax.lax.stop_gradient((source, target, transform))
    # Into a frame about the centre of both clouds, along their principal axes, in which turns are constants.
    moved = _moved(transform, source.even)
    axes, centre = _principal_frame(moved, target.even)
    into = Rigid(axes.T, -rigid.rotate(axes.T, centre))
    clouds = _moved(into, moved), _moved(into, target.even)
    turns = _best_turns(_rate(clouds, _NEAR * _coarse_spacing(source, target, _FIELD)))
    refined = _refine(turns, clouds, _coarse_spacing(source, target, _FEW))
    significance = _compare(refined, clouds, coarser(source, target))
    rows, distinct = _distinct(refined, significance)
    best = jax.tree.map(lambda leaf: leaf[rows], refined)
    there = rigid.inverse(into)
    poses = jax.vmap(lambda turn: rigid.compose(there, rigid.compose(turn, rigid.compose(into, transform))))(best)
    return Alternatives(poses, jnp.where(distinct, significance[rows], _MOST))


def _moved(transform: Rigid, cloud: Cloud) -> Cloud:
    return Cloud(jnp.where(cloud.mask[:, None], rigid.apply(transform, cloud.points), 0.0), cloud.mask)


def _principal_frame(source: Cloud, target: Cloud) -> tuple[Array, Array]:
    """Principal axes of both clouds together, the columns of a rotation, any where there are none; and their centre."""
    points, mask = (jnp.concatenate(both) for both in zip(source, target, strict=True))
    centre = jnp.matmul(mask / jnp.maximum(jnp.sum(mask), 1), points, precision=_HIGHEST)
    centred = jnp.where(mask[:, None], points - centre, 0.0)
    moment = jnp.matmul(centred.T, centred, precision=_HIGHEST)
    least, greatest = jax.vmap(least_axis)(
        jnp.stack([moment, jnp.trace(moment) * jnp.eye(3, dtype=moment.dtype) - moment])
    )
    return nearest_rotation(jnp.stack([greatest, cross(least, greatest), least], axis=1)), centre


def _coarse_spacing(source: Samples, target: Samples, count: int) -> Array:
    """The spacing, (), of the coarser one of the first ``count`` points of two even samples."""
    return jnp.maximum(*(thinned_spacing(jnp.sum(each.even.mask), each.spacing, count) for each in (source, target)))


def _rate(clouds: tuple[Cloud, Cloud], near: Array) -> Array:
    """How well the clouds agree after each of the ``_TURNS``, (T,), in both directions.

    Args:
      clouds: source and target, in the frame of the turns.
      near: (), the distance from which on a place does not count as near.
    """
    extent = jnp.maximum(jnp.max(jnp.abs(jnp.stack([each.points for each in clouds]))), LEAST_SPACING)
    steps = extent * ((jnp.arange(_CELLS) + 0.5) * (2 / _CELLS) - 1)
    places = jnp.stack(jnp.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    sides = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(first(each, _FIELD) for each in clouds))
    # The target's points, seen from the source, turn back.
    turns = jnp.stack([_TURNS.swapaxes(1, 2), _TURNS]).astype(near.dtype)

    def rate(side: Array) -> Array:
        asked, other = jax.tree.map(lambda leaf: leaf[side], sides), jax.tree.map(lambda leaf: leaf[1 - side], sides)
        squared = nearest(places, other, block=_BLOCK).squared
        grid = jnp.maximum(1 - squared / near**2, 0.0)
        turned = jnp.matmul(asked.points[:_RATED], turns[side], precision=_HIGHEST)
        cells = jnp.clip(jnp.floor((turned / extent + 1) * (_CELLS / 2)).astype(jnp.int32), 0, _CELLS - 1)
        nearness = grid[(cells[..., 0] * _CELLS + cells[..., 1]) * _CELLS + cells[..., 2]]
        mask = asked.mask[:_RATED]
        return jnp.matmul(nearness, mask / jnp.maximum(jnp.sum(mask), 1))

    return jnp.sum(jax.lax.map(rate, jnp.arange(2)), axis=0)


def _best_turns(ratings: Array) -> Array:
    """The best-rated turns, (K, 3, 3), none within 12° of another; of those about an axis only peaks count."""
    about = ratings[-3 * len(_ABOUT) :].reshape(3, -1)
    beside = jnp.maximum(*(jnp.pad(about, ((0, 0), (1, 1)))[:, k : k + len(_ABOUT)] for k in (0, 2)))
    ratings = ratings.at[-3 * len(_ABOUT) :].set(jnp.where(about >= beside, about, -1.0).ravel())
    turns = jnp.asarray(_TURNS, ratings.dtype)

    def pick(ratings: Array, _: None) -> tuple[Array, Array]:
        best = turns[jnp.argmax(ratings)]
        near = jnp.sum(turns * best, axis=(1, 2)) > 1 + 2 * jnp.cos(jnp.deg2rad(_DISTINCT))
        return jnp.where(near, -2.0, ratings), best

    return jax.lax.scan(pick, ratings, None, length=_REFINED)[1]


def _refine(turns: Array, clouds: tuple[Cloud, Cloud], spacing: Array) -> Rigid:
    """Where a few steps of robust ICP lead from each of these turns (K, 3, 3).

    The same for all, step by step, which takes a third of the time of ``refine.anneal``, whose runs end one by one.
    """
    few, more = first(clouds[0], _FEW), first(clouds[1], 2 * _FEW)
    starts = Rigid(turns, jnp.zeros((len(turns), 3), turns.dtype))

    def step(poses: Rigid, width: Array) -> tuple[Rigid, None]:
        placed = jax.vmap(rigid.apply, (0, None))(poses, few.points)
        index, squared = nearest(placed.reshape(-1, 3), more, block=_BLOCK)
        squared = jnp.where(few.mask, squared.reshape(placed.shape[:2]), jnp.inf)
        counterparts = more.points[index].reshape(placed.shape)
        weights = robust_weights(squared, width)
        new = jax.vmap(partial(procrustes, turn=quick_rotation), (None, 0, 0))(few.points, counterparts, weights)
        # Three correspondences determine a pose; with fewer it stays.
        paired = jnp.sum(weights > 0, axis=1) >= 3
        new = jax.tree.map(lambda a, b: jnp.where(paired.reshape(-1, *(1,) * (a.ndim - 1)), a, b), new, poses)
        return new, None

    widths = spacing * jnp.asarray(np.geomspace(*_WIDTHS, _STEPS), spacing.dtype)
    return jax.lax.scan(step, starts, widths)[0]


def _compare(turns: Rigid, clouds: tuple[Cloud, Cloud], spacing: Array) -> Array:
    """By how many standard errors the clouds agree better without each turn, (K,).

    Agreement is a mean over points, so the scatter of what they add to the difference tells its error. Seen within one
    spacing it tells poses apart that differ by little, within three those that differ in few points. A turn after which
    nothing is near is no alternative: 10.
    """
    asked = tuple(first(each, _COMPARED) for each in clouds)
    every = jax.tree.map(
        lambda own, others: jnp.concatenate([own[None].astype(others.dtype), others]), rigid.identity(), turns
    )
    squared, masks = squared_distances(every, clouds, asked), jnp.stack([each.mask for each in asked])
    weights = masks / jnp.maximum(jnp.sum(masks, axis=1, keepdims=True), 1)

    def in_errors(width: Array) -> Array:
        near = jnp.where(masks[:, None], jnp.maximum(1 - squared / width**2, 0.0), 0.0)
        better = near[:, :1] - near[:, 1:]
        means = jnp.einsum("skq,sq->sk", better, weights, precision=_HIGHEST)
        squares = (better - means[..., None]) ** 2
        error = jnp.sqrt(jnp.einsum("skq,sq->k", squares, weights**2, precision=_HIGHEST)) / 2
        return jnp.where(jnp.any(near[:, 1:] > 0, axis=(0, 2)), jnp.mean(means, axis=0) / (error + _ALIKE), _MOST)

    return jnp.clip(jnp.max(jax.vmap(in_errors)(spacing * jnp.array(_SEEN, spacing.dtype)), axis=0), -_MOST, _MOST)


def _distinct(poses: Rigid, significance: Array) -> tuple[Array, Array]:
    """The rows (``KEPT``,) of the best poses, none turned within 20° of another or of none, and whether there is."""
    usable = rigid.rotation_angle(poses.rotation, jnp.eye(3)) > jnp.deg2rad(_SAME)
    return rigid.distinct(poses, jnp.where(usable, -significance, -jnp.inf), count=KEPT, apart=_SAME)


def _rotations_evenly(count: int) -> np.ndarray:
    """Rotations (count, 3, 3) that cover all of them evenly: super-Fibonacci spirals (Alexa 2022)."""
    slots = np.arange(count) + 0.5
    inner, outer = np.sqrt(slots / count), np.sqrt(1 - slots / count)
    one, other = (2 * np.pi * slots / turn for turn in (np.sqrt(2), 1.533751168755204288118041))
    x, y, z, w = inner * np.sin(one), inner * np.cos(one), outer * np.sin(other), outer * np.cos(other)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _rotations_about_axes(angles: np.ndarray) -> np.ndarray:
    """Rotations (3·A, 3, 3) about x, y and z by these angles (A,)."""
    cosine, sine, nothing = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    about_z = np.moveaxis(
        np.array([[cosine, -sine, nothing], [sine, cosine, nothing], [nothing, nothing, nothing + 1]]), -1, 0
    )
    return np.concatenate([np.roll(about_z, (k, k), (1, 2)) for k in (1, 2, 0)])


def _all_turns() -> np.ndarray:
    even = _rotations_evenly(_EVENLY)
    large = (np.trace(even, axis1=1, axis2=2) - 1) / 2 < np.cos(np.deg2rad(_LEAST))
    return np.concatenate([even[large], _rotations_about_axes(np.deg2rad(_ABOUT))])


_TURNS = _all_turns().astype(np.float32)
