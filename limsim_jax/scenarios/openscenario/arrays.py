"""A scenario as arrays for the device: what is fixed (`Board`), and what a step changes (`Memory`).

`K` entities, `C` corridors of `P` points with `M` lanes, `A` rows of actions, `S` elements of the storyboard,
`Q` conditions in `G` groups of `R` triggers, `J` trajectories of `V` points, `L` places, `W` values. Sizes
are padded, so that scenarios of similar size share programs. Coordinates are those of the lane map.
"""

from __future__ import annotations

import enum

from flax import struct
from jaxtyping import Array, Bool, Float, Int


class Shape(enum.IntEnum):
    """How a value goes to its target."""

    STEP = 0
    LINEAR = 1
    SINUSOIDAL = 2
    CUBIC = 3


class Dimension(enum.IntEnum):
    """What the value of a dynamics is."""

    TIME = 0
    RATE = 1
    DISTANCE = 2
    ACCELERATION = 3  # lateral, at most


class Kind(enum.IntEnum):
    """What a row of actions does."""

    NOTHING = 0
    SPEED = 1
    PROFILE = 2
    GAP = 3  # longitudinal distance
    SYNCHRONIZE = 4
    LANE = 5
    OFFSET = 6
    BESIDE = 7  # lateral distance
    TRAJECTORY = 8
    TELEPORT = 9
    ROUTE = 10
    CONTROL = 11
    SEEN = 12
    APPEAR = 13
    DISAPPEAR = 14
    VALUE = 15


LONGITUDINAL = (Kind.SPEED, Kind.PROFILE, Kind.GAP, Kind.SYNCHRONIZE, Kind.TRAJECTORY)
LATERAL = (Kind.LANE, Kind.OFFSET, Kind.BESIDE, Kind.TRAJECTORY)


class Test(enum.IntEnum):
    """What a condition looks at."""

    NEVER = 0
    TIME = 1
    VALUE = 2
    ELEMENT = 3
    HEADWAY = 4
    COLLISION_TIME = 5
    DISTANCE = 6
    REACH = 7
    SPEED = 8
    RELATIVE_SPEED = 9
    ACCELERATION = 10
    STAND_STILL = 11
    TRAVELED = 12
    END_OF_ROAD = 13
    OFFROAD = 14
    COLLISION = 15
    ANGLE = 16


class Rule(enum.IntEnum):
    """Comparisons."""

    EQUAL = 0
    NOT_EQUAL = 1
    GREATER = 2
    GREATER_EQUAL = 3
    LESS = 4
    LESS_EQUAL = 5


class Edge(enum.IntEnum):
    """What of a condition counts: its value, or how it changes."""

    NONE = 0
    RISING = 1
    FALLING = 2
    BOTH = 3


class Frame(enum.IntEnum):
    """Coordinates in which distances are measured."""

    ENTITY = 0
    ROAD = 1
    WORLD = 2


class Along(enum.IntEnum):
    """Direction of a distance or a speed."""

    EUCLIDEAN = 0
    LONGITUDINAL = 1
    LATERAL = 2


class Level(enum.IntEnum):
    """Kinds of elements, from the top down."""

    STORY = 0
    ACT = 1
    GROUP = 2
    MANEUVER = 3
    EVENT = 4
    ACTION = 5


class Phase(enum.IntEnum):
    """State of an element."""

    STANDBY = 0
    RUNNING = 1
    COMPLETE = 2


class Change(enum.IntEnum):
    """Transitions of elements, as bits."""

    START = 1
    END = 2
    STOP = 4
    SKIP = 8


class Priority(enum.IntEnum):
    """What an event does to others of its maneuver."""

    PARALLEL = 0
    OVERRIDE = 1
    SKIP = 2


class PlaceKind(enum.IntEnum):
    """How a place is given."""

    FIXED = 0
    LANE = 1  # relative to an entity: lanes and metres along its corridor
    ROAD = 2  # metres along and across its corridor
    OBJECT = 3  # metres ahead and to the left of it
    WORLD = 4  # metres in x and y


