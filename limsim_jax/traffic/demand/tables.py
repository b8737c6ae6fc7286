"""Tables of a map and a population on the host."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import (
    LaneMap,
    lane_rows,
)
from limsim_jax.maps.network import Network
from limsim_jax.maps.routing import Round
from limsim_jax.traffic.vehicles import PARAMETERS, Population

CHANGE_ROOM, CHANGE_TIME = 60.0, 6.0
"""m, and s at the speed limit, per lane to cross: the least room to the goal of a vehicle that starts."""


@dataclass(frozen=True)
class Tables:
    """Tables on the host: `L` rows and `G` goals of the lane map, `Y` types of vehicles."""

    network: Network
    goals: tuple[str, ...]
    common: NDArray[np.bool_]  # [G] of traffic without a goal of its own
    rows: dict[str, int]
    classes: NDArray[np.int32]  # of the types of the population
    shares: NDArray[np.float64]  # of the types of the population, adding up to 1
    lengths: tuple[float, float]  # m, of the shortest and the longest vehicle
    widths: NDArray[np.float64]  # [Y] m, of the widest vehicle of a type
    allowed: NDArray[np.bool_]  # [L, Y] types on lanes
    reachable: NDArray[np.bool_]  # [L, G]
    lanes_to_go: NDArray[np.int32]  # [L, G]
    change_distance: NDArray[np.float64]  # [L, G] m
    speed_limit: NDArray[np.float64]  # [L] m/s

    @staticmethod
    def of(
        network: Network,
        lane_map: LaneMap,
        goals: Mapping[str, Sequence[str]],
        population: Population,
        common: Collection[str] | None = None,
    ) -> Tables:
        """Tables of a map, its goals and a population.

        `common` are the goals of traffic without one of its own; None: all.
        Raises `ValueError` if the goals do not fit."""
        rows = lane_rows(network)
        is_goal, reachable = (np.asarray(x) for x in (lane_map.routes.is_goal, lane_map.routes.reachable))
        for column, (name, lanes) in enumerate(goals.items()):
            ends = [rows[lane] for lane in lanes if lane in rows]
            there = reachable if isinstance(lanes, Round) else is_goal
            if column >= there.shape[1] or not ends or not there[ends, column].all():
                raise ValueError(
                    f"goal '{name}' is not number {column} of the lane map, which has other goals"
                )
        share = np.asarray(population.share, float)
        classes = np.asarray(population.vehicle_class)
        length, width = PARAMETERS.index("length"), PARAMETERS.index("width")
        least, most = np.asarray(population.lower, float), np.asarray(population.upper, float)
        access = np.asarray(lane_map.access)
        return Tables(
            network=network,
            goals=tuple(goals),
            common=_common(goals, common, is_goal.shape[1]),
            rows=rows,
            classes=classes,
            shares=share / share.sum(),
            lengths=(float(least[share > 0, length].min()), float(most[share > 0, length].max())),
            widths=most[:, width],
            allowed=(access[:, None] >> classes) & 1 == 1,
            reachable=np.asarray(lane_map.routes.reachable),
            lanes_to_go=np.asarray(lane_map.routes.lanes_to_go),
            change_distance=np.asarray(lane_map.routes.change_distance, float),
            speed_limit=np.asarray(lane_map.speed_limit, float),
        )

    def leaves_room(self, row: Any, s: Any) -> NDArray[np.bool_]:
        """Goals `[*b, G]` with room to change lanes from `s` (m)."""
        room = self.change_distance[row] - np.asarray(s)[..., None]
        per_lane = np.maximum(CHANGE_ROOM, CHANGE_TIME * self.speed_limit[row])[..., None]
        return self.reachable[row] & (room > per_lane * np.abs(self.lanes_to_go[row]))


def _common(goals: Iterable[str], common: Collection[str] | None, size: int) -> NDArray[np.bool_]:
    found = np.zeros(size, bool)
    for column, name in enumerate(goals):
        found[column] = common is None or name in common
    return found


def cumulative(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cumulative shares along the last axis; they end in exactly 1."""
    total = np.cumsum(shares, -1)
    return np.where(total >= total[..., -1:] * (1 - 1e-12), 1.0, total / total[..., -1:])
