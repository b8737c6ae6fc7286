"""Metrics of a rollout: `EvaluateEgo` for one ego, `EvaluateEgos`, `EvaluateTraffic`.

A `StepRecord` is what a physics step leaves behind. After every decision its records go through the metrics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.metrics.catalog import DERIVED, EGO, TRAFFIC
from limsim_jax.metrics.course import Aside, Course, OnLanes, aside, comes_near, course
from limsim_jax.metrics.description import Description
from limsim_jax.metrics.ego import EgoCarry, EgoMetrics
from limsim_jax.metrics.measure import Metric, Own, check_names
from limsim_jax.metrics.record import (
    Snapshot,
    after,
    at_start,
    ego_step,
    meets_ego,
    traffic_step,
    with_leader,
)
from limsim_jax.metrics.reductions import Measured
from limsim_jax.metrics.safety import NONE, Rss
from limsim_jax.metrics.step import EgoStep
from limsim_jax.metrics.traffic import Detectors, TrafficCarry, TrafficMetrics, TrafficStep
from limsim_jax.traffic.engine import Tick
from limsim_jax.traffic.neighbors import lanes_ahead, other_lane
from limsim_jax.types import Config, State
from limsim_jax.xla import row

_COMMON = ("t", "box", "velocity", "b_max", "changing", "violation", "state")
_PER_EGO: Any = EgoStep._make(None if name in _COMMON else 0 for name in EgoStep._fields)
"""Axes of an `EgoStep` of several egos: what is the same for all of them has none."""

_KEYS = ("scenario", "policy", "seed", "ego", "digest")
_TAKEN = (*_KEYS, *(column.name for column in (*EGO, *DERIVED)))


class StepRecord(NamedTuple):
    """A world after a physics step: `N` slots. Of several egos, `ego` and `stopped` have an axis more."""

    ego: EgoStep
    traffic: TrafficStep
    other: Int[Array, " N"]  # the second lane of a vehicle that changes lanes
    way: Int[Array, "N D"]  # lanes to come
    aside: Aside
    stopped: Bool[Array, "*e"]  # the ego has stopped at the stop sign ahead
    goal: Int[Array, "*e"]  # of the ego now


class EgoState(NamedTuple):
    """Metrics of an ego, and what is known from its earlier steps."""

    metrics: EgoCarry
    goal: Int[Array, "*e"]  # at the start: another one is no arrival
    lane: Int[Array, "*e"]  # a step ago
    stopped: Bool[Array, "*e"]  # at the stop sign at its end
    to_go: Float[Array, "*e"]  # m, when the goal could last be reached


class MetricState(NamedTuple):
    """State of `EvaluateEgo`."""

    ego: EgoState
    traffic: TrafficCarry


@dataclass(frozen=True, kw_only=True)
class EvaluateEgo:
    """Metrics of one ego and of the traffic, for `Rollout.measure`. Results are scalars.

    Attributes:
      rss: parameters of RSS.
      ego: row of `State.egos`.
      metrics: metrics of one's own, besides the built-in ones.

    Raises:
      ValueError: own metrics whose names clash or that are none; a row that is negative.
    """

    rss: Rss = field(default_factory=Rss)
    ego: int = 0
    metrics: tuple[Metric, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "metrics", tuple(self.metrics))
        check_names(self.metrics, _TAKEN)
        if self.ego < 0:
            raise ValueError(f"ego is {self.ego}; a row of State.egos is expected, from 0")

    @property
    def descriptions(self) -> tuple[Description, ...]:
        """All columns of `result`, in order: of the ego, of the traffic, then one's own."""
        return (*EGO, *TRAFFIC, *(metric.description for metric in self.metrics))

    @property
    def units(self) -> dict[str, str]:
        """Unit and meaning of every column."""
        return {column.name: column.meaning for column in self.descriptions}

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[MetricState, StepRecord]:
        """Nothing measured yet, and the record of the start.

        Raises:
          ValueError: a world without this ego; an own metric whose memory changes or whose result is no
            scalar.
        """
        rows = state.egos.slot.shape[0]
        if self._last >= rows:
            raise ValueError(f"ego {self._last} is measured, but the world has {rows} egos")
        first = self._record(lane_map, at_start(config, lane_map, state))
        later = jnp.full((state.lane.shape[0], lanes_ahead(config, lane_map)), NO_LANE)
        first = first._replace(way=jnp.concatenate([first.way, later], 1))

        def begin(step: EgoStep, goal: Int[Array, ""]) -> EgoState:
            return EgoState(
                metrics=self._begin(config, lane_map, step),
                goal=goal,
                lane=state.lane[step.slot],
                stopped=jnp.zeros((), bool),
                to_go=jnp.float32(0),
            )

        _, traffic = self._metrics(config)
        ego = self._each(begin, (_PER_EGO, 0))(first.ego, first.goal)
        return MetricState(ego, traffic.init(state.lane.shape[0], 0)), first

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> StepRecord:
        """What the metrics need to know of a physics step."""
        record = self._record(lane_map, after(lane_map, tick))
        lead = self._each(lambda step: with_leader(step, tick), (_PER_EGO,), _PER_EGO)
        return record._replace(
            ego=lead(record.ego),
            traffic=record.traffic._replace(v_free=tick.decision.v0),
            way=tick.decision.lanes,
        )

    def update(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: MetricState,
        records: StepRecord,
        *,
        start: bool | Bool[Array, ""] = False,
    ) -> MetricState:
        """Add the records of a decision, `[decision_every, ...]`, or of the start."""
        relevant = self._each(lambda slot: paths(lane_map, slot, records, start), (0,))(records.ego.slot[0])
        _, traffic = self._metrics(config)

        def one(carry: MetricState, record: StepRecord) -> MetricState:
            each = self._each(partial(self._advance, config, lane_map), (0, _PER_EGO, 0, 0, None, 0))
            ego = each(carry.ego, record.ego, record.stopped, record.goal, record.traffic, relevant)
            return MetricState(ego, _flow(traffic, carry.traffic, record.traffic))

        return over_steps(one, carry, records, start)

    def result(self, config: Config, lane_map: LaneMap, carry: MetricState) -> dict[str, Measured]:
        """All columns of `units`."""
        ego, traffic = self._metrics(config)
        flow = _flow_result(traffic, lane_map, carry.traffic)
        return self._each(ego.result, (0,))(carry.ego.metrics) | flow

    # --- one ego; `EvaluateEgos` maps these over several

    @property
    def _last(self) -> int:
        return self.ego

    @property
    def _rows(self) -> int | Int[Array, " E"]:
        return self.ego

    def _each(self, f: Callable[..., Any], in_axes: Any, out_axes: Any = 0) -> Callable[..., Any]:
        return f

    def _metrics(self, config: Config) -> tuple[EgoMetrics, TrafficMetrics]:
        return EgoMetrics(config.dt, self.rss, self.metrics), TrafficMetrics(config.dt)

    def _record(self, lane_map: LaneMap, snapshot: Snapshot) -> StepRecord:
        state, keep = snapshot.state, bool(self.metrics)

        def one(row: int | Int[Array, ""]) -> tuple[EgoStep, Bool[Array, ""], Int[Array, ""]]:
            step = ego_step(lane_map, snapshot, row, keep_state=keep)
            return step, state.stopped[step.slot], state.goal[step.slot]

        step, stopped, goal = self._each(one, (0,), (_PER_EGO, 0, 0))(self._rows)
        return StepRecord(
            ego=step,
            traffic=traffic_step(state, snapshot.left, snapshot.time, snapshot.dx),
            other=other_lane(lane_map, state)[0],
            way=state.lane[:, None],
            aside=aside(lane_map, state),
            stopped=stopped,
            goal=goal,
        )

    def _begin(self, config: Config, lane_map: LaneMap, step: EgoStep) -> EgoCarry:
        ego, _ = self._metrics(config)
        carry = ego.init(step.active.shape[0], step.zones.id.shape[0])
        for metric in self.metrics:
            Own(metric).check(ego.view(carry, step, lane_map))
        return carry

    def _advance(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: EgoState,
        step: EgoStep,
        stopped: Bool[Array, ""],
        goal: Int[Array, ""],
        flow: TrafficStep,
        relevant: tuple[Bool[Array, " N"], Course],
    ) -> EgoState:
        """One step of one ego: its route and arrival, then its metrics."""
        ego, _ = self._metrics(config)
        routes, slot = lane_map.routes, step.slot
        lane, s = flow.lane[slot], flow.s[slot]
        # an ego that leaves is on no lane any more
        leaves = flow.left[slot] & ((goal == carry.goal) | routes.is_goal[carry.lane, carry.goal])
        on_route = routes.reachable[lane, carry.goal]
        reached = step.arrived & routes.is_goal[lane, carry.goal]
        to_go = jnp.where(on_route, routes.distance[lane, carry.goal] - s, carry.to_go)
        to_go = jnp.where(leaves | reached, 0, to_go)
        meets, how = relevant
        step = step._replace(
            relevant=meets,
            meets=how.meets,
            follows=how.follows,
            leads=how.leads,
            to_go=to_go,
            on_route=on_route,
            arrived=leaves | reached,
            stop_sign=step.stop_sign & ~carry.stopped,
        )
        return EgoState(
            metrics=ego.update(carry.metrics, step, lane_map),
            goal=carry.goal,
            lane=jnp.where(lane == NO_LANE, carry.lane, lane),
            stopped=((lane == carry.lane) & carry.stopped) | stopped,
            to_go=to_go,
        )


