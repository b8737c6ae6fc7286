"""SUMO as the referee of a world that we have driven: collisions by its rules, and its own record."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from limsim_jax.bridges.sumo.messages import Body, Move, Orders, Start, SumoError
from limsim_jax.bridges.sumo.process import SumoProcess
from limsim_jax.bridges.sumo.seats import Places, angle_of
from limsim_jax.maps.lane_map import VEHICLE_CLASSES, absolute
from limsim_jax.maps.network import Network

if TYPE_CHECKING:
    from limsim_jax.api.world import World

KINDS = dict(
    zip(VEHICLE_CLASSES, ("passenger", "delivery", "truck", "bus", "motorcycle", "emergency"), strict=True)
)
"""vClass of SUMO for each of our classes."""


class Collision(NamedTuple):
    """Two vehicles that SUMO says collide; the first moment of it."""

    time: float  # s
    slots: tuple[int, int]  # of the world


@dataclass(frozen=True)
class Verdict:
    """What SUMO has seen.

    Attributes:
      collisions: pairs, each once.
      steps: of the world.
      vehicles: that were shown.
      echo: m, largest distance between a place and what SUMO reported.
    """

    collisions: tuple[Collision, ...]
    steps: int
    vehicles: int
    echo: float


def referee(world: World, *, fcd: str | Path | None = None) -> Verdict:
    """Show a world to SUMO, step by step: we drive all vehicles, SUMO watches.

        lj.referee(lj.Experiment(map="town.net.xml", horizon=60).run(seed=3)).collisions

    Args:
      world: of a map that is a SUMO network.
      fcd: file for SUMO's floating car data.

    Raises:
      SumoError: a map of another format, SUMO is missing, or its process ends; one line.
    """
    source = world.map.source
    if not source.endswith((".net.xml", ".net.xml.gz")):
        raise SumoError(f"{source}: SUMO knows its own networks only; a .net.xml is expected")
    trace, network = world.trace, world.map.network
    dt = float(trace.time[1] - trace.time[0]) if len(trace.time) > 1 else 0.1
    record = () if fcd is None else ("--fcd-output", str(fcd))
    runs = _Runs(world)
    found: dict[tuple[int, int], Collision] = {}
    echo = 0.0
    with SumoProcess(Start(arguments=("-n", source, *record), seed=0, dt=dt, outputs=True)) as sumo:
        Places(network, world.map.lanes, sumo.there)
        before: set[int] = set()
        for t, time in enumerate(trace.time):
            now = {runs.handle(t, int(slot)): int(slot) for slot in np.flatnonzero(trace.active[t])}
            there = set(now)
            add = tuple(runs.body(h, t, now[h]) for h in sorted(there - before, reverse=True))
            moves = {h: runs.move(h, t, slot) for h, slot in now.items()}
            reading = sumo.step(Orders(add=add, remove=tuple(before - there), move=moves))
            before = there
            for k, handle in enumerate(reading.handle.tolist()):
                if handle in moves:
                    away = np.hypot(reading.x[k] - moves[handle].x, reading.y[k] - moves[handle].y)
                    echo = max(echo, float(away))
            for pair in reading.collisions:
                if pair[0] in now and pair[1] in now:
                    slots = tuple(sorted((now[pair[0]], now[pair[1]])))
                    key = min(pair), max(pair)
                    found.setdefault(key, Collision(float(time), (slots[0], slots[1])))
    return Verdict(tuple(found.values()), len(trace.time), runs.count, echo)


class _Runs:
    """The vehicles of a trace: one handle for each that is in a slot for some time."""

    def __init__(self, world: World) -> None:
        trace, network = world.trace, world.map.network
        self.trace, self.network = trace, network
        ids, steps = world.map.lane_ids, len(trace.time)
        self._handle = np.zeros(trace.active.shape, np.int64)
        self._roads: dict[int, tuple[np.ndarray, list[str]]] = {}
        self.count = 0
        for slot in range(trace.active.shape[1]):
            here = np.flatnonzero(trace.active[:, slot])
            cuts = np.flatnonzero((np.diff(here) > 1) | (np.diff(trace.vehicle[here, slot]) != 0)) + 1
            for part in np.split(here, cuts) if here.size else []:
                self.count += 1
                self._handle[part, slot] = -self.count
                lanes = [_road(network, ids[row]) for row in trace.lane[part, slot]]
                at = np.full(steps, -1)
                ways = [road for road, _ in itertools.groupby(lanes)]
                at[part] = np.cumsum([0, *(a != b for a, b in itertools.pairwise(lanes))])
                self._roads[-self.count] = at, ways
        half = trace.box[..., 3] / 2
        x, y = (trace.box[..., k] + half * f(trace.box[..., 2]) for k, f in ((0, np.cos), (1, np.sin)))
        self.x, self.y = absolute(world.map.lanes, x, y)

    def handle(self, t: int, slot: int) -> int:
        """The handle of the vehicle in a slot."""
        return int(self._handle[t, slot])

    def body(self, handle: int, t: int, slot: int) -> Body:
        """A vehicle that comes."""
        length, width = self.trace.box[t, slot, 3:5].tolist()
        known = self.trace.vehicle_class
        kind = "car" if known is None else VEHICLE_CLASSES[int(known[t, slot])]
        at, roads = self._roads[handle]
        return Body(handle, f"v{-handle}", KINDS[kind], length, width, roads[at[t]])

    def move(self, handle: int, t: int, slot: int) -> Move:
        """Where it is, and over which edges it goes on."""
        at, roads = self._roads[handle]
        ahead: list[str] = []
        for road in roads[at[t] :]:
            if road in ahead:
                break
            ahead.append(road)
        trace = self.trace
        return Move(
            float(self.x[t, slot]), float(self.y[t, slot]), float(angle_of(trace.box[t, slot, 2])),
            float(trace.v[t, slot]), float(trace.a[t, slot]), edges=tuple(ahead),
        )  # fmt: skip


def _road(network: Network, lane: str) -> str:
    """The edge of a lane; of a lane within a junction the next edge."""
    found = network.lanes[lane]
    while found.junction is not None and found.successors:
        found = network.lanes[found.successors[0]]
    return found.road


__all__ = ["Collision", "Verdict", "referee"]
