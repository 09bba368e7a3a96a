"""What the configurations refuse, in the same words. Values that are arrays or traced are taken as they are."""

import math
from typing import Any

MOST = 100_000
"""Counts beyond it would ask for more memory than machines have, by a slip of the finger."""


def check_whole(options: Any, *, most: int = MOST, **least: int) -> None:
    """Refuses, with a ``ValueError`` naming the field, values that are not whole numbers within these bounds."""
    for name, smallest in least.items():
        value = getattr(options, name)
        if not _plain(value):
            continue
        if type(value) is not int:
            raise ValueError(f"{name}: expected a whole number, got {value!r}")
        if value < smallest:
            raise ValueError(f"{name}: expected at least {smallest}, got {value}")
        if value > most:
            raise ValueError(f"{name}: expected at most {most}, got {value}")


def check_positive(options: Any, *names: str) -> None:
    """Refuses, with a ``ValueError`` naming the field, values that are not positive, finite numbers."""
    for name in names:
        value = getattr(options, name)
        if _plain(value) and not (isinstance(value, int | float) and 0 < value < math.inf):
            raise ValueError(f"{name}: expected a positive number, got {value!r}")


def check_share(options: Any, *names: str) -> None:
    """Refuses, with a ``ValueError`` naming the field, values that are not numbers from 0 to 1."""
    for name in names:
        value = getattr(options, name)
        if _plain(value) and not (isinstance(value, int | float) and 0 <= value <= 1):
            raise ValueError(f"{name}: expected a share from 0 to 1, got {value!r}")


def _plain(value: Any) -> bool:
    """Whether the value is one that a user wrote down: JAX also puts arrays and placeholders into a pytree's leaves."""
    return value is None or isinstance(value, bool | int | float | str | list | tuple | dict)
