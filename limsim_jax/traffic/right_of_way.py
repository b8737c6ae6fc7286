"""Who goes first where paths meet, and where the others wait: lights, signs, priority, gaps.

Every vehicle looks at the next two connectors on its way: the one it is on, and those it comes to. For
every conflict of a connector it looks at the vehicles on the foe that have not passed yet. Of two
vehicles exactly one goes first, and both see it alike, because both evaluate the same function of the
same state with the roles swapped:

1. who is on the stretch goes before who is not, who can no longer stop before who can;
2. else who has come to stand where others cross, then the one with priority (the map's, and that of the
   light; between equals right before left, who waits longer, who comes first), unless the other has time to
   pass: a gap of `GAP_LEAD` seconds in front of it, which is longer by the time that others keep it, if it
   stands;
3. who does not go first waits at the stop line, or lets the other clear the stretch, or where paths
   merge follows the other as its leader.

Gap acceptance follows the windows of entry and exit times of Krajzewicz & Erdmann, SUMO's junction model
(2013), with the driver's `gap_factor`. Waiting makes impatient: gaps shrink by up to 60 % in a minute.
Highway Capacity Manual 6th ed., ch. 20: critical gaps of 4 to 7 s.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.conflicts import ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, turn_speed
from limsim_jax.maps.signals import SignalState, lane_states
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.motion import tails
from limsim_jax.traffic.neighbors import Ahead, Pair, Shelf
from limsim_jax.types import Config, Driver, Lights, State
from limsim_jax.xla import computed_once

GAP_LEAD = 1.5
"""s between the own exit of a stretch and the entry of a vehicle with priority, for a `gap_factor` of 1."""

GAP_FOLLOW = 0.5
"""s between the exit of the vehicle that goes first and the own entry."""

BRAKE = 4.0
"""m/s^2: who would have to brake harder to wait counts as one who goes."""

YELLOW_BRAKE = 3.0
"""m/s^2: who can stop with this stops at yellow."""

WAITED = 3.0
"""s of waiting of both, after which right before left no longer holds: who waits longer goes."""

STUCK = 20.0
"""s of waiting of both, after which priority no longer holds: who waits longer goes."""

_ROWS = 3  # connectors ahead that a vehicle looks at
_FOES = 3  # vehicles per conflict
_BEHIND = 160.0  # m before a connector that still count as coming to it
_PAIRS = 2  # conflicts that are looked at, per slot; more at once make vehicles wait
_EASY = 2.0  # m/s^2, braking from which conflicts ahead matter
_MARGIN = 0.5  # m between the front bumper and what it waits at
_YELLOW = 2.5  # s of yellow that are counted on
_YELLOW_HARD = 5.0  # m/s^2, more than what who stops at yellow comes to
_OVER_LINE = 2.0  # m beyond the line at which a vehicle that rolls may still stop
_SLOWS = 1.0  # m/s^2, braking of who may stop inside a junction
_STANDS = 1.0  # m/s, below which the vehicle ahead counts as standing
_STARTS = 0.2  # m/s^2, above which a vehicle that stood moves on
_LONG = 1e3  # s, who is kept by somebody who stands comes at no time that others could tell


class Rows(NamedTuple):
    """The next connectors of every vehicle, `R` of them."""

    connector: Int[Array, "N R"]  # -1 where there is none
    lane: Int[Array, "N R"]
    x: Float[Array, "N R"]  # m, front bumper along the connector; negative before it
    line: Float[Array, "N R"]  # m to the place to wait before the junction; negative once passed


class Yielding(NamedTuple):
    """What the right of way asks of every vehicle."""

    stop: Float[Array, " N"]  # m to where the front bumper has to stop, NO_GAP if nowhere
    lead: Int[Array, " N"]  # slot of a vehicle to follow through a merge or a split, -1 for none
    lead_gap: Float[Array, " N"]  # m to it
    held: Bool[Array, " N"]  # stands for the right of way, a sign or a full exit, not for a light
    stopped: Bool[Array, " N"]  # has stopped at the stop sign ahead


def rows_ahead(config: Config, lane_map: LaneMap, state: State, ahead: Ahead) -> Rows:
    """The first connectors on the way of every vehicle, from its own lane on."""
    table = lane_map.conflicts
    connector = jnp.where(state.active[:, None], table.connector[ahead.lane], -1)
    connector = jnp.where(ahead.start < config.look_ahead, connector, -1)
    count = jnp.cumsum(connector >= 0, -1)
    junction = lane_map.junction[ahead.lane]
    setback = (lane_map.length - lane_map.stop_s)[ahead.lane]
    rows, line = [], jnp.full_like(state.s, -NO_GAP)
    inside = jnp.full_like(state.lane, -1)
    for r in range(_ROWS):
        here = (connector >= 0) & (count == r + 1)
        index = jnp.argmax(here, -1)[:, None]
        found = here.any(-1)
        pick = lambda x, i: jnp.take_along_axis(x, i, -1)[:, 0]  # noqa: E731
        start, which = pick(ahead.start, index), pick(junction, index)
        before = jnp.maximum(index - 1, 0)
        enters = (index[:, 0] > 0) & (which >= 0) & (pick(junction, before) != which)
        # the line of a junction holds for all its connectors; who is inside has none, nor has a lane outside
        line = jnp.where(
            enters, start - pick(setback, before), jnp.where((which >= 0) & (which == inside), line, -NO_GAP)
        )
        inside = which
        rows.append(
            (
                jnp.where(found, pick(connector, index), -1),
                jnp.where(found, pick(ahead.lane, index), NO_LANE),
                jnp.where(found, -start, -NO_GAP),
                jnp.where(found, line, -NO_GAP),
            )
        )
    return Rows(*(jnp.stack(column, -1) for column in zip(*rows, strict=True)))


def travel_time(
    distance: Float[Array, "*#b"], v: Float[Array, "*#b"], v_end: Float[Array, "*#b"], a: Float[Array, "*#b"]
) -> Float[Array, "*b"]:
    """Seconds to cover `distance` m from speed `v`, accelerating with `a` up to `v_end >= v`."""
    distance = jnp.maximum(distance, 0)
    v_end = jnp.maximum(v_end, 0.1)
    reached = jnp.minimum(jnp.sqrt(v * v + 2 * a * distance + 1e-9), v_end)
    room = (v_end * v_end - v * v) / (2 * a)
    return jnp.maximum(reached - v, 0) / a + jnp.maximum(distance - room, 0) / v_end


class _Sight(NamedTuple):
    """What others can tell about a vehicle on its way over a connector."""

    y: Array  # m, front bumper along the connector
    length: Array
    v: Array
    fast: Array  # m/s, the speed it may reach
    slow: Array  # m/s, the speed it has to keep to
    a: Array
    brake: Array  # m, to stop with BRAKE
    wait: Array  # s
    line: Array  # m to the stop line
    stuck: Array  # 1 if kept by a light, a full exit or a queue
    held: Array  # 1 if kept by the right of way at the last decision
    slows: Array  # 1 if it brakes: it may stop on its way
    major: Array  # 1 if the light gives priority, -1 if it takes it
    slot: Array


@jax.named_scope("right_of_way")
def give_way(lane_map: LaneMap, state: State, rows: Rows, own: Pair, lights: Lights) -> Yielding:
    """Where every vehicle has to wait, and whom it follows through merges and splits.

    Args:
      lane_map: where.
      state: the world.
      rows: the connectors to come.
      own: leader and follower on the own way.
      lights: of the decision.
    """
    table, driver = lane_map.conflicts, state.driver
    shows = jnp.asarray(lane_states(lane_map.signals, lights.phase))  # at the entry of every lane
    n = state.lane.shape[0]
    brake = state.v * state.v / (2 * BRAKE)

    speed = turn_speed(lane_map, rows.lane, driver.a_lat[:, None])
    since = lights.elapsed[lane_map.signals.lane_program[rows.lane]]
    at_light, major = _lights(state, rows, speed, shows, since)
    full = _exit_full(lane_map, state, rows, own)
    standing = (own.lead >= 0) & (state.v[own.lead] < _STANDS) & (state.v < _STANDS)
    queued = standing & (own.lead_gap < 2 * driver.s0 + 1)
    starts = state.a > _STARTS
    queued |= (state.v < _STANDS) & (state.waiting > WAITED) & ~state.held & ~starts  # whatever it waits for
    sign, stopped = _stop_sign(lane_map, state, rows)

    def everywhere(x: Array) -> Array:
        return jnp.broadcast_to(x[:, None] if x.ndim == 1 else x, (n, _ROWS)).astype(jnp.float32)

    a = jnp.maximum(driver.a, 0.5)
    sight = _Sight(
        y=rows.x,
        length=everywhere(state.shape.length),
        v=everywhere(state.v),
        fast=jnp.maximum(state.v[:, None], speed),
        slow=speed,
        a=everywhere(a),
        brake=everywhere(brake),
        wait=everywhere(state.waiting),
        line=rows.line,
        stuck=everywhere((at_light < NO_GAP) | full | queued[:, None]),
        held=everywhere(state.held),
        slows=everywhere(state.a < -_SLOWS),
        major=major.astype(jnp.float32),
        slot=everywhere(jnp.arange(n)),
    )
    if table.foe.shape[1]:
        until, lead, lead_gap = _meet(lane_map, state, rows, sight)
    else:  # a map where paths never meet
        until = jnp.full((n, _ROWS), NO_GAP, jnp.float32)
        lead, lead_gap = jnp.full(n, -1, jnp.int32), jnp.full(n, NO_GAP, jnp.float32)
    stop, waiting = _where_to_stop(table.wait_s[rows.connector], rows, sight, until, sign | full)
    held = state.active & waiting.any(-1) & (state.v < _STANDS)  # who still moves may yet come
    stop = jnp.minimum(stop, at_light).min(-1)
    return Yielding(
        stop=jnp.where(state.active, stop, NO_GAP),
        lead=lead,
        lead_gap=lead_gap,
        held=held,
        stopped=stopped,
    )


def _meet(
    lane_map: LaneMap, state: State, rows: Rows, sight: _Sight
) -> tuple[Float[Array, "N R"], Int[Array, " N"], Float[Array, " N"]]:
    """All conflicts at once: m to the first stretch that is taken (NO_GAP: none), whom to follow, the gap.

    Few of the conflicts of a map matter to a vehicle at a time: those that it comes to soon and that
    somebody else comes to. These, at most `_PAIRS` per slot, are put together before they are looked at.
    """
    table, driver = lane_map.conflicts, state.driver
    n, size, slots = state.lane.shape[0], table.length.shape[0], table.foe.shape[1]
    # tails that are still on the connector behind, or on the one behind that if lanes are short
    tail, y = tails(lane_map, state)
    tail = jnp.where(tail == NO_LANE, -1, table.connector[tail])
    entries = jax.tree.map(lambda x: jnp.concatenate([x, x[:, :1], x[:, :1]], -1), sight)
    entries = entries._replace(
        y=jnp.concatenate([sight.y, y], -1),
        line=jnp.concatenate([sight.line, jnp.full_like(y, -NO_GAP)], -1),
    )
    entries = _Sight(*(x.ravel() for x in entries))
    connector = jnp.concatenate([rows.connector, tail], -1).ravel()
    count = connector.shape[0]

    shelf = Shelf(size, count)

    def share(k: Array, x: Array) -> Array:
        return (x + _BEHIND) / (table.length[k] + _BEHIND)

    entries = computed_once(entries)
    order, entry = shelf.sort(connector, share(connector, entries.y - entries.length))

    # which conflicts matter
    k = rows.connector
    busy = jnp.zeros(size, bool).at[jnp.where(connector < 0, size, connector)].set(True, mode="drop")
    reach = rows.x + (state.v * state.v / (2 * _EASY) + 1.5 * state.v + 12)[:, None]
    s_in, s_out, foe = (x.T[:, k.ravel()] for x in (table.s_in, table.s_out, table.foe))  # [C, N R]
    matters = (s_in < reach.ravel()[None]) & (s_out > (rows.x - sight.length).ravel()[None])
    matters &= busy[foe] & (foe >= 0) & (k >= 0).ravel()[None]
    matters = computed_once(matters)
    number = matters.sum(0, dtype=jnp.int32)
    begin = jnp.cumsum(number) - number
    most = _PAIRS * n
    pair = jnp.arange(most, dtype=jnp.int32)
    row = jnp.searchsorted(begin, pair, side="right", method="scan_unrolled").astype(jnp.int32) - 1
    row = computed_once(row)
    nth, upto, c = pair - begin[row], jnp.zeros_like(row), jnp.zeros_like(row)
    for slot in range(slots):
        upto += matters[slot, row].astype(jnp.int32)
        c += (upto <= nth).astype(jnp.int32)
    exists = (pair < begin[-1] + number[-1]) & (c < slots)
    c = jnp.minimum(c, slots - 1)
    vehicle, k, c = computed_once((row // _ROWS, k.ravel()[row], c))
    missed = (number > 0) & (begin + number > most)  # no room in the list: better wait

    # for each: the vehicles on the foe that have not cleared the stretch, the nearest first
    foe, kind = table.foe[k, c], table.type[k, c]
    s_in, s_out, f_in, f_out = (x[k, c][None] for x in (table.s_in, table.s_out, table.f_in, table.f_out))
    splits, merges = (kind == ConflictType.DIVERGE)[None], (kind == ConflictType.MERGE)[None]
    me = computed_once(_Sight(*(x.ravel()[row][None] for x in sight)))
    level = me.y - s_in + f_in  # on the foe; splits begin together, or one way goes on over several lanes
    # of those who queue on a merge the last one ahead hides the others, not those who come after it
    abreast = jnp.clip(me.y - s_out + f_out, f_in, f_out)
    wanted = shelf.key(foe, share(foe, jnp.where(splits, level, jnp.where(merges, abreast, f_out))[0]))
    first = computed_once(shelf.first_from(order, wanted))
    at = entry[jnp.clip(first, 0, count - 1)]
    ahead = (first < count) & (connector[at] == foe) & (entries.y[at] - entries.length[at] < f_out[0])
    q = jnp.arange(_FOES)[:, None]
    place = first[None] + jnp.where(splits, q - 1, ahead.astype(jnp.int32)[None] - 1 - q)
    index = computed_once(entry[jnp.clip(place, 0, count - 1)])  # [Q, P]
    there = (place >= 0) & (place < count) & (connector[index] == foe[None]) & exists[None]
    other = computed_once(_Sight(*(x[index] for x in entries)))
    long = me.length**2 * table.sweep[k, c][None] + other.length**2 * table.f_sweep[k, c][None] > 1
    there &= (kind != ConflictType.SWEEP)[None] | long
    there = computed_once(there & (other.slot != me.slot))

    mine, theirs = _Way(s_in, s_out), _Way(f_in, f_out)
    gaps = _gap(driver, state)
    rivals = _compare(
        me, mine, gaps[vehicle][None], other, theirs, gaps[other.slot.astype(jnp.int32)],
        table.prio[k, c][None], table.tie[k, c][None], merges,
    )  # fmt: skip

    distance_in = s_in - me.y
    past = s_out + me.length - me.y <= 0
    # a vehicle that clears the stretch before one comes there needs no care
    way = f_out + other.length - other.y
    out = travel_time(way, jnp.minimum(other.v, other.slow), other.slow, 0.7 * other.a)
    soon = travel_time(distance_in, me.v, me.fast, me.a)
    halts = (other.stuck > 0) | ((other.slows > 0) & (other.line < -_MARGIN))  # perhaps within the stretch
    cares = there & ~past & ~splits & ~((out + GAP_FOLLOW < soon) & ~halts & ~merges)
    # merging: behind the other where there is room behind it, if that asks for less than to wait before
    # the stretch, or before the junction if only some haste would stop it there
    behind = (s_out - me.y) - (f_out - other.y + other.length)
    s0, T, b = (x[vehicle][None] for x in (driver.s0, driver.T, driver.b))
    reach = behind + other.v * other.v / (2 * b)
    hastes = (me.line > 0) & (me.line + _MARGIN > me.brake) & (me.line < me.brake * BRAKE / _EASY)
    eases = (behind > s0 + 0.5 * T * me.v) & (reach > jnp.where(hastes, me.line, distance_in))
    follows = merges & (eases | (distance_in <= -_MARGIN))
    # keep clear: nobody enters behind a slow vehicle only to stand where others cross
    clear = (table.cross_s[k][None] - me.y) + me.length + s0
    stands = (table.cross_s[k][None] > 0) & (me.line > -_MARGIN) & (other.v < 2 * _STANDS)
    follows &= ~(stands & (behind < clear))
    cares, follows = computed_once((cares, follows))

    def both(x: Array) -> tuple[Array, Array]:
        return x[vehicle][None], x[other.slot.astype(jnp.int32)]

    # who has come to stand where others cross goes before all that can still wait, until it is on its way
    across = there & ~merges & ~splits & (distance_in < 0) & ~past
    blocks = jnp.zeros(n, bool).at[vehicle].max(across.any(0))
    blocks = both(computed_once(blocks & (state.waiting > WAITED)))
    # how long those who stand are kept by who goes before them in any case: so much later do they come
    kept = jnp.where(halts | (other.held > 0), _LONG, out)
    kept = jnp.where(cares & ~follows & ~_goes_first(rivals, blocks), kept, 0).max(0)
    kept = jnp.zeros(n, jnp.float32).at[vehicle].max(kept)
    kept = computed_once(jnp.where(state.v < _STANDS, kept, 0))
    waits = cares & ~_goes_first(rivals, blocks, both(kept))
    follows &= waits
    waits, follows = computed_once((waits, follows))
    taken = (waits & ~follows).any(0)
    until = jnp.where(taken, distance_in[0], NO_GAP)
    until = jnp.full(n * _ROWS, NO_GAP, jnp.float32).at[row].min(until)
    until = jnp.where(missed, jnp.minimum(until, 0), until).reshape(n, _ROWS)

    # splits: who is ahead on the other way, until its rear is clear
    in_front = there & splits & (other.y > jnp.maximum(level, 0)) & (other.y - other.length < f_out) & ~past
    gap = jnp.where(follows, behind, jnp.where(in_front, other.y - other.length - level, NO_GAP))
    need = jnp.where(gap < NO_GAP, gap + other.v * other.v / (2 * b), 2 * NO_GAP)
    gap, need = computed_once((gap, need))
    best = gap[0], need[0], other.slot[0]
    for i in range(1, _FOES):
        nearer = need[i] < best[1]
        best = tuple(jnp.where(nearer, x[i], y) for x, y in zip((gap, need, other.slot), best, strict=True))
    gap, need, slot = computed_once(best)
    least = jnp.full(n, 2 * NO_GAP, jnp.float32).at[vehicle].min(need)
    chosen = (need == least[vehicle]) & (need < NO_GAP)
    which = jnp.full(n + 1, -1, jnp.int32).at[jnp.where(chosen, vehicle, n)].max(pair)[:n]
    lead = jnp.where(which >= 0, slot[which].astype(jnp.int32), -1)
    return until, lead, jnp.where(which >= 0, gap[which], NO_GAP)


class _Way(NamedTuple):
    """A stretch on a connector."""

    start: Array
    end: Array


def _gap(driver: Driver, state: State) -> Float[Array, " N"]:
    """s that a driver keeps in front of a vehicle with priority; impatience makes it smaller."""
    impatience = jnp.clip((state.waiting - 5) / 60, 0, 1)
    return GAP_LEAD * driver.gap_factor * (1 - 0.6 * impatience)


class _Rivals(NamedTuple):
    """Two vehicles that come to a stretch, as far as both see it alike whatever keeps them."""

    sure: Array  # who goes first is beyond choice: one of them, or both, cannot wait any more
    forced: Array  # whether `me` goes first then
    major: Array  # whether `me` has priority
    mine: _Passage
    theirs: _Passage


class _Passage(NamedTuple):
    """Whether a vehicle could pass before the other."""

    soon: Array  # s until it comes
    needs: Array  # s until it has left, and the gap that it keeps
    stuck: Array  # it does not come
    held: Array  # it stands for the right of way
    calm: Array  # it stands, or can still stop without haste


def _compare(
    me: _Sight,
    mine: _Way,
    gap_me: Array,
    foe: _Sight,
    theirs: _Way,
    gap_foe: Array,
    prio: Array,
    tie: Array,
    merges: Array,
) -> _Rivals:
    """What decides whether `me` goes before `foe`; with the roles swapped, the opposite."""
    in_me, in_foe = mine.start - me.y, theirs.start - foe.y
    level_me = (in_me <= -_MARGIN).astype(jnp.int32) + (in_me < me.brake).astype(jnp.int32)
    level_foe = (in_foe <= -_MARGIN).astype(jnp.int32) + (in_foe < foe.brake).astype(jnp.int32)
    soon_me, soon_foe = computed_once(
        (travel_time(in_me, me.v, me.fast, me.a), travel_time(in_foe, foe.v, foe.fast, foe.a))
    )
    before = me.slot < foe.slot
    # both inside, or both unable to stop: who is further on
    left_me, left_foe = mine.end - me.y, theirs.end - foe.y
    nearer = jnp.where(left_me == left_foe, before, left_me < left_foe)
    sooner = jnp.where(soon_me == soon_foe, before, soon_me < soon_foe)
    forced = jnp.where(level_me == 2, nearer, sooner)
    forced = jnp.where(level_me != level_foe, level_me > level_foe, forced)

    # between those who can still choose: who has priority
    forced, sooner, level_me, level_foe = computed_once((forced, sooner, level_me, level_foe))
    longer = jnp.where(me.wait == foe.wait, sooner, me.wait > foe.wait)
    both = jnp.minimum(me.wait, foe.wait)
    rank = jnp.where((tie != 0) & (both < WAITED), tie > 0, longer)
    light = jnp.sign(me.major - foe.major)
    order = jnp.where(light != 0, light, prio.astype(light.dtype))
    stuck = (me.held > 0) & (foe.held > 0) & (both > STUCK)
    major = jnp.where(stuck, longer, jnp.where(order != 0, order > 0, rank))
    return computed_once(
        _Rivals(
            sure=(level_me > 0) | (level_foe > 0),
            forced=forced,
            major=major,
            mine=_passage(me, mine, gap_me, foe, in_me, soon_me, merges),
            theirs=_passage(foe, theirs, gap_foe, me, in_foe, soon_foe, merges),
        )
    )


def _passage(
    who: _Sight, way: _Way, gap: Array, other: _Sight, before: Array, soon: Array, merges: Array
) -> _Passage:
    """What it takes `who`, `before` m and `soon` s from the stretch, to pass in front of `other`."""
    start = jnp.minimum(who.v, who.slow)
    a = 0.8 * who.a
    # merging, it has to be in front by its length; crossing, to have left
    distance = jnp.where(merges, way.start, way.end) - who.y + who.length
    out = travel_time(distance, start, who.slow, a)
    speed = jnp.minimum(jnp.sqrt(start * start + 2 * a * jnp.maximum(distance, 0)), who.slow)
    slower = jnp.maximum(other.v - speed, 0)
    loss = jnp.where(merges, slower * slower / (4 * jnp.maximum(other.v, 1)), 0)  # other brakes with 2 m/s^2
    gap = jnp.where(who.line < 0, 0.3 * gap, gap)  # who has entered goes on
    return _Passage(
        soon=soon,
        needs=out + gap + loss,
        stuck=who.stuck > 0,
        held=who.held > 0,
        calm=(who.v < _STANDS) | (before > 2 * who.brake + _MARGIN),
    )


def _goes_first(
    rivals: _Rivals, blocks: tuple[Array, Array], kept: tuple[Array, Array] | None = None
) -> Array:
    """Whether `me` goes before `foe`, given whether they block others and for how many s others keep them."""

    def passes(minor: _Passage, major: _Passage, later: Array | float) -> Array:
        in_time = minor.needs < major.soon + jnp.where(minor.held, 0.0, later)
        return ~minor.stuck & (major.stuck | in_time)

    me, foe = (0.0, 0.0) if kept is None else kept
    mine, theirs = blocks[0] & rivals.theirs.calm, blocks[1] & rivals.mine.calm
    major = jnp.where(mine != theirs, mine, rivals.major)
    free = jnp.where(major, ~passes(rivals.theirs, rivals.mine, me), passes(rivals.mine, rivals.theirs, foe))
    return jnp.where(rivals.sure, rivals.forced, free)


def _lights(
    state: State,
    rows: Rows,
    speed: Float[Array, "N R"],
    shows: Int[Array, " L"],
    since: Float[Array, "N R"],
) -> tuple[Array, Array]:
    """m to the line where a light says stop, else NO_GAP; and what the light says of priority, [N, R].

    `since`: s that the light has shown this.
    """
    light = shows[rows.lane]
    brake = state.v * state.v
    line = jnp.maximum(rows.line, 0)
    # at yellow a driver decides once: what counts is how fast it was, and how far the line, when it began
    v_then = state.v[:, None] + jnp.maximum(-state.a, 0)[:, None] * since
    then = line + (state.v[:, None] + v_then) / 2 * since
    # who slows down for a turn comes too late even if it is near
    late = 2 * then > _YELLOW * (v_then + speed)
    could = v_then * v_then <= 2 * jnp.where(late, 1.5 * YELLOW_BRAKE, YELLOW_BRAKE) * then
    # nobody who has come down for something else, as a bend, brakes hard at the last moment
    could &= brake[:, None] <= 2 * _YELLOW_HARD * line
    # who has begun to brake, but comes down late, goes on braking
    brakes = (state.a < -_SLOWS)[:, None] & (brake[:, None] <= 2 * state.driver.b[:, None] * line)
    at_yellow = light == SignalState.YELLOW
    yellow = at_yellow & (could | brakes)
    at_red = (light == SignalState.RED) | (light == SignalState.RED_YELLOW)
    # who cannot stop any more drives on, but who only rolls stands, even with its bumper over the line
    red = at_red & (brake[:, None] <= 2 * 0.9 * state.driver.b_max[:, None] * line)
    rolls = (state.v < _STANDS)[:, None] & (rows.line > -_OVER_LINE)
    red |= (at_red | at_yellow) & rolls
    stops = (yellow | red) & (rows.x < 0) & (rows.line > -NO_GAP / 2) & (rows.connector >= 0)
    minor = (light == SignalState.GREEN_MINOR) | (light == SignalState.STOP)
    major = jnp.where(light == SignalState.GREEN_MAJOR, 1, jnp.where(minor, -1, 0))
    left_over = (rows.line < -_MARGIN) & at_red  # clears the junction first; at yellow who stops lets it
    stop = jnp.where(stops, jnp.maximum(rows.line - _MARGIN, -_MARGIN), NO_GAP)
    return stop, jnp.where(left_over, 2, major)


def _exit_full(lane_map: LaneMap, state: State, rows: Rows, own: Pair) -> Bool[Array, "N R"]:
    """Keep clear: whether a vehicle would come to stand where others cross."""
    clear = lane_map.conflicts.cross_s[rows.connector]
    needed = clear - rows.x + state.shape.length[:, None] + state.driver.s0[:, None]
    slow = (own.lead >= 0) & (state.v[own.lead] < _STANDS)
    room = own.lead_gap + 2 * state.v[own.lead]
    return (clear > 0) & slow[:, None] & (room[:, None] < needed) & (rows.line > -_MARGIN)


def _stop_sign(lane_map: LaneMap, state: State, rows: Rows) -> tuple[Bool[Array, "N R"], Bool[Array, " N"]]:
    """Whether a stop sign still has to be obeyed, and who has stopped at the one ahead."""
    sign = lane_map.conflicts.must_stop[rows.connector] & (rows.line > -_MARGIN)
    near = rows.line[:, 0] < 2.5
    stopped = sign[:, 0] & (state.stopped | ((state.v < 0.3) & near))
    return sign & ~(stopped[:, None] & (jnp.arange(_ROWS) == 0)[None]), stopped


def _where_to_stop(
    wait_s: Float[Array, "N R"],
    rows: Rows,
    sight: _Sight,
    until: Float[Array, "N R"],
    barred: Bool[Array, "N R"],
) -> tuple[Float[Array, "N R"], Bool[Array, "N R"]]:
    """m to where the front bumper waits, NO_GAP if it need not; and whether it has to."""
    taken = until < NO_GAP / 2
    until = until - _MARGIN
    # all that is taken may lie beyond the point to wait at within the junction
    beyond = taken & (wait_s > 0) & (wait_s - rows.x > -_MARGIN) & (until >= wait_s - rows.x - _MARGIN)
    until = jnp.where(beyond, jnp.maximum(wait_s - rows.x, 0), until)
    # before the line, unless the line is too near
    at_line = (rows.line > -_MARGIN) & (rows.line + _MARGIN > sight.brake)
    line = jnp.maximum(rows.line - _MARGIN, -_MARGIN)
    stop = jnp.where(taken, jnp.where(at_line & ~beyond, jnp.minimum(line, until), until), NO_GAP)
    stop = jnp.where(barred & at_line, jnp.minimum(stop, line), stop)
    return stop, taken | barred
