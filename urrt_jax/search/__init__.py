"""Global search: hypotheses from matched features and from the network's landmarks, the best of which are refined."""

from urrt_jax.search.config import Search
from urrt_jax.search.cover import rotation_cover
from urrt_jax.search.search import Found, search

__all__ = ["Found", "Search", "rotation_cover", "search"]
