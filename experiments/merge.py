"""Merging and exiting on a motorway, next to SUMO.

    python experiments/merge.py [--worlds 64] [--length 200] [--ramp 1200]

A motorway of three lanes with 120 km/h. Vehicles have to enter it (`on`) from a ramp with 80 km/h over an
acceleration lane of `--length` m without a taper, or leave it (`off`) over a deceleration lane. The flow on
the motorway grows from row to row. Both simulators read the same network, with the same flows and their own
default drivers. The table counts vehicles that have to change lanes, those that stop before they have done
so, and those that never do. Writes experiments/results/merge.json and .md. Needs `eclipse-sumo`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import numpy as np
from capacity import FAST, WIDTH, Road, Site
from watch import STANDS, Changes

from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, read_network
from limsim_jax.maps.routing import default_goals
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.traffic.demand import Flow, build_demand, sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.vehicles import default_population, restrict_to_map
from limsim_jax.types import Config
from limsim_jax.xla import use_all_cores

RESULTS = Path(__file__).parent / "results"
MOTORWAY = (1200.0, 2400.0, 3600.0, 4800.0)  # veh/h on its three lanes
HORIZON = 600.0  # s
SLOTS = 256
DT = 0.1  # s, of both
SLOW = 22.22  # m/s
UPSTREAM, DOWNSTREAM, RAMP = 800.0, 600.0, 300.0  # m


def network(case: str, length: float, folder: Path) -> Path:
    """A motorway with a ramp, from SUMO's netconvert."""
    on, edge = case == "on", -3 * WIDTH  # lanes lie to the right of their edge
    course = [(-RAMP, edge - 0.1 * RAMP), (-RAMP / 3, edge), (0.0, edge)]
    course = course if on else [(length - x, y) for x, y in reversed(course)]
    nodes = {
        "west": (-UPSTREAM, 0.0),
        "a": (0.0, 0.0),
        "b": (length, 0.0),
        "east": (length + DOWNSTREAM, 0.0),
    }
    nodes["far"] = course[0 if on else -1]
    roads = {
        "before": Road("west", "a", 3, FAST),
        "beside": Road("a", "b", 4, FAST),
        "after": Road("b", "east", 3, FAST),
        "ramp": Road("far", "a", 1, SLOW, course) if on else Road("b", "far", 1, SLOW, course),
    }
    links = [("before", k, "beside", k + 1) for k in range(3)]
    links += [("beside", k + 1, "after", k) for k in range(3)]
    links.append(("ramp", 0, "beside", 0) if on else ("beside", 0, "ramp", 0))
    return Site(nodes, roads, links).write(folder)


def flows(case: str, motorway: float, ramp: float) -> list[tuple[str, str, float]]:
    """Origin, goal, veh/h."""
    if case == "on":
        return [("before", "after", motorway), ("ramp", "after", ramp)]
    return [("before", "after", motorway - ramp), ("before", "ramp", ramp)]


def ours(net: Path, demand: list[tuple[str, str, float]], worlds: int) -> dict[str, Any]:
    """Our traffic."""
    found = read_network(net)
    lane_map = build_lane_map(found)
    wanted = [Flow(origin=a, goal=b, rate=rate) for a, b, rate in demand if rate > 0]
    population = restrict_to_map(default_population(), lane_map)
    goals = default_goals(found)
    spec = build_demand(found, lane_map, goals, wanted, population, horizon=HORIZON, vehicles=0)
    run = Rollout(Config(dt=DT), Traffic(), HORIZON, measure=Changes())
    batch = Worlds(
        run, lane_map, lambda key: sample_scenario(spec, lane_map, key, SLOTS), chunk=min(worlds, 32)
    )
    parts = [(x.totals, x.measures) for _, x in batch.chunks(range(worlds))]
    totals, counts = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    must, stood, missed = (int(x) for x in counts.sum(0))
    return {
        "must_change": must,
        "stood": stood,
        "missed": missed,
        "contacts": int(totals.collided.sum()),
        "left_per_hour": float(totals.left.sum()) * 3600 / HORIZON / worlds,
        "speed": float(totals.distance.sum() / totals.time.sum()),
    }


