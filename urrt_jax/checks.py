"""What the configurations refuse, in the same words."""

import math
from typing import Any


def check_whole(options: Any, **least: int) -> None:
    """Refuses, with a ``ValueError`` naming the field, values that are not whole numbers of at least so much."""
    for name, smallest in least.items():
        value = getattr(options, name)
        if type(value) is not int:
            raise ValueError(f"{name}: expected a whole number, got {value!r}")
        if value < smallest:
            raise ValueError(f"{name}: expected at least {smallest}, got {value}")


def check_positive(options: Any, *names: str) -> None:
    """Refuses, with a ``ValueError`` naming the field, values that are not positive, finite numbers."""
    for name in names:
        value = getattr(options, name)
        if not (isinstance(value, int | float) and 0 < value < math.inf):
            raise ValueError(f"{name}: expected a positive number, got {value!r}")


def check_share(options: Any, *names: str) -> None:
    """Refuses, with a ``ValueError`` naming the field, values that are not numbers from 0 to 1."""
    for name in names:
        value = getattr(options, name)
        if not (isinstance(value, int | float) and 0 <= value <= 1):
            raise ValueError(f"{name}: expected a share from 0 to 1, got {value!r}")
