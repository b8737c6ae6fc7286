"""Traffic on random road networks: which share of maps and episodes is free of faults.

    python experiments/random_maps.py [--maps 40] [--first 0] [--seeds 10] [--demand low moderate high]
    python experiments/random_maps.py --final

Maps are those of `random_roads`, one per whole number. Those below 10,000 are for work. `--final` measures
300 maps from 10,000 on, and single ones of these are never looked at: they must not become examples. Writes
experiments/results/random_maps.json and .md; runs for work write random_maps_work.json and .md. Rows are
added as they are done, and a run that was broken off goes on where it was, unless the code has changed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from random_roads import KINDS, Unfit, kind_of, write_map
from random_roads.loads import LEVELS, SIZES, Loaded, demand_of, load
from watch import Watch, mirror_of, summary

import limsim_jax
from limsim_jax.files import write_whole
from limsim_jax.maps import MapError, read_network
from limsim_jax.maps.cache import key as cache_key
from limsim_jax.maps.lane_map import lane_ids
from limsim_jax.simulation.rollout import Rollout, Started, started
from limsim_jax.simulation.worlds import over_worlds
from limsim_jax.traffic.demand import sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.types import Config, Status
from limsim_jax.xla import enable_compilation_cache, run_once, use_all_cores

RESULTS = Path(__file__).parent / "results"
FINAL_FIRST, FINAL_MAPS = 10_000, 300
SECONDS = 180.0
"""s, length of an episode; traffic that stands for 120 s is gridlocked."""

OWN_SLOTS = 384
"""Vehicles at once on a map that fits into no size class."""

SHOWN = "active", "lane", "s", "d", "v", "status", "struck", "struck_at", "waiting", "shape"
"""What is kept of the vehicles at the end, to tell where faults happened."""

PLACES = 6
"""Places of faults per row, at most."""

WORST = 12
"""Maps that the table lists."""


class Programs:
    """Programs that run worlds on any map of a size class."""

    def __init__(self, slots: int, worlds: int, seconds: float) -> None:
        enable_compilation_cache()
        devices = jax.local_devices()
        self.chunk = -(-worlds // len(devices)) * len(devices)
        mesh = Mesh(np.array(devices), ("worlds",))
        config, traffic = Config(dt=0.1), Traffic()

        def start(shared: Any, seed: Any) -> Started:
            lane_map, demand, mirror = shared
            run = Rollout(config, traffic, seconds, measure=Watch(mirror))
            return started(run, lane_map, lambda key: sample_scenario(demand, lane_map, key, slots), seed)

        def advance(shared: Any, world: Started) -> Any:
            lane_map, _, mirror = shared
            run = Rollout(config, traffic, seconds, measure=Watch(mirror))
            result, _ = run.advance(lane_map, *world)
            return result.totals, result.measures, {name: getattr(result.state, name) for name in SHOWN}

        self.start: Any = over_worlds(start, mesh, run_once())
        self.advance: Any = over_worlds(advance, mesh)

    def run(self, shared: Any, worlds: int) -> tuple[Any, Any, Any]:
        """Totals, counts and last vehicles of the worlds 0, 1, ... on the host."""
        seeds = np.minimum(np.arange(self.chunk), worlds - 1).astype(np.int32)
        found = jax.device_get(self.advance(shared, self.start(shared, seeds)))
        return jax.tree.map(lambda x: x[:worlds], found)

    def compiled(self) -> int:
        """How many programs were compiled; two, unless shapes differ."""
        return self.start._cache_size() + self.advance._cache_size()


class Measurement:
    """Runs maps, with programs that maps of a size class share."""

    def __init__(self, folder: Path, worlds: int, seconds: float, *, blind: bool) -> None:
        self.blind = blind  # rows do not say where faults happened
        self.folder, self.worlds, self.seconds = folder, worlds, seconds
        self.programs: dict[str, Programs] = {}

    def rows(self, seed: int, levels: Sequence[str]) -> Iterator[dict[str, Any]]:
        """A row per level of demand; a map that fails has rows that say why."""
        head: dict[str, Any] = {"map": seed, "kind": kind_of(seed)}
        begin = time.perf_counter()
        try:
            made = write_map(seed, self.folder)
            head |= {"of": made.of, "file": made.path.name}
            loaded = load(read_network(made.path, cache=False))
            head |= {"size": loaded.size, "load_s": round(time.perf_counter() - begin, 2)}
        except Exception as error:
            stage = (
                "drawn"
                if isinstance(error, Unfit)
                else "refused"
                if isinstance(error, MapError)
                else "failed"
            )
            for level in levels:
                yield head | {"demand": level, stage: _one_line(error)}
            return
        for level in levels:
            try:
                yield head | {"demand": level} | self._measure(loaded, seed, level)
            except Exception as error:
                yield head | {"demand": level, "failed": _one_line(error)}

    def _measure(self, loaded: Loaded, seed: int, level: str) -> dict[str, Any]:
        begin = time.perf_counter()
        demand, rate = demand_of(loaded, level, seed, self.seconds)
        size = SIZES.get(loaded.size)
        if loaded.size not in self.programs or size is None:
            slots = OWN_SLOTS if size is None else size.slots
            self.programs[loaded.size] = Programs(slots, self.worlds, self.seconds)
        programs = self.programs[loaded.size]
        shared = jax.tree.map(np.asarray, (loaded.lane_map, demand, mirror_of(loaded.lane_map.conflicts)))
        ready, before = time.perf_counter(), programs.compiled()
        totals, counts, vehicles = programs.run(shared, self.worlds)
        done = time.perf_counter()
        bad = {
            "contact": totals.collided > 0,
            "against": counts[:, 1] > 0,
            "gridlock": totals.gridlock,
            "off_road": totals.off_road > 0,
            "broken": totals.broken > 0,
        }
        return {
            "rate": round(rate),
            "initial": demand.initial,
            "episodes": self.worlds,
            **{f"{name}_worlds": np.nonzero(which)[0].tolist() for name, which in bad.items()},
            **{name: value for name, value in summary(totals, counts).items() if name != "suspects"},
            **({} if self.blind else places(lane_ids(loaded.network), totals, vehicles)),
            "compiled": programs.compiled() - before,
            "prepare_s": round(ready - begin, 2),
            "run_s": round(done - ready, 2),
        }


def places(ids: Sequence[str], totals: Any, vehicles: dict[str, Any]) -> dict[str, Any]:
    """Where vehicles touched, left the road, or stand for longest."""

    def place(world: int, slot: int) -> str:
        lane = int(vehicles["lane"][world, slot])
        s, d = vehicles["s"][world, slot], vehicles["d"][world, slot]
        long = vehicles["shape"].length[world, slot]
        name = ids[lane] if 0 <= lane < len(ids) else "nowhere"
        return f"{name} at {s:.1f} m, {d:.1f} m aside, {long:.1f} m long"

    found: dict[str, list[str]] = {"contacts": [], "strays": [], "stands": []}
    for world in range(len(totals.collided)):
        status = np.where(vehicles["active"][world], vehicles["status"][world], 0)
        for slot in np.nonzero(status & int(Status.COLLIDED))[0].tolist():
            when = f"world {world}, {vehicles['struck_at'][world, slot]:.1f} s: "
            found["contacts"].append(when + place(world, slot))
        for slot in np.nonzero(status & int(Status.OFF_ROAD))[0].tolist():
            found["strays"].append(f"world {world}: {place(world, slot)}")
        if totals.gridlock[world]:
            waits = np.where(vehicles["active"][world], vehicles["waiting"][world], -1)
            slot = int(np.argmax(waits))
            found["stands"].append(f"world {world}, for {waits[slot]:.0f} s: {place(world, slot)}")
    return {name: some[:PLACES] for name, some in found.items() if some}


def _one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]


def shares(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of maps and episodes without each fault, and further sums."""
    run = [row for row in rows if "episodes" in row]
    found: dict[str, Any] = {
        "maps": len({row["map"] for row in rows}),
        "not run": len({r["map"] for r in rows} - {r["map"] for r in run}),
    }
    episodes = sum(row["episodes"] for row in run)
    found["episodes"] = episodes
    for fault in ("contact", "against", "gridlock", "off_road"):
        clean = [row for row in run if not row[f"{fault}_worlds"]]
        bad = sum(len(row[f"{fault}_worlds"]) for row in run)
        found[f"{fault} maps"] = round(100 * len(clean) / max(len(run), 1), 1)
        found[f"{fault} episodes"] = round(100 * (1 - bad / max(episodes, 1)), 2)
    found["braking"] = max((row["deceleration"] for row in run), default=0.0)
    found["missed"] = round(
        100 * sum(r["missed"] for r in run) / max(sum(r["must_change"] for r in run), 1), 2
    )
    found["red"] = sum(row["ran_red"] for row in run)
    found["km"] = round(sum(row["vehicle_km"] for row in run))
    return found


