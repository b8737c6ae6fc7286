"""`Experiment`: which map, which traffic, which ego, for how long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from limsim_jax.api.map import Map, load_map
from limsim_jax.maps import bundled_maps
from limsim_jax.maps.network import MapError, Network
from limsim_jax.scenarios.library.catalogue import no_experiment
from limsim_jax.sweeps import experiment as _file
from limsim_jax.sweeps.experiment import (
    ActionTable,
    EgoTable,
    ExperimentError,
    ExperimentFile,
    FlowTable,
    ObstacleTable,
    VehicleTable,
    ZoneTable,
    first_fault,
    read_experiments,
)
from limsim_jax.traffic.human import HumanDriver

if TYPE_CHECKING:
    from limsim_jax.api.world import World
    from limsim_jax.metrics.measure import Metric
    from limsim_jax.policies.base import PolicyLike
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.traffic.car_following import CarFollowing
    from limsim_jax.traffic.vehicles import Population

_ABSENT: Any = type("Absent", (), {"__repr__": lambda _: "..."})()


class _Named:
    """A table that names itself where a field is wrong."""

    def __init__(self, **fields: Any) -> None:
        try:
            super().__init__(**fields)
        except ValidationError as error:
            raise ExperimentError(f"{type(self).__name__}: {first_fault(error)}") from None


class Flow(_Named, FlowTable):
    """Vehicles that come in: `lj.Flow(rate=400, origin="1-", goal="3+")`; rate in veh/h of each origin."""


class Ego(_Named, EgoTable):
    """A vehicle under test: `lj.Ego(start="1-", goal="3+")`; without a start it is drawn in every world."""


class Vehicle(_Named, VehicleTable):
    """A vehicle with a place, and actions, of its own: `lj.Vehicle(start="1-", s=80.0, action=[...])`."""


class Action(_Named, ActionTable):
    """An order to a vehicle: `lj.Action(at=5.0, brake=4.0)`, `lj.Action(within=30.0, leave=True)`."""


class Obstacle(_Named, ObstacleTable):
    """A body that stands on a lane: `lj.Obstacle(start="1-", lane=1, s=300.0)`."""


class Zone(_Named, ZoneTable):
    """A place with closed lanes, another limit or friction: `lj.Zone(where="3", speed_limit=8.3)`."""


class Experiment:
    """An experiment: a bundled one, a TOML file, a `.sumocfg`, or one that is built from keywords.

        lj.Experiment("roundabout")
        lj.Experiment("mine.toml", horizon=60, policy=lj.PDMClosed())
        lj.Experiment(map="Town05.xodr", horizon=300, flows=[lj.Flow(rate=400)], ego=None)
        lj.Experiment("morning.sumocfg")

    Keywords replace fields of the file. Every field is checked at once; nothing is compiled before it runs.

    Args:
      source: name of a bundled experiment, a TOML file or a `.sumocfg`; None: keywords only, of which `map`
        and `horizon` are needed.
      map: a `Map`, the name of a bundled map, or a map file.
      name: of letters, digits, `_` and `-`; by default that of the file or the map.
      horizon: s.
      ego: an `Ego`, several, or None for plain traffic.
      policy: drives the egos: a value such as `PDMClosed()`, or a name.
      flows: `Flow`s that come in.
      vehicles: on the road at the start.
      placed: `Vehicle`s with a place, and actions, of their own.
      obstacles: `Obstacle`s on the road.
      zones: `Zone`s with closed lanes, other limits or friction.
      density: instead of that, vehicles per km of lane at the start.
      demand: vehicles of SUMO instead of all these: a `.sumocfg`, or files of routes, trips and flows.
      begin: time of SUMO's files at which the episode starts, s.
      mix: shares of vehicle classes.
      drivers: a `Population`, or the file of one.
      model: car-following model: "acc", "iidm", "idm", or a value such as `IDM()`.
      human: reaction time and errors of the drivers: a `HumanDriver`, or True for the usual one.
      lane_changes: whether the traffic changes lanes.
      after_collision: "stop", "continue" or "end".
      success: metric to value or bounds, as `{"contacts": 0, "mean_speed": {"min": 8}}`.
      metrics: own metrics (`Metric`), as more columns.
      slots: vehicles that can be on the road at once.
      dt: s, physics step.
      decision_every: physics steps per decision.
      description: text.

    Raises:
      ExperimentError: one line that names the field.
      MapError: one line about the map file.
    """

    def __init__(
        self,
        source: str | Path | ExperimentFile | None = None,
        *,
        map: Map | Network | str | Path | None = None,
        name: str | None = None,
        horizon: float | None = None,
        ego: EgoTable | Sequence[EgoTable] | None = _ABSENT,
        policy: PolicyLike | str | None = None,
        flows: Sequence[FlowTable] | None = None,
        vehicles: int | None = None,
        placed: Sequence[VehicleTable] | None = None,
        obstacles: Sequence[ObstacleTable] | None = None,
        zones: Sequence[ZoneTable] | None = None,
        density: float | None = None,
        demand: str | Path | Sequence[str | Path] | None = None,
        begin: float | None = None,
        mix: Mapping[str, float] | None = None,
        drivers: Population | str | Path | None = None,
        model: CarFollowing | str | None = None,
        human: HumanDriver | bool | None = None,
        lane_changes: bool | None = None,
        after_collision: str | None = None,
        success: Mapping[str, Any] | None = None,
        metrics: Sequence[Metric] = (),
        slots: int | None = None,
        dt: float | None = None,
        decision_every: int | None = None,
        description: str | None = None,
    ) -> None:
        table = _table(source)
        fields = {
            "name": name, "horizon": _number(horizon), "slots": slots, "dt": _number(dt),
            "decision_every": decision_every, "description": description,
            "vehicle": None if placed is None else list(placed),
            "obstacle": None if obstacles is None else list(obstacles),
            "zone": None if zones is None else list(zones),
        }  # fmt: skip
        traffic = {
            "flow": None if flows is None else list(flows), "vehicles": vehicles, "density": _number(density),
            "mix": None if mix is None else {k: float(x) for k, x in mix.items()},
            "demand": None if demand is None else _paths(demand), "begin": _number(begin),
            "lane_changes": lane_changes, "after_collision": after_collision,
            "drivers": str(drivers) if isinstance(drivers, str | Path) else None,
            "model": model if isinstance(model, str) else None,
            "human": asdict(human) if isinstance(human, HumanDriver) else human,
        }  # fmt: skip
        given = {key: value for key, value in traffic.items() if value is not None}
        merged = {**dict(table.get("traffic", {})), **given}
        if vehicles is not None and density is None:
            merged.pop("density", None)
        if density is not None and vehicles is None:
            merged.pop("vehicles", None)
        table |= {key: value for key, value in fields.items() if value is not None}
        if merged:
            table["traffic"] = merged
        if ego is not _ABSENT:
            table["ego"] = False if ego is None else ego
        if success is not None:
            table["success"] = dict(success)
        if isinstance(policy, str):
            table["ego"] = _file.with_policy(table.get("ego", {}), policy, table.get("name", "experiment"))
        self._town = _town(map)
        if self._town is not None:
            table["map"] = self._town.source if self._town.name not in bundled_maps() else self._town.name
        elif isinstance(map, str | Path):
            table["map"] = str(map)
        table = _file.with_demand(table, Path(), table.get("name", "Experiment"))
        if "name" not in table and "map" in table:
            table["name"] = _file.name_of(Path(table["map"]))
        self.file = _checked(table)
        self.policy = None if isinstance(policy, str) else policy
        self.drivers = None if isinstance(drivers, str | Path) else drivers
        self.model = None if isinstance(model, str) else model
        self.metrics = tuple(metrics)
        if self.policy is not None and not self.file.ego:
            raise ExperimentError(f"{self.name}: policy: there is no ego that it could drive")

    @property
    def name(self) -> str:
        """Of the experiment, in results."""
        return self.file.name

    @cached_property
    def map(self) -> Map:
        """Where it happens."""
        return self._town or load_map(self.file.map)

    def episodes(
        self,
        policy: PolicyLike | str | None = None,
        *,
        chunk: int | None = None,
        metrics: Sequence[Metric] = (),
    ) -> Episodes:
        """The worlds of this experiment under a policy."""
        from limsim_jax.policies.base import policy_name
        from limsim_jax.sweeps.episode import Episodes

        file = self.file
        if isinstance(policy, str):
            file, policy = self._with_name(policy), None
        elif policy is None:
            policy = self.policy
        if policy is not None and not file.ego:
            raise ExperimentError(f"{self.name}: policy: there is no ego that it could drive")
        return Episodes(
            file,
            chunk=chunk,
            policy=policy,
            name=None if policy is None else policy_name(policy),
            town=self._town,
            drivers=self.drivers,
            model=self.model,
            metrics=(*self.metrics, *metrics),
        )

    def _with_name(self, policy: str) -> ExperimentFile:
        found = self.file.model_dump() | {"map": self.file.map}
        egos = [dict(ego) for ego in found["ego"]] if isinstance(found["ego"], list) else found["ego"]
        return _checked(found | {"ego": _file.with_policy(egos, policy, self.name)})

    @cached_property
    def _own(self) -> dict[str, Episodes]:
        return {}

    def run(self, seed: int = 0, *, policy: PolicyLike | str | None = None, ego: int = 0) -> World:
        """Run one world and keep every step.

        Args:
          seed: of the world: the same traffic for every policy.
          policy: drives the egos instead of the experiment's own policy.
          ego: whose metrics and key moments the world shows.
        """
        from limsim_jax.api.world import World

        key = repr(policy)
        if key not in self._own:
            self._own[key] = self.episodes(policy, chunk=1)
        return World.run(self._own[key], seed, ego)

    def __repr__(self) -> str:
        file = self.file
        egos = "no ego" if not file.ego else f"{len(file.ego)} ego{'s' if len(file.ego) > 1 else ''}"
        return f"Experiment '{self.name}': map {file.map}, {file.horizon:g} s, {egos}, {file.slots} slots"


def load_experiments(
    source: str | Path | Experiment | Sequence[str | Path | Experiment],
) -> list[Experiment]:
    """All experiments of a name, a file or a list: "paper" is five.

    Raises:
      ExperimentError: one line with the file and the field.
    """
    if isinstance(source, Experiment):
        return [source]
    if isinstance(source, str | Path):
        if message := no_experiment(source):
            raise ExperimentError(message)
        return [Experiment(file) for file in read_experiments(source)]
    return [experiment for one in source for experiment in load_experiments(one)]


def _table(source: str | Path | ExperimentFile | None) -> dict[str, Any]:
    """The fields of a file, or of nothing, before keywords replace some."""
    if source is None:
        return {}
    if isinstance(source, ExperimentFile):
        return source.model_dump()
    if isinstance(source, Map | Network) or str(source).endswith((".xodr", ".net.xml", ".gz")):
        raise ExperimentError(f"Experiment: {source} is a map; write map=...")
    found = read_experiments(source)
    if len(found) != 1:
        names = ", ".join(x.name for x in found)
        raise ExperimentError(f"{source}: is {len(found)} experiments ({names}); name one, or sweep them all")
    return found[0].model_dump()


def _town(map: Map | Network | str | Path | None) -> Map | None:
    if isinstance(map, Map | Network):
        return load_map(map)
    if map is None:
        return None
    try:
        return load_map(map)
    except MapError as error:
        raise ExperimentError(f"map: {error}") from None


def _checked(table: Mapping[str, Any]) -> ExperimentFile:
    try:
        return ExperimentFile.model_validate(table)
    except ValidationError as error:
        raise ExperimentError(f"{table.get('name', 'Experiment')}: {first_fault(error)}") from None


def _paths(files: str | Path | Sequence[str | Path]) -> list[str]:
    return [str(file) for file in ([files] if isinstance(files, str | Path) else files)]


def _number(x: float | None) -> float | None:
    """A number of the caller as the float that files have."""
    return float(x) if isinstance(x, int) and not isinstance(x, bool) else x


def one_experiment(experiment: Experiment | str | Path, do: str) -> Experiment:
    """The only experiment.

    Raises:
      ValueError: there are several, to `do` one by one.
      ExperimentError: it cannot be read.
    """
    experiments = load_experiments(experiment)
    if len(experiments) != 1:
        raise ValueError(f"experiment: {len(experiments)} scenarios at once; {do} them one by one")
    return experiments[0]


__all__ = [
    "Action",
    "Ego",
    "Experiment",
    "Flow",
    "Obstacle",
    "Vehicle",
    "Zone",
    "load_experiments",
    "one_experiment",
]
