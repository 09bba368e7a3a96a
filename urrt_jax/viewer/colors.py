"""The colours of clouds, regions and distances, the same in the figure and on the page."""

import numpy as np
from jax.typing import ArrayLike

SOURCE = (226, 92, 62)
TARGET = (140, 158, 180)
REGIONS = np.array(
    [
        (230, 92, 71), (38, 138, 135), (240, 168, 48), (112, 84, 168), (98, 161, 64), (214, 92, 148),
        (42, 103, 176), (150, 92, 52), (18, 176, 196), (172, 166, 36), (148, 40, 78), (236, 138, 110),
    ],
    np.uint8,
)  # fmt: skip
# From small distances to large ones, in equal steps. All stand out from white and from black.
DISTANCES = ((58, 105, 190), (48, 160, 178), (150, 190, 92), (244, 178, 56), (206, 58, 50))


def region_colors(labels: ArrayLike) -> np.ndarray:
    """One colour for every point, (N, 3) uint8 red, green, blue, by its region.

    Args:
      labels: (N,) non-negative integers, as ``Registration.source_regions``; from region 12 on the colours repeat.

    Raises:
      ValueError: labels that are not (N,) non-negative integers.
    """
    labels = np.asarray(labels)
    if labels.ndim != 1 or not np.issubdtype(labels.dtype, np.integer) or np.any(labels < 0):
        raise ValueError(f"labels: expected (N,) non-negative integers, got {labels.dtype} of shape {labels.shape}")
    return REGIONS[labels % len(REGIONS)]