COLUMNS = {
    "maps": "maps",
    "not run": "not run",
    "episodes": "episodes",
    "contact maps": "maps without a contact, %",
    "contact episodes": "episodes, %",
    "against maps": "maps without a crossing against priority, %",
    "against episodes": "episodes, %",
    "gridlock maps": "maps without gridlock, %",
    "gridlock episodes": "episodes, %",
    "off_road maps": "maps with none off road, %",
    "off_road episodes": "episodes, %",
    "braking": "hardest braking, m/s^2",
    "missed": "needed lane changes missed, %",
    "red": "red lights run",
    "km": "vehicle-km",
}


def report(rows: list[dict[str, Any]], *, final: bool) -> str:
    """Markdown: shares by demand and kind, maps that were not run, and the worst maps."""
    lines = []
    for level in [x for x in LEVELS if any(row["demand"] == x for row in rows)]:
        mine = [row for row in rows if row["demand"] == level]
        lines += [f"## {level} demand", "", "| kind | " + " | ".join(COLUMNS.values()) + " |"]
        lines.append("|---" * (len(COLUMNS) + 1) + "|")
        groups = {kind: [row for row in mine if row["kind"] == kind] for kind in KINDS}
        for kind, some in [*groups.items(), ("all", mine)]:
            if some:
                found = shares(some)
                lines.append(f"| {kind} | " + " | ".join(str(found[name]) for name in COLUMNS) + " |")
        lines.append("")
    stopped = {(r["map"], r["kind"], k, r[k]) for r in rows for k in ("drawn", "refused", "failed") if k in r}
    if stopped:
        lines += ["## Maps that were not run", "", "| map | kind | stage | reason |", "|---|---|---|---|"]
        lines += [f"| {seed} | {kind} | {stage} | {why} |" for seed, kind, stage, why in sorted(stopped)] + [
            ""
        ]
    if not final:
        lines += ["## Worst maps", "", *_worst([row for row in rows if "episodes" in row]), ""]
    return "\n".join(lines)


