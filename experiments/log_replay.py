"""Replay of recorded scenes with egos that brake: takeovers, hand-backs, contacts, and the time it takes.

    python experiments/log_replay.py [--part braking policies benchmark] [--variants 1000]
        [--data ../shared/data/trajectories]

Writes experiments/results/log_replay.json and .md. Every vehicle of a scene is the ego in turn, in three
ways each: it slows down for a moment, brakes for a moment, or brakes to a standstill and stays. In one scene
planners take the wheel of every vehicle in turn. Parts that are not named keep their figures.
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

from limsim_jax.files import write_whole
from limsim_jax.log_replay.arrays import SceneArrays, build_arrays
from limsim_jax.log_replay.pilot import PolicyPilot
from limsim_jax.log_replay.takeover import Record, as_logged, braking, replay, replay_many
from limsim_jax.maps import build_lane_map
from limsim_jax.policies.limsim_tm.policy import LimSimTM
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.recordings import Lanelet, Tracks, lanelet_network, read_platoon, read_tracks

HERE = Path(__file__).parent
RESULTS = HERE / "results"
DATA = HERE.parents[1] / "shared" / "data" / "trajectories"
BENCHMARK = "USA_US101-24_2_T-1"
WAYS = {"3 m/s2 for 1 s": (3.0, 1.0), "6 m/s2 for 1 s": (6.0, 1.0), "6 m/s2, stays": (6.0, 1e6)}
PLATOONS = {"no_ACC_handling_part22": 60.0, "no_ACC_handling_part26": 100.0, "short_dynamic_part20": 40.0}
LONG = 40.0  # s, of recordings that can tell what share of vehicles is back within 20 s
STRETCH = 60.0  # s of them: long enough to come back
POLICIES = {"PDM-Closed": PDMClosed, "LimSim-TM": LimSimTM}
DRIVEN = 6.0  # s of its log that a vehicle has left when a planner takes its wheel, at least
AFTER = 1.0  # s after its first entry, or after the start of the benchmark's range, the ego brakes


def platoon(cars: int = 12, seconds: float = 60.0, dt: float = 0.1) -> Tracks:
    """A made-up platoon on one lane, whose speed waves gently.

    It is recorded for long enough to come back to the log.
    """
    t = np.arange(round(seconds / dt)) * dt
    v = 15 + 2 * np.sin(2 * np.pi * t / 25)
    way = np.append(0, np.cumsum((v[1:] + v[:-1]) / 2)) * dt
    length = 4.0 + 0.1 * np.arange(cars)
    start = 400 - np.append(0, np.cumsum(length[1:] + 15 * (0.9 + 0.05 * np.arange(cars - 1))))
    x = start + way[:, None]
    lane = np.linspace(0, 1600, 161)
    lanelet = Lanelet("1", np.stack([lane, 0 * lane + 1.75], -1), np.stack([lane, 0 * lane - 1.75], -1))
    return Tracks(
        name="made platoon", source="made platoon", dt=dt, vehicles=tuple(str(k) for k in range(cars)),
        x=x, y=0 * x, heading=0 * x, v=np.repeat(v[:, None], cars, 1), length=length,
        width=np.full(cars, 1.8), network=lanelet_network([lanelet], "made platoon", "made platoon"),
    )  # fmt: skip


def egos_of(scene: SceneArrays, way: tuple[float, float], left: float = 1.0) -> Any:
    """Every vehicle that is there for long enough: `left` s after it has been told."""
    there = np.asarray(scene.last - scene.first) * scene.log.dt
    slots = np.flatnonzero(there > AFTER + left)
    start = np.asarray(scene.first)[slots] * scene.log.dt + AFTER
    brake = jax.vmap(lambda s, t: braking(scene, s, t, *way))
    return brake(jnp.asarray(slots, jnp.int32), jnp.asarray(start, jnp.float32))


def measure(recorded: Tracks) -> list[dict[str, Any]]:
    """Rows of the table for a scene."""
    scene = build_arrays(recorded, build_lane_map(recorded.network))
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
                "carried_on": int(found.ended.sum()), "handed_back": back, "in_time": in_time,
                "late": late, "left_or_cut_off": takeovers - in_time - late,
                "share_in_time": in_time / (in_time + late) if seen_through else None,
                "controlled_s": float(found.controlled.sum()) / max(takeovers + int(found.ended.sum()), 1),
                "largest_displacement_m": float(found.displacement.max()),
                "longest_chain": int((found.takeovers > 0).sum(1).max()),
                "egos_with_contact": int((contacts > 0).sum()), "contacts": int(contacts.sum()),
                "hardest_braking": float(found.hardest.max()), "largest_jump_m": float(found.jump.max()),
            }
        )  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    return rows


def driven(recorded: Tracks) -> list[dict[str, Any]]:
    """Planners at the wheel of each vehicle, until its log ends."""
    lane_map = build_lane_map(recorded.network)
    scene = build_arrays(recorded, lane_map)
    egos = egos_of(scene, (0.0, 1e6), DRIVEN)

    @jax.jit
    def run(scene: SceneArrays, egos: Any, pilot: PolicyPilot) -> Any:
        def one(ego: Any) -> Any:
            counts, moments = replay(scene, ego, pilot=pilot, record=True)
            assert moments is not None
            return counts, jax.tree.map(lambda x: x[:, ego.slot], moments)

        return jax.lax.map(one, egos, batch_size=8)

    rows = []
    slots = np.asarray(egos.slot)
    there = np.asarray(egos.told).T & np.asarray(scene.log.valid)[:, slots]  # [T, egos]
    for name, policy in POLICIES.items():
        begin = time.perf_counter()
        counts, me = jax.tree.map(
            np.asarray, run(scene, egos, PolicyPilot(lane_map=lane_map, policy=policy()))
        )
        seconds = time.perf_counter() - begin
        log = jax.tree.map(lambda x: np.asarray(x)[:, slots], (scene.log.x, scene.log.y, scene.log.v))
        apart = np.hypot(me.x.T - log[0], me.y.T - log[1])
        last = len(there) - 1 - there[::-1].argmax(0)
        rows.append(
            {
                "policy": name, "scene": recorded.name, "egos": len(slots),
                "takeovers": int(counts.takeovers.sum()),
                "egos_with_contact": int(counts.struck.any((1, 2)).sum()),
                "mean_speed": float(me.v.T[there].mean()), "mean_speed_of_log": float(log[2][there].mean()),
                "apart_at_end_m": float(np.median(apart[last, np.arange(len(slots))])),
                "seconds": seconds,
            }
        )  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    return rows


def benchmark(recorded: Tracks, variants: int) -> dict[str, Any]:
    """Time of many variants of a scene in one program."""
    scene = build_arrays(recorded, build_lane_map(recorded.network))
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


def table(rows: list[dict[str, Any]], policies: list[dict[str, Any]], bench: dict[str, Any]) -> str:
    """Markdown."""
    columns = {
        "scene": "scene", "vehicles": "vehicles", "s": "seconds", "ego": "way", "egos": "egos",
        "takeovers": "takeovers", "logs carried on": "carried_on",
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
        "vehicles leave before, and behind an ego that stays no vehicle can go back.",
        "",
        f"Planners at the wheel of {policies[0]['egos']} vehicles of {policies[0]['scene']} in turn, each",
        f"from {AFTER:g} s after its first moment to the end of its log:",
        "",
        "| policy | takeovers | egos with contact | mean speed, m/s | of the logs, m/s "
        "| median distance from the log at its end, m |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for r in policies:
        lines.append(
            f"| {r['policy']} | {r['takeovers']} | {r['egos_with_contact']} | {r['mean_speed']:.1f} "
            f"| {r['mean_speed_of_log']:.1f} | {r['apart_at_end_m']:.1f} |"
        )
    lines += [
        "",
        f"{b['variants']} variants of {b['scene']} ({b['vehicles']} vehicles, {b['steps']} steps) in one",
        f"program: compiled in {b['compile_s']:.1f} s, run in {b['run_s']:.1f} s "
        f"({b['cpu_s']:.1f} s of CPU),",
        f"{b['vehicle_updates_per_s']:.3g} vehicle-updates/s, {b['takeovers']} takeovers,",
        f"{b['variants_with_contact']} variants with a contact. {b['device']}, {b['cores']} cores, float32.",
    ]
    return "\n".join(lines)


PARTS = ("braking", "policies", "benchmark")


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--variants", type=int, default=1000)
    options = parser.parse_args()
    files = sorted((options.data / "commonroad").glob("*.xml.gz"))
    if not files:
        raise SystemExit(
            f"{options.data}: no commonroad/*.xml.gz; the folder of recorded trajectories is expected"
        )
    path = RESULTS / "log_replay.json"
    found = json.loads(path.read_text()) if path.exists() and set(options.part) != set(PARTS) else {}
    missing = [part for part in PARTS if part not in {*found, *options.part}]
    if missing:
        parser.error(f"--part: nothing is known of {', '.join(missing)}; name them too")
    scenes = [platoon(), *(read_tracks(path) for path in files)]
    for name, start in PLATOONS.items():
        scenes.append(read_platoon(options.data / f"openacc_zalazone_{name}.csv.gz", start, STRETCH))
    busy = next(scene for scene in scenes if scene.name == BENCHMARK)
    if "braking" in options.part:
        found["braking"] = [row for recorded in scenes for row in measure(recorded)]
    if "policies" in options.part:
        found["policies"] = driven(busy)
    if "benchmark" in options.part:
        found["benchmark"] = benchmark(busy, options.variants)
        print(json.dumps(found["benchmark"]), flush=True)
    head = "Regenerate: `python experiments/log_replay.py`\n\n"
    write_whole(path, json.dumps({part: found[part] for part in PARTS}, indent=1) + "\n")
    write_whole(RESULTS / "log_replay.md", head + table(*(found[part] for part in PARTS)) + "\n")


if __name__ == "__main__":
    main()
