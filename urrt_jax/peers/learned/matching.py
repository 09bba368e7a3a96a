"""From features to counterparts: soft matches, whose means ``rigid.procrustes`` then aligns."""

import jax
import jax.numpy as jnp
from jax import Array

_HIGHEST = jax.lax.Precision.HIGHEST


def scaled_products(source: Array, target: Array) -> Array:
    """The products over √C, (N, M), of features (N, C) and (M, C): the logits of attention."""
    return jnp.matmul(source, target.T, precision=_HIGHEST) / jnp.sqrt(source.shape[-1])


def soft_matches(logits: Array, mask: Array) -> Array:
    """Softmax over the real target points: (N, M), rows add to 1.

    Args:
      logits: (N, M).
      mask: (M,) bool, the real target points.
    """
    return jax.nn.softmax(jnp.where(mask[None, :], logits, -jnp.inf), axis=-1)


def hard_matches(key: Array, logits: Array, mask: Array, temperature: Array) -> Array:
    """One target point for every source point, drawn by the softmax of its logits: (N, M), a one and zeros in a row.

    The derivative is that of the softmax at ``temperature`` with the same Gumbel noise: the straight-through
    Gumbel-softmax estimator (Jang et al. 2017). What row i draws depends on ``key``, i and its real logits alone.

    Args:
      key: random key.
      logits: (N, M).
      mask: (M,) bool, the real target points.
      temperature: ().
    """
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(logits.shape[0]))
    noise = jax.vmap(lambda row_key: jax.random.gumbel(row_key, logits.shape[1:], logits.dtype))(keys)
    soft = soft_matches((logits + noise) / temperature, mask)
    hard = jax.nn.one_hot(jnp.argmax(soft, axis=-1), logits.shape[1], dtype=logits.dtype)
    return soft + jax.lax.stop_gradient(hard - soft)


def soft_targets(matches: Array, target: Array) -> Array:
    """For every source point the mean of the target points (M, 3), weighted by its matches (N, M): (N, 3)."""
    return jnp.matmul(matches, target, precision=_HIGHEST)
