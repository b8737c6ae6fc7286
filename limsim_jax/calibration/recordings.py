"""Recorded vehicles from files of several kinds, as one table.

`read_recording(path)` tells the kind by the columns: NGSIM (feet, or the metric table of pairs), TGSIM
pairs, OpenACC, highD, inD and its relatives (rounD, exiD, uniD), CommonRoad. Everything is SI afterwards.

Whatever makes a number mean something else (columns or values missing, wrong units, a time twice) refuses
the file with a `RecordingError`. Defects that real recordings have here and there (time missing, bodies that
overlap, a leader behind its follower) are listed in `Recording.defects` and cut out by `cleaning`, unless
more than `TOLERATED` of the followers have some: then they too refuse the file.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
from lxml import etree
from numpy.typing import NDArray
from scipy.spatial import KDTree

from limsim_jax.maps.lane_map import VEHICLE_CLASSES

FOOT = 0.3048
TOLERATED = 0.05
"""Share of the followers of a file that may have defects."""

REACH = 150.0
"""m, no leader is looked for beyond."""

BESIDE = 1.2
"""m, vehicles whose centres are farther apart across the lane do not follow each other."""

_CAR, _TRUCK, _MOTORCYCLE = (VEHICLE_CLASSES.index(name) for name in ("car", "truck", "motorcycle"))
_CLASSES = {
    "car": _CAR,
    "truck": _TRUCK,
    "truck_bus": _TRUCK,
    "trailer": _TRUCK,
    "van": VEHICLE_CLASSES.index("van"),
    "bus": VEHICLE_CLASSES.index("bus"),
    "motorcycle": _MOTORCYCLE,
}
_CAR_LENGTHS = (3.0, 7.0)  # m, where the median of cars has to be
_FASTEST = 70.0  # m/s

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class RecordingError(ValueError):
    """A recording that cannot be used; one line that names file, line and column and what would be right."""


@dataclass(frozen=True)
class Defect:
    """What is wrong with a recording at one place, and how many rows it concerns."""

    kind: str  # "time", "overlap", "behind", "spacing"
    vehicle: str
    line: int  # of the file, the header being line 1
    rows: int
    message: str


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Rows `R`, one per vehicle and time, sorted by vehicle and time; NaN and -1: unknown or none."""

    source: str  # file
    kind: str
    human: bool  # followers are driven by humans
    dt: float  # s
    names: tuple[str, ...]  # of vehicles
    columns: Mapping[str, str]  # names in the file of the fields below
    defects: tuple[Defect, ...] = ()
    speed_limit: float = math.nan  # m/s
    line: Ints  # of the file
    vehicle: Ints  # index into `names`
    time: Floats  # s
    x: Floats  # m, front bumper along the lane or path
    y: Floats  # m, across
    v: Floats  # m/s
    a: Floats  # m/s^2
    lane: Ints
    length: Floats  # m
    vehicle_class: Ints  # index into VEHICLE_CLASSES
    leader: Ints  # index into `names`
    x_lead: Floats  # m, front bumper, seen along the same lane or path as `x`
    v_lead: Floats  # m/s
    length_lead: Floats  # m

    @property
    def gap(self) -> Floats:
        """Bumper to bumper, m."""
        return self.x_lead - self.length_lead - self.x

    def __len__(self) -> int:
        return len(self.time)


Source = str | Path | Recording
"""Of recorded data: a file, or what was read from one."""

_ROWS = ("line", "vehicle", "time", "x", "y", "v", "a", "lane", "length", "vehicle_class", "leader")
_ROWS += ("x_lead", "v_lead", "length_lead")


def read_recording(path: str | Path) -> Recording:
    """Read a recording; of highD and inD the `..._tracks.csv`, with its meta files beside it.

    Raises:
      RecordingError: what is wrong and where, in one line.
    """
    path = Path(path)
    data = _read(path)
    head = data[:4096].decode("utf-8", "replace").lstrip("\ufeff")
    if head.lstrip().startswith("<"):
        return _checked(_commonroad(path, data))
    lines = head.splitlines()
    if lines[0].split(",")[0].strip() in ("Date", "Vehicle_order"):
        return _openacc(path, data)
    columns = [name.strip().strip('"') for name in lines[0].split(",")]
    known = {name.lower() for name in columns}
    for signs, reader in _READERS:
        if signs <= known:
            return _checked(reader(_Table(path, data, columns)))
    near = max(_READERS, key=lambda reader: len(reader[0] & known))[0]
    if near & known:
        missing = ", ".join(sorted(near - known))
        raise RecordingError(f"{path}: line 1: column {missing} is missing; found are {', '.join(columns)}")
    raise RecordingError(
        f"{path}: line 1: no recording of a known kind (NGSIM, TGSIM pairs, OpenACC, highD, inD, "
        f"CommonRoad); its columns are {', '.join(columns)[:200]}"
    )


def as_recording(source: Source) -> Recording:
    """The recording itself, or the file read, with the errors of `read_recording`."""
    return source if isinstance(source, Recording) else read_recording(source)


# --- files -------------------------------------------------------------------------------------------


def _read(path: Path) -> bytes:
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise RecordingError(f"{path}: damaged gzip data ({error})") from None
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror or error}") from None
    if not data.strip():
        raise RecordingError(f"{path}: the file is empty; a header and rows of data would be right")
    return data


