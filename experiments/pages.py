"""Puts the tables that commands have written into the pages that show them: `python -m experiments.pages`.

A page marks the place of a table by its file in this folder. Each mark has a line of its own, and what stands between
the two is replaced:

    <!-- table: benchmarks/speed.md -->
    <!-- end -->
"""

import re
from pathlib import Path

HERE = Path(__file__).parent
PAGES = (HERE.parent / "README.md", HERE / "README.md", *sorted(HERE.glob("*/README.md")))
_MARKS = re.compile(r"^<!-- (?:table: \S+|end) -->$", re.MULTILINE)
_PLACE = re.compile(r"^(<!-- table: (\S+) -->\n)(?:(?!<!-- ).*\n)*(<!-- end -->)$", re.MULTILINE)


def refreshed(page: str) -> str:
    """The text of a page with the tables as they are written today.

    Raises:
      ValueError: a mark has no counterpart.
      OSError: a table cannot be read.
    """
    new, count = _PLACE.subn(lambda place: f"{place[1]}\n{(HERE / place[2]).read_text().strip()}\n\n{place[3]}", page)
    marks = _MARKS.findall(page)
    if len(marks) != 2 * count:
        raise ValueError(f"marks: each table needs a beginning and an end, got {', '.join(marks)}")
    return new


if __name__ == "__main__":
    for path in PAGES:
        before = path.read_text()
        if (after := refreshed(before)) != before:
            path.write_text(after)
            print(f"wrote {path.relative_to(HERE.parent)}")
