"""An experiment as episodes: a seed in, a row of metrics out; thousands of them at once."""

from __future__ import annotations

import copy
import difflib
import hashlib
import importlib
import math
import os
import platform
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np
from numpy.typing import NDArray

import limsim_jax
from limsim_jax.maps import bundled_maps
from limsim_jax.maps import cache as kept_on_disk
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.map import Map
from limsim_jax.maps.network import Network
from limsim_jax.maps.xml import file_hash
from limsim_jax.metrics.answers import LANGUAGE, METERED, language_columns
from limsim_jax.metrics.catalog import TOTALS
from limsim_jax.metrics.measure import Metric
from limsim_jax.metrics.observer import EvaluateEgo, EvaluateEgos, EvaluateTraffic
from limsim_jax.metrics.reductions import on_host
from limsim_jax.policies.area import PARTS
from limsim_jax.policies.base import PolicyLike, check_policy, knows, policy_name, views, with_scenery
from limsim_jax.policies.host import failure_reasons
from limsim_jax.policies.language.store import Answer
from limsim_jax.policies.several import Several
from limsim_jax.simulation.ending import Watch
from limsim_jax.simulation.rollout import Result, Rollout, decision_key, world_key
from limsim_jax.simulation.trace import trace
from limsim_jax.simulation.worlds import Given, Names, Worlds
from limsim_jax.sweeps.answers import Notes, of_rows
from limsim_jax.sweeps.build import (
    demand_of,
    doubts,
    egos_of,
    flows_of,
    map_of,
    policy_of,
    traffic_of,
    with_view,
)
from limsim_jax.sweeps.experiment import NO_POLICY, Bounds, ExperimentError, ExperimentFile
from limsim_jax.sweeps.identity import describe, describe_program, is_foreign, policy_code, without_sources
from limsim_jax.sweeps.moments import key_moments
from limsim_jax.sweeps.places import check_routes
from limsim_jax.sweeps.reruns import CanBrake, Replay, Reruns
from limsim_jax.sweeps.script import script_of, script_vehicles, share_done, with_zones
from limsim_jax.sweeps.store import Outcome
from limsim_jax.sweeps.sumo import files_of, sumo_of
from limsim_jax.traffic.car_following import CarFollowing
from limsim_jax.traffic.demand import Flow, sample_scenario
from limsim_jax.traffic.demand.draws import Layout, draw
from limsim_jax.traffic.demand.sumo import with_schedule
from limsim_jax.traffic.ego import with_rows
from limsim_jax.traffic.vehicles import Population
from limsim_jax.types import Config, Scenario, State

_SHARE_OF_MEMORY = 0.25
_TEMPORARIES = 80  # memory of a running world with what it leaves behind, in units of its arrays
_WORLDS = {"cpu": 10, "gpu": 2000, "tpu": 2000}
"""Worlds per device and call, if memory allows: on CPUs more are hardly faster, and few seeds wait."""

_LEAST = {"cpu": 20}
"""Worlds per call at least, so that machines of one and of two cores make the same rows."""

AFTERWARDS = 12.0
"""s that a brief replay goes on without its ego: `UNSAFE` s, and the look-ahead of a planner at their end."""

_BEGUN = "actions_begun"

_NO_PART_OF_ROWS = ("api", "bench", "bench.py", "bridges", "cli", "report")
"""Rooms whose code changes no row; a bridge that does adds a hash of its own."""


