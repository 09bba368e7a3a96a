"""Under vmap a loop is a plain loop for each problem, whatever is batched, and problems do not wait for each other."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from urrt_jax.loops import anyone, largest, only_if, where_needed, while_each

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


_batched = jax.jit(jax.vmap(_run))


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
def test_every_problem_agrees_with_a_loop(size):
    numbers, weights = _problems(size)
    _agrees(_batched(numbers, weights), _expected(numbers, weights))


def test_eager_agrees_with_jit():
    _agrees(jax.vmap(_run)(*_problems(40)), _batched(*_problems(40)))


@pytest.mark.parametrize("slow", [0, 15, 16, 39])
def test_one_slow_problem_among_finished_ones_agrees_with_a_loop(slow):
    numbers, weights = jnp.ones(40, jnp.int32).at[slow].set(27), jnp.ones(40)
    _agrees(_batched(numbers, weights), _expected(numbers, weights))


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


def test_batched_finished_at_the_start_are_returned_unchanged():
    start = jnp.arange(40.0) - 20.0, jnp.arange(80.0).reshape(40, 2)

    def ruin(context, state):
        return state[0] - jnp.inf, state[1] * jnp.nan

    end = jax.vmap(lambda state: while_each(lambda now: now[0] > 0, ruin, state, ()))(start)
    np.testing.assert_array_equal(end[1][:21], start[1][:21])
    np.testing.assert_array_equal(end[0][:21], start[0][:21])
    assert bool(jnp.all(jnp.isnan(end[1][21:])))


def test_a_batch_of_batched_that_have_all_finished_is_returned_unchanged():
    numbers, weights = jnp.ones(40, jnp.int32), jnp.ones(40)
    _agrees(_batched(numbers, weights), (numbers, np.zeros(40), np.zeros(40)))


def test_batched_do_not_wait_for_the_slowest():
    """Of 64 problems one takes 100 steps; together they would take 6400, one by one 163."""
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
    """Of 200 problems, a few of two steps are left: one after the other, all of them would take a turn."""
    calls: collections.Counter[str] = collections.Counter()

    def step(_, state):
        jax.debug.callback(lambda now: calls.update(["step"]), state)
        return state - 1

    numbers = jnp.zeros(200).at[jnp.array([5, 90, 199])[:left]].set(2)
    end = jax.vmap(lambda number: while_each(lambda now: now > 0, step, number, ()))(numbers)
    np.testing.assert_array_equal(end, jnp.zeros(200))
    jax.effects_barrier()
    assert calls["step"] <= 2 * 25 * (left > 0)  # two turns of all places


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


def _root(operands):
    """Of numbers below zero it is poison."""
    value, factor = operands
    return jnp.sqrt(value), {"scaled": factor * value}


_NEEDED = jnp.arange(40) % 3 == 1
_VALUES = jnp.where(_NEEDED, jnp.arange(40.0), -1.0)
_OTHERWISE = jnp.full(40, 7.0), {"scaled": -jnp.arange(40.0)}


def _cond(needed, value, otherwise, factor=2.0):
    return jax.lax.cond(needed, lambda operands: _root(operands), lambda _: otherwise, (value, factor))


def _where(needed, value, otherwise, factor=2.0, **options):
    return where_needed(needed, _root, (value, factor), otherwise, **options)


def _same(found, expected) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), found, expected)


@pytest.mark.parametrize("needed", [False, True])
def test_without_vmap_where_needed_is_cond(needed):
    arguments = jnp.array(needed), jnp.float32(9.0), (jnp.float32(7.0), {"scaled": jnp.float32(-3.0)})
    _same(jax.jit(_where)(*arguments), _cond(*arguments))


@pytest.mark.parametrize("at_once", [None, 1, 2, 7, 100])
def test_where_needed_agrees_with_cond_for_every_pair(at_once):
    found = jax.jit(jax.vmap(lambda *each: _where(*each, at_once=at_once)))(_NEEDED, _VALUES, _OTHERWISE)
    _same(found, jax.vmap(_cond)(_NEEDED, _VALUES, _OTHERWISE))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))


@pytest.mark.parametrize("needed", [False, True])
def test_where_needed_agrees_with_cond_where_the_need_is_not_batched(needed):
    found = jax.vmap(lambda *each: _where(jnp.array(needed), *each))(jnp.abs(_VALUES), _OTHERWISE)
    _same(found, jax.vmap(lambda *each: _cond(jnp.array(needed), *each))(jnp.abs(_VALUES), _OTHERWISE))


def test_where_needed_agrees_with_cond_under_nested_vmap():
    needed, values, otherwise = jax.tree.map(lambda leaf: leaf.reshape(5, 8), (_NEEDED, _VALUES, _OTHERWISE))
    found = jax.jit(jax.vmap(jax.vmap(_where)))(needed, values, otherwise)
    _same(found, jax.vmap(jax.vmap(_cond))(needed, values, otherwise))


@pytest.mark.parametrize("axes", [((0, 0, 0, None), (None, None, None, 0)), ((None, None, None, 0), (0, 0, 0, None))])
def test_where_needed_agrees_with_cond_under_nested_vmap_over_one_argument_each(axes):
    factors, (outer, inner) = jnp.arange(1.0, 4.0), axes
    found, expected = (
        jax.vmap(jax.vmap(one, in_axes=inner), in_axes=outer)(_NEEDED, _VALUES, _OTHERWISE, factors)
        for one in (_where, _cond)
    )
    _same(found, expected)


@pytest.mark.parametrize(("pairs", "at_once", "expected"), [(0, 2, 0), (1, 1, 1), (3, 1, 3), (3, 2, 4), (40, 8, 40)])
def test_pairs_that_do_not_need_it_are_not_computed(pairs, at_once, expected):
    """Beside those that share the last turn."""
    calls: collections.Counter[str] = collections.Counter()

    def counted(value):
        jax.debug.callback(lambda _: calls.update(["call"]), value)
        return value + 1

    needed = jnp.zeros(40, bool).at[jnp.arange(pairs) * 7 % 40].set(True)
    values, otherwise = jnp.arange(40.0), jnp.zeros(40)
    found = jax.vmap(lambda *each: where_needed(each[0], counted, *each[1:], at_once=at_once))(
        needed, values, otherwise
    )
    np.testing.assert_array_equal(found, np.where(needed, values + 1, 0))
    jax.effects_barrier()
    assert calls["call"] == expected


def test_no_derivative_passes_where_it_is_needed():
    def total(values):
        return jnp.sum(jax.vmap(_where)(_NEEDED, values, _OTHERWISE)[0])

    np.testing.assert_array_equal(jax.grad(total)(jnp.abs(_VALUES)), np.zeros(40))


def _counted(count):
    """The turns of a loop up to the largest count."""
    return jax.lax.fori_loop(0, largest(count), lambda _, turns: turns + 1, 0)


def test_largest_of_one_is_itself():
    assert int(jax.jit(_counted)(5)) == 5


@pytest.mark.parametrize("shape", [(6,), (2, 3)])
def test_largest_is_the_batch_s_under_vmap(shape):
    counts, run = jnp.array([3, 0, 8, 1, 8, 2]).reshape(shape), _counted
    for _ in shape:
        run = jax.vmap(run)
    np.testing.assert_array_equal(jax.jit(run)(counts), np.full(shape, 8))


def test_largest_makes_one_loop():
    """Its end is one number for the whole batch; a plain loop would carry one count a pair and ask them all."""

    def loops(function):
        equations = jax.make_jaxpr(jax.vmap(function))(jnp.arange(6)).eqns
        return [each.params["cond_jaxpr"] for each in equations if each.primitive.name == "while"]

    def plain(count):
        return jax.lax.fori_loop(0, count, lambda _, turns: turns + 1, 0)

    (one,), (other,) = loops(_counted), loops(plain)
    assert all(aval.shape == () for aval in one.in_avals[:2])
    assert any(aval.shape == (6,) for aval in other.in_avals)


@pytest.mark.parametrize("flags", [[False, False, False], [False, True, False]])
def test_anyone_is_one_answer_for_the_whole_batch(flags):
    """So that a conditional takes one branch, and what the other one would call is not called."""
    calls = []

    def seen(value):
        calls.append(value)
        return value

    def one(flag, value):
        return jax.lax.cond(
            anyone(flag), lambda: jax.pure_callback(seen, value, value, vmap_method="expand_dims"), lambda: -value
        )

    values = jnp.arange(3.0)
    found = jax.jit(jax.vmap(one))(jnp.array(flags), values)
    np.testing.assert_array_equal(found, values if any(flags) else -values)
    assert bool(calls) == any(flags)
    assert bool(anyone(jnp.array(flags[1]))) == flags[1]


def test_only_if_computes_what_is_needed_and_nothing_else():
    calls = []

    def costly():
        return jax.pure_callback(lambda: calls.append(1) or np.float32(3), jax.ShapeDtypeStruct((), jnp.float32))

    found = jax.jit(lambda needed: only_if(needed, costly, jnp.float32(0)))
    assert found(False) == 0 and not calls
    assert found(True) == 3 and calls
    assert "cond" not in str(jax.make_jaxpr(lambda: only_if(True, costly, jnp.float32(0)))())
