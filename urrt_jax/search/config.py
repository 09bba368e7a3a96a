"""How to search."""

import dataclasses

from urrt_jax.checks import check_positive, check_share, check_whole


@dataclasses.dataclass(frozen=True, kw_only=True)
class Search:
    """How to look for the pose among all poses. Lengths are in spacings of the subsample, so that units do not matter.

    Attributes:
      points: points of each cloud that are looked at.
      normal_radius: of the neighbourhood of a normal.
      feature_radius: of the neighbourhood of a feature.
      match_distance: two matches agree when the lengths between their ends differ by less than this, and a match
        agrees with a pose that brings its ends closer than this.
      matches: hypotheses from matched features, at most; 0 for none.
      support: matches that a hypothesis is made of, besides its first.
      landmarks: hypotheses from the network's landmarks, about; 0 for none.
      rotations: members of the cover of SO(3) at which the network makes a step: 0, 1 (the clouds as they are), 24 or
        60.
      max_angle: hypotheses that turn by more, in degrees, are not considered: shapes that are nearly symmetric often
        fit as well when turned around, and who knows better should say so. Turns count from ``register``'s ``initial``.
      preference: how much of the score, from 0 to 1, a turn by ``max_angle`` costs; smaller ones by their square. Among
        poses that fit alike, which symmetric shapes have, the one that turns less is then the better one.
      tried: hypotheses that are briefly refined.
      kept: those of them that are refined on the whole subsample.
      inlier_distance: beyond it a point counts as unmatched when poses are compared.
      quick: points of dense clouds (of eight times as many) that are looked at first, for a pose from matched features;
        0 for no such look.
      sure: the confidence in that pose, from 0 to 1, from which on it is the answer.
    """

    points: int = 1024
    normal_radius: float = 2.0
    feature_radius: float = 5.0
    match_distance: float = 1.5
    matches: int = 64
    support: int = 16
    landmarks: int = 256
    rotations: int = 0
    max_angle: float = 180.0
    preference: float = 0.0
    tried: int = 64
    kept: int = 4
    inlier_distance: float = 1.5
    quick: int = 512
    sure: float = 0.9

    def __post_init__(self) -> None:
        check_whole(self, points=16, matches=0, support=3, landmarks=0, tried=1, kept=1, quick=0)
        if type(self.rotations) is not int or self.rotations not in (0, 1, 24, 60):
            raise ValueError(f"rotations: expected 0, 1, 24 or 60, got {self.rotations!r}")
        if not self.matches + self.landmarks + self.rotations:
            raise ValueError("matches, landmarks and rotations: all are 0, which leaves no hypothesis")
        check_share(self, "preference")
        check_positive(
            self, "normal_radius", "feature_radius", "match_distance", "max_angle", "inlier_distance", "sure"
        )
