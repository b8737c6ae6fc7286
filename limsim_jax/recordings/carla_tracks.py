"""Tracks of the vehicles in a recorder log of CARLA."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from limsim_jax.maps.network import Network
from limsim_jax.recordings.carla_bodies import body_of
from limsim_jax.recordings.carla_log import CM, Actor, ActorType, CarlaLog, Frame, Kind, from_carla, parse_log
from limsim_jax.recordings.recording import FASTEST, Floats, RecordingError
from limsim_jax.recordings.tracks import Rows, Tracks, tracks_from_rows

STEP = 0.025
"""s, time step of the tracks of a log whose frames are not evenly spaced.

With it, the straight line between two steps is within 2 mm of the way at 20 m/s^2."""

HERO = "hero"
"""Role of the vehicle under test in CARLA, and its name here if there is one only; others have their ids."""

EVEN = 1e-3
"""s by which the frames of a log with a fixed step may be off."""

_STEPS = (0.02, 0.5)  # s, a log with a fixed step within these keeps it
_LONGEST = 100_000  # steps
_JUMP = 2.0  # m farther than its speed allows: the vehicle was put elsewhere
_LEVEL = 3.0  # m above or below the lane at which a vehicle is not on the road: CARLA parks some under it
_NEAR = 8.0  # m from the middle of a lane that is still the road
_FIT = 0.5  # share of the places of vehicles that lie on the map it was recorded on, at least
_SAMPLE = 2.0  # m between the points of lanes that vehicles are compared with


def read_carla_tracks(path: Path, data: bytes, network: Network, dt: float | None = None) -> Tracks:
    """All vehicles of a log.

    Between frames vehicles move evenly, as in CARLA's replayer. A vehicle that was put elsewhere counts as
    another one from then on. Walkers, props and vehicles above or below the road are left out.

    Args:
      path: of the log, for errors.
      data: its bytes.
      network: of the town.
      dt: s per step; None: that of the log if it is fixed, otherwise 0.025 s.

    Raises:
      RecordingError: no log, no vehicles, times that do not grow, or another map.
    """
    log = parse_log(path, data)
    time = _times(path, log)
    dt = _step(time) if dt is None else dt
    if not 0 < dt <= 1:
        raise RecordingError(f"{path}: dt: {dt:g} s; more than 0 and at most 1 is expected")
    if (time[-1] - time[0]) / dt > _LONGEST:
        raise RecordingError(
            f"{path}: lasts {time[-1] - time[0]:g} s; at most {_LONGEST:,} steps of {dt:g} s are expected"
        )
    roads = _Roads(network)
    rows: list[Rows] = []
    fits = []
    for vehicle, frames, places in _pieces(path, log, time):
        t = time[frames] - time[0]
        if len(t) < 2:
            continue
        steps = np.arange(math.ceil(t[0] / dt - 1e-6), math.floor(t[-1] / dt + 1e-6) + 1)
        if len(steps) < 2:
            continue
        at = np.stack([np.interp(steps * dt, t, column) for column in places.T], -1)
        beside, level = roads.near(at[:, :3])
        fits.append((len(beside), beside.sum()))
        if level.any():
            rows.append(_rows(vehicle, log.frames[int(frames[0])].number, steps, at, dt))
    if not fits:
        raise RecordingError(
            f"{path}: no vehicles that move through two frames; recorded vehicles are expected"
        )
    total, fit = np.sum(fits, 0)
    if fit < _FIT * total:
        raise RecordingError(
            f"{path}: {fit} of {total} places of its vehicles lie on the lanes of {network.source}; the map "
            f"of {log.map}, where it was recorded, is expected"
        )
    if not rows:
        raise RecordingError(f"{path}: all vehicles are above or below the road; vehicles on it are expected")
    return tracks_from_rows(path, f"{log.map} {Path(path).name}", float(dt), _joined(rows), network)


def _times(path: Path, log: CarlaLog) -> Floats:
    """s, of each frame."""
    time = np.array([frame.elapsed for frame in log.frames])
    wrong = ~np.isfinite(time) | np.append(False, np.diff(time) <= 0)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise RecordingError(
            f"{path}: frame {log.frames[k].number}: {time[k]:g} s elapsed; seconds that grow are expected"
        )
    if len(time) < 2:
        raise RecordingError(f"{path}: one frame; at least two are expected")
    return time


def _step(time: Floats) -> float:
    steps = np.diff(time)
    step = round(float(np.median(steps)), 6)
    even = np.abs(time - time[0] - step * np.arange(len(time))).max() < EVEN
    return step if even and _STEPS[0] <= step <= _STEPS[1] else STEP


def _is_hero(actor: Actor) -> bool:
    return actor.type == ActorType.VEHICLE and actor.attribute("role_name") == HERO


def _pieces(path: Path, log: CarlaLog, time: Floats) -> Iterator[tuple[_Vehicle, NDArray[Any], Floats]]:
    """Stretches of vehicles: numbers of frames, and x, y, z (m) and heading (rad, no jumps).

    A stretch ends where its vehicle leaves or is put elsewhere. An id may be given to another actor later.
    """
    heroes = {actor.id for actor in log.actors() if _is_hero(actor)}
    present: dict[int, tuple[_Vehicle, list[int], list[Any]]] = {}
    found: list[tuple[_Vehicle, list[int], list[Any]]] = []
    for k, frame in enumerate(log.frames):
        for ident in frame.records(Kind.DELETE)["id"].tolist():
            present.pop(ident, None)
        for actor in frame.added:
            present.pop(actor.id, None)
            if actor.type == ActorType.VEHICLE:
                name = HERO if _is_hero(actor) and len(heroes) == 1 else str(actor.id)
                present[actor.id] = (_Vehicle.of(actor, frame, name), [], [])
                found.append(present[actor.id])
        positions = frame.records(Kind.POSITION)
        for n in np.flatnonzero(np.isin(positions["id"], list(present))).tolist():
            ident, location, rotation = positions[n].tolist()
            _, frames, places = present[ident]
            row = (*location, rotation[2])
            if frames[-1:] == [k] or not np.isfinite(row).all():
                fault = "two places" if frames[-1:] == [k] else "a place that is not finite"
                raise RecordingError(
                    f"{path}: frame {frame.number}: vehicle {ident}: {fault}; one place in cm is expected"
                )
            frames.append(k)
            places.append(row)
    for vehicle, frames, places in found:
        values, number = np.array(places, float).reshape(-1, 4), np.array(frames, int)
        x, y, z, heading = from_carla(values[:, :3], values[:, 3])
        x, y = x + vehicle.ahead * np.cos(heading), y + vehicle.ahead * np.sin(heading)
        table = np.stack([x, y, z, heading], -1)
        far = np.linalg.norm(np.diff(table[:, :3], axis=0), axis=1) > FASTEST * np.diff(time[number]) + _JUMP
        cuts = np.flatnonzero(far | (np.diff(number) > 1)) + 1
        for begin, end in pairwise([0, *cuts.tolist(), len(number)]):
            part = table[begin:end].copy()
            part[:, 3] = np.unwrap(part[:, 3])
            yield vehicle, number[begin:end], part


class _Roads:
    """Where the lanes of a network are."""

    def __init__(self, network: Network) -> None:
        points = []
        for lane in network.drivable_lanes():
            s = np.linspace(0, lane.length, max(2, math.ceil(lane.length / _SAMPLE) + 1))
            points.append(lane.pose(s)[0])
        self.points = np.concatenate(points)
        self.tree = KDTree(self.points[:, :2])

    def near(self, xyz: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Places `[n]` near a lane, and those at its height."""
        distance, index = self.tree.query(xyz[:, :2], k=min(16, len(self.points)))
        level = np.abs(self.points[index, 2] - xyz[:, 2:]) < _LEVEL
        return distance[:, 0] < _NEAR, ((distance < _NEAR) & level).any(-1)


