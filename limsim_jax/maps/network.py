"""Road network on the host, the same type from every reader.

Exact, in float64 and of ragged sizes. A `Network` holds what a map file states, in one vocabulary.
Readers build it, `rasterise` turns it into device arrays, `report.draw` shows it. Nothing here uses JAX.

Conventions: SI units, radians counter-clockwise, right-handed x east / y north. Every lane runs in
its travel direction: `s = 0` is where traffic enters it, `left` is the driver's left.
"""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

Array = NDArray[np.float64]


class MapError(ValueError):
    """A map that cannot be used.

    One line: file, line, element, reason and, if known, the remedy.
    """

    def __init__(
        self,
        reason: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        element: str | None = None,
    ) -> None:
        self.reason, self.file, self.line, self.element = reason, file, line, element
        place = f"{file if file is not None else 'map'}" + (f":{line}" if line else "")
        super().__init__(": ".join(_one_line(part) for part in (place, element, reason) if part))

    def __reduce__(self) -> Any:
        return _rebuild_map_error, (self.reason, self.file, self.line, self.element)


def _one_line(text: str, longest: int = 500) -> str:
    """The text without line breaks, shortened where it is very long."""
    text = " ".join(text.split())
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-longest // 4 :]}"


def _rebuild_map_error(reason: str, file: Any, line: Any, element: Any) -> MapError:
    return MapError(reason, file=file, line=line, element=element)


class Action(enum.StrEnum):
    """How a reader treated an element of the file."""

    READ = "read"  # taken over exactly
    APPROXIMATED = "approximated"  # taken over, but not exactly
    IGNORED = "ignored"  # not taken over
    REPAIRED = "repaired"  # broken in the file, repaired here
    ADDED = "added"  # not in the file, and needed: made up here
    UNUSABLE = "unusable"  # stated in the file, and nothing that traffic could follow


@dataclass(frozen=True, kw_only=True)
class Note:
    """One line of the import report."""

    action: Action
    element: str  # kind: "lane", "signal", "laneSection", ...
    where: str  # ids a person can search the file for: "road 12 section 0 lane -1"
    message: str
    line: int | None = None

    def __str__(self) -> str:
        place = f"line {self.line}: " if self.line else ""
        return f"{self.action:<12} {place}{self.element} {self.where}: {self.message}".rstrip()


@dataclass
class ImportReport:
    """What a reader did with every element.

    It has counts per element and action, and a note for every action but READ.
    """

    counts: Counter[tuple[str, Action]] = field(default_factory=Counter)
    notes: list[Note] = field(default_factory=list)

    def read(self, element: str, count: int = 1) -> None:
        """Count elements that were taken over exactly."""
        if count:
            self.counts[element, Action.READ] += count

    def approximated(self, element: str, where: str, message: str, line: int | None = None) -> None:
        """Record an element that was taken over, but not exactly."""
        self._note(Action.APPROXIMATED, element, where, message, line)

    def ignored(
        self, element: str, where: str, message: str, line: int | None = None, *, count: int = 1
    ) -> None:
        """Record an element that was not taken over, or `count` equal ones."""
        self._note(Action.IGNORED, element, where, message, line, count)

    def repaired(self, element: str, where: str, message: str, line: int | None = None) -> None:
        """Record an element that is broken in the file and was repaired."""
        self._note(Action.REPAIRED, element, where, message, line)

    def added(self, element: str, where: str, message: str, line: int | None = None) -> None:
        """Record something that is needed, missing in the file and made up."""
        self._note(Action.ADDED, element, where, message, line)

    def unusable(self, element: str, where: str, message: str, line: int | None = None) -> None:
        """Record a statement of the file that traffic cannot follow."""
        self._note(Action.UNUSABLE, element, where, message, line)

    def _note(
        self, action: Action, element: str, where: str, message: str, line: int | None, count: int = 1
    ) -> None:
        self.counts[element, action] += count
        self.notes.append(Note(action=action, element=element, where=where, message=message, line=line))

    def elements(self) -> list[str]:
        """The elements counted, sorted by name."""
        return sorted({element for element, _ in self.counts})

    def total(self, action: Action) -> int:
        """How many elements met this action."""
        return sum(n for (_, a), n in self.counts.items() if a is action)

    def __str__(self) -> str:
        width = max([len(e) for e in self.elements()] + [7])
        head = f"{'element':<{width}}" + "".join(f"{a.value:>14}" for a in Action)
        rows = [
            f"{e:<{width}}" + "".join(f"{self.counts.get((e, a), 0) or '.':>14}" for a in Action)
            for e in self.elements()
        ]
        return "\n".join([head, *rows])


