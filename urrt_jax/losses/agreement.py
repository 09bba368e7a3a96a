"""Agreement of regions: high if the region of a point predicts that of its counterpart, and many regions are used.

That is the mutual information of both regions. If all points lie in one region it is zero, although regions agree.
"""

import jax
import jax.numpy as jnp
from jax import Array

_TINY = 1e-6  # of a probability


def region_pairs(source: Array, target: Array, weights: Array) -> Array:
    """How much of the weight lies in region i of the source and region j of the target, (n, n).

    Args:
      source: (M, n), the probability of every region for points of one cloud.
      target: (M, n), the same for the points of the other cloud that correspond to them.
      weights: (M,), how much a pair of points counts.
    """
    return jnp.matmul((source * weights[:, None]).T, target, precision=jax.lax.Precision.HIGHEST)


def mutual_information(pairs: Array) -> Array:
    """The mutual information in nats of the two regions of a pair of points, (); 0 where no pair counts.

    It is between 0 and ln n. The order of the clouds does not matter: the table is made symmetric first (Ji et al.
    2019, invariant information clustering, eq. 3).

    Args:
      pairs: (n, n), at least zero (``region_pairs``).

    Example:
      >>> import jax.numpy as jnp
      >>> round(float(mutual_information(jnp.eye(4)) / jnp.log(4)), 2)
      1.0
    """
    joint = (pairs + pairs.T) / 2
    total = jnp.sum(joint)
    joint = joint / jnp.where(total > 0, total, 1.0) + _TINY
    joint = joint / jnp.sum(joint)
    alone = jnp.sum(joint, axis=0)
    return jnp.sum(joint * (jnp.log(joint) - jnp.log(alone)[:, None] - jnp.log(alone)))
