"""The API reference, one page a module, made from the docstrings: ``python -m experiments.reference --out docs``.

Needs pdoc (extra ``dev``). The pages open from disk and are never committed.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy.typing as npt
import pdoc.render
import tyro
from jax.typing import ArrayLike
from pdoc.doc import formatannotation  # type: ignore[reportPrivateImportUsage]

from urrt_jax.clouds import CloudLike

# pdoc spells unions out. The longer one first: it contains the other.
_COMMA = r", (?![^\[]*\])"  # outside of brackets
_NAMES = {"CloudLike": CloudLike, "ArrayLike": ArrayLike, "npt.ArrayLike": npt.ArrayLike}


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Write the API reference as HTML pages.

    Attributes:
        out: Folder of the pages; open its index.html.
    """

    out: Path = Path("docs")

    def run(self) -> None:
        """Writes the pages."""
        pdoc.render.configure(docformat="google", math=True)
        plain = pdoc.render.env.filters["format_signature"]
        pdoc.render.env.filters["format_signature"] = lambda sig, colon: plain(shortened(sig), colon=colon)
        pdoc.pdoc("urrt_jax", output_directory=self.out)
        print(f"wrote {self.out / 'index.html'}")


def shortened(signature: inspect.Signature) -> inspect.Signature:
    """The signature as the sources spell it: names of types instead of long unions, ``ICP()`` for all its defaults."""
    parameters = [
        each.replace(annotation=_annotation(each.annotation), default=_default(each.default))
        for each in signature.parameters.values()
    ]
    return signature.replace(parameters=parameters, return_annotation=_annotation(signature.return_annotation))


class _Written:
    """What is printed as this text."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _annotation(annotation: Any) -> Any:
    if annotation is inspect.Parameter.empty:
        return annotation
    text = formatannotation(annotation)
    for name, union in _NAMES.items():
        text = text.replace(", ".join(map(formatannotation, get_args(union))), name)
    text = re.sub(r"Union\[((?:[^\[\]]|\[[^\[\]]*\])*)\]", lambda found: re.sub(_COMMA, " | ", found[1]), text)
    text = re.sub(r"\b(?:\w+\.)+(?=\w)", "", text)  # modules
    return _Written(text.replace("NoneType", "None"))


def _default(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type) and value == type(value)():
        return _Written(f"{type(value).__name__}()")
    return value


if __name__ == "__main__":
    tyro.cli(Reference).run()
