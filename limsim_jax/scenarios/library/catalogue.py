"""The catalogue of the library: entries with tags, parameters, licence and outcomes of reference drivers.

Scenarios of our own are pairs of files of OpenSCENARIO XML beside this module: `NAME.xosc` varies the
parameters of `scenarios/NAME.xosc`. Ranges and counts are read from them, all words from `catalogue.toml`,
figures from `outcomes.json`, which `experiments/library.py` writes.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from limsim_jax.maps.xml import file_hash
from limsim_jax.sweeps.experiment import bundled_experiments

if TYPE_CHECKING:
    from limsim_jax.scenarios.openscenario.scenario import OpenScenario

FOLDER = Path(__file__).resolve().parent
"""Of the files."""

OUTCOMES = FOLDER / "outcomes.json"
"""What reference drivers make of the scenarios."""

PREFIX = "library"
"""Folder that may stand before a name: `library/cut_in`."""

OWN_LICENCE = "Apache-2.0"
"""Of all that comes with the package."""

_CLOSE = 3  # names that a message offers
_LISTED = 3  # values that are written one by one even if their steps are equal


class LibraryError(ValueError):
    """No such entry or tag; one line with what is close."""


class Outcome(NamedTuple):
    """What a reference driver makes of a sample of the variants.

    Attributes:
      policy: name of the driver.
      variants: that were run, evenly spread.
      passed: of these, without a contact, on the road.
      collided: of these.
    """

    policy: str
    variants: int
    passed: int
    collided: int


class Parameter(NamedTuple):
    """A parameter that varies.

    Attributes:
      name: in the file and, after `parameter_`, in results.
      unit: SI or km/h; empty where there is none.
      meaning: in words.
      source: of its values.
      values: all of them, in the order of the file; numbers or texts.
    """

    name: str
    unit: str
    meaning: str
    source: str
    values: tuple[float | str, ...]

    @property
    def range(self) -> str:
        """The values in short: `10 to 60 by 10`, or all of them."""
        plain = [x if isinstance(x, str) else f"{x:g}" for x in self.values]
        numbers = [x for x in self.values if not isinstance(x, str)]
        if len(numbers) > _LISTED:
            steps = {round(b - a, 9) for a, b in pairwise(numbers)}
            if len(steps) == 1:
                return f"{plain[0]} to {plain[-1]} by {steps.pop():g}"
        return ", ".join(plain)


@dataclass(frozen=True)
class Entry:
    """An entry of the library.

    Attributes:
      name: by which commands know it.
      kind: "scenarios" of our own, a bundled "experiment", or a set of "others" that the user fetches.
      title: what happens, in a sentence.
      tags: of `tags()`.
      licence: SPDX identifier.
      command: that runs it.
      path: of the file; None: the user fetches it.
      address: from where.
      needs: what the command needs besides.
      outcomes: of reference drivers; none: not measured.
    """

    name: str
    kind: Literal["scenarios", "experiment", "others"]
    title: str
    tags: tuple[str, ...]
    licence: str
    command: str
    path: Path | None = None
    address: str = ""
    needs: str = ""
    outcomes: tuple[Outcome, ...] = ()
    _told: Mapping[str, tuple[str, str, str]] = field(default_factory=dict, repr=False)

    @cached_property
    def scenarios(self) -> OpenScenario | None:
        """The file with its variants; None: it is no scenario of our own."""
        from limsim_jax.scenarios.openscenario.scenario import openscenario

        return openscenario(self.path) if self.kind == "scenarios" and self.path is not None else None

    @property
    def variants(self) -> int | None:
        """How many; None: an experiment has seeds, and sets of others are not here."""
        return None if self.scenarios is None else len(self.scenarios)

    @property
    def map_file(self) -> Path | None:
        """The map of a scenario of our own."""
        if self.scenarios is None:
            return None
        first = self.scenarios.scenario()
        return first.path.parent / first.map_file

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """What varies, in the order of the file."""
        if self.scenarios is None:
            return ()
        found = []
        for name, values in self.scenarios.values().items():
            unit, meaning, source = self._told[name]
            some = dict.fromkeys(map(_as_number, values))
            found.append(Parameter(name, unit, meaning, source, tuple(some)))
        return tuple(found)

    def files(self) -> list[Path]:
        """Files on which the variants of a scenario of our own depend."""
        if self.path is None or self.map_file is None:
            return []
        return [
            self.path,
            FOLDER / "scenarios" / self.path.name,
            *sorted((FOLDER / "scenarios" / "catalogs").glob("*.xosc")),
            self.map_file,
        ]

    @property
    def hash(self) -> str:
        """Of these files: outcomes belong to it."""
        return file_hash(b"".join(path.read_bytes() for path in self.files()))

    def __str__(self) -> str:
        lines = [f"{self.name}: {self.title}", f"  tags {', '.join(self.tags)}; licence {self.licence}"]
        if self.scenarios is not None and self.map_file is not None:
            lines.append(f"  {self.variants} variants on map {self.map_file.stem}, of")
            wide = max(len(x.name) for x in self.parameters)
            for one in self.parameters:
                values = f"{one.range} {one.unit}".strip()
                lines.append(f"    {one.name:<{wide}}  {values}: {one.meaning} ({one.source})")
        for one in self.outcomes:
            lines.append(
                f"  {one.policy}: {one.passed} of {one.variants} variants passed, {one.collided} collided"
            )
        if self.address:
            lines.append(f"  fetch it from {self.address}")
        if self.needs:
            lines.append(f"  needs {self.needs}")
        return "\n".join([*lines, f"  {self.command}"])


class Entries(list[Entry]):
    """Entries; shown as a table."""

    def rows(self) -> list[tuple[str, ...]]:
        """Name, variants, passed by driver, title; as texts."""
        found = []
        for one in self:
            passed = {x.policy: f"{x.passed}/{x.variants}" for x in one.outcomes}
            count = "" if one.variants is None else str(one.variants)
            found.append((one.name, count, *(passed.get(x, "") for x in drivers()), one.title))
        return found

    def __repr__(self) -> str:
        rows = [("name", "variants", *drivers(), ""), *self.rows()]
        wide = [max(len(row[k]) for row in rows) for k in range(len(rows[0]) - 1)]
        return "\n".join(
            "  ".join([*(x.ljust(n) for x, n in zip(row, wide, strict=False)), row[-1]]).rstrip()
            for row in rows
        )


def library(*wanted: str, search: str = "") -> Entries:
    """What is in the scenario library.

        lj.library()                       # everything, as a table
        lj.library("motorway", "cut-in")   # with both tags
        lj.library(search="pedestrian")
        lj.openscenario("cut_in")          # the variants of an entry

    Args:
      wanted: tags, all of which an entry has.
      search: words that are all in its name, title or tags, in any case of letters.

    Raises:
      LibraryError: a tag that is not known; one line.
    """
    known = [tag for some in tags().values() for tag in some]
    for tag in wanted:
        if tag not in known:
            raise LibraryError(f"tag '{tag}': not known; {_offer(tag, known)}")
    words = search.lower().split()
    return Entries(
        one
        for one in _entries()
        if set(wanted) <= set(one.tags)
        and all(word in " ".join((one.name, one.title, *one.tags)).lower() for word in words)
    )


def tags() -> dict[str, tuple[str, ...]]:
    """All tags by what they tell: road, manoeuvre, actor, from."""
    return {kind: tuple(some) for kind, some in _catalogue()["tags"].items()}


def entry(name: str) -> Entry:
    """The entry of a name; `library/NAME` does as well.

    Raises:
      LibraryError: there is none; one line with those that are close.
    """
    bare = _bare(name)
    for one in _entries():
        if one.name == bare:
            return one
    raise LibraryError(f"{name}: not in the library; {_offer(bare, [x.name for x in _entries()])}")


def scenario_file(name: str | Path) -> Path | None:
    """The file of a scenario of our own, by its name; None: no such name, or a file of the user has it."""
    bare = _bare(str(name))
    found = FOLDER / f"{bare}.xosc"
    return found if not Path(name).is_file() and bare in _own() and found.is_file() else None


def close_to(name: str | Path) -> str | None:
    """What to say of a file that is not there; None: no scenario of our own has a name like it."""
    close = get_close_matches(_bare(str(name)), _own(), _CLOSE)
    return f"{name}: no such file; in the scenario library there is {', '.join(close)}" if close else None


def no_experiment(name: str | Path) -> str | None:
    """Why a name is no experiment: it is in the library, or close to a name there; None: it may be one."""
    if scenario_file(name) is not None:
        return (
            f"{name}: is a scenario of the library, and no experiment; lj.openscenario has its "
            f"variants, and they run by limsim-jax sweep {name}"
        )
    path = Path(name)
    return None if path.is_file() or path.stem in bundled_experiments() else close_to(name)


def drivers() -> tuple[str, ...]:
    """Policies of which outcomes are known."""
    return tuple(dict.fromkeys(x["policy"] for x in _outcomes()))


def _as_number(value: float | str) -> float | str:
    """A value of a file: those of sets are texts."""
    try:
        return float(value)
    except ValueError:
        return value


def _bare(name: str) -> str:
    path = PurePosixPath(name.replace("\\", "/"))
    if path.suffix not in ("", ".xosc") or path.parent.as_posix() not in (".", PREFIX):
        return name
    return path.stem


def _offer(name: str, known: Iterable[str]) -> str:
    known = list(known)
    close = get_close_matches(name, known, _CLOSE)
    return f"close are {', '.join(close)}" if close else f"known are {', '.join(known)}"


@cache
def _catalogue() -> dict[str, Any]:
    return tomllib.loads((FOLDER / "catalogue.toml").read_text(encoding="utf-8"))


@cache
def _own() -> tuple[str, ...]:
    return tuple(x["name"] for x in _catalogue()["scenario"])


@cache
def _outcomes() -> tuple[dict[str, Any], ...]:
    if not OUTCOMES.is_file():
        return ()
    return tuple(json.loads(OUTCOMES.read_text(encoding="utf-8"))["rows"])


@cache
def _entries() -> tuple[Entry, ...]:
    found, sources = _catalogue(), _catalogue()["sources"]
    entries = []
    for one in found["scenario"]:
        path = FOLDER / f"{one['name']}.xosc"
        told = {name: (unit, said, sources[x]) for name, (unit, said, x) in one["parameters"].items()}
        made = [
            Outcome(x["policy"], x["variants"], x["passed"], x["collided"])
            for x in _outcomes()
            if x["scenario"] == one["name"]
        ]
        entries.append(
            Entry(
                one["name"], "scenarios", _title(path), tuple(one["tags"]), OWN_LICENCE,
                f"limsim-jax sweep {one['name']} --policy pdm_closed --preventable",
                path, outcomes=tuple(made), _told=told,
            )
        )  # fmt: skip
    bundled = bundled_experiments()
    for one in found["experiment"]:
        path = bundled[one["name"]]
        title = tomllib.loads(path.read_text(encoding="utf-8"))["description"]
        entries.append(
            Entry(
                one["name"], "experiment", title, tuple(one["tags"]), OWN_LICENCE,
                f"limsim-jax sweep {one['name']} --policy pdm_closed"
                + (" --map FILE" if "needs" in one else ""),
                path, needs=one.get("needs", ""),
            )
        )  # fmt: skip
    for one in found["other"]:
        entries.append(
            Entry(
                one["name"], "others", one["title"], tuple(one["tags"]), one["licence"], one["command"],
                address=one["address"],
            )
        )  # fmt: skip
    return tuple(entries)


def _title(path: Path) -> str:
    """The description in the header of a file."""
    from limsim_jax.scenarios.openscenario.source import Source

    return Source(path).root().child("FileHeader").text("description")
