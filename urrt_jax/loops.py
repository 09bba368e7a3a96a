"""Loops that behave under ``vmap``: pairs that are done, or need nothing, do not wait for the others."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap

_FEW, _MANY = 16, 256  # problems at once: enough to fill a CPU; more for large batches, which accelerators want


def while_each(
    unfinished: Callable[[Any], Array],
    step: Callable[[Any, Any], Any],
    start: Any,
    context: Any,
    *,
    at_once: int | None = None,
) -> Any:
    """The state when ``unfinished(state)`` is false, of ``state = step(context, state)`` from ``start``.

    This is ``jax.lax.while_loop``, except under ``vmap``: there a plain loop goes on for the whole batch until its
    slowest member is done. Here a few problems are worked on at a time; when one is done, the next takes its place.
    Answers are the same. No derivative passes.

    Args:
      unfinished: of a state, (); closes over no traced value.
      step: of the context and the state; closes over no traced value.
      start: state, a pytree of arrays.
      context: what stays the same, a pytree of arrays.
      at_once: problems worked on at a time under ``vmap``; by default from 16 to 256, growing with the batch.
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
        places = min(size, at_once or max(_FEW, min(size // 8, _MANY)))
        end = _queue(unfinished, step, start, context, context_batched, places)
        return end, jax.tree.map(lambda _: True, end)

    start, context = jax.tree.map(jax.lax.stop_gradient, (start, context))
    return run(start, context)


def where_needed(
    needed: Array, function: Callable[[Any], Any], operands: Any, otherwise: Any, *, at_once: int | None = None
) -> Any:
    """``function(operands)`` where ``needed``, else ``otherwise``, of the same structure; no derivative passes.

    It acts like ``jax.lax.cond``, except under ``vmap``: a plain ``cond`` evaluates both branches for the whole batch.
    Here pairs that don't need the function cost next to nothing.

    Args:
      needed: (), bool.
      function: of the operands; closes over no traced value.
      operands: a pytree of arrays.
      otherwise: a pytree of arrays.
      at_once: as for ``while_each``.
    """

    def step(operands: Any, state: tuple[Any, Array]) -> tuple[Any, Array]:
        value = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), function(operands), state[0])
        return value, jnp.array(False)

    otherwise = jax.tree.map(jnp.asarray, otherwise)
    return while_each(lambda state: state[1], step, (otherwise, jnp.asarray(needed)), operands, at_once=at_once)[0]


def each_cloud(function: Callable[[Any], Any], source: Any, target: Any) -> tuple[Any, Any]:
    """The function of the source's arrays and of the target's; of equal shapes in a loop, which is compiled once."""
    if jax.tree.map(jnp.shape, source) != jax.tree.map(jnp.shape, target):
        return function(source), function(target)
    both = jax.lax.map(function, jax.tree.map(lambda *leaves: jnp.stack(leaves), source, target))
    return jax.tree.map(lambda leaf: leaf[0], both), jax.tree.map(lambda leaf: leaf[1], both)


def only_if(needed: Array | bool, function: Callable[[], Any], otherwise: Any) -> Any:
    """``function()`` where it is ``needed``, (), else what has its structure. A Python ``True`` costs no ``cond``."""
    return function() if needed is True else jax.lax.cond(needed, function, lambda: otherwise)


@custom_vmap
def largest(count: Array) -> Array:
    """The count or flag, (); under ``vmap`` the largest of the batch, so that a loop up to it is one loop for all."""
    return count


@largest.def_vmap
def _largest_of_batch(size: int, batched: list[bool], count: Array) -> tuple[Array, bool]:
    return largest(jnp.max(count)), False


def anyone(flag: Array) -> Array:
    """The flag, (); under ``vmap`` whether it is set anywhere in the batch, so that ``cond`` still takes one branch."""
    return largest(flag)


def _queue(unfinished: Callable, step: Callable, start: Any, context: Any, batched: Any, places: int) -> Any:
    size = jax.tree.leaves(start)[0].shape[0]
    axes = jax.tree.map(lambda has: 0 if has else None, batched)
    # Problems that are done before they begin stand behind all others, where they are never reached.
    begun = ~jax.vmap(unfinished)(start)
    queue, waiting = jnp.argsort(begun), jnp.sum(~begun)

    def problem_at(place: Array) -> Array:
        return queue[jnp.minimum(place, size - 1)]

    def busy(now: tuple) -> Array:
        place, *_ = now
        return jnp.any(place < waiting)

    def advance(now: tuple) -> tuple:
        place, following, states, ends = now
        problem = problem_at(place)
        mine = jax.tree.map(lambda leaf, has: leaf[problem] if has else leaf, context, batched)
        going = jax.vmap(unfinished)(states)
        after = jax.vmap(step, in_axes=(axes, 0))(mine, states)
        states = jax.tree.map(lambda new, old: jnp.where(_spread(going, new), new, old), after, states)
        done = (place < waiting) & ~jax.vmap(unfinished)(states)
        # A place without a problem points beyond the last one, where nothing is written.
        target = jnp.where(done, problem, size)
        ends = jax.tree.map(lambda all_, some: all_.at[target].set(some, mode="drop"), ends, states)
        place = jnp.where(done, jnp.minimum(following + jnp.cumsum(done) - 1, size), place)
        fresh = jax.tree.map(lambda leaf: leaf[problem_at(place)], start)
        states = jax.tree.map(lambda new, old: jnp.where(_spread(done, new), new, old), fresh, states)
        return place, following + jnp.sum(done), states, ends

    first = jnp.arange(places)
    states = jax.tree.map(lambda leaf: leaf[queue[:places]], start)
    return jax.lax.while_loop(busy, advance, (first, jnp.array(places), states, start))[3]


def _spread(flags: Array, leaf: Array) -> Array:
    return flags.reshape(-1, *[1] * (leaf.ndim - 1))
