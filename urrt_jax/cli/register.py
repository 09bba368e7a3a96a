"""``urrt register``: two files to a transform, or many files to a table of transforms."""

from __future__ import annotations

import json as json_format
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

if TYPE_CHECKING:
    from urrt_jax import Registration
    from urrt_jax.io import PointCloud


@dataclass(frozen=True, kw_only=True)
class Register:
    """Align two clouds: the transform that carries the source onto the target, and how well it fits.

    Reads .ply, .obj, .off, .stl, .pcd, .las, .laz, .xyz, .pts, .txt, .csv, .npy and .npz. Both files must use one unit;
    any will do.

    Two files: urrt register scan.ply model.ply --out moved.ply --view pair.html

    A folder of sources, one target: urrt register scans/ --to model.ply --out results.csv

    A table of pairs: urrt register --pairs pairs.csv --out results.csv

    Many pairs give a CSV with a row each: source, target, the matrix row by row (m00, m01, ..., m33), fitness, rmse,
    overlap_source, overlap_target, confidence, converged, reason, seconds, options, inputs. A pair that can't be
    registered has nan for its numbers and a reason, and stops no other. The same command continues a run that was
    stopped: pairs in the file are not run again, unless their files have changed since.

    Exit codes: 0, all converged. 1, at least one pair did not. 2, wrong use, bad input, or a file could not be written.

    Attributes:
        source: File of the cloud that moves, or with --to a folder of such files.
        target: File of the cloud that stays.
        to: The target of all files in the folder SOURCE, which are registered in the order of their names. Files named
            .txt or .csv are left out if the folder has others.
        pairs: Table of pairs (CSV): columns source, target and, where known, initial, a file of a rough transform.
            Relative paths are relative to the table's folder.
        json: Print one JSON object: matrix, rotation, translation, fitness, rmse, overlap, confidence, converged,
            reason, information, covariance, alternatives (matrix and weight of each). A number that is not finite is
            null. Of many pairs: pairs, converged, not_converged (counts by reason), failed, results (a list).
        out: Write the moved source here, as .ply, .pcd, .las, .laz, .xyz, .txt, .csv, .npy or .npz. It keeps the
            source's colours and normals if the format holds them; without colours a .ply is coloured by region. Of many
            pairs: write the results here (.csv) instead of on stdout.
        picture: Write a picture of before and after here (.png, .pdf or .svg).
        view: Write a page here (.html) that shows both clouds in a browser.
        search: Look among all poses, whatever the rotation and with partial overlap: 'auto' where the network's
            estimate does not fit.
        initial: File of a rough transform from source to target, where one is known: four rows of text, .npy, or what
            --json printed. With --to it is that of all files.
        no_refine: Keep the network's own estimate, without search and ICP.
        model: Name of a packaged model (see 'urrt info'), or a file written by 'urrt train'.
        inlier_distance: What counts as touching in fitness and rmse, in the clouds' unit; by default 1.5 times the
            spacing of the coarser cloud.
        samples: Points to draw on a mesh with faces, from 1 to 10,000,000.
    """

    source: Positional[Path | None] = None
    target: Positional[Path | None] = None
    to: Path | None = None
    pairs: Path | None = None
    json: bool = False
    out: Path | None = None
    picture: Path | None = None
    view: Path | None = None
    search: Literal["auto", "always", "never"] = "auto"
    initial: Path | None = None
    no_refine: bool = False
    model: str = "modelnet40"
    inlier_distance: float | None = None
    samples: int = 20_000

    def run(self) -> int:
        """Registers, prints, and writes what was asked for."""
        given = [self.source is not None, self.target is not None, self.to is not None, self.pairs is not None]
        if given == [False, False, False, True] or given == [True, False, True, False]:
            return self._run_many()
        if self.source is None or self.target is None or given != [True, True, False, False]:
            raise ValueError(
                "name two files (urrt register A B), a folder and its target (urrt register FOLDER --to B), "
                "or a table of pairs (urrt register --pairs PAIRS.csv)"
            )
        if self.target.is_dir():
            raise ValueError(f"{self.target} is a folder, a file was expected")
        if self.source.is_dir():
            raise ValueError(
                f"{self.source} is a folder; 'urrt register {self.source} --to {self.target}' registers all its files"
            )
        return self._run_one(self.source, self.target)

    def _run_one(self, source_path: Path, target_path: Path) -> int:
        from urrt_jax import register
        from urrt_jax.cli.compiling import compile_for
        from urrt_jax.cli.outputs import check_outputs, check_page, check_picture
        from urrt_jax.cli.printing import as_dict, as_table
        from urrt_jax.cli.streams import as_sentence, note, show
        from urrt_jax.io import check_samples, check_writable, read_cloud, read_point_cloud, read_transform

        # Everything that may be mistyped is looked at before any work.
        check_samples(self.samples, name="--samples")
        outputs = {"--out": self.out, "--picture": self.picture, "--view": self.view}
        check_outputs(outputs, (source_path, target_path, self.initial, Path(self.model)))
        check_picture(self.picture, "--picture")
        if self.out is not None:
            check_writable(self.out)
        check_page(self.view, "--view")
        initial = None if self.initial is None else read_transform(self.initial)
        options = self._options()
        cloud = read_point_cloud(source_path, samples=self.samples)
        source, target = cloud.points, read_cloud(target_path, samples=self.samples)
        compile_for(max(len(source), len(target)), **options)
        result = register(source, target, **options, initial=initial, inlier_distance=self.inlier_distance)
        if self.json:
            show(json_format.dumps(as_dict(result), allow_nan=False))
        else:
            show(f"source       {source_path.name}, {len(source):,} points")
            show(f"target       {target_path.name}, {len(target):,} points\n")
            show(as_table(result))

        # Only now: a file that can't be written must not cost the result.
        code = 0 if result.converged else 1
        for path, write in self._writers(cloud, target, result):
            try:
                write(path)
            except Exception as error:
                note(f"error: {path} was not written: {as_sentence(error)}")
                code = 2
            else:
                note(f"wrote {path}")
        return code

    def _writers(
        self, cloud: PointCloud, target: Any, result: Registration
    ) -> list[tuple[Path, Callable[[Path], None]]]:
        """The files to write, each with a function that writes it."""
        from urrt_jax.cli.printing import write_picture
        from urrt_jax.io import holds_colors, holds_normals, write_cloud
        from urrt_jax.viewer import region_colors, save_page

        title = None if self.source is None or self.target is None else f"{self.source.name} → {self.target.name}"

        def write_moved(path: Path) -> None:
            moved, more = result.apply(cloud.points), {}
            if holds_colors(path) and cloud.colors is not None:
                more["colors"] = cloud.colors
            elif path.suffix.lower() == ".ply":
                more["colors"] = region_colors(result.source_regions)
            if holds_normals(path) and cloud.normals is not None:
                more["normals"] = turned(cloud.normals, result.rotation)
            write_cloud(path, moved, **more)

        writers = {
            self.out: write_moved,
            self.picture: lambda path: write_picture(path, cloud.points, target, result),
            self.view: lambda path: save_page(path, cloud.points, target, result, title=title),
        }
        return [(path, write) for path, write in writers.items() if path is not None]

    def _run_many(self) -> int:
        from urrt_jax.cli.many import (
            COLUMNS,
            Results,
            as_object,
            pairs_of_folder,
            pairs_of_table,
            print_summary,
            register_many,
            summary,
        )
        from urrt_jax.cli.outputs import check_outputs
        from urrt_jax.cli.streams import note, show
        from urrt_jax.io import check_samples, read_transform
        from urrt_jax.registration import check_options, check_rigid

        check_samples(self.samples, name="--samples")
        for flag, path in (("--picture", self.picture), ("--view", self.view)):
            if path is not None:
                raise ValueError(f"{flag}: shows one pair: urrt register SOURCE TARGET {flag} {path}")
        if self.out is not None and self.out.suffix.lower() != ".csv":
            raise ValueError(f"--out: {self.out}: the results of many pairs are written as .csv")
        if self.pairs is not None and self.initial is not None:
            raise ValueError("--initial: give the table of --pairs a column initial")
        if self.source is not None and not self.source.is_dir():
            what = "is a file" if self.source.exists() else "is no folder, there is nothing of this name"
            raise ValueError(f"{self.source} {what}; --to takes a folder, 'urrt register A B' two files")
        if self.to is not None and not self.to.is_file():
            what = "is a folder, a file was expected" if self.to.is_dir() else "there is no such file"
            raise ValueError(f"--to: {self.to}: {what}")
        if self.initial is not None:
            check_rigid(read_transform(self.initial))
        check_outputs({"--out": self.out}, (self.pairs, self.to, self.initial))
        options = self._options() | {"inlier_distance": self.inlier_distance}
        check_options(options["model"], options["refine"], options["search"], self.inlier_distance)
        if self.pairs is not None:
            pairs = pairs_of_table(self.pairs)
        else:
            assert self.source is not None and self.to is not None  # run has looked
            pairs = pairs_of_folder(self.source, self.to, self.initial, out=self.out)
        results = Results(pairs, self._described(), self.out, echo=not self.json)
        if self.out is None and not self.json:
            show(",".join(COLUMNS))
        if results.left and sys.stderr.isatty():
            note("programs are compiled at the first pairs of each size, unless an earlier run kept them")
        register_many(results, samples=self.samples, options=options)
        found = summary(results.rows())
        print_summary(found)
        if self.json:
            show(json_format.dumps(found | {"results": [as_object(row) for row in results.rows()]}, allow_nan=False))
        return 0 if found["converged"] == len(pairs) else 1

    def _options(self) -> dict[str, Any]:
        """What ``register`` is told."""
        from urrt_jax import Search, load_model
        from urrt_jax.refine import ICP

        if self.no_refine and self.search == "always":
            raise ValueError("--no-refine: keeps the network's own estimate, without a search; leave --search out")
        return {
            "model": load_model(self.model),
            "refine": None if self.no_refine else ICP(),
            "search": None if self.no_refine else {"auto": "auto", "always": Search(), "never": None}[self.search],
        }

    def _described(self) -> str:
        """What decides the result beside the files, in words without paths."""
        from urrt_jax import __version__, model_card

        said = [f"urrt {__version__}", f"model {Path(self.model).stem} {model_card(self.model)['sha256'][:8]}"]
        if self.no_refine:
            said.append("no refinement")
        elif self.search != "auto":
            said.append(f"search {self.search}")
        if self.inlier_distance is not None:
            said.append(f"inlier distance {self.inlier_distance:g}")
        if self.samples != 20_000:
            said.append(f"{self.samples} samples")
        return ", ".join(said)


def turned(normals: Any, rotation: Any) -> Any:
    """The normals (N, 3) of the moved cloud, in their own dtype."""
    import numpy as np

    normals = np.asarray(normals)
    return (normals.astype(np.float64) @ np.asarray(rotation, np.float64).T).astype(normals.dtype)