@dataclass(frozen=True)
class EvaluateEgos(EvaluateEgo):
    """Metrics of the first egos, `E` of them, and of the traffic. Every result is `[E]`.

    The metrics of the traffic are computed once, and repeated in the results.

    Attributes:
      count: E, at least 1. `ego` does not count.
    """

    count: int

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count < 1:
            raise ValueError(f"count is {self.count}; at least 1 ego is expected")

    def result(self, config: Config, lane_map: LaneMap, carry: MetricState) -> dict[str, Measured]:
        """All columns of `units`, `[E]`."""
        found = super().result(config, lane_map, carry)
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (self.count,)), found)

    @property
    def _last(self) -> int:
        return self.count - 1

    @property
    def _rows(self) -> int | Int[Array, " E"]:
        return 0 if self.count == 1 else jnp.arange(self.count)

    def _each(self, f: Callable[..., Any], in_axes: Any, out_axes: Any = 0) -> Callable[..., Any]:
        return f if self.count == 1 else jax.vmap(f, in_axes, out_axes)


@dataclass(frozen=True)
class EvaluateTraffic:
    """Metrics of the traffic alone, for `Rollout.measure`, also of worlds without egos."""

    @property
    def descriptions(self) -> tuple[Description, ...]:
        """All columns of `result`, in order."""
        return TRAFFIC

    @property
    def units(self) -> dict[str, str]:
        """Unit and meaning of every column."""
        return {column.name: column.meaning for column in self.descriptions}

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[TrafficCarry, TrafficStep]:
        """Nothing measured yet, and the record of the start."""
        still = jnp.zeros_like(state.s)
        first = traffic_step(state, still > 0, config.time(state.step), still)
        return TrafficMetrics(config.dt).init(state.lane.shape[0], 0), first

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> TrafficStep:
        """What the metrics need to know of a physics step."""
        step = traffic_step(tick.state, tick.left, tick.time, tick.dx)
        return step._replace(v_free=tick.decision.v0)

    def update(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: TrafficCarry,
        records: TrafficStep,
        *,
        start: bool | Bool[Array, ""] = False,
    ) -> TrafficCarry:
        """Add the records of a decision, `[decision_every, ...]`, or of the start."""
        return over_steps(partial(_flow, TrafficMetrics(config.dt)), carry, records, start)

    def result(self, config: Config, lane_map: LaneMap, carry: TrafficCarry) -> dict[str, Measured]:
        """All columns of `units`."""
        return _flow_result(TrafficMetrics(config.dt), lane_map, carry)


