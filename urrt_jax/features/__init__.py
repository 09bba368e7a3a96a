"""Local features of points, for matching."""

from urrt_jax.features.fpfh import fpfh

__all__ = ["fpfh"]
