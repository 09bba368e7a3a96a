"""The command ``urrt``: register two files, a demonstration, training, evaluation.

One module a subcommand: a frozen dataclass whose fields are its flags and whose ``run`` does the work. JAX is imported
inside ``run``, so that ``--help`` answers at once.
"""

import os
import sys
from collections.abc import Sequence
from typing import Any

import tyro

from urrt_jax.cli.demo import Demo
from urrt_jax.cli.evaluate import Evaluate
from urrt_jax.cli.register import Register
from urrt_jax.cli.train import Train

_COMMANDS = {"register": Register, "demo": Demo, "train": Train, "evaluate": Evaluate}
_DESCRIPTION = """Rigid registration of 3D point clouds: the rotation R and translation t with target = R @ source + t.

Environment variables:

URRT_DATA      the data for train and evaluate, where --data is not given

URRT_NO_CACHE  if set, compiled programs are not kept in the user's cache folder

URRT_DEBUG     if set, an error shows its traceback"""
_STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName)


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of ``urrt`` with these arguments (the process's own by default): 0, 2 for an error, 130 for Ctrl-C.

    An error of the user is one line on stderr.
    """
    command = tyro.extras.subcommand_cli_from_dict(
        _COMMANDS, prog="urrt", description=_DESCRIPTION, args=arguments, config=_STYLE
    )
    try:
        _keep_compiled_programs(command)
        return command.run()
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        if os.environ.get("URRT_DEBUG"):
            raise
        print("urrt: error:", " ".join(str(error).split()), file=sys.stderr)
        return 2


def _keep_compiled_programs(command: Any) -> None:
    """From now on compiled programs are kept in the user's cache folder, if that can be written."""
    if os.environ.get("URRT_NO_CACHE"):
        return
    # Before JAX is imported: XLA's CPU loader logs a screenful of errors for every program, because it takes two tuning
    # hints for instructions that the processor lacks; programs for other processors have other names.
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    from urrt_jax.program_cache import processor, use_compilation_cache

    folder = use_compilation_cache()
    if folder is None or not isinstance(command, Train):
        return
    # The steps of training are no programs of ours, but jitted functions, which JAX itself can keep.
    from importlib.metadata import version

    import jax

    folder = folder.parent / "jax" / f"{version('jaxlib')}-{processor()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
