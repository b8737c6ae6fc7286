"""Random episodes of background traffic on many maps, and their faults.

    python experiments/soundness.py [--episodes 1920] [--town-episodes 192] [--map NAME_OR_FILE ...]

Vehicles at the start, arrivals, drivers and goals differ from episode to episode. The default maps are the
bundled ones, and CARLA's towns where the folder of real maps exists. Writes
experiments/results/soundness.json and .md; maps that are not named keep their rows.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, bundled_maps, read_network
from limsim_jax.maps.conflicts import ConflictTable, ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.sweeps.build import plain_demand
from limsim_jax.traffic.bodies import tails
from limsim_jax.traffic.demand import sample_scenario
from limsim_jax.traffic.engine import Tick, Traffic
from limsim_jax.types import Config, State, Status
from limsim_jax.xla import use_all_cores

RESULTS = Path(__file__).parent / "results"

RATES = {"highway": 2000.0, "ramp": 900.0, "intersection": 400.0, "roundabout": 400.0, "long_route": 250.0}
"""veh/h per origin; other maps: `OTHER_RATE`."""

OTHER_RATE = 200.0
SLOTS = {"highway": 128, "ramp": 128, "long_route": 128}
"""Vehicles at once; other bundled maps: 64, towns: 128."""

SHARED = Path(os.environ.get("LIMSIM_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))
TOWNS = sorted((SHARED / "opendrive").glob("carla_*.xodr"))
INITIAL, IN_TOWN = 20, 50  # vehicles at the start, about
IN_SMALL_TOWN = {"carla_legacy_town02": 25}  # a grid of single lanes, 5.7 km of them
HORIZON = 180.0  # s
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

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The count before any vehicle is seen."""
        none = jnp.zeros((3, *state.active.shape), bool)
        return state.entered, none, jnp.zeros(3, jnp.int32)

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Any:
        """The vehicle in each slot, and which of the three it does."""
        state = tick.state
        must = lane_map.routes.lanes_to_go[state.lane, state.goal] != 0
        missed = (state.status & int(Status.MISSED_ROUTE)) != 0
        each = jnp.stack([must, must & (state.v < STANDS), missed])
        return jnp.where(state.active, state.entered, -1), state.active & each

    def update(self, config: Config, lane_map: LaneMap, carry: Any, records: Any) -> Any:
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


