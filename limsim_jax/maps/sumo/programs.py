"""Signal programs of SUMO networks and additional files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from limsim_jax.maps.network import ImportReport, Movement, Phase, Program
from limsim_jax.maps.xml import Element, XmlReader, read_bytes

DEMAND_ROOTS = tuple("additional additionals add routes route-alternatives trips vtypes flows".split())
"""Root elements of additional and route files; SUMO itself does not look at them."""


class Programs:
    """The programs of all traffic lights, one of them in use."""

    def __init__(self, report: ImportReport) -> None:
        self.report = report
        self._known: dict[str, dict[str, tuple[XmlReader, Element, Program]]] = {}  # light -> program id

    def __contains__(self, light: str) -> bool:
        return light in self._known

    def read_additional(self, path: str | Path) -> None:
        """Take the signal programs of an additional file."""
        xml = XmlReader(path)
        for _, element in xml.children(read_bytes(path), *DEMAND_ROOTS):
            if element.tag == "tlLogic":
                self.add(xml, element)
            else:
                xml.ignore(element, "not part of the road network; `read_demand` reads demand")
        xml.ignored.summarise(self.report)

    def add(self, xml: XmlReader, element: Element) -> None:
        """Take a `<tlLogic>`."""
        light = xml.text(element, "id")
        name = xml.text(element, "programID", "")
        kind = xml.text(element, "type", "static")
        phases = tuple(self._phase(xml, child) for child in element if child.tag == "phase")
        xml.ignore_children(element, "phase")
        offset_text = xml.text(element, "offset", "0")
        offset = 0.0 if offset_text == "begin" else xml.parse_number(element, "offset", offset_text)
        xml.ignore_unasked(element)
        if not phases:
            if name in self._known.get(light, {}):
                xml.ignore(element, "parameters for a program that is defined elsewhere")
                return
            raise xml.error(element, "the program has no phases")
        if len({len(phase.state) for phase in phases}) > 1:
            raise xml.error(element, "the states of its phases have different lengths")
        if any(i >= len(phases) or i < 0 for phase in phases for i in phase.next):
            raise xml.error(element, "a phase has a 'next' beyond the last phase")
        where = f"{light} program {name}"
        if offset_text == "begin":
            self.report.approximated("tlLogic", where, "offset 'begin' taken as 0", element.sourceline)
        elif kind not in {"static", "actuated"}:
            message = f"type '{kind}' is kept by name; its rule and parameters are not read"
            self.report.approximated("tlLogic", where, message, element.sourceline)
        else:
            self.report.read("tlLogic")
        known = self._known.setdefault(light, {})
        if name in known:
            self.report.repaired("tlLogic", where, "defined twice; the later one is kept", element.sourceline)
            del known[name]
        program = Program(id=light, name=name, type=kind, offset=offset, phases=phases)
        known[name] = (xml, element, program)

    def _phase(self, xml: XmlReader, element: Element) -> Phase:
        state = xml.text(element, "state")
        if not state or set(state) - set("ryYGguosO"):
            raise xml.error(element, f"state='{state[:40]}' has letters other than r y Y G g u s o O")
        state = state.replace("Y", "y")  # yellow of a stream with priority means the same

        def bound(name: str) -> float | None:  # SUMO writes -1 for 'none'
            value = xml.number(element, name, None)
            return value if value is not None and value >= 0 else None

        try:
            following = tuple(int(i) for i in xml.text(element, "next", "").split())
        except ValueError:
            raise xml.error(element, f"next='{element.get('next')[:40]}' is no list of phases") from None
        phase = Phase(
            duration=xml.number(element, "duration", minimum=0.0),
            state=state,
            min_duration=bound("minDur"),
            max_duration=bound("maxDur"),
            next=following,
            name=xml.text(element, "name", ""),
        )
        xml.ignore_unasked(element)
        self.report.read("phase")
        return phase

    def assign(self, movements: tuple[Movement, ...]) -> dict[str, Program]:
        """All programs with the movements that their letters control.

        Raises `MapError` for a state with fewer letters than the light has links.
        """
        links: dict[str, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
        for movement in movements:
            if movement.program is not None and movement.link is not None:
                links[movement.program][movement.link].append(movement.index)
        result = {}
        for light, known in self._known.items():
            in_use = next(reversed(known))
            for name, (xml, element, program) in known.items():
                size = len(program.phases[0].state)
                if links[light] and max(links[light]) >= size:
                    message = f"its states have {size} letters, but it controls link {max(links[light])}"
                    raise xml.error(element, message)
                controlled = tuple(tuple(links[light][i]) for i in range(size))
                key = light if name == in_use else f"{light}:{name}"
                result[key] = replace(program, id=key, movements=controlled)
            if len(known) > 1:
                others = short_list(f"'{name}'" for name in known if name != in_use)
                message = f"program '{in_use}', loaded last, is in use; kept beside it: {others}"
                self.report.approximated("tlLogic", light, message, known[in_use][1].sourceline)
        return result


def short_list(names: Iterable[str]) -> str:
    """Up to five names in one line."""
    names = list(names)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
