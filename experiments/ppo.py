"""Learns to drive by proximal policy optimisation.

    python experiments/ppo.py highway                      # learns, and compares with the planners
    python experiments/ppo.py ramp
    python experiments/ppo.py selfplay                     # four egos of one network meet at the ramp
    PYTHONPATH=experiments limsim-jax sweep ramp --policy ppo:ramp --seeds 100

PPO (Schulman et al., 2017) with generalised advantages, over 128 worlds at once. The network sees
`lj.ObserveVector`, earns `lj.RouteReward` and chooses one of five meta-actions per decision. A rollout and
its epochs of learning are one compiled program, divided among the cores. `Learned` is the result as a policy.

Writes experiments/results/ppo_NAME.json (curve, comparison, times), .md and .npz (weights), and the curve as
docs/results/ppo_NAME.png.
"""

from __future__ import annotations

import argparse
import functools
import io
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float
from numpy.typing import NDArray

import limsim_jax as lj
from limsim_jax.files import write_whole
from limsim_jax.policies.vector import EGO, LIGHT, OTHER, ROUTE
from limsim_jax.statistics import poisson_rate, wilson
from limsim_jax.traffic.ego import Meta
from limsim_jax.types import Status
from limsim_jax.xla import enable_compilation_cache, run_often, use_all_cores

RESULTS = Path(__file__).parent / "results"
PICTURES = Path(__file__).parents[1] / "docs" / "results"
ACTIONS = (Meta.KEEP, Meta.ACCELERATE, Meta.DECELERATE, Meta.LEFT, Meta.RIGHT)
FIRST_SEED = 1_000_000
"""Of training."""

COMPARED = 1_000
"""First seed of the comparison: worlds that nothing was learned or chosen by."""

RECENT = 10
"""Updates over which the curve is averaged."""


@dataclass(frozen=True)
class Settings:
    """Numbers of PPO, after Huang et al. 2022, "The 37 implementation details of PPO"."""

    worlds: int = 128
    steps: int = 32  # decisions per rollout
    epochs: int = 4
    batches: int = 4  # per epoch
    rate: float = 1e-3  # of Adam, falling to 0
    discount: float = 0.99  # per decision
    trace: float = 0.95  # lambda of the advantages
    clip: float = 0.2
    entropy: float = 0.01
    value: float = 0.5  # weight of the loss of values
    norm: float = 0.5  # largest gradient


# --- the network and the policy ----------------------------------------------------------------------


