"""Training of PDM-Hybrid on our own rollouts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import PolicyLike
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.policies.pdm.learned import (
    BEYOND,
    POSE_TIME,
    POSES,
    Features,
    Offset,
    Past,
    features,
    in_frame,
    load_weights,
    no_past,
    remember,
    save_weights,
)
from limsim_jax.simulation.rollout import started
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import read_experiments
from limsim_jax.traffic.command import Command
from limsim_jax.types import Config, State
from limsim_jax.xla import enable_compilation_cache

SCENARIOS = ("highway", "ramp", "intersection", "roundabout", "long_route")
"""Bundled experiments for training."""

FIRST_SEED = 1_000_000
"""First seed of training; sweeps start at 0, with worlds that the network has not seen."""


class Samples(NamedTuple):
    """Training data: `S` moments, as NumPy arrays."""

    features: Features  # [S, ...]
    future: NDArray[np.float32]  # [S, 16, 3], driven poses in the frame of the ego
    seed: NDArray[np.int32]  # [S], of the world


class Errors(NamedTuple):
    """Open-loop errors of forecasts over all poses up to 8 s."""

    l1: float  # mean of the absolute errors of x, y (m) and heading (rad)
    ade: float  # m, mean distance
    fde: float  # m, mean distance at the end

    def __str__(self) -> str:
        return f"L1 {self.l1:.3f}, mean distance {self.ade:.2f} m, at 8 s {self.fde:.2f} m"


class Report(NamedTuple):
    """Result of training, on held-out seeds."""

    samples: int
    held_out: int
    before: Errors  # PDM-Closed
    after: Errors  # PDM-Hybrid


class _Memory(NamedTuple):
    driver: Any
    past: Past
    features: Features  # [D, E, ...]
    pose: Float[Array, "D E 3"]
    active: Bool[Array, "D E"]


@dataclass(frozen=True)
class _Recorder:
    """Drives like a policy, and records the network's inputs at every decision."""

    driver: PolicyLike
    decisions: int

    @property
    def free(self) -> bool:
        return self.driver.free

    @property
    def others(self) -> int:
        return getattr(self.driver, "others", 0)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> _Memory:
        past = no_past(config, state)
        seen = self._see(config, lane_map, state, past)

        def rows(x: Any) -> Array:
            return jnp.zeros((self.decisions, *x.shape), x.dtype)

        egos = state.egos
        pose = jnp.stack([egos.x, egos.y, egos.heading], -1)
        return _Memory(
            self.driver.init(config, lane_map, state),
            past,
            jax.tree.map(rows, seen),
            rows(pose),
            rows(egos.free),
        )

    def _see(self, config: Config, lane_map: LaneMap, state: State, past: Past) -> Features:
        plan = PDMClosed().plan(config, lane_map, state, beyond=BEYOND)
        return features(config, lane_map, state, past, plan)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: _Memory, key: jax.Array
    ) -> tuple[Command, _Memory]:
        past = remember(memory.past, state)
        seen = self._see(config, lane_map, state, past)
        now = state.step // config.decision_every
        egos = state.egos
        pose = jnp.stack([egos.x, egos.y, egos.heading], -1)
        # a vehicle that had a contact is no example
        good = state.active[egos.slot] & (state.status[egos.slot] == 0)

        def write(rows: Array, row: Array) -> Array:
            return rows.at[now].set(row)

        command, driver = self.driver(config, lane_map, state, memory.driver, key)
        return command, _Memory(
            driver,
            past,
            jax.tree.map(write, memory.features, seen),
            write(memory.pose, pose),
            write(memory.active, good),
        )


def record(
    experiment: str, seeds: Sequence[int], *, policy: str = "like_traffic", chunk: int = 16
) -> Samples:
    """Training data from rollouts of an experiment, driven by a policy.

    Args:
      experiment: a file or a bundled name; its decisions are `POSE_TIME` apart.
      seeds: of the worlds.
      policy: name of the policy.
      chunk: worlds that run at once.

    Raises:
      ExperimentError: the experiment cannot be run.
      ValueError: its decisions are not `POSE_TIME` apart.
    """
    enable_compilation_cache()
    parts: list[Samples] = []
    for told in read_experiments(experiment, policy=policy):
        episodes = Episodes(told, chunk=chunk)
        run = episodes.rollout
        if abs(run.config.decision_time - POSE_TIME) > 1e-6:
            raise ValueError(
                f"{told.name}: decisions every {run.config.decision_time} s; training needs {POSE_TIME} s"
            )
        run = replace(run, policy=_Recorder(run.policy, run.decisions), measure=None)

        def one(lane_map: LaneMap, seed: jax.Array, run: Any = run, episodes: Any = episodes) -> _Memory:
            memory = run.advance(lane_map, *started(run, lane_map, episodes.sample, seed))[1].memory
            return memory.policy  # the recorder has a view, as PDM-Hybrid does

        many = jax.jit(jax.vmap(one, in_axes=(None, 0)))
        for first in range(0, len(seeds), chunk):
            some = list(seeds[first : first + chunk])
            padded = np.array(some + [some[-1]] * (chunk - len(some)), np.int32)
            memory = jax.device_get(many(episodes.lane_map, padded)._replace(driver=None))
            count = len(some)
            parts.append(_samples(jax.tree.map(lambda x, n=count: x[:n], memory), np.array(some)))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _samples(memory: _Memory, seeds: NDArray[Any]) -> Samples:
    """Moments `[S]` of worlds `[B, D, E]` with known next eight seconds."""
    pose, active = memory.pose, memory.active
    count = pose.shape[1] - POSES
    now = pose[:, :count, :, None]
    later = np.stack([pose[:, k : k + count] for k in range(1, POSES + 1)], 3)  # [B D E 16 3]
    known = np.stack([active[:, k : k + count] for k in range(POSES + 1)], -1).all(-1)
    origin = now[..., 0], now[..., 1], now[..., 2]
    future = np.asarray(in_frame(origin, *(later[..., k] for k in range(3))))
    seed = np.broadcast_to(seeds[:, None, None], known.shape)
    return Samples(
        features=jax.tree.map(lambda x: x[:, :count][known], memory.features),
        future=future[known].astype(np.float32),
        seed=seed[known].astype(np.int32),
    )


