"""From the words of an experiment file to what runs.

What does not fit the map, or names something that is not there, is an `ExperimentError` of one line.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from limsim_jax.maps import bundled_maps
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.map import Map, load_map
from limsim_jax.maps.network import MapError, Network
from limsim_jax.maps.origins import leading, origins, road_origins
from limsim_jax.maps.routing import default_goals
from limsim_jax.policies import POLICIES
from limsim_jax.policies.base import PolicyLike, build_policy, seeing
from limsim_jax.policies.several import Several
from limsim_jax.policies.view import view_of
from limsim_jax.sweeps.experiment import EgoTable, ExperimentError, ExperimentFile
from limsim_jax.sweeps.places import placed, vehicles_of
from limsim_jax.sweeps.sumo import with_lights
from limsim_jax.traffic import car_following
from limsim_jax.traffic.demand import Demand, EgoStart, Flow, build_demand
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.human import HumanDriver
from limsim_jax.traffic.population_file import read_population
from limsim_jax.traffic.vehicles import (
    URBAN,
    Population,
    default_population,
    restrict_to_map,
)

MODELS: dict[str, Callable[[], Any]] = {
    "idm": car_following.IDM,
    "iidm": car_following.IIDM,
    "acc": car_following.ACC,
}
"""Car-following models by their names in experiment files."""

_FAR_TOO_FAST = 1.5  # times the highest limit, above which a speed is probably in km/h

ROADS_OF_A_CLOSED_MAP = 12
"""Roads, at most, on which traffic comes into a map without origins."""


def policy_of(experiment: ExperimentFile) -> PolicyLike:
    """The policy that the file names, with its options; of egos that differ in it, `Several`."""
    egos, name = experiment.ego, experiment.name
    if not egos:
        return POLICIES["like_traffic"]()
    if experiment.one_policy:
        return _policy(name, "ego", egos[0])
    policies = tuple(_policy(name, f"ego.{k}", ego) for k, ego in enumerate(egos))
    try:
        return Several(policies)
    except ValueError as error:
        raise ExperimentError(f"{name}: ego.policy: {error}") from None


def _policy(experiment: str, field: str, ego: EgoTable) -> PolicyLike:
    name, where = ego.policy, f"{experiment}: {field}.policy"
    if ":" in name:
        factory = _own(name, where)
    elif name in POLICIES:
        factory = POLICIES[name]
    else:
        raise ExperimentError(
            f"{where}: unknown policy '{name}'; known are {', '.join(POLICIES)}, or module:factory"
        )
    try:
        policy = build_policy(factory, ego.options)
    except (TypeError, ValueError) as error:
        raise ExperimentError(f"{experiment}: {field}.options: {error}") from None
    if not isinstance(getattr(policy, "free", None), bool):
        raise ExperimentError(f"{where}: '{name}' is no policy; see limsim_jax.policies.base.Policy")
    return with_view(ego, policy)


def with_view(ego: EgoTable, policy: PolicyLike) -> PolicyLike:
    """The policy with the view that the file gives to its ego."""
    if ego.view or ego.privileged is not None:
        view = view_of(ego.view) if ego.view else None
        return seeing(policy, view=view, privileged=ego.privileged)
    return policy


def _own(name: str, where: str) -> Callable[..., PolicyLike]:
    """A factory by module and name; modules of the current folder are found, too."""
    module, _, attribute = name.partition(":")
    here = os.getcwd()
    added = here not in sys.path and "" not in sys.path
    if added:
        sys.path.append(here)
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ExperimentError(
            f"{where}: '{name}' cannot be loaded: {error}; looked in the Python path and in {here}"
        ) from None
    finally:
        if added:
            sys.path.remove(here)


def map_of(experiment: ExperimentFile, town: Map | None = None) -> Map:
    """The map with the named goals and the lights of SUMO's demand."""
    if town is None:
        try:
            town = load_map(bundled_maps().get(experiment.map, experiment.map))
        except MapError as error:
            known = ", ".join(bundled_maps())
            hint = "" if os.path.exists(experiment.map) else f"; bundled maps are {known}"
            raise ExperimentError(f"{experiment.name}: map: {error}{hint}") from None
    named = *experiment.ego, *experiment.vehicle
    wanted = [x.goal for x in named if x.goal]
    for flow in experiment.traffic.flow:
        wanted += [flow.goal] if isinstance(flow.goal, str) else list(flow.goal or ())
    return with_lights(experiment, town).with_goals(wanted, [x.route for x in named if x.route])


def egos_of(experiment: ExperimentFile, town: Map, policy: PolicyLike) -> EgoStart | None:
    """Where the egos start and what they are; None without one."""
    tables, name = experiment.ego, experiment.name
    if not tables:
        return None
    driver, shape = vehicles_of(f"{name}: ego", tables)
    speeds = [ego.v for ego in tables]
    if any(v is None for v in speeds) and any(v is not None for v in speeds):
        raise ExperimentError(f"{name}: ego.v: {len(tables)} egos need a speed each, or none has one")
    v = None if speeds[0] is None else jnp.asarray(speeds, jnp.float32)
    free = policy.frees if isinstance(policy, Several) else [policy.free] * len(tables)
    common = {"driver": driver, "shape": shape, "v": v, "free": jnp.asarray(free)}
    if all(ego.start == "random" for ego in tables):
        return EgoStart(**common)
    if any(ego.start == "random" for ego in tables):
        raise ExperimentError(f"{name}: ego.start: {len(tables)} egos need a start each, or all are random")
    return EgoStart(**placed(f"{name}: ego", tables, shape, town), **common)


