"""How to refine."""

import dataclasses

from urrt_jax.checks import check_positive, check_share, check_whole


@dataclasses.dataclass(frozen=True, kw_only=True)
class ICP:
    """How to refine. Lengths are relative to the clouds, so that units do not matter.

    Attributes:
      coarse_points: points of the source in the first stage, which looks for the basin, point to point; twice as many
        of the target. 0 skips that stage.
      coarse_iterations: its iterations at most.
      reach: the first stage's weights fall to a quarter at this distance, in units of the clouds' radius; it shrinks
        from here to the spacing.
      points: points of each cloud that look for their neighbour in all of the other one, in the second stage.
      iterations: its iterations at most.
      inlier_distance: the second stage's weights fall to a quarter at this many spacings of the coarser cloud, after
        they have shrunk from the first stage's spacing; at less, down to a twentieth of it, where the pairs that count
        turn out to lie closer.
      plane: 1 measures distances to the neighbour's tangent plane, 0 to the neighbour; between them both count. Planes
        let samples of one surface slide on each other; points hold where planes don't.
      normal_radius: of the neighbourhood of a normal, in spacings.
      soft_points: clouds of at most so many points each end softly: every point pairs with every other, by how likely,
        in a third stage of as many iterations at most, where the second one found that points have no counterparts
        and that the clouds overlap whole. Time and memory grow with the square; 0 leaves it out.
      mutual: only pairs count that are each other's nearest, as far as the chosen points go.
      trim: only the nearest pairs count, as many as the overlap is estimated to hold.
      tolerance: a stage has converged when a step turns by less than this (radians) and moves by less than this share
        of the clouds' radius, and its weights hardly narrow any more.
    """

    coarse_points: int = 256
    coarse_iterations: int = 30
    reach: float = 0.4
    points: int = 2048
    iterations: int = 80
    inlier_distance: float = 1.0
    plane: float = 0.9
    normal_radius: float = 3.0
    soft_points: int = 640
    mutual: bool = False
    trim: bool = False
    tolerance: float = 5e-5

    def __post_init__(self) -> None:
        check_whole(self, coarse_points=0, coarse_iterations=1, points=3, iterations=1, soft_points=0)
        check_positive(self, "reach", "inlier_distance", "normal_radius", "tolerance")
        check_share(self, "plane")
