"""Refinement: from a rough transform to an exact one."""

from urrt_jax.refine.config import ICP
from urrt_jax.refine.icp import Refinement, icp

__all__ = ["ICP", "Refinement", "icp"]