def errors(forecast: Any, future: Any) -> Errors:
    """Errors of forecast poses against driven ones, both `[S, 16, 3]`."""
    off = np.asarray(forecast) - np.asarray(future)
    off[..., 2] = np.remainder(off[..., 2] + np.pi, 2 * np.pi) - np.pi
    apart = np.hypot(off[..., 0], off[..., 1])
    return Errors(float(np.abs(off).mean()), float(apart.mean()), float(apart[:, -1].mean()))


def fit(
    samples: Samples,
    *,
    hidden: int = 128,
    epochs: int = 60,
    batch: int = 256,
    rate: float = 1e-3,
    seed: int = 0,
    tell: Callable[[str], None] | None = None,
) -> Any:
    """Weights of `Offset` with the least L1 error on the samples.

    Adam with cosine decay of the learning rate.

    Raises:
      ValueError: there are no samples.
    """
    import optax

    model, count = Offset(hidden), len(samples.future)
    if count < 1:
        raise ValueError("no samples to learn from: no ego drove for eight seconds")
    batch = min(batch, count)
    steps = epochs * (count // batch)
    key = jax.random.key(seed)
    first = jax.tree.map(lambda x: x[:1], samples.features)
    weights = model.init(key, first)["params"]
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps))
    size = jnp.array([1.0, 1.0, 10.0])[None, None]

    def loss(weights: Any, some: Samples, key: jax.Array) -> Array:
        poses = model.apply({"params": weights}, some.features, train=True, rngs={"dropout": key})
        assert isinstance(poses, jax.Array)
        return jnp.mean(jnp.abs(poses - some.future) * size)

    @jax.jit
    def step(weights: Any, state: Any, some: Samples, key: jax.Array) -> tuple[Any, Any, Array]:
        value, slope = jax.value_and_grad(loss)(weights, some, key)
        with jax.numpy_dtype_promotion("standard"):  # Optax relies on it
            change, state = optimiser.update(slope, state)
        return optax.apply_updates(weights, change), state, value

    state, rng = optimiser.init(weights), np.random.default_rng(seed)
    for epoch in range(epochs):
        order, total = rng.permutation(count), 0.0
        for k in range(count // batch):
            some = jax.tree.map(lambda x, i=order[k * batch : (k + 1) * batch]: x[i], samples)
            now = jax.random.fold_in(key, epoch * count + k)
            weights, state, value = step(weights, state, some, now)
            total += float(value)
        if tell is not None and (epoch + 1) % 10 == 0:
            tell(f"epoch {epoch + 1} of {epochs}: L1 {total / (count // batch):.4f}")
    return jax.device_get(weights)


def train(
    out: str | Path,
    *,
    experiments: Sequence[str] = SCENARIOS,
    policy: str = "like_traffic",
    seeds: int = 48,
    held_out: int = 16,
    hidden: int = 128,
    epochs: int = 60,
    chunk: int = 16,
    tell: Callable[[str], None] | None = None,
) -> Report:
    """Train PDM-Hybrid's network on rollouts and write its weights.

    Args:
      out: file of the weights, for `PDMHybrid(weights=...)`.
      experiments: files or bundled names; their decisions are 0.5 s apart.
      policy: name of the policy that drives in them.
      seeds: training worlds of each, from `FIRST_SEED` on.
      held_out: held-out worlds of each, the seeds after those.
      hidden: width of the layers; 512 in the paper.
      epochs: passes through the samples.
      chunk: worlds that run at once.
      tell: takes lines of progress.

    Raises:
      ExperimentError, ValueError: in one line, before anything is trained.
    """
    if seeds < 1 or held_out < 1:
        raise ValueError(f"{seeds} seeds to learn from and {held_out} held out; expected at least 1 of each")
    tell = tell or (lambda line: None)
    parts: list[Samples] = []
    for name in experiments:
        worlds = range(FIRST_SEED, FIRST_SEED + seeds + held_out)
        parts.append(record(name, worlds, policy=policy, chunk=chunk))
        tell(f"{name}: {len(parts[-1].future)} moments")
    samples = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    learns = samples.seed < FIRST_SEED + seeds
    if not learns.any() or learns.all():
        raise ValueError("too few moments: in some seeds an ego has to drive for more than eight seconds")
    seen, unseen = (jax.tree.map(lambda x, which=which: x[which], samples) for which in (learns, ~learns))
    weights = fit(seen, hidden=hidden, epochs=epochs, tell=tell)
    save_weights(out, weights)
    after = Offset(hidden).apply({"params": load_weights(str(out))}, unseen.features)
    return Report(
        samples=len(seen.future),
        held_out=len(unseen.future),
        before=errors(unseen.features.plan, unseen.future),
        after=errors(after, unseen.future),
    )
