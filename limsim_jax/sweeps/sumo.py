"""SUMO's vehicles as the traffic of an experiment."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from limsim_jax.maps.map import Map, load_map
from limsim_jax.maps.network import MapError
from limsim_jax.maps.sumo import read_demand
from limsim_jax.maps.sumo.reader import read_sumo
from limsim_jax.maps.sumo.records import Demand
from limsim_jax.maps.xml import read_bytes
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile, name_of
from limsim_jax.sweeps.sumo_files import inputs
from limsim_jax.traffic.demand.sumo import SumoDemand

AFTERWARDS = 600.0
"""s that an episode goes on after the last departure, where SUMO would wait for the last vehicle."""

ROOM = 2.0
"""Slots per vehicle that is expected at once at half the limits: queues at lights need more."""


def experiment_of(path: Path) -> dict[str, Any]:
    """A `.sumocfg` as the fields of an experiment without an ego.

    The horizon reaches to the end of the configuration, or `AFTERWARDS` s beyond the last departure. Slots
    are `ROOM` times the vehicles that are on the road at once at half the limits.

    Raises:
      MapError: a file cannot be used.
      ExperimentError: vehicles depart for ever; one line.
    """
    given = inputs([path])
    begin = given.begin or 0.0
    end = given.end
    if end is None:
        demand = read_demand(given.files)
        end = max(_departures(demand, path), default=begin) + AFTERWARDS
    table: dict[str, Any] = {
        "name": name_of(path),
        "map": str(given.network),
        "horizon": float(end - begin),
        "ego": False,
        "traffic": {"demand": [str(path.resolve())]},
    }
    if not end > begin:
        raise ExperimentError(f"{path}: ends at {end:g} s, but begins at {begin:g} s")
    plain = ExperimentFile.model_validate(table)
    found = sumo_of(plain, with_lights(plain, load_map(plain.map)))
    assert found is not None
    return table | {"slots": min(max(math.ceil(ROOM * found.at_once()), 64), 4096)}


def _departures(demand: Demand, path: Path) -> list[float]:
    """Last departures of vehicles and flows, s."""
    times = [v.depart for v in demand.vehicles.values() if not isinstance(v.depart, str)]
    for name, flow in demand.flows.items():
        if flow.end is not None:
            times.append(flow.end)
        elif flow.number is not None and (flow.period or flow.vehicles_per_hour):
            times.append(flow.begin + flow.number * (flow.period or 3600 / (flow.vehicles_per_hour or 1)))
        else:
            raise ExperimentError(f"{path}: flow {name} emits vehicles without end; give the file an <end>")
    return [x for x in times if math.isfinite(x)]


def with_lights(experiment: ExperimentFile, town: Map) -> Map:
    """The map with the programs of lights that the demand brings.

    Raises:
      ExperimentError: a file that cannot be used; one line.
    """
    if not town.source.endswith((".net.xml", ".net.xml.gz")):
        return town
    with _named(experiment):
        programs = [path for path in files_of(experiment) if b"<tlLogic" in read_bytes(path)]
        return replace(town, network=read_sumo(town.source, programs)) if programs else town


def sumo_of(experiment: ExperimentFile, town: Map) -> SumoDemand | None:
    """The demand that the experiment names, on its map; None if it names none.

    Raises:
      ExperimentError: a file that cannot be used, or does not fit the map; one line.
    """
    if not experiment.traffic.demand:
        return None
    wanted = experiment.traffic.begin
    with _named(experiment):
        given = inputs(experiment.traffic.demand)
        return SumoDemand(
            town.network, town.lanes, read_demand(given.files, town.network),
            seconds=experiment.horizon, begin=given.begin if wanted is None else wanted,
        )  # fmt: skip


def files_of(experiment: ExperimentFile) -> tuple[Path, ...]:
    """The files of demand that the rows depend on."""
    return inputs(experiment.traffic.demand).files


@contextmanager
def _named(experiment: ExperimentFile) -> Iterator[None]:
    """Errors name the experiment and the field."""
    try:
        yield
    except (MapError, ValueError) as error:
        raise ExperimentError(f"{experiment.name}: traffic.demand: {error}") from None