@struct.dataclass(frozen=True, kw_only=True)
class Corridors:
    """Chains of lanes, `roads.Corridor`, as arrays."""

    line: Float[Array, "C P 3"]  # x, y (m), heading (rad, without jumps)
    center: Float[Array, "C P M"]  # m
    half: Float[Array, "C P M"]  # m
    number: Int[Array, "C P M"]
    sign: Float[Array, "C P"]
    start: Float[Array, " C"]  # m, of the first point
    last: Int[Array, " C"]  # the last point that is real
    free: Bool[Array, " C"]  # no road


@struct.dataclass(frozen=True, kw_only=True)
class Entities:
    """What moves."""

    length: Float[Array, " K"]  # m
    width: Float[Array, " K"]  # m
    ahead: Float[Array, " K"]  # m, middle of the body ahead of its reference point
    kind: Int[Array, " K"]  # 0 vehicle, 1 pedestrian, 2 miscellaneous
    policy: Bool[Array, " K"]  # a policy may drive it
    real: Bool[Array, " K"]  # no padding


@struct.dataclass(frozen=True, kw_only=True)
class Places:
    """Positions that actions and conditions name."""

    kind: Int[Array, " L"]  # a `PlaceKind`
    pose: Float[Array, "L 3"]  # x, y, heading of a fixed one; the heading of others
    corridor: Int[Array, " L"]  # that an entity takes there; -1: its own
    entity: Int[Array, " L"]  # that it is relative to
    along: Float[Array, " L"]  # ds or dx, m
    beside: Float[Array, " L"]  # offset, dt or dy, m
    lanes: Int[Array, " L"]  # to the left
    turned: Int[Array, " L"]  # 0: along the road or entity; 1: heading relative to that; 2: absolute


@struct.dataclass(frozen=True, kw_only=True)
class Trajectories:
    """Paths of straight pieces."""

    points: Float[Array, "J V 3"]  # x, y, heading
    way: Float[Array, "J V"]  # m from the start
    time: Float[Array, "J V"]  # s
    last: Int[Array, " J"]
    local: Bool[Array, " J"]  # from where the entity is


@struct.dataclass(frozen=True, kw_only=True)
class ActionRows:
    """Actions, one row for each of their actors."""

    kind: Int[Array, " A"]  # a `Kind`
    element: Int[Array, " A"]  # of the storyboard
    entity: Int[Array, " A"]  # actor
    only_triggering: Bool[Array, " A"]  # acts only where the entity meets the condition of its event
    shape: Int[Array, " A"]
    dimension: Int[Array, " A"]
    over: Float[Array, " A"]  # value of the dynamics: s, m, rate
    value: Float[Array, " A"]  # target: speed, distance, offset
    other: Int[Array, " A"]  # entity that the target is relative to; -1: none
    lane: Int[Array, " A"]  # number of the lane, or lanes to the left of the other
    factor: Bool[Array, " A"]
    time_gap: Bool[Array, " A"]
    freespace: Bool[Array, " A"]
    side: Int[Array, " A"]  # +1 ahead of or left of the other, -1 behind or right, 0 where it is
    continuous: Bool[Array, " A"]
    limits: Float[Array, "A 3"]  # acceleration, deceleration (m/s^2), speed (m/s)
    place: Int[Array, " A"]  # target
    place_other: Int[Array, " A"]  # target of the master
    steady: Float[Array, "A 2"]  # m and s before the target, from which the speed is constant
    corridor: Int[Array, " A"]  # of a route
    trajectory: Int[Array, " A"]
    timed: Bool[Array, " A"]
    absolute: Bool[Array, " A"]  # times of a trajectory count from the start of the scenario
    offset: Float[Array, " A"]  # s, or m from the start of the trajectory if it is not timed
    speeds: Float[Array, "A F"]  # m/s, of a profile
    times: Float[Array, "A F"]  # s from its start
    variable: Int[Array, " A"]
    how: Int[Array, " A"]  # 0 set, 1 add, 2 multiply


@struct.dataclass(frozen=True, kw_only=True)
class Elements:
    """Parts of the storyboard."""

    level: Int[Array, " S"]  # a `Level`; -1: padding
    parent: Int[Array, " S"]  # -1: none
    start: Int[Array, " S"]  # trigger; -1: none, it starts with its parent
    stop: Int[Array, " S"]  # trigger; -1: none
    most: Int[Array, " S"]  # times that it is executed
    priority: Int[Array, " S"]


