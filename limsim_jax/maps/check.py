"""Checks of a network: gaps, kinks, and circles of right of way."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from limsim_jax.maps.network import Lane, Network

GAP = 0.01
"""Largest distance (m) between the ends of two linked lanes that counts as continuous."""

KINK = math.radians(0.5)
"""Largest jump of heading (rad) between two linked lanes that counts as continuous."""


@dataclass(frozen=True, kw_only=True)
class Seam:
    """A link between two lanes at which the centre line jumps."""

    before: str  # lane id
    after: str  # lane id
    gap: float  # m, distance between the end of one and the start of the other
    kink: float  # rad, heading after minus heading before, in (-pi, pi]
    junction: str | None  # the junction that one of the lanes crosses

    def __str__(self) -> str:
        place = f" in junction {self.junction}" if self.junction is not None else ""
        jump = f"gap {self.gap:.3f} m, kink {math.degrees(self.kink):.2f} deg"
        return f"{self.before} -> {self.after}{place}: {jump}"


def seams(network: Network, *, gap: float = GAP, kink: float = KINK) -> Iterator[Seam]:
    """Links between drivable lanes that jump, in file order.

    Those of more than `gap` (m) or `kink` (rad) count.
    """
    for before in network.drivable_lanes():
        for after in (network.lanes[name] for name in before.successors):
            seam = _seam(before, after)
            if after.drivable and (seam.gap > gap or abs(seam.kink) > kink):
                yield seam


def deadlocks(network: Network) -> list[list[str]]:
    """Circles of right of way, as lane ids: see `priority_cycles`."""
    from limsim_jax.maps.conflicts import build_conflicts, connectors, priority_cycles
    from limsim_jax.maps.lane_map import lane_rows

    lanes = connectors(network)
    table = build_conflicts(network, lane_rows(network))
    return [[lanes[k].id for k in cycle] for cycle in priority_cycles(table)]


def _seam(before: Lane, after: Lane) -> Seam:
    turn = float(after.heading[0] - before.heading[-1])
    return Seam(
        before=before.id,
        after=after.id,
        gap=float(np.linalg.norm(after.xyz[0] - before.xyz[-1])),
        kink=math.pi - (math.pi - turn) % (2 * math.pi),
        junction=before.junction if before.junction is not None else after.junction,
    )
