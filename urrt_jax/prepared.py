"""A cloud prepared for registration: sorted, sampled, and measured once, for every stage that follows."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from urrt_jax.clouds import Cloud, centroid, curve_order, first, normals, subsample, take, thin
from urrt_jax.features import Constellations, constellations
from urrt_jax.neighbors import LARGE, LEAST_SPACING, Blocks, make_blocks, nearest, spacing, typical_distance

THINNED = 4096
"""Points of a thinned cloud: normals are made from them, and the first steps of a large pair's refinement."""
_SPACING_POINTS = 1024  # points at which the spacing of a large cloud is measured


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Sizes:
    """How many points the later stages ask for.

    Attributes:
      sample: points of the even subsample.
      queries: points of the cloud that look for their neighbours in the other one, at most.
      normal_radius: of the neighbourhood of a normal, in spacings of the thinned cloud.
    """

    sample: int = dataclasses.field(metadata={"static": True})
    queries: int = dataclasses.field(metadata={"static": True})
    normal_radius: Array | float


class Samples(NamedTuple):
    """What stands for a cloud at a fixed size, whatever its number of points.

    Attributes:
      even: an even subsample, farthest points first (``subsample``).
      spacing: (), the even subsample's resolution (``neighbors.spacing``), never 0.
      thinned: at most ``THINNED`` points whose density follows the cloud's, along the curve (``thin``).
      constellations: points that are known again where the other cloud holds them, too; none where ``thinned`` is not
        the whole cloud.
    """

    even: Cloud
    spacing: Array
    thinned: Cloud
    constellations: Constellations


class Prepared(NamedTuple):
    """A cloud of N points and what is known of it. Padding changes none of it.

    Attributes:
      cloud: its points along a space-filling curve, padding last.
      rows: (N,) int32, where each of these points stood in the cloud as it was given.
      count: (), how many points are real.
      blocks: what neighbours are searched in, where the cloud is large.
      spacing: (), its resolution (``neighbors.spacing``), never 0.
      samples: subsamples of fixed sizes.
      queries: at most as many of its points as ``Sizes`` says, whose density follows the cloud's.
      normals: (Q, 3), unit normals at these.
    """

    cloud: Cloud
    rows: Array
    count: Array
    blocks: Blocks | None
    spacing: Array
    samples: Samples
    queries: Cloud
    normals: Array


def prepare(sizes: Sizes, cloud: Cloud) -> Prepared:
    """The prepared cloud, of one in units of its radius (``frames``)."""
    rows = curve_order(cloud.points, cloud.mask).astype(jnp.int32)
    cloud = take(cloud, rows)
    count = jnp.sum(cloud.mask)
    blocks = make_blocks(cloud, ordered=True) if cloud.points.shape[0] > LARGE else None
    measured = thin(cloud, _SPACING_POINTS, ordered=True)
    apart = nearest(measured.points, cloud, blocks=blocks, distinct=True, ordered=blocks is not None).squared
    width = jnp.maximum(typical_distance(apart, measured.mask), LEAST_SPACING)
    thinned, queries = (thin(cloud, size, ordered=True) for size in (THINNED, sizes.queries))
    radius = sizes.normal_radius * thinned_spacing(count, width)
    even = subsample(thinned, sizes.sample)
    known = thinned._replace(mask=thinned.mask & (count <= THINNED))
    if measured.points.shape != known.points.shape:  # else the same points
        apart = nearest(known.points, known, distinct=True).squared
    samples = Samples(
        even=even,
        spacing=jnp.maximum(spacing(even), LEAST_SPACING),
        thinned=first(thinned, THINNED),
        constellations=constellations(known, apart, width),
    )
    return Prepared(
        cloud=cloud,
        rows=rows,
        count=count,
        blocks=blocks,
        spacing=width,
        samples=samples,
        queries=queries,
        normals=normals(queries.points, thinned, radius, centroid(cloud)),
    )


def coarser(source: Prepared | Samples, target: Prepared | Samples) -> Array:
    """The spacing, (), of the coarser one of two clouds, or of the coarser one of their even subsamples."""
    return jnp.maximum(source.spacing, target.spacing)


def thinned_spacing(count: Array, width: Array, kept: int = THINNED) -> Array:
    """The spacing, (), of a thinned cloud: on a surface, it grows as the square root of the points left out.

    Args:
      count: (), points of the whole cloud.
      width: (), the spacing of the whole cloud.
      kept: how many points the thinned cloud has, at most.
    """
    return width * jnp.sqrt(jnp.maximum(1.0, count / kept)).astype(width.dtype)
