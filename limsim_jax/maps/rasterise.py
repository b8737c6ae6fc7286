"""A network to a `LaneMap`: intervals of lanes and tables of rules.

Runs on the host in float64; `limsim_jax.maps.lane_map` says what the intervals are. A lane gets the longest
intervals that stay within `TOLERANCE` of the lane of the network. All tables are padded to `bucket` sizes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from limsim_jax.geometry import derivative, polynomial
from limsim_jax.maps.bridges import goes_on_beside, side_step
from limsim_jax.maps.conflicts import build_conflicts, stand_back
from limsim_jax.maps.lane_map import (
    CELL,
    EARLIER,
    LANE_TYPES,
    NO_LANE,
    REACH,
    VEHICLE_CLASSES,
    Goals,
    LaneMap,
    bucket,
    cell_row,
    lane_rows,
)
from limsim_jax.maps.network import ImportReport, Lane, MapError, Network
from limsim_jax.maps.routing import build_routes, default_goals
from limsim_jax.maps.signals import build_signals
from limsim_jax.maps.widths import begins_narrow, ends_narrow, usable

Floats = NDArray[np.float64]

SPACINGS = tuple(2.0**power for power in range(4, -4, -1))
"""Interval lengths to choose from, longest first, m."""

TOLERANCE = {"position": 1e-3, "width": 1e-3, "elevation": 1e-2, "heading": math.radians(0.25)}
"""Largest deviation of a device lane from its host lane, m and rad, unless `ds` is already the least."""

WORST_DEVIATION = 0.05
"""A map with a lane that deviates by more at the least `ds` is refused, m."""

TURN_WINDOW = 4.0
"""`curvature_max` is the mean over a stretch of this length, m: about a wheelbase and a half."""

SIGHT = 50.0
"""Distance that every vehicle must see ahead, m: to stop from 70 km/h with 4 m/s^2."""

LONGEST = 20.0
"""Length of the longest vehicle, m."""

MOST_PIECES = 8
"""Connectors of one way across a junction, at most, that vehicles look at."""

_MOST = 12  # lanes that a vehicle scans, at most
_BESIDE = 500.0  # m, beyond which it does not matter how far lanes run side by side
_CHUNK_LENGTH, _CHUNK_TURN = 32.0, 0.6  # m, rad: a candidate of `project` has at most about one closest point
_JUMP = 1.5e-3  # m: closer host samples are a kink or a step
_JUMP_ZONE = 0.5  # m: around a kink or a step, heading and width are not judged
_CURVATURE_SLIP = 1e-3  # rad: curvature and turn between two host samples that differ by more show a jump
_MAX_ROWS = 2**24
LEAST = {
    "lanes": 64,
    "rows": 4096,
    "neighbors": 4,
    "chunks": 2048,
    "cells": 16384,
    "candidates": 49152,
    "connectors": 64,
    "foes": 12,
    "goals": 16,
    "programs": 16,
    "phases": 16,
    "links": 32,
    "movements": 64,
    "sight": 4,
    "behind": 2,
    "approaches": 3,
}
"""Least sizes of padded tables: all small maps have the same shapes, and share compiled programs."""


def build_lane_map(
    network: Network,
    goals: Goals | None = None,
    routes: Mapping[str, Sequence[str]] | None = None,
    *,
    report: ImportReport | None = None,
    least: Mapping[str, int] | None = None,
) -> LaneMap:
    """Turn a network into arrays: lanes, conflicts, routes and signals.

    Args:
        network: the map.
        goals: lane ids of each goal of `routes`, in the order of its columns or by name; default: the
            ways out of the map, see `routing.default_goals`.
        routes: the roads to be driven, of goals by name whose way is prescribed.
        report: receives a note for every lane that misses `TOLERANCE` at the least interval length.
        least: least sizes of tables by the names in `LEAST`, so that maps share compiled programs.

    Raises:
        KeyError: an unknown name in `least`.
        MapError: no lane for motor traffic, numbers that are not finite, a link to a lane that is not
            there, or a lane that cannot be followed within `WORST_DEVIATION`.
    """
    size = _sizes(least or {})
    goals = default_goals(network) if goals is None else goals  # those of the map as it is
    network = _without_side_steps(network, report)
    lanes = list(network.drivable_lanes())
    if not lanes:
        raise MapError("no lane that motor traffic may use", file=network.source)
    host = _HostLanes.join(network, lanes)
    raster = _rasterise(network, host, report)
    tables = _lane_tables(network, lanes, size["neighbors"])
    origin = np.round((host.xyz[:, :2].min(0) + host.xyz[:, :2].max(0)) / 2)
    if np.abs(origin).max() >= 2**31:
        raise MapError("coordinates beyond 2^31 m", file=network.source)
    if len(raster.lane) >= _MAX_ROWS:
        raise MapError(f"{len(raster.lane)} intervals; at most {_MAX_ROWS} fit", file=network.source)

    num_rows, num_lanes = (
        bucket(len(raster.lane) + 1, size["rows"]),
        bucket(len(lanes) + 1, size["lanes"]),
    )
    rows = raster.rows.copy()
    rows[:, [0, 4]] -= origin
    straight = np.zeros(16)
    straight[[1, 8, 14]] = 1.0  # along x, 1 m wide, 1 m long
    inert = {
        "first": num_rows - 1,
        "access": 0,
        "count": 1,
        "ds": 1.0,
        "length": 1.0,
        "speed_limit": 1.0,
        "stop_s": 1.0,
        "start_s": 0.0,
        "end_s": 1.0,
    }
    tables |= {
        "first": raster.first,
        "count": raster.count,
        "ds": raster.ds,
        "length": host.length,
        "curvature_max": _curvature_max(host),
    }
    arrays = {
        "origin": origin.astype(np.int32),
        "rows": _pad(rows, num_rows, straight),
        "height": _pad(raster.height, num_rows, 0.0),
        "side": _pad(raster.side, num_rows, np.array([0.0, 1.0, 0.0, 1.0])),
        **{name: _pad(table, num_lanes, inert.get(name, _inert(table))) for name, table in tables.items()},
        **_grid(raster, rows, size),
    }
    order = lane_rows(network)
    stop_s = tables["stop_s"]
    rules = _rule_tables(
        network, goals, routes or {}, stop_s, num_lanes, size, keep_foes="foes" in (least or {})
    )
    lane_map = LaneMap(
        **arrays,
        **rules,
        lanes_in_sight=max(_lanes_in_sight(lanes, order), size["sight"]),
        lanes_behind=max(_lanes_behind(lanes, order), min(size["behind"], EARLIER + 1)),
        approaches=max(_approaches(network), size["approaches"]),
    )
    return jax.tree.map(lambda array: jnp.asarray(_device_type(array)), lane_map)


def _sizes(least: Mapping[str, int]) -> dict[str, int]:
    """Least sizes of all tables, larger where the caller wants that."""
    unknown = sorted(set(least) - set(LEAST))
    if unknown:
        raise KeyError(f"no table '{unknown[0]}'; there are {', '.join(LEAST)}")
    return {name: max(count, least.get(name, 0)) for name, count in LEAST.items()}


def _without_side_steps(network: Network, report: ImportReport | None) -> Network:
    """The network without links that lead sideways, or where no car fits.

    In some files two lanes continue as one where one of them ends beside it. Without the link from that one,
    its vehicles change lanes. So they do where a lane narrows to nothing or opens from it, and the lane
    beside goes on.
    """
    lanes = dict(network.lanes)
    for lane in network.drivable_lanes():
        for name in lane.successors:
            after = network.lanes[name]
            going = goes_on_beside(network.lanes, lane, after)
            if going is not None:
                step = side_step(lane, after)
                why = f"begins {step:.1f} m beside the end of {lane.id}: traffic changes to {going.id}, "
                why += f"which continues as {name}"
            elif beside := _way_round(network.lanes, lane, after):
                why = f"is too narrow where {lane.id} leads into it: traffic changes lanes with {beside.id}"
            else:
                continue
            before, after = lanes[lane.id], lanes[name]
            lanes[lane.id] = replace(before, successors=tuple(x for x in before.successors if x != name))
            lanes[name] = replace(after, predecessors=tuple(x for x in after.predecessors if x != lane.id))
            if report is not None:
                report.repaired("lane link", f"{lane.id} -> {name}", f"{name} {why}")
    return network if lanes == network.lanes else replace(network, lanes=lanes)


def _way_round(lanes: Mapping[str, Lane], before: Lane, after: Lane) -> Lane | None:
    """The lane by which traffic avoids a link that is too narrow.

    None where it need not or cannot. Lanes that are narrow as a whole are driven as they are.
    """
    if not after.drivable or before.junction is not None or after.junction is not None:
        return None
    if ends_narrow(before):
        sides = ((before.left, before.may_change_left), (before.right, before.may_change_right))
        return next((lanes[x] for x, may in sides if x and may and lanes[x].successors), None)
    if begins_narrow(after):
        for name in (after.left, after.right):
            if name and lanes[name].predecessors:
                other = lanes[name]
                if other.may_change_left if other.left == after.id else other.may_change_right:
                    return other
    return None


def _rule_tables(
    network: Network,
    goals: Goals,
    prescribed: Mapping[str, Sequence[str]],
    stop_s: NDArray[np.float64],
    num_lanes: int,
    least: Mapping[str, int],
    *,
    keep_foes: bool,
) -> dict[str, Any]:
    """Conflicts, routes and signals, padded to buckets.

    `keep_foes`: a map without conflicts has room for some as well.
    """
    rows = lane_rows(network)
    conflicts = build_conflicts(network, rows)
    routes = build_routes(network, rows, goals, prescribed=prescribed)
    signals = build_signals(network, rows)
    (connectors, foes), (_, num_goals) = conflicts.foe.shape, routes.distance.shape
    programs, phases, links = signals.state.shape
    size = {
        name: bucket(count, least[name])
        for name, count in {
            "connectors": connectors,
            "foes": foes,
            "goals": num_goals,
            "programs": programs,
            "phases": phases,
            "links": links,
            "movements": len(signals.movement_link),
        }.items()
    }
    if not foes and not keep_foes:
        size["foes"] = 0  # a program without conflicts is a third faster
    return {
        "stand_back": _pad(stand_back(network, rows, conflicts, stop_s), num_lanes, 0.0),
        "conflicts": conflicts.pad(lanes=num_lanes, connectors=size["connectors"], foes=size["foes"]),
        "routes": routes.pad(lanes=num_lanes, goals=size["goals"]),
        "signals": signals.pad(
            programs=size["programs"],
            phases=size["phases"],
            links=size["links"],
            lanes=num_lanes,
            movements=size["movements"],
        ),
    }


def _device_type(array: NDArray[Any]) -> NDArray[Any]:
    kinds = {"f": np.float32, "i": np.int32, "b": np.bool_}
    return array.astype(kinds[array.dtype.kind])


def _inert(table: NDArray[Any]) -> Any:
    """Value of the null lane in a table of lanes: False, NO_LANE or zero."""
    return {"b": False, "i": NO_LANE, "f": 0.0}[table.dtype.kind]


def _pad(table: NDArray[Any], size: int, value: Any) -> NDArray[Any]:
    padded = np.empty((size, *table.shape[1:]), table.dtype)
    padded[: len(table)] = table
    padded[len(table) :] = value
    return padded


def _lane_tables(network: Network, lanes: list[Lane], neighbors: int) -> dict[str, NDArray[Any]]:
    """Attributes and links of each lane, as arrays by row; room for `neighbors` links at least."""
    rows = {lane.id: row for row, lane in enumerate(lanes)}
    junctions = {junction: index for index, junction in enumerate(network.junctions)}
    stop_s = np.array([lane.length for lane in lanes])
    last_line: dict[str, float] = {}
    for line in network.stop_lines:
        last_line[line.spot.lane] = max(line.spot.s, last_line.get(line.spot.lane, 0.0))
    for lane, s in last_line.items():
        if lane in rows:
            stop_s[rows[lane]] = min(s, stop_s[rows[lane]])

    def row_of(lane: Lane, other: str | None) -> int:
        if other is not None and other not in network.lanes:
            raise MapError(
                f"refers to lane '{other}', which does not exist",
                file=network.source,
                element=f"lane '{lane.id}'",
            )
        return rows.get(other, NO_LANE) if other is not None else NO_LANE

    def links(which: str) -> NDArray[np.int64]:
        found = [
            [r for other in getattr(lane, which) if (r := row_of(lane, other)) != NO_LANE] for lane in lanes
        ]
        table = np.full((len(lanes), bucket(max(map(len, found)), neighbors)), NO_LANE)
        for row, others in enumerate(found):
            table[row, : len(others)] = others
        return table

    wide = usable(network)
    left = np.array([row_of(lane, lane.left) for lane in lanes])
    right = np.array([row_of(lane, lane.right) for lane in lanes])
    return {
        "speed_limit": np.array([lane.speed_limit for lane in lanes], float),
        "stop_s": stop_s,
        "start_s": np.array([wide[lane.id][0] for lane in lanes]),
        "end_s": np.array([wide[lane.id][1] for lane in lanes]),
        "left": left,
        "right": right,
        "opposite": np.array([row_of(lane, lane.opposite) for lane in lanes]),
        "may_change_left": np.array([lane.may_change_left for lane in lanes]) & (left != NO_LANE),
        "may_change_right": np.array([lane.may_change_right for lane in lanes]) & (right != NO_LANE),
        "beside_s": np.stack([_beside(lanes, rows, side, wide) for side in ("left", "right")], -1),
        "successors": links("successors"),
        "predecessors": links("predecessors"),
        "lane_type": np.array([LANE_TYPES.index(lane.type) for lane in lanes]),
        "access": np.array(
            [sum(1 << i for i, c in enumerate(VEHICLE_CLASSES) if c in lane.access) for lane in lanes]
        ),
        "is_connector": np.array([lane.junction is not None for lane in lanes]),
        "junction": np.array([junctions.get(lane.junction or "", -1) for lane in lanes]),
        "valid": np.ones(len(lanes), bool),
    }


def _beside(
    lanes: list[Lane],
    rows: Mapping[str, int],
    side: Literal["left", "right"],
    wide: Mapping[str, tuple[float, float]],
) -> Floats:
    """Distance (m) on which the neighbour of each lane runs beside it.

    It is measured from the start of the lane to where the neighbour parts from it, or becomes too narrow. A
    junction parts lanes, too. Where lanes fork, the branch on which they part first counts. Beyond this lane
    at most `_BESIDE` m count.
    """

    def goes_on(lane: Lane, after: str) -> bool:
        other = getattr(lanes[rows[after]], side)
        beside = getattr(lane, side)
        return (
            lanes[rows[after]].junction is None and other in rows and other in lanes[rows[beside]].successors
        )

    length = np.array([lane.length for lane in lanes])
    names = [getattr(lane, side) for lane in lanes]
    taper = [lanes[rows[name]].length - wide[name][1] if name in rows else 0.0 for name in names]
    found = np.where([name in rows for name in names], np.maximum(length - taper, 0.0), 0.0)
    on = [
        [rows[after] if goes_on(lane, after) else -1 for after in lane.successors if after in rows]
        if getattr(lane, side) in rows
        else []
        for lane in lanes
    ]
    while True:
        before = found.copy()
        for row, after in enumerate(on):
            if after:
                found[row] = length[row] + min(_BESIDE, *(found[k] if k >= 0 else 0.0 for k in after))
        if (found == before).all():
            return found


def _lanes_behind(lanes: list[Lane], rows: Mapping[str, int]) -> int:
    """Lanes behind its own that a long vehicle covers, at least 2."""
    before = [[rows[name] for name in lane.predecessors if name in rows] for lane in lanes]
    short = [row for row, lane in enumerate(lanes) if lane.length < LONGEST]
    reach = {row: lanes[row].length for row in short}  # m, least length of a chain that ends there
    for count in range(2, EARLIER + 1):
        further: dict[int, float] = {}
        for row, length in reach.items():
            for other in before[row]:
                further[other] = min(further.get(other, math.inf), length + lanes[other].length)
        reach = {row: length for row, length in further.items() if length < LONGEST}
        if not reach:
            return count
    return EARLIER + 1


def _approaches(network: Network) -> int:
    """Connectors that vehicles look at: as many as a way across a junction has, and two more."""
    pieces = max((sum(network.lanes[x].drivable for x in m.via) for m in network.movements), default=1)
    return min(max(pieces, 1), MOST_PIECES) + 2


def _lanes_in_sight(lanes: list[Lane], rows: Mapping[str, int]) -> int:
    """Lanes beyond its own in `SIGHT` of a vehicle.

    The largest number for any lane, at most `_MOST`.
    """
    reach = np.zeros(len(lanes))  # m, length of the shortest way over this many lanes
    for count in range(_MOST):
        after = [[reach[rows[x]] for x in lane.successors if x in rows] for lane in lanes]
        if min((min(ways) for ways in after if ways), default=SIGHT) >= SIGHT:
            return count
        reach = np.array(
            [lane.length + min(ways, default=SIGHT) for lane, ways in zip(lanes, after, strict=True)]
        )
    return _MOST


@dataclass(frozen=True)
class _HostLanes:
    """Samples of all lanes end to end on one axis.

    One search on that axis serves many lanes.
    """

    lanes: list[Lane]
    offset: Float[NDArray[np.float64], " L"]  # where each lane starts on the axis
    length: Float[NDArray[np.float64], " L"]
    first: Int[NDArray[np.int64], " L"]  # its first sample
    lane: Int[NDArray[np.int64], " M"]  # lane of each sample
    s: Float[NDArray[np.float64], " M"]
    t: Float[NDArray[np.float64], " M"]  # the same on the axis
    xyz: Float[NDArray[np.float64], "M 3"]
    heading: Float[NDArray[np.float64], " M"]
    curvature: Float[NDArray[np.float64], "M 2"]  # where the stretch to the next sample starts and ends
    width: Float[NDArray[np.float64], " M"]
    side_s: Float[NDArray[np.float64], "M 2"]  # s on the left and on the right lane

    @staticmethod
    def join(network: Network, lanes: list[Lane]) -> _HostLanes:
        for lane in lanes:
            values = (lane.s, lane.xyz.ravel(), lane.heading, lane.curvature, lane.width, lane.road_s)
            if (
                not np.isfinite(np.concatenate(values)).all()
                or len(lane.s) < 2
                or (np.diff(lane.s) <= 0).any()
            ):
                raise MapError(
                    "centre line needs two or more finite samples with rising s",
                    file=network.source,
                    element=f"lane '{lane.id}'",
                )
        length = np.array([lane.length for lane in lanes])
        offset = np.concatenate([[0.0], np.cumsum(length + 1.0)[:-1]])
        counts = np.array([len(lane.s) for lane in lanes])
        s, heading, curvature = (
            np.concatenate([getattr(lane, name) for lane in lanes]) for name in ("s", "heading", "curvature")
        )
        side_s = [
            network.lanes[other].s_at_road(lane.road_s) if other in network.lanes else lane.s
            for lane in lanes
            for other in (lane.left, lane.right)
        ]
        return _HostLanes(
            lanes=lanes,
            offset=offset,
            length=length,
            first=np.cumsum(counts) - counts,
            lane=np.repeat(np.arange(len(lanes)), counts),
            s=s,
            t=s + np.repeat(offset, counts),
            xyz=np.concatenate([lane.xyz for lane in lanes]),
            heading=heading,
            curvature=_one_sided_curvature(s, heading, curvature),
            width=np.concatenate([lane.width for lane in lanes]),
            side_s=np.stack([np.concatenate(side_s[0::2]), np.concatenate(side_s[1::2])], -1),
        )

    def at(self, lane: NDArray[np.int64], s: NDArray[np.float64], toward: float = 0.0) -> _Samples:
        """All quantities at `s` (m) on `lane`.

        At a kink or step they are those on its far (`toward` = +1) or near (-1) side.
        """
        t = self.offset[lane] + s
        last = np.append(self.first[1:], len(self.t))[lane] - 2
        j = np.clip(np.searchsorted(self.t, t + 1e-7 * toward, side="right") - 1, self.first[lane], last)
        h = self.s[j + 1] - self.s[j]
        w = np.clip((s - self.s[j]) / h, 0.0, 1.0)

        def linear(values: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
            w = w.reshape(w.shape + (1,) * (values.ndim - 1))
            return values[j] * (1 - w) + values[j + 1] * w

        tangent = np.stack([np.cos(self.heading), np.sin(self.heading)], -1)
        w_, h_ = w[:, None], h[:, None]
        p0, p1, m0, m1 = self.xyz[j, :2], self.xyz[j + 1, :2], tangent[j] * h_, tangent[j + 1] * h_
        xy = (
            p0 * (1 + 2 * w_) * (1 - w_) ** 2
            + m0 * w_ * (1 - w_) ** 2
            + p1 * w_**2 * (3 - 2 * w_)
            - m1 * w_**2 * (1 - w_)
        )
        dxy = 6 * w_ * (1 - w_) * (p1 - p0) + m0 * (1 - w_) * (1 - 3 * w_) - m1 * w_ * (2 - 3 * w_)
        heading = np.arctan2(dxy[:, 1], dxy[:, 0])
        one_sided = w
        if toward:
            jump = h <= _JUMP
            one_sided = np.where(jump, float(toward > 0), w)
            heading = np.where(jump, self.heading[j + (toward > 0)], heading)
        return _Samples(
            xy=xy,
            z=linear(self.xyz[:, 2], w),
            heading=heading,
            curvature=self.curvature[j, 0] * (1 - one_sided) + self.curvature[j, 1] * one_sided,
            width=linear(self.width, one_sided),
            side_s=linear(self.side_s, w),
        )


def _one_sided_curvature(
    s: NDArray[np.float64], heading: NDArray[np.float64], curvature: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Curvature at both ends of each stretch between samples.

    A sample where the curvature jumps has one value, valid on one of its sides. The turn along the stretch
    shows when that is the other side. The value nearer to the mean curvature then holds, and the other
    follows from the mean.
    """
    pairs = np.stack([curvature, np.append(curvature[1:], curvature[-1])], -1)
    h = np.append(np.diff(s), 0.0)
    sound = h > _JUMP  # not a kink, nor the gap between two lanes
    mean = np.divide(np.append(np.diff(heading), 0.0), h, out=pairs.mean(1), where=sound)
    wrong = np.abs(pairs.mean(1) - mean) * h > _CURVATURE_SLIP
    start_holds = np.abs(pairs[:, 0] - mean) < np.abs(pairs[:, 1] - mean)
    pairs[:, 1] = np.where(wrong & start_holds, 2 * mean - pairs[:, 0], pairs[:, 1])
    pairs[:, 0] = np.where(wrong & ~start_holds, 2 * mean - pairs[:, 1], pairs[:, 0])
    return pairs


