"""The types of a simulation.

`Config` is fixed for a run, `Scenario` for an episode; a step changes the `State`. Shapes stand at the
fields: `N` vehicle slots, `V` vehicles of a schedule, `O` origins, `E` egos, `A` actions, `Z` zones. All
types describe one world; a batch is a `vmap`. SI units, radians, counter-clockwise; `d > 0` is left.
"""

from __future__ import annotations

import enum
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int


@struct.dataclass(frozen=True, kw_only=True)
class Config:
    """Fixed for a run. All static: another value is another program."""

    dt: float = struct.field(pytree_node=False)  # s, physics step
    decision_every: int = struct.field(pytree_node=False, default=5)  # physics steps per decision
    look_ahead: float = struct.field(pytree_node=False, default=300.0)  # m along the route
    look_ahead_lanes: int = struct.field(pytree_node=False, default=4)  # lanes beyond the own one, at least

    @property
    def decision_time(self) -> float:
        """Seconds between two decisions."""
        return self.dt * self.decision_every

    def time(self, step: Int[Array, ""]) -> Float[Array, ""]:
        """Seconds since the start after this many physics steps."""
        return step.astype(jnp.float32) * self.dt


@struct.dataclass(frozen=True, kw_only=True)
class Driver:
    """How a vehicle is driven. Paper symbols for paper parameters."""

    speed_factor: Float[Array, " N"]  # desired speed over the speed limit
    v_max: Float[Array, " N"]  # m/s, what the vehicle or its driver never exceeds
    T: Float[Array, " N"]  # s, time gap
    s0: Float[Array, " N"]  # m, standstill gap
    a: Float[Array, " N"]  # m/s^2, largest acceleration
    b: Float[Array, " N"]  # m/s^2, comfortable deceleration
    delta: Float[Array, " N"]  # acceleration exponent
    b_max: Float[Array, " N"]  # m/s^2, hardest braking
    coolness: Float[Array, " N"]  # 0..1, trust that the leader does not brake hard (ACC-IDM)
    politeness: Float[Array, " N"]  # MOBIL p
    threshold: Float[Array, " N"]  # m/s^2, MOBIL a_th: least advantage of a lane change
    b_safe: Float[Array, " N"]  # m/s^2, braking that a lane change may ask of the follower
    keep_right: Float[Array, " N"]  # m/s^2, MOBIL bias towards the right lane (left with left-hand traffic)
    lane_change_time: Float[Array, " N"]  # s
    a_lat: Float[Array, " N"]  # m/s^2, lateral acceleration accepted in bends
    gap_factor: Float[Array, " N"]  # factor on the gaps accepted at junctions
    svo: Float[Array, " N"]  # rad, social value orientation: 0 egoistic, pi/4 prosocial


@struct.dataclass(frozen=True, kw_only=True)
class Shape:
    """Body of a vehicle."""

    length: Float[Array, " N"]  # m
    width: Float[Array, " N"]  # m
    wheelbase: Float[Array, " N"]  # m
    vehicle_class: Int[Array, " N"]  # index into maps.lane_map.VEHICLE_CLASSES


class Status(enum.IntFlag):
    """Bits of `State.status`: what has happened to a vehicle since it entered."""

    COLLIDED = 1
    OFF_ROAD = 2
    WRONG_WAY = 4
    RED_LIGHT = 8  # crossed a stop line on red
    MISSED_ROUTE = 16  # could not reach the lane that its goal needs
    NOT_FINITE = 32
    HARD_BRAKE = 64  # braked harder than its driver's `b_max`
    SCRIPTED = 128  # a vehicle of the experiment's `[[vehicle]]` list


class Order(enum.IntEnum):
    """What an action of a script asks of its vehicle."""

    BRAKE = 0
    SPEED = 1
    CHANGE_LANE = 2
    LEAVE = 3


