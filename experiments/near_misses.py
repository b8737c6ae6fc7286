"""Near misses judged by eye: moments of the five scenarios from above, and a verdict on each.

    python experiments/near_misses.py [--seeds 2] [--moments 8] [--scenarios ramp ...] [--policies ...]

A moment is a pair of vehicles whose bodies would touch within 1.5 s if they went on straight. It counted as a
near miss before if the paths of both may meet at all; whether it counts now is up to the present definition.
Draws the world at its least time to collision, and where both drive in the next 3 s, onto sheets in
results/near_misses. Moments that were found before stay there.

The verdicts on 244 moments are in experiments/results/near_misses.csv. Moments of the run that are in it
get their `counted_before` and `counted_now` anew. Writes experiments/results/near_misses.md from it.
"""

from __future__ import annotations

import argparse
import csv
import math
import pickle
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int
from readme_tables import PAPER

from limsim_jax.files import write_whole
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.metrics.observer import EvaluateEgo, StepRecord, paths
from limsim_jax.metrics.safety import NEAR_MISS, NONE, encounter, ttc_2d
from limsim_jax.metrics.step import StepView
from limsim_jax.report.frames import EGO, Layer, Scene, draw_map_only
from limsim_jax.simulation.rollout import one_world
from limsim_jax.simulation.trace import trace
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import read_experiments
from limsim_jax.traffic.engine import Tick
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, State
from limsim_jax.xla import enable_compilation_cache

HERE = Path(__file__).parent
RESULTS = HERE / "results"
POLICIES = ("like_traffic", "constant_speed")
AROUND = (10, 8)  # decisions before and after a moment that are kept
AHEAD = 3.0  # s of motion in a picture
OTHER = "#e07b00"
ROWS, COLUMNS = 3, 4  # pictures on a sheet
KEY = ("scenario", "policy", "seed", "ego", "other", "time")
SAID = ("kind", "verdict")
COLUMNS_OF_CSV = (*KEY, *SAID, "counted_before", "counted_now")


class Times(NamedTuple):
    """Times to collision with another vehicle, s, `[T]`; `NONE`."""

    boxes: Float[Array, " T"]  # of boxes that go on straight, wherever they are going
    before: Float[Array, " T"]
    now: Float[Array, " T"]


@partial(jax.jit, static_argnums=0)
def times(
    config: Config, lane_map: LaneMap, ticks: Tick, ego: Int[Array, ""], other: Int[Array, ""]
) -> Times:
    """Times to collision in all steps of whole decisions, by all definitions; `ego`, `other`: slots."""
    egos = ticks.state.egos
    egos = replace(egos, slot=egos.slot.at[:, 0].set(ego), free=egos.free & (egos.slot == ego))
    ticks = ticks._replace(state=replace(ticks.state, egos=egos))
    measure = EvaluateEgo()

    slots = jnp.arange(ticks.state.active.shape[1])
    pair = (slots == ego) | (slots == other)  # of all others nothing is asked

    def decision(ticks: Tick) -> Times:
        records = jax.vmap(lambda tick: measure.record(config, lane_map, tick))(ticks)
        relevant, how = paths(lane_map, ego, records)

        def step(record: StepRecord) -> Times:
            now = record.ego._replace(relevant=relevant, active=record.ego.active & pair, **how._asdict())
            view = StepView(now, config.dt, now.active[ego], jnp.zeros_like(now.active))
            boxes = jnp.where(view.apart[other] & now.active[ego], view.ttc[other], NONE)
            counts = relevant[other] | now.changing[ego] | view.touches[other]
            lane = jnp.where(view.leader == other, view.least_ttc_1d, NONE)
            straight = jnp.minimum(jnp.where(counts, boxes, NONE), lane)
            return Times(boxes, straight, view.urgent_ttc[0])

        return jax.vmap(step)(records)

    every = config.decision_every
    parts = jax.tree.map(lambda x: x.reshape(-1, every, *x.shape[1:]), ticks)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), lax.map(decision, parts))


