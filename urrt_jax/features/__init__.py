"""Local features of points: FPFH, by which the search matches, and moments, by which the network tells points apart."""

from urrt_jax.features.fpfh import fpfh
from urrt_jax.features.moments import moment_invariants

__all__ = ["fpfh", "moment_invariants"]