@struct.dataclass(frozen=True, kw_only=True)
class Actions:
    """Orders to vehicles, `A` of them; those of a vehicle stand in the order in which they begin.

    An action begins when all its conditions hold and the one before it has begun.
    """

    slot: Int[Array, " A"]  # of its vehicle
    order: Int[Array, " A"]  # an `Order`
    value: Float[Array, " A"]  # BRAKE: m/s^2; SPEED: m/s; CHANGE_LANE: +1 left, -1 right
    rate: Float[Array, " A"]  # m/s^2, SPEED: how fast it gets there; 0: as its driver would
    duration: Float[Array, " A"]  # s; inf: until the next one; CHANGE_LANE: of the move, inf: its driver's
    careful: Bool[Array, " A"]  # minds others, bends and signals all the same
    # conditions
    at: Float[Array, " A"]  # s since the start, at least
    within: Float[Array, " A"]  # m to the nearest ego, middle to middle, at most
    travelled: Float[Array, " A"]  # m since the start, at least
    after: Float[Array, " A"]  # s since the one before has begun, at least
    before: Int[Array, " A"]  # the action before it, -1: none


@struct.dataclass(frozen=True, kw_only=True)
class Zones:
    """Speed limits and friction that differ from the map's, `Z` zones."""

    lanes: Bool[Array, "Z L"]
    begin: Float[Array, " Z"]  # s
    end: Float[Array, " Z"]  # s
    limit: Float[Array, " Z"]  # m/s; inf: the map's
    friction: Float[Array, " Z"]  # coefficient between tyres and road; inf: of a dry road


@struct.dataclass(frozen=True, kw_only=True)
class Script:
    """What an experiment says about single vehicles and places."""

    actions: Actions | None
    zones: Zones | None


