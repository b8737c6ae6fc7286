"""A world that is shared with SUMO, on the device: one tick of the host's clock.

Every vehicle has one owner. Vehicles of SUMO are *foreign*: they take part in neighbours, right of way,
contacts and metrics, but where they are is what SUMO says. A tick has two halves:

1. `settle`: the moment that both sides have reached. Foreign vehicles are written into their slots, contacts
   are looked for, metrics are kept.
2. `move`: decide if it is time, and drive our vehicles to the next moment. SUMO drives the others there.

With `Seen.everyone`, the vehicles in slots are ours: SUMO inserts them, and they are foreign at that moment
only. Those whose route leads nowhere on the map stay SUMO's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose, side_s, to_frenet, width
from limsim_jax.policies.base import PolicyLike, sighted
from limsim_jax.simulation.rollout import Measure, measured_start
from limsim_jax.simulation.totals import Stood, Totals, count, no_totals
from limsim_jax.simulation.trace import Trace, trace
from limsim_jax.traffic.collision import record as record_events
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import at_slots, sync
from limsim_jax.traffic.engine import Decision, Tick, Traffic, drive
from limsim_jax.traffic.motion import boxes, without
from limsim_jax.traffic.parameters import DRIVING
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config, Driver, Egos, Queues, Shape, State, Status

NOWHERE = 0
"""Column of routes that cannot be driven on the map."""

_OVER_LINE = 0.1  # m of a foreign body beyond the line from which it is in two lanes
_OURS = Status.NOT_FINITE | Status.RED_LIGHT | Status.HARD_BRAKE | Status.MISSED_ROUTE
"""What is found while our vehicles move; all else is found once SUMO's are where they belong."""


@struct.dataclass(frozen=True, kw_only=True)
class Seen:
    """What SUMO says of one world: `N` slots, `E` egos, `G` signal programs. Places from the map's origin.

    Rows of egos hold what SUMO says of them; only the first moment is read from there.
    """

    present: Bool[Array, " N"]  # a vehicle of SUMO is in the slot
    fresh: Bool[Array, " N"]  # since now
    arrived: Bool[Array, " N"]  # the one that was there has reached its end
    number: Int[Array, " N"]  # of the vehicle in this world
    lane: Int[Array, " N"]
    s: Float[Array, " N"]  # m, about
    x: Float[Array, " N"]  # m, middle of the front bumper
    y: Float[Array, " N"]
    heading: Float[Array, " N"]  # rad
    v: Float[Array, " N"]  # m/s
    a: Float[Array, " N"]  # m/s^2
    goal: Int[Array, " N"]
    driver: Driver  # [N]
    shape: Shape  # [N]
    phase: Int[Array, " G"]  # of the lights
    lost: Int[Array, ""]  # vehicles without a slot
    ended: Bool[Array, " E"]  # SUMO has taken the ego off the road
    alive: Bool[Array, ""]  # the world goes on; otherwise nothing changes
    everyone: Bool[Array, ""]  # we drive the others as well


class Moved(NamedTuple):
    """Our vehicles at the next moment, and how they got there."""

    state: State  # foreign vehicles are where we would have driven them
    decision: Decision
    dx: Float[Array, " N"]  # m
    left: Bool[Array, " N"]
    command: Command


class SharedCarry(NamedTuple):
    """A shared world between two ticks."""

    state: State  # the last moment that both sides have reached
    moved: Moved
    memory: Any
    totals: Totals
    stood: Stood
    measured: Any


class Pushed(NamedTuple):
    """Where our vehicles are at the next moment: for SUMO. Rows of its own vehicles mean nothing."""

    x: Float[Array, " N"]  # m, middle of the front bumper
    y: Float[Array, " N"]
    heading: Float[Array, " N"]  # rad
    v: Float[Array, " N"]  # m/s
    a: Float[Array, " N"]  # m/s^2
    active: Bool[Array, " N"]
    goal: Int[Array, " N"]
    ghost: Float[Array, "N 3"]  # x, y, heading of the body on a second lane; NaN: it is on one