class _Samples(NamedTuple):
    xy: NDArray[np.float64]
    z: NDArray[np.float64]
    heading: NDArray[np.float64]
    curvature: NDArray[np.float64]
    width: NDArray[np.float64]
    side_s: NDArray[np.float64]


@dataclass(frozen=True)
class _Raster:
    """Intervals of some lanes, lane after lane, in file coordinates."""

    lane: NDArray[np.int64]  # of each interval
    start: NDArray[np.float64]  # s where it starts, m
    rows: NDArray[np.float64]
    height: NDArray[np.float64]
    side: NDArray[np.float64]
    first: NDArray[np.int64]  # first interval of each lane
    count: NDArray[np.int64]  # of intervals of each lane
    ds: NDArray[np.float64]  # of each lane


def _rasterise(network: Network, host: _HostLanes, report: ImportReport | None) -> _Raster:
    """Intervals of all lanes, each at the longest spacing within `TOLERANCE`."""
    check = _check_points(host)
    everything = todo = np.arange(len(host.lanes))
    ds = np.full(len(host.lanes), SPACINGS[-1])
    errors: dict[str, NDArray[np.float64]] = {}
    for spacing in SPACINGS:
        errors = _deviation(host, todo, _cut(host, todo, np.full(len(todo), spacing)), check)
        missed = np.any([errors[name] > limit for name, limit in TOLERANCE.items()], axis=0)
        ds[todo[~missed]] = spacing
        todo, errors = todo[missed], {name: error[missed] for name, error in errors.items()}
        if not len(todo):
            break
    else:
        for k, lane in enumerate(todo):
            error = {name: values[k] for name, values in errors.items() if values[k] > TOLERANCE[name]}
            if error.get("position", 0.0) > WORST_DEVIATION:
                raise MapError(
                    f"intervals of {SPACINGS[-1]:g} m leave the centre line by {error['position']:.3f} m",
                    file=network.source,
                    element=f"lane '{host.lanes[lane].id}'",
                )
            if report is not None:
                deviation = ", ".join(f"{name} {value:.2g}" for name, value in error.items())
                report.approximated(
                    "device lane",
                    host.lanes[lane].id,
                    f"deviates at {SPACINGS[-1]:g} m intervals (m, rad): {deviation}",
                )
    return _cut(host, everything, ds)


