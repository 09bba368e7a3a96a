"""How a registration is printed: for people and for programs."""

import sys
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from urrt_jax.atomic import write_atomically
from urrt_jax.evaluation.metrics import rotation_degrees
from urrt_jax.result import UNKNOWN_DEVIATION, Registration, rotation_deviation


def as_dict(result: Registration) -> dict[str, Any]:
    """The result as lists and numbers for JSON, as `--json` prints it; None for a number that is not finite."""
    matrix = np.asarray(result.matrix, np.float64)
    return {
        "matrix": _as_json(matrix),
        "rotation": _as_json(matrix[:3, :3]),
        "translation": _as_json(matrix[:3, 3]),
        "fitness": _as_json(result.fitness),
        "rmse": _as_json(result.rmse),
        "overlap": _as_json(result.overlap),
        "confidence": _as_json(result.confidence),
        "converged": bool(result.converged),
        "reason": result.reason,
        "information": _as_json(result.information),
        "covariance": _as_json(result.covariance),
        "alternatives": [
            {"matrix": _as_json(matrix), "weight": weight} for matrix, weight in result.alternatives.likely()
        ],
    }


def _as_json(numbers: ArrayLike) -> Any:
    """The numbers as a float or nested lists of floats, with None for NaN and infinity, which JSON does not have."""
    numbers = np.asarray(numbers, np.float64)
    values = numbers.astype(object)
    values[~np.isfinite(numbers)] = None
    return values.tolist()


def as_table(result: Registration) -> str:
    """The result as lines of text, as `urrt register` prints it."""
    rotation, translation = np.asarray(result.rotation), np.asarray(result.translation)
    heading = f"R, turns by {float(rotation_degrees(rotation, np.eye(3))):.2f}°"
    lines = [f"{'':13}{heading:<36}t"]
    for row, shift in zip(rotation, translation, strict=True):
        lines.append(f"{'':11}" + "".join(f"{value:11.6f}" for value in row) + f"{shift:16.6f}")
    reach = f"{float(result.inlier_distance):.4g}"
    lines += [
        "",
        f"fitness      {float(result.fitness):<8.4f} share of the source within {reach} of the target",
        f"rmse         {float(result.rmse):<8.4g} of those points",
        "overlap      {:.0%} of the source, {:.0%} of the target".format(*np.asarray(result.overlap).tolist()),
        f"deviation    {_deviation(result):<8} of the rotation, as the residuals show it",
        f"confidence   {float(result.confidence):.3f}",
        "converged    yes" if result.converged else f"converged    NO       {result.reason}",
    ]
    return "\n".join(lines)


def _deviation(result: Registration) -> str:
    degrees = rotation_deviation(result.covariance)
    return f"{degrees:.2g}°" if degrees < UNKNOWN_DEVIATION else "unknown"


def write_picture(path: Path, source: np.ndarray, target: np.ndarray, result: Registration) -> None:
    """Writes the picture of before and after, whole or not at all; the extension chooses the format."""
    from urrt_jax.viewer import plot_registration

    content = BytesIO()
    plot_registration(source, target, result).savefig(content, format=path.suffix[1:].lower())
    write_atomically(path, content.getvalue())


def print_skipped(skipped: Sequence[tuple[str, str]]) -> None:
    """Names the files that could not be used, on stderr, and how many they are."""
    for name, reason in skipped:
        print(f"skipped {name}: {reason}", file=sys.stderr)
    if skipped:
        print(f"{len(skipped)} files skipped", file=sys.stderr)


def changed_flags(flags: Any, prefix: str = "") -> list[str]:
    """The flags of a command whose values are not the defaults, as they are typed, with names in the place of paths."""
    typed = []
    for field in fields(flags):
        value, name = getattr(flags, field.name), prefix + field.name.replace("_", "-")
        if is_dataclass(value):
            typed += changed_flags(value, f"{name}.")
        elif value is True:
            typed.append(f"--{name}")
        elif value != field.default:
            values = value if isinstance(value, tuple) else (value,)
            paths = name in ("out", "data", "model", "start")
            typed += [f"--{name}", *(Path(each).name if paths else without_folder(str(each)) for each in values)]
    return typed


def without_folder(method: str) -> str:
    """A method's name with no more than the name of the file of its own model, as in "network:model.npz"."""
    stages, colon, own = method.partition(":")
    return stages + colon + Path(own).name if own else method