class Watch:
    """Crossing conflicts, those against priority, and `Changes`: a `simulation.rollout.Measure`.

    A crossing conflict is a pair of vehicles inside the stretch where their lanes are less than 2.3 m apart,
    so they need not touch. It is against priority if the vehicle that must yield (by signal, otherwise by the
    map) moves there, more than `NOSE` inside.
    """

    def __init__(self, table: ConflictTable) -> None:
        self.changes = Changes()
        foe, cross = np.asarray(table.foe), np.asarray(table.type) == ConflictType.CROSS
        places = np.stack([np.asarray(x) for x in (table.s_in, table.s_out, table.f_in, table.f_out)], -1)
        self.mirror = np.zeros(foe.shape, np.int32)  # place in the flat table of the entry seen from the foe
        for k, c in zip(*np.nonzero(cross), strict=True):
            j = foe[k, c]
            same = (foe[j] == k) & (places[j] == places[k, c][[2, 3, 0, 1]]).all(-1)
            self.mirror[k, c] = j * foe.shape[1] + int(np.argmax(same))

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

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The count before any vehicles meet."""
        met = jnp.zeros(2, jnp.int32)
        return self._pairs(lane_map, state), met, self.changes.init(config, lane_map, state)

    def record(self, config: Config, lane_map: LaneMap, tick: Tick) -> Any:
        """Pairs after a step, and the record of `Changes`."""
        return self._pairs(lane_map, tick.state), self.changes.record(config, lane_map, tick)

    def update(self, config: Config, lane_map: LaneMap, carry: Any, records: Any) -> Any:
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


def episodes(
    path: str | Path, rate: float, count: int, *, slots: int, chunk: int, initial: int = INITIAL
) -> dict[str, Any]:
    """Run `count` episodes on a map and add up what happened."""
    network = read_network(path)
    lane_map = build_lane_map(network)
    demand, _ = plain_demand(network, lane_map, rate=rate, vehicles=initial, seconds=HORIZON)
    run = Rollout(Config(dt=0.1), Traffic(), HORIZON, measure=Watch(lane_map.conflicts))
    start = time.perf_counter()
    worlds = Worlds(run, lane_map, lambda key: sample_scenario(demand, lane_map, key, slots), chunk=chunk)
    worlds.compile()
    compiled = time.perf_counter()
    parts = [(result.totals, result.measures) for _, result in worlds.chunks(range(count))]
    totals, counts = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    together, against, must, *_ = (int(x) for x in counts.sum(0))
    done = time.perf_counter()
    events = {
        name: int(np.sum(getattr(totals, name)))
        for name in (
            "entered", "left", "waiting", "full", "collided", "off_road", "wrong_way", "ran_red", "missed",
            "hard", "broken", "gridlock",
        )
    }  # fmt: skip
    bad = np.nonzero(totals.collided | totals.gridlock | totals.off_road | totals.broken)[0]
    return events | {
        "map": Path(path).stem,
        "episodes": count,
        "slots": slots,
        "rate": rate,
        "together": together,
        "against_priority": against,
        "must_change": must,
        "missed_percent": round(100 * events["missed"] / max(must, 1), 3),
        "collided_episodes": int(np.sum(totals.collided > 0)),
        "off_road_episodes": int(np.sum(totals.off_road > 0)),
        "deceleration": round(float(np.max(totals.deceleration)), 2),
        "longest_wait": round(float(np.max(totals.longest_wait)), 1),
        "vehicle_km": round(float(np.sum(totals.distance)) / 1000, 1),
        "mean_speed": round(float(np.sum(totals.distance) / np.sum(totals.time)), 2),
        "compile_s": round(compiled - start, 1),
        "run_s": round(done - compiled, 1),
        "suspects": bad[:10].tolist(),
    }


COLUMNS = {
    "map": "map",
    "episodes": "episodes",
    "entered": "vehicles",
    "vehicle_km": "vehicle-km",
    "collided_episodes": "episodes with a collision",
    "gridlock": "gridlock",
    "broken": "not finite",
    "off_road": "off road",
    "wrong_way": "wrong way",
    "ran_red": "red light",
    "together": "two where lanes cross",
    "against_priority": "of these against priority",
    "must_change": "have to change lanes",
    "missed": "never did",
    "missed_percent": "that is, %",
    "deceleration": "hardest braking, m/s^2",
    "full": "no slot",
    "mean_speed": "mean speed, m/s",
}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(COLUMNS.values()) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join(str(row[name]) for name in COLUMNS) + " |" for row in rows]
    return "\n".join(lines)


def check_maps(parser: argparse.ArgumentParser, names: list[str]) -> None:
    """End the program if a name is neither file nor bundled map."""
    for name in names:
        if not Path(name).exists() and name not in bundled_maps():
            parser.error(f"--map {name}: no such file, nor one of {', '.join(bundled_maps())}")


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=1920)
    parser.add_argument("--town-episodes", type=int, default=192)
    parser.add_argument("--map", nargs="*", default=[*bundled_maps(), *map(str, TOWNS)])
    parser.add_argument("--chunk", type=int, default=64)
    parser.add_argument("--rate", type=float)
    parser.add_argument("--out", default="soundness")
    options = parser.parse_args()
    for name in ("episodes", "town_episodes", "chunk"):
        if getattr(options, name) < 1:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name)}: at least 1")
    check_maps(parser, options.map)
    use_all_cores()
    file = RESULTS / f"{options.out}.json"
    rows = {row["map"]: row for row in json.loads(file.read_text())["maps"]} if file.exists() else {}
    for name in options.map:
        rate = options.rate or RATES.get(name, OTHER_RATE)
        path, bundled = bundled_maps().get(name) or name, name in bundled_maps()
        count = options.episodes if bundled else options.town_episodes
        in_town = IN_SMALL_TOWN.get(Path(name).stem, IN_TOWN)
        slots, initial = (SLOTS.get(name, 64), INITIAL) if bundled else (128, in_town)
        row = episodes(path, rate, count, slots=slots, chunk=options.chunk, initial=initial)
        rows[row["map"]] = row
        print(json.dumps(row), flush=True)
        jax.clear_caches()
    RESULTS.mkdir(exist_ok=True)
    head = "Regenerate: `python experiments/soundness.py`\n\n"
    write_whole(file, json.dumps({"maps": list(rows.values())}, indent=1) + "\n")
    write_whole(RESULTS / f"{options.out}.md", head + table(list(rows.values())) + "\n")


if __name__ == "__main__":
    main()
