"""`Results`: what a sweep found, as tables, comparisons, replays and a report."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from limsim_jax.sweeps.store import Results as Stored
from limsim_jax.sweeps.store import ResultsError
from limsim_jax.sweeps.store import open_results as open_stored

if TYPE_CHECKING:
    import pandas as pd

    from limsim_jax.api.world import World
    from limsim_jax.policies.language.store import Answer
    from limsim_jax.report.compare import Comparison
    from limsim_jax.report.tables import TextTable
    from limsim_jax.scenarios.openscenario.outcome import Tally
    from limsim_jax.sweeps.episode import Episodes

"""(scenario, policy) to a function that makes their worlds again."""


class Row(dict[str, Any]):
    """An episode of results: a mapping of its columns that can be replayed."""

    def __init__(self, fields: Mapping[str, Any], results: Results) -> None:
        super().__init__(fields)
        self._results = results

    @property
    def scenario(self) -> str:
        """Name of the scenario."""
        return self["scenario"]

    @property
    def policy(self) -> str:
        """Name of the policy."""
        return self["policy"]

    @property
    def seed(self) -> int:
        """Of the world."""
        return self["seed"]

    @property
    def ego(self) -> int:
        """Number of the ego in its world."""
        return self["ego"]

    def replay(self) -> World:
        """Run the world again and keep every step."""
        return self._results.replay(self)

    def __repr__(self) -> str:
        words = f"{self.scenario}, {self.policy}, seed {self.seed}"
        kind = self.get("kind")
        return f"<{words}: {kind} at {self['time']:.1f} s>" if kind else f"<{words}>"


class Results:
    """The episodes of a sweep: a row per scenario, policy, seed and ego.

    Printed, it is the table of the main metrics with 95 % intervals.

    Attributes:
      path: folder of the results.
      episodes: all rows, a `pyarrow.Table`; metrics that could not be measured are null.
      moments: key moments, a `pyarrow.Table`.
      units: what every column means.
    """

    def __init__(self, stored: Stored) -> None:
        self.stored = stored
        self.path, self.units = stored.path, stored.units
        self.episodes, self.moments = stored.episodes, stored.moments
        self._made: dict[tuple[str, str], Episodes] = {}

    @functools.cached_property
    def _summary(self) -> pa.Table:
        from limsim_jax.report.tables import summary

        return summary(self.stored)

    def summary(self) -> pa.Table:
        """Every metric with its interval, spread and number of values."""
        return self._summary

    def table(self) -> TextTable:
        """The main metrics with 95 % intervals; it prints, and shows itself in a notebook."""
        from limsim_jax.report.tables import headline

        return headline(self.stored, table=self._summary)

    def compare(self, a: str, b: str | None = None, *, other: Results | None = None) -> Comparison:
        """Policy `b` against `a`, seed by seed: equal seeds are equal traffic.

        Args:
          a: name of a policy.
          b: another policy; None: the same name in `other`.
          other: results that hold `b`; None: these.

        Raises:
          ValueError: an unknown policy, or worlds that are not the same.
        """
        from limsim_jax.report.compare import compare

        if b is None and other is None:
            raise ValueError(f"compare: name the policy to compare '{a}' with; there are {self._policies()}")
        second = self if other is None else other
        for name, results in ((a, self), (b or a, second)):
            if name not in results.policies:
                raise ValueError(f"compare: no policy '{name}'; there are {results._policies()}")
        return compare(self.stored, None if other is None else other.stored, policies=(a, b or a))

    def outcome(self) -> list[Tally]:
        """How many variants of each scenario file passed and collided, by policy.

        `preventable`: collisions that the careful driver of UN R157 avoids, where `r157_careful` was run on
        the same variants. Results of other experiments have none.
        """
        from limsim_jax.scenarios.openscenario.outcome import outcome

        return outcome(self.stored)

    @property
    def policies(self) -> list[str]:
        """Names of the policies."""
        return list(dict.fromkeys(policy for _, policy in self.stored.provenance))

    @property
    def scenarios(self) -> list[str]:
        """Names of the scenarios."""
        return list(dict.fromkeys(scenario for scenario, _ in self.stored.provenance))

    def _policies(self) -> str:
        return ", ".join(self.policies)

    def worst(self, k: int = 10, *, metric: str | None = None) -> list[Row]:
        """The worst episodes, by severity or by a metric; each can be replayed."""
        from limsim_jax.report.tables import worst

        return [Row({"ego": 0} | row, self) for row in worst(self.stored, metric, k).to_pylist()]

    def row(self, seed: int, *, scenario: str | None = None, policy: str | None = None, ego: int = 0) -> Row:
        """The episode of a seed."""
        group = self._group(scenario, policy)
        wanted = (
            (pc.field("scenario") == group[0])
            & (pc.field("policy") == group[1])
            & (pc.field("seed") == seed)
            & (pc.field("ego") == ego)
        )
        rows = self.episodes.filter(wanted).to_pylist()
        if not rows:
            raise ValueError(f"{self.path}: no seed {seed} of {group[0]} ({group[1]})")
        return Row(rows[0], self)

    def replay(
        self, row: Mapping[str, Any] | int, *, scenario: str | None = None, policy: str | None = None
    ) -> World:
        """Run a world of the results again and keep every step.

        Args:
          row: an episode, or a seed.
          scenario, policy: names, where `row` is a seed and the results hold several.
        """
        from limsim_jax.api.world import World

        if isinstance(row, int):
            group, seed, ego = self._group(scenario, policy), row, 0
        else:
            group, seed, ego = (row["scenario"], row["policy"]), row["seed"], row.get("ego", 0)
        return World.run(self._recalled(*group, [seed]), seed, ego)

    def answers(self, seed: int, *, scenario: str | None = None, policy: str | None = None) -> list[Answer]:
        """What a language model answered in a world; empty where none drove.

        Args:
          seed: of the world.
          scenario, policy: names, where the results hold several.
        """
        from limsim_jax.sweeps.answers import stored_answers

        return stored_answers(self.path, *self._group(scenario, policy), seed)

    def trajectories(
        self, seeds: Sequence[int], *, scenario: str | None = None, policy: str | None = None
    ) -> pa.Table:
        """Every vehicle of some worlds in one long table.

        Args:
          seeds: of the worlds.
          scenario, policy: names; None: all of them.

        Returns:
          Columns scenario, policy, seed, and those of `simulation.table.trajectory_table`.
        """
        from limsim_jax.api.world import World

        groups = [g for g in self.stored.provenance if scenario in (None, g[0]) and policy in (None, g[1])]
        if not groups:
            raise ValueError(f"no scenario '{scenario}' with policy '{policy}'; there are {self._groups()}")
        parts = []
        for group in groups:
            worlds = self._recalled(*group, seeds)
            for seed in seeds:
                part = World.run(worlds, seed, explain=False).trajectories()
                for place, (name, value) in enumerate(zip(("scenario", "policy"), group, strict=True)):
                    part = part.add_column(place, name, pa.array([value] * part.num_rows))
                parts.append(part)
        return pa.concat_tables(parts, promote_options="default")

    def worlds_of(self, scenario: str, policy: str) -> Episodes:
        """What makes the worlds of a scenario and policy again."""
        group = scenario, policy
        if group not in self._made:
            self._made[group] = rebuild(self.stored, *group)
        return self._made[group]

    def _recalled(self, scenario: str, policy: str, seeds: Sequence[int]) -> Episodes:
        """The same, ready to run these seeds: a language model says again what it said."""
        from limsim_jax.sweeps.answers import recall

        worlds = self.worlds_of(scenario, policy)
        recall(worlds, self.path, seeds)
        return worlds

    def report(self, path: str | Path | None = None, *, worst: int = 6) -> Path:
        """Write the report as an HTML page.

        Replays of the worst episodes lie beside it.

        Args:
          path: of the page; None: `report.html` in the folder of the results.
          worst: episodes with pictures and replays.
        """
        from limsim_jax.report.page import write_report

        def again(scenario: str, policy: str, seeds: Sequence[int]) -> Sequence[tuple[Any, ...]]:
            worlds = self._recalled(scenario, policy, seeds)
            return worlds.replays([(seed, 0) for seed in seeds], brief=True)

        target = self.path / "report.html" if path is None else Path(path)
        return write_report(self.stored, target, replayer=again, worst=worst, table=self._summary)

    def to_pandas(self) -> pd.DataFrame:
        """A row per episode as a pandas DataFrame.

        Raises:
          ModuleNotFoundError: pandas is not installed: `pip install "limsim-jax[pandas]"`.
        """
        try:
            import pandas  # noqa: F401
        except ModuleNotFoundError:
            raise ModuleNotFoundError('pandas is needed: pip install "limsim-jax[pandas]"') from None
        return self.episodes.to_pandas()

    def _group(self, scenario: str | None, policy: str | None) -> tuple[str, str]:
        fits = [g for g in self.stored.provenance if scenario in (None, g[0]) and policy in (None, g[1])]
        if len(fits) != 1:
            reason = (
                "several fit; name scenario and policy" if fits else "there is no such scenario or policy"
            )
            raise ValueError(f"{reason}; the results hold {self._groups()}")
        return fits[0]

    def _groups(self) -> str:
        return ", ".join(f"{scenario} ({policy})" for scenario, policy in self.stored.provenance)

    def __len__(self) -> int:
        return self.episodes.num_rows

    def __str__(self) -> str:
        return str(self.table())

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


def open_results(path: str | Path) -> Results:
    """Read the results of a sweep.

    Args:
      path: folder of the results.

    Raises:
      ResultsError: one line: no results there, none finished, or a damaged file.
    """
    return Results(open_stored(path))


def rebuild(stored: Stored, scenario: str, policy: str, *, cores: int | None = None) -> Episodes:
    """The worlds of stored results, from what is stored about them.

    Raises:
      ResultsError: they hang on a Python value (a policy, drivers, metrics) that a folder does not hold.
    """
    from limsim_jax.policies.language.driver import offline
    from limsim_jax.sweeps.episode import Episodes
    from limsim_jax.sweeps.experiment import ExperimentFile
    from limsim_jax.xla import use_all_cores

    about = stored.provenance[scenario, policy]
    values = [name for name in ("policy", "model", "metrics") if name in about]
    values += ["drivers"] if isinstance(about.get("drivers"), dict) else []
    if values:
        raise ResultsError(
            f"{stored.path}: {scenario} ({policy}) was made with {values[0]} from Python, which the folder "
            "does not hold; run the same lj.sweep again (finished worlds are kept) and use what it returns"
        )
    use_all_cores(cores)
    if "engine" in about:  # a bridge ran them; it lies above this room
        return importlib.import_module("limsim_jax.bridges.sumo.world").rebuild(about)
    if "openscenario" in about:
        from limsim_jax.scenarios.openscenario.episodes import rebuild as again

        with offline():
            return again(about, policy)
    experiment = ExperimentFile.model_validate(about["experiment"] | {"map": about["map_file"]})
    with offline():
        return Episodes(experiment, chunk=about["chunk"])
