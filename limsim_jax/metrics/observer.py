"""From the engine to the metrics: `EvaluateEgo` shows the first ego and the traffic to their metrics.

A `StepRecord` is what a physics step leaves behind; after every decision its records go through the metrics.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.conflicts import ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose, width
from limsim_jax.maps.signals import SignalState, lane_states
from limsim_jax.metrics.ego import EgoCarry, EgoMetrics
from limsim_jax.metrics.reductions import Measured
from limsim_jax.metrics.safety import NO_GAP, Rss, Zones
from limsim_jax.metrics.step import EgoStep
from limsim_jax.metrics.traffic import Detectors, TrafficCarry, TrafficMetrics, TrafficStep
from limsim_jax.traffic.collision import CLEARANCE, level, off_road
from limsim_jax.traffic.ego import arrived, body_place
from limsim_jax.traffic.engine import Tick
from limsim_jax.traffic.motion import boxes, tails
from limsim_jax.traffic.neighbors import other_lane
from limsim_jax.types import Config, State, Status

AT_RED = 15.0
"""m before a red light within which who stands waits for it."""

_STANDS = 0.5  # m/s
_ON_LINE = 0.5  # m beyond the stop line from which who starts does not cross it


class StepRecord(NamedTuple):
    """A world after a physics step: `N` slots, `Z` conflict zones near the ego."""

    ego: EgoStep
    traffic: TrafficStep
    other: Int[Array, " N"]  # the second lane of who changes lanes
    way: Int[Array, "N D"]  # lanes to come
    stopped: Bool[Array, ""]  # the ego has stopped at the stop sign ahead


class MetricState(NamedTuple):
    """State of `EvaluateEgo`."""

    ego: EgoCarry
    traffic: TrafficCarry
    goal: Int[Array, ""]  # of the ego at the start: another one is no arrival
    lane: Int[Array, ""]  # of the ego, a step ago
    stopped: Bool[Array, ""]  # at the stop sign at its end
    to_go: Float[Array, ""]  # m, when the goal could last be reached


@dataclass(frozen=True)
class EvaluateEgo:
    """Metrics of the first ego and of the traffic, for `Rollout.measure`.

    Attributes:
      rss: parameters of RSS.
    """

    rss: Rss = field(default_factory=Rss)

    def _metrics(self, config: Config) -> tuple[EgoMetrics, TrafficMetrics]:
        return EgoMetrics(config.dt, self.rss), TrafficMetrics(config.dt)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> MetricState:
        """Everything as it is at the start."""
        ego, traffic = self._metrics(config)
        slots, slot = state.lane.shape[0], state.egos.slot[0]
        nothing = jnp.zeros(slots, jnp.float32)
        nobody = state.active & False
        first = _record(lane_map, state, nobody, nobody, jnp.zeros((), jnp.float32), nothing)
        carry = MetricState(
            ego=ego.init(slots, first.ego.zones.id.shape[0]),
            traffic=traffic.init(slots, 0),
            goal=state.goal[slot],
            lane=state.lane[slot],
            stopped=jnp.zeros((), bool),
            to_go=jnp.float32(0),
        )
        return self._step(config, lane_map, carry, first, jnp.ones(slots, bool))

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> StepRecord:
        """What the metrics need to know of a physics step."""
        off = tick.off_road
        if off is None:
            off = off_road(lane_map, tick.state, boxes(lane_map, tick.state))
        record = _record(lane_map, tick.state, tick.left, off, tick.time, tick.dx)
        slot = tick.state.egos.slot[0]
        other, gap = (x[slot, 0] for x in tick.decision.obstacles)
        gap = gap + tick.x[other] - tick.x[slot]
        ahead = (other >= 0) & tick.state.active[other]
        ego = record.ego._replace(
            lead=jnp.where(ahead, other, -1), lead_gap=jnp.where(ahead, jnp.maximum(gap, 0), NO_GAP)
        )
        return record._replace(
            ego=ego, traffic=record.traffic._replace(v_free=tick.decision.v0), way=tick.decision.lanes
        )

    def update(
        self, config: Config, lane_map: LaneMap, carry: MetricState, records: StepRecord
    ) -> MetricState:
        """Pass the records since the last decision through the metrics."""
        relevant = _meets_ego(lane_map, records.ego.slot[0], records.way[0], records.other.max(0))

        def step(carry: MetricState, record: StepRecord) -> tuple[MetricState, None]:
            return self._step(config, lane_map, carry, record, relevant), None

        return lax.scan(step, carry, records)[0]

    def _step(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: MetricState,
        record: StepRecord,
        relevant: Bool[Array, " N"],
    ) -> MetricState:
        ego, traffic = self._metrics(config)
        seen, slot = record.ego, record.ego.slot
        lane, s = record.traffic.lane[slot], record.traffic.s[slot]
        routes = lane_map.routes
        # who leaves the map is on no lane any more
        leaves = record.traffic.left[slot] & routes.is_goal[carry.lane, carry.goal]
        on_route = routes.reachable[lane, carry.goal]
        reached = seen.arrived & routes.is_goal[lane, carry.goal]
        to_go = jnp.where(on_route, routes.distance[lane, carry.goal] - s, carry.to_go)
        to_go = jnp.where(leaves | reached, 0, to_go)
        seen = seen._replace(
            relevant=relevant,
            to_go=to_go,
            on_route=on_route,
            arrived=leaves | reached,
            stop_sign=seen.stop_sign & ~carry.stopped,
        )
        handed_over = record.traffic.s <= record.traffic.dx
        changed = record.traffic.active & carry.traffic.active & (record.traffic.lane != carry.traffic.lane)
        none = Detectors(jnp.zeros(0, jnp.int32), jnp.zeros(0, jnp.float32))
        flow = record.traffic._replace(changed=changed & ~handed_over)
        return MetricState(
            ego=ego.update(carry.ego, seen),
            traffic=traffic.update(carry.traffic, none, flow),
            goal=carry.goal,
            lane=jnp.where(lane == NO_LANE, carry.lane, lane),
            stopped=((lane == carry.lane) & carry.stopped) | record.stopped,
            to_go=to_go,
        )

    def result(self, config: Config, lane_map: LaneMap, carry: MetricState) -> dict[str, Measured]:
        """All of `episode.NAMES`, and of the traffic with `traffic_` in front."""
        ego, traffic = self._metrics(config)
        length = jnp.sum(jnp.where(lane_map.valid, lane_map.length, 0))
        flow = traffic.result(carry.traffic, length)
        return ego.result(carry.ego) | {f"traffic_{name}": value for name, value in flow.items()}


def _record(
    lane_map: LaneMap,
    state: State,
    left: Bool[Array, " N"],
    off: Bool[Array, " N"],
    t: Float[Array, ""],
    dx: Float[Array, " N"],
) -> StepRecord:
    """All that needs no memory; who leads the ego, and where it wants to go, is filled in later."""
    slot = state.egos.slot[0]
    box = boxes(lane_map, state)
    z = level(lane_map, state)
    seen = state.active & (jnp.abs(z - z[slot]) < CLEARANCE)  # who is on a bridge is out of reach
    lane, s, v = state.lane[slot], state.s[slot], state.v[slot]
    routes, table = lane_map.routes, lane_map.conflicts
    shows = lane_states(lane_map.signals, state.lights.phase)
    red = shows == SignalState.RED

    # the lane that was entered in this step, and how the one before was left
    entered = state.active & (state.previous != NO_LANE) & (state.s <= dx) & (dx > 0)
    before_line = state.s - dx + lane_map.length[state.previous]
    before_line = before_line <= lane_map.stop_s[state.previous] + _ON_LINE
    signed = table.must_stop[table.connector[lane]]

    # lights: who drives in the junction after crossing on red has no right to
    ran = ((state.status & int(Status.RED_LIGHT)) != 0) & (lane_map.junction[state.lane] >= 0)
    wrong = (state.status & int(Status.WRONG_WAY)) != 0
    following = routes.next_lane[lane, state.goal[slot]]
    waits = red[following] & (v < _STANDS) & (lane_map.stop_s[lane] - s < AT_RED)

    # the road at the ego
    at, at_s = body_place(lane_map, lane, state.previous[slot], s, state.shape.length[slot])
    heading = pose(lane_map, at, at_s)[2]
    half = width(lane_map, state.lane, state.s) / 2
    straddles = jnp.abs(state.d) + state.shape.width / 2 > half
    sides = [lane, lane_map.left[lane], lane_map.right[lane]]
    sides += [lane_map.left[sides[1]], lane_map.right[sides[2]], following]
    near = (state.lane[:, None] == jnp.stack(sides)[None]) & (state.lane != NO_LANE)[:, None]
    near = near.any(-1) & seen & (jnp.arange(state.lane.shape[0]) != slot)
    count = jnp.sum(near, dtype=state.v.dtype)
    direction = jnp.stack([jnp.cos(box[:, 2]), jnp.sin(box[:, 2])], -1)
    at_goal = arrived(lane_map, state)[0]

    ego = EgoStep(
        t=t,
        box=box,
        velocity=state.v[:, None] * direction,
        active=seen,
        b_max=state.driver.b_max,
        relevant=seen,
        changing=(state.side != 0) | straddles | off,
        violation=ran | wrong,
        slot=slot,
        v=v,
        a=state.a[slot],
        rear_axle=state.shape.wheelbase[slot] / 2,
        lead=jnp.int32(-1),
        lead_gap=jnp.float32(NO_GAP),
        lane_heading=heading,
        on_lane=lane != NO_LANE,
        speed_limit=lane_map.speed_limit[lane],
        to_go=jnp.float32(0),
        on_route=lane != NO_LANE,
        arrived=at_goal,
        off_road=off[slot],
        in_junction=lane_map.junction[at] >= 0,
        red_light=entered[slot] & red[lane] & before_line[slot],
        stop_sign=entered[slot] & signed,
        waits_at_red=waits,
        v_others=jnp.sum(jnp.where(near, state.v, 0)) / jnp.maximum(count, 1),
        others=count > 0,
        zones=_zones(lane_map, state, slot, following),
    )
    return StepRecord(
        ego=ego,
        traffic=TrafficStep(
            t=t,
            active=state.active,
            lane=state.lane,
            s=state.s,
            dx=dx,
            v=state.v,
            v_free=state.driver.v_max,
            inside=jnp.ones_like(left),
            changed=jnp.zeros_like(left),
            left=left,
            entered=state.entered,
        ),
        other=other_lane(lane_map, state)[0],
        way=state.lane[:, None],
        stopped=state.stopped[slot],
    )


def _zones(lane_map: LaneMap, state: State, slot: Int[Array, ""], following: Int[Array, ""]) -> Zones:
    """Conflict zones on the lane of the ego, the one before and the next one, and who is in them."""
    table = lane_map.conflicts
    if table.foe.shape[1] == 0:  # a map where paths never meet
        nowhere = jnp.zeros(1, bool)
        return Zones(jnp.full(1, -1, jnp.int32), nowhere, nowhere)
    ego = jnp.stack([state.previous[slot], state.lane[slot], following])
    end = lane_map.length[ego]
    front = jnp.stack([state.s[slot] + end[0], state.s[slot], jnp.float32(-1)])  # m along each of the three
    row = table.connector[ego]  # the null row where there is none: stretches that are absent hold nobody
    foe = jnp.where(table.type[row] == ConflictType.SWEEP, -1, table.foe[row])  # paths that keep apart
    count = foe.shape[1]
    zone = jnp.where(foe >= 0, row[:, None] * count + jnp.arange(count)[None], -1)

    def inside(front: Array, length: Array, begin: Array, end: Array) -> Array:
        return (front > begin) & (front - length < end)

    mine = inside(front[:, None], state.shape.length[slot], table.s_in[row], table.s_out[row])
    others = state.active & (jnp.arange(state.lane.shape[0]) != slot)
    behind, along = tails(lane_map, state)
    lane, begin, end = (
        x[..., None] for x in (table.lane[foe], table.f_in[row], table.f_out[row])
    )  # [3, C, 1]
    theirs = jnp.zeros((), bool)
    for at, front in ((state.lane, state.s), *zip(behind.T, along.T, strict=True)):
        at, front, length = (x[None, None] for x in (at, front, state.shape.length))
        theirs |= (lane == at) & inside(front, length, begin, end)
    theirs = (theirs & others[None, None]).any(-1)
    there = zone >= 0
    return Zones(zone.ravel(), (mine & there).ravel(), (theirs & there).ravel())


def _meets_ego(
    lane_map: LaneMap, slot: Int[Array, ""], way: Int[Array, "N D"], other: Int[Array, " N"]
) -> Bool[Array, " N"]:
    """Whose lanes to come are those of the ego, or cross or join them: all others keep apart from it."""
    table = lane_map.conflicts
    lanes = jnp.concatenate([way, other[:, None]], -1)
    mine = lanes[slot]
    foes = table.lane[table.foe[table.connector[mine]]].ravel()  # NO_LANE where there is none
    ours = jnp.concatenate([mine, foes])
    meets = (lanes[..., None] == ours[None, None]) & (ours != NO_LANE)[None, None]
    return meets.any((-1, -2))