class _Table:
    """A CSV file with a header; its columns by name, whatever their case."""

    def __init__(self, path: Path, data: bytes, columns: Sequence[str], skip: int = 0) -> None:
        self.path, self.skip = path, skip
        self._names = {name.lower(): name for name in columns}
        wide = {name: pa.string() for name in columns}
        try:
            self._table = pacsv.read_csv(
                io.BytesIO(data),
                pacsv.ReadOptions(column_names=list(columns), skip_rows=skip + 1, use_threads=False),
                convert_options=pacsv.ConvertOptions(
                    column_types=wide, strings_can_be_null=True, null_values=[""]
                ),
            )
        except (pa.ArrowInvalid, UnicodeDecodeError) as error:
            found = re.search(r"Row #(\d+): Expected (\d+) columns, got (\d+)", str(error))
            what = (
                f"line {found[1]}: {found[3]} values; {found[2]} as in the header would be right"
                if found
                else str(error).splitlines()[0]
            )
            raise RecordingError(f"{path}: {what}") from None
        if not len(self):
            raise RecordingError(f"{path}: line {skip + 2}: no rows; the file ends after its header")

    def __len__(self) -> int:
        return self._table.num_rows

    def __contains__(self, column: str) -> bool:
        return column.lower() in self._names

    @property
    def lines(self) -> Ints:
        return np.arange(len(self), dtype=np.int64) + self.skip + 2

    def name(self, column: str) -> str:
        """As the file has it."""
        if column not in self:
            raise RecordingError(
                f"{self.path}: line {self.skip + 1}: column {column} is missing; found are "
                f"{', '.join(self._names.values())}"
            )
        return self._names[column.lower()]

    def text(self, column: str) -> NDArray[np.str_]:
        """Values as they stand, "" where there are none."""
        values = self._table[self.name(column)].combine_chunks().fill_null("")
        return np.asarray(values.to_numpy(zero_copy_only=False), dtype=str)

    def numbers(self, column: str, *, missing: bool = False) -> Floats:
        """Finite numbers; where `missing` is allowed, NaN for empty values."""
        name = self.name(column)
        values = self._table[name].combine_chunks()
        try:
            numbers = np.asarray(values.cast(pa.float64()).to_numpy(zero_copy_only=False))
        except pa.ArrowInvalid:
            numbers = np.full(len(self), np.nan)
            for k, value in enumerate(values.to_pylist()):
                try:
                    numbers[k] = math.nan if value is None or not value.strip() else float(value)
                except ValueError:
                    self.refuse(column, k, f"'{str(value)[:30]}'; a number would be right")
        bad = np.isinf(numbers) | (np.isnan(numbers) if not missing else False)
        if bad.any():
            k = int(np.argmax(bad))
            self.refuse(column, k, f"{values[k].as_py() or 'no value'}; a finite number would be right")
        return numbers

    def refuse(self, column: str, row: int, message: str) -> NoReturn:
        raise RecordingError(
            f"{self.path}: line {row + self.skip + 2}, column {self.name(column)}: {message}"
        )


# --- kinds -------------------------------------------------------------------------------------------


def _ngsim_pairs(table: _Table) -> Recording:
    """Metric table of pairs, one row per follower and frame."""
    frame = table.numbers("frame_id")
    follower, leader = table.text("vehicle_id"), table.text("preceding")
    names, (vehicle, lead) = _named(follower, leader)
    columns = {
        "time": "frame_id",
        "x": "local_y",
        "v": "v_vel",
        "length": "v_length",
        "x_lead": "preceding_local_y",
        "v_lead": "preceding_vel",
        "length_lead": "preceding_length",
    }
    numbers: dict[str, Any] = {
        name: table.numbers(column) for name, column in columns.items() if name != "time"
    }
    return _sorted(
        table,
        kind="NGSIM pairs",
        names=names,
        columns=columns,
        vehicle=vehicle,
        leader=lead,
        time=frame * 0.1,
        y=table.numbers("local_x"),
        a=table.numbers("v_acc"),
        lane=table.numbers("lane_id").astype(np.int64),
        vehicle_class=_ngsim_classes(table),
        **numbers,
    )


def _ngsim(table: _Table) -> Recording:
    """As published: feet, frames of 0.1 s, ids that come again; `Location` must be one."""
    if "location" in table and len(set(table.text("location"))) > 1:
        places = ", ".join(sorted(set(table.text("location"))))
        table.refuse("location", 0, f"several sites in one file ({places}); one would be right")
    ident, frame = table.numbers("vehicle_id"), table.numbers("frame_id")
    time = frame * 0.1
    if "global_time" in table:
        epoch = table.numbers("global_time") / 1000
        # of one vehicle id, seconds of both clocks agree but for a constant
        order = np.lexsort((frame, ident))
        same = np.diff(ident[order]) == 0
        drift = np.abs(np.diff(epoch[order]) - np.diff(time[order])) > 0.05
        # An id that comes again has both clocks jump; only a wrong unit makes most steps differ.
        if same.any() and np.mean(drift[same]) > 0.5:
            k = int(order[1:][same & drift][0])
            table.refuse(
                "global_time", k, "does not go with Frame_ID; milliseconds, 100 a frame, would be right"
            )
    # An id may come again in another period of the survey: that is another vehicle.
    period = _periods(ident, time, limit=60.0)
    who = np.char.add(
        ident.astype(np.int64).astype(str), np.where(period > 0, np.char.add("/", period.astype(str)), "")
    )
    lead = table.numbers("preceding").astype(np.int64)
    names, (vehicle, _) = _named(who, who)
    columns = {"time": "frame_id", "x": "local_y", "v": "v_vel", "length": "v_length", "leader": "preceding"}
    recording = _sorted(
        table,
        kind="NGSIM",
        names=names,
        columns=columns,
        vehicle=vehicle,
        leader=lead,  # ids, for now
        time=time,
        x=table.numbers("local_y") * FOOT,
        y=table.numbers("local_x") * FOOT,
        v=table.numbers("v_vel") * FOOT,
        a=table.numbers("v_acc") * FOOT,
        lane=table.numbers("lane_id").astype(np.int64),
        length=table.numbers("v_length") * FOOT,
        vehicle_class=_ngsim_classes(table),
    )
    ids = np.array([int(name.split("/")[0]) for name in names])[recording.vehicle]
    return _joined(recording, ids)


