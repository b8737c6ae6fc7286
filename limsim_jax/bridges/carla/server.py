"""Our worlds live in CARLA: a recorded one, an experiment decision by decision, or an `Env`.

    with CarlaServer(world.map) as server:
        play(world, server)

The server runs in synchronous mode, one tick per physics step. What moves is ours: every vehicle is put where
it is with its physics off, so that CARLA shows and senses it. Four calls are all that a world needs of CARLA
(`Backend`), so that tests and other simulators can stand in. Never run against a CARLA server: tests use the
types of the client library and doubles of the rest.
"""

from __future__ import annotations

import contextlib
import math
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from limsim_jax.api.world import World
from limsim_jax.bridges.carla.camera import Camera, Kind, Mount
from limsim_jax.bridges.carla.stage import Cast, Stage, nearest_light, stage_of
from limsim_jax.log_replay.replay import Replay
from limsim_jax.maps.map import Map
from limsim_jax.maps.network import TrafficLight
from limsim_jax.recordings.carla_bodies import BODIES, body_of
from limsim_jax.recordings.carla_log import LIGHT_STATES

LONGEST_TICK = 0.1
"""s: CARLA's physics needs ticks of at most 10 substeps of 0.01 s, its defaults."""

HEIGHT = 100.0
"""m above the road at which vehicles come in: CARLA spawns nothing where there is no room."""

ABOVE = 20.0
"""m, by which it tries higher where even there something is."""

TRIES = 3

OFF_LANE = 0.5
"""m across between the middle of a lane of ours and CARLA's: farther apart, the maps differ."""

_BRAKE_LIGHT, _POSITION_LIGHT = 8, 1  # of carla.VehicleLightState


class CarlaError(RuntimeError):
    """What went wrong with a CARLA server, in one line."""


class Pose(NamedTuple):
    """The place of the middle of a body, in file coordinates."""

    x: float  # m
    y: float
    z: float
    heading: float  # rad
    pitch: float = 0.0  # rad, nose up is positive


class Backend(Protocol):
    """What a world needs of the simulator that shows it. Vehicles go by the numbers of their `Cast`."""

    def spawn(self, one: Cast, pose: Pose) -> None:
        """Bring a vehicle in."""
        ...

    def move(self, poses: Mapping[int, Pose], braking: Mapping[int, bool]) -> None:
        """Put vehicles where they are now; those that brake show it."""
        ...

    def tick(self) -> int:
        """One step of time; returns the number of the frame."""
        ...

    def destroy(self, numbers: Iterable[int]) -> None:
        """Take vehicles out."""
        ...


@dataclass(frozen=True)
class Foreign:
    """A vehicle that others own, such as a hero of another client."""

    id: int  # of the actor
    blueprint: str
    role: str
    pose: Pose
    v: float  # m/s
    length: float  # m
    width: float  # m


# --- the server ---------------------------------------------------------------------------------------------