class ActorCritic(nn.Module):
    """Logits of the actions, and the value. The others share an encoder, whatever their order."""

    wide: int = 128

    @nn.compact
    def __call__(self, seen: Float[Array, "*b D"]) -> tuple[Float[Array, "*b A"], Float[Array, "*b"]]:
        """Of vectors of `lj.ObserveVector`."""
        first = len(EGO) + 20 * len(ROUTE)
        others = seen[..., first : -len(LIGHT)].reshape(*seen.shape[:-1], -1, len(OTHER))
        each = nn.relu(nn.Dense(self.wide // 2)(nn.relu(nn.Dense(self.wide // 2)(others))))
        most = jnp.where(others[..., :1] > 0, each, 0.0).max(-2)
        x = jnp.concatenate([seen[..., :first], seen[..., -len(LIGHT) :], most], -1)
        for _ in range(2):
            x = nn.tanh(nn.Dense(self.wide)(x))
        logits = nn.Dense(len(ACTIONS), kernel_init=nn.initializers.orthogonal(0.01))(x)
        return logits, nn.Dense(1)(x)[..., 0]


@dataclass(frozen=True)
class Learned(lj.Policy):
    """Drives by the actions of a network.

    Attributes:
      weights: file of `save`.
      greedy: takes the likeliest action; otherwise it draws one, as while learning.
    """

    weights: str = str(RESULTS / "ppo_highway.npz")
    greedy: bool = False

    free = False

    def __post_init__(self) -> None:
        load(self.weights)

    def __call__(self, config: Any, lane_map: Any, state: Any, memory: Any, key: Any) -> Any:
        """A meta-action per ego."""
        logits, _ = ActorCritic().apply(load(self.weights), lj.ObserveVector()(config, lane_map, state))
        action = logits.argmax(-1) if self.greedy else jax.random.categorical(key, logits)
        meta = jnp.asarray([int(x) for x in ACTIONS], jnp.int32)[action]
        return lj.Command(meta=meta), memory


def highway() -> Learned:
    """What has learned on the motorway."""
    return Learned(greedy=True, name="ppo")


def ramp() -> Learned:
    """What has learned to merge."""
    return Learned(str(RESULTS / "ppo_ramp.npz"), name="ppo")


def selfplay() -> Learned:
    """What has learned to merge among others that learn."""
    return Learned(str(RESULTS / "ppo_selfplay.npz"), name="ppo")


def save(path: Path, weights: Any) -> None:
    """Write weights as .npz, in half precision."""
    flat = {"/".join(k.key for k in path): x for path, x in jax.tree_util.tree_leaves_with_path(weights)}
    file = io.BytesIO()
    np.savez(file, **{name: np.asarray(x, np.float16) for name, x in flat.items()})  # pyright: ignore
    write_whole(path, file.getvalue())


@functools.cache
def load(path: str) -> Any:
    """Read what `save` wrote.

    Raises:
      ValueError: there are no such weights.
    """
    weights: dict[str, Any] = {}
    try:
        with np.load(path) as file:
            for name in file.files:
                *folders, last = name.split("/")
                functools.reduce(lambda at, x: at.setdefault(x, {}), folders, weights)[last] = np.float32(
                    file[name]
                )
    except OSError as error:
        raise ValueError(f"{path}: no weights; python experiments/ppo.py learns them ({error})") from None
    return weights


# --- learning ----------------------------------------------------------------------------------------


class Moment(NamedTuple):
    """What happened in a decision: `[T, B, E]`, or `[S]` when shuffled."""

    seen: Any  # [..., D]
    action: Any
    chance: Any  # logarithm of its probability
    value: Any
    reward: Any
    ends: Any  # nothing of value follows
    cut: Any  # another episode follows
    counts: Any  # the ego was still driving


class Worlds(NamedTuple):
    """Worlds between two rollouts."""

    state: Any
    seen: Any


def rollout(env: lj.Env, settings: Settings, weights: Any, worlds: Worlds, key: Any) -> Any:
    """Drive `steps` decisions; a world that is over goes on as a fresh one."""
    count = worlds.seen.shape[0]
    keys = jax.random.split(key, settings.steps + 1)
    # one fresh start per world and rollout: episodes are longer than rollouts
    fresh = Worlds(*jax.vmap(env.reset)(jax.random.split(keys[0], count))[::-1])

    def decide(worlds: Worlds, key: Any) -> tuple[Worlds, Any]:
        logits, value = ActorCritic().apply(weights, worlds.seen)
        action = jax.random.categorical(key, logits)
        chance = jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], -1)[..., 0]
        meta = jnp.asarray([int(x) for x in ACTIONS], jnp.int32)[action]
        driving = ~worlds.state.ended
        seen, state, reward, over, late, info = jax.vmap(env.step)(
            jax.random.split(key, count), worlds.state, {"meta": meta}
        )
        # the horizon cuts an episode short: what would have come is worth its value
        ahead: Any = ActorCritic().apply(weights, seen)
        worth: Any = jnp.where(late[:, None] & ~over, ahead[1], 0.0)
        reward += settings.discount * worth
        done = late | over.all(-1)
        moment = Moment(
            worlds.seen, action, chance, value, reward, over | late[:, None], done[:, None] | over, driving
        )
        fell = driving & (over | late[:, None])
        told = jnp.stack([fell.sum(), (fell & info.arrived).sum(), jnp.sum(reward)]).astype(jnp.float32)

        def renew(new: Any, old: Any) -> Any:
            return jnp.where(done.reshape(-1, *[1] * (new.ndim - 1)), new, old)

        return jax.tree.map(renew, fresh, Worlds(state, seen)), (moment, told)

    worlds, (moments, told) = lax.scan(decide, worlds, keys[1:])
    return worlds, moments, told.sum(0)


