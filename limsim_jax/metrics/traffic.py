"""Traffic flow: Edie's definitions, virtual detectors, delay, queues, lane changes, travel times.

- Over a region of lanes with `length` m in all and a time T (Edie 1963): flow = distance travelled /
  (length T), density = time spent / (length T), mean speed = distance travelled / time spent, so that
  flow = density x speed holds exactly.
- A detector at (lane, s) counts front bumpers that pass it, at times interpolated within the step. Flow is
  count / time; the harmonic mean of the speeds estimates the mean speed in space (Wardrop 1952); density
  is their quotient. One value per detector and interval is a point of the fundamental diagram.
- Saturation flow (HCM 2010, chapter 31): the reciprocal of the mean headway of discharging queues from
  the fifth vehicle on. A queue is what passes without a headway above `QUEUE_BREAK`.
- Delay: time spent less the time that the same distance takes at free speed (the limit, or what the
  vehicle wants if that is less). Queue: vehicles slower than `QUEUE_SPEED`.

Units: m, s, m/s; flows are per hour and densities per kilometre where the name says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.metrics.description import Better, Description, Headline, Plot
from limsim_jax.metrics.reductions import Least, Mean, Measured, measured
from limsim_jax.numerics import safe_divide, safe_sqrt

QUEUE_SPEED = 5 / 3.6
"""m/s, below which a vehicle counts as queued (5 km/h)."""

QUEUE_BREAK = 5.0
"""s: a longer headway at a detector ends the discharge of a queue."""

QUEUE_FIRST = 5
"""The first vehicle of a queue whose headway counts for the saturation flow."""

HEADWAY_BINS = 24
HEADWAY_BIN = 0.5
"""s, width of the bins of the headway histogram; the last bin takes all that is longer."""


def _column(
    name: str,
    meaning: str,
    better: Better,
    formula: str,
    missing: str = "",
    *,
    source: str = "",
    plot: Plot | None = None,
    headline: Headline | None = None,
) -> Description:
    name = f"traffic_{name}"
    return Description(
        name,
        meaning,
        "Traffic",
        better,
        formula=formula,
        source=source,
        missing=missing,
        plot=plot,
        headline=headline,
    )


_EDIE = "Edie 1963"
_STOOD = "No vehicle moved."
_NO_TRIP = "No vehicle reached its goal."

DESCRIPTIONS = (
    _column(
        "mean_speed", "m/s, distance travelled by time spent", "higher", "Distance travelled / time spent.",
        "No vehicle was there.", source=_EDIE, plot=Plot("Mean speed of the traffic", "m/s"),
        headline=Headline(16, "mean speed", unit="m/s", plain=True),
    ),
    _column(
        "flow_per_hour", "vehicles per hour and lane", "higher",
        "Distance travelled / (length of all lanes x time), per hour.", source=_EDIE,
        headline=Headline(17, "flow per lane", unit="vehicles/h", plain=True),
    ),
    _column(
        "density_per_km", "vehicles per km of lane", "neither",
        "Time spent / (length of all lanes x time), per km.", source=_EDIE,
        headline=Headline(18, "density per lane", unit="vehicles/km", plain=True),
    ),
    _column("vehicle_km", "km driven by all", "neither", "Distance travelled by all vehicles, in km."),
    _column(
        "delay_per_km", "s lost to others per km", "lower",
        "Time spent less that of the same distance at free speed, per km; free speed is the lesser of limit "
        "and desired speed.",
        _STOOD, headline=Headline(19, "delay", unit="s/km", plain=True),
    ),
    _column(
        "delay_share", "share of the time lost to others", "lower", "That delay / time spent.",
        "No vehicle was there.",
    ),
    _column(
        "mean_queue", "vehicles slower than 5 km/h", "lower",
        "Mean number of vehicles below 5 km/h, over steps."
    ),
    _column("max_queue", "most of them at once", "lower", "Greatest number of vehicles below 5 km/h in a "
    "step."),
    _column(
        "lane_changes_per_km", "lane changes per km driven", "lower", "Lane changes / km driven by all.",
        _STOOD
    ),
    _column("trips", "vehicles that reached their goals", "neither", "Vehicles that left at their goals."),
    _column(
        "mean_travel_time", "s, of those", "lower", "Mean time from entering to leaving, of trips.", _NO_TRIP,
        headline=Headline(20, "travel time of a trip", unit="s", plain=True),
    ),
    _column(
        "sd_travel_time", "s, standard deviation", "neither",
        "Standard deviation of the travel times of trips.",
        _NO_TRIP,
    ),
)  # fmt: skip
"""The columns, in order."""

NAMES = {column.name.removeprefix("traffic_"): column.meaning for column in DESCRIPTIONS}
"""What `TrafficMetrics.result` measures."""


class TrafficStep(NamedTuple):
    """The traffic after a step, in `N` slots."""

    t: Float[Array, ""]  # s
    active: Bool[Array, " N"]
    lane: Int[Array, " N"]
    s: Float[Array, " N"]  # m, front bumper
    dx: Float[Array, " N"]  # m travelled in this step, also by vehicles that left in it
    v: Float[Array, " N"]  # m/s
    v_free: Float[Array, " N"]  # m/s, speed without others
    inside: Bool[Array, " N"]  # in the region that is measured; of a vehicle that left: before
    changed: Bool[Array, " N"]  # crossed into the lane beside in this step
    left: Bool[Array, " N"]  # left the map at its goal in this step
    entered: Float[Array, " N"]  # s, when it entered


class Detectors(NamedTuple):
    """Where the detectors are."""

    lane: Int[Array, " D"]
    s: Float[Array, " D"]  # m


class TrafficCarry(NamedTuple):
    """State of `TrafficMetrics.update`; `D` detectors, `I` intervals."""

    started: Bool[Array, ""]
    start: Float[Array, ""]  # s
    now: Float[Array, ""]
    active: Bool[Array, " N"]  # of the step before
    lane: Int[Array, " N"]
    s: Float[Array, " N"]
    distance: Float[Array, ""]  # m, within the region
    time: Float[Array, ""]  # s, within the region
    delay: Float[Array, ""]  # s, within the region
    queue: Mean  # vehicles
    longest: Least  # of the negative
    changes: Int[Array, ""]
    trips: Mean  # s
    square_trips: Float[Array, ""]
    passages: Int[Array, "D I"]
    sum_speed: Float[Array, "D I"]
    sum_slowness: Float[Array, "D I"]  # s/m
    last_crossing: Float[Array, " D"]  # s
    seen: Bool[Array, " D"]
    in_queue: Int[Array, " D"]  # place of the last one in its queue
    headways: Int[Array, "D H"]
    discharge: Mean  # [D], s, headways of queues


@dataclass(frozen=True)
class TrafficMetrics:
    """Metrics of the flow in one world.

    Attributes:
        dt: s, time step.
        interval: s, over which detectors aggregate.
        intervals: How many of them; what comes later is counted in the last.
    """

    dt: float
    interval: float = 60.0
    intervals: int = 1

    def init(self, vehicles: int, detectors: int) -> TrafficCarry:
        """Before the first step."""
        zero, none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        table = jnp.zeros((detectors, self.intervals))
        return TrafficCarry(
            started=jnp.zeros((), bool),
            start=zero,
            now=zero,
            active=jnp.zeros(vehicles, bool),
            lane=jnp.full(vehicles, -1, jnp.int32),
            s=jnp.zeros(vehicles),
            distance=zero,
            time=zero,
            delay=zero,
            queue=Mean.empty(),
            longest=Least.empty(),
            changes=none,
            trips=Mean.empty(),
            square_trips=zero,
            passages=table.astype(jnp.int32),
            sum_speed=table,
            sum_slowness=table,
            last_crossing=jnp.zeros(detectors),
            seen=jnp.zeros(detectors, bool),
            in_queue=jnp.zeros(detectors, jnp.int32),
            headways=jnp.zeros((detectors, HEADWAY_BINS), jnp.int32),
            discharge=Mean.empty(detectors),
        )

    def update(self, carry: TrafficCarry, detectors: Detectors, step: TrafficStep) -> TrafficCarry:
        """One step; the first call sets the start."""
        counts = carry.started
        there = (step.active | step.left) & step.inside & counts
        dx = jnp.where(there, step.dx, 0)
        free = jnp.maximum(step.v_free, 0.1)
        queued = jnp.sum(there & ~step.left & (step.v < QUEUE_SPEED), dtype=dx.dtype)
        duration = step.t - step.entered
        arrived = step.left & counts
        carry = carry._replace(
            started=jnp.ones((), bool),
            start=jnp.where(counts, carry.start, step.t),
            now=step.t,
            distance=carry.distance + jnp.sum(dx),
            time=carry.time + jnp.sum(there, dtype=dx.dtype) * self.dt,
            delay=carry.delay + jnp.sum(jnp.where(there, jnp.maximum(self.dt - dx / free, 0), 0)),
            queue=carry.queue.add(queued, counts),
            longest=carry.longest.add(-queued, step.t, counts),
            changes=carry.changes + jnp.sum(there & step.changed, dtype=jnp.int32),
            trips=Mean(
                carry.trips.total + jnp.sum(jnp.where(arrived, duration, 0)),
                carry.trips.weight + jnp.sum(arrived, dtype=dx.dtype),
            ),
            square_trips=carry.square_trips + jnp.sum(jnp.where(arrived, duration * duration, 0)),
        )
        carry = self._detect(carry, detectors, step)
        return carry._replace(active=step.active, lane=step.lane, s=step.s)

    def _detect(self, carry: TrafficCarry, detectors: Detectors, step: TrafficStep) -> TrafficCarry:
        """Passages of the detectors.

        A lane change is none; the new lane counts.
        """
        drove = carry.active & (step.active | step.left)  # no vehicle is active before the start
        handed_over = step.left | ((step.lane != carry.lane) & (step.s <= step.dx))
        place, lane = detectors.s[:, None], detectors.lane[:, None]  # [D, 1]
        on_now = (lane == step.lane[None]) & ~step.left[None]
        behind_now = step.s - step.dx
        passed_now = on_now & (behind_now[None] < place) & (place <= step.s[None])
        on_before = (lane == carry.lane[None]) & handed_over[None]
        passed_before = on_before & (carry.s[None] < place) & (place <= (carry.s + step.dx)[None])
        passed = (passed_now | passed_before) & drove[None]
        way = place - jnp.where(passed_now, behind_now[None], carry.s[None])
        time = step.t - self.dt * (1 - safe_divide(way, jnp.broadcast_to(step.dx[None], way.shape)))
        any_passed = passed.any(1)
        when = jnp.max(jnp.where(passed, time, -1e9), 1)  # two in one step and lane would overlap
        when = jnp.where(any_passed, when, carry.last_crossing)
        number = jnp.sum(passed, 1, dtype=jnp.int32)
        v = jnp.broadcast_to(step.dx[None] / self.dt, passed.shape)
        speeds = jnp.sum(jnp.where(passed, v, 0), 1)
        slowness = jnp.sum(jnp.where(passed, 1 / jnp.maximum(v, 0.1), 0), 1)

        first = carry.start
        index = jnp.clip(((step.t - first) / self.interval - 1e-4).astype(jnp.int32), 0, self.intervals - 1)
        here = (jnp.arange(self.intervals) == index)[None]
        headway = when - carry.last_crossing
        follows = any_passed & carry.seen
        bin = jnp.clip((headway / HEADWAY_BIN).astype(jnp.int32), 0, HEADWAY_BINS - 1)
        one_hot = (jnp.arange(HEADWAY_BINS)[None] == bin[:, None]) & follows[:, None]
        in_queue = jnp.where(follows & (headway <= QUEUE_BREAK), carry.in_queue + 1, 1)
        return carry._replace(
            passages=carry.passages + jnp.where(here, number[:, None], 0),
            sum_speed=carry.sum_speed + jnp.where(here, speeds[:, None], 0),
            sum_slowness=carry.sum_slowness + jnp.where(here, slowness[:, None], 0),
            last_crossing=when,
            seen=carry.seen | any_passed,
            in_queue=jnp.where(any_passed, in_queue, carry.in_queue),
            headways=carry.headways + one_hot.astype(jnp.int32),
            discharge=carry.discharge.add(headway, follows & (in_queue >= QUEUE_FIRST)),
        )

    def result(self, carry: TrafficCarry, length: Float[Array, ""] | float) -> dict[str, Measured]:
        """The flow in a region whose lanes have a total `length` (m)."""
        duration = carry.now - carry.start
        some, driven = duration > 0, carry.distance > 0
        area = duration * length
        mean_trip = carry.trips.result()
        variance = safe_divide(carry.square_trips, carry.trips.weight) - mean_trip.value**2
        kilometres = carry.distance / 1000
        longest = carry.longest.result()
        return {
            "mean_speed": measured(safe_divide(carry.distance, carry.time), carry.time > 0),
            "flow_per_hour": measured(3600 * safe_divide(carry.distance, area), some),
            "density_per_km": measured(1000 * safe_divide(carry.time, area), some),
            "vehicle_km": measured(kilometres),
            "delay_per_km": measured(safe_divide(carry.delay, kilometres), driven),
            "delay_share": measured(safe_divide(carry.delay, carry.time), carry.time > 0),
            "mean_queue": carry.queue.result(),
            "max_queue": measured(-longest.value, longest.valid),
            "lane_changes_per_km": measured(
                safe_divide(carry.changes.astype(kilometres.dtype), kilometres), driven
            ),
            "trips": measured(carry.trips.weight),
            "mean_travel_time": mean_trip,
            "sd_travel_time": measured(safe_sqrt(jnp.maximum(variance, 0)), mean_trip.valid),
        }

    def detector_result(self, carry: TrafficCarry) -> dict[str, Measured]:
        """Per detector and interval `[D, I]`: flow, speeds, density; per detector the rest."""
        count = carry.passages.astype(carry.sum_speed.dtype)
        begin = jnp.arange(self.intervals, dtype=count.dtype) * self.interval
        since = jnp.maximum(carry.now - carry.start - begin, 0)
        last = jnp.arange(self.intervals) == self.intervals - 1
        duration = jnp.where(last, since, jnp.minimum(since, self.interval))
        duration = jnp.broadcast_to(duration[None], count.shape)
        flow = safe_divide(count, duration)
        some = count > 0
        harmonic = safe_divide(count, carry.sum_slowness)
        headways = carry.headways.astype(count.dtype)
        total = headways.sum(1, keepdims=True)
        discharge = carry.discharge.result()
        return {
            "flow_per_hour": measured(3600 * flow, duration > 0),
            "mean_speed": measured(safe_divide(carry.sum_speed, count), some),
            "harmonic_speed": measured(harmonic, some),
            "density_per_km": measured(1000 * safe_divide(flow, harmonic), some),
            "headway_histogram": measured(headways / jnp.maximum(total, 1), total > 0),
            "saturation_flow_per_hour": measured(
                3600 * safe_divide(jnp.ones_like(discharge.value), discharge.value), discharge.valid
            ),
        }
