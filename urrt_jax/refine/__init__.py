"""Refinement: from a rough transform to an exact one.

``find_basin`` on even samples, ``settle_thinned`` for large pairs, ``settle`` on whole clouds, and ``expect`` (EM-ICP)
for small clouds without counterparts. ``differentiable_pose`` adds the derivatives of where they end.
"""

import jax
import jax.numpy as jnp

from urrt_jax.prepared import Prepared
from urrt_jax.refine.config import ICP
from urrt_jax.refine.em import expect, expected_pose
from urrt_jax.refine.icp import Settled, anneal, find_basin, settle, settle_thinned, settled_pose
from urrt_jax.rigid import Rigid

__all__ = ["ICP", "Settled", "anneal", "differentiable_pose", "expect", "find_basin", "settle", "settle_thinned"]


def differentiable_pose(refine: ICP, source: Prepared, target: Prepared, settled: Settled, expected: Settled) -> Rigid:
    """The transform at which refinement ended, with its derivatives; where none is taken, nothing is computed.

    Args:
      refine: how to refine.
      source: N points.
      target: N points.
      settled: what ``settle`` returned.
      expected: what ``expect`` made of that.
    """
    pose = settled_pose(refine, source, target, settled)
    if not refine.em_points:
        return pose
    likely = expected_pose(refine, source, target, pose, expected)
    return jax.tree.map(lambda one, other: jnp.where(settled.sparse, one, other), likely, pose)
