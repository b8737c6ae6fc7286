"""Training of the end-to-end driver: cloning an expert, then DAgger (Ross, Gordon, Bagnell, AISTATS 2011).

At first the expert drives, from disturbed places, so that its labels show how to get back. In each round of
DAgger the student drives most of the time, and the expert labels the states that the student gets into. The
time is shared out beforehand; within it training goes on for as long as there is time.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

import limsim_jax
from limsim_jax.policies.end_to_end.network import (
    RULES,
    WHOLE,
    Design,
    Network,
    Outputs,
    Trained,
    fresh_weights,
    parameters,
    save_weights,
    two_hot,
)
from limsim_jax.sweeps.episode import source_hash
from limsim_jax.training.collect import Field, Labels, Sample
from limsim_jax.training.hybrid import SCENARIOS

FIRST_SEED = 2_000_000
"""First seed of training; sweeps start at 0, so that no result is of a world seen in training."""

HELD_OUT = 11
"""Of eleven segments one is held out, with all its worlds: with five scenarios, each in its turn."""

KEPT = 60_000
"""Samples that are kept at most, 1.4 GB; of more, old ones are replaced at random."""

BATCH = 256
"""Samples per step."""

RATE, DECAY, CLIP = 1.5e-3, 1e-4, 1.0
"""Of AdamW: largest learning rate, weight decay, largest norm of a gradient. Chosen by the loss."""

SPEED_LOST = 0.3
"""Share of the samples without the own speed: or the network learns to stay because it stands."""

LEAD = 0.3
"""Share of the segments that the expert drives in a round of DAgger."""

WEIGHTS = {"path": 1.0, "speed": 1.0, "waypoints": 0.3, "density": 0.5, "rules": 0.2}
"""What parts of the loss count."""

_SHARES = {"clone": 0.45, "round": 0.55}  # of the time that is left after compiling
_COLLECTS = 0.35  # share of a phase in which samples are collected
_LOOK_EVERY, _LOOK_AT = 100, 1024  # steps, and held-out samples that are looked at


class Losses(NamedTuple):
    """Parts of the loss of a batch."""

    path: Float[Array, ""]  # m, smooth L1 over the points that the plan reaches
    speed: Float[Array, ""]  # nats, cross-entropy of the classes
    waypoints: Float[Array, ""]  # m
    density: Float[Array, ""]  # nats of objects, and their numbers
    rules: Float[Array, ""]  # nats

    def total(self, design: Design) -> Float[Array, ""]:
        """The sum that training makes least."""
        parts = dict(self._asdict())
        for name in ("path", "speed") if design.waypoints else ("waypoints",):
            parts.pop(name)
        return jnp.sum(jnp.stack([WEIGHTS[name] * part for name, part in parts.items()]))


def losses(said: Outputs, labels: Labels) -> Losses:
    """What a network says against labels `[S, ...]`."""
    known = labels.known.astype(jnp.float32)
    path = jnp.sum(_smooth(said.path - labels.path) * known) / jnp.maximum(jnp.sum(known), 1.0)
    speed = -jnp.mean(jnp.sum(two_hot(labels.change) * jax.nn.log_softmax(said.speed, -1), -1))
    near = jnp.asarray(1 / (1 + 0.3 * np.arange(labels.waypoints.shape[-2])), jnp.float32)
    off = _smooth(said.waypoints - labels.waypoints).sum(-1)
    there, logit = labels.density[..., 0], said.density[..., 0]
    # cells with and without an object count half each, and sure ones little (Lin et al., ICCV 2017)
    chance = jax.nn.sigmoid(jnp.where(there > 0, logit, -logit))
    nats = -jnp.square(1 - chance) * jax.nn.log_sigmoid(jnp.where(there > 0, logit, -logit))
    count, rest = jnp.maximum(jnp.sum(there), 1.0), jnp.maximum(jnp.sum(1 - there), 1.0)
    objects = jnp.sum(nats * there) / count + 8 * jnp.sum(nats * (1 - there)) / rest
    numbers = jnp.abs(said.density[..., 1:] - labels.density[..., 1:]).sum(-1)
    rules = _bernoulli(said.rules, labels.rules)
    return Losses(
        path=path,
        speed=speed,
        waypoints=jnp.mean(off * near[None]),
        density=objects + jnp.sum(numbers * there) / count,
        rules=jnp.mean(rules),
    )


def _smooth(x: Array) -> Array:
    """Smooth L1: quadratic below 0.25."""
    size = jnp.abs(x)
    return jnp.where(size < 0.25, 2 * size * size, size - 0.125)


def _bernoulli(logit: Array, truth: Array) -> Array:
    return -jax.nn.log_sigmoid(jnp.where(truth, logit, -logit))


# --- samples -----------------------------------------------------------------------------------------


class Store:
    """Samples on the host: those to learn from, and held-out ones."""

    def __init__(self, most: int = KEPT, seed: int = 0) -> None:
        self.most, self.rng = most, np.random.default_rng(seed)
        self.parts: dict[bool, list[Sample]] = {False: [], True: []}
        self.counts: dict[str, int] = {}
        self._joined: dict[bool, Sample] = {}
        self._added = 0

    def add(self, scenario: str, samples: Sample) -> None:
        """Keep samples `[S, ...]`; some are held out, whole segments of them."""
        count = len(samples.good)
        if not count:
            return
        held = self._added % HELD_OUT == 1
        self._added += 1
        self.parts[held].append(samples)
        self._joined.pop(held, None)
        self.counts[scenario] = self.counts.get(scenario, 0) + count

    def samples(self, held: bool = False) -> Sample:
        """All samples of a kind, at most `most`."""
        if held not in self._joined:
            joined = jax.tree.map(lambda *x: np.concatenate(x), *self.parts[held])
            most = self.most if not held else self.most // 10
            if len(joined.good) > most:
                keep = np.sort(self.rng.choice(len(joined.good), most, replace=False))
                joined = jax.tree.map(lambda x: x[keep], joined)
            self.parts[held] = [joined]
            self._joined[held] = joined
        return self._joined[held]

    def __len__(self) -> int:
        return sum(len(part.good) for part in self.parts[False])


def importance(labels: Labels, ego: Float[np.ndarray, "S 9"]) -> Float[np.ndarray, " S"]:
    """How often each sample is drawn: braking, setting off and red lights are rare and matter."""
    stands = ego[:, 0] * 20 < 0.5
    change = np.asarray(labels.change)
    red = np.asarray(labels.rules)[:, RULES.index("red light")]
    aside = np.abs(np.asarray(labels.path)[:, -1]) > 1.0
    return 1.0 + 2.0 * (np.abs(change) > 1.0) + 3.0 * (stands & (change > 0.3)) + 2.0 * red + 4.0 * aside


# --- training ----------------------------------------------------------------------------------------


class Learner:
    """Weights, their optimiser, and the best weights so far.

    The best ones have the least loss on held-out samples.
    """

    def __init__(self, design: Design, seed: int = 0) -> None:
        import optax

        self.design, self.rng = design, np.random.default_rng(seed)
        self.mesh = Mesh(np.array(jax.local_devices()), ("batch",))
        self._apart = NamedSharding(self.mesh, PartitionSpec("batch"))
        network, everywhere = Network(design), NamedSharding(self.mesh, PartitionSpec())
        self.optimiser = optax.chain(
            optax.clip_by_global_norm(CLIP), optax.scale_by_adam(), optax.add_decayed_weights(DECAY)
        )
        self.weights = jax.device_put(fresh_weights(design, seed), everywhere)
        self.state = jax.device_put(self.optimiser.init(self.weights), everywhere)
        self.best: tuple[float, Any] = (np.inf, jax.device_get(self.weights))

        def loss(weights: Any, some: Sample) -> tuple[Array, Losses]:
            said = network.apply({"params": weights}, some.inputs)
            assert isinstance(said, Outputs)
            parts = losses(said, some.labels)
            return parts.total(design), parts

        def step(weights: Any, state: Any, some: Sample, rate: Array) -> tuple[Any, Any, Array]:
            (value, _), slope = jax.value_and_grad(loss, has_aux=True)(weights, some)
            with jax.numpy_dtype_promotion("standard"):  # Optax relies on it
                change, state = self.optimiser.update(slope, state, weights)
            return jax.tree.map(lambda w, x: w - rate * x, weights, change), state, value

        self._step = jax.jit(step, donate_argnums=(0, 1))
        self._losses = jax.jit(loss)

    def learn(
        self, store: Store, seconds: float, clock: Callable[[], float] = time.monotonic
    ) -> Iterator[tuple[int, float, Losses]]:
        """Learn for some time, the rate falling as a cosine.

        Yields now and then: steps so far, the mean loss of them, and losses of held-out samples.
        """
        samples, began = store.samples(), clock()
        draw = np.cumsum(importance(samples.labels, np.asarray(samples.inputs.ego)))
        self.best = (np.inf, self.best[1])  # the held-out samples are others now
        batch = BATCH - BATCH % len(self.mesh.devices)
        total, steps = 0.0, 0
        while True:
            share = (clock() - began) / max(seconds, 1e-9)
            over = share >= 1 and steps > 0
            if steps and (over or steps % _LOOK_EVERY == 0):
                yield steps, total / steps, self.look(store)
            if over:
                return
            which = np.searchsorted(draw, self.rng.random(batch) * draw[-1])
            some = jax.tree.map(lambda x: x[which], samples)  # noqa: B023
            some = jax.device_put(self._without_speed(some), self._apart)
            rate = jnp.float32(
                RATE * (0.02 + 0.98 * (1 + np.cos(np.pi * min(share, 1))) / 2) * min(1, (steps + 1) / 50)
            )
            self.weights, self.state, value = self._step(self.weights, self.state, some, rate)
            total, steps = total + float(value), steps + 1

    def _without_speed(self, some: Sample) -> Sample:
        """Some samples lose the own speed and acceleration."""
        ego = np.array(some.inputs.ego)
        lost = self.rng.random(len(ego)) < SPEED_LOST
        ego[lost, :2], ego[lost, -1] = 0, 0
        return some._replace(inputs=some.inputs._replace(ego=ego))

    def look(self, store: Store) -> Losses:
        """Losses of held-out samples; weights that are the best so far are kept."""
        held = store.samples(held=True)
        many = _LOOK_AT - _LOOK_AT % len(self.mesh.devices)
        which = np.linspace(0, len(held.good) - 1, many).astype(int)
        some = jax.device_put(jax.tree.map(lambda x: x[which], held), self._apart)
        value, parts = self._losses(self.weights, some)
        if float(value) < self.best[0]:
            self.best = float(value), jax.device_get(self.weights)
        return jax.device_get(parts)


# --- the whole training ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Report:
    """Result of training.

    Attributes:
      trained: the network, and how it came about.
      stopped: whether it was interrupted.
    """

    trained: Trained
    stopped: bool

    def __str__(self) -> str:
        about = self.trained.about
        state = "stopped" if self.stopped else "finished"
        held_out = about["held_out"]
        loss = "held-out loss unknown" if held_out is None else f"held-out loss {held_out:.3f}"
        return (
            f"{state} after {about['seconds'] / 60:.1f} min: {sum(about['samples'].values()):,} samples, "
            f"{about['steps']:,} steps, {loss}"
        )


def train(
    out: str | Path,
    *,
    scenarios: Sequence[str] = SCENARIOS,
    rounds: int = 2,
    worlds: int = 32,
    minutes: float = 18.0,
    design: Design = WHOLE,
    seed: int = 0,
    tell: Callable[[str], None] | None = None,
) -> Report:
    """Train the end-to-end driver and write its weights.

    An interrupt (Ctrl-C) ends the training; the best weights so far are kept.

    Args:
      out: file of the weights, for `EndToEnd(weights=...)`.
      scenarios: files or bundled names of experiments.
      rounds: of DAgger; 0: the expert is cloned only.
      worlds: of a scenario that run at once.
      minutes: all of it together, compiling included.
      design: of the network.
      seed: of weights, order and disturbances.
      tell: takes lines of progress.

    Raises:
      ExperimentError, ValueError: in one line, before anything is compiled.
    """
    if rounds < 0:
        raise ValueError(f"{rounds} rounds; expected 0 or more")
    if worlds < 1:
        raise ValueError(f"{worlds} worlds; expected at least 1")
    if not 0 < minutes < float("inf"):
        raise ValueError(f"{minutes:g} minutes; expected more than 0")
    if not scenarios:
        raise ValueError("no scenarios; expected at least one")
    run = _Training(Path(out), tuple(scenarios), rounds, worlds, minutes * 60, design, seed, tell or _silent)
    return run.run()


def _silent(line: str) -> None:
    del line


class _Training:
    """A training in progress."""

    def __init__(
        self, out: Path, scenarios: tuple[str, ...], rounds: int, worlds: int, seconds: float, design: Design,
        seed: int, tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.out, self.rounds, self.seconds, self._tell = out, rounds, seconds, tell
        self.began = time.monotonic()
        self.fields = [Field(name, worlds, design, FIRST_SEED) for name in scenarios]
        self.learner, self.store = Learner(design, seed), Store(seed=seed)
        self.rng = np.random.default_rng(seed + 1)
        self.curve: list[dict[str, Any]] = []
        self.steps = 0
        self._turns = [0] * len(scenarios)

    @property
    def elapsed(self) -> float:
        """s."""
        return time.monotonic() - self.began

    def tell(self, line: str) -> None:
        """A line of progress."""
        self._tell(f"{self.elapsed / 60:5.1f} min  {line}")

    def run(self) -> Report:
        """All of it."""
        stopped = False
        try:
            self._compile()
            left = self.seconds - self.elapsed
            self._phase("cloning", 1.0, left * (_SHARES["clone"] if self.rounds else 1.0))
            for k in range(self.rounds):
                each = (self.seconds - self.elapsed) / (self.rounds - k)
                self._phase(f"round {k + 1} of {self.rounds}", LEAD, each)
        except KeyboardInterrupt:
            stopped = True
            self.tell("interrupted; the best weights so far are kept")
        report = Report(self._trained(), stopped)
        save_weights(self.out, report.trained)
        return report

    def _compile(self) -> None:
        """All programs, two at a time."""
        count = parameters(self.learner.weights)
        self.tell(f"compiling {len(self.fields)} scenarios; the network has {count:,} parameters")
        weights = self.learner.best[1]

        def one(field: Field) -> None:
            field.compile(weights)
            self.tell(f"{field.scenario}: compiled")

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(one, self.fields))

    def _phase(self, name: str, lead: float, seconds: float) -> None:
        """Collect, then learn, within some time."""
        began = self.elapsed
        while self.elapsed - began < seconds * _COLLECTS or not self._enough():
            field = self._next()
            weights = self.learner.best[1]
            self.store.add(field.scenario, field.segment(weights, lead, self.rng))
        told = ", ".join(f"{name} {count:,}" for name, count in self.store.counts.items())
        self.tell(f"{name}: samples so far: {told}")
        left, before = max(began + seconds - self.elapsed, 0.0), self.steps
        shown = self.elapsed
        for steps, value, held in self.learner.learn(self.store, left):
            self.steps = before + steps
            parts = {part: round(float(x), 4) for part, x in held._asdict().items()}
            self.curve.append({"s": round(self.elapsed), "phase": name, "loss": round(value, 4)} | parts)
            if self.elapsed - shown > 20 or self.elapsed - began >= seconds:
                shown = self.elapsed
                rest = ", ".join(f"{part} {x:.3f}" for part, x in parts.items())
                self.tell(f"{name}: step {self.steps}, loss {value:.3f}; held out: {rest}")
        save_weights(self.out, self._trained())

    def _next(self) -> Field:
        """The scenario whose turn it is: long ones more often, by the root of their length."""
        turns = [n / field.segments**0.5 for n, field in zip(self._turns, self.fields, strict=True)]
        k = int(np.argmin(turns))
        self._turns[k] += 1
        return self.fields[k]

    def _enough(self) -> bool:
        """Whether there are samples of every scenario, held-out ones among them."""
        return bool(self.store.parts[True]) and len(self.store.counts) == len(self.fields)

    def _trained(self) -> Trained:
        """The best weights so far."""
        held, weights = self.learner.best
        seeds = {f.scenario: [FIRST_SEED, f.next_seed - 1] for f in self.fields}
        about = {
            "version": limsim_jax.__version__,
            "source": source_hash(),
            "jax": jax.__version__,
            "device": f"{jax.local_device_count()} x {jax.local_devices()[0].device_kind}",
            "seconds": round(self.elapsed, 1),
            "minutes": self.seconds / 60,
            "rounds": self.rounds,
            "seeds": seeds,
            "samples": dict(self.store.counts),
            "steps": self.steps,
            "parameters": parameters(weights),
            "held_out": round(held, 4) if np.isfinite(held) else None,
            "curve": self.curve[:: max(1, len(self.curve) // 40)],
        }
        return Trained(self.learner.design, weights, json.loads(json.dumps(about)))
