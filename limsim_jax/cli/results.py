"""Commands about sweeps and their results: sweep, report, compare, verify, replay, export."""

from __future__ import annotations

import functools
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from limsim_jax.cli.common import ChunkOption, DrivenByOption, ExperimentArgument, experiments_of, window
from limsim_jax.cli.scenarios import is_scenario, sweep_scenarios

if TYPE_CHECKING:
    import pyarrow as pa

    from limsim_jax.report.tables import TextTable
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.sweeps.experiment import ExperimentFile
    from limsim_jax.sweeps.runner import Progress
    from limsim_jax.sweeps.store import Results

ResultsArgument = Annotated[Path, typer.Argument(metavar="RESULTS", help="Folder that a sweep has written.")]
ScenarioOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="Scenario, where the results hold several.")
]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the table as JSON.")]
PolicyOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="Policy, where the results hold several.")
]


IN_SWEEP = 6
"""Worst episodes with pictures in the report at the end of a sweep."""

SECONDS = 60.0
"""s after which such a report replays no further scenario."""


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module."""
    for command in (sweep, warm, report, compare, verify, replay, export, reflect):
        app.command()(command)


def sweep(
    experiment: Annotated[
        str,
        typer.Argument(
            metavar="EXPERIMENT",
            help="Experiment file (.toml, .sumocfg, .xosc, or a folder of .xosc), or the name of a bundled "
            "one, or of a scenario of the library.",
        ),
    ],
    seeds: Annotated[
        int | None,
        typer.Option(
            help="How many worlds of each scenario: seeds 0, 1, 2, ...; of a .xosc so many of its variants."
            "  [default: 100; of a .xosc all]"
        ),
    ] = None,
    odd: Annotated[
        bool | None,
        typer.Option(
            "--odd-seeds/--even-seeds",
            help="Seeds 1, 3, 5, ... or 0, 2, 4, ...: even ones teach language models, odd ones test them.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where results go.  [default: results/EXPERIMENT]"),
    ] = None,
    policy: DrivenByOption = None,
    map_file: Annotated[
        str | None, typer.Option("--map", metavar="MAP", help="Use this map, not that of the file.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Run one of N parts, from 0/N on: for job arrays.")
    ] = None,
    until_ci: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTH[:METRIC]",
            help="Stop once the interval of the metric (default: success) is within +- WIDTH.",
        ),
    ] = None,
    chunk: ChunkOption = None,
    workers: Annotated[
        int | None, typer.Option(help="Number of Ray workers to run on (needs the extra 'ray').")
    ] = None,
    address: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Ray cluster.  [default: this machine]")
    ] = None,
    engine: Annotated[
        Literal["limsim", "sumo"],
        typer.Option(help="What runs the traffic: limsim, or SUMO itself (a .sumocfg; extra 'sumo')."),
    ] = "limsim",
    ego: Annotated[
        str | None,
        typer.Option(
            metavar="ID[,ID]",
            help="With SUMO: vehicles that the policy drives.  [default: drawn by the seed]",
        ),
    ] = None,
    egos: Annotated[
        int | None, typer.Option(min=1, help="With SUMO: how many vehicles are drawn.  [default: 1]")
    ] = None,
    horizon: Annotated[
        float | None,
        typer.Option(help="With SUMO: s that an ego has for its trip.  [default: 180]  Of a .xosc: at most."),
    ] = None,
    root: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Of a .xosc: catalogs may lie in this folder.")
    ] = None,
    lenient: Annotated[
        bool, typer.Option("--lenient", help="Of a .xosc: list what is not supported, and leave it out.")
    ] = False,
    at_once: Annotated[
        bool,
        typer.Option("--at-once", help="Of a .xosc: the policy drives from the start."),
    ] = False,
    preventable: Annotated[
        bool,
        typer.Option(
            "--preventable",
            help="Of a .xosc: run the careful driver of UN R157, too; count what collisions it avoids.",
        ),
    ] = False,
    drivers: Annotated[
        Literal["sumo", "ours"] | None,
        typer.Option(help="With SUMO: what drives the other vehicles.  [default: sumo]"),
    ] = None,
    event: Annotated[
        str | None,
        typer.Option(
            "--estimate",
            metavar="EVENT",
            help="Estimate the probability of a rare event instead: contact, fault, or as min_ttc<1.",
        ),
    ] = None,
    method: Annotated[
        Literal["subset", "crude", "cross-entropy"] | None,
        typer.Option(help="With --estimate: how.  [default: subset]"),
    ] = None,
    budget: Annotated[
        int | None, typer.Option(help="With --estimate: worlds in all, at most.  [default: 5000]")
    ] = None,
    least: Annotated[
        float | None,
        typer.Option(help="With --estimate: probability that is looked for, at least.  [default: 1e-4]"),
    ] = None,
    on_error: Annotated[
        Literal["record", "stop"],
        typer.Option(help="An episode in which the policy fails is recorded as failed, or stops the sweep."),
    ] = "record",
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Remove what is there of this experiment, and start anew.")
    ] = False,
    html: Annotated[bool, typer.Option("--report/--no-report", help="Write the report at the end.")] = True,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="With --estimate: write the table as JSON.")
    ] = None,
) -> None:
    """Run an experiment with many seeds; go on where an earlier run has stopped.

    The exit code is 1 if the policy failed in an episode."""
    part, stop = _shard(shard), _until(until_ci)
    if event is None:
        _refuse(
            {"--method": method, "--budget": budget, "--least": least, "--json": json_file},
            "only with --estimate",
        )
    elif is_scenario(experiment):
        raise typer.BadParameter("a .xosc has variants, no random numbers", param_hint="--estimate")
    else:
        alone = {
            "--shard": shard, "--until-ci": until_ci, "--workers": workers, "--seeds": seeds,
            "--odd-seeds": odd, "--engine sumo": None if engine == "limsim" else engine,
        }  # fmt: skip
        for name, value in alone.items():
            if value is not None:
                raise typer.BadParameter(
                    f"an estimate is one run of its own, without {name}", param_hint="--estimate"
                )
    if is_scenario(experiment):
        if engine != "limsim" or workers is not None or stop is not None:
            raise typer.BadParameter("not with --engine, --workers or --until-ci", param_hint="EXPERIMENT")
        if odd is not None:
            raise typer.BadParameter("a .xosc has variants, no seeds", param_hint="--odd-seeds")
        sweep_scenarios(
            Path(experiment), policy, out=out, variants=seeds, override=map_file, chunk=chunk, shard=part,
            on_error=on_error, fresh=fresh, horizon=horizon, root=root, lenient=lenient, controlled=at_once,
            preventable=preventable,
        )  # fmt: skip
        return
    only = {"--root": root, "--lenient": lenient, "--at-once": at_once, "--preventable": preventable}
    for name, value in only.items():
        if value:
            raise typer.BadParameter("only of a .xosc", param_hint=name)
    seeds = 100 if seeds is None else seeds
    if not 1 <= seeds <= 2**31:
        raise typer.BadParameter(f"{seeds}; between 1 and 2^31", param_hint="--seeds")
    worlds = range(seeds) if odd is None else range(int(odd), 2 * seeds, 2)
    if worlds[-1] >= 2**31:
        raise typer.BadParameter(f"{seeds}; the last seed would be {worlds[-1]}", param_hint="--seeds")
    if chunk is not None and chunk < 1:
        raise typer.BadParameter(f"{chunk}; at least 1", param_hint="--chunk")
    if workers is not None and workers < 1:
        raise typer.BadParameter(f"{workers}; at least 1", param_hint="--workers")
    if fresh and part is not None:
        raise typer.BadParameter("it would remove the results of other shards", param_hint="--fresh")
    in_sumo = {"--ego": ego, "--egos": egos, "--horizon": horizon, "--drivers": drivers}
    if ego is not None and egos is not None:
        raise typer.BadParameter("--ego names them; --egos draws so many", param_hint="--egos")
    if engine == "sumo":
        _refuse({"--map": map_file, "--workers": workers}, "not with --engine sumo")
        experiments: list[ExperimentFile] = []
    else:
        _refuse(in_sumo, "only with --engine sumo")
        experiments = experiments_of(experiment, map_file, policy)
    folder = Path("results") / Path(experiment).stem if out is None else out
    if event is not None:
        from limsim_jax.cli.rare import estimate

        folder = folder.with_name(f"{folder.name}-estimate") if out is None else out
        return estimate(experiments, event, folder, method, budget, least, chunk, fresh, html, json_file)
    begin = time.perf_counter()

    from limsim_jax.api.progress import progress_bar
    from limsim_jax.report.tables import failed_policies
    from limsim_jax.sweeps import runner

    kept: dict[tuple[str, str], int] = {}
    if engine == "sumo":
        made = [_sumo_episodes(experiment, policy, ego, egos, horizon, drivers, chunk)]
    else:
        made = build(experiments, chunk) if workers is None else []
    if html and part is None:  # imported while programs are loaded or compiled
        Thread(target=_import_report, daemon=True).start()
    try:
        with progress_bar() as show:

            def tell(now: Progress) -> None:
                kept[now.scenario, now.policy] = now.done
                if show is not None:
                    show(now)

            if workers is not None:
                from limsim_jax.sweeps.cluster import sweep_on_ray

                factory = functools.partial(build, experiments, chunk, cores=1)
                summary = sweep_on_ray(
                    factory, worlds, folder, workers=workers, address=address, shard=part,
                    until_ci=stop, progress=tell, on_error=on_error, fresh=fresh,
                )  # fmt: skip
            else:
                summary = runner.sweep(
                    made, worlds, folder, shard=part, until_ci=stop, progress=tell,
                    on_error=on_error, fresh=fresh,
                )  # fmt: skip
    except KeyboardInterrupt:
        print(f"stopped; {sum(kept.values())} worlds are kept in {folder}; the same command goes on")
        raise
    ran = sum(found.ran for found in summary.parts)
    for line in summary.damaged:
        print(f"set aside and run again: {line}")
    for found in summary.parts:
        if stop is not None and found.interval is not None:
            low, high = found.interval.low, found.interval.high
            state = "reached" if found.reached else "not reached"
            where = f"{stop[1]} within [{low:.4g}, {high:.4g}]"
            print(f"{found.scenario}: {where} after {found.done} seeds, {state}")
    print(f"{ran} worlds run in {time.perf_counter() - begin:.0f} s, results in {folder}")
    if part is None:
        opened, table = _print_headline(folder)
        if html:
            _write_report(opened, table, folder / "report.html", IN_SWEEP, SECONDS, made)
        if failed := failed_policies(opened):
            print("\n".join(failure.text for failure in failed))
            raise typer.Exit(1)


def warm(
    experiment: ExperimentArgument,
    policy: DrivenByOption = None,
    map_file: Annotated[
        str | None, typer.Option("--map", metavar="MAP", help="Use this map, not that of the file.")
    ] = None,
    chunk: ChunkOption = None,
) -> None:
    """Compile the programs of an experiment now; sweeps of any number of seeds then start at once."""
    from concurrent.futures import ThreadPoolExecutor, as_completed

    from limsim_jax.files import cache_directory
    from limsim_jax.sweeps.runner import COMPILERS

    if chunk is not None and chunk < 1:
        raise typer.BadParameter(f"{chunk}; at least 1", param_hint="--chunk")
    begin = time.perf_counter()
    made = build(experiments_of(experiment, map_file, policy), chunk)
    with ThreadPoolExecutor(COMPILERS) as pool:
        jobs = {pool.submit(one.compile): one for one in made}
        for job in as_completed(jobs):
            job.result()
            one = jobs[job]
            print(f"{one.scenario} / {one.policy}: ready after {time.perf_counter() - begin:.0f} s")
    print(f"programs are kept in {cache_directory()}")


def report(
    results: ResultsArgument,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Page to write.  [default: RESULTS/report.html]")
    ] = None,
    worst: Annotated[int, typer.Option(min=0, help="Worst episodes to show with pictures and replays.")] = 6,
    csv: Annotated[Path | None, typer.Option(metavar="DIR", help="Write the tables as CSV, too.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Print the main metrics with intervals, and write the report.

    The report is a page with plots and the worst episodes."""
    opened, table = _print_headline(results)
    if csv is not None:
        from limsim_jax.report.tables import write_csv

        for path in write_csv(opened, csv, table=table):
            print(f"wrote {path}")
    _write_json(json_file, table)
    _write_report(opened, table, results / "report.html" if out is None else out, worst)


