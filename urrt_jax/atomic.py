"""Writing a file whole or not at all."""

import os
import secrets
from pathlib import Path


def write_atomically(path: str | os.PathLike[str], content: bytes | str) -> None:
    """Writes the file, so that a reader, or a kill at any moment, finds the old content or all of the new.

    Raises:
      OSError: the folder does not exist or can't be written; the message names ``path``.
    """
    path = Path(path)
    # In the same folder, because a move is atomic only within one file system; machines may share it.
    unfinished = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    try:
        unfinished.write_bytes(content.encode() if isinstance(content, str) else content)
        os.replace(unfinished, path)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        unfinished.unlink(missing_ok=True)