@struct.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a script is."""

    begun: Float[Array, " A"]  # s, when each action began; inf: not yet
    made: Bool[Array, " A"]  # lane changes that have started


@struct.dataclass(frozen=True, kw_only=True)
class Outside:
    """Vehicles that something outside of the traffic moves, `K` of them."""

    slot: Int[Array, " K"]  # -1: none
    held: Bool[Array, " K"]  # moved from outside now; otherwise by the traffic or a policy
    there: Bool[Array, " K"]
    x: Float[Array, " K"]  # m, middle of the body
    y: Float[Array, " K"]
    heading: Float[Array, " K"]  # rad
    v: Float[Array, " K"]  # m/s
    a: Float[Array, " K"]  # m/s^2
    box: Float[Array, "K 5"]  # bodies now, as `motion.boxes`
    over: Bool[Array, ""]  # the episode is at its end
    memory: Any  # of the player


@struct.dataclass(frozen=True, kw_only=True)
class HumanMemory:
    """What human drivers err in and remember: see `traffic.human`."""

    gap: Float[Array, " N"]  # error of the gap, of variance 1
    speed: Float[Array, " N"]  # error of the leader's speed, of variance 1
    noise: Float[Array, " N"]  # random acceleration, of variance 1
    a: Float[Array, "N H"]  # m/s^2, wanted in the last `H` steps, the latest first


@struct.dataclass(frozen=True, kw_only=True)
class Schedule:
    """Vehicles that enter from outside: sorted by origin, within an origin by time.

    An origin is a queue in front of one lane: its vehicles enter in order, each when there is room.
    Padding has a `time` that never comes.
    """

    time: Float[Array, " V"]  # s, wants to enter
    lane: Int[Array, " V"]
    s: Float[Array, " V"]  # m, front bumper at entry
    v: Float[Array, " V"]  # m/s, at entry; less where that would not be safe
    goal: Int[Array, " V"]  # column of the route table
    driver: Driver  # [V]
    shape: Shape  # [V]
    start: Int[Array, " O1"]  # rows start[o] .. start[o + 1] - 1 belong to origin o
    script: Script | None = None  # orders of the experiment
    outside: Any = None  # what a player of vehicles from outside needs to know


@struct.dataclass(frozen=True, kw_only=True)
class Queues:
    """What has entered so far."""

    next: Int[Array, " O"]  # row of the schedule that enters next, per origin
    full: Int[Array, ""]  # departures that were due and safe, but no slot was free: counted every decision


@struct.dataclass(frozen=True, kw_only=True)
class Lights:
    """Where the signal programs are; `P` programs and, last, the one that is off."""

    phase: Int[Array, " P"]
    elapsed: Float[Array, " P"]  # s in this phase
    gap: Float[Array, " P"]  # s since a vehicle was last seen on an approach that is green (actuated)


@struct.dataclass(frozen=True, kw_only=True)
class Egos:
    """Vehicles under test, `E` of them (maybe none). Lane, s, d, v, a of an ego are in its slot of `State`.

    A `free` ego moves in the plane by a bicycle model, and its Frenet state follows from that; the others
    keep to lanes as all traffic does, and their Cartesian state follows.
    """

    slot: Int[Array, " E"]
    free: Bool[Array, " E"]
    x: Float[Array, " E"]  # m, centre of the body
    y: Float[Array, " E"]
    heading: Float[Array, " E"]  # rad
    steering: Float[Array, " E"]  # rad, angle of the front wheels, left > 0
    a: Float[Array, " E"]  # m/s^2, of the drive train


@struct.dataclass(frozen=True, kw_only=True)
class State:
    """What a step changes. A slot that is not `active` holds harmless numbers."""

    step: Int[Array, ""]  # physics steps since the start
    driver: Driver  # [N], of the vehicle in the slot
    shape: Shape  # [N]
    active: Bool[Array, " N"]
    vehicle: Int[Array, " N"]  # row of the schedule, -1 for vehicles that were there at the start
    lane: Int[Array, " N"]
    previous: Int[Array, " N"]  # lane before `lane`, on which the tail may still be
    earlier: Int[Array, "N P"]  # lanes before `previous`, the latest first; NO_LANE where not known
    s: Float[Array, " N"]  # m, front bumper along the lane
    d: Float[Array, " N"]  # m, offset of the vehicle from the centre of the lane, left > 0
    v: Float[Array, " N"]  # m/s
    a: Float[Array, " N"]  # m/s^2, of the last step
    goal: Int[Array, " N"]  # column of the route table
    # lane change: a move of the vehicle's centre from the middle of one lane to the middle of the next
    side: Int[Array, " N"]  # +1 on the way to the left, -1 to the right, 0 keeping the lane
    crossed: Bool[Array, " N"]  # `lane` is already the lane that it moves to
    progress: Float[Array, " N"]  # share of the lane change that is done, 0..1
    shift: Float[Array, " N"]  # m, offset from the centre of the lane that it moves to, at the start
    rest: Float[Array, " N"]  # s until the next lane change may start
    # junctions
    waiting: Float[Array, " N"]  # s below walking speed
    yielding: Bool[Array, " N"]  # stood for the right of way, a sign or a full exit at the last decision
    stopped: Bool[Array, " N"]  # has stopped at the stop sign ahead
    # record
    distance: Float[Array, " N"]  # m since it entered
    entered: Float[Array, " N"]  # s, time of entry
    status: Int[Array, " N"]  # bits of `Status`
    struck: Int[Array, " N"]  # slot of the first body that it touched, -1 for none
    struck_at: Float[Array, " N"]  # s, when
    # the rest of the world
    queues: Queues
    lights: Lights
    egos: Egos
    script: Progress | None = None  # None: there is none
    outside: Outside | None = None  # None: there are none
    human: HumanMemory | None = None  # None: drivers see all at once


@struct.dataclass(frozen=True, kw_only=True)
class Scenario:
    """One episode: its start, which includes the egos, and the vehicles that enter later."""

    start: State
    schedule: Schedule
