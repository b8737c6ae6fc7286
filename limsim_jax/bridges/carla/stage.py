"""A recorded world as CARLA shows it: a blueprint, a pose and lights for every vehicle and moment.

The recorder log (`carla_log`) and the live bridge (`carla`) both play this.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.api.world import World
from limsim_jax.log_replay.replay import Replay
from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, LaneMap, absolute, lane_ids
from limsim_jax.maps.map import Map
from limsim_jax.maps.network import Network, TrafficLight
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.recordings.carla_bodies import BODIES, Body
from limsim_jax.simulation.trace import Trace

FULL_STEER = 70.0
"""degrees, angle of the front wheels at steer 1: that of the wheels in CARLA's recorder logs."""

FULL_BRAKE = 8.0
"""m/s^2, deceleration at brake 1: hard braking on a dry road. For show, as all pedals here."""

FULL_THROTTLE = 4.0
"""m/s^2, acceleration at throttle 1."""

BRAKE_LIGHT = 0.5
"""m/s^2, deceleration from which on brake lights shine; below it a vehicle may coast."""

STANDING = 0.1
"""m/s, below it a vehicle stands on its brake."""

NEAR = 2.0
"""m between a light of the map and CARLA's: in Town01 they stand 0.32 m apart."""

_WHEELBASE = 0.6  # of the length
_GRADE = 1.0  # m before and behind the middle between which the grade is measured

Floats = NDArray[np.float64]

_SHOWN = {
    SignalState.RED: 0,
    SignalState.YELLOW: 1,
    SignalState.GREEN_MINOR: 2,
    SignalState.GREEN_MAJOR: 2,
    SignalState.RED_YELLOW: 0,  # CARLA has no such state, and no vehicle may go yet
    SignalState.STOP: 0,
    SignalState.OFF_BLINKING: 3,
    SignalState.OFF: 3,
}
_STATE = np.array([_SHOWN[state] for state in SignalState])


@dataclass(frozen=True)
class Cast:
    """A vehicle of a world."""

    number: int  # of the schedule; below 0: there at the start
    slot: int
    ego: bool
    vehicle_class: str  # of `VEHICLE_CLASSES`; "" if not known
    length: float  # m
    width: float  # m

    def blueprint(self, known: Collection[str] | None = None) -> str:
        """The blueprint that is most like it, of those that are known.

        Raises:
          ValueError: none are known.
        """
        choice = {name: body for name, body in BODIES.items() if known is None or name in known}
        if not choice:
            raise ValueError("no blueprint of CARLA's vehicles is known; at least one is expected")
        wheels = 2 if self.vehicle_class == "motorcycle" else 4

        def unlike(item: tuple[str, Body]) -> tuple[bool, bool, float]:
            body = item[1]
            other = bool(self.vehicle_class) and body.vehicle_class != self.vehicle_class
            size = math.dist((body.length, body.width), (self.length, self.width))
            return body.wheels != wheels, other, size

        return min(choice.items(), key=unlike)[0]


@dataclass(frozen=True, eq=False)
class Stage:
    """`T` moments of `V` vehicles and `L` traffic lights; NaN where a vehicle is not there.

    Positions are those of the middle of the body, on the road, in the coordinates of the map file.
    """

    time: Floats  # [T], s
    cast: tuple[Cast, ...]  # [V]
    x: Floats  # [T, V], m
    y: Floats
    z: Floats
    heading: Floats  # rad
    pitch: Floats  # rad, nose up is positive
    v: Floats  # m/s
    a: Floats  # m/s^2
    lights: tuple[TrafficLight, ...]  # [L]
    states: NDArray[np.int64]  # [T, L], numbers of `recordings.carla_log.LIGHT_STATES`

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Which vehicles are there, `[T, V]`."""
        return np.isfinite(self.x)

    @cached_property
    def since(self) -> Floats:
        """s for which each light has shown its state, `[T, L]`."""
        steps = np.arange(len(self.time))[:, None]
        fresh = np.concatenate([np.ones_like(self.states[:1], bool), np.diff(self.states, axis=0) != 0])
        begun = np.maximum.accumulate(np.where(fresh, steps, 0))
        return self.time[:, None] - self.time[begun]

    @cached_property
    def turning(self) -> Floats:
        """rad/s, `[T, V]`."""
        if len(self.time) < 2:
            return np.zeros_like(self.x)
        turned = np.diff(self.heading, axis=0)
        turned = (turned + math.pi) % (2 * math.pi) - math.pi
        rate = turned / np.diff(self.time)[:, None]
        return np.nan_to_num(np.concatenate([rate, rate[-1:]]))

    @cached_property
    def steer(self) -> Floats:
        """-1 (left) to 1, `[T, V]`: that of a bicycle on its path."""
        length = np.array([one.length for one in self.cast])
        curvature = np.divide(self.turning, self.v, out=np.zeros_like(self.v), where=self.v > 1.0)
        angle = np.degrees(np.arctan(_WHEELBASE * length * curvature))
        return np.clip(-angle / FULL_STEER, -1, 1)

    @cached_property
    def throttle(self) -> Floats:
        """0 to 1, `[T, V]`."""
        return np.clip(self.a / FULL_THROTTLE, 0, 1)

    @cached_property
    def brake(self) -> Floats:
        """0 to 1, `[T, V]`."""
        return np.where(self.v < STANDING, 1.0, np.clip(-self.a / FULL_BRAKE, 0, 1))

    @cached_property
    def braking(self) -> NDArray[np.bool_]:
        """Whether the brake lights shine, `[T, V]`."""
        return (self.a < -BRAKE_LIGHT) | (self.v < STANDING)


def stage_of(world: World | Replay) -> Stage:
    """What CARLA shows of a world, or of a replay's first variant."""
    if isinstance(world, Replay):
        shown = world.world()
        return set_stage(shown.map, shown.trace, shown.ego, lights=False)
    return set_stage(world.map, world.trace, world.ego)


