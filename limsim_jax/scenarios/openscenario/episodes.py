"""Variants of a scenario as worlds of a sweep: seed `k` is variant `k`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.map import Map, load_map
from limsim_jax.maps.network import MapError
from limsim_jax.maps.xml import file_hash
from limsim_jax.metrics.observer import EvaluateEgo
from limsim_jax.metrics.reductions import on_host
from limsim_jax.policies.base import PolicyLike, policy_name
from limsim_jax.scenarios.openscenario.build import Built, build
from limsim_jax.scenarios.openscenario.expressions import Value
from limsim_jax.scenarios.openscenario.padding import Sizes
from limsim_jax.scenarios.openscenario.roads import Roads
from limsim_jax.scenarios.openscenario.scenario import OpenScenario, openscenario
from limsim_jax.scenarios.openscenario.source import OpenScenarioError, one_line
from limsim_jax.scenarios.openscenario.storyboard import Scenario
from limsim_jax.scenarios.openscenario.world import Play, world_of
from limsim_jax.simulation.rollout import Result, Rollout
from limsim_jax.simulation.trace import trace
from limsim_jax.simulation.worlds import Names, Worlds
from limsim_jax.sweeps.answers import Notes
from limsim_jax.sweeps.build import policy_of
from limsim_jax.sweeps.episode import Episodes, provenance_of, source_hash
from limsim_jax.sweeps.experiment import EgoTable, ExperimentFile, name_of
from limsim_jax.sweeps.identity import describe_program
from limsim_jax.sweeps.reruns import CanBrake
from limsim_jax.traffic.demand.draws import Layout
from limsim_jax.traffic.engine import Traffic
from limsim_jax.types import Config
from limsim_jax.types import Scenario as World

HORIZON = 60.0
"""s of a world, unless its scenario ends sooner."""

PASSED, ENDED = "passed", "scenario_ended"
_LOOKED_AT = 64
"""Variants whose sizes are looked at before the program is compiled."""
_CHUNK = 50
_LONGEST = 60  # letters of a name
_SCRIPT = "script"

UNITS = {
    PASSED: "1 if the ego touches nothing, stays on the road, and its policy does not fail",
    ENDED: "1 if the scenario's own end comes within the horizon",
}


def map_of(scenario: Scenario, override: str | Path | None = None) -> Map:
    """The map of a scenario.

    Args:
      scenario: whose file names it.
      override: a map file, or a folder in which the named map is looked for; None: beside the scenario.

    Raises:
      OpenScenarioError: there is none.
    """
    named = scenario.map_file.replace("\\", "/")
    given = None if override is None else Path(override)
    if not named and (given is None or given.is_dir()):
        raise OpenScenarioError(f"{scenario.path}: names no map; give one with --map")
    tried = [scenario.path.parent / named] if given is None else [given]
    if given is not None and given.is_dir():
        stem = Path(named).name
        tried = [given / stem, given / f"{stem}.xodr"]
        tried += [x for x in sorted(given.glob("*.xodr")) if x.stem.lower().endswith(stem.lower())]
    for path in tried:
        if path.is_file():
            try:
                return load_map(path)
            except MapError as error:
                raise OpenScenarioError(one_line(str(error))) from None
    raise OpenScenarioError(
        f"{scenario.path}: map '{scenario.map_file}' is not found; give the file, or a folder, with --map"
    )


class ScenarioEpisodes(Episodes):
    """Variants of one scenario on one map, chunk by chunk.

    Args:
      scenario: the file.
      which: numbers of variants, all on the same map; world `k` is the `k`-th of them.
      policy: drives the ego, or the name of one that does; None: it keeps to its script.
      name: of the scenario in results.
      town: the map.
      chunk: worlds per call.
      horizon: s.
      dt: s, physics step.
      decision_every: physics steps per decision; None: as the policy needs, otherwise 5.
      controlled: the policy drives from the start, even if the scenario activates it later or never.
      asked: how many variants of the file, on all maps; None: all.
    """

    def __init__(
        self,
        scenario: OpenScenario,
        which: Sequence[int],
        policy: PolicyLike | str | None,
        *,
        name: str,
        town: Map,
        chunk: int | None = None,
        horizon: float = HORIZON,
        dt: float = 0.1,
        decision_every: int | None = None,
        controlled: bool = False,
        asked: int | None = None,
    ) -> None:
        self.source, self.which, self.town = scenario, list(which), town
        self.scenario, self._asked = name, asked
        named = isinstance(policy, str)
        run = ExperimentFile(
            name=name, map=town.source, horizon=horizon, dt=dt, slots=64,
            ego=(EgoTable(policy=policy if named else "like_traffic"),),
        )  # fmt: skip
        value = None if named else policy
        self._values = {"policy": value, "drivers": None, "model": None, "metrics": ()}
        self._policy: PolicyLike = policy_of(run) if value is None else value
        needs = getattr(self._policy, "decision_time", None)
        every = 5 if needs is None else max(1, round(needs / dt))
        every = every if decision_every is None else decision_every
        self.experiment = run.model_copy(update={"decision_every": every})
        self.policy = _SCRIPT if policy is None else self.experiment.policy if named else policy_name(policy)
        self._script_only, self._controlled = policy is None, controlled
        self.roads = Roads(town)
        self._measure = EvaluateEgo()
        self.notes = Notes(self._policy, dt)
        self._script = self._sumo = None
        self._code = None
        self.sizes = self._sizes(dt)
        self.units = self._all_units()
        config = Config(dt=dt, decision_every=every)
        self.rollout = Rollout(config, Traffic(player=Play()), horizon, self._policy, measure=self._measure)
        self.world_bytes = 0
        watched, source = replace(self.rollout, record=trace, policy=CanBrake(self._policy)), source_hash()
        names = Names(
            describe_program(source, "variants", *self.sizes),
            describe_program(source, replace(watched, horizon=1.0, measure=None)),  # for any time
            describe_program(source, config, self._measure),
        )
        self.worlds = Worlds(
            watched, self.lane_map, lambda world: world, names=names,
            given=lambda seeds: (self.worlds_of(seeds.tolist()), seeds),
            chunk=min(_CHUNK, max(len(self.which), 1)) if chunk is None else chunk,
        )  # fmt: skip
        self.chunk = self.worlds.chunk

    @property
    def egos(self) -> int:
        """Vehicles under test."""
        return 1

    @property
    def layout(self) -> Layout:  # pyright: ignore[reportIncompatibleVariableOverride]
        """There is none: a scenario has variants.

        Raises:
          ExperimentError: always.
        """
        self._refuse("layout", "a .xosc has variants, no random numbers")

    def under(self, policy: PolicyLike) -> ScenarioEpisodes:
        """The same worlds under another policy."""
        run = self.experiment
        return ScenarioEpisodes(
            self.source, self.which, policy, name=self.scenario, town=self.town, chunk=self.chunk,
            horizon=run.horizon, dt=run.dt, decision_every=run.decision_every, controlled=self._controlled,
            asked=self._asked,
        )  # fmt: skip

    def _sizes(self, dt: float) -> Sizes:
        """Sizes that hold a sample of the variants."""
        count = len(self.which)
        some = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(int))
        found = Sizes()
        for k in some:
            found = found | self._built(self.source.scenario(self.which[k]), dt, found).sizes
        return found

    def _built(self, scenario: Scenario, dt: float, sizes: Sizes) -> Built:
        return build(
            scenario, self.roads, dt, script=self._script_only, controlled=self._controlled, sizes=sizes
        )

    def worlds_of(self, seeds: Sequence[int]) -> World:
        """The worlds of some seeds, `[B, ...]`."""
        found: dict[int, World] = {}
        for k in dict.fromkeys(seeds):
            k = k % len(self.which)
            scenario = self.source.scenario(self.which[k])
            built = self._built(scenario, self.experiment.dt, self.sizes)
            if built.sizes != self.sizes:
                raise OpenScenarioError(
                    f"{self.source.path}: variant {self.which[k]} is larger than others; sweep it alone"
                )
            found[k] = world_of(scenario, built, self.roads, free=self._policy.free)
        rows = [found[k % len(self.which)] for k in seeds]
        return jax.tree.map(lambda *x: jnp.asarray(np.stack([np.asarray(z) for z in x])), *rows)

    # --- results

    @cached_property
    def parameters(self) -> dict[str, list[Value]]:
        """Values of the parameters that vary, by world."""
        return self.source.values(self.which)

    @cached_property
    def words(self) -> dict[str, list[str]]:
        """Texts that parameters take.

        A row has the place of the text in this list.
        """
        found = {}
        for name, values in self.parameters.items():
            if any(_as_number(x) is None for x in values):
                found[name] = sorted({str(x) for x in values})
        return found

    def _all_units(self) -> dict[str, str]:
        units = UNITS | dict(self._measure.units)
        for name in self.source.variants.names:
            words = self.words.get(name)
            said = "" if words is None else ": " + ", ".join(f"{k} {word}" for k, word in enumerate(words))
            units[f"parameter_{name}"] = f"parameter of the scenario{said}"
        return units

    def _columns(
        self, result: Result, seeds: Sequence[int], answers: Mapping[int, Sequence[Any]]
    ) -> dict[str, NDArray[np.float64]]:
        found: dict[str, NDArray[np.float64]] = dict(on_host(result.measures))
        outside = result.state.outside
        assert outside is not None
        found[ENDED] = np.asarray(outside.over, float)
        bad = sum(
            np.nan_to_num(found[x]) > 0 for x in ("contacts", "off_road", "policy_failed") if x in found
        )
        found[PASSED] = (np.asarray(bad) == 0).astype(float)
        found["success"] = found[PASSED]  # a scenario file has no destination to arrive at
        found |= self._parameter_columns(seeds)
        return {name: found[name] for name in self.units}

    def _parameter_columns(self, seeds: Sequence[int]) -> dict[str, NDArray[np.float64]]:
        found = {}
        for name, values in self.parameters.items():
            words = self.words.get(name)
            given = [values[k] for k in seeds]
            numbers = [_as_number(x) if words is None else words.index(str(x)) for x in given]
            found[f"parameter_{name}"] = np.array(numbers, float)
        return found

    def provenance(self) -> dict[str, Any]:
        """Where the rows come from."""
        about = provenance_of(self.experiment, self.town.network, self._policy, self._values, self.chunk)
        template = self.source.template.source.path
        files: Mapping[str, Path] = {"file": self.source.path, "template": template}
        return about | {
            "openscenario": {name: file_hash(path.read_bytes()) for name, path in files.items()},
            "openscenario_file": str(self.source.path.absolute()),
            "lenient": self.source.lenient,
            "root": None if self.source.root is None else str(self.source.root.absolute()),
            "asked": self._asked,
            "variants": len(self.which),
            "words": self.words,
            "controlled": self._controlled,
        }


def _as_number(value: Value) -> float | None:
    try:
        return float(value)
    except ValueError:
        return None


def episodes_of(
    scenario: OpenScenario,
    policy: PolicyLike | str | None,
    *,
    override: str | Path | None = None,
    variants: int | None = None,
    **options: Any,
) -> list[ScenarioEpisodes]:
    """Episodes of a file, one for each of its maps.

    Args:
      scenario: the file.
      policy: drives the ego, or the name of one that does; None: its script.
      override: as `map_of`.
      variants: so many of them, evenly spread; None: all.
      options: of `ScenarioEpisodes`.
    """
    return [
        ScenarioEpisodes(
            scenario, which, policy, name=name, town=map_of(scenario.scenario(which[0]), override),
            asked=variants, **options,
        )
        for name, which in _by_map(scenario, variants)
    ]  # fmt: skip


def rebuild(about: Mapping[str, Any], policy: str) -> ScenarioEpisodes:
    """The worlds of stored results, from their provenance.

    Args:
      about: their provenance.
      policy: its name in the results.

    Raises:
      OpenScenarioError: the file or its map is not there any more, or is another one; one line.
    """
    scenario = openscenario(about["openscenario_file"], lenient=about["lenient"], root=about["root"])
    run = ExperimentFile.model_validate(about["experiment"] | {"map": about["map_file"]})
    which = dict(_by_map(scenario, about["asked"])).get(run.name)
    if which is None:
        raise OpenScenarioError(f"{scenario.path}: has no variants of '{run.name}' any more")
    return ScenarioEpisodes(
        scenario, which, None if policy == _SCRIPT else run.ego[0].policy, name=run.name,
        town=map_of(scenario.scenario(which[0]), run.map), chunk=about["chunk"],
        horizon=run.horizon, dt=run.dt, decision_every=run.decision_every,
        controlled=about["controlled"], asked=about["asked"],
    )  # fmt: skip


def _by_map(scenario: OpenScenario, variants: int | None) -> list[tuple[str, list[int]]]:
    """Names and variants of episodes, for each map of a file."""
    total = len(scenario)
    chosen = range(total) if variants is None or variants >= total else _spread(total, variants)
    declared = {x.name for x in scenario.template.declarations}
    named = scenario.scenario(chosen[0]).map_file
    by_map: dict[str, list[int]] = {}
    varies = [x for x in scenario.variants.names if x in declared]
    groups: dict[tuple[Value, ...], str] = {}
    for k in chosen:
        values = scenario.variants[k]
        # only parameters that are texts can name a map
        key = tuple(x for name in varies if isinstance(x := values.get(name, ""), str))
        if key not in groups:
            groups[key] = scenario.scenario(k).map_file if key else named
        by_map.setdefault(groups[key], []).append(k)
    endings = [f"-{Path(file).stem}" if len(by_map) > 1 else "" for file in by_map]
    names = [_short(name_of(Path(f"{scenario.name}{ending}.xosc"))) for ending in endings]
    return list(zip(names, by_map.values(), strict=True))


def _short(name: str) -> str:
    """The name; of one that is too long its begin and a hash."""
    if len(name) <= _LONGEST:
        return name
    ending = file_hash(name.encode())[:8]
    return f"{name[: _LONGEST - len(ending) - 1]}_{ending}"


def _spread(total: int, count: int) -> list[int]:
    return sorted({int(x) for x in np.linspace(0, total - 1, count)})
