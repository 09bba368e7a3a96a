"""Points in text: one a line, its columns between commas, semicolons, tabs or spaces."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, NamedTuple, TextIO

import numpy as np

from urrt_jax.io.cloud import PointCloud, as_colors, as_normals
from urrt_jax.io.files import BadFile

_MAX_LINE = 65_536  # characters of a header or of the first point; no table is so wide

_POINTS = (("x", "y", "z"),)
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
_COLORS = (("r", "g", "b"), ("red", "green", "blue"))
_COMMENT = ("#", "//")


class _Layout(NamedTuple):
    """What stands above the numbers, and how they are arranged."""

    first: int
    """The number of the first line that holds a point; lines count from 1."""
    delimiter: str | None
    columns: int
    plain: bool
    """Whether all columns of the first point are numbers."""
    points: tuple[int, ...]
    normals: tuple[int, ...] | None
    colors: tuple[int, ...] | None
    declared: tuple[int, int] | None
    """A number of points that stands alone on a line, and the number of that line."""


def read_text(file: BinaryIO) -> PointCloud:
    """The columns that a header names x, y and z (and nx, ny, nz; r, g, b), or the first three where there is none."""
    return _read(file, {})


def read_pts(file: BinaryIO) -> PointCloud:
    """As `read_text`; without a header, 6 or 7 columns end with red, green and blue."""
    return _read(file, {6: (3, 4, 5), 7: (4, 5, 6)})


def write_xyz(cloud: PointCloud) -> bytes:
    """The bytes of a text with three numbers a line."""
    return _write(cloud, " ", "")


def write_txt(cloud: PointCloud) -> bytes:
    """The bytes of a text with spaces between its columns, which a comment names."""
    return _write(cloud, " ", "# ")


def write_csv(cloud: PointCloud) -> bytes:
    """The bytes of a text with commas between its columns, which its first line names."""
    return _write(cloud, ",", "", named=True)


def _write(cloud: PointCloud, delimiter: str, comment: str, *, named: bool | None = None) -> bytes:
    columns, names, formats = [cloud.points], [*_POINTS[0]], ["%.17g"] * 3
    if cloud.normals is not None:
        columns.append(cloud.normals)
        names += _NORMALS[0]
        formats += ["%.17g"] * 3
    if cloud.colors is not None:
        columns.append(cloud.colors)
        names += _COLORS[0]
        formats += ["%d"] * 3
    header = delimiter.join(names) if named or comment else ""
    buffer = io.BytesIO()
    table = np.concatenate([column.astype(np.float64) for column in columns], axis=1)
    np.savetxt(buffer, table, formats, delimiter, header=header, comments=comment)
    return buffer.getvalue()


def _read(file: BinaryIO, unnamed_colors: dict[int, tuple[int, ...]]) -> PointCloud:
    with _lines(file) as lines:
        layout = _layout(lines, unnamed_colors)
    if layout is None:
        return PointCloud(np.empty((0, 3)))
    used = [*layout.points, *(layout.normals or ()), *(layout.colors or ())]
    with _lines(file) as lines:
        try:
            table = np.loadtxt(
                itertools.islice(lines, layout.first - 1, None),
                delimiter=layout.delimiter,
                # Without a choice of columns NumPy makes sure that all lines have equally many.
                usecols=None if layout.plain else used,
                ndmin=2,
            )
        except ValueError as error:
            raise BadFile(_fault(file, layout, used)) from error
    if layout.plain:
        table = table[:, used]
    if layout.declared is not None and layout.declared[0] != len(table):
        promised, line = layout.declared
        raise BadFile(f"line {line} promises {promised:,} points, the file holds {len(table):,}")
    points = np.ascontiguousarray(table[:, :3])
    normals = table[:, 3:6] if layout.normals else None
    colors = table[:, -3:] if layout.colors else None
    return PointCloud(points, as_normals(normals, len(points)), as_colors(colors, len(points)))


@contextmanager
def _lines(file: BinaryIO) -> Iterator[TextIO]:
    """The file's lines from its beginning on, in the alphabet that its byte-order mark tells, else in UTF-8."""
    file.seek(0)
    utf16 = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    file.seek(0)
    # What UTF-8 cannot decode may stand in a comment; among numbers it is found to be no number.
    text = io.TextIOWrapper(file, "utf-16" if utf16 else "utf-8-sig", errors="replace")
    try:
        yield text
    finally:
        text.detach()  # else it would close the file


