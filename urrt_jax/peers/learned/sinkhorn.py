"""Soft one-to-one matches with outliers: Sinkhorn's normalisation of rows and columns in logarithms."""

import jax
import jax.numpy as jnp
from jax import Array


def sinkhorn(logits: Array, source_mask: Array, target_mask: Array, steps: int) -> Array:
    """Matches (N, M) in [0, 1]: the columns of real points add to at most 1, and their rows nearly so.

    A slack row and a slack column, whose logits start at zero, take the share of a point that has no counterpart
    (Yew and Lee 2020). One step makes every row add to 1, its slack included, and then every column; the
    slack row and the slack column are not normalised themselves. So columns are exact and rows converge. Padded points
    have no match.

    Args:
      logits: (N, M), finite.
      source_mask: (N,) bool, the real source points.
      target_mask: (M,) bool, the real target points.
      steps: how often rows and columns are normalised.
    """
    real = source_mask[:, None] & target_mask[None, :]
    # The slack entries stay finite, so that no sum is empty and derivatives are finite.
    logs = jnp.pad(jnp.where(real, logits, -jnp.inf), ((0, 1), (0, 1)))
    for _ in range(steps):
        logs = logs.at[:-1].add(-jax.nn.logsumexp(logs[:-1], axis=1, keepdims=True))
        logs = logs.at[:, :-1].add(-jax.nn.logsumexp(logs[:, :-1], axis=0, keepdims=True))
    return jnp.exp(logs[:-1, :-1])