def set_stage(
    town: Map, trace: Trace, ego: int = -1, *, lights: bool = True, lanes: LaneMap | None = None
) -> Stage:
    """What CARLA shows of a trace.

    Args:
      town: where it happened.
      trace: NumPy, `[T, ...]`.
      ego: slot of the ego; -1: none beside those that a policy drives.
      lights: whether the trace knows what the signals show; a log replay does not.
      lanes: of the world, with its signals; None: those of the map.
    """
    lanes, network = town.lanes if lanes is None else lanes, town.network
    active = np.asarray(trace.active, bool)
    slot = np.broadcast_to(np.arange(active.shape[1]), active.shape)
    # vehicles of the start have no number
    number = np.where(np.asarray(trace.vehicle) < 0, -1 - slot, trace.vehicle)
    t, n = np.nonzero(active)
    names, column = np.unique(number[t, n], return_inverse=True)
    first = np.full(len(names), len(t))
    np.minimum.at(first, column, np.arange(len(t)))
    order = np.argsort(first, kind="stable")  # as they come in
    rank = np.argsort(order)
    column = rank[column]
    cast = tuple(_cast(trace, ego, int(names[k]), int(t[first[k]]), int(n[first[k]])) for k in order)
    box = np.asarray(trace.box, np.float64)
    x, y = absolute(lanes, box[..., 0], box[..., 1])
    z, grade = _heights(network, trace)

    def table(values: Any) -> Floats:
        out = np.full((len(active), len(cast)), np.nan)
        out[t, column] = np.asarray(values, float)[t, n]
        return out

    height, grades = _filled(table(z)), _filled(table(grade))
    signals, states = _lights(network, lanes, np.asarray(trace.phase))
    time = np.asarray(trace.time, np.float64)
    return Stage(
        time=np.round(time - time[0], 6), cast=cast, x=table(x), y=table(y), z=height,
        heading=table(box[..., 2]), pitch=np.arctan(grades), v=table(trace.v), a=table(trace.a),
        lights=signals if lights else (), states=states if lights else states[:, :0],
    )  # fmt: skip


def _cast(trace: Trace, ego: int, number: int, t: int, n: int) -> Cast:
    classes = trace.vehicle_class
    driven = () if trace.driven is None else np.asarray(trace.driven)[t]
    length, width = np.asarray(trace.box)[t, n, 3:]
    kind = "" if classes is None else VEHICLE_CLASSES[int(np.asarray(classes)[t, n])]
    return Cast(number, n, n == ego or n in driven, kind, float(length), float(width))


def _heights(network: Network, trace: Trace) -> tuple[Floats, Floats]:
    """Height (m) and grade of the road below each body.

    Below the middle, `[T, N]`; NaN beside all lanes."""
    lane, ids = np.asarray(trace.lane), lane_ids(network)
    active = np.asarray(trace.active, bool)
    s = np.asarray(trace.s, np.float64) - np.asarray(trace.box, np.float64)[..., 3] / 2
    z, grade = np.full(lane.shape, np.nan), np.full(lane.shape, np.nan)
    for row in np.unique(lane[active]):
        if row == NO_LANE:
            continue
        here, on = active & (lane == row), network.lanes[ids[row]]
        before, behind = np.clip(s[here] + _GRADE, 0, on.length), np.clip(s[here] - _GRADE, 0, on.length)
        rise = np.interp(before, on.s, on.xyz[:, 2]) - np.interp(behind, on.s, on.xyz[:, 2])
        slope = np.divide(rise, before - behind, out=np.zeros_like(rise), where=before > behind)
        ends = [(on.xyz[k + 1, 2] - on.xyz[k, 2]) / (on.s[k + 1] - on.s[k]) for k in (0, -2)]
        slope = np.where(before > behind, slope, np.where(s[here] < 0, *ends))
        inside = np.clip(s[here], 0, on.length)
        z[here] = np.interp(inside, on.s, on.xyz[:, 2]) + slope * (s[here] - inside)
        grade[here] = slope
    return z, grade


