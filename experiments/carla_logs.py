"""Our traffic on CARLA's towns, as recorder logs, beside CARLA's own lanes.

    python experiments/carla_logs.py [--data FOLDER] [--seconds 10] [--vehicles 40]

Traffic runs on each town and is written as a recorder log. A parser that shares nothing with ours reads it
(`log_parser`), and `carla.Map` says where the middle of the lane is at every vehicle. The table has the
distance across and the angle; vehicles in a lane change are counted apart. One row is the log of a server, as
read by the same parser: its own car. Writes experiments/results/carla_logs.json and .md. Needs `carla`.
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import os
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from log_parser import parse

import limsim_jax as lj
from limsim_jax.api.world import World
from limsim_jax.bridges.carla.log import FIRST_ID, carla_log
from limsim_jax.bridges.carla.stage import stage_of
from limsim_jax.files import write_whole
from limsim_jax.recordings.carla_bodies import BODIES

RESULTS = Path(__file__).parent / "results"
TOWNS = ("carla_town01", "carla_town03", "carla_town04", "carla_town05", "carla_town06")
EVERY = 5  # frames between two that are compared
CHANGING = 0.3  # m from the middle of our lane: on the way to another one


def lane_check(frames: list[dict[str, Any]], town: Any) -> dict[str, np.ndarray]:
    """How far vehicles are from the middle of CARLA's lane.

    Across (m), in angle (degrees) and in height (m)."""
    import carla

    added = {a[0]: a[4] for frame in frames for a in frame.get("add", ()) if a[1] == 1}
    rows = []
    for k, frame in enumerate(frames[::EVERY]):
        for ident, x, y, z, _, _, yaw in frame["positions"]:
            if ident not in added:
                continue
            h, ahead = math.radians(yaw), BODIES[added[ident]].ahead
            at = x / 100 + ahead * math.cos(h), y / 100 + ahead * math.sin(h)
            spot = carla.Location(x=at[0], y=at[1], z=z / 100)
            way = town.get_waypoint(spot, lane_type=carla.LaneType.Any)
            middle, turn = way.transform.location, math.radians(way.transform.rotation.yaw)
            # across the lane: along it, CARLA finds the nearest point to some cm only
            across = (at[1] - middle.y) * math.cos(turn) - (at[0] - middle.x) * math.sin(turn)
            angle = (yaw - way.transform.rotation.yaw + 180) % 360 - 180
            rows.append((k, ident, across, angle, middle.z - z / 100, bool(way.is_junction)))
    table = np.array(rows, float).reshape(-1, 6)
    names = ("frame", "id", "across", "angle", "height", "junction")
    return {name: table[:, k] for k, name in enumerate(names)}


def run(source: Path, seconds: float, vehicles: int) -> dict[str, Any]:
    """The figures of a town: traffic, its log, and CARLA's lanes."""
    import carla

    experiment = lj.Experiment(map=source, ego=None, vehicles=vehicles, horizon=seconds, slots=64)
    world = World.run(experiment.episodes(chunk=1), 0, explain=False)
    began = time.perf_counter()
    data = carla_log(world).to_bytes()
    wrote = time.perf_counter() - began
    frames = parse(data)["frames"]
    found = lane_check(frames, carla.Map(source.stem, source.read_text(encoding="utf-8")))
    slots = np.array([one.slot for one in stage_of(world).cast])
    step, who = (EVERY * found["frame"]).astype(int), found["id"].astype(int) - FIRST_ID
    off = np.abs(world.trace.d[step, slots[who]])  # from the middle of our own lane
    keeps = off < CHANGING
    return {
        "town": source.stem,
        "frames": len(frames),
        "kilobytes": len(data) / 1024,
        "write_seconds": wrote,
        "vehicles": int(max(len(frame["positions"]) for frame in frames)),
        "compared": len(found["across"]),
        "changing": int((~keeps).sum()),
        **{name: _quantiles(found[name][keeps]) for name in ("across", "angle", "height")},
    }


def _quantiles(values: np.ndarray) -> dict[str, float]:
    q = np.quantile(np.abs(values), [0.5, 0.95, 1.0])
    return dict(zip(("median", "q95", "max"), map(float, q), strict=True))


def server_row(folder: Path) -> dict[str, Any]:
    """The same check of a log that a server has recorded."""
    import carla

    path = folder / "carla_logs" / "town01_lane_center.log.gz"
    town = carla.Map("Town01", (folder / "opendrive" / "carla_town01.xodr").read_text(encoding="utf-8"))
    frames = parse(gzip.decompress(path.read_bytes()))["frames"]
    found = lane_check(frames, town)
    return {
        "town": "log of a server, Town01", "frames": len(frames), "vehicles": 1,
        "compared": len(found["across"]), "changing": 0,
        **{name: _quantiles(found[name]) for name in ("across", "angle", "height")},
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """The rows in Markdown."""
    head = (
        "| town | places compared | in a lane change | across, mm: median, 95 % | angle: median, 95 % | "
        "height, mm: median, 95 % |\n|---|---:|---:|---:|---:|---:|"
    )
    lines = [head]
    for row in rows:
        mm = lambda x: f"{1e3 * x['median']:.1f}, {1e3 * x['q95']:.0f}"  # noqa: E731
        angle = f"{row['angle']['median']:.3f}°, {row['angle']['q95']:.2f}°"
        lines.append(
            f"| {row['town']} | {row['compared']:,} | {row['changing']:,} | {mm(row['across'])} | {angle} | "
            f"{mm(row['height'])} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Parse the command line, run, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    shared = os.environ.get("LIMSIM_SHARED_DATA", "../shared/data")
    parser.add_argument("--data", type=Path, default=Path(shared), help="folder with opendrive/, carla_logs/")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--vehicles", type=int, default=40)
    options = parser.parse_args()
    if not find_spec("carla"):
        parser.error('carla is missing: pip install "limsim-jax[carla]"')
    rows = [server_row(options.data)]
    for name in TOWNS:
        rows.append(run(options.data / "opendrive" / f"{name}.xodr", options.seconds, options.vehicles))
        print(json.dumps(rows[-1]), flush=True)
    head = "Regenerate: `python experiments/carla_logs.py`.\n\n"
    write_whole(RESULTS / "carla_logs.json", json.dumps({"rows": rows}, indent=1) + "\n")
    write_whole(RESULTS / "carla_logs.md", head + table(rows) + "\n")


if __name__ == "__main__":
    main()
