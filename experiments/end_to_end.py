"""The end-to-end driver: the five scenarios, maps that it was not trained on, and what it is made of.

    python experiments/end_to_end.py [--full] [--ablations] [--weights FILE] [--seeds N]

Rows: the driver, without its safety filter, with faults of its sensors, an untrained network, and the filter
alone, which drives along the route at the speed limit. `--ablations` first trains networks without LiDAR,
without cameras, with waypoints instead of path and speed, and without DAgger, each for `--minutes` (or takes
them from `--out`, where they are kept). `--full` has 200 seeds instead of 20. Seeds start at 0;
training begins at 2,000,000. Held-out maps are towns of CARLA in $LIMSIM_SHARED_DATA; without them their rows
are left out. Worlds go to `--out`; an interrupted run continues there. Writes
experiments/results/end_to_end.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.compute as pc
from readme_tables import PAPER, end_to_end

from limsim_jax.files import write_whole
from limsim_jax.policies.end_to_end import EndToEnd
from limsim_jax.policies.end_to_end.network import Design, Trained, fresh_weights
from limsim_jax.policies.end_to_end.policy import WEIGHTS
from limsim_jax.sensors.faults import Faults
from limsim_jax.statistics import bootstrap, wilson
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentFile, read_experiments
from limsim_jax.sweeps.runner import Progress, sweep
from limsim_jax.sweeps.store import open_results
from limsim_jax.training.end_to_end import train
from limsim_jax.xla import enable_compilation_cache, use_all_cores

HERE = Path(__file__).parent
RESULTS = HERE / "results"
SHARED = Path(os.environ.get("LIMSIM_SHARED_DATA", HERE.parents[1] / "shared" / "data"))
HELD_OUT = ("carla_town01", "carla_town03")
"""Maps that no network was trained on, under the bundled experiment `town`."""

FAULTS = Faults(drop_rate=0.01, freeze_rate=0.01, position_drift=0.05, yaw_drift=0.0035)
"""A fault of each camera every 50 s, 0.5 to 3 s long, and the drift of Bench2Drive-Robust."""

ABLATIONS: dict[str, tuple[Design, int]] = {
    "without LiDAR": (Design(lidar=False), 2),
    "without cameras": (Design(cameras=False), 2),
    "waypoints": (Design(waypoints=True), 2),
    "without DAgger": (Design(), 0),
}
"""Designs, and rounds of DAgger."""


def drivers(weights: Path) -> dict[str, EndToEnd]:
    """The driver and what shows where its driving comes from."""
    driver = EndToEnd(str(weights))
    untrained = Trained(Design(), jax.device_get(fresh_weights(seed=1)), {})
    return {
        "end-to-end": driver,
        "without the filter": replace(driver, filter=False),
        "with faults": replace(driver, faults=FAULTS),
        "untrained": EndToEnd(network=untrained),
        "the filter alone": replace(driver, steers=False),
    }


def ablations(out: Path, minutes: float) -> dict[str, EndToEnd]:
    """Networks that lack something, trained unless they are there."""
    found = {}
    for name, (design, rounds) in ABLATIONS.items():
        file = out / f"{name.replace(' ', '_')}.npz"
        if not file.exists():
            print(f"training '{name}'", flush=True)
            part = file.with_suffix(".part.npz")
            tell = partial(print, flush=True)
            if train(part, design=design, rounds=rounds, minutes=minutes, tell=tell).stopped:
                raise SystemExit(f"'{name}' is half trained; its weights are in {part}")
            part.rename(file)
        found[name] = EndToEnd(str(file))
    return found


def experiments() -> list[tuple[ExperimentFile, bool]]:
    """The scenarios, and whether their maps were held out."""
    found = [(read_experiments(name)[0], False) for name in PAPER]
    for name in HELD_OUT:
        file = SHARED / "opendrive" / f"{name}.xodr"
        if file.exists():
            town = read_experiments("town", map_file=str(file))[0]
            found.append((town.model_copy(update={"name": name}), True))
        else:
            print(f"{file} is not there: no rows of this map", flush=True)
    return found


def row(experiment: ExperimentFile, name: str, driver: EndToEnd, seeds: int, out: Path) -> dict[str, Any]:
    """One row: shares and means over seeds, with 95 % intervals."""
    label = name.replace(" ", "_").lower()
    episodes = Episodes(experiment, policy=driver, name=label)

    def show(now: Progress) -> None:
        print(f"{experiment.name} / {name}: {now.done} of {now.wanted}, {now.elapsed:.0f} s", flush=True)

    sweep([episodes], range(seeds), out, progress=show)
    rows = open_results(out).episodes
    mine = (pc.field("scenario") == experiment.name) & (pc.field("policy") == label)
    columns = rows.filter(mine & (pc.field("seed") < seeds)).to_pydict()
    found: dict[str, Any] = {"scenario": experiment.name, "driver": name, "seeds": seeds}
    for event in ("success", "at_fault_contacts", "off_road", "red_lights", "policy_failed"):
        count = int(np.sum(np.asarray(columns[event], float) > 0))
        found[event] = [count / seeds, *wilson(count, seeds)[-2:]]
    for mean, column in (("completion", "completion"), ("score", "limsim_faithful_drive")):
        values = np.asarray(columns[column], float)
        values = values[np.isfinite(values)]
        interval = bootstrap(values)
        found[mean] = [float(values.mean()), interval.low, interval.high]
    return found


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="200 seeds")
    parser.add_argument("--ablations", action="store_true")
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    parser.add_argument("--minutes", type=float, default=18.0, help="of training of each ablation")
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--drivers", nargs="+", help="some rows only")
    parser.add_argument("--scenarios", nargs="+", help="some scenarios only")
    parser.add_argument("--out", type=Path, default=Path("results/end_to_end"))
    options = parser.parse_args()
    seeds = options.seeds or (200 if options.full else 20)
    if seeds < 1:
        parser.error(f"--seeds {seeds}: expected at least 1")
    use_all_cores()
    enable_compilation_cache()
    options.out.mkdir(parents=True, exist_ok=True)
    policies = drivers(options.weights)
    about = policies["end-to-end"].trained.about
    if options.ablations:
        policies |= ablations(options.out, options.minutes)
    file = RESULTS / "end_to_end.json"
    found: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"rows": []}
    kept = {(r["scenario"], r["driver"]): r for r in found["rows"]}
    trained = found.get("ablations", {}) | {
        name: {x: policies[name].trained.about[x] for x in ("seconds", "device", "steps", "rounds")}
        for name in ABLATIONS
        if name in policies
    }
    for experiment, held_out in experiments():
        for name, driver in policies.items():
            if options.drivers and name not in options.drivers:
                continue
            if options.scenarios and experiment.name not in options.scenarios:
                continue
            one = row(experiment, name, driver, seeds, options.out) | {"held_out": held_out}
            one["device"] = jax.local_devices()[0].device_kind
            kept[experiment.name, name] = one
            print(json.dumps(one), flush=True)
            found = {"about": about, "ablations": trained, "rows": list(kept.values())}
            write_whole(file, json.dumps(found, indent=1) + "\n")
            head = "Regenerate: `python experiments/end_to_end.py`\n\n"
            write_whole(RESULTS / "end_to_end.md", f"{head}{end_to_end(found)}\n")


if __name__ == "__main__":
    main()
