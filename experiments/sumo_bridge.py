"""Our planners in SUMO's traffic, beside the same planners in ours; and what the bridge costs.

    python experiments/sumo_bridge.py [--seeds 4] [--nets ingolstadt1] [--policies pdm_closed,limsim_tm]
    python experiments/sumo_bridge.py --full
    python experiments/sumo_bridge.py --only-cost

`--full`: 50 seeds on five networks. In SUMO's traffic a car of the scenario's own demand is taken over within
its first minutes. In ours an ego starts at random among 30 vehicles, and 300 veh/h come in at each origin.
Both have 120 s and arrive at the end of their routes. The cost is that of a SUMO process with all its
vehicles read, and of one that moves them all as well, per vehicle and step. Writes
experiments/results/sumo_bridge.json and .md. Needs shared data, and the extra `sumo`.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import limsim_jax as lj
from limsim_jax.bridges.sumo.messages import Move, Orders, Start
from limsim_jax.bridges.sumo.process import SumoProcess
from limsim_jax.files import write_whole
from limsim_jax.statistics import wilson

RESULTS = Path(__file__).parent / "results"
DATA = Path(os.environ.get("LIMSIM_SHARED_DATA", "shared/data")) / "sumo"
ALL: tuple[str, ...] = (
    "ingolstadt1",
    "bologna_pasubio",
    "limsim_town05",
    "limsim_roundabout",
    "limsim_bigInter",
)
HORIZON = 120.0  # s
VEHICLES, RATE = 30, 300.0  # of our traffic at the start, and veh/h at each origin
COLUMNS = ("success", "contacts", "completion", "nuplan_score", "mean_speed")
WARM = 1200  # steps until there are vehicles to read
STEPS = 200  # that are timed


def config(net: str, folder: Path) -> Path:
    """The `.sumocfg` of a network, or one for its files."""
    for there in (DATA / net / f"{net}.sumocfg", DATA / net / "run.sumocfg"):
        if there.exists():
            return there
    network = next((DATA / net).glob("*.net.xml"))
    routes = sorted((DATA / net).glob("*.rou.xml"), key=lambda x: "vtypes" not in x.name)
    path = folder / f"{net}.sumocfg"
    path.write_text(
        f'<configuration><net-file value="{network}"/>'
        f'<route-files value="{",".join(map(str, routes))}"/></configuration>'
    )
    return path


def figures(outcome: Any, seconds: dict[str, list[float]] | None) -> dict[str, Any]:
    """Means over seeds, and the interval of the success."""
    table = outcome.episodes.to_pydict()
    found = {x: float(np.nanmean(np.array(table[x], float))) for x in COLUMNS if x in table}
    good = np.array(table["success"], float)
    low, high = wilson(int(good.sum()), good.size)[1:]
    found |= {"seeds": good.size, "success_low": low, "success_high": high}
    if seconds is not None:
        found["decision_ms"] = 1e3 * (
            float(np.median(seconds["decide"])) - float(np.median(seconds["drive"]))
        )
        found["sumo_collisions"] = float(np.mean(table["sumo_collisions"]))
        found["sumo_echo"] = float(np.max(table["sumo_echo"]))
    return found


def rows(nets: list[str], policies: list[str], seeds: int, folder: Path) -> list[dict[str, Any]]:
    """A row per network, planner and traffic."""
    found = []
    for net in nets:
        path = config(net, folder)
        for name in policies:
            world = lj.SumoWorld(path, policy=name, horizon=HORIZON, name=net)
            results = world.sweep(seeds, folder / f"{net}-{name}-sumo", progress=False)
            theirs = figures(results, world.episodes.seconds)
            ours = lj.Experiment(
                map=world.file.map, name=net, horizon=HORIZON, ego=lj.Ego(policy=name), slots=128,
                flows=[lj.Flow(rate=RATE)], vehicles=VEHICLES,
            )  # fmt: skip
            own = lj.sweep(ours, seeds=seeds, out=folder / f"{net}-{name}-ours", progress=False)
            for traffic, row in (("SUMO", theirs), ("ours", figures(own, None))):
                found.append({"net": net, "policy": name, "traffic": traffic, **row})
                print(found[-1], flush=True)
    return found


def cost(net: str, folder: Path) -> dict[str, Any]:
    """µs per vehicle and step: to read it, and to move it; and how many vehicles there are."""
    found = {}
    with SumoProcess(Start(arguments=("-c", str(config(net, folder))), seed=1, dt=0.1)) as process:
        reading = process.step(Orders())
        for _ in range(WARM):
            reading = process.step(Orders())
        count = len(reading.handle)
        for name in ("read", "moved"):
            begin = time.perf_counter()
            for _ in range(STEPS):
                moves = {}
                if name == "moved":
                    columns = (reading.handle, reading.x, reading.y, reading.angle, reading.v)
                    moves = {int(h): Move(x, y, w, v) for h, x, y, w, v in zip(*columns, strict=True)}
                take = tuple(h for h in moves if h not in reading.owned)
                reading = process.step(Orders(take=take, move=moves))
            found[name] = (time.perf_counter() - begin) / STEPS
    each = 1e6 / count
    return {
        "net": net, "vehicles": count, "step_ms": 1e3 * found["read"],
        "read_us": each * found["read"], "move_us": each * (found["moved"] - found["read"]),
    }  # fmt: skip


def markdown(found: dict[str, Any]) -> str:
    """Both tables."""
    lines = [
        "| network | planner | traffic | seeds | success | contacts | nuPlan score | mean speed, m/s | "
        "decision, ms | collisions that SUMO reports |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in found["rows"]:
        share = f"{row['success']:.0%} [{row['success_low']:.0%}, {row['success_high']:.0%}]"
        cells = [row["net"], row["policy"], row["traffic"], row["seeds"], share, f"{row['contacts']:.2f}"]
        cells += [f"{row['nuplan_score']:.2f}", f"{row['mean_speed']:.1f}"]
        known = "decision_ms" in row
        cells += [f"{row['decision_ms']:.1f}", f"{row['sumo_collisions']:.2f}"] if known else ["", ""]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += ["", "| network | vehicles | step and reading, ms | reading, µs each | moving, µs each |"]
    lines += ["|---|---:|---:|---:|---:|"]
    for row in found["cost"]:
        lines.append(
            f"| {row['net']} | {row['vehicles']} | {row['step_ms']:.2f} | {row['read_us']:.1f} | "
            f"{row['move_us']:.1f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--nets", default="ingolstadt1")
    parser.add_argument("--policies", default="pdm_closed,limsim_tm")
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--only-cost", action="store_true")
    given = parser.parse_args()
    seeds, nets = (50, list(ALL)) if given.full else (given.seeds, given.nets.split(","))
    path = RESULTS / "sumo_bridge.json"
    found = json.loads(path.read_text()) if path.exists() else {"rows": []}
    with tempfile.TemporaryDirectory() as folder:
        if not given.only_cost:
            found["rows"] = rows(nets, given.policies.split(","), seeds, Path(folder))
        found["cost"] = [cost(net, Path(folder)) for net in ("ingolstadt1", "limsim_town05")]
    write_whole(path, json.dumps(found, indent=1) + "\n")
    write_whole(path.with_suffix(".md"), markdown(found))
    print(markdown(found))


if __name__ == "__main__":
    main()