def _filled(values: Floats) -> Floats:
    """Columns without gaps.

    The last known value fills a gap, otherwise the first one, otherwise 0."""
    known = np.isfinite(values)
    row = np.where(known, np.arange(len(values))[:, None], -1)
    row = np.maximum.accumulate(row)
    first = known.argmax(0)
    filled = np.take_along_axis(values, np.where(row < 0, first, row), 0)
    return np.nan_to_num(filled)


def _lights(
    network: Network, lanes: LaneMap, phase: NDArray[Any]
) -> tuple[tuple[TrafficLight, ...], NDArray[np.int64]]:
    """Lights that govern a movement, and what they show."""
    heads = signal_heads(network, lanes)
    state = np.asarray(lanes.signals.state)
    shown = [_STATE[state[head.program, phase[:, head.program], head.links[0]]] for head in heads]
    states = np.stack(shown, -1) if shown else np.zeros((len(phase), 0), np.int64)
    return tuple(head.light for head in heads), states


class Head(NamedTuple):
    """A light, and which links of which signal program it shows."""

    light: TrafficLight
    program: int  # row of the signal table
    links: tuple[int, ...]


def signal_heads(network: Network, lanes: LaneMap) -> list[Head]:
    """The lights that govern a movement with a program."""
    program, link = (np.asarray(x) for x in (lanes.signals.movement_program, lanes.signals.movement_link))
    heads = []
    for light in network.traffic_lights:
        governed = {spot.lane for spot in light.spots}
        meant = [
            movement.index
            for movement in network.movements
            if (movement.incoming in governed or governed.intersection(movement.via))
            and (not light.turns or movement.turn in light.turns)
            and program[movement.index] >= 0
        ]
        if meant:
            row = int(program[meant[0]])
            links = dict.fromkeys(int(link[k]) for k in meant if program[k] == row)
            heads.append(Head(light, row, tuple(links)))
    return heads


def lanes_showing(lanes: LaneMap, heads: Sequence[Head], shown: Mapping[str, str]) -> LaneMap:
    """The map whose lights show what lights elsewhere show.

    Args:
      lanes: the map.
      heads: of the map, see `signal_heads`.
      shown: names of `LIGHT_STATES` by the ids of lights; links of others and of unknown lights keep to their
        programs.
    """
    table = lanes.signals
    state = np.array(table.state)
    for head in heads:
        name = shown.get(head.light.id, "unknown")
        for link in head.links if name in _MEANT else ():
            go = state[head.program, :, link]
            yields = not (go == SignalState.GREEN_MAJOR).any()
            green = SignalState.GREEN_MINOR if yields else SignalState.GREEN_MAJOR
            state[head.program, :, link] = green if name == "green" else _MEANT[name]
    return replace(lanes, signals=replace(table, state=jnp.asarray(state, jnp.asarray(table.state).dtype)))


_MEANT = {
    "red": SignalState.RED,
    "yellow": SignalState.YELLOW,
    "green": SignalState.GREEN_MAJOR,
    "off": SignalState.OFF_BLINKING,  # vehicles yield
}


def nearest_light(lights: Sequence[TrafficLight], x: float, y: float) -> int | None:
    """The light that stands at a place.

    The place is in m, in coordinates of the map file. None: there is no light."""
    distance = [math.dist(light.position[:2], (x, y)) for light in lights]
    if not distance or min(distance) > NEAR:
        return None
    return distance.index(min(distance))


def town_of(network: Network) -> str:
    """The name that CARLA gives the map of a network.

    `Town05` for files such as `carla_town05.xodr`; otherwise `OpenDriveMap`, as worlds are called that
    CARLA generates from a file.
    """
    found = re.search(r"town(\d\d(?:hd)?)(_opt)?", Path(network.source).name, re.IGNORECASE)
    if found is None:
        return "OpenDriveMap"
    return f"Town{found[1].upper()}{'_Opt' if found[2] else ''}"


__all__ = [
    "NEAR",
    "Cast",
    "Head",
    "Stage",
    "lanes_showing",
    "nearest_light",
    "set_stage",
    "signal_heads",
    "stage_of",
    "town_of",
]
