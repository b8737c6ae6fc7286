"""What a shared world and its SUMO tell each other: plain values and NumPy arrays.

Places are those of SUMO: the middle of the front bumper, m; angles in degrees clockwise from north.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

GHOST = "limsim_ghost."
"""Begin of the ids of ghosts: a body that reaches into a second lane is there a second time, thin."""


class SumoError(ValueError):
    """SUMO cannot run, or has ended; one line."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """How a simulation starts.

    Attributes:
      arguments: files and options of SUMO, as on its command line.
      seed: of SUMO's random numbers.
      dt: s, length of a step.
      gui: show SUMO's window (`sumo-gui`).
      outputs: write the files that the arguments and files ask for; otherwise they go to a folder that is
        removed: worlds side by side would overwrite each other's.
    """

    arguments: tuple[str, ...]
    seed: int
    dt: float
    gui: bool = False
    outputs: bool = False


class Started(NamedTuple):
    """What there is in a simulation."""

    version: str
    time: float  # s
    lanes: tuple[str, ...]  # ids
    lengths: NDArray[np.float64]  # m, of the lanes
    lights: tuple[str, ...]  # ids


class Newcomer(NamedTuple):
    """A vehicle that has come."""

    handle: int  # its number from now on
    id: str
    kind: str  # vClass
    length: float  # m
    width: float  # m
    tau: float  # s
    min_gap: float  # m
    accel: float  # m/s^2
    decel: float  # m/s^2
    emergency_decel: float  # m/s^2
    max_speed: float  # m/s
    speed_factor: float
    edges: tuple[str, ...]  # of the rest of its route, each once


class Reading(NamedTuple):
    """The road after a step: `V` vehicles, and what has happened."""

    time: float  # s
    handle: NDArray[np.int32]
    lane: NDArray[np.int32]  # index into `Started.lanes`; -1: on none
    s: NDArray[np.float64]  # m along SUMO's lane
    x: NDArray[np.float64]  # m
    y: NDArray[np.float64]
    angle: NDArray[np.float64]  # degrees
    v: NDArray[np.float64]  # m/s
    a: NDArray[np.float64]  # m/s^2
    new: tuple[Newcomer, ...]
    routes: dict[int, tuple[str, ...]]  # edges to go, of vehicles with another route than before
    gone: dict[int, bool]  # vehicles that have left: whether they have arrived
    lights: tuple[str, ...]  # state of every light
    collisions: tuple[tuple[int, int], ...]  # collider and victim; the owner of a ghost stands for it
    pending: int  # vehicles that wait to be inserted
    expected: int  # vehicles on the road or still to come
    owned: frozenset[int]  # vehicles that we own and that SUMO still has


class Move(NamedTuple):
    """Where a vehicle of ours is at the end of the step."""

    x: float
    y: float
    angle: float
    v: float | None = None  # m/s; None: as the way tells
    a: float = 0.0  # m/s^2
    edges: tuple[str, ...] = ()  # of our route, from the present edge on; empty: as SUMO has it
    ghost: tuple[float, float, float] | None = None  # x, y and angle on a second lane


class Body(NamedTuple):
    """A vehicle of ours that SUMO does not have yet."""

    handle: int  # negative, chosen by us
    id: str
    kind: str  # vClass
    length: float  # m
    width: float  # m
    edge: str  # where it is


@dataclass(frozen=True, kw_only=True)
class Orders:
    """What SUMO has to do before and in the next step."""

    take: tuple[int, ...] = ()  # vehicles of SUMO that are ours from now on
    release: tuple[int, ...] = ()  # vehicles that SUMO drives again
    remove: tuple[int, ...] = ()  # vehicles of ours that have left
    add: tuple[Body, ...] = ()
    move: dict[int, Move] = field(default_factory=dict)
    lights: Mapping[str, str | None] = field(default_factory=dict)  # state; None: SUMO's program again
