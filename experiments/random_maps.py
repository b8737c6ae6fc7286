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
import contextlib
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from random_roads import KINDS, Unfit, kept_map, kind_of
from random_roads.loads import LEVELS, SIZES, demand_of, load
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
    """Programs that run worlds on any maps of a size class."""

    def __init__(self, slots: int, worlds: int, seconds: float, together: int) -> None:
        enable_compilation_cache()
        devices = jax.local_devices()
        self.chunk = -(-worlds // len(devices)) * len(devices)
        self.worlds, self.together = worlds, together
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

        self.start: Any = over_worlds(jax.vmap(start, (0, None)), mesh, run_once())
        self.advance: Any = over_worlds(jax.vmap(advance), mesh)

    def run(self, maps: Sequence[Any]) -> list[tuple[Any, Any, Any]]:
        """Totals, counts and last vehicles of the worlds 0, 1, ... of each map, on the host."""
        filled = [*maps, *[maps[-1]] * (self.together - len(maps))]
        shared = jax.tree.map(lambda *x: np.stack(x), *filled)
        seeds = np.minimum(np.arange(self.chunk), self.worlds - 1).astype(np.int32)
        found = jax.device_get(self.advance(shared, self.start(shared, seeds)))
        return [jax.tree.map(lambda x: x[: self.worlds, m], found) for m in range(len(maps))]  # noqa: B023

    def compiled(self) -> int:
        """How many programs were compiled; two, unless shapes differ."""
        return self.start._cache_size() + self.advance._cache_size()


class Ready(NamedTuple):
    """A map and its demand, before it runs."""

    head: dict[str, Any]
    """First columns of its row."""
    size: str
    shared: Any
    """Lane map, demand and `mirror_of`, of NumPy arrays."""
    ids: Sequence[str]
    """Of the lanes."""


def prepare(seed: int, levels: Sequence[str], folder: Path, seconds: float) -> list[Ready | dict[str, Any]]:
    """Draw a map and sample its demands.

    A map that the folder has is not drawn again. Where one fails there is a row that says why.
    """
    head: dict[str, Any] = {"map": seed, "kind": kind_of(seed)}
    begin = time.perf_counter()
    try:
        made = kept_map(seed, folder)
        head |= {"of": made.of, "file": made.path.name}
        loaded = load(read_network(made.path, cache=False))
        ids, mirror = lane_ids(loaded.network), mirror_of(loaded.lane_map.conflicts)
        head |= {"size": loaded.size, "load_s": round(time.perf_counter() - begin, 2)}
    except Exception as error:
        stage = (
            "drawn" if isinstance(error, Unfit) else "refused" if isinstance(error, MapError) else "failed"
        )
        return [head | {"demand": level, stage: _one_line(error)} for level in levels]
    found: list[Ready | dict[str, Any]] = []
    for level in levels:
        begin = time.perf_counter()
        try:
            demand, rate = demand_of(loaded, level, seed, seconds)
            shared = jax.tree.map(np.asarray, (loaded.lane_map, demand, mirror))
            more = {"demand": level, "rate": round(rate), "initial": demand.initial}
            more["prepare_s"] = round(time.perf_counter() - begin, 2)
            found.append(Ready(head | more, loaded.size, shared, ids))
        except Exception as error:
            found.append(head | {"demand": level, "failed": _one_line(error)})
    return found


class Measurement:
    """Runs maps, `together` at once.

    Maps of a size class share programs.
    """

    def __init__(self, worlds: int, seconds: float, together: int, *, blind: bool) -> None:
        self.blind = blind  # rows do not say where faults happened
        self.worlds, self.seconds, self.together = worlds, seconds, together
        self.programs: dict[str, Programs] = {}

    def rows(self, prepared: Iterable[Ready | dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """A row per map and level of demand, as they are done.

        Maps that fit into no size class come last: each of them compiles programs of its own.
        """
        waiting: dict[str, list[Ready]] = {}
        own: list[Ready] = []
        for one in prepared:
            if isinstance(one, dict):
                yield one
            elif one.size not in SIZES:
                own.append(one)
            else:
                group = waiting.setdefault(one.size, [])
                group.append(one)
                if len(group) == self.together:
                    yield from self._run(waiting.pop(one.size))
        for group in [*waiting.values(), *([one] for one in own)]:
            yield from self._run(group)

    def _run(self, maps: list[Ready]) -> Iterator[dict[str, Any]]:
        begin, size = time.perf_counter(), maps[0].size
        try:
            if size not in SIZES:
                programs = Programs(OWN_SLOTS, self.worlds, self.seconds, 1)
            elif size in self.programs:
                programs = self.programs[size]
            else:
                programs = Programs(SIZES[size].slots, self.worlds, self.seconds, self.together)
                self.programs[size] = programs
            before = programs.compiled()
            results = programs.run([one.shared for one in maps])
        except Exception as error:
            yield from (one.head | {"failed": _one_line(error)} for one in maps)
            return
        cost = {
            "compiled": programs.compiled() - before,
            "run_s": round((time.perf_counter() - begin) / len(maps), 2),
        }
        for one, result in zip(maps, results, strict=True):
            yield one.head | self._row(one, *result) | cost

    def _row(self, one: Ready, totals: Any, counts: Any, vehicles: Any) -> dict[str, Any]:
        bad = {
            "contact": totals.collided > 0,
            "against": counts[:, 1] > 0,
            "gridlock": totals.gridlock,
            "off_road": totals.off_road > 0,
            "broken": totals.broken > 0,
        }
        return {
            "episodes": self.worlds,
            **{f"{name}_worlds": np.nonzero(which)[0].tolist() for name, which in bad.items()},
            **{name: value for name, value in summary(totals, counts).items() if name != "suspects"},
            **({} if self.blind else places(one.ids, totals, vehicles)),
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
    parser.add_argument("--together", type=int, default=1, help="maps in one call; more on a GPU, such as 32")
    parser.add_argument("--jobs", type=int, default=0, help="processes that read maps beside the worlds")
    parser.add_argument("--draw", action="store_true", help="only write the maps into the folder")
    options = parser.parse_args()
    for name, least in (
        ("maps", 1),
        ("first", 0),
        ("seeds", 1),
        ("seconds", 1),
        ("together", 1),
        ("jobs", 0),
    ):
        if not getattr(options, name) >= least:
            parser.error(f"--{name} {getattr(options, name):g}: at least {least}")
    if options.final:
        options.first, options.maps = FINAL_FIRST, FINAL_MAPS
    elif max(options.pick or [options.first + options.maps - 1]) >= FINAL_FIRST:
        parser.error(f"maps from {FINAL_FIRST} on are for --final")
    wanted = options.pick or range(options.first, options.first + options.maps)
    seeds = [seed for seed in wanted if kind_of(seed) in options.kinds]
    if options.draw:
        for seed in seeds:
            with contextlib.suppress(Unfit):  # is said when it runs
                kept_map(seed, options.folder)
        return
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
    todo = {seed: [x for x in options.demand if (seed, x) not in rows] for seed in seeds}
    measurement = Measurement(options.seeds, options.seconds, options.together, blind=options.final)
    RESULTS.mkdir(exist_ok=True)
    for row in measurement.rows(_prepared(todo, options.folder, options.seconds, options.jobs)):
        rows[row["map"], row["demand"]] = row
        write_whole(file, json.dumps({"setting": setting, "rows": list(rows.values())}, indent=1) + "\n")
        print(_brief(row), flush=True)
    shown = [rows[seed, level] for seed in seeds for level in options.demand if (seed, level) in rows]
    head = "Regenerate: `python experiments/random_maps.py" + (" --final" if options.final else "") + "`\n\n"
    head += f"{options.seeds} worlds of {options.seconds:g} s per map and demand.\n\n"
    text = head + report(shown, final=options.final)
    write_whole(file.with_suffix(".md"), text)
    print(text)


def _prepared(
    todo: dict[int, list[str]], folder: Path, seconds: float, jobs: int
) -> Iterator[Ready | dict[str, Any]]:
    """What runs, map by map; read by other processes, without an accelerator, where there are `jobs`."""
    work = [(seed, levels, folder, seconds) for seed, levels in todo.items() if levels]
    if not jobs:
        for one in work:
            yield from prepare(*one)
        return
    here = os.environ.get("JAX_PLATFORMS")
    os.environ["JAX_PLATFORMS"] = "cpu"
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        made = [pool.submit(prepare, *one) for one in work]
        if here is None:
            del os.environ["JAX_PLATFORMS"]
        else:
            os.environ["JAX_PLATFORMS"] = here
        for each in made:
            yield from each.result()


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
