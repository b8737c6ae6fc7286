"""Egos in SUMO's traffic as episodes of a sweep: a seed in, a row of metrics out."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.bridges.sumo.messages import Move, Orders, Reading, Start, SumoError
from limsim_jax.bridges.sumo.process import SumoProcess
from limsim_jax.bridges.sumo.program import NOWHERE, Pushed, Seen, SharedWorld
from limsim_jax.bridges.sumo.seats import Places, Seats, angle_of, class_of
from limsim_jax.bridges.sumo.ways import Lights, Ways
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.map import Map
from limsim_jax.maps.sumo.classes import ENGINE_CLASS
from limsim_jax.metrics.catalog import TOTALS
from limsim_jax.metrics.measure import Metric
from limsim_jax.metrics.observer import EvaluateEgo, EvaluateEgos
from limsim_jax.metrics.reductions import on_host
from limsim_jax.policies.base import PolicyLike, views, with_scenery
from limsim_jax.simulation.rollout import world_key
from limsim_jax.simulation.trace import Trace
from limsim_jax.sweeps.build import map_of, policy_of, traffic_of, with_view
from limsim_jax.sweeps.episode import digests, provenance_of, succeeds
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile
from limsim_jax.sweeps.identity import is_foreign, policy_code
from limsim_jax.sweeps.moments import key_moments
from limsim_jax.sweeps.reruns import Replay
from limsim_jax.sweeps.store import Outcome
from limsim_jax.xla import enable_compilation_cache, run_often, run_once

WAYS = 3
"""Columns of the route table per slot of all worlds: routes of vehicles that are there, and of the last."""

LEAST_TRIP = 150.0
"""m that an ego that is drawn has to go at least."""

AFTERWARDS = 2.0
"""s that a world goes on without its egos."""

UNITS = {
    "sumo_collisions": "vehicles that collided with the ego, as SUMO says",
    "sumo_collision_time": "s, when SUMO first reported a collision of the ego",
    "sumo_echo": "m, largest distance between the ego's place and the one that SUMO reported",
    "sumo_lost": "most vehicles of SUMO at a time without a slot of the world",
    "sumo_elsewhere": "most vehicles of SUMO at a time on lanes that the map has not",
    "sumo_pathless": "vehicles of SUMO whose route cannot be driven on the map",
}
"""Columns that the bridge adds to those of every sweep."""


@dataclass(frozen=True, kw_only=True)
class Takeover:
    """Which vehicles of SUMO become egos, and when.

    Attributes:
      vehicles: ids; each is taken over once all are on the road. None: the first ones that are inserted
        after a moment that the seed draws.
      count: how many, where they are drawn.
      earliest, latest: s after the begin of the simulation; bounds of that moment.
      everyone: we take over the other vehicles as well, from that moment or their insertion on.
    """

    vehicles: tuple[str, ...] = ()
    count: int = 1
    earliest: float = 60.0
    latest: float = 180.0
    everyone: bool = False

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"takeover: {self.count} egos; at least 1 is expected")
        if not 0 <= self.earliest <= self.latest:
            raise ValueError(f"takeover: {self.earliest:g} to {self.latest:g} s is no interval")

    @property
    def egos(self) -> int:
        """Number of egos."""
        return len(self.vehicles) or self.count


class SumoEpisodes:
    """Runs a `.sumocfg` with our planner in it.

    A few worlds run at a time, each with a SUMO of its own.

    Args:
      experiment: of `world.experiment_of`; its demand is the `.sumocfg`.
      config: the `.sumocfg`.
      takeover: which vehicles are egos.
      chunk: worlds at the same time; by default one per core, 2 to 8.
      policy: drives the egos; None: the one that the experiment names.
      name: of the policy in results; None: that of the experiment.
      metrics: own metrics beside the built-in ones.
      gui: show SUMO's window; for one world at a time.

    Raises:
      ExperimentError: the experiment does not fit its map or names something that is not there.
      SumoError: SUMO is missing, does not start, or runs another network.
    """

    def __init__(
        self,
        experiment: ExperimentFile,
        config: Path,
        takeover: Takeover,
        *,
        chunk: int | None = None,
        policy: PolicyLike | None = None,
        name: str | None = None,
        metrics: Sequence[Metric] = (),
        gui: bool = False,
    ) -> None:
        self.experiment, self.config, self.takeover = experiment, Path(config), takeover
        self.scenario = experiment.name
        self.policy = experiment.policy if name is None else name
        self.gui = gui
        self.chunk = max(2, min(os.cpu_count() or 1, 8)) if chunk is None else chunk
        self._values = {"policy": policy, "metrics": tuple(metrics)}
        self._policy = policy_of(experiment) if policy is None else with_view(experiment.ego[0], policy)
        self.egos = takeover.egos
        if experiment.slots <= self.egos:
            self._refuse("slots", f"{experiment.slots}, but there are {self.egos} egos and their traffic")
        if experiment.traffic.human is not None:
            self._refuse("traffic.human", "the traffic belongs to SUMO")
        if getattr(self._policy, "others", 0):
            self._refuse("policy", "it drives other vehicles as well; those belong to SUMO")
        self._town: Map = map_of(experiment)
        own = tuple(metrics)
        try:
            self._measure = (
                EvaluateEgo(metrics=own) if self.egos == 1 else EvaluateEgos(count=self.egos, metrics=own)
            )
        except ValueError as error:
            self._refuse("metrics", str(error))
        self.units = self._units()
        self.program = SharedWorld(
            experiment.dt, experiment.decision_every, traffic_of(experiment), self._policy, self._measure,
            self.egos,
        )  # fmt: skip
        try:
            for view in views(self._policy):
                view.late(self.program.planning)
        except ValueError as error:
            self._refuse("ego.view", str(error))
        self._code = policy_code(self._policy) if is_foreign(self._policy) else None
        self._ways = Ways(self._town.network, self._town.lanes, WAYS * experiment.slots * self.chunk + 1)
        self._lights: Lights | None = None
        self._places: Places | None = None
        self._map = with_scenery(self._policy, self._town)
        self.seconds: dict[str, list[float]] = {"decide": [], "drive": []}
        """s per world that ticks took: those with a decision of the policy, and those without."""

    def _refuse(self, field: str, message: str) -> NoReturn:
        raise ExperimentError(f"{self.experiment.name}: {field}: {message}")

    def _units(self) -> dict[str, str]:
        units = dict(self._measure.units)
        if self.experiment.success and "success" not in units:
            units = {"success": "1 if the criteria of the experiment are met"} | units
        return units | {total.name: total.meaning for total in TOTALS} | UNITS

    @property
    def town(self) -> Map:
        """The map, with routes and lights that SUMO has shown."""
        shown = replace(self._town)
        shown.__dict__["lanes"] = self.lane_map
        return shown

    @property
    def lights(self) -> list[str]:
        """Ids of SUMO's lights, in its order; empty before the first run."""
        return [] if self._lights is None else self._lights.names

    @property
    def network(self) -> Any:
        """The map on the host."""
        return self._town.network

    @property
    def lane_map(self) -> LaneMap:
        """The map on the device, with lights that SUMO has shown."""
        return self._map if self._lights is None else self._lights.put_on(self._map)

    def provenance(self) -> dict[str, Any]:
        """Where the rows come from."""
        takeover = self.takeover
        with self._process(0) as sumo:
            version = sumo.there.version
        return provenance_of(
            self.experiment, self._town.network, self._policy, self._values, self.chunk, self._code
        ) | {
            "devices": 1,
            "engine": {
                "name": "sumo", "version": version, "config": str(self.config.resolve()),
                "vehicles": list(takeover.vehicles), "count": takeover.count,
                "earliest": takeover.earliest, "latest": takeover.latest,
                "everyone": takeover.everyone, "bridge": _bridge_hash(),
            }
        }  # fmt: skip

    def compile(self) -> None:
        """The first chunk compiles."""

    # --- runs

    def run(self, seeds: Sequence[int]) -> Outcome:
        """Run at most `chunk` worlds."""
        if len(seeds) > self.chunk:
            raise ValueError(f"{len(seeds)} seeds at once; at most {self.chunk}")
        found = self._run(seeds, keep=False)
        rows = np.repeat(np.asarray(seeds, np.int64), self.egos)
        numbers = np.tile(np.arange(self.egos, dtype=np.int32), len(seeds))
        return Outcome(
            seeds=rows, egos=numbers, metrics=found.metrics,
            moments=key_moments(rows, numbers, found.metrics),
            digest=digests(found.metrics, self._named(found.state), self.egos),
        )  # fmt: skip

    def _named(self, state: Any) -> Any:
        """Final states without columns of routes: those depend on the other worlds of the call."""
        columns, where = np.unique(np.asarray(state.goal), return_inverse=True)
        routes = [crc32(" ".join(self._ways.edges(int(k))).encode()) for k in columns]
        goal = np.asarray(routes, np.int64)[where].reshape(state.goal.shape)
        return replace(state, goal=np.where(state.active, goal, 0))

    def replay(self, seed: int, ego: int = 0, *, explain: bool = True) -> Replay:
        """Run one world again and keep every step."""
        return self.replays([(seed, ego)], explain=explain)[0]

    def replays(
        self, which: Sequence[tuple[int, int]], *, explain: bool = True, brief: bool = False
    ) -> list[Replay]:
        """Run worlds again, SUMO with the same seeds, and keep every step.

        `explain` and `brief` change nothing: what else could have been done is not asked of SUMO, and worlds
        end with their egos anyway."""
        del explain, brief
        found = []
        for first in range(0, len(which), self.chunk):
            some = which[first : first + self.chunk]
            ran = self._run([seed for seed, _ in some], keep=True)
            for k, (seed, ego) in enumerate(some):
                row = k * self.egos + ego
                values = {name: x[row : row + 1] for name, x in ran.metrics.items()}
                moments = key_moments(np.asarray([seed], np.int64), np.asarray([ego], np.int32), values)
                table = {name: column.tolist() for name, column in moments.items()}
                rows = [dict(zip(table, x, strict=True)) for x in zip(*table.values(), strict=True)]
                plain = {name: float(x[0]) for name, x in values.items()}
                found.append(Replay(self.network, self.lane_map, ran.traces[k], ego, rows, plain))
        return found

    def _process(self, seed: int) -> SumoProcess:
        arguments = ("-c", str(self.config))
        return SumoProcess(Start(arguments=arguments, seed=seed, dt=self.experiment.dt, gui=self.gui))

    def _run(self, seeds: Sequence[int], *, keep: bool) -> _Ran:
        with ExitStack() as stack:
            worlds = []
            for seed in seeds:
                sumo = stack.enter_context(self._process(seed))
                if self._lights is None:
                    self._places = Places(self._town.network, self._town.lanes, sumo.there)
                    self._lights = Lights(self._town.network, self._town.lanes, sumo.there.lights)
                worlds.append(self._world(sumo, seed))
                stack.callback(worlds[-1].seats.close)
            return self._drive(worlds, keep)

    def _world(self, sumo: SumoProcess, seed: int) -> _World:
        assert self._places is not None and self._lights is not None
        seats = Seats(
            self._places, self._ways, self._lights, self.experiment.slots, everyone=self.takeover.everyone
        )
        return _World(sumo, seed, seats, self)

    def _drive(self, worlds: list[_World], keep: bool) -> _Ran:
        """All worlds through time, together."""
        count, dt = len(worlds), self.experiment.dt
        pad = self.chunk - count
        seen = [world.begin() for world in worlds]
        keys = jnp.stack([jax.random.split(world_key(world.seed))[1] for world in worlds + worlds[:1] * pad])
        start, tick, finish = self._compiled
        carry = start(self._lanes(), _stacked(seen, pad))
        traces: list[Any] = []
        steps = round(self.experiment.horizon / dt)
        for step in range(steps + 1):
            now = _stacked(seen, pad)
            lanes, began = self._lanes(), time.perf_counter()
            due = step % self.experiment.decision_every == 0
            carry, trace, pushed = tick(lanes, carry, now, np.bool_(step == 0), np.bool_(due), keys)
            pushed = jax.device_get(pushed)
            if step:  # the first may compile
                self.seconds["decide" if due else "drive"].append((time.perf_counter() - began) / self.chunk)
            if step and keep:
                traces.append(jax.device_get(trace))
            if step == steps or not any(world.alive for world in worlds):
                break
            for k, world in enumerate(worlds):
                if world.alive:
                    world.push(jax.tree.map(lambda x: x[k], pushed))  # noqa: B023
            seen = [world.see() for world in worlds]
        measures = on_host(jax.device_get(finish(self._lanes(), carry)))
        return self._ran(worlds, measures, jax.device_get((carry.state, carry.totals)), traces)

    @cached_property
    def _compiled(self) -> tuple[Any, Any, Any]:
        enable_compilation_cache()
        program, once = self.program, run_once()
        return (
            jax.jit(jax.vmap(program.start, (None, 0)), compiler_options=once),
            jax.jit(jax.vmap(program.tick, (None, 0, 0, None, None, 0)), compiler_options=run_often()),
            jax.jit(jax.vmap(program.result, (None, 0)), compiler_options=once),
        )

    def _lanes(self) -> LaneMap:
        """The map with the routes and phases that are known by now."""
        assert self._lights is not None
        if self._ways.changed:
            self._map = replace(self._map, routes=self._ways.table())
            self._lit = self._lights.put_on(self._map)
        elif self._lights.changed:
            self._lit = self._lights.put_on(self._map)
        return self._lit

    def _ran(self, worlds: list[_World], measures: Any, after: Any, traces: list[Any]) -> _Ran:
        count, each = len(worlds), self.egos
        state, totals = jax.tree.map(lambda x: x[:count], after)
        found = {name: np.asarray(x)[:count].astype(float) for name, x in measures.items()}
        for column in TOTALS:
            found[column.name] = np.asarray(getattr(totals, column.name.removeprefix("traffic_")), float)
        found["traffic_waiting"] = np.array([world.reading.pending for world in worlds], float)
        metrics = {name: x.ravel() if x.ndim == 2 else np.repeat(x, each) for name, x in found.items()}
        of_egos = [world.columns(k) for world in worlds for k in range(each)]
        metrics |= {name: np.array([row[name] for row in of_egos]) for name in UNITS}
        if self.experiment.success:
            sound = metrics["policy_failed"] == 0
            metrics["success"] = succeeds(metrics, self.experiment.success) * sound
        lengths = [world.steps for world in worlds]
        kept = [
            jax.tree.map(lambda *x: np.stack([one[k] for one in x]), *traces[: max(lengths[k], 1)])  # noqa: B023
            for k in range(count)
            if traces
        ]
        return _Ran({name: metrics[name] for name in self.units}, state, kept)


