"""``urrt demo``: a made-up shape in a random pose, registered, with the truth beside the answer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Register a made-up shape to its copy in a random pose, and show how far from the truth the answer is.

    The two clouds share no point, both are noisy, and a part of the source is cut off. Nothing is downloaded. The
    picture needs Matplotlib (pip install 'urrt-jax[viz]'); without it the result is printed all the same.

    Another trial, with half of the source cut off: urrt demo --seed 3 --keep 0.5 --out trial.png

    Exit codes: 0, whether or not the trial converged. 2, wrong use, or the picture could not be written.

    Attributes:
        out: Where to write the picture of before and after.
        view: Write a page here (.html) that shows both clouds in a browser.
        seed: Of the pose, the noise and the cut: another number, another trial.
        noise: Standard deviation of the noise on every coordinate; the shape has radius 1.
        keep: Share of the source that is left, in (0, 1].
        model: Name of a packaged model, or a file written by 'urrt train'.
    """

    out: Path = Path("demo.png")
    view: Path | None = None
    seed: int = 0
    noise: float = 0.01
    keep: float = 0.8
    model: str = "modelnet40"

    def run(self) -> int:
        """Registers, prints the errors, and writes the picture if Matplotlib is there."""
        import numpy as np

        from urrt_jax import ICP, load_model, register
        from urrt_jax.cli.compiling import compile_for
        from urrt_jax.cli.outputs import check_outputs, check_page, check_picture, has_matplotlib
        from urrt_jax.cli.printing import as_table, write_picture
        from urrt_jax.cli.streams import note, show
        from urrt_jax.evaluation.metrics import rotation_degrees
        from urrt_jax.viewer import save_page

        check_outputs({"--view": self.view})
        check_page(self.view, "--view")
        if drawn := has_matplotlib():
            check_outputs({"--out": self.out})
            check_picture(self.out, "--out")
        source, target, rotation, translation = demo_pair(self.seed, noise=self.noise, keep=self.keep)
        options: dict[str, Any] = {"model": load_model(self.model), "refine": ICP(), "search": "auto"}
        compile_for(max(len(source), len(target)), **options)
        result = register(source, target, **options)
        turned = float(rotation_degrees(rotation, np.eye(3)))
        error = float(rotation_degrees(result.rotation, rotation))
        offset = np.linalg.norm(np.asarray(result.translation) - translation)
        show(f"source       {len(source):,} points, {self.keep:.0%} of the shape, noise {self.noise:g}")
        show(f"target       {len(target):,} points, turned by {turned:.2f}° and moved\n")
        show(as_table(result))
        show(f"error        {error:.3f}° and {offset:.4f}, against the truth")
        if drawn:
            write_picture(self.out, source, target, result)
            note(f"wrote {self.out}")
        else:
            note("no picture was drawn: pictures need Matplotlib: pip install 'urrt-jax[viz]'")
        if self.view is not None:
            save_page(self.view, source, target, result, title="urrt demo")
            note(f"wrote {self.view}")
        return 0


def demo_pair(seed: int, *, noise: float, keep: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Source (N, 3), target (M, 3) and the true rotation (3, 3) and translation (3,) between them.

    Each angle is uniform in ±45°, each component of the translation in ±0.5. A plane cuts the source.

    Raises:
        ValueError: ``keep`` outside (0, 1], or a negative ``noise`` or ``seed``.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from urrt_jax.data import demo_shape

    if not 0 < keep <= 1:
        raise ValueError(f"keep: expected a share in (0, 1], got {keep}")
    if not 0 <= noise < np.inf or seed < 0:
        raise ValueError(f"noise and seed: expected finite numbers of at least 0, got {noise} and {seed}")
    random = np.random.default_rng(seed)
    rotation = Rotation.from_euler("zyx", random.uniform(-45, 45, size=3), degrees=True).as_matrix()
    translation = random.uniform(-0.5, 0.5, size=3)
    shape = demo_shape(4096).astype(np.float64)
    source, target = shape[::2], shape[1::2] @ rotation.T + translation
    height = source @ random.normal(size=3)
    source = source[height <= np.quantile(height, keep)]
    source, target = (cloud + random.normal(scale=noise, size=cloud.shape) for cloud in (source, target))
    return source, target, rotation, translation
