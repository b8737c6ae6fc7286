"""How long sweeps take, and how much memory: small ones with their report, one with many seeds, the paper's.

    python experiments/sweep_speed.py [--rows wait seeds more paper] [--seeds 1000] [--more 10000]

Without `--rows` the small ones, in some minutes; rows that do not run stay as they are. Every sweep is a
process of its own, with an empty cache or with that of the one before. Writes
experiments/results/sweep_speed.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from readme_tables import sweep_speed

RESULTS = Path(__file__).parent / "results"

NAMES = ("seeds", "more", "paper")
"""The rows of sweeps without a report; `wait` are those with one."""

WAITS = (("intersection", "like_traffic"), ("intersection", "limsim_tm"))
"""Experiments and policies, each from nothing and warm."""

WAIT_SEEDS = 20

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


def run(arguments: Sequence[str], cache: Path) -> dict[str, Any]:
    """One sweep: seconds from the command to its end, MB, programs that were compiled or loaded."""
    before, start = set(cache.rglob("*.bin")), time.time()
    begin = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-m", "limsim_jax.cli", "sweep", *arguments],
        env=os.environ | {"LIMSIM_JAX_CACHE": str(cache)},
    ) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.perf_counter() - begin
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)}: exit code {process.returncode}")
    programs = set(cache.rglob("*.bin"))
    loaded = [path for path in programs & before if path.stat().st_mtime > start]  # a load touches the file
    return {
        "wall_s": round(wall, 1),
        "cpu_s": round(used.ru_utime + used.ru_stime, 1),
        "peak_memory_mb": round(used.ru_maxrss / 1024),
        "compiled": len(programs - before),
        "loaded": len(loaded),
    }


def sweep(experiment: str, seeds: int, folder: Path) -> dict[str, Any]:
    """A sweep to its table, with an empty cache."""
    out = folder / f"{Path(experiment).stem}-{seeds}"
    found = run([experiment, f"--seeds={seeds}", f"--out={out}", "--no-report"], folder / f"cache-{seeds}")
    return {"experiment": Path(experiment).stem, "seeds": seeds, **found}


def waits(folder: Path) -> Iterator[dict[str, Any]]:
    """Small sweeps with their report, from nothing and once more."""
    for experiment, policy in WAITS:
        cache = folder / f"cache-{experiment}-{policy}"
        for kind in ("from nothing", "warm"):
            out = folder / f"{experiment}-{policy}-{kind.replace(' ', '-')}"
            found = run([experiment, f"--policy={policy}", f"--seeds={WAIT_SEEDS}", f"--out={out}"], cache)
            yield {"experiment": experiment, "policy": policy, "seeds": WAIT_SEEDS, "cache": kind, **found}


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1000)
    parser.add_argument("--more", type=int, default=10000)
    parser.add_argument("--rows", nargs="+", choices=("wait", *NAMES), default=["wait"])
    options = parser.parse_args()
    file = RESULTS / "sweep_speed.json"
    found = json.loads(file.read_text()) if file.is_file() else {}
    rows = found.setdefault("sweeps", [{}] * len(NAMES))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        many = folder / "highway, 60 s.toml"
        many.write_text(f'name = "highway_60"{MANY}')
        sweeps = ((many, options.seeds), (many, options.more), ("paper", 100))
        for i, (experiment, seeds) in enumerate(sweeps):
            if NAMES[i] in options.rows:
                rows[i] = sweep(str(experiment), seeds, folder)
        if "wait" in options.rows:
            found["waits"] = list(waits(folder))
    head = "Regenerate: `python experiments/sweep_speed.py --rows wait seeds more paper`\n\n"
    file.write_text(json.dumps(found, indent=1) + "\n")
    (RESULTS / "sweep_speed.md").write_text(head + sweep_speed(found) + "\n")


if __name__ == "__main__":
    main()
