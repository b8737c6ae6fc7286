"""What an experiment says about single vehicles and places, as arrays: see `traffic.script`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.geometry import box_separation
from limsim_jax.maps.cut import SHORTEST, close, cut
from limsim_jax.maps.lane_map import pose
from limsim_jax.maps.map import Map
from limsim_jax.maps.network import Lane, Network
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile
from limsim_jax.sweeps.places import placed, vehicles_of
from limsim_jax.sweeps.script_file import ActionTable, ObstacleTable, VehicleTable, ZoneTable
from limsim_jax.traffic.demand import EgoStart
from limsim_jax.types import Actions, Order, Progress, Script, Zones

_NEVER_CHANGES = 1e9
"""m/s^2, `Driver.threshold` of a vehicle that keeps its lane."""

_ACTIONS, _ZONES = 8, 2
"""Numbers of actions and zones are rounded up to multiples of these, so that scripts share programs."""


# ---- zones


def with_zones(experiment: ExperimentFile, town: Map) -> Map:
    """The map cut at the ends of zones, without closed lanes."""
    network = town.network
    cuts: dict[tuple[str, int], set[float]] = {}
    for k, zone in enumerate(experiment.zone):
        for lane, low, high in _stretches(_field(experiment, k), zone, network):
            if zone.s_from or zone.s_to is not None:
                cuts.setdefault((lane.road, lane.section), set()).update((low, high))
    network = cut(network, cuts)
    closed = [
        lane.id
        for k, zone in enumerate(experiment.zone)
        if zone.closed
        for lane in zone_lanes(_field(experiment, k), zone, town.network, network)
    ]
    if network is town.network and not closed:
        return town
    shut = [network.lanes[name] for name in closed]
    network = close(network, closed)
    if not any(True for _ in network.drivable_lanes()):
        raise ExperimentError(f"{experiment.name}: zone: no lane of the map is left open")
    return replace(
        town,
        network=network,
        no_exits=frozenset(x for lane in shut for x in lane.predecessors),
        no_entries=frozenset(x for lane in shut for x in lane.successors),
    )


def _field(experiment: ExperimentFile, number: int) -> str:
    return f"{experiment.name}: zone.{number}"


def _stretches(where: str, zone: ZoneTable, network: Network) -> Iterable[tuple[Lane, float, float]]:
    """The lanes of a zone, with its ends (m along the road).

    Raises:
      ExperimentError: a road or lane that the map does not have, or a stretch beyond it; one line.
    """
    names = list(network.lanes) if zone.where == "*" else zone.where
    for name in [names] if isinstance(names, str) else names:
        if name in network.lanes:
            lane = network.lanes[name]
            yield lane, *_on_road(where, zone, lane)
        elif name in network.roads:
            lanes = [lane for lane in network.drivable_lanes() if lane.road == name]
            most = max((float(lane.road_s.max()) for lane in lanes), default=0.0)
            _check_length(where, zone, f"road '{name}'", most)
            for lane in lanes:
                yield lane, zone.s_from, math.inf if zone.s_to is None else zone.s_to
        else:
            roads = ", ".join(list(network.roads)[:8])
            raise ExperimentError(f"{where}.where: no road or lane '{name}'; roads are {roads}")


def _on_road(where: str, zone: ZoneTable, lane: Lane) -> tuple[float, float]:
    _check_length(where, zone, f"lane '{lane.id}'", lane.length)
    ends = np.interp([zone.s_from, lane.length if zone.s_to is None else zone.s_to], lane.s, lane.road_s)
    return float(ends.min()), float(ends.max())


def _check_length(where: str, zone: ZoneTable, name: str, length: float) -> None:
    for field in ("s_from", "s_to"):
        value = getattr(zone, field)
        if value is not None and value > length + 0.5:
            raise ExperimentError(f"{where}.{field}: {value:g} m, but {name} is only {length:.1f} m long")


def zone_lanes(where: str, zone: ZoneTable, before: Network, after: Network) -> list[Lane]:
    """The lanes of a zone on the map that is cut.

    Args:
      where: experiment and field, for messages.
      zone: the table.
      before: the map as the file has it.
      after: the map that is cut.

    Raises:
      ExperimentError: a zone without any lane: it is too short; one line.
    """
    found = []
    for lane, low, high in _stretches(where, zone, before):
        piece, number = lane.id, 0
        while piece in after.lanes:
            middle = float(after.lanes[piece].road_s[[0, -1]].mean())
            if low <= middle <= high:
                found.append(after.lanes[piece])
            number += 1
            piece = f"{lane.id}/{number}"
    if not found:
        raise ExperimentError(
            f"{where}: from {zone.s_from:g} to {zone.s_to or math.inf:g} m there is no lane; a zone has "
            f"{SHORTEST:g} m or more, outside junctions"
        )
    return found


# ---- vehicles


def script_vehicles(experiment: ExperimentFile, town: Map, egos: EgoStart | None) -> EgoStart | None:
    """The vehicles and obstacles that are named one by one; None without any.

    Raises:
      ExperimentError: a place or goal that the map does not have, or bodies that overlap; one line.
    """
    name = experiment.name
    groups = []
    if experiment.vehicle:
        tables = experiment.vehicle
        driver, shape = vehicles_of(f"{name}: vehicle", tables)
        keeps = jnp.asarray([table.keeps_lane for table in tables])
        driver = replace(driver, threshold=jnp.where(keeps, _NEVER_CHANGES, driver.threshold))
        speeds = jnp.asarray([math.nan if x.v is None else x.v for x in tables], jnp.float32)
        groups.append((driver, shape, speeds, placed(f"{name}: vehicle", tables, shape, town)))
    if experiment.obstacle:
        groups.append(_obstacles(name, experiment.obstacle, town))
    if not groups:
        return None
    driver, shape, v, place = jax.tree.map(lambda *x: jnp.concatenate(x), *groups)
    found = EgoStart(driver=driver, shape=shape, v=v, free=jnp.zeros(v.shape, bool), **place)
    _check_apart(experiment, town, egos, found)
    return found


def _obstacles(name: str, tables: Sequence[ObstacleTable], town: Map) -> tuple:
    """Obstacles as vehicles with a size of their own."""
    standing = [VehicleTable(start=x.start, lane=x.lane, s=x.s, v=0.0, keeps_lane=True) for x in tables]
    driver, shape = vehicles_of(f"{name}: obstacle", standing)
    size = {k: jnp.asarray([getattr(x, k) for x in tables], jnp.float32) for k in ("length", "width")}
    shape = replace(shape, **size)
    place = placed(f"{name}: obstacle", standing, shape, town, goes=False)
    return driver, shape, jnp.zeros(len(tables), jnp.float32), place


def _check_apart(experiment: ExperimentFile, town: Map, egos: EgoStart | None, found: EgoStart) -> None:
    """Raise `ExperimentError` where two bodies overlap at the start."""
    groups = [found] if egos is None or egos.lane is None else [egos, found]
    names = [
        *(f"ego.{k}" for k in range(sum(x.count for x in groups[:-1]))),
        *(f"vehicle.{k}" for k in range(len(experiment.vehicle))),
        *(f"obstacle.{k}" for k in range(len(experiment.obstacle))),
    ]
    lane, s, length, width = (
        jnp.concatenate(x)
        for x in zip(*((g.lane, g.s, g.shape.length, g.shape.width) for g in groups), strict=True)
    )
    x, y, heading = pose(town.lanes, lane, s - length / 2, jnp.zeros_like(s))
    box = jnp.stack([x, y, heading, length, width], -1)
    gaps = np.asarray(jax.vmap(jax.vmap(box_separation, (None, 0)), (0, None))(box, box))
    for a, b in zip(*np.nonzero(np.triu(gaps <= 0, 1)), strict=True):
        raise ExperimentError(f"{experiment.name}: {names[b]}: overlaps {names[a]} at the start")


# ---- the script


def script_of(experiment: ExperimentFile, original: Network, town: Map, first: int) -> Script | None:
    """Actions and zones as arrays; None without any.

    Args:
      experiment: the file's tables.
      original: the map as the file has it.
      town: the map that is cut.
      first: slot of the first vehicle of the script.
    """
    actions, zones = _actions(experiment, first), _zones(experiment, original, town)
    return None if actions is None and zones is None else Script(actions=actions, zones=zones)


def _actions(experiment: ExperimentFile, first: int) -> Actions | None:
    orders = [x.action for x in experiment.vehicle] + [_stands(x) for x in experiment.obstacle]
    actions = [(first + k, action) for k, found in enumerate(orders) for action in found]
    if not actions:
        return None
    before = [k - 1 if k and actions[k - 1][0] == slot else -1 for k, (slot, _) in enumerate(actions)]
    tables = [action for _, action in actions]
    floats = {
        "value": [_value(x) for x in tables],
        "rate": [x.rate or 0.0 for x in tables],
        "duration": [math.inf if x.duration is None else x.duration for x in tables],
        "at": [x.at for x in tables],
        "within": [math.inf if x.within is None else x.within for x in tables],
        "travelled": [x.travelled for x in tables],
        "after": [x.after for x in tables],
    }
    columns = {name: np.asarray(x, np.float32) for name, x in floats.items()} | {
        "slot": np.asarray([slot for slot, _ in actions], np.int32),
        "order": np.asarray([int(_order(x)) for x in tables], np.int32),
        "careful": np.asarray([x.careful for x in tables], bool),
        "before": np.asarray(before, np.int32),
    }
    spare = -len(actions) % _ACTIONS  # these never begin
    columns = {name: np.pad(x, (0, spare), mode="edge") for name, x in columns.items()}
    columns["at"][len(actions) :] = np.inf
    return Actions(**{name: jnp.asarray(x) for name, x in columns.items()})


def share_done(actions: Actions, progress: Progress) -> NDArray[np.float64]:
    """Share of the actions that have begun, `[W]`; a lane change once it has started."""
    known = np.isfinite(np.asarray(actions.at))
    waits = (np.asarray(actions.order) == Order.CHANGE_LANE) & ~np.asarray(progress.made)
    return (np.isfinite(np.asarray(progress.begun)) & ~waits)[..., known].mean(-1)


def _stands(obstacle: ObstacleTable) -> list[ActionTable]:
    stands = [ActionTable(stop=True, careful=False)]
    return stands if obstacle.until is None else [*stands, ActionTable(leave=True, at=obstacle.until)]


def _order(action: ActionTable) -> Order:
    if action.speed is not None:
        return Order.SPEED
    if action.change_lane is not None:
        return Order.CHANGE_LANE
    return Order.LEAVE if action.leave else Order.BRAKE


def _value(action: ActionTable) -> float:
    if action.speed is not None:
        return action.speed
    if action.change_lane is not None:
        return 1.0 if action.change_lane == "left" else -1.0
    return action.brake or 0.0


def _zones(experiment: ExperimentFile, original: Network, town: Map) -> Zones | None:
    zones = [(k, zone) for k, zone in enumerate(experiment.zone) if not zone.closed]
    if not zones:
        return None
    rows = {name: row for row, name in enumerate(town.lane_ids)}
    spare = -len(zones) % _ZONES
    lanes = np.zeros((len(zones) + spare, town.lanes.length.shape[0]), bool)  # no lane is in a spare one
    for mask, (k, zone) in zip(lanes, zones, strict=False):
        found = zone_lanes(_field(experiment, k), zone, original, town.network)
        mask[[rows[lane.id] for lane in found if lane.id in rows]] = True
    table = {
        "begin": [zone.begin for _, zone in zones],
        "end": [math.inf if zone.end is None else zone.end for _, zone in zones],
        "limit": [math.inf if zone.speed_limit is None else zone.speed_limit for _, zone in zones],
        "friction": [math.inf if zone.friction is None else zone.friction for _, zone in zones],
    }
    ends = {name: np.pad(np.asarray(x, np.float32), (0, spare), mode="edge") for name, x in table.items()}
    return Zones(lanes=jnp.asarray(lanes), **{name: jnp.asarray(x) for name, x in ends.items()})
