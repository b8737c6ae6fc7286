"""Experiment files: which traffic, which ego, which policy, for how long.

A TOML file describes one `ExperimentFile`, or names others: `experiments = ["highway.toml", "ramp.toml"]`.
Whatever is wrong is one line that names the file and the field.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    ValidationError,
    field_serializer,
    field_validator,
    model_validator,
)

from limsim_jax.maps.network import MapError
from limsim_jax.policies.view import view_of
from limsim_jax.sweeps.script_file import (
    ActionTable,
    NotNegative,
    ObstacleTable,
    PlacedTable,
    Positive,
    Table,
    VehicleTable,
    ZoneTable,
    one_or_more,
)
from limsim_jax.sweeps.sumo_files import CONFIG, resolved
from limsim_jax.traffic.collision import AfterCollision
from limsim_jax.traffic.human import HumanDriver

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=60)]

_PACKAGE = Path(__file__).resolve().parents[1]


_OF_POLICY = "policy", "options", "view", "privileged"

NO_POLICY = "traffic"
"""Name of the policy in results without an ego."""


class ExperimentError(ValueError):
    """An experiment cannot be run as it stands; one line that names file and field."""


def _names(found: Any) -> Any:
    return [found] if isinstance(found, str) else found


class FlowTable(Table):
    """Vehicles that come in: see `traffic.demand.Flow`."""

    origin: str | list[str] = "*"
    """Names of `limsim_jax.origins`, road or lane ids; "*": every origin of the map that leads to a goal."""
    rate: NotNegative
    """Vehicles per hour, of each origin."""
    goal: str | dict[str, float] | None = None
    pattern: Literal["poisson", "uniform", "platoon"] = "poisson"
    begin: NotNegative = 0.0
    """s"""
    end: Positive | None = None
    """s"""
    speed: NotNegative | None = None
    """m/s"""
    classes: dict[str, float] | None = None
    platoon: Annotated[int, Field(ge=1)] = 5
    headway: Positive = 2.0
    """s"""


class HumanTable(Table):
    """Drivers with a reaction time and errors. Absent, they see everything at once and exactly."""

    reaction: NotNegative = HumanDriver.reaction
    """s; the acceleration follows from what was seen that long ago"""
    anticipates: bool = HumanDriver.anticipates
    """A driver counts on its own acceleration and on an even speed of its leader meanwhile."""
    vehicles_ahead: Annotated[int, Field(ge=1)] = HumanDriver.vehicles_ahead
    """Vehicles that a driver looks at."""
    gap_error: NotNegative = HumanDriver.gap_error
    """Relative standard deviation of the gap that a driver sees."""
    approach_error: NotNegative = HumanDriver.approach_error
    """1/s; standard deviation of the leader's speed that a driver sees, per metre of gap"""
    error_time: Positive = HumanDriver.error_time
    """s; for how long errors last"""
    noise: NotNegative = HumanDriver.noise
    """m^2/s^3; intensity of a random acceleration"""


def _with_defaults(found: Any) -> Any:
    if isinstance(found, bool):
        return {} if found else None
    if not isinstance(found, dict | HumanTable | None):
        raise ValueError(
            f"true, or a table of numbers such as reaction = {HumanDriver.reaction}; not {found!r}"
        )
    return found


class TrafficTable(Table):
    """All vehicles but the egos."""

    vehicles: Annotated[int, Field(ge=0)] | None = None
    """On the road at the start, the ego not counted unless its start is random."""
    density: NotNegative = 0.0
    """Instead of that, vehicles per km of lane at the start."""
    flow: Annotated[list[FlowTable], BeforeValidator(one_or_more)] = Field(default_factory=list)
    demand: Annotated[list[str], BeforeValidator(_names)] = Field(default_factory=list)
    """Vehicles of SUMO instead of all that: a `.sumocfg`, or files of routes, trips and flows, seen from the
    experiment file."""
    begin: NotNegative | None = None
    """Time of SUMO's files at which the episode starts, s; absent: as the `.sumocfg` says, or the first
    departure."""
    mix: dict[str, NotNegative] | None = None
    """Shares of vehicle classes."""
    drivers: str | None = None
    """A file of drivers that `limsim-jax calibrate` wrote, seen from the experiment file."""
    model: Literal["idm", "iidm", "acc"] = "acc"
    human: Annotated[HumanTable | None, BeforeValidator(_with_defaults)] = None
    """Reaction time and errors of all drivers on lanes; `true` for the usual ones."""
    lane_changes: bool = True
    after_collision: AfterCollision = "stop"

    @model_validator(mode="after")
    def _one_number(self) -> TrafficTable:
        if self.vehicles is not None and self.density:
            raise ValueError("vehicles or density, not both")
        return self

    @model_validator(mode="after")
    def _one_source(self) -> TrafficTable:
        others = "vehicles", "density", "flow", "mix", "drivers"
        if self.demand and (given := [name for name in others if getattr(self, name)]):
            raise ValueError(f"demand brings vehicles and drivers of its own; leave {', '.join(given)} out")
        if self.begin is not None and not self.demand:
            raise ValueError("begin is a time of SUMO's files; there is no demand")
        return self