def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Results.")],
    b: Annotated[
        Path | None, typer.Argument(metavar="[B]", help="Other results; without, two policies of A.")
    ] = None,
    policies: Annotated[
        str | None, typer.Option(metavar="P,Q", help="Compare policy P of A with Q of B.")
    ] = None,
    rows: Annotated[
        int | None,
        typer.Option(min=1, help="Print so many rows: main metrics, then by evidence; absent: main metrics."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="Write all rows as CSV.")] = None,
    json_file: JsonOption = None,
) -> None:
    """Compare B with A seed by seed: equal seeds are equal traffic."""
    from limsim_jax.report.compare import compare as compare_results
    from limsim_jax.report.compare import comparison_text
    from limsim_jax.sweeps.store import open_results

    pair: tuple[str, str] | None = None
    if policies is not None:
        first, comma, second = policies.partition(",")
        if not (first and comma and second) or "," in second:
            raise typer.BadParameter(f"'{policies}'; as like_traffic,mine", param_hint="--policies")
        pair = first, second
    found = compare_results(open_results(a), None if b is None else open_results(b), policies=pair)
    _print_table(comparison_text(found, rows))
    if csv is not None:
        from pyarrow import csv as writer

        writer.write_csv(found.table, csv)
        print(f"wrote {csv}")
    _write_json(json_file, found.table)


