"""Global search: hypotheses from matched features and from the network's landmarks, the best of which are refined.

Where both clouds hold the same points, ``find_counterparts`` finds the pose without a search.
"""

from urrt_jax.search.config import Search
from urrt_jax.search.counterparts import find_counterparts
from urrt_jax.search.search import (
    DENSE,
    FINALISTS,
    Found,
    choose_finalist,
    cost,
    judge_quick_look,
    preference_among,
    search_quickly,
    search_thoroughly,
)

__all__ = [
    "DENSE",
    "FINALISTS",
    "Found",
    "Search",
    "choose_finalist",
    "cost",
    "find_counterparts",
    "judge_quick_look",
    "preference_among",
    "search_quickly",
    "search_thoroughly",
]