class Moment(NamedTuple):
    """An encounter of two vehicles at its least time to collision."""

    key: tuple[str, str, int, int, int, float]  # with the slots of both, the ego first
    step: int  # in `ticks`
    ticks: Tick  # around it, NumPy


@jax.jit
def encounters(lane_map: LaneMap, ticks: Tick) -> tuple[Float[Array, "N N"], Int[Array, "N N"]]:
    """Least time to collision of all pairs that go on straight, s.

    And the step in which it is.
    """
    n = ticks.state.active.shape[1]

    def step(carry: tuple[Array, Array], tick: tuple[Array, State]) -> tuple[tuple[Array, Array], None]:
        (k, state), (best, when) = tick, carry
        box = boxes(lane_map, state)
        velocity = state.v[:, None] * jnp.stack([jnp.cos(box[:, 2]), jnp.sin(box[:, 2])], -1)
        ttc = jax.vmap(lambda one, v: ttc_2d(encounter(one, v, box, velocity)))(box, velocity)
        ttc = jnp.where(state.active & state.active[:, None] & ~jnp.eye(n, dtype=bool), ttc, NONE)
        return (jnp.minimum(best, ttc), jnp.where(ttc < best, k, when)), None

    start = jnp.full((n, n), NONE), jnp.zeros((n, n), jnp.int32)
    steps = jnp.arange(ticks.time.shape[0], dtype=jnp.int32)
    return lax.scan(step, start, (steps, ticks.state))[0]