@dataclass(frozen=True)
class _Vehicle:
    """A vehicle of a log; m."""

    name: str
    length: float
    width: float
    ahead: float  # middle of the body ahead of the actor's origin

    @classmethod
    def of(cls, actor: Actor, frame: Frame, name: str) -> _Vehicle:
        """The vehicle of an actor, sized by box or blueprint."""
        boxes = frame.records(Kind.BOX)
        for box in boxes[boxes["id"] == actor.id][:1]:
            if np.isfinite([*box["origin"], *box["extent"]]).all() and (box["extent"] > 0).all():
                length, width = 2 * box["extent"][:2].astype(float) / CM
                return cls(name, float(length), float(width), float(box["origin"][0]) / CM)
        body = body_of(actor.blueprint, 2 if actor.attribute("number_of_wheels") == "2" else 4)
        return cls(name, body.length, body.width, body.ahead)


def _rows(vehicle: _Vehicle, line: int, steps: np.ndarray, at: Floats, dt: float) -> Rows:
    count = len(steps)
    velocity = np.gradient(at[:, :2], dt, axis=0)
    return Rows(
        line=np.full(count, line),
        vehicle=np.full(count, vehicle.name),
        step=steps.astype(float),
        x=at[:, 0],
        y=at[:, 1],
        heading=(at[:, 3] + math.pi) % (2 * math.pi) - math.pi,
        v=np.hypot(velocity[:, 0], velocity[:, 1]),
        length=np.full(count, vehicle.length),
        width=np.full(count, vehicle.width),
    )


def _joined(pieces: list[Rows]) -> Rows:
    """All rows; a name that is there twice gets a number behind it."""
    names: defaultdict[str, int] = defaultdict(int)
    own = []
    for rows in pieces:
        name = str(rows.vehicle[0])
        names[name] += 1
        own.append(name if names[name] == 1 else f"{name}#{names[name]}")
    columns = {field: np.concatenate([getattr(rows, field) for rows in pieces]) for field in _FIELDS}
    vehicle = np.concatenate([np.full(len(p.line), n) for p, n in zip(pieces, own, strict=True)])
    return Rows(vehicle=vehicle, **columns)


_FIELDS = ("line", "step", "x", "y", "heading", "v", "length", "width")

__all__ = ["STEP", "read_carla_tracks"]
