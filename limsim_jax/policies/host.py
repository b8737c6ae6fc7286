"""Planners outside JAX: Python, torch or ONNX functions, called once per decision.

A function of NumPy arrays drives the egos of the whole batch, here by pure pursuit and the IDM:

    def follow(seen):
        x, y = seen.way_x[..., 5] + seen.wheelbase / 2, seen.way_y[..., 5]  # 10 m ahead, from the rear axle
        steering = np.arctan(2 * seen.wheelbase * y / (x * x + y * y))
        ahead = seen.there & (np.abs(seen.other_y) < 1.5) & (seen.other_x > 0)
        gap = np.where(ahead, seen.other_x - (seen.other_length + seen.length[..., None]) / 2, 1e6)
        first = gap.argmin(-1)[..., None]
        gap = np.maximum(np.take_along_axis(gap, first, -1)[..., 0], 0.1)
        closing = np.where(gap < 1e5, seen.v - np.take_along_axis(seen.other_v, first, -1)[..., 0], 0)
        stops = (seen.light <= SignalState.YELLOW) & (seen.light_distance < gap)
        gap, closing = np.where(stops, seen.light_distance, gap), np.where(stops, seen.v, closing)
        wish = np.maximum(2 + 1.2 * seen.v + seen.v * closing / (2 * 3**0.5), 0)
        a = 1.5 * (1 - (seen.v / seen.limit) ** 4 - (wish / gap) ** 2)
        return {"acceleration": np.clip(a, -8, 1.5), "steering": steering}

    Rollout(config, traffic, horizon=60.0, policy=HostPolicy(follow))

An experiment file names a factory of such a policy as `policy = "package.module:factory"`. Under `vmap` the
function is called once for all worlds, and once per device if a batch is spread over several. It must be a
pure function of its arguments: what it wants to remember, it returns as `memory`.
"""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.policies.base import Policy, snake_case
from limsim_jax.policies.predict import constant_velocity, nearest
from limsim_jax.policies.reference import reference_path
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control, Trajectory
from limsim_jax.types import Config, State, Status

Kind = Literal["control", "trajectory", "meta"]

BROKEN = -2
"""A meta-action of a planner that failed: the engine takes it for a broken command."""

# where installed code lies, which is not the planner's
_FOREIGN = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})

FAR = 1e6
"""m to the next light where there is none."""

_LANES = 4  # lanes beyond the own one that are searched for lights


class Observation(NamedTuple):
    """What the egos see, `[B, E]`.

    `B` worlds, `E` egos, `M` points of the reference path, `K` others. Positions are in the frame of the ego:
    x ahead of the centre of its body, y to the left. Values of others that are not `there`, and of rows
    without an ego, have no meaning.
    """

    time: Any  # [B], s since the start
    v: Any  # m/s
    a: Any  # m/s^2
    steering: Any  # rad
    length: Any  # m
    width: Any
    wheelbase: Any
    limit: Any  # m/s
    light: Any  # `SignalState` of the next light on the path
    light_distance: Any  # m from the front bumper to its stop line, `FAR` if there is none
    to_go: Any  # lanes to cross for the route, left > 0
    to_go_within: Any  # m
    way_x: Any  # [B, E, M], m, reference path: the middle of the lane along the route
    way_y: Any
    way_heading: Any  # rad
    way_limit: Any  # m/s
    there: Any  # [B, E, K], bool
    other_x: Any  # m, centre
    other_y: Any
    other_heading: Any  # rad
    other_v: Any  # m/s
    other_length: Any  # m
    other_width: Any