@dataclass(frozen=True)
class SharedWorld:
    """The program of a shared world; written for one, `vmap` makes the batch.

    Attributes:
      dt: s, step of both sides.
      decision_every: steps per decision of the policy.
      traffic: how our vehicles read the rules; how egos of `LikeTraffic` drive.
      policy: drives the egos.
      measure: metrics.
      egos: number E; they are in the first slots.
    """

    dt: float
    decision_every: int
    traffic: Traffic
    policy: PolicyLike
    measure: Measure
    egos: int

    @property
    def config(self) -> Config:
        """Of the clock that both sides share."""
        return Config(dt=self.dt, decision_every=1)

    @property
    def planning(self) -> Config:
        """Of the policy."""
        return Config(dt=self.dt, decision_every=self.decision_every)

    def start(self, lane_map: LaneMap, seen: Seen) -> SharedCarry:
        """The world at its first moment, with everything where SUMO has it."""
        lanes = with_lights(lane_map, seen.phase, jnp.float32(0))
        s, d = _on_lane(lanes, seen)
        there = seen.present & (seen.lane != NO_LANE)
        state = start_state(
            lanes, seen.driver, seen.shape, lane=jnp.where(there, seen.lane, NO_LANE), s=s, v=seen.v,
            goal=seen.goal, active=there, origins=1,
        )  # fmt: skip
        slot, zero = jnp.arange(self.egos, dtype=jnp.int32), jnp.zeros(self.egos, jnp.float32)
        bound = Egos(
            slot=slot, free=zero > 0, x=zero, y=zero, heading=zero, steering=zero, a=zero,
        )  # fmt: skip
        lights = replace(state.lights, phase=seen.phase)
        a = jnp.where(there, seen.a, 0)
        state = replace(state, d=d, a=a, vehicle=seen.number, egos=bound, lights=lights)
        egos = sync(lanes, state, boxes(lanes, state)).egos
        if self.policy.free:
            half, heading = seen.shape.length[slot] / 2, seen.heading[slot]
            egos = replace(
                egos, free=jnp.ones_like(egos.free), heading=heading, a=seen.a[slot],
                x=seen.x[slot] - half * jnp.cos(heading), y=seen.y[slot] - half * jnp.sin(heading),
            )  # fmt: skip
        state = replace(state, egos=egos)
        memory = self._policy.init(self.planning, lanes, state)
        held = self._no_command(lanes, state, memory)
        shapes = jax.eval_shape(self._move, lanes, state, memory, held, jnp.bool_(True), jax.random.key(0))[0]
        moved = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)._replace(state=state)
        stood = Stood(state.distance, jnp.zeros_like(state.distance))
        measured = measured_start(self.measure, self.config, lanes, state)
        return SharedCarry(state, moved, memory, no_totals(state), stood, measured)

    def tick(
        self,
        lane_map: LaneMap,
        carry: SharedCarry,
        seen: Seen,
        first: Bool[Array, ""],
        due: Bool[Array, ""],
        key: Key[Array, ""],
    ) -> tuple[SharedCarry, Trace, Pushed]:
        """Settle at this moment, and drive to the next.

        Args:
          lane_map: the map.
          carry: of the tick before.
          seen: what SUMO says now.
          first: nothing has moved yet: there is nothing to settle.
          due: the policy decides now. The same for all worlds of a batch, so that it is not asked otherwise.
          key: of the world.

        Returns:
          The carry, the record of this moment, and where our vehicles will be at the next.
        """
        moved = carry.moved
        lanes = with_lights(lane_map, seen.phase, self.config.time(moved.state.step))
        state, left, dx = self._settled(lanes, carry, seen)
        box = boxes(lanes, state)
        state, off = record_events(self.config, lanes, state, box, free=self.policy.free)
        time = self.config.time(state.step)
        tick = Tick(state, box, left, off, time, moved.decision, dx, dx, moved.command)
        records = jax.tree.map(lambda x: x[None], self.measure.record(self.config, lanes, tick))
        measured = self.measure.update(self.config, lanes, carry.measured, records)
        totals, stood = count(self.config, carry.totals, carry.stood, carry.state, state)
        settled = carry._replace(state=state, totals=totals, stood=stood, measured=measured)
        settled = jax.tree.map(lambda old, new: jnp.where(first, old, new), carry, settled)
        seen_now = trace(lanes)(tick)

        state = settled.state
        now = jax.random.fold_in(key, state.step)
        moved, memory = self._move(lanes, state, carry.memory, moved.command, due, now)
        after = settled._replace(moved=moved, memory=memory)
        after = jax.tree.map(lambda old, new: jnp.where(seen.alive, new, old), carry, after)
        return after, seen_now, self._pushed(lanes, after.moved.state)

    def result(self, lane_map: LaneMap, carry: SharedCarry) -> Any:
        """Metrics of the world."""
        return self.measure.result(self.config, lane_map, carry.measured)

    # --- halves of a tick

    def _settled(
        self, lanes: LaneMap, carry: SharedCarry, seen: Seen
    ) -> tuple[State, Bool[Array, " N"], Float[Array, " N"]]:
        """The world with SUMO's vehicles where they are; those that have left; how far all came (m)."""
        before, moved = carry.state, carry.moved
        after, dt = moved.state, self.dt
        others = jnp.arange(seen.lane.shape[0]) >= self.egos
        foreign = others & (seen.fresh | (seen.goal == NOWHERE) | ~seen.everyone)
        ended = at_slots(after.egos, seen.ended, jnp.zeros_like(foreign)) & before.active
        kept = after.active & ~ended & (seen.present | ~others)
        there = jnp.where(foreign, seen.present & (seen.lane != NO_LANE), kept)
        same = before.active & ~seen.fresh
        s, d = _on_lane(lanes, seen)
        previous, earlier = _trail(lanes, before, seen.lane, same)
        half = seen.shape.width / 2
        over = there & (half + jnp.abs(d) - width(lanes, seen.lane, s) / 2 > _OVER_LINE)
        still = jnp.where(seen.v < DRIVING.walking_speed, jnp.where(same, before.waiting, 0) + dt, 0)
        nothing, zero = jnp.zeros_like(before.side), jnp.zeros_like(before.s)
        dx = jnp.where(foreign, jnp.where(same, seen.v * dt, 0), moved.dx)
        now = self.config.time(after.step)
        theirs = {
            "lane": seen.lane, "previous": previous, "s": s, "d": d, "v": seen.v, "a": seen.a,
            "goal": seen.goal, "side": jnp.where(over, jnp.where(d > 0, 1, -1), 0), "crossed": nothing > 0,
            "progress": zero, "shift": zero, "rest": zero, "waiting": still,
            "yielding": after.yielding & same, "stopped": after.stopped & same,
            "distance": jnp.where(same, before.distance + dx, 0), "vehicle": seen.number,
            "entered": jnp.where(seen.fresh, now, before.entered),
        }  # fmt: skip
        fields = {name: jnp.where(foreign, value, getattr(after, name)) for name, value in theirs.items()}
        known = jnp.where(seen.fresh & foreign, 0, before.status)
        ours = jnp.where(foreign, 0, after.status & int(_OURS))
        fresh = seen.fresh & foreign
        queues = Queues(
            next=before.queues.next + jnp.sum(fresh & there, dtype=jnp.int32),
            full=before.queues.full + seen.lost,
        )
        left = jnp.where(foreign, False, moved.left | ended) | (others & seen.arrived & before.active)
        state = replace(
            after,
            active=there,
            earlier=jnp.where(foreign[:, None], earlier, after.earlier),
            driver=jax.tree.map(lambda old, new: jnp.where(foreign, new, old), after.driver, seen.driver),
            shape=jax.tree.map(lambda old, new: jnp.where(foreign, new, old), after.shape, seen.shape),
            status=known | ours,
            struck=jnp.where(fresh, -1, before.struck),
            struck_at=jnp.where(fresh, 0, before.struck_at),
            lights=replace(after.lights, phase=seen.phase),
            queues=queues,
            **fields,
        )
        return without(state, ~there), left, dx

    # Jitted, although within a jitted function: both uses share one trace.

    @cached_property
    def _policy(self) -> PolicyLike:
        return sighted(self.policy)

    @cached_property
    def _decide(self) -> Callable[..., tuple[Command, Any]]:
        return jax.jit(partial(self._policy, self.planning))

    @cached_property
    def _move(self) -> Callable[..., tuple[Moved, Any]]:
        """Our vehicles a step on."""

        def move(
            lanes: LaneMap,
            state: State,
            memory: Any,
            held: Command,
            due: Bool[Array, ""],
            key: Key[Array, ""],
        ) -> tuple[Moved, Any]:
            command, memory = lax.cond(
                due, lambda: self._decide(lanes, state, memory, key), lambda: (held, memory)
            )
            after, records = drive(
                self.config, self.traffic, lanes, state, None, command,
                lambda tick: (tick.decision, tick.dx, tick.left), free=self.policy.free,
            )  # fmt: skip
            decision, dx, left = jax.tree.map(lambda x: x[0], records)
            return Moved(after, decision, dx, left, command), memory

        return jax.jit(move)

    def _no_command(self, lanes: LaneMap, state: State, memory: Any) -> Command:
        """A command of the shapes of the policy's."""
        shapes = jax.eval_shape(self._decide, lanes, state, memory, jax.random.key(0))[0]
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def _pushed(self, lanes: LaneMap, state: State) -> Pushed:
        egos, slot = state.egos, state.egos.slot
        own = zip(boxes(lanes, state)[:, :3].T, (egos.x, egos.y, egos.heading), strict=True)
        x, y, heading = (column.at[slot].set(mine) for column, mine in own)
        half = state.shape.length / 2
        lane, s, side = state.lane, state.s, state.side
        beside = jnp.where(side > 0, lanes.left[lane], jnp.where(side < 0, lanes.right[lane], NO_LANE))
        ghost = jnp.stack(pose(lanes, beside, side_s(lanes, lane, s, side)), -1)
        return Pushed(
            x=x + half * jnp.cos(heading),
            y=y + half * jnp.sin(heading),
            heading=wrap_angle(heading),
            v=state.v,
            a=state.a,
            active=state.active,
            goal=state.goal,
            ghost=jnp.where((beside == NO_LANE)[:, None], jnp.nan, ghost),
        )


