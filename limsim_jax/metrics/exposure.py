"""Exposure: how long an ego is in each cell of its operational design domain, counted while worlds run.

`CountExposure` is a measure of a rollout. Its memory are two integers per cell and ego, the number of physics
steps and the first of them. Time is steps times `dt`. The domain and its bins are those of `domain`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, pose
from limsim_jax.metrics.domain import (
    CHANGE_LEFT,
    CHANGE_RIGHT,
    IN_JUNCTION,
    KEEP,
    SIDEWAYS,
    STAND,
    STANDS,
    Domain,
    Places,
)
from limsim_jax.metrics.safety import NO_GAP, NONE, ttc_1d
from limsim_jax.traffic.ego import arrived
from limsim_jax.traffic.engine import Tick
from limsim_jax.types import Config, State, Status

NEVER = np.iinfo(np.int32).max
"""First step of a cell that is not reached."""


class Moment(NamedTuple):
    """An ego after a physics step; with an axis of egos in a world of several."""

    step: Int[Array, "*e"]  # physics steps since the start
    there: Bool[Array, "*e"]  # on the road, and its policy works
    arrived: Bool[Array, "*e"]
    lane: Int[Array, "*e"]
    v: Float[Array, "*e"]  # m/s
    gap: Float[Array, "*e"]  # m to the leader, `NO_GAP` for none
    v_leader: Float[Array, "*e"]  # m/s
    side: Int[Array, "*e"]  # lane change: +1 to the left, -1 to the right, 0 none


class Counted(NamedTuple):
    """What `CountExposure` finds: `E` egos, `C` cells."""

    steps: Int[Array, "E C"]  # physics steps in each cell
    first: Int[Array, "E C"]  # number of the first of them, from 1; `NEVER`


class ExposureCarry(NamedTuple):
    """State of `CountExposure`."""

    counted: Counted
    goal: Int[Array, " E"]  # at the start: another one is no arrival
    started: Bool[Array, " E"]
    over: Bool[Array, " E"]


@dataclass(frozen=True, eq=False)
class CountExposure:
    """Steps of the first egos in every cell, for `Rollout.measure`.

    A step counts by the state at its end, from the first step of the ego until it arrives, leaves, or its
    policy fails. The step in which it leaves the map has no place and does not count.

    Attributes:
      domain: the cells.
      places: what the lanes of the map are.
      egos: E, at least 1.
    """

    domain: Domain
    places: Places
    egos: int = 1

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[ExposureCarry, None]:
        """Nothing counted. The start does not count."""
        slot = state.egos.slot[: self.egos]
        shape = self.egos, self.domain.size
        counted = Counted(jnp.zeros(shape, jnp.int32), jnp.full(shape, NEVER, jnp.int32))
        over = jnp.zeros(self.egos, bool)
        return ExposureCarry(counted, state.goal[slot], state.active[slot], over), None

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Moment:
        """The egos after a physics step, `[E]`."""
        state = tick.state
        slot = state.egos.slot[: self.egos]
        other, gap = (x[slot, 0] for x in tick.decision.obstacles)
        leads = (other >= 0) & state.active[other]
        lane, v = state.lane[slot], state.v[slot]
        return Moment(
            step=jnp.broadcast_to(state.step, slot.shape),
            there=state.active[slot] & ((state.status[slot] & int(Status.NOT_FINITE)) == 0),
            arrived=arrived(lane_map, state)[: self.egos],
            lane=lane,
            v=v,
            gap=jnp.where(leads, jnp.maximum(gap + tick.x[other] - tick.x[slot], 0), NO_GAP),
            v_leader=jnp.where(leads, state.v[other], 0),
            side=_side(lane_map, state, tick.box, self.egos),
        )

    def update(
        self,
        config: Config,
        lane_map: LaneMap,
        carry: ExposureCarry,
        records: Moment,
        *,
        start: bool | Bool[Array, ""] = False,
    ) -> ExposureCarry:
        """Count the steps since the last decision, `[decision_every, E]`."""
        del start

        def one(carry: ExposureCarry, now: Moment) -> tuple[ExposureCarry, Bool[Array, " E"]]:
            counts = now.there & ~carry.over
            reached = now.arrived & lane_map.routes.is_goal[now.lane, carry.goal]
            over = carry.over | (counts & reached) | (carry.started & ~now.there)
            return carry._replace(started=carry.started | now.there, over=over), counts

        _, goal, started, over = carry
        none = Counted(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))
        ended, counts = lax.scan(one, ExposureCarry(none, goal, started, over), records)
        cell = cell_of(self.domain, self.places, records)
        ego = jnp.broadcast_to(jnp.arange(self.egos), cell.shape)
        steps, first = carry.counted
        steps = steps.at[ego, cell].add(counts.astype(jnp.int32))
        first = first.at[ego, cell].min(jnp.where(counts, records.step, NEVER))
        return ended._replace(counted=Counted(steps, first))

    def result(self, config: Config, lane_map: LaneMap, carry: ExposureCarry) -> Counted:
        """Steps and first steps, `[E, C]`."""
        return carry.counted


def cell_of(domain: Domain, places: Places, now: Moment) -> Int[Array, "*e"]:
    """The cell of an ego, a number below `domain.size`."""
    leads = now.gap < NO_GAP
    ttc = ttc_1d(now.gap, now.v, now.v_leader)
    road = jnp.asarray(places.road)[now.lane]
    value: dict[str, Any] = {
        "speed": lambda edges: _bin(edges, now.v),
        "gap": lambda edges: _bin(edges, now.gap, leads),
        "ttc": lambda edges: _bin(edges, ttc, leads & (ttc < NONE)),
        "manoeuvre": lambda _: _manoeuvre(places, now, road),
        "road": lambda _: road,
    }
    found = jnp.zeros_like(now.lane)
    for dimension in domain.dimensions:
        found = found * dimension.size + value[dimension.name](dimension.edges)
    return found


def _bin(
    edges: tuple[float, ...], x: Float[Array, "*e"], known: Bool[Array, "*e"] | None = None
) -> Int[Array, "*e"]:
    """Bin of a number; behind all others where it is not known. NaN is in the first."""
    found = sum(((x >= edge).astype(jnp.int32) for edge in edges), start=jnp.zeros(x.shape, jnp.int32))
    return found if known is None else jnp.where(known, found, len(edges) + 1)


def _manoeuvre(places: Places, now: Moment, road: Int[Array, "*e"]) -> Int[Array, "*e"]:
    change = jnp.where(now.side > 0, CHANGE_LEFT, CHANGE_RIGHT)
    plain = jnp.where(now.side != 0, change, KEEP)
    moves = jnp.where(road == IN_JUNCTION, jnp.asarray(places.turn)[now.lane], plain)
    return jnp.where(now.v < STANDS, STAND, moves)


def _side(lane_map: LaneMap, state: State, box: Float[Array, "N 5"], egos: int) -> Int[Array, " E"]:
    """To which side egos change lanes.

    Egos on lanes know. Free ones reach over the line to a lane in the same direction and move sideways, by
    `SIDEWAYS` at least.
    """
    slot = state.egos.slot[:egos]
    lane, side, v = state.lane[slot], state.side[slot], state.v[slot]
    sideways = v * jnp.sin(box[slot, 2] - pose(lane_map, lane, state.s[slot])[2])
    beside = jnp.where(side > 0, lane_map.left[lane], lane_map.right[lane])
    changes = (side != 0) & (beside != NO_LANE) & (jnp.abs(sideways) >= SIDEWAYS)
    free = jnp.where(changes, jnp.sign(sideways).astype(side.dtype), 0)
    return jnp.where(state.egos.free[:egos], free, side)


# --- on the host


class Sparse(NamedTuple):
    """Cells that were reached: a row per world, ego and cell, sorted."""

    world: NDArray[np.int64]  # [K], place among the seeds
    ego: NDArray[np.int64]  # [K]
    cell: NDArray[np.int64]  # [K]
    steps: NDArray[np.int64]  # [K]
    first: NDArray[np.int64]  # [K], physics steps from the start to the first one there


def sparse(counted: Counted, world: int = 0) -> Sparse:
    """The cells with a count, of arrays `[W, E, C]`; worlds are numbered from `world` on."""
    steps, first = np.asarray(counted.steps), np.asarray(counted.first)
    places = np.nonzero(steps)
    worlds, egos, cells = (x.astype(np.int64) for x in places)
    return Sparse(worlds + world, egos, cells, steps[places].astype(np.int64), first[places].astype(np.int64))


def joined(parts: list[Sparse]) -> Sparse:
    """All rows of parts whose worlds rise."""
    return Sparse(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def over(found: Sparse, cells: NDArray[np.int64]) -> Sparse:
    """Rows of a coarser domain, in which cell `c` is `cells[c]`."""
    keys = np.stack([found.world, found.ego, cells[found.cell]], 1)
    unique, row = np.unique(keys, axis=0, return_inverse=True)
    row, count = row.ravel(), len(unique)
    steps = np.bincount(row, found.steps, count).astype(np.int64)
    first = np.full(count, NEVER, np.int64)
    np.minimum.at(first, row, found.first)
    world, ego, cell = unique.T.copy()
    return Sparse(world, ego, cell, steps, first)
