"""How long sweeps take, and how much memory: the paper's five scenarios, and one scenario with many seeds.

    python experiments/sweep_speed.py [--seeds 1000] [--more 10000] [--only seeds|more|paper]

Every sweep is a process of its own with an empty compilation cache. Writes
experiments/results/sweep_speed.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from readme_tables import sweep_speed

RESULTS = Path(__file__).parent / "results"

NAMES = ("seeds", "more", "paper")
"""The rows."""

MANY = """
map = "highway"
horizon = 60.0
slots = 64
[ego]
start = "1-"
lane = 1
s = 60.0
goal = "2-"
[traffic]
vehicles = 30
[[traffic.flow]]
origin = "1-"
rate = 1500
"""


def sweep(experiment: str, seeds: int, folder: Path) -> dict[str, Any]:
    """One sweep: seconds from the command to the table, MB."""
    out, cache = folder / f"{Path(experiment).stem}-{seeds}", folder / f"cache-{seeds}"
    command = [
        sys.executable,
        "-m",
        "limsim_jax.cli",
        "sweep",
        experiment,
        f"--seeds={seeds}",
        f"--out={out}",
    ]
    begin = time.perf_counter()
    with subprocess.Popen(
        [*command, "--no-report"], stdout=subprocess.PIPE, text=True,
        env=os.environ | {"LIMSIM_JAX_CACHE": str(cache)},
    ) as process:  # fmt: skip
        text = process.communicate()[0]
    if process.returncode:
        raise SystemExit(text)
    wall = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(text, flush=True)
    return {
        "experiment": Path(experiment).stem,
        "seeds": seeds,
        "wall_s": round(wall, 1),
        "peak_memory_mb": round(peak),
    }


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--more", type=int, default=10000)
    parser.add_argument("--only", choices=NAMES, help="this row; the others stay as they are")
    options = parser.parse_args()
    file = RESULTS / "sweep_speed.json"
    rows = json.loads(file.read_text())["sweeps"] if options.only else [{}] * len(NAMES)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        many = folder / "highway, 60 s.toml"
        many.write_text(f'name = "highway_60"{MANY}')
        # the peak is that of all children so far: the small one first
        sweeps = ((many, options.seeds), (many, options.more), ("paper", 100))
        for i, (experiment, seeds) in enumerate(sweeps):
            if options.only in (None, NAMES[i]):
                rows[i] = sweep(str(experiment), seeds, folder)
    head = "Regenerate: `python experiments/sweep_speed.py`\n\n"
    file.write_text(json.dumps({"sweeps": rows}, indent=1) + "\n")
    (RESULTS / "sweep_speed.md").write_text(head + sweep_speed({"sweeps": rows}) + "\n")


if __name__ == "__main__":
    main()
