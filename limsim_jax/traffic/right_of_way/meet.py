"""All conflicts of a moment: which vehicles wait for which, and which follow which through a merge.

Few of the conflicts of a map matter to a vehicle at a time: those that it comes to soon and that another
vehicle comes to. These pairs, at most `PAIRS` per slot, are listed first and looked at together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.conflicts import ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.traffic.bodies import tails
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.neighbors import SortKeys
from limsim_jax.traffic.parameters import JUNCTIONS
from limsim_jax.traffic.right_of_way.approaches import Approaches
from limsim_jax.traffic.right_of_way.passage import (
    Observed,
    Stretch,
    arrival_time,
    compare,
    gap_share,
    goes_first,
    travel_time,
    usual_gap,
)
from limsim_jax.types import State
from limsim_jax.xla import computed_once

PAIRS = 2
"""Conflicts that are looked at, per slot; a vehicle waits if there are more at once."""

FOES = 3
"""Vehicles that are looked at per conflict."""

OPPOSING = math.radians(120)
"""Vehicles whose headings differ by more come from opposite directions."""

_BEHIND = 160.0  # m before a connector that still count as coming to it
_UNKNOWN = 1e3  # s, arrival time of a vehicle blocked by a stopped one: effectively never


class _OnConnectors(NamedTuple):
    """Vehicles on their connectors, in order of connector and rear bumper; `A` = N (R + 2) entries."""

    connector: Int[Array, " A"]
    observed: Observed  # [A]
    keys: Array  # sorted
    entry: Int[Array, " A"]  # at each place of the order


class _Pairs(NamedTuple):
    """Approaches and their conflicts that matter, `P` of them."""

    number: Int[Array, " P"]  # 0 to P - 1
    row: Int[Array, " P"]  # of the flattened approaches
    vehicle: Int[Array, " P"]
    connector: Int[Array, " P"]
    conflict: Int[Array, " P"]  # column of the table
    exists: Bool[Array, " P"]
    missed: Bool[Array, " NR"]  # approaches whose conflicts found no room in the list


class _Foes(NamedTuple):
    """Vehicles on the other path of every pair: `Q` each, nearest first."""

    me: Observed  # [1, P]
    other: Observed  # [Q, P]
    there: Bool[Array, "Q P"]
    mine: Stretch  # [1, P]
    theirs: Stretch  # [1, P]
    level: Float[Array, "1 P"]  # m, place of `me` along the other path
    splits: Bool[Array, "1 P"]
    merges: Bool[Array, "1 P"]


def meet(
    lane_map: LaneMap, state: State, approaches: Approaches, observed: Observed
) -> tuple[Float[Array, "N R"], Int[Array, " N"], Float[Array, " N"]]:
    """Look at all conflicts at once.

    Args:
      lane_map: where.
      state: the world.
      approaches: connectors ahead.
      observed: the vehicles on them, `[N, R]`.

    Returns:
      m to the first conflict area that is taken, NO_GAP if none is; the slot of the vehicle to follow
      through a merge or a split, -1 for none; and m to it.
    """
    table, driver = lane_map.conflicts, state.driver
    n = state.lane.shape[0]
    connectors = _sorted(lane_map, state, approaches, observed)
    pairs = _pairs(lane_map, state, approaches, observed, connectors.connector)
    foes = _foes(lane_map, connectors, pairs, observed)
    me, other, there, mine, theirs, level, splits, merges = foes
    vehicle, k, c = pairs.vehicle, pairs.connector, pairs.conflict

    shares = gap_share(driver, state)
    turned = wrap_angle(table.approach[table.foe[k, c]] - table.approach[k])
    gap = usual_gap(merges, (jnp.abs(turned) > OPPOSING)[None])
    my_gap = shares[vehicle][None] * gap
    foe_gap = shares[other.slot.astype(jnp.int32)] * gap
    encounter = compare(
        me, mine, my_gap, other, theirs, foe_gap,
        table.prio[k, c][None], table.tie[k, c][None], merges,
        (table.must_stop[k] & table.must_stop[table.foe[k, c]])[None],
    )  # fmt: skip

    distance_in = mine.start - me.front
    past = mine.end + me.length - me.front <= 0
    s0, T, b = (x[vehicle][None] for x in (driver.s0, driver.T, driver.b))
    # a vehicle that clears the conflict area before one arrives needs no care; in a merge it has to be in
    # front of one that is no faster
    way = jnp.where(merges, theirs.start + s0, theirs.end) + other.length - other.front
    out = travel_time(
        way, jnp.minimum(other.v, other.turn_speed), other.turn_speed, JUNCTIONS.exit_acceleration * other.a
    )
    arrival = arrival_time(me, mine.start)
    # it may stop inside the conflict area
    halts = (other.blocked > 0) | ((other.slowing > 0) & (other.line < -JUNCTIONS.margin))
    # In a merge, follow the other where there is room behind it, and where that asks for less than to wait
    # before the conflict area, or before the junction if the vehicle could only just stop there.
    behind = (mine.end - me.front) - (theirs.end - other.front + other.length)
    reach = behind + other.v * other.v / (2 * b)
    hastes = (me.line > 0) & (me.line + JUNCTIONS.margin > me.brake)
    hastes &= me.line < me.brake * JUNCTIONS.firm_braking / JUNCTIONS.easy_braking
    eases = (behind > s0 + JUNCTIONS.merge_headway * T * me.v) & (
        reach > jnp.where(hastes, me.line, distance_in)
    )
    follows = merges & (eases | (distance_in <= -JUNCTIONS.margin))
    clears = (out + JUNCTIONS.gap_follow < arrival) & (~merges | ((me.v <= other.v) & ~follows))
    concerns = there & ~past & ~splits
    cares = concerns & ~(clears & ~halts)
    # keep clear: no vehicle enters behind a slow one only to stop where other paths cross
    clear = (table.cross_s[k][None] - me.front) + me.length + s0
    stands = (table.cross_s[k][None] > 0) & (me.line > -JUNCTIONS.margin)
    stands &= other.v < 2 * JUNCTIONS.standstill
    follows &= ~(stands & (behind < clear))
    cares, follows = computed_once((cares, follows))

    def both(x: Array) -> tuple[Array, Array]:
        return x[vehicle][None], x[other.slot.astype(jnp.int32)]

    # a vehicle that stands where others cross goes before all that can still wait, until it moves off
    across = there & ~merges & ~splits & (distance_in < 0) & ~past
    obstructing = jnp.zeros(n, bool).at[vehicle].max(across.any(0))
    obstructing = both(computed_once(obstructing & (state.waiting > JUNCTIONS.tie_time)))
    # First without delays: how long do vehicles that go first in any case keep the ones that stand? Then
    # with these delays, since so much later do they arrive.
    delay = jnp.where(halts | (other.yielding > 0), _UNKNOWN, out)
    delayed = cares & ~follows & ~goes_first(encounter, obstructing)
    # inside the junction a vehicle that waits for another may stop in the way of others
    held = jnp.zeros(n, bool).at[vehicle].max((delayed & (me.line < -JUNCTIONS.margin)).any(0))
    held = computed_once(held)[other.slot.astype(jnp.int32)]
    cares |= concerns & clears & held
    delay = jnp.where(delayed, delay, 0).max(0)
    delay = jnp.zeros(n, jnp.float32).at[vehicle].max(delay)
    delay = computed_once(jnp.where(state.v < JUNCTIONS.standstill, delay, 0))
    waits = cares & ~goes_first(encounter, obstructing, both(delay))
    follows &= waits
    waits, follows = computed_once((waits, follows))
    taken = (waits & ~follows).any(0)
    # before a path with priority rather than across it, if it can still stop there
    back = table.hold[k, c] - me.front[0]
    until = jnp.where(taken, jnp.where(back > me.brake[0], back, distance_in[0]), NO_GAP)
    count = approaches.connector.shape[1]
    until = jnp.full(n * count, NO_GAP, jnp.float32).at[pairs.row].min(until)
    until = jnp.where(pairs.missed, jnp.minimum(until, 0), until).reshape(n, count)

    # in a split, the vehicle ahead on the other path, until its rear is clear
    in_front = there & splits & (other.front > jnp.maximum(level, 0))
    in_front = in_front & (other.front - other.length < theirs.end) & ~past
    gap = jnp.where(follows, behind, jnp.where(in_front, other.front - other.length - level, NO_GAP))
    need = jnp.where(gap < NO_GAP, gap + other.v * other.v / (2 * b), 2 * NO_GAP)
    lead, lead_gap = _leader(n, pairs, *computed_once((gap, need)), other.slot)
    return until, lead, lead_gap


def _sorted(lane_map: LaneMap, state: State, approaches: Approaches, observed: Observed) -> _OnConnectors:
    """Put vehicles in order on connectors."""
    table = lane_map.conflicts
    # tails that are still on connectors behind
    tail, front = tails(lane_map, state)
    tail = jnp.where(tail == NO_LANE, -1, table.connector[tail])
    entries = jax.tree.map(lambda x: jnp.concatenate([x, *[x[:, :1]] * tail.shape[1]], -1), observed)
    entries = entries._replace(
        front=jnp.concatenate([observed.front, front], -1),
        line=jnp.concatenate([observed.line, jnp.full_like(front, -NO_GAP)], -1),
    )
    entries = Observed(*(x.ravel() for x in entries))
    connector = jnp.concatenate([approaches.connector, tail], -1).ravel()
    entries = computed_once(entries)
    keys, entry = SortKeys(table.length.shape[0], connector.shape[0]).sort(
        connector, _share(lane_map, connector, entries.front - entries.length)
    )
    return _OnConnectors(connector, entries, keys, entry)


def _share(lane_map: LaneMap, connector: Array, x: Array) -> Array:
    """Place `x` (m) along a connector as a share; 0 is `_BEHIND` before it."""
    return (x + _BEHIND) / (lane_map.conflicts.length[connector] + _BEHIND)


def _pairs(
    lane_map: LaneMap, state: State, approaches: Approaches, observed: Observed, connector: Int[Array, " A"]
) -> _Pairs:
    """List the conflicts that matter: near, and with a vehicle on the other path."""
    table, k = lane_map.conflicts, approaches.connector
    n, size, slots = state.lane.shape[0], table.length.shape[0], table.foe.shape[1]
    busy = jnp.zeros(size, bool).at[jnp.where(connector < 0, size, connector)].set(True, mode="drop")
    stopping = state.v * state.v / (2 * JUNCTIONS.easy_braking)
    stopping = stopping + JUNCTIONS.sight_time * state.v + JUNCTIONS.sight_room
    reach = approaches.x + stopping[:, None]
    s_in, s_out, foe = (x.T[:, k.ravel()] for x in (table.s_in, table.s_out, table.foe))  # [C, N R]
    matters = (s_in < reach.ravel()[None]) & (s_out > (approaches.x - observed.length).ravel()[None])
    matters &= busy[foe] & (foe >= 0) & (k >= 0).ravel()[None]
    matters = computed_once(matters)
    number = matters.sum(0, dtype=jnp.int32)
    begin = jnp.cumsum(number) - number
    most = PAIRS * n
    pair = jnp.arange(most, dtype=jnp.int32)
    row = jnp.searchsorted(begin, pair, side="right", method="scan_unrolled").astype(jnp.int32) - 1
    row = computed_once(row)
    nth, upto, c = pair - begin[row], jnp.zeros_like(row), jnp.zeros_like(row)
    for slot in range(slots):
        upto += matters[slot, row].astype(jnp.int32)
        c += (upto <= nth).astype(jnp.int32)
    exists = (pair < begin[-1] + number[-1]) & (c < slots)
    c = jnp.minimum(c, slots - 1)
    vehicle, k, c = computed_once((row // k.shape[1], k.ravel()[row], c))
    missed = (number > 0) & (begin + number > most)  # no room in the list: better wait
    return _Pairs(pair, row, vehicle, k, c, exists, missed)


def _foes(lane_map: LaneMap, connectors: _OnConnectors, pairs: _Pairs, observed: Observed) -> _Foes:
    """Find vehicles on the other paths that have not cleared the conflict."""
    table, k, c = lane_map.conflicts, pairs.connector, pairs.conflict
    connector, entries, keys, entry = connectors
    count = connector.shape[0]
    search = SortKeys(table.length.shape[0], count)
    foe, kind = table.foe[k, c], table.type[k, c]
    s_in, s_out, f_in, f_out = (x[k, c][None] for x in (table.s_in, table.s_out, table.f_in, table.f_out))
    splits, merges = (kind == ConflictType.DIVERGE)[None], (kind == ConflictType.MERGE)[None]
    me = computed_once(Observed(*(x.ravel()[pairs.row][None] for x in observed)))
    # on the other path; splits start together, or one path goes on over several lanes
    level = me.front - s_in + f_in
    # of a queue on a merge the last vehicle ahead hides the others, not those that come after it
    abreast = jnp.clip(me.front - s_out + f_out, f_in, f_out)
    place = jnp.where(splits, level, jnp.where(merges, abreast, f_out))[0]
    wanted = search.key(foe, _share(lane_map, foe, place))
    first = computed_once(search.first_from(keys, wanted))
    at = entry[jnp.clip(first, 0, count - 1)]
    ahead = (first < count) & (connector[at] == foe) & (entries.front[at] - entries.length[at] < f_out[0])
    q = jnp.arange(FOES)[:, None]
    place = first[None] + jnp.where(splits, q - 1, ahead.astype(jnp.int32)[None] - 1 - q)
    index = computed_once(entry[jnp.clip(place, 0, count - 1)])  # [Q, P]
    there = (place >= 0) & (place < count) & (connector[index] == foe[None]) & pairs.exists[None]
    other = computed_once(Observed(*(x[index] for x in entries)))
    long = me.length**2 * table.sweep[k, c][None] + other.length**2 * table.f_sweep[k, c][None] > 1
    there &= (kind != ConflictType.SWEEP)[None] | long
    there = computed_once(there & (other.slot != me.slot))
    return _Foes(me, other, there, Stretch(s_in, s_out), Stretch(f_in, f_out), level, splits, merges)


def _leader(
    n: int, pairs: _Pairs, gap: Float[Array, "Q P"], need: Float[Array, "Q P"], slot: Array
) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """The vehicle to follow: the one that leaves the least room.

    Args:
      n: number of slots.
      pairs: conflicts and the vehicles that follow.
      gap: m to the other.
      need: m to where the other could stop.
      slot: of the other.

    Returns:
      The slot to follow, -1 for none, and the gap.
    """
    vehicle = pairs.vehicle
    best = gap[0], need[0], slot[0]
    for i in range(1, FOES):
        nearer = need[i] < best[1]
        best = tuple(jnp.where(nearer, x[i], y) for x, y in zip((gap, need, slot), best, strict=True))
    least_gap, least_need, least_slot = computed_once(best)
    least = jnp.full(n, 2 * NO_GAP, jnp.float32).at[vehicle].min(least_need)
    chosen = (least_need == least[vehicle]) & (least_need < NO_GAP)
    which = jnp.full(n + 1, -1, jnp.int32).at[jnp.where(chosen, vehicle, n)].max(pairs.number)[:n]
    lead = jnp.where(which >= 0, least_slot[which].astype(jnp.int32), -1)
    return lead, jnp.where(which >= 0, least_gap[which], NO_GAP)
