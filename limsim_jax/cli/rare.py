"""What `sweep --estimate` does, and the commands triage, sensitivity, adversary, exposure."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from limsim_jax.cli.common import (
    ChunkOption,
    DrivenByOption,
    ExperimentArgument,
    JsonOption,
    experiments_of,
    table,
    write_json,
)
from limsim_jax.cli.results import PolicyOption, ResultsArgument, ScenarioOption

if TYPE_CHECKING:
    from limsim_jax.sweeps.experiment import ExperimentFile

REPLAYS = 3
"""Worlds with the event that are written as replays."""


def estimate(
    experiments: Sequence[ExperimentFile],
    event: str,
    folder: Path,
    method: Any,
    budget: int | None,
    least: float | None,
    chunk: int | None,
    fresh: bool,
    replays: bool,
    json_file: Path | None,
) -> None:
    """Estimate the probability of an event, print it, and write replays."""
    from limsim_jax.api.estimate import estimate as run
    from limsim_jax.api.experiment import Experiment
    from limsim_jax.files import check_writable

    experiment = Experiment(_one(experiments, "--estimate"))
    check_writable(json_file)
    begin = time.perf_counter()
    told = {"method": method, "worlds": budget, "least": least}
    options: dict[str, Any] = {name: value for name, value in told.items() if value is not None}
    found = run(experiment, event, out=folder, chunk=chunk, fresh=fresh, **options)
    table(found.rows(), f"{found.scenario}, {found.policy}: {found.event.name}")
    if json_file is not None:
        write_json(json_file, found.as_json())
        print(f"wrote {json_file}")
    if replays:
        for k in found.telling(REPLAYS):
            path = found.replay(k).save(folder / "replays" / f"failure-{k}.html")
            print(f"wrote {path}")
    print(f"{found.worlds:,} worlds in {time.perf_counter() - begin:.0f} s, kept in {folder}")


def triage(
    results: ResultsArgument,
    scenario: ScenarioOption = None,
    policy: PolicyOption = None,
    most: Annotated[int, typer.Option(min=0, help="Groups whose representative is changed and shown.")] = 8,
    change: Annotated[
        bool, typer.Option("--change/--no-change", help="Look for what makes failures go away.")
    ] = True,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Page to write.  [default: RESULTS/triage.html]")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Group failures of a sweep by what happened.

    One of each group is changed until it does not happen: what it hangs on."""
    from limsim_jax.api.results import open_results
    from limsim_jax.api.triage import triage as run
    from limsim_jax.files import check_writable
    from limsim_jax.report.triage import HEAD, rows_of

    opened = open_results(results)
    for name, known, told in (
        ("--scenario", opened.scenarios, scenario), ("--policy", opened.policies, policy)
    ):  # fmt: skip
        if told is not None and told not in known:
            message = f"'{told}' is not there; there are {', '.join(known)}"
            raise typer.BadParameter(message, param_hint=name)
    page = results / "triage.html" if out is None else out
    check_writable(json_file, page)
    found = run(opened, scenario=scenario, policy=policy, most=most, change=change, page=page)
    if not found:
        print("no episode failed")
    else:
        table(rows_of(found), head=HEAD)
    if json_file is not None:
        write_json(json_file, [
            {
                "scenario": x.cluster.scenario, "policy": x.cluster.policy, "kind": x.cluster.kind,
                "what": x.cluster.words, "episodes": len(x.cluster.members),
                "share": x.cluster.share._asdict(), "representative": x.cluster.typical.seed,
                "seeds": [member.seed for member in x.cluster.members], "change": x.change,
            }
            for x in found
        ])  # fmt: skip
        print(f"wrote {json_file}")
    print(f"wrote {page}")