@dataclass(frozen=True)
class Observe:
    """Makes the `Observation` of one world.

    Attributes:
      nearest: number of others, `K`.
      points: points of the reference path, `M`.
      step: m between points.
    """

    nearest: int = 8
    points: int = 40
    step: float = 2.0

    def __call__(self, config: Config, lane_map: LaneMap, state: State) -> Observation:
        """The world as its egos see it."""
        egos, slot, shape = state.egos, state.egos.slot, state.shape
        cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]

        def frame(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
            dx, dy = x - egos.x[:, None], y - egos.y[:, None]
            return cos * dx + sin * dy, cos * dy - sin * dx

        goal = state.goal[slot]
        path = reference_path(lane_map, state, slot, points=self.points, step=self.step)
        way_x, way_y = frame(path.x, path.y)
        now = constant_velocity(lane_map, state, jnp.zeros(1, state.v.dtype))
        near = nearest(lane_map, state, now, slot, self.nearest)
        other_x, other_y = frame(now.x[near, 0], now.y[near, 0])
        light, distance = _next_light(lane_map, state)
        own = state.lane[slot]
        return Observation(
            time=config.time(state.step),
            v=state.v[slot],
            a=egos.a,
            steering=egos.steering,
            length=shape.length[slot],
            width=shape.width[slot],
            wheelbase=shape.wheelbase[slot],
            limit=lane_map.speed_limit[own],
            light=light,
            light_distance=distance,
            to_go=lane_map.routes.lanes_to_go[own, goal],
            to_go_within=lane_map.routes.change_distance[own, goal] - state.s[slot],
            way_x=way_x,
            way_y=way_y,
            way_heading=wrap_angle(path.heading - egos.heading[:, None]),
            way_limit=path.limit,
            there=near >= 0,
            other_x=other_x,
            other_y=other_y,
            other_heading=wrap_angle(now.heading[near, 0] - egos.heading[:, None]),
            other_v=state.v[near],
            other_length=shape.length[near],
            other_width=shape.width[near],
        )


def _next_light(lane_map: LaneMap, state: State) -> tuple[jax.Array, jax.Array]:
    """State of the next light, and m to its stop line."""
    slot = state.egos.slot
    lane, goal = state.lane[slot], state.goal[slot]
    shows = lane_states(lane_map.signals, state.lights.phase)
    end = lane_map.length[lane] - state.s[slot]
    light, distance = jnp.full_like(lane, SignalState.OFF), jnp.full_like(end, FAR)
    for _ in range(_LANES):
        following = lane_map.routes.next_lane[lane, goal]
        line = end - (lane_map.length - lane_map.stop_s)[lane]
        shown = shows[following].astype(light.dtype)
        found = (distance >= FAR) & (following != NO_LANE) & (shown != SignalState.OFF) & (line > 0)
        light, distance = jnp.where(found, shown, light), jnp.where(found, line, distance)
        end, lane = end + lane_map.length[following], following
    return light, distance


def _empty_road(seen: Any) -> Any:
    """An observation of a straight empty road, to try a function on.

    Zeros of the same shapes if the observation is of another kind.
    """
    zeros = jax.tree.map(lambda x: np.zeros((1, *x.shape), x.dtype), seen)
    if not isinstance(zeros, Observation):
        return zeros
    steps = np.arange(zeros.way_x.shape[-1], dtype=np.float32)
    return zeros._replace(
        **{name: np.full_like(zeros.v, 10.0) for name in ("v", "limit")},
        length=zeros.length + np.float32(5.0),
        width=zeros.width + np.float32(2.0),
        wheelbase=zeros.wheelbase + np.float32(3.0),
        light=zeros.light + SignalState.OFF,
        light_distance=zeros.light_distance + np.float32(FAR),
        way_x=zeros.way_x + 2 * steps,
        way_limit=zeros.way_limit + np.float32(10.0),
    )


def command_from(kind: Kind, found: Mapping[str, Any], config: Config, state: State, dt: float) -> Command:
    """The command of named arrays, from a host function or an `Env`.

    Args:
      kind: what they are.
      found: see `HostPolicy`, without the axis of worlds; trajectories in the frames of the egos.
      config: of the run.
      state: in which the command is given.
      dt: s between samples of trajectories.
    """
    if kind == "control":
        return Command(control=Control(**{name: jnp.asarray(x, jnp.float32) for name, x in found.items()}))
    if kind == "meta":
        return Command(meta=jnp.asarray(found["meta"], jnp.int32))
    egos = state.egos
    x, y, heading, v = (jnp.asarray(found[name], jnp.float32) for name in ("x", "y", "heading", "v"))
    cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]
    trajectory = Trajectory(
        x=egos.x[:, None] + cos * x - sin * y,
        y=egos.y[:, None] + sin * x + cos * y,
        heading=wrap_angle(egos.heading[:, None] + heading),
        v=v,
        t0=config.time(state.step),
        dt=dt,
    )
    return Command(trajectory=trajectory)


