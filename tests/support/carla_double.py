"""A double of a CARLA server: value types of the real library, actors that remember, faults on request.

`Faults` says what fails. All calls are in `Double.calls`.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Faults:
    """What goes wrong."""

    spawn_returns_none: bool = False
    spawn_blocked: int = 0  # so many tries are in vain
    tick_times_out_at: int | None = None  # at this tick
    actor_dies_at: int | None = None  # at this tick the first vehicle is gone
    server: str = "0.9.16"
    no_images: bool = False
    settings_fail: bool = False
    physics_fails: bool = False
    destroy_fails: bool = False


def _timed_out() -> RuntimeError:
    return RuntimeError("time-out of 10000ms while waiting for the simulator,\nmake sure it is ready")


@dataclass
class Settings:
    synchronous_mode: bool = False
    fixed_delta_seconds: float | None = None


class Actor:
    def __init__(self, double: Double, ident: int, type_id: str, transform: Any, role: str = "") -> None:
        self.double, self.id, self.type_id, self.transform = double, ident, type_id, transform
        self.attributes = {"role_name": role}
        self.is_alive = True
        self.physics = True
        self.lamps = 0
        self.velocity = double.carla.Vector3D(0.0, 0.0, 0.0)
        box = double.carla.BoundingBox(double.carla.Location(x=0.1), double.carla.Vector3D(2.4, 1.0, 0.7))
        self.bounding_box = box

    def set_simulate_physics(self, on: bool) -> None:
        self.double.calls.append(("physics", self.id, on, self.double.frame))
        if self.double.faults.physics_fails:
            raise _timed_out()
        self.physics = on

    def get_transform(self) -> Any:
        return self.transform

    def get_velocity(self) -> Any:
        return self.velocity

    def destroy(self) -> bool:
        self.is_alive = False
        self.double.actors.pop(self.id, None)
        return True


class Sensor(Actor):
    def __init__(
        self, double: Double, ident: int, blueprint: Blueprint, transform: Any, parent: Actor
    ) -> None:
        super().__init__(double, ident, blueprint.id, transform)
        self.size = int(blueprint.values["image_size_y"]), int(blueprint.values["image_size_x"])
        self.parent = parent
        self.callback: Callable[[Any], None] | None = None

    def listen(self, callback: Callable[[Any], None]) -> None:
        self.callback = callback

    def stop(self) -> None:
        self.callback = None

    def shoot(self, frame: int) -> None:
        if self.callback is None or self.double.faults.no_images:
            return
        height, width = self.size
        bgra = np.zeros((height, width, 4), np.uint8)
        bgra[..., 0], bgra[..., 1], bgra[..., 2], bgra[..., 3] = 1, 2, frame % 256, 255
        self.callback(types.SimpleNamespace(frame=frame, raw_data=bgra.tobytes(), height=height, width=width))


class Light(Actor):
    def __init__(self, double: Double, ident: int, transform: Any) -> None:
        super().__init__(double, ident, "traffic.traffic_light", transform)
        self.state = double.carla.TrafficLightState.Red

    def set_state(self, state: Any) -> None:
        self.double.calls.append(("light", self.id, str(state)))
        self.state = state

    def get_state(self) -> Any:
        return self.state

    def freeze(self, on: bool) -> None:
        self.double.calls.append(("freeze", on))


@dataclass
class Blueprint:
    id: str
    values: dict[str, str] = field(default_factory=dict)

    def has_attribute(self, name: str) -> bool:
        return name in ("role_name", "color")

    def set_attribute(self, name: str, value: str) -> None:
        self.values[name] = value


class Listing(list[Any]):
    def filter(self, pattern: str) -> Listing:
        head = pattern.rstrip("*")
        return Listing(x for x in self if (getattr(x, "type_id", None) or x.id).startswith(head))

    def find(self, name: str) -> Any:
        for one in self:
            if one.id == name:
                return one
        raise IndexError(f"blueprint '{name}' not found")


class Double:
    """Client and world in one."""

    def __init__(
        self,
        town: Any,
        carla: Any,
        *,
        faults: Faults | None = None,
        blueprints: tuple[str, ...] = (
            "vehicle.lincoln.mkz_2017", "vehicle.mitsubishi.fusorosa", "vehicle.yamaha.yzf",
            "vehicle.carlamotors.european_hgv", "sensor.camera.rgb", "sensor.camera.depth",
            "sensor.camera.semantic_segmentation",
        ),
    ) -> None:  # fmt: skip
        self.town, self.carla, self.faults = town, carla, faults or Faults()
        self.library = Listing(Blueprint(name) for name in blueprints)
        self.settings = Settings()
        self.actors: dict[int, Actor] = {}
        self.calls: list[tuple[Any, ...]] = []
        self.frame, self.ticks, self.next_id = 100, 0, 50
        self.moves: list[dict[int, Any]] = []

    # --- client

    def get_server_version(self) -> str:
        return self.faults.server

    def get_client_version(self) -> str:
        return "0.9.16"

    def get_world(self) -> Double:
        return self

    def apply_batch_sync(self, batch: list[Any], do_tick: bool) -> list[Any]:
        assert not do_tick
        answers = []
        moved = {}
        for command in batch:
            actor, kind = self.actors.get(command.actor_id), type(command).__name__
            error = "" if actor is not None and actor.is_alive else f"actor {command.actor_id} not found"
            if actor is not None:
                if kind == "ApplyTransform":
                    actor.transform = moved[actor.id] = command.transform
                elif kind == "SetVehicleLightState":
                    actor.lamps = int(command.light_state)
                elif kind == "DestroyActor":
                    if self.faults.destroy_fails:
                        raise _timed_out()
                    actor.is_alive = False
                    del self.actors[actor.id]
            answers.append(types.SimpleNamespace(error=error, actor_id=command.actor_id))
        if moved:
            self.moves.append(moved)
        return answers

    # --- world

    def get_map(self) -> Any:
        return self.town

    def get_settings(self) -> Settings:
        return Settings(self.settings.synchronous_mode, self.settings.fixed_delta_seconds)

    def apply_settings(self, settings: Settings) -> int:
        if self.faults.settings_fail and settings.synchronous_mode:
            raise _timed_out()
        self.settings = settings
        return self.frame

    def get_blueprint_library(self) -> Listing:
        return self.library

    def try_spawn_actor(self, blueprint: Blueprint, transform: Any, attach_to: Any = None) -> Actor | None:
        self.calls.append(("spawn", blueprint.id, transform.location.z))
        if self.faults.spawn_returns_none:
            return None
        if self.faults.spawn_blocked:
            self.faults.spawn_blocked -= 1
            return None
        return self.add(
            Actor(self, self.next_id, blueprint.id, transform, blueprint.values.get("role_name", ""))
        )

    def spawn_actor(self, blueprint: Blueprint, transform: Any, attach_to: Any = None) -> Actor:
        return self.add(Sensor(self, self.next_id, blueprint, transform, attach_to))

    def add(self, actor: Any) -> Any:
        self.actors[actor.id] = actor
        self.next_id = max(self.next_id, actor.id) + 1
        return actor

    def get_actors(self) -> Listing:
        return Listing(self.actors.values())

    def tick(self, seconds: float) -> int:
        self.ticks += 1
        if self.faults.tick_times_out_at == self.ticks:
            raise _timed_out()
        if self.faults.actor_dies_at == self.ticks:
            first = next(a for a in self.actors.values() if a.type_id.startswith("vehicle."))
            first.is_alive = False
            del self.actors[first.id]
        self.frame += 1
        for actor in list(self.actors.values()):
            if isinstance(actor, Sensor):
                actor.shoot(self.frame)
        return self.frame

    @property
    def vehicles(self) -> list[Actor]:
        return [a for a in self.actors.values() if a.type_id.startswith("vehicle.")]
