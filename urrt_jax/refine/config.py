"""How to refine."""

import dataclasses
from typing import Any

import jax

from urrt_jax.checks import check_positive, check_share, check_whole

_STATIC: Any = {"static": True}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class ICP:
    """How to refine. Lengths are relative to the clouds, so that units do not matter.

    A pytree: ``coarse_points``, ``points`` and ``em_points`` fix shapes and are static; all other numbers are leaves,
    which may be traced, batched and differentiated, and whose values compile nothing anew.

    Example:
      >>> ICP(plane=0.0).iterations  # point to point
      80
      >>> ICP(plane=2.0)
      Traceback (most recent call last):
      ValueError: plane: expected a share from 0 to 1, got 2.0

    Attributes:
      coarse_points: points of the source in the coarse stage, which finds the basin of convergence, point to point;
        twice as many of the target. 0 skips that stage.
      coarse_iterations: the most iterations of the coarse stage.
      reach: the coarse stage's weights fall to a quarter at this distance, in units of the clouds' radius. The distance
        shrinks from here to the spacing of the subsample.
      points: points of each cloud that look for their nearest neighbour in the whole other cloud, in the fine stage.
      iterations: the most iterations of the fine stage.
      inlier_distance: the fine stage's weights fall to a quarter at this many spacings of the coarser cloud, after
        they have shrunk from the coarse stage's spacing. Where the correspondences turn out to be closer than that, the
        distance shrinks further, down to a twentieth.
      plane: the share, in [0, 1], of the distance to the neighbour's tangent plane; the rest is the distance to the
        neighbour itself. Planes let samples of one surface slide on each other; points hold where planes do not.
      normal_radius: the radius of the neighbourhood of a normal, in spacings.
      em_points: clouds with at most this many points get a further stage, EM-ICP, of at most ``iterations`` iterations,
        where the fine stage found that points have no counterparts and that the clouds overlap as a whole. Every
        source point is matched to all target points, weighted by likelihood. Time and memory grow with the square of
        the number of points; 0 leaves the stage out.
      tolerance: a stage has converged when a step turns by less than this (radians), moves by less than this share of
        the clouds' radius, and hardly changes the width of the weights.
    """

    coarse_points: int = dataclasses.field(default=256, metadata=_STATIC)
    coarse_iterations: int = 30
    reach: float = 0.4
    points: int = dataclasses.field(default=2048, metadata=_STATIC)
    iterations: int = 80
    inlier_distance: float = 1.0
    plane: float = 0.9
    normal_radius: float = 3.0
    em_points: int = dataclasses.field(default=640, metadata=_STATIC)
    tolerance: float = 5e-5

    def __post_init__(self) -> None:
        check_whole(self, coarse_points=0, coarse_iterations=1, points=3, iterations=1, em_points=0)
        check_positive(self, "reach", "inlier_distance", "normal_radius", "tolerance")
        check_share(self, "plane")
