"""Maneuvers by search: groups of vehicles, their corridors, and the search in each.

A group is searched on the corridor of its first member: `LANES` lanes around its own, with the positions of
all vehicles along and across its path. Where paths cross, the right of way decides; it enters the search as
positions to stop at.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, width
from limsim_jax.policies.limsim_tm import group, search
from limsim_jax.policies.predict import Prediction
from limsim_jax.policies.reference import ReferencePath, project_onto
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.types import State

LANES = 5
"""Lanes of a corridor; the own lane is in the middle."""

_MIDDLE = LANES // 2
_NEAR = 60.0  # m, within which a vehicle that is not planned for may join a group
_FAR_AWAY = 1e3  # m off the path, for vehicles to be ignored


class Maneuvers(NamedTuple):
    """Maneuvers of `V` vehicles until the next search."""

    side: Int[Array, " V"]  # lane change: +1 left, -1 right, 0 none
    v: Float[Array, "V H"]  # m/s, at the moments of the search
    action: Int[Array, "V D"]  # `Meta`


class Corridor(NamedTuple):
    """Lanes that `V` vehicles may change to, counted to the left."""

    left: Int[Array, " V"]  # lanes on the left that it may change to, at most `_MIDDLE`
    right: Int[Array, " V"]
    wanted_left: Int[Array, " V"]  # the leftmost lane that leads to the goal, relative to the own one
    wanted_right: Int[Array, " V"]
    to_go: Float[Array, " V"]  # m until it must be in one that leads to the goal


def corridor(
    lane_map: LaneMap,
    lane: Int[Array, " V"],
    s: Float[Array, " V"],
    goal: Int[Array, " V"],
    vehicle_class: Array,
) -> Corridor:
    """Lanes beside vehicles, and those that lead to their goals; `s` in m."""
    routes = lane_map.routes
    found, wanted, room = [], [], []
    own = routes.lanes_to_go[lane, goal]
    for table, allowed in (
        (lane_map.left, lane_map.may_change_left),
        (lane_map.right, lane_map.may_change_right),
    ):
        here, count, good = lane, jnp.zeros_like(lane), jnp.zeros_like(lane)
        open_, leads = jnp.ones(lane.shape, bool), own == 0
        last = jnp.full(s.shape, NO_GAP, s.dtype)
        for _ in range(_MIDDLE):
            beside = table[here]
            usable = ((lane_map.access[beside] >> vehicle_class) & 1) == 1
            open_ &= allowed[here] & (beside != NO_LANE) & usable & ~lane_map.is_connector[here]
            count = count + open_.astype(count.dtype)
            leads &= open_ & (routes.lanes_to_go[beside, goal] == 0) & routes.reachable[beside, goal]
            good = good + leads.astype(good.dtype)
            astray = open_ & ~leads
            last = jnp.where(astray, jnp.minimum(last, routes.change_distance[beside, goal] - s), last)
            here = jnp.where(open_, beside, here)
        found.append(count)
        wanted.append(good)
        room.append(last)
    must = own != 0
    wanted_left = jnp.asarray(jnp.where(must, own, wanted[0]))
    wanted_right = jnp.asarray(jnp.where(must, own, -wanted[1]))
    return Corridor(
        left=found[0],
        right=found[1],
        wanted_left=wanted_left,
        wanted_right=wanted_right,
        to_go=jnp.where(must, routes.change_distance[lane, goal] - s, jnp.minimum(room[0], room[1])),
    )


def grouped(
    lane_map: LaneMap,
    state: State,
    slot: Int[Array, " V"],
    drives: Bool[Array, " V"],
    lane: Int[Array, " V"],
    wish: Int[Array, " V"],
    x: Float[Array, " N"],
    y: Float[Array, " N"],
    near: Int[Array, "V K"],
    counts: Bool[Array, "V K"],
) -> Int[Array, "V G"]:
    """Slots of the vehicles of each group, -1 for none; every planned vehicle is in one.

    Groups consist of planned vehicles that interact. Free places go to other vehicles nearby (`near` where it
    `counts`), whose maneuvers are then searched together with the rest.
    """
    c = group.Vehicles(
        active=drives, lane=jnp.where(drives, lane, NO_LANE), s=state.s[slot], v=state.v[slot],
        length=state.shape.length[slot], x=x[slot], y=y[slot], wish=wish,
        lane_length=lane_map.length[lane], successors=lane_map.successors[lane],
        left=lane_map.left[lane], right=lane_map.right[lane], in_junction=lane_map.is_connector[lane],
    )  # fmt: skip
    score = jnp.arange(slot.shape[0], dtype=jnp.float32)
    rows = group.group(group.interactions(c), score, drives, slot.shape[0])
    members = jnp.where(rows >= 0, slot[rows], -1)
    first = jnp.maximum(rows[:, 0], 0)
    candidates = jnp.where(counts[first], near[first], -1)  # [V K]
    planned = (candidates[:, :, None] == jnp.where(drives, slot, -2)[None, None]).any(-1)
    candidates = jnp.where(planned | (rows[:, :1] < 0), -1, candidates)
    order = jnp.where(candidates >= 0, jnp.cumsum(candidates >= 0, -1, dtype=jnp.int32), 0)
    places = []
    for k in range(group.SIZE):
        empty = members[:, k] < 0
        nth = jnp.sum(members[:, : k + 1] < 0, -1, dtype=jnp.int32)
        pick = jnp.where(order == nth[:, None], candidates, -1).max(-1)
        places.append(jnp.where(empty & (nth > 0), pick, members[:, k]))
    return jnp.stack(places, -1)


def scene(
    lane_map: LaneMap,
    state: State,
    member: Int[Array, " G"],
    path: ReferencePath,
    near: Int[Array, " K"],
    prediction: Prediction,
    lane: Int[Array, " N"],
    side: Int[Array, " N"],
    wall: Float[Array, " N"],
) -> search.Scene:
    """The search problem of one group.

    Args:
      lane_map: the map.
      state: the world now.
      member: slots of the group, -1 for none.
      path: of the first member, `[1 M]`; the corridor runs along it.
      near: slots of other vehicles, -1 for none.
      prediction: at the moments of the search.
      lane: of the centres of all bodies.
      side: lane changes in progress.
      wall: m to where each vehicle must stop.
    """
    everybody = jnp.concatenate([member, jnp.where((near[:, None] == member[None]).any(-1), -1, near)])
    x, y = prediction.x[everybody], prediction.y[everybody]  # [G+K H]
    s, d, along = (found[0] for found in project_onto(path, x[None], y[None]))
    turned = jnp.cos(prediction.heading[everybody] - along)
    s = s + state.shape.length[everybody][:, None] / 2  # fronts
    count = member.shape[0]
    breadth = width(lane_map, lane[member[0]], state.s[member[0]])
    across = d + _MIDDLE * breadth

    own = lane[member]
    c = corridor(lane_map, own, state.s[member], state.goal[member], state.shape.vehicle_class[member])
    active = (member >= 0) & (jnp.abs(d[:count, 0]) < (_MIDDLE + 0.5) * breadth) & (turned[:count, 0] > 0.5)
    at = jnp.clip(jnp.round(across[:count, 0] / breadth), 0, LANES - 1).astype(jnp.int32)
    driver = jax.tree.map(lambda value: value[member], state.driver)
    limit = driver.speed_factor * lane_map.speed_limit[own]
    stop = jnp.where(wall[member] < NO_GAP / 2, s[:count, 0] + wall[member], NO_GAP)
    mine = at[:, None] == jnp.arange(LANES)[None]
    others = everybody[count:]
    away = (turned[count:] < 0.3) | (jnp.abs(s[count:]) > path.reach)
    lanes = lambda low, value: jnp.clip(at + value, low, LANES - 1)  # noqa: E731
    return search.Scene(
        active=active,
        s=s[:count, 0],
        v=state.v[member],
        a=state.a[member],
        lane=at,
        d=across[:count, 0] - at.astype(d.dtype) * breadth,
        aim=lanes(0, jnp.clip(side[member], -c.right, c.left)),
        length=state.shape.length[member],
        width=state.shape.width[member],
        v0=jnp.maximum(jnp.minimum(limit, driver.v_max), 1.0),
        driver=driver,
        first_lane=lanes(0, -c.right),
        last_lane=lanes(0, c.left),
        wanted_first=lanes(0, c.wanted_right),
        wanted_last=lanes(0, c.wanted_left),
        to_go=c.to_go,
        stop=jnp.where(mine, stop[:, None], NO_GAP),
        other_active=others >= 0,
        other_s=s[count:],
        other_y=jnp.where(away, _FAR_AWAY, across[count:]),
        other_v=jnp.broadcast_to(state.v[others][:, None], away.shape),
        other_length=state.shape.length[others],
        other_width=state.shape.width[others],
        lane_width=breadth,
    )


def decide_maneuvers(
    settings: search.Settings,
    lane_map: LaneMap,
    state: State,
    slot: Int[Array, " V"],
    members: Int[Array, "V G"],
    path: ReferencePath,
    near: Int[Array, "V K"],
    prediction: Prediction,
    lane: Int[Array, " N"],
    side: Int[Array, " N"],
    wall: Float[Array, " N"],
    previous: Int[Array, "V D"],
    key: Key[Array, ""],
) -> Maneuvers:
    """Maneuvers of the vehicles in `slot`, by a search in every group."""
    row_of = lambda which: jnp.argmax(slot[None] == which[:, None], -1)  # noqa: E731
    first = row_of(members[:, 0])

    def one(member: Array, row: Array, key: Key[Array, ""]) -> tuple[search.Plan, Array]:
        mine = jax.tree.map(lambda value: value[row][None], path)
        found = scene(lane_map, state, member, mine, near[row], prediction, lane, side, wall)
        known = (slot[None] == member[:, None]).any(-1) & (member >= 0)
        before = jnp.where(
            known[:, None], previous[row_of(member)], search.no_plan(member.shape[0], settings.decisions)
        )
        return search.search(settings, found, before, key), found.lane

    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(members.shape[0]))
    plans, lanes = jax.vmap(one)(members, first, keys)
    # every planned vehicle is in exactly one group
    flat = members.reshape(-1)
    place = jnp.argmax(flat[None] == slot[:, None], -1)
    found = (flat[None] == slot[:, None]).any(-1) & (slot >= 0)
    pick = lambda value: value.reshape(-1, *value.shape[2:])[place]  # noqa: E731
    soon = settings.substeps
    turn = jnp.round(pick(plans.aim)[:, soon]).astype(jnp.int32) - pick(lanes)
    return Maneuvers(
        side=jnp.where(found & ~pick(plans.crashed), jnp.clip(turn, -1, 1), 0),
        v=pick(plans.v),
        action=pick(plans.action),
    )


def neighbours(
    gap: Float[Array, "V K"], d: Float[Array, "V K"], there: Bool[Array, "V K"]
) -> Bool[Array, "V K"]:
    """Vehicles around that may join a group: the two nearest on and beside the own lane."""
    close = there & (jnp.abs(d) < 5.5) & (gap < _NEAR)
    best = lax.top_k(jnp.where(close, -gap, -NO_GAP), min(group.SIZE - 1, gap.shape[1]))[0][:, -1:]
    return close & (-gap >= best)