def _ngsim_classes(table: _Table) -> Ints:
    kind = table.numbers("v_class")
    for k in np.flatnonzero(~np.isin(kind, (1, 2, 3)))[:1]:
        table.refuse("v_class", int(k), f"{kind[k]:g}; 1 (motorcycle), 2 (car) or 3 (truck) would be right")
    return np.array([-1, _MOTORCYCLE, _CAR, _TRUCK])[kind.astype(np.int64)]


def _tgsim_pairs(table: _Table) -> Recording:
    """Positions along the road; `spacing` tells the length that was taken off."""
    run, follower = table.text("run_no"), table.text("follower_id")
    who = _joined_text("run ", run, " vehicle ", follower)
    lead = _joined_text("run ", run, " vehicle ", table.text("leader_id"))
    names, (vehicle, leader) = _named(who, lead)
    columns = {
        "time": "timestamp",
        "x": "xFollowerReal",
        "v": "vFollowerReal",
        "a": "aFollowerReal",
        "x_lead": "xLeaderReal",
        "v_lead": "vLeaderReal",
        "length_lead": "spacing",
    }
    values: dict[str, Any] = {name: table.numbers(column) for name, column in columns.items()}
    values["length_lead"] = values["x_lead"] - values["x"] - values["length_lead"]
    return _sorted(
        table,
        kind="TGSIM pairs",
        names=names,
        columns=columns | {"length_lead": "spacing"},
        vehicle=vehicle,
        leader=leader,
        vehicle_class=np.full(len(table), _CAR),
        **values,
    )


def _highd(table: _Table) -> Recording:
    """highD: boxes by their upper left corner, `width` along the road; two directions of travel."""
    tracks, meta = _meta(table.path, "id")
    rate = float(meta["frameRate"])
    frame, ident = table.numbers("frame"), table.numbers("id").astype(np.int64)
    forward = _per_track(table, tracks, ident, "drivingDirection").astype(float) == 2  # 1: towards smaller x
    sign = np.where(forward, 1.0, -1.0)
    length = table.numbers("width")
    x = table.numbers("x") + np.where(forward, length, 0.0)
    kinds = _per_track(table, tracks, ident, "class")
    names, (vehicle, _) = _named(ident.astype(str), ident.astype(str))
    limit = float(meta.get("speedLimit") or "nan")
    recording = _sorted(
        table,
        kind="highD",
        names=names,
        columns={"time": "frame", "x": "x", "v": "xVelocity", "length": "width", "leader": "precedingId"},
        speed_limit=limit if limit > 0 else math.nan,
        vehicle=vehicle,
        leader=table.numbers("precedingId").astype(np.int64),  # ids, for now
        time=frame / rate,
        x=sign * x,
        y=sign * (table.numbers("y") + table.numbers("height") / 2),
        v=sign * table.numbers("xVelocity"),
        a=sign * table.numbers("xAcceleration"),
        lane=table.numbers("laneId").astype(np.int64),
        length=length,
        vehicle_class=_classes(table, kinds),
    )
    return _joined(recording, np.array([int(name) for name in names])[recording.vehicle])


def _ind(table: _Table) -> Recording:
    """inD and relatives: centres in a plane, no lanes; the leader is whoever is next on one's own path."""
    tracks, meta = _meta(table.path, "trackId")
    rate = float(meta["frameRate"])
    ident = table.numbers("trackId").astype(np.int64)
    kinds = _per_track(table, tracks, ident, "class")
    keep = np.isin(kinds, list(_CLASSES))  # no pedestrians and bicycles
    heading = np.radians(table.numbers("heading"))
    v = (
        table.numbers("lonVelocity")
        if "lonVelocity" in table
        else np.hypot(table.numbers("xVelocity"), table.numbers("yVelocity"))
    )
    values = {
        "line": table.lines,
        "ident": ident,
        "time": table.numbers("frame") / rate,
        "px": table.numbers("xCenter"),
        "py": table.numbers("yCenter"),
        "heading": heading,
        "v": v,
        "length": table.numbers("length"),
        "vehicle_class": np.array([_CLASSES.get(kind, -1) for kind in kinds]),
    }
    values = {name: column[keep] for name, column in values.items()}
    if not len(values["time"]):
        raise RecordingError(f"{table.path}: no motor vehicle among its tracks; tracksMeta has their classes")
    limit = float(meta.get("speedLimit") or "nan")
    columns = {"time": "frame", "x": "xCenter", "v": "lonVelocity" if "lonVelocity" in table else "xVelocity"}
    return _on_paths(
        table.path, "inD", columns | {"length": "length"}, limit if limit > 0 else math.nan, values
    )


