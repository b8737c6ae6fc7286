"""Distances of given poses from our lanes, on host and device."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.network import Lane, LaneType, Network

# Thresholds for a map, in SI units.
HOST_LATERAL = 1e-3
DEVICE_LATERAL = 0.05
DEVICE_MEDIAN = 0.01
HEADING = math.radians(1.0)
WIDTH = 0.01
LENGTH = 1e-3  # of the length
NO_SECTION = 1e-3  # m; shorter lane sections hold no traffic, so lanes may start that much later

Array = NDArray[np.float64]


@dataclass
class Misfit:
    """Deviations of given poses from our lanes.

    One entry per pose; NaN where no lane of ours is there.
    """

    lateral: Array  # m, across the track
    along: Array  # m, along the track, from where the road coordinate says
    heading: Array  # rad
    width: Array  # m
    at: Array  # m, arc length of the foot point on the host lane
    device: Array  # m, across the track, of the device lane
    may_left: Array  # 1 or 0 where our lane has a driving lane beside it, otherwise NaN
    may_right: Array
    lane: list[str]

    @classmethod
    def empty(cls, count: int) -> Misfit:
        """All NaN."""
        return cls(*(np.full(count, np.nan) for _ in range(8)), lane=[""] * count)

    def bad(self) -> NDArray[np.bool_]:
        """Poses for which the host lane misses a threshold."""
        good = (self.lateral < HOST_LATERAL) & (self.heading < HEADING) & (self.width < WIDTH)
        return ~good


def project(lane: Lane, xy: Array, s: Array) -> tuple[Array, Array, Array]:
    """Project points on a lane.

    Returns arc length (m), offset to the left (m) and the residual along the lane (m).
    """
    for _ in range(8):
        position, heading = lane.pose(s)
        delta = xy - position[:, :2]
        along = delta[:, 0] * np.cos(heading) + delta[:, 1] * np.sin(heading)
        s = np.clip(s + along, 0.0, lane.length)
    position, heading = lane.pose(s)
    delta = xy - position[:, :2]
    c, n = np.cos(heading), np.sin(heading)
    return s, delta[:, 1] * c - delta[:, 0] * n, delta[:, 0] * c + delta[:, 1] * n


class OurMap:
    """Our lanes, found by road and number, on host and device."""

    def __init__(self, network: Network) -> None:
        """Index the driving lanes and build the device map."""
        self.network = network
        self.lanes: dict[tuple[str, int], list[Lane]] = {}
        for lane in network.lanes.values():
            if lane.type is LaneType.DRIVING:
                self.lanes.setdefault((lane.road, lane.number), []).append(lane)
        for lanes in self.lanes.values():
            lanes.sort(key=lambda lane: min(lane.road_s[0], lane.road_s[-1]))
        self._device = device_poses(network)

    def misfit(self, where: Sequence[tuple[str, int]], s: Array, pose: Array, width: Array) -> Misfit:
        """Deviation of poses `[K, 3]` (m, m, rad) from our lanes.

        They are given at road coordinates `s` of (road, lane number).
        """
        out = Misfit.empty(len(where))
        groups: dict[tuple[str, int], list[int]] = {}
        for i, place in enumerate(where):
            groups.setdefault(place, []).append(i)
        for place, members in groups.items():
            rows = np.array(members)
            for lane in self.lanes.get(place, ()):
                lo, hi = sorted((lane.road_s[0], lane.road_s[-1]))
                inside = rows[(s[rows] >= lo - NO_SECTION) & (s[rows] <= hi + NO_SECTION)]
                if len(inside):
                    self._fit(lane, inside, s, pose, width, out)
        known = np.flatnonzero(np.isfinite(out.lateral))
        if len(known):
            xy, heading = self._device([out.lane[i] for i in known], out.at[known])
            delta = pose[known, :2] - xy
            out.device[known] = np.abs(delta[:, 1] * np.cos(heading) - delta[:, 0] * np.sin(heading))
        return out

    def _fit(
        self, lane: Lane, rows: NDArray[np.int_], s: Array, pose: Array, width: Array, out: Misfit
    ) -> None:
        start = lane.s_at_road(s[rows])
        at, lateral, residual = project(lane, pose[rows, :2], start)
        # A point beyond the end of the lane is off by as much as it is beyond, less rounding.
        lateral = np.hypot(lateral, np.maximum(np.abs(residual) - 1e-4, 0.0))
        # Where two lanes meet both are right; of the same road the later one is in charge.
        better = ~(lateral > out.lateral[rows] + 1e-5)
        rows, at, start, lateral = rows[better], at[better], start[better], lateral[better]
        if not len(rows):
            return
        out.lateral[rows], out.along[rows], out.at[rows] = lateral, np.abs(at - start), at
        _, heading = lane.pose(at)
        out.heading[rows] = np.abs(np.angle(np.exp(1j * (pose[rows, 2] - heading))))
        # At the same road coordinate: where arc length is measured anew, points shift along the road.
        out.width[rows] = np.abs(width[rows] - lane.width_at(start))
        out.may_left[rows] = lane.may_change_left if self._driving(lane.left) else np.nan
        out.may_right[rows] = lane.may_change_right if self._driving(lane.right) else np.nan
        for row in rows:
            out.lane[row] = lane.id

    def _driving(self, lane: str | None) -> bool:
        return lane is not None and self.network.lanes[lane].type is LaneType.DRIVING

    def beside(
        self, marked: set[tuple[str, str, int]], stated: set[tuple[str, str, int]]
    ) -> set[tuple[str, str, int]]:
        """Of these (signal, road, lane): the connectors behind a signal.

        They leave a lane on which traffic passes the signal: one that the file names for it, or one that
        leads into such a connector.
        """
        ways_in: dict[str, set[str]] = {}
        for signal, road, number in stated:
            for lane in self.lanes.get((road, number), ()):
                ways_in.setdefault(signal, {lane.id}).update({lane.id, *lane.predecessors})
        return {
            (signal, road, number)
            for signal, road, number in marked
            for lane in self.lanes.get((road, number), ())
            if lane.junction is not None and ways_in.get(signal, set()) & set(lane.predecessors)
        }

    def on_any_lane(self, pose: Array) -> NDArray[np.bool_]:
        """Which poses lie on one of our driving lanes, within 5 cm."""
        found = np.zeros(len(pose), bool)
        if not found.size:
            return found
        for lane in (lane for lanes in self.lanes.values() for lane in lanes):
            step = max(1, int(0.5 / max(lane.length / len(lane.s), 1e-3)))
            knots = np.unique(np.append(np.arange(0, len(lane.s), step), len(lane.s) - 1))
            gap = np.hypot(*(pose[:, None, :2] - lane.xyz[knots, :2]).transpose(2, 0, 1))
            close = np.flatnonzero((gap.min(1) < 25.0) & ~found)
            if len(close):
                _, lateral, residual = project(lane, pose[close, :2], lane.s[knots[gap[close].argmin(1)]])
                found[close] = (np.abs(lateral) < DEVICE_LATERAL) & (np.abs(residual) < DEVICE_LATERAL)
        return found


def device_poses(network: Network) -> Callable[[Sequence[str], Array], tuple[Array, Array]]:
    """A function that looks up poses on the device map.

    It takes lane ids and arc lengths and returns positions `[K, 2]` and headings `[K]` in float64.
    """
    import jax
    import jax.numpy as jnp

    from limsim_jax.maps.lane_map import lane_rows, pose
    from limsim_jax.maps.rasterise import build_lane_map

    lane_map = build_lane_map(network)
    rows = lane_rows(network)
    origin = np.asarray(lane_map.origin, np.float64)[:2]
    at = jax.jit(pose)

    def poses(lanes: Sequence[str], s: Array) -> tuple[Array, Array]:
        size = 4 ** max(5, math.ceil(math.log(len(s), 4)))  # few sizes, few compilations
        lane = np.zeros(size, np.int32)
        lane[: len(s)] = [rows[i] for i in lanes]
        padded = jnp.asarray(np.pad(s, (0, size - len(s))), jnp.float32)
        x, y, heading = (np.asarray(v, np.float64)[: len(s)] for v in at(lane_map, jnp.asarray(lane), padded))
        return np.stack([x, y], -1) + origin, heading

    return poses