class CarlaServer:
    """A CARLA server, ours while the `with` block lasts.

    On entry it is checked and set to synchronous mode. On exit, also after an exception, all that was spawned
    is destroyed, traffic lights go on, and the settings are as before.

    Args:
      town: the map of the world; its lanes must be those of the server's map.
      dt: s per tick, the physics step of the world; 0.1 at most.
      host: name or address.
      port: first of the two ports of the server.
      timeout: s for an answer.
      client: a `carla.Client`, or a double of it; None: a new one.
      carla: the client library, or a double of it; None: the installed one.

    Raises:
      ImportError: the client library is not installed.
      CarlaError: no answer, another version, another map; one line.
      ValueError: a tick that is too long.
    """

    def __init__(
        self,
        town: Map,
        *,
        dt: float = 0.1,
        host: str = "127.0.0.1",
        port: int = 2000,
        timeout: float = 10.0,
        client: Any = None,
        carla: Any = None,
    ) -> None:
        if not 0 < dt <= LONGEST_TICK + 1e-9:
            raise ValueError(
                f"dt: {dt:g} s; ticks of more than 0 and at most {LONGEST_TICK:g} s are expected"
            )
        self.carla = _library() if carla is None else carla
        self.town, self.dt, self.timeout = town, dt, timeout
        self.place = f"CARLA at {host}:{port}"
        if client is None:
            client = self.carla.Client(host, port)
            client.set_timeout(timeout)
        self._client = client
        self._world: Any = None
        self._settings: Any = None
        self._actors: dict[int, tuple[Any, str]] = {}
        self._lit: dict[int, bool] = {}
        self._lights: dict[str, tuple[Any, int]] | None = None  # id of ours: theirs, state last set
        self._frozen = False
        self._cameras: list[tuple[Camera, Any]] = []
        self._known: frozenset[str] = frozenset()

    def __enter__(self) -> Self:
        with self._asked("the version"):
            theirs, own = self._client.get_server_version(), self._client.get_client_version()
        if theirs != own:
            raise CarlaError(
                f"{self.place}: version {theirs}, and the client library is {own}; "
                f"one version is expected: pip install carla=={theirs}"
            )
        with self._asked("the world"):
            self._world = self._client.get_world()
            self._check_map(self._world.get_map())
            library = self._world.get_blueprint_library().filter("vehicle.*")
            self._known = frozenset(blueprint.id for blueprint in library) & BODIES.keys()
        if not self._known:
            raise CarlaError(f"{self.place}: has none of the known vehicles, such as {next(iter(BODIES))}")
        try:
            with self._asked("synchronous mode"):
                self._settings = self._world.get_settings()
                settings = self._world.get_settings()
                settings.synchronous_mode = True
                settings.fixed_delta_seconds = self.dt
                self._world.apply_settings(settings)
        except BaseException:
            self._leave(quiet=True)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._leave(quiet=error is not None)

    @contextlib.contextmanager
    def _asked(self, what: str) -> Iterator[None]:
        """Errors of the client library in one line."""
        try:
            yield
        except CarlaError:
            raise
        except (RuntimeError, IndexError) as error:
            said = " ".join(str(error).split())[:200]
            raise CarlaError(f"{self.place}: {what}: {said}") from None

    def _check_map(self, theirs: Any) -> None:
        """Whether our lanes are lanes there, at some places."""
        carla, off, count = self.carla, 0, 0
        lanes = [lane for lane in self.town.network.drivable_lanes() if lane.junction is None]
        for lane in lanes[:: max(1, len(lanes) // 50)]:
            xyz, _ = lane.pose(lane.length / 2)
            way = theirs.get_waypoint(_location(carla, *xyz.tolist()), lane_type=carla.LaneType.Any)
            count += 1
            if way is None:
                off += 1
                continue
            at, turn = way.transform.location, math.radians(way.transform.rotation.yaw)
            dx, dy = float(xyz[0]) - at.x, -float(xyz[1]) - at.y
            off += (
                abs(dy * math.cos(turn) - dx * math.sin(turn)) > OFF_LANE or math.hypot(dx, dy) > 4 * OFF_LANE
            )
        if off > 0.1 * count:
            raise CarlaError(
                f"{self.place}: its map {theirs.name} differs from {self.town.source}: {off} of {count} "
                "lanes are not there; client.load_world of this town, or generate_opendrive_world of this "
                "file, is expected"
            )

    # --- the four calls

    def spawn(self, one: Cast, pose: Pose) -> None:
        """Bring a vehicle in, with its physics off.

        It comes in high above its place, and its physics is off before the server ticks."""
        blueprint = one.blueprint(self._known)
        world, color = self._world, "220,50,30" if one.ego else "60,90,130"
        with self._asked(f"vehicle {one.number}: {blueprint}"):
            found = world.get_blueprint_library().find(blueprint)
            for name, value in (("role_name", "limsim_ego" if one.ego else "limsim"), ("color", color)):
                if found.has_attribute(name):
                    found.set_attribute(name, value)
            for k in range(TRIES):
                high = pose._replace(z=pose.z + HEIGHT + k * ABOVE)
                actor = world.try_spawn_actor(found, self._transform(high, blueprint))
                if actor is not None:
                    break
            else:
                raise CarlaError(
                    f"{self.place}: vehicle {one.number}: {blueprint} was not spawned, {TRIES} tries"
                )
            self._actors[one.number] = actor, blueprint
            actor.set_simulate_physics(False)
        self.move({one.number: pose}, {})

    def move(self, poses: Mapping[int, Pose], braking: Mapping[int, bool]) -> None:
        """Put vehicles where they are, all in one batch."""
        command, batch, numbers = self.carla.command, [], []
        for number, pose in poses.items():
            actor, blueprint = self._actor(number)
            batch.append(command.ApplyTransform(actor.id, self._transform(pose, blueprint)))
            numbers.append(number)
        for number, lit in braking.items():
            if self._lit.get(number) != lit:
                state = self.carla.VehicleLightState(_POSITION_LIGHT + _BRAKE_LIGHT * lit)
                batch.append(command.SetVehicleLightState(self._actor(number)[0].id, state))
                numbers.append(number)
                self._lit[number] = lit
        self._send(batch, numbers)

    def tick(self) -> int:
        """One step of time; waits until the server has made it and all cameras have their picture."""
        with self._asked("tick"):
            frame = int(self._world.tick(self.timeout))
        for camera, _ in self._cameras:
            if not camera.wait(frame, self.timeout):
                raise CarlaError(
                    f"{self.place}: camera '{camera.kind}' has no picture of frame {frame} after "
                    f"{self.timeout:g} s"
                )
        return frame

    def destroy(self, numbers: Iterable[int]) -> None:
        """Take vehicles out, with their cameras."""
        numbers = list(numbers)
        actors = {self._actor(number)[0].id: number for number in numbers}
        for camera, sensor in [x for x in self._cameras if x[0].vehicle in numbers]:
            with self._asked(f"camera of vehicle {camera.vehicle}"):
                sensor.stop()
                sensor.destroy()
            self._cameras.remove((camera, sensor))
        for number in numbers:
            del self._actors[number]
            self._lit.pop(number, None)
        batch = [self.carla.command.DestroyActor(ident) for ident in actors]
        self._send(batch, list(actors.values()))

    # --- beyond the four calls

    def show_lights(self, lights: Sequence[TrafficLight], states: Sequence[int]) -> int:
        """Switch CARLA's lights as ours; returns how many stand where ours do.

        Args:
          lights: ours.
          states: numbers of `LIGHT_STATES`.
        """
        names = ("Red", "Yellow", "Green", "Off", "Unknown")
        found = self._find_lights(lights)
        with self._asked("traffic lights"):
            if found and not self._frozen:
                self._frozen = True
                next(iter(found.values()))[0].freeze(True)  # all of them
            for light, state in zip(lights, map(int, states), strict=True):
                if light.id in found and found[light.id][1] != state:
                    theirs = found[light.id][0]
                    theirs.set_state(getattr(self.carla.TrafficLightState, names[state]))
                    found[light.id] = theirs, state
        return len(found)

    def read_lights(self, lights: Sequence[TrafficLight]) -> dict[str, str]:
        """What CARLA's lights show, by the ids of ours that stand there."""
        shown = {}
        found = self._find_lights(lights)
        with self._asked("traffic lights"):
            for ident, (theirs, _) in found.items():
                state = str(theirs.get_state()).rpartition(".")[2].lower()
                shown[ident] = state if state in LIGHT_STATES else "unknown"
        return shown

    def foreign(self) -> list[Foreign]:
        """Vehicles that others own, as they are now."""
        own = {actor.id for actor, _ in self._actors.values()}
        found = []
        with self._asked("vehicles"):
            for actor in self._world.get_actors().filter("vehicle.*"):
                if actor.id not in own and actor.is_alive:
                    found.append(_foreign(actor))
        return found

    def camera(
        self, vehicle: int, kind: Kind = "rgb", *, width: int = 640, height: int = 360, fov: float = 90.0,
        mount: Mount | None = None,
    ) -> Camera:  # fmt: skip
        """Put a camera on a vehicle of ours.

        Args:
          vehicle: its number.
          kind: rgb, depth or semantic.
          width: pixels.
          height: pixels.
          fov: degrees across.
          mount: where on the vehicle.
        """
        mount, carla = mount or Mount(), self.carla
        camera = Camera(vehicle, kind, width, height)
        actor, blueprint = self._actor(vehicle)
        with self._asked(f"camera '{kind}'"):
            found = self._world.get_blueprint_library().find(camera.blueprint)
            for name, value in (("image_size_x", width), ("image_size_y", height), ("fov", fov)):
                found.set_attribute(name, str(value))
            ahead = body_of(blueprint).ahead
            place = carla.Transform(
                carla.Location(x=mount.x + ahead, y=-mount.y, z=mount.z),
                carla.Rotation(pitch=math.degrees(mount.pitch), yaw=-math.degrees(mount.yaw)),
            )
            sensor = self._world.spawn_actor(found, place, attach_to=actor)
            self._cameras.append((camera, sensor))
            sensor.listen(camera.put)
        return camera

    def images(self, kind: Kind = "rgb") -> NDArray[Any]:
        """Pictures of the last tick, `[n, H, W, C]`: cameras of a kind in the order in which they were made.

        uint8 RGB; float32 m of depth, one channel; uint8 classes of CARLA, one channel.

        Raises:
          CarlaError: no such camera, cameras of several sizes, or no tick yet.
        """
        cameras = [camera for camera, _ in self._cameras if camera.kind == kind]
        pictures = [camera.picture for camera in cameras if camera.picture is not None]
        if not pictures or len(pictures) < len(cameras):
            raise CarlaError(f"{self.place}: no picture of kind '{kind}'; a camera and a tick are expected")
        if len({picture.shape for picture in pictures}) > 1:
            raise CarlaError(f"{self.place}: cameras '{kind}' of several sizes; one size is expected")
        return np.stack(pictures)

    # --- inside

    def _actor(self, number: int) -> tuple[Any, str]:
        if number not in self._actors:
            raise CarlaError(f"{self.place}: no vehicle {number} of ours is there")
        return self._actors[number]

    def _transform(self, pose: Pose, blueprint: str) -> Any:
        """The place of an actor: its origin is near the middle of its body."""
        carla, ahead = self.carla, body_of(blueprint).ahead
        level = ahead * math.cos(pose.pitch)
        x, y = pose.x - level * math.cos(pose.heading), pose.y - level * math.sin(pose.heading)
        rotation = carla.Rotation(pitch=math.degrees(pose.pitch), yaw=-math.degrees(pose.heading), roll=0.0)
        return carla.Transform(_location(carla, x, y, pose.z - ahead * math.sin(pose.pitch)), rotation)

    def _send(self, batch: list[Any], numbers: list[int]) -> None:
        if not batch:
            return
        with self._asked("batch"):
            answers = self._client.apply_batch_sync(batch, False)
        for number, answer in zip(numbers, answers, strict=True):
            if answer.error:
                said = " ".join(str(answer.error).split())[:200]
                raise CarlaError(f"{self.place}: vehicle {number}: {said}")

    def _find_lights(self, lights: Sequence[TrafficLight]) -> dict[str, tuple[Any, int]]:
        """Lights of CARLA where ours stand; looked for once."""
        if self._lights is None:
            found: dict[str, tuple[Any, int]] = {}
            with self._asked("traffic lights"):
                for actor in self._world.get_actors().filter("traffic.traffic_light*"):
                    at = actor.get_transform().location
                    k = nearest_light(lights, at.x, -at.y)
                    if k is not None:
                        found[lights[k].id] = actor, -1
            self._lights = found
        return self._lights

    def _leave(self, *, quiet: bool) -> None:
        """Everything as before; goes on to the end whatever fails."""
        faults: list[str] = []

        def attempt(what: str, act: Callable[[], Any]) -> None:
            try:
                act()
            except Exception as error:  # the next thing must be undone all the same
                faults.append(f"{what}: {' '.join(str(error).split())[:200]}")

        for camera, sensor in self._cameras:
            attempt(f"camera '{camera.kind}'", sensor.stop)
            attempt(f"camera '{camera.kind}'", sensor.destroy)
        batch = [self.carla.command.DestroyActor(actor.id) for actor, _ in self._actors.values()]
        if batch:
            attempt("vehicles", lambda: self._client.apply_batch_sync(batch, False))
        lights = [actor for actor, _ in (self._lights or {}).values()]
        if self._frozen and lights:
            attempt("traffic lights", lambda: lights[0].freeze(False))
        if self._settings is not None:
            attempt("settings", lambda: self._world.apply_settings(self._settings))
        self._cameras, self._actors, self._lights, self._lit = [], {}, None, {}
        self._frozen, self._settings = False, None
        if faults and not quiet:
            raise CarlaError(f"{self.place}: not all was undone: {'; '.join(faults)}")


def _library() -> Any:
    try:
        import carla
    except ImportError:
        raise ImportError(
            "CARLA needs its client library, for Linux and Windows and Python up to 3.12: "
            'pip install "limsim-jax[carla]"'
        ) from None
    return carla


def _location(carla: Any, x: float, y: float, z: float) -> Any:
    return carla.Location(x=x, y=-y, z=z)


def _foreign(actor: Any) -> Foreign:
    transform, velocity, box = actor.get_transform(), actor.get_velocity(), actor.bounding_box
    heading = -math.radians(transform.rotation.yaw)
    ahead = box.location.x
    pose = Pose(
        transform.location.x + ahead * math.cos(heading),
        -transform.location.y + ahead * math.sin(heading),
        transform.location.z,
        heading,
        math.radians(transform.rotation.pitch),
    )
    return Foreign(
        actor.id, actor.type_id, actor.attributes.get("role_name", ""), pose,
        math.hypot(velocity.x, velocity.y), 2 * box.extent.x, 2 * box.extent.y,
    )  # fmt: skip


# --- worlds in it -------------------------------------------------------------------------------------------


@dataclass
class Show:
    """Brings the vehicles of a stage in and out of a backend.

    Attributes:
      backend: what shows it.
      without: numbers of vehicles that are there anyway, and not brought in.
      lights: whether its traffic lights are switched as ours.
      present: numbers of the vehicles that were brought in.
    """

    backend: Backend
    without: frozenset[int] = frozenset()
    lights: bool = True
    present: set[int] = field(default_factory=set)

    def moment(self, stage: Stage, t: int) -> int:
        """Show one moment and tick; returns the frame."""
        here = {stage.cast[k].number: int(k) for k in np.flatnonzero(stage.present[t])}
        here = {number: k for number, k in here.items() if number not in self.without}
        if gone := self.present - here.keys():
            self.backend.destroy(sorted(gone))
            self.present -= gone
        poses = {number: _pose(stage, t, k) for number, k in here.items()}
        for number in [n for n in here if n not in self.present]:
            self.backend.spawn(stage.cast[here[number]], poses[number])
            self.present.add(number)
        self.backend.move(poses, {number: bool(stage.braking[t, k]) for number, k in here.items()})
        show_lights = getattr(self.backend, "show_lights", None)
        if show_lights is not None and stage.lights and self.lights:
            show_lights(stage.lights, stage.states[t])
        return self.backend.tick()

    def clear(self) -> None:
        """Take all vehicles out."""
        if self.present:
            self.backend.destroy(sorted(self.present))
            self.present.clear()


def _pose(stage: Stage, t: int, k: int) -> Pose:
    columns = stage.x, stage.y, stage.z, stage.heading, stage.pitch
    return Pose(*(float(column[t, k]) for column in columns))


OnTick = Callable[[int, float], Any]
"""Called after each tick with the number of the frame and the time in our world, s."""


def play(
    world: World | Replay, backend: Backend, *, on_tick: OnTick | None = None, real_time: bool = False
) -> int:
    """Show a recorded world or a log replay, step by step; returns the number of ticks.

    Args:
      world: with its trace.
      backend: a `CarlaServer` whose `dt` is the step of the world, or a stand-in.
      on_tick: see `OnTick`; a place to fetch pictures.
      real_time: wait between ticks, so that a second takes a second.

    Raises:
      CarlaError: what went wrong, in one line.
      ValueError: the backend ticks by another step.
    """
    stage, show = stage_of(world), Show(backend)
    steps = np.diff(stage.time)
    dt = float(np.median(steps)) if len(steps) else None
    check_step(backend, dt)
    began = clock.monotonic()
    for t, time in enumerate(stage.time.tolist()):
        frame = show.moment(stage, t)
        if on_tick is not None:
            on_tick(frame, time)
        if real_time:
            clock.sleep(max(0.0, time - (clock.monotonic() - began)))
    show.clear()
    return len(stage.time)


def check_step(backend: Any, dt: float | None) -> None:
    """Raises `ValueError` if the backend ticks by another step than `dt`, s."""
    theirs = getattr(backend, "dt", None)
    if dt is not None and theirs is not None and abs(theirs - dt) > 1e-4:
        raise ValueError(
            f"dt: the server ticks by {theirs:g} s and the world by {dt:g} s; one step is expected"
        )


__all__ = [
    "Backend", "CarlaError", "CarlaServer", "Foreign", "Pose", "Show", "check_step", "play",
]  # fmt: skip
