"""Quality and speed of LimSim-TM's search beside other searches.

    taskset -c 0 python experiments/search_quality.py [--scenes 128] [--quick]

Times are CPU times, of one core if run like this. Writes experiments/results/search_quality.json and .md. All
searches use the same model of the road, and are judged by driving their plans.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mctx
import numpy as np

from limsim_jax.policies.limsim_tm import search as tm
from limsim_jax.policies.limsim_tm.search import (
    ACTIONS,
    Plan,
    Scene,
    Settings,
    no_plan,
    play,
    search,
)
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.types import Driver
from limsim_jax.xla import batch_last

RESULTS = Path(__file__).parent / "results"
LANE_WIDTH = 3.5
TEAM = float(np.arctan2(2, 1))  # rad: in a group of three, each wants the mean of all rewards
DRIVER = {
    "speed_factor": 1.0, "v_max": 60.0, "T": 1.2, "s0": 2.0, "a": 1.5, "b": 2.0, "delta": 4.0, "b_max": 8.0,
    "coolness": 0.99, "politeness": 0.2, "threshold": 0.15, "b_safe": 3.0, "keep_right": 0.0,
    "lane_change_time": 4.0, "a_lat": 2.5, "gap_factor": 1.0, "svo": 0.0,
}  # fmt: skip


def road(
    own: Sequence[tuple[float, float, int]],
    others: Sequence[tuple[float, float, int]] = (),
    *,
    lanes: int = 3,
    wanted: Sequence[int | None] | None = None,
    svo: Sequence[float] | float = 0.0,
    to_go: float = 150.0,
    v0: float = 14.0,
    stop: Any = None,
    steps: int = Settings().steps,
    dt: float = Settings().dt,
) -> Scene:
    """Vehicles `(s, v, lane)` on one road; the others keep their speed.

    `wanted` is the lane that each vehicle wants.
    """
    count, number = len(own), max(len(others), 1)
    s, v, lane = (np.asarray(column) for column in zip(*own, strict=True))
    rest = np.asarray(others or [(0, 0, 0)], float)
    t = np.arange(steps + 1) * dt
    first = [0 if k is None else k for k in wanted or [None] * count]
    last = [lanes - 1 if k is None else k for k in wanted or [None] * count]

    def floats(x: Any) -> jax.Array:
        return jnp.asarray(x, jnp.float32)

    def ints(x: Any) -> jax.Array:
        return jnp.asarray(x, jnp.int32)

    return Scene(
        active=jnp.ones(count, bool),
        s=floats(s),
        v=floats(v),
        a=jnp.zeros(count),
        lane=ints(lane),
        d=jnp.zeros(count),
        aim=ints(lane),
        length=jnp.full(count, 4.8),
        width=jnp.full(count, 1.9),
        v0=jnp.full(count, v0),
        driver=Driver(
            **{k: jnp.broadcast_to(floats(x), (count,)) for k, x in (DRIVER | {"svo": svo}).items()}
        ),
        first_lane=jnp.zeros(count, jnp.int32),
        last_lane=jnp.full(count, lanes - 1),
        wanted_first=ints(first),
        wanted_last=ints(last),
        to_go=jnp.full(count, to_go),
        stop=floats(np.full((count, lanes), NO_GAP) if stop is None else stop),
        other_active=jnp.full(number, bool(others)),
        other_s=floats(rest[:, :1] + rest[:, 1:2] * t),
        other_y=floats(np.repeat(rest[:, 2:] * LANE_WIDTH, len(t), 1)),
        other_v=floats(np.repeat(rest[:, 1:2], len(t), 1)),
        other_length=jnp.full(number, 4.8),
        other_width=jnp.full(number, 1.9),
        lane_width=floats(LANE_WIDTH),
    )


def crowded(seed: int, vehicles: int = 3, others: int = 8, **kwargs: Any) -> Scene:
    """Random traffic on three lanes; each vehicle wants a random lane."""
    random = np.random.default_rng(seed)
    found: list[tuple[float, float, int]] = []
    while len(found) < vehicles + others:
        s, lane, v = random.uniform(-60, 60), int(random.integers(3)), random.uniform(8, 16)
        if all(lane != k or abs(s - x) > 8 + 0.5 * abs(v - w) for x, w, k in found):
            found.append((s, v, lane))
    found.sort(key=lambda row: abs(row[0]))
    wanted = [int(k) for k in random.integers(0, 3, vehicles)]
    kwargs = {"svo": TEAM, "wanted": wanted} | kwargs
    return road(found[:vehicles], found[vehicles:], **kwargs)


def merge(seed: int, svo: float) -> Scene:
    """A merge: a vehicle whose lane ends, and one with `svo` on the through lane."""
    random = np.random.default_rng(seed)
    v = random.uniform(11, 14)
    own = [(0.0, v, 0), (random.uniform(-14, 2), v + random.uniform(-1, 1.5), 1)]
    stop = [[random.uniform(70, 100), NO_GAP]] * 2
    return road(own, lanes=2, wanted=[1, 1], svo=[0.0, svo], to_go=60.0, stop=stop)


def stacked(scenes: Sequence[Scene]) -> Scene:
    """A batch."""
    return jax.tree.map(lambda *of: jnp.stack(of), *scenes)


def sequences(decisions: int, vehicles: int) -> jax.Array:
    """All actions of all vehicles, `[5^(D G), G, D]`."""
    rows = itertools.product(range(ACTIONS), repeat=decisions * vehicles)
    return jnp.asarray(list(rows), jnp.int32).reshape(-1, vehicles, decisions)


def decide(settings: Settings, scenes: Scene, seed: int = 0) -> Plan:
    """Search in a batch of scenes."""
    batch, vehicles = scenes.s.shape
    previous = jnp.repeat(no_plan(vehicles, settings.decisions)[None], batch, 0)
    keys = jax.random.split(jax.random.key(seed), batch)
    return jax.vmap(lambda *of: search(settings, *of))(scenes, previous, keys)


# ---- joint actions, by mctx


# type checkers do not see their fields
_Output: Any = mctx.RecurrentFnOutput
_Root: Any = mctx.RootFnOutput


def by_mctx(policy: str, settings: Settings, scenes: Scene) -> Plan:
    """Search over joint actions: one tree over 5^G arms for the mean reward of the group.

    The value of a leaf is the reward of the default policy from there on, as in our search.
    """
    batch, count = scenes.s.shape
    depth, arms = settings.decisions, ACTIONS**count
    floats = jax.vmap(tm._in_floats)(scenes)
    digits = jnp.asarray([ACTIONS ** (count - 1 - k) for k in range(count)])

    def split(code: jax.Array) -> jax.Array:
        return (code[:, None] // digits[None]) % ACTIONS

    def step(scene: Scene, motion: Any, score: Any, k: jax.Array, action: jax.Array) -> Any:
        def of(moments: jax.Array) -> jax.Array:
            at = jnp.broadcast_to(jnp.minimum(k, depth - 1), moments.shape[1:])
            return jnp.take_along_axis(moments, at[None], 0)[0]

        others = jax.tree.map(of, tm._moments(settings, scene))
        new = tm._decision(settings, tm._prepare(scene), scene, motion, score, action, others)[:2]
        return jax.tree.map(lambda a, b: jnp.where(k < depth, a, b), new, (motion, score))

    advance = jax.vmap(batch_last(step))

    def earned(score: Any) -> jax.Array:
        return score.reward.mean(-1)

    def value(motion: Any, score: Any, k: jax.Array) -> jax.Array:
        free = jnp.full((batch, count), -1)

        def on(carry: Any, _: None) -> tuple[Any, None]:
            motion, score, k = carry
            return (*advance(floats, motion, score, k, free), k + 1), None

        (_, end, _), _ = jax.lax.scan(on, (motion, score, k), None, length=depth)
        return earned(end) - earned(score)

    def recurrent(_: Any, key: Any, code: jax.Array, embedding: Any) -> tuple[Any, Any]:
        del key
        motion, score, k = embedding
        after, later = advance(floats, motion, score, k, split(code))
        output = _Output(
            reward=earned(later) - earned(score),
            discount=jnp.where(k + 1 < depth, 1.0, 0.0),
            prior_logits=jnp.zeros((batch, arms)),
            value=value(after, later, k + 1),
        )
        return output, (after, later, k + 1)

    motion, score = jax.vmap(tm._start)(floats)
    k = jnp.zeros(batch, jnp.int32)
    root = _Root(
        prior_logits=jnp.zeros((batch, arms)), value=value(motion, score, k), embedding=(motion, score, k)
    )
    more: dict[str, Any] = {"gumbel_scale": 1.0} if policy == "gumbel" else {"dirichlet_fraction": 0.0}
    run: Callable[..., Any] = mctx.gumbel_muzero_policy if policy == "gumbel" else mctx.muzero_policy
    if policy != "gumbel":
        more["temperature"] = 0.0
    found = run(
        (), jax.random.key(0), root, recurrent,
        num_simulations=settings.simulations, max_depth=depth, **more,
    )  # fmt: skip
    tree, row = found.search_tree, jnp.arange(batch)
    node, code, actions = jnp.zeros(batch, jnp.int32), jnp.asarray(found.action), []
    for _ in range(depth):
        actions.append(jnp.where((code >= 0)[:, None], split(jnp.maximum(code, 0)), -1))
        node = jnp.where(code >= 0, jnp.asarray(tree.children_index)[row, node, jnp.maximum(code, 0)], -1)
        visits = jnp.asarray(tree.children_visits)[row, jnp.maximum(node, 0)]
        code = jnp.where((node >= 0) & (visits.sum(-1) > 0), jnp.argmax(visits, -1), -1)
    return jax.vmap(lambda *of: play(settings, *of))(scenes, jnp.stack(actions, -1))


# ---- what is shown


def timed(function: Callable[..., Any], *of: Any, repeat: int = 5) -> tuple[Any, float, float]:
    """Result, CPU seconds of the fastest call, and those of compilation."""
    begin = time.process_time()
    program = jax.jit(function).lower(*of).compile()
    compiled = time.process_time() - begin
    result = jax.block_until_ready(program(*of))
    times = []
    for _ in range(repeat):
        begin = time.process_time()
        jax.block_until_ready(program(*of))
        times.append(time.process_time() - begin)
    return result, min(times), compiled


def against_enumeration(scenes: int, simulations: Sequence[int]) -> list[dict[str, Any]]:
    """Regret against the best of all plans, for one and two vehicles."""
    rows = []
    for vehicles, decisions in ((1, 3), (1, 4), (2, 2)):
        base = Settings(decisions=decisions)
        batch = stacked([crowded(k, vehicles, 8, steps=base.steps, svo=np.pi / 4) for k in range(scenes)])
        every = sequences(decisions, vehicles)

        def all_plans(scene: Scene, settings: Settings = base, every: jax.Array = every) -> jax.Array:
            plans = jax.vmap(lambda actions: play(settings, scene, actions))(every)
            return plans.value.sum(-1)

        best = jax.jit(lambda b: jax.lax.map(all_plans, b))(batch).max(-1)
        for n in simulations:
            settings = Settings(decisions=decisions, simulations=n)
            plan = jax.jit(lambda b, settings=settings: decide(settings, b))(batch)
            gap = np.asarray(best - plan.value.sum(-1)) / vehicles
            rows.append(
                {
                    "vehicles": vehicles, "decisions": decisions, "plans": len(every), "simulations": n,
                    "scenes": scenes, "regret": float(gap.mean()), "best_found": float((gap < 1e-3).mean()),
                }
            )  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
    return rows


def against_joint(scenes: int, cases: Sequence[tuple[str, int]]) -> list[dict[str, Any]]:
    """Reward, collisions and time of plans for three vehicles in a crowd."""
    batch = stacked([crowded(1000 + k) for k in range(scenes)])
    free = jax.jit(jax.vmap(lambda s: play(Settings(), s, jnp.full((3, Settings().decisions), -1))))(batch)
    rows = [_judged("default policy", 0, free, 0.0, 0.0)]
    for method, n in cases:
        settings = Settings(simulations=n)
        run = decide if method == "ours" else lambda s, b, method=method: by_mctx(method, s, b)
        plan, seconds, compiled = timed(lambda b, s=settings, run=run: run(s, b), batch, repeat=3)
        rows.append(_judged(method, n, plan, seconds / scenes, compiled))
        print(json.dumps(rows[-1]), flush=True)
    return rows


def _judged(method: str, n: int, plan: Plan, seconds: float, compiled: float) -> dict[str, Any]:
    return {
        "method": method,
        "simulations": n,
        "reward": float(plan.reward.mean()),
        "collision": float(plan.crashed.any(-1).mean()),
        "scenes": len(plan.reward),
        "ms_per_group": seconds * 1e3,
        "compile_s": compiled,
    }


def orientation(scenes: int, simulations: int) -> list[dict[str, Any]]:
    """Outcome of a merge by social value orientation."""
    rows = []
    settings = Settings(simulations=simulations)
    run = jax.jit(lambda b: decide(settings, b))
    for svo in np.linspace(-np.pi / 8, np.pi / 2, 6):
        batch = stacked([merge(k, float(svo)) for k in range(scenes)])
        plan = run(batch)
        merged = np.asarray(plan.y[:, 0, -1]) > LANE_WIDTH / 2
        first = merged & np.asarray(plan.s[:, 0, -1] > plan.s[:, 1, -1])
        rows.append(
            {
                "svo_deg": float(np.rad2deg(svo)),
                "loss": float((batch.v0[:, 1] - plan.v[:, 1].mean(-1)).mean()),
                "merges_first": float(first.mean()),
                "merging_reward": float(plan.reward[:, 0].mean()),
                "through_reward": float(plan.reward[:, 1].mean()),
                "collision": float(plan.crashed.any(-1).mean()),
                "scenes": scenes,
                "simulations": simulations,
            }
        )
        print(json.dumps(rows[-1]), flush=True)
    return rows


def speed(cases: Sequence[tuple[int, int]]) -> list[dict[str, Any]]:
    """Milliseconds for a group, alone and in a batch."""
    rows = []
    for batch, n in cases:
        settings = Settings(simulations=n)
        scenes = stacked([crowded(k) for k in range(batch)])
        _, seconds, compiled = timed(lambda b, s=settings: decide(s, b), scenes)
        rows.append({"batch": batch, "simulations": n, "ms": seconds * 1e3 / batch, "compile_s": compiled})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def _table(rows: list[dict[str, Any]], columns: dict[str, str]) -> list[str]:
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + "---:|" * len(columns)]
    for row in rows:
        cells = [row[k] if isinstance(row[k], str) else f"{row[k]:.4g}" for k in columns]
        lines.append("| " + " | ".join(cells) + " |")
    return [*lines, ""]


def report(result: dict[str, Any]) -> str:
    """Markdown."""
    lines = ["Regenerate: `taskset -c 0 python experiments/search_quality.py`", ""]
    lines += [
        "Distance of the plan from the best of all plans (reward per vehicle, 1 is a ride at the desired"
        " speed), and how often the best is found; the two vehicles are prosocial:",
        "",
    ]
    lines += _table(
        result["enumeration"],
        {"vehicles": "vehicles", "decisions": "decisions", "plans": "plans", "simulations": "simulations",
         "regret": "short of the best", "best_found": "best found"},
    )  # fmt: skip
    lines += ["Three vehicles that want the mean of their rewards, eight others that keep their speed:", ""]
    lines += _table(
        result["joint"],
        {"method": "search", "simulations": "simulations", "ms_per_group": "CPU ms per group",
         "reward": "reward", "collision": "plans with a collision", "compile_s": "compile, s"},
    )  # fmt: skip
    lines += ["A merge, by the social value orientation of the vehicle on the through lane:", ""]
    lines += _table(
        result["orientation"],
        {"svo_deg": "angle, deg", "loss": "slower than wanted, m/s", "merges_first": "merges ahead of it",
         "merging_reward": "reward, merging", "through_reward": "reward, through", "collision": "collision"},
    )  # fmt: skip
    lines += ["Time for a group of three with eight others:", ""]
    lines += _table(
        result["speed"],
        {"batch": "batch", "simulations": "simulations", "ms": "CPU ms per group", "compile_s": "compile, s"},
    )
    lines.append(f"{result['device']}, one core, float32; load of the machine {result['load']:.1f}.")
    return "\n".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=128)
    parser.add_argument("--quick", action="store_true", help="few scenes and few simulations")
    options = parser.parse_args()
    count = 16 if options.quick else options.scenes
    numbers = (20, 200) if options.quick else (20, 200, 2000)
    joint = [("ours", 20), ("ours", 50), ("gumbel", 16), ("gumbel", 50), ("puct", 50)]
    sizes = [(1, 50), (64, 32), (64, 50), (64, 100), (256, 50)]
    result = {
        "enumeration": against_enumeration(count // 4, numbers),
        "joint": against_joint(count, joint[:2] if options.quick else joint),
        "orientation": orientation(count, 100),
        "speed": speed(sizes[:2] if options.quick else sizes),
        "device": platform.processor() or platform.machine(),
        "load": os.getloadavg()[0],
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "search_quality.json").write_text(json.dumps(result, indent=1) + "\n")
    (RESULTS / "search_quality.md").write_text(report(result) + "\n")


if __name__ == "__main__":
    main()