@dataclass(frozen=True)
class _Ran:
    metrics: dict[str, NDArray[np.float64]]  # [W E]
    state: Any  # [W ...]
    traces: list[Trace]


class _World:
    """One world of a call: its SUMO, its seats, and what the bridge counts."""

    def __init__(self, sumo: SumoProcess, seed: int, seats: Seats, episodes: SumoEpisodes) -> None:
        self.sumo, self.seed, self.seats, self._of = sumo, seed, seats, episodes
        self.alive = True
        self.steps = 0
        self.reading: Reading
        self._orders: dict[str, Any] = {}
        self._pushed: Pushed | None = None
        self._last: Seen
        self._over: float | None = None
        egos = episodes.takeover.egos
        self._met: list[dict[int, float]] = [{} for _ in range(egos)]  # by handle, s
        self._echo = np.zeros(egos)
        self._gone = np.zeros(egos, bool)
        self._ours: set[int] = set()  # vehicles that SUMO knows to be ours

    def begin(self) -> Seen:
        """Run SUMO until the egos are there, and take them over."""
        takeover, begin = self._of.takeover, self.sumo.there.time
        rng = np.random.default_rng([self.seed, 0x5010])
        at = begin + rng.uniform(takeover.earliest, takeover.latest)
        candidates: list[int] = []
        while True:
            self.reading = self.sumo.step(Orders())
            self.seats.meet(self.reading)
            there = set(self.reading.handle.tolist())
            candidates = [h for h in candidates if h in there]
            named = {one.id: one.handle for one in self.seats.known.values()}
            if takeover.vehicles:
                candidates = [named[x] for x in takeover.vehicles if x in named]
            elif self.reading.time >= at:
                candidates += [one.handle for one in self.reading.new if self._fits(one.handle)]
            if len(candidates) >= takeover.egos:
                break
            if not self.reading.expected:
                what = (
                    f"vehicle '{next(x for x in takeover.vehicles if x not in named)}' is never on the road"
                    if takeover.vehicles
                    else f"no vehicle that could be the ego is inserted after {at - begin:.0f} s"
                )
                raise SumoError(f"{self._of.config}: {what} (seed {self.seed})")
        egos = tuple(candidates[: takeover.egos])
        self._last = self.seats.start(self.reading, egos)
        for handle in egos:
            if self.seats.column[handle] == 0:
                one = self.seats.known[handle]
                raise SumoError(f"{self._of.config}: the route of '{one.id}' cannot be driven on the map")
        self._own()
        return self._last

    def _own(self) -> None:
        """Take over and hand back: with the next orders."""
        there = set(self.reading.handle.tolist())
        ours = set(self.seats.egos)
        if self._of.takeover.everyone:
            ours |= {h for h in self.seats.slot if self.seats.column[h] != NOWHERE}
        take, release = sorted((ours - self._ours) & there), sorted((self._ours - ours) & there)
        self._orders, self._ours = {"take": tuple(take), "release": tuple(release)}, ours & there

    def _fits(self, handle: int) -> bool:
        """Whether a vehicle can be an ego: a car with some way to go."""
        one = self.seats.known[handle]
        k = self.reading.handle.tolist().index(handle)
        places = self.seats.places.on(self.reading.lane[[k]], self.reading.s[[k]])
        row, s = int(places[0][0]), float(places[1][0])
        if row < 0 or ENGINE_CLASS.get(one.kind) != "car" or not one.edges:
            return False
        ways = self.seats.ways
        column = ways.take(one.edges, class_of(one))
        fits = ways.reaches(row, column) and ways.to_go(row, column) - s >= LEAST_TRIP
        ways.give_back(column)
        return bool(fits)

    def push(self, pushed: Pushed) -> None:
        """Tell SUMO where our vehicles will be; it begins its step."""
        x0, y0 = self.seats.places.origin
        moves, remove = {}, []
        for handle in sorted(self._ours, key=self.seats.slot.__getitem__):
            k = self.seats.slot[handle]
            ego = k < len(self._gone)
            if ego and self._gone[k]:
                continue
            if not pushed.active[k]:
                remove.append(handle)
                if ego:
                    self._gone[k] = True
                continue
            ghost = pushed.ghost[k].astype(float)
            moves[handle] = Move(
                x=float(pushed.x[k]) + x0,
                y=float(pushed.y[k]) + y0,
                angle=float(angle_of(pushed.heading[k])),
                v=float(pushed.v[k]),
                a=float(pushed.a[k]),
                edges=self.seats.ways.edges(int(pushed.goal[k])),
                ghost=None
                if np.isnan(ghost[0])
                else (ghost[0] + x0, ghost[1] + y0, float(angle_of(ghost[2]))),
            )
        self._pushed = pushed
        self.sumo.ask(Orders(move=moves, remove=tuple(remove), **self._orders))

    def see(self) -> Seen:
        """What SUMO says after its step."""
        if not self.alive:
            return self._last
        self.reading = self.sumo.answer()
        self.steps += 1
        self.seats.meet(self.reading)
        self._compare()
        if self._gone.all() and self._over is None:
            self._over = self.reading.time + AFTERWARDS
        over = self._over is not None and self.reading.time >= self._over
        seen = self.seats.see(self.reading)
        self._own()
        # a world that is over settles this moment, and no other
        self._last = replace(seen, alive=np.bool_(False))
        self.alive = not over
        return seen

    def _compare(self) -> None:
        """Our egos with what SUMO says of them."""
        index = {h: k for k, h in enumerate(self.reading.handle.tolist())}
        x0, y0 = self.seats.places.origin
        for i, handle in enumerate(self.seats.egos):
            if handle in self.reading.gone:
                self._gone[i] = True
            if handle in index and not self._gone[i] and self._pushed is not None:
                k = index[handle]
                away = np.hypot(
                    self.reading.x[k] - x0 - self._pushed.x[i], self.reading.y[k] - y0 - self._pushed.y[i]
                )
                self._echo[i] = max(self._echo[i], away)
            for pair in self.reading.collisions:
                if handle in pair:
                    other = pair[0] if pair[1] == handle else pair[1]
                    self._met[i].setdefault(other, self.steps * self._of.experiment.dt)

    def columns(self, ego: int) -> dict[str, float]:
        """What the bridge adds to the row of an ego."""
        met = self._met[ego]
        return {
            "sumo_collisions": len(met),
            "sumo_collision_time": min(met.values()) if met else np.nan,
            "sumo_echo": self._echo[ego],
            "sumo_lost": self.seats.lost,
            "sumo_elsewhere": self.seats.elsewhere,
            "sumo_pathless": self.seats.pathless,
        }


def _stacked(seen: list[Seen], pad: int) -> Seen:
    """Worlds as a batch; rows without a world do not go on."""
    idle = [replace(seen[0], alive=np.bool_(False))] * pad
    return jax.tree.map(lambda *x: np.stack(x), *seen, *idle)


def _bridge_hash() -> str:
    """Of the code of the bridge."""
    hashed = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        hashed.update(path.name.encode() + b"\0" + path.read_bytes())
    return hashed.hexdigest()[:16]


__all__ = ["UNITS", "SumoEpisodes", "Takeover"]