def _openacc(path: Path, data: bytes) -> Recording:
    """Platoons: speeds and positions by GNSS, spacings bumper to bumper; missing values are empty."""
    lines = data.decode("utf-8", "replace").splitlines()
    header = next((k for k, line in enumerate(lines[:20]) if line.startswith("Time,")), None)
    if header is None:
        raise RecordingError(
            f"{path}: no line that starts with 'Time,'; OpenACC has one after its five of header"
        )
    facts = {row[0]: row[1:] for row in csv.reader(lines[:header]) if row}
    order = facts.get("Vehicle_order", [])
    table = _Table(path, data, [name.strip() for name in lines[header].split(",")], skip=header)
    time = table.numbers("Time")
    human = (facts.get("ACC") or ["0"])[0].strip() == "0"
    spacings = sorted(
        int(name[3:]) for name in lines[header].split(",") if re.fullmatch(r"IVS\d+", name.strip())
    )
    if not spacings:
        raise RecordingError(f"{path}: line {header + 1}: no column IVS1, IVS2, ...; spacings would be right")
    parts = []
    for k in spacings:
        if f"Speed{k}" not in table or f"Speed{k + 1}" not in table:
            continue
        gap = table.numbers(f"IVS{k}", missing=True)
        v, lead = (table.numbers(f"Speed{j}", missing=True) for j in (k + 1, k))
        there = np.isfinite(gap) & np.isfinite(v) & np.isfinite(lead)
        if not there.any():
            continue
        length = 4.5
        if all(f"{axis}{j}" in table for axis in "EN" for j in (k, k + 1)):
            ahead, behind = (
                np.stack([table.numbers(f"{axis}{j}", missing=True) for axis in "EN"]) for j in (k, k + 1)
            )
            apart = np.hypot(*(ahead - behind)) - gap
            length = float(np.median(apart[np.isfinite(apart)])) if np.isfinite(apart).any() else length
            if not _CAR_LENGTHS[0] <= length <= _CAR_LENGTHS[1]:
                raise RecordingError(
                    f"{path}: line {int(np.argmax(there)) + header + 2}, column IVS{k}: spacing and "
                    f"positions leave {length:.1f} m for the length of a car{_feet(length)}; 3 to 7 m "
                    "would be right"
                )
        # The Doppler speed of the leader carries the pair along; the spacing places the follower.
        travelled = np.zeros(len(time))
        speeds = np.where(np.isfinite(lead), lead, 0.0)
        travelled[1:] = np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(time))
        x_lead = travelled + length
        name = [order[j - 1] if j <= len(order) else f"vehicle {j}" for j in (k + 1, k)]
        parts.append((k, there, name, travelled - gap, v, x_lead, lead, np.full(len(time), length)))
    if not parts:
        raise RecordingError(f"{path}: no spacing with the speeds of both its vehicles")
    names = tuple(dict.fromkeys(name for part in parts for name in part[2]))
    count = [int(part[1].sum()) for part in parts]

    def column(values: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([x[part[1]] for x, part in zip(values, parts, strict=True)])

    nothing = np.full(sum(count), np.nan)
    recording = Recording(
        source=str(path),
        kind="OpenACC",
        human=human,
        dt=_step(path, "Time", time, np.zeros(len(time), np.int64), table.lines),
        names=names,
        columns={"time": "Time", "x": "IVS", "v": "Speed", "x_lead": "IVS", "v_lead": "Speed"},
        line=column([table.lines] * len(parts)).astype(np.int64),
        vehicle=np.repeat([names.index(part[2][0]) for part in parts], count),
        leader=np.repeat([names.index(part[2][1]) for part in parts], count),
        time=column([time] * len(parts)),
        x=column([part[3] for part in parts]),
        v=column([part[4] for part in parts]),
        y=nothing,
        a=nothing,
        lane=np.zeros(sum(count), np.int64),
        length=nothing,
        vehicle_class=np.full(sum(count), _CAR),
        x_lead=column([part[5] for part in parts]),
        v_lead=column([part[6] for part in parts]),
        length_lead=column([part[7] for part in parts]),
    )
    return _checked(recording)


def _commonroad(path: Path, data: bytes) -> Recording:
    """Obstacles on lanelets; `x` runs along chains of lanelets, the lane is the chain."""
    try:
        root = etree.fromstring(
            data, etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
        )
    except etree.XMLSyntaxError as error:
        raise RecordingError(f"{path}: not valid XML: {error}") from None
    if root.tag != "commonRoad":
        raise RecordingError(f"{path}: line {root.sourceline}: <{root.tag}>; <commonRoad> would be right")
    dt = _xml_number(path, root, "timeStepSize", root.get("timeStepSize"))
    rows: dict[str, list[float]] = {key: [] for key in ("line", "ident", "time", "px", "py", "heading", "v")}
    rows |= {"length": [], "vehicle_class": []}
    for obstacle in root.iter("dynamicObstacle", "obstacle"):
        kind = (obstacle.findtext("type") or "").strip()
        if kind not in _CLASSES or obstacle.find("trajectory") is None:
            continue
        length = _xml_child(path, obstacle, "shape/rectangle/length")
        states: Any = obstacle.xpath("initialState | trajectory/state")
        for state in states:
            rows["line"].append(float(state.sourceline))
            rows["ident"].append(_xml_number(path, obstacle, "id", obstacle.get("id")))
            rows["time"].append(_xml_child(path, state, "time/exact") * dt)
            rows["px"].append(_xml_child(path, state, "position/point/x"))
            rows["py"].append(_xml_child(path, state, "position/point/y"))
            rows["heading"].append(_xml_child(path, state, "orientation/exact"))
            rows["v"].append(_xml_child(path, state, "velocity/exact"))
            rows["length"].append(length)
            rows["vehicle_class"].append(_CLASSES[kind])
    if not rows["time"]:
        raise RecordingError(
            f"{path}: no <dynamicObstacle> with a <trajectory>; recorded vehicles would be right"
        )
    values = {name: np.asarray(column) for name, column in rows.items()}
    for name in ("line", "ident", "vehicle_class"):
        values[name] = values[name].astype(np.int64)
    columns = {"time": "time", "x": "position", "v": "velocity", "length": "length"}
    return _on_lanelets(path, columns, values, _chains(path, root))


# Columns that tell the kinds apart; readers name the others that they miss.
_READERS = (
    ({"pair_id", "frame_id"}, _ngsim_pairs),
    ({"xleaderreal", "xfollowerreal"}, _tgsim_pairs),
    ({"trackid", "xcenter"}, _ind),
    ({"laneid", "precedingid"}, _highd),
    ({"vehicle_id", "frame_id", "local_y"}, _ngsim),
)


# --- tables ------------------------------------------------------------------------------------------


def _named(*columns: NDArray[np.str_]) -> tuple[tuple[str, ...], list[Ints]]:
    names, index = np.unique(np.concatenate(columns), return_inverse=True)
    parts = np.split(index.astype(np.int64), len(columns))
    return tuple(names.tolist()), parts


def _joined_text(*parts: Any) -> NDArray[np.str_]:
    joined = parts[0]
    for part in parts[1:]:
        joined = np.char.add(joined, part)
    return np.char.strip(joined)


def _periods(ident: Floats, time: Floats, limit: float) -> Ints:
    """How often an id has vanished for longer than `limit` seconds before, per row."""
    order = np.lexsort((time, ident))
    new = np.diff(ident[order], prepend=np.nan) != 0
    again = ~new & (np.diff(time[order], prepend=time[order][:1]) > limit)
    total = np.cumsum(again)
    first = np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))
    period = np.empty(len(order), np.int64)
    period[order] = total - total[first]
    return period


