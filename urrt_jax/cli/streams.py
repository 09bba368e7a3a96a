"""Standard output and standard error of the commands: results on the one, everything else on the other."""

import codecs
import io
import os
import sys
from typing import Any, TextIO

_READABLE = {"°": " deg", "²": "^2", "≈": "~", "×": "x", "±": "+-", "…": "...", "•": "*", "–": "-", "—": "-", "→": "->"}


def show(text: str) -> None:
    """Prints a result on stdout at once. If nobody reads stdout any more, the command goes on without it."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _discard(sys.stdout)


def note(text: str) -> None:
    """Prints a line on stderr that begins with the name of the program."""
    try:
        print(f"urrt: {text}", file=sys.stderr, flush=True)
    except BrokenPipeError:
        _discard(sys.stderr)


def show_warning(message: Warning | str, *_: Any) -> None:
    """A Python warning as one line on stderr; it takes the place of ``warnings.showwarning``."""
    note(f"warning: {' '.join(str(message).split())}")


def open_closed_streams() -> None:
    """Gives the process a standard input, output and error that lead nowhere, where its caller has closed them.

    Otherwise the next file to be opened would take the place of one of them, and get what is printed.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the smallest number that is free
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115


def replace_unknown_characters() -> None:
    """From now on stdout and stderr show characters that their encoding lacks in a readable way, as " deg" for "°"."""
    codecs.register_error("readable", _replace)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="readable")


def close_streams() -> None:
    """Writes what is left to stdout and stderr; what cannot be written is dropped without a word."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            _discard(stream)


def as_sentence(error: BaseException) -> str:
    """What went wrong, as one line for a person."""
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror:
        reason = error.strerror[:1].lower() + error.strerror[1:]
        return reason if error.filename is None else f"{error.filename}: {reason}"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in text:
        return "there is not enough memory for clouds of this size"
    if text and isinstance(error, ValueError | OSError | ImportError | FloatingPointError):
        return text
    return f"unexpected, please report it ({type(error).__name__}: {text}); with URRT_DEBUG=1 its traceback is shown"


def _replace(error: UnicodeError) -> tuple[str, int]:
    """The error handler "readable" of ``codecs``."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    unknown = error.object[error.start : error.end]
    known = (_READABLE.get(character, "?") for character in unknown)
    return "".join(known).encode(error.encoding, "replace").decode(error.encoding), error.end


def _discard(stream: TextIO) -> None:
    """Whatever is written to this stream from now on is thrown away, also what it still holds."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
