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
import numpy as np
from watch import Watch, mirror_of, summary

from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, bundled_maps, read_network
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.sweeps.build import plain_demand
from limsim_jax.traffic.demand import sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.types import Config
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


def episodes(
    path: str | Path, rate: float, count: int, *, slots: int, chunk: int, initial: int = INITIAL
) -> dict[str, Any]:
    """Run `count` episodes on a map and add up what happened."""
    network = read_network(path)
    lane_map = build_lane_map(network)
    demand, _ = plain_demand(network, lane_map, rate=rate, vehicles=initial, seconds=HORIZON)
    run = Rollout(Config(dt=0.1), Traffic(), HORIZON, measure=Watch(mirror_of(lane_map.conflicts)))
    start = time.perf_counter()
    worlds = Worlds(run, lane_map, lambda key: sample_scenario(demand, lane_map, key, slots), chunk=chunk)
    worlds.compile()
    compiled = time.perf_counter()
    parts = [(result.totals, result.measures) for _, result in worlds.chunks(range(count))]
    totals, counts = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    done = time.perf_counter()
    return summary(totals, counts) | {
        "map": Path(path).stem,
        "episodes": count,
        "slots": slots,
        "rate": rate,
        "compile_s": round(compiled - start, 1),
        "run_s": round(done - compiled, 1),
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
