"""The end-to-end driver as a policy: sensors, network, controller, safety filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import Policy
from limsim_jax.policies.end_to_end.control import (
    DT,
    filtered,
    free_distances,
    objects_of,
    pursue,
    way_along,
    way_through,
)
from limsim_jax.policies.end_to_end.inputs import (
    EGO,
    Inputs,
    Look,
    Points,
    Sensors,
    inputs_of,
    no_points,
    points_at,
    route_of,
)
from limsim_jax.policies.end_to_end.network import (
    WAYPOINT_TIME,
    Network,
    Outputs,
    Trained,
    load_weights,
    path_places,
    target_speed,
)
from limsim_jax.policies.reference import ReferencePath, project_onto
from limsim_jax.policies.weights import digest
from limsim_jax.sensors.camera import Pictures
from limsim_jax.sensors.faults import FaultMemory, Faults
from limsim_jax.sensors.rig import Rig
from limsim_jax.sensors.scene import Pose
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Trajectory
from limsim_jax.types import Config, State

WEIGHTS = Path(__file__).with_name("end_to_end.npz")
"""Weights that come with the package."""

SIGNALS = 1.5
"""m that the predicted path moves aside, from which the ego signals a lane change. Chosen: half a lane."""

OFFSET = EGO.index("offset from the route")
"""Column of the ego's offset."""


class Memory(NamedTuple):
    """What the driver remembers of `E` egos."""

    points: Points  # LiDAR points of the last decision
    held: Float[Array, " E"]  # s that the filter alone has held it
    faults: FaultMemory | None  # [E, ...]


class Seen(NamedTuple):
    """All that a decision is made from."""

    look: Look
    pose: Pose  # [E], where the egos take themselves to be
    path: ReferencePath
    inputs: Inputs


