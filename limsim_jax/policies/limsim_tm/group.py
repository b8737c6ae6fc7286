"""Groups of vehicles that decide together: interacting pairs, and groups of fixed size.

The rules and their constants are those of LimSim's decision maker (Wen et al., LimSim, IEEE ITSC 2023).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE

SIZE = 3
"""Vehicles in a group."""

_JUNCTION = 20.0  # m between vehicles, one of them in a junction
_TIME = 3.5  # s of the follower's speed, within which it interacts with its leader
_BESIDE = 2.0  # m, added to both lengths for vehicles side by side

_NEVER = 1e9  # score of vehicles that may not be chosen


class Vehicles(NamedTuple):
    """Candidates; `V` of them, in lanes with up to `C` successors each."""

    active: Bool[Array, " V"]
    lane: Int[Array, " V"]
    s: Float[Array, " V"]  # m, front bumper
    v: Float[Array, " V"]  # m/s
    length: Float[Array, " V"]  # m
    x: Float[Array, " V"]  # m
    y: Float[Array, " V"]  # m
    wish: Int[Array, " V"]  # wanted or current lane change: +1 left, -1 right, 0 none
    # of its lane
    lane_length: Float[Array, " V"]  # m
    successors: Int[Array, "V C"]  # lane indices, `NO_LANE` for none
    left: Int[Array, " V"]
    right: Int[Array, " V"]
    in_junction: Bool[Array, " V"]


def interactions(vehicles: Vehicles) -> Bool[Array, "V V"]:
    """Pairs of vehicles that interact; symmetric, the diagonal is False.

    Two vehicles interact if they are within 20 m of each other and one is in a junction; if they are in one
    lane, or in a lane and its successor, with a gap of less than 3.5 s at the follower's speed plus its
    length; or if they are side by side and one wants to change to the lane of the other.
    """
    c = vehicles
    away = jnp.hypot(c.x[:, None] - c.x[None], c.y[:, None] - c.y[None])
    junction = (c.in_junction[:, None] | c.in_junction[None]) & (away < _JUNCTION)

    known = (c.lane != NO_LANE)[None]
    same = (c.lane[:, None] == c.lane[None]) & known
    front_to_front = c.s[None] - c.s[:, None]  # m that j is ahead of i
    reach = (_TIME * c.v + c.length)[:, None]
    follows = same & (front_to_front >= 0) & (front_to_front - c.length[None] < reach)
    onto = (c.successors[:, :, None] == c.lane[None, None]).any(1) & known
    follows |= onto & ((c.lane_length - c.s)[:, None] + (c.s - c.length)[None] < reach)

    beside = jnp.abs(front_to_front) < c.length[:, None] + c.length[None] + _BESIDE
    to_left = (c.left[:, None] == c.lane[None]) & (c.wish[:, None] > 0)
    to_right = (c.right[:, None] == c.lane[None]) & (c.wish[:, None] < 0)
    changes = (to_left | to_right) & known & beside

    one_way = junction | follows | changes
    count = c.lane.shape[0]
    return (one_way | one_way.T) & c.active[:, None] & c.active[None] & ~jnp.eye(count, dtype=bool)


def group(
    interacts: Bool[Array, "V V"],
    score: Float[Array, " V"],
    active: Bool[Array, " V"],
    groups: int,
    size: int = SIZE,
) -> Int[Array, "groups size"]:
    """Form groups greedily: the first free vehicle by `score`, its neighbors, then theirs.

    Each vehicle is in one group at most, and in exactly one if there are as many groups as vehicles. A
    vehicle that interacts with no free vehicle is alone in its group.

    Args:
      interacts: pairs, symmetric.
      score: lower comes first, such as the distance to the ego; below 1e9, ties by index.
      active: vehicles to be grouped.
      groups: number of groups.
      size: vehicles per group.

    Returns:
      Indices of vehicles, -1 for an empty place; empty groups come last.
    """

    def choose(free: Array, of: Array) -> tuple[Array, Array]:
        """The best free vehicle or -1, and those still free after that."""
        best = jnp.argmin(jnp.where(of & free, score, _NEVER)).astype(jnp.int32)
        found = jnp.where((of & free).any(), best, -1)
        return found, free & (jnp.arange(free.shape[0]) != found)

    def one(free: Array, _: None) -> tuple[Array, Array]:
        member, free = choose(free, free)
        members, near = [member], jnp.zeros_like(free)
        for _k in range(size - 1):
            near |= interacts[members[-1]] & (members[-1] >= 0)
            member, free = choose(free, near)
            members.append(member)
        return free, jnp.stack(members)

    return lax.scan(one, active, None, length=groups)[1]


__all__ = ["SIZE", "Vehicles", "group", "interactions"]
