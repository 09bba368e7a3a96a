"""``urrt evaluate``: the errors of one or more methods over a data set."""

import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure the errors of registration methods over the shapes of a data set.

    Beside --out, in the folder 'items', a .npz for every method keeps the values of every item; the same command
    continues a run that was stopped (remove the folder after changing code). An item on which a method fails is scored
    as the identity and listed.

    Two methods on made-up shapes: urrt evaluate --methods register icp --limit 100 --out results.json

    A harder protocol: urrt evaluate --protocol 'outliers share=0.2' --methods register

    Exit codes: 0, the figures were written. 2, wrong use or bad input.

    Attributes:
        data: 'procedural', a .npz file, a folder of ModelNet40, or a folder of meshes; by default $URRT_DATA, else
            'procedural'. For the protocol 'scans' a .npz with names, pose_to_world and pts_<name>.
        split: Which half of the data.
        protocol: How pairs are made: dcp, prnet, prnet_noise, rpmnet (needs --points 2048), incomplete,
            incomplete_both, drift, drift_target, outliers, independent, independent_noise, scans. Options follow the
            name, as in 'outliers share=0.2'.
        methods: network, register, plain and search are ours: the network alone, register as it is by default, without
            a search, and always after a search within 90° (search_all: among all rotations); a model of its own may
            follow, as in network:modelnet40-paper. identity and principal_axes need nothing; icp, icp_identity,
            icp_plane, gicp, fgr, fgr_icp, ransac, ransac_icp, kiss, and on scans scan_icp, scan_fgr, scan_ransac,
            scan_kiss need 'urrt-jax[peers]'; goicp says how to install it. Learned: dcp_v1, rienet (rienet_unseen,
            rienet_7scenes, rienet_icl), pointnetlk, pointnetlk_learning3d and pointnetlk_revisited need their released
            weights in $URRT_DATA/peers; NAME:FILE, as in dcp_v2:runs/dcp_v2/model.npz, has weights that 'urrt train
            --method NAME' wrote.
        model: Ours: name of a packaged model, or a file written by 'urrt train'.
        limit: At most so many items, evenly spread.
        points: Points of each shape.
        batch: Pairs at once, for ours and learned methods; 32 by default, or fewer where the network is large.
        out: Where to write the results.
    """

    data: str | None = None
    split: Literal["train", "test"] = "test"
    protocol: str = "dcp"
    methods: tuple[str, ...] = ("network", "register")
    model: str = "modelnet40"
    limit: int | None = None
    points: int = 1024
    batch: int | None = None
    out: Path = Path("results.json")

    def run(self) -> int:
        """Evaluates, prints the figures and writes them."""
        import jax

        from urrt_jax import __version__, model_card
        from urrt_jax.atomic import write_atomically
        from urrt_jax.cli.printing import changed_flags, print_skipped, without_folder
        from urrt_jax.cli.streams import note, show
        from urrt_jax.data import find_data, load_shapes
        from urrt_jax.evaluation import evaluate, find_method, find_protocol, load_scan_pairs, spread, values_path

        # Everything that may be mistyped is looked at before any work.
        find_protocol(self.protocol)
        methods = {name: find_method(name, model=self.model) for name in self.methods}
        if not methods:
            raise ValueError("methods: name at least one")
        spread(1, self.limit)
        identities = {without_folder(name): method.identity() for name, method in methods.items()}
        if len(identities) < len(methods):
            raise ValueError("methods: models of one file name would share a column; copy them to different names")
        card, source = model_card(self.model), find_data(self.data)
        if self.protocol.split()[0] == "scans":
            pairs, _ = load_scan_pairs(source)
        else:
            shapes = load_shapes(source, split=self.split, points=self.points, progress=True)
            print_skipped(shapes.skipped)
            pairs = shapes.points
        items = spread(len(pairs), self.limit)

        self.out.parent.mkdir(parents=True, exist_ok=True)
        figures, failures = {}, {}
        if sys.stderr.isatty() and any(method.batch > 1 for method in methods.values()):
            note("methods that take batches compile at the first one, unless an earlier run kept the programs")
        for name, method in methods.items():
            save = values_path(self.out.parent / "items", name, method, self.protocol, pairs, items)
            save.parent.mkdir(exist_ok=True)
            batch = self.batch if method.batch > 1 else None
            found = evaluate(method, self.protocol, pairs, items=items, save=save, batch=batch)
            figures[without_folder(name)] = found.summary()
            failures[without_folder(name)] = {str(item): reason for item, reason in found.failures.items()}
        # Names only: a results file is for other people, too.
        settings = {
            "command": shlex.join(["urrt", "evaluate", *changed_flags(self)]),
            "versions": {"urrt_jax": __version__, "jax": jax.__version__},
            "device": jax.devices()[0].platform,
            "model": Path(self.model).name,
            "model_sha256": card["sha256"],
            "data": Path(source).name,
            "split": self.split,
            "points": self.points,
            "protocol": self.protocol,
            "items": len(items),
            "seed": "the number of each item",
            "methods": identities,
        }
        show(figures_table(figures))
        write_atomically(
            self.out, json.dumps(settings | {"figures": figures, "failed_items": failures}, indent=2) + "\n"
        )
        note(f"wrote {self.out}, and the values of every item to {self.out.parent / 'items'}")
        return 0


def figures_table(figures: dict[str, dict[str, Any]]) -> str:
    """The figures as text: a row a figure, a column a method."""
    rows = list(dict.fromkeys(row for each in figures.values() for row in each))
    width = max(map(len, rows)) + 2
    columns = {name: max(16, len(name) + 2) for name in figures}
    lines = [" " * width + "".join(f"{name:>{wide}}" for name, wide in columns.items())]
    for row in rows:
        cells = (f"{_short(figures[name].get(row)):>{wide}}" for name, wide in columns.items())
        lines.append(f"{row:<{width}}" + "".join(cells))
    return "\n".join(lines)


def _short(value: Any) -> str:
    return "" if value is None else f"{value:.5g}"
