"""Occupancy: the self-supervised reconstruction loss that teaches the partition where the shape is.

Inside and outside come from a closed mesh where there is one (``urrt_jax.data.solid``), else from the cloud itself, as
a shell around its points.
"""

import jax
import jax.numpy as jnp
import optax
from jax import Array

from urrt_jax.clouds import Cloud
from urrt_jax.neighbors import nearest, spacing


def occupancy_loss(logits: Array, inside: Array, mask: Array | None = None) -> Array:
    """The mean binary cross-entropy of occupancy logits (Q,) against inside (Q,) bool, ().

    Args:
      logits: (Q,) the logit of lying inside.
      inside: (Q,) bool.
      mask: (Q,) bool, which queries count; None for all.
    """
    losses = optax.sigmoid_binary_cross_entropy(logits, inside.astype(logits.dtype))
    mask = jnp.ones(losses.shape, bool) if mask is None else mask
    return jnp.sum(jnp.where(mask, losses, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


def shell_samples(key: Array, cloud: Cloud, count: int, *, thickness: float = 1.0) -> tuple[Array, Array]:
    """Queries (count, 3) around a bare cloud and whether each lies in its shell, (count,) bool.

    A query is inside when its nearest point is closer than ``thickness`` times the cloud's own spacing. Half of the
    queries are drawn about points of the cloud, at one and at three spacings, so that both answers are common near
    the surface; the others fill the cube around the cloud.

    Args:
      key: random key.
      cloud: N points, centred.
      count: number of queries.
      thickness: half the shell's thickness, in multiples of ``spacing(cloud)``.
    """
    choose, spread, fill = jax.random.split(key, 3)
    step = jax.lax.stop_gradient(spacing(cloud))
    about = count // 2
    share = cloud.mask / jnp.maximum(jnp.sum(cloud.mask), 1)
    index = jax.random.choice(choose, cloud.points.shape[0], (about,), p=share)
    sigma = jnp.where(jnp.arange(about) % 2 == 0, 1.0, 3.0)[:, None] * step
    near = cloud.points[index] + sigma * jax.random.normal(spread, (about, 3))
    reach = 1.1 * jnp.max(jnp.abs(cloud.points))
    wide = jax.random.uniform(fill, (count - about, 3), minval=-reach, maxval=reach)
    queries = jnp.concatenate([near, wide])
    squared = nearest(queries, cloud).squared
    return queries, squared < (thickness * step) ** 2