def over_steps(
    one: Callable[[Any, Any], Any], carry: Any, records: Any, start: bool | Bool[Array, ""]
) -> Any:
    """The carry after one record and the next; at the start after the last one alone."""
    count = jax.tree.leaves(records)[0].shape[0]
    if isinstance(start, bool):
        some = jax.tree.map(lambda x: x[-1:], records) if start else records
        return lax.scan(lambda carry, record: (one(carry, record), None), carry, some)[0]
    first = jnp.where(start, count - 1, 0)
    return lax.fori_loop(first, count, lambda i, carry: one(carry, row(records, i)), carry)


def paths(
    lane_map: LaneMap,
    slot: Int[Array, ""],
    records: StepRecord,
    start: bool | Bool[Array, ""] = False,
) -> tuple[Bool[Array, " N"], Course]:
    """Of the records since a decision: paths that may meet that of the ego in `slot`, and when they do.

    Times of meeting are in s since the start of the world. Of vehicles that come nowhere near on straight
    lines, or keep to other lanes, they are not known, and do not count. At the start no paths are known, and
    all may meet.
    """
    flow, way = records.traffic, records.way[0]
    now = jax.tree.map(lambda x: x[0], records.aside)
    vehicles = OnLanes(way, flow.lane[0], flow.s[0], flow.v[0], records.ego.box[0], now, records.other[0])
    relevant = meets_ego(lane_map, slot, way, records.other.max(0))
    near = jax.vmap(comes_near, (None, 0, 0))(slot, records.ego.box, records.ego.velocity).any(0)
    changes = records.ego.changing[:, slot].any()
    found = course(lane_map, slot, vehicles, near & (relevant | changes) & ~jnp.asarray(start))
    return relevant | start, Course(
        meets=jnp.where(start, NONE, found.meets + flow.t[0]),
        follows=found.follows & ~jnp.asarray(start),
        leads=found.leads & ~jnp.asarray(start),
    )


def _flow(metrics: TrafficMetrics, carry: TrafficCarry, step: TrafficStep) -> TrafficCarry:
    """One step of the traffic: which vehicles have changed lanes, then the metrics."""
    handed_over = step.s <= step.dx
    changed = step.active & carry.active & (step.lane != carry.lane)
    none = Detectors(jnp.zeros(0, jnp.int32), jnp.zeros(0, jnp.float32))
    return metrics.update(carry, none, step._replace(changed=changed & ~handed_over))


def _flow_result(metrics: TrafficMetrics, lane_map: LaneMap, carry: TrafficCarry) -> dict[str, Measured]:
    length = jnp.sum(jnp.where(lane_map.valid, lane_map.length, 0))
    return {f"traffic_{name}": value for name, value in metrics.result(carry, length).items()}
