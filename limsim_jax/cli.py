"""The command line.

A user's error is one line on stderr and exit code 2. A bug is a traceback.
"""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from limsim_jax import __version__

if TYPE_CHECKING:
    from limsim_jax.maps.network import ImportReport, Network

app = typer.Typer(
    help="Road traffic for validating automated driving.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
map_app = typer.Typer(help="Look at a map: OpenDRIVE (.xodr) or SUMO (.net.xml).", no_args_is_help=True)
bench_app = typer.Typer(help="Measure speed on this machine.", no_args_is_help=True)
app.add_typer(map_app, name="map")
app.add_typer(bench_app, name="bench")

MapArgument = Annotated[
    str, typer.Argument(metavar="FILE", help="Map file, gzipped or not, or the name of a bundled map.")
]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.")]
NoCacheOption = Annotated[bool, typer.Option("--no-cache", help="Read the map file itself; leave no trace.")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command (default: that of the process) and return its exit code."""
    from limsim_jax.maps.network import MapError

    try:
        code = app(args=arguments, prog_name="limsim-jax", standalone_mode=False)
    except typer.TyperException as error:  # an unknown command, a missing argument, a bad option
        return _refuse(error.format_message())
    except MapError as error:
        return _refuse(str(error))
    except OSError as error:
        if error.filename is None:  # not about a file that the user named
            raise
        return _refuse(f"{error.filename}: {error.strerror}")
    except ModuleNotFoundError as error:
        if error.name is not None:  # not an extra that is missing: those come with advice, not a name
            raise
        return _refuse(str(error))
    except (typer.Abort, KeyboardInterrupt):
        return 130
    return code or 0


def _refuse(reason: str) -> int:
    print("limsim-jax:", " ".join(reason.split()), file=sys.stderr)
    return 2


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"limsim-jax {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """Road traffic for validating automated driving."""
    del version


@map_app.command()
def info(file: MapArgument, json_file: JsonOption = None, no_cache: NoCacheOption = False) -> None:
    """What is in a map: counts, lengths, bounds, junctions, lights, and what the reader did."""
    network = _load(file, no_cache)
    facts = _facts(network)
    if json_file is not None:
        _write_json(json_file, facts | {"report": _report(network.report)})
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
    window = None if bounds is None else _window(bounds)
    network = _load(file, no_cache)
    from limsim_jax.maps.draw import draw_map

    draw_map(network, output, conflicts=conflicts, labels=labels, bounds=window)
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

    Findings are what the reader had to repair, links at which the centre line jumps by more than 1 cm
    or 0.5 degrees, and circles of lanes each of which yields to the next. With --strict, what was
    approximated, ignored or added is a finding as well.
    """
    from limsim_jax.maps import build_lane_map
    from limsim_jax.maps.check import deadlocks, seams
    from limsim_jax.maps.network import Action

    network = _load(file, no_cache)
    report = copy.deepcopy(network.report)
    build_lane_map(network, report=report, cache=not no_cache)
    broken, circles = list(seams(network)), deadlocks(network)
    counted = {*Action} - {Action.READ} if strict else {Action.REPAIRED}
    findings = len(broken) + len(circles) + sum(report.total(action) for action in counted)
    if json_file is not None:
        _write_json(
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


@bench_app.command()
def maps(
    file: Annotated[
        str, typer.Argument(metavar="[FILE]", help="Map file or the name of a bundled map.")
    ] = "long_route",
    json_file: JsonOption = None,
    markdown_file: Annotated[
        Path | None, typer.Option("--markdown", metavar="FILE", help="Write the tables as Markdown.")
    ] = None,
    all_cores: Annotated[bool, typer.Option("--all-cores", help="Use every core, not just one.")] = False,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of which the median counts.")] = 5,
    batch: Annotated[
        list[int] | None, typer.Option(min=1, help="Look-ups per call; may be given several times.")
    ] = None,
) -> None:
    """Time a map from file to device arrays, cold and from cache, and look-ups on its lanes."""
    from limsim_jax.bench import bench_maps, markdown

    result = bench_maps(_path(file), all_cores=all_cores, repeats=repeats, batches=batch or [1_000, 100_000])
    tables = markdown(result)
    if json_file is not None:
        _write_json(json_file, result)
    if markdown_file is not None:
        command = f"limsim-jax bench maps {file}" + " --all-cores" * all_cores + f" --repeats {repeats}"
        markdown_file.write_text(f"# How fast maps load\n\nMade by `{command}`.\n\n{tables}\n")
    print(tables)


def _path(file: str) -> Path:
    from limsim_jax.maps import bundled_map

    return path if (path := Path(file)).exists() or len(path.parts) > 1 else bundled_map(file)


def _load(file: str, no_cache: bool) -> Network:
    from limsim_jax.maps import load_map

    return load_map(_path(file), cache=not no_cache)


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


def _window(text: str) -> tuple[float, float, float, float]:
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not four numbers X0,Y0,X1,Y1", param_hint="--bounds") from None
    return x0, y0, x1, y1


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
