"""Traffic lights while the clock runs: fixed programs by the time of day, actuated ones by detectors.

An actuated green phase goes on while vehicles come to it less than `GAP` s apart, within its least and its
longest duration; all its other phases are as in the plan. As in SUMO's actuated programs (the gap is that
of its default `max-gap`), with a detector as long as `DETECTOR` before the stop line.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states, phase_at
from limsim_jax.types import Config, Lights, State

GAP = 3.0
"""s without a vehicle at the detector after which an actuated green ends."""

DETECTOR = 40.0
"""m before the stop line in which vehicles keep an actuated light green."""

ON_LINE = 0.5
"""m beyond a stop line, within its lane, where a front bumper has not crossed it yet."""


@jax.named_scope("lights")
def switch(
    config: Config, lane_map: LaneMap, state: State, light: Int[Array, "N R"], line: Float[Array, "N R"]
) -> Lights:
    """The lights at this decision.

    Args:
      config: of the run.
      lane_map: where.
      state: the world at the last decision but for the motion since.
      light: lanes behind a light that vehicles come to (their first connector), NO_LANE for none.
      line: m to the stop line before it; negative behind.
    """
    table, lights = lane_map.signals, state.lights
    phase = phase_at(table, config.time(state.step))
    start = state.step == 0
    # actuated programs
    program = table.lane_program[light]
    shown = lane_states(table, lights.phase)[light]
    green = (shown == SignalState.GREEN_MAJOR) | (shown == SignalState.GREEN_MINOR)
    seen = green & (program >= 0) & (line > 0) & (line < DETECTOR)
    size = lights.phase.shape[0]
    called = jnp.zeros(size, bool).at[jnp.where(seen, program, size)].max(True, mode="drop")
    row = jnp.arange(size)
    now = lights.phase
    elapsed = lights.elapsed + config.decision_time
    gap = jnp.where(called, 0, lights.gap + config.decision_time)
    shortest, longest, usual = (x[row, now] for x in (table.min_duration, table.max_duration, table.duration))
    extends = longest > shortest
    over = jnp.where(extends, (elapsed >= shortest) & ((gap > GAP) | (elapsed >= longest)), elapsed >= usual)
    after = jnp.where(over, table.next_phase[row, now], now)
    actuated = table.actuated & ~start
    new = jnp.where(actuated, after, phase)
    return Lights(
        phase=new,
        elapsed=jnp.where(start | jnp.where(actuated, over, new != now), 0, elapsed),
        gap=jnp.where(actuated & ~over, gap, 0),
    )


def crosses_on_red(
    lane_map: LaneMap, state: State, dx: Float[Array, " N"], slot: Int[Array, ""] | None = None
) -> Bool[Array, "*N"]:
    """Whether vehicles have run a red light in the last `dx` m.

    The line may stand well before the end of its lane: what counts is the light when the front passes the
    line, not when the vehicle enters the junction.

    Args:
      lane_map: where.
      state: after the way.
      dx: m driven.
      slot: of the only vehicle that is asked for; None: all.
    """
    asked = state.active, state.lane, state.previous, state.goal, state.s, dx
    active, here, previous, goal, s, dx = asked if slot is None else (x[slot] for x in asked)
    entered = (previous != NO_LANE) & (s <= dx)
    lane = jnp.where(entered, previous, here)
    onto = jnp.where(entered, here, lane_map.routes.next_lane[here, goal])
    front = s + jnp.where(entered, lane_map.length[lane], 0)
    line = jnp.minimum(lane_map.stop_s[lane] + ON_LINE, lane_map.length[lane])
    red = lane_states(lane_map.signals, state.lights.phase) == SignalState.RED
    crossed = active & (front - dx <= line) & (front > line) & (lane != NO_LANE)
    return crossed & (onto != NO_LANE) & red[onto]