def theirs(net: Path, demand: list[tuple[str, str, float]], worlds: int) -> dict[str, Any]:
    """SUMO's traffic; vehicles that it teleports from a wrong lane have missed."""
    import libsumo  # pyright: ignore[reportMissingImports]

    lines = [
        f'<flow id="{a}_{b}" begin="0" end="{HORIZON}" from="{a}" to="{b}" period="exp({rate / 3600})" '
        f'departLane="best" departSpeed="max"/>'
        for a, b, rate in demand if rate > 0
    ]  # fmt: skip
    routes = net.with_suffix(".rou.xml")
    routes.write_text(f"<routes>{''.join(lines)}</routes>")
    through = {f"{a}_{b}" for a, b, _ in demand if (a, b) == ("before", "after")}
    must, stood, missed, contacts, left, metres, seconds = 0, 0, 0, 0, 0, 0.0, 0.0
    for seed in range(worlds):
        options = ["-n", str(net), "-r", str(routes), "--step-length", str(DT), "--seed", str(seed)]
        libsumo.start(["sumo", *options, "--no-step-log", "--no-warnings", "--xml-validation", "never"])
        come, stand, gone, hit = set[str](), set[str](), set[str](), set[str]()
        for _ in range(round(HORIZON / DT)):
            libsumo.simulationStep()
            left += libsumo.simulation.getArrivedNumber()
            hit |= set(libsumo.simulation.getCollidingVehiclesIDList())
            gone |= set(libsumo.simulation.getStartingTeleportIDList())
            for name in libsumo.vehicle.getIDList():
                v = libsumo.vehicle.getSpeed(name)
                metres, seconds = metres + v * DT, seconds + DT
                if name.rsplit(".", 1)[0] in through:
                    continue
                lane = libsumo.vehicle.getLaneID(name)
                off = name.startswith("before")  # to the exit
                come |= {name} if not off or lane.startswith("before") else set()
                waits = lane.startswith("beside") and (lane != "beside_0") == off
                stand |= {name} if waits and v < STANDS else set()
        libsumo.close()
        must, stood, missed = must + len(come), stood + len(stand), missed + len(gone & come)
        contacts += len(hit)
    return {
        "must_change": must,
        "stood": stood,
        "missed": missed,
        "contacts": contacts,
        "left_per_hour": left * 3600 / HORIZON / worlds,
        "speed": metres / seconds,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| ramp | motorway, veh/h | ramp, veh/h | simulator | have to change lanes | stood before, % "
        "| missed, % | arrived, veh/h | mean speed, m/s | contacts |",
        "|---|---:|---:|---|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        for name in ("ours", "SUMO"):
            x = row[name]
            stood, missed = (100 * x[key] / max(x["must_change"], 1) for key in ("stood", "missed"))
            lines.append(
                f"| {row['case']} | {row['motorway']:,.0f} | {row['ramp']:,.0f} | {name} "
                f"| {x['must_change']:,} | {stood:.2f} | {missed:.2f} "
                f"| {x['left_per_hour']:,.0f} | {x['speed']:.1f} | {x['contacts']} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--peer-worlds", type=int, default=8)
    parser.add_argument("--length", type=float, default=200.0)
    parser.add_argument("--ramp", type=float, default=1200.0)
    options = parser.parse_args()
    for name, least in (("worlds", 1), ("peer_worlds", 1), ("length", 50), ("ramp", 1)):
        if not getattr(options, name) >= least:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name):g}: at least {least}")
    if options.ramp > min(MOTORWAY):
        parser.error(f"--ramp {options.ramp:g}: at most {min(MOTORWAY):g}, the least flow on the motorway")
    if not find_spec("sumo") or not find_spec("libsumo"):
        parser.error("SUMO is missing: pip install eclipse-sumo libsumo")
    use_all_cores()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for case in ("on", "off"):
            net = network(case, options.length, Path(folder))
            for motorway in MOTORWAY:
                demand = flows(case, motorway, options.ramp)
                row = {"case": case, "length": options.length, "motorway": motorway, "ramp": options.ramp}
                row["ours"] = ours(net, demand, options.worlds)
                row["SUMO"] = theirs(net, demand, options.peer_worlds)
                rows.append(row)
                print(json.dumps(row), flush=True)
    RESULTS.mkdir(exist_ok=True)
    head = f"Regenerate: `python experiments/merge.py`. Ramps of {options.length:g} m.\n\n"
    write_whole(RESULTS / "merge.json", json.dumps({"rows": rows}, indent=1) + "\n")
    write_whole(RESULTS / "merge.md", head + table(rows) + "\n")


if __name__ == "__main__":
    main()
