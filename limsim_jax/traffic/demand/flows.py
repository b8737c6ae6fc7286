"""Flows of the user, and their streams of vehicles per departure lane."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc

from limsim_jax.maps.lane_map import (
    VEHICLE_CLASSES,
    lane_ids,
)
from limsim_jax.maps.origins import origins, road_starts
from limsim_jax.traffic.demand.tables import Tables

RARE = 1e-9
"""Chance per flow and lane that more vehicles arrive than the schedule has rows for; see `overflow`."""

_PATTERNS = ("poisson", "uniform", "platoon")


@dataclass(frozen=True, kw_only=True)
class Flow:
    """Vehicles from one or several origins.

    The flow of an origin is spread over its lanes. Vehicles to a goal use those lanes evenly from which they
    can reach it with room to change lanes (`CHANGE_ROOM` and `CHANGE_TIME`), or if there are none, those with
    the fewest lanes to cross. A lane gets traffic in proportion to the share of vehicles that may use it.

    Patterns, independent on every lane: `poisson` has exponential headways. `uniform` has equal headways from
    a random phase. `platoon` has groups of `platoon` vehicles `headway` s apart, and between the groups an
    exponential time on top of that.
    """

    origin: str | Sequence[str]
    """Names of `maps.origins.origins`, road ids (`+` or `-` behind them chooses the direction, by the sign of
    the lane numbers in OpenDRIVE) or lane ids."""
    rate: float
    """Vehicles per hour, of each origin."""
    goal: str | Mapping[str, float] | None = None
    """Name of a goal, or shares by name (turning ratios); None: all ways out in reach, in equal shares."""
    pattern: str = "poisson"
    begin: float = 0.0
    """s"""
    end: float | None = None
    """s; None: to the horizon."""
    speed: float | None = None
    """m/s at entry, where that is safe; None: the speed limit."""
    classes: Mapping[str, float] | None = None
    """Weights of vehicle classes; None: those of the population."""
    platoon: int = 5
    headway: float = 2.0
    """s within a platoon"""


@dataclass(frozen=True)
class Stream:
    """A flow on one departure lane."""

    flow: Flow
    number: int  # of the flow
    row: int
    rate: float  # veh/s
    begin: float
    end: float
    goals: NDArray[np.float64]  # shares
    types: NDArray[np.float64]  # shares
    # groups of `size` arrivals `headway` apart, then an exponential time of mean `idle` s
    size: int = field(init=False)
    headway: float = field(init=False)
    idle: float = field(init=False)

    def __post_init__(self) -> None:
        match self.flow.pattern:
            case "uniform":
                size, headway, idle = 1, 1 / self.rate, 0.0
            case "platoon":
                size, headway = self.flow.platoon, self.flow.headway
                idle = size / self.rate - size * headway
                idle = 0.0 if abs(idle) < 1e-6 else idle
            case _:
                size, headway, idle = 1, 0.0, 1 / self.rate
        for name, value in {"size": size, "headway": headway, "idle": idle}.items():
            object.__setattr__(self, name, value)

    def capacity(self) -> int:
        """Rows that suffice but for a chance of `RARE`, and one more.

        If the last one is taken, the schedule may be too short.

        `k` groups take `k size headway` s and a gamma-distributed time.
        """
        duration = self.end - self.begin
        block = self.size * self.headway
        most = 8 + duration / block if block else math.inf
        if self.idle:
            # A Poisson process without the blocks is an upper bound, and it needs at most this many.
            mean = duration / self.idle
            most = min(most, mean + 10 * math.sqrt(mean) + 40)
        k = np.arange(1, math.ceil(most) + 1)
        left = np.maximum(duration - (k - 1) * block, 0)
        chance = gammainc(k, left / self.idle) if self.idle else (left > 0).astype(float)
        groups = int(np.argmax(chance < RARE)) + 1 if (chance < RARE).any() else len(k)
        return self.size * groups + 1


def streams_of(tables: Tables, flow: Flow, number: int, horizon: float) -> list[Stream]:
    """A flow on all its departure lanes."""
    names = [flow.origin] if isinstance(flow.origin, str) else list(flow.origin)
    label = f"flow {number} from {_some(names)}"
    _check_numbers(label, flow)
    if not names:
        raise ValueError(f"flow {number}: it has no origin")
    end = horizon if flow.end is None else min(flow.end, horizon)
    lanes = [_departure_lanes(tables, label, origin) for origin in names]
    types = _type_weights(tables, label, flow.classes)
    found = []
    for origin, rows in zip(names, lanes, strict=True):
        weight = (tables.allowed[rows] * types).sum(1)  # [R]
        if not weight.any():
            raise ValueError(f"{label}: no lane of '{origin}' is open to its vehicle classes")
        share = _goal_shares(tables, label, flow, rows, weight)  # [G]
        to_lane = np.zeros((len(rows), len(share)))
        for g in np.nonzero(share)[0]:
            to_lane[:, g] = share[g] * _spread(tables, rows, int(g), weight)
        if flow.rate == 0 or end <= flow.begin:
            continue
        for row, to_goal in zip(rows, to_lane, strict=True):
            if not to_goal.any():
                continue
            allowed = types * tables.allowed[row]
            stream = Stream(
                flow=flow,
                number=number,
                row=row,
                rate=flow.rate / 3600 * to_goal.sum(),
                begin=flow.begin,
                end=end,
                goals=to_goal / to_goal.sum(),
                types=allowed / allowed.sum(),
            )
            if stream.idle < 0:
                raise ValueError(
                    f"{label}: {stream.rate * 3600:.0f} veh/h on lane '{lane_ids(tables.network)[row]}' do "
                    f"not fit a headway of {flow.headway:g} s, at most {3600 / flow.headway:.0f} veh/h do"
                )
            found.append(stream)
    return found


def _check_numbers(label: str, flow: Flow) -> None:
    if flow.pattern not in _PATTERNS:
        raise ValueError(f"{label}: pattern '{flow.pattern}' is unknown; known are {', '.join(_PATTERNS)}")
    if not 0 <= flow.rate < math.inf:
        raise ValueError(f"{label}: rate = {flow.rate:g} veh/h; it has to be 0 or more, and finite")
    if not 0 <= flow.begin < math.inf:
        raise ValueError(f"{label}: begin = {flow.begin:g} s; it has to be 0 or more, and finite")
    if flow.end is not None and not flow.begin <= flow.end:
        raise ValueError(f"{label}: it ends at {flow.end:g} s, before it begins at {flow.begin:g} s")
    if flow.speed is not None and not 0 <= flow.speed < math.inf:
        raise ValueError(f"{label}: speed = {flow.speed:g} m/s; it has to be 0 or more, and finite")
    if flow.pattern == "platoon" and not (flow.platoon >= 1 and 0 < flow.headway < math.inf):
        raise ValueError(
            f"{label}: platoons of {flow.platoon} with a headway of {flow.headway:g} s; it takes 1 or more "
            "vehicles and a positive headway"
        )


def _departure_lanes(tables: Tables, label: str, origin: str) -> list[int]:
    """Rows of the lanes of an origin."""
    network, ways = tables.network, road_starts(tables.network)
    ways_in = origins(network)
    if origin in ways_in:
        return [tables.rows[lane] for lane in ways_in[origin]]
    if origin in network.lanes:
        lane = network.lanes[origin]
        if not lane.drivable or lane.junction is not None:
            what = "lies inside a junction" if lane.drivable else "is not for motor traffic"
            raise ValueError(f"{label}: lane '{origin}' {what}")
        return [tables.rows[origin]]
    both = [name for name in (f"{origin}+", f"{origin}-") if name in ways]
    inwards = [name for name in both if name in ways_in]
    if len(inwards) == 1:
        return [tables.rows[lane] for lane in ways_in[inwards[0]]]
    if both:
        raise ValueError(f"{label}: road '{origin}' has traffic both ways; name one: {_some(both)}")
    lanes = [lane for lane in ways.get(origin, []) if lane.junction is None]
    if not lanes:
        known = ", ".join(list(ways_in or ways)[:5])
        raise ValueError(f"{label}: no road or lane '{origin}' to depart from; there are {known}")
    return [tables.rows[lane.id] for lane in lanes]


def _type_weights(tables: Tables, label: str, classes: Mapping[str, float] | None) -> NDArray[np.float64]:
    """Shares of the types of the population, with these weights of classes."""
    if classes is None:
        return tables.shares
    weights = np.zeros(len(tables.shares))
    for name, weight in classes.items():
        if name not in VEHICLE_CLASSES:
            known = ", ".join(VEHICLE_CLASSES)
            raise ValueError(f"{label}: vehicle class '{name}' is unknown; known are {known}")
        if not 0 <= weight < math.inf:
            raise ValueError(f"{label}: vehicle class '{name}' has the weight {weight:g}")
        mine = tables.classes == VEHICLE_CLASSES.index(name)
        if weight > 0 and not mine.any():
            raise ValueError(f"{label}: the population has no vehicles of class '{name}'")
        of_class = np.where(mine, tables.shares, 0)
        # a class that the population has but never draws: its types in equal shares
        of_class = of_class if of_class.any() else mine.astype(float)
        weights += weight * of_class / max(of_class.sum(), 1e-30)
    if not weights.any():
        raise ValueError(f"{label}: no vehicle class has a positive weight")
    return weights / weights.sum()


def _goal_shares(
    tables: Tables, label: str, flow: Flow, rows: list[int], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Shares of the goals of a flow, adding up to 1."""
    reachable = np.any(tables.reachable[rows] & (weight > 0)[:, None], axis=0)
    if flow.goal is None:
        common = reachable & tables.common
        if not common.any():
            known = [name for name, wanted in zip(tables.goals, tables.common, strict=False) if wanted]
            raise ValueError(f"{label}: it can reach none of the goals {_some(known)}")
        return common / common.sum()
    shares = {flow.goal: 1.0} if isinstance(flow.goal, str) else dict(flow.goal)
    wanted = np.zeros(tables.reachable.shape[1])
    for name, share in shares.items():
        if name not in tables.goals:
            raise ValueError(f"{label}: no goal '{name}'; there are {_some(tables.goals)}")
        if not 0 <= share < math.inf:
            raise ValueError(f"{label}: goal '{name}' has the share {share:g}; it has to be 0 or more")
        goal = tables.goals.index(name)
        if share > 0 and not reachable[goal]:
            can = _some([tables.goals[g] for g in np.nonzero(reachable)[0]]) or "none"
            raise ValueError(f"{label}: no way to goal '{name}'; it can reach {can}")
        wanted[goal] = share
    if not wanted.any():
        raise ValueError(f"{label}: no goal has a positive share")
    return wanted / wanted.sum()


def _some(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names[:8]) + (", ..." if len(names) > 8 else "")


def _spread(tables: Tables, rows: list[int], goal: int, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shares of the lanes of an origin in traffic to one goal."""
    usable = tables.reachable[rows, goal] & (weight > 0)
    easy = usable & tables.leaves_room(rows, np.full(len(rows), tables.lengths[1]))[:, goal]
    if not easy.any():
        lanes = np.where(usable, np.abs(tables.lanes_to_go[rows, goal]), np.iinfo(np.int32).max)
        easy = usable & (lanes == lanes.min())
    share = np.where(easy, weight, 0)
    return share / share.sum()
