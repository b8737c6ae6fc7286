"""Capacity of roads and junctions: our traffic, SUMO's, and what is known of real roads.

    python experiments/capacity.py [--worlds 4] [--minutes 15] [--sites motorway merge ...]

Both simulators read the same networks of netconvert, with the same flows, each with its own default drivers
(ours: the motorway mix on motorways, the urban mix elsewhere). The first five minutes do not count. Writes
experiments/results/capacity.json and .md, row by row; rows of other sites stay. Needs `eclipse-sumo`.

Real roads: the Highway Capacity Manual, 6th edition (HCM 6); Knoop, Wilson, Buisson and van Arem 2012,
Quantifying the number of lane changes in traffic, TRR; Duret, Ahn and Buisson 2012, Transportation Research C
(lanes); Al-Kaisy and Doruk 2023 (four-way stops).
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from maps_against_sumo import run_sumo
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.maps.lane_map import lane_ids
from limsim_jax.maps.routing import default_goals
from limsim_jax.simulation.rollout import Rollout, started
from limsim_jax.simulation.worlds import over_worlds
from limsim_jax.traffic.demand import Flow, build_demand, sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.vehicles import (
    HIGHWAY,
    URBAN,
    default_population,
    restrict_to_map,
    sample,
    uniform_population,
)
from limsim_jax.types import Config, Scenario
from limsim_jax.xla import enable_compilation_cache, use_all_cores

RESULTS = Path(__file__).parent / "results"
DT, WARM = 0.1, 300.0  # s
SLOTS = 384
STANDS = 1.5  # m/s
FAST, RAMP, TOWN = 33.33, 22.22, 13.89  # m/s
TWO_LANES = "about 3,600", "1,800 per lane"
LONG = 3.0  # km of motorway on which lane changes are counted
RING = 16.0  # m, radius of the roundabout
WIDTH = 3.2  # m, netconvert's lanes

# --- sites -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Road:
    """A road of one direction between two nodes."""

    start: str
    end: str
    lanes: int
    speed: float  # m/s
    shape: Sequence[tuple[float, float]] = ()
    priority: int = -1  # netconvert's


@dataclass(frozen=True)
class Site:
    """A network of SUMO, and where vehicles are counted."""

    nodes: Mapping[str, tuple[float, float]]
    roads: Mapping[str, Road]
    links: Sequence[tuple[str, int, str, int]] = ()  # empty: as netconvert has it
    kinds: Mapping[str, str] = field(default_factory=dict)  # of nodes
    mix: Mapping[str, float] = field(default_factory=lambda: HIGHWAY)
    options: str = ""
    lights: str = ""  # a file of programs
    standing: tuple[str, float] | None = None  # lane, and m along it, where a car stands all the time

    def write(self, folder: Path) -> Path:
        """Make the network."""
        nodes = [
            f'<node id="{name}" x="{x}" y="{y}" type="{self.kinds.get(name, "priority")}"/>'
            for name, (x, y) in self.nodes.items()
        ]
        roads = []
        for name, r in self.roads.items():
            shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in r.shape)
            roads.append(
                f'<edge id="{name}" from="{r.start}" to="{r.end}" numLanes="{r.lanes}" speed="{r.speed}" '
                f'priority="{r.priority}"{f" shape={chr(34)}{shape}{chr(34)}" if shape else ""}/>'
            )
        links = [
            f'<connection from="{a}" fromLane="{k}" to="{b}" toLane="{j}"/>' for a, k, b, j in self.links
        ]
        options = f"--no-turnarounds true {self.options}"
        files = ("nodes", "n", nodes), ("edges", "e", roads), ("connections", "x", links)
        for kind, letter, lines in files:
            if lines:
                path = folder / f"{kind}.xml"
                path.write_text(f"<{kind}>{''.join(lines)}</{kind}>")
                options += f" -{letter} {path}"
        if self.lights:
            (folder / "lights.xml").write_text(self.lights)
            options += f" -i {folder / 'lights.xml'}"
        net = folder / "site.net.xml"
        run_sumo("netconvert", f"{options} -o {net}")
        return net


def motorway() -> Site:
    """Three lanes, 4 km."""
    nodes = {"west": (0.0, 0.0), "middle": (1000 * LONG, 0.0), "east": (1000 * LONG + 1000, 0.0)}
    return Site(nodes, {"in": Road("west", "middle", 3, FAST), "out": Road("middle", "east", 3, FAST)})


def merge(lanes: int, length: float = 200.0) -> Site:
    """A ramp onto a motorway, with an acceleration lane without a taper."""
    edge = -lanes * WIDTH
    nodes = {"west": (-1500.0, 0.0), "a": (0.0, 0.0), "b": (length, 0.0), "east": (length + 800, 0.0)}
    nodes["far"] = (-300.0, edge - 30)
    roads = {
        "in": Road("west", "a", lanes, FAST),
        "beside": Road("a", "b", lanes + 1, FAST),
        "out": Road("b", "east", lanes, FAST),
        "ramp": Road("far", "a", 1, RAMP, ((-300, edge - 30), (-100, edge), (0, edge))),
    }
    links = [("in", k, "beside", k + 1) for k in range(lanes)]
    links += [("beside", k + 1, "out", k) for k in range(lanes)]
    return Site(nodes, roads, [*links, ("ramp", 0, "beside", 0)])


def lane_drop() -> Site:
    """Three lanes become two; the right one ends."""
    nodes = {"west": (-2000.0, 0.0), "a": (0.0, 0.0), "east": (800.0, 0.0)}
    roads = {"in": Road("west", "a", 3, FAST), "out": Road("a", "east", 2, FAST)}
    return Site(nodes, roads, [("in", 1, "out", 0), ("in", 2, "out", 1)])


def weaving(length: float = 300.0) -> Site:
    """An on-ramp and an off-ramp share an auxiliary lane."""
    edge = -2 * WIDTH
    nodes = {"west": (-1500.0, 0.0), "a": (0.0, 0.0), "b": (length, 0.0), "east": (length + 800, 0.0)}
    nodes |= {"far": (-300.0, edge - 30), "away": (length + 300.0, edge - 30)}
    on = (-300, edge - 30), (-100, edge), (0, edge)
    off = (length, edge), (length + 100, edge), (length + 300, edge - 30)
    roads = {
        "in": Road("west", "a", 2, FAST), "beside": Road("a", "b", 3, FAST),
        "out": Road("b", "east", 2, FAST), "ramp": Road("far", "a", 1, RAMP, on),
        "exit": Road("b", "away", 1, RAMP, off),
    }  # fmt: skip
    links = [("in", 0, "beside", 1), ("in", 1, "beside", 2), ("ramp", 0, "beside", 0)]
    links += [("beside", 1, "out", 0), ("beside", 2, "out", 1), ("beside", 0, "exit", 0)]
    return Site(nodes, roads, links)


def standing() -> Site:
    """Two lanes; a car stands on the right one."""
    nodes = {"west": (0.0, 0.0), "middle": (1000.0, 0.0), "east": (1300.0, 0.0)}
    roads = {"in": Road("west", "middle", 2, RAMP), "out": Road("middle", "east", 2, RAMP)}
    return Site(nodes, roads, mix=URBAN, standing=("in_0", 800.0))


def signal() -> Site:
    """One lane before lights: 35 s of green, 3 of yellow, in 60."""
    nodes = {"west": (-600.0, 0.0), "a": (0.0, 0.0), "east": (300.0, 0.0)}
    nodes |= {"south": (0.0, -100.0), "north": (0.0, 100.0)}
    roads = {"in": Road("west", "a", 1, TOWN), "out": Road("a", "east", 1, TOWN)}
    roads |= {"side": Road("south", "a", 1, TOWN), "away": Road("a", "north", 1, TOWN)}
    links = [("in", 0, "out", 0), ("side", 0, "away", 0)]
    phases = (35, "Gr"), (3, "yr"), (2, "rr"), (15, "rG"), (3, "ry"), (2, "rr")
    return Site(
        nodes, roads, links, {"a": "traffic_light"}, URBAN,
        lights='<tlLogics><tlLogic id="a" type="static" programID="0" offset="0">'
        + "".join(f'<phase duration="{t}" state="{state}"/>' for t, state in phases)
        + '</tlLogic><connection from="in" to="out" fromLane="0" toLane="0" tl="a" linkIndex="0"/>'
        '<connection from="side" to="away" fromLane="0" toLane="0" tl="a" linkIndex="1"/></tlLogics>',
    )  # fmt: skip


def roundabout() -> Site:
    """One lane, four arms; those from the west enter before those that go around from the north."""
    names = ("east", "north", "west", "south")
    at = [(math.cos(math.pi / 2 * k), math.sin(math.pi / 2 * k)) for k in range(4)]
    nodes = {f"r{k}": (RING * x, RING * y) for k, (x, y) in enumerate(at)}
    nodes |= {name: (400 * x, 400 * y) for name, (x, y) in zip(names, at, strict=True)}
    roads = {}
    for k, name in enumerate(names):
        bow = [math.pi / 2 * (k + j / 8) for j in range(9)]
        roads[f"ring{k}"] = Road(
            f"r{k}", f"r{(k + 1) % 4}", 1, 8.33, [(RING * math.cos(b), RING * math.sin(b)) for b in bow], 3
        )
        roads[f"in_{name}"] = Road(name, f"r{k}", 1, TOWN)
        roads[f"out_{name}"] = Road(f"r{k}", name, 1, TOWN)
    return Site(nodes, roads, mix=URBAN, options="--roundabouts.guess true")


def crossing(kind: str) -> Site:
    """Four arms of one lane; east and west are the major road."""
    at = {"west": (-400.0, 0.0), "east": (400.0, 0.0), "south": (0.0, -400.0), "north": (0.0, 400.0)}
    roads = {}
    for name in at:
        rank = 3 if name in ("west", "east") and kind == "priority_stop" else 1
        roads |= {f"in_{name}": Road(name, "a", 1, TOWN, priority=rank)}
        roads |= {f"out_{name}": Road("a", name, 1, TOWN, priority=rank)}
    return Site(at | {"a": (0.0, 0.0)}, roads, kinds={"a": kind}, mix=URBAN)


MERGES = {lanes: partial(merge, lanes) for lanes in (2, 3)}
two_way, all_way = partial(crossing, "priority_stop"), partial(crossing, "allway_stop")

# --- what is measured --------------------------------------------------------------------------------

Passes = Mapping[tuple[str, str], Sequence[NDArray[np.float64]]]
"""By two roads, for each world: s at which vehicles came from the first onto the second."""


@dataclass(frozen=True)
class Seen:
    """What happened in the worlds of a cell."""

    passes: Passes
    changes: float  # lane changes on `in`, per hour after the warm-up
    stood: float  # share of the vehicles that stood on `beside`'s rightmost lane
    left: float  # share of vehicles on the leftmost lane of `in`, in space
    hours: float  # after the warm-up


def times(seen: Seen, road: str, start: str | None = None) -> list[NDArray[np.float64]]:
    """s at which vehicles came onto a road, by world.

    From one other road, or from all.
    """
    ways = [x for (a, b), x in seen.passes.items() if b == road and start in (None, a)]
    return [np.sort(np.concatenate(x)) for x in zip(*ways, strict=True)]


def flow(seen: Seen, road: str, start: str | None = None) -> float:
    """veh/h onto a road after the warm-up."""
    return float(np.mean([(t >= WARM).sum() for t in times(seen, road, start)]) / seen.hours)


def best_five(seen: Seen, road: str) -> float:
    """veh/h in the best five minutes."""
    most = []
    for t in times(seen, road):
        later = t[t >= WARM]
        most.append(max((((later >= x) & (later < x + 300)).sum() for x in later), default=0) * 12)
    return float(np.mean(most))


def longest_gap(seen: Seen, road: str) -> float:
    """Longest time (s) without a vehicle onto a road, after the warm-up."""
    end = WARM + 3600 * seen.hours
    return float(max(np.diff([WARM, *t[t >= WARM], end]).max() for t in times(seen, road)))


def saturation(seen: Seen, road: str) -> float:
    """veh/h from the fifth vehicle of each green on."""
    gaps: list[float] = []
    for t in times(seen, road):
        for start in np.arange(WARM, t[-1], 60.0):
            queue = t[(t >= start) & (t < start + 40)]
            gaps += list(np.diff(queue)[3:])
    full = np.array(gaps)
    return float(3600 / full[full < 6].mean())


# --- our traffic -------------------------------------------------------------------------------------

SIZES = {
    "lanes": 128, "rows": 8192, "neighbors": 4, "chunks": 2048, "cells": 16384, "candidates": 49152,
    "connectors": 96, "foes": 16, "goals": 16, "programs": 16, "phases": 16, "links": 32, "movements": 96,
    "sight": 6, "behind": 4, "approaches": 5,
}  # fmt: skip
DEMAND = {"streams": 24, "origins": 24, "rows": 2048, "arrivals": 1024, "seats": 256, "vehicles": 48}


@cache
def program(minutes: float) -> tuple[Any, Any]:
    """One program for all sites."""
    mesh = Mesh(np.array(jax.local_devices()), ("worlds",))
    config = Config(dt=DT)

    def record(_: Any) -> Any:
        def kept(tick: Any) -> Any:
            x = tick.state
            which = jnp.asarray(jnp.where(x.active, x.lane, -1), jnp.int16)
            return which, (x.v * 100).astype(jnp.int16), jnp.asarray(x.entered, jnp.int16)

        return kept

    run = Rollout(config, Traffic(), 60 * minutes, record=record)

    def start(shared: Any, seed: Any) -> Any:
        lane_map, demand, lane, s = shared

        def sampler(key: Any) -> Scenario:
            return _with_standing(sample_scenario(demand, lane_map, key, SLOTS), lane, s)

        return started(run, lane_map, sampler, seed)

    def advance(shared: Any, world: Any) -> Any:
        return run.advance(shared[0], *world)[0].trace

    return over_worlds(start, mesh), over_worlds(advance, mesh)


def _with_standing(scenario: Scenario, lane: Any, s: Any) -> Scenario:
    """The scenario and a car that stands on a lane.

    It takes the last slot; for a lane of -1 there is none.
    """
    x, last = scenario.start, (jnp.arange(SLOTS) == SLOTS - 1) & (lane >= 0)
    driver, shape = sample(
        uniform_population("car", v_max=0.0, politeness=0.0, threshold=1000.0), jax.random.key(0)
    )
    put = lambda new, old: jnp.where(last, jnp.asarray(new, old.dtype), old)  # noqa: E731
    mix = lambda new, old: jax.tree.map(put, new, old)  # noqa: E731
    start = replace(x, driver=mix(driver, x.driver), shape=mix(shape, x.shape), lane=put(lane, x.lane),
                    s=put(s, x.s), v=put(0.0, x.v), goal=put(0, x.goal), active=x.active | last)  # fmt: skip
    return replace(scenario, start=start)


def ours(site: Site, net: Path, demand: Mapping[tuple[str, str], float], worlds: int, minutes: float) -> Seen:
    """Our traffic on a site."""
    network = read_network(net, cache=False)
    lane_map = build_lane_map(network, least=SIZES, cache=False)
    population = restrict_to_map(default_population(site.mix), lane_map)
    flows = [Flow(origin=a, goal=b, rate=rate) for (a, b), rate in demand.items() if rate > 0]
    spec = build_demand(
        network, lane_map, default_goals(network), flows, population, horizon=60 * minutes, vehicles=0,
        least=DEMAND,
    )  # fmt: skip
    start, advance = program(minutes)
    count = -(-worlds // jax.local_device_count()) * jax.local_device_count()
    ids = lane_ids(network)
    name, s = site.standing or ("", 0.0)
    shared = (lane_map, spec, jnp.int32(ids.index(name) if name else -1), jnp.float32(s))
    lanes, speeds, who = jax.device_get(advance(shared, start(shared, np.arange(count, dtype=np.int32))))
    roads = [name.rsplit("_", 1)[0] for name in ids]
    of = np.array([*(list(site.roads).index(x) if x in site.roads else -1 for x in roads), -1])
    return _seen(site, ids, of, lanes[:worlds], speeds[:worlds] / 100, who[:worlds])


def _seen(site: Site, ids: Sequence[str], of: NDArray, lanes: NDArray, v: NDArray, who: NDArray) -> Seen:
    """From lanes, speeds and arrivals `[W, T, N]`."""
    here = list(site.roads)
    passed: dict[tuple[str, str], list[tuple[int, float]]] = {
        (a, b): [] for a in here for b in here if a != b
    }
    hours = (lanes.shape[1] * DT - WARM) / 3600
    warm = round(WARM / DT)
    same = (who[:, 1:] == who[:, :-1]) & (lanes[:, 1:] >= 0) & (lanes[:, :-1] >= 0)
    now, was = of[lanes[:, 1:]], of[lanes[:, :-1]]
    time = np.arange(lanes.shape[1])[:, None]
    for w in range(len(lanes)):
        road = of[lanes[w]]  # [T, N]; inside junctions -1
        known = np.maximum.accumulate(np.where(road >= 0, time, 0), 0)
        last = np.take_along_axis(road, known, 0)
        mine = np.take_along_axis(who[w], known, 0) == who[w]
        before = np.where(mine[:-1] & mine[1:], last[:-1], -1)
        for t, n in zip(*np.nonzero((road[1:] >= 0) & (before >= 0) & (road[1:] != before)), strict=True):
            if who[w, t + 1, n] == who[w, known[t, n], n]:
                passed[here[before[t, n]], here[road[t + 1, n]]].append((w, (t + 1) * DT))
    passes = {
        way: [np.array([t for k, t in found if k == w]) for w in range(len(lanes))]
        for way, found in passed.items()
    }
    inner = here.index("in") if "in" in here else -2
    moved = same & (now == inner) & (was == inner) & (lanes[:, 1:] != lanes[:, :-1])
    changes = moved[:, warm:].sum() / len(lanes) / hours
    on = of[lanes[:, warm:]] == inner
    leftmost = f"in_{site.roads['in'].lanes - 1}" if inner >= 0 else ""
    left = (on & (lanes[:, warm:] == _row(ids, leftmost))).sum() / max(on.sum(), 1)
    aside = lanes == _row(ids, "beside_0")
    came = {(w, n, who[w, t, n]) for w, t, n in zip(*np.nonzero(aside), strict=True) if t >= warm}
    slow = {(w, n, who[w, t, n]) for w, t, n in zip(*np.nonzero(aside & (v < STANDS)), strict=True)}
    return Seen(passes, changes, len(slow & came) / max(len(came), 1), float(left), hours)


def _row(ids: Sequence[str], name: str) -> int:
    return list(ids).index(name) if name in ids else -9


# --- SUMO's ------------------------------------------------------------------------------------------


def theirs(
    site: Site, net: Path, demand: Mapping[tuple[str, str], float], worlds: int, minutes: float
) -> Seen:
    """SUMO's traffic on a site, with its default drivers."""
    import libsumo  # pyright: ignore[reportMissingImports]

    flows = "".join(
        f'<flow id="{a}.{b}" begin="0" end="{60 * minutes}" from="{a}" to="{b}" '
        f'period="exp({rate / 3600})" departLane="best" departSpeed="max"/>'
        for (a, b), rate in demand.items() if rate > 0
    )  # fmt: skip
    routes, log = net.with_name("site.rou.xml"), net.with_name("changes.xml")
    if site.standing is not None:
        lane, s = site.standing
        edge, at = lane.rsplit("_", 1)
        first = f'<trip id="stands" depart="0" from="{edge}" to="out" departLane="{at}" departPos="{s - 50}">'
        flows = f'{first}<stop lane="{lane}" endPos="{s}" duration="1e6"/></trip>{flows}'
    routes.write_text(f"<routes>{flows}</routes>")
    here = list(site.roads)
    passes: dict[tuple[str, str], list[NDArray]] = {(a, b): [] for a in here for b in here if a != b}
    hours = (60 * minutes - WARM) / 3600
    changes, came, slow, on, left = 0, set[Any](), set[Any](), 0, 0
    inner = site.roads.get("in")
    for seed in range(worlds):
        options = ["-n", str(net), "-r", str(routes), "--step-length", str(DT), "--seed", str(seed)]
        options += ["--lanechange-output", str(log), "--no-step-log", "--no-warnings"]
        libsumo.start(["sumo", *options, "--xml-validation", "never"])
        where: dict[str, str] = {}
        found: dict[tuple[str, str], list[float]] = {way: [] for way in passes}
        for step in range(1, round(60 * minutes / DT) + 1):
            libsumo.simulationStep()
            t = step * DT
            for road in site.roads:
                for name in libsumo.edge.getLastStepVehicleIDs(road):
                    if where.get(name) != road:
                        if name in where:
                            found[where[name], road].append(t)
                        where[name] = road
            if "beside" in site.roads and t >= WARM:
                for name in libsumo.lane.getLastStepVehicleIDs("beside_0"):
                    came.add((seed, name))
                    if libsumo.vehicle.getSpeed(name) < STANDS:
                        slow.add((seed, name))
            if inner is not None and t >= WARM and step % 50 == 0:
                on += libsumo.edge.getLastStepVehicleNumber("in")
                left += libsumo.lane.getLastStepVehicleNumber(f"in_{inner.lanes - 1}")
        libsumo.close()
        changes += sum(
            'from="in_' in line and float(line.split('time="')[1].split('"')[0]) >= WARM
            for line in log.read_text().splitlines() if "<change " in line
        )  # fmt: skip
        for way, when in found.items():
            passes[way].append(np.array(when))
    stood = len(slow) / max(len(came), 1)
    return Seen(passes, changes / worlds / hours, stood, left / max(on, 1), hours)


