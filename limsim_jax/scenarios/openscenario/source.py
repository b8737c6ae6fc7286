"""Files of OpenSCENARIO XML: bounded parsing, attributes with parameters, and what no reader has asked for.

Files may come from any source. The parser resolves no entities and opens no network; size and depth are
bounded. An element that no reader asks for is refused by its name, or listed (`lenient`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from limsim_jax.maps.network import MapError
from limsim_jax.maps.xml import XmlReader, read_bytes
from limsim_jax.scenarios.openscenario.expressions import ExpressionError, Value, resolve, written

MAX_BYTES = 50_000_000
"""Bytes of a file, at most."""

MAX_DEPTH = 100
"""Levels of elements, at most."""

_REQUIRED: Any = object()
_LONGEST = 300

_NO_MATTER = frozenset(
    "author date description revMajor revMinor model model3d mass role name resource spdxId z p r type "
    "graphics sensors controllerType maxAccelerationRate maxDecelerationRate positionZ trackWidth "
    "wheelDiameter maxSteering height routeStrategy closed atmosphericPressure temperature".split()
)
"""Attributes that change nothing here: names of models, heights, masses."""


class OpenScenarioError(ValueError):
    """A scenario that cannot be used, in one line: file, line, element, reason."""


def one_line(text: str) -> str:
    """The text in one line of bounded length."""
    text = " ".join(str(text).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 3 :]}"


class Source:
    """A file, and what has been read of it.

    Attributes:
      path: of the file.
      lenient: what is not supported is listed in `notes`, not refused.
      notes: what was left out, a line each.
    """

    def __init__(self, path: Path, *, lenient: bool = False, data: bytes | None = None) -> None:
        self.path, self.lenient = path, lenient
        self.notes: dict[str, None] = {}
        self._reader = XmlReader(path)
        self._seen: set[Any] = set()
        self._asked: dict[Any, set[str]] = {}
        try:
            data = read_bytes(path) if data is None else data
            if len(data) > MAX_BYTES:
                raise MapError(f"larger than {MAX_BYTES // 10**6} MB", file=path)
            self._root = self._reader.parse(data, "OpenSCENARIO")
        except MapError as error:
            reason = str(error).replace("a folder, not a map file", "a folder, not a scenario file")
            raise OpenScenarioError(one_line(reason)) from None
        self._check_depth()

    def _check_depth(self) -> None:
        level = [self._root]
        for _ in range(MAX_DEPTH):
            level = [child for element in level for child in element]
            if not level:
                return
        raise OpenScenarioError(f"{self.path}: elements nested more than {MAX_DEPTH} levels deep")

    def root(self, scope: Mapping[str, Value] | None = None) -> Node:
        """The element `OpenSCENARIO`."""
        return self.node(self._root, scope or {})

    def node(self, element: Any, scope: Mapping[str, Value]) -> Node:
        """An element as read; from now on it counts as asked for."""
        self._seen.add(element)
        return Node(self, element, scope)

    def asked(self, element: Any, name: str) -> None:
        """An attribute that was asked for."""
        self._asked.setdefault(element, set()).add(name)

    def note(self, text: str) -> None:
        """List what was left out."""
        self.notes[one_line(text)] = None

    def refuse(self, node: Node, reason: str) -> None:
        """Refuse an element, or list it if the reader is lenient.

        Raises:
          OpenScenarioError: not lenient.
        """
        if not self.lenient:
            raise node.error(reason)
        node.skip(reason)

    def check(self, node: Node) -> None:
        """Refuse elements below `node` that no reader has asked for; list attributes that none has read."""
        from limsim_jax.scenarios.openscenario.coverage import why_not

        stack = [node.element]
        while stack:
            element = stack.pop()
            if element not in self._seen:
                child = Node(self, element, {})
                parent = element.getparent()
                said = why_not(element.tag)
                self.refuse(child, said if said.startswith("not") else f"{said} (within <{parent.tag}>)")
                continue
            asked = self._asked.get(element, set())
            for name in element.attrib:
                if name not in asked and name not in _NO_MATTER and not name.startswith("{"):
                    self.note(f"<{element.tag}>: attribute '{name}' is not read")
            stack.extend(reversed(list(element)))


class Node:
    """An element of a file with the parameters that hold there. Attributes are asked for by type."""

    __slots__ = ("element", "scope", "source")

    def __init__(self, source: Source, element: Any, scope: Mapping[str, Value]) -> None:
        self.source, self.element, self.scope = source, element, scope

    @property
    def tag(self) -> str:
        """Name of the element."""
        return str(self.element.tag)

    def error(self, reason: str) -> OpenScenarioError:
        """An error of one line that names the place."""
        line = self.element.sourceline
        name = self.element.get("name")
        what = f"<{self.tag} {name}>" if name else f"<{self.tag}>"
        place = f"{self.source.path}:{line}" if line else str(self.source.path)
        return OpenScenarioError(one_line(f"{place}: {what}: {reason}"))

    def scoped(self, values: Mapping[str, Value]) -> Node:
        """The same element with more parameters."""
        return Node(self.source, self.element, {**self.scope, **values})

    def skip(self, reason: str) -> None:
        """Leave out this element, and list it."""
        self.source.note(f"<{self.tag}>: {reason}")
        self.pass_over()

    def pass_over(self) -> None:
        """Leave out this element, which changes nothing; no line is written."""
        for element in self.element.iter():
            self.source._seen.add(element)
            self.source._asked.setdefault(element, set()).update(element.attrib)

    # --- elements

    def children(self, *names: str) -> list[Node]:
        """Children with one of these names, in the order of the file."""
        return [self.source.node(x, self.scope) for x in self.element if x.tag in names]

    def every(self) -> list[Node]:
        """All children."""
        return [self.source.node(x, self.scope) for x in self.element]

    def optional(self, name: str) -> Node | None:
        """The child of this name, or None."""
        found = self.children(name)
        if len(found) > 1:
            raise self.error(f"{len(found)} <{name}>; one is expected")
        return found[0] if found else None

    def child(self, name: str) -> Node:
        """The child of this name."""
        found = self.optional(name)
        if found is None:
            raise self.error(f"<{name}> is missing")
        return found

    def only(self, names: Iterable[str], beside: Iterable[str] = ()) -> Node | None:
        """The child that is a choice of several.

        Args:
          names: of the choice.
          beside: names of other children, which do not count.

        Returns:
          None where it is one that is not supported and the reader is lenient.
        """
        from limsim_jax.scenarios.openscenario.coverage import why_not

        names = tuple(names)
        others = [x for x in self.element if x.tag not in (*names, *beside)]
        found = self.children(*names)
        if len(found) + len(others) > 1:
            raise self.error(f"one of {', '.join(names)} is expected, not {len(found) + len(others)}")
        if others:
            self.source.refuse(Node(self.source, others[0], self.scope), why_not(str(others[0].tag)))
            return None
        if not found:
            raise self.error(f"one of {', '.join(names)} is missing")
        return found[0]

    # --- attributes

    def has(self, name: str) -> bool:
        """Whether the attribute is there and not empty."""
        return bool((self.element.get(name) or "").strip())

    def value(self, name: str, default: Any = _REQUIRED) -> Any:
        """An attribute after parameters and expressions: a number, a flag or a text."""
        self.source.asked(self.element, name)
        raw = self.element.get(name)
        if raw is None or (default is not _REQUIRED and not raw.strip()):
            if default is _REQUIRED:
                raise self.error(f"attribute '{name}' is missing")
            return default
        try:
            return resolve(raw, self.scope)
        except ExpressionError as error:
            raise self.error(f"attribute '{name}': {error}") from None

    def raw(self, name: str) -> str:
        """An attribute as it is written."""
        self.source.asked(self.element, name)
        return self.element.get(name, "").strip()

    def label(self, name: str = "name") -> str:
        """A name, which need not be there.

        It may begin like an expression and be none.
        """
        raw = self.raw(name)
        try:
            return written(resolve(raw, self.scope)).strip()
        except ExpressionError:
            return raw

    def text(self, name: str, default: Any = _REQUIRED) -> Any:
        """A text."""
        value = self.value(name, default)
        return value if value is None else written(value).strip()

    def number(
        self,
        name: str,
        default: Any = _REQUIRED,
        *,
        least: float = -math.inf,
        above: float = -math.inf,
        infinite: bool = False,
    ) -> Any:
        """A finite number, at least `least` and above `above`; `infinite`: INF may stand there, too."""
        value = self.value(name, default)
        if value is default and default is not _REQUIRED:
            return default
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except ValueError:
            number = math.nan
        if (math.isinf(number) and not infinite) or math.isnan(number) or 1e12 < abs(number) < math.inf:
            raise self.error(f"attribute '{name}' is '{one_line(str(value))}', not a finite number")
        if number < least or number <= above:
            bound = f"at least {least:g}" if number < least else f"above {above:g}"
            raise self.error(f"attribute '{name}' is {number:g}; {bound} is expected")
        return number

    def integer(self, name: str, default: Any = _REQUIRED, *, least: float = -math.inf) -> Any:
        """A whole number."""
        number = self.number(name, default, least=least)
        if number is default and default is not _REQUIRED:
            return default
        if number != int(number):
            raise self.error(f"attribute '{name}' is {number:g}, not a whole number")
        return int(number)

    def flag(self, name: str, default: Any = _REQUIRED) -> Any:
        """True or false."""
        value = self.value(name, default)
        if isinstance(value, bool) or value is None:
            return value
        text = written(value).lower()
        if text not in ("true", "false", "1", "0"):
            raise self.error(f"attribute '{name}' is '{value}', neither true nor false")
        return text in ("true", "1")

    def choice(self, name: str, choices: Iterable[str], default: Any = _REQUIRED) -> str:
        """One of several words."""
        value, choices = self.text(name, default), tuple(choices)
        if value not in choices and value is not default:
            raise self.error(f"attribute '{name}' is '{value}', none of {', '.join(choices)}")
        return value
