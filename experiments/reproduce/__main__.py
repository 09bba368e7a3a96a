"""The command `python -m experiments.reproduce`, run from the root of the clone."""

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

_STYLE = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName)


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Reproduce a table or figure: load the data, run every method, write results.json, Markdown and figures.

    The errors of every pair are saved in the folder 'items' beside --out. If a run is stopped, the same command
    continues it, and tables that measure the same method on the same pairs share the saved errors. Remove the folder
    after changing code. Methods of other libraries need 'urrt-jax[peers]'; the row of a method that is not installed
    says how to install it.

    Attributes:
        table: table1, table2, table3, figure4, beyond, unseen, default, or a folder of your own with a config.toml.
        data: 'procedural', a .npz file, a folder of ModelNet40, or a folder of meshes; by default $URRT_DATA, or
            'procedural' if that is not set. Tables beyond the paper also look in this folder for bunny_scans.npz and
            for a set with 2,048 points per shape.
        out: Folder to write to; by default reproduced/TABLE.
        limit: Measure at most this many pairs of each protocol, evenly spread over the data.
        only: Measure these methods anew, by their names in the config.toml. The rows of the other methods are copied
            from the results in --out, which must be of the same data, pairs and settings; rows that are not there are
            measured.
        model: Our network: the name of a packaged model, or a file written by 'urrt train'.
    """

    table: Annotated[str, tyro.conf.Positional]
    data: str | None = None
    out: Path | None = None
    limit: int | None = None
    only: tuple[str, ...] | None = None
    model: str = "modelnet40"

    def run(self) -> None:
        """Runs the experiment, prints its table and the names of the files that were written."""
        # Imported here, so that --help does not wait for JAX.
        from experiments.reproduce.experiment import find_experiment
        from experiments.reproduce.pictures import draw_pairs
        from experiments.reproduce.run import reproduce
        from urrt_jax.data import find_data

        experiment = find_experiment(self.table)
        data = find_data(self.data)
        out = self.out or Path("reproduced") / experiment.name
        command = self._command(data)
        if experiment.kind == "table":
            reproduce(
                experiment, data, out,
                model=self.model, limit=self.limit, only=self.only, command=command, report=print,
            )  # fmt: skip
            print((out / "table.md").read_text())
            drawn = "table.md and figures"
        else:
            if self.only is not None:
                raise ValueError(f"--only: {experiment.name} is a figure, which is always drawn whole")
            draw_pairs(experiment, data, out, model=self.model, limit=self.limit, command=command, report=print)
            drawn = "figure.png"
        print(f"wrote results.json and {drawn} to {out}")

    def _command(self, data: str) -> str:
        """The command as the results record it: names in place of paths outside the clone; no --only."""
        flags = ["python", "-m", "experiments.reproduce", Path(self.table).name, "--data", Path(data).name]
        if self.out is not None:
            flags += ["--out", self.out.as_posix() if not self.out.is_absolute() else self.out.name]
        flags += [] if self.limit is None else ["--limit", str(self.limit)]
        flags += [] if self.model == "modelnet40" else ["--model", Path(self.model).name]
        return shlex.join(flags)


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of the command: 0, 2 for an error, 130 for Ctrl-C.

    `arguments` are the process's own by default. An error is one line on stderr, or a traceback if URRT_DEBUG is set.
    """
    command = tyro.cli(Reproduce, prog="python -m experiments.reproduce", args=arguments, config=_STYLE)
    try:
        command.run()
    except KeyboardInterrupt:
        return 130
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        if os.environ.get("URRT_DEBUG"):
            raise
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
