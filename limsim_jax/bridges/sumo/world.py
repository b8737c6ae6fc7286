"""`SumoWorld`: a SUMO scenario with our planner in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

from pydantic import ValidationError

from limsim_jax.maps.network import MapError
from limsim_jax.sweeps.experiment import ExperimentError, ExperimentFile, first_fault, name_of, with_policy
from limsim_jax.sweeps.sumo_files import CONFIG, inputs

if TYPE_CHECKING:
    from limsim_jax.api.results import Results
    from limsim_jax.api.world import World
    from limsim_jax.bridges.sumo.episodes import SumoEpisodes
    from limsim_jax.metrics.measure import Metric
    from limsim_jax.policies.base import PolicyLike

Drivers = Literal["sumo", "ours"]

HORIZON = 180.0
"""s that an ego has for its trip, unless the caller says another number."""

SLOTS = 64
"""Vehicles of SUMO around the egos that a world holds at a time, egos included."""

COARSEST = 0.1
"""s; a coarser step of a `.sumocfg` is made finer: planners cannot steer by steps of 1 s."""


class SumoWorld:
    """A `.sumocfg` in which our planner drives some of SUMO's vehicles.

        world = lj.SumoWorld("town.sumocfg", policy=lj.LimSimTM())
        world.run(seed=3).show()
        results = world.sweep(seeds=50, out="results/town")

    SUMO drives all other vehicles and owns the signals. With `drivers="ours"` our driver model drives them,
    with the parameters that SUMO has of them. SUMO still inserts them, says their routes, and owns the
    signals.

    A vehicle is taken over with its route, its speed and its body once SUMO has inserted it; when it arrives,
    it leaves SUMO as well. Equal seeds are equal traffic up to what the planner changes. Each world has a
    SUMO process of its own.

    Args:
      config: a `.sumocfg`.
      policy: drives the egos: a value such as `PDMClosed()`, or a name.
      ego: id of the vehicle that is taken over, or several; None: drawn by the seed.
      egos: how many are drawn.
      takeover: s after the begin between which they are drawn: the first ones that are inserted from then on.
      horizon: s from the takeover on.
      dt: s, step of both sides; None: that of the `.sumocfg`, at most 0.1 s.
      drivers: of the other vehicles: "sumo", or "ours".
      decision_every: steps per decision of the policy; None: those of 0.5 s.
      slots: vehicles around the egos that a world holds; the nearest where there are more.
      view: what the policy sees, fields of `View`.
      success: what counts as success, as in an experiment.
      name: of the scenario in results.
      metrics: own metrics as more columns.
      chunk: worlds at the same time; None: one per core, 2 to 8.
      gui: show SUMO's window.

    Raises:
      ExperimentError: a value that makes no sense; one line.
      MapError: a file that cannot be used; one line.
    """

    def __init__(
        self,
        config: str | Path,
        *,
        policy: PolicyLike | str = "limsim_tm",
        ego: str | Sequence[str] | None = None,
        egos: int = 1,
        takeover: tuple[float, float] = (60.0, 180.0),
        horizon: float = HORIZON,
        drivers: Drivers = "sumo",
        dt: float | None = None,
        decision_every: int | None = None,
        slots: int = SLOTS,
        view: Mapping[str, Any] | None = None,
        success: Mapping[str, Any] | None = None,
        name: str | None = None,
        metrics: Sequence[Metric] = (),
        chunk: int | None = None,
        gui: bool = False,
    ) -> None:
        self.config = Path(config)
        self.vehicles = (ego,) if isinstance(ego, str) else tuple(ego or ())
        self.takeover = (egos, *map(float, takeover))
        if drivers not in get_args(Drivers):
            raise ExperimentError(f"drivers: '{drivers}'; known are {', '.join(get_args(Drivers))}")
        self.drivers = drivers
        self.policy = None if isinstance(policy, str) else policy
        self.metrics, self.chunk, self.gui = tuple(metrics), chunk, gui
        table = experiment_of(
            self.config, horizon=horizon, dt=dt, decision_every=decision_every, slots=slots, name=name
        )
        if view:
            table["ego"] = table["ego"] | {"view": dict(view)}
        if isinstance(policy, str):
            table["ego"] = with_policy(table["ego"], policy, str(self.config))
        if success is not None:
            table["success"] = dict(success)
        self.file = _checked(table)

    @cached_property
    def episodes(self) -> SumoEpisodes:
        """The worlds, as a sweep runs them.

        Raises:
          ExperimentError: the experiment does not fit its map.
        """
        from limsim_jax.bridges.sumo.episodes import SumoEpisodes, Takeover
        from limsim_jax.policies.base import policy_name

        count, earliest, latest = self.takeover
        try:
            takeover = Takeover(
                vehicles=self.vehicles, count=int(count), earliest=earliest, latest=latest,
                everyone=self.drivers == "ours",
            )  # fmt: skip
        except ValueError as error:
            raise ExperimentError(f"{self.file.name}: {error}") from None
        return SumoEpisodes(
            self.file, self.config, takeover, chunk=self.chunk, policy=self.policy,
            name=None if self.policy is None else policy_name(self.policy), metrics=self.metrics,
            gui=self.gui,
        )  # fmt: skip

    def run(self, seed: int = 0, *, ego: int = 0) -> World:
        """Run one world and keep every step.

        Args:
          seed: of SUMO, and of what is drawn here.
          ego: whose metrics and key moments the world shows.

        Raises:
          SumoError: SUMO is missing, refuses the files, or its process ends; one line.
        """
        from limsim_jax.api.world import World

        episodes: Any = self.episodes
        return World.run(episodes, seed, ego)

    def sweep(
        self,
        seeds: int | Sequence[int] = 20,
        out: str | Path | None = None,
        *,
        fresh: bool = False,
        progress: bool = True,
    ) -> Results:
        """Run many seeds; finished worlds are kept.

        Args:
          seeds: how many, or which.
          out: folder of the results; None: `results/NAME`.
          fresh: remove what is there of this scenario and policy.
          progress: show a progress bar.

        Raises:
          SumoError: SUMO is missing, refuses the files, or its process ends; one line.
          ResultsError: `out` cannot be written, or holds results that were made differently.
        """
        from limsim_jax.api.progress import progress_bar
        from limsim_jax.api.results import Results
        from limsim_jax.sweeps import runner
        from limsim_jax.sweeps.store import open_results

        path = Path("results") / self.file.name if out is None else Path(out)
        chosen = range(seeds) if isinstance(seeds, int) else seeds
        with progress_bar(progress) as show:
            runner.sweep([self.episodes], chosen, path, progress=show, fresh=fresh)
        found, episodes = Results(open_results(path)), cast("Any", self.episodes)
        found._made |= {(episodes.scenario, episodes.policy): episodes}
        return found

    def __repr__(self) -> str:
        who = ", ".join(self.vehicles) or f"{int(self.takeover[0])} drawn"
        return f"SumoWorld '{self.file.name}': {self.config}, egos: {who}, {self.file.horizon:g} s"


def experiment_of(
    config: Path,
    *,
    horizon: float = HORIZON,
    dt: float | None = None,
    decision_every: int | None = None,
    slots: int = SLOTS,
    name: str | None = None,
) -> dict[str, Any]:
    """A `.sumocfg` as the fields of an experiment whose traffic SUMO drives.

    Raises:
      ExperimentError: no `.sumocfg`, or no such file.
      MapError: the file cannot be used; one line.
    """
    from limsim_jax.maps.sumo.config import read_sumocfg

    if config.suffix != CONFIG:
        raise ExperimentError(f"{config}: SUMO runs a {CONFIG}, with a network and vehicles")
    try:
        network = inputs([config]).network
        step = min(read_sumocfg(config).step_length, COARSEST) if dt is None else dt
    except MapError as error:
        raise ExperimentError(str(error)) from None
    return {
        "name": name_of(config) if name is None else name,
        "map": str(network),
        "horizon": float(horizon),
        "dt": float(step),
        "decision_every": max(round(0.5 / step), 1) if decision_every is None else decision_every,
        "slots": slots,
        "traffic": {"demand": [str(config.resolve())]},
        "ego": {},
    }


def rebuild(about: Mapping[str, Any]) -> SumoEpisodes:
    """The worlds of stored results, from their provenance."""
    from limsim_jax.bridges.sumo.episodes import SumoEpisodes, Takeover

    engine = about["engine"]
    names = "count", "earliest", "latest"
    known = {name: engine[name] for name in names} | {"everyone": engine.get("everyone", False)}
    takeover = Takeover(vehicles=tuple(engine["vehicles"]), **known)
    experiment = ExperimentFile.model_validate(about["experiment"] | {"map": about["map_file"]})
    return SumoEpisodes(experiment, Path(engine["config"]), takeover, chunk=about["chunk"])


def _checked(table: Mapping[str, Any]) -> ExperimentFile:
    try:
        return ExperimentFile.model_validate(table)
    except ValidationError as error:
        raise ExperimentError(f"{table['name']}: {first_fault(error)}") from None


__all__ = ["HORIZON", "SLOTS", "SumoWorld", "experiment_of", "rebuild"]