class Episodes:
    """Runs an experiment, chunk by chunk. Its parts: `rollout`, `lane_map`, `sample`, `worlds`.

    Args:
      experiment: the file's tables.
      chunk: worlds per call; by default a round number from 10 a device on CPUs and 2000 on others, less
        if memory does not allow that.
      policy: drives the egos; None: the one that the experiment names.
      name: of the policy in results; None: that of the experiment.
      town: the map; None: the one that the experiment names.
      drivers: population of the traffic; None: the one of the experiment.
      model: car-following model; None: the one of the experiment.
      metrics: own metrics beside the built-in ones.

    Raises:
      ExperimentError: the experiment does not fit its map or names something that is not there; one line.
    """

    def __init__(
        self,
        experiment: ExperimentFile,
        *,
        chunk: int | None = None,
        policy: PolicyLike | None = None,
        name: str | None = None,
        town: Map | None = None,
        drivers: Population | None = None,
        model: CarFollowing | None = None,
        metrics: Sequence[Metric] = (),
    ) -> None:
        self.experiment = experiment
        self.scenario = experiment.name
        self.policy = NO_POLICY if not experiment.ego else experiment.policy if name is None else name
        self._values = {"policy": policy, "drivers": drivers, "model": model, "metrics": tuple(metrics)}
        if policy is None or not experiment.ego:
            self._policy = policy_of(experiment)
        else:
            self._policy = with_view(experiment.ego[0], policy)
        self._as_read = map_of(experiment, town)
        self.town = with_zones(experiment, self._as_read)
        check_routes(experiment, self.town)
        self._egos = egos_of(experiment, self.town, self._policy)
        self._placed = script_vehicles(experiment, self.town, self._egos)
        self._script = script_of(experiment, self._as_read.network, self.town, self.egos)
        self._measure = self._measures(tuple(metrics))
        self.notes = Notes(self._policy, experiment.dt)
        self.units = self._units()
        self._check_success()
        self._demand = demand_of(experiment, self.town, self._egos, drivers, self._placed)
        self._sumo = sumo_of(experiment, self.town)
        notes = () if self._sumo is None else self._sumo.notes
        said = (f"{experiment.name}: traffic.demand: {note}" for note in notes)
        for doubt in [*doubts(experiment, self.town), *said]:
            warnings.warn(doubt, stacklevel=2)
        self._check_room()
        config = Config(dt=experiment.dt, decision_every=experiment.decision_every)
        self._check_views(config)
        behaviour = traffic_of(experiment, model)
        self.rollout = Rollout(config, behaviour, experiment.horizon, self._policy, measure=self._measure)
        self._code = self._check_policy()
        source, slots = source_hash(), experiment.slots
        sumo = self._sumo
        drawn = self.lane_map, self._demand, self._egos, self._placed, self._script, slots
        if sumo is not None:
            drawn += sumo.tables
        sampling = None if sumo is not None and sumo.random else describe_program(source, *drawn)
        self._drawn = jax.jit(self.sample)  # traced once for its size and the start of worlds
        self.world_bytes = self._memory(sampling)
        self.chunk = self._chunk() if chunk is None else chunk
        run = replace(self.rollout, record=trace, policy=CanBrake(self._policy))
        # programs run for any time, and what measures knows no policy
        running = describe_program(source, replace(run, horizon=1.0, measure=None))
        names = Names(sampling, running, describe_program(source, config, self._measure))
        self.worlds = Worlds(run, self.lane_map, self._drawn, chunk=self.chunk, names=names)
        self.chunk = self.worlds.chunk

    @property
    def egos(self) -> int:
        """Vehicles under test."""
        return 0 if self._egos is None else self._egos.count

    @property
    def flows(self) -> list[Flow]:
        """The flows that come in, one per origin."""
        return flows_of(self.experiment, self.town)

    @property
    def initial(self) -> int:
        """Vehicles of the traffic on the road at the start."""
        return self._demand.initial

    @property
    def network(self) -> Network:
        """The map on the host."""
        return self.town.network

    @cached_property
    def lane_map(self) -> LaneMap:
        """The map on the device, with what the policy needs of it."""
        own = None if self._sumo is None else self._sumo.lane_map
        return with_scenery(self._policy, self.town, own)

    def under(self, policy: PolicyLike) -> Episodes:
        """The same worlds under another policy."""
        values: dict[str, Any] = self._values | {"policy": policy}
        return Episodes(
            self.experiment, chunk=self.chunk, town=self._as_read, name=policy_name(policy), **values
        )  # fmt: skip

    @cached_property
    def layout(self) -> Layout:
        """The random numbers of a world, one by one.

        Raises:
          ExperimentError: they are no array: those of SUMO's demand.
        """
        if self._sumo is not None:
            self._refuse("traffic.demand", "the random numbers of SUMO's demand are no array; count seeds")
        return Layout.of(self._demand)

    def from_numbers(self, given: Given) -> Episodes:
        """The same worlds from arrays of random numbers: a seed is what `given` makes of it.

        They run by the same program; only their start has one of its own. `given` returns values of
        `layout`, `[B, D]`.
        """
        layout, found = self.layout, copy.copy(self)
        found.__dict__.pop("_reruns", None)
        names = self.worlds.names
        started = None if names.sampling is None else f"numbers {names.sampling}"
        found.worlds = Worlds(
            self.worlds.rollout, self.lane_map, lambda values: self.sample(layout.draws(values)),
            chunk=self.chunk, names=names._replace(sampling=started), given=given,
        )  # fmt: skip
        return found

    def numbers(self, seeds: Sequence[int]) -> NDArray[np.float32]:
        """The random numbers of seeds, `[B, D]`, as values of `layout`."""
        return np.asarray(self._of_seed[0](np.asarray(seeds, np.int32)))

    def scenario_of(self, seed: int) -> Scenario:
        """The scenario of a seed, on the host."""
        return jax.device_get(self._of_seed[1](np.int32(seed)))

    @cached_property
    def _of_seed(self) -> tuple[Callable[[Any], jax.Array], Callable[[Any], Scenario]]:
        """Programs: random numbers of seeds, and the scenario of one."""
        layout = self.layout

        def key(seed: jax.Array) -> jax.Array:
            return jax.random.split(world_key(seed))[0]

        numbers = jax.vmap(lambda seed: layout.values(draw(self._demand, key(seed))))
        return jax.jit(numbers), jax.jit(lambda seed: self.sample(key(seed)))

    def _measures(self, metrics: tuple[Metric, ...]) -> EvaluateEgo | EvaluateTraffic:
        if not self.egos:
            if metrics:
                self._refuse("metrics", f"'{metrics[0].name}' is of an ego, and there is none")
            return EvaluateTraffic()
        try:
            return (
                EvaluateEgo(metrics=metrics)
                if self.egos == 1
                else EvaluateEgos(count=self.egos, metrics=metrics)
            )
        except ValueError as error:
            self._refuse("metrics", str(error))

    def _units(self) -> dict[str, str]:
        units = dict(self._measure.units)
        if self.experiment.success and "success" not in units:
            units = {"success": "1 if the criteria of the experiment are met"} | units
        units |= {total.name: total.meaning for total in TOTALS}
        if self._script is not None and self._script.actions is not None:
            units[_BEGUN] = "share of the actions of the experiment that have begun, lane changes started"
        if self.notes.drivers and self.egos:
            units |= {column.name: column.meaning for column in LANGUAGE}
        return units

    def _refuse(self, field: str, message: str) -> NoReturn:
        raise ExperimentError(f"{self.experiment.name}: {field}: {message}")

    def _check_success(self) -> None:
        unknown = [name for name in self.experiment.success if name not in self.units]
        if unknown:
            close = difflib.get_close_matches(unknown[0], list(self.units), 3, 0.5)
            hint = f"did you mean {' or '.join(repr(name) for name in close)}?" if close else ""
            hint = hint or "the page of metrics lists all, such as success, contacts, mean_speed"
            self._refuse(f"success.{unknown[0]}", f"no such metric; {hint}")

    def _check_room(self) -> None:
        placed = self._egos is not None and self._egos.lane is not None
        room = self._demand.initial + (self.egos if placed else 0)
        room += 0 if self._placed is None else self._placed.count
        if room > self.experiment.slots:
            self._refuse("slots", f"{self.experiment.slots}, but {room} vehicles are there at the start")
        if not placed and room < self.egos:
            one = self.egos == 1
            starts = "a random start needs" if one else f"{self.egos} random starts need"
            needed = "one vehicle" if one else f"{self.egos} vehicles"
            if self._sumo is not None:
                self._refuse("ego.start", f"{starts} a vehicle at the start, and a demand has none")
            self._refuse("traffic.density", f"{starts} at least {needed} at the start")

    def _check_views(self, config: Config) -> None:
        try:
            for view in views(self._policy):
                view.late(config)
        except ValueError as error:
            self._refuse("ego.view", str(error))

    def _check_policy(self) -> dict[str, Any] | None:
        """The code of a policy of one's own.

        It is traced once: what is wrong with it is one line, not a trace of a compiler."""
        if not is_foreign(self._policy):
            return None
        ours = type(self._policy).__module__.startswith("limsim_jax.")
        if ours and not isinstance(self._policy, Several):
            return policy_code(self._policy)

        def start(key: jax.Array) -> State:
            state = self.sample(key).start
            return replace(state, egos=with_rows(state.egos, getattr(self._policy, "others", 0)))

        state = jax.eval_shape(start, jax.random.key(0))
        try:
            programs = check_policy(self._policy, self.rollout.config, self.lane_map, state)
        except ValueError as error:
            self._refuse("policy", str(error))
        return policy_code(self._policy, programs)

    def sample(self, key: Any) -> Scenario:
        """The scenario of a world, from its key or its random numbers."""
        world = sample_scenario(
            self._demand, self.lane_map, key, self.experiment.slots, self._egos,
            vehicles=self._placed, script=self._script,
        )  # fmt: skip
        return world if self._sumo is None else with_schedule(world, self._sumo.schedule(key))

    def _memory(self, sampling: str | None) -> int:
        """Bytes that one more world needs: its arrays at the start, and temporaries in proportion.

        `sampling`: all that they depend on. Tracing takes half a second, so their size is kept on disk.
        """
        name = None if sampling is None else kept_on_disk.key("world", sampling)
        size = None if name is None else kept_on_disk.load(name)
        if size is None:
            arrays = jax.tree.leaves(jax.eval_shape(self._drawn, jax.random.key(0)))
            size = sum(math.prod(x.shape) * x.dtype.itemsize for x in arrays)
            if name is not None:
                kept_on_disk.store(name, size)
        return _TEMPORARIES * size

    def _chunk(self) -> int:
        device = jax.local_devices()[0]
        stats = device.memory_stats() if device.platform != "cpu" else None
        if stats and "bytes_limit" in stats:
            memory = stats["bytes_limit"] * jax.local_device_count()
        else:
            memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        most = int(_SHARE_OF_MEMORY * memory / self.world_bytes)
        platform = device.platform
        wanted = max(_WORLDS.get(platform, 10) * jax.local_device_count(), _LEAST.get(platform, 1))
        # a round number leaves no chunk half empty
        fits = [x for n in range(9) for k in (1, 2, 5) if (x := k * 10**n) <= max(most, 1)]
        return next((x for x in fits if x >= wanted), fits[-1])

    def provenance(self) -> dict[str, Any]:
        """Where the rows come from."""
        about = provenance_of(
            self.experiment, self.town.network, self._policy, self._values, self.chunk, self._code
        )
        return about | {
            "memory": {
                "bytes_per_world": self.world_bytes,
                "share_of_memory": _SHARE_OF_MEMORY,
                "bytes_per_chunk": self.world_bytes * self.chunk,
            },
        }

    def compile(self) -> None:
        """Compile now; otherwise the first chunk does."""
        self.worlds.compile()

    def run(self, seeds: Sequence[int]) -> Outcome:
        """Run at most `chunk` worlds."""
        if len(seeds) > self.chunk:
            raise ValueError(f"{len(seeds)} seeds at once; at most {self.chunk}")
        self.notes.forget()
        (_, result), *_ = self.worlds.chunks(seeds)
        answers = self.notes.take(seeds)
        metrics = self._columns(result, seeds, answers)
        each = max(self.egos, 1)
        rows, egos = self._rows(seeds)
        return Outcome(
            seeds=rows,
            egos=egos,
            metrics=metrics,
            moments=key_moments(rows, egos, metrics, self._reasons(rows, metrics)),
            digest=digests(metrics, result.state, each),
            answers=answers,
        )

    def _rows(self, seeds: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Seed and ego of each row, `[W E]`."""
        each = max(self.egos, 1)
        return np.repeat(np.asarray(seeds, np.int64), each), np.tile(
            np.arange(each, dtype=np.int32), len(seeds)
        )

    def _columns(
        self, result: Result, seeds: Sequence[int], answers: Mapping[int, Sequence[Answer]]
    ) -> dict[str, NDArray[np.float64]]:
        """Columns with a row per world and ego, `[W E]`."""
        found: dict[str, NDArray[np.float64]] = dict(on_host(result.measures))
        for column in TOTALS:
            counted = getattr(result.totals, column.name.removeprefix("traffic_"))
            found[column.name] = np.asarray(counted, float)
        progress = result.state.script
        if progress is not None and self._script is not None and self._script.actions is not None:
            found[_BEGUN] = share_done(self._script.actions, progress)
        each = max(self.egos, 1)
        metrics = {name: x.ravel() if x.ndim == 2 else np.repeat(x, each) for name, x in found.items()}
        if self.notes.drivers and self.egos:
            metrics |= language_columns(of_rows(answers, *self._rows(seeds)))
        if self.experiment.success:
            sound = metrics["policy_failed"] == 0 if "policy_failed" in metrics else True
            metrics["success"] = succeeds(metrics, self.experiment.success) * sound
        return {name: metrics[name] for name in self.units}

    def _reasons(
        self, seeds: NDArray[np.int64], metrics: Mapping[str, NDArray[np.float64]]
    ) -> dict[int, str]:
        """By seed, what exceptions of a planner on the host said."""
        known = failure_reasons(self._policy)
        found = {}
        for k in np.flatnonzero(metrics["policy_failed"] > 0) if known else ():
            seed, time = int(seeds[k]), float(metrics["policy_failed_time"][k])
            key = decision_key(seed, round(time / self.experiment.dt) - 1)
            parts = (jax.random.fold_in(key, part) for part in range(PARTS))
            keys = (np.asarray(jax.random.key_data(x)).tobytes() for x in (key, *parts))
            reason = next((known[x] for x in keys if x in known), None)
            if reason is not None:
                found[seed] = reason
        return found

    @cached_property
    def _reruns(self) -> Reruns:
        return Reruns(self.worlds, self.rollout)

    def replay(self, seed: int, ego: int = 0, *, explain: bool = True) -> Replay:
        """Run one world again and keep every step: see `replays`."""
        return self.replays([(seed, ego)], explain=explain)[0]

    def replays(
        self, which: Sequence[tuple[int, int]], *, explain: bool = True, brief: bool = False
    ) -> list[Replay]:
        """Run worlds again and keep every step. They are those of the sweep, to the last bit.

        Args:
          which: seeds and egos, whose metrics and key moments are wanted.
          explain: find out which vehicle or module could have avoided the worst moment: see
            `Reruns.avoidable` and `Reruns.module`.
          brief: run no longer than `AFTERWARDS` s after the egos have arrived or left; metrics of the
            traffic are those up to there.
        """
        for _, ego in which:
            if not 0 <= ego < max(self.egos, 1):
                raise ValueError(f"ego {ego}: the experiment has egos 0 to {self.egos - 1}")
        found = []
        for first in range(0, len(which), self.chunk):
            found += self._replayed(which[first : first + self.chunk], brief)
        if explain:
            self._explain([seed for seed, _ in which], found)
        return found

    def _replayed(self, which: Sequence[tuple[int, int]], brief: bool) -> list[Replay]:
        """At most a chunk of replays."""
        enough = Watch([ego for _, ego in which], AFTERWARDS) if brief else None
        self.notes.forget()
        result = self._reruns.replay([seed for seed, _ in which], enough)
        answers = self.notes.take([seed for seed, _ in which])
        columns = self._columns(result, [seed for seed, _ in which], answers)
        found = []
        for k, (seed, ego) in enumerate(which):
            row = k * max(self.egos, 1) + ego
            metrics = {name: x[row : row + 1] for name, x in columns.items()}
            seeds = np.asarray([seed], np.int64)
            moments = key_moments(seeds, np.asarray([ego], np.int32), metrics, self._reasons(seeds, metrics))
            table = {name: column.tolist() for name, column in moments.items()}
            rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
            seen = jax.tree.map(lambda x: x[k], result.trace)  # noqa: B023
            values = {name: float(x[0]) for name, x in metrics.items()}
            slot = ego if self.egos else -1
            said = [x for x in answers.get(seed, ()) if x.ego == ego]
            found.append(Replay(self.network, self.lane_map, seen, slot, rows, values, said))
        return found

    def _explain(self, seeds: Sequence[int], found: Sequence[Replay]) -> None:
        """Add to the worst moments what could have avoided them."""
        failed = [
            (seed, one)
            for seed, one in zip(seeds, found, strict=True)
            if one.moments and one.moments[0]["kind"] in ("contact", "off_road", "red_light")
        ]
        contacts = [(seed, one) for seed, one in failed if one.moments[0]["kind"] == "contact"]
        able = self._reruns.avoidable([(seed, one.ego, one.metrics) for seed, one in contacts])
        for (_, one), said in zip(contacts, able, strict=True):
            one.moments[0] |= said
        for seed, one in failed:
            kind = one.moments[0]["kind"]
            one.moments[0]["module"] = self._reruns.module(seed, one.ego, one.metrics, kind, one.trace)


def provenance_of(
    experiment: ExperimentFile,
    network: Network,
    policy: PolicyLike,
    values: Mapping[str, Any],
    chunk: int,
    code: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Where the rows of an experiment come from.

    Args:
      experiment: its tables.
      network: the map.
      policy: what drives the egos.
      values: what Python gave instead of names.
      chunk: worlds per call.
      code: of a policy of one's own.
    """
    device = jax.local_devices()[0]
    drivers, given = experiment.traffic.drivers, values["policy"]
    demand = files_of(experiment)
    each = policy if isinstance(policy, Several) else None
    return {
        **({"drivers": file_hash(Path(drivers).read_bytes())} if drivers is not None else {}),
        **({"demand": {str(path): file_hash(path.read_bytes()) for path in demand}} if demand else {}),
        **{name: describe(value) for name, value in values.items() if value and name != "policy"},
        **({"policy": without_sources(describe(given))} if given is not None else {}),
        **({"policy_code": code} if code else {}),
        **({"knows": knows(policy)} if experiment.ego else {}),
        **({"policies": list(each.names), "each_knows": [knows(x) for x in each.policies]} if each else {}),
        "experiment": experiment.model_dump(mode="json", exclude={"map"}),
        "map": {"file": os.path.basename(network.source), "hash": network.file_hash},
        # where to find the map again: a bundled one by its name
        "map_file": experiment.map if experiment.map in bundled_maps() else os.path.abspath(experiment.map),
        "version": limsim_jax.__version__,
        "source": source_hash(),
        "chunk": chunk,
        "platform": device.platform,
        "device": device.device_kind,
        "devices": jax.local_device_count(),
        "machine": platform.machine(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxlib": importlib.import_module("jaxlib").__version__,
    }


@cache
def source_hash() -> str:
    """Of all code, and weights, that make rows: rows of other code are other rows."""
    package = Path(limsim_jax.__file__).parent
    hashed = hashlib.sha256()
    for path in sorted([*package.rglob("*.py"), *package.rglob("*.npz")]):
        if path.relative_to(package).parts[0] in _NO_PART_OF_ROWS:
            continue
        hashed.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return hashed.hexdigest()[:16]


def succeeds(
    metrics: Mapping[str, NDArray[np.float64]], criteria: Mapping[str, bool | float | Bounds]
) -> NDArray[np.float64]:
    """1 where all criteria are met; a value that is missing meets none."""
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


def digests(metrics: Mapping[str, NDArray[np.float64]], state: Any, each: int) -> NDArray[np.uint64]:
    """A hash of every world's rows and final state.

    It is the same for all `each` rows of a world."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(state)]
    columns = np.stack([metrics[name] for name in metrics if name not in METERED], -1)
    columns = columns.reshape(-1, each, columns.shape[-1])
    digests = []
    for i in range(len(columns)):
        hashed = hashlib.blake2b(np.ascontiguousarray(columns[i]).tobytes(), digest_size=8)
        for leaf in leaves:
            hashed.update(leaf[i].tobytes())
        digests.append(int.from_bytes(hashed.digest(), "little"))
    return np.repeat(np.asarray(digests, np.uint64), each)
