"""Faults of background traffic: what `soundness` and `random_maps` count while worlds run."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.conflicts import ConflictTable, ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.simulation.totals import Totals
from limsim_jax.traffic.bodies import tails
from limsim_jax.traffic.engine import Tick
from limsim_jax.types import Config, State, Status

RANK = np.zeros(len(SignalState), np.int32)  # by what a light shows; at red, vehicles inside clear first
RANK[[SignalState.RED, SignalState.YELLOW, SignalState.RED_YELLOW]] = 2
RANK[SignalState.GREEN_MAJOR] = 1
RANK[[SignalState.GREEN_MINOR, SignalState.STOP]] = -1
STANDS = 0.1  # m/s, below which SUMO counts a vehicle as waiting
NOSE = 0.5  # m, by which a vehicle that stops to yield may stand too far


class Changes:
    """Lane changes that routes need: by how many vehicles, after a stop, or never.

    A `simulation.rollout.Measure`; every vehicle counts once.
    """

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[Any, None]:
        """The count before any vehicle is seen."""
        none = jnp.zeros((3, *state.active.shape), bool)
        return (state.entered, none, jnp.zeros(3, jnp.int32)), None

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Any:
        """The vehicle in each slot, and which of the three it does."""
        state = tick.state
        must = lane_map.routes.lanes_to_go[state.lane, state.goal] != 0
        missed = (state.status & int(Status.MISSED_ROUTE)) != 0
        each = jnp.stack([must, must & (state.v < STANDS), missed])
        return jnp.where(state.active, state.entered, -1), state.active & each

    def update(
        self, config: Config, lane_map: LaneMap, carry: Any, records: Any, *, start: Any = False
    ) -> Any:
        """Count vehicles that were not counted before."""

        def step(carry: Any, record: Any) -> tuple[Any, None]:
            vehicle, known, counts = carry
            known &= vehicle == record[0]
            counts += jnp.sum(record[1] & ~known, -1, dtype=jnp.int32)
            return (record[0], known | record[1], counts), None

        return jax.lax.scan(step, carry, records)[0]

    def result(self, config: Config, lane_map: LaneMap, carry: Any) -> Any:
        """Numbers of vehicles: have to change, stopped before, never did."""
        return carry[-1]


def mirror_of(table: ConflictTable) -> NDArray[np.int32]:
    """Flat index of each crossing in its foe's row, `[K, C]`."""
    foe, cross = np.asarray(table.foe), np.asarray(table.type) == ConflictType.CROSS
    places = np.stack([np.asarray(x) for x in (table.s_in, table.s_out, table.f_in, table.f_out)], -1)
    mirror = np.zeros(foe.shape, np.int32)
    for k, c in zip(*np.nonzero(cross), strict=True):
        j = foe[k, c]
        same = (foe[j] == k) & (places[j] == places[k, c][[2, 3, 0, 1]]).all(-1)
        mirror[k, c] = j * foe.shape[1] + int(np.argmax(same))
    return mirror


class Watch:
    """Crossing conflicts, those against priority, and `Changes`: a `simulation.rollout.Measure`.

    A crossing conflict is a pair of vehicles inside the stretch where their lanes are less than 2.3 m apart,
    so they need not touch. It is against priority if the vehicle that must yield (by signal, otherwise by the
    map) moves there, more than `NOSE` inside.
    """

    def __init__(self, mirror: jax.Array | NDArray[np.int32]) -> None:
        self.changes = Changes()
        self.mirror = mirror  # of `mirror_of`

    def _pairs(self, lane_map: LaneMap, state: State) -> tuple[jax.Array, jax.Array]:
        """Entries `[K, C]` with vehicles on both sides, and those against priority."""
        table = lane_map.conflicts
        behind, front = tails(lane_map, state)
        lane = jnp.concatenate([jnp.where(state.active, state.lane, NO_LANE)[:, None], behind], -1)
        front = jnp.concatenate([state.s[:, None], front], -1)[..., None]
        k = jnp.where(lane == NO_LANE, -1, table.connector[lane])
        inside = (front > table.s_in[k]) & (front - state.shape.length[:, None, None] < table.s_out[k])
        inside &= (table.type[k] == ConflictType.CROSS) & (k >= 0)[..., None]
        taken = jnp.zeros(table.foe.shape, bool).at[k].max(inside)
        moves = inside & (front > table.s_in[k] + NOSE) & (state.v >= STANDS)[:, None, None]
        moves = jnp.zeros(table.foe.shape, bool).at[k].max(moves)
        both = taken & taken.ravel()[self.mirror]
        shows = lane_states(lane_map.signals, state.lights.phase)[table.lane]
        rank = jnp.asarray(RANK)[shows]
        light = jnp.sign(rank[:, None] - rank[table.foe])
        yields = jnp.where(light != 0, light, table.prio) < 0
        against = both & yields & moves
        return both, against | against.ravel()[self.mirror]

    def init(self, config: Config, lane_map: LaneMap, state: State) -> tuple[Any, None]:
        """The count before any vehicles meet."""
        met = jnp.zeros(2, jnp.int32)
        return (self._pairs(lane_map, state), met, self.changes.init(config, lane_map, state)[0]), None

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Any:
        """Pairs after a step, and the record of `Changes`."""
        return self._pairs(lane_map, tick.state), self.changes.record(config, lane_map, tick)

    def update(
        self, config: Config, lane_map: LaneMap, carry: Any, records: Any, *, start: Any = False
    ) -> Any:
        """Count pairs when they begin, and vehicles once."""
        (before, met, changes), (pairs, vehicles) = carry, records
        begun = [
            jnp.sum(x & ~jnp.concatenate([y[None], x[:-1]]), dtype=jnp.int32) // 2
            for x, y in zip(pairs, before, strict=True)
        ]
        last = jax.tree.map(lambda x: x[-1], pairs)
        return last, met + jnp.stack(begun), self.changes.update(config, lane_map, changes, vehicles)

    def result(self, config: Config, lane_map: LaneMap, carry: Any) -> Any:
        """Crossing conflicts, of these against priority, and the counts of `Changes`."""
        return jnp.concatenate([carry[1], self.changes.result(config, lane_map, carry[-1])])


EVENTS = (
    "entered", "left", "waiting", "full", "collided", "off_road", "wrong_way", "ran_red", "missed", "hard",
    "broken", "gridlock",
)  # fmt: skip
"""Counts of `Totals` that are added up."""


def summary(totals: Totals, counts: NDArray[Any]) -> dict[str, Any]:
    """Totals `[B]` and counts of `Watch` `[B, 5]` of worlds, added up."""
    together, against, must, *_ = (int(x) for x in counts.sum(0))
    events = {name: int(np.sum(getattr(totals, name))) for name in EVENTS}
    bad = np.nonzero(totals.collided | totals.gridlock | totals.off_road | totals.broken)[0]
    return events | {
        "together": together,
        "against_priority": against,
        "must_change": must,
        "missed_percent": round(100 * events["missed"] / max(must, 1), 3),
        "collided_episodes": int(np.sum(totals.collided > 0)),
        "off_road_episodes": int(np.sum(totals.off_road > 0)),
        "deceleration": round(float(np.max(totals.deceleration)), 2),
        "longest_wait": round(float(np.max(totals.longest_wait)), 1),
        "vehicle_km": round(float(np.sum(totals.distance)) / 1000, 1),
        "mean_speed": round(float(np.sum(totals.distance) / max(np.sum(totals.time), 1e-6)), 2),
        "suspects": bad[:10].tolist(),
    }
