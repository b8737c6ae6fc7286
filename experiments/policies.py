"""Results of every policy in the five scenarios of the LimSim Series.

    python experiments/policies.py [--seeds 1000] [--policies limsim_tm pdm_closed ...] [--scenarios ramp ...]

Without --seeds the long route has 300 seeds and every other scenario 1,000. Worlds go to results/policies. An
interrupted run continues there, and `limsim-jax report results/policies` shows the worst worlds. Writes
experiments/results/policies.json and .md; policies and scenarios that are not named keep their rows.
`--paper 10` adds the results of the first ten seeds alone, as many as in the paper. Decisions are timed by
`limsim-jax bench policy`; `--skip decisions` leaves that for a quiet machine. Those of `own_policies.py`, one
in JAX and one on the host, are timed as well (`--policies own`).
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.compute as pc
from readme_tables import PAPER, policies

from limsim_jax.bench import bench_policy
from limsim_jax.files import write_whole
from limsim_jax.policies import POLICIES as KNOWN
from limsim_jax.policies.base import build_policy, knows
from limsim_jax.statistics import bootstrap, wilson
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import read_experiments
from limsim_jax.sweeps.runner import Progress, sweep
from limsim_jax.sweeps.store import open_results
from limsim_jax.xla import enable_compilation_cache, use_all_cores

HERE = Path(__file__).parent
RESULTS = HERE / "results"
POLICIES = (
    "like_traffic", "pdm_closed", "pdm_closed_rules", "pdm_hybrid", "limsim_tm", "limsim_tm_privileged",
    "area_of_interest", "end_to_end",
)  # fmt: skip
SEEDS = dict.fromkeys(PAPER, 1000) | {"long_route": 300}
OWN = ("own_policies:Cautious", "own_policies:follower")
EVENTS = ("success", "at_fault_contacts", "contacts", "near_misses")
MEANS = {"completion": "completion", "score": "limsim_faithful_drive", "nuplan": "nuplan_score"}


def worlds(policy: str, scenario: str, seeds: int, few: int, out: Path, chunk: int | None) -> dict[str, Any]:
    """One cell of the table."""
    (experiment,) = read_experiments(scenario, policy=policy)
    episodes = Episodes(experiment, chunk=None if chunk is None else min(chunk, seeds))

    def show(now: Progress) -> None:
        print(f"{scenario} / {policy}: {now.done} of {now.wanted} worlds, {now.elapsed:.0f} s", flush=True)

    sweep([episodes], range(seeds), out, progress=show)
    rows = open_results(out).episodes
    mine = (pc.field("scenario") == scenario) & (pc.field("policy") == policy) & (pc.field("seed") < seeds)
    found = {
        name: np.asarray(column)
        for name, column in rows.filter(mine).sort_by("seed").to_pydict().items()
        if name in {*EVENTS, *MEANS.values(), "traffic_collided", "traffic_gridlock"}
    }
    row: dict[str, Any] = {"policy": policy, "scenario": scenario, "seeds": seeds}
    row["worlds_device"] = jax.local_devices()[0].device_kind
    row["knows"] = knows(build_policy(KNOWN[policy], {}))
    row |= summary(found)
    if few:
        row["few"] = {"seeds": few} | summary({name: values[:few] for name, values in found.items()})
    return row


def decisions(scenario: str, policy: str) -> dict[str, Any]:
    """Latency and amortised time of a decision, ms; compile time, s."""
    told = bench_policy(scenario, policy, cold=True)
    return {
        "decision_ms": 1e3 * told["latency_s"],
        "amortised_ms": 1e3 * told["amortised_s"],
        "compile_s": told["amortised_compile_s"],
        "device": told["device"],
    }


def own() -> list[dict[str, Any]]:
    """Times of decisions of own policies, in JAX and on the host."""
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(HERE), os.environ.get("PYTHONPATH")]))
    return [{"policy": policy, "scenario": "roundabout"} | decisions("roundabout", policy) for policy in OWN]


def summary(found: dict[str, np.ndarray]) -> dict[str, Any]:
    """Shares and means with 95 % intervals, and collisions of others."""
    row: dict[str, Any] = {}
    for name in EVENTS:
        events, seeds = int(np.sum(found[name] > 0)), len(found[name])
        row[name] = [events / seeds, *wilson(events, seeds)[-2:]]
    for name, column in MEANS.items():
        values = found[column][np.isfinite(found[column])]
        interval = bootstrap(values)
        row[name] = [float(values.mean()), interval.low, interval.high]
    touched = found["contacts"] + (found["contacts"] > 0)  # by the ego, and the ego
    return row | {
        "others_collided": int(np.sum(np.maximum(found["traffic_collided"] - touched, 0))),
        "gridlocks": int(np.sum(found["traffic_gridlock"])),
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--paper", type=int, default=10)
    named = (*POLICIES, "own")
    parser.add_argument("--policies", nargs="+", default=list(named), choices=named)
    parser.add_argument("--scenarios", nargs="+", default=list(PAPER), choices=list(PAPER))
    parser.add_argument("--skip", choices=("worlds", "decisions"))
    parser.add_argument("--out", type=Path, default=Path("results/policies"))
    parser.add_argument("--chunk", type=int, help="worlds per call")
    options = parser.parse_args()
    if options.seeds is not None and options.seeds < 1:
        parser.error(f"--seeds {options.seeds}: expected at least 1")
    use_all_cores()
    enable_compilation_cache()
    file = RESULTS / "policies.json"
    found = json.loads(file.read_text()) if file.exists() else {"rows": []}
    kept = {(r["scenario"], r["policy"]): r for r in found["rows"]}

    def write() -> None:
        found["rows"] = [kept[s, p] for s in PAPER for p in POLICIES if (s, p) in kept]
        write_whole(file, json.dumps(found, indent=1) + "\n")
        head = "Regenerate: `python experiments/policies.py`\n\n"
        write_whole(RESULTS / "policies.md", f"{head}{policies(found, few=True)}\n")

    for policy in options.policies:
        if policy == "own":
            if options.skip != "decisions":
                found["own"] = own()
                write()
            continue
        for scenario in options.scenarios:
            seeds = options.seeds or SEEDS[scenario]
            few = min(options.paper, seeds)
            if options.skip == "worlds" and (scenario, policy) not in kept:
                parser.error(f"--skip worlds: none of {scenario} with {policy} have been run yet")
            row = kept.setdefault((scenario, policy), {})
            if options.skip != "worlds":
                row |= worlds(policy, scenario, seeds, few, options.out, options.chunk)
            if options.skip != "decisions":
                row |= decisions(scenario, policy)
            print(json.dumps(row), flush=True)
            write()


if __name__ == "__main__":
    main()
