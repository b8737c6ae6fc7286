"""Oddities of the traffic, counted: jumps, slides, jerks, hard braking, idle stops, changes of mind.

    python experiments/oddities.py [--worlds 12] [--map NAME_OR_FILE ...]

Three minutes of background traffic per world, every physics step. Prints where and when the first few of
each kind are; look at them with `limsim-jax run MAP --seed N --video FILE` and the flows of
`soundness.py`. Writes experiments/results/oddities.json and .md; maps that are not named keep their rows.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray
from soundness import HORIZON, INITIAL, OTHER_RATE, RATES, RESULTS, SLOTS, check_maps

from limsim_jax.files import write_whole
from limsim_jax.maps import build_lane_map, bundled_maps, read_network
from limsim_jax.maps.lane_map import LaneMap, lane_rows
from limsim_jax.simulation.rollout import Rollout, one_world
from limsim_jax.sweeps.build import plain_demand
from limsim_jax.traffic.demand import sample_scenario
from limsim_jax.traffic.engine import Tick, Traffic
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config
from limsim_jax.xla import enable_compilation_cache

DT = 0.1
KINDS = {
    "jumps": "a body moves 0.25 m more or less than its speed tells",
    "slides": "a body moves 0.25 rad off its heading",
    "hard": "begins to brake with more than 5 m/s^2",
    "turns": "turns by 0.5 degrees in a step below 0.2 m/s",
    "jerks": "the acceleration changes by more than 15 m/s^3, not by coming to a stand",
    "changes": "begins to change lanes",
    "reversed": "begins to change back within 15 s",
    "stands": "stands for 10 s without a line, a vehicle within 10 m ahead, or another right of way",
}
SHOWN = 3


class Seen(NamedTuple):
    """What is recorded of a step."""

    box: Float[Array, "N 5"]
    active: Bool[Array, " N"]
    vehicle: Int[Array, " N"]
    lane: Int[Array, " N"]
    s: Float[Array, " N"]
    v: Float[Array, " N"]
    a: Float[Array, " N"]
    side: Int[Array, " N"]
    yielding: Bool[Array, " N"]


def odd(lane_map: LaneMap, seen: Seen) -> dict[str, Bool[np.ndarray, "T N"]]:
    """Steps and slots at which each kind begins, `[T, N]`."""
    box, v = seen.box, seen.v
    same = seen.active[1:] & seen.active[:-1] & (seen.vehicle[1:] == seen.vehicle[:-1])
    dx, dy = (np.diff(box[..., k], axis=0) for k in range(2))
    moved = np.hypot(dx, dy)
    off = np.abs(_wrapped(np.arctan2(dy, dx) - box[1:, :, 2]))
    standing = np.zeros(v.shape, bool)
    still = np.zeros(v.shape[1], int)
    to_line = np.asarray(lane_map.stop_s)[seen.lane] - seen.s
    for t in range(len(v)):
        still = np.where(seen.active[t] & (v[t] < 0.3), still + 1, 0)
        for n in np.nonzero(still == round(10 / DT))[0]:
            c, s = np.cos(box[t, n, 2]), np.sin(box[t, n, 2])
            x, y = box[t, :, 0] - box[t, n, 0], box[t, :, 1] - box[t, n, 1]
            ahead, across = c * x + s * y, c * y - s * x
            near = (ahead > 0.5) & (ahead < (box[t, n, 3] + box[t, :, 3]) / 2 + 10) & (np.abs(across) < 2)
            at_line = -2 < to_line[t, n] < 3
            standing[t, n] = not (near & seen.active[t]).any() and not at_line and not seen.yielding[t, n]
    happens = {
        "jumps": same & (np.abs(moved - DT * (v[1:] + v[:-1]) / 2) > 0.25),
        "slides": same & (moved > 0.15) & (off > 0.25),
        "hard": same & (seen.a[1:] < -5),
        "turns": same & (v[1:] < 0.2) & (np.abs(_wrapped(np.diff(box[..., 2], axis=0))) > math.radians(0.5)),
        "jerks": same & (np.abs(np.diff(seen.a, axis=0)) > 15 * DT) & (v[1:] > 0),
        "changes": same & (seen.side[1:] != 0) & (seen.side[:-1] == 0),
    }
    first = {k: np.concatenate([x[:1], x[1:] & ~x[:-1]]) for k, x in happens.items()}
    found = {k: np.concatenate([np.zeros((1, v.shape[1]), bool), x]) for k, x in first.items()}
    return found | {"stands": standing, "reversed": _reversed(seen, found["changes"])}


def _wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.angle(np.exp(1j * angle))


def _reversed(seen: Seen, begins: Bool[np.ndarray, "T N"]) -> Bool[np.ndarray, "T N"]:
    """Lane changes to the other side within 15 s of one."""
    found = np.zeros_like(begins)
    for n in range(begins.shape[1]):
        times = np.flatnonzero(begins[:, n])
        for one, two in itertools.pairwise(times):
            same = seen.vehicle[one, n] == seen.vehicle[two, n] and seen.active[one:two, n].all()
            back = seen.side[one, n] == -seen.side[two, n]
            found[two, n] = same and back and two - one <= round(15 / DT)
    return found


def watch(name: str, worlds: int) -> dict[str, Any]:
    """Watch some worlds on a map."""
    network = read_network(bundled_maps().get(name) or name)
    lane_map = build_lane_map(network)
    lanes = list(lane_rows(network))
    demand, _ = plain_demand(
        network, lane_map, rate=RATES.get(name, OTHER_RATE), vehicles=INITIAL, seconds=HORIZON
    )
    slots = SLOTS.get(name, 64)

    def recorder(lane_map: LaneMap) -> Any:
        def record(tick: Tick) -> Seen:
            x = tick.state
            return Seen(boxes(lane_map, x), x.active, x.vehicle, x.lane, x.s, x.v, x.a, x.side, x.yielding)

        return record

    run = Rollout(Config(dt=DT), Traffic(), HORIZON, record=recorder)
    go = jax.jit(
        lambda seed: one_world(run, lane_map, lambda key: sample_scenario(demand, lane_map, key, slots), seed)
    )
    counts: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
    km = 0.0
    for seed in range(worlds):
        result = jax.device_get(go(seed))
        seen, km = result.trace, km + float(result.totals.distance) / 1000
        for kind, where in odd(lane_map, seen).items():
            for t, n in np.argwhere(where):
                counts[kind] += 1
                if kind != "changes" and counts[kind] <= SHOWN:
                    place = f"{lanes[seen.lane[t, n]]} at {seen.s[t, n]:.1f} m, {seen.v[t, n]:.1f} m/s"
                    print(f"{name} seed {seed} {(t + 1) * DT:.1f} s slot {n}: {kind} on {place}", flush=True)
    return {"map": Path(name).stem, "worlds": worlds, "vehicle_km": round(km, 1)} | counts


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    counted = [kind for kind in KINDS if kind not in ("jerks", "changes", "reversed")]
    names = ["map", "worlds", "vehicle-km", *counted, "jerks per km", "lane changes per km", "reversed"]
    lines = ["| " + " | ".join(names) + " |", "|---|" + "---:|" * (len(names) - 1)]
    for r in rows:
        km, share = r["vehicle_km"], r["reversed"] / max(r["changes"], 1)
        cells = [r["map"], r["worlds"], f"{km:,.0f}", *(r[kind] for kind in counted)]
        cells += [f"{r['jerks'] / km:.2f}", f"{r['changes'] / km:.2f}", f"{share:.1%}".replace("%", " %")]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join([*lines, "", *(f"- {kind}: {what}" for kind, what in KINDS.items())])


def main() -> None:
    """Watch and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--map", nargs="*", default=list(bundled_maps()))
    options = parser.parse_args()
    if options.worlds < 1:
        parser.error(f"--worlds {options.worlds}: at least 1")
    check_maps(parser, options.map)
    enable_compilation_cache()
    file = RESULTS / "oddities.json"
    rows = {row["map"]: row for row in json.loads(file.read_text())["maps"]} if file.exists() else {}
    for name in options.map:
        row = watch(name, options.worlds)
        rows[row["map"]] = row
        print(json.dumps(row), flush=True)
    write_whole(file, json.dumps({"maps": list(rows.values())}, indent=1) + "\n")
    head = "Regenerate: `python experiments/oddities.py`\n\n"
    write_whole(RESULTS / "oddities.md", f"{head}{table(list(rows.values()))}\n")


if __name__ == "__main__":
    main()
