"""What every stage of a registration asks of a cloud, made once: its order along a curve, its blocks, its spacing."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from urrt_jax.geometry.blocks import Blocks
from urrt_jax.geometry.clouds import Cloud, thin
from urrt_jax.geometry.curve import curve_order
from urrt_jax.geometry.neighbors import LEAST_SPACING, searchable, spacing

_ASKED = 1024  # points at which the spacing of a large cloud is asked


class Prepared(NamedTuple):
    """A cloud and what is known of it.

    Attributes:
      cloud: N points.
      order: (N,), its rows along a space-filling curve; None for a small cloud.
      reference: what ``nearest`` searches: the blocks of a large cloud, a small cloud itself.
      spacing: (), its resolution (``spacing``), never 0.
    """

    cloud: Cloud
    order: Array | None
    reference: Cloud | Blocks
    spacing: Array

    def thin(self, count: int) -> Cloud:
        """``thin`` without another sort."""
        return thin(self.cloud, count, order=self.order)


def prepare(cloud: Cloud | Prepared) -> Prepared:
    """The cloud prepared; one that is already is returned as it is."""
    if isinstance(cloud, Prepared):
        return cloud
    order = curve_order(cloud.points, cloud.mask) if cloud.points.shape[0] > _ASKED else None
    reference = searchable(cloud, order)
    width = spacing(reference, sample=thin(cloud, _ASKED, order=order))
    return Prepared(cloud, order, reference, jnp.maximum(width, LEAST_SPACING))
