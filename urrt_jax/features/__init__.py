"""Local features of points.

FPFH, by which the search matches; moments, by which the network tells points apart; and constellations, by which points
that both clouds hold are known again.
"""

from urrt_jax.features.constellations import Constellations, constellations
from urrt_jax.features.fpfh import fpfh, turned_around
from urrt_jax.features.moments import moment_invariants

__all__ = ["Constellations", "constellations", "fpfh", "moment_invariants", "turned_around"]
