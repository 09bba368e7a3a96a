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


def remove_unfinished() -> None:
    """Removes what calls in other threads have begun to write, for a process that is about to end."""
    for path in tuple(_unfinished):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