class LaneType(enum.StrEnum):
    """Lane types of OpenDRIVE 1.8 (table 'lane types'); SUMO lanes map onto them by their permissions."""

    DRIVING = "driving"
    ENTRY = "entry"
    EXIT = "exit"
    ON_RAMP = "onRamp"
    OFF_RAMP = "offRamp"
    CONNECTING_RAMP = "connectingRamp"
    SLIP_LANE = "slipLane"
    BIDIRECTIONAL = "bidirectional"
    BUS = "bus"
    TAXI = "taxi"
    HOV = "HOV"
    SHARED = "shared"
    BIKING = "biking"
    WALKING = "walking"
    SIDEWALK = "sidewalk"
    SHOULDER = "shoulder"
    STOP = "stop"
    PARKING = "parking"
    MEDIAN = "median"
    BORDER = "border"
    CURB = "curb"
    RESTRICTED = "restricted"
    TRAM = "tram"
    RAIL = "rail"
    ROAD_WORKS = "roadWorks"
    SPECIAL = "special"  # special1..3, mwyEntry/mwyExit fold into ENTRY/EXIT
    NONE = "none"


DRIVABLE = frozenset(
    {
        LaneType.DRIVING,
        LaneType.ENTRY,
        LaneType.EXIT,
        LaneType.ON_RAMP,
        LaneType.OFF_RAMP,
        LaneType.CONNECTING_RAMP,
        LaneType.SLIP_LANE,
        LaneType.BUS,
        LaneType.TAXI,
        LaneType.HOV,
        LaneType.SHARED,
    }
)
"""Lane types on which motor traffic runs in one direction: these become rows of a `LaneMap`."""

MOTOR_CLASSES = frozenset({"car", "van", "truck", "bus", "motorcycle", "emergency"})
"""Vehicle classes of the engine."""


class Turn(enum.StrEnum):
    """Which way a movement turns at its junction."""

    STRAIGHT = "straight"
    LEFT = "left"
    RIGHT = "right"
    SLIGHT_LEFT = "slight_left"
    SLIGHT_RIGHT = "slight_right"
    U_TURN = "u_turn"


class Control(enum.StrEnum):
    """What regulates a movement at its stop position."""

    NONE = "none"  # right of way by the general rule (right before left) or nothing to regulate
    PRIORITY = "priority"  # has priority by sign or record
    YIELD = "yield"
    STOP = "stop"
    ALL_WAY_STOP = "all_way_stop"
    SIGNAL = "signal"
    ZIPPER = "zipper"  # merging lanes take turns