def _layout(lines: TextIO, unnamed_colors: dict[int, tuple[int, ...]]) -> _Layout | None:
    """What stands above the first point; None where there is no point."""
    names, named_at, commented, declared = None, 0, None, None
    for number in itertools.count(1):
        line = lines.readline(_MAX_LINE)
        if not line:
            break
        if len(line) == _MAX_LINE:
            raise BadFile(f"line {number}: longer than {_MAX_LINE:,} characters")
        if line.lstrip().startswith(_COMMENT):
            commented = _names(line.lstrip().lstrip("#/"))
            continue
        line = line.split("#")[0]
        if not line.strip():
            continue
        words = _split(line)
        numeric = [_is_number(word) for word in words]
        if names is None and declared is None and len(words) == 1 and words[0].isdecimal():
            declared = int(words[0]), number
        elif names is None and not all(numeric):
            names, named_at = _names(line), number
            if not {"x", "y", "z"} <= set(names):
                raise BadFile(
                    f"line {number}: expected numbers, or a header with the names x, y and z, got {line.strip()[:60]!r}"
                )
        else:
            if names is None and commented and len(commented) == len(words) and {"x", "y", "z"} <= set(commented):
                names = commented
            if names is None and len(words) < 3:
                raise BadFile(f"line {number}: a point needs 3 numbers, got {line.strip()[:60]!r}")
            if names is not None and len(words) != len(names):
                raise BadFile(f"line {number}: {len(words)} columns, but the header names {len(names)}")
            found = _columns(names, named_at) if names else ((0, 1, 2), None, unnamed_colors.get(len(words)))
            return _Layout(number, _delimiter(line), len(words), all(numeric), *found, declared)
    if declared is not None and declared[0]:
        raise BadFile(f"line {declared[1]} promises {declared[0]:,} points, the file holds none")
    return None


def _columns(names: list[str], line: int) -> tuple[tuple[int, ...], tuple[int, ...] | None, tuple[int, ...] | None]:
    """Where points, normals and colours stand in a header."""
    found = []
    for kinds in (_POINTS, _NORMALS, _COLORS):
        choice = next((kind for kind in kinds if set(kind) <= set(names)), None)
        twice = [name for name in choice or () if names.count(name) > 1]
        if twice:
            raise BadFile(f"line {line}: the header names {twice[0]!r} twice")
        found.append(None if choice is None else tuple(names.index(name) for name in choice))
    return found[0], found[1], found[2]


def _delimiter(line: str) -> str | None:
    return next((delimiter for delimiter in (";", ",") if delimiter in line), None)


def _split(line: str) -> list[str]:
    return [word.strip() for word in line.strip().split(_delimiter(line))]


def _names(line: str) -> list[str]:
    """The names in a header, small, without quotes and units: `"X [m]"` is `x`."""
    words = (word.strip("\"' ").lower() for word in _split(line))
    return [re.sub(r"\s*[\[(].*", "", word) for word in words]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word  # Python allows it, NumPy does not


def _fault(file: BinaryIO, layout: _Layout, used: list[int]) -> str:
    """What is wrong with the first line that NumPy could not read."""
    with _lines(file) as lines:
        for number, line in enumerate(lines, 1):
            text = line.split("#")[0].strip()
            if number < layout.first or not text:
                continue
            if layout.delimiter == ";" and "," in text:
                return f"line {number}: decimal commas are not read; write decimal points: {text[:60]!r}"
            words = [word.strip() for word in text.split(layout.delimiter)]
            if len(words) != layout.columns:
                return f"line {number}: {len(words)} columns, but line {layout.first} has {layout.columns}"
            wrong = [words[i] for i in (range(layout.columns) if layout.plain else used) if not _is_number(words[i])]
            if wrong:
                return f"line {number}: expected a number, got {wrong[0][:40]!r}"
    return "its lines are not all numbers"
