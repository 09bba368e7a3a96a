"""Refinement: from a rough transform to an exact one."""

from urrt_jax.refine.icp import ICP, Refinement, icp

__all__ = ["ICP", "Refinement", "icp"]
