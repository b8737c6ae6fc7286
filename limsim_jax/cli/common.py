"""What several commands share: arguments, tables, windows, JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from limsim_jax.maps.network import Network
    from limsim_jax.sweeps.experiment import ExperimentFile

MapArgument = Annotated[
    str, typer.Argument(metavar="FILE", help="Map file, gzipped or not, or the name of a bundled map.")
]
ExperimentArgument = Annotated[
    str,
    typer.Argument(
        metavar="EXPERIMENT", help="Experiment file (.toml, .sumocfg), or the name of a bundled one."
    ),
]
JsonOption = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON.")]
DrivenByOption = Annotated[
    str | None, typer.Option(metavar="NAME", help="Drive the ego by this policy instead.")
]
ChunkOption = Annotated[int | None, typer.Option(help="Worlds per call.  [default: as memory allows]")]
NoCacheOption = Annotated[bool, typer.Option("--no-cache", help="Read the map file itself; leave no trace.")]


def table(
    lines: Sequence[Sequence[str]],
    title: str | None = None,
    head: Sequence[str] = (),
    *,
    wide: bool = False,
) -> None:
    """Print rows of cells, such as names and values.

    `wide`: a line each, even if it is longer than 80 letters; not on a terminal."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(*head, show_header=bool(head), box=None, pad_edge=False)
    for cells in lines:
        table.add_row(*(Text(cell) for cell in cells))
    console = Console()
    if wide and not console.is_terminal:
        console.width = 200
    if title is not None:
        console.print(Text(title, style="bold"))
    console.print(table)


def path(file: str) -> Path:
    """The file, or the bundled map of this name."""
    from limsim_jax.maps import bundled_map

    return path if (path := Path(file)).is_file() or len(path.parts) > 1 else bundled_map(file)


def load(file: str, no_cache: bool) -> Network:
    """Read a map."""
    from limsim_jax.maps import read_network

    return read_network(path(file), cache=not no_cache)


def experiments_of(name: str, map_file: str | None = None, policy: str | None = None) -> list[ExperimentFile]:
    """The experiments of a file, or of a name; one that is not known may be in the scenario library."""
    from limsim_jax.scenarios.library.catalogue import no_experiment
    from limsim_jax.sweeps.experiment import ExperimentError, read_experiments

    if message := no_experiment(name):
        raise ExperimentError(message)
    return read_experiments(name, map_file=map_file, policy=policy)


def window(text: str) -> tuple[float, float, float, float]:
    """X0,Y0,X1,Y1 as four numbers."""
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"'{text}' is not four numbers X0,Y0,X1,Y1", param_hint="--bounds") from None
    return x0, y0, x1, y1


def write_json(path: Path, value: Any) -> None:
    """Write plain values."""
    path.write_text(json.dumps(value, indent=1) + "\n")