def collect(episodes: Episodes, policy: str, seeds: int, most: int, file: Path) -> list[Moment]:
    """Moments of some worlds, at most `most` of them at random; those in `file`, if it exists.

    Where the ego drives as all traffic does, every vehicle stands for it, and either one of two.
    """
    if file.exists():
        return pickle.loads(file.read_bytes())
    lane_map, config = episodes.lane_map, episodes.rollout.config
    run = replace(episodes.rollout, measure=None, record=lambda lane_map: lambda tick: tick)
    go = jax.jit(lambda lane_map, seed: one_world(run, lane_map, episodes.sample, seed).trace)
    moments, rng, every = [], np.random.default_rng(0), config.decision_every
    for seed in range(seeds):
        ticks = go(lane_map, jnp.int32(seed))
        least, when = jax.device_get(encounters(lane_map, ticks))
        ticks = jax.device_get(ticks)
        ego = int(ticks.state.egos.slot[0, 0])
        pairs = np.argwhere((least > 0) & (least < NEAR_MISS[0]))
        if policy == "like_traffic":
            coin = rng.random(least.shape) < 0.5  # of two, which one is the ego
            pairs = [(i, j) for i, j in pairs if coin[min(i, j), max(i, j)] == (i < j)]
        else:
            pairs = [(i, j) for i, j in pairs if i == ego]
        for one, other in pairs:
            step = int(when[one, other])
            first, last = (step // every - AROUND[0]) * every, (step // every + AROUND[1]) * every
            if first < 0 or last > len(ticks.time):
                continue
            kept = jax.tree.map(lambda x: x[first:last].copy(), ticks)  # noqa: B023
            time = round(float(ticks.time[step]), 2)
            moment = Moment((episodes.scenario, policy, seed, int(one), int(other), time), step - first, kept)
            if 0 < judged(config, lane_map, moment).boxes < NEAR_MISS[0]:  # not on a bridge, no contact
                moments.append(moment)
        print(f"{episodes.scenario} / {policy}: seed {seed}, {len(moments)} moments", flush=True)
    moments = [moments[k] for k in sorted(rng.permutation(len(moments))[:most])]
    write_whole(file, pickle.dumps(moments))
    return moments


class Least(NamedTuple):
    """As `Times`, the least of an encounter, s."""

    boxes: float
    before: float
    now: float


def judged(config: Config, lane_map: LaneMap, moment: Moment) -> Least:
    """Least times to collision of an encounter."""
    pair = list(moment.key[3:5])
    found = jax.device_get(times(config, lane_map, moment.ticks, *map(jnp.int32, pair)))
    entered = np.asarray(moment.ticks.state.entered)[:, pair]
    same = (entered == entered[moment.step]).all(1)  # later another vehicle may have the slot
    return Least(*(float(x[same].min()) for x in found))


def draw(ax: Any, episodes: Episodes, moment: Moment, title: str) -> None:
    """A moment from above: the ego in magenta, the other in orange, and where both are every half second."""
    from matplotlib.collections import PolyCollection

    (ego, other), k, config = moment.key[3:5], moment.step, episodes.rollout.config
    seen = jax.device_get(jax.vmap(trace(episodes.lane_map))(moment.ticks))
    scene = Scene(episodes.network, episodes.lane_map, seen, [ego])
    both = scene.xy[k, [ego, other]]
    half = max(16.0, *(np.ptp(both, axis=0) / 2 + 9))
    x, y = both.mean(0)
    draw_map_only(ax, episodes.network, (x - 1.3 * half, y - half, x + 1.3 * half, y + half))
    ax.set_xticks([])
    ax.set_yticks([])
    layer = Layer(ax, scene)
    layer.update(k)
    layer.artists["vehicles"].set_array(None)
    layer.artists["vehicles"].set_facecolor("#b9c0c9")
    every = round(0.5 / config.dt)
    last = min(k + round(AHEAD / config.dt), len(scene.time) - 1)
    for who, colour in ((other, OTHER), (ego, EGO)):
        for at in range(k, last + 1, every):
            if not scene.active[at, who]:
                break
            slots, shapes = scene.outlines(at, 1.0)
            body = shapes[list(slots).index(who)]
            face = colour if at == k else "none"
            ax.add_collection(PolyCollection([body], facecolor=face, edgecolor=colour, lw=0.7, zorder=500))
    ax.set_title(title, fontsize=6.5, loc="left", pad=2)


def sheets(rows: Sequence[tuple[Episodes, Moment, str]], out: Path, name: str) -> None:
    """Pictures of moments on sheets of `ROWS` by `COLUMNS`."""
    from matplotlib.figure import Figure

    for first in range(0, len(rows), ROWS * COLUMNS):
        figure = Figure(figsize=(4.2 * COLUMNS, 3.5 * ROWS), dpi=110)
        axes = figure.subplots(ROWS, COLUMNS, squeeze=False).ravel()
        figure.subplots_adjust(0.01, 0.01, 0.99, 0.97, 0.03, 0.12)
        some = rows[first : first + ROWS * COLUMNS]
        for ax in axes[len(some) :]:
            ax.set_axis_off()
        for ax, row in zip(axes, some, strict=False):
            draw(ax, *row)
        figure.savefig(out / f"{name}_{first // (ROWS * COLUMNS)}.png")


def words(moment: Moment, number: int, ttc: float, dt: float) -> str:
    """Title of a picture."""
    _, policy, seed, ego, other, time = moment.key
    k, state = moment.step, moment.ticks.state
    last = k + round(AHEAD / dt)
    pair = [ego, other]
    v = " ".join(f"{x:.1f}" for x in np.asarray(state.v)[k, pair])
    a = " ".join(f"{x:.1f}" for x in np.asarray(state.a)[k : last + 1, pair].min(0))
    side = " ".join(f"{x:+d}" if x else "0" for x in np.asarray(state.side)[k, pair])
    return (
        f"#{number} {policy} {seed}: {ego}, {other} at {time:.1f}, TTC {ttc:.2f}, v {v}, a {a}, side {side}"
    )


def read(file: Path) -> dict[tuple[str, ...], dict[str, str]]:
    """Rows of a table by their key."""
    if not file.exists():
        return {}
    with file.open(newline="") as lines:
        return {tuple(row[name] for name in KEY): row for row in csv.DictReader(lines)}


def written(rows: Sequence[dict[str, Any]]) -> str:
    """A table as CSV."""
    lines = [",".join(COLUMNS_OF_CSV)]
    lines += [",".join(str(row[name]) for name in COLUMNS_OF_CSV) for row in rows]
    return "\n".join(lines) + "\n"


def table(rows: Sequence[dict[str, str]]) -> str:
    """What was seen, as Markdown."""
    head = "| scenario | policy | moments | true | before | false | now | false | true missed |"
    lines = [head, "|---|---|" + "---:|" * 7]
    cells = [(scenario, policy) for scenario in PAPER for policy in POLICIES]
    for scenario, policy in [*cells, ("all", "")]:
        some = [
            row for row in rows if scenario == "all" or (row["scenario"], row["policy"]) == (scenario, policy)
        ]
        if not some:
            continue
        true = [row for row in some if row["verdict"] == "true"]
        numbers = [len(some), len(true)]
        for name in ("counted_before", "counted_now"):
            counted = [row for row in some if row[name] == "1"]
            numbers += [len(counted), sum(row["verdict"] == "false" for row in counted)]
        numbers.append(sum(row["counted_now"] == "0" for row in true))
        lines.append(f"| {scenario} | {policy} | " + " | ".join(map(str, numbers)) + " |")
    lines += [
        "",
        "| kind | verdict | moments | counted before | counted now |",
        "|---|---|---:|---:|---:|",
    ]
    kinds = Counter((row["kind"], row["verdict"]) for row in rows)
    for (kind, verdict), number in kinds.most_common():
        some = [row for row in rows if (row["kind"], row["verdict"]) == (kind, verdict)]
        counts = (sum(row[name] == "1" for row in some) for name in ("counted_before", "counted_now"))
        lines.append(f"| {kind} | {verdict} | {number} | " + " | ".join(map(str, counts)) + " |")
    return "\n".join(lines)


def main() -> None:
    """Collect, draw and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2, help="worlds of each scenario and policy")
    parser.add_argument("--moments", type=int, default=8, help="of each scenario, at most")
    parser.add_argument("--scenarios", nargs="*", default=list(PAPER))
    parser.add_argument("--policies", nargs="*", default=list(POLICIES))
    parser.add_argument("--out", type=Path, default=Path("results/near_misses"))
    parser.add_argument("--no-pictures", action="store_true")
    options = parser.parse_args()
    if options.seeds < 1 or options.moments < 1:
        parser.error("--seeds and --moments: at least 1")
    enable_compilation_cache()
    options.out.mkdir(parents=True, exist_ok=True)
    said = read(RESULTS / "near_misses.csv")
    index = []
    each = math.ceil(options.moments / len(options.policies))
    for scenario in options.scenarios:
        pictures = []
        for policy in options.policies:
            (experiment,) = read_experiments(scenario, policy=policy)
            episodes = Episodes(experiment, chunk=1)
            config, lane_map = episodes.rollout.config, episodes.lane_map
            file = options.out / f"{scenario}_{policy}_{options.seeds}.pkl"
            for moment in collect(episodes, policy, options.seeds, each, file):
                found = judged(config, lane_map, moment)
                pictures.append((episodes, moment, words(moment, len(pictures), found.boxes, config.dt)))
                row: dict[str, Any] = dict(zip(KEY, map(str, moment.key), strict=True))
                known = said.get(tuple(row.values()), {})
                row |= {name: known.get(name, "") for name in SAID}
                row |= {
                    f"counted_{name}": str(int(getattr(found, name) < NEAR_MISS[0]))
                    for name in ("before", "now")
                }
                known.update(row)
                index.append(row)
        if not options.no_pictures:
            sheets(pictures, options.out, scenario)
        write_whole(options.out / "index.csv", written(index))
        print(f"{scenario}: {len(pictures)} moments", flush=True)
    if said:
        rows = list(said.values())
        write_whole(RESULTS / "near_misses.csv", written(rows))
        head = "From the verdicts in near_misses.csv, by `python experiments/near_misses.py`\n\n"
        write_whole(RESULTS / "near_misses.md", f"{head}{table(rows)}\n")


if __name__ == "__main__":
    main()