def _sorted(
    table: _Table,
    *,
    kind: str,
    names: tuple[str, ...],
    columns: Mapping[str, str],
    human: bool = True,
    speed_limit: float = math.nan,
    **values: NDArray[Any],
) -> Recording:
    """A recording with the rows in order; what is not given is unknown."""
    values["line"] = table.lines
    return _build(table.path, kind, names, columns, human, speed_limit, values)


def _build(
    path: Path,
    kind: str,
    names: tuple[str, ...],
    columns: Mapping[str, str],
    human: bool,
    speed_limit: float,
    values: dict[str, NDArray[Any]],
) -> Recording:
    count = len(values["time"])
    for name in _ROWS:
        if name not in values:
            values[name] = np.full(count, -1) if name in ("lane", "leader") else np.full(count, np.nan)
    order = np.lexsort((values["time"], values["vehicle"]))
    ordered: dict[str, Any] = {name: np.asarray(values[name])[order] for name in _ROWS}
    dt = _step(path, columns["time"], ordered["time"], ordered["vehicle"], ordered["line"])
    return Recording(
        source=str(path), kind=kind, human=human, dt=dt, names=names, columns=columns,
        speed_limit=speed_limit, **ordered,
    )  # fmt: skip


def _step(path: Path, column: str, time: Floats, vehicle: Ints, line: Ints) -> float:
    """Time step of a recording; refuses times that come twice and steps that are none of a recording."""
    same = np.diff(vehicle) == 0
    steps = np.diff(time)
    twice = same & (steps < 1e-4)
    if twice.any():
        k = int(np.argmax(twice)) + 1
        raise RecordingError(
            f"{path}: line {max(line[k], line[k - 1])}, column {column}: this vehicle is at t = "
            f"{time[k]:.2f} s already in line {min(line[k], line[k - 1])}; one row per vehicle "
            "and time would be right"
        )
    if not same.any():
        raise RecordingError(f"{path}: line {line[0]}: no vehicle with two rows; trajectories would be right")
    dt = round(float(np.median(steps[same])), 5)
    if not 0.01 <= dt <= 0.5:
        raise RecordingError(
            f"{path}: line {line[0]}, column {column}: steps of {dt:g} s; 0.01 to 0.5 s would be right"
        )
    return dt


def _joined(recording: Recording, ident: Ints) -> Recording:
    """Leaders by the ids in `leader`, with their states at the same time."""
    r = recording
    tick = np.round(r.time / r.dt).astype(np.int64)
    width = int(tick.max() - min(tick.min(), 0)) + 2
    key = ident * width + tick - tick.min()
    order = np.argsort(key, kind="stable")
    wanted = r.leader * width + tick - tick.min()
    at = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    row = order[at]
    found = (r.leader > 0) & (key[row] == wanted)
    return replace(
        r,
        leader=np.where(found, r.vehicle[row], -1),
        x_lead=np.where(found, r.x[row], np.nan),
        v_lead=np.where(found, r.v[row], np.nan),
        length_lead=np.where(found, r.length[row], np.nan),
    )


def _meta(path: Path, key: str) -> tuple[dict[int, dict[str, str]], dict[str, str]]:
    """`..._tracksMeta.csv` by track and the row of `..._recordingMeta.csv` beside `..._tracks.csv`."""
    if "_tracks" not in path.name:
        raise RecordingError(f"{path}: has to be named ..._tracks.csv, so that its meta files are found")
    found: list[list[dict[str, str]]] = []
    for kind in ("tracksMeta", "recordingMeta"):
        other = path.with_name(path.name.replace("_tracks", f"_{kind}", 1))
        rows = list(csv.DictReader(_read(other).decode("utf-8-sig", "replace").splitlines()))
        if not rows:
            raise RecordingError(f"{other}: line 2: no rows; the file ends after its header")
        needed = (key, "class") if kind == "tracksMeta" else ("frameRate",)
        for column in needed:
            if column not in rows[0]:
                raise RecordingError(
                    f"{other}: line 1: column {column} is missing; found are {', '.join(rows[0])}"
                )
        found.append(rows)
    tracks, (meta, *_) = found
    try:
        if not 1 <= float(meta["frameRate"]) <= 100:
            raise ValueError
        return {int(float(row[key])): row for row in tracks}, meta
    except ValueError:
        other = path.with_name(path.name.replace("_tracks", "_recordingMeta", 1))
        raise RecordingError(
            f"{other}: line 2, column frameRate: '{meta['frameRate']}'; 1 to 100 frames a second, and "
            f"numbers for {key}, would be right"
        ) from None


