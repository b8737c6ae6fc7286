"""Lights, signs, stop lines and crosswalks, with the lanes that they govern."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from limsim_jax.maps.network import (
    Control,
    Crosswalk,
    ImportReport,
    Lane,
    LaneSpot,
    Movement,
    Sign,
    SignKind,
    StopLine,
    TrafficLight,
    Turn,
)
from limsim_jax.maps.opendrive.curves import Array
from limsim_jax.maps.opendrive.lanes import Piece, RoadShape, lane_id
from limsim_jax.maps.opendrive.records import (
    SPEED_UNITS,
    RawController,
    RawObject,
    RawRoad,
    RawSignal,
)

# OpenDRIVE signal catalogue (base types 1 000 000 ff.): lights for motor traffic, and for others
VEHICLE_LIGHTS = {"1000001", "1000008", "1000009", "1000010", "1000011", "1000012", "1000016", "1000020"}
OTHER_LIGHTS = {
    "1000002": "pedestrians",
    "1000007": "cyclists",
    "1000013": "cyclists",
    "1000014": "trams",
    "1000015": "pedestrians and cyclists",
    "1000017": "trams",
    "1000018": "trams",
}
# arrows on lights, by subtype
_LEFT, _RIGHT = (Turn.LEFT, Turn.SLIGHT_LEFT, Turn.U_TURN), (Turn.RIGHT, Turn.SLIGHT_RIGHT)
_AHEAD = (Turn.STRAIGHT, Turn.SLIGHT_LEFT, Turn.SLIGHT_RIGHT)
ARROWS = {
    ("1000011", "10"): _LEFT,
    ("1000011", "20"): _RIGHT,
    ("1000011", "30"): _AHEAD,
    ("1000011", "40"): _AHEAD + _LEFT,
    ("1000011", "50"): _AHEAD + _RIGHT,
    ("1000012", "10"): _LEFT,
    ("1000012", "20"): _RIGHT,
}
# road signs by country, "type" or "type-subtype"; the catalogue of OpenDRIVE itself numbers as Germany does
_GERMAN = {
    "205": SignKind.YIELD,
    "206": SignKind.STOP,
    "301": SignKind.PRIORITY,
    "306": SignKind.PRIORITY,
    "274": SignKind.SPEED,
}
SIGNS = {
    "": _GERMAN,
    "OPENDRIVE": _GERMAN,
    "DE": _GERMAN,
    "DEU": _GERMAN,
    "GER": _GERMAN,
    "AT": {},
    "US": {"R1-1": SignKind.STOP, "R1-2": SignKind.YIELD, "R2-1": SignKind.SPEED},
    "USA": {"R1-1": SignKind.STOP, "R1-2": SignKind.YIELD, "R2-1": SignKind.SPEED},
    "SE": {
        "B1": SignKind.YIELD,
        "B2": SignKind.STOP,
        "B4": SignKind.PRIORITY,
        "C31": SignKind.SPEED,
    },
}
STOP_LINE_TYPES = {"294"}
APPROACH = 60.0  # m; a sign further from the junction than this does not regulate it
INSIDE = 10.0  # m; a stop line may lie this far inside the junction
BESIDE = 12.0  # m; largest distance of a sign from the lane end that it regulates


@dataclass
class Furniture:
    """Signals, signs and markings of the roads."""

    lights: list[TrafficLight]
    signs: list[Sign]
    stop_lines: list[StopLine]
    crosswalks: list[Crosswalk]


class Furnisher:
    """Finds the lanes for signals and objects."""

    def __init__(
        self,
        roads: dict[str, RawRoad],
        pieces: dict[str, list[Piece]],
        lanes: dict[str, Lane],
        movements: tuple[Movement, ...],
        controllers: Iterable[RawController],
        report: ImportReport,
    ) -> None:
        self.roads, self.pieces, self.lanes, self.report = roads, pieces, lanes, report
        self.incoming = sorted({m.incoming for m in movements})
        self.controller_of = {s: c.id for c in controllers for s in c.signals}
        self._drivable = [lane for lane in lanes.values() if lane.drivable]
        self._boxes = np.array(
            [[*lane.xyz[:, :2].min(0), *lane.xyz[:, :2].max(0)] for lane in self._drivable]
        ).reshape(-1, 4)

    def run(self) -> Furniture:
        """All furniture of the map."""
        found = Furniture([], [], [], [])
        references: dict[str, list[tuple[RawRoad, RawSignal]]] = defaultdict(list)
        known: dict[str, RawSignal] = {}
        for road in self.roads.values():
            for signal in road.signals:
                if signal.reference:
                    references[signal.id].append((road, signal))
                else:
                    known.setdefault(signal.id, signal)
        for key, places in references.items():
            if key not in known:
                road, signal = places[0]
                self.report.ignored(
                    "signalReference",
                    f"road {road.id}",
                    f"signal {key} is not in the file",
                    signal.line,
                    count=len(places),
                )
        unknown: dict[tuple[str, str], list[tuple[RawRoad, RawSignal]]] = defaultdict(list)
        for road in self.roads.values():
            for signal in road.signals:
                if signal.reference:
                    continue
                places = [(road, signal)]
                if known[signal.id] is signal:
                    places += references.get(signal.id, [])
                self._signal(road, signal, places, found, unknown)
            for thing in road.objects:
                self._object(road, thing, found)
        for (country, kind), cases in unknown.items():
            road, signal = cases[0]
            self.report.ignored(
                "sign",
                f"road {road.id} signal {signal.id}",
                f"type '{kind}' of country '{country}' has no meaning here; "
                f"{len(cases)} in the file, kept as 'other'",
                signal.line,
                count=len(cases),
            )
        return found

    # --- signals --------------------------------------------------------------------------------

    def _signal(
        self,
        road: RawRoad,
        signal: RawSignal,
        places: list[tuple[RawRoad, RawSignal]],
        found: Furniture,
        unknown: dict[tuple[str, str], list[tuple[RawRoad, RawSignal]]],
    ) -> None:
        where = f"road {road.id} signal {signal.id}"
        x, y, z, heading = RoadShape(road).point(signal.s, signal.t)
        position = (x, y, z + signal.z)
        facing = heading + signal.heading_offset + (np.pi if signal.orientation == "-" else 0.0)
        spots = list(dict.fromkeys(spot for r, place in places for spot in self._spots(r, place)))
        if signal.dynamic:
            if signal.type not in VEHICLE_LIGHTS:
                whom = OTHER_LIGHTS.get(signal.type, f"unknown (type '{signal.type}')")
                self.report.ignored("traffic light", where, f"a light for {whom}", signal.line)
                return
            if not spots:
                spots = self._by_position(position, where, "traffic light", signal.line)
            found.lights.append(
                TrafficLight(
                    id=signal.id,
                    name=signal.name,
                    position=position,
                    heading=self._heading(spots, float(facing)),
                    spots=tuple(spots),
                    turns=ARROWS.get((signal.type, signal.subtype), ()),
                    controller=self.controller_of.get(signal.id),
                    line=signal.line,
                )
            )
            self.report.read("traffic light")
            return
        if signal.type in STOP_LINE_TYPES and signal.country in ("", "OPENDRIVE", "DE", "DEU", "GER"):
            if not spots:
                spots = self._by_position(position, where, "stop line", signal.line)
            for spot in spots:
                found.stop_lines.append(StopLine(id=signal.id, spot=spot, line=signal.line))
            self.report.read("stop line")
            return
        kind = classify(signal)
        value = speed_value(signal) if kind is SignKind.SPEED else None
        if kind is SignKind.OTHER or (kind is SignKind.SPEED and value is None):
            kind = SignKind.OTHER
            unknown[signal.country, signal.type].append((road, signal))
        elif kind is not SignKind.SPEED and not spots:
            spots = self._by_position(position, where, f"{kind} sign", signal.line)
        found.signs.append(
            Sign(
                id=signal.id,
                kind=kind,
                name=signal.name,
                position=position,
                heading=float(facing),
                value=value,
                spots=tuple(spots),
                line=signal.line,
            )
        )
        if kind is not SignKind.OTHER:
            self.report.read(f"{kind} sign")

    def _heading(self, spots: list[LaneSpot], facing: float) -> float:
        """Direction (rad) of the traffic that faces a light.

        It is that of the governed lanes. Without lanes it is the orientation of the signal: writers
        disagree on whether `orientation` means the traffic or the face of the light.
        """
        if not spots:
            return facing
        headings = np.array([self.lanes[spot.lane].pose(spot.s)[1] for spot in spots])
        return float(np.angle(np.exp(1j * headings).sum()))

    def _spots(self, road: RawRoad, signal: RawSignal) -> list[LaneSpot]:
        """Lanes that the file names, by `validity` or otherwise by `orientation`."""
        s = min(max(signal.s, 0.0), road.length)
        pieces = self.pieces[road.id]
        piece = next((p for p in pieces if p.start - 1e-6 <= s <= p.end + 1e-6), None)
        if piece is None:
            return []
        spots = []
        for number, attributes in piece.attributes.items():
            lane = self.lanes[lane_id((road.id, piece.index, number))]
            if not lane.drivable:
                continue
            if signal.validity:
                valid = any(min(v) <= number <= max(v) for v in signal.validity)
            else:
                valid = signal.orientation not in ("+", "-") or attributes.forward == (
                    signal.orientation == "+"
                )
            if valid:
                spots.append(LaneSpot(lane=lane.id, s=float(lane.s_at_road(s))))
        return spots

    def _by_position(
        self, position: tuple[float, float, float], where: str, element: str, line: int | None
    ) -> list[LaneSpot]:
        """Lanes for a signal that names none: they enter a junction beside or below it."""
        best, score = "", BESIDE
        for name in self.incoming:
            lane = self.lanes[name]
            end, heading = lane.xyz[-1], lane.heading[-1]
            dx, dy = position[0] - end[0], position[1] - end[1]
            ahead = dx * np.cos(heading) + dy * np.sin(heading)
            left = -dx * np.sin(heading) + dy * np.cos(heading)
            kerb = left if self.roads[lane.road].left_hand else -left
            if abs(position[2] - end[2]) > 8.0 or kerb < -1.0:
                continue
            distance = float(np.hypot(ahead, kerb))
            if distance < score:
                best, score = name, distance
        if not best:
            self.report.ignored(
                element, where, "names no lanes and stands at none that enters a junction", line
            )
            return []
        chosen = [best]
        for side in ("left", "right"):
            name = getattr(self.lanes[best], side)
            while name is not None and name in self.incoming:
                chosen.append(name)
                name = getattr(self.lanes[name], side)
        self.report.approximated(
            element, where, f"names no lanes: taken for {', '.join(sorted(chosen))} by its position", line
        )
        return [LaneSpot(lane=name, s=self.lanes[name].length) for name in sorted(chosen)]

    # --- objects --------------------------------------------------------------------------------

    def _object(self, road: RawRoad, thing: RawObject, found: Furniture) -> None:
        where = f"road {road.id} object {thing.id}"
        x, y, z, heading = RoadShape(road).point(thing.s, thing.t)
        outlines = [self._outline(road, thing, corners) for corners in thing.outlines]
        if not outlines and thing.length > 0 and thing.width >= 0:
            u, v = thing.length / 2, thing.width / 2
            box = np.array([(-u, -v), (u, -v), (u, v), (-u, v)])
            outlines = [_turned(box, heading + thing.heading) + np.array([x, y])]
        if thing.type == "crosswalk":
            if not outlines or len(outlines[0]) < 3:
                self.report.ignored("crosswalk", where, "has neither an outline nor a size", thing.line)
                return
            outline = outlines[0]
            spans = self._spans(outline, z)
            found.crosswalks.append(
                Crosswalk(id=thing.id, outline=outline, spans=tuple(spans), line=thing.line)
            )
            self.report.read("crosswalk")
            return
        named = bool(
            re.search(r"stop[ _-]?line", thing.name, re.IGNORECASE)
            or thing.subtype in ("stopline", "signallines")
        )
        flat = thing.height <= 0.1 and thing.type in ("", "-1", "none", "roadmark")
        if outlines and flat:
            start, end, breadth = _bar(outlines[0])
            length = float(np.hypot(*(end - start)))
            if named or (length >= 2.0 and breadth <= 1.0):
                spots = self._crossings(start, end, z)
                for spot in spots:
                    found.stop_lines.append(StopLine(id=thing.id, spot=spot, line=thing.line))
                if spots and named:
                    self.report.read("stop line")
                    return
                if spots:
                    self.report.approximated(
                        "stop line",
                        where,
                        f"'{thing.name}' is a bar painted across lanes: taken as a stop line",
                        thing.line,
                    )
                    return
        self.report.ignored("object", where, f"{thing.type} '{thing.name}'", thing.line)

    def _outline(self, road: RawRoad, thing: RawObject, corners: list[tuple[bool, float, float]]) -> Array:
        shape = RoadShape(road)
        x, y, _, heading = shape.point(thing.s, thing.t)
        points = []
        for on_road, p, q in corners:
            if on_road:
                points.append(shape.point(p, q)[:2])
            else:
                points.append(
                    tuple(_turned(np.array([[p, q]]), heading + thing.heading)[0] + np.array([x, y]))
                )
        if len(points) > 2 and np.allclose(points[0], points[-1], atol=1e-3):
            points.pop()
        return np.array(points)

    def _near(self, low: Array, high: Array, z: float) -> list[Lane]:
        b = self._boxes
        hit = (b[:, 0] <= high[0]) & (b[:, 2] >= low[0]) & (b[:, 1] <= high[1]) & (b[:, 3] >= low[1])
        return [
            self._drivable[i]
            for i in np.nonzero(hit)[0]
            if np.abs(self._drivable[i].xyz[:, 2] - z).min() < 4.0
        ]

    def _crossings(self, start: Array, end: Array, z: float) -> list[LaneSpot]:
        """Where centre lines cross the segment, before or early in a junction.

        Only crossings at more than 45 degrees count.
        """
        spots = []
        for lane in self._near(np.minimum(start, end), np.maximum(start, end), z):
            s = _crossing(lane, start, end)
            if s is None:
                continue
            _, heading = lane.pose(s)
            along = np.array([np.cos(heading), np.sin(heading)])
            if lane.junction is not None and s > min(INSIDE, lane.length / 2):
                continue  # a line for oncoming traffic, or a guide line
            if abs(float(along @ (end - start))) < 0.71 * float(np.hypot(*(end - start))):
                spots.append(LaneSpot(lane=lane.id, s=s))
        return spots

    def _spans(self, outline: Array, z: float) -> list[tuple[str, float, float]]:
        spans = []
        for lane in self._near(outline.min(0), outline.max(0), z):
            # only the stretch within reach of the outline, from the samples of the lane
            centre, reach = outline.mean(0), float(np.hypot(*np.ptp(outline, axis=0)))
            step = np.diff(lane.s, append=lane.length).max()
            near = np.hypot(*(lane.xyz[:, :2] - centre).T) <= reach + step
            if not near.any():
                continue
            low, high = lane.s[near][[0, -1]] + np.array([-step, step])
            s = np.clip(np.arange(low, high + 0.05, 0.05), 0.0, lane.length)
            inside = inside_polygon(lane.pose(s)[0][:, :2], outline)
            if inside.any():
                where = np.nonzero(inside)[0]
                spans.append((lane.id, float(s[where[0]]), float(s[where[-1]])))
        return spans


def classify(signal: RawSignal) -> SignKind:
    """What a static sign says, by country, type and subtype."""
    table = SIGNS.get(signal.country)
    if table is None:
        return SignKind.OTHER
    kind = signal.type.upper()
    joined = f"{kind}-{signal.subtype}" if kind.isalnum() and not kind.isalpha() else kind + signal.subtype
    return table.get(kind) or table.get(joined) or SignKind.OTHER


def speed_value(signal: RawSignal) -> float | None:
    """Speed in m/s that a speed sign shows.

    It is `value` in `unit`; without a value it is the subtype of the German catalogue.
    """
    american = signal.country in ("US", "USA")
    unit = SPEED_UNITS.get(signal.unit.lower()) if signal.unit else (0.44704 if american else 1 / 3.6)
    if unit is None:
        return None
    if signal.value is not None and signal.value > 0:
        value = signal.value
        if signal.country == "SE" and value < 14:  # C31-5 is 50 km/h
            value *= 10
        return value * unit
    if signal.subtype.isdigit():
        number = int(signal.subtype)
        # catalogue until 2017: 274-51 is 10 km/h, 274-63 is 130 km/h; since then the number is the speed
        return (number - 50) * 10 / 3.6 if 51 <= number <= 63 else number / 3.6 if number > 0 else None
    return None


def extend_lights(
    lights: list[TrafficLight], movements: tuple[Movement, ...], lanes: dict[str, Lane], report: ImportReport
) -> list[TrafficLight]:
    """Extend lights to all movements of the lanes that they stop.

    A vehicle that waits at a red light blocks the whole lane. Movements that no light names, from a lane
    of which another movement is named, are added and reported.
    """
    own: dict[str, dict[int, None]] = defaultdict(dict)  # lane -> lights that name it
    for i, light in enumerate(lights):
        for spot in light.spots:
            own[spot.lane][i] = None
    added: dict[int, dict[str, None]] = defaultdict(dict)
    by_lane: dict[str, list[Movement]] = defaultdict(list)
    for m in movements:
        by_lane[m.incoming].append(m)
    for name, members in by_lane.items():
        if name in own:
            continue
        named = {i: None for m in members for via in m.via for i in own.get(via, ())}
        for m in members:
            if named and m.via and not any(via in own for via in m.via):
                added[next(iter(named))][m.via[0]] = None
    result = list(lights)
    for i, vias in added.items():
        light = lights[i]
        report.repaired(
            "traffic light",
            light.id,
            f"named for other movements of the same lanes only: extended to {', '.join(vias)}",
            light.line,
        )
        result[i] = replace(light, spots=light.spots + tuple(LaneSpot(lane=v, s=0.0) for v in vias))
    return result


def fit_arrows(
    lights: list[TrafficLight], movements: tuple[Movement, ...], lanes: dict[str, Lane], report: ImportReport
) -> list[TrafficLight]:
    """Lights with arrows that fit the ways below them.

    The validity says which lane; an arrow only chooses among several ways from it. Where no way turns as
    the arrow does, its light governs the ways that no other light over the lane names.
    """
    entry = _entries(movements)
    over: dict[str, list[int]] = defaultdict(list)  # entering lane -> lights
    for i, light in enumerate(lights):
        for spot in light.spots:
            if (name := downstream(spot, lanes, entry)) is not None:
                over[name].append(i)
    result = list(lights)
    for name, found in over.items():
        ways = {movements[m].turn for m in entry[name]}
        for i in found:
            if not lights[i].turns or ways & set(lights[i].turns):
                continue
            others = {turn for j in found if j != i for turn in lights[j].turns}
            more = sorted((ways - others) or ways)
            result[i] = replace(result[i], turns=tuple(dict.fromkeys((*result[i].turns, *more))))
            report.approximated(
                "traffic light",
                lights[i].id,
                f"shows {lights[i].turns[0]}, no way from lane {name}: governs {' and '.join(more)}",
                lights[i].line,
            )
    return result


def _entries(movements: tuple[Movement, ...]) -> dict[str, list[int]]:
    """Movements by each lane on their way into and across the junction."""
    entry: dict[str, list[int]] = defaultdict(list)
    for m in movements:
        for name in (m.incoming, *m.via):
            entry[name].append(m.index)
    return entry


def regulate(
    movements: tuple[Movement, ...],
    lanes: dict[str, Lane],
    lights: Iterable[TrafficLight],
    signs: Iterable[Sign],
    report: ImportReport,
) -> tuple[Movement, ...]:
    """Give every movement its control: light before sign before priority record."""
    entry = _entries(movements)
    control: dict[int, Control] = {}
    order = {Control.PRIORITY: 0, Control.YIELD: 1, Control.STOP: 2, Control.SIGNAL: 3}
    meaning = {
        SignKind.STOP: Control.STOP,
        SignKind.YIELD: Control.YIELD,
        SignKind.PRIORITY: Control.PRIORITY,
    }
    things = [("traffic light", light, Control.SIGNAL) for light in lights]
    things += [(f"{sign.kind} sign", sign, meaning[sign.kind]) for sign in signs if sign.kind in meaning]
    for element, thing, new in things:
        reached: set[int] = set()
        turns = thing.turns if isinstance(thing, TrafficLight) else ()
        for spot in thing.spots:
            name = downstream(spot, lanes, entry)
            for m in entry[name] if name is not None else ():
                if not turns or movements[m].turn in turns:
                    reached.add(m)
        if thing.spots and not reached and not turns and new is not Control.PRIORITY:
            report.approximated(
                element,
                thing.id,
                f"regulates {', '.join(spot.lane for spot in thing.spots)}, where no junction follows",
                thing.line,
            )
        for m in reached:
            if m not in control or order[new] > order[control[m]]:
                control[m] = new
    by_junction: dict[str, list[Movement]] = defaultdict(list)
    for m in movements:
        by_junction[m.junction].append(m)
    for members in by_junction.values():
        controls = [control.get(m.index, m.control) for m in members]
        if len({m.incoming for m in members}) > 1 and all(c is Control.STOP for c in controls):
            control.update({m.index: Control.ALL_WAY_STOP for m in members})
    return tuple(replace(m, control=control.get(m.index, m.control)) for m in movements)


def downstream(spot: LaneSpot, lanes: dict[str, Lane], entry: dict[str, list[int]]) -> str | None:
    """The lane ahead that enters a junction within `APPROACH` metres."""
    name, way = spot.lane, -spot.s
    for _ in range(16):
        if name in entry:
            return name if way + lanes[name].length < APPROACH or lanes[name].junction else None
        way += lanes[name].length
        following = [s for s in lanes[name].successors if lanes[s].road == lanes[name].road]
        if len(following) != 1 or way > APPROACH:
            return None
        name = following[0]
    return None


# --- plane geometry -----------------------------------------------------------------------------


def _turned(points: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


def _bar(outline: Array) -> tuple[Array, Array, float]:
    """The long axis of an outline (its two ends) and its breadth."""
    centre = outline.mean(0)
    _, _, axes = np.linalg.svd(outline - centre)
    along, across = (outline - centre) @ axes[0], (outline - centre) @ axes[1]
    middle = centre + axes[1] * (across.max() + across.min()) / 2
    return middle + axes[0] * along.min(), middle + axes[0] * along.max(), float(np.ptp(across))


def _crossing(lane: Lane, start: Array, end: Array) -> float | None:
    """First arc length at which the centre line crosses the segment."""
    d = end - start
    normal = np.array([-d[1], d[0]])
    s = np.union1d(lane.s, np.linspace(0.0, lane.length, max(2, int(lane.length / 0.5) + 1)))
    points = lane.pose(s)[0][:, :2]
    side = (points - start) @ normal
    for i in np.nonzero(side[:-1] * side[1:] <= 0)[0]:
        if side[i] == side[i + 1]:
            continue
        f = side[i] / (side[i] - side[i + 1])
        point = points[i] + f * (points[i + 1] - points[i])
        if -0.02 <= (point - start) @ d / (d @ d) <= 1.02:
            return float(s[i] + f * (s[i + 1] - s[i]))
    return None


def inside_polygon(points: Array, outline: Array) -> np.ndarray:
    """Even-odd rule for points `[M, 2]` and a polygon `[K, 2]`.

    Samples often lie on the outline. It belongs to one side of the polygon, where shapely takes all or none.
    """
    x, y = points[:, 0, None], points[:, 1, None]
    x0, y0 = outline.T
    x1, y1 = np.roll(outline, -1, 0).T
    straddles = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return (straddles & (x < at)).sum(1) % 2 == 1
