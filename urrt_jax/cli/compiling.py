"""What a command says while it compiles."""

import sys
from typing import Any

from urrt_jax.cli.streams import note
from urrt_jax.registration import make_options
from urrt_jax.stages import rung
from urrt_jax.warming import is_warm, warm_up


def compile_for(size: int, *, model: Any, refine: Any, search: Any) -> None:
    """Compiles ``register`` for clouds of so many points, and says so on stderr; does nothing where that is a file.

    Arguments as for ``warm_up``.
    """
    if sys.stderr.isatty() and not is_warm(size, make_options(model, refine, search)):
        note(f"compiling, once for clouds of up to {rung(size):,} points")
        warm_up([size], model=model, refine=refine, search=search, rare=False, progress=True)
