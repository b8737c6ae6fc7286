"""Commands about scenario files: check, the library, and sweeps over their variants."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from limsim_jax.cli.common import JsonOption, table, write_json

if TYPE_CHECKING:
    from limsim_jax.scenarios.library.catalogue import Entry
    from limsim_jax.sweeps.runner import Progress

RootOption = Annotated[
    Path | None,
    typer.Option("--root", metavar="DIR", help="Catalogs may lie in this folder.  [default: that of FILE]"),
]
LenientOption = Annotated[
    bool, typer.Option("--lenient", help="List what is not supported, and leave it out.")
]


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(check)
    app.command()(library)


def check(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Scenario or distribution, OpenSCENARIO XML (.xosc), or the name of one of the library.",
        ),
    ],
    root: RootOption = None,
    lenient: LenientOption = False,
    json_file: JsonOption = None,
) -> None:
    """Say what is in a scenario, and what is left out."""
    from limsim_jax.scenarios.openscenario.scenario import openscenario

    found = openscenario(file, lenient=lenient, root=root)
    first = found.scenario()
    if json_file is not None:
        write_json(
            json_file,
            {
                "file": str(file),
                "version": ".".join(map(str, first.version)),
                "map": first.map_file,
                "ego": first.ego,
                "entities": {x.name: x.category for x in first.entities},
                "parameters": first.parameters,
                "varies": list(found.variants.names),
                "product": found.variants.product,
                "variants": len(found),
                "notes": list(found.notes),
            },
        )
    print(found)


def library(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Entry to tell about.  [default: a table of all]")
    ] = None,
    tag: Annotated[
        list[str] | None, typer.Option(metavar="TAG", help="Entries with this tag; of several, with all.")
    ] = None,
    search: Annotated[str, typer.Option(metavar="WORDS", help="Entries with these words.")] = "",
    json_file: JsonOption = None,
) -> None:
    """Show the scenario library: what happens, parameters, and what reference drivers make of it."""
    from limsim_jax.scenarios.library.catalogue import drivers, entry, tags
    from limsim_jax.scenarios.library.catalogue import library as entries

    if name is not None:
        if tag or search:
            raise typer.BadParameter("an entry, or a choice by --tag and --search", param_hint="NAME")
        found = entry(name)
        print(found)
        if json_file is not None:
            write_json(json_file, _as_json(found))
        return
    chosen = entries(*(tag or ()), search=search)
    if json_file is not None:
        write_json(json_file, [_as_json(x) for x in chosen])
    if not chosen:
        print("no entry has all of that")
        return
    table(chosen.rows(), head=("name", "variants", *drivers(), "what happens"), wide=True)
    print(f"columns of drivers: how many of a sample of variants passed. Tell about one: {_COMMAND} NAME")
    for kind, some in tags().items():
        print(f"--tag, {kind}: {', '.join(some)}")


_COMMAND = "limsim-jax library"


def _as_json(one: Entry) -> dict[str, Any]:
    """All that is known of an entry, as plain values."""
    return {
        "name": one.name,
        "kind": one.kind,
        "title": one.title,
        "tags": list(one.tags),
        "licence": one.licence,
        "file": None if one.path is None else str(one.path),
        "map": None if one.map_file is None else str(one.map_file),
        "variants": one.variants,
        "parameters": [x._asdict() | {"values": list(x.values)} for x in one.parameters],
        "outcomes": [x._asdict() for x in one.outcomes],
        "address": one.address,
        "command": one.command,
    }


def is_scenario(name: str) -> bool:
    """Whether an argument names scenarios: files, folders, or of the library."""
    from limsim_jax.scenarios.library.catalogue import scenario_file

    path = Path(name)
    is_file = path.suffix.lower() == ".xosc" or (path.is_dir() and any(path.glob("*.xosc")))
    return is_file or scenario_file(name) is not None


def files_of(path: Path) -> list[Path]:
    """The files to run: of a folder its distributions, or its scenarios if it has none."""
    files = sorted(path.glob("*.xosc")) if path.is_dir() else []
    if not files:
        return [path]
    varied = [x for x in files if b"ParameterValueDistribution" in x.read_bytes()]
    return varied or files


def sweep_scenarios(
    path: Path,
    policy: str | None,
    *,
    out: Path | None,
    variants: int | None,
    override: str | None,
    chunk: int | None,
    shard: tuple[int, int] | None,
    on_error: Literal["record", "stop"],
    fresh: bool,
    horizon: float | None,
    root: Path | None,
    lenient: bool,
    controlled: bool,
    preventable: bool,
) -> None:
    """Run all variants of a scenario, or of those in a folder.

    `preventable`: also under the careful driver of UN R157."""
    import time

    from limsim_jax.api.progress import progress_bar
    from limsim_jax.scenarios.openscenario.episodes import HORIZON, episodes_of
    from limsim_jax.scenarios.openscenario.outcome import CAREFUL
    from limsim_jax.scenarios.openscenario.scenario import openscenario
    from limsim_jax.sweeps import runner
    from limsim_jax.xla import use_all_cores

    use_all_cores()
    length = HORIZON if horizon is None else horizon
    if not 0 < length < 1e5:
        raise typer.BadParameter(f"{length:g} s; it has to be above 0", param_hint="--horizon")
    driver = None if policy == "script" else policy
    drivers = [driver, CAREFUL] if preventable and driver != CAREFUL else [driver]
    options: dict[str, Any] = {"horizon": length, "chunk": chunk, "controlled": controlled}
    made = []
    for file in files_of(path):
        found = openscenario(file, lenient=lenient, root=root)
        for note in found.notes:
            print(f"{found.name}: {note}")
        for one in drivers:
            made += episodes_of(found, one, override=override, variants=variants, **options)
    folder = Path("results") / path.stem if out is None else out
    begin, ran = time.perf_counter(), 0
    with progress_bar() as show:

        def tell(now: Progress) -> None:
            if show is not None:
                show(now)

        for one in made:
            summary = runner.sweep(
                [one], range(len(one.which)), folder, shard=shard, progress=tell, on_error=on_error,
                fresh=fresh,
            )  # fmt: skip
            ran += sum(part.ran for part in summary.parts)
    print(f"{ran} worlds run in {time.perf_counter() - begin:.0f} s, results in {folder}")
    if shard is None:
        print_outcome(folder)


def print_outcome(folder: Path) -> None:
    """Print how the variants of each scenario ended."""
    from limsim_jax.scenarios.openscenario.outcome import CAREFUL, outcome, totals
    from limsim_jax.sweeps.store import open_results

    found = outcome(open_results(folder))
    if len({x.scenario for x in found}) > 1:
        found += totals(found)
    lines = [["" if x is None else str(x) for x in row] for row in found]
    table(lines, head=("scenario", "policy", "variants", "passed", "collided", "preventable"), wide=True)
    if any(x.preventable is not None for x in found):
        print(f"preventable: collisions in variants in which {CAREFUL} has none")
    print(f"where variants pass, and the worst of them: limsim-jax report {shlex.quote(str(folder))}")