class EgoTable(PlacedTable):
    """The vehicle under test."""

    start: str = "random"
    """An entry of the map, a road or lane id; "random": the place and goal of some vehicle at the start."""
    goal: str | None = None
    """Where it goes: a way out of the map or a lane id. Not with a random start."""
    policy: str = "like_traffic"
    """One of `limsim_jax.policies`, or "package.module:factory" of your own."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Arguments of the policy."""
    view: dict[str, Any] = Field(default_factory=dict)
    """What the policy sees: fields of `policies.view.View`."""
    privileged: bool | None = None
    """Whether the policy gets the true state instead of a view; absent: as the policy says."""

    @model_validator(mode="after")
    def _goal_belongs_to_start(self) -> EgoTable:
        goes = self.goal is not None or bool(self.route)
        if (self.start == "random") == goes:
            raise ValueError(
                "an ego with a random start has no goal of its own" if goes else "a goal is missing"
            )
        return self

    @field_validator("view")
    @classmethod
    def _can_be_seen(cls, found: dict[str, Any]) -> dict[str, Any]:
        view_of(found)
        return found


class Bounds(Table):
    """What a metric must keep to."""

    min: float | None = None
    max: float | None = None


class ExperimentFile(Table):
    """One experiment. `Field`s have the units that their descriptions say."""

    name: Name
    map: str
    """Name of a bundled map, or a file, seen from the experiment file."""
    horizon: Positive
    """s"""
    description: str = ""
    dt: Annotated[float, Field(gt=0, le=0.5)] = 0.1
    """s, physics step."""
    decision_every: Annotated[int, Field(ge=1)] = 5
    """Physics steps per decision."""
    slots: Annotated[int, Field(ge=1, le=4096)] = 64
    """Vehicles that can be on the road at once."""
    traffic: TrafficTable = TrafficTable()
    ego: tuple[EgoTable, ...] = (EgoTable(),)
    """The vehicle under test, several as `[[ego]]`, or none: `ego = false`."""
    vehicle: Annotated[list[VehicleTable], BeforeValidator(one_or_more)] = Field(default_factory=list)
    """Vehicles with a place, and actions, of their own."""
    obstacle: Annotated[list[ObstacleTable], BeforeValidator(one_or_more)] = Field(default_factory=list)
    """Bodies that stand on lanes."""
    zone: Annotated[list[ZoneTable], BeforeValidator(one_or_more)] = Field(default_factory=list)
    """Closed lanes, and speed limits and friction that differ from the map's."""
    success: dict[str, bool | int | float | Bounds] = Field(default_factory=dict)
    """What counts as success: metrics with the value or the bounds they must keep; absent: to arrive
    without a contact and without leaving the road."""

    @field_validator("ego", mode="before")
    @classmethod
    def _as_tuple(cls, found: Any) -> Any:
        if found is False or found is None:
            return ()
        return tuple(found) if isinstance(found, list | tuple) else (found,)

    @field_serializer("ego")
    def _as_written(self, egos: tuple[EgoTable, ...]) -> Any:
        plain = [ego.model_dump(mode="json") for ego in egos]
        return plain[0] if len(plain) == 1 else plain or False

    @property
    def policy(self) -> str:
        """Name of the policy or policies, fit for a folder."""
        names = dict.fromkeys(ego.policy.rpartition(":")[2] for ego in self.ego)
        return "-and-".join(names) or NO_POLICY

    @property
    def one_policy(self) -> bool:
        """Whether all egos have the same policy with the same options."""
        return all(
            getattr(ego, name) == getattr(self.ego[0], name) for ego in self.ego[1:] for name in _OF_POLICY
        )

    @property
    def asks_host(self) -> bool:
        """Whether worlds may call functions outside JAX while they run.

        Policies of one's own may, and `language`; so does a demand of SUMO."""
        named = [word for ego in self.ego for word in _words([ego.policy, ego.options])]
        return bool(self.traffic.demand) or any(":" in word or word == "language" for word in named)


def _words(tree: Any) -> Iterator[str]:
    """All texts of a tree of plain values; of what is not plain, ":"."""
    if isinstance(tree, Mapping | list | tuple):
        for x in tree.values() if isinstance(tree, Mapping) else tree:
            yield from _words(x)
    elif not isinstance(tree, bool | int | float | None):
        yield tree if isinstance(tree, str) else ":"


