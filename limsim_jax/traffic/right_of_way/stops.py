"""Places where vehicles stop at junctions: for lights, signs, full exits and conflict areas."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.neighbors import Pair
from limsim_jax.traffic.parameters import JUNCTIONS
from limsim_jax.traffic.right_of_way.approaches import Approaches, throughout
from limsim_jax.types import State

_LEADERS = 3  # vehicles of a queue whose stops are looked at


def stops_at_lights(
    state: State,
    approaches: Approaches,
    speed: Float[Array, "N R"],
    shows: Int[Array, " L"],
    since: Float[Array, "N R"],
) -> tuple[Array, Array]:
    """Where lights stop vehicles, and what they say of priority.

    Args:
      state: the world.
      approaches: connectors ahead.
      speed: m/s, at which the connectors are driven.
      shows: what the light at the entry of every lane shows, a `SignalState`.
      since: s that it has shown this.

    Returns:
      m to the place to stop, NO_GAP where no light says stop; and 1 where the light gives priority, -1
      where it takes it, 2 for a vehicle that clears the junction. Both `[N, R]`.
    """
    light = shows[approaches.lane]
    brake = state.v * state.v
    line = jnp.maximum(approaches.line, 0)
    # at yellow a driver decides once: what counts are speed and distance at the moment when it began
    v_then = state.v[:, None] + jnp.maximum(-state.a, 0)[:, None] * since
    then = line + (state.v[:, None] + v_then) / 2 * since
    # a vehicle that slows down for a turn comes too late even if it is near
    late = 2 * then > JUNCTIONS.yellow_time * (v_then + speed)
    hard = JUNCTIONS.yellow_late * JUNCTIONS.yellow_braking
    could = v_then * v_then <= 2 * jnp.where(late, hard, JUNCTIONS.yellow_braking) * then
    # a vehicle that has slowed down for something else, as a bend, does not brake hard at the last moment
    could &= brake[:, None] <= 2 * JUNCTIONS.yellow_hardest * line
    # a vehicle that has begun to brake late goes on braking
    braking = (state.a < -JUNCTIONS.slowing)[:, None] & (brake[:, None] <= 2 * state.driver.b[:, None] * line)
    at_yellow = light == SignalState.YELLOW
    yellow = at_yellow & (could | braking)
    at_red = (light == SignalState.RED) | (light == SignalState.RED_YELLOW)
    # a vehicle that cannot stop any more drives on; one that only rolls stops, even just over the line
    red = at_red & (brake[:, None] <= 2 * JUNCTIONS.red_braking * state.driver.b_max[:, None] * line)
    rolls = (state.v < JUNCTIONS.standstill)[:, None] & (approaches.line > -JUNCTIONS.over_line)
    red |= (at_red | at_yellow) & rolls
    stops = (
        (yellow | red) & (approaches.x < 0) & (approaches.line > -NO_GAP / 2) & (approaches.connector >= 0)
    )
    minor = (light == SignalState.GREEN_MINOR) | (light == SignalState.STOP)
    major = jnp.where(light == SignalState.GREEN_MAJOR, 1, jnp.where(minor, -1, 0))
    left_over = (approaches.line < -JUNCTIONS.margin) & at_red  # clears the junction first
    light = throughout(approaches, jnp.where(left_over, 2, major))
    stops = throughout(approaches, stops)
    stop = jnp.where(stops, jnp.maximum(approaches.line - JUNCTIONS.margin, -JUNCTIONS.margin), NO_GAP)
    return stop, light


def exit_full(lane_map: LaneMap, state: State, approaches: Approaches, own: Pair) -> Bool[Array, "N R"]:
    """Keep clear: whether a vehicle would come to stand where other paths cross.

    Args:
      lane_map: where.
      state: the world.
      approaches: connectors ahead.
      own: leader and follower on the own route.
    """
    crosses, needed = _past_crossings(lane_map, state, approaches)
    needed += state.driver.s0[:, None]
    slow = (own.lead >= 0) & (state.v[own.lead] < JUNCTIONS.standstill)
    room = own.lead_gap + JUNCTIONS.exit_time * state.v[own.lead]
    return crosses & slow[:, None] & (room[:, None] < needed) & (approaches.line > -JUNCTIONS.margin)


def keeps_clear(
    lane_map: LaneMap,
    state: State,
    approaches: Approaches,
    own: Pair,
    brake: Float[Array, "N R"],
    stop: Float[Array, "N R"],
) -> tuple[Float[Array, "N R"], Bool[Array, "N R"]]:
    """Keep clear: no vehicle stops with its tail where other paths cross.

    It waits before the junction if it will have to stop beyond it without enough room: for the next junction,
    or behind a leader that has to stop.

    Args:
      lane_map: where.
      state: the world.
      approaches: connectors ahead.
      own: leader and follower on the own route.
      brake: m, to stop with `firm_braking`.
      stop: m to where a vehicle has to stop for each connector, NO_GAP if it need not.

    Returns:
      m to where it stops for each, and for which it waits for the next junction.
    """
    crosses, needed = _past_crossings(lane_map, state, approaches)
    comes = first = stop.min(-1)
    behind = jnp.full_like(first, NO_GAP)
    for _ in range(_LEADERS):
        behind = jnp.where(own.lead >= 0, own.lead_gap + comes[own.lead] - state.driver.s0, NO_GAP)
        comes = jnp.minimum(first, behind)
    ahead = (approaches.line > -JUNCTIONS.margin) & (approaches.line + JUNCTIONS.margin > brake) & crosses
    line = jnp.maximum(approaches.line - JUNCTIONS.margin, -JUNCTIONS.margin)
    places, waits = [], []
    here = later = jnp.full_like(state.s, NO_GAP)  # first stops in the junction of a connector, and beyond
    goes_on = jnp.zeros_like(state.active)
    for r in reversed(range(stop.shape[1])):
        later = jnp.where(goes_on, later, jnp.minimum(later, here))
        full = (later < needed[:, r]) | ((behind < needed[:, r]) & (behind > approaches.line[:, r]))
        full &= ahead[:, r]
        place = jnp.where(full, jnp.minimum(stop[:, r], line[:, r]), stop[:, r])
        here = jnp.where(goes_on, jnp.minimum(here, place), place)
        goes_on = approaches.goes_on[:, r]
        places.append(place)
        waits.append(full)
    return jnp.stack(places[::-1], -1), jnp.stack(waits[::-1], -1)


def _past_crossings(
    lane_map: LaneMap, state: State, approaches: Approaches
) -> tuple[Bool[Array, "N R"], Float[Array, "N R"]]:
    """Whether paths cross a connector; m until the tail is past."""
    clear = lane_map.conflicts.cross_s[approaches.connector]
    return clear > 0, clear - approaches.x + state.shape.length[:, None]


def stop_signs(
    lane_map: LaneMap, state: State, approaches: Approaches
) -> tuple[Bool[Array, "N R"], Bool[Array, " N"]]:
    """Stop signs to obey, and vehicles that have obeyed the first."""
    sign = lane_map.conflicts.must_stop[approaches.connector] & (approaches.line > -JUNCTIONS.margin)
    first = jnp.where(sign, approaches.line, NO_GAP).min(-1)
    # egos are asked for what the law asks for
    enough = jnp.full_like(state.v, JUNCTIONS.sign_speed).at[state.egos.slot].set(JUNCTIONS.sign_stop)
    stopped = (first < JUNCTIONS.sign_distance) & (state.stopped | (state.v < enough))
    return sign & ~(stopped[:, None] & (approaches.line <= first[:, None])), stopped


def stops_at_conflicts(
    wait_s: Float[Array, "N R"],
    approaches: Approaches,
    brake: Float[Array, "N R"],
    until: Float[Array, "N R"],
    barred: Bool[Array, "N R"],
) -> tuple[Float[Array, "N R"], Bool[Array, "N R"]]:
    """Where vehicles wait for others.

    Args:
      wait_s: m along the connectors, the place to wait within the junction; 0 for none.
      approaches: connectors ahead.
      brake: m, to stop with `firm_braking`.
      until: m to the first conflict area that is taken, NO_GAP if none is.
      barred: a sign or a full exit says stop.

    Returns:
      m to where the front bumper waits, NO_GAP if it need not, and whether it has to wait.
    """
    taken = until < NO_GAP / 2
    until = until - JUNCTIONS.margin
    # all that is taken may lie beyond the point to wait at within the junction
    beyond = (
        taken
        & (wait_s > 0)
        & (wait_s - approaches.x > -JUNCTIONS.margin)
        & (until >= wait_s - approaches.x - JUNCTIONS.margin)
    )
    until = jnp.where(beyond, jnp.maximum(wait_s - approaches.x, 0), until)
    # before the line, unless the line is too near
    at_line = (approaches.line > -JUNCTIONS.margin) & (approaches.line + JUNCTIONS.margin > brake)
    line = jnp.maximum(approaches.line - JUNCTIONS.margin, -JUNCTIONS.margin)
    stop = jnp.where(taken, jnp.where(at_line & ~beyond, jnp.minimum(line, until), until), NO_GAP)
    stop = jnp.where(barred & at_line, jnp.minimum(stop, line), stop)
    return stop, taken | barred