def advantages(settings: Settings, moments: Moment, last: Any) -> Any:
    """Generalised advantages `[T, B, E]` (Schulman et al., 2016). `last`: values after the rollout."""

    def back(carry: Any, moment: Moment) -> Any:
        following, ahead = carry
        on = 1.0 - moment.ends
        delta = moment.reward + settings.discount * following * on - moment.value
        ahead = delta + settings.discount * settings.trace * on * ahead
        return (moment.value, ahead), ahead

    return lax.scan(back, (last, jnp.zeros_like(last)), moments, reverse=True)[1]


def loss(settings: Settings, weights: Any, moments: Moment, gain: Any, target: Any) -> Any:
    """Clipped surrogate, error of values and entropy of one batch `[S]`."""
    logits, value = ActorCritic().apply(weights, moments.seen)
    log = jax.nn.log_softmax(logits)
    chance = jnp.take_along_axis(log, moments.action[..., None], -1)[..., 0]
    ratio = jnp.exp(chance - moments.chance)
    few = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip) * gain)
    entropy = -jnp.sum(jnp.exp(log) * log, -1)
    each = -few + settings.value * (value - target) ** 2 - settings.entropy * entropy
    return jnp.sum(each * moments.counts) / jnp.maximum(moments.counts.sum(), 1.0)


def update_of(env: lj.Env, settings: Settings, optimiser: Any, mesh: Mesh) -> Any:
    """A rollout and its epochs of learning, divided among the devices."""

    def update(weights: Any, slopes: Any, worlds: Worlds, key: Any) -> Any:
        here = jax.random.fold_in(key, lax.axis_index("worlds"))
        worlds, moments, told = rollout(env, settings, weights, worlds, here)
        _, last = ActorCritic().apply(weights, worlds.seen)
        gain = advantages(settings, moments, last)
        target = gain + moments.value
        counts = moments.counts.astype(jnp.float32)
        moments = moments._replace(counts=counts)
        mean = lax.pmean(jnp.sum(gain * counts) / jnp.maximum(counts.sum(), 1.0), "worlds")
        spread = lax.pmean(jnp.sum((gain - mean) ** 2 * counts) / jnp.maximum(counts.sum(), 1.0), "worlds")
        gain = (gain - mean) / (jnp.sqrt(spread) + 1e-8)
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), (moments, gain, target))

        def learn(carry: Any, some: Any) -> Any:
            weights, slopes = carry
            change = jax.grad(functools.partial(loss, settings))(weights, *some)
            change, slopes = optimiser.update(lax.pmean(change, "worlds"), slopes)
            return (optax.apply_updates(weights, change), slopes), None

        def epoch(carry: Any, key: Any) -> Any:
            order = jax.random.permutation(key, flat[1].shape[0]).reshape(settings.batches, -1)
            return lax.scan(learn, carry, jax.tree.map(lambda x: x[order], flat))

        keys = jax.random.split(jax.random.fold_in(here, 1), settings.epochs)
        (weights, slopes), _ = lax.scan(epoch, (weights, slopes), keys)
        return weights, slopes, worlds, lax.psum(told, "worlds")

    every, some = PartitionSpec(), PartitionSpec("worlds")
    shared = jax.shard_map(
        update, mesh=mesh, in_specs=(every, every, some, every), out_specs=(every, every, some, every),
        check_vma=False,
    )  # fmt: skip
    return jax.jit(shared, donate_argnums=(0, 1, 2), compiler_options=run_often())


