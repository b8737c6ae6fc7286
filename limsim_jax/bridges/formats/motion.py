"""A recorded world as bodies that move: what every format needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, absolute, lane_ids
from limsim_jax.traffic.vehicles import DEFAULTS

if TYPE_CHECKING:
    from limsim_jax.api.world import World
    from limsim_jax.maps.network import Network
    from limsim_jax.simulation.trace import Trace

_WHOLE = 1e-3
"""Share of a step by which times may differ from whole steps: those of a trace are float32."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """One vehicle, there at `K` moments without a gap.

    Positions are those of the middle of the body, in coordinates of the map file.
    """

    name: str  # ego, ego_1, ...; vehicle_7: row 7 of the schedule; start_3: was there at the start, slot 3
    ego: bool
    vehicle_class: str  # one of `VEHICLE_CLASSES`
    length: float  # m
    width: float  # m
    first: int  # row of `Motion.time` of its first moment
    x: Float[np.ndarray, " K"]  # m
    y: Float[np.ndarray, " K"]
    heading: Float[np.ndarray, " K"]  # rad, counter-clockwise from the x axis, without jumps
    speed: Float[np.ndarray, " K"]  # m/s
    acceleration: Float[np.ndarray, " K"]  # m/s^2
    lane: tuple[str | None, ...]  # K ids; None beside all lanes
    s: Float[np.ndarray, " K"]  # m along the lane, front bumper
    d: Float[np.ndarray, " K"]  # m, left of its centre

    @property
    def last(self) -> int:
        """Row of `Motion.time` of the last moment."""
        return self.first + len(self.x) - 1

    @property
    def wheelbase(self) -> float:
        """m, in proportion to the length as in the class: a trace holds no axles."""
        k = VEHICLE_CLASSES.index(self.vehicle_class)
        return self.length * DEFAULTS["wheelbase"].median[k] / DEFAULTS["length"].median[k]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """All bodies of a world, egos first, and the clock.

    Attributes:
      title: what it is, in a line.
      scenario: name, as in results.
      seed: of the world.
      network: the map.
      time: s, `[T]`, evenly spaced.
      step: s between two moments.
      bodies: all vehicles.
    """

    title: str
    scenario: str
    seed: int
    network: Network
    time: Float[np.ndarray, " T"]
    step: float
    bodies: tuple[Body, ...]


def motion_of(world: World, every: float | None = None) -> Motion:
    """The bodies of a world.

    Args:
      world: with its trace.
      every: s between moments, a multiple of the time step; None: every step.

    Raises:
      ValueError: a trace of fewer than two moments, or `every` is no multiple of its step.
    """
    trace = world.trace
    time = np.asarray(trace.time, float)
    if len(time) < 2:
        raise ValueError(f"{world.title}: {len(time)} moments; at least two are expected")
    step = round(float(time[-1] - time[0]) / (len(time) - 1), 6)
    rows, count = _rows(time, step, every)
    active = np.asarray(trace.active)[rows]
    if len(rows) < 2 or not active.any():
        raise ValueError(f"{world.title}: {len(rows)} moments with vehicles; at least two are expected")
    shared = {name: np.asarray(getattr(trace, name))[rows] for name in ("lane", "s", "d", "v", "a", "box")}
    x, y = absolute(world.map.lanes, shared["box"][..., 0], shared["box"][..., 1])
    classes = None if trace.vehicle_class is None else np.asarray(trace.vehicle_class)[rows]
    ids = lane_ids(world.map.network)
    names = _Names(world)
    bodies = []
    for first, last, slot, number in _stretches(active, np.asarray(trace.vehicle)[rows]):
        k = slice(first, last + 1)
        lane = tuple(None if row == NO_LANE else ids[row] for row in shared["lane"][k, slot].tolist())
        name, ego = names.of(slot, number)
        bodies.append(
            Body(
                name=name,
                ego=ego,
                vehicle_class="car" if classes is None else VEHICLE_CLASSES[int(classes[first, slot])],
                length=float(shared["box"][first, slot, 3]),
                width=float(shared["box"][first, slot, 4]),
                first=first,
                x=x[k, slot],
                y=y[k, slot],
                heading=np.unwrap(shared["box"][k, slot, 2].astype(float)),
                speed=shared["v"][k, slot].astype(float),
                acceleration=shared["a"][k, slot].astype(float),
                lane=lane,
                s=shared["s"][k, slot].astype(float),
                d=shared["d"][k, slot].astype(float),
            )
        )
    bodies.sort(key=lambda body: (not body.ego, body.name if body.ego else ""))
    clock = np.round(time[rows[0]] / step) * step + count * step * np.arange(len(rows))
    return Motion(
        title=world.title, scenario=world.scenario, seed=world.seed, network=world.map.network,
        time=np.round(clock, 6), step=round(count * step, 6), bodies=tuple(bodies),
    )  # fmt: skip


def _rows(time: NDArray[np.float64], step: float, every: float | None) -> tuple[NDArray[np.int64], int]:
    """Rows of the trace to keep, and steps between them."""
    count = 1 if every is None else round(every / step)
    if every is not None and (count < 1 or abs(every / step - count) > _WHOLE * max(count, 1)):
        raise ValueError(f"every {every:g} s: a multiple of the time step, {step:g} s, is expected")
    number = np.round(time / step).astype(int)
    return np.flatnonzero(number % count == 0), count


def _stretches(active: NDArray[np.bool_], vehicle: Int[np.ndarray, "T N"]) -> list[tuple[int, int, int, int]]:
    """First and last row, slot and number of every vehicle: slots are used again."""
    found = []
    for slot in np.flatnonzero(active.any(0)).tolist():
        there, number = active[:, slot], vehicle[:, slot]
        same = there[1:] & there[:-1] & (number[1:] == number[:-1])
        begins = np.flatnonzero(there & ~np.append(False, same))
        ends = np.flatnonzero(there & ~np.append(same, False))
        found += [(int(i), int(j), slot, int(number[i])) for i, j in zip(begins, ends, strict=True)]
    return sorted(found)


class _Names:
    """Names of vehicles."""

    def __init__(self, world: World) -> None:
        self.egos = {slot: number for slot, number in _egos(world)}
        self.seen: dict[str, int] = {}

    def of(self, slot: int, number: int) -> tuple[str, bool]:
        """Name, and whether it is an ego."""
        ego = self.egos.get(slot) == number
        if ego:
            place = list(self.egos).index(slot)
            name = f"ego_{place}" if place else "ego"
        else:
            name = f"start_{slot}" if number < 0 else f"vehicle_{number}"
        again = self.seen[name] = self.seen.get(name, 0) + 1
        return (name if again == 1 else f"{name}_{again}"), ego


def _egos(world: World) -> list[tuple[int, int]]:
    """Slot and number of every ego: the first vehicle in its slot."""
    trace: Trace = world.trace
    count = 1 if world.episodes is None else world.episodes.egos
    slots = [world.ego]
    if trace.driven is not None:
        driven = np.asarray(trace.driven)[:, :count]
        slots = [int(column[column >= 0][0]) for column in driven.T if (column >= 0).any()] or slots
    active = np.asarray(trace.active)
    return [
        (slot, int(np.asarray(trace.vehicle)[active[:, slot].argmax(), slot]))
        for slot in slots
        if slot >= 0 and active[:, slot].any()
    ]


__all__ = ["Body", "Motion", "motion_of"]
