"""The command line.

A user's error is one line on stderr and exit code 2. A bug is a traceback.
"""

from __future__ import annotations

import copy
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from limsim_jax import __version__
from limsim_jax.cli import fitting, results
from limsim_jax.files import check_writable

if TYPE_CHECKING:
    from limsim_jax.maps.network import ImportReport, Network
    from limsim_jax.simulation.totals import Totals

# XLA logs an error for every program that it loads from its own cache on a CPU; nothing is wrong.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

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
results.add_commands(app)
fitting.add_commands(app)

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
    except ValueError as error:
        if not _is_ours(error):
            raise
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


def _is_ours(error: ValueError) -> bool:
    """Whether our own code has raised it, to tell the user what to do."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return trace is not None and str(trace.tb_frame.f_globals.get("__name__")).startswith("limsim_jax.")


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
    from limsim_jax.report.draw import draw_map

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


@app.command()
def run(
    file: Annotated[str, typer.Argument(metavar="MAP", help="Name of a bundled map, or a map file.")],
    seconds: Annotated[float, typer.Option(help="Seconds of traffic.")] = 60.0,
    seed: Annotated[int, typer.Option(help="Another seed is another world.")] = 0,
    rate: Annotated[
        float | None, typer.Option(help="Vehicles per hour that come in at each origin.  [default: 400]")
    ] = None,
    vehicles: Annotated[int, typer.Option(help="Vehicles on the road at the start.")] = 20,
    slots: Annotated[int, typer.Option(help="Vehicles that can be on the road at once.")] = 64,
    dt: Annotated[float, typer.Option(help="Physics step, s.")] = 0.1,
    video: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a video: .gif or .mp4, 10 frames per second.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a picture of the end: .png.")
    ] = None,
    bounds: Annotated[
        str | None, typer.Option(metavar="X0,Y0,X1,Y1", help="Show this window (m) of the map.")
    ] = None,
    trace_file: Annotated[
        Path | None, typer.Option("--trace", metavar="FILE", help="Write every step: .npz or .parquet.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Run one world of traffic and say what happened."""
    for name, value in (("--seconds", seconds), ("--dt", dt)):
        if not (value > 0 and math.isfinite(value)):
            raise typer.BadParameter(f"{value:g} s; it has to be above 0", param_hint=name)
    if dt > 0.5:
        raise typer.BadParameter(f"{dt:g} s is too coarse for traffic; at most 0.5", param_hint="--dt")
    if rate is not None and not (rate >= 0 and math.isfinite(rate)):
        raise typer.BadParameter(f"{rate:g} veh/h; it has to be 0 or more", param_hint="--rate")
    if not 0 <= seed < 2**31:
        raise typer.BadParameter(f"{seed}; it has to be within 0 and 2^31 - 1", param_hint="--seed")
    if slots < 1:
        raise typer.BadParameter(f"{slots}; at least 1", param_hint="--slots")
    if vehicles < 0:
        raise typer.BadParameter(f"{vehicles}; it has to be 0 or more", param_hint="--vehicles")
    if vehicles > slots:
        message = f"{vehicles} do not fit into {slots} slots; ask for more with --slots"
        raise typer.BadParameter(message, param_hint="--vehicles")
    window = None if bounds is None else _window(bounds)
    _check_outputs(video, picture, trace_file)
    check_writable(video, picture, trace_file, json_file)
    network = _load(file, no_cache=False)

    import jax
    import numpy as np

    from limsim_jax.bench import RATE, build_traffic
    from limsim_jax.maps import build_lane_map
    from limsim_jax.maps.network import MapError
    from limsim_jax.simulation.rollout import Result, Rollout, one_world
    from limsim_jax.simulation.trace import trace
    from limsim_jax.traffic.demand import sample_scenario
    from limsim_jax.traffic.engine import Traffic
    from limsim_jax.types import Config
    from limsim_jax.xla import enable_compilation_cache

    lane_map = build_lane_map(network)
    per_origin = RATE if rate is None else rate
    try:
        demand, origins = build_traffic(
            network, lane_map, rate=per_origin, vehicles=vehicles, seconds=seconds
        )
        if demand.initial > slots:
            raise ValueError(f"{demand.initial} vehicles at the start do not fit into {slots} slots")
    except ValueError as error:
        raise MapError(str(error), file=network.source) from None
    wants_trace = any(path is not None for path in (video, picture, trace_file))
    # decisions about every half a second, as with steps of 0.1 s
    config = Config(dt=dt, decision_every=max(1, round(0.5 / dt)))
    rollout = Rollout(config, Traffic(), seconds, record=trace if wants_trace else None)

    arrays, structure = jax.tree.flatten(lane_map)

    @jax.jit
    def world(arrays: list[Any], seed: Any) -> Result:  # the world of this seed in a batch, too
        lane_map = jax.tree.unflatten(structure, arrays)
        return one_world(rollout, lane_map, lambda key: sample_scenario(demand, lane_map, key, slots), seed)

    enable_compilation_cache()
    start = time.perf_counter()
    compiled = world.lower(arrays, np.int32(seed)).compile()
    built = time.perf_counter()
    result = jax.device_get(compiled(arrays, np.int32(seed)))
    done = time.perf_counter()
    given = "" if rate is not None else " (default)"
    arrivals = f"{per_origin:g} veh/h{given} at each of {origins} origins" if origins else "no origins"
    summary = {
        "map": network.name or file,
        "source": network.source,
        "file_hash": network.file_hash,
        "seed": seed,
        "seconds": rollout.decisions * config.decision_time,
        "dt": dt,
        "rate": per_origin,
        "origins": origins,
        "initial": demand.initial,
        "slots": slots,
        **_outcome(result.totals),
        "compile_s": built - start,
        "run_s": done - built,
    }
    if json_file is not None:
        _write_json(json_file, summary)
    _show(f"{Path(network.source).name}, {summary['seconds']:g} s, seed {seed}", arrivals, summary)
    if trace_file is not None:
        from limsim_jax.simulation.table import write_trace

        write_trace(trace_file, network, lane_map, result.trace)
    if picture is not None or video is not None:
        from limsim_jax.report.video import write_picture, write_video

        if picture is not None:
            write_picture(picture, network, lane_map, result.trace, bounds=window)
        if video is not None:
            every = max(1, round(0.1 / dt))
            write_video(
                video, network, lane_map, result.trace, fps=1 / (dt * every), every=every, bounds=window
            )
    for path in (trace_file, picture, video, json_file):
        if path is not None:
            print(f"wrote {path}")


