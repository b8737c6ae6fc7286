"""Our planners among SUMO's drivers and among ours, in the same traffic; and what the bridge costs.

    python experiments/sumo_bridge.py [--seeds 3] [--nets ingolstadt1] [--policies pdm_closed] [--horizon 60]
    python experiments/sumo_bridge.py --full
    python experiments/sumo_bridge.py --only-cost

`--full`: both planners, 120 s, 50 seeds, the networks of `FULL`. `--out DIR` keeps the worlds, and the same
command goes on where it was stopped. The costs of the bridge are measured once, or by `--only-cost`.

A seed draws a car of the scenario's own demand; the planner takes it over within its first minutes. For both
drivers it is the same car, at the same moment, among the same vehicles: SUMO drives them on, or we take all
of them over. SUMO inserts vehicles, says their routes and owns the signals in both. Writes
experiments/results/sumo_bridge.json and .md, where rows of other networks stay. Needs shared data, and the
extra `sumo`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import pickle
import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

import limsim_jax as lj
from limsim_jax.bridges.sumo.link import Link
from limsim_jax.bridges.sumo.messages import Move, Orders, Start
from limsim_jax.files import write_whole
from limsim_jax.policies.base import sighted
from limsim_jax.statistics import wilson
from limsim_jax.xla import run_often

RESULTS = Path(__file__).parent / "results"
DATA = Path(os.environ.get("LIMSIM_SHARED_DATA", "shared/data")) / "sumo"
FULL = (
    "ingolstadt1",
    "bologna_pasubio",
    "limsim_roundabout",
    "limsim_bigInter",
    "limsim_town05",
)
COLUMNS = ("success", "nuplan_score", "at_fault_contacts", "completion", "mean_speed", "sumo_collisions")
CHUNK = 10  # worlds at the same time
KEPT = 24  # decisions that are timed
WARM = 1200  # steps until there are vehicles to read
STEPS = 200  # that are timed
EVERY = 10  # decisions of a world, of which one is timed
CALLS = 20  # per decision that is timed; the median counts


def config(net: str, folder: Path) -> Path:
    """The `.sumocfg` of a network, or one for its files."""
    for there in (DATA / net / f"{net}.sumocfg", DATA / net / "run.sumocfg"):
        if there.exists():
            return there
    network = next((DATA / net).glob("*.net.xml"))
    routes = sorted((DATA / net).glob("*.rou.xml"), key=lambda x: "vtypes" not in x.name)
    path = folder / f"{net}.sumocfg"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f'<configuration><net-file value="{network}"/>'
        f'<route-files value="{",".join(map(str, routes))}"/></configuration>'
    )
    return path


def figures(episodes: dict[str, list[Any]]) -> dict[str, Any]:
    """Means over seeds, and the interval of the success."""
    found = {x: float(np.nanmean(np.array(episodes[x], float))) for x in COLUMNS}
    good = np.array(episodes["success"], float)
    low, high = wilson(int(good.sum()), good.size)[1:]
    echo = float(np.max(episodes["sumo_echo"]))
    return found | {"seeds": good.size, "success_low": low, "success_high": high, "sumo_echo": echo}


def decision_ms(world: lj.SumoWorld) -> float:
    """Median time of a decision of the policy alone: of the processor, so other work does not count.

    It decides in states of the world of seed 0: the first ones, every `EVERY`th.
    """
    episodes: Any = world.episodes
    start, tick, finish = episodes._compiled
    kept: list[Any] = []
    calls = 0

    def keeping(lanes: Any, carry: Any, *more: Any) -> Any:
        nonlocal calls
        found = tick(lanes, carry, *more)
        if len(kept) < KEPT and calls % (EVERY * episodes.experiment.decision_every) == 0:
            kept.append((lanes, *jax.tree.map(lambda x: x[0], (found[0].state, found[0].memory))))
        calls += 1
        return found

    episodes._compiled = start, keeping, finish
    episodes.run([0])
    program: Any = episodes.program
    decide = jax.jit(partial(sighted(program.policy), program.planning), compiler_options=run_often())
    key, times = jax.random.key(0), []
    for case in kept:
        jax.block_until_ready(decide(*case, key))
        for _ in range(CALLS):
            begin = time.process_time()
            jax.block_until_ready(decide(*case, key))
            times.append(time.process_time() - begin)
    return 1e3 * float(np.median(times))


def rows(
    nets: Sequence[str], policies: list[str], seeds: int, horizon: float, folder: Path
) -> Iterator[list[dict[str, Any]]]:
    """A row for each kind of drivers, per network and planner."""
    for net in nets:
        for name in policies:
            compiled, seen = None, []
            for drivers in ("sumo", "ours"):
                world = lj.SumoWorld(
                    config(net, folder), policy=name, horizon=horizon, drivers=drivers, name=net,
                    chunk=min(seeds, CHUNK),
                )  # fmt: skip
                episodes: Any = world.episodes
                if compiled is None:
                    compiled = episodes._compiled
                episodes._compiled = compiled  # one program for both kinds of drivers
                table = world.sweep(seeds, folder / f"{net}-{name}-{drivers}", progress=False)
                seen.append(figures(table.episodes.to_pydict()))
                seen[-1] |= {"net": net, "policy": name, "drivers": drivers}
                print(seen[-1], flush=True)
            time_ms = decision_ms(world)
            yield [row | {"decision_ms": time_ms} for row in seen]


def cost(path: str) -> dict[str, Any]:
    """µs per vehicle and step, where all vehicles are read and moved; in a process without a simulation."""
    link = Link(Start(arguments=("-c", path), seed=1, dt=0.1))
    for _ in range(WARM):
        link.step(Orders())
    parts = "step", "read", "move", "pipe"
    spent: dict[str, float] = {name: 0.0 for name in parts}
    counted: dict[str, int] = {name: 0 for name in parts}

    def spend(name: str, begin: float, count: int) -> float:
        now = time.perf_counter()
        spent[name] += now - begin
        counted[name] += count
        return now

    reading = link.read()
    for _ in range(STEPS):
        count = len(reading.handle)
        began = time.perf_counter()
        link.sumo.simulationStep()
        began = spend("step", began, count)
        reading = link.read()
        spend("read", began, len(reading.handle))
    each = {name: spent[name] / max(counted[name], 1) for name in ("step", "read")}
    for _ in range(STEPS):
        columns = (reading.handle, reading.x, reading.y, reading.angle, reading.v)
        moves = {int(h): Move(x, y, w, v) for h, x, y, w, v in zip(*columns, strict=True)}
        orders = Orders(take=tuple(h for h in moves if h not in reading.owned), move=moves)
        began = time.perf_counter()
        pickle.loads(pickle.dumps(orders, pickle.HIGHEST_PROTOCOL))
        pickle.loads(pickle.dumps(reading, pickle.HIGHEST_PROTOCOL))
        began = spend("pipe", began, len(moves))
        reading = link.step(orders)
        spend("move", began, len(moves))
    each |= {name: spent[name] / counted[name] for name in ("move", "pipe")}
    each["move"] -= each["step"] + each["read"]
    link.close()
    return {"vehicles": round(counted["move"] / STEPS)} | {f"{k}_us": 1e6 * x for k, x in each.items()}


def costs(nets: list[str], folder: Path) -> list[dict[str, Any]]:
    """`cost` of each network, in a process of its own: libsumo holds one simulation."""
    found = []
    for net in nets:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            found.append({"net": net} | pool.apply(cost, (str(config(net, folder)),)))
    return found


def markdown(found: dict[str, Any]) -> str:
    """Both tables."""
    lines = [
        "| network | planner | drivers | seeds | success | nuPlan score | contacts at fault | completion | "
        "mean speed, m/s | decision, ms |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in found["rows"]:
        share = f"{row['success']:.0%} [{row['success_low']:.0%}, {row['success_high']:.0%}]"
        who = {"sumo": "SUMO's", "ours": "ours"}[row["drivers"]]
        cells = [row["net"], row["policy"], who, row["seeds"], share, f"{row['nuplan_score']:.2f}"]
        cells += [f"{row['at_fault_contacts']:.2f}", f"{row['completion']:.0%}", f"{row['mean_speed']:.1f}"]
        cells.append(f"{row['decision_ms']:.1f}")
        lines.append(f"| {' | '.join(map(str, cells))} |")
    ends = ["", f"Each ego has {found['horizon']:g} s.", ""]
    lines = [*lines, *ends] if found["rows"] else []
    lines += ["| network | vehicles | SUMO's step, µs | reading, µs | moving, µs | pickling, µs |"]
    lines += ["|---|---:|---:|---:|---:|---:|"]
    for row in found["cost"]:
        parts = " | ".join(f"{row[f'{name}_us']:.1f}" for name in ("step", "read", "move", "pipe"))
        lines.append(f"| {row['net']} | {row['vehicles']} | {parts} |")
    return "\n".join([*lines, "", "Per vehicle and step.", ""])


def save(path: Path, found: dict[str, Any]) -> None:
    """Write both files."""
    write_whole(path, json.dumps(found, indent=1) + "\n")
    write_whole(path.with_suffix(".md"), markdown(found))


def main() -> None:
    """Run, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--nets", default="ingolstadt1,limsim_roundabout")
    parser.add_argument("--policies", default="pdm_closed")
    parser.add_argument("--horizon", type=float, default=60.0)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--out", type=Path, help="folder that keeps the worlds")
    parser.add_argument("--only-cost", action="store_true")
    given = parser.parse_args()
    nets, policies = given.nets.split(","), given.policies.split(",")
    seeds, horizon = given.seeds, given.horizon
    if given.full:
        nets, policies, seeds, horizon = FULL, ["pdm_closed", "limsim_tm"], 50, 120.0
    path = RESULTS / "sumo_bridge.json"
    found = json.loads(path.read_text()) if path.exists() else {"rows": [], "horizon": horizon, "cost": []}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) if given.out is None else given.out
        if not given.only_cost:
            others = [x for x in found["rows"] if x["net"] not in nets and found["horizon"] == horizon]
            found |= {"rows": others, "horizon": horizon}
            for more in rows(nets, policies, seeds, horizon, out):
                found["rows"] += more
                save(path, found)
        if given.only_cost or not found["cost"]:
            found["cost"] = costs(["ingolstadt1", "bologna_pasubio", "limsim_town05"], out)
    save(path, found)
    print(markdown(found))


if __name__ == "__main__":
    main()
