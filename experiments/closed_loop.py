"""Populations under which simulated traffic is distributed as recorded traffic; measured on held-out data.

    python experiments/closed_loop.py [--part NAME ...] [--folder ../shared/data/trajectories]

Writes experiments/results/closed_loop.json and .md. Recordings: followers behind one another, by gradients.
Saturation flow and lane-change rate: whole worlds, without gradients.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from calibration import files

from limsim_jax.calibration.closed_loop import (
    UNITS,
    calibrate_closed_loop,
    linked_recordings,
)
from limsim_jax.calibration.matching import Engine, TrafficFlow, match
from limsim_jax.calibration.parameters import PARAMETERS
from limsim_jax.calibration.report import gather
from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, bundled_maps, read_network
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.routing import default_goals
from limsim_jax.recordings import read_recording
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.traffic.demand import Flow, build_demand
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.vehicles import default_population
from limsim_jax.types import Config
from limsim_jax.xla import enable_compilation_cache

RESULTS = Path(__file__).parent / "results"
SOURCES: dict[str, dict[str, Any]] = {
    "ngsim": {
        "title": "NGSIM I-80, human, congested",
        "speed_limit": 29.0,  # 65 mph
    },
    "tgsim": {"title": "TGSIM, human"},
    "openacc-acc": {"title": "OpenACC platoons, ACC", "period": 100.0},
    "openacc-human": {
        "title": "OpenACC platoons, human",
        "period": 100.0,
    },
    "us101": {
        "title": "US-101 scenes, human",
        "shortest": 6.0,
        "period": 20.0,
        "settle": 2.0,
        "speed_limit": 24.6,  # 55 mph
    },
}
SATURATION = 1900.0
"""veh/h and lane, base saturation flow of the Highway Capacity Manual."""


def recordings(folder: Path, name: str) -> dict[str, Any]:
    """One data set: fits of single drivers, their population, and the closed loop from there."""
    options = SOURCES[name]
    linked = linked_recordings(
        files(folder, name), period=options.get("period", 60.0), settle=options.get("settle", 5.0)
    )
    found, _ = gather(files(folder, name), shortest=options.get("shortest", 20.0))
    result = calibrate_closed_loop(linked, found, speed_limit=options.get("speed_limit", 30.0))
    print(result.text(), flush=True)
    return result.as_json() | {
        "title": options["title"],
        "period": options.get("period", 60.0),
        "drivers": len(linked.drivers),
    }


# --- the engine --------------------------------------------------------------------------------------


def saturation_engine() -> Engine:
    """Cars straight on over the bundled crossing.

    There are more than the lights let through: queues never end.
    """
    network = read_network(bundled_maps()["intersection"])
    goals = default_goals(network)
    lane_map = build_lane_map(network, goals)
    rows = lane_rows(network)
    straight = [rows[name] for name in ("1_3_-3", "1_3_-2", "3_3_-3", "3_3_-2")]
    flows = [Flow(origin=origin, goal=goal, rate=2800.0) for origin, goal in (("1", "4"), ("3", "2"))]
    horizon = 240.0
    demand = build_demand(
        network, lane_map, goals, flows, default_population({"car": 1.0}), horizon=horizon, vehicles=4
    )
    places = tuple((row, float(lane_map.stop_s[row])) for row in straight)
    measure = TrafficFlow(detectors=places, begin=60.0)
    run = Rollout(Config(dt=0.1), Traffic(), horizon, measure=measure)
    return Engine(run, lane_map, demand, 64, ("T", "a"))


def lane_change_engine(density: float) -> Engine:
    """Cars on the bundled motorway, as dense as recorded; how fast they are follows from that."""
    network = read_network(bundled_maps()["highway"])
    goals = default_goals(network)
    lane_map = build_lane_map(network, goals)
    demand = build_demand(
        network, lane_map, goals, [], default_population({"car": 1.0}), horizon=60.0, density=density
    )
    run = Rollout(Config(dt=0.1), Traffic(), 60.0, measure=TrafficFlow(begin=10.0))
    return Engine(run, lane_map, demand, demand.initial, ("politeness", "threshold"))


def recorded_lane_changes(folder: Path) -> dict[str, float]:
    """Lane changes per km in the two halves of every US-101 scene; density, veh/km and lane."""
    changes, driven, spacing = np.zeros(2), np.zeros(2), []
    for path in files(folder, "us101"):
        r = read_recording(path)
        on = r.lane >= 0
        middle = (r.time.min() + r.time.max()) / 2
        changed = (np.diff(r.vehicle) == 0) & on[1:] & on[:-1] & (np.diff(r.lane) != 0)
        for k, half in enumerate((r.time < middle, r.time >= middle)):
            changes[k] += np.sum(changed & half[1:])
            driven[k] += np.sum(r.v[on & half]) * r.dt / 1000
        spacing.append((r.x_lead - r.x)[r.leader >= 0])
    return {
        "fitted": float(changes[0] / driven[0]),
        "held_out": float(changes[1] / driven[1]),
        "changes": float(changes.sum()),
        "vehicle_km": float(driven.sum()),
        "density": float(1000 / np.mean(np.concatenate(spacing))),
    }


def matched(engine: Engine, statistic: str, target: float, **options: Any) -> dict[str, Any]:
    """Factors on medians that give a statistic its target; held-out seeds."""
    begin = time.perf_counter()
    seeds, others = options.pop("seeds"), options.pop("others")
    found = match(
        engine.means(seeds),
        {statistic: target},
        dict.fromkeys(engine.names, 1.0),
        options.pop("bounds"),
        tame=0.05,
        **options,
    )
    seconds = time.perf_counter() - begin
    # as many candidates as before: the same program
    both = np.ones((options["members"], len(engine.names)))
    both[0] = list(found.parameters.values())
    unseen = engine.means(others)(both)
    row = {name: float(unseen[name][0]) for name in ("mean_speed", "lane_changes_per_km", "density_per_km")}
    return {
        "statistic": statistic,
        "target": target,
        "fitted": {"default": found.before[statistic], "matched": found.after[statistic]},
        "held_out": {"default": float(unseen[statistic][1]), "matched": float(unseen[statistic][0])},
        "factors": found.parameters,
        "evaluations": found.evaluations * len(seeds),
        "history": found.history.tolist(),
        "of_matched": row,
        "seconds": seconds,
    }


def saturation(folder: Path) -> dict[str, Any]:
    """Factors on T and a for the saturation flow."""
    del folder
    return matched(
        saturation_engine(), "saturation_flow_per_hour", SATURATION, seeds=range(3), others=range(1000, 1003),
        bounds={"T": (0.4, 2.0), "a": (0.5, 2.0)}, members=6, generations=6,
    )  # fmt: skip


def lane_changes(folder: Path) -> dict[str, Any]:
    """Factors on politeness and threshold for the lane changes of US-101."""
    recorded = recorded_lane_changes(folder)
    found = matched(
        lane_change_engine(recorded["density"]), "lane_changes_per_km", recorded["fitted"], seeds=range(2),
        others=range(1000, 1002), bounds={"politeness": (0.1, 4.0), "threshold": (0.1, 10.0)},
        members=6, generations=6,
    )  # fmt: skip
    return found | {"recorded": recorded}


WORLDS = {"saturation": saturation, "lane-changes": lane_changes}


# --- the tables --------------------------------------------------------------------------------------


def table(found: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = []
    names = list(UNITS)
    sets = [found[name] for name in SOURCES if name in found]
    if sets:
        lines += [
            "Followers simulated behind one another; only those without a leader in the recording follow",
            "their logs. Distances from the recording: Wasserstein-1 of time headways, speeds and gaps,",
            "difference of mean speeds, and of flows at equal densities (Edie). Drivers are drawn from the",
            "simulator's default population, from that of fits to single drivers, and from that one adjusted",
            "in closed loop. *Held out*: every period is simulated with populations that were fitted without",
            "it, in three turns; distances of all periods together. *Halves*: between two halves of the",
            "recorded drivers. *Own record*: of a record that the closed-loop populations have made, from",
            "other draws of their drivers; an exactly right population is as far. ACC-IDM, the model of the",
            "simulator's traffic.",
            "",
            "| data | periods | drivers from | "
            + " | ".join(f"{name}, {UNITS[name]}" for name in names)
            + " |",
            "|---|---|---|" + "---:|" * len(names),
        ]
    for one in sets:
        names_of = {"default": "default", "start": "single fits", "closed_loop": "**closed loop**"}
        rows = [("held out", names_of[who], one["held_out"][who]) for who in names_of]
        rows += [("held out", "*own record*", one["from_own"]), ("all", "*halves*", one["floor"])]
        rows += [("fitted, all", names_of[who], one["fitted"][who]) for who in ("start", "closed_loop")]
        for where, who, row in rows:
            values = " | ".join(f"{row[name]:.3g}" for name in names)
            lines.append(f"| {one['title']} | {where} | {who} | {values} |")
    if sets:
        lines += [
            "",
            "What is left of the default population's distances on held-out periods; behind it what would be",
            "left if the population were exactly right (own record).",
            "",
        ]
        lines += [
            "| data | periods | samples | " + " | ".join(names) + " | all fits, s |",
            "|---|---:|---:|" + "---:|" * (len(names) + 1),
        ]
        for one in sets:
            values = " | ".join(
                f"{one['left_of_default'][name]:.0%} ({one['reachable'][name]:.0%})" for name in names
            )
            count = sum(map(len, one["folds"]))
            lines.append(f"| {one['title']} | {count} | {one['samples']} | {values} | {one['seconds']:.0f} |")
        lines += ["", "Populations: median, and factor of one standard deviation.", ""]
        lines += ["| data | drivers from | " + " | ".join(PARAMETERS) + " |", "|---|---|" + "---:|" * 5]
        for one in sets:
            for who, law in one["population"].items():
                values = " | ".join(
                    f"{law['median'][p]:.2f} x/ {np.exp(law['spread'][p]):.2f}" for p in PARAMETERS
                )
                lines.append(f"| {one['title']} | {who.replace('_', ' ')} | {values} |")
    worlds = {name: found[name] for name in WORLDS if name in found}
    if worlds:
        lines += ["", "Whole worlds, CMA-ES on factors of medians, the same seeds for all candidates.", ""]
        lines += [
            "| statistic | target | default | matched | other seeds, default | other seeds, matched "
            "| factors | worlds | s |",
            "|---|---:|---:|---:|---:|---:|---|---:|---:|",
        ]
        for name, row in worlds.items():
            digits = 0 if name == "saturation" else 2
            values = [row["target"], *row["fitted"].values(), *row["held_out"].values()]
            factors = ", ".join(f"{p} {x:.2f}" for p, x in row["factors"].items())
            lines.append(
                f"| {row['statistic']} | "
                + " | ".join(f"{x:.{digits}f}" for x in values)
                + f" | {factors} | {row['evaluations']} | {row['seconds']:.0f} |"
            )
        if "lane-changes" in worlds:
            row = worlds["lane-changes"]
            log = row["recorded"]
            lines += [
                "",
                f"Lane changes: target is the rate in the first halves of the eight US-101 scenes; in the "
                f"second halves it is {log['held_out']:.2f} per km ({log['changes']:.0f} changes in "
                f"{log['vehicle_km']:.0f} km in all). Worlds: motorway of four lanes, at the start "
                f"{log['density']:.0f} vehicles per km and lane as in the scenes; mean speed "
                f"{row['of_matched']['mean_speed']:.1f} m/s.",
            ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", nargs="*", choices=[*SOURCES, *WORLDS])
    parser.add_argument("--folder", type=Path, default=Path("../shared/data/trajectories"))
    options = parser.parse_args()
    enable_compilation_cache()
    path = RESULTS / "closed_loop.json"
    found = json.loads(path.read_text()) if options.part and path.exists() else {}
    for name in options.part or [*SOURCES, *WORLDS]:
        found[name] = WORLDS[name](options.folder) if name in WORLDS else recordings(options.folder, name)
        RESULTS.mkdir(exist_ok=True)
        head = "Regenerate: `python experiments/closed_loop.py`\n\n"
        write_whole(path, json.dumps(found, indent=1) + "\n")
        write_whole(RESULTS / "closed_loop.md", head + table(found) + "\n")


if __name__ == "__main__":
    main()