@struct.dataclass(frozen=True, kw_only=True)
class Conditions:
    """Tests, with their edges and delays."""

    test: Int[Array, " Q"]  # a `Test`
    group: Int[Array, " Q"]  # -1: padding
    owner: Int[Array, " Q"]  # element while which they are looked at; -1: always
    edge: Int[Array, " Q"]
    delay: Int[Array, " Q"]  # steps
    who: Bool[Array, "Q K"]  # triggering entities
    every: Bool[Array, " Q"]
    rule: Int[Array, " Q"]
    value: Float[Array, " Q"]
    entity: Int[Array, " Q"]  # the other; -1: a place or none
    place: Int[Array, " Q"]
    frame: Int[Array, " Q"]
    along: Int[Array, " Q"]
    freespace: Bool[Array, " Q"]
    tolerance: Float[Array, " Q"]
    kind: Int[Array, " Q"]  # of entities that a collision counts with; -1: all
    elements: Bool[Array, "Q S"]  # that a state is of
    phase: Int[Array, " Q"]  # a `Phase`, -1: none
    change: Int[Array, " Q"]  # bits of `Change`
    variable: Int[Array, " Q"]


@struct.dataclass(frozen=True, kw_only=True)
class Board:
    """A scenario, all but what changes."""

    corridors: Corridors
    entities: Entities
    places: Places
    trajectories: Trajectories
    actions: ActionRows
    elements: Elements
    conditions: Conditions
    group_trigger: Int[Array, " G"]  # trigger of each group; -1: padding
    trigger_elements: Int[Array, " R"]  # padding has no meaning; its length is the number of triggers
    stop: Int[Array, ""]  # trigger that ends the scenario; -1: none
    ring: int = struct.field(pytree_node=False)  # steps that delays look back, at most


@struct.dataclass(frozen=True, kw_only=True)
class Memory:
    """A scenario at one moment."""

    step: Int[Array, ""]
    # entities
    corridor: Int[Array, " K"]
    s: Float[Array, " K"]  # m, reference point along its corridor
    t: Float[Array, " K"]  # m to the left
    yaw: Float[Array, " K"]  # rad, of the body against its path
    pose: Float[Array, "K 3"]  # x, y, heading of the reference point
    v: Float[Array, " K"]  # m/s along the corridor
    a: Float[Array, " K"]  # m/s^2
    across: Float[Array, " K"]  # m/s to the left
    column: Int[Array, " K"]  # lane that it keeps to
    off: Float[Array, " K"]  # m to the left of the middle of that
    held: Bool[Array, " K"]  # moved by the scenario, not by a policy
    there: Bool[Array, " K"]
    seen: Bool[Array, " K"]  # by other traffic
    travelled: Float[Array, " K"]  # m
    stood: Float[Array, " K"]  # s; -1: it moves
    ended: Float[Array, " K"]  # s at the end of its road; -1: it is not there
    off_road: Float[Array, " K"]  # s; -1: it is on a lane
    longitudinal: Int[Array, " K"]  # row of the action that rules; -1: none
    lateral: Int[Array, " K"]
    # actions
    at: Float[Array, " A"]  # s, when they began; inf: not running
    base: Float[Array, " A"]  # speed, or metres from the start of a trajectory, at their begin
    target: Float[Array, " A"]
    span: Float[Array, " A"]  # s or m that they take
    went: Float[Array, " A"]  # m travelled since
    column_from: Int[Array, " A"]
    off_from: Float[Array, " A"]
    anchor: Float[Array, "A 3"]  # pose at their begin
    done: Bool[Array, " A"]
    # storyboard
    phase: Int[Array, " S"]
    change: Int[Array, " S"]  # bits of `Change` since the last look
    runs: Int[Array, " S"]
    # conditions
    before: Bool[Array, " Q"]
    looked: Bool[Array, " Q"]
    past: Bool[Array, "Q D"]
    values: Float[Array, " W"]
    over: Bool[Array, ""]
