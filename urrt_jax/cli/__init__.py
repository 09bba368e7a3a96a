"""The command ``urrt``: register files, a demonstration, training, evaluation, and what is installed.

One module a subcommand: a frozen dataclass whose fields are its flags and whose ``run`` does the work and returns the
exit code. JAX is imported inside ``run``, so that ``--help`` answers at once; even tyro is imported after Ctrl-C is
looked after.
"""

import functools
import operator
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

from urrt_jax.cli.interrupt import end_on_ctrl_c
from urrt_jax.cli.streams import (
    as_sentence,
    close_streams,
    note,
    open_closed_streams,
    replace_unknown_characters,
    show_warning,
)

_DESCRIPTION = """Rigid registration of 3D point clouds: the rotation R and translation t with target = R @ source + t.

Examples:

urrt demo

urrt register scan.ply model.ply --out moved.ply

urrt register scans/ --to model.ply --out results.csv

Exit codes: 0, done; of register: all pairs converged. 1, register ran, and a pair did not converge. 2, wrong use, bad
input, or a file that could not be written. 130, Ctrl-C.

Results are on stdout; notes, warnings and progress are on stderr.

Completion of commands and flags in bash: urrt --tyro-write-completion bash
~/.local/share/bash-completion/completions/urrt. In zsh: urrt --tyro-write-completion zsh DIR/_urrt, where DIR is one of
the folders in $fpath. 'tcsh' is known, too.

Environment variables:

URRT_DATA      the data for train and evaluate, where --data is not given

URRT_NO_CACHE  if set, compiled programs are not kept in the user's cache folder

URRT_DEBUG     if set, an error shows its traceback"""


def console() -> int:
    """The exit code of the process ``urrt``: ``main`` on a terminal of any encoding, which Ctrl-C ends at once."""
    open_closed_streams()
    end_on_ctrl_c()
    replace_unknown_characters()
    try:
        code = main()
    except SystemExit as end:  # of tyro, after --help or wrong use
        code = end.code if isinstance(end.code, int) else 2 if end.code else 0
    except BrokenPipeError:  # nobody reads the help to its end
        code = 0
    close_streams()
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of ``urrt`` with these arguments (the process's own by default), as ``urrt --help`` lists them.

    An error or a warning is one line on stderr.

    Raises:
      SystemExit: from tyro, after ``--help``, and for flags that it does not know.
      BrokenPipeError: nobody reads the help.
    """
    command = _parse(arguments)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default", UserWarning)
            warnings.showwarning = show_warning
            _keep_compiled_programs(command)
            return command.run()
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # nobody reads the rows of many results, or the progress
        return 2
    except Exception as error:
        if os.environ.get("URRT_DEBUG"):
            raise
        note(f"error: {as_sentence(error)}")
        return 2


def _parse(arguments: Sequence[str] | None) -> Any:
    """The subcommand that these arguments name, with its flags."""
    import tyro

    from urrt_jax.cli.demo import Demo
    from urrt_jax.cli.evaluate import Evaluate
    from urrt_jax.cli.info import Info
    from urrt_jax.cli.register import Register
    from urrt_jax.cli.train import Train

    commands = {
        "register": (Register, "Align two clouds, or many with one target."),
        "demo": (Demo, "Register a made-up shape to its copy in a random pose."),
        "train": (Train, "Train our network on shapes, without labels, or a learned method to compare it with."),
        "evaluate": (Evaluate, "Measure the errors of registration methods over a data set."),
        "info": (Info, "Show versions, devices, packaged models and the cache of compiled programs."),
    }
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # The short descriptions are for the list of commands; the help of one command is its docstring.
    listed = not arguments or arguments[0] not in commands
    choices = [
        Annotated[command, tyro.conf.subcommand(name, description=said if listed else None)]
        for name, (command, said) in commands.items()
    ]
    command: Any = functools.reduce(operator.or_, choices)
    style = tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName
    return tyro.cli(command, prog="urrt", description=_DESCRIPTION, args=arguments, config=style)


def _keep_compiled_programs(command: Any) -> None:
    """From now on compiled programs are kept in the user's cache folder, if that can be written."""
    if os.environ.get("URRT_NO_CACHE"):
        return
    # Before JAX is imported: XLA's CPU loader logs a screenful of errors for every program, because it takes two tuning
    # hints for instructions that the processor lacks; programs for other processors have other names.
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    from urrt_jax.cli.train import Train
    from urrt_jax.program_cache import use_compilation_cache

    use_compilation_cache(jitted=isinstance(command, Train))  # the steps of training are jitted
