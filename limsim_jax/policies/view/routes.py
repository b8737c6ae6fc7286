"""Belief about routes: at the next split a vehicle takes the branch that would matter most to the planner.

A vehicle that signals takes a branch on that side. Of the branches that remain, the planner expects one that
meets its own route, for prudence; of several, and if there is none, the straightest. Later splits do not
matter within the horizon of a planner. A vehicle beyond a split shows by its lane where it goes.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose
from limsim_jax.types import State

TURN = 0.35
"""rad, change of heading from which a branch is a turn (20 degrees)."""

TURN_WITHIN = 30.0
"""m of a branch within which that counts."""

_LANES = 4  # lanes ahead that are searched for a split
_OWN_LANES = 5  # lanes of the own route beyond the present one
_MUST_CHANGE = 1e6  # m, cost of a goal that needs a lane change


def believed_goals(
    lane_map: LaneMap,
    state: State,
    mine: Bool[Array, " N"],
    signals: Bool[Array, " N"],
    signal_distance: float,
) -> Int[Array, " N"]:
    """Goals that stand for the believed routes of all vehicles.

    Args:
      lane_map: the map.
      state: the world now, with the true goals.
      mine: vehicles that the planner drives; it knows their goals.
      signals: vehicles whose turn signals can be read.
      signal_distance: m before a split from which they signal.

    Returns:
      Columns of the route table.
    """
    routes, successors = lane_map.routes, lane_map.successors
    beside = jnp.where(state.side > 0, lane_map.left[state.lane], lane_map.right[state.lane])
    moves = (state.side != 0) & ~state.crossed & (beside != NO_LANE)
    lane = jnp.where(moves, beside, state.lane)
    split, room = lane, lane_map.length[lane] - state.s
    for _ in range(_LANES):
        after = successors[split]
        single = (after != NO_LANE).sum(-1) == 1
        split = jnp.where(single, after[:, 0], split)
        room = jnp.where(single, room + lane_map.length[after[:, 0]], room)

    branch = successors[split]  # [N C]
    following = routes.next_lane[split]  # [N G]
    there = (branch != NO_LANE) & (following[:, None] == branch[..., None]).any(-1)
    turn = _turn(lane_map, split, branch)
    side = jnp.where(turn > TURN, 1, jnp.where(turn < -TURN, -1, 0))
    taken = branch == jnp.take_along_axis(following, state.goal[:, None], 1)
    taken &= there
    shown = signals & taken.any(-1) & (room < signal_distance)
    fits = there & (~shown[:, None] | (side == jnp.sum(jnp.where(taken, side, 0), -1)[:, None]))

    score = jnp.where(_meets(lane_map, state, branch), 10.0, 0.0) - jnp.abs(turn)
    best = jnp.argmax(jnp.where(fits, score, -jnp.inf), -1)[:, None]
    expected = jnp.take_along_axis(branch, best, 1)
    match = jnp.where(fits.any(-1)[:, None], following == expected, routes.is_goal[split])
    match |= routes.reachable[lane] & ~match.any(-1, keepdims=True)
    changes = jnp.abs(routes.lanes_to_go[lane]).astype(state.s.dtype)
    cost = routes.distance[split] + _MUST_CHANGE * changes
    goal = jnp.argmin(jnp.where(match, cost, jnp.inf), -1).astype(state.goal.dtype)
    return jnp.where(mine, state.goal, goal)


def _turn(lane_map: LaneMap, split: Int[Array, " N"], branch: Int[Array, "N C"]) -> Float[Array, "N C"]:
    """Change of heading along each branch, rad, left > 0."""
    before = pose(lane_map, split, lane_map.length[split])[2]
    reach = jnp.minimum(lane_map.length[branch], TURN_WITHIN)
    return wrap_angle(pose(lane_map, branch, reach)[2] - before[:, None])


def _meets(lane_map: LaneMap, state: State, branch: Int[Array, "N C"]) -> Bool[Array, "N C"]:
    """Whether a branch is on an ego's route or meets it."""
    slot = state.egos.slot
    lane, goal = jnp.where(slot >= 0, state.lane[slot], NO_LANE), state.goal[slot]
    lanes = [lane]
    for _ in range(_OWN_LANES):
        lanes.append(lane_map.routes.next_lane[lanes[-1], goal])
    table = lane_map.conflicts
    foe = table.lane[table.foe[table.connector[branch]]]  # [N C K]
    near = jnp.concatenate([branch[..., None], foe], -1)
    own = jnp.stack(lanes).reshape(1, 1, 1, -1)
    return ((near[..., None] == own) & (own != NO_LANE)).any((-1, -2))
