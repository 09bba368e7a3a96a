"""``urrt register``: two files to a transform."""

from __future__ import annotations

import json as json_format
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional


@dataclass(frozen=True, kw_only=True)
class Register:
    """Align two clouds: the transform that carries the source onto the target, and how well it fits.

    Reads .ply, .obj, .off, .stl, .xyz, .npy, .npz and .pcd. Both files must use one unit; any will do.

    Attributes:
        source: File of the cloud that moves.
        target: File of the cloud that stays.
        json: Print one JSON object: matrix, rotation, translation, fitness, rmse, overlap, confidence, converged,
            reason, information, covariance, alternatives (matrix and weight of each). A number that is not finite is
            null.
        out: Write the moved source here, as .ply (coloured by region), .xyz or .npy.
        picture: Write a picture of before and after here (.png, .pdf or .svg).
        search: Look among all poses, whatever the rotation and with partial overlap: 'auto' where the network's
            estimate does not fit.
        initial: File of a rough transform from source to target, where one is known: four rows of text, .npy, or what
            --json printed.
        no_refine: Keep the network's own estimate, without search and ICP.
        model: Name of a packaged model, or a file written by 'urrt train'.
        inlier_distance: What counts as touching in fitness and rmse, in the clouds' unit; by default 1.5 times the
            spacing of the sparser cloud.
        samples: Points to draw on a mesh with faces, from 1 to 10,000,000.
    """

    source: Positional[Path]
    target: Positional[Path]
    json: bool = False
    out: Path | None = None
    picture: Path | None = None
    search: Literal["auto", "always", "never"] = "auto"
    initial: Path | None = None
    no_refine: bool = False
    model: str = "modelnet40"
    inlier_distance: float | None = None
    samples: int = 20_000

    def run(self) -> int:
        """Registers, prints, and writes what was asked for."""
        from urrt_jax import Search, load_model, register
        from urrt_jax.cli.compiling import compile_for
        from urrt_jax.cli.printing import as_dict, as_table
        from urrt_jax.io import check_samples, read_cloud, read_transform, write_cloud
        from urrt_jax.refine import ICP
        from urrt_jax.viewer import plot_registration, region_colors

        check_samples(self.samples, name="--samples")
        for path in (self.out, self.picture):
            if path is not None and not path.parent.is_dir():
                raise ValueError(f"{path}: there is no folder {path.parent} to write to")
        initial = None if self.initial is None else read_transform(self.initial)
        source, target = (read_cloud(path, samples=self.samples) for path in (self.source, self.target))
        options: dict[str, Any] = {
            "model": load_model(self.model),
            "refine": None if self.no_refine else ICP(),
            "search": None if self.no_refine else {"auto": "auto", "always": Search(), "never": None}[self.search],
        }
        compile_for(max(len(source), len(target)), **options)
        result = register(source, target, **options, initial=initial, inlier_distance=self.inlier_distance)
        if self.out is not None:
            colors = region_colors(result.source_regions) if self.out.suffix.lower() == ".ply" else None
            write_cloud(self.out, result.apply(source), colors)
        if self.picture is not None:
            plot_registration(source, target, result, path=self.picture)

        if self.json:
            print(json_format.dumps(as_dict(result), allow_nan=False))
            return 0
        print(f"source       {self.source.name}, {len(source):,} points")
        print(f"target       {self.target.name}, {len(target):,} points\n")
        print(as_table(result))
        for path in (self.out, self.picture):
            if path is not None:
                print(f"wrote        {path}")
        return 0