def _per_track(
    table: _Table, tracks: Mapping[int, Mapping[str, str]], ident: Ints, column: str
) -> NDArray[np.str_]:
    known, index = np.unique(ident, return_inverse=True)
    values = []
    for k, track in enumerate(known.tolist()):
        if track not in tracks or column not in tracks[track]:
            row = int(np.argmax(index == k))
            table.refuse("id" if "id" in table else "trackId", row, f"{track} has no {column} in tracksMeta")
        values.append(tracks[track][column].strip().lower())
    return np.array(values)[index]


def _classes(table: _Table, kinds: NDArray[np.str_]) -> Ints:
    known, index = np.unique(kinds, return_inverse=True)
    for k, kind in enumerate(known.tolist()):
        if kind not in _CLASSES:
            row = int(np.argmax(index == k))
            raise RecordingError(
                f"{table.path}: line {row + 2}: class '{kind}' in tracksMeta; one of "
                f"{', '.join(_CLASSES)} would be right"
            )
    return np.array([_CLASSES[kind] for kind in known.tolist()])[index]


# --- leaders in the plane ----------------------------------------------------------------------------


def _on_paths(
    path: Path, kind: str, columns: Mapping[str, str], limit: float, values: dict[str, NDArray[Any]]
) -> Recording:
    """Leaders where there are no lanes: the next vehicle on the path that the follower itself took."""
    order = np.lexsort((values["time"], values["ident"]))
    values = {name: column[order] for name, column in values.items()}
    ident, time = values["ident"], values["time"]
    names, vehicle = np.unique(ident, return_inverse=True)
    _step(path, columns["time"], time, vehicle, values["line"])
    point = np.stack([values["px"], values["py"]], -1)
    heading, length = values["heading"], values["length"]
    starts = np.searchsorted(vehicle, np.arange(len(names) + 1))
    tick = np.round(time / np.median(np.diff(time)[np.diff(vehicle) == 0])).astype(np.int64)
    x, x_lead = np.zeros(len(time)), np.full(len(time), np.nan)
    lead_row = np.full(len(time), -1)
    first, last = tick[starts[:-1]], tick[starts[1:] - 1]
    for i in range(len(names)):
        own = slice(starts[i], starts[i + 1])
        track = point[own]
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=-1))])
        x[own] = s + length[own] / 2
        tree, best = KDTree(track), np.full(len(track), np.inf)
        for j in np.flatnonzero((first <= last[i]) & (last >= first[i])):
            if j == i:
                continue
            rows = np.arange(starts[j], starts[j + 1])
            at = np.searchsorted(tick[own], tick[rows])
            rows = rows[(at < len(track)) & (tick[own][np.minimum(at, len(track) - 1)] == tick[rows])]
            at = np.searchsorted(tick[own], tick[rows])
            apart, nearest = map(np.asarray, tree.query(point[rows], distance_upper_bound=2 * BESIDE))
            hit = np.isfinite(apart)
            rows, at, nearest = rows[hit], at[hit], nearest[hit]
            offset, course = point[rows] - track[nearest], heading[own][nearest]
            along = offset[:, 0] * np.cos(course) + offset[:, 1] * np.sin(course)
            across = offset[:, 1] * np.cos(course) - offset[:, 0] * np.sin(course)
            # Nobody follows who is only abreast of, or beyond an end of, the path.
            hit = (np.abs(across) <= BESIDE) & (np.abs(along) <= BESIDE)
            rows, at, nearest, along = rows[hit], at[hit], nearest[hit], along[hit]
            turned = np.cos(heading[rows] - heading[own][nearest]) > 0.5
            front = s[nearest] + along + length[rows] / 2
            gap = front - length[rows] - x[own][at]
            ahead = turned & (s[nearest] > s[at]) & (gap < np.minimum(best[at], REACH))
            best[at[ahead]] = gap[ahead]
            x_lead[own.start + at[ahead]] = front[ahead]
            lead_row[own.start + at[ahead]] = rows[ahead]
    there = lead_row >= 0
    return _build(
        path,
        kind,
        tuple(str(name) for name in names),
        columns,
        True,
        limit,
        {
            "line": values["line"],
            "vehicle": vehicle,
            "time": time,
            "x": x,
            "v": values["v"],
            "length": length,
            "vehicle_class": values["vehicle_class"],
            "leader": np.where(there, vehicle[lead_row], -1),
            "x_lead": x_lead,
            "v_lead": np.where(there, values["v"][lead_row], np.nan),
            "length_lead": np.where(there, length[lead_row], np.nan),
        },
    )


@dataclass(frozen=True)
class _Chains:
    """Lanelets one after another: points of their centre lines."""

    point: Floats  # [P 2]
    s: Floats  # [P], along the chain
    chain: Ints  # [P]
    half_width: Floats  # [P]
    heading: Floats  # [P]