@dataclass(frozen=True, kw_only=True, eq=False)
class Lane:
    """A stretch of lane with constant type, limit, neighbours and permissions.

    The centre line is sampled so finely that cubic Hermite interpolation (`pose`) is within 0.1 mm
    of the curve that the file defines. Samples are ascending in `s`; a kink is two samples 1 mm apart.
    """

    id: str  # unique in the network
    road: str  # road (OpenDRIVE) or edge (SUMO) id
    section: int = 0  # lane section within the road, in file order, from 0
    number: int  # lane number in the file: signed in OpenDRIVE, from 0 at the right edge in SUMO
    type: LaneType = LaneType.DRIVING
    s: Float[Array, " M"]  # m, arc length along this centre line, s[0] = 0
    xyz: Float[Array, "M 3"]  # m
    heading: Float[Array, " M"]  # rad, direction of travel, unwrapped
    curvature: Float[Array, " M"]  # 1/m, positive bends left
    width: Float[Array, " M"]  # m, across the road reference line as the file gives it
    road_s: Float[Array, " M"]  # m, coordinate along the road; falls with s where traffic runs against it
    declared_length: float | None = None  # m, length attribute of the file where it has one (SUMO)
    speed_limit: float  # m/s
    access: frozenset[str] = MOTOR_CLASSES  # vehicle classes that may use it
    successors: tuple[str, ...] = ()
    predecessors: tuple[str, ...] = ()
    left: str | None = None  # neighbour in the same direction
    right: str | None = None
    may_change_left: bool = False  # road marks and rules let traffic cross to `left`
    may_change_right: bool = False
    opposite: str | None = None  # oncoming lane beyond the left edge (right edge with left-hand traffic)
    junction: str | None = None  # the junction whose area it crosses: then it is a connector

    @property
    def carriageway(self) -> tuple[str, int, bool]:
        """Key of the lanes side by side in the same direction."""
        return self.road, self.section, self.number < 0

    @property
    def length(self) -> float:
        """Arc length of the centre line, m."""
        return float(self.s[-1])

    @property
    def drivable(self) -> bool:
        """Whether it is for motor traffic."""
        return self.type in DRIVABLE and bool(self.access & MOTOR_CLASSES)

    def pose(self, s: Any) -> tuple[Array, Array]:
        """Position `[..., 3]` (m) and heading `[...]` (rad) at arc length `s`.

        `s` is in m and clipped to the lane.
        """
        s = np.clip(np.asarray(s, float), 0.0, self.length)
        i = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        h = self.s[i + 1] - self.s[i]
        u = (s - self.s[i]) / h
        tangent = np.stack([np.cos(self.heading), np.sin(self.heading)], -1)
        p0, p1 = self.xyz[i, :2], self.xyz[i + 1, :2]
        m0, m1 = tangent[i] * h[..., None], tangent[i + 1] * h[..., None]
        u_ = u[..., None]
        xy = (
            p0 * (1 + 2 * u_) * (1 - u_) ** 2
            + m0 * u_ * (1 - u_) ** 2
            + p1 * u_**2 * (3 - 2 * u_)
            - m1 * u_**2 * (1 - u_)
        )
        dxy = 6 * u_ * (1 - u_) * (p1 - p0) + m0 * (1 - u_) * (1 - 3 * u_) - m1 * u_ * (2 - 3 * u_)
        z = self.xyz[i, 2] + u * (self.xyz[i + 1, 2] - self.xyz[i, 2])
        return np.concatenate([xy, z[..., None]], -1), np.arctan2(dxy[..., 1], dxy[..., 0])

    def width_at(self, s: Any) -> Array:
        """Lane width (m) at arc length `s` (m, clipped)."""
        return np.interp(s, self.s, self.width)

    def s_at_road(self, road_s: Any) -> Array:
        """Arc length (m) at road coordinate `road_s` (m, clipped): the inverse of the `road_s` samples."""
        if self.road_s[-1] >= self.road_s[0]:
            return np.interp(road_s, self.road_s, self.s)
        return np.interp(road_s, self.road_s[::-1], self.s[::-1])


@dataclass(frozen=True, kw_only=True)
class Movement:
    """A way across a junction.

    It leaves `incoming`, follows the `via` connectors in order and enters `outgoing`. `via` is empty
    where the lanes meet directly (direct junctions, SUMO nets without internal lanes).
    """

    index: int  # position in `Network.movements`
    junction: str
    incoming: str  # lane id
    outgoing: str  # lane id
    via: tuple[str, ...] = ()
    turn: Turn = Turn.STRAIGHT
    control: Control = Control.NONE
    program: str | None = None  # signal program that controls it
    link: int | None = None  # its place in the state strings of that program
    yields_to: frozenset[int] = frozenset()  # movements to which the file gives priority
    foes: frozenset[int] = frozenset()  # movements that cross it or merge with it, says the file
    waits_inside: bool = False  # may enter the junction and wait there for its foes (SUMO `cont`)
    keep_clear: bool = True  # must not enter unless it can leave (SUMO `keepClear`)


@dataclass(frozen=True, kw_only=True)
class Junction:
    """A junction and the movements across it, in the file's link order."""

    id: str
    name: str = ""
    type: str = "default"  # OpenDRIVE: default, direct, virtual; SUMO: priority, traffic_light, ...
    movements: tuple[int, ...] = ()  # indices into `Network.movements`
    connectors: tuple[str, ...] = ()  # ids of all lanes inside the junction
    center: tuple[float, float] = (0.0, 0.0)  # m
    outline: tuple[tuple[float, float], ...] = ()  # m, x y around its area, where the file draws it
    roundabout: bool = False  # part of a roundabout, where the file says so


@dataclass(frozen=True, kw_only=True)
class Phase:
    """One state of a signal program."""

    duration: float  # s
    state: str  # one character per link, SUMO's alphabet: r y G g u s o O
    min_duration: float | None = None  # s, actuated programs
    max_duration: float | None = None  # s, actuated programs
    next: tuple[int, ...] = ()  # allowed next phases; empty: the one that follows
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class Program:
    """A signal program: phases in order, repeated with an offset."""

    id: str
    name: str = ""
    type: str = "static"  # static, actuated
    offset: float = 0.0  # s
    phases: tuple[Phase, ...]
    movements: tuple[tuple[int, ...], ...] = ()  # per link: indices of the movements it controls
    generated: bool = False  # the file has lights but no timing, so this program is ours


