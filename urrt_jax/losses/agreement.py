"""Agreement of regions: high if the region of a point predicts that of its counterpart, and regions are even.

It is the mutual information of both regions. If all points lie in one region it is zero, although regions agree.
"""

import jax
import jax.numpy as jnp
from jax import Array

_TINY = 1e-7  # of a probability


def region_pairs(source: Array, target: Array, weights: Array) -> Array:
    """How much of the weight lies in region i of the source and region j of the target, (n, n).

    Args:
      source: (M, n), the probability of every region for points of one cloud.
      target: (M, n), the same for the points of the other cloud that correspond to them.
      weights: (M,), how much a pair of points counts.
    """
    return jnp.matmul((source * weights[:, None]).T, target, precision=jax.lax.Precision.HIGHEST)


def region_agreement(pairs: Array) -> Array:
    """The mutual information of both regions of a pair of points, (), in nats.

    It is between 0 and ln n; 0 where no pair counts. The order of the clouds does not matter: the table is made
    symmetric first (Ji et al. 2019, invariant information clustering: eq. 3).

    Args:
      pairs: (n, n), at least zero (``region_pairs``).

    Example:
      >>> import jax.numpy as jnp
      >>> round(float(region_agreement(jnp.eye(4)) / jnp.log(4)), 2)
      1.0
    """
    joint = (pairs + pairs.T) / 2
    total = jnp.sum(joint)
    usable = total > 0
    joint = joint / jnp.where(usable, total, 1.0) + _TINY
    joint = joint / jnp.sum(joint)
    alone = jnp.sum(joint, axis=0)
    together = jnp.sum(joint * jnp.log(joint))
    return jnp.where(usable, together - 2 * jnp.sum(alone * jnp.log(alone)), 0.0)
