"""Pure functions that are compiled once for each shape: ahead of time side by side, or when they are first called.

A long computation is written as a Python function over several programs. On abstract values that function compiles all
of its programs; on arrays it runs them; under ``jax.jit``, ``jax.grad`` or ``jax.vmap`` it is traced as one.
"""

import functools
import sys
import threading
from collections.abc import Callable, Hashable, Sequence
from concurrent import futures
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike
from tqdm import tqdm

from urrt_jax.program_cache import compile_and_keep, entry_key, load_program, use_compilation_cache

__all__ = [
    "Program",
    "clear_programs",
    "compile_ahead",
    "is_debugging",
    "thread_settings",
    "use_compilation_cache",
    "wait_until_ready",
]

# XLA runs a part of each compilation in threads of its own; more at once gain little and take memory. A guess.
_COMPILED_AT_ONCE = 2
# Settings of JAX that change what is traced. jit has a program for each of their values, too.
_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_device",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_numpy_dtype_promotion",
)
# Under these settings jit behaves specially, so the call is left to it.
_DEBUGGING = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
_TRACED, _ABSTRACT, _ON_DEVICE, _ON_HOST = range(4)


class _Outputs(NamedTuple):
    tree: Any  # PyTreeDef, which jax exports under a name that pyright can't use as a type
    leaves: list[jax.ShapeDtypeStruct]


class _Compilation:
    """What is known of a program for one signature. Both futures fail if the program can't be traced or compiled."""

    def __init__(self) -> None:
        self.outputs: futures.Future[_Outputs] = futures.Future()
        self.executable: futures.Future[jax.stages.Compiled] = futures.Future()

    def fail(self, error: BaseException) -> None:
        for future in (self.outputs, self.executable):
            if not future.done():
                future.set_exception(error)


_lock = threading.Lock()
_compilations: dict[tuple, _Compilation] = {}
_in_background: list[_Compilation] = []
_compiled_ahead: set[Hashable] = set()
_slots = threading.Semaphore(_COMPILED_AT_ONCE)


