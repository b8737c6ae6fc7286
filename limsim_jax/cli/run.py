"""The command run: one world of traffic or of an experiment."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from limsim_jax.cli.common import JsonOption, path, table, window, write_json
from limsim_jax.files import check_writable

if TYPE_CHECKING:
    from limsim_jax.api.experiment import Experiment
    from limsim_jax.simulation.totals import Totals

RATE = 400.0
"""veh/h at each origin, unless the user says another number."""


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
    part = None if bounds is None else window(bounds)
    _check_outputs(video, picture, trace_file)
    check_writable(video, picture, trace_file, json_file)

    import jax
    import numpy as np

    from limsim_jax.simulation.rollout import Result, one_world
    from limsim_jax.simulation.trace import trace
    from limsim_jax.xla import enable_compilation_cache

    per_origin = RATE if rate is None else rate
    experiment = _traffic(file, rate=per_origin, vehicles=vehicles, seconds=seconds, slots=slots, dt=dt)
    episodes = experiment.episodes(chunk=1)
    network, lane_map = episodes.network, episodes.lane_map
    origins = len({flow.origin for flow in episodes.flows})
    wants_trace = any(output is not None for output in (video, picture, trace_file))
    rollout = replace(episodes.rollout, measure=None, record=trace if wants_trace else None)

    arrays, structure = jax.tree.flatten(lane_map)

    @jax.jit
    def world(arrays: list[Any], seed: Any) -> Result:  # the world of this seed in a batch, too
        return one_world(rollout, jax.tree.unflatten(structure, arrays), episodes.sample, seed)

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
        "seconds": rollout.decisions * rollout.config.decision_time,
        "dt": dt,
        "rate": per_origin,
        "origins": origins,
        "initial": episodes.initial,
        "slots": slots,
        **_outcome(result.totals),
        "compile_s": built - start,
        "run_s": done - built,
    }
    if json_file is not None:
        write_json(json_file, summary)
    _show(f"{Path(network.source).name}, {summary['seconds']:g} s, seed {seed}", arrivals, summary)
    if trace_file is not None:
        from limsim_jax.simulation.table import write_trace

        write_trace(trace_file, network, lane_map, result.trace)
    if picture is not None or video is not None:
        from limsim_jax.report.video import write_picture, write_video

        if picture is not None:
            write_picture(picture, network, lane_map, result.trace, bounds=part)
        if video is not None:
            every = max(1, round(0.1 / dt))
            write_video(
                video, network, lane_map, result.trace, fps=1 / (dt * every), every=every, bounds=part
            )
    for output in (trace_file, picture, video, json_file):
        if output is not None:
            print(f"wrote {output}")


def _traffic(file: str, *, rate: float, vehicles: int, seconds: float, slots: int, dt: float) -> Experiment:
    """Plain traffic on a map: the default drivers, from all origins to all goals."""
    from limsim_jax.api.experiment import Experiment, Flow
    from limsim_jax.api.map import load_map

    return Experiment(
        map=load_map(path(file)),
        horizon=seconds,
        ego=None,
        flows=[Flow(rate=float(rate))],
        vehicles=vehicles,
        slots=slots,
        dt=dt,
        # decisions about every half a second, as with steps of 0.1 s
        decision_every=max(1, round(0.5 / dt)),
    )


def _check_outputs(video: Path | None, picture: Path | None, trace_file: Path | None) -> None:
    """Refuse files that cannot be written before anything takes long."""
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
    """Totals of one world as plain values, and their means."""
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
    table(
        [
            ("arrivals", arrivals),
            ("entered", f"{summary['entered']}, {summary['initial']} of them there at the start"),
            ("left", str(summary["left"])),
            ("waiting to enter", f"{summary['waiting']}{slots}"),
            ("collided", str(summary["collided"])),
            ("other incidents", ", ".join(others) or "none"),
            ("mean speed", number("mean_speed", "m/s")),
            ("mean travel time", number("mean_travel_time", "s, of vehicles that left")),
            ("hardest braking", number("deceleration", "m/s^2")),
            ("longest wait", number("longest_wait", "s")),
            ("compile", number("compile_s", "s")),
            ("run", f"{summary['run_s']:.2f} s"),
        ],
        title,
    )
