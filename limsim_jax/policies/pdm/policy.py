"""PDM-Closed as a policy: the best proposal, or emergency braking; on request with the rules of the road."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.numerics import safe_norm
from limsim_jax.policies.base import Policy, PolicyLike
from limsim_jax.policies.pdm.give_way import along_with, way
from limsim_jax.policies.pdm.proposals import FRACTIONS, idm, leaders, poses
from limsim_jax.policies.pdm.road import DT, STEPS, Body, bodies, others_around, road_ahead
from limsim_jax.policies.pdm.score import TTC, Scores, score
from limsim_jax.policies.pdm.tracker import STOPPING_SPEED, drive_along, fitted
from limsim_jax.policies.predict import Predictor, along_route, constant_velocity
from limsim_jax.policies.simple import FollowLane
from limsim_jax.standards import COMFORT
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Trajectory
from limsim_jax.traffic.engine import Traffic
from limsim_jax.types import Config, State
from limsim_jax.xla import computed_once

EMERGENCY_TIME, EMERGENCY_SPEED, EMERGENCY_BRAKING = 2.0, 5.0, 7.0
"""Emergency braking: s to an at-fault contact; m/s, greatest speed for it if `strict_tuplan`; m/s^2."""

_AS_GOOD = 1e-3  # scores that differ by less count as equal


class Plan(NamedTuple):
    """Decision for `V` vehicles."""

    trajectory: Trajectory  # [V T], centre of the body
    best: Int[Array, " V"]  # index of the proposal
    signal: Int[Array, " V"]  # +1 or -1 for a lane change to the left or right
    brakes: Bool[Array, " V"]  # emergency
    scores: Scores
    tail: Trajectory  # [V T'], the proposal beyond the trajectory


@dataclass(frozen=True)
class PDMClosed(Policy):
    """PDM-Closed as a policy; its egos move in the plane.

    Attributes:
      seen: number of nearest other vehicles that it considers.
      strict_tuplan: conventions of the public implementation, see `limsim_jax.policies.pdm`.
      rules: whether it gives way as the map demands, and expects the others to follow the road and to give
        way, too. The published planner does not; this one is named `pdm_closed_rules`.
      predict: predictor of the others; None: constant velocity, with `rules` along their routes.
      traffic: right of way.

    Raises:
      ValueError: no other vehicle is seen, or rules in the public implementation, which has none.
    """

    seen: int = 32
    strict_tuplan: bool = False
    rules: bool = False
    predict: Predictor | None = None
    traffic: Traffic = field(default_factory=Traffic)

    def __post_init__(self) -> None:
        if self.seen < 1:
            raise ValueError(f"seen: {self.seen} others; expected at least 1")
        if self.rules and self.strict_tuplan:
            raise ValueError("rules: the public implementation has none; expected rules or strict_tuplan")

    @property
    def default_name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Another one with rules."""
        return "pdm_closed_rules" if self.rules else "pdm_closed"

    def variants(self, seen: Predictor) -> dict[str, PolicyLike]:
        """The policy with a reference in the place of one module.

        Prediction: the recorded future. Planning: car following on the lane.
        """
        return {"prediction": replace(self, predict=seen), "planning": FollowLane()}

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """The best proposal as a trajectory over 4 s."""
        del key
        plan = self.plan(config, lane_map, state)
        return Command(trajectory=plan.trajectory, signal=plan.signal), memory

    def plan(self, config: Config, lane_map: LaneMap, state: State, beyond: int = 0) -> Plan:
        """The decision, with the chosen proposal for `beyond` more steps of `DT`."""
        strict, slot = self.strict_tuplan, state.egos.slot
        steps = STEPS + beyond
        body = computed_once(bodies(state, slot))
        road = computed_once(road_ahead(lane_map, state, slot, body, strict))
        moments = max(steps, STEPS + round(TTC[-1] / DT)) + 1
        predict, first = self.predict or constant_velocity, None
        if self.rules:
            first = way(config, self.traffic, lane_map, state, slot)
            road = first.stopping(road, body)
            predict = self.predict or along_route
        others = others_around(
            lane_map, state, slot, predict, self.seen, moments, None if first is None else first.stop
        )
        others = computed_once(others)
        along = leaders(road, body, others, steps)
        along = computed_once(along if first is None else along_with(along, first, road, body))
        proposals = computed_once(idm(road, body, along, strict))
        lead = computed_once(poses(road, body, proposals, strict))
        motion = computed_once(drive_along(fitted(lead) if strict else lead, body, STEPS, strict))
        scores = score(road, body, others, proposals, motion, strict)
        # the first of equally good proposals: the middle of the lane, and the slower driver
        slack = 0.0 if strict else _AS_GOOD
        best = jnp.argmax(scores.total >= jnp.max(scores.total, -1, keepdims=True) - slack, -1)
        pick = lambda values: jnp.take_along_axis(values, best[:, None, None], 1)[:, 0]  # noqa: E731
        x, y, heading, v = (pick(values) for values in motion[:4])
        path = (best // len(FRACTIONS))[:, None]
        leads, offset = (jnp.take_along_axis(x, path, 1)[:, 0] for x in (road.worth > 0, road.offset))
        brakes = jnp.take_along_axis(scores.contact, best[:, None], 1)[:, 0] <= EMERGENCY_TIME
        if strict:
            brakes &= body.v <= EMERGENCY_SPEED
            stop = _stop_straight(body)
        else:
            stop = _stop_along(body, x, y, heading)
        now = config.time(state.step)
        halt = brakes[:, None]
        driven = tuple(jnp.where(halt, a, b) for a, b in zip(stop, (x, y, heading, v), strict=True))
        rest = (pick(values)[:, STEPS + 1 :] for values in lead[:4])
        rest = tuple(jnp.where(halt, a[:, -1:], b) for a, b in zip(driven, rest, strict=True))
        return Plan(
            trajectory=_centred(body, driven, now),
            best=best,
            signal=jnp.where(leads, jnp.sign(offset - road.d), 0).astype(jnp.int32),
            brakes=brakes,
            scores=scores,
            tail=_centred(body, rest, now + (STEPS + 1) * DT),
        )


def _centred(body: Body, poses: tuple[Array, ...], t0: Array) -> Trajectory:
    """Poses of the rear axle as a trajectory of the centre."""
    x, y, heading, v = poses
    axle = body.wheelbase[:, None] / 2
    return Trajectory(
        x=x + axle * jnp.cos(heading), y=y + axle * jnp.sin(heading), heading=heading, v=v, t0=t0, dt=DT
    )


def _stop_along(body: Body, x: Array, y: Array, heading: Array) -> tuple[Array, ...]:
    """Poses on the same path, braked with `EMERGENCY_BRAKING` to a standstill."""
    t, v0 = DT * jnp.arange(STEPS + 1, dtype=x.dtype)[None], body.v[:, None]
    braking = jnp.minimum(t, v0 / EMERGENCY_BRAKING)
    distance = v0 * braking - EMERGENCY_BRAKING * braking * braking / 2
    steps = safe_norm(jnp.stack([jnp.diff(x), jnp.diff(y)]), 0)
    done = jnp.pad(jnp.cumsum(steps, -1), ((0, 0), (1, 0)))
    x, y, heading = (jax.vmap(jnp.interp)(distance, done, values) for values in (x, y, heading))
    return x, y, heading, v0 - EMERGENCY_BRAKING * braking


def _stop_straight(body: Body) -> tuple[Array, ...]:
    """Straight poses of the rear axle, at a speed for nuPlan's tracker."""
    t, v0 = DT * jnp.arange(STEPS + 1, dtype=body.v.dtype)[None], body.v[:, None]
    u = jnp.where(v0 > STOPPING_SPEED, -10 * v0, -4 * v0 - body.a[:, None])
    low, high = COMFORT["acceleration"]
    speed = 1.1 * (v0 + jnp.clip(u, low, high))
    heading = jnp.broadcast_to(body.heading[:, None], (*body.v.shape, STEPS + 1))
    distance = speed * t
    return (
        body.x[:, None] + distance * jnp.cos(heading),
        body.y[:, None] + distance * jnp.sin(heading),
        heading,
        jnp.where(t > 0, speed, v0),
    )
