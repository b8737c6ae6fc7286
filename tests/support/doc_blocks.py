"""The Python blocks of README and docs, as programs: one for each page.

Comments in a page say what its blocks need:

    <!-- blocks: quick -->          they compile no engine, so they run in the default tier
    <!-- blocks: none -->           they are not run
    <!-- blocks: needs FILE -->     FILE is a recording, which may be absent
    <!-- block: skip -->            the next block is not run

Blocks of a page share their names and run in a folder of their own. Seeds and copies are few here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from paths import REPO

SEEDS = 2

_BLOCK = re.compile(r"(<!-- block: skip -->\n+)?^```python\n(.*?)^```", re.M | re.S)
_MANY = re.compile(r"\b(seeds|count|seconds)=(\d[\d_]*)")


@dataclass(frozen=True)
class Page:
    """A page with Python blocks."""

    path: Path
    blocks: tuple[tuple[int, str], ...]
    """Line and code of each."""
    mode: str
    """What the comment says: quick, none, needs FILE; or engine."""

    @property
    def name(self) -> str:
        """Path in the repository."""
        return self.path.relative_to(REPO).as_posix()


def pages() -> list[Page]:
    """All pages that have blocks to run."""
    found = []
    for path in [REPO / "README.md", *sorted((REPO / "docs").rglob("*.md"))]:
        text = path.read_text(encoding="utf-8")
        said = re.search(r"<!-- blocks: (.*?) -->", text)
        blocks = tuple(
            (text.count("\n", 0, one.start(2)), few(one[2])) for one in _BLOCK.finditer(text) if not one[1]
        )
        if blocks:
            found.append(Page(path, blocks, said[1] if said else "engine"))
    return found


def few(code: str) -> str:
    """The code with few seeds."""
    return _MANY.sub(lambda x: f"{x[1]}={min(int(x[2].replace('_', '')), SEEDS)}", code)