# --- the table ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cell:
    """A row: a site under a demand, what is measured, and what real roads have."""

    site: str
    what: str
    unit: str
    make: Callable[[], Site]
    demand: Mapping[Any, float]  # veh/h by origin and goal
    measure: Callable[[Seen], float]
    real: str
    source: str = ""


def _hcm(v: float, gap: float, follow: float) -> float:
    """veh/h of a minor stream across `v` veh/h (HCM 6, equation 20-36)."""
    return 3600 / follow if v == 0 else v * math.exp(-v * gap / 3600) / (1 - math.exp(-v * follow / 3600))


def cells() -> list[Cell]:
    """All rows."""
    found = []
    through = ("in", "out")
    for rate in (4200.0, 7200.0):
        demand, said = {through: rate}, f"{rate:,.0f} veh/h on three lanes"
        add = lambda what, unit, measure, real, source: found.append(  # noqa: E731
            Cell("motorway", f"{said}: {what}", unit, motorway, demand, measure, real, source)  # noqa: B023
        )
        add("served per lane, best 5 min", "veh/h", lambda s: best_five(s, "out") / 3,
            "2,000 to 2,400" if rate > 6000 else "", "HCM 6, chapter 12")  # fmt: skip
        add("lane changes", "per veh-km", lambda s: s.changes / (LONG * flow(s, "out")), "0.5",
            "Knoop et al. 2012")  # fmt: skip
        add("share of the left lane", "%", lambda s: 100 * s.left, "grows with the flow",
            "Duret et al. 2012")  # fmt: skip
    for lanes, main, ramp in ((2, 2400, 800), (2, 3000, 500), (2, 3600, 800), (3, 3600, 1200)):
        demand = {("in", "out"): float(main), ("ramp", "out"): float(ramp)}
        said = f"{lanes} lanes, {main:,} + {ramp:,} veh/h"
        make = MERGES[lanes]
        found.append(Cell("merge", f"{said}: served", "veh/h", make, demand, lambda s: flow(s, "out"),
                          f"{main + ramp:,} asked"))  # fmt: skip
        found.append(
            Cell("merge", f"{said}: stood on the ramp's lane", "%", make, demand, lambda s: 100 * s.stood, "")
        )
    for rate in (3800.0, 4200.0):
        found.append(Cell("lane drop", f"3 to 2 lanes, {rate:,.0f} veh/h: served", "veh/h", lane_drop,
                          {through: rate}, lambda s: flow(s, "out"), *TWO_LANES))  # fmt: skip
    demand = {through: 2400.0, ("ramp", "out"): 800.0, ("in", "exit"): 800.0}
    found.append(Cell("weaving", "2,400 through, 800 on, 800 off: served", "veh/h", weaving, demand,
                      lambda s: flow(s, "out") + flow(s, "exit"), *TWO_LANES))  # fmt: skip
    for rate in (600.0, 1500.0):
        said, demand = f"a car stands on one of two lanes, {rate:,.0f} veh/h", {through: rate}
        found.append(Cell("standing car", f"{said}: served", "veh/h", standing, demand,
                          lambda s: flow(s, "out"), f"{rate:,.0f} asked"))  # fmt: skip
        found.append(Cell("standing car", f"{said}: longest time in which none passes", "s", standing, demand,
                          lambda s: longest_gap(s, "out"), ""))  # fmt: skip
    found.append(Cell("signal", "saturation flow from the fifth on", "veh/h", signal,
                      {through: 1800.0, ("side", "away"): 60.0}, lambda s: saturation(s, "out"),
                      "1,800 to 1,950", "HCM 6, chapter 19"))  # fmt: skip
    for rate in (0.0, 400.0, 800.0):
        demand = {("in_north", "out_east"): rate, ("in_west", "out_south"): 1700.0}
        found.append(Cell("roundabout", f"entry against {rate:,.0f} veh/h", "veh/h", roundabout, demand,
                          lambda s: flow(s, "out_south"), f"{1380 * math.exp(-0.00102 * rate):,.0f}",
                          "HCM 6, equation 22-1"))  # fmt: skip
    minor = {"right": ("out_east", 6.2, 3.3), "straight": ("out_north", 6.5, 4.0)}
    minor["left"] = ("out_west", 7.1, 3.5)
    for rate in (200.0, 600.0):
        for turn, (goal, gap, follow) in minor.items():
            demand = {("in_west", "out_east"): rate, ("in_south", goal): 1500.0}
            count = lambda s, goal=goal: flow(s, goal, "in_south")  # noqa: E731
            found.append(Cell("two-way stop", f"{turn} across {rate:,.0f} veh/h", "veh/h", two_way, demand,
                              count, f"{_hcm(rate, gap, follow):,.0f}", "HCM 6, chapter 20"))  # fmt: skip
        demand = {("in_west", "out_east"): rate, ("in_east", "out_south"): 1700.0}
        found.append(Cell("two-way stop", f"left from the major road across {rate:,.0f} veh/h", "veh/h",
                          two_way, demand, lambda s: flow(s, "out_south"),
                          f"{_hcm(rate, 4.1, 2.2):,.0f}", "HCM 6, chapter 20"))  # fmt: skip
    ways = {("in_west", "out_east"): 400.0, ("in_east", "out_west"): 400.0,
            ("in_south", "out_north"): 400.0, ("in_north", "out_south"): 400.0}  # fmt: skip
    found.append(Cell("four-way stop", "1,600 veh/h straight on: served", "veh/h", all_way, ways,
                      lambda s: sum(flow(s, f"out_{x}") for x in ("west", "east", "south", "north")),
                      "1,300 to 1,800", "HCM 6, chapter 21; Al-Kaisy and Doruk 2023"))  # fmt: skip
    return found


