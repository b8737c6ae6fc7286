"""SUMO configurations (`.sumocfg`): files and times of a simulation."""

from __future__ import annotations

import re
from pathlib import Path

from limsim_jax.maps.network import ImportReport, MapError
from limsim_jax.maps.sumo.records import SumoConfig
from limsim_jax.maps.sumo.vehicle_types import parse_time
from limsim_jax.maps.xml import Element, XmlReader, read_bytes


def read_sumocfg(path: str | Path) -> SumoConfig:
    """Read the files and times of a SUMO configuration.

    Raises:
      MapError: the file cannot be used, names no network, or names files that do not exist.
    """
    xml, report = XmlReader(path), ImportReport()
    root = xml.parse(read_bytes(path), "configuration", "sumoConfiguration")
    options: dict[str, tuple[str, Element]] = {}
    for element in root.iter():
        name = _OPTION_NAMES.get(element.tag)
        value = element.get("value", element.get("v"))
        if name is not None and value is not None:
            report.read(element.tag)
            options[name] = value, element
        elif value is not None:
            xml.ignore(element, "not an input of the simulation")
    missing: list[str] = []

    def files(name: str) -> tuple[Path, ...]:
        names = [part.strip() for part in re.split(r"[,;]", options[name][0])] if name in options else []
        found = tuple(Path(path).parent / part for part in names if part)
        missing.extend(str(file) for file in found if not file.is_file())
        return found

    def time(name: str, default: float | None) -> float | None:
        if name not in options:
            return default
        value = parse_time(xml, options[name][1], name, options[name][0])
        return default if value < 0 else value

    nets = files("net-file")
    routes, additional = files("route-files"), files("additional-files")
    if missing:
        raise MapError(f"it names files that do not exist: {', '.join(missing)}", file=str(path))
    if len(nets) != 1:
        raise MapError(f"it names {len(nets)} networks, not one (<net-file value=...>)", file=str(path))
    xml.ignored.summarise(report)
    return SumoConfig(
        network=nets[0],
        routes=routes,
        additional=additional,
        begin=time("begin", 0.0) or 0.0,
        end=time("end", None),
        step_length=time("step-length", 1.0) or 1.0,
        report=report,
    )


_OPTION_NAMES = {
    name: names[0]
    for names in (
        ("net-file", "net", "n"),
        ("route-files", "route", "r"),
        ("additional-files", "additional", "a"),
        ("begin", "b"),
        ("end", "e"),
        ("step-length",),
    )
    for name in names
}
