"""Worlds as recorder logs that CARLA plays.

    write_log("world.log", world)

`CARLA` plays a log with `client.replay_file`, see the guide. Logs come back by `lj.load_scene`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.api.world import World
from limsim_jax.bridges.carla.stage import Stage, nearest_light, stage_of, town_of
from limsim_jax.log_replay.replay import Replay
from limsim_jax.recordings.carla_bodies import BODIES
from limsim_jax.recordings.carla_log import (
    CM,
    RECORDS,
    Actor,
    ActorType,
    Attribute,
    AttributeType,
    CarlaLog,
    Frame,
    Kind,
    Packet,
    read_log,
    save_log,
    to_carla,
)

FIRST_ID = 1000
"""Id of the first vehicle: above those of the lights, signs and props of CARLA's towns."""

DESCRIPTION = 26
"""Number of the blueprint `vehicle.lincoln.mkz_2017` in logs of CARLA 0.9.12."""

EGO_COLOR, COLORS = "220,50,30", ("60,90,130", "120,120,120", "230,230,230", "30,30,30", "70,100,60")
"""Red, green, blue."""

_BRAKE, _POSITION = 8, 1  # of carla.VehicleLightState


def write_log(
    path: str | Path,
    world: World | Replay,
    *,
    town: str | None = None,
    like: str | Path | CarlaLog | None = None,
    date: int = 0,
) -> Path:
    """Write a world as a recorder log.

    A server knows blueprints by numbers of its own, and finds traffic lights by their place to the cm.
    Neither is in a map file. `like` is any log that this server has recorded in this town, and has both.

    Args:
      path: of the log; gzipped if it ends with `.gz`, which CARLA does not unpack.
      world: with its trace; of a log replay the first variant.
      town: name of the map in CARLA; None: by the name of the map file.
      like: a log of the server that is to play this one. None: all vehicles get the number of the Lincoln in
        CARLA 0.9.12, and lights stand where the map has their signals.
      date: s since 1970, in the header.

    Returns:
      The path.

    Raises:
      RecordingError: `like` is no recorder log.
      ValueError: `like` has no vehicle, or the world has no step.
      OSError: the file cannot be written.
    """
    save_log(path, carla_log(world, town=town, like=like, date=date))
    return Path(path)


def carla_log(
    world: World | Replay,
    *,
    town: str | None = None,
    like: str | Path | CarlaLog | None = None,
    date: int = 0,
) -> CarlaLog:
    """The recorder log of a world, see `write_log`."""
    stage = stage_of(world)
    if not len(stage.time):
        raise ValueError("the trace of the world has no step")
    model = read_log(like) if isinstance(like, (str, Path)) else like
    network = (world.scene.map if isinstance(world, Replay) else world.map).network
    frames = tuple(_Writer(stage, model).frames())
    return CarlaLog(map=town or town_of(network), date=date, frames=frames)


