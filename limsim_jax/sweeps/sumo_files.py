"""The files that an experiment with SUMO's vehicles names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from limsim_jax.maps.sumo.config import read_sumocfg

CONFIG = ".sumocfg"


class Inputs(NamedTuple):
    """What files of demand name."""

    files: tuple[Path, ...]
    """Of routes, vehicles and programs of lights."""
    network: Path | None = None
    begin: float | None = None  # s
    end: float | None = None  # s


def inputs(names: Sequence[str | Path]) -> Inputs:
    """The files; a `.sumocfg` stands for those that it names.

    Raises:
      MapError: a `.sumocfg` that cannot be used; one line.
    """
    files: list[Path] = []
    network = begin = end = None
    for name in map(Path, names):
        if name.suffix != CONFIG:
            files.append(name)
            continue
        found = read_sumocfg(name)
        files += [*found.additional, *found.routes]  # in SUMO's order
        network, begin, end = found.network, found.begin, found.end
    return Inputs(tuple(files), network, begin, end)


def resolved(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The fields of an experiment, its demand seen from a folder; without a map that of the `.sumocfg`."""
    found, traffic = dict(table), table.get("traffic")
    if not isinstance(traffic, Mapping) or not traffic.get("demand"):
        return found
    names = traffic["demand"]
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return found  # is refused as every other field
    there = [folder / name if (folder / name).exists() else Path(name) for name in names]
    found["traffic"] = dict(traffic) | {"demand": [str(path.resolve()) for path in there]}
    config = next((path for path in there if path.suffix == CONFIG), None)
    if "map" not in found and config is not None:
        found["map"] = str(inputs([config]).network)
    return found