def verify(
    results: ResultsArgument,
    sample: Annotated[int, typer.Option(min=1, help="Worlds of each scenario to run again.")] = 16,
    seed: Annotated[int, typer.Option(help="Of the choice.")] = 0,
) -> None:
    """Run a sample of stored worlds again and compare them.

    Every number and the final state must be equal."""
    from limsim_jax.api.results import rebuild
    from limsim_jax.sweeps.runner import verify as verify_results
    from limsim_jax.sweeps.store import open_results

    opened = open_results(results)
    groups = list(opened.provenance)
    found = verify_results(opened, [rebuild(opened, *group) for group in groups], sample, seed)
    for line in found.differences:
        print(f"made differently: {line}")
    for miss in found.mismatches:
        print(f"differs: {miss.scenario}/{miss.policy} seed {miss.seed}: {miss.what}")
    print(f"{found.checked} worlds run again, {len(found.mismatches)} differ")
    if not found.ok:
        raise typer.Exit(1)


def replay(
    results: ResultsArgument,
    seed: Annotated[int, typer.Option(help="Which world.")],
    scenario: ScenarioOption = None,
    policy: PolicyOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write .html (viewer), .gif or .mp4 (video), .png (worst moment), .parquet, .npz (steps)."
            "  [default: RESULTS/replays/SCENARIO-POLICY-SEED.html]",
        ),
    ] = None,
    at: Annotated[
        float | None, typer.Option(help="Moment of a picture, s.  [default: the worst one]")
    ] = None,
    begin: Annotated[float | None, typer.Option("--from", help="First moment of a video, s.")] = None,
    end: Annotated[float | None, typer.Option("--to", help="Last moment of a video, s.")] = None,
    follow: Annotated[
        int | None, typer.Option(help="Vehicle that the camera follows, by its slot.  [default: the ego]")
    ] = None,
    bounds: Annotated[
        str | None, typer.Option(metavar="X0,Y0,X1,Y1", help="A fixed view of this area instead, m.")
    ] = None,
    sensors: Annotated[
        Literal["six", "front", "one", "own"] | None,
        typer.Option(
            help="Show what the ego senses beside the traffic: six, front (three) or one camera with LiDAR, "
            "bird's-eye view and object list; own: the sensors of the policy. A frame per decision, at most "
            "240 in an episode, in about 1 MB."
        ),
    ] = None,
) -> None:
    """Run one world of the results again and show it."""
    from limsim_jax.api.results import rebuild
    from limsim_jax.api.sensed import check_sensors, watch
    from limsim_jax.api.world import World
    from limsim_jax.sweeps.answers import recall
    from limsim_jax.sweeps.store import open_results

    opened = open_results(results)
    group = _group(opened, scenario, policy)
    path = results / "replays" / f"{group[0]}-{group[1]}-{seed}.html" if out is None else out
    if path.suffix not in (".html", ".gif", ".mp4", ".png", ".parquet", ".npz"):
        raise typer.BadParameter(
            f"'{path}': use .html, .gif, .mp4, .png, .parquet or .npz", param_hint="--out"
        )
    _check_seed(seed)
    moving, still = path.suffix in (".gif", ".mp4"), path.suffix == ".png"
    options = {
        "--at": (at, still), "--from": (begin, moving), "--to": (end, moving),
        "--follow": (follow, still or moving), "--bounds": (bounds, still or moving),
        "--sensors": (sensors, still or moving or path.suffix == ".html"),
    }  # fmt: skip
    for name, (value, fits) in options.items():
        if value is not None and not fits:
            raise typer.BadParameter(f"not for {path.suffix} files", param_hint=name)
    area = None if bounds is None else window(bounds)
    if area is not None and follow is not None:
        raise typer.BadParameter(
            "a view is fixed or follows a vehicle; leave out --follow", param_hint="--bounds"
        )
    stored = _known(opened, group, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    episodes = rebuild(opened, *group)
    if sensors is not None:
        if not episodes.egos:
            raise typer.BadParameter(f"'{group[0]}' has no ego", param_hint="--sensors")
        check_sensors(episodes, sensors)
    recall(episodes, results, [seed])
    world = World.run(episodes, seed)
    for row in world.moments:
        value = "" if math.isnan(row["value"]) else f", {row['value']:.2f}"
        value += f": {row['reason']}" if row.get("reason") else ""
        who = f", responsible: {row['responsible']}" if row["responsible"] else ""
        able = [name for name in ("ego", "other") if row.get(f"avoidable_by_{name}")]
        saved = f", had braked in time, would have avoided it: {' or '.join(able)}" if able else ""
        module = f", avoided by a reference {row['module']} module" if row.get("module") else ""
        print(f"{row['time']:6.1f} s  {row['kind']}{value}{who}{saved}{module}")
    _tell_differences(world.metrics, stored)
    given: dict[str, Any] = {"at": at, "begin": begin, "end": end, "follow": follow, "bounds": area}
    if sensors is not None:
        given["sensors"] = film = watch(world, sensors)
        print(f"{film!r}, one every {film.spacing:g} s")
    world.save(path, **{name: value for name, value in given.items() if value is not None})
    print(f"wrote {path}")


def export(
    results: ResultsArgument,
    seed: Annotated[int, typer.Option(help="Which world.")],
    to: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT",
            help="parquet (long table), fcd (SUMO), commonroad, openscenario or carla.  [default: by FILE]",
        ),
    ] = None,
    scenario: ScenarioOption = None,
    policy: PolicyOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File to write.  [default: RESULTS/exports/SCENARIO-POLICY-SEED...]"
        ),
    ] = None,
    every: Annotated[
        float | None, typer.Option(help="Time between moments, s.  [default: every time step]")
    ] = None,
) -> None:
    """Run one world again and write its trajectories for other tools."""
    from limsim_jax.api.results import rebuild
    from limsim_jax.api.world import World
    from limsim_jax.bridges.formats.export import FORMATS, format_of
    from limsim_jax.bridges.formats.export import export as write
    from limsim_jax.files import check_writable
    from limsim_jax.sweeps.answers import recall
    from limsim_jax.sweeps.store import open_results

    if to is None and out is None:
        raise typer.BadParameter(f"name one of {', '.join(FORMATS)}", param_hint="--to")
    name = format_of(out, to)
    _check_seed(seed)
    if every is not None and not every > 0:
        raise typer.BadParameter(f"{every:g} s; more than 0 is expected", param_hint="--every")
    opened = open_results(results)
    group = _group(opened, scenario, policy)
    path = results / "exports" / f"{group[0]}-{group[1]}-{seed}{FORMATS[name]}" if out is None else out
    path.parent.mkdir(parents=True, exist_ok=True)
    check_writable(path)
    stored = _known(opened, group, seed)
    worlds = rebuild(opened, *group)
    recall(worlds, results, [seed])
    world = World.run(worlds, seed, explain=False)
    _tell_differences(world.metrics, stored)
    print(f"wrote {write(world, path, name, every=every)}")


