"""Recorder logs of CARLA: bytes to typed frames and back, without loss.

The layout is that of CARLA's recorder (CARLA documentation, "Recorder binary file format", and the headers of
its recorder): little endian, strings with their length before them, packets of an id, a size and data.
Lengths are centimetres, angles degrees, rotations roll, pitch, yaw. CARLA's frame is left-handed: y and yaw
are mirrored against ours (`to_carla`, `from_carla`).
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.recordings.recording import RecordingError
from limsim_jax.recordings.table import read_bytes

MAGIC = "CARLA_RECORDER"
CM = 100.0
"""cm per m."""

_HEAD = struct.Struct("<BI")
_COUNT = struct.Struct("<H")
_FRAME = struct.Struct("<Qdd")
_ACTOR = struct.Struct("<IB6fI")


class Kind(enum.IntEnum):
    """Ids of packets."""

    FRAME_START = 0
    FRAME_END = 1
    ADD = 2
    DELETE = 3
    PARENT = 4
    COLLISION = 5
    POSITION = 6
    TRAFFIC_LIGHT = 7
    VEHICLE = 8
    WALKER = 9
    VEHICLE_LIGHT = 10
    SCENE_LIGHT = 11
    KINEMATICS = 12
    BOX = 13
    PLATFORM_TIME = 14
    PHYSICS = 15
    LIGHT_TIME = 16
    TRIGGER = 17


class ActorType(enum.IntEnum):
    """What an actor is."""

    OTHER = 0
    VEHICLE = 1
    WALKER = 2
    TRAFFIC_LIGHT = 3
    TRAFFIC_SIGN = 4
    SENSOR = 5


class AttributeType(enum.IntEnum):
    """What the text of an attribute stands for."""

    BOOL = 0
    INT = 1
    FLOAT = 2
    STRING = 3
    COLOR = 4


def _record(*fields: Any) -> np.dtype[Any]:
    return np.dtype([("id", "<u4"), *fields])


_POSE = (("location", "<f4", 3), ("rotation", "<f4", 3))

RECORDS: dict[int, np.dtype[Any]] = {
    Kind.DELETE: _record(),
    Kind.PARENT: _record(("parent", "<u4")),
    Kind.COLLISION: _record(("a", "<u4"), ("b", "<u4"), ("hero_a", "u1"), ("hero_b", "u1")),
    Kind.POSITION: _record(*_POSE),  # cm, degrees
    Kind.TRAFFIC_LIGHT: _record(("frozen", "u1"), ("elapsed", "<f4"), ("state", "u1")),  # s
    Kind.VEHICLE: _record(
        ("steer", "<f4"), ("throttle", "<f4"), ("brake", "<f4"), ("hand_brake", "u1"), ("gear", "<i4")
    ),
    Kind.WALKER: _record(("speed", "<f4")),
    Kind.VEHICLE_LIGHT: _record(("state", "<u4")),
    Kind.KINEMATICS: _record(("velocity", "<f4", 3), ("angular", "<f4", 3)),  # m/s, degrees/s
    Kind.BOX: _record(("origin", "<f4", 3), ("extent", "<f4", 3)),  # cm, from the actor; half sides
    Kind.LIGHT_TIME: _record(("green", "<f4"), ("yellow", "<f4"), ("red", "<f4")),  # s
    Kind.TRIGGER: _record(("origin", "<f4", 3), ("extent", "<f4", 3)),
}
"""Packets that are a count and records of one size."""

LIGHT_STATES = ("red", "yellow", "green", "off", "unknown")
"""By the number of the state of a traffic light."""


@dataclass(frozen=True)
class Attribute:
    """A property of an actor, as text."""

    type: int
    name: str
    value: str


@dataclass(frozen=True)
class Actor:
    """An actor that comes in."""

    id: int
    type: int  # of `ActorType`
    location: tuple[float, float, float]  # cm
    rotation: tuple[float, float, float]  # degrees: roll, pitch, yaw
    description: int  # number of the blueprint on the server that wrote the log
    blueprint: str
    attributes: tuple[Attribute, ...] = ()

    def attribute(self, name: str) -> str | None:
        """The text of an attribute, None without one."""
        return next((a.value for a in self.attributes if a.name == name), None)


Content = tuple[Actor, ...] | NDArray[Any] | float | bytes
"""Of a packet: actors, records (`RECORDS`), seconds (`PLATFORM_TIME`), or bytes of kinds not decoded."""


@dataclass(frozen=True, eq=False)
class Packet:
    """A packet of a frame."""

    kind: int
    content: Content


@dataclass(frozen=True, eq=False)
class Frame:
    """What one tick of the server recorded, in order."""

    number: int  # from 1
    duration: float  # s until the next one, -1 in the last
    elapsed: float  # s since the first
    packets: tuple[Packet, ...]

    def records(self, kind: Kind) -> NDArray[Any]:
        """All records of a kind of `RECORDS`, `[n]`."""
        found = [p.content for p in self.packets if p.kind == kind]
        return np.concatenate(found) if found else np.zeros(0, RECORDS[kind])  # pyright: ignore

    @property
    def added(self) -> tuple[Actor, ...]:
        """Actors that come in."""
        return tuple(a for p in self.packets if p.kind == Kind.ADD for a in p.content)  # pyright: ignore


@dataclass(frozen=True, eq=False, kw_only=True)
class CarlaLog:
    """A recorder log."""

    map: str  # name of the town
    date: int  # s since 1970
    frames: tuple[Frame, ...]
    source: str = "log"  # file

    def to_bytes(self) -> bytes:
        """The file, unpacked."""
        return b"".join(_encoded(self))

    def actors(self) -> Iterator[Actor]:
        """All actors that come in, frame by frame."""
        for frame in self.frames:
            yield from frame.added

    def __repr__(self) -> str:
        last = self.frames[-1].elapsed if self.frames else 0.0
        kinds = [actor.type for actor in self.actors()]
        return (
            f"CarlaLog of {self.map}: {len(self.frames)} frames, {last:.1f} s, "
            f"{kinds.count(ActorType.VEHICLE)} vehicles, {kinds.count(ActorType.WALKER)} walkers"
        )


def to_carla(x: Any, y: Any, z: Any, heading: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Our position and heading in CARLA's frame and units.

    Metres and radians as cm, `[..., 3]`, and degrees of yaw, -180 to 180."""
    location = np.stack(np.broadcast_arrays(x, np.negative(y), z), -1) * CM
    return location, (180.0 - np.degrees(heading)) % 360.0 - 180.0