def _cut(host: _HostLanes, lanes: NDArray[np.int64], ds: NDArray[np.float64]) -> _Raster:
    """Intervals of `lanes`, each at its own spacing `ds`; `lane` counts within `lanes`."""
    length = host.length[lanes]
    counts = np.maximum(1, np.floor(length / ds + 0.5).astype(np.int64))
    first = np.cumsum(counts) - counts
    of = np.repeat(np.arange(len(lanes)), counts)
    index = np.arange(counts.sum()) - first[of]
    start = index * ds[of]
    end = np.where(index == counts[of] - 1, length[of], start + ds[of])
    h = end - start
    lane = lanes[of]
    a, b = host.at(lane, start, +1), host.at(lane, end, -1)
    inner = [host.at(lane, start + h * third) for third in (1 / 3, 2 / 3)]

    h_ = h[:, None]
    t0, t1 = (np.stack([np.cos(p.heading), np.sin(p.heading)], -1) for p in (a, b))
    chord = (b.xy - a.xy) / h_
    hermite = np.stack([a.xy, t0, (3 * chord - 2 * t0 - t1) / h_, (t0 + t1 - 2 * chord) / h_**2], -1)
    width = _cubic_through(h, a.width, inner[0].width, inner[1].width, b.width)
    height = _cubic_through(h, a.z, inner[0].z, inner[1].z, b.z)
    bend = np.stack([a.curvature, (b.curvature - a.curvature) / h], -1)
    rows = np.concatenate([hermite.reshape(-1, 8), width, bend, h_, ((b.z - a.z) / h)[:, None]], -1)
    side = np.stack([a.side_s, (b.side_s - a.side_s) / h_], -1).reshape(-1, 4)
    return _Raster(of, start, rows, height, side, first, counts, ds)


