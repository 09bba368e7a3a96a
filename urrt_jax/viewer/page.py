"""The page: one HTML file that shows both clouds in 3D and moves the source from its first to its registered pose.

Its HTML, CSS and JavaScript are the files in ``web/``, which this module joins to one that needs no network.
"""

import base64
import html
import json
import os
import re
from dataclasses import dataclass, field
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from urrt_jax.atomic import write_atomically
from urrt_jax.clouds import CloudLike, as_array
from urrt_jax.result import UNKNOWN_DEVIATION, Registration, rotation_deviation
from urrt_jax.viewer.colors import DISTANCES, REGIONS, SOURCE, TARGET
from urrt_jax.viewer.scene import DrawnCloud, Scene

_POINTS = 200_000  # of each cloud; these make a file of 8 MB, and weak graphics cards still turn them without a stutter
_HEIGHT = 600  # pixels, of the page within a notebook
_SCRIPTS = ("read.js", "numbers.js", "view.js", "panel.js", "main.js")


@dataclass(frozen=True)
class Page:
    """A page about one registration; as the last line of a notebook's cell it is shown.

    Attributes:
      html: the whole page, which needs no network.
    """

    html: str = field(repr=False)

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {_HEIGHT}px; border: 1px solid #8884; border-radius: 6px"
        return f'<iframe title="Registration" style="{style}" srcdoc="{html.escape(self.html)}"></iframe>'


def save_page(
    path: str | os.PathLike[str],
    source: CloudLike,
    target: CloudLike,
    result: Registration,
    *,
    title: str | None = None,
) -> None:
    """Writes an interactive page about a registration: one HTML file that opens from disk, without a network.

    It shows both clouds, moves the source along the rigid motion, colours it by region or by its distance to the
    target, and lists the diagnostics, the matrix and the other poses that fit.

    Args:
      path: of the file, which is written whole or not at all.
      source: (N, 3), without padding; at most 200,000 points of each cloud are shown, always the same ones.
      target: (M, 3).
      result: what ``register(source, target)`` returned.
      title: over the diagnostics, "Registration" by default.

    Raises:
      ValueError: a batch, or clouds of other sizes than the ones registered.
      OSError: the file can't be written.
    """
    write_atomically(path, _page(source, target, result, title))


def show_registration(source: CloudLike, target: CloudLike, result: Registration) -> Page:
    """The page that ``save_page`` writes, to be shown in a notebook: the last line of a cell shows it.

    Arguments and errors are those of ``save_page``.
    """
    return Page(_page(source, target, result, None))


def _page(source: CloudLike, target: CloudLike, result: Registration, title: str | None) -> str:
    title = "Registration" if title is None else title
    content = json.dumps(_content(source, target, result, title), allow_nan=False)
    parts = {
        "title": html.escape(title),
        "style": _file("page.css"),
        "content": content.replace("<", "\\u003c"),  # so that no text in it ends the element it stands in
        "three": _file("three.min.js"),
        "script": "\n".join(_file(name) for name in _SCRIPTS),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _file("page.html"))


def _file(name: str) -> str:
    return (resources.files("urrt_jax.viewer") / "web" / name).read_text(encoding="utf-8")


def _content(source: CloudLike, target: CloudLike, result: Registration, title: str) -> dict[str, Any]:
    """All that the page shows, for JSON: arrays are base64 of little-endian numbers, and what is not finite is None."""
    scene = Scene.of(source, target, result, points=_POINTS)
    deviation = rotation_deviation(result.covariance)
    inlier_distance = _number(result.inlier_distance)
    return {
        "title": title,
        "source": _as_content(scene.source),
        "target": _as_content(scene.target),
        "start": scene.start.tolist(),
        "closer": scene.closer,
        "poses": _poses(scene, np.asarray(as_array(target, "target"), np.float64), result, inlier_distance),
        "diagnostics": {
            "converged": bool(result.converged),
            "reason": result.reason,
            "fitness": _number(result.fitness),
            "rmse": _number(result.rmse),
            "inlier_distance": inlier_distance,
            "overlap": [_number(share) for share in np.asarray(result.overlap)],
            "confidence": _number(result.confidence),
            "deviation": deviation if deviation < UNKNOWN_DEVIATION else None,  # or NaN
        },
        "colors": {
            "source": SOURCE,
            "target": TARGET,
            "regions": REGIONS.tolist(),
            "distances": DISTANCES,
        },
    }


def _as_content(cloud: DrawnCloud) -> dict[str, Any]:
    return {
        "count": cloud.count,
        "shown": len(cloud.points),
        "points": _base64(cloud.points, "<f4"),
        "labels": _base64(cloud.labels % len(REGIONS), "u1"),
    }


def _poses(
    scene: Scene, target: np.ndarray, result: Registration, inlier_distance: float | None
) -> list[dict[str, Any]]:
    """The result's pose and then the others that fit; without an end where the pose is not finite.

    ``distances`` holds every shown source point's distance to the nearest of all target points, in steps of 1/255 of
    the pose's ``largest``; greater ones are cut there.
    """
    target = target[np.isfinite(target).all(axis=1)] - scene.target.centre
    tree = KDTree(target) if len(target) else None
    others = result.alternatives.likely()
    own = np.asarray(result.matrix, np.float64)
    poses = []
    for matrix, weight in [(own, 1 - sum(weight for _, weight in others)), *others]:
        pose = {"weight": weight, "matrix": [_number(value) for value in matrix.ravel()]}
        if np.isfinite(matrix).all():
            rotation, end = matrix[:3, :3], scene.end(matrix[:3, :3], matrix[:3, 3])
            pose["end"] = end.tolist()
            pose["angle"] = _degrees(rotation)
            pose["turned"] = _degrees(rotation @ own[:3, :3].T) if np.isfinite(own).all() else None
            if tree is not None and scene.source.count:
                distances, _ = tree.query(scene.source.points @ rotation.T + end)
                largest = 2 * inlier_distance if inlier_distance else float(distances.max(initial=0.0))
                steps = np.round(255 * np.minimum(distances / (largest or 1.0), 1.0))
                pose |= {"largest": largest, "distances": _base64(steps, "u1")}
        poses.append(pose)
    return poses


def _degrees(rotation: np.ndarray) -> float:
    return float(np.rad2deg(Rotation.from_matrix(rotation).magnitude()))


def _number(value: Any) -> float | None:
    """The number for JSON, which has no NaN and no infinity."""
    return float(value) if np.isfinite(value) else None


def _base64(array: np.ndarray, dtype: DTypeLike) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype).tobytes()).decode()