def _worst(rows: list[dict[str, Any]]) -> list[str]:
    """Maps with the most worlds that have a fault, and these worlds."""
    names = "contact", "against", "gridlock", "off_road", "broken"
    weight = {"contact": 10, "off_road": 10, "broken": 100, "gridlock": 3, "against": 1}
    scored = sorted(rows, key=lambda row: -sum(len(row[f"{x}_worlds"]) * weight[x] for x in names))
    lines = ["| map | kind | demand | file | " + " | ".join(f"{x} worlds" for x in names) + " | braking |"]
    lines.append("|---" * (5 + len(names)) + "|")
    for row in scored[:WORST]:
        worlds = [" ".join(map(str, row[f"{x}_worlds"][:8])) for x in names]
        first = [str(row[x]) for x in ("map", "kind", "demand", "file")]
        lines.append("| " + " | ".join([*first, *worlds, str(row["deceleration"])]) + " |")
    return lines


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10, help="worlds per map and demand")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--demand", nargs="+", default=["moderate"], choices=list(LEVELS))
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--pick", nargs="+", type=int, help="these maps only")
    parser.add_argument("--final", action="store_true", help="the final measurement")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "limsim_random_maps")
    parser.add_argument("--out")
    parser.add_argument("--cores", type=int)
    options = parser.parse_args()
    for name, least in (("maps", 1), ("first", 0), ("seeds", 1), ("seconds", 1)):
        if not getattr(options, name) >= least:
            parser.error(f"--{name} {getattr(options, name):g}: at least {least}")
    if options.final:
        options.first, options.maps = FINAL_FIRST, FINAL_MAPS
    elif max(options.pick or [options.first + options.maps - 1]) >= FINAL_FIRST:
        parser.error(f"maps from {FINAL_FIRST} on are for --final")
    use_all_cores(options.cores)
    file = RESULTS / f"{options.out or ('random_maps' if options.final else 'random_maps_work')}.json"
    here, package = Path(__file__).parent, Path(limsim_jax.__file__).parent
    sources = sorted([*here.glob("random_roads/*.py"), here / "watch.py", *package.glob("**/*.py")])
    code = cache_key("random maps", *(path.read_text() for path in sources))
    setting = {"code": code[-12:], "episodes": options.seeds, "seconds": options.seconds}
    kept = json.loads(file.read_text()) if file.exists() else {}
    rows = (
        {(r["map"], r["demand"]): r for r in kept.get("rows", [])} if kept.get("setting") == setting else {}
    )
    wanted = options.pick or range(options.first, options.first + options.maps)
    seeds = [seed for seed in wanted if kind_of(seed) in options.kinds]
    measurement = Measurement(options.folder, options.seeds, options.seconds, blind=options.final)
    RESULTS.mkdir(exist_ok=True)
    for seed in seeds:
        todo = [level for level in options.demand if (seed, level) not in rows]
        for row in measurement.rows(seed, todo):
            rows[row["map"], row["demand"]] = row
            write_whole(file, json.dumps({"setting": setting, "rows": list(rows.values())}, indent=1) + "\n")
            print(_brief(row), flush=True)
    shown = [rows[seed, level] for seed in seeds for level in options.demand if (seed, level) in rows]
    head = "Regenerate: `python experiments/random_maps.py" + (" --final" if options.final else "") + "`\n\n"
    head += f"{options.seeds} worlds of {options.seconds:g} s per map and demand.\n\n"
    text = head + report(shown, final=options.final)
    write_whole(file.with_suffix(".md"), text)
    print(text)


def _brief(row: dict[str, Any]) -> str:
    """A line about a row."""
    for stage in ("drawn", "refused", "failed"):
        if stage in row:
            return f"{row['map']} {row['kind']} {row['demand']}: {stage} {row[stage]}"
    names = "contact", "against", "gridlock", "off_road"
    faults = ", ".join(f"{name} {row[f'{name}_worlds']}" for name in names if row[f"{name}_worlds"])
    cost = (
        f"{row['size']}, {row['load_s']} + {row['prepare_s']} + {row['run_s']} s, {row['compiled']} compiled"
    )
    flow = f"{row['rate']} veh/h, {row['entered']} entered, {row['left']} left, full {row['full']}"
    more = f"waiting {row['waiting']}, missed {row['missed']}, braking {row['deceleration']}"
    return f"{row['map']} {row['kind']} {row['demand']}: {faults or 'clean'}; {flow}, {more} ({cost})"


if __name__ == "__main__":
    main()
