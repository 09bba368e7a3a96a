"""Files that a command is told to write: what is wrong with their names is said before any work."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from urrt_jax.atomic import check_place

PICTURES = (".png", ".pdf", ".svg")


def check_outputs(outputs: Mapping[str, Path | None], inputs: Iterable[Path | None] = ()) -> None:
    """Nothing, if each of these files could be written and no other file of the command would be overwritten.

    Args:
      outputs: by the name of the flag, for instance "--out"; None where a flag is not given.
      inputs: files that the command reads; None where there is none.

    Raises:
      ValueError: a file can't be written there (``check_place``), or two names are one file.
    """
    taken = {_identity(path): f"{path} is read" for path in inputs if path is not None}
    for flag, path in outputs.items():
        if path is None:
            continue
        try:
            check_place(path)
        except ValueError as error:
            raise ValueError(f"{flag}: {error}") from error
        if (use := taken.get(_identity(path))) is not None:
            raise ValueError(f"{flag}: {use} by this command too; choose another name")
        taken[_identity(path)] = f"{path} is written by {flag}"


def check_picture(path: Path | None, flag: str) -> None:
    """Nothing, if a picture can be drawn into a file of this name, or none is asked for.

    Raises:
      ValueError: another extension than .png, .pdf or .svg.
      ImportError: Matplotlib is not installed.
    """
    if path is None:
        return
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"{flag}: {path}: a picture can be written as {', '.join(PICTURES)}")
    if not has_matplotlib():
        raise ImportError(f"{flag}: pictures need Matplotlib: pip install 'urrt-jax[viz]'")


def check_page(path: Path | None, flag: str) -> None:
    """Nothing, if a page is written into a file of this name, or none is asked for; else a ``ValueError``."""
    if path is not None and path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{flag}: {path}: a page is written as .html")


def has_matplotlib() -> bool:
    """Whether Matplotlib is installed."""
    from importlib.util import find_spec

    return find_spec("matplotlib") is not None


def _identity(path: Path) -> object:
    """What is equal for two names of one file: hard links and names on a file system that ignores case, too."""
    try:
        status = path.stat()
    except OSError:
        return path.resolve()
    return status.st_dev, status.st_ino
