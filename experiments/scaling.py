"""What worlds, slots and workers cost as there are more of them.

    python experiments/scaling.py [--seconds 60] [--seeds 1000]

Traffic alone for worlds and slots; sweeps with all metrics for workers, which are processes of one core
each under Ray, on this machine. Writes experiments/results/scaling.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from readme_tables import scaling
from sweep_speed import MANY

from limsim_jax.bench import bench_traffic
from limsim_jax.maps import bundled_map

RESULTS = Path(__file__).parent / "results"

WORLDS = tuple(("intersection", worlds, 64) for worlds in (2, 4, 16, 64, 256, 1024))
SLOTS = (("highway", 256, 64), ("highway", 64, 256), ("highway", 16, 1024), ("highway", 4, 4096))
"""Map, worlds and slots. Worlds are divided evenly among cores, so a single one would run on each of them."""

FEW = 200
"""Seeds of the sweep that tells what workers take to start."""


def cost(name: str, worlds: int, slots: int, seconds: float) -> dict[str, Any]:
    """Traffic of one size: us of one core per slot and step, and memory."""
    row = bench_traffic(bundled_map(name), worlds=worlds, vehicles=slots, seconds=seconds, peer=False)
    return {
        "map": name,
        "worlds": row["worlds"],
        "slots": slots,
        "slot_updates_per_s": row["slot_updates_per_s"],
        "us_per_slot": 1e6 * row["cores"] / row["slot_updates_per_s"],
        "peak_memory_mb": round(row["peak_memory"] / 1e6),
    }


def sweep(experiment: Path, seeds: int, workers: int, folder: Path) -> float:
    """Seconds of a sweep."""
    out = folder / f"{workers}-{seeds}"
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "limsim_jax.cli", "sweep", str(experiment), f"--seeds={seeds}",
         f"--workers={workers}", f"--out={out}", "--no-report"],
        env=os.environ | {"LIMSIM_JAX_CACHE": str(folder / "cache")}, check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    return time.perf_counter() - begin


def cluster(seeds: int) -> list[dict[str, Any]]:
    """Seconds that more seeds take on one and on two workers."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        experiment = folder / "highway_60.toml"
        experiment.write_text(f'name = "highway_60"{MANY}')
        sweep(experiment, FEW // 2, 1, folder)  # fills the cache
        for workers in (1, 2):
            few, more = (sweep(experiment, n, workers, folder) for n in (FEW, seeds))
            rows.append({"workers": workers, "seeds": seeds - FEW, "s": more - few, "start_s": few})
    return rows


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=1000)
    options = parser.parse_args()
    found = {
        "worlds": [cost(*case, options.seconds) for case in WORLDS],
        "slots": [cost(*case, options.seconds) for case in SLOTS],
        "workers": cluster(options.seeds),
    }
    (RESULTS / "scaling.json").write_text(json.dumps(found, indent=1) + "\n")
    (RESULTS / "scaling.md").write_text(
        "Regenerate: `python experiments/scaling.py`\n\n" + scaling(found) + "\n"
    )


if __name__ == "__main__":
    main()