class Program:
    """A pure function of positional pytrees, compiled once for each structure, shapes and dtypes of its arguments.

    What a call does depends on the leaves of the arguments:

    - If any leaf is traced, the function is called under ``jax.jit``.
    - If any leaf is a ``jax.ShapeDtypeStruct``, the call returns the outputs as ``jax.ShapeDtypeStruct`` and does not
      wait for the compilation, which continues in a thread. ``wait_until_ready`` waits.
    - If all leaves are arrays or numbers, the compiled program runs. It is taken from memory, else from the folder of
      ``use_compilation_cache``, else compiled.

    Numbers count as arrays without axes. Static configuration belongs in the structure of the arguments (fields of
    registered dataclasses that are marked static). The outputs may be any pytree that can be pickled.

    Attributes:
      function: the function itself.
      name: its qualified name.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.function = function
        self.name: str = function.__qualname__
        self._jitted = jax.jit(function)
        self._batched: Program | None = None

    def __repr__(self) -> str:
        return f"Program({self.function.__module__}.{self.name})"

    @property
    def batched(self) -> "Program":
        """The program for many problems at once: the first argument is shared, all others have a leading axis."""

        @functools.wraps(self.function)
        def over_batch(shared: Any, *others: Any) -> Any:
            return jax.vmap(self.function, in_axes=(None, *(0 for _ in others)))(shared, *others)

        over_batch.__name__ += "_batched"
        over_batch.__qualname__ += "_batched"
        with _lock:  # two programs for one function would compile twice
            if self._batched is None:
                self._batched = Program(over_batch)
            return self._batched

    def __call__(self, *arguments: Any) -> Any:
        """The outputs, of the same kind as the arguments: traced, abstract or arrays.

        Raises:
          Exception: what the function raises when it is traced.
        """
        leaves, tree, kinds = _flatten(arguments)
        if _TRACED in kinds or (_ABSTRACT not in kinds and is_debugging()):
            return self._jitted(*jax.tree.unflatten(tree, leaves))
        compilation = self._compilation(leaves, tree, in_background=_ABSTRACT in kinds)
        out_tree, abstract = compilation.outputs.result()
        if _ABSTRACT in kinds:
            return jax.tree.unflatten(out_tree, abstract)
        executable = compilation.executable.result()
        try:
            return jax.tree.unflatten(out_tree, executable(*leaves))
        except ValueError:  # arrays were put on another device than the default one, which jit follows
            return self._jitted(*jax.tree.unflatten(tree, leaves))

    def is_ready(self, *arguments: Any) -> bool:
        """Whether a call with these arguments, arrays or abstract values, would run without compiling or loading."""
        leaves, tree, _ = _flatten(arguments)
        compilation = _compilations.get(self._key(leaves, tree))
        if compilation is None or not compilation.executable.done():
            return False
        return compilation.executable.exception() is None

    def _key(self, leaves: Sequence[Any], tree: Any) -> tuple:
        signature = tuple([(leaf.shape, leaf.dtype) for leaf in leaves])
        return self, tree, signature, tuple(map(_setting, _SETTINGS))

    def _compilation(self, leaves: Sequence[Any], tree: Any, *, in_background: bool) -> _Compilation:
        """The compilation for these arguments, which this call starts if nobody has."""
        key = self._key(leaves, tree)
        if (compilation := _compilations.get(key)) is not None:
            return compilation
        with _lock:
            if (compilation := _compilations.get(key)) is not None:
                return compilation
            compilation = _compilations[key] = _Compilation()
        try:
            self._start(compilation, key, in_background)
        except BaseException as error:  # Ctrl-C too, or others would wait for ever
            _fail(compilation, key, error)
            raise
        return compilation

    def _start(self, compilation: _Compilation, key: tuple, in_background: bool) -> None:
        _, tree, signature, settings = key
        inputs = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in signature]
        device = _default_device()
        on_disk = entry_key(self.function.__module__, self.name, f"{tree} {signature}", settings, device)
        if (loaded := load_program(on_disk, inputs, device)) is not None:
            executable, outputs = loaded
            compilation.outputs.set_result(_Outputs(jax.tree.structure(outputs), jax.tree.leaves(outputs)))
            compilation.executable.set_result(executable)
            return
        # Traced here, because settings and Python's lock belong to this thread; XLA compiles without the lock.
        lowered, outputs = self._lower(tree, inputs)
        compilation.outputs.set_result(outputs)

        def finish() -> None:
            kept = jax.tree.unflatten(outputs.tree, outputs.leaves)
            compilation.executable.set_result(compile_and_keep(lowered, on_disk, kept))

        if in_background:
            _run_in_background(compilation, key, finish)
        else:
            finish()

    def _lower(self, tree: Any, inputs: Sequence[jax.ShapeDtypeStruct]) -> tuple[jax.stages.Lowered, _Outputs]:
        out_tree = None

        def from_leaves(*leaves: Any) -> list[Any]:
            nonlocal out_tree
            outputs, out_tree = jax.tree.flatten(self.function(*jax.tree.unflatten(tree, leaves)))
            return outputs

        from_leaves.__name__ = self.function.__name__  # XLA's name for the program, in profiles
        lowered = jax.jit(from_leaves, keep_unused=True).lower(*inputs)
        return lowered, _Outputs(out_tree, [jax.ShapeDtypeStruct(out.shape, out.dtype) for out in lowered.out_info])


def wait_until_ready(progress: bool = False) -> None:
    """Returns when all programs that abstract calls have started to compile are ready.

    Args:
      progress: shows a bar on stderr.

    Raises:
      Exception: the first error of a compilation.
    """
    with _lock:
        compilations = list(_in_background)
    waiting = {compilation.executable for compilation in compilations}
    if waiting:
        with tqdm(total=len(waiting), desc="compiling", unit="program", file=sys.stderr, disable=not progress) as bar:
            while waiting:
                # Short waits let Ctrl-C through on every system.
                done, waiting = futures.wait(waiting, timeout=0.1, return_when=futures.FIRST_COMPLETED)
                bar.update(len(done))
    with _lock:
        _in_background[:] = [compilation for compilation in _in_background if compilation not in compilations]
    for compilation in compilations:
        compilation.executable.result()


def compile_ahead(key: Hashable, call: Callable[[], Any]) -> None:
    """Calls ``call``, which calls programs with abstract values, unless it was called with this key before."""
    if key not in _compiled_ahead and not is_debugging():
        call()
        _compiled_ahead.add(key)


def is_debugging() -> bool:
    """Whether a setting of JAX for debugging is on, under which programs on arrays are not compiled ahead of time."""
    return any(map(_setting, _DEBUGGING))


def thread_settings() -> tuple:
    """The settings of JAX that decide what a program does; context managers change them for one thread."""
    return tuple(map(_setting, _SETTINGS + _DEBUGGING))


def clear_programs() -> None:
    """Forgets all compiled programs of this process; what is on disk stays."""
    with _lock:
        _compilations.clear()
        _in_background.clear()
        _compiled_ahead.clear()


def _run_in_background(compilation: _Compilation, key: tuple, finish: Callable[[], None]) -> None:
    """Runs ``finish`` in a thread when one of the few slots is free."""

    def work() -> None:
        with _slots:
            if not threading.main_thread().is_alive():  # the process is ending; start nothing more
                _fail(compilation, key, futures.CancelledError())
                return
            try:
                finish()
            except BaseException as error:
                _fail(compilation, key, error)  # and wait_until_ready raises it
                return
        with _lock:
            if compilation in _in_background:
                _in_background.remove(compilation)

    with _lock:
        _in_background.append(compilation)
    # Not an executor, which at exit would first work through all that waits; nor daemons, which crash inside XLA then.
    threading.Thread(target=work, name="urrt_jax compilation").start()


def _fail(compilation: _Compilation, key: tuple, error: BaseException) -> None:
    """Tells those who wait, and lets a later call try again."""
    with _lock:
        if _compilations.get(key) is compilation:
            del _compilations[key]
    compilation.fail(error)


def _flatten(arguments: tuple) -> tuple[list[Any], Any, set[int]]:
    """Leaves with shapes and dtypes, the tree, and the kinds of leaves there are."""
    leaves, tree = jax.tree.flatten(arguments)
    kinds = {_kind(type_) for type_ in set(map(type, leaves))}
    if _ON_HOST in kinds:
        leaves = [_as_array(leaf) if _kind(type(leaf)) == _ON_HOST else leaf for leaf in leaves]
    if _ABSTRACT in kinds:
        leaves = [_canonical(leaf) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf for leaf in leaves]
    return leaves, tree, kinds


@functools.cache
def _kind(leaf_type: type) -> int:
    if issubclass(leaf_type, Tracer):
        return _TRACED
    if issubclass(leaf_type, jax.ShapeDtypeStruct):
        return _ABSTRACT
    return _ON_DEVICE if issubclass(leaf_type, jax.Array) else _ON_HOST


def _as_array(leaf: Any) -> np.ndarray:
    """The leaf with the dtype that JAX gives it; a Python integer is int32."""
    if type(leaf) is int:
        return np.asarray(leaf, np.int32)
    array = np.asarray(leaf)
    return array.astype(_canonical_dtype(array.dtype), copy=False)


def _canonical(leaf: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(leaf.shape, _canonical_dtype(leaf.dtype))


def _canonical_dtype(dtype: DTypeLike) -> Any:
    return _canonical_dtype_of(dtype, _setting("jax_enable_x64"))


@functools.cache  # JAX takes 5 µs for it
def _canonical_dtype_of(dtype: DTypeLike, _: bool) -> Any:
    return jax.dtypes.canonicalize_dtype(dtype, allow_extended_dtype=True)


def _default_device() -> Any:
    chosen = _setting("jax_default_device")
    return chosen if isinstance(chosen, jax.Device) else jax.devices(chosen)[0]


def _setting(name: str) -> Any:
    return getattr(jax.config, name)  # pyright knows no attributes of it
