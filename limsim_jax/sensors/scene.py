"""What there is to see: bodies and lights, and which of them are around an ego."""

from __future__ import annotations

import enum
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, VEHICLE_CLASSES, LaneMap, elevation
from limsim_jax.maps.scenery import FIRST_VEHICLE, LIGHT_BOTTOM, LIGHT_SIZE, Label, Scenery
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.traffic.collision import CLEARANCE, level
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import State

HEIGHTS = {"car": 1.5, "van": 2.86, "truck": 2.4, "bus": 3.4, "motorcycle": 1.5, "emergency": 2.86}
"""Heights of bodies, m (SUMO 1.28: defaults of passenger, delivery, truck, bus, motorcycle, emergency)."""

BRAKING = 1.3
"""Brake lights shine at a deceleration above this, m/s^2 (UN Regulation 13-H, 5.2.22.4)."""

STANDING = 0.1
"""A vehicle below this speed holds its brake, m/s. Chosen."""

SIGNAL_DISTANCE = 30.5
"""m before a turn from which a vehicle signals (100 ft: California Vehicle Code 22108)."""

OBJECTS, LIGHTS = 16, 4
"""Bodies and lights that sensors see, unless told: the nearest ones."""


MOST_SLOTS = 2**15
"""Slots of a world with sensors."""


class Lamp(enum.IntFlag):
    """Lamps of a vehicle that are on."""

    BRAKE = 1
    LEFT = 2
    RIGHT = 4


@struct.dataclass(frozen=True, kw_only=True)
class Scene:
    """All that sensors could see of a moment: `N` slots and the `M` lights of the map."""

    box: Float[Array, "N 5"]  # x, y (m), heading (rad), length, width (m)
    z: Float[Array, " N"]  # m, elevation of the road
    v: Float[Array, " N"]  # m/s
    active: Bool[Array, " N"]
    label: Int[Array, " N"]  # `Label`
    lamps: Int[Array, " N"]  # bits of `Lamp`
    light: Int[Array, " M"]  # `Label` of each light


@struct.dataclass(frozen=True, kw_only=True)
class Bodies:
    """`K` boxes around an ego, in its frame; the lights come last."""

    x: Float[Array, " K"]  # m, middle
    y: Float[Array, " K"]
    z: Float[Array, " K"]  # m, lower side
    heading: Float[Array, " K"]  # rad
    length: Float[Array, " K"]  # m
    width: Float[Array, " K"]
    height: Float[Array, " K"]
    vx: Float[Array, " K"]  # m/s over ground, along the axes of the ego
    vy: Float[Array, " K"]
    label: Int[Array, " K"]
    lamps: Int[Array, " K"]
    slot: Int[Array, " K"]  # of the vehicle; -1: a light
    there: Bool[Array, " K"]


@struct.dataclass(frozen=True, kw_only=True)
class Pose:
    """Place of an ego in the map."""

    x: Float[Array, ""]  # m
    y: Float[Array, ""]
    heading: Float[Array, ""]  # rad


def scene_of(lane_map: LaneMap, scenery: Scenery, state: State) -> Scene:
    """The scene of a state."""
    return Scene(
        box=boxes(lane_map, state),
        z=level(lane_map, state),
        v=state.v,
        active=state.active,
        label=state.shape.vehicle_class + int(FIRST_VEHICLE),
        lamps=_brakes(state.v, state.a) | _signals(lane_map, scenery, state),
        light=_shown(lane_map, scenery, state.lights.phase),
    )


def scene_of_trace(lane_map: LaneMap, scenery: Scenery, trace: Any, step: int) -> Scene:
    """The scene of a step of a recorded `Trace`, on the host.

    A trace holds no routes: turn signals follow from the turns and lane changes that come.
    """
    now = {name: getattr(trace, name)[step] for name in ("box", "v", "a", "active", "lane", "s", "phase")}
    kind = np.zeros(now["lane"].shape, np.int32)
    if trace.vehicle_class is not None:
        kind = np.asarray(trace.vehicle_class[step])
    finite = np.isfinite(now["box"]).all(-1)
    return Scene(
        box=jnp.asarray(np.where(finite[:, None], now["box"], 1), jnp.float32),
        z=elevation(lane_map, jnp.asarray(now["lane"]), jnp.asarray(now["s"]))[0],
        v=jnp.asarray(now["v"]),
        active=jnp.asarray(now["active"] & finite),
        label=jnp.asarray(kind + int(FIRST_VEHICLE), jnp.int32),
        lamps=_brakes(jnp.asarray(now["v"]), jnp.asarray(now["a"]))
        | jnp.asarray(_signals_ahead(lane_map, scenery, trace, step)),
        light=_shown(lane_map, scenery, jnp.asarray(now["phase"])),
    )


