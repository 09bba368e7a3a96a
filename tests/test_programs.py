import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from urrt_jax import program_cache
from urrt_jax.programs import Program, clear_programs, use_compilation_cache, wait_until_ready

COMPILED = "/jax/core/compile/backend_compile_duration"
SOURCE = np.linspace(0, 1, 12, dtype=np.float32).reshape(4, 3) ** 2
TARGET = SOURCE[:, ::-1].copy()


class Options:
    """A pytree with static configuration (rounds) and one leaf (scale)."""

    def __init__(self, rounds, scale):
        self.rounds, self.scale = rounds, scale


jax.tree_util.register_pytree_node(
    Options, lambda options: ((options.scale,), options.rounds), lambda rounds, leaves: Options(rounds, *leaves)
)


class Fit(NamedTuple):
    moment: jax.Array
    errors: dict[str, jax.Array]


def fit(options, source, target):
    moment = source.T @ target * options.scale
    for _ in range(options.rounds):
        moment = jnp.sin(moment)
    return Fit(moment, {"sum": moment.sum(), "count": jnp.int32(len(source))})


fit.__module__ = "urrt_jax.trial"  # only programs of the package are kept on disk
OPTIONS = Options(2, np.float32(0.5))
ARGUMENTS = (OPTIONS, SOURCE, TARGET)


def abstract(tree):
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), np.asarray(leaf).dtype), tree)


def check_equal(actual, expected):
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), actual, expected)


@contextlib.contextmanager
def compilations() -> Iterator[list[str]]:
    """The names of what is compiled in any thread while the block runs."""
    seen = []

    def note(event: str, _: float, **about: str | int) -> None:
        if event == COMPILED:
            seen.append(about.get("fun_name", ""))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield seen
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


@pytest.fixture(autouse=True)
def _fresh_process(monkeypatch):
    """As in a process of its own, without JAX's own cache, which the tests share: what it holds is not kept again."""
    monkeypatch.setattr(program_cache, "_cache", None)
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    shared = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    compilation_cache.reset_cache()
    clear_programs()
    yield
    jax.config.update("jax_compilation_cache_dir", shared)
    compilation_cache.reset_cache()
    with contextlib.suppress(Exception):
        wait_until_ready()
    clear_programs()


@pytest.fixture
def folder(tmp_path) -> Path:
    """An empty cache in use."""
    folder = tmp_path / "programs"
    assert use_compilation_cache(folder) == folder
    return folder


def entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def run_process(source: str, **environment: str) -> str:
    """What a new Python process prints; it knows neither the JAX cache nor the compiler flags of the tests."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    kept |= {"JAX_PLATFORMS": "cpu", "TF_CPP_MIN_LOG_LEVEL": "3"} | environment
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=120, env=kept)
    assert done.returncode == 0, done.stderr
    return done.stdout


class TestCall:
    def test_on_arrays_it_agrees_with_the_function(self):
        check_equal(Program(fit)(*ARGUMENTS), fit(*ARGUMENTS))

    def test_on_abstract_values_it_returns_the_structure_of_the_outputs(self):
        outputs = Program(fit)(*abstract(ARGUMENTS))
        assert outputs == jax.eval_shape(fit, *ARGUMENTS)

    def test_an_abstract_call_makes_the_program_ready(self):
        program = Program(fit)
        assert not program.is_ready(*ARGUMENTS)
        program(*abstract(ARGUMENTS))
        wait_until_ready()
        assert program.is_ready(*ARGUMENTS) and program.is_ready(*abstract(ARGUMENTS))
        with compilations() as compiled:
            program(*ARGUMENTS)
        assert not compiled

    def test_a_second_call_does_not_compile(self):
        program = Program(fit)
        program(*ARGUMENTS)
        with compilations() as compiled:
            program(OPTIONS, SOURCE + 1, TARGET)
            program(*abstract(ARGUMENTS))
        assert not compiled

    @pytest.mark.parametrize(
        "other",
        [(Options(3, np.float32(0.5)), SOURCE, TARGET), (OPTIONS, SOURCE[:3], TARGET[:3])],
        ids=["static", "shape"],
    )
    def test_another_static_argument_or_shape_is_another_program(self, other):
        program = Program(fit)
        program(*ARGUMENTS)
        check_equal(program(*other), fit(*other))

    @pytest.mark.parametrize(
        ("number", "dtype"), [(2.0, np.float32), (2, np.int32), (True, np.bool_), (np.float64(2), np.float32)]
    )
    def test_numbers_are_arrays_without_axes(self, number, dtype):
        assert Program(lambda x: x)(number).dtype == dtype

    def test_double_precision_is_another_program(self):
        program = Program(lambda x: x + 1)
        single = program(2.0)
        with jax.enable_x64(True):
            double = program(2.0)
        assert (single.dtype, double.dtype, program(2.0).dtype) == (np.float32, np.float64, np.float32)

    def test_unused_arguments_are_allowed(self):
        assert Program(lambda x, unused: x + 1)(1.0, SOURCE) == 2

    def test_keys_are_arrays(self):
        key = jax.random.key(1)
        assert Program(lambda key: jax.random.uniform(key))(key) == jax.random.uniform(key)

    def test_arrays_made_in_another_process_or_by_jax_agree(self):
        on_device = jax.tree.map(jnp.asarray, ARGUMENTS)
        check_equal(Program(fit)(*on_device), fit(*on_device))

    def test_an_error_of_the_function_is_raised_at_every_call(self):
        @Program
        def fail(x):
            raise ZeroDivisionError("never")

        for argument in (1.0, 1.0, jax.ShapeDtypeStruct((), jnp.float32)):
            with pytest.raises(ZeroDivisionError):
                fail(argument)

    def test_nans_are_found_where_jax_looks_for_them(self):
        program = Program(jnp.sqrt)
        with jax.debug_nans(True), pytest.raises(FloatingPointError):
            program(-1.0)


class TestComposition:
    def test_batched_agrees_with_a_loop(self):
        sources, targets = np.stack([SOURCE, SOURCE + 1]), np.stack([TARGET, 2 * TARGET])
        program = Program(fit)
        one_by_one = [program(OPTIONS, source, target) for source, target in zip(sources, targets, strict=True)]
        check_equal(program.batched(OPTIONS, sources, targets), jax.tree.map(lambda *x: np.stack(x), *one_by_one))

    def test_batched_is_one_program(self):
        program = Program(fit)
        assert program.batched is program.batched
        assert program.batched.name != program.name

    def test_under_jit(self):
        check_equal(jax.jit(Program(fit))(*ARGUMENTS), fit(*ARGUMENTS))

    def test_under_vmap(self):
        sources = np.stack([SOURCE, SOURCE + 1])
        moments = jax.vmap(lambda source: Program(fit)(OPTIONS, source, TARGET).moment)(sources)
        check_equal(moments[1], fit(OPTIONS, sources[1], TARGET).moment)

    def test_under_grad(self):
        def total(function):
            return lambda source: function(OPTIONS, source, TARGET).errors["sum"]

        check_equal(jax.grad(total(Program(fit)))(SOURCE), jax.grad(total(fit))(SOURCE))

    def test_a_program_in_a_program(self):
        inner = Program(lambda x: x + 1)
        assert Program(lambda x: 2 * inner(x))(1.0) == 4

    def test_a_composition_compiles_all_its_programs_on_abstract_values(self):
        first, second = Program(lambda x: x + 1), Program(lambda x: x * 2)
        second(first(jax.ShapeDtypeStruct((3,), jnp.float32)))
        wait_until_ready(progress=True)
        with compilations() as compiled:
            second(first(np.ones(3, np.float32)))
        assert not compiled


class TestThreads:
    def test_threads_that_ask_at_once_compile_once(self):
        traced = []

        @Program
        def slow(x):
            traced.append(x)
            time.sleep(0.2)
            return x + 1

        results = []
        argument = np.ones(3, np.float32)
        with compilations() as compiled:
            threads = [threading.Thread(target=lambda: results.append(slow(argument))) for _ in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        assert len(traced) == len(compiled) == 1
        assert [float(result[0]) for result in results] == [2.0] * 4

    def test_waiting_raises_the_error_of_a_compilation(self, monkeypatch):
        def fail(*_):
            raise MemoryError("compiler")

        program = Program(lambda x: x + 1)
        with monkeypatch.context() as patched:
            patched.setattr("urrt_jax.programs.compile_and_keep", fail)
            program(jax.ShapeDtypeStruct((), jnp.float32))
            with pytest.raises(MemoryError, match="compiler"):
                wait_until_ready()
        wait_until_ready()
        assert program(1.0) == 2

    def test_a_process_that_ends_starts_no_more_compilations(self):
        printed = run_process("""
import threading, time
import jax
from urrt_jax import programs

def slow(lowered, key, outputs):
    print("started", flush=True)
    time.sleep(0.5)

programs.compile_and_keep = slow
for size in range(6):
    programs.Program(lambda x: x + 1)(jax.ShapeDtypeStruct((size,), "float32"))
""")
        assert printed.split() == ["started"] * 2


class TestDisk:
    def test_another_process_neither_traces_nor_compiles(self, tmp_path):
        # SVD, because kernels of LAPACK need what JAX prepares only while it traces.
        source = """
import json, sys
from typing import NamedTuple
import jax, jax.numpy as jnp, numpy as np
from urrt_jax.programs import Program, use_compilation_cache

