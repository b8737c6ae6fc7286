"""The five scenarios of the LimSim Series with every policy: how far, how well, how often without fault.

    python experiments/policies.py [--seeds 1000] [--policies limsim_tm pdm_closed ...] [--scenarios ramp ...]

Writes experiments/results/policies.json and .md; policies and scenarios that are not named keep their rows.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from limsim_jax.metrics.intervals import bootstrap, wilson
from limsim_jax.rollout import enable_compilation_cache, use_all_cores, world_key
from limsim_jax.sweep.episode import Episodes
from limsim_jax.sweep.experiment import read_experiments

RESULTS = Path(__file__).parent / "results"
POLICIES = ("like_traffic", "pdm_closed", "pdm_hybrid", "limsim_tm")
PAPER = {"highway": 76.3, "ramp": 64.6, "intersection": 86.3, "roundabout": 72.1, "long_route": 78.8}
MEANS = {"completion": "completion", "score": "limsim_faithful_drive", "nuplan": "nuplan_score"}


def measure(policy: str, scenario: str, seeds: int) -> dict[str, Any]:
    """One cell of the table."""
    (experiment,) = read_experiments(scenario, policy=policy)
    episodes = Episodes(experiment, chunk=min(seeds, 32))
    begin = time.perf_counter()
    episodes.compile()
    compiled = time.perf_counter() - begin
    begin = time.perf_counter()
    parts = [
        episodes.run(range(k, min(k + episodes.chunk, seeds))).metrics
        for k in range(0, seeds, episodes.chunk)
    ]
    run = time.perf_counter() - begin
    found = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    row: dict[str, Any] = {"policy": policy, "scenario": scenario, "seeds": seeds}
    row |= {"compile_s": compiled, "run_s": run, "decision_ms": latency(episodes)}
    for name in ("success", "at_fault_contacts", "contacts"):
        events = int(np.sum(found[name] > 0))
        row[name] = [events / seeds, *wilson(events, seeds)[-2:]]
    for name, column in MEANS.items():
        values = found[column][np.isfinite(found[column])]
        interval = bootstrap(values)
        row[name] = [float(values.mean()), interval.low, interval.high]
    row["background_collisions"] = int(found["traffic_collided"].sum())
    return row


def latency(episodes: Episodes) -> float:
    """Median time of one decision of one world, ms: a call of the policy alone, compiled, from the host."""
    run, lane_map = episodes.rollout, episodes.lane_map
    scenario = jax.jit(episodes.sample)(world_key(0))
    carry = jax.jit(lambda state: run.begin(lane_map, state))(scenario.start)
    decide = jax.jit(lambda state, memory, key: run.policy(run.config, lane_map, state, memory, key))
    times = []
    for k in range(30):
        begin = time.perf_counter()
        jax.block_until_ready(decide(carry.state, carry.memory, jax.random.key(k)))
        times.append(time.perf_counter() - begin)
    return 1000 * float(np.median(times[3:]))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| scenario | policy | seeds | success, % | route completion, % | LimSim driving score (paper) "
        "| nuPlan score | episodes with a contact at fault, % | decision, ms |",
        "|---|---|---:|---|---|---|---|---|---:|",
    ]

    def percent(x: list[float]) -> str:
        return f"{100 * x[0]:.1f} [{100 * x[1]:.1f}, {100 * x[2]:.1f}]"

    for r in rows:
        score = f"{r['score'][0]:.1f} [{r['score'][1]:.1f}, {r['score'][2]:.1f}]"
        paper = f" ({PAPER[r['scenario']]})" if r["policy"] == "limsim_tm" and r["scenario"] in PAPER else ""
        nuplan = f"{r['nuplan'][0]:.3f}"
        lines.append(
            f"| {r['scenario']} | {r['policy']} | {r['seeds']} | {percent(r['success'])} "
            f"| {percent(r['completion'])} | {score}{paper} | {nuplan} | {percent(r['at_fault_contacts'])} "
            f"| {r['decision_ms']:.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--policies", nargs="+", default=list(POLICIES))
    parser.add_argument("--scenarios", nargs="+", default=list(PAPER))
    options = parser.parse_args()
    use_all_cores()
    enable_compilation_cache()
    file = RESULTS / "policies.json"
    kept = (
        {(r["scenario"], r["policy"]): r for r in json.loads(file.read_text())["rows"]}
        if file.exists()
        else {}
    )
    for scenario in options.scenarios:
        for policy in options.policies:
            kept[scenario, policy] = measure(policy, scenario, options.seeds)
            print(json.dumps(kept[scenario, policy]), flush=True)
            order = [(s, p) for s in PAPER for p in POLICIES if (s, p) in kept]
            rows = [kept[key] for key in order]
            file.write_text(
                json.dumps({"rows": rows, "device": jax.devices()[0].device_kind}, indent=1) + "\n"
            )
            note = "Brackets: 95 % intervals over seeds. Demand: experiments/*.toml. Paper: 10 seeds."
            text = f"Regenerate: `python experiments/policies.py`\n\n{table(rows)}\n\n{note}\n"
            (RESULTS / "policies.md").write_text(text)


if __name__ == "__main__":
    main()
