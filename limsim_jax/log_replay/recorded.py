"""Recorded scenes from files: tracks of vehicles in the plane and the lanes that they drive on.

`read_scene` reads a CommonRoad file, or one scenario of tables (`scenes_vehicles.csv` with
`scenes_lanelets.csv` and `scenes_lanelet_points.csv` beside it). Numbers are SI, positions those of the
middle of the body. Nothing is repaired: what cannot be replayed is refused with one line.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from limsim_jax.maps import xml
from limsim_jax.maps.network import ImportReport, Lane, MapError, Network, Road

SPEED_LIMIT = 30.0
"""m/s, of lanes whose recording tells none."""

_MOTOR = ("car", "truck", "bus", "motorcycle", "van", "priorityVehicle", "taxi")
_FASTEST = 70.0  # m/s
_JUMP = 2.0  # m by which a step may be longer than the speeds at its ends allow
_CAR_SIZE = (4.5, 1.8)  # m, where a recording tells none
_LANE = 3.5  # m, likewise
_STEP = 1.0  # m between samples of the lanes that are built
_BEND = 4.0  # m over which headings of points along a lane are taken

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """Tracks on a common clock, `T` moments and `N` vehicles; NaN where a vehicle is not there."""

    name: str
    source: str  # file
    dt: float  # s
    vehicles: tuple[str, ...]  # ids in the file
    x: Float[np.ndarray, "T N"]  # m, middle of the body, in coordinates of the file
    y: Float[np.ndarray, "T N"]
    heading: Float[np.ndarray, "T N"]  # rad
    v: Float[np.ndarray, "T N"]  # m/s
    length: Float[np.ndarray, " N"]  # m
    width: Float[np.ndarray, " N"]  # m
    network: Network

    @property
    def valid(self) -> Bool[np.ndarray, "T N"]:
        """Where there is something recorded."""
        return np.isfinite(self.x)


@dataclass(frozen=True)
class Lanelet:
    """A piece of lane between two bounds, in the direction of travel."""

    id: str
    left_bound: Float[np.ndarray, "K 2"]  # m
    right_bound: Float[np.ndarray, "M 2"]
    left: str | None = None  # neighbour in the same direction
    right: str | None = None
    predecessors: tuple[str, ...] = ()
    successors: tuple[str, ...] = ()


def read_scene(
    path: str | Path, scenario: str | None = None, *, speed_limit: float = SPEED_LIMIT
) -> Recorded:
    """Read a recorded scene with its lanes.

    Args:
      path: a CommonRoad XML file, or the table of vehicles; also gzipped.
      scenario: which one of the table; not needed if it has only one.
      speed_limit: m/s, of the lanes: no recording tells it for all of them.

    Raises:
      ValueError: one line that names file, line and column or element, and what would be right.
    """
    path = Path(path)
    data = xml.read_bytes(path)
    if data[:200].lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return _commonroad(path, data, speed_limit)
    return _tables(path, data, scenario, speed_limit)


# --- CommonRoad --------------------------------------------------------------------------------------


def _commonroad(path: Path, data: bytes, speed_limit: float) -> Recorded:
    name, dt = path.name, math.nan
    lanelets: list[Lanelet] = []
    rows = _Rows(path)
    read = xml.Reader(path)
    for root, element in xml.top_level(data, path, "commonRoad"):
        name = root.get("benchmarkID", path.name)
        if math.isnan(dt):
            dt = read.number(root, "timeStepSize")
            if not 0 < dt <= 1:
                read.fail(root, f"timeStepSize is {dt:g} s; more than 0 and at most 1 would be right")
        if element.tag == "lanelet":
            lanelets.append(_lanelet(read, element))
        elif element.tag in ("dynamicObstacle", "obstacle") and element.find("trajectory") is not None:
            kind = (element.findtext("type") or "").strip()
            if kind not in _MOTOR:
                continue
            size = [_number(read, element, f"shape/rectangle/{side}") for side in ("length", "width")]
            for state in (element.find("initialState"), *element.iterfind("trajectory/state")):
                if state is None:
                    read.fail(element, "has no <initialState>")
                values = [
                    _number(read, state, child)
                    for child in ("position/point/x", "position/point/y", "orientation/exact")
                ]
                step = _number(read, state, "time/exact")
                speed = _number(read, state, "velocity/exact")
                rows.add(state.sourceline, read.text(element, "id"), step, *values, speed, *size)
    network = lanelet_network(lanelets, name, str(path), xml.file_hash(data), speed_limit)
    return rows.recorded(name, dt, network)


def _lanelet(read: xml.Reader, element: Any) -> Lanelet:
    bounds = []
    for side in ("leftBound", "rightBound"):
        points = [
            [_number(read, point, axis) for axis in ("x", "y")] for point in element.iterfind(f"{side}/point")
        ]
        if len(points) < 2:
            read.fail(element, f"<{side}> has {len(points)} points; at least 2 would be right")
        bounds.append(np.array(points))

    def beside(side: str) -> str | None:
        link = element.find(side)
        return link.get("ref") if link is not None and link.get("drivingDir") == "same" else None

    links = [tuple(link.get("ref") for link in element.iterfind(end)) for end in ("predecessor", "successor")]
    return Lanelet(
        read.text(element, "id"),
        bounds[0],
        bounds[1],
        beside("adjacentLeft"),
        beside("adjacentRight"),
        *links,
    )


def _number(read: xml.Reader, element: Any, child: str) -> float:
    text = element.findtext(child)
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        found = "missing" if text is None else f"'{text.strip()[:30]}'"
        read.fail(element, f"<{child}> is {found}; a finite number would be right")
    return value


# --- tables ------------------------------------------------------------------------------------------


def _tables(path: Path, data: bytes, scenario: str | None, speed_limit: float) -> Recorded:
    table = _Table(path, data)
    text = ("scenario", "vehicle_id")
    numbers = ("step", "t", "x", "y", "heading", "v", "length", "width")
    table.require(*text, *numbers)
    known = table.distinct("scenario")
    scenario = table.choose(scenario, known)
    rows = _Rows(path)
    clock = []
    for line, row in table.rows(scenario):
        values = {name: table.number(line, row, name) for name in numbers}
        rows.add(
            line,
            row["vehicle_id"],
            *(values[name] for name in ("step", "x", "y", "heading", "v", "length", "width")),
        )
        clock.append((values["step"], values["t"], line))
    dt = _dt(path, clock)
    lanelets = _lanelet_tables(path, scenario)
    network = lanelet_network(lanelets, scenario, str(path), xml.file_hash(data), speed_limit)
    return rows.recorded(scenario, dt, network)


def _dt(path: Path, clock: list[tuple[float, float, int]]) -> float:
    step, t, line = (np.array(column) for column in zip(*clock, strict=True))
    first, last = np.argmin(step), np.argmax(step)
    dt = (t[last] - t[first]) / max(step[last] - step[first], 1)
    wrong = np.abs(t - t[first] - (step - step[first]) * dt) > 1e-3
    if not 0 < dt <= 1 or wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(
            f"{path}: line {int(line[k])}, column t: {t[k]:g} s at step {step[k]:g}; "
            "seconds that grow by one time step per step, at most 1 s, would be right"
        )
    return float(round(dt, 6))


def _lanelet_tables(path: Path, scenario: str) -> list[Lanelet]:
    ending = path.name.split("_vehicles", 1)[-1]
    files = [path.with_name(f"scenes_{part}{ending}") for part in ("lanelets", "lanelet_points")]
    links, points = (_Table(file, xml.read_bytes(file)) for file in files)
    links.require("scenario", "lanelet_id", "left", "left_direction", "right", "right_direction")
    links.require("predecessors", "successors")
    points.require("scenario", "lanelet_id", "side", "index", "x", "y")
    bounds: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for line, row in points.rows(scenario):
        if row["side"] not in ("left", "right"):
            points.refuse(line, "side", f"'{row['side']}'; left or right would be right")
        place = (
            points.number(line, row, "index"),
            points.number(line, row, "x"),
            points.number(line, row, "y"),
        )
        bounds.setdefault((row["lanelet_id"], row["side"]), []).append(place)
    found = []
    for line, row in links.rows(scenario):
        sides = []
        for side in ("left", "right"):
            line_points = sorted(bounds.get((row["lanelet_id"], side), []))
            if len(line_points) < 2:
                links.refuse(
                    line,
                    "lanelet_id",
                    f"lanelet {row['lanelet_id']} has {len(line_points)} points of its {side} bound in "
                    f"{files[1].name}; at least 2 would be right",
                )
            sides.append(np.array(line_points)[:, 1:])
        beside = [
            row[side] if row[side] and row[f"{side}_direction"] == "same" else None
            for side in ("left", "right")
        ]
        ends = [tuple(row[end].split()) for end in ("predecessors", "successors")]
        found.append(Lanelet(row["lanelet_id"], *sides, *beside, *ends))
    return found


class _Table:
    """A CSV file with a header."""

    def __init__(self, path: Path, data: bytes, skip: int = 0) -> None:
        self.path = path
        try:
            reader = csv.reader(io.StringIO(data.decode("utf-8-sig")))
            self.columns = [name.strip() for name in next(reader)]
            self._rows = [(reader.line_num + skip, row) for row in reader if row]
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{path}: no table of comma-separated values ({error})") from None
        if not self._rows:
            raise ValueError(f"{path}: line 2: no rows; the file ends after its header")
        for line, row in self._rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"{path}: line {line}: {len(row)} values; "
                    f"{len(self.columns)} as in the header would be right"
                )

    def require(self, *columns: str) -> None:
        for name in columns:
            if name not in self.columns:
                raise ValueError(
                    f"{self.path}: line 1: column {name} is missing; "
                    f"found are {', '.join(self.columns)[:200]}"
                )

    def distinct(self, column: str) -> list[str]:
        k = self.columns.index(column)
        return list(dict.fromkeys(row[k] for _, row in self._rows))

    def choose(self, scenario: str | None, known: Sequence[str]) -> str:
        if scenario is None and len(known) == 1:
            return known[0]
        if scenario is None or scenario not in known:
            asked = "no scenario named" if scenario is None else f"no scenario '{scenario}'"
            raise ValueError(f"{self.path}: column scenario: {asked}; it has {', '.join(known)[:300]}")
        return scenario

    def rows(self, scenario: str) -> Iterator[tuple[int, dict[str, str]]]:
        for line, row in self._rows:
            values = dict(zip(self.columns, row, strict=True))
            if values["scenario"] == scenario:
                yield line, values

    def column(self, column: str) -> Floats:
        """Numbers, NaN where there is none."""
        k, values = self.columns.index(column), np.full(len(self._rows), np.nan)
        for n, (line, row) in enumerate(self._rows):
            if row[k]:
                values[n] = self.number(line, {column: row[k]}, column)
        return values

    def number(self, line: int, row: dict[str, str], column: str) -> float:
        try:
            value = float(row[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.refuse(line, column, f"'{row[column][:30]}'; a finite number would be right")
        return value

    def refuse(self, line: int, column: str, message: str) -> NoReturn:
        raise ValueError(f"{self.path}: line {line}, column {column}: {message}")


# --- OpenACC -----------------------------------------------------------------------------------------


def read_platoon(
    path: str | Path, start: float, seconds: float, *, speed_limit: float = SPEED_LIMIT
) -> Recorded:
    """A stretch of an OpenACC recording: cars behind one another, and the one lane that they drive along.

    Such files have no lanes; theirs is the way of the last car, then that of the first. Take stretches in
    which nobody comes by the same place twice.

    Args:
      path: the file.
      start: s from its first row.
      seconds: length of the stretch; cars whose record has a gap in it are left out.
      speed_limit: m/s.

    Raises:
      ValueError: one line that names file, line and column, and what would be right.
    """
    path = Path(path)
    data = xml.read_bytes(path)
    skip = next((k for k, line in enumerate(data.splitlines()[:20]) if line.startswith(b"Time,")), None)
    if skip is None:
        raise ValueError(f"{path}: no line that starts with 'Time,'; OpenACC has one after five of header")
    table = _Table(path, b"\n".join(data.splitlines()[skip:]), skip)
    cars = [name[5:] for name in table.columns if name.startswith("Speed")]
    table.require("Time", *(f"{axis}{car}" for car in cars for axis in "EN"))
    time = table.column("Time")
    dt = float(np.round(np.median(np.diff(time)), 6))
    rows = np.flatnonzero((time - time[0] >= start - 1e-6) & (time - time[0] < start + seconds - 1e-6))
    if len(rows) < max(2, seconds / dt - 1) or np.abs(np.diff(time[rows]) - dt).max() > 1e-3:
        last = time[-1] - time[0]
        raise ValueError(
            f"{path}: column Time: {start:g} to {start + seconds:g} s has {len(rows)} rows; "
            f"steps of {dt:g} s without a gap, within 0 to {last:.0f} s, would be right"
        )
    tracks = {car: np.stack([table.column(f"{c}{car}")[rows] for c in ("E", "N", "Speed")]) for car in cars}
    tracks = {car: track for car, track in tracks.items() if np.isfinite(track).all()}
    if len(tracks) < 2:
        raise ValueError(f"{path}: {len(tracks)} cars without a gap in this stretch; 2 would be right")
    checked = _Rows(path)
    for car, (x, y, v) in tracks.items():
        heading = _course(x, y)
        for k, row in enumerate(rows):
            checked.add(
                int(row) + skip + 2, car, float(k), x[k], y[k], heading[k], max(v[k], 0.0), *_CAR_SIZE
            )
    cars = list(tracks)
    first, last = tracks[cars[0]][:2].T, tracks[cars[-1]][:2].T
    onward = int(np.argmin(np.linalg.norm(first - last[-1], axis=-1)))
    line = np.concatenate([last, first[onward + 1 :]])
    line = line[np.append(True, _forward(line))]
    line = np.concatenate([line, line[-1:] + (line[-1:] - line[-2:-1]) * 10])
    across = np.gradient(line, axis=0)
    across = np.stack([-across[:, 1], across[:, 0]], -1) / np.linalg.norm(across, axis=-1)[:, None]
    lane = Lanelet("lane", line + across * _LANE / 2, line - across * _LANE / 2)
    name = f"{path.name.split('.')[0]}, {start:g} to {start + seconds:g} s"
    return checked.recorded(
        name, dt, lanelet_network([lane], name, str(path), xml.file_hash(data), speed_limit)
    )


def _course(x: Floats, y: Floats) -> Floats:
    """Heading of a body by its way over `_BEND` m; standing ones keep it."""
    way = np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y))))
    grid, once = np.unique(way, return_index=True)
    ends = [np.clip(way + side * _BEND / 2, 0, way[-1]) for side in (-1, 1)]
    (x0, y0), (x1, y1) = ((np.interp(end, grid, x[once]), np.interp(end, grid, y[once])) for end in ends)
    return np.unwrap(np.arctan2(y1 - y0, x1 - x0))


def _forward(line: Floats) -> NDArray[np.bool_]:
    """Which points of a way are at least a metre after the last one taken."""
    taken = np.zeros(len(line) - 1, bool)
    at = line[0]
    for k, point in enumerate(line[1:]):
        if np.linalg.norm(point - at) >= _STEP:
            taken[k], at = True, point
    return taken


# --- tracks ------------------------------------------------------------------------------------------


class _Rows:
    """Rows of any file, checked and put on the clock."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._tracks: dict[str, list[tuple[float, ...]]] = {}

    def add(self, line: int, vehicle: str, *values: float) -> None:
        """`values`: step, x, y, heading, v, length, width."""
        self._tracks.setdefault(vehicle, []).append((*values, float(line)))

    def recorded(self, name: str, dt: float, network: Network) -> Recorded:
        if not self._tracks:
            raise ValueError(f"{self.path}: no recorded vehicles; tracks of cars or trucks would be right")
        tracks = {vehicle: np.array(sorted(rows)) for vehicle, rows in self._tracks.items()}
        for vehicle, rows in tracks.items():
            self._check(vehicle, rows, dt)
        start = min(rows[0, 0] for rows in tracks.values())
        count = int(max(rows[-1, 0] for rows in tracks.values()) - start) + 1
        table = np.full((4, count, len(tracks)), np.nan)
        for k, rows in enumerate(tracks.values()):
            table[:, (rows[:, 0] - start).astype(int), k] = rows[:, 1:5].T
        size = np.array([rows[0, 5:7] for rows in tracks.values()])
        x, y, heading, v = table
        return Recorded(
            name=name, source=str(self.path), dt=dt, vehicles=tuple(tracks), network=network,
            x=x, y=y, heading=heading, v=v, length=size[:, 0], width=size[:, 1],
        )  # fmt: skip

    def _check(self, vehicle: str, rows: Floats, dt: float) -> None:
        step, x, y, heading, v, length, width, line = rows.T

        def refuse(bad: NDArray[np.bool_], message: str) -> None:
            if bad.any():
                k = int(np.argmax(bad))
                raise ValueError(
                    f"{self.path}: line {int(line[k])}: vehicle {vehicle}: "
                    + message.format(
                        step=step[k], v=v[k], length=length[k], width=width[k], before=step[max(k - 1, 0)],
                        jump=chord[max(k - 1, 0)], heading=heading[k],
                    )
                )  # fmt: skip

        chord = np.hypot(np.diff(x), np.diff(y))
        after = np.diff(step, prepend=step[0] - 1)
        refuse(step != np.round(step), "step {step:g}; a whole number would be right")
        refuse(after == 0, "step {step:g} twice; once would be right")
        refuse(after > 1, "step {step:g} follows step {before:g}; no gap in time would be right")
        refuse(
            (length < 1) | (length > 30) | (width < 0.4) | (width > 4),
            "length {length:g} m, width {width:g} m; metres, 1 to 30 and 0.4 to 4, would be right",
        )
        refuse((v < 0) | (v > _FASTEST), "v is {v:g} m/s; metres per second, 0 to 70, would be right")
        far = chord > (np.maximum(v[1:], v[:-1]) * dt + _JUMP)
        refuse(
            np.append(False, far),
            "moves {jump:.1f} m in one step at v {v:g} m/s; metres and seconds would be right",
        )
        refuse(np.abs(heading) > 4 * math.pi, "heading {heading:g}; radians would be right")


