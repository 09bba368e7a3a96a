"""Ctrl-C that ends the process at once.

Python raises ``KeyboardInterrupt`` in the main thread when that next runs Python code. XLA compiles for seconds without
doing so, threads that compile are waited for at exit, and an exception raised inside an import or a C callback may be
swallowed. Here the signal reaches a thread of its own, which ends the process.
"""

import contextlib
import os
import signal
import threading
from types import FrameType

from urrt_jax.atomic import remove_unfinished

INTERRUPTED = 130
"""The exit code after Ctrl-C, as shells have it: 128 + SIGINT."""


def end_on_ctrl_c() -> None:
    """From now on Ctrl-C ends the process with exit code 130, whatever it is doing.

    It does nothing where Ctrl-C is ignored, as after ``nohup``, where the caller looks after it, or where the system
    has no pipes that never block (Windows before Python 3.12).
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler or not hasattr(os, "set_blocking"):
        return
    # The handler in C writes the signal's number to this pipe at once, in whichever thread it runs. A blocked signal
    # and sigwait would do the same, but child processes would inherit the block.
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, _ended_elsewhere)
    threading.Thread(target=_watch, args=(reader,), name="urrt Ctrl-C", daemon=True).start()


def leave_ctrl_c_to_python() -> None:
    """Undoes ``end_on_ctrl_c``: Ctrl-C is a ``KeyboardInterrupt`` again, for work that saves first."""
    if signal.getsignal(signal.SIGINT) is _ended_elsewhere:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.set_wakeup_fd(-1)


def _ended_elsewhere(number: int, frame: FrameType | None) -> None:
    """Handler of the main thread."""


def _watch(reader: int) -> None:
    while number := os.read(reader, 1):
        if number[0] == signal.SIGINT:
            remove_unfinished()
            with contextlib.suppress(OSError):
                os.write(2, b"\n")
            os._exit(INTERRUPTED)