def _cubic_through(h: NDArray[np.float64], *values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients of cubics with these values at 0, h/3, 2h/3, h."""
    nodes = np.linalg.inv(np.vander(np.arange(4) / 3, increasing=True))
    return np.stack(values, -1) @ nodes.T / h[:, None] ** np.arange(4)


class _Check(NamedTuple):
    """Places at which device lanes are compared with host lanes."""

    lane: NDArray[np.int64]
    s: NDArray[np.float64]
    truth: _Samples
    smooth: NDArray[np.bool_]  # away from kinks and steps


def _check_points(host: _HostLanes) -> _Check:
    """Host samples, and places between them at most 0.25 m apart.

    Around kinks and steps there are more.

    The number of parts is odd: halves and quarters of host intervals tend to be bounds of ours.
    """
    gap = np.diff(host.t)
    same = host.lane[1:] == host.lane[:-1]
    parts = np.where(same, 2 * np.ceil(gap / 0.5).astype(np.int64) + 1, 1)
    segment = np.repeat(np.arange(len(gap)), parts)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    t = np.append(host.t[segment] + gap[segment] * part / parts[segment], host.t[-1])
    lane = np.append(host.lane[segment], host.lane[-1])

    jump = np.flatnonzero(same & (gap <= _JUMP))
    near = SPACINGS[-1] * np.arange(-1.0, 1.25, 0.25)
    t = np.append(t, (host.t[jump, None] + near).ravel())
    lane = np.append(lane, np.repeat(host.lane[jump], len(near)))
    s = np.clip(t - host.offset[lane], 0.0, host.length[lane])
    order = np.lexsort((s, lane))
    t, lane, s = t[order], lane[order], s[order]

    smooth = np.ones(len(t), bool)
    if len(jump):
        after = np.searchsorted(host.t[jump], t)
        for k in (np.maximum(after - 1, 0), np.minimum(after, len(jump) - 1)):
            smooth &= np.abs(t - host.t[jump[k]]) > _JUMP_ZONE
    return _Check(lane, s, host.at(lane, s), smooth)


def _deviation(
    host: _HostLanes, lanes: NDArray[np.int64], raster: _Raster, check: _Check
) -> dict[str, NDArray[np.float64]]:
    """Largest deviation of each of `lanes` from the host, by quantity."""
    place = np.full(len(host.lanes), -1)
    place[lanes] = np.arange(len(lanes))
    mine = np.flatnonzero(place[check.lane] >= 0)
    of, s = place[check.lane[mine]], check.s[mine]
    row = raster.first[of] + np.minimum((s / raster.ds[of]).astype(np.int64), raster.count[of] - 1)
    u = s - raster.start[row]
    c = raster.rows[row].T
    x, y, width = polynomial(c[:4], u), polynomial(c[4:8], u), polynomial(c[8:12], u)
    turn = (
        np.arctan2(polynomial(derivative(c[4:8]), u), polynomial(derivative(c[:4]), u))
        - check.truth.heading[mine]
    )
    smooth = check.smooth[mine]
    error = {
        "position": np.hypot(x - check.truth.xy[mine, 0], y - check.truth.xy[mine, 1]),
        "width": np.abs(width - check.truth.width[mine]) * smooth,
        "elevation": np.abs(polynomial(raster.height[row].T, u) - check.truth.z[mine]),
        "heading": np.abs(np.remainder(turn + np.pi, 2 * np.pi) - np.pi) * smooth,
    }
    begin = np.searchsorted(of, np.arange(len(lanes)))
    return {name: np.maximum.reduceat(values, begin) for name, values in error.items()}


def _curvature_max(host: _HostLanes) -> NDArray[np.float64]:
    """Largest mean |curvature| of each lane over any stretch of `TURN_WINDOW`, 1/m.

    A shorter lane is one stretch; stretches below 1 m count as 1 m. It is a mean because a polyline bends
    nowhere but at its kinks.
    """
    stretch = np.minimum(TURN_WINDOW, host.length)[host.lane]
    begin, end = host.offset[host.lane], (host.offset + host.length)[host.lane]
    largest = np.zeros(len(host.t))
    for ahead in (0.0, 1.0):  # the stretch that ends at the sample, and the one that starts there
        start = np.clip(host.t - (1 - ahead) * stretch, begin, end - stretch)
        turn = np.interp(start + stretch, host.t, host.heading) - np.interp(start, host.t, host.heading)
        largest = np.maximum(largest, np.abs(turn) / np.maximum(stretch, 1.0))
    return np.maximum.reduceat(largest, host.first)


def _grid(raster: _Raster, rows: NDArray[np.float64], least: Mapping[str, int]) -> dict[str, NDArray[Any]]:
    """Tables of `project`: short stretches of lane, and those near each cell."""
    c, h = rows.T, rows[:, 14]
    turn = np.arctan2(polynomial(derivative(c[4:8]), h), polynomial(derivative(c[:4]), h)) - np.arctan2(
        c[5], c[1]
    )
    turn = np.abs(np.remainder(turn + np.pi, 2 * np.pi) - np.pi)
    turned = np.cumsum(turn) - turn
    turned -= turned[raster.first][raster.lane]
    key = np.stack([raster.lane, raster.start // _CHUNK_LENGTH, turned // _CHUNK_TURN])
    head = np.flatnonzero(np.append(True, (np.diff(key) != 0).any(0)))  # first interval of each chunk
    tail = np.append(head[1:], len(h)) - 1
    chunk_lane = raster.lane[head]
    ends = np.stack([polynomial(c[:4, tail], h[tail]), polynomial(c[4:8, tail], h[tail])], -1)
    span = np.stack([raster.start[head], raster.start[tail] + h[tail]], -1)
    chunks = np.concatenate([span, rows[head][:, [0, 4]], ends], -1)

    # Points at most 2 m apart along each interval: no point of it is more than 1 m from one of them.
    parts = np.maximum(1, np.ceil(h / 2.0).astype(np.int64))
    row = np.repeat(np.arange(len(h)), parts)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    u = h[row] * (part + 0.5) / parts[row]
    xy = np.stack([polynomial(c[:4, row], u), polynomial(c[4:8, row], u)], -1)
    chunk = (np.searchsorted(head, np.arange(len(h)), side="right") - 1)[row]
    found = []
    base = np.floor(xy / CELL)
    around = math.ceil((REACH + 1.01) / CELL)
    for step in np.ndindex(2 * around + 1, 2 * around + 1):
        cell = base + step - around
        outside = np.maximum(np.maximum(cell * CELL - xy, xy - (cell + 1) * CELL), 0.0)
        near = np.hypot(*outside.T) <= REACH + 1.01
        found.append(np.column_stack([cell[near].astype(np.int64), chunk[near]]))
    entries = np.unique(np.concatenate(found), axis=0)
    cells = np.unique(entries[:, :2], axis=0)
    size = 1 << (max(2 * len(cells), least["cells"]) - 1).bit_length()
    keyed = np.unique(np.column_stack([cell_row(entries[:, 0], entries[:, 1], size), entries[:, 2]]), axis=0)
    return {
        "chunk_lane": _pad(chunk_lane, bucket(len(chunk_lane), least["chunks"]), NO_LANE),
        "chunk": _pad(chunks, bucket(len(chunks), least["chunks"]), 0.0),
        "cell_start": np.searchsorted(keyed[:, 0], np.arange(size + 1)),
        "cell_chunks": _pad(keyed[:, 1], bucket(len(keyed), least["candidates"]), 0),
    }