# --- lanes -------------------------------------------------------------------------------------------


def lanelet_network(
    lanelets: Sequence[Lanelet], name: str, source: str, file_hash: str = "", speed_limit: float = SPEED_LIMIT
) -> Network:
    """A network whose lanes run in the middle between the bounds of lanelets.

    Lanelets that are neighbours make a road; links to lanelets that are not there are dropped and reported.
    Lane changes are allowed wherever a neighbour drives the same way: recordings tell no markings.

    Raises:
      MapError: no lanelet, an id twice, one without length or width, or two that call one another
        neighbours on different sides.
    """
    if not lanelets:
        raise MapError("no lanelet; a map of the lanes would be right", file=source)
    known: dict[str, Lanelet] = {}
    for lanelet in lanelets:
        if lanelet.id in known:
            raise MapError("is there twice; ids have to differ", file=source, element=f"lanelet {lanelet.id}")
        known[lanelet.id] = lanelet
    report = ImportReport()
    report.added("speed limit", "all lanes", f"{speed_limit:g} m/s; the recording tells none")
    lanelets = [_linked(lanelet, known, report) for lanelet in lanelets]
    known = {lanelet.id: lanelet for lanelet in lanelets}
    road_of = _roads(lanelets, known, source)
    lanes = {}
    for lanelet in lanelets:
        report.read("lanelet")
        lanes[lanelet.id] = _lane(lanelet, road_of[lanelet.id], source, speed_limit)
    roads = {
        road: Road(id=road, length=max(lane.length for lane in lanes.values() if lane.road == road))
        for road in dict.fromkeys(road for road, _ in road_of.values())
    }
    return Network(
        name=name,
        source=source,
        file_hash=file_hash,
        format="lanelets",
        lanes=lanes,
        roads=roads,
        report=report,
    )


