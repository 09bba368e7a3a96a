"""What the surroundings of a point look like from any pose: invariants of Gaussian-weighted moments.

Around every point the cloud is weighed by a Gaussian, and the mass, the mean and the covariance of what it holds are
taken, over widths one octave apart. Turning and moving the cloud turns the means and covariances with it; what is kept
of them stays: traces, determinants and lengths, how the mass grows from width to width, angles between the means of two
widths, and the triple products of three.
"""

import itertools

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.clouds import Cloud

_HIGHEST = jax.lax.Precision.HIGHEST
_ROWS = 64  # points a block
_FLAT = 1e-4  # added to what a root is taken of, whose slope is infinite at zero
_NEAR = 0.05  # of a width: means nearer than this have no direction
_FINEST = 0.1  # of the unit radius: about the distance of neighbours among 512 points of a surface


def invariant_count(octaves: int) -> int:
    """How many invariants ``moment_invariants`` gives of a point."""
    pairs, triples = octaves * (octaves - 1) // 2, octaves * (octaves - 1) * (octaves - 2) // 6
    return 5 * octaves + max(octaves - 1, 0) + pairs + triples


def moment_invariants(cloud: Cloud, octaves: int) -> Array:
    """Invariants (N, ``invariant_count``) of the surroundings of every point under rigid motions of the cloud.

    Widths of the Gaussians are 0.1, 0.2, 0.4, … of the frame's unit. All but the triple products, the last columns,
    are the same for a mirrored cloud; those change sign. They cost N² in time. Zero for padding.

    Args:
      cloud: N points in a frame of unit radius (``normalize_pair``).
      octaves: how many widths.
    """
    if octaves == 0:
        return jnp.zeros((cloud.points.shape[0], 0), cloud.points.dtype)
    points, mask = cloud
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
    count = points.shape[0]
    blocks = jnp.pad(points, ((0, -count % _ROWS), (0, 0))).reshape(-1, _ROWS, 3)
    totals = jnp.moveaxis(jax.lax.map(weighted, blocks), 1, 0).reshape(octaves, -1, moments.shape[1])[:, :count]
    shapes, offsets, masses = [], [], []
    for width, sums in zip(widths, totals, strict=True):
        mass = jnp.where(sums[:, 0] > 1e-6, sums[:, 0], 1.0)
        mean = sums[:, 1:4] / mass[:, None]
        spread = (sums[:, 4:] / mass[:, None] - mean[:, upper[0]] * mean[:, upper[1]]) / width**2
        xx, xy, xz, yy, yz, zz = spread.T
        area = xx * yy + xx * zz + yy * zz - xy**2 - xz**2 - yz**2
        volume = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
        offset = (mean - points) / width
        reach = jnp.sum(offset**2, axis=1)
        offset = offset / jnp.sqrt(reach + _NEAR**2)[:, None]
        x, y, z = offset.T
        along = xx * x**2 + yy * y**2 + zz * z**2 + 2 * (xy * x * y + xz * x * z + yz * y * z)
        shapes += [
            xx + yy + zz,
            jnp.sqrt(jnp.maximum(area, 0.0) + _FLAT),
            jnp.cbrt(jnp.maximum(volume, 0.0) + _FLAT),
            jnp.sqrt(reach + _FLAT),
            along,
        ]
        offsets.append(offset)
        masses.append(jnp.log(mass))
    rises = [wide - narrow for narrow, wide in itertools.pairwise(masses)]
    cosines = [jnp.sum(a * b, axis=1) for a, b in itertools.combinations(offsets, 2)]
    triples = [jnp.sum(a * jnp.cross(b, c), axis=1) for a, b, c in itertools.combinations(offsets, 3)]
    return jnp.where(mask[:, None], jnp.stack([*shapes, *rises, *cosines, *triples], axis=1), 0.0)
