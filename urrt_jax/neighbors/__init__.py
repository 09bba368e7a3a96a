"""Nearest neighbours by direct differences: all pairs for small clouds, compact spatial blocks for large ones."""

from urrt_jax.neighbors.blocks import Blocks, make_blocks
from urrt_jax.neighbors.nearest import (
    LARGE,
    LEAST_SPACING,
    Neighbors,
    coarser_spacing,
    k_nearest,
    nearest,
    spacing,
    top_rows,
    typical_distance,
)

__all__ = [
    "LARGE",
    "LEAST_SPACING",
    "Blocks",
    "Neighbors",
    "coarser_spacing",
    "k_nearest",
    "make_blocks",
    "nearest",
    "spacing",
    "top_rows",
    "typical_distance",
]
