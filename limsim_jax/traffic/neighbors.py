"""Leaders and followers: on the own lane, beside it, across lane ends.

One sort per decision puts all vehicles in order of (lane, s); every query is then a binary search.
A vehicle that changes lanes stands in the order twice, once on each lane.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, side_s, width
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.types import Config, State
from limsim_jax.xla import computed_once

_POSITION_BITS = 18  # of a sort key, at most: positions on a lane to 1 / 2^18 of its length
_FEWEST_BITS = 14  # with fewer left for the position, the number of the entry stays out of the key
_OVER_LINE = 0.3  # m of room that a body which leaves a lane keeps to the traffic that stays there
_UPSTREAM = 2  # predecessors of a lane that are searched for followers


class Ahead(NamedTuple):
    """The lanes that a vehicle will drive on: its own and those after it; NO_LANE where the way ends."""

    lane: Int[Array, "N D"]
    start: Float[Array, "N D"]  # m from the front bumper to the start of the lane; negative for the own one


class Obstacles(NamedTuple):
    """Obstacles of every vehicle, `K` of them: others, or stop obstacles, with gaps."""

    other: Int[Array, "N K"]  # slot of the other vehicle, -1 for a stop obstacle
    gap: Float[Array, "N K"]  # m at the decision, bumper to bumper; NO_GAP if there is none


class Pair(NamedTuple):
    """Leader and follower of every vehicle at a place on some lane."""

    lead: Int[Array, "*b"]  # slot, -1 if there is none
    lead_gap: Float[Array, "*b"]  # m from the own front to the rear of the leader
    lag: Int[Array, "*b"]
    lag_gap: Float[Array, "*b"]  # m from the front of the follower to the own rear


class Order(NamedTuple):
    """Vehicles in order of lane and position, `E` = 2N entries; those of no lane last.

    Entry i < N is vehicle i on its lane, entry N + i the same vehicle on its other lane.
    """

    key: UInt[Array, " E"]
    vehicle: Int[Array, " E"]  # slot
    lane: Int[Array, " E"]
    s: Float[Array, " E"]  # m, front bumper
    rank: Int[Array, " E"]  # place of every entry in the order
    first: Int[Array, " L"]  # place of the first entry of every lane, E if there is none
    last: Int[Array, " L"]  # and of the last, -1 if there is none


class SortKeys:
    """Sorts entries by row and position, and finds places among them.

    Sorting one word that holds row, position and number of the entry is several times as fast as sorting
    pairs; pairs are sorted where 32 bits are too few.

    Args:
      rows: rows go from 0 to this number; the last one is for entries that have no place.
      entries: how many there are.
    """

    def __init__(self, rows: int, entries: int) -> None:
        row_bits, number_bits = rows.bit_length(), max(1, (entries - 1).bit_length())
        self.packed = 32 - row_bits - number_bits >= _FEWEST_BITS
        self.number_bits = number_bits if self.packed else 0
        self.bits = min(_POSITION_BITS, 32 - row_bits - self.number_bits)  # for the position
        self.rows, self.entries = rows, entries

    def key(self, row: Int[Array, "*b"], share: Float[Array, "*b"]) -> UInt[Array, "*b"]:
        """Key of a row (-1: no place) and a position in it, 0 to 1; the number is 0."""
        part = (jnp.clip(share, 0.0, 1.0) * (2**self.bits - 1)).astype(jnp.uint32)
        row = jnp.where(row < 0, self.rows, row).astype(jnp.uint32)
        return ((row << self.bits) | part) << self.number_bits

    def sort(
        self, row: Int[Array, " E"], share: Float[Array, " E"]
    ) -> tuple[UInt[Array, " E"], Int[Array, " E"]]:
        """Sorted keys, and which entry stands at each place."""
        key, number = self.key(row, share), jnp.arange(self.entries, dtype=jnp.int32)
        if not self.packed:
            key, number = lax.sort((key, number), num_keys=1)
            return key, number
        key = jnp.sort(key | number.astype(jnp.uint32))
        return key, (key & (2**self.number_bits - 1)).astype(jnp.int32)

    def first_from(self, keys: UInt[Array, " E"], key: UInt[Array, "*b"]) -> Int[Array, "*b"]:
        """Place of the first entry that is not before `key`."""
        return jnp.searchsorted(keys, key, method="scan_unrolled").astype(jnp.int32)

    def first_beyond(self, keys: UInt[Array, " E"], key: UInt[Array, "*b"]) -> Int[Array, "*b"]:
        """Place of the first entry beyond `key`."""
        last = key | (2**self.number_bits - 1)
        return jnp.searchsorted(keys, last, side="right", method="scan_unrolled").astype(jnp.int32)


def _coming(
    config: Config, lane_map: LaneMap, state: State, ahead: Ahead, lane: Int[Array, "*b"]
) -> tuple[Int[Array, "*b"], Float[Array, "*b"]]:
    """The next vehicle that comes to each lane over another lane.

    -1 where none comes within `config.look_ahead`. Also returns m from it to the lane.
    """
    size, n = lane_map.length.shape[0], state.lane.shape[0]
    # one word that holds distance and slot, so that one scatter and one gather find both
    slot_bits = max(1, (n - 1).bit_length())
    unit = config.look_ahead / 2 ** min(22, 31 - slot_bits)  # m
    way, start = ahead.lane[:, 2:], ahead.start[:, 2:]
    seen = state.active[:, None] & (way != NO_LANE) & (start < config.look_ahead)
    word = (jnp.clip(start, 0, config.look_ahead) / unit).astype(jnp.uint32) << slot_bits
    word |= jnp.arange(n, dtype=jnp.uint32)[:, None]
    way, word = computed_once((jnp.where(seen, way, size), word))
    none = jnp.uint32(2**32 - 1)
    first = computed_once(jnp.full(size, none).at[way].min(word, mode="drop")[lane])
    slot: Array = (first & (2**slot_bits - 1)).astype(jnp.int32)
    return jnp.where(first < none, slot, -1), (first >> slot_bits).astype(jnp.float32) * unit


def lanes_ahead(config: Config, lane_map: LaneMap) -> int:
    """Number of lanes ahead that are looked at: more on maps of short lanes."""
    return max(config.look_ahead_lanes, lane_map.lanes_in_sight)


@jax.named_scope("look_ahead")
def look_ahead(config: Config, lane_map: LaneMap, state: State) -> Ahead:
    """Follow the route of every vehicle over `lanes_ahead` lanes beyond its own."""
    return follow_routes(config, lane_map, state.lane, state.s, state.goal)


def follow_routes(
    config: Config, lane_map: LaneMap, lane: Int[Array, " N"], s: Float[Array, " N"], goal: Int[Array, " N"]
) -> Ahead:
    """The first lanes on routes from `s` (m) of `lane` to `goal`."""
    lanes, starts = [lane], [-s]
    for _ in range(lanes_ahead(config, lane_map)):
        starts.append(starts[-1] + lane_map.length[lanes[-1]])
        lanes.append(lane_map.routes.next_lane[lanes[-1], goal])
    return Ahead(jnp.stack(lanes, -1), jnp.stack(starts, -1))


@jax.named_scope("sort_vehicles")
def sort_vehicles(lane_map: LaneMap, state: State) -> Order:
    """Put all active vehicles in order; those that change lanes also on the lane they change to."""
    other, other_s = other_lane(lane_map, state)
    lane = jnp.concatenate([jnp.where(state.active, state.lane, NO_LANE), other])
    s = jnp.concatenate([state.s, other_s])
    size, count = lane_map.length.shape[0], lane.shape[0]
    place = jnp.arange(count, dtype=jnp.int32)
    key, entry = SortKeys(size, count).sort(lane, s / lane_map.length[lane])
    lane, s = lane[entry], s[entry]
    # unique indices, the others out of bounds and dropped: no two writes meet
    changes = lane[1:] != lane[:-1]
    begins = jnp.concatenate([jnp.ones(1, bool), changes]) & (lane != NO_LANE)
    ends = jnp.concatenate([changes, jnp.ones(1, bool)]) & (lane != NO_LANE)
    unique = {"mode": "drop", "unique_indices": True}
    return Order(
        key=key,
        vehicle=jnp.where(entry < count // 2, entry, entry - count // 2),
        lane=lane,
        s=s,
        rank=jnp.zeros(count, jnp.int32).at[entry].set(place, **unique),
        first=jnp.full(size, count, jnp.int32).at[jnp.where(begins, lane, size + place)].set(place, **unique),
        last=jnp.full(size, -1, jnp.int32).at[jnp.where(ends, lane, size + place)].set(place, **unique),
    )


def other_lane(lane_map: LaneMap, state: State) -> tuple[Int[Array, " N"], Float[Array, " N"]]:
    """The other lane of vehicles that change lanes, and s there (m).

    NO_LANE for all others. From the start it is the lane that the vehicle moves to, then the one that it
    comes from as long as its body is there.
    """
    side = jnp.where(state.crossed, -state.side, state.side)
    lane = jnp.where(side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    reach = jnp.abs(state.d) + state.shape.width / 2 + _OVER_LINE
    there = ~state.crossed | (reach > width(lane_map, state.lane, state.s) / 2)
    lane = jnp.where(state.active & (side != 0) & there, lane, NO_LANE)
    return lane, side_s(lane_map, state.lane, state.s, side)


def place_of(
    order: Order, lane_map: LaneMap, lane: Int[Array, "*b"], s: Float[Array, "*b"]
) -> Int[Array, "*b"]:
    """Place of the first entry beyond `s` (m) on `lane`."""
    sorting = SortKeys(lane_map.length.shape[0], order.key.shape[0])
    return sorting.first_beyond(order.key, sorting.key(lane, s / lane_map.length[lane]))


def _entry(
    order: Order, position: Int[Array, "*b"], lane: Int[Array, "*b"]
) -> tuple[Int[Array, "*b"], Float[Array, "*b"]]:
    """Vehicle and s of the entry at `position`; vehicle -1 if there is none there on `lane`."""
    last = order.key.shape[0] - 1
    place = computed_once(jnp.clip(position, 0, last))
    there, vehicle, s = computed_once((order.lane[place], order.vehicle[place], order.s[place]))
    there = (position == place) & (there == lane) & (lane != NO_LANE)
    return jnp.where(there, vehicle, -1), s


@jax.named_scope("neighbors")
def neighbors(
    config: Config,
    lane_map: LaneMap,
    order: Order,
    state: State,
    lane: Int[Array, "N K"],
    s: Float[Array, "N K"],
    here: Int[Array, "N K"],
    ahead: Ahead | None = None,
) -> Pair:
    """Leaders and followers of every vehicle at K places each.

    The leader is looked for along the route from there, within `config.look_ahead`. The follower is the
    next vehicle behind on the lane. If there is none, it is the nearest of the first vehicles on two
    predecessors and, given `ahead`, of the vehicles that come from farther back. The vehicle itself does
    not count. Without a lane there are no neighbours.

    Args:
      config: of the run.
      lane_map: where.
      order: of all vehicles.
      state: the world.
      lane: of the places.
      s: m along it.
      here: place in the order of the first entry beyond: `place_of`, or `rank` + 1 where a vehicle is.
      ahead: routes of all vehicles.
    """
    # vehicles last: their axis is the long one, along which XLA vectorises
    lane, s, here = lane.T, s.T, here.T
    me = jnp.arange(lane.shape[-1], dtype=jnp.int32)[None]
    goal = jnp.broadcast_to(state.goal[None], lane.shape)
    length = state.shape.length

    lanes, starts = [], []
    start, after = lane_map.length[lane] - s, lane
    for _ in range(lanes_ahead(config, lane_map)):
        following = lane_map.routes.next_lane[after, goal]
        # where the way ends, tails of vehicles that drive on may still be in front
        after = jnp.where(following == NO_LANE, lane_map.successors[after, 0], following)
        lanes.append(after)
        starts.append(start)
        start = start + lane_map.length[after]
    on, offset = jnp.stack(lanes), jnp.stack(starts)  # [D, K, N]
    behind = jnp.stack([lane_map.predecessors[lane, k] for k in range(_UPSTREAM)])  # [P, K, N]
    first, last = order.first[on], order.last[behind]

    # leader: the next entry that is not the vehicle itself, or the last vehicle of the following lanes
    vehicle, position = _entry(order, here, lane)
    vehicle2, position2 = _entry(order, here + 1, lane)
    skip = vehicle == me
    lead, lead_at = jnp.where(skip, vehicle2, vehicle), jnp.where(skip, position2, position) - s
    vehicle, position = _entry(order, first, on)
    vehicle2, position2 = _entry(order, first + 1, on)
    skip = vehicle == me[None]
    vehicle, position = jnp.where(skip, vehicle2, vehicle), offset + jnp.where(skip, position2, position)
    vehicle, position = computed_once((vehicle, position))
    for k in range(len(lanes)):
        new = (lead < 0) & (vehicle[k] >= 0)
        lead = jnp.where(new, vehicle[k], lead)
        lead_at = jnp.where(new, position[k], lead_at)
    lead, lead_at = computed_once((lead, lead_at))
    lead_gap = lead_at - length[lead]
    lead = jnp.where(lead_gap < config.look_ahead, lead, -1)

    # follower: the entry before, or the first vehicle on a lane that leads here
    vehicle, position = _entry(order, here - 1, lane)
    vehicle2, position2 = _entry(order, here - 2, lane)
    skip = vehicle == me
    lag, lag_at = jnp.where(skip, vehicle2, vehicle), s - jnp.where(skip, position2, position)
    vehicle, position = _entry(order, last, behind)
    vehicle = jnp.where(vehicle == me[None], -1, vehicle)
    distance = s[None] + lane_map.length[behind] - position
    distance = jnp.where(vehicle >= 0, distance, NO_GAP)
    upstream = (lag < 0) & (lane != NO_LANE)
    for k in range(_UPSTREAM):
        nearer = upstream & ((distance[k] < lag_at) | (k == 0))
        lag, lag_at = jnp.where(nearer, vehicle[k], lag), jnp.where(nearer, distance[k], lag_at)
    if ahead is not None:
        vehicle, start = _coming(config, lane_map, state, ahead, lane)
        distance = s + start
        nearer = upstream & (vehicle >= 0) & (vehicle != me) & ((distance < lag_at) | (lag < 0))
        lag, lag_at = jnp.where(nearer, vehicle, lag), jnp.where(nearer, distance, lag_at)
    found = Pair(
        lead,
        jnp.where(lead >= 0, lead_gap, NO_GAP),
        lag,
        jnp.where(lag >= 0, lag_at - length[None], NO_GAP),
    )
    return Pair(*(x.T for x in found))
