"""The loop under vmap is a plain loop for each lane, whatever is batched, and lanes do not wait for each other."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.refine.lanes import while_each

_START = np.array([1, 2, 27, 3, 1, 97, 16, 6, 1, 1, 703, 5, 32, 27, 2, 1, 871, 4, 1, 9])  # 0 to 178 steps


def _unfinished(state):
    number, _, _ = state
    return number != 1


def _step(context, state):
    """A step of Collatz's sequence, which adds up what it passes and counts."""
    odd, weight = context
    number, total, count = state
    return jnp.where(number % 2 == 0, number // 2, odd * number + 1), total + weight * number, count + 1


def _loop(number, weight, odd=3):
    total, count = 0.0, 0
    while number != 1:
        total, count = total + weight * number, count + 1
        number = number // 2 if number % 2 == 0 else odd * number + 1
    return number, total, count


def _run(number, weight, odd=3):
    return while_each(_unfinished, _step, (number, jnp.float32(0), jnp.int32(0)), (odd, weight))


_lanes = jax.jit(jax.vmap(_run))


def _expected(numbers, weights) -> list[np.ndarray]:
    numbers, weights = np.broadcast_arrays(numbers, weights)
    ends = [_loop(int(a), float(b)) for a, b in zip(numbers.flat, weights.flat, strict=True)]
    return [np.reshape(each, numbers.shape) for each in zip(*ends, strict=True)]


def _agrees(found, expected) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def _problems(size: int) -> tuple[jax.Array, jax.Array]:
    """Numbers and weights (size,)."""
    return jnp.asarray(np.resize(_START, size), jnp.int32), jnp.arange(size, dtype=jnp.float32) % 7


@pytest.mark.parametrize("number", [1, 2, 27, 703])
def test_without_vmap_it_is_a_loop(number):
    _agrees(_run(jnp.int32(number), jnp.float32(0.5)), _expected(number, 0.5))


@pytest.mark.parametrize("size", [1, 15, 16, 17, 200, 2100])
def test_every_lane_agrees_with_a_loop(size):
    numbers, weights = _problems(size)
    _agrees(_lanes(numbers, weights), _expected(numbers, weights))


def test_eager_agrees_with_jit():
    _agrees(jax.vmap(_run)(*_problems(40)), _lanes(*_problems(40)))


@pytest.mark.parametrize("slow", [0, 15, 16, 39])
def test_one_slow_lane_among_finished_ones_agrees_with_a_loop(slow):
    numbers, weights = jnp.ones(40, jnp.int32).at[slow].set(27), jnp.ones(40)
    _agrees(_lanes(numbers, weights), _expected(numbers, weights))


def test_a_start_that_is_not_batched_agrees_with_a_loop():
    _, weights = _problems(40)
    _agrees(jax.jit(jax.vmap(_run, in_axes=(None, 0)))(jnp.int32(27), weights), _expected(27, weights))


def test_a_context_that_is_not_batched_agrees_with_a_loop():
    numbers, _ = _problems(40)
    _agrees(jax.jit(jax.vmap(_run, in_axes=(0, None)))(numbers, jnp.float32(0.5)), _expected(numbers, 0.5))


@pytest.mark.parametrize("shape", [(3, 5), (20, 2)])
def test_nested_vmap_agrees_with_a_loop(shape):
    numbers, weights = (each.reshape(shape) for each in _problems(np.prod(shape)))
    _agrees(jax.jit(jax.vmap(jax.vmap(_run)))(numbers, weights), _expected(numbers, weights))


@pytest.mark.parametrize("axes", [((None, 0), (0, None)), ((0, None), (None, 0))])
def test_nested_vmap_over_one_argument_each_agrees_with_a_loop(axes):
    numbers, weights = _problems(20)[0], jnp.arange(1.0, 4.0)
    outer, inner = axes
    found = jax.jit(jax.vmap(jax.vmap(_run, in_axes=inner), in_axes=outer))(numbers, weights)
    grid = (numbers, weights[:, None]) if outer == (None, 0) else (numbers[:, None], weights)
    _agrees(found, _expected(*grid))


def test_lanes_finished_at_the_start_are_returned_unchanged():
    start = jnp.arange(40.0) - 20.0, jnp.arange(80.0).reshape(40, 2)

    def ruin(context, state):
        return state[0] - jnp.inf, state[1] * jnp.nan

    end = jax.vmap(lambda state: while_each(lambda now: now[0] > 0, ruin, state, ()))(start)
    np.testing.assert_array_equal(end[1][:21], start[1][:21])
    np.testing.assert_array_equal(end[0][:21], start[0][:21])
    assert bool(jnp.all(jnp.isnan(end[1][21:])))


def test_a_batch_of_lanes_that_have_all_finished_is_returned_unchanged():
    numbers, weights = jnp.ones(40, jnp.int32), jnp.ones(40)
    _agrees(_lanes(numbers, weights), (numbers, np.zeros(40), np.zeros(40)))


def test_lanes_do_not_wait_for_the_slowest():
    """Of 64 problems one takes 100 steps; together they would take 6400, in lanes of their own 163."""
    calls: collections.Counter[str] = collections.Counter()

    def step(_, state):
        jax.debug.callback(lambda now: calls.update(["step"]), state)
        return state - 1

    numbers = jnp.where(jnp.arange(64) == 0, 100, 1)
    end = jax.vmap(lambda number: while_each(lambda now: now > 0, step, number, ()))(numbers)
    jax.block_until_ready(end)
    jax.effects_barrier()
    assert calls["step"] <= 6400 // 3


@pytest.mark.parametrize("left", [0, 3])
def test_problems_done_at_the_start_take_no_turn(left):
    """Of 200 problems, a few of two steps are left: one lane after the other would ask for every one of them."""
    calls: collections.Counter[str] = collections.Counter()

    def step(_, state):
        jax.debug.callback(lambda now: calls.update(["step"]), state)
        return state - 1

    numbers = jnp.zeros(200).at[jnp.array([5, 90, 199])[:left]].set(2)
    end = jax.vmap(lambda number: while_each(lambda now: now > 0, step, number, ()))(numbers)
    np.testing.assert_array_equal(end, jnp.zeros(200))
    jax.effects_barrier()
    assert calls["step"] <= 2 * 25 * (left > 0)  # two turns of all lanes


def _scalar(start, weight):
    """A loop whose end depends on both floats."""
    return while_each(lambda now: now < 10, lambda by, now: now + by, start, weight)


_STARTS, _WEIGHTS = jnp.linspace(0.0, 11.0, 20), jnp.linspace(0.5, 3.0, 20)
_scalars = jax.jit(jax.vmap(_scalar))


@pytest.mark.parametrize("argument", [0, 1])
def test_no_derivative_passes_without_vmap(argument):
    assert float(jax.grad(_scalar, argnums=argument)(jnp.float32(0.5), jnp.float32(0.75))) == 0


@pytest.mark.parametrize("argument", [0, 1])
def test_no_derivative_passes_through_a_batch(argument):
    gradient = jax.grad(lambda *args: jnp.sum(_scalars(*args)), argnums=argument)(_STARTS, _WEIGHTS)
    np.testing.assert_array_equal(gradient, np.zeros(20))


def test_no_derivative_passes_in_a_batch_of_gradients():
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.grad(_scalar, argnums=1)))(_STARTS, _WEIGHTS), np.zeros(20))


def test_the_end_is_a_constant_factor_to_a_derivative():
    gradient = jax.grad(lambda starts: jnp.sum(starts * _scalars(starts, _WEIGHTS)))(_STARTS)
    np.testing.assert_allclose(gradient, _scalars(_STARTS, _WEIGHTS), rtol=1e-6)
