"""Replay of recorded scenes with egos that brake: takeovers, hand-backs, contacts, and the time it takes.

    python experiments/log_replay.py [--data ../shared/data/trajectories] [--variants 1000]

Writes experiments/results/log_replay.json and .md. Every vehicle of a scene is the ego in turn, in three
ways each: it slows down for a moment, brakes for a moment, or brakes to a standstill and stays.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from limsim_jax.log_replay.recorded import Lanelet, Recorded, lanelet_network, read_platoon, read_scene
from limsim_jax.log_replay.scene import Scene, build_scene
from limsim_jax.log_replay.takeover import Record, as_logged, braking, replay, replay_many
from limsim_jax.maps import build_lane_map

HERE = Path(__file__).parent
RESULTS = HERE / "results"
DATA = HERE.parents[1] / "shared" / "data" / "trajectories"
BENCHMARK = "USA_US101-24_2_T-1"
WAYS = {"3 m/s2 for 1 s": (3.0, 1.0), "6 m/s2 for 1 s": (6.0, 1.0), "6 m/s2, stays": (6.0, 1e6)}
PLATOONS = {"no_ACC_handling_part22": 60.0, "no_ACC_handling_part26": 100.0, "short_dynamic_part20": 40.0}
LONG = 40.0  # s, of recordings that can tell what share of vehicles is back within 20 s
STRETCH = 60.0  # s of them: long enough to come back
AFTER = 1.0  # s after its first entry, or after the start of the benchmark's range, the ego brakes


def platoon(cars: int = 12, seconds: float = 60.0, dt: float = 0.1) -> Recorded:
    """A made platoon of different cars on one lane, whose speed waves gently: long enough to come back."""
    t = np.arange(round(seconds / dt)) * dt
    v = 15 + 2 * np.sin(2 * np.pi * t / 25)
    way = np.append(0, np.cumsum((v[1:] + v[:-1]) / 2)) * dt
    length = 4.0 + 0.1 * np.arange(cars)
    start = 400 - np.append(0, np.cumsum(length[1:] + 15 * (0.9 + 0.05 * np.arange(cars - 1))))
    x = start + way[:, None]
    lane = np.linspace(0, 1600, 161)
    lanelet = Lanelet("1", np.stack([lane, 0 * lane + 1.75], -1), np.stack([lane, 0 * lane - 1.75], -1))
    return Recorded(
        name="made platoon", source="made platoon", dt=dt, vehicles=tuple(str(k) for k in range(cars)),
        x=x, y=0 * x, heading=0 * x, v=np.repeat(v[:, None], cars, 1), length=length,
        width=np.full(cars, 1.8), network=lanelet_network([lanelet], "made platoon", "made platoon"),
    )  # fmt: skip


def egos_of(scene: Scene, way: tuple[float, float]) -> Any:
    """Every vehicle that is there for long enough."""
    there = np.asarray(scene.last - scene.first) * scene.log.dt
    slots = np.flatnonzero(there > AFTER + 1)
    start = np.asarray(scene.first)[slots] * scene.log.dt + AFTER
    brake = jax.vmap(lambda s, t: braking(scene, s, t, *way))
    return brake(jnp.asarray(slots, jnp.int32), jnp.asarray(start, jnp.float32))


def measure(recorded: Recorded) -> list[dict[str, Any]]:
    """Rows of the table for a scene."""
    scene = build_scene(recorded, build_lane_map(recorded.network))
    valid = np.asarray(scene.log.valid)
    counts, moments = jax.jit(lambda s: replay(s, as_logged(s, 0), record=True))(scene)
    same = all(
        (np.asarray(getattr(moments, name))[valid] == np.asarray(getattr(scene.log, name))[valid]).all()
        for name in ("x", "y", "heading", "v")
    ) and bool((np.asarray(moments.active) == valid).all())
    run = jax.jit(replay_many)
    long = len(valid) * recorded.dt >= LONG
    rows = []
    for name, way in WAYS.items():
        egos = egos_of(scene, way)
        found: Record = jax.tree.map(np.asarray, run(scene, egos))
        contacts = found.struck.sum((1, 2)) // 2
        takeovers, back = int(found.takeovers.sum()), int(found.handed_back.sum())
        in_time, late = int(found.in_time.sum()), int(found.late.sum())
        seen_through = long and way[1] < LONG and in_time + late
        rows.append(
            {
                "scene": recorded.name, "vehicles": valid.shape[1], "seconds": len(valid) * recorded.dt,
                "as_logged": {"takeovers": int(counts.takeovers.sum()), "bit_for_bit": same},
                "logged_overlaps": int(scene.touched.sum()) // 2,
                "way": name, "egos": len(contacts), "takeovers": takeovers,
                "because_the_log_ends": int(found.ended.sum()), "handed_back": back, "in_time": in_time,
                "late": late, "left_or_cut_off": takeovers - in_time - late,
                "share_in_time": in_time / (in_time + late) if seen_through else None,
                "controlled_s": float(found.controlled.sum()) / max(takeovers, 1),
                "largest_displacement_m": float(found.displacement.max()),
                "longest_chain": int((found.takeovers > 0).sum(1).max()),
                "egos_with_contact": int((contacts > 0).sum()), "contacts": int(contacts.sum()),
                "hardest_braking": float(found.hardest.max()), "largest_jump_m": float(found.jump.max()),
            }
        )  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    return rows


def benchmark(recorded: Recorded, variants: int) -> dict[str, Any]:
    """Time of many variants of a scene in one program."""
    scene = build_scene(recorded, build_lane_map(recorded.network))
    rng = np.random.default_rng(0)
    number = scene.log.x.shape[1]
    draw = [rng.uniform(*bounds, variants) for bounds in ((1.0, 6.0), (2.0, 8.0), (0.5, 4.0))]
    egos = jax.vmap(lambda *of: braking(scene, *of))(
        jnp.asarray(rng.integers(0, number, variants), jnp.int32),
        *(jnp.asarray(x, jnp.float32) for x in draw),
    )
    begin = time.perf_counter()
    program = jax.jit(replay_many).lower(scene, egos).compile()
    compiled = time.perf_counter() - begin
    times, cpu = [], []
    found: Record = jax.block_until_ready(program(scene, egos))
    for _ in range(2):
        begin, busy = time.perf_counter(), time.process_time()
        jax.block_until_ready(program(scene, egos))
        times.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - busy)
    updates = variants * int(scene.log.valid.sum())
    contacts = np.asarray(found.struck.sum((1, 2))) // 2
    return {
        "scene": recorded.name, "variants": variants, "vehicles": number, "steps": scene.log.x.shape[0],
        "compile_s": compiled, "run_s": min(times), "cpu_s": min(cpu),
        "vehicle_updates_per_s": updates / min(times), "variants_per_s": variants / min(times),
        "takeovers": int(found.takeovers.sum()), "variants_with_contact": int((contacts > 0).sum()),
        "cores": os.cpu_count(), "device": jax.devices()[0].device_kind,
    }  # fmt: skip


def table(rows: list[dict[str, Any]], bench: dict[str, Any]) -> str:
    """Markdown."""
    columns = {
        "scene": "scene", "vehicles": "vehicles", "s": "seconds", "ego": "way", "egos": "egos",
        "takeovers": "takeovers", "as the log ends": "because_the_log_ends",
        "longest chain": "longest_chain", "handed back within 20 s": "in_time",
        "later or never": "late", "left or cut off before": "left_or_cut_off",
        "share within 20 s": "share_in_time", "largest displacement, m": "largest_displacement_m",
        "egos with contact": "egos_with_contact", "largest jump, m": "largest_jump_m",
    }  # fmt: skip
    form = {"seconds": "{:.0f}", "share_in_time": "{:.0%}", "largest_displacement_m": "{:.1f}"}
    form["largest_jump_m"] = "{:.3f}"
    lines = [" | ".join(columns), " | ".join("---" if k in ("scene", "ego") else "---:" for k in columns)]
    for r in rows:
        cells = ["" if r[k] is None else form.get(k, "{}").format(r[k]) for k in columns.values()]
        lines.append(" | ".join(cells))
    lines = [f"| {line} |" for line in lines]
    same = all(r["as_logged"]["bit_for_bit"] and r["as_logged"]["takeovers"] == 0 for r in rows)
    said = "no takeovers, and the log to the bit, in every scene" if same else "NOT the log in every scene"
    logged = sum(r["logged_overlaps"] for r in rows) // len(WAYS)
    b = bench
    lines += [
        "",
        f"With the ego on its log: {said}. Pairs that overlap in the logs themselves: {logged}; they are not",
        "counted as contacts. The share is that of the takeovers that were seen through, in recordings of at",
        f"least {LONG:g} s and of egos that clear the way: on the 100 to 200 m of road of the others most",
        "vehicles leave before, and behind an ego that stays nobody can go back.",
        "",
        f"{b['variants']} variants of {b['scene']} ({b['vehicles']} vehicles, {b['steps']} steps) in one",
        f"program: compiled in {b['compile_s']:.1f} s, run in {b['run_s']:.1f} s "
        f"({b['cpu_s']:.1f} s of CPU),",
        f"{b['vehicle_updates_per_s']:.3g} vehicle-updates/s, {b['takeovers']} takeovers,",
        f"{b['variants_with_contact']} variants with a contact. {b['device']}, {b['cores']} cores, float32.",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--variants", type=int, default=1000)
    options = parser.parse_args()
    files = sorted((options.data / "commonroad").glob("*.xml.gz"))
    if not files:
        raise SystemExit(
            f"{options.data}: no commonroad/*.xml.gz; the folder of recorded trajectories would be right"
        )
    scenes = [platoon(), *(read_scene(path) for path in files)]
    for name, start in PLATOONS.items():
        scenes.append(read_platoon(options.data / f"openacc_zalazone_{name}.csv.gz", start, STRETCH))
    rows = [row for recorded in scenes for row in measure(recorded)]
    bench = benchmark(next(r for r in scenes if r.name == BENCHMARK), options.variants)
    print(json.dumps(bench), flush=True)
    RESULTS.mkdir(exist_ok=True)
    head = "Regenerate: `python experiments/log_replay.py`\n\n"
    (RESULTS / "log_replay.json").write_text(
        json.dumps({"scenes": rows, "benchmark": bench}, indent=1) + "\n"
    )
    (RESULTS / "log_replay.md").write_text(head + table(rows, bench) + "\n")


if __name__ == "__main__":
    main()
