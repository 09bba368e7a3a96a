"""A loop whose lanes do not wait for each other under ``vmap``."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap

_FEW, _MANY = 16, 256  # lanes at once: enough to fill a CPU; more for large batches, which accelerators want


def while_each(unfinished: Callable[[Any], Array], step: Callable[[Any, Any], Any], start: Any, context: Any) -> Any:
    """The state when ``unfinished(state)`` is false, of ``state = step(context, state)`` from ``start``.

    ``jax.lax.while_loop``, but for ``vmap``: there a plain loop goes on for all lanes until the slowest is done. Here a
    few lanes work at a time, and one that is done takes the next problem from the queue. Answers are the same. No
    derivative passes.

    Args:
      unfinished: of a state, (); closes over no traced value.
      step: of the context and the state; closes over no traced value.
      start: state, a pytree of arrays.
      context: what stays the same, a pytree of arrays.
    """

    @custom_vmap
    def run(start: Any, context: Any) -> Any:
        return jax.lax.while_loop(unfinished, lambda state: step(context, state), start)

    @run.def_vmap
    def run_queue(size: int, batched: Any, start: Any, context: Any) -> tuple[Any, Any]:
        start_batched, context_batched = batched
        start, context = jax.tree.map(jnp.asarray, (start, context))
        start = jax.tree.map(
            lambda leaf, has: leaf if has else jnp.broadcast_to(leaf, (size, *jnp.shape(leaf))), start, start_batched
        )
        end = _queue(unfinished, step, start, context, context_batched)
        return end, jax.tree.map(lambda _: True, end)

    start, context = jax.tree.map(jax.lax.stop_gradient, (start, context))
    return run(start, context)


def _queue(unfinished: Callable, step: Callable, start: Any, context: Any, batched: Any) -> Any:
    size = jax.tree.leaves(start)[0].shape[0]
    lanes = min(size, max(_FEW, min(size // 8, _MANY)))
    axes = jax.tree.map(lambda has: 0 if has else None, batched)
    # Problems that are done before they begin stand behind all others, where nobody asks for them.
    begun = ~jax.vmap(unfinished)(start)
    queue, waiting = jnp.argsort(begun), jnp.sum(~begun)

    def ask(place: Array) -> Array:
        return queue[jnp.minimum(place, size - 1)]

    def busy(now: tuple) -> Array:
        place, *_ = now
        return jnp.any(place < waiting)

    def advance(now: tuple) -> tuple:
        place, following, states, ends = now
        problem = ask(place)
        mine = jax.tree.map(lambda leaf, has: leaf[problem] if has else leaf, context, batched)
        going = jax.vmap(unfinished)(states)
        after = jax.vmap(step, in_axes=(axes, 0))(mine, states)
        states = jax.tree.map(lambda new, old: jnp.where(_spread(going, new), new, old), after, states)
        done = (place < waiting) & ~jax.vmap(unfinished)(states)
        # A lane without a problem points beyond the last one, where nothing is written.
        target = jnp.where(done, problem, size)
        ends = jax.tree.map(lambda all_, some: all_.at[target].set(some, mode="drop"), ends, states)
        place = jnp.where(done, jnp.minimum(following + jnp.cumsum(done) - 1, size), place)
        fresh = jax.tree.map(lambda leaf: leaf[ask(place)], start)
        states = jax.tree.map(lambda new, old: jnp.where(_spread(done, new), new, old), fresh, states)
        return place, following + jnp.sum(done), states, ends

    first = jnp.arange(lanes)
    states = jax.tree.map(lambda leaf: leaf[queue[:lanes]], start)
    return jax.lax.while_loop(busy, advance, (first, jnp.array(lanes), states, start))[3]


def _spread(flags: Array, leaf: Array) -> Array:
    return flags.reshape(-1, *[1] * (leaf.ndim - 1))