@dataclass(frozen=True)
class HostPolicy(Policy):
    """Egos driven by a function on the host.

    `function(seen)` gets what `observe` makes of all worlds, as NumPy arrays with a first axis `B`. It
    returns a mapping of arrays, by `command`:

    - "control": `acceleration` (m/s^2) and `steering` (rad), `[B, E]`, held until the next decision;
    - "trajectory": `x`, `y` (m), `heading` (rad), `v` (m/s), `[B, E, samples]`, of the centre of the body in
      the frame of the ego, every `dt` s from now on;
    - "meta": `meta`, `[B, E]`, whole numbers: `traffic.ego.Meta`, -1: like the traffic.

    With `memory` it is `function(seen, memory)` with an array `[B, E, memory]`, zeros at the start, and
    returns the mapping and the new array. If it is `keyed`, its last argument is an array `[B, 2]` with the
    random keys of the decisions, by which its notes are found again.

    Before anything is compiled, the function is tried on one empty straight road. An error there is a
    `ValueError` of one line; an exception of the function is named with its file and line. A world in which
    the function fails later is a failed episode (`policy_failed`): it raises, returns something else than it
    should, or a number that is not finite. After an exception the worlds of the call are tried one by one, so
    that the others go on.

    Attributes:
      function: the planner.
      command: kind of what it returns.
      memory: numbers kept for each ego.
      observe: makes a pytree of arrays of one world: `(config, lane_map, state)`.
      samples: of a trajectory.
      dt: s between samples.
      keyed: whether the function gets the keys of the decisions.
      failures: why it failed in this process, by the random key of the decision.
    """

    function: Callable[..., Any]
    command: Kind = "control"
    memory: int = 0
    observe: Callable[[Config, LaneMap, State], Any] = field(default_factory=Observe)
    samples: int = 41
    dt: float = 0.1
    keyed: bool = False
    failures: dict[bytes, str] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.knows == "sensors":  # they look at the world itself, not at a view of it
            object.__setattr__(self, "privileged", True)
        if self.command not in get_args(Kind):
            raise ValueError(f"command: '{self.command}'; known are {', '.join(get_args(Kind))}")
        if self.memory < 0:
            raise ValueError(f"memory: {self.memory} numbers; expected 0 or more")
        if self.samples < 2 or not self.dt > 0:
            raise ValueError(
                f"{self.samples} samples every {self.dt} s; expected 2 or more, and more than 0 s"
            )

    @property
    def free(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether its egos move in the plane; with meta-actions they keep to lanes."""
        return self.command != "meta"

    @property
    def knows(self) -> str | None:
        """What `observe` says that it knows: "sensors", or None."""
        return getattr(self.observe, "knows", None)

    @property
    def needs_scenery(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether `observe` says so."""
        return bool(getattr(self.observe, "needs_scenery", False))

    @property
    def default_name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The name of the function."""
        return snake_case(getattr(self.function, "__name__", type(self.function).__name__))

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """Zeros, after the function has been tried.

        Raises:
          ValueError: the function raises, or returns something other than it should.
        """
        count = state.egos.slot.shape[0]
        seen = jax.eval_shape(lambda lane_map, state: self.observe(config, lane_map, state), lane_map, state)
        none = np.zeros((1, count, self.memory), np.float32)
        self._call(_empty_road(seen), none, np.zeros((1, 2), np.uint32), count)
        return jnp.zeros((count, self.memory), jnp.float32)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """Call the function."""
        seen = self.observe(config, lane_map, state)
        count = state.egos.slot.shape[0]
        shapes = {name: (count, *rest) for name, rest in self._fields().items()}

        status = state.status[state.egos.slot]
        fine = state.active[state.egos.slot] & ((status & int(Status.NOT_FINITE)) == 0)

        def ask(one: Any, *asked: Any) -> Any:
            # the leading axes of `one` are those that `vmap` has added
            batch = np.shape(one)
            size = int(np.prod(batch))
            flat = jax.tree.map(lambda x: np.asarray(x).reshape(size, *np.shape(x)[len(batch) :]), asked)
            found, kept = self._ask(_Asked(*flat), count)
            return jax.tree.map(lambda x: x.reshape(*batch, *x.shape[1:]), (found, kept))

        kind = jnp.int32 if self.command == "meta" else jnp.float32
        wanted = {name: jax.ShapeDtypeStruct(shape, kind) for name, shape in shapes.items()}
        kept = jax.ShapeDtypeStruct(memory.shape, jnp.float32)
        found, memory = jax.pure_callback(
            ask, (wanted, kept), jnp.zeros(()), *_Asked(seen, memory, fine, jax.random.key_data(key)),
            vmap_method="broadcast_all",
        )  # fmt: skip
        return command_from(self.command, found, config, state, self.dt), memory

    def _fields(self) -> dict[str, tuple[int, ...]]:
        """Names of the returned arrays, and their axes after `[B, E]`."""
        if self.command == "control":
            return {"acceleration": (), "steering": ()}
        if self.command == "meta":
            return {"meta": ()}
        return {name: (self.samples,) for name in ("x", "y", "heading", "v")}

    def _ask(self, asked: _Asked, count: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """What the function says of all worlds; worlds in which it fails get broken commands.

        Worlds in which it has failed before are not shown to it again: they look like one of the others.
        """
        size, fine = len(asked.key), asked.fine.any(-1)
        alive = np.flatnonzero(fine)
        found, kept = self._nothing(size, count), np.array(asked.memory)
        if not alive.size:
            return found, kept
        shown = np.where(fine, np.arange(size), alive[0])
        seen, memory, keys = jax.tree.map(lambda x: x[shown], (asked.seen, asked.memory, asked.key))
        try:
            answer, remembered = self._call(seen, memory, keys, count)
            for name, x in answer.items():
                found[name][alive] = x[alive]
            kept[alive] = remembered[alive]
        except ValueError:
            for k in map(int, alive):
                try:
                    one = asked.seen, asked.memory, asked.key
                    seen, memory, keys = jax.tree.map(lambda x: x[k : k + 1], one)  # noqa: B023
                    answer, kept[k : k + 1] = self._call(seen, memory, keys, count)
                except ValueError as error:
                    self.failures[asked.key[k].tobytes()] = str(error)
                    continue
                for name, x in answer.items():
                    found[name][k : k + 1] = x
        return found, kept

    def _nothing(self, size: int, count: int) -> dict[str, np.ndarray]:
        """Broken commands."""
        kind, value = (np.int32, BROKEN) if self.command == "meta" else (np.float32, np.nan)
        return {name: np.full((size, count, *rest), value, kind) for name, rest in self._fields().items()}

    def _call(
        self, seen: Any, memory: Any, keys: np.ndarray, count: int
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Call the function for the worlds of some keys; check what it returns."""
        name = getattr(self.function, "__qualname__", type(self.function).__qualname__)
        given = [seen, *([memory] if self.memory else []), *([keys] if self.keyed else [])]
        try:
            found = self.function(*given)
        except Exception as error:
            raise ValueError(f"{_where(error, name)}: {type(error).__name__}: {error}") from error
        if self.memory:
            if not (isinstance(found, tuple) and len(found) == 2):
                raise ValueError(f"{name}: returns {_what(found)}, not a mapping and the new memory")
            found, memory = found
        if not isinstance(found, Mapping) or set(found) != set(self._fields()):
            raise ValueError(f"{name}: returns {_what(found)}, not a mapping of {', '.join(self._fields())}")
        kind = np.int32 if self.command == "meta" else np.float32
        checked: dict[str, np.ndarray] = {}
        size = len(keys)
        for field_, rest in self._fields().items():
            checked[field_] = _checked(name, field_, found[field_], (size, count, *rest), kind)
        shape = (size, count, self.memory)
        return checked, _checked(name, "memory", memory, shape, np.float32)


class _Asked(NamedTuple):
    """What a call is about, `[B, ...]`."""

    seen: Any
    memory: Any
    fine: Any  # [B, E], the ego is there and the planner has not failed it
    key: Any  # of the decision


def failure_reasons(policy: Any) -> dict[bytes, str]:
    """Why planners within a policy failed in this process.

    By the random key of the decision."""
    found: dict[bytes, str] = {}
    for one in planners(policy):
        found |= one.failures
    return found


def planners(policy: Any) -> list[HostPolicy]:
    """The planners on the host within a policy, each once."""
    found = [policy] if isinstance(policy, HostPolicy) else []
    for value in vars(policy).values() if is_dataclass(policy) else ():
        for one in value if isinstance(value, tuple) else (value,):
            if is_dataclass(one) and not isinstance(one, type):
                found += [x for x in planners(one) if all(x is not y for y in found)]
    return found


def _where(error: Exception, name: str) -> str:
    """File, line and function where an exception of the planner was raised.

    The last line of the planner's own code: frames of installed packages and of Python are left out.
    """
    frames = traceback.extract_tb(error.__traceback__)[1:]
    own = [frame for frame in frames if not frame.filename.startswith(_FOREIGN) and frame.filename[:1] != "<"]
    if not own:
        return name
    return f"{Path(own[-1].filename).name}:{own[-1].lineno} in {own[-1].name}"


def _what(found: Any) -> str:
    return (
        f"a mapping of {', '.join(map(str, found))}" if isinstance(found, Mapping) else type(found).__name__
    )


def _checked(name: str, field_: str, value: Any, shape: tuple[int, ...], kind: Any) -> np.ndarray:
    """The value as an array of this shape; otherwise a `ValueError`."""
    try:
        array = np.asarray(value)
        numbers = np.issubdtype(array.dtype, np.integer if kind is np.int32 else np.number)
    except (TypeError, ValueError):
        array, numbers = np.zeros(0), False
    if not numbers or np.iscomplexobj(array):
        wanted = "whole numbers" if kind is np.int32 else "numbers"
        raise ValueError(f"{name}: {field_} is {_what(value)} of {array.dtype}, not an array of {wanted}")
    if array.shape != shape:
        raise ValueError(f"{name}: {field_} has shape {list(array.shape)}, not [B, E, ...] = {list(shape)}")
    return np.ascontiguousarray(array, kind)
