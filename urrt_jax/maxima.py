"""Maxima whose derivative goes to one row.

That of ``jnp.max`` goes to all rows that equal the maximum. It is wrong where the compiler computes the rows a second
time with another rounding: then none of them, or another one, equals it.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def maximum(features: Array, axis: int) -> Array:
    """The maximum along an axis, which the result lacks; its derivative goes to the first row that has it."""
    return jnp.max(features, axis=axis)


@maximum.defjvp
def _maximum_jvp(axis: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (features,), (tangent,) = primals, tangents
    largest = jnp.argmax(features, axis=axis, keepdims=True)
    rows = jax.lax.broadcasted_iota(largest.dtype, features.shape, axis % features.ndim)

    def chosen(values: Array) -> Array:
        return jnp.sum(jnp.where(rows == largest, values, 0.0), axis=axis)

    # The value comes from the same rows: computing the maximum, too, would take longer.
    return chosen(features), chosen(tangent)


def masked_max(features: Array, mask: Array, axis: int = 0) -> Array:
    """The maximum over the real rows along an axis; ``mask`` has the shape of ``features`` without the last axis.

    −∞ where no row is real.
    """
    return maximum(jnp.where(mask[..., None], features, -jnp.inf), axis)
