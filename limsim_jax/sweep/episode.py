"""An experiment as episodes: a seed in, a row of metrics out; thousands of them at once."""

from __future__ import annotations

import hashlib
import importlib
import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import limsim_jax
from limsim_jax.maps import build_lane_map, bundled_maps, read_network
from limsim_jax.maps.lane_map import LaneMap, lane_rows
from limsim_jax.maps.network import MapError, Network
from limsim_jax.maps.origins import origins
from limsim_jax.maps.routing import default_goals
from limsim_jax.maps.xml import file_hash
from limsim_jax.metrics.blame import Responsibility
from limsim_jax.metrics.catalog import TOTALS, catalog
from limsim_jax.metrics.observer import EvaluateEgo
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.safety import NEAR_MISS, Rss
from limsim_jax.policies import POLICIES
from limsim_jax.policies.base import PolicyLike, build_policy, variants
from limsim_jax.policies.predict import Replayed, constant_velocity
from limsim_jax.simulation.rollout import Carry, Result, Rollout, Started, started
from limsim_jax.simulation.totals import Totals
from limsim_jax.simulation.trace import Trace, trace
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.sweep.experiment import Bounds, EgoTable, ExperimentError, ExperimentFile
from limsim_jax.sweep.store import Outcome
from limsim_jax.traffic import car_following
from limsim_jax.traffic.demand import Demand, EgoStart, Flow, build_demand, sample_scenario
from limsim_jax.traffic.engine import Command, Traffic
from limsim_jax.traffic.population_file import read_population
from limsim_jax.traffic.vehicles import (
    URBAN,
    default_population,
    restrict_to_map,
    sample_vehicles,
    uniform_population,
)
from limsim_jax.types import Config, Scenario, State
from limsim_jax.xla import enable_compilation_cache, run_once

HARD = 3.4
"""m/s^2 of braking asked for by the leader (DRAC) from which it is a key moment."""

UNSAFE = 4.0
"""s before a contact at which somebody may have begun to brake, at most."""

LEAD_UP = 1.0
"""s around a contact within which near misses and hard braking belong to it."""

SCORE_DROP = 50.0
"""LimSim's score of a second below which it is a key moment."""

MOMENTS = ("contact", "off_road", "red_light", "near_miss", "hard_brake", "unsafe", "score_drop")
"""Kinds of key moments, the worst first."""

_MODELS = {"idm": car_following.IDM, "iidm": car_following.IIDM, "acc": car_following.ACC}
_TOTALS = tuple(total.name.removeprefix("traffic_") for total in TOTALS)
_SHARE_OF_MEMORY = 0.25
_TEMPORARIES = 12  # a world needs so many times the memory of its arrays while it runs
_CHUNKS = {"cpu": 50, "gpu": 2000, "tpu": 2000}
"""Worlds per call, if memory allows: round numbers of seeds leave no chunk half empty."""


class Replay(NamedTuple):
    """One world, every step of it."""

    network: Network
    lane_map: LaneMap
    trace: Trace  # [T, ...], NumPy
    ego: int  # slot
    moments: list[dict[str, Any]]
    metrics: dict[str, float]


UNITS: dict[str, str] = {column.name: column.meaning for column in catalog()}
"""What every column means."""