def pose_of(scene: Scene, slot: Int[Array, ""] | int) -> Pose:
    """Where the vehicle in a slot is."""
    box = scene.box[slot]
    return Pose(x=box[0], y=box[1], heading=box[2])


def bodies_around(
    scene: Scene,
    scenery: Scenery,
    slot: Int[Array, ""] | int,
    *,
    objects: int = OBJECTS,
    lights: int = LIGHTS,
) -> Bodies:
    """The boxes that sensors of the vehicle in a slot can see.

    The road is flat for sensors: bodies within `traffic.collision.CLEARANCE` of the elevation of the ego
    stand on its ground, others are on another level and out of sight.

    Args:
      scene: the moment.
      scenery: of the map.
      slot: of the ego, whose own body is left out.
      objects: the nearest bodies that count, at most all.
      lights: the nearest lights that count, of those that the ego comes to.

    Raises:
      ValueError: a world with more than `MOST_SLOTS`.
    """
    pose = pose_of(scene, slot)
    number = scene.v.shape[0]
    if number > MOST_SLOTS:
        raise ValueError(f"sensors: {number} slots; expected at most {MOST_SLOTS}")
    seen = scene.active & (jnp.arange(number) != slot) & (jnp.abs(scene.z - scene.z[slot]) <= CLEARANCE)
    near, there = _nearest(scene.box[:, 0] - pose.x, scene.box[:, 1] - pose.y, seen, objects)
    box = scene.box[near]
    label = scene.label[near]
    height = jnp.asarray([HEIGHTS[name] for name in VEHICLE_CLASSES], jnp.float32)[
        jnp.clip(label - int(FIRST_VEHICLE), 0, len(VEHICLE_CLASSES) - 1)
    ]
    v = scene.v[near]
    body = _framed(pose, box[:, 0], box[:, 1], box[:, 2])
    turned = body["heading"]
    zero = jnp.zeros_like(v)
    columns = body | {
        "z": zero, "length": box[:, 3], "width": box[:, 4], "height": height, "vx": v * jnp.cos(turned),
        "vy": v * jnp.sin(turned), "label": label, "lamps": scene.lamps[near], "slot": near, "there": there,
    }  # fmt: skip
    if lights:
        x, y, heading = (scenery.light[:, k] for k in range(3))
        ahead = (x - pose.x) * jnp.cos(heading) + (y - pose.y) * jnp.sin(heading) > 0
        faces = jnp.cos(heading - pose.heading) > 0
        near, there = _nearest(x - pose.x, y - pose.y, (scenery.light_lane >= 0) & ahead & faces, lights)
        lamp = _framed(pose, x[near], y[near], heading[near])
        zero, size = jnp.zeros_like(lamp["x"]), jnp.ones_like(lamp["x"])
        none = jnp.zeros_like(near)
        more = lamp | {
            "z": size * LIGHT_BOTTOM, "length": size * LIGHT_SIZE[0], "width": size * LIGHT_SIZE[1],
            "height": size * LIGHT_SIZE[2], "vx": zero, "vy": zero, "label": scene.light[near],
            "lamps": none, "slot": none - 1, "there": there,
        }  # fmt: skip
        columns = {name: jnp.concatenate([column, more[name]]) for name, column in columns.items()}
    return Bodies(**columns)


def _nearest(
    x: Float[Array, " N"], y: Float[Array, " N"], seen: Bool[Array, " N"], count: int
) -> tuple[Int[Array, " K"], Bool[Array, " K"]]:
    """The nearest of those seen, and which of the answers are there."""
    away = jnp.where(seen, x * x + y * y, jnp.inf)
    found, index = lax.top_k(-away, min(count, away.shape[0]))
    return index.astype(jnp.int32), found > -jnp.inf