@dataclass(frozen=True)
class EndToEnd(Policy):
    """Drives from cameras, LiDAR, route and speed by a network; its egos move in the plane.

    It reads the state by its sensors only, see `end_to_end.inputs`.

    Attributes:
      weights: file of `limsim-jax train end-to-end`; None: the network that comes with the package.
      filter: whether the safety filter may lower its speed.
      steers: whether it drives as the network says; otherwise along the route at the speed limit, so that
        the filter alone acts.
      faults: of its sensors; a table in a file.
      rig: of its vehicles; None: the one that the network was trained with.
      network: in the place of `weights`, as training has it.
      trained: the network.
      content: a hash of the network.

    Raises:
      ValueError: no such file, weights of another network, or a rig without the cameras that it needs.
    """

    weights: str | None = None
    filter: bool = True
    steers: bool = True
    faults: Faults | Mapping[str, Any] | None = None
    rig: Rig | None = None
    network: Trained | None = field(default=None, repr=False, compare=False)
    trained: Trained = field(init=False, repr=False, compare=False)
    content: str = field(default="", init=False, repr=False)
    privileged: bool = field(default=True, kw_only=True)

    needs_scenery = True
    knows = "sensors"

    def __post_init__(self) -> None:
        if not self.privileged:
            raise ValueError("privileged: false; the driver has sensors of its own, not a view")
        if isinstance(self.faults, Mapping):
            try:
                object.__setattr__(self, "faults", Faults(**{k: _fixed(v) for k, v in self.faults.items()}))
            except TypeError as error:
                raise ValueError(f"faults: {str(error).rpartition('() ')[2]}") from None
        if self.faults is not None:
            assert isinstance(self.faults, Faults)
            self.sensors.rig.check(*self.faults.dropped, *self.faults.frozen)
            if self.faults.delay:
                raise ValueError(f"faults: delay: {self.faults.delay} s; the driver has none")
        _ = self.sensors
        trained = self._network()
        object.__setattr__(self, "trained", trained)
        object.__setattr__(self, "content", digest(trained.weights, repr(trained.design)))

    @property
    def sensors(self) -> Sensors:
        """The sensors of its vehicles."""
        return Sensors() if self.rig is None else Sensors(self.rig)

    def _network(self) -> Trained:
        if self.network is not None:
            return self.network
        return load_weights(str(WEIGHTS) if self.weights is None else self.weights)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Memory:
        """No LiDAR points yet."""
        faults = None
        if isinstance(self.faults, Faults):
            look = self.sensors.look(lane_map, state, jax.random.key(0))
            begin = self.faults.init
            faults = jax.vmap(lambda pictures: begin(self.sensors.rig, pictures))(look.pictures)
        return Memory(no_points(self.sensors, state), jnp.zeros(state.egos.slot.shape, jnp.float32), faults)

    def see(
        self, config: Config, lane_map: LaneMap, state: State, memory: Memory, key: jax.Array
    ) -> tuple[Seen, Memory]:
        """The inputs of the network now, and the memory."""
        look, faults = self.sensors.look(lane_map, state, key), memory.faults
        pictures, pose = look.pictures, look.pose
        if isinstance(self.faults, Faults):
            pictures, pose, faults = self._spoiled(config, state, look, memory, key)
        egos = replace(state.egos, x=pose.x, y=pose.y, heading=pose.heading)
        path, points = route_of(lane_map, state), points_at(self.sensors, look.scan, pose)
        inputs = inputs_of(lane_map, replace(state, egos=egos), path, pictures.color, points, memory.points)
        return Seen(look, pose, path, inputs), memory._replace(points=points, faults=faults)

    def _spoiled(
        self, config: Config, state: State, look: Look, memory: Memory, key: jax.Array
    ) -> tuple[Pictures, Pose, FaultMemory]:
        """Pictures and poses as faults make them."""
        assert isinstance(self.faults, Faults) and memory.faults is not None
        spoil, dt = self.faults.spoil, config.decision_time

        def one(k: Array, faults: FaultMemory, pictures: Pictures, pose: Pose) -> Any:
            return spoil(faults, pictures, pose, dt, jax.random.fold_in(key, k), state.step)

        number = jnp.arange(state.egos.slot.shape[0])
        return jax.vmap(one)(number, memory.faults, look.pictures, look.pose)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Memory, key: jax.Array
    ) -> tuple[Command, Memory]:
        """Look, ask the network, and drive."""
        seen, memory = self.see(config, lane_map, state, memory, key)
        trained = self.trained
        said = Network(trained.design).apply({"params": trained.weights}, seen.inputs)
        assert isinstance(said, Outputs)
        return self.drive(config, state, memory, seen, said)

    def drive(
        self, config: Config, state: State, memory: Memory, seen: Seen, said: Outputs
    ) -> tuple[Command, Memory]:
        """The command for what the network says, and the memory."""
        egos, slot = state.egos, state.egos.slot
        v, shape = state.v[slot], state.shape
        pose = seen.pose.x, seen.pose.y, seen.pose.heading
        _, offset, _ = project_onto(seen.path, pose[0][:, None], pose[1][:, None])
        places = path_places(v)
        if not self.steers:
            target = jnp.minimum(seen.path.limit[:, 0], v + 2.0)
            way, moves = way_along(seen.path, pose, places, jnp.zeros_like(said.path), offset[:, 0]), 0.0 * v
        elif self.trained.design.waypoints:
            x, y = (jnp.concatenate([0 * v[:, None], said.waypoints[..., k]], -1) for k in (0, 1))
            far = jnp.hypot(jnp.diff(x), jnp.diff(y))
            target = (far[:, 0] + far[:, 1]) / (2 * WAYPOINT_TIME)
            way, moves = _even(x, y, far), 0.0 * v
        else:
            target = target_speed(v, said.speed)
            offsets = said.path if self.trained.design.route else jnp.zeros_like(said.path)
            way = way_along(seen.path, pose, places, offsets, offset[:, 0])
            moves = offsets[:, -1] - offset[:, 0]
        if self.filter:
            free = free_distances(way, objects_of(said.density), shape.length[slot], shape.width[slot])
            target, held = filtered(v, target, free, said.rules, memory.held, config.decision_time)
            memory = memory._replace(held=held)
        motion = pursue(way, v, target, shape.wheelbase[slot])
        cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]
        trajectory = Trajectory(
            x=egos.x[:, None] + cos * motion.x - sin * motion.y,
            y=egos.y[:, None] + sin * motion.x + cos * motion.y,
            heading=egos.heading[:, None] + motion.heading,
            v=motion.v,
            t0=config.time(state.step),
            dt=DT,
        )
        signal = jnp.where(jnp.abs(moves) > SIGNALS, jnp.sign(moves), 0.0).astype(jnp.int32)
        return Command(trajectory=trajectory, signal=signal), memory


def _even(x: Array, y: Array, far: Array) -> Any:
    """A path through waypoints, evenly spaced and at least 20 m long; straight on after the last one."""
    done = jnp.pad(jnp.cumsum(jnp.maximum(far, 1e-3), -1), ((0, 0), (1, 0)))
    turn = jnp.arctan2(y[:, -1] - y[:, -2], x[:, -1] - x[:, -2] + 1e-3)
    more = jnp.maximum(20.0 - done[:, -1], 1.0)
    x, y, done = (
        jnp.concatenate([values, (values[:, -1] + more * way)[:, None]], -1)
        for values, way in ((x, jnp.cos(turn)), (y, jnp.sin(turn)), (done, jnp.ones_like(turn)))
    )
    step = done[:, -1] / 63
    at = step[:, None] * jnp.arange(64, dtype=x.dtype)[None]
    x, y = (jax.vmap(jnp.interp)(at, done, values) for values in (x, y))
    return way_through(x, y, step)


def _fixed(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
