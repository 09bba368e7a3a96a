"""RIENet's objective, which needs no true pose: what one pass of it is judged by (Shen et al. 2022, section 3.4)."""

import jax.numpy as jnp
from jax import Array

from urrt_jax import rigid
from urrt_jax.clouds import Cloud
from urrt_jax.maxima import maximum
from urrt_jax.neighbors import nearest, top_rows
from urrt_jax.rigid import Rigid

_CHAMFER_SCALE = 0.01  # of squared distances; the released code's "loss margin"
_TINY = 1e-15  # keeps the logarithm finite


def alignment_loss(moved: Cloud, target: Cloud) -> Array:
    """The robust Chamfer distance, both ways, (): a sum over points, not a mean.

    Each squared distance x to the nearest point of the other cloud counts ½x² below 0.01 and linearly above.
    """

    def one_way(query: Cloud, reference: Cloud) -> Array:
        squared = jnp.where(query.mask, nearest(query.points, reference).squared, 0.0)
        far = _CHAMFER_SCALE * squared - _CHAMFER_SCALE**2 / 2
        return jnp.sum(jnp.where(squared < _CHAMFER_SCALE, squared**2 / 2, far))

    return one_way(moved, target) + one_way(target, moved)


def keypoints(weights: Array, mask: Array, count: int) -> tuple[Array, Array]:
    """The rows (K,) of the ``count`` real points of largest weight, K ≤ count, and which of them are real, (K,)."""
    rows = top_rows(jnp.where(mask, weights, -1.0), min(count, mask.shape[0]))
    return rows, mask[rows]


def consensus_loss(
    source: Array, matched: Array, rows: Array, neighbors: Array, edge_mask: Array, transform: Rigid, share: float
) -> Array:
    """How far keypoints and the edges around them miss what they were matched to, (): sums of squares.

    Args:
      source: (N, 3).
      matched: (N, 3), the soft targets.
      rows: (K,), the keypoints.
      neighbors: (K, k), the rows of each keypoint's neighbours.
      edge_mask: (K, k) bool, the real edges of real keypoints; the first is to the keypoint itself.
      transform: what this pass found.
      share: the weight of the edges.
    """
    # A moved point minus its soft target: its difference from that of a neighbour is the residual of the edge.
    residual = rigid.apply(transform, source) - matched
    of_points = jnp.where(edge_mask[:, :1], residual[rows], 0.0)
    of_edges = jnp.where(edge_mask[..., None], residual[rows][:, None] - residual[neighbors], 0.0)
    return jnp.sum(of_points**2) + share * jnp.sum(of_edges**2)


def match_loss(matches: Array, real: Array) -> Array:
    """The mean over keypoints of −log of each one's largest match, ().

    Args:
      matches: (K, M), the rows of the keypoints.
      real: (K,) bool.
    """
    return -jnp.sum(jnp.where(real, jnp.log(maximum(matches, 1) + _TINY), 0.0)) / jnp.maximum(jnp.sum(real), 1)