def _chains(path: Path, root: Any) -> _Chains:
    centre, width, successors = {}, {}, {}
    for lanelet in root.iter("lanelet"):
        if lanelet.find("leftBound") is None:
            continue  # a reference
        name = lanelet.get("id")
        left, right = (
            np.array(
                [
                    [_xml_child(path, p, "x"), _xml_child(path, p, "y")]
                    for p in lanelet.iterfind(f"{side}/point")
                ]
            )
            for side in ("leftBound", "rightBound")
        )
        if len(left) != len(right) or len(left) < 2:
            raise RecordingError(
                f"{path}: line {lanelet.sourceline}: lanelet {name} has bounds of {len(left)} and "
                f"{len(right)} points; "
                "as many on both sides, and at least two, would be right"
            )
        centre[name] = (left + right) / 2
        width[name] = np.linalg.norm(left - right, axis=-1)
        successors[name] = [link.get("ref") for link in lanelet.iterfind("successor")]
    if not centre:
        raise RecordingError(f"{path}: no <lanelet>; a lane map would be right")
    followed = {name for after in successors.values() for name in after}
    free = dict.fromkeys(centre)
    parts = []
    # From where nobody comes first; a loop has no such place, and begins anywhere.
    for name in [*(name for name in centre if name not in followed), *centre]:
        chain, at = len(parts), 0.0
        pieces = []
        while name in free:
            del free[name]
            line = centre[name]
            along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))])
            fine = np.linspace(0, along[-1], max(int(along[-1]) + 1, 2))
            xy = np.stack([np.interp(fine, along, line[:, k]) for k in range(2)], -1)
            pieces.append((xy, at + fine, np.full(len(fine), chain), np.interp(fine, along, width[name] / 2)))
            at += along[-1]
            name = next((after for after in successors[name] if after in free), "")
        if pieces:
            xy, s, chains, half = (np.concatenate(column) for column in zip(*pieces, strict=True))
            step = np.gradient(xy, axis=0)
            parts.append((xy, s, chains, half, np.arctan2(step[:, 1], step[:, 0])))
    return _Chains(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _on_lanelets(
    path: Path, columns: Mapping[str, str], values: dict[str, NDArray[Any]], chains: _Chains
) -> Recording:
    """Positions along chains of lanelets; the leader is the next vehicle on the same chain."""
    order = np.lexsort((values["time"], values["ident"]))
    values = {name: column[order] for name, column in values.items()}
    point = np.stack([values["px"], values["py"]], -1)
    # Among the nearest centre points one whose lane goes the same way.
    apart, near = KDTree(chains.point).query(point, k=min(8, len(chains.point)))
    turn = np.cos(values["heading"][:, None] - chains.heading[near])
    pick = np.argmin(np.where(turn > 0.5, apart, apart + 1e3), axis=-1)
    near = np.take_along_axis(near, pick[:, None], -1)[:, 0]
    offset = point - chains.point[near]
    tangent = np.stack([np.cos(chains.heading[near]), np.sin(chains.heading[near])], -1)
    along = np.sum(offset * tangent, -1)
    across = tangent[:, 0] * offset[:, 1] - tangent[:, 1] * offset[:, 0]
    on = (np.abs(across) <= chains.half_width[near] + 0.5) & (np.abs(along) < 3)
    names, vehicle = np.unique(values["ident"], return_inverse=True)
    lane = np.where(on, chains.chain[near], -1)
    length = values["length"]
    x = chains.s[near] + along + length / 2
    dt = _step(path, columns["time"], values["time"], vehicle, values["line"])
    tick = np.round(values["time"] / dt).astype(np.int64)
    ahead = np.lexsort((x, lane, tick))
    same = (np.diff(tick[ahead]) == 0) & (np.diff(lane[ahead]) == 0) & (lane[ahead][1:] >= 0)
    lead = np.full(len(x), -1)
    lead[ahead[:-1][same]] = ahead[1:][same]
    lead[np.where(lead >= 0, x[lead] - x, 0) > REACH] = -1
    # Side by side on one chain, where lanes merge or one of them is changing lanes: nobody follows.
    beside = (lead >= 0) & (x[lead] - length[lead] <= x) & (np.abs(across[lead] - across) > BESIDE)
    lead[beside] = -1
    there = lead >= 0
    return _build(
        path,
        "CommonRoad",
        tuple(str(name) for name in names),
        columns,
        True,
        math.nan,
        {
            "line": values["line"],
            "vehicle": vehicle,
            "time": values["time"],
            "x": x,
            "y": across,
            "v": values["v"],
            "lane": lane,
            "length": length,
            "vehicle_class": values["vehicle_class"],
            "leader": np.where(there, vehicle[lead], -1),
            "x_lead": np.where(there, x[lead], np.nan),
            "v_lead": np.where(there, values["v"][lead], np.nan),
            "length_lead": np.where(there, length[lead], np.nan),
        },
    )


def _xml_child(path: Path, element: Any, child: str) -> float:
    found = element.find(child)
    if found is None:
        raise RecordingError(f"{path}: line {element.sourceline}: <{element.tag}> has no {child}")
    return _xml_number(path, found, child, found.text)


def _xml_number(path: Path, element: Any, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RecordingError(
            f"{path}: line {element.sourceline}, {name}: '{text or ''}'; a finite number would be right"
        )
    return value


# --- checks ------------------------------------------------------------------------------------------


def _checked(recording: Recording) -> Recording:
    """The recording with its defects; refuses wrong units and a file with too many defects."""
    _check_units(recording)
    defects = tuple(_defects(recording))
    recording = replace(recording, defects=defects)
    followers = len(np.unique(recording.vehicle[recording.leader >= 0]))
    if not followers:
        raise RecordingError(
            f"{recording.source}: line {recording.line[0]}: nobody follows anybody in this file"
        )
    bad = {defect.vehicle for defect in defects if defect.kind != "spacing"}
    if len(bad) > TOLERATED * followers:
        more = f" (and {len(defects) - 1} more like this)" if len(defects) > 1 else ""
        first = next(iter(defects)).message
        raise RecordingError(f"{recording.source}: {first}{more}")
    return recording


def _feet(value: float, usual: float = 4.6) -> str:
    """A hint that a length is one in feet."""
    return " (it looks like feet)" if 0.7 < value * FOOT / usual < 1.4 else ""


def _check_units(r: Recording) -> None:
    def refuse(row: int, field: str, message: str) -> NoReturn:
        raise RecordingError(
            f"{r.source}: line {r.line[row]}, column {r.columns.get(field, field)}: {message}"
        )

    for field in ("length", "length_lead"):
        cars = (r.vehicle_class == _CAR) & np.isfinite(getattr(r, field))
        if field == "length_lead":  # whose class is that of its own rows
            cars &= r.leader >= 0
        if cars.any():
            middle = float(np.median(getattr(r, field)[cars]))
            if not _CAR_LENGTHS[0] <= middle <= _CAR_LENGTHS[1]:
                hint = (
                    " (it looks like metres where feet belong)"
                    if r.kind == "NGSIM" and middle < 2.2
                    else _feet(middle)
                )
                refuse(
                    int(np.argmax(cars)),
                    field,
                    f"cars are {middle:.1f} m long in the median{hint}; 3 to 7 m would be right",
                )
    for x, v, who in ((r.x, r.v, "x v"), (r.x_lead, r.v_lead, "x_lead v_lead")):
        fields_ = who.split()
        backwards = v < -0.5
        if np.mean(backwards) > 0.01:
            refuse(
                int(np.argmax(backwards)), fields_[1], f"{v[backwards][0]:.2f} m/s; speeds are not negative"
            )
        fast = float(np.nanquantile(v, 0.99)) if np.isfinite(v).any() else 0.0
        if fast > _FASTEST:
            k = int(np.nanargmax(v))
            refuse(k, fields_[1], f"{v[k]:.0f} m/s; at most {_FASTEST:.0f} m/s would be right")
        if r.kind == "OpenACC" and fields_[0] == "x_lead":
            continue  # these positions are integrals of the speeds
        step = np.diff(r.time)
        near = (
            (np.diff(r.vehicle) == 0)
            & (step < 1.5 * r.dt)
            & (np.diff(r.leader) == 0)
            & (np.diff(r.lane) == 0)
        )
        moved, driven = np.diff(x), 0.5 * (v[1:] + v[:-1]) * step
        # Positions against speeds, over rows where something moves.
        moving = near & (driven > 0.5 * r.dt) & np.isfinite(moved)
        if moving.sum() >= 20:
            ratio = float(np.sum(moved[moving]) / np.sum(driven[moving]))
            if not 0.8 <= ratio <= 1.25:
                hints = {
                    3.281: "positions in feet",
                    0.3048: "speeds in feet per second",
                    0.2778: "speeds in km/h",
                }
                hints |= {10: "speeds per frame", 0.1: "time in frames"}
                hint = next(
                    (f" (that is {text})" for k, text in hints.items() if abs(ratio / k - 1) < 0.05), ""
                )
                refuse(
                    int(np.argmax(moving)) + 1,
                    fields_[0],
                    f"positions advance {ratio:.2f} times as far as the speeds in "
                    f"{r.columns.get(fields_[1])} say{hint}; m and m/s would be right",
                )


def _defects(r: Recording) -> Iterator[Defect]:
    """Time that is missing, leaders behind, bodies that overlap."""

    def column(field: str) -> str:
        return r.columns.get(field, field)

    step = np.diff(r.time)
    same = (np.diff(r.vehicle) == 0) & (r.leader[1:] >= 0) & (r.leader[:-1] == r.leader[1:])
    gapless = r.kind == "OpenACC"  # where missing values are part of the format
    for k in np.flatnonzero(same & (step > 1.5 * r.dt)) if not gapless else ():
        yield Defect(
            "time",
            r.names[r.vehicle[k]],
            int(r.line[k + 1]),
            0,
            f"line {r.line[k + 1]}, column {column('time')}: {step[k]:.1f} s are missing before this row of "
            f"vehicle {r.names[r.vehicle[k]]}; steps of {r.dt:g} s would be right",
        )
    following = r.leader >= 0
    behind = following & (r.x_lead <= r.x)
    overlap = following & ~behind & (r.gap <= 0)
    for bad, kind in ((behind, "behind"), (overlap, "overlap")):
        if gapless:
            kind = "spacing"
        first = bad & ~np.concatenate([[False], bad[:-1] & (np.diff(r.vehicle) == 0)])
        for k in np.flatnonzero(first):
            end = k + 1
            while end < len(bad) and bad[end] and r.vehicle[end] == r.vehicle[k]:
                end += 1
            name, leader = r.names[r.vehicle[k]], r.names[r.leader[k]]
            what = (
                f"leader {leader} is {r.x[k] - r.x_lead[k]:.1f} m behind its follower {name}; a leader ahead"
                if kind == "behind"
                else f"{name} overlaps its leader {leader} by {-r.gap[k:end].min():.1f} m; a gap above 0"
            )
            yield Defect(
                kind,
                name,
                int(r.line[k]),
                int(end - k),
                f"line {r.line[k]}, column {column('x_lead' if kind == 'behind' else 'x')}: {what} "
                "would be right",
            )


__all__ = ["TOLERATED", "Defect", "Recording", "RecordingError", "Source", "as_recording", "read_recording"]