def learn(experiment: lj.Experiment, settings: Settings, steps: int, tell: Callable[[str], None]) -> Any:
    """Learn from a number of decisions; returns weights, the curve, and s of compiling."""
    env = lj.Env(
        experiment, action="meta", observe=lj.ObserveVector(), reward=lj.RouteReward(),
        ends=Status.COLLIDED | Status.OFF_ROAD | Status.RED_LIGHT,
    )  # fmt: skip
    mesh = Mesh(np.array(jax.local_devices()), ("worlds",))
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.norm),
        optax.inject_hyperparams(optax.adam)(learning_rate=settings.rate, eps=1e-5),
    )
    everywhere, divided = (NamedSharding(mesh, x) for x in (PartitionSpec(), PartitionSpec("worlds")))
    key = jax.random.key(FIRST_SEED)
    weights = ActorCritic().init(key, jnp.zeros((1, env.egos, lj.ObserveVector().size)))
    # placed as the program leaves them, so that it is compiled once
    weights, slopes = jax.device_put((weights, optimiser.init(weights)), everywhere)
    begun = time.perf_counter()
    reset = jax.jit(jax.vmap(env.reset), out_shardings=divided, compiler_options=run_often())
    seen, state = reset(jax.random.split(jax.random.fold_in(key, 1), settings.worlds))
    worlds = Worlds(state, seen)
    update = update_of(env, settings, optimiser, mesh).lower(weights, slopes, worlds, key).compile()
    compiled = time.perf_counter() - begun
    tell(f"compiled in {compiled:.0f} s")
    begun, cpu = time.perf_counter(), time.process_time()
    curve, spent, n = [], 0.0, 0
    updates = -(-steps // (settings.steps * settings.worlds))
    while n < updates:
        rate = np.float32(settings.rate * (1 - n / updates))
        slopes[1].hyperparams["learning_rate"] = jax.device_put(rate, everywhere)
        now = jax.device_put(jax.random.fold_in(key, n + 2), everywhere)
        weights, slopes, worlds, told = update(weights, slopes, worlds, now)
        ended, arrived, reward = (float(x) for x in told)
        n, spent = n + 1, time.perf_counter() - begun
        curve.append(
            {
                "env_steps": n * settings.steps * settings.worlds,
                "wall_s": round(spent, 1),
                "cpu_s": round(time.process_time() - cpu, 1),
                "ended": int(ended),
                "arrived": int(arrived),
                "reward": round(reward / (settings.steps * settings.worlds * env.egos), 4),
            }
        )
        if n % 10 == 0:
            tell(f"{curve[-1]['env_steps']} steps, {spent:.0f} s: success {100 * recent(curve)[-1]:.1f} %")
    return jax.device_get(weights), curve, compiled


def recent(curve: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Share of arrivals among the ends of the last `RECENT` updates; NaN: none."""
    arrived, ended = (np.cumsum([0] + [row[name] for row in curve]) for name in ("arrived", "ended"))
    first = np.maximum(np.arange(len(curve)) + 1 - RECENT, 0)
    count = ended[1:] - ended[first]
    return np.where(count > 0, (arrived[1:] - arrived[first]) / np.maximum(count, 1), np.nan)


# --- comparison --------------------------------------------------------------------------------------


def selfplay_experiment() -> lj.Experiment:
    """Four egos at the ramp: two merge, two drive on."""
    merging = [lj.Ego(start="5", s=s, goal="3") for s in (250.0, 200.0)]
    passing = [lj.Ego(start="1", lane=lane, s=s, goal="3") for lane, s in ((1, 300.0), (2, 250.0))]
    return lj.Experiment("ramp", name="selfplay", ego=[*merging, *passing])


EXPERIMENTS = {
    "highway": (lambda: lj.Experiment("highway"), highway, 0.95),
    "ramp": (lambda: lj.Experiment("ramp"), ramp, 0.85),
    "selfplay": (selfplay_experiment, selfplay, 0.85),
}
"""What to learn: an experiment, the policy that comes of it, and the success to reach."""


def compare(experiment: lj.Experiment, policies: list[lj.Policy], seeds: int) -> list[dict[str, Any]]:
    """What a sweep says of the network and of the planners."""
    results = lj.sweep(experiment, policies=policies, seeds=range(COMPARED, COMPARED + seeds), progress=False)
    rows = []
    for name in results.policies:
        table = results.episodes.filter(np.asarray(results.episodes.column("policy")) == name)
        column = {
            x: np.asarray(table.column(x), float) for x in ("success", "contacts", "off_road", "distance")
        }
        bad = int(((column["contacts"] > 0) | (column["off_road"] > 0)).sum())
        km = float(column["distance"].sum() / 1000)
        rate = poisson_rate(bad, km)
        done = wilson(int(column["success"].sum()), len(column["success"]))
        rows.append(
            {
                "policy": name,
                "episodes": len(column["success"]),
                "success": [round(100 * x, 1) for x in (done.estimate, done.low, done.high)],
                "infractions": bad,
                "km": round(km, 1),
                "km_per_infraction": [
                    None if x == 0 else round(1 / x, 1) for x in (rate.estimate, rate.high, rate.low)
                ],
            }
        )
    return rows


def draw(path: Path, name: str, curve: list[dict[str, Any]]) -> None:
    """The learning curve as .png."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), dpi=120, layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [row["env_steps"] / 1000 for row in curve]
    left.plot(steps, 100 * recent(curve), color="#1d6fd1")
    left.set(ylim=(0, 102), ylabel=f"success, %, last {RECENT} updates", xlabel="decisions, thousands")
    right.plot(steps, [row["reward"] for row in curve], color="#1d6fd1")
    right.set(ylabel="reward per decision", xlabel="decisions, thousands")
    for ax in (left, right):
        ax.grid(alpha=0.3)
    figure.suptitle(f"PPO, {name}")
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    write_whole(path, file.getvalue())


def table(report: dict[str, Any]) -> str:
    """The comparison as Markdown."""
    curve, success = report["curve"], recent(report["curve"])
    lines = [
        f"Regenerate: `python experiments/ppo.py {report['experiment']}`",
        "",
        "| policy | episodes | success, % | km driven | infractions | km per infraction |",
        "|---|---:|---|---:|---:|---|",
    ]
    for row in report["policies"]:
        done, low, high = row["success"]
        km, least, most = row["km_per_infraction"]
        known = f"at least {least}" if km is None else f"{km} [{least}, {most}]"
        name = f"{row['policy']} (learned)" if row["policy"] == "ppo" else row["policy"]
        lines.append(
            f"| {name} | {row['episodes']} | {done} [{low}, {high}] | {row['km']:,} | {row['infractions']} "
            f"| {known} |"
        )
    reached = np.flatnonzero(success >= report["goal"])
    when = curve[int(reached[0])] if reached.size else None
    goal = f"{100 * report['goal']:.0f} % of the episodes"
    lines += [
        "",
        f"Learned in {curve[-1]['wall_s'] / 60:.1f} min on {report['devices']} cores "
        f"({curve[-1]['cpu_s'] / 60:.1f} min of CPU time), after {report['compile_s']:.0f} s of compiling: "
        f"{curve[-1]['env_steps']:,} decisions in {report['settings']['worlds']} worlds. "
        + (
            f"While it learned, it first arrived in {goal} after {when['env_steps']:,} decisions, "
            f"{when['wall_s'] / 60:.1f} min."
            if when
            else f"While it learned, it never arrived in {goal}."
        ),
        "An infraction is a contact or a departure from the road. Worlds of the sweep are others than those "
        "of learning; intervals of 95 %.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Learn, compare, and write."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("experiment", choices=list(EXPERIMENTS))
    parser.add_argument("--steps", type=int, default=300_000, help="decisions to learn from")
    parser.add_argument("--seeds", type=int, default=200, help="of the comparison")
    parser.add_argument("--compare", action="store_true", help="with the weights that are there")
    parser.add_argument("--alone", action="store_true", help="drive the network without the planners")
    told = parser.parse_args()
    devices = use_all_cores()
    enable_compilation_cache()
    name, path = told.experiment, RESULTS / f"ppo_{told.experiment}"
    make, policy, goal = EXPERIMENTS[name]
    if told.compare:
        report = json.loads(path.with_suffix(".json").read_text())
    else:
        settings = Settings()
        weights, curve, compiled = learn(make(), settings, told.steps, lambda line: print(line, flush=True))
        save(path.with_suffix(".npz"), weights)
        load.cache_clear()
        report = {
            "experiment": name, "goal": goal, "devices": devices, "compile_s": round(compiled, 1),
            "settings": asdict(settings), "policies": [], "curve": curve,
        }  # fmt: skip
        draw(PICTURES / f"ppo_{name}.png", name, curve)
    if told.seeds:
        others = [] if told.alone else [lj.LikeTraffic(), lj.PDMClosed(), lj.LimSimTM()]
        report["policies"] = compare(make(), [policy(), *others], told.seeds)
    write_whole(path.with_suffix(".json"), json.dumps(report, indent=1) + "\n")
    write_whole(path.with_suffix(".md"), table(report))
    print(table(report))


if __name__ == "__main__":
    main()