def from_carla(location: Any, yaw: Any) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """A location and yaw of CARLA in our frame and units.

    From cm, `[..., 3]`, and degrees to x, y, z (m) and heading (rad)."""
    x, y, z = np.moveaxis(np.asarray(location, np.float64) / CM, -1, 0)
    return x, -y, z, -np.radians(np.asarray(yaw, np.float64))


# --- reading ------------------------------------------------------------------------------------------------


_MARK = _COUNT.pack(len(MAGIC)) + MAGIC.encode()


def is_carla_log(data: bytes) -> bool:
    """Whether a file begins as a recorder log does."""
    return data[2 : 2 + len(_MARK)] == _MARK


def read_log(path: str | Path) -> CarlaLog:
    """Read a recorder log, also gzipped.

    Raises:
      RecordingError: one line that names the file, the byte of the unpacked file, and what is expected.
    """
    return parse_log(path, read_bytes(path))


def parse_log(path: str | Path, data: bytes) -> CarlaLog:
    """The log in the bytes of a file; `path` is named in errors.

    Raises:
      RecordingError: see `read_log`.
    """
    reader = _Reader(str(path), data)
    (version,) = reader.unpack(_COUNT, "the version")
    if not _MARK.startswith(data[2 : 2 + len(_MARK)]):
        mark = data[4 : 2 + len(_MARK)].decode(errors="replace")
        raise reader.error(f"the mark is {mark!r}; {MAGIC}, of a recorder log of CARLA, is expected", 2)
    reader.text("the mark of a recorder log")
    if version != 1:
        raise reader.error(f"version {version}; version 1 is expected", 0)
    (date,) = reader.unpack(struct.Struct("<q"), "the date")
    town = reader.text("the name of the map")
    frames = []
    while reader.at < len(data):
        frames.append(_frame(reader))
    if not frames:
        raise reader.error("no frames; at least one is expected", reader.at)
    return CarlaLog(map=town, date=date, frames=tuple(frames), source=str(path))


class _Reader:
    """Bytes up to `end`; whatever is not there is an error with its place."""

    def __init__(self, source: str, data: bytes) -> None:
        self.source, self.data, self.at, self.end = source, data, 0, len(data)

    def error(self, reason: str, at: int) -> RecordingError:
        return RecordingError(f"{self.source}: byte {at}: {reason}")

    def take(self, count: int, what: str) -> int:
        """Where `count` bytes begin, which are passed."""
        begin = self.at
        if begin + count > self.end:
            where = "the file" if self.end == len(self.data) else f"its packet (byte {self.end})"
            raise self.error(f"{where} ends within {what}; {count} bytes are expected", begin)
        self.at += count
        return begin

    def unpack(self, layout: struct.Struct, what: str) -> tuple[Any, ...]:
        return layout.unpack_from(self.data, self.take(layout.size, what))

    def text(self, what: str) -> str:
        begin = self.at
        (count,) = self.unpack(_COUNT, what)
        start = self.take(count, what)
        try:
            return self.data[start : start + count].decode()
        except UnicodeDecodeError:
            raise self.error(f"{what} is no UTF-8", begin) from None


