"""What the surroundings of a point look like from any pose: invariants of Gaussian-weighted moments.

Around every point the cloud is weighed by a Gaussian, and the mass, the mean and the covariance of what it holds are
taken, over widths one octave apart. Turning and moving the cloud turns the means and covariances with it; what is kept
of them stays: traces, determinants and lengths, how the mass grows from width to width, angles between the means of two
widths, and the triple products of three.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.rigid import cross

_HIGHEST = jax.lax.Precision.HIGHEST
_ROWS = 64  # points a block
_FLAT = 1e-4  # added to what a root is taken of, whose slope is infinite at zero
_NEAR = 0.05  # of a width: means nearer than this have no direction
# About what the invariants are for points of a shape's surface, and how far they differ: per width trace, area, volume,
# reach and spread along it; then growths, cosines, triple products. Rough, and the same for all widths.
_USUAL = (1.4, 0.7, 0.4, 0.4, 0.45), 1.2, 0.65, 0.0
_DIFFERING = (0.35, 0.2, 0.15, 0.2, 0.2), 0.25, 0.4, 0.25
_NOTHING = 1e-6  # less mass than this is none
_FINEST = 0.1  # of the unit radius: about the distance of neighbours among 512 points of a surface


def invariant_count(octaves: int) -> int:
    """How many invariants ``moment_invariants`` gives of a point."""
    return 5 * octaves + sum(_between_widths(octaves))


def _between_widths(octaves: int) -> tuple[int, int, int]:
    """How many invariants compare widths: growths of the mass, cosines of two means, triple products."""
    return max(octaves - 1, 0), math.comb(octaves, 2), math.comb(octaves, 3)


def centred_invariants(invariants: Array, octaves: int) -> Array:
    """Invariants (..., ``invariant_count``) less what they usually are, divided by how far they usually differ."""
    usual, differing = (
        np.concatenate([np.tile(each, octaves), np.repeat(others, _between_widths(octaves))])
        for each, *others in (_USUAL, _DIFFERING)
    )
    return (invariants - jnp.asarray(usual, invariants.dtype)) / jnp.asarray(differing, invariants.dtype)


def moment_invariants(cloud: Cloud, octaves: int, places: Array | None = None) -> Array:
    """Invariants of the surroundings of every point under rigid motions, (N, ``invariant_count``), or of Q places.

    Widths of the Gaussians are 0.1, 0.2, 0.4, … of the frame's unit. All but the triple products, the last columns,
    are the same for a mirrored cloud; those change sign. They cost N² in time, N·Q for places. Zero for padding. A
    Gaussian about a place far from all points that holds next to nothing has no mean and no spread.

    Args:
      cloud: N points in a frame of unit radius (``normalize_pair``).
      octaves: how many widths.
      places: (Q, 3), on the cloud or off it, described instead of the cloud's own points; none of them is padding.
    """
    points, mask = cloud
    described = points if places is None else places
    if octaves == 0:
        return jnp.zeros((described.shape[0], 0), points.dtype)
    widths = [_FINEST * 2**octave for octave in range(octaves)]
    upper = jnp.array([0, 0, 0, 1, 1, 2]), jnp.array([0, 1, 2, 1, 2, 2])
    products = points[:, upper[0]] * points[:, upper[1]]
    moments = jnp.where(mask[:, None], jnp.concatenate([jnp.ones_like(points[:, :1]), points, products], axis=1), 0.0)
    squares = jnp.sum(points**2, axis=1)

    def weighted(block: Array) -> Array:
        away = squares + jnp.sum(block**2, axis=1, keepdims=True) - 2 * jnp.matmul(block, points.T, precision=_HIGHEST)
        # Of points far out rounding is left, but no distance is negative.
        away = jnp.maximum(away, 0.0) / 2
        # Half the width is the fourth power: one exponential for all. The barrier keeps XLA from undoing that.
        weights, totals = jax.lax.optimization_barrier(jnp.exp(-away / widths[-1] ** 2)), []
        for _ in widths:
            # A product for every width: stacked first, the weights would take longer than their exponentials.
            totals.append(jnp.matmul(weights, moments, precision=_HIGHEST))
            weights = (weights * weights) * (weights * weights)
        return jnp.stack(totals[::-1])

    # In blocks that stay in the cache; all N² weights at once take twice the time.
    count = described.shape[0]
    blocks = jnp.pad(described, ((0, -count % _ROWS), (0, 0))).reshape(-1, _ROWS, 3)
    totals = jnp.moveaxis(jax.lax.map(weighted, blocks), 1, 0).reshape(octaves, -1, moments.shape[1])[:, :count]
    # All octaves at once, (K, N): what follows is compiled once instead of once an octave.
    scale = jnp.array(widths, points.dtype)[:, None]
    # Of a point's own surroundings the mass is at least 1, its own.
    some = totals[..., 0] > _NOTHING
    mass = jnp.where(some, totals[..., 0], _NOTHING)
    mean = jnp.where(some[..., None], totals[..., 1:4] / mass[..., None], described)
    spread = (totals[..., 4:] / mass[..., None] - mean[..., upper[0]] * mean[..., upper[1]]) / scale[..., None] ** 2
    spread = jnp.where(some[..., None], spread, 0.0)
    xx, xy, xz, yy, yz, zz = jnp.moveaxis(spread, -1, 0)
    area = xx * yy + xx * zz + yy * zz - xy**2 - xz**2 - yz**2
    volume = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    offset = (mean - described) / scale[..., None]
    reach = jnp.sum(offset**2, axis=-1)
    offset = offset / jnp.sqrt(reach + _NEAR**2)[..., None]
    x, y, z = jnp.moveaxis(offset, -1, 0)
    along = xx * x**2 + yy * y**2 + zz * z**2 + 2 * (xy * x * y + xz * x * z + yz * y * z)
    size = jnp.sqrt(jnp.maximum(area, 0.0) + _FLAT), jnp.cbrt(jnp.maximum(volume, 0.0) + _FLAT)
    shapes = jnp.stack([xx + yy + zz, *size, jnp.sqrt(reach + _FLAT), along], axis=1).reshape(-1, count)

    logarithm = jnp.log(mass)
    pairs, triples = (
        np.array(list(itertools.combinations(range(octaves), number)), int).reshape(-1, number).T for number in (2, 3)
    )
    cosines = jnp.sum(offset[pairs[0]] * offset[pairs[1]], axis=-1)
    volumes = jnp.sum(offset[triples[0]] * cross(offset[triples[1]], offset[triples[2]]), axis=-1)
    columns = jnp.concatenate([shapes, logarithm[1:] - logarithm[:-1], cosines, volumes])
    return jnp.where(mask[:, None], columns.T, 0.0) if places is None else columns.T
