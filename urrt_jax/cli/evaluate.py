"""``urrt evaluate``: a model's errors over a data set."""

import json
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure a model's errors over the shapes of a data set, before and after refinement.

    Attributes:
        data: 'procedural', a .npz file, a folder of ModelNet40, or a folder of meshes; by default $URRT_DATA, else
            'procedural'.
        split: Which half of the data.
        protocol: How pairs are made; 'dcp': the clean pairs of Deep Closest Point.
        model: Name of a packaged model, or a file written by 'urrt train'.
        limit: At most so many shapes.
        points: Points of each shape.
        batch: Pairs at once.
        no_refine: Measure the network alone, without ICP.
        out: Where to write the results.
    """

    data: str | None = None
    split: Literal["train", "test"] = "test"
    protocol: str = "dcp"
    model: str = "modelnet40"
    limit: int | None = None
    points: int = 1024
    batch: int = 64
    no_refine: bool = False
    out: Path = Path("results.json")

    def run(self) -> int:
        """Evaluates, prints the summary and writes it."""
        import jax

        from urrt_jax import __version__, load_model, model_card
        from urrt_jax.atomic import write_atomically
        from urrt_jax.cli.printing import changed_flags, print_skipped
        from urrt_jax.data import find_data, load_shapes
        from urrt_jax.evaluation import PROTOCOLS, evaluate
        from urrt_jax.refine import ICP

        if self.protocol not in PROTOCOLS:
            raise ValueError(f"protocol: expected one of {sorted(PROTOCOLS)}, got {self.protocol!r}")
        model, source = load_model(self.model), find_data(self.data)
        shapes = load_shapes(source, split=self.split, points=self.points, limit=self.limit, progress=True)
        print_skipped(shapes.skipped)
        evaluation = evaluate(
            model,
            shapes.points,
            protocol=self.protocol,
            refine=None if self.no_refine else ICP(),
            batch=self.batch,
        )
        summary = evaluation.summary()
        # Names only: a results file is for other people, too.
        settings = {
            "model": Path(self.model).name,
            "model_sha256": model_card(self.model)["sha256"],
            "versions": {"urrt_jax": __version__, "jax": jax.__version__},
            "device": jax.devices()[0].platform,
            "command": shlex.join(["urrt", "evaluate", *changed_flags(self)]),
            "data": Path(source).name,
            "split": self.split,
            "points": self.points,
            "refine": not self.no_refine,
        }
        print(figures_table(summary))
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.out, json.dumps(settings | summary, indent=2) + "\n")
        print(f"wrote {self.out}")
        return 0


def figures_table(summary: dict[str, Any]) -> str:
    """The figures of a summary: a row a figure, a column for each of its groups, then what stands alone."""
    groups = {name: figures for name, figures in summary.items() if isinstance(figures, dict)}
    rows = list(dict.fromkeys(row for figures in groups.values() for row in figures))
    lines = [" " * 20 + "".join(f"{name:>12}" for name in groups)]
    for row in rows:
        lines.append(f"{row:<20}" + "".join(f"{figures.get(row, float('nan')):>12.5g}" for figures in groups.values()))
    lines += [f"{name:<20}{_short(value):>12}" for name, value in summary.items() if name not in groups]
    return "\n".join(lines)


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