class Episodes:
    """Runs an experiment, chunk by chunk; `rollout`, `lane_map` and `sample` are what it is made of.

    Args:
      experiment: what to run.
      chunk: worlds per call; by default as many as memory allows, at most 50 on CPUs and 2000 on others.

    Raises:
      ExperimentError: the experiment does not fit its map or names what is not there; one line.
    """

    def __init__(self, experiment: ExperimentFile, *, chunk: int | None = None) -> None:
        self.experiment = experiment
        self.scenario, self.policy = experiment.name, experiment.policy
        self.units = UNITS
        self._check_success()
        self._policy = _policy(experiment)
        self.network, self.lane_map, goals = _map(experiment)
        self._egos = _ego(experiment, self.network, self.lane_map, goals, self._policy.free)
        self._demand = _demand(experiment, self.network, self.lane_map, goals, self._egos)
        room = self._demand.initial + (self._egos.count if self._egos.lane is not None else 0)
        if room > experiment.slots:
            self._refuse("slots", f"{experiment.slots}, but {room} vehicles are there at the start")
        if room < 1:
            self._refuse("traffic.density", "a random start needs at least one vehicle at the start")
        config = Config(dt=experiment.dt, decision_every=experiment.decision_every)
        traffic = experiment.traffic
        behaviour = Traffic(
            model=_MODELS[traffic.model](),
            lane_changes=traffic.lane_changes,
            after_collision=traffic.after_collision,
        )
        self.rollout = Rollout(config, behaviour, experiment.horizon, self._policy, measure=EvaluateEgo())
        self.world_bytes = self._memory()
        self.chunk = self._chunk() if chunk is None else chunk
        self._worlds = Worlds(self.rollout, self.lane_map, self.sample, chunk=self.chunk)
        self.chunk = self._worlds.chunk

    def _refuse(self, field: str, message: str) -> None:
        raise ExperimentError(f"{self.experiment.name}: {field}: {message}")

    def _check_success(self) -> None:
        unknown = [name for name in self.experiment.success if name not in self.units]
        if unknown:
            self._refuse(f"success.{unknown[0]}", f"no such metric; known are {', '.join(self.units)}")

    def sample(self, key: jax.Array) -> Scenario:
        """The scenario of a world."""
        return sample_scenario(self._demand, self.lane_map, key, self.experiment.slots, self._egos)

    def _memory(self) -> int:
        """Bytes that one more world needs: its arrays at the start, and temporaries in proportion."""
        scenario = jax.eval_shape(self.sample, jax.random.key(0))
        return _TEMPORARIES * sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(scenario))

    def _chunk(self) -> int:
        device = jax.local_devices()[0]
        stats = device.memory_stats() if device.platform != "cpu" else None
        if stats and "bytes_limit" in stats:
            memory = stats["bytes_limit"] * jax.local_device_count()
        else:
            memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        most = int(_SHARE_OF_MEMORY * memory / self.world_bytes)
        most = max(1, min(most, _CHUNKS.get(device.platform, 50)))
        size = 10 ** (len(str(most)) - 1)
        return max(k * size for k in (1, 2, 5) if k * size <= most)

    def provenance(self) -> dict[str, Any]:
        """Where the rows come from."""
        device = jax.local_devices()[0]
        drivers = self.experiment.traffic.drivers
        return {
            **({"drivers": file_hash(Path(drivers).read_bytes())} if drivers is not None else {}),
            "experiment": self.experiment.model_dump(mode="json", exclude={"map"}),
            "map": {"file": os.path.basename(self.network.source), "hash": self.network.file_hash},
            "map_file": self._map_file(),
            "version": limsim_jax.__version__,
            "source": _source_hash(),
            "chunk": self.chunk,
            "platform": device.platform,
            "device": device.device_kind,
            "devices": jax.local_device_count(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "jax": jax.__version__,
            "jaxlib": importlib.import_module("jaxlib").__version__,
            "memory": {
                "bytes_per_world": self.world_bytes,
                "share_of_memory": _SHARE_OF_MEMORY,
                "bytes_per_chunk": self.world_bytes * self.chunk,
            },
        }

    def _map_file(self) -> str:
        """Where to find the map again: a bundled one by its name."""
        name = self.experiment.map
        return name if name in bundled_maps() else os.path.abspath(name)

    def compile(self) -> None:
        """Compile now; else the first chunk does."""
        self._worlds.compile()

    def run(self, seeds: Sequence[int]) -> Outcome:
        """Run at most `chunk` worlds."""
        if len(seeds) > self.chunk:
            raise ValueError(f"{len(seeds)} seeds at once; at most {self.chunk}")
        (_, result), *_ = self._worlds.chunks(seeds)
        metrics = self._columns(result.measures, result.totals)
        return Outcome(
            seeds=np.asarray(seeds, np.int64),
            metrics=metrics,
            moments=_moments(np.asarray(seeds, np.int64), metrics),
            digest=_digest(metrics, result.state),
        )

    def _columns(self, measures: Any, totals: Totals) -> dict[str, NDArray[np.float64]]:
        metrics: dict[str, NDArray[np.float64]] = dict(on_host(measures))
        metrics |= {f"traffic_{name}": np.asarray(getattr(totals, name), float) for name in _TOTALS}
        if self.experiment.success:
            metrics["success"] = _succeeds(metrics, self.experiment.success)
        return {name: metrics[name] for name in self.units}

    def replay(self, seed: int) -> Replay:
        """Run one world again and keep every step.

        After a contact the world is run twice more, in which the ego, or the other vehicle, brakes as hard as
        it can from the response time of RSS after the first unsafe moment on (at most `UNSAFE` s before the
        contact): who could have avoided it? After a contact, a place off the road or a red light that was
        run, a policy made of modules (`policies.base.variants`) drives again from that moment on (`UNSAFE` s
        before, where it is none of distance) with a reference in the place of each: which would have avoided
        it, at least for `UNSAFE` s more?
        """
        result = self._again(seed)
        metrics = self._columns(result.measures, result.totals)
        moments = _moments(np.asarray([seed], np.int64), metrics)
        columns = {name: column.tolist() for name, column in moments.items()}
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
        found = {name: float(x[0]) for name, x in metrics.items()}
        worst = rows[0]["kind"] if rows else None
        if worst in ("contact", "off_road", "red_light"):
            event, unsafe = found[f"{worst}_time"], found["rss_first_time"]
            start = max(event - UNSAFE, 0.0)
            if worst == "contact":
                start = max(start, 0.0 if np.isnan(unsafe) else min(unsafe, event))
                for who, slot in (("ego", 0), ("other", int(found["contact_other"]))):
                    changed = self._again(seed, slot, start + Rss().response)
                    measures = on_host(changed.measures)
                    same = measures["contact_other"][0] == found["contact_other"]
                    later = measures["contact_time"][0] > event + UNSAFE
                    rows[0][f"avoidable_by_{who}"] = bool(measures["contacts"][0] == 0 or not same or later)
            blamed = self._modules_to_blame(seed, worst, start, event + UNSAFE, result.trace)
            rows[0]["module"] = " or ".join(blamed) or None
        return Replay(self.network, self.lane_map, result.trace, 0, rows, found)

    def _again(self, seed: int, slot: int = -1, at: float = np.inf) -> Result:
        """One world, every step; the vehicle in `slot` brakes from `at` s on."""
        start, advance = self._one
        world = start(self.lane_map, np.int32(seed))
        result = jax.device_get(advance(self.lane_map, world, np.int32(slot), np.float32(at)))
        single = jax.tree.map(lambda x: x[None], (result.measures, result.totals))
        return result._replace(measures=single[0], totals=single[1])

    @cached_property
    def _references(self) -> dict[str, Callable[..., Any]]:
        """For each module of the policy: metrics of a world with the reference in its place.

        For `first` decisions the policy is the own one, for `more` the other one.
        """

        def advance(
            module: str, lane_map: LaneMap, world: Started, first: jax.Array, more: jax.Array, box: jax.Array
        ) -> Any:
            def decisions(run: Rollout, count: jax.Array, carry: Carry) -> Carry:
                def one(_: Any, carry: Carry) -> Carry:
                    return run.advance(lane_map, world.schedule, world.key, carry, 1)[1]

                return jax.lax.fori_loop(0, count, one, carry)

            run = self.rollout
            carry = decisions(run, first, world.carry)
            other = variants(self._policy, Replayed(box, run.config.dt))[module]
            carry = carry._replace(memory=other.init(run.config, lane_map, carry.state))
            carry = decisions(replace(run, policy=other), more, carry)
            return EvaluateEgo().result(run.config, lane_map, carry.measured)

        return {
            module: jax.jit(partial(advance, module)) for module in variants(self._policy, constant_velocity)
        }

    def _modules_to_blame(self, seed: int, kind: str, start: float, end: float, seen: Trace) -> list[str]:
        """Modules of the policy whose references, in their places from `start` s on, avoid it until `end`."""
        every = self.rollout.config.decision_time
        first = int(start / every)
        more = min(math.ceil(end / every), self.rollout.decisions) - first
        world = self._one[0](self.lane_map, np.int32(seed))
        found = []
        for module, advance in self._references.items():
            measures = advance(self.lane_map, world, np.int32(first), np.int32(more), seen.box)
            if on_host(measures)[f"{kind}_time"] is None:
                found.append(module)
        return found

    @cached_property
    def _one(self) -> tuple[Callable[..., Started], Callable[..., Result]]:
        def start(lane_map: LaneMap, seed: jax.Array) -> Started:
            return started(self.rollout, lane_map, self.sample, seed)

        def advance(lane_map: LaneMap, world: Started, slot: jax.Array, at: jax.Array) -> Result:
            run = replace(self.rollout, record=trace, policy=_Braking(self._policy, slot, at))
            return run.advance(lane_map, *world)[0]

        enable_compilation_cache()
        return jax.jit(start, compiler_options=run_once()), jax.jit(advance)


class _Braking:
    """A policy, and a vehicle that brakes from some moment on."""

    def __init__(self, policy: PolicyLike, slot: jax.Array, at: jax.Array) -> None:
        self.free, self.others = policy.free, getattr(policy, "others", 0)
        self.init = policy.init
        self.policy, self.slot, self.at = policy, slot, at

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        command, memory = self.policy(config, lane_map, state, memory, key)
        brakes = (jnp.arange(state.lane.shape[0]) == self.slot) & (config.time(state.step) >= self.at)
        return replace(command, brake=brakes), memory


@cache
def _source_hash() -> str:
    """Of all code, and weights, that make rows: rows of other code are other rows."""
    package = Path(limsim_jax.__file__).parent
    hashed = hashlib.sha256()
    for path in sorted([*package.rglob("*.py"), *package.rglob("*.npz")]):
        if path.relative_to(package).parts[0] in ("bench.py", "cli", "report"):
            continue
        hashed.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return hashed.hexdigest()[:16]


# --- from the words of the file to arrays ------------------------------------------------------------


def _policy(experiment: ExperimentFile) -> PolicyLike:
    name, options = experiment.ego.policy, experiment.ego.options
    where = f"{experiment.name}: ego.policy"
    if ":" in name:
        module, _, attribute = name.partition(":")
        try:
            factory: Callable[..., PolicyLike] = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise ExperimentError(f"{where}: '{name}' cannot be loaded: {error}") from None
    elif name in POLICIES:
        factory = POLICIES[name]
    else:
        raise ExperimentError(
            f"{where}: unknown policy '{name}'; known are {', '.join(POLICIES)}, or module:factory"
        )
    try:
        policy = build_policy(factory, options)
    except (TypeError, ValueError) as error:
        raise ExperimentError(f"{experiment.name}: ego.options: {error}") from None
    if not isinstance(getattr(policy, "free", None), bool):
        raise ExperimentError(f"{where}: '{name}' is no policy; see limsim_jax.policies.base.Policy")
    return policy


def _map(experiment: ExperimentFile) -> tuple[Network, LaneMap, dict[str, tuple[str, ...]]]:
    path = bundled_maps().get(experiment.map, experiment.map)
    try:
        network = read_network(path)
    except MapError as error:
        known = ", ".join(bundled_maps())
        hint = "" if os.path.exists(path) else f"; bundled maps are {known}"
        raise ExperimentError(f"{experiment.name}: map: {error}{hint}") from None
    goals = dict(default_goals(network))
    wanted = [experiment.ego.goal] if experiment.ego.goal else []
    for flow in experiment.traffic.flow:
        wanted += [flow.goal] if isinstance(flow.goal, str) else list(flow.goal or ())
    added = False
    for goal in wanted:
        if goal not in goals and goal in network.lanes:
            goals[goal] = (goal,)
            added = True
    return network, build_lane_map(network, goals if added else None), goals


def _ego(
    experiment: ExperimentFile,
    network: Network,
    lane_map: LaneMap,
    goals: Mapping[str, tuple[str, ...]],
    free: bool,
) -> EgoStart:
    ego, name = experiment.ego, experiment.name
    try:
        population = uniform_population(ego.vehicle, **ego.driver)
    except ValueError as error:
        raise ExperimentError(f"{name}: ego: {error}") from None
    vehicle = jnp.argmax(population.share)[None].astype(jnp.int32)
    # compiled as one: operation by operation it takes seconds
    sample = jax.jit(sample_vehicles, compiler_options=run_once())
    driver, shape = sample(population, jax.random.key(0), jnp.zeros(1, jnp.int32), vehicle)
    common = {"driver": driver, "shape": shape, "free": jnp.asarray([free])}
    common["v"] = None if ego.v is None else jnp.asarray([ego.v], jnp.float32)
    if ego.start == "random":
        return EgoStart(**common)
    lane = _start_lane(name, ego, network)
    length = network.lanes[lane].length
    if not ego.s < length:
        raise ExperimentError(f"{name}: ego.s: {ego.s:g} m, but lane '{lane}' is only {length:.1f} m long")
    if ego.goal is None or ego.goal not in goals:
        raise ExperimentError(f"{name}: ego.goal: no goal or lane '{ego.goal}'; goals are {', '.join(goals)}")
    row, column = lane_rows(network)[lane], list(goals).index(ego.goal)
    if not bool(lane_map.routes.reachable[row, column]):
        can = [goal for k, goal in enumerate(goals) if bool(lane_map.routes.reachable[row, k])]
        raise ExperimentError(
            f"{name}: ego.goal: '{ego.goal}' cannot be reached from lane '{lane}'; "
            f"from there it goes to {', '.join(can) or 'nowhere'}"
        )
    return EgoStart(
        lane=jnp.asarray([row], jnp.int32),
        s=jnp.asarray([max(ego.s, float(shape.length[0]))], jnp.float32),
        goal=jnp.asarray([column], jnp.int32),
        **common,
    )


def _start_lane(name: str, ego: EgoTable, network: Network) -> str:
    """The lane that the ego starts on."""
    known = origins(network)
    if ego.start in network.lanes:
        lanes = [ego.start]
    elif ego.start in known:
        lanes = list(known[ego.start])
    else:
        road = [lane for lane in network.drivable_lanes() if lane.road == ego.start and lane.junction is None]
        first = [lane for lane in road if lane.section == min(x.section for x in road)]
        if len({lane.number < 0 for lane in first}) > 1:
            raise ExperimentError(
                f"{name}: ego.start: road '{ego.start}' has traffic both ways; name one of its lanes, as "
                f"'{first[0].id}'"
            )
        lanes = [lane.id for lane in first]
    if not lanes:
        raise ExperimentError(
            f"{name}: ego.start: no origin, road or lane '{ego.start}'; origins are {', '.join(known)}"
        )
    rightmost = [lane for lane in lanes if network.lanes[lane].right not in lanes]
    ordered = rightmost[:1]
    while ordered and network.lanes[ordered[-1]].left in lanes:
        ordered.append(str(network.lanes[ordered[-1]].left))
    if ego.lane >= len(ordered):
        raise ExperimentError(
            f"{name}: ego.lane: {ego.lane}, but '{ego.start}' has lanes 0 to {len(ordered) - 1}"
        )
    chosen = network.lanes[ordered[ego.lane]]
    if not chosen.drivable or chosen.junction is not None:
        raise ExperimentError(f"{name}: ego.start: lane '{chosen.id}' is no lane to start on")
    return chosen.id


def _demand(
    experiment: ExperimentFile,
    network: Network,
    lane_map: LaneMap,
    goals: Mapping[str, tuple[str, ...]],
    egos: EgoStart,
) -> Demand:
    traffic, names = experiment.traffic, list(origins(network))
    flows = []
    for flow in traffic.flow:
        for origin in names if flow.origin == "*" else [flow.origin]:
            fields: dict[str, Any] = flow.model_dump() | {"origin": origin}
            flows.append(Flow(**fields))
    try:
        shares = URBAN if traffic.mix is None else traffic.mix
        drivers = traffic.drivers
        population = default_population(shares) if drivers is None else read_population(drivers, shares)
        population = restrict_to_map(population, lane_map)
        return build_demand(
            network, lane_map, goals, flows, population, horizon=experiment.horizon, density=traffic.density,
            vehicles=traffic.vehicles, egos=egos,
        )  # fmt: skip
    except ValueError as error:
        raise ExperimentError(f"{experiment.name}: traffic: {error}") from None


# --- from arrays to rows -----------------------------------------------------------------------------


def _succeeds(
    metrics: Mapping[str, NDArray[np.float64]], criteria: Mapping[str, bool | float | Bounds]
) -> NDArray[np.float64]:
    """1 where all criteria are met; what could not be measured meets none."""
    good = np.ones(len(next(iter(metrics.values()))), bool)
    for name, wanted in criteria.items():
        value = metrics[name]
        if isinstance(wanted, Bounds):
            least, most = wanted.min, wanted.max
            good &= value >= (-np.inf if least is None else least)
            good &= value <= (np.inf if most is None else most)
        else:
            good &= value == float(wanted)
    return good.astype(float)


def _moments(seeds: NDArray[np.int64], metrics: Mapping[str, NDArray[np.float64]]) -> dict[str, NDArray[Any]]:
    """When things went wrong or nearly did, the worst of each world first."""
    m = metrics
    nobody = np.full(len(seeds), np.nan)
    found = {
        "contact": (m["contact_time"], m["contact_delta_v"], m["contact_other"], m["contact_time"] >= 0),
        "off_road": (m["off_road_time"], m["off_road"], nobody, m["off_road_time"] >= 0),
        "red_light": (m["red_light_time"], m["red_lights"], nobody, m["red_light_time"] >= 0),
        "near_miss": (m["min_ttc_time"], m["min_ttc"], nobody, m["min_ttc"] < NEAR_MISS[0]),
        "hard_brake": (m["max_drac_time"], m["max_drac"], nobody, m["max_drac"] > HARD),
        "unsafe": (m["rss_first_time"], nobody, nobody, m["rss_first_time"] >= 0),
        "score_drop": (m["worst_second_time"], m["worst_second"], nobody, m["worst_second"] < SCORE_DROP),
    }
    rows = []
    for i, seed in enumerate(seeds.tolist()):
        rank = 0
        for kind in MOMENTS:
            time, value, other, there = (column[i] for column in found[kind])
            lead_up = kind in ("near_miss", "hard_brake") and abs(time - m["contact_time"][i]) < LEAD_UP
            if there and not lead_up:
                rank += 1
                who = m["contact_responsibility"][i] if kind == "contact" else np.nan
                known = not np.isnan(who) and who != Responsibility.NONE
                responsible = Responsibility(int(who)).name.lower() if known else None
                rows.append((seed, rank, kind, time, other, value, responsible))
    columns = list(zip(*rows, strict=True)) or [[]] * 7
    return {
        "seed": np.asarray(columns[0], np.int64),
        "rank": np.asarray(columns[1], np.int32),
        "kind": np.asarray(columns[2], object),
        "time": np.asarray(columns[3], np.float64),
        "other": np.asarray(columns[4], np.float64),
        "value": np.asarray(columns[5], np.float64),
        "responsible": np.asarray(columns[6], object),
    }


def _digest(metrics: Mapping[str, NDArray[np.float64]], state: Any) -> NDArray[np.uint64]:
    """A hash of every world's row and final state."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(state)]
    columns = np.stack([metrics[name] for name in metrics], -1)
    digests = []
    for i in range(len(columns)):
        hashed = hashlib.blake2b(columns[i].tobytes(), digest_size=8)
        for leaf in leaves:
            hashed.update(leaf[i].tobytes())
        digests.append(int.from_bytes(hashed.digest(), "little"))
    return np.asarray(digests, np.uint64)
