"""A policy at the wheel of an ego in a log: a bicycle model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Float, Int, Key

from limsim_jax.geometry import wrap_angle
from limsim_jax.log_replay.arrays import SceneArrays
from limsim_jax.log_replay.takeover import Ego, Flight, Moment
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, to_frenet
from limsim_jax.policies.base import PolicyLike, sighted
from limsim_jax.traffic.command import Command, hold_and_brake, without_broken
from limsim_jax.traffic.ego import Control, Limits, step_free, track
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config, Egos, Shape, State

PLANNED = 10
"""Moments of a plan, 0.3 s apart."""

_GRID = 0.3  # s
_WHEELBASE = 0.6  # of the length of a body


class _Memory(NamedTuple):
    state: State  # of the ego alone
    command: Command
    policy: Any


@struct.dataclass(frozen=True, kw_only=True)
class PolicyPilot:
    """Lets a policy drive the ego. It sees all vehicles on the lanes where they are.

    Hand it to a compiled function as an argument, for the map in it.
    """

    lane_map: LaneMap  # of the scene
    policy: PolicyLike = struct.field(pytree_node=False)  # whose egos move in the plane
    decision_every: int = struct.field(pytree_node=False, default=5)  # moments of the log per decision
    limits: Limits = struct.field(pytree_node=False, default=Limits())  # of the ego

    def __post_init__(self) -> None:
        """Refuse policies that cannot drive here."""
        if not self.policy.free:
            raise ValueError("policy: it keeps to lanes; one that moves egos in the plane is expected")
        if self.policy.others:
            raise ValueError("policy: it drives other vehicles; one that drives the ego alone is expected")

    def init(self, scene: SceneArrays, ego: Ego) -> Flight:
        """On the log."""
        config = self._config(scene)
        zero = jnp.zeros_like(scene.log.x[0, 0])
        nobody = Moment(*scene_row(scene, jnp.int32(0)), jnp.zeros_like(scene.first), scene.first == 0)
        state = self._world(scene, ego, nobody, jnp.zeros_like(nobody.v), jnp.int32(0), None)
        policy = sighted(self.policy)
        memory = policy.init(config, self.lane_map, state)
        shapes = jax.eval_shape(policy, config, self.lane_map, state, memory, jax.random.key(0))
        command = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes[0])
        if command.trajectory is None and command.control is None:
            raise ValueError("policy: returns neither trajectories nor controls; one of them is expected")
        alone = _alone(state, ego.slot)
        return Flight(
            flying=jnp.zeros((), bool), x=zero, y=zero, heading=zero, v=zero, a=zero,
            plan=jnp.zeros((PLANNED, 3), zero.dtype), memory=_Memory(alone, command, memory),
        )  # fmt: skip

    def step(
        self,
        scene: SceneArrays,
        ego: Ego,
        flight: Flight,
        moment: Moment,
        a: Float[Array, " N"],
        t: Int[Array, ""],
        key: Key[Array, ""] | None,
    ) -> Flight:
        """Decide if it is time, and drive one moment on."""
        config, dt, driver = self._config(scene), scene.log.dt, sighted(self.policy)
        key = jax.random.key(0) if key is None else key
        memory: _Memory = flight.memory
        starts = ego.told[t] & ~flight.flying & moment.active[ego.slot]
        flying = flight.flying | starts
        world = self._world(scene, ego, moment, a, t, None)
        fresh = _alone(world, ego.slot)
        own = jax.tree.map(lambda new, old: jnp.where(flight.flying, old, new), fresh, memory.state)
        own = replace(own, step=t)

        def decide() -> tuple[Command, Any]:
            seen = self._world(scene, ego, moment, a, t, own)
            begin = driver.init(config, self.lane_map, seen)
            before = jax.tree.map(lambda new, old: jnp.where(flight.flying, old, new), begin, memory.policy)
            return driver(config, self.lane_map, seen, before, jax.random.fold_in(key, t))

        command, policy = lax.cond(
            t % self.decision_every == 0, decide, lambda: (memory.command, memory.policy)
        )
        own, sound, broken = without_broken(own, command)
        # until its first decision the ego goes on as it was
        decided = t % self.decision_every == 0
        time = config.time(t)
        if sound.trajectory is not None:
            control = track(config, self.limits, own, sound.trajectory, time)
        else:
            assert sound.control is not None  # as `init` has found
            control = sound.control
        hold = Control(acceleration=own.egos.a, steering=own.egos.steering)
        knows = flight.flying | decided
        own, control = hold_and_brake(self.limits, own, control, broken)
        control = jax.tree.map(lambda new, old: jnp.where(knows, new, old), control, hold)
        moved = step_free(config, self.lane_map, self.limits, own, control)
        egos = moved.egos
        place = jnp.stack([egos.x[0], egos.y[0], egos.heading[0]])
        then = time + dt + _GRID * jnp.arange(1, PLANNED + 1, dtype=time.dtype)
        plan = _straight(place, moved.v[0])
        if sound.trajectory is not None:
            ahead: Array = sound.trajectory.at(then)[0, :, :3]
            plan = jnp.where(knows, ahead, plan)
        return Flight(
            flying=flying, x=place[0], y=place[1], heading=place[2], v=moved.v[0], a=moved.a[0], plan=plan,
            memory=_Memory(moved, command, policy),
        )  # fmt: skip

    def _config(self, scene: SceneArrays) -> Config:
        return Config(dt=scene.log.dt, decision_every=self.decision_every)

    def _world(
        self, scene: SceneArrays, ego: Ego, moment: Moment, a: Array, t: Array, own: State | None
    ) -> State:
        """All vehicles on lanes, and the ego in the plane; with `own` the ego as it is known there."""
        me = jnp.arange(moment.x.shape[0])
        log = scene.log
        dx = moment.x[:, None] - scene.path[..., 0]
        dy = moment.y[:, None] - scene.path[..., 1]
        k = jnp.argmin(dx * dx + dy * dy, -1)
        lane = jnp.where(moment.active, scene.lane[me, k], NO_LANE)
        s, d, along = to_frenet(self.lane_map, lane, scene.lane_s[me, k], moment.x, moment.y)
        del along
        there = lane != NO_LANE
        shape = Shape(
            length=log.length, width=log.width, wheelbase=_WHEELBASE * log.length,
            vehicle_class=jnp.zeros_like(scene.first),
        )  # fmt: skip
        state = start_state(
            self.lane_map, scene.driver, shape, lane=lane, s=jnp.where(there, s + log.length / 2, 0),
            v=moment.v, goal=scene.goal, active=there,
        )  # fmt: skip
        slot = ego.slot[None]
        egos = Egos(
            slot=slot, free=jnp.ones(1, bool), x=moment.x[slot], y=moment.y[slot],
            heading=wrap_angle(moment.heading[slot]), steering=jnp.zeros(1, d.dtype), a=a[slot],
        )  # fmt: skip
        state = replace(state, step=t, d=jnp.where(there, d, 0), a=a, egos=egos)
        if own is None:
            return state
        mine = me == ego.slot
        names = "lane", "previous", "s", "d", "v", "a", "side", "distance"
        state = replace(state, earlier=jnp.where(mine[:, None], own.earlier[:1], state.earlier))
        known = {n: jnp.where(mine, getattr(own, n)[0], getattr(state, n)) for n in names}
        return replace(state, egos=replace(own.egos, slot=slot), **known)


def scene_row(scene: SceneArrays, t: Int[Array, ""]) -> tuple[Array, Array, Array, Array]:
    """x, y, heading and v of the log at a moment."""
    log = scene.log
    return log.x[t], log.y[t], log.heading[t], log.v[t]


def _alone(state: State, slot: Array) -> State:
    """A world with the ego alone, in slot 0."""
    number = state.lane.shape[0]

    def row(x: Array) -> Array:
        return x[slot][None] if x.ndim == 1 and x.shape[0] == number else x

    names = [name for name in vars(state) if name not in ("step", "queues", "lights", "egos", "script")]
    rows = {name: jax.tree.map(row, getattr(state, name)) for name in names}
    return replace(state, egos=replace(state.egos, slot=jnp.zeros(1, jnp.int32)), **rows)


def _straight(place: Array, v: Array) -> Array:
    """A plan at constant speed straight on."""
    way = v * _GRID * jnp.arange(1, PLANNED + 1, dtype=v.dtype)
    heading = jnp.full_like(way, place[2])
    return jnp.stack([place[0] + way * jnp.cos(heading), place[1] + way * jnp.sin(heading), heading], -1)


__all__ = ["PLANNED", "PolicyPilot"]