def _linked(lanelet: Lanelet, known: dict[str, Lanelet], report: ImportReport) -> Lanelet:
    """The lanelet with links to lanelets that are there."""

    def there(other: str | None, what: str) -> bool:
        if other is not None and other not in known:
            report.ignored(what, f"lanelet {lanelet.id}", f"leads to lanelet {other}, which is not there")
        return other in known

    return replace(
        lanelet,
        left=lanelet.left if there(lanelet.left, "neighbour") else None,
        right=lanelet.right if there(lanelet.right, "neighbour") else None,
        predecessors=tuple(other for other in lanelet.predecessors if there(other, "predecessor")),
        successors=tuple(other for other in lanelet.successors if there(other, "successor")),
    )


def _roads(lanelets: Sequence[Lanelet], known: dict[str, Lanelet], source: str) -> dict[str, tuple[str, int]]:
    """Road and number of every lanelet: neighbours make a road, numbered from the right edge."""
    found: dict[str, tuple[str, int]] = {}
    for lanelet in lanelets:
        for other, back in ((lanelet.left, "right"), (lanelet.right, "left")):
            if other is not None and getattr(known[other], back) not in (None, lanelet.id):
                raise MapError(
                    f"is beside lanelet {other}, whose {back} neighbour is {getattr(known[other], back)}",
                    file=source,
                    element=f"lanelet {lanelet.id}",
                )
        if lanelet.id in found:
            continue
        edge, seen = lanelet, {lanelet.id}
        while edge.right is not None and edge.right not in seen:
            edge = known[edge.right]
            seen.add(edge.id)
        number, road, at = 0, edge.id, edge
        while at.id not in found:
            found[at.id] = (road, number)
            number += 1
            if at.left is None:
                break
            at = known[at.left]
        found.setdefault(lanelet.id, (lanelet.id, 0))
    return found