def sensitivity(
    experiment: ExperimentArgument,
    policy: DrivenByOption = None,
    metrics: Annotated[
        str | None, typer.Option(metavar="A,B", help="Metrics.  [default: contacts, times, speeds]")
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="Seeds of the traffic; each costs a world per parameter, and two.")
    ] = 40,
    chunk: ChunkOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Page to write.  [default: results/NAME-sensitivity.html]"),
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Say on which assumption about the other drivers a result hangs."""
    from limsim_jax.api.experiment import Experiment
    from limsim_jax.api.triage import sensitivity as run
    from limsim_jax.files import check_writable

    one = _one(experiments_of(experiment, policy=policy), "EXPERIMENT")
    page = Path("results") / f"{one.name}-sensitivity.html" if out is None else out
    page.parent.mkdir(parents=True, exist_ok=True)
    check_writable(json_file, page)
    wanted = None if metrics is None else [name.strip() for name in metrics.split(",")]
    found = run(Experiment(one), metrics=wanted, seeds=seeds, chunk=chunk, page=page)
    print(found)
    if json_file is not None:
        write_json(json_file, found.as_json())
        print(f"wrote {json_file}")
    print(f"wrote {page}")


def adversary(
    experiment: ExperimentArgument,
    policy: DrivenByOption = None,
    event: Annotated[
        str, typer.Option(metavar="EVENT", help="What is looked for: contact, fault, or as min_ttc<1.")
    ] = "contact",
    reference: Annotated[
        str, typer.Option(metavar="NAME", help="Policy that drives the failures as well, or none.")
    ] = "pdm_closed_rules",
    budget: Annotated[int, typer.Option(help="Worlds in all, at most.")] = 2000,
    starts: Annotated[int, typer.Option(help="Searches side by side.")] = 4,
    most: Annotated[int, typer.Option(help="Failures after which the search ends.")] = 5,
    least_plausible: Annotated[
        float, typer.Option(help="Share of random worlds that are as unusual as a failure, at least.")
    ] = 0.01,
    seed: Annotated[int, typer.Option(help="The first plain world, and the seed of the searches.")] = 0,
    chunk: ChunkOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder to write.  [default: results/NAME-adversary]"),
    ] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Remove what is there of this search, and start anew.")
    ] = False,
    replays: Annotated[
        bool, typer.Option("--replays/--no-replays", help="Write replays of up to three failures.")
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Search for plausible worlds in which a policy fails. It gives no probability."""
    from limsim_jax.api.adversary import adversary as run
    from limsim_jax.api.experiment import Experiment
    from limsim_jax.files import check_writable

    if chunk is not None and chunk < 1:
        raise typer.BadParameter(f"{chunk}; at least 1", param_hint="--chunk")
    one = _one(experiments_of(experiment, policy=policy), "EXPERIMENT")
    check_writable(json_file)
    folder = Path("results") / f"{one.name}-adversary" if out is None else out
    begin = time.perf_counter()
    found = run(
        Experiment(one), event, reference=None if reference == "none" else reference, worlds=budget,
        starts=starts, most=most, least_plausible=least_plausible, seed=seed, out=folder, chunk=chunk,
        fresh=fresh,
    )  # fmt: skip
    table(found.rows(), f"{found.scenario}, {found.policy}: {found.event.name}")
    if json_file is not None:
        write_json(json_file, found.as_json())
        print(f"wrote {json_file}")
    if replays:
        for k in range(min(REPLAYS, len(found.failures))):
            path = found.replay(k).save(folder / "replays" / f"failure-{k}.html")
            print(f"wrote {path}")
    print(f"{found.worlds.total:,} worlds in {time.perf_counter() - begin:.0f} s, kept in {folder}")


def exposure(
    experiment: ExperimentArgument,
    policy: DrivenByOption = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many worlds: seeds 0, 1, 2, ...")] = 50,
    dimensions: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="Of speed, gap, ttc, manoeuvre, road.  [default: all]"),
    ] = None,
    edges: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=X,Y", help="Edges of the bins of a dimension, m/s, m or s; may be repeated."
        ),
    ] = None,
    search: Annotated[
        int, typer.Option(min=0, help="Further seeds, at most, that look for cells not covered.")
    ] = 0,
    replays: Annotated[
        int, typer.Option(min=0, help="Worlds with rare cells that are written as replays.")
    ] = REPLAYS,
    chunk: ChunkOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder to write to.  [default: results/NAME-exposure]"),
    ] = None,
) -> None:
    """Say how long the ego is in which situations.

    Situations are bins of speed, gap, TTC, manoeuvre and road. It lists those that are not covered."""
    from limsim_jax.api.experiment import Experiment
    from limsim_jax.api.exposure import exposure as run
    from limsim_jax.api.exposure import write
    from limsim_jax.files import check_writable
    from limsim_jax.metrics.domain import domain_of

    one = _one(experiments_of(experiment, policy=policy), "EXPERIMENT")
    names = None if dimensions is None else [name.strip() for name in dimensions.split(",")]
    bins = _edges(edges or [])
    domain_of(names, bins)
    folder = Path("results") / f"{one.name}-exposure" if out is None else out
    folder.mkdir(parents=True, exist_ok=True)
    check_writable(folder / "exposure.json", folder / "exposure.html")
    begin = time.perf_counter()
    found = run(Experiment(one), seeds=seeds, dimensions=names, edges=bins, search=search, chunk=chunk)
    print(found)
    page = write(found, folder, replays=replays)
    more = 0 if found.more is None else len(found.more.seeds)
    print(f"{len(found.seeds) + more:,} worlds in {time.perf_counter() - begin:.0f} s")
    for path in (folder / "exposure.json", page):
        print(f"wrote {path}")


def _edges(options: Sequence[str]) -> dict[str, list[float]]:
    """NAME=X,Y as numbers by name."""
    found = {}
    for text in options:
        name, sign, numbers = text.partition("=")
        try:
            found[name.strip()] = [float(x) for x in numbers.split(",")]
        except ValueError:
            sign = ""
        if not sign:
            raise typer.BadParameter(f"'{text}'; NAME=X,Y is expected, as gap=5,20,50", param_hint="--edges")
    return found


def _one(experiments: Sequence[ExperimentFile], hint: str) -> ExperimentFile:
    """The only experiment; `hint` is the parameter that several do not go with."""
    if len(experiments) != 1:
        names = ", ".join(one.name for one in experiments)
        raise typer.BadParameter(f"one experiment at a time, not {names}", param_hint=hint)
    return experiments[0]


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module."""
    for command in (triage, sensitivity, adversary, exposure):
        app.command()(command)