def doubts(experiment: ExperimentFile, town: Map) -> list[str]:
    """What runs but is hardly meant, a line each: speeds far above every limit of the map."""
    limit = max(lane.speed_limit for lane in town.network.drivable_lanes())
    flows = enumerate(experiment.traffic.flow)
    speeds = [("ego.v", ego.v) for ego in experiment.ego]
    speeds += [(f"vehicle.{k}.v", x.v) for k, x in enumerate(experiment.vehicle)]
    speeds += [
        (f"vehicle.{k}.action.{i}.speed", action.speed)
        for k, x in enumerate(experiment.vehicle)
        for i, action in enumerate(x.action)
    ]
    speeds += [(f"zone.{k}.speed_limit", x.speed_limit) for k, x in enumerate(experiment.zone)]
    speeds += [(f"traffic.flow.{k}.speed", flow.speed) for k, flow in flows]
    return [
        f"{experiment.name}: {field}: {v:g} m/s, but the highest limit of the map is {limit:.1f} m/s; "
        f"{v:g} km/h are {v / 3.6:.1f} m/s"
        for field, v in dict(speeds).items()
        if v is not None and v > _FAR_TOO_FAST * limit
    ]


def population_of(experiment: ExperimentFile, drivers: Population | None = None) -> Population:
    """The drivers of the traffic: these, those of the file that is named, or the default ones."""
    traffic = experiment.traffic
    if drivers is not None:
        return drivers
    shares = URBAN if traffic.mix is None else traffic.mix
    return default_population(shares) if traffic.drivers is None else read_population(traffic.drivers, shares)


def flows_of(experiment: ExperimentFile, town: Map) -> list[Flow]:
    """The flows of the file.

    "*" stands for all origins from which a goal can be reached, on a closed map for a dozen of its roads.
    """
    inside = road_origins(town.network, ROADS_OF_A_CLOSED_MAP) if not experiment.ego else []
    reachable = np.asarray(town.lanes.routes.reachable)
    found = []
    for flow in experiment.traffic.flow:
        goals = [flow.goal] if isinstance(flow.goal, str) else list(flow.goal or town.exits)
        columns = [k for k, name in enumerate(town.goals) if name in goals]
        every = leading(town.network, town.origins, reachable[:, columns]) or inside
        for origin in every if flow.origin == "*" else [flow.origin]:
            fields: dict[str, Any] = flow.model_dump() | {"origin": origin}
            found.append(Flow(**fields))
    return found


def demand_of(
    experiment: ExperimentFile,
    town: Map,
    egos: EgoStart | None,
    drivers: Population | None = None,
    placed: EgoStart | None = None,
) -> Demand:
    """The vehicles of the start and those that come later."""
    traffic = experiment.traffic
    try:
        population = restrict_to_map(population_of(experiment, drivers), town.lanes)
        return build_demand(
            town.network, town.lanes, town.goals, flows_of(experiment, town), population,
            horizon=experiment.horizon, density=traffic.density, vehicles=traffic.vehicles,
            egos=egos, placed=placed, common=town.exits,
        )  # fmt: skip
    except ValueError as error:
        raise ExperimentError(f"{experiment.name}: traffic: {error}") from None


def plain_origins(network: Network, lane_map: LaneMap) -> list[str]:
    """Origins from which a goal can be reached; on a closed map a dozen of its roads."""
    ways = leading(network, origins(network), np.asarray(lane_map.routes.reachable))
    return ways or road_origins(network, ROADS_OF_A_CLOSED_MAP)


def plain_demand(
    network: Network, lane_map: LaneMap, *, rate: float, vehicles: int, seconds: float
) -> tuple[Demand, int]:
    """Plain traffic: the default drivers that fit the map, from all origins to all goals.

    On a map without origins traffic comes in at the starts of a dozen of its roads.

    Args:
      network: the map.
      lane_map: of that map, with the default goals.
      rate: veh/h per origin.
      vehicles: on the road at the start.
      seconds: for how long others come.

    Returns:
      The demand, and the number of origins.

    Raises:
      ValueError: numbers out of range, or more vehicles than the roads hold.
    """
    names = plain_origins(network, lane_map)
    flows = [Flow(origin=name, rate=rate) for name in names]
    population = restrict_to_map(default_population(), lane_map)
    demand = build_demand(
        network, lane_map, default_goals(network), flows, population, horizon=seconds, vehicles=vehicles
    )
    return demand, len(names)


def traffic_of(experiment: ExperimentFile, model: Any = None) -> Traffic:
    """How the traffic drives; `model` replaces the car-following model of the file."""
    traffic = experiment.traffic
    try:
        human = None if traffic.human is None else HumanDriver(**traffic.human.model_dump())
    except ValueError as error:
        raise ExperimentError(f"{experiment.name}: traffic.human.{error}") from None
    return Traffic(
        model=MODELS[traffic.model]() if model is None else model,
        human=human,
        lane_changes=traffic.lane_changes,
        after_collision=traffic.after_collision,
    )