def reflect(
    results: ResultsArgument,
    memory: Annotated[Path, typer.Option(metavar="FILE", help="Memories, made or added to (JSON Lines).")],
    last: Annotated[int, typer.Option(min=1, help="Decisions before a failure to look at.")] = 3,
    scenario: ScenarioOption = None,
    policy: PolicyOption = None,
) -> None:
    """Let a language model look back at its failures on even seeds.

    What it learns goes into a file for the option memory of its next sweep (--odd-seeds)."""
    from limsim_jax.api.results import rebuild
    from limsim_jax.files import check_writable
    from limsim_jax.sweeps.reflect import reflect as look_back
    from limsim_jax.sweeps.store import open_results

    check_writable(memory)
    opened = open_results(results)
    group = _group(opened, scenario, policy)
    drivers = rebuild(opened, *group).notes.drivers
    if not drivers:
        raise typer.BadParameter(f"{group[0]} ({group[1]}) has no language model", param_hint="--policy")
    drivers[0].chat.check()
    learnt = look_back(opened, drivers[0], memory, scenario=group[0], policy=group[1], last=last, say=print)
    print(f"wrote {memory}: {len(learnt)} memories")


# --- helpers -----------------------------------------------------------------------------------------


def build(
    experiments: Sequence[ExperimentFile], chunk: int | None = None, cores: int | None = None
) -> list[Episodes]:
    """Episodes of experiments, on all cores or so many."""
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.xla import use_all_cores

    use_all_cores(cores, spare=any(one.asks_host for one in experiments))
    return [Episodes(one, chunk=chunk) for one in experiments]


