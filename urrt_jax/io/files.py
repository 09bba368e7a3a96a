"""What every file must be before a parser sees it, and what it means when the parser fails."""

from __future__ import annotations

import logging
import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

MAX_BYTES = 4 * 2**30
"""The largest file that is read, in bytes. It holds `MAX_POINTS` points in any binary format; it is a guess."""

MAX_RATIO = 200
"""How many times larger than its compressed form a content may be: scans reach 20, and a bomb of zeros 1,000."""


class BadFile(ValueError):
    """What is wrong with the content of a file, in words; `opened` adds the file's name."""


@contextmanager
def opened(path: Path, *, most: int = MAX_BYTES) -> Iterator[BinaryIO]:
    """The open file; whatever a parser raises inside becomes a `ValueError` that names the file and says why.

    Raises:
        FileNotFoundError: there is no such file.
        OSError: it may not be read.
        ValueError: it is a folder, a pipe or a device, of no bytes or of more than `most`.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise ValueError(f"{path}: a folder, not a file")
    if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait for ever, and a device may have no end
        raise ValueError(f"{path}: a pipe or a device, not a regular file")
    if status.st_size == 0:
        raise ValueError(f"{path}: empty, a file of no bytes")
    if status.st_size > most:
        raise ValueError(f"{path}: of {status.st_size:,} bytes, more than the {most:,} that are read")
    with open(path, "rb") as file, _without_logs(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # NumPy stops at the first word that is no number and warns; the numbers after it would be lost.
        warnings.filterwarnings("error", message="string or file could not be read")
        try:
            yield file
        except BadFile as error:
            raise ValueError(f"{path}: {error}") from error
        except MemoryError:
            raise
        except Exception as error:  # a parser fed with anything may raise anything
            raise ValueError(f"{path}: damaged, or not of the format {path.suffix} in spite of its name") from error


@contextmanager
def _without_logs() -> Iterator[None]:
    """Keeps the parsers from logging, some with a traceback, what is raised here or does not matter."""
    loggers = [logging.getLogger(name) for name in ("trimesh.util", "laspy.lasreader")]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def size_of(file: BinaryIO) -> int:
    """The length of an open file in bytes."""
    return os.fstat(file.fileno()).st_size
