"""Elements of an OpenDRIVE file as plain records, not interpreted."""

from __future__ import annotations

from dataclasses import dataclass, field

from limsim_jax.maps.opendrive.curves import Cubics, ReferenceLine

SPEED_UNITS = {"": 1.0, "m/s": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6, "mph": 0.44704}
"""Metres per second in one unit of a speed, by its lower-case name."""


@dataclass(frozen=True, kw_only=True)
class RoadLink:
    """Road `predecessor` or `successor`."""

    is_junction: bool
    id: str
    contact: str = ""  # start, end
    s: float | None = None  # virtual junctions: where on the other road
    direction: str = ""  # virtual junctions: + or -
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Mark:
    """Road mark on the outer border of a lane, from `s` on."""

    s: float  # m from the section start
    type: str
    change: str | None  # increase, decrease, both, none
    rules: tuple[str, ...] = ()


@dataclass(kw_only=True)
class RawLane:
    """Lane of a lane section."""

    id: int
    type: str
    forward_sign: int = 0  # 1.8 `direction`: 0 standard, 1 reversed, 2 both
    predecessors: tuple[int, ...] = ()
    successors: tuple[int, ...] = ()
    width: Cubics | None = None
    border: Cubics | None = None
    marks: list[Mark] = field(default_factory=list)
    speeds: list[tuple[float, float]] = field(default_factory=list)  # (s from section start, m/s)
    access: list[tuple[float, str, tuple[str, ...]]] = field(default_factory=list)  # s, rule, classes
    line: int | None = None


@dataclass(kw_only=True)
class RawSection:
    """Lane section; `end` is where the next one starts."""

    s: float
    end: float = 0.0
    lanes: dict[int, RawLane] = field(default_factory=dict)
    line: int | None = None


@dataclass(kw_only=True)
class RawSignal:
    """`signal`, or `signalReference` without the attributes of the signal."""

    id: str
    s: float
    t: float
    z: float = 0.0
    orientation: str
    validity: list[tuple[int, int]]
    reference: bool = False
    name: str = ""
    type: str = ""
    subtype: str = ""
    country: str = ""
    dynamic: bool = False
    value: float | None = None
    unit: str = ""
    heading_offset: float = 0.0
    line: int | None = None


@dataclass(kw_only=True)
class RawObject:
    """`object` that lies flat on the road: crosswalks and painted bars."""

    id: str
    type: str
    subtype: str
    name: str
    s: float
    t: float
    z: float
    heading: float
    length: float
    width: float
    height: float
    outlines: list[list[tuple[bool, float, float]]]  # (is cornerRoad, u or s, v or t)
    validity: list[tuple[int, int]]
    line: int | None = None


@dataclass(kw_only=True)
class RawRoad:
    """Road."""

    id: str
    name: str
    length: float
    junction: str | None
    left_hand: bool
    predecessor: RoadLink | None = None
    successor: RoadLink | None = None
    types: list[tuple[float, str, float | None]] = field(default_factory=list)  # s, type, m/s
    reference: ReferenceLine = field(default_factory=lambda: ReferenceLine([]))
    offset: Cubics = field(default_factory=lambda: Cubics([]))
    elevation: Cubics = field(default_factory=lambda: Cubics([]))
    superelevation: Cubics = field(default_factory=lambda: Cubics([]))
    sections: list[RawSection] = field(default_factory=list)
    signals: list[RawSignal] = field(default_factory=list)
    objects: list[RawObject] = field(default_factory=list)
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class RawConnection:
    """`connection` of a junction.

    `road` is the connecting road or, in direct junctions, the linked road.
    """

    incoming: str | None
    road: str
    contact: str
    lanes: tuple[tuple[int, int], ...]
    line: int | None = None


@dataclass(kw_only=True)
class RawJunction:
    """Junction."""

    id: str
    name: str
    type: str
    main_road: str | None = None
    connections: list[RawConnection] = field(default_factory=list)
    priorities: list[tuple[str, str, int | None]] = field(default_factory=list)  # high, low, line
    controllers: list[str] = field(default_factory=list)
    line: int | None = None


@dataclass(kw_only=True)
class RawController:
    """Signal controller."""

    id: str
    name: str
    sequence: int | None
    signals: tuple[str, ...]
    line: int | None = None