def bundled_experiments() -> dict[str, Path]:
    """The experiments that come with the package: name to path."""
    installed, checkout = _PACKAGE / "_bundled", _PACKAGE.parent / "experiments"
    folder = installed if installed.is_dir() else checkout
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def read_experiments(
    path: str | Path, *, map_file: str | None = None, policy: str | None = None
) -> list[ExperimentFile]:
    """Read an experiment file, or the name of a bundled one.

    Args:
      path: of the file.
      map_file: another map than that of the file.
      policy: another policy than that of the file, without the file's options for that.

    Raises:
      ExperimentError: with the file and the field.
    """
    path = Path(path)
    if not path.is_file() and path.name == str(path):  # a folder of results may have the name of one
        known = bundled_experiments()
        if path.stem not in known:
            raise ExperimentError(
                f"{path}: no such file, and no bundled experiment either; bundled are {', '.join(known)}"
            )
        path = known[path.stem]
    if path.suffix == CONFIG:
        return [_of_sumo(path, map_file, policy)]
    try:
        found = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ExperimentError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ExperimentError(f"{path}: not a text file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise ExperimentError(f"{path}: not valid TOML: {error}") from None
    if "experiments" in found:
        others = found["experiments"]
        if set(found) - {"experiments", "description"}:
            extra = ", ".join(sorted(set(found) - {"experiments", "description"}))
            raise ExperimentError(
                f"{path}: next to 'experiments' there can be a description only, not {extra}"
            )
        if not isinstance(others, list) or not others or not all(isinstance(x, str) for x in others):
            raise ExperimentError(f'{path}: experiments: a list of file names, as ["highway.toml"]')
        nested = [read_experiments(path.parent / other, map_file=map_file, policy=policy) for other in others]
        experiments = [experiment for some in nested for experiment in some]
        names = [experiment.name for experiment in experiments]
        for name in names:
            if names.count(name) > 1:
                raise ExperimentError(f"{path}: two experiments are named '{name}'")
        return experiments
    return [_experiment(found, path, map_file, policy)]


def _of_sumo(path: Path, map_file: str | None, policy: str | None) -> ExperimentFile:
    from limsim_jax.sweeps.sumo import experiment_of

    try:
        return _experiment(experiment_of(path), path, map_file, policy)
    except MapError as error:
        raise ExperimentError(str(error)) from None


def _experiment(
    found: Mapping[str, Any], path: Path, map_file: str | None, policy: str | None
) -> ExperimentFile:
    found = {"name": path.stem, **found}
    if map_file is not None:
        found["map"] = map_file
    elif isinstance(found.get("map"), str) and (path.parent / found["map"]).exists():
        found["map"] = str(path.parent / found["map"])
    found = with_demand(found, path.parent, path)
    traffic = found.get("traffic")
    if isinstance(traffic, dict) and isinstance(traffic.get("drivers"), str):
        drivers = path.parent / traffic["drivers"]
        if drivers.exists():
            found["traffic"] = traffic | {"drivers": str(drivers.resolve())}
    if policy is not None:
        found["ego"] = with_policy(found.get("ego", {}), policy, path)
    try:
        return ExperimentFile.model_validate(found)
    except ValidationError as error:
        raise ExperimentError(f"{path}: {first_fault(error)}") from None


def with_demand(table: Mapping[str, Any], folder: Path, where: str | Path) -> dict[str, Any]:
    """The fields of an experiment, its demand seen from a folder."""
    try:
        return resolved(table, folder)
    except MapError as error:
        raise ExperimentError(f"{where}: traffic.demand: {error}") from None


def name_of(path: Path) -> str:
    """A file's name as that of an experiment."""
    return re.sub(r"[^A-Za-z0-9_-]", "_", path.stem)


def with_policy(ego: Any, policy: str, where: str | Path) -> Any:
    """The table or tables of egos with another policy."""
    if isinstance(ego, list):
        return [with_policy(one, policy, where) for one in ego]
    if ego is False:
        raise ExperimentError(f"{where}: ego: there is none that policy '{policy}' could drive")
    if not isinstance(ego, dict):
        return ego
    if policy != ego.get("policy", EgoTable.model_fields["policy"].default):
        ego = {name: value for name, value in ego.items() if name != "options"}  # of the other policy
    return ego | {"policy": policy}


def first_fault(error: ValidationError) -> str:
    """The first thing that is wrong, in the file's words."""
    errors = error.errors()
    # a name that is mistyped is also missing: the culprit is what stands there
    first = min(errors, key=lambda fault: fault["type"] != "extra_forbidden")
    parts = [part for part in first["loc"] if not _is_branch(part)]
    if parts[:2] == ["ego", 0]:  # written as one table
        parts = ["ego", *parts[2:]]
    where = ".".join(map(str, parts))
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        message = "no such field"
        known = _fields_at(first["loc"][:-1])
        if known:
            message += f"; known are {', '.join(known)}"
    elif first["type"] != "missing" and first["type"] != "value_error":
        message += f", not {first['input']!r}"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{where}: {message}{more}" if where else f"{message}{more}"


def _is_branch(part: Any) -> bool:
    """Names that pydantic gives to the members of a union."""
    return isinstance(part, str) and ("[" in part or part in ("str", "float", "int", "bool", "Bounds"))


def _fields_at(where: tuple[Any, ...]) -> list[str]:
    tables: dict[tuple[str, ...], type[BaseModel]] = {
        (): ExperimentFile,
        ("ego",): EgoTable,
        ("traffic",): TrafficTable,
        ("traffic", "flow"): FlowTable,
        ("traffic", "human"): HumanTable,
        ("vehicle",): VehicleTable,
        ("vehicle", "action"): ActionTable,
        ("obstacle",): ObstacleTable,
        ("zone",): ZoneTable,
    }
    table = tables.get(tuple(part for part in where if isinstance(part, str)))
    return list(table.model_fields) if table else []
