"""Commands about maps: info, draw, check."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from limsim_jax.cli.common import JsonOption, MapArgument, NoCacheOption, load, window, write_json

if TYPE_CHECKING:
    from limsim_jax.maps.network import ImportReport, Network

map_app = typer.Typer(help="Look at a map: OpenDRIVE (.xodr) or SUMO (.net.xml).", no_args_is_help=True)


@map_app.command()
def info(file: MapArgument, json_file: JsonOption = None, no_cache: NoCacheOption = False) -> None:
    """What is in a map: counts, lengths, bounds, junctions, lights, and what the reader did."""
    network = load(file, no_cache)
    facts = _facts(network)
    if json_file is not None:
        write_json(json_file, facts | {"report": _report(network.report)})
    width = max(map(len, facts)) + 2
    for name, value in facts.items():
        print(f"{name.replace('_', ' '):<{width}}{_say(value)}")
    print(f"\n{network.report}")


@map_app.command()
def draw(
    file: MapArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture to write: .png, .svg or .pdf.")],
    conflicts: Annotated[bool, typer.Option("--conflicts", help="Mark where paths cross or merge.")] = False,
    labels: Annotated[bool, typer.Option("--labels", help="Write the ids of roads and junctions.")] = False,
    bounds: Annotated[
        str | None, typer.Option(metavar="X0,Y0,X1,Y1", help="Draw this window (m) of the map.")
    ] = None,
    no_cache: NoCacheOption = False,
) -> None:
    """Draw a map: lanes with their direction, junctions, lights, stop lines."""
    part = None if bounds is None else window(bounds)
    network = load(file, no_cache)
    from limsim_jax.report.draw import draw_map

    draw_map(network, output, conflicts=conflicts, labels=labels, bounds=part)
    print(f"wrote {output}")


@map_app.command()
def check(
    file: MapArgument,
    strict: Annotated[
        bool, typer.Option("--strict", help="Count what was approximated, ignored or added, too.")
    ] = False,
    json_file: JsonOption = None,
    no_cache: NoCacheOption = False,
) -> int:
    """Say whether a map can be trusted: exit code 0 if it is clean, 1 if not, 2 if it cannot be used.

    Findings are what the reader had to repair or cannot use, links at which the centre line jumps by more
    than 1 cm or 0.5 degrees, and circles of lanes each of which yields to the next. With --strict, what
    was approximated, ignored or added is a finding as well.
    """
    from limsim_jax.maps import build_lane_map
    from limsim_jax.maps.check import deadlocks, seams
    from limsim_jax.maps.network import Action

    network = load(file, no_cache)
    report = copy.deepcopy(network.report)
    build_lane_map(network, report=report, cache=not no_cache)
    broken, circles = list(seams(network)), deadlocks(network)
    counted = {*Action} - {Action.READ} if strict else {Action.REPAIRED, Action.UNUSABLE}
    findings = len(broken) + len(circles) + sum(report.total(action) for action in counted)
    if json_file is not None:
        write_json(
            json_file,
            {
                "source": network.source,
                "file_hash": network.file_hash,
                "strict": strict,
                "findings": findings,
                "seams": [vars(seam) for seam in broken],
                "deadlocks": circles,
                "report": _report(report),
            },
        )
    print(report)
    for note in report.notes:
        print(note)
    for seam in broken:
        print(f"{'seam':<12} {seam}")
    for circle in circles:
        print(f"{'deadlock':<12} each yields to the next: {', '.join(circle)}")
    print(f"{network.source}: {findings or 'no'} finding{'' if findings == 1 else 's'}")
    return 1 if findings else 0


def _facts(network: Network) -> dict[str, Any]:
    """The figures of a network under their names; lengths in km, bounds in m."""
    drivable = list(network.drivable_lanes())
    return {
        "name": network.name,
        "source": network.source,
        "format": network.format,
        "file_hash": network.file_hash,
        "geo_reference": network.geo_reference,
        "bounds_m": [round(x, 2) for x in network.bounds()],
        "roads": len(network.roads),
        "lanes": len(network.lanes),
        "drivable_lanes": len(drivable),
        "drivable_km": round(sum(lane.length for lane in drivable) / 1e3, 3),
        "connectors": sum(lane.junction is not None for lane in drivable),
        "junctions": len(network.junctions),
        "movements": len(network.movements),
        "traffic_lights": len(network.traffic_lights),
        "programs": len(network.programs),
        "signs": len(network.signs),
        "stop_lines": len(network.stop_lines),
        "crosswalks": len(network.crosswalks),
    }


def _report(report: ImportReport) -> dict[str, Any]:
    """An import report as plain values."""
    counts: dict[str, dict[str, int]] = {element: {} for element in report.elements()}
    for (element, action), count in report.counts.items():
        counts[element][action.value] = count
    return {"counts": counts, "notes": [vars(note) for note in report.notes]}


def _say(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(f"{x:g}" for x in value)
    return " ".join(str(value).split()) or "-"
