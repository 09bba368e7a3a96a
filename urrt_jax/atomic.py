"""Writing a file whole or not at all."""

import contextlib
import os
import secrets
from pathlib import Path

UNFINISHED = ".part"
"""How the name of a file ends that a killed process may leave behind."""

_unfinished: set[Path] = set()


def write_atomically(path: str | os.PathLike[str], content: bytes | str) -> None:
    """Writes the file, so that a reader, or a kill at any moment, finds the old content or all of the new.

    Where `path` is a symbolic link, the file it points to is written and the link stays.

    Raises:
      OSError: the folder does not exist or can't be written; the message names ``path``.
    """
    target = Path(os.path.realpath(path))
    # In the same folder, because a move is atomic only within one file system; machines may share it. The name is not
    # made from the target's, which may be as long as a name can be.
    unfinished = target.with_name(f".{os.getpid()}-{secrets.token_hex(8)}{UNFINISHED}")
    _unfinished.add(unfinished)
    try:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(unfinished, target)
    except OSError as error:
        raise type(error)(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        # Whatever keeps it from being removed also kept it from being written, and has been raised already.
        with contextlib.suppress(OSError):
            unfinished.unlink()
        _unfinished.discard(unfinished)


def check_place(path: str | os.PathLike[str]) -> None:
    """Raises a ``ValueError`` that says why, where ``write_atomically`` should not or could not write this file.

    The folder is missing or can't be written to, or the name is that of a folder, a pipe or a device, which must not be
    replaced by a file.
    """
    path = Path(path)
    folder = Path(os.path.realpath(path)).parent  # where a link points to is where it is written
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder} to write to")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: the folder {folder} is not writable")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path}: exists and is not a regular file, so it is not replaced")


def remove_unfinished() -> None:
    """Removes what calls in other threads have begun to write, for a process that is about to end."""
    for path in tuple(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