def _framed(pose: Pose, x: Array, y: Array, heading: Array) -> dict[str, Array]:
    """Places and headings in the frame of a pose."""
    cos, sin = jnp.cos(pose.heading), jnp.sin(pose.heading)
    dx, dy = x - pose.x, y - pose.y
    return {"x": cos * dx + sin * dy, "y": cos * dy - sin * dx, "heading": heading - pose.heading}


# --- lamps and lights --------------------------------------------------------------------------------


def _brakes(v: Float[Array, " N"], a: Float[Array, " N"]) -> Int[Array, " N"]:
    return jnp.where((a < -BRAKING) | (v < STANDING), int(Lamp.BRAKE), 0)


def _side(turn: Array) -> Array:
    """Lamps for +1 left, -1 right, 0 none."""
    return jnp.where(turn > 0, int(Lamp.LEFT), jnp.where(turn < 0, int(Lamp.RIGHT), 0))


def _signals(lane_map: LaneMap, scenery: Scenery, state: State) -> Int[Array, " N"]:
    """Turn signals: of a lane change in progress, a turn under way, or one that comes."""
    turn = scenery.turn[state.lane]
    way = lane_map.length[state.lane] - state.s
    lane = state.lane
    for _ in range(2):  # a lane before the connector may be short
        lane = jnp.where(lane >= 0, lane_map.routes.next_lane[lane, state.goal], NO_LANE)
        turn = jnp.where((turn == 0) & (way < SIGNAL_DISTANCE), scenery.turn[lane], turn)
        way = way + lane_map.length[lane]
    return _side(jnp.where(state.side != 0, state.side, turn))


def _signals_ahead(lane_map: LaneMap, scenery: Scenery, trace: Any, step: int) -> np.ndarray:
    """Turn signals by what vehicles do in the next steps."""
    turn, left, right = (np.asarray(x) for x in (scenery.turn, lane_map.left, lane_map.right))
    dt = float(trace.time[1] - trace.time[0]) if len(trace.time) > 1 else 0.1
    lane, vehicle = trace.lane[step], trace.vehicle[step]
    found, way, blinks = turn[lane], np.zeros(lane.shape), np.zeros(lane.shape, int)
    for k in range(step + 1, min(step + round(6 / dt), len(trace.time))):
        same = trace.active[k] & (trace.vehicle[k] == vehicle)
        way = way + trace.v[k] * dt
        then, before = trace.lane[k], trace.lane[k - 1]
        found = np.where((found == 0) & same & (way < SIGNAL_DISTANCE), turn[then], found)
        if (k - step) * dt <= 2.5:  # about the first half of a lane change, before the lane is another
            moved = same & (then != before) & (before >= 0) & (then >= 0)
            side = np.where(then == left[before], 1, np.where(then == right[before], -1, 0))
            blinks = np.where((blinks == 0) & moved, side, blinks)
    side = np.where(blinks != 0, blinks, found)
    return np.where(side > 0, int(Lamp.LEFT), np.where(side < 0, int(Lamp.RIGHT), 0)).astype(np.int32)


_SHOWN = {
    SignalState.RED: Label.LIGHT_RED,
    SignalState.YELLOW: Label.LIGHT_YELLOW,
    SignalState.GREEN_MINOR: Label.LIGHT_GREEN,
    SignalState.GREEN_MAJOR: Label.LIGHT_GREEN,
    SignalState.RED_YELLOW: Label.LIGHT_RED,
    SignalState.STOP: Label.LIGHT_RED,
    SignalState.OFF_BLINKING: Label.LIGHT_YELLOW,
    SignalState.OFF: Label.LIGHT_OFF,
}


def _shown(lane_map: LaneMap, scenery: Scenery, phase: Int[Array, " P"]) -> Int[Array, " M"]:
    """The `Label` of every light."""
    table = jnp.asarray([int(_SHOWN[state]) for state in SignalState], jnp.int32)
    return table[lane_states(lane_map.signals, phase)[scenery.light_lane]]


__all__ = ["Bodies", "Lamp", "Pose", "Scene", "bodies_around", "pose_of", "scene_of", "scene_of_trace"]