def _frame(reader: _Reader) -> Frame:
    begin = reader.at
    kind, size = reader.unpack(_HEAD, "the head of a packet")
    if kind != Kind.FRAME_START or size != _FRAME.size:
        raise reader.error(
            f"packet {kind} of {size} bytes; the start of a frame, packet 0 of 24 bytes, is expected",
            begin,
        )
    number, duration, elapsed = reader.unpack(_FRAME, "the start of a frame")
    packets = []
    while True:
        begin = reader.at
        kind, size = reader.unpack(_HEAD, f"frame {number}")
        if kind == Kind.FRAME_START:
            raise reader.error(f"frame {number} has no end before the next one", begin)
        start = reader.take(size, f"packet {kind} of frame {number}")
        if kind == Kind.FRAME_END:
            if size:
                raise reader.error(f"the end of frame {number} has {size} bytes; none are expected", begin)
            return Frame(number, duration, elapsed, tuple(packets))
        packets.append(Packet(kind, _content(reader, kind, start, size)))


def _content(reader: _Reader, kind: int, start: int, size: int) -> Content:
    data = reader.data
    if kind == Kind.PLATFORM_TIME:
        if size != 8:
            raise reader.error(f"packet {kind} has {size} bytes; 8 are expected", start)
        return float(struct.unpack_from("<d", data, start)[0])
    if kind in RECORDS:
        record = RECORDS[kind]
        count = _COUNT.unpack_from(data, start)[0] if size >= 2 else 0
        if size != 2 + count * record.itemsize:
            raise reader.error(
                f"packet {kind} has {size} bytes for {count} records of {record.itemsize} bytes; "
                f"{2 + count * record.itemsize} are expected",
                start,
            )
        return np.frombuffer(data, record, count, start + 2)
    if kind == Kind.ADD:
        inner = _Reader(reader.source, data)
        inner.at, inner.end = start, start + size
        (count,) = inner.unpack(_COUNT, "the number of actors")
        actors = tuple(_actor(inner) for _ in range(count))
        if inner.at != inner.end:
            raise reader.error(
                f"{inner.end - inner.at} bytes after the last actor; none are expected", inner.at
            )
        return actors
    return data[start : start + size]


def _actor(reader: _Reader) -> Actor:
    ident, kind, *pose, description = reader.unpack(_ACTOR, "an actor")
    blueprint = reader.text("the blueprint of an actor")
    (count,) = reader.unpack(_COUNT, "the attributes of an actor")
    attributes = []
    for _ in range(count):
        (type_,) = reader.unpack(struct.Struct("<B"), "an attribute")
        attributes.append(Attribute(type_, reader.text("an attribute"), reader.text("an attribute")))
    return Actor(ident, kind, tuple(pose[:3]), tuple(pose[3:]), description, blueprint, tuple(attributes))


# --- writing ------------------------------------------------------------------------------------------------


def save_log(path: str | Path, log: CarlaLog) -> None:
    """Write a log, all of it or nothing; gzipped if the name ends with `.gz`.

    Raises:
      OSError: the file cannot be written.
      ValueError: a text or a number of records that the format has no room for.
    """
    data = log.to_bytes()
    if Path(path).suffix.lower() == ".gz":
        import gzip

        data = gzip.compress(data, mtime=0)
    write_whole(path, data)


def _encoded(log: CarlaLog) -> Iterator[bytes]:
    yield _COUNT.pack(1) + _text(MAGIC) + struct.pack("<q", log.date) + _text(log.map)
    for frame in log.frames:
        yield _packet(Kind.FRAME_START, _FRAME.pack(frame.number, frame.duration, frame.elapsed))
        for packet in frame.packets:
            yield _packet(packet.kind, _data(packet))
        yield _packet(Kind.FRAME_END, b"")


def _packet(kind: int, data: bytes) -> bytes:
    return _HEAD.pack(kind, len(data)) + data


def _data(packet: Packet) -> bytes:
    content = packet.content
    match content:
        case bytes():
            return content
        case float():
            return struct.pack("<d", content)
        case np.ndarray():
            records = np.ascontiguousarray(content, RECORDS[packet.kind])
            return _count(len(records)) + records.tobytes()
        case tuple():
            return _count(len(content)) + b"".join(_encoded_actor(actor) for actor in content)
        case _:
            raise TypeError(f"packet {packet.kind}: {type(content).__name__} is no content of a packet")


def _encoded_actor(actor: Actor) -> bytes:
    head = _ACTOR.pack(actor.id, actor.type, *actor.location, *actor.rotation, actor.description)
    attributes = [bytes([a.type]) + _text(a.name) + _text(a.value) for a in actor.attributes]
    return head + _text(actor.blueprint) + _count(len(attributes)) + b"".join(attributes)


def _text(text: str) -> bytes:
    data = text.encode()
    return _count(len(data)) + data


def _count(count: int) -> bytes:
    if count >= 2**16:
        raise ValueError(f"{count} records or bytes of text; a recorder log has room for {2**16 - 1}")
    return _COUNT.pack(count)


__all__ = [
    "CM",
    "LIGHT_STATES",
    "RECORDS",
    "Actor",
    "ActorType",
    "Attribute",
    "AttributeType",
    "CarlaLog",
    "Frame",
    "Kind",
    "Packet",
    "from_carla",
    "is_carla_log",
    "parse_log",
    "read_log",
    "save_log",
    "to_carla",
]