def _said(x: float) -> str:
    return f"{x:.2f}" if x < 2 else f"{x:,.0f}"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown."""
    lines = ["| site | | unit | ours | SUMO | real roads | source |", "|---|---|---|---:|---:|---|---|"]
    for r in rows:
        lines.append(
            f"| {r['site']} | {r['what']} | {r['unit']} | {_said(r['ours'])} | {_said(r['SUMO'])} "
            f"| {r['real']} | {r['source']} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Parse the command line, run, write."""
    wanted = cells()
    every = list(dict.fromkeys(cell.site for cell in wanted))
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--sites", nargs="+", choices=every, default=every)
    options = parser.parse_args()
    if options.worlds < 1 or not options.minutes * 60 >= WARM + 300:
        parser.error("at least one world, and ten minutes: the first five do not count")
    if not find_spec("sumo") or not find_spec("libsumo"):
        parser.error("SUMO is missing: pip install eclipse-sumo libsumo")
    use_all_cores()
    enable_compilation_cache()
    file = RESULTS / "capacity.json"
    kept = {r["what"]: r for r in json.loads(file.read_text())["rows"]} if file.exists() else {}
    done: dict[Any, tuple[Seen, Seen]] = {}
    order = [cell.what for cell in wanted]
    for cell in wanted:
        if cell.site not in options.sites:
            continue
        key = cell.make, tuple(cell.demand.items())
        if key not in done:
            site = cell.make()
            with tempfile.TemporaryDirectory() as folder:
                net = site.write(Path(folder))
                given = site, net, cell.demand
                done[key] = (
                    ours(*given, options.worlds, options.minutes),
                    theirs(*given, 1, options.minutes),
                )
        of_us, of_sumo = (float(cell.measure(x)) for x in done[key])
        kept[cell.what] = {"site": cell.site, "what": cell.what, "unit": cell.unit, "ours": of_us,
                           "SUMO": of_sumo, "real": cell.real, "source": cell.source}  # fmt: skip
        print(json.dumps(kept[cell.what]), flush=True)
        rows = sorted((r for name, r in kept.items() if name in order), key=lambda r: order.index(r["what"]))
        write_whole(file, json.dumps({"rows": rows}, indent=1) + "\n")
        head = "Regenerate: `python experiments/capacity.py`\n\n"
        write_whole(file.with_suffix(".md"), head + table(rows) + "\n")


if __name__ == "__main__":
    main()