class _Writer:
    """Frame after frame of a stage."""

    def __init__(self, stage: Stage, like: CarlaLog | None) -> None:
        self.stage = stage
        numbers: dict[str, int] = {}
        first = FIRST_ID
        if like is not None:
            actors = list(like.actors())
            numbers = {a.blueprint: a.description for a in actors if a.type == ActorType.VEHICLE}
            first = max([first, *(a.id + 1 for a in actors)])
            if not numbers.keys() & BODIES.keys():
                raise ValueError(
                    f"{like.source}: has no vehicle of a known blueprint; at least one is expected"
                )
        known = numbers.keys() & BODIES.keys() if numbers else None
        self.blueprints = [one.blueprint(known) for one in stage.cast]
        self.numbers = [numbers.get(name, DESCRIPTION) for name in self.blueprints]
        self.ids = np.arange(first, first + len(stage.cast), dtype=np.uint32)
        self.bodies = [BODIES[name] for name in self.blueprints]
        ahead = np.array([body.ahead for body in self.bodies])
        level = ahead * np.cos(stage.pitch)
        x = stage.x - level * np.cos(stage.heading)
        y = stage.y - level * np.sin(stage.heading)
        self.location, self.yaw = to_carla(x, y, stage.z - ahead * np.sin(stage.pitch), stage.heading)
        self.lights, self.columns = _lights(stage, like)

    def frames(self) -> Iterator[Frame]:
        """All frames."""
        time, present = self.stage.time, self.stage.present
        nobody = np.zeros(len(self.ids), bool)
        for t in range(len(time)):
            before = present[t - 1] if t else nobody
            here = np.flatnonzero(present[t])
            came, left = np.flatnonzero(present[t] & ~before), np.flatnonzero(before & ~present[t])
            packets = [
                Packet(Kind.ADD, (*(self.lights if t == 0 else ()), *(self._actor(t, int(k)) for k in came))),
                _packet(Kind.DELETE, self.ids[left]),
                _packet(Kind.PARENT, self.ids[:0]),
                _packet(Kind.COLLISION, self.ids[:0]),
                self._places(t, here),
                self._lights_shown(t),
                self._animation(t, here),
                _packet(Kind.WALKER, self.ids[:0]),
                _packet(Kind.VEHICLE_LIGHT, self.ids[here], state=self._lamps(t, here)),
                self._kinematics(t, here),
                self._boxes(came),
            ]  # fmt: skip
            last = t == len(time) - 1
            yield Frame(t + 1, -1.0 if last else float(time[t + 1] - time[t]), float(time[t]), tuple(packets))

    def _actor(self, t: int, k: int) -> Actor:
        one, body = self.stage.cast[k], self.bodies[k]
        attributes = (
            Attribute(AttributeType.INT, "number_of_wheels", str(body.wheels)),
            Attribute(AttributeType.BOOL, "sticky_control", "true"),
            Attribute(AttributeType.COLOR, "color", EGO_COLOR if one.ego else COLORS[k % len(COLORS)]),
            Attribute(AttributeType.STRING, "role_name", "hero" if one.ego else "autopilot"),
        )
        x, y, z = self.location[t, k].tolist()
        roll, pitch, yaw = self._turn(t, np.array([k]))[0].tolist()
        return Actor(
            int(self.ids[k]), ActorType.VEHICLE, (x, y, z), (roll, pitch, yaw), self.numbers[k],
            self.blueprints[k], attributes,
        )  # fmt: skip

    def _places(self, t: int, here: NDArray[Any]) -> Packet:
        rotation = self._turn(t, here)
        return _packet(Kind.POSITION, self.ids[here], location=self.location[t, here], rotation=rotation)

    def _turn(self, t: int, here: NDArray[Any]) -> NDArray[Any]:
        """Roll, pitch and yaw, degrees."""
        pitch = np.degrees(self.stage.pitch[t, here])
        return np.stack([np.zeros(len(here)), pitch, self.yaw[t, here]], -1)

    def _lights_shown(self, t: int) -> Packet:
        ids = np.array([light.id for light in self.lights], np.uint32)
        elapsed, state = self.stage.since[t, self.columns], self.stage.states[t, self.columns]
        return _packet(Kind.TRAFFIC_LIGHT, ids, frozen=1, elapsed=elapsed, state=state)

    def _animation(self, t: int, here: NDArray[Any]) -> Packet:
        stage = self.stage
        return _packet(
            Kind.VEHICLE, self.ids[here], steer=stage.steer[t, here], throttle=stage.throttle[t, here],
            brake=stage.brake[t, here], hand_brake=0, gear=1,
        )  # fmt: skip

    def _lamps(self, t: int, here: NDArray[Any]) -> NDArray[Any]:
        return _POSITION + _BRAKE * self.stage.braking[t, here].astype(np.uint32)

    def _kinematics(self, t: int, here: NDArray[Any]) -> Packet:
        stage = self.stage
        heading, pitch, v = (values[t, here] for values in (stage.heading, stage.pitch, stage.v))
        level = v * np.cos(pitch)
        velocity = np.stack([level * np.cos(heading), -level * np.sin(heading), v * np.sin(pitch)], -1)
        nothing = np.zeros(len(here))
        angular = np.stack([nothing, nothing, -np.degrees(stage.turning[t, here])], -1)
        return _packet(Kind.KINEMATICS, self.ids[here], velocity=velocity, angular=angular)

    def _boxes(self, came: NDArray[Any]) -> Packet:
        """Boxes of our size about the middle of the body."""
        rows = [(self.stage.cast[k], self.bodies[k]) for k in came]
        origin = np.array([(b.ahead, 0, b.height / 2) for _, b in rows]).reshape(-1, 3)
        extent = np.array([(one.length / 2, one.width / 2, b.height / 2) for one, b in rows]).reshape(-1, 3)
        return _packet(Kind.BOX, self.ids[came], origin=CM * origin, extent=CM * extent)


def _packet(kind: Kind, ids: NDArray[Any], **columns: Any) -> Packet:
    records = np.zeros(len(ids), RECORDS[kind])
    records["id"] = ids
    for name, values in columns.items():
        records[name] = values
    return Packet(kind, records)


def _lights(stage: Stage, like: CarlaLog | None) -> tuple[list[Actor], list[int]]:
    """Traffic lights as actors, and their columns in the stage."""
    if like is None:
        places = [to_carla(*light.position, light.heading) for light in stage.lights]
        actors = [
            Actor(k + 1, ActorType.TRAFFIC_LIGHT, tuple(at.tolist()), (0.0, 0.0, float(yaw)), 0, _LIGHT)
            for k, (at, yaw) in enumerate(places)
        ]
        return actors, list(range(len(actors)))
    theirs = {a.id: a for a in like.actors() if a.type == ActorType.TRAFFIC_LIGHT}
    pairs = {
        ident: nearest_light(stage.lights, a.location[0] / CM, -a.location[1] / CM)
        for ident, a in theirs.items()
    }
    found = {ident: k for ident, k in pairs.items() if k is not None}
    return [theirs[ident] for ident in found], list(found.values())


_LIGHT = "traffic.traffic_light"

__all__ = ["carla_log", "read_log", "write_log"]
