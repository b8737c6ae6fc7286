"""Files of OpenSCENARIO XML as values: `openscenario`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

from limsim_jax.scenarios.openscenario.catalogs import Catalogs
from limsim_jax.scenarios.openscenario.distributions import One, Variants, read_distributions
from limsim_jax.scenarios.openscenario.expressions import Value, written
from limsim_jax.scenarios.openscenario.parameters import broken, read_declarations, settle
from limsim_jax.scenarios.openscenario.reading import Reader
from limsim_jax.scenarios.openscenario.reading_story import StoryReader
from limsim_jax.scenarios.openscenario.source import Node, OpenScenarioError, Source
from limsim_jax.scenarios.openscenario.storyboard import (
    Condition,
    ElementState,
    Scenario,
    Storyboard,
    Trigger,
)

NEWEST = (1, 3)
"""The newest version that is known."""


class Template:
    """A scenario file before its parameters have values.

    Args:
      path: of the file.
      lenient: elements that are not supported are listed, not refused.
      root: folder in which catalogs may lie; None: that of the file.
      source: the file, where it is read already.
    """

    def __init__(
        self, path: Path, *, lenient: bool = False, root: Path | None = None, source: Source | None = None
    ) -> None:
        self.source = Source(path, lenient=lenient) if source is None else source
        top = self.source.root()
        self.version = _version(top)
        self.declarations = read_declarations(top)
        twice = [x for x in self.declarations if [y.name for y in self.declarations].count(x.name) > 1]
        if twice:
            raise twice[0].node.error(f"parameter '{twice[0].name}' is declared twice")
        self._catalogs = Catalogs(top, lenient=lenient, within=root)
        self._checked = False

    def scenario(self, given: Mapping[str, Value]) -> Scenario:
        """The scenario with these values of its parameters.

        Raises:
          OpenScenarioError: what does not fit, in one line.
        """
        values = settle(self.declarations, given)
        for one in self.declarations:
            fault = broken(one, values)
            if fault is not None:
                raise one.node.error(fault)
        root = self.source.root(values)
        for tag in ("CatalogLocations", "ParameterDeclarations"):
            root.children(tag)
        for one in root.children("MonitorDeclarations"):
            one.pass_over()
        variables = settle(read_declarations(root, "VariableDeclarations"), None, values)
        read = Reader(self._catalogs)
        map_file = _map_file(root)
        read.read_entities(root)
        story = StoryReader(read, {*values, *variables}).storyboard(root.child("Storyboard"))
        if not self._checked:
            self.source.check(root)
            self._checked = True
        _check_references(story, root)
        return Scenario(
            name=self.source.path.stem,
            path=self.source.path,
            version=self.version,
            parameters=values,
            variables=variables,
            map_file=map_file,
            entities=tuple(read.entities.values()),
            storyboard=story,
            notes=tuple(self.source.notes),
        )


def _version(root: Node) -> tuple[int, int]:
    header = root.child("FileHeader")
    for one in header.every():
        one.pass_over()
    version = header.integer("revMajor", least=0), header.integer("revMinor", least=0)
    if version[0] != 1:
        raise header.error(f"version {version[0]}.{version[1]}; 1.0 to 1.3 are known")
    if version > NEWEST:
        root.source.note(f"version {version[0]}.{version[1]} is read as {NEWEST[0]}.{NEWEST[1]}")
    return version


def _map_file(root: Node) -> str:
    block = root.optional("RoadNetwork")
    if block is None:
        return ""
    for one in block.children("SceneGraphFile", "UsedArea"):
        one.pass_over()
    for one in block.children("TrafficSignals"):
        if list(one.element):
            one.skip("ignored: the lights of the map run by their own programs")
    logic = block.optional("LogicFile")
    return "" if logic is None else logic.text("filepath")


def elements_of(story: Storyboard) -> Iterator[tuple[str, str]]:
    """Kinds and full names of all parts of a storyboard, `story::act::...`."""
    for a in story.stories:
        yield "story", a.name
        for b in a.acts:
            at_act = f"{a.name}::{b.name}"
            yield "act", at_act
            for c in b.groups:
                at_group = f"{at_act}::{c.name}"
                yield "maneuverGroup", at_group
                for d in c.maneuvers:
                    at_maneuver = f"{at_group}::{d.name}"
                    yield "maneuver", at_maneuver
                    for e in d.events:
                        at_event = f"{at_maneuver}::{e.name}"
                        yield "event", at_event
                        for f in e.actions:
                            yield "action", f"{at_event}::{f.name}"


def names_element(reference: str, full: str) -> bool:
    """Whether a reference means an element of this full name.

    It may have the names of some ancestors before its own.
    """
    return full == reference or full.endswith(f"::{reference}")


def conditions_of(story: Storyboard) -> Iterator[Condition]:
    """All conditions of a storyboard."""
    triggers: list[Trigger] = [story.stop]
    for a in story.stories:
        for b in a.acts:
            triggers += [b.start or (), b.stop]
            triggers += [
                event.start or ()
                for group in b.groups
                for maneuver in group.maneuvers
                for event in maneuver.events
            ]
    for trigger in triggers:
        for group in trigger:
            yield from group


def _check_references(story: Storyboard, root: Node) -> None:
    known = list(elements_of(story))
    for condition in conditions_of(story):
        test = condition.test
        if not isinstance(test, ElementState):
            continue
        if not any(kind == test.kind and names_element(test.element, full) for kind, full in known):
            raise root.error(f"condition '{condition.name}': there is no {test.kind} '{test.element}'")


class OpenScenario:
    """A scenario file and its variants.

    Attributes:
      path: of the file.
      name: of the file, without its ending.
      lenient, root: as it was read.
      template: the scenario before its parameters have values.
      variants: values of parameters, variant by variant.
    """

    def __init__(self, path: str | Path, *, lenient: bool = False, root: str | Path | None = None) -> None:
        self.path, self.lenient = Path(path), lenient
        self.root = None if root is None else Path(root)
        self.name = self.path.stem
        source = Source(self.path, lenient=lenient)
        top = source.root()
        tags = {str(x.tag) for x in top.element}
        if "Catalog" in tags:
            raise top.error("a catalog is no scenario; name the scenario that uses it")
        distribution = top.optional("ParameterValueDistribution")
        if distribution is None:
            self.template = Template(self.path, lenient=lenient, root=self.root, source=source)
            self.variants: Variants = One()
            self._notes: tuple[str, ...] = ()
            return
        _version(top)
        named = distribution.child("ScenarioFile").text("filepath")
        text = named.replace("\\", "/")
        if PurePosixPath(text).is_absolute() or ":" in text or "\0" in text:
            raise distribution.error(f"ScenarioFile '{named}' is absolute; a path from this file is expected")
        self.template = Template(self.path.parent / text, lenient=lenient, root=self.root)
        self.variants = read_distributions(distribution, self.template.declarations)
        source.check(top)
        self._notes = tuple(source.notes)

    def __len__(self) -> int:
        return len(self.variants)

    def scenario(self, k: int = 0) -> Scenario:
        """The `k`-th variant with all parameters resolved.

        Raises:
          OpenScenarioError: what does not fit, in one line.
        """
        if not 0 <= k < len(self):
            raise OpenScenarioError(f"{self.path}: no variant {k}; 0 to {len(self) - 1} are there")
        return self.template.scenario(self.variants[k])

    def values(self, which: Sequence[int] | None = None) -> dict[str, list[Value]]:
        """Values of the parameters that vary, as columns.

        A row is a variant: all of them, or some.
        """
        rows = [self.variants[k] for k in (range(len(self)) if which is None else which)]
        return {name: [row.get(name, "") for row in rows] for name in self.variants.names}

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out of the first variant, a line each."""
        return (*self._notes, *self.scenario().notes)

    def __repr__(self) -> str:
        first = self.scenario()
        entities = ", ".join(f"{x.name} ({x.category})" for x in first.entities)
        lines = [
            f"OpenSCENARIO {first.version[0]}.{first.version[1]} '{self.name}': {entities or 'no entities'}",
            f"  map {first.map_file or 'none'}, ego {first.ego or 'none'}",
        ]
        if self.variants.names:
            filtered = "" if self.variants.product == len(self) else f" of {self.variants.product}"
            lines.append(f"  {len(self)}{filtered} variants of {', '.join(self.variants.names)}")
        elif self.template.declarations:
            values = ", ".join(f"{name} = {written(x)}" for name, x in first.parameters.items())
            lines.append(f"  parameters {values}")
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


def openscenario(path: str | Path, *, lenient: bool = False, root: str | Path | None = None) -> OpenScenario:
    """Read a file of OpenSCENARIO XML 1.0 to 1.3.

    It is a scenario, or a distribution of the parameters of one. Scenarios of the library have names.

    Args:
      path: `.xosc` file. Catalogs lie in its folder or below. Where there is no such file: a name of the
        scenario library, as `cut_in`.
      lenient: elements that are not supported are listed in `notes`, not refused.
      root: folder in which catalogs may lie, where they are not below that of the file.

    Raises:
      OpenScenarioError: one line with file, line, element and reason.
    """
    found = OpenScenario(_file(Path(path)), lenient=lenient, root=root)
    found.scenario()
    return found


def _file(path: Path) -> Path:
    """The file, or that of the library."""
    from limsim_jax.scenarios.library.catalogue import close_to, scenario_file

    found = scenario_file(path)
    if found is None and not path.exists() and (message := close_to(path)):
        raise OpenScenarioError(message)
    return path if found is None else found
