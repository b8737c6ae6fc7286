"""Commands about scenarios of other tools: check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from limsim_jax.cli.common import JsonOption, write_json

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


def check(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="Scenario or distribution, OpenSCENARIO XML (.xosc).")
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
