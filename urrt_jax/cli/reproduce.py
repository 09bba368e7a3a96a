"""``urrt reproduce``: the tables and figures of the paper, and the ones it should have had."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Reproduce a table or figure in a clone of this repository, from data to Markdown and pictures.

    The values of every item are kept beside --out, in the folder 'items': the same command continues a run that was
    stopped, and tables share what they have in common (remove the folder after changing code). Methods of other
    libraries need 'urrt-jax[peers]'; a missing one is a row that says how to install it.

    Attributes:
        table: table1, table2, table3, figure4, beyond, unseen, or a folder with a config.toml of your own.
        data: 'procedural', a .npz file, a folder of ModelNet40, or a folder of meshes; by default $URRT_DATA, else
            'procedural'. Tables beyond the paper look for bunny_scans.npz and a set of 2,048 points a shape in it.
        out: Folder to write; by default reproduced/TABLE.
        limit: At most so many items of each protocol, evenly spread.
        only: Methods to measure anew, by their names in the config.toml; the rows of the others are taken from the
            results in --out, which must be of the same code.
        model: Ours: name of a packaged model, or a file written by 'urrt train'.
    """

    table: Annotated[str, tyro.conf.Positional]
    data: str | None = None
    out: Path | None = None
    limit: int | None = None
    only: tuple[str, ...] | None = None
    model: str = "modelnet40"

    def run(self) -> int:
        """Runs the experiment, prints its table and says what was written."""
        from urrt_jax.data import find_data
        from urrt_jax.reproduce import draw_pairs, find_experiment, reproduce

        experiment = find_experiment(self.table)
        data = find_data(self.data)
        out = self.out or Path("reproduced") / experiment.name
        flags = ["urrt", "reproduce", Path(self.table).name, "--data", Path(data).name]
        if self.out is not None:
            flags += ["--out", self.out.as_posix() if not self.out.is_absolute() else self.out.name]
        flags += [] if self.limit is None else ["--limit", str(self.limit)]
        flags += [] if self.model == "modelnet40" else ["--model", Path(self.model).name]
        command = shlex.join(flags)
        if experiment.kind == "table":
            reproduce(
                experiment, data, out,
                model=self.model, limit=self.limit, only=self.only, command=command, report=print,
            )  # fmt: skip
            print((out / "table.md").read_text())
            drawn = "table.md and figures"
        else:
            if self.only is not None:
                raise ValueError(f"--only: {experiment.name} is drawn as a whole")
            draw_pairs(experiment, data, out, model=self.model, limit=self.limit, command=command, report=print)
            drawn = "figure.png"
        print(f"wrote results.json and {drawn} to {out}")
        return 0
