"""Compiled programs on disk: a later process runs them without tracing, lowering or compiling.

JAX's own persistent cache saves only the last of these three. An entry here is a whole executable, so its key has to
cover whatever tracing would have read: the sources of this package, the versions of what it is built on, settings,
static arguments, shapes and the processor. An entry that can't be used costs time and nothing else.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import os
import pickle
import platform
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import serialize_executable

from urrt_jax.atomic import UNFINISHED, write_atomically

_PACKAGE = __name__.partition(".")[0]
# Tracing runs code of these too.
_BUILT_ON = ("jax", "jaxlib", "flax", "optax", "jaxlie", "numpy")
_FORMAT = b"urrt_jax program 1"
_SUFFIX = ".program"
_JITTED = "jax"
# Events that JAX records.
_JAX_CACHE_ASKED = "/jax/compilation_cache/compile_requests_use_cache"
_JAX_CACHE_HIT = "/jax/compilation_cache/cache_hits"


class _Cache(NamedTuple):
    folder: Path
    max_bytes: int


_cache: _Cache | None = None
_Device = Any  # jax.Device, which pyright doesn't take for a type


def use_compilation_cache(
    folder: str | os.PathLike[str] | None = None, *, max_bytes: int = 2**29, jitted: bool = False
) -> Path | None:
    """The folder that keeps compiled programs from now on in this process, or None if it can't be made or read.

    None also where the environment variable ``URRT_NO_CACHE`` is set and no folder is named.

    On a CPU XLA logs a harmless error, of many lines, for every program that it loads: it takes two tuning hints for
    instructions that the processor lacks. The environment variable ``TF_CPP_MIN_LOG_LEVEL=3``, set before JAX is
    imported, keeps it quiet.

    Entries are unpickled, and unpickling can run any code: the folder must belong to the user, and nobody else may
    write to it. A new folder gets mode 0700. A folder that can only be read is used, but nothing is added to it.

    Args:
      folder: by default ``$XDG_CACHE_HOME/urrt_jax/programs``, or ``~/.cache/urrt_jax/programs``.
      max_bytes: when all entries together are larger, the least recently used are removed.
      jitted: whether to keep also what you jit yourself, and the steps of training. JAX's own cache does that, in the
        folder's ``jax``, without a bound; these functions are traced anew in each process.

    Raises:
      ValueError: ``max_bytes`` is negative.
    """
    global _cache
    if max_bytes < 0:
        raise ValueError(f"max_bytes must not be negative, got {max_bytes}")
    if folder is None and os.environ.get("URRT_NO_CACHE"):
        return None
    try:
        folder = Path(folder) if folder is not None else _default_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _environment()
    except (OSError, RuntimeError, ImportError):  # no such folder; no home; no sources or versions to tell programs by
        return None
    if not os.access(folder, os.R_OK | os.X_OK):
        return None
    _listen_to_jax_cache()
    _cache = _Cache(folder, max_bytes)
    if jitted:
        jaxlib = importlib.metadata.version("jaxlib")
        _use_jax_cache(folder / _JITTED / f"{jaxlib}-{processor()}")
    return folder


def _use_jax_cache(folder: Path) -> None:
    """From now on JAX keeps all that it compiles in this folder, if that can be made."""
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _default_folder() -> Path:
    asked = Path(os.environ.get("XDG_CACHE_HOME", ""))
    root = asked if asked.is_absolute() else Path("~/.cache").expanduser()  # as the XDG specification has it
    return root / "urrt_jax" / "programs"


def cached_files() -> tuple[Path, dict[Path, int]]:
    """The user's cache folder, and the files in it with their sizes in bytes: programs, and what training has compiled.

    Raises:
      RuntimeError: there is no home folder.
    """
    root = _default_folder()
    sizes = {}
    for path in [*_entries(root), *root.glob(f"{_JITTED}/*/*")]:
        with contextlib.suppress(OSError):  # another process has just removed it
            sizes[path] = path.stat().st_size
    return root, sizes


@functools.cache
def processor() -> str:
    """A name for this kind of processor: a home folder may be shared by several, and programs are compiled for one."""
    described = platform.machine() + platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        described += next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:  # not Linux
        pass
    return hashlib.sha256(described.encode()).hexdigest()[:12]


def entry_key(module: str, name: str, inputs: str, settings: Sequence[object], device: _Device) -> str | None:
    """The name of a program's entry, or None if the program is not to be kept.

    Programs of other packages are not kept, because the key covers only the sources of this one; nor are programs that
    another program may share its name with, or whose static arguments have a name only in this process.

    Args:
      module: where the program's function is defined.
      name: the function's qualified name.
      inputs: structure (with static arguments), shapes and dtypes of the arguments.
      settings: what else tracing depends on.
      device: where the program runs.
    """
    if _cache is None or module.partition(".")[0] != _PACKAGE or "<" in name or " at 0x" in inputs:
        return None
    parts = (
        *_environment(),
        *(os.environ.get("XLA_FLAGS", ""), jax.device_count(device.platform)),
        *(device.platform, device.device_kind, device.id, device.client.platform_version),
        *(module, name, inputs, *settings),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@functools.cache
def _environment() -> tuple[str, ...]:
    """What is the same for all programs of a process: sources, versions, processor."""
    sources = hashlib.sha256()
    root = Path(__file__).parent
    paths = sorted(root.rglob("*.py"))
    if not paths:
        raise FileNotFoundError(f"no sources in {root}")
    for path in paths:
        content = path.read_bytes()
        sources.update(f"{path.relative_to(root)} {len(content)}\n".encode() + content)
    versions = (f"{package} {importlib.metadata.version(package)}" for package in _BUILT_ON)
    return sources.hexdigest(), platform.python_version(), processor(), *versions


def load_program(
    key: str | None, inputs: Sequence[jax.ShapeDtypeStruct], device: _Device
) -> tuple[jax.stages.Compiled, Any] | None:
    """The executable, from the list of inputs to the list of outputs, and its outputs' tree; None if there is none.

    The leaves of the tree are ``jax.ShapeDtypeStruct``.
    """
    if key is None or (payload := _read_entry(key)) is None:
        return None
    try:
        executable, outputs = pickle.loads(payload)
        _initialise_libraries(device)
        in_tree = jax.tree.structure((tuple(inputs), {}))
        out_tree = jax.tree.structure(jax.tree.leaves(outputs))
        return serialize_executable.deserialize_and_load(
            executable, in_tree, out_tree, backend=device.client, execution_devices=[device]
        ), outputs
    except Exception:  # unpickling raises anything; the program is compiled instead
        return None


def _initialise_libraries(device: _Device) -> None:
    """JAX gives its kernels the addresses of LAPACK while it lowers; without them a loaded program calls address 0."""
    if device.platform == "cpu":
        from jaxlib import lapack

        lapack.prepare_lapack_call("potrf", np.dtype(np.float32))


def compile_and_keep(lowered: jax.stages.Lowered, key: str | None, outputs: Any) -> jax.stages.Compiled:
    """The executable, which is also written to the cache if one is in use; failures to write are ignored."""
    events = _jax_cache_events()
    events.clear()
    compiled = lowered.compile()
    # XLA can't serialise for a second time what JAX's cache has deserialised: on the CPU the copy loads and then fails
    # when it is run. Where that cache is in use and no event came, somebody has removed the listener.
    unsure = jax.config.values["jax_compilation_cache_dir"] and _JAX_CACHE_ASKED not in events
    if key is None or unsure or _JAX_CACHE_HIT in events:
        return compiled
    try:
        executable, _, _ = serialize_executable.serialize(compiled)
        payload = pickle.dumps((executable, outputs))
    except Exception:  # XLA says in many ways that a program can't be serialised, such as one with callbacks
        return compiled
    _write_entry(key, payload)
    return compiled


_of_thread = threading.local()


def _jax_cache_events() -> set[str]:
    """What JAX's persistent cache did in this thread, since the set was last cleared."""
    if not hasattr(_of_thread, "events"):
        _of_thread.events = set()
    return _of_thread.events