class Turn(NamedTuple):
    rotation: jax.Array
    singular: jax.Array

class Recorder(list):
    def __call__(self, event, seconds, **_):
        self.append(event)

def turn(points):
    left, singular, right = jnp.linalg.svd(points.T @ points)
    return Turn(left @ right, singular)

turn.__module__ = "urrt_jax.trial"
use_compilation_cache(sys.argv[1] if len(sys.argv) > 1 else FOLDER)
events = Recorder()
jax.monitoring.register_event_duration_secs_listener(events)
result = Program(turn)(np.arange(12, dtype=np.float32).reshape(4, 3) ** 2)
print(json.dumps([events, type(result).__name__, np.asarray(result.singular).tolist()]))
""".replace("FOLDER", repr(str(tmp_path)))
        first, second = (json.loads(run_process(source)) for _ in range(2))
        assert COMPILED in first[0]
        assert not [event for event in second[0] if event.startswith("/jax/core/compile")]
        assert second[1:] == first[1:]

    def test_forgotten_programs_come_from_disk(self, folder):
        program = Program(fit)
        expected = program(*ARGUMENTS)
        clear_programs()
        with compilations() as compiled:
            assert program(*abstract(ARGUMENTS)) == jax.eval_shape(fit, *ARGUMENTS)
            assert program.is_ready(*ARGUMENTS)
            check_equal(program(*ARGUMENTS), expected)
        assert not compiled

    def test_an_abstract_call_writes_too(self, folder):
        Program(fit)(*abstract(ARGUMENTS))
        wait_until_ready()
        assert len(entries(folder)) == 1

    def test_nothing_is_written_where_no_folder_is_in_use(self, tmp_path, monkeypatch):
        monkeypatch.setattr(program_cache, "write_atomically", None)
        Program(fit)(*ARGUMENTS)

    @pytest.mark.parametrize(
        "damage",
        [
            lambda content: b"",
            lambda content: b"garbage",
            lambda content: content[: len(content) // 2],
            lambda content: content[:-1] + bytes([content[-1] ^ 1]),
            lambda content: content.replace(b"program 1", b"program 0", 1),
            lambda content: program_cache._header(b"no pickle") + b"no pickle",
            lambda content: program_cache._header(b"I1\n.") + b"I1\n.",  # a pickle of something else
        ],
        ids=["empty", "garbage", "truncated", "flipped bit", "another format", "no pickle", "foreign pickle"],
    )
    def test_a_damaged_entry_is_replaced(self, folder, damage):
        program = Program(fit)
        expected = program(*ARGUMENTS)
        (entry,) = entries(folder)
        entry.write_bytes(damage(entry.read_bytes()))
        damaged = entry.read_bytes()
        clear_programs()
        check_equal(program(*ARGUMENTS), expected)
        assert entry.read_bytes() != damaged
        clear_programs()
        with compilations() as compiled:
            program(*ARGUMENTS)
        assert not compiled

    def test_an_entry_that_cannot_be_read_is_ignored(self, folder):
        program = Program(fit)
        expected = program(*ARGUMENTS)
        (entry,) = entries(folder)
        entry.unlink()
        entry.mkdir()
        clear_programs()
        check_equal(program(*ARGUMENTS), expected)

    @pytest.mark.parametrize("error", [PermissionError(13, "read-only"), OSError(28, "no space left on device")])
    def test_a_folder_that_cannot_be_written_is_still_read(self, folder, monkeypatch, error):
        def refuse(*_):
            raise error

        program = Program(fit)
        expected = program(*ARGUMENTS)
        monkeypatch.setattr(program_cache, "write_atomically", refuse)
        monkeypatch.setattr(program_cache.os, "utime", refuse)
        clear_programs()
        with compilations() as compiled:
            check_equal(program(*ARGUMENTS), expected)
        assert not compiled
        program(OPTIONS, SOURCE[:2], TARGET[:2])
        assert len(entries(folder)) == 1

    def test_the_least_recently_used_entries_are_removed(self, folder):
        program = Program(fit)
        sizes = (1, 2, 3)
        for age, size in enumerate(sizes):
            program(OPTIONS, SOURCE[:size], TARGET[:size])
            newest = max(entries(folder), key=lambda path: path.stat().st_mtime_ns)
            os.utime(newest, (1000 + age, 1000 + age))
        bytes_of = [path.stat().st_size for path in entries(folder)]
        clear_programs()
        program(OPTIONS, SOURCE[:1], TARGET[:1])  # now the most recently used
        use_compilation_cache(folder, max_bytes=sum(bytes_of) + max(bytes_of) // 2)  # three and a half
        program(OPTIONS, SOURCE, TARGET)
        clear_programs()
        with compilations() as compiled:
            program(OPTIONS, SOURCE[:1], TARGET[:1])
            program(OPTIONS, SOURCE[:3], TARGET[:3])
        assert not compiled
        assert len(entries(folder)) == 3

    def test_the_folder_is_the_users_alone(self, folder):
        assert folder.stat().st_mode & 0o777 == 0o700

    def test_without_a_folder_there_is_no_cache(self, tmp_path):
        (tmp_path / "file").write_text("")
        assert use_compilation_cache(tmp_path / "file" / "programs") is None

    def test_the_default_folder_is_in_the_users_cache(self, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        monkeypatch.delenv("URRT_NO_CACHE", raising=False)
        assert use_compilation_cache() == tmp_path / "urrt_jax" / "programs"

    def test_a_relative_folder_of_the_environment_is_ignored(self, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", "here")
        monkeypatch.setenv("HOME", str(tmp_path))
        monkeypatch.delenv("URRT_NO_CACHE", raising=False)
        monkeypatch.chdir(tmp_path)
        assert use_compilation_cache() == tmp_path / ".cache" / "urrt_jax" / "programs"

    def test_the_environment_can_forbid_the_default_folder(self, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        monkeypatch.setenv("URRT_NO_CACHE", "1")
        assert use_compilation_cache() is None
        assert not (tmp_path / "urrt_jax").exists()

    def test_a_negative_size_is_refused(self, tmp_path):
        with pytest.raises(ValueError, match="-1"):
            use_compilation_cache(tmp_path, max_bytes=-1)


class TestEntries:
    @pytest.mark.parametrize(
        "other",
        [
            lambda program: program(Options(3, np.float32(0.5)), SOURCE, TARGET),
            lambda program: program(OPTIONS, SOURCE[:3], TARGET[:3]),
            lambda program: program(OPTIONS, SOURCE.astype(np.float16), TARGET),
            lambda program: program.batched(OPTIONS, SOURCE[None], TARGET[None]),
        ],
        ids=["static argument", "shape", "dtype", "batched"],
    )
    def test_differ(self, folder, other):
        program = Program(fit)
        program(*ARGUMENTS)
        other(program)
        assert len(entries(folder)) == 2

    @pytest.mark.parametrize("setting", [jax.enable_x64, jax.default_matmul_precision], ids=["x64", "precision"])
    def test_differ_between_settings(self, folder, setting):
        program = Program(fit)
        program(*ARGUMENTS)
        with setting(True if setting is jax.enable_x64 else "highest"):
            program(*ARGUMENTS)
        assert len(entries(folder)) == 2

    def test_differ_between_compiler_flags(self, folder, monkeypatch):
        program = Program(fit)
        program(*ARGUMENTS)
        clear_programs()
        monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
        program(*ARGUMENTS)
        assert len(entries(folder)) == 2

    def test_differ_between_versions_of_the_package(self, folder, monkeypatch):
        program = Program(fit)
        program(*ARGUMENTS)
        clear_programs()
        monkeypatch.setattr(program_cache, "_environment", lambda: ("other sources",))
        program(*ARGUMENTS)
        assert len(entries(folder)) == 2

    def test_static_arguments_named_by_their_address_are_not_kept(self, folder):
        Program(fit)(Options(_Rounds(), np.float32(1)), SOURCE, TARGET)
        assert not entries(folder)

    def test_programs_of_other_packages_are_not_kept(self, folder):
        def other(x):
            return x + 1

        Program(other)(1.0)
        other.__module__ = "urrt_jax.trial"  # still local: its name is not the only one of its kind
        Program(other)(1.0)
        assert not entries(folder)

    def test_programs_with_callbacks_are_not_kept(self, folder):
        assert Program(_callback)(np.float32(1)) == 1
        assert not entries(folder)

    def test_what_came_from_the_cache_of_jax_is_not_kept(self, tmp_path):
        printed = run_process(
            f"""
import os
import jax
from urrt_jax.programs import Program, clear_programs, use_compilation_cache

def increment(x):
    return x + 1

increment.__module__ = "urrt_jax.trial"
for folder in ({str(tmp_path / "miss")!r}, {str(tmp_path / "hit")!r}):
    use_compilation_cache(folder)
    clear_programs()
    Program(increment)(1.0)
    print(len(os.listdir(folder)))
""",
            JAX_COMPILATION_CACHE_DIR=str(tmp_path / "jax"),
            JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0",
            JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES="-1",
        )
        assert printed.split() == ["1", "0"]


class _Rounds:
    """A static argument without a name of its own, which is equal to nothing else."""

    def __index__(self):
        return 1


def _callback(x):
    return jax.pure_callback(np.asarray, jax.ShapeDtypeStruct((), jnp.float32), x)


_callback.__module__ = "urrt_jax.trial"
