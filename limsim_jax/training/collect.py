"""Samples for the end-to-end driver: what it sees, and what an expert would do there.

The expert sees what the student can see: vehicles within the range of the LiDAR that are not hidden, and no
turn signals, which its pictures are too coarse for (after LEAD: an expert that knows more than the student
teaches what cannot be learned). It labels every state that is visited, also where the student drives.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float

from limsim_jax.maps.lane_map import LaneMap, pose
from limsim_jax.maps.scenery import Label
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.policies.base import PolicyLike, sighted
from limsim_jax.policies.end_to_end.inputs import LIDAR_RANGE, STEP, Inputs
from limsim_jax.policies.end_to_end.network import (
    CELL,
    DENSITY,
    DENSITY_GRID,
    JUNCTION,
    LENGTH,
    SPEED,
    TARGET_TIME,
    WAYPOINT_TIME,
    WAYPOINTS,
    WIDTH,
    Design,
    Network,
    Outputs,
    Trained,
    fresh_weights,
    path_places,
)
from limsim_jax.policies.end_to_end.policy import EndToEnd, Memory, Seen
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.policies.reference import project_onto
from limsim_jax.policies.view import View
from limsim_jax.sensors.lidar import hits_per_body
from limsim_jax.simulation.rollout import Rollout, Started, started
from limsim_jax.simulation.worlds import over_worlds
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import read_experiments
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Trajectory, at_slots
from limsim_jax.types import Config, State
from limsim_jax.xla import run_often, run_once

HITS = 3
"""LiDAR points from which a vehicle belongs to the density map (`sensors.objects.Detector`)."""

RED_WITHIN = 60.0
"""m along the route within which a red light counts, if a picture shows one."""

SEGMENT = 20
"""Decisions between two disturbances: 10 s."""

ASIDE, ASTRAY, FASTER = 0.7, 0.1, 0.2
"""Standard deviations of disturbances: m, rad, share of the speed. Chosen: one in six leaves its lane."""


def expert() -> PolicyLike:
    """The expert: PDM-Closed by the rules, with the view of the student."""
    view = View(range=LIDAR_RANGE, occlusion=True, signals=0.0)
    return PDMClosed(rules=True, view=view)


CALM = 0.4
"""Share of the segments without a disturbance. Chosen."""

LEFT = 0.3
"""New worlds start once egos are left in fewer than this share. Chosen."""


class Labels(NamedTuple):
    """What the network should have said, `[E, ...]`."""

    path: Float[Array, "E 10"]  # m left of the route
    known: Bool[Array, "E 10"]  # the expert's plan reaches that far
    change: Float[Array, " E"]  # m/s, of the speed within `TARGET_TIME`
    waypoints: Float[Array, "E 8 2"]  # m
    density: Float[Array, "E 16 12 8"]  # "object" is 0 or 1
    rules: Bool[Array, "E 3"]


class Sample(NamedTuple):
    """A moment, `[E, ...]`."""

    inputs: Inputs
    labels: Labels
    good: Bool[Array, " E"]  # the ego is there, and nothing has happened to it


def labels_of(config: Config, lane_map: LaneMap, state: State, seen: Seen, plan: Trajectory) -> Labels:
    """The labels of a moment from the plan of an expert."""
    egos, slot = state.egos, state.egos.slot
    v, path = state.v[slot], seen.path
    s, d, _ = project_onto(path, plan.x, plan.y)
    places = path_places(v)
    now = config.time(state.step)
    soon = plan.at(now[None] + TARGET_TIME)[:, 0, 3]
    later = plan.at(now + WAYPOINT_TIME * jnp.arange(1, WAYPOINTS + 1, dtype=jnp.float32))
    cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]
    dx, dy = later[..., 0] - egos.x[:, None], later[..., 1] - egos.y[:, None]
    near = round(JUNCTION / STEP) + 1
    far = round(RED_WITHIN / STEP) + 1
    shows = lane_states(lane_map.signals, state.lights.phase)[path.lane[:, :far]]
    stop = jnp.asarray(
        [int(SignalState.RED), int(SignalState.RED_YELLOW), int(SignalState.STOP)], shows.dtype
    )
    red = (seen.look.pictures.label == int(Label.LIGHT_RED)).any((-1, -2, -3))
    waits = (soon < v - 1.0) | ((v < 0.5) & (soon < 0.5))
    return Labels(
        path=jax.vmap(jnp.interp)(places, s, d),
        known=places <= s[:, -1:],
        change=soon - v,
        waypoints=jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx], -1),
        density=_density(seen),
        rules=jnp.stack(
            [lane_map.is_connector[path.lane[:, :near]].any(-1), red & jnp.isin(shows, stop).any(-1), waits],
            -1,
        ),
    )


def _density(seen: Seen) -> Float[Array, "E 16 12 8"]:
    """The density map of the vehicles that the LiDAR meets."""
    rows, columns = DENSITY_GRID.shape
    middle_x, middle_y = DENSITY_GRID.middles()

    def one(scan: Any, bodies: Any) -> Float[Array, "Q 8"]:
        there = bodies.there & (bodies.slot >= 0) & (hits_per_body(scan, bodies) >= HITS)
        row, column, inside = DENSITY_GRID.cells(bodies.x, bodies.y)
        there &= inside
        cell = jnp.where(there, row * columns + column, rows * columns)
        x = (bodies.x - middle_x[0, 0]) / CELL - row.astype(jnp.float32)
        y = (bodies.y - middle_y[0, 0]) / CELL - column.astype(jnp.float32)
        speed = jnp.hypot(bodies.vx, bodies.vy) / SPEED
        numbers = (
            there.astype(jnp.float32), x, y, jnp.cos(bodies.heading), jnp.sin(bodies.heading),
            bodies.length / LENGTH, bodies.width / WIDTH, speed,
        )  # fmt: skip
        values = jnp.stack(numbers, -1)
        grid = jnp.zeros((rows * columns + 1, len(DENSITY)), jnp.float32)
        for k in reversed(range(cell.shape[0])):  # of two in a cell the nearer one stays
            grid = grid.at[cell[k]].set(values[k])
        return grid[:-1]

    return jax.vmap(one)(seen.look.scan, seen.look.bodies).reshape(-1, rows, columns, len(DENSITY))


class _Memory(NamedTuple):
    student: Memory
    expert: Any
    sample: Sample
    led: Bool[Array, ""]  # whether the expert drives


@dataclass(frozen=True)
class _Collector:
    """Drives as the expert or the student, and labels what it sees."""

    student: EndToEnd
    teacher: PolicyLike = field(default_factory=lambda: sighted(expert()))
    privileged = True
    free = True
    others = 0

    def init(self, config: Config, lane_map: LaneMap, state: State) -> _Memory:
        student = self.student.init(config, lane_map, state)
        teacher = self.teacher.init(config, lane_map, state)
        shapes = jax.eval_shape(
            lambda: self._decide(config, lane_map, state, student, teacher, jax.random.key(0))[0]
        )
        return _Memory(
            student, teacher, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes), jnp.bool_(True)
        )

    def _decide(
        self, config: Config, lane_map: LaneMap, state: State, mine: Memory, theirs: Any, key: jax.Array
    ) -> tuple[Sample, Command, Command, Memory, Any]:
        seen, mine = self.student.see(config, lane_map, state, mine, key)
        trained = self.student.trained
        said = Network(trained.design).apply({"params": trained.weights}, seen.inputs)
        assert isinstance(said, Outputs)
        own, mine = self.student.drive(config, state, mine, seen, said)
        told, theirs = self.teacher(config, lane_map, state, theirs, key)
        assert told.trajectory is not None
        labels = labels_of(config, lane_map, state, seen, told.trajectory)
        slot = state.egos.slot
        good = state.active[slot] & (state.status[slot] == 0)
        return Sample(seen.inputs, labels, good), own, told, mine, theirs

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: _Memory, key: jax.Array
    ) -> tuple[Command, _Memory]:
        sample, own, told, mine, theirs = self._decide(
            config, lane_map, state, memory.student, memory.expert, key
        )
        assert own.trajectory is not None and told.trajectory is not None
        plan = told.trajectory
        time = plan.t0 + plan.dt * jnp.arange(plan.x.shape[1], dtype=jnp.float32)
        mixed = own.trajectory.at(time)
        values = {
            name: jnp.where(memory.led, getattr(plan, name), mixed[..., k])
            for k, name in enumerate(("x", "y", "heading", "v"))
        }
        assert own.signal is not None and told.signal is not None
        signal = jnp.where(memory.led, told.signal, own.signal)
        command = Command(trajectory=replace(plan, **values), signal=signal)
        return command, _Memory(mine, theirs, sample, memory.led)


def disturbed(lane_map: LaneMap, state: State, by: Float[Array, " 3"]) -> State:
    """The state with its egos moved aside, turned and at another speed.

    Args:
      lane_map: the map.
      state: the world.
      by: m to the left, rad, share of the speed.
    """
    egos, slot = state.egos, state.egos.slot
    lane, s = body_place(lane_map, state, slot)
    d = state.d[slot] + by[0]
    x, y, _ = pose(lane_map, lane, s, d)
    v = jnp.maximum(state.v[slot] * (1 + by[2]), 0.0)
    there = state.active[slot] & egos.free
    return replace(
        state,
        d=at_slots(egos, d, state.d, there),
        v=at_slots(egos, v, state.v, there),
        egos=replace(
            egos,
            x=jnp.where(there, x, egos.x),
            y=jnp.where(there, y, egos.y),
            heading=jnp.where(there, egos.heading + by[1], egos.heading),
        ),
    )


class Order(NamedTuple):
    """How a segment of a world goes."""

    led: Bool[Array, ""]  # the expert drives
    by: Float[Array, " 3"]  # disturbance at its start


class Field:
    """Worlds of a scenario from which samples come.

    Args:
      scenario: a file or a bundled name.
      worlds: that run at once; rounded up to a multiple of the devices.
      design: of the network that drives.
      first_seed: of its worlds.

    Raises:
      ExperimentError: the experiment cannot be run; one line.
    """

    def __init__(self, scenario: str, worlds: int, design: Design, first_seed: int = 0) -> None:
        blank = EndToEnd(network=Trained(design, fresh_weights(design), {}))
        (told,) = read_experiments(scenario, policy="like_traffic")
        self.scenario = told.name
        self.episodes = Episodes(told, policy=blank, chunk=1)
        self.design = design
        devices = jax.local_devices()
        self.worlds = -(-worlds // len(devices)) * len(devices)
        self.mesh = Mesh(np.array(devices), ("worlds",))
        here = NamedSharding(self.mesh, PartitionSpec())
        self.lane_map = jax.device_put(self.episodes.lane_map, here)
        self.next_seed = first_seed
        self._running: Started | None = None
        self._done = 0
        self._start: Any = None
        self._advance: Any = None

    @property
    def segments(self) -> int:
        """Segments until the horizon."""
        return -(-self.episodes.rollout.decisions // SEGMENT)

    def _run(self, weights: Any) -> Rollout:
        student = EndToEnd(network=Trained(self.design, weights, {}))
        return replace(self.episodes.rollout, policy=_Collector(student), measure=None)

    def compile(self, weights: Any) -> Field:
        """Get the programs ready."""

        def start(shared: Any, seed: Any) -> Started:
            lane_map, weights = shared
            return started(self._run(weights), lane_map, self.episodes.sample, seed)

        def advance(shared: Any, world: tuple[Started, Order]) -> tuple[Started, Sample]:
            lane_map, weights = shared
            run, (begun, order) = self._run(weights), world
            state = disturbed(lane_map, begun.carry.state, order.by)
            memory = begun.carry.memory._replace(led=order.led)
            carry = begun.carry._replace(state=state, memory=memory)

            def step(carry: Any, _: None) -> tuple[Any, Sample]:
                carry = run.advance(lane_map, begun.schedule, begun.key, carry, 1)[1]
                return carry, carry.memory.sample

            carry, samples = lax.scan(step, carry, None, length=SEGMENT)
            return begun._replace(carry=carry), samples

        shared = self.lane_map, weights
        seeds = jnp.zeros(self.worlds, jnp.int32)
        begin = over_worlds(start, self.mesh, run_once()).lower(shared, seeds)
        worlds = begin.out_info
        orders = jax.eval_shape(lambda: _orders(np.zeros(self.worlds, bool), np.zeros((self.worlds, 3))))
        self._advance = (
            over_worlds(advance, self.mesh, compile_soon()).lower(shared, (worlds, orders)).compile()
        )
        self._start = begin.compile()
        return self

    def segment(self, weights: Any, lead: float, rng: np.random.Generator) -> Sample:
        """Samples `[S, ...]` of the next segment of its worlds.

        Worlds go on from where they were. New ones start once few egos are left, or at the horizon.

        Args:
          weights: of the student.
          lead: share of the worlds in which the expert drives.
          rng: of disturbances.
        """
        shared = self.lane_map, weights
        if self._running is None:
            seeds = np.arange(self.next_seed, self.next_seed + self.worlds, dtype=np.int32)
            self._running, self._done = self._start(shared, seeds), 0
            self.next_seed += self.worlds
        led = rng.random(self.worlds) < lead
        calm = rng.random((self.worlds, 1)) < CALM
        by = np.where(calm, 0, rng.normal(size=(self.worlds, 3)) * (ASIDE, ASTRAY, FASTER))
        self._running, samples = self._advance(shared, (self._running, _orders(led, by)))
        samples = jax.device_get(samples)  # [W, D, E, ...]
        self._done += 1
        good = np.array(samples.good)
        if good[:, -1].mean() < LEFT or self._done >= self.segments:
            self._running = None
        return jax.tree.map(lambda x: x[good], samples)


def compile_soon() -> dict[str, Any] | None:
    """Compiler options of a program that runs for minutes: between `run_often` and `run_once`."""
    often = run_often()
    return often and {**(run_once() or {}), "xla_backend_optimization_level": 1}


def _orders(led: Any, by: Any) -> Order:
    return Order(jnp.asarray(led, bool), jnp.asarray(by, jnp.float32))
