"""What all commands share: help, exit codes, streams, warnings, and the cache of compiled programs."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import pytest

from urrt_jax import cli
from urrt_jax.cli.info import Info
from urrt_jax.cli.streams import as_sentence
from urrt_jax.cli.train import Train


@pytest.mark.parametrize(
    "command", [[], ["register"], ["demo"], ["train"], ["evaluate"], ["info"]], ids=lambda c: "".join(c) or "urrt"
)
def test_help_answers_without_importing_jax(command):
    program = (
        "import sys\n"
        "from urrt_jax.cli import main\n"
        "try:\n"
        f"    main({[*command, '--help']})\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "assert not {'jax', 'flax', 'numpy', 'matplotlib', 'trimesh'} & set(sys.modules), 'a heavy import'\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage: urrt" in done.stdout


def test_debugging_shows_the_traceback(register, files, monkeypatch):
    monkeypatch.setenv("URRT_DEBUG", "1")
    with pytest.raises(FileNotFoundError):
        register(source=Path("missing.ply"))


def test_an_unknown_flag_ends_with_code_2(register, files, capsys):
    with pytest.raises(SystemExit) as end:
        register("--nonsense")
    assert end.value.code == 2
    assert capsys.readouterr().out == ""


def test_compiled_programs_are_kept_and_the_second_run_is_silent_about_it(files, tmp_path):
    # Nor JAX's own cache, which the tests share: what it holds is not kept again.
    left_out = "URRT_NO_CACHE", "JAX_COMPILATION_CACHE_DIR"
    environment = {name: value for name, value in os.environ.items() if name not in left_out}
    environment |= {"XDG_CACHE_HOME": str(tmp_path)}
    program = [sys.executable, "-m", "urrt_jax.cli", "register", "--json", "--no-refine"]
    command = [*program, str(files["a.ply"]), str(files["b.xyz"]), "--model", str(files["model.npz"])]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=False) for _ in range(2)
    )
    assert first.returncode == second.returncode in (0, 1)
    assert list((tmp_path / "urrt_jax" / "programs").glob("*.program"))
    assert not (tmp_path / "urrt_jax" / "programs" / "jax").exists()
    assert json.loads(first.stdout) == json.loads(second.stdout)
    assert first.stderr == second.stderr == ""


def test_an_unusable_cache_folder_does_not_matter(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.delenv("URRT_NO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = jax.config.jax_compilation_cache_dir
    cli._keep_compiled_programs(Train(out=tmp_path))
    assert jax.config.jax_compilation_cache_dir == before


def urrt(*arguments: str, **environment: str) -> subprocess.Popen:
    """The command in a process of its own, without a cache of programs."""
    command = [sys.executable, "-m", "urrt_jax.cli", *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=os.environ | environment, stdout=pipe, stderr=pipe, text=True)


def test_help_reads_well_on_a_terminal_that_knows_ascii_only():
    with urrt("info", PYTHONIOENCODING="ascii") as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "within 45 deg about" in out
    with urrt("--help", PYTHONIOENCODING="ascii") as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0 and not err and out.isascii() and "register" in out


@pytest.mark.parametrize("arguments", [["--help"], ["info"]], ids=" ".join)
def test_a_closed_pipe_ends_the_command_silently(arguments):
    with urrt(*arguments) as process:
        process.stdout.close()
        err = process.stderr.read()
    assert err == "" and process.returncode == 0


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("closed", "out"), [("<&-", True), (">&-", False), ("2>&-", True), (">&- 2>&-", False), ("<&- >&- 2>&-", False)]
)
def test_closed_streams_change_neither_the_exit_code_nor_what_is_printed(closed, out):
    command = f"{shlex.quote(sys.executable)} -m urrt_jax.cli info --json {closed}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
    assert bool(done.stdout) == out and (not out or json.loads(done.stdout))


def test_completion_is_a_script_for_the_shell():
    with urrt("--tyro-print-completion", "bash") as process:
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and "complete " in out and "urrt" in out


# Says "ready" and goes into C code that does not return to Python.
_BUSY = """
import sys, threading, time
import urrt_jax.cli
from urrt_jax.cli.info import Info

def run(self):
    import ctypes
    threading.Thread(target=time.sleep, args=(60,)).start()  # Python would wait for it at its end
    print("ready", flush=True)
    ctypes.CDLL(None).sleep(60)
    ctypes.CDLL(None).sleep(60)

Info.run = run
sys.argv = ["urrt", "info"]
sys.exit(urrt_jax.cli.console())
"""


@pytest.mark.skipif(os.name == "nt", reason="os.kill does not send Ctrl-C there")
def test_ctrl_c_ends_a_command_at_once_even_inside_c_code():
    environment = os.environ | {"URRT_NO_CACHE": "1"}
    with subprocess.Popen([sys.executable, "-c", _BUSY], env=environment, stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        start = time.monotonic()
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert time.monotonic() - start < 5
        assert process.stderr.read() == "\n"


@pytest.mark.skipif(os.name == "nt", reason="os.kill does not send Ctrl-C there")
def test_a_command_that_was_told_to_ignore_ctrl_c_ignores_it():
    program = _BUSY.replace(
        "import sys", "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN)\nimport sys", 1
    )
    environment = os.environ | {"URRT_NO_CACHE": "1"}
    with subprocess.Popen([sys.executable, "-c", program], env=environment, stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.5)
        process.kill()


@pytest.mark.skipif(os.name == "nt", reason="os.kill does not send Ctrl-C there")
def test_training_gets_ctrl_c_back_as_an_exception():
    program = """
import os, signal
from urrt_jax.cli.interrupt import end_on_ctrl_c, leave_ctrl_c_to_python
end_on_ctrl_c()
leave_ctrl_c_to_python()
try:
    os.kill(os.getpid(), signal.SIGINT)
    signal.pause()
except KeyboardInterrupt:
    print("saved")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout) == (0, "saved\n"), done.stderr


@pytest.mark.skipif(os.name == "nt", reason="it has no signal masks")
def test_a_child_process_gets_ctrl_c_as_usual():
    child = "import signal; print(signal.getsignal(2) is signal.default_int_handler, signal.pthread_sigmask(0, []))"
    program = f"""
import subprocess, sys
from urrt_jax.cli.interrupt import end_on_ctrl_c
end_on_ctrl_c()
subprocess.run([sys.executable, "-c", {child!r}], check=True)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    assert done.stdout == "True set()\n", done.stderr


def test_a_warning_is_one_line_on_stderr(capsys, monkeypatch):
    def run(self):
        warnings.warn("scale ratio 1000:\nis one in millimetres?", stacklevel=1)
        return 0

    monkeypatch.setattr(Info, "run", run)
    assert cli.main(["info"]) == 0
    assert capsys.readouterr().err == "urrt: warning: scale ratio 1000: is one in millimetres?\n"


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (ValueError("a.ply: empty,\n it holds no points"), "a.ply: empty, it holds no points"),
        (PermissionError(13, "Permission denied", "a.ply"), "a.ply: permission denied"),
        (MemoryError(), "there is not enough memory for clouds of this size"),
        (IndexError("list index out of range"), "unexpected, please report it (IndexError: list index out of range)"),
        (ValueError(), "unexpected, please report it (ValueError: )"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_an_error_is_said_as_a_sentence(error, expected):
    assert as_sentence(error).startswith(expected)


def test_an_unexpected_error_ends_with_code_2_and_a_line(capsys, monkeypatch):
    monkeypatch.setattr(Info, "run", lambda self: [][1])
    assert cli.main(["info"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("urrt: error: unexpected") and err.count("\n") == 1