def _lane(lanelet: Lanelet, place: tuple[str, int], source: str, speed_limit: float) -> Lane:
    def fail(reason: str) -> NoReturn:
        raise MapError(reason, file=source, element=f"lanelet {lanelet.id}")

    left, right = _matched(lanelet.left_bound, lanelet.right_bound)
    xy, across = (left + right) / 2, np.linalg.norm(left - right, axis=-1)
    chord = np.linalg.norm(np.diff(xy, axis=0), axis=-1)
    if chord.sum() < 0.5:
        fail(f"is {chord.sum():.2f} m long; at least 0.5 m would be right")
    if np.median(across) < 0.5:
        fail(f"is {np.median(across):.2f} m wide; at least 0.5 m would be right")
    along = np.append(0.0, np.cumsum(chord))
    s = np.linspace(0, along[-1], max(round(along[-1] / _STEP) + 1, 3))
    # the direction over a few metres: points of recorded maps are centimetres apart and uneven
    reach = min(_BEND, along[-1]) / 2
    ends = [np.clip(s + side * reach, 0, along[-1]) for side in (-1, 1)]
    first, last = (np.stack([np.interp(e, along, xy[:, k]) for k in range(2)], -1) for e in ends)
    step = last - first
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    to_left = np.stack([np.interp(s, along, (left - xy)[:, k]) for k in range(2)], -1)
    if np.median(step[:, 0] * to_left[:, 1] - step[:, 1] * to_left[:, 0]) < 0:
        fail("has its left bound on the right; bounds in the direction of travel would be right")
    points = np.stack([np.interp(s, along, xy[:, k]) for k in range(2)] + [np.zeros_like(s)], -1)
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1)))
    return Lane(
        id=lanelet.id, road=place[0], number=place[1], s=length, xyz=points, heading=heading,
        curvature=np.gradient(heading, length), width=np.interp(s, along, across), road_s=length,
        speed_limit=speed_limit, successors=lanelet.successors, predecessors=lanelet.predecessors,
        left=lanelet.left, right=lanelet.right,
        may_change_left=lanelet.left is not None, may_change_right=lanelet.right is not None,
    )  # fmt: skip


def _matched(left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Both bounds with as many points: by index if they have as many already, else by share of length."""
    if len(left) == len(right):
        return left, right
    count = max(len(left), len(right))

    def resampled(line: Floats) -> Floats:
        share = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1)))
        place = np.linspace(0, share[-1], count)
        return np.stack([np.interp(place, share, line[:, k]) for k in range(2)], -1)

    return resampled(left), resampled(right)


__all__ = ["SPEED_LIMIT", "Lanelet", "Recorded", "lanelet_network", "read_platoon", "read_scene"]
