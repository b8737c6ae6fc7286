"""Cost and fidelity of the Area of Interest by its size.

    python experiments/area_of_interest.py [--seeds 32] [--scenario roundabout]

LimSim-TM drives the ego of the scenario, and more or fewer of the vehicles around it. Cost is the CPU time of
the run alone, without compilation. Fidelity is the Wasserstein-1 distance between the outcomes over seeds and
those with all vehicles planned. The noise level is the distance between two sets of seeds with all vehicles
planned. Writes experiments/results/area_of_interest.json and .md.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np
from readme_tables import OUTCOMES, PAPER, area_of_interest
from scipy.stats import wasserstein_distance

from limsim_jax.bench import _processor
from limsim_jax.files import write_whole
from limsim_jax.statistics import bootstrap
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentFile, read_experiments
from limsim_jax.xla import enable_compilation_cache, use_all_cores

RESULTS = Path(__file__).parent / "results"
SLOTS = 40
"""Slots of the world; the largest area plans for all of them."""

EVERYWHERE = 1e6
"""m"""

AREAS = ((2, 15.0), (4, 25.0), (8, 50.0), (16, 50.0), (SLOTS, EVERYWHERE))
"""Vehicles planned for beside the ego, and the radius, m."""


def with_area(experiment: ExperimentFile, slots: int, radius: float) -> ExperimentFile:
    """The experiment with LimSim-TM for `slots` vehicles beside the ego."""
    options = {"around": "limsim_tm", "slots": slots, "radius": radius}
    ego = experiment.ego[0].model_copy(update={"options": options})
    return experiment.model_copy(update={"ego": (ego,), "slots": SLOTS})


def outcomes(experiment: ExperimentFile, seeds: range, chunk: int) -> tuple[dict[str, np.ndarray], float]:
    """Metrics of each seed, and s of CPU time per world."""
    episodes = Episodes(experiment, chunk=chunk)
    episodes.compile()
    chunks = [seeds[k : k + episodes.chunk] for k in range(0, len(seeds), episodes.chunk)]
    begin = time.process_time()
    found = [episodes.run(chunk).metrics for chunk in chunks]
    spent = time.process_time() - begin
    return {name: np.concatenate([some[name] for some in found]) for name in found[0]}, spent / len(seeds)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=32)
    parser.add_argument("--scenario", default="roundabout", choices=list(PAPER))
    options = parser.parse_args()
    use_all_cores()
    enable_compilation_cache()
    (experiment,) = read_experiments(options.scenario, policy="area_of_interest")
    seeds, rows, whole = range(options.seeds), [], {}
    for slots, radius in reversed(AREAS):
        every = slots == SLOTS  # a second set of seeds gives the noise level
        ran = range(2 * options.seeds) if every else seeds
        found, cost = outcomes(with_area(experiment, slots, radius), ran, options.seeds)
        mine = {name: values[: options.seeds] for name, values in found.items()}
        other = mine
        if every:
            whole, other = mine, {name: values[options.seeds :] for name, values in found.items()}
        rows.append({
            "slots": slots,
            "radius": radius if radius < EVERYWHERE else None,
            "seconds_per_world": cost,
            "seconds_per_world_second": cost / experiment.horizon,
            "success": float(mine["success"].mean()),
            "episodes_with_traffic_collided": int(np.sum(mine["traffic_collided"] > 0)),
            "episodes_with_gridlock": int(np.sum(mine["traffic_gridlock"] > 0)),
            "full": int(np.sum(mine["traffic_full"])),
            "means": {name: list(bootstrap(mine[name])[:3]) for name in OUTCOMES},
            "distance": {name: wasserstein_distance(other[name], whole[name]) for name in OUTCOMES},
        })  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    result = {
        "scenario": experiment.name,
        "seeds": options.seeds,
        "horizon_s": experiment.horizon,
        "slots": SLOTS,
        "device": _processor() if jax.default_backend() == "cpu" else jax.devices()[0].device_kind,
        "devices": jax.local_device_count(),
        "rows": rows[::-1],
    }
    head = "Regenerate: `python experiments/area_of_interest.py`\n\n"
    write_whole(RESULTS / "area_of_interest.json", json.dumps(result, indent=1) + "\n")
    write_whole(RESULTS / "area_of_interest.md", f"{head}{area_of_interest(result)}\n")


if __name__ == "__main__":
    main()
