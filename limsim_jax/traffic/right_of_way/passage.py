"""Which of two vehicles goes first through a conflict area.

Both vehicles evaluate the same function of the same state with the roles swapped, so exactly one of them
goes first, and both know which.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from limsim_jax.traffic.parameters import JUNCTIONS
from limsim_jax.types import Driver, State
from limsim_jax.xla import computed_once


class Observed(NamedTuple):
    """What other drivers can tell about a vehicle near a connector. All of one shape."""

    front: Array  # m, front bumper along the connector
    length: Array  # m
    v: Array  # m/s
    top_speed: Array  # m/s, speed that it may reach
    turn_speed: Array  # m/s, speed that the connector allows
    a: Array  # m/s^2, largest acceleration
    brake: Array  # m, to stop with `firm_braking`
    waiting: Array  # s
    line: Array  # m to the stop line
    blocked: Array  # 1 if a light, a sign, a full exit or a queue stops it
    yielding: Array  # 1 if it stood for the right of way at the last decision
    slowing: Array  # 1 if it brakes, and so may stop on its way
    starts: Array  # 1 if it moves off, or drives faster and faster
    light: Array  # 1 if the light gives priority, -1 if it takes it, 2 if it clears the junction
    slot: Array
    soonest: Array  # s, least time to the start of the connector


class Stretch(NamedTuple):
    """A conflict area along a connector."""

    start: Array  # m
    end: Array  # m


class Passage(NamedTuple):
    """Whether a vehicle could pass before the other."""

    arrival: Array  # s until it comes
    needs: Array  # s until it has left, and the gap that it keeps
    blocked: Array  # it does not come
    yielding: Array  # it stands for the right of way
    calm: Array  # it stands, or can still stop without haste


class Encounter(NamedTuple):
    """Two vehicles at a conflict area, without the delays by others."""

    decided: Array  # one of them, or both, can no longer wait: no choice is left
    decided_first: Array  # whether `me` goes first then
    major: Array  # whether `me` has priority
    mine: Passage
    theirs: Passage


def travel_time(
    distance: Float[Array, "*#b"], v: Float[Array, "*#b"], v_end: Float[Array, "*#b"], a: Float[Array, "*#b"]
) -> Float[Array, "*b"]:
    """Time (s) for a distance (m), accelerating up to `v_end >= v`.

    0 for a negative distance. Speeds in m/s, `a` in m/s^2.
    """
    distance = jnp.maximum(distance, 0)
    v_end = jnp.maximum(v_end, 0.1)
    reached = jnp.minimum(jnp.sqrt(v * v + 2 * a * distance + 1e-9), v_end)
    room = (v_end * v_end - v * v) / (2 * a)
    return jnp.maximum(reached - v, 0) / a + jnp.maximum(distance - room, 0) / v_end


def arrival_time(vehicle: Observed, place: Array) -> Array:
    """Least time (s) to a place (m along the connector)."""
    free = travel_time(place - vehicle.front, vehicle.v, vehicle.top_speed, vehicle.a)
    # from the start of the connector on at its full speed
    slowed = vehicle.soonest + place / jnp.maximum(vehicle.top_speed, 0.1)
    return jnp.where(vehicle.front < 0, jnp.maximum(free, slowed), free)


def gap_share(driver: Driver, state: State) -> Float[Array, " N"]:
    """Share of the usual gap that a driver keeps.

    Impatience makes it smaller.
    """
    impatience = jnp.clip((state.waiting - JUNCTIONS.impatience_start) / JUNCTIONS.impatience_time, 0, 1)
    return driver.gap_factor * (1 - JUNCTIONS.impatience * impatience)


def usual_gap(merges: Array, opposing: Array) -> Array:
    """Gap (s) that a usual driver keeps to a vehicle with priority.

    Args:
      merges: whether the paths merge; otherwise they cross.
      opposing: whether the vehicles come from opposite directions; otherwise one comes from the side.
    """
    crossing = JUNCTIONS.gap_lead + jnp.where(opposing, 0, JUNCTIONS.gap_side)
    return jnp.where(merges, JUNCTIONS.gap_merge, crossing)


def compare(
    me: Observed,
    mine: Stretch,
    my_gap: Array,
    foe: Observed,
    theirs: Stretch,
    foe_gap: Array,
    prio: Array,
    tie: Array,
    merges: Array,
    all_way: Array,
) -> Encounter:
    """What decides whether `me` goes before `foe`; with the roles swapped, the opposite.

    Args:
      me: one vehicle.
      mine: the conflict area on its connector.
      my_gap: s, that it keeps.
      foe: the other vehicle.
      theirs: the conflict area on its connector.
      foe_gap: s, that it keeps.
      prio: priority by the map: 1 if `me` has it, -1 if `foe` has it, 0 if they are equal.
      tie: the same by right before left.
      merges: whether the paths merge; otherwise they cross.
      all_way: whether both come from stop signs: the first that has come goes first.
    """
    margin = JUNCTIONS.margin
    my_distance, foe_distance = mine.start - me.front, theirs.start - foe.front
    my_level, foe_level = _level(me, my_distance), _level(foe, foe_distance)
    my_arrival, foe_arrival = computed_once(
        (
            arrival_time(me, mine.start),
            arrival_time(foe, theirs.start),
        )
    )
    before = me.slot < foe.slot
    # both inside, or both unable to stop: the one that is further on
    my_rest, foe_rest = mine.end - me.front, theirs.end - foe.front
    nearer = jnp.where(my_rest == foe_rest, before, my_rest < foe_rest)
    sooner = jnp.where(my_arrival == foe_arrival, before, my_arrival < foe_arrival)
    first = jnp.where(my_level == 3, nearer, sooner)
    first = jnp.where(my_level != foe_level, my_level > foe_level, first)

    # between vehicles that can still choose: the one with priority
    first, sooner, my_level, foe_level = computed_once((first, sooner, my_level, foe_level))
    longer = jnp.where(me.waiting == foe.waiting, sooner, me.waiting > foe.waiting)
    both = jnp.minimum(me.waiting, foe.waiting)
    first_came = all_way & (jnp.abs(me.waiting - foe.waiting) > JUNCTIONS.turn_time)
    equals = jnp.where((tie != 0) & (both < JUNCTIONS.tie_time) & ~first_came, tie > 0, longer)
    # of equals, one that is in the junction before one at its line
    my_entry, foe_entry = me.line < -margin, foe.line < -margin
    equals = jnp.where(my_entry != foe_entry, my_entry, equals)
    light = jnp.sign(me.light - foe.light)
    order = jnp.where(light != 0, light, prio.astype(light.dtype))
    gridlock = (me.yielding > 0) & (foe.yielding > 0) & (both > JUNCTIONS.priority_time)
    major = jnp.where(gridlock, longer, jnp.where(order != 0, order > 0, equals))
    return computed_once(
        Encounter(
            decided=(my_level > 0) | (foe_level > 0),
            decided_first=first,
            major=major,
            mine=_passage(me, mine, my_gap, foe, my_distance, my_arrival, merges),
            theirs=_passage(foe, theirs, foe_gap, me, foe_distance, foe_arrival, merges),
        )
    )


def _level(vehicle: Observed, distance_in: Array) -> Array:
    """3: inside the conflict area, 2: cannot stop before it, 1: pulls out into it, 0: can wait."""
    inside, comes = distance_in <= -JUNCTIONS.margin, distance_in < vehicle.brake
    pulls_out = (vehicle.starts > 0) & (distance_in < JUNCTIONS.pulling_out)
    level = comes.astype(jnp.int32) * 2 + inside.astype(jnp.int32)
    return jnp.maximum(level, pulls_out.astype(jnp.int32))


def _passage(
    vehicle: Observed,
    stretch: Stretch,
    gap: Array,
    other: Observed,
    distance_in: Array,
    arrival: Array,
    merges: Array,
) -> Passage:
    """What a vehicle needs to pass before `other`.

    It is `distance_in` m and `arrival` s away from the conflict area.
    """
    start = jnp.minimum(vehicle.v, vehicle.turn_speed)
    a = JUNCTIONS.passing_acceleration * vehicle.a
    # in a merge it has to be in front by its length; at a crossing it has to have left
    distance = jnp.where(merges, stretch.start, stretch.end) - vehicle.front + vehicle.length
    out = travel_time(distance, start, vehicle.turn_speed, a)
    speed = jnp.minimum(jnp.sqrt(start * start + 2 * a * jnp.maximum(distance, 0)), vehicle.turn_speed)
    slower = jnp.maximum(other.v - speed, 0)
    # the time that the other loses by braking down to that speed
    loss = slower * slower / (2 * JUNCTIONS.merge_braking * jnp.maximum(other.v, 1))
    loss = jnp.where(merges, loss, 0)
    gap = jnp.where(vehicle.line < 0, JUNCTIONS.gap_lead_entered * gap, gap)
    return Passage(
        arrival=arrival,
        needs=out + gap + loss,
        blocked=vehicle.blocked > 0,
        yielding=vehicle.yielding > 0,
        calm=(vehicle.v < JUNCTIONS.standstill)
        | (distance_in > JUNCTIONS.calm_factor * vehicle.brake + JUNCTIONS.margin),
    )


def goes_first(
    encounter: Encounter, obstructing: tuple[Array, Array], delay: tuple[Array, Array] | None = None
) -> Array:
    """Whether `me` goes before `foe`.

    Args:
      encounter: of the two.
      obstructing: whether each stands where other paths cross.
      delay: s for which other vehicles keep each from starting; None: 0.
    """

    def passes(minor: Passage, major: Passage, delay: Array | float) -> Array:
        in_time = minor.needs < major.arrival + jnp.where(minor.yielding, 0.0, delay)
        return ~minor.blocked & (major.blocked | in_time)

    my_delay, foe_delay = (0.0, 0.0) if delay is None else delay
    i_clear = obstructing[0] & encounter.theirs.calm
    foe_clears = obstructing[1] & encounter.mine.calm
    major = jnp.where(i_clear != foe_clears, i_clear, encounter.major)
    free = jnp.where(
        major,
        ~passes(encounter.theirs, encounter.mine, my_delay),
        passes(encounter.mine, encounter.theirs, foe_delay),
    )
    return jnp.where(encounter.decided, encounter.decided_first, free)