@functools.cache
def _listen_to_jax_cache() -> None:
    def note(event: str, **_: str | int) -> None:
        if event in (_JAX_CACHE_ASKED, _JAX_CACHE_HIT):
            _jax_cache_events().add(event)

    jax.monitoring.register_event_listener(note)


def _read_entry(key: str) -> bytes | None:
    """The payload of an entry; None if there is none or it is damaged."""
    if _cache is None:
        return None
    path = _cache.folder / (key + _SUFFIX)
    try:
        content = path.read_bytes()
    except OSError:
        return None
    payload = memoryview(content)[len(_header(b"")) :]
    if not content.startswith(_header(payload)):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # the time of last use, for _remove_least_recently_used
    return bytes(payload)


def _write_entry(key: str, payload: bytes) -> None:
    if _cache is None:
        return
    with contextlib.suppress(OSError):
        write_atomically(_cache.folder / (key + _SUFFIX), _header(payload) + payload)
        _remove_least_recently_used(_cache)


def _header(payload: bytes | memoryview) -> bytes:
    return _FORMAT + b" " + hashlib.sha256(payload).hexdigest().encode() + b"\n"


def _entries(folder: Path) -> list[Path]:
    """The programs in a folder, and what killed processes have left of others."""
    return [*folder.glob(f"*{_SUFFIX}"), *folder.glob(f".*{UNFINISHED}")]


def _remove_least_recently_used(cache: _Cache) -> None:
    entries = []
    for path in _entries(cache.folder):
        try:
            entries.append((path.stat().st_mtime_ns, path.stat().st_size, path))
        except OSError:  # another process has just removed it
            continue
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= cache.max_bytes:
            return
        path.unlink(missing_ok=True)
        total -= size
