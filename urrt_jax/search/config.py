"""How to search."""

import dataclasses
from typing import Any

import jax

from urrt_jax.checks import check_positive, check_share, check_whole

_STATIC: Any = {"static": True}
_MOST = 4096  # rows of the matrices that are compared with each other: their squares must fit into memory


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Search:
    """How to look for the pose among all poses. Lengths are in spacings of the subsample, so that units do not matter.

    A pytree: whole numbers fix shapes and are static; the other numbers are leaves, whose values compile nothing anew.

    Example:
      >>> Search(max_angle=90.0, preference=0.2).kept
      4
      >>> Search(max_angle=-1.0)
      Traceback (most recent call last):
      ValueError: max_angle: expected a positive number, got -1.0

    Attributes:
      points: points of each cloud's subsample in the thorough search.
      normal_radius: of the neighbourhood of a normal.
      feature_radius: of the neighbourhood of a feature. Where both clouds have 4,096 points or more, features of 0.6 of
        it count as much.
      match_distance: two feature matches are compatible when the lengths between their ends differ by less than this; a
        match supports a pose that brings its ends closer than this.
      matches: the number of hypotheses from feature matches, at most; 0 for none.
      support: matches that a hypothesis is made of, besides its first.
      landmarks: the number of hypotheses from the network's landmarks, about; 0 for none.
      max_angle: hypotheses that turn by more, in degrees, are not considered. Nearly symmetric shapes often fit as well
        when they are turned around, and only the user can know better. Turns count from ``register``'s ``initial``.
      preference: the score, in [0, 1], that a turn by ``max_angle`` costs; smaller turns cost less, by their square.
        Among poses that fit alike, which symmetric shapes have, the one that turns least is then chosen. A tenth of it
        where both clouds have 4,096 points or more, which tell such poses apart.
      tried: hypotheses that are briefly refined.
      kept: those of them that are refined on the whole subsample; about four times as many where both clouds have 4,096
        points or more.
      inlier_distance: beyond it a point counts as unmatched when poses are compared.
      sure: the confidence, in [0, 1], in the pose of the quick look (at dense clouds, through few points and features
        alone) from which on it is taken and the thorough search is skipped; half of it, where most of the quick look's
        hypotheses end there.
    """

    points: int = dataclasses.field(default=1024, metadata=_STATIC)
    normal_radius: float = 2.0
    feature_radius: float = 5.0
    match_distance: float = 1.5
    matches: int = dataclasses.field(default=64, metadata=_STATIC)
    support: int = dataclasses.field(default=16, metadata=_STATIC)
    landmarks: int = dataclasses.field(default=256, metadata=_STATIC)
    max_angle: float = 180.0
    preference: float = 0.0
    tried: int = dataclasses.field(default=64, metadata=_STATIC)
    kept: int = dataclasses.field(default=4, metadata=_STATIC)
    inlier_distance: float = 1.5
    sure: float = 0.9

    def __post_init__(self) -> None:
        check_whole(self, most=_MOST, points=16, matches=0, support=3, landmarks=0, tried=1, kept=1)
        if not self.matches + self.landmarks:
            raise ValueError("matches and landmarks: both are 0, which leaves no hypothesis")
        check_share(self, "preference")
        check_positive(
            self, "normal_radius", "feature_radius", "match_distance", "max_angle", "inlier_distance", "sure"
        )
