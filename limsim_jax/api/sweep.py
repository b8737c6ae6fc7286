"""`sweep`: experiments under policies over many seeds."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from limsim_jax.api.experiment import Experiment, load_experiments
from limsim_jax.api.progress import progress_bar
from limsim_jax.api.results import Results
from limsim_jax.sweeps import runner
from limsim_jax.sweeps.store import open_results
from limsim_jax.xla import use_all_cores

if TYPE_CHECKING:
    from limsim_jax.metrics.measure import Metric
    from limsim_jax.policies.base import PolicyLike


def sweep(
    experiment: Experiment | str | Path | Sequence[Experiment | str | Path],
    *,
    policies: Sequence[PolicyLike | str] | PolicyLike | str | None = None,
    seeds: int | Sequence[int] = 100,
    out: str | Path | None = None,
    metrics: Sequence[Metric] = (),
    chunk: int | None = None,
    shard: tuple[int, int] | None = None,
    until_ci: tuple[float, str] | None = None,
    on_error: runner.OnError = "record",
    fresh: bool = False,
    progress: bool = True,
) -> Results:
    """Run experiments with many seeds, each under every policy.

        results = lj.sweep("roundabout", policies=[lj.LikeTraffic(), lj.PDMClosed()], seeds=1000)

    Equal seeds are equal traffic for every policy. A world depends on its seed alone.

    Args:
      experiment: an `Experiment`, the name of a bundled one, a TOML file, or a list of these.
      policies: values such as `PDMClosed()`, or names; None: the policy of each experiment. Two settings of
        one planner need two names: `lj.named("tm50", lj.LimSimTM(simulations=50))`.
      seeds: how many, or which.
      out: folder of the results. It is made, or resumed: finished worlds do not run again. None: a
        temporary folder, which is removed with the results.
      metrics: own metrics (`Metric`) as more columns.
      chunk: worlds per call; None: as memory allows.
      shard: (i, n): only every n-th chunk from the i-th on, for job arrays.
      until_ci: (half-width, metric): stop once the interval of the metric is that narrow.
      on_error: "record": an episode in which the policy raises an exception or gives a command that is not
        finite is a failed episode (`policy_failed`); "stop": it ends the sweep.
      fresh: remove what `out` holds of these experiments and policies, and start anew.
      progress: show a progress bar.

    Raises:
      ExperimentError: an experiment that cannot run; one line.
      ValueError: seeds, shard or until_ci out of range, or two policies of one name.
      PolicyFailedError: the policy failed, with `on_error="stop"`.
      ResultsError: `out` cannot be written, or holds results that were made differently.
    """
    use_all_cores()
    experiments = load_experiments(experiment)
    wanted: list[Any] = [policies] if policies is None or isinstance(policies, str) else []
    if not wanted:
        wanted = list(policies) if isinstance(policies, Sequence) else [policies]
    if not wanted:
        raise ValueError("policies: the list is empty; None stands for the policy of each experiment")
    chosen = range(seeds) if isinstance(seeds, int) else seeds
    if isinstance(seeds, int) and not 1 <= seeds <= 2**31:
        raise ValueError(f"seeds: {seeds}; between 1 and 2^31")
    pairs = [(one, policy) for one in experiments for policy in wanted]
    episodes = [one.episodes(policy, chunk=chunk, metrics=metrics) for one, policy in pairs]
    _check_names([(x.scenario, x.policy) for x in episodes])
    path = Path(tempfile.mkdtemp(prefix="limsim-jax-") if out is None else out)
    try:
        with progress_bar(progress) as show:
            runner.sweep(
                episodes, chosen, path, shard=shard, until_ci=until_ci, progress=show, on_error=on_error,
                fresh=fresh,
            )  # fmt: skip
        found = Results(open_results(path))
    except BaseException:
        if out is None:
            shutil.rmtree(path, ignore_errors=True)
        raise
    if out is None:
        weakref.finalize(found, shutil.rmtree, path, ignore_errors=True)
    found._made |= {(x.scenario, x.policy): x for x in episodes}
    return found


def _check_names(pairs: Sequence[tuple[str, str]]) -> None:
    for scenario, policy in pairs:
        if list(pairs).count((scenario, policy)) > 1:
            raise ValueError(
                f"policies: '{policy}' stands twice in {scenario}; give one another name, as "
                f'lj.named("other", lj.LimSimTM(...))'
            )