def _refuse(options: Mapping[str, Any], message: str) -> None:
    """Refuse options that are given; None: not given."""
    for name, value in options.items():
        if value is not None:
            raise typer.BadParameter(message, param_hint=name)


def _sumo_episodes(
    config: str,
    policy: str | None,
    ego: str | None,
    egos: int | None,
    horizon: float | None,
    drivers: Literal["sumo", "ours"] | None,
    chunk: int | None,
) -> Any:
    """The worlds of a `.sumocfg` that SUMO runs."""
    from limsim_jax.bridges.sumo.world import HORIZON, SumoWorld

    return SumoWorld(
        config,
        policy="limsim_tm" if policy is None else policy,
        ego=None if ego is None else ego.split(","),
        egos=1 if egos is None else egos,
        horizon=HORIZON if horizon is None else horizon,
        drivers="sumo" if drivers is None else drivers,
        chunk=chunk,
    ).episodes


def _group(results: Results, scenario: str | None, policy: str | None) -> tuple[str, str]:
    """The one scenario and policy that are meant."""
    groups = list(results.provenance)
    fits = [(s, p) for s, p in groups if scenario in (None, s) and policy in (None, p)]
    if len(fits) != 1:
        known = ", ".join(f"{s} ({p})" for s, p in groups)
        wanted = "name one with --scenario and --policy" if fits else "there is no such one"
        raise typer.BadParameter(f"{wanted}; the results hold {known}", param_hint="--scenario")
    return fits[0]


