"""Commands that measure speed on this machine."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from limsim_jax.cli.common import JsonOption, path, table, write_json
from limsim_jax.files import check_writable

bench_app = typer.Typer(help="Measure speed on this machine.", no_args_is_help=True)


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
        path(file), worlds=worlds, vehicles=vehicles, seconds=seconds, repeats=repeats, rate=rate,
        peer=not no_peer, cold=cold,
    )  # fmt: skip
    if json_file is not None:
        write_json(json_file, result)
    table(traffic_lines(result))


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
        write_json(json_file, result)
    table(policy_lines(result))


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
    """Time a map from file to device arrays, and its look-ups.

    Both are timed cold and from the cache."""
    from limsim_jax.bench import bench_maps, markdown

    result = bench_maps(path(file), all_cores=all_cores, repeats=repeats, batches=batch or [1_000, 100_000])
    tables = markdown(result)
    if json_file is not None:
        write_json(json_file, result)
    if markdown_file is not None:
        command = f"limsim-jax bench maps {file}" + " --all-cores" * all_cores + f" --repeats {repeats}"
        markdown_file.write_text(f"# How fast maps load\n\nMade by `{command}`.\n\n{tables}\n")
    print(tables)