def with_lights(lane_map: LaneMap, phase: Int[Array, " G"], time: Float[Array, ""]) -> LaneMap:
    """The map whose lights are in these phases now.

    Phases last 1 s each there, so the offset of a program says in which it is."""
    signals = lane_map.signals
    return replace(lane_map, signals=replace(signals, offset=time - phase.astype(jnp.float32) - 0.5))


def _on_lane(lanes: LaneMap, seen: Seen) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Front bumpers along their lanes, and beside their centres, m."""
    s, d, _ = to_frenet(lanes, seen.lane, seen.s, seen.x, seen.y)
    there = seen.present & (seen.lane != NO_LANE)
    s = jnp.clip(s, 0, lanes.length[seen.lane])
    return jnp.where(there, s, 0), jnp.where(there, d, 0)


def _trail(
    lanes: LaneMap, before: State, lane: Int[Array, " N"], same: Bool[Array, " N"]
) -> tuple[Int[Array, " N"], Int[Array, "N P"]]:
    """Lanes behind those of foreign vehicles: the nearest, and the ones before it.

    A vehicle that has gone on by one or two lanes has its tail there; after a lane change it is not known.
    """
    after = lanes.successors[before.lane]  # [N K]
    next_one = (after == lane[:, None]).any(-1)
    over = (lanes.successors[after] == lane[:, None, None]).any(-1) & (after != NO_LANE)
    between = jnp.take_along_axis(after, jnp.argmax(over, -1)[:, None], -1)[:, 0]
    stays = lane == before.lane
    skipped = over.any(-1) & ~next_one
    once = jnp.concatenate([before.previous[:, None], before.earlier[:, :-1]], -1)
    twice = jnp.concatenate([before.lane[:, None], once[:, :-1]], -1)
    previous = jnp.where(next_one, before.lane, jnp.where(skipped, between, NO_LANE))
    earlier = jnp.where(next_one[:, None], once, jnp.where(skipped[:, None], twice, NO_LANE))
    previous = jnp.where(same, jnp.where(stays, before.previous, previous), NO_LANE)
    earlier = jnp.where(same[:, None], jnp.where(stays[:, None], before.earlier, earlier), NO_LANE)
    return previous, earlier
