"""Speed of the traffic on this machine, next to SUMO.

On the same maps with the same flows.

    python experiments/traffic_speed.py [--worlds 256] [--seconds 60]

Writes experiments/results/traffic_speed.json and .md. `limsim-jax bench traffic MAP` measures one map.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from limsim_jax.bench import bench_traffic
from limsim_jax.maps import bundled_map

RESULTS = Path(__file__).parent / "results"
CASES = (("highway", 64), ("intersection", 64), ("roundabout", 64), ("highway", 256), ("highway", 1024))


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| map | worlds x slots | vehicles on the road per world | vehicle-updates/s | slot-updates/s "
        "| SUMO, vehicle-updates/s | ratio | trace and compile, s | from the cache, s | memory, MB |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in rows:
        peer = r["peer"] or {}
        sumo = f"{peer['vehicle_updates_per_s']:.3g}" if "vehicle_updates_per_s" in peer else "not run"
        ratio = f"{r['ratio']:.1f}" if r.get("ratio") else ""
        compiled, loaded = (None, r["compile_s"]) if r["from_cache"] else (r["compile_s"], r["load_s"])
        compiled, loaded = ("" if x is None else f"{x:.1f}" for x in (compiled, loaded))
        lines.append(
            f"| {r['map']} | {r['worlds']} x {r['vehicles']} | {r['mean_vehicles']:.1f} "
            f"| {r['vehicle_updates_per_s']:.3g} | {r['slot_updates_per_s']:.3g} | {sumo} | {ratio} "
            f"| {compiled} | {loaded} | {r['peak_memory'] / 1e6:.0f} |"
        )
    first = rows[0]
    lines += ["", f"{first['device']}, {first['cores']} cores, steps of {first['dt']:g} s, float32."]
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    rows = []
    for k, (name, slots) in enumerate(CASES):
        row = bench_traffic(
            bundled_map(name),
            worlds=options.worlds * 64 // slots,
            vehicles=slots,
            seconds=options.seconds,
            cold=k == 0,
        )
        rows.append(row | {"map": name})
        print(json.dumps(rows[-1]), flush=True)
    RESULTS.mkdir(exist_ok=True)
    head = "Regenerate: `python experiments/traffic_speed.py`\n\n"
    (RESULTS / "traffic_speed.json").write_text(json.dumps({"cases": rows}, indent=1) + "\n")
    (RESULTS / "traffic_speed.md").write_text(head + table(rows) + "\n")


if __name__ == "__main__":
    main()