def _stored(results: Results, group: tuple[str, str], seed: int) -> dict[str, Any] | None:
    """The row of a seed, if there is one."""
    import pyarrow.compute as pc

    table = results.episodes
    wanted = (
        (pc.field("scenario") == group[0]) & (pc.field("policy") == group[1]) & (pc.field("seed") == seed)
    )
    rows = table.filter(wanted).to_pylist()
    return rows[0] if rows else None


def _known(results: Results, group: tuple[str, str], seed: int) -> dict[str, Any] | None:
    """The row of a seed; a note if there is none."""
    found = _stored(results, group, seed)
    if found is None:
        print(f"note: the results hold no seed {seed} of {group[0]} ({group[1]}); it is run now")
    return found


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**31:
        raise typer.BadParameter(f"{seed}; it has to be within 0 and 2^31 - 1", param_hint="--seed")


def _tell_differences(metrics: Mapping[str, float], stored: Mapping[str, Any] | None) -> None:
    """A note if a world is not the one that is stored."""
    from limsim_jax.metrics.answers import METERED

    compared = [] if stored is None else [name for name in metrics if name not in METERED]
    differs = [name for name in compared if stored and not _alike(metrics[name], stored[name])]
    if differs:
        print(f"note: not the episode that is stored: {', '.join(differs[:3])} differ; 'verify' may tell why")