@bench_app.command()
def traffic(
    file: Annotated[
        str, typer.Argument(metavar="[MAP]", help="Name of a bundled map, or a map file.")
    ] = "intersection",
    worlds: Annotated[int, typer.Option(min=1, help="Worlds run together.")] = 256,
    vehicles: Annotated[int, typer.Option(min=1, help="Vehicle slots per world.")] = 64,
    seconds: Annotated[float, typer.Option(min=0.5, help="Seconds of traffic.")] = 20.0,
    repeats: Annotated[int, typer.Option(min=1, help="Runs of which the median counts.")] = 3,
    rate: Annotated[float, typer.Option(min=0, help="Vehicles per hour at each origin.")] = 400.0,
    cold: Annotated[
        bool, typer.Option("--cold", help="Compile with an empty cache, then load from it.")
    ] = False,
    no_peer: Annotated[bool, typer.Option("--no-peer", help="Do not run SUMO next to it.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Time traffic in many worlds on all cores, or on the accelerator; next to it SUMO if installed."""
    from limsim_jax.bench import bench_traffic, traffic_lines

    for name, value in (("--seconds", seconds), ("--rate", rate)):
        if not math.isfinite(value):
            raise typer.BadParameter(f"{value:g}; it has to be finite", param_hint=name)
    check_writable(json_file)
    result = bench_traffic(
        _path(file), worlds=worlds, vehicles=vehicles, seconds=seconds, repeats=repeats, rate=rate,
        peer=not no_peer, cold=cold,
    )  # fmt: skip
    if json_file is not None:
        _write_json(json_file, result)
    _table(traffic_lines(result))


@bench_app.command()
def policy(
    experiment: Annotated[str, typer.Argument(help="Experiment file, or the name of one.")],
    name: Annotated[
        str | None, typer.Option("--policy", metavar="NAME", help="Instead of the experiment's.")
    ] = None,
    worlds: Annotated[int, typer.Option(min=1, help="Worlds of the batch.")] = 64,
    repeats: Annotated[int, typer.Option(min=1, help="Tens of calls of which the median counts.")] = 5,
    cold: Annotated[bool, typer.Option("--cold", help="Compile with an empty cache.")] = False,
    json_file: JsonOption = None,
) -> None:
    """Time the decisions of a policy: of one world on one core, and of many on all."""
    from limsim_jax.bench import bench_policy, policy_lines
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.sweeps.experiment import read_experiments

    check_writable(json_file)
    read = read_experiments(experiment, policy=name)
    if len(read) != 1:
        raise typer.BadParameter(f"'{experiment}' is {len(read)} experiments; name one of them")
    Episodes(read[0])  # says what is wrong with it
    result = bench_policy(experiment, name, worlds=worlds, repeats=repeats, cold=cold)
    if json_file is not None:
        _write_json(json_file, result)
    _table(policy_lines(result))


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


def _check_outputs(video: Path | None, picture: Path | None, trace_file: Path | None) -> None:
    """Refuse files that could not be written in the end, before anything takes long."""
    try:
        if video is not None or picture is not None:
            from limsim_jax.report.video import PICTURE_SUFFIXES, VIDEO_SUFFIXES, check_suffix

            if video is not None:
                check_suffix(video, VIDEO_SUFFIXES)
            if picture is not None:
                check_suffix(picture, PICTURE_SUFFIXES)
        if trace_file is not None and trace_file.suffix.lower() not in (".npz", ".parquet"):
            raise ValueError(f"cannot write '{trace_file}': use .npz or .parquet")
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    if trace_file is not None and trace_file.suffix.lower() == ".parquet":
        try:
            import pyarrow.parquet  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                f"'{trace_file}' needs pyarrow: pip install pyarrow, or write .npz"
            ) from None


def _outcome(totals: Totals) -> dict[str, Any]:
    """Totals of one world as plain values, and the means that they give."""
    plain = {name: value.item() for name, value in vars(totals).items()}
    distance, driven, travel = plain.pop("distance"), plain.pop("time"), plain.pop("travel_time")
    return plain | {
        "vehicle_km": distance / 1e3,
        "mean_speed": distance / driven if driven else None,
        "mean_travel_time": travel / plain["left"] if plain["left"] else None,
    }


def _show(title: str, arrivals: str, summary: dict[str, Any]) -> None:
    """Print the summary of a run."""

    def number(name: str, unit: str) -> str:
        return "-" if summary[name] is None else f"{summary[name]:.1f} {unit}"

    slots = f"  ({summary['full']} times no slot was free: --slots)" if summary["full"] else ""
    incidents = {
        "off_road": "off the road", "wrong_way": "wrong way", "ran_red": "ran a red light",
        "missed": "missed their lane change", "hard": "braked beyond their limit",
        "broken": "with numbers that are not finite",
    }  # fmt: skip
    others = [f"{summary[name]} {text}" for name, text in incidents.items() if summary[name]]
    if summary["gridlock"]:
        others.append("gridlock")
    _table(
        [
            ("arrivals", arrivals),
            ("entered", f"{summary['entered']}, {summary['initial']} of them there at the start"),
            ("left", str(summary["left"])),
            ("waiting to enter", f"{summary['waiting']}{slots}"),
            ("collided", str(summary["collided"])),
            ("other incidents", ", ".join(others) or "none"),
            ("mean speed", number("mean_speed", "m/s")),
            ("mean travel time", number("mean_travel_time", "s, of those who left")),
            ("hardest braking", number("deceleration", "m/s^2")),
            ("longest wait", number("longest_wait", "s")),
            ("compile", number("compile_s", "s")),
            ("run", f"{summary['run_s']:.2f} s"),
        ],
        title,
    )


def _table(lines: list[tuple[str, str]], title: str | None = None) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in lines:
        table.add_row(Text(name), Text(value))
    console = Console()
    if title is not None:
        console.print(Text(title, style="bold"))
    console.print(table)


def _path(file: str) -> Path:
    from limsim_jax.maps import bundled_map

    return path if (path := Path(file)).exists() or len(path.parts) > 1 else bundled_map(file)


def _load(file: str, no_cache: bool) -> Network:
    from limsim_jax.maps import read_network

    return read_network(_path(file), cache=not no_cache)


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
