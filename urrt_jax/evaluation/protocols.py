"""Protocols: pure functions from (clouds, item) to a pair with its truth, the same on every machine.

Draws come from NumPy's legacy generator, ``RandomState(item)``, in a fixed order, because that is how the published
protocols are defined. Target = R·source + t, with R = Rx·Ry·Rz.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation


class Trial(NamedTuple):
    """One pair and its truth.

    Attributes:
      source: (N, 3) float32.
      target: (M, 3) float32.
      rotation: (3, 3) float64.
      translation: (3,) float64.
    """

    source: np.ndarray
    target: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray


def draw_pose(random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """DCP's pose: three angles uniform in [0, 45°], about x, y, z in this order, then a translation in ±0.5."""
    x, y, z = (random.uniform() * np.pi / 4 for _ in range(3))
    translation = np.array([random.uniform(-0.5, 0.5) for _ in range(3)])
    return Rotation.from_euler("zyx", [z, y, x]).as_matrix(), translation


def dcp(clouds: np.ndarray, item: int, *, points: int = 1024) -> Trial:
    """DCP's clean pair (Wang and Solomon 2019): both clouds hold the same points, each in an order of its own.

    Args:
      clouds: (S, P, 3), shapes in the unit sphere.
      item: which shape; also the seed.
      points: the first so many of its points are used.
    """
    random = np.random.RandomState(item)
    rotation, translation = draw_pose(random)
    source = clouds[item, :points].astype(np.float64)
    target = source @ rotation.T + translation
    source, target = random.permutation(source), random.permutation(target)
    return Trial(source.astype(np.float32), target.astype(np.float32), rotation, translation)


PROTOCOLS: dict[str, Callable[..., Trial]] = {"dcp": dcp}
"""Every protocol by its name: a new one is a function and a line here."""