@dataclass(frozen=True, kw_only=True)
class LaneSpot:
    """A place on a lane."""

    lane: str
    s: float  # m


@dataclass(frozen=True, kw_only=True)
class TrafficLight:
    """A light and where traffic that it governs has to stop."""

    id: str
    name: str = ""
    position: tuple[float, float, float]  # m
    heading: float  # rad, direction of the traffic that looks at it
    spots: tuple[LaneSpot, ...] = ()  # lanes governed, and where its head stands along them
    turns: tuple[Turn, ...] = ()  # arrow lights: the turns governed; empty: all
    controller: str | None = None
    line: int | None = None


class SignKind(enum.StrEnum):
    """Kinds of sign with a meaning for the engine."""

    STOP = "stop"
    YIELD = "yield"
    PRIORITY = "priority"  # has right of way
    SPEED = "speed"
    OTHER = "other"


@dataclass(frozen=True, kw_only=True)
class Sign:
    """A static sign."""

    id: str
    kind: SignKind
    name: str = ""
    position: tuple[float, float, float]  # m
    heading: float  # rad
    value: float | None = None  # m/s for speed signs
    spots: tuple[LaneSpot, ...] = ()
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class StopLine:
    """Where the front bumper has to stop on a lane."""

    id: str
    spot: LaneSpot
    line: int | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Crosswalk:
    """A pedestrian crossing."""

    id: str
    outline: Float[Array, "K 2"]  # m
    spans: tuple[tuple[str, float, float], ...] = ()  # (lane, s_in, s_out): where lanes cross it
    line: int | None = None


@dataclass(frozen=True, kw_only=True)
class Road:
    """A road (OpenDRIVE) or edge (SUMO)."""

    id: str
    name: str = ""
    type: str = ""  # town, motorway, ...; SUMO edge type
    length: float = 0.0  # m, as declared
    junction: str | None = None
    left_hand: bool = False
    priority: int = 0  # SUMO edge priority
    line: int | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Network:
    """All that a map file states about its roads."""

    name: str
    source: str  # path of the file
    file_hash: str  # SHA-256 of its bytes, unpacked
    format: str  # "OpenDRIVE 1.4", "SUMO 1.16"
    geo_reference: str = ""
    lanes: dict[str, Lane]
    roads: dict[str, Road]
    movements: tuple[Movement, ...] = ()
    junctions: dict[str, Junction] = field(default_factory=dict)
    programs: dict[str, Program] = field(default_factory=dict)
    traffic_lights: tuple[TrafficLight, ...] = ()
    signs: tuple[Sign, ...] = ()
    stop_lines: tuple[StopLine, ...] = ()
    crosswalks: tuple[Crosswalk, ...] = ()
    report: ImportReport = field(default_factory=ImportReport)

    def drivable_lanes(self) -> Iterator[Lane]:
        """Lanes on which motor traffic runs, in file order."""
        return (lane for lane in self.lanes.values() if lane.drivable)

    def road_lanes(self, road: str) -> list[Lane]:
        """Lanes of a road, in file order. Raises `MapError` if the map has no such road."""
        found = [lane for lane in self.lanes.values() if lane.road == road]
        if not found:
            raise MapError(
                f"no road '{road}'; ids look like {', '.join(list(self.roads)[:5])}", file=self.source
            )
        return found

    def lane_at(self, road: str, number: int, road_s: float) -> Lane:
        """The lane with this number at a road coordinate (m). Raises `MapError` if there is none.

        On the border of two lanes it is the later one, as in OpenDRIVE.
        """
        spans = [
            (min(lane.road_s[0], lane.road_s[-1]), max(lane.road_s[0], lane.road_s[-1]), lane)
            for lane in self.lanes.values()
            if lane.road == road and lane.number == number
        ]
        inside = [(lo, lane) for lo, hi, lane in spans if lo - 1e-9 <= road_s <= hi + 1e-9]
        if not inside:
            raise MapError(f"road '{road}' has no lane {number} at s = {road_s:g}", file=self.source)
        return max(inside, key=lambda pair: pair[0])[1]

    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max of all centre lines, m."""
        xy = np.concatenate([lane.xyz[:, :2] for lane in self.lanes.values()])
        (x0, y0), (x1, y1) = xy.min(0), xy.max(0)
        return float(x0), float(y0), float(x1), float(y1)