def _alike(value: float, stored: float | None) -> bool:
    """Equal but for rounding: a program that keeps every step may round otherwise."""
    return math.isnan(value) if stored is None else math.isclose(value, stored, rel_tol=1e-3, abs_tol=1e-4)


def _shard(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    first, slash, second = text.partition("/")
    if not (slash and first.isdecimal() and second.isdecimal()) or int(first) >= int(second):
        raise typer.BadParameter(
            f"'{text}' is not I/N with I below N; the four parts of a sweep are 0/4, 1/4, 2/4 and 3/4",
            param_hint="--shard",
        )
    return int(first), int(second)


def _until(text: str | None) -> tuple[float, str] | None:
    if text is None:
        return None
    width, _, metric = text.partition(":")
    try:
        return float(width), metric or "success"
    except ValueError:
        raise typer.BadParameter(f"'{text}'; as 0.02 or 0.5:mean_speed", param_hint="--until-ci") from None


def _print_headline(path: Path) -> tuple[Results, pa.Table]:
    """Print it; the results and their summary."""
    from limsim_jax.report.tables import headline, summary
    from limsim_jax.sweeps.store import open_results

    results = open_results(path)
    table = summary(results)
    _print_table(headline(results, table=table))
    return results, table


def _write_json(path: Path | None, table: pa.Table) -> None:
    if path is not None:
        path.write_text(json.dumps(table.to_pylist(), indent=1) + "\n")
        print(f"wrote {path}")


def _print_table(table: TextTable) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console()
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate(table.header):
        shown.add_column(name, justify="left" if k == 0 else "right", no_wrap=k == 0)
    for row in table.rows:
        shown.add_row(*row)
    if not console.is_terminal:
        console.width = 200
    console.print(shown)
    for note in table.notes:
        print(note)


def _import_report() -> None:
    from limsim_jax.report.page import get_ready

    get_ready()


def _write_report(
    results: Results,
    table: pa.Table,
    path: Path,
    worst: int,
    seconds: float = math.inf,
    made: Sequence[Episodes] = (),
) -> None:
    """`made`: worlds that are compiled already."""
    from limsim_jax.api.results import rebuild
    from limsim_jax.report.page import write_report
    from limsim_jax.sweeps.answers import recall

    known = {(one.scenario, one.policy): one for one in made}

    def again(scenario: str, policy: str, seeds: Sequence[int]) -> Sequence[tuple[Any, ...]]:
        group = scenario, policy
        episodes = known[group] if group in known else rebuild(results, *group)
        recall(episodes, results.path, seeds)
        return episodes.replays([(seed, 0) for seed in seeds], brief=True)

    write_report(results, path, replayer=again, worst=worst, seconds=seconds, say=print, table=table)
    print(f"wrote {path}")
