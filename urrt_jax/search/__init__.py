"""Global search: hypotheses from matched features and from the network's landmarks, the best of which are refined."""

from urrt_jax.search.config import Search
from urrt_jax.search.search import DENSE, Found, search_quickly, search_thoroughly

__all__ = ["DENSE", "Found", "Search", "search_quickly", "search_thoroughly"]
