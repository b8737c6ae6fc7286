"""How fast environments for learning are.

    python experiments/env_speed.py [--experiment ramp] [--seconds 20]

`limsim_jax.bridges.gymnasium.VectorEnv` takes random meta-actions, for batches of 1, 16 and 128 worlds, with
resets. Counted are decisions of environments per second, and vehicle-updates per second: vehicles on the road
times physics steps. Starting and compiling do not count. One device, which is about one core on CPUs.
Writes experiments/results/env_speed.json and .md.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from limsim_jax.bridges.gymnasium import VectorEnv
from limsim_jax.files import write_whole

RESULTS = Path(__file__).parent / "results"
COUNTS = (1, 16, 128)
WARM = 5
"""Decisions before the clock starts."""


def measure(experiment: str, count: int, seconds: float) -> dict[str, Any]:
    """Figures of one batch."""
    begun = time.perf_counter()
    envs = VectorEnv(experiment, count)
    core = envs._worlds.env  # pyright: ignore[reportPrivateUsage]
    envs.reset(seed=0)
    envs.action_space.seed(0)
    for _ in range(WARM):
        envs.step(envs.action_space.sample())
    ready = time.perf_counter() - begun
    steps, vehicles, spent = 0, 0.0, 0.0
    while spent < seconds:
        start = time.perf_counter()
        envs.step(envs.action_space.sample())
        spent += time.perf_counter() - start
        steps += 1
        vehicles += float(np.asarray(envs._worlds.states.world.active).sum())  # pyright: ignore
    return {
        "worlds": count,
        "env_steps_per_s": round(steps * count / spent, 1),
        "vehicle_updates_per_s": round(vehicles * core.config.decision_every / spent),
        "vehicles_per_world": round(vehicles / steps / count, 1),
        "ready_s": round(ready, 1),
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--experiment", default="ramp")
    parser.add_argument("--seconds", type=float, default=20.0, help="of stepping per batch")
    told = parser.parse_args()
    rows = [measure(told.experiment, count, told.seconds) for count in COUNTS]
    device = jax.local_devices()[0].device_kind
    report = {"experiment": told.experiment, "device": device, "rows": rows}
    lines = [
        "Regenerate: `python experiments/env_speed.py`",
        "",
        "| worlds | decisions/s of all | vehicle-updates/s | vehicles per world | start and compile, s |",
        "|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        lines.append(
            f"| {row['worlds']} | {row['env_steps_per_s']:,.0f} | {row['vehicle_updates_per_s']:.2e} "
            f"| {row['vehicles_per_world']} | {row['ready_s']} |"
        )
    lines += [
        "",
        f"Experiment `{told.experiment}`, Gymnasium's VectorEnv with resets, one core, "
        "decisions of 5 physics steps of 0.1 s, vector observations.",
    ]
    text = "\n".join(lines) + "\n"
    write_whole(RESULTS / "env_speed.json", json.dumps(report, indent=1) + "\n")
    write_whole(RESULTS / "env_speed.md", text)
    print(text)


if __name__ == "__main__":
    main()
