"""`estimate`: the probability of a rare event in the worlds of an experiment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from limsim_jax.api.experiment import Experiment, one_experiment
from limsim_jax.api.progress import count_bar
from limsim_jax.api.searched import Searched
from limsim_jax.sweeps.estimate import LEAST, Method
from limsim_jax.sweeps.estimate import Estimate as _Estimate
from limsim_jax.sweeps.estimate import estimate as _estimate
from limsim_jax.xla import use_all_cores

if TYPE_CHECKING:
    from limsim_jax.policies.base import PolicyLike


class Estimate(Searched, _Estimate):
    """How probable an event is under a policy; it can replay worlds."""


def estimate(
    experiment: Experiment | str | Path,
    event: str = "contact",
    *,
    policy: PolicyLike | str | None = None,
    method: Method = "subset",
    worlds: int = 5000,
    runs: int = 10,
    least: float = LEAST,
    level: float = 0.95,
    seed: int = 0,
    out: str | Path | None = None,
    chunk: int | None = None,
    fresh: bool = False,
    progress: bool = True,
) -> Estimate:
    """How probable an event is: per episode, per hour and per million km, with an interval.

        found = lj.estimate("roundabout", "contact", policy=lj.PDMClosed(), worlds=20_000)

    The random numbers of a world are one array: arrivals, goals, bodies and drivers. A sampler moves through
    it, and the program of a sweep runs each world that it asks for.

    Args:
      experiment: an `Experiment`, the name of a bundled one, or a TOML file, with an ego.
      event: "contact", "fault" (a contact by the ego's own fault by nuPlan's rules), or a metric and a bound,
        such as "min_ttc<1".
      policy: a value or a name; None: that of the experiment.
      method: "subset" simulation, "crude" counting, or "cross-entropy" (at most 30 random numbers).
      worlds: how many may run. Fewer do where the event is not rare.
      runs: independent runs, at least 10; the interval comes from their spread.
      least: probability per episode below which the event is not followed; a bound then.
      level: of confidence.
      seed: of the sampler.
      out: folder. It is made, or resumed: worlds that ran do not run again. None: nothing is kept.
      chunk: worlds per call; None: as memory allows.
      fresh: remove what `out` holds, and start anew.
      progress: show a progress bar.

    Raises:
      ExperimentError: an experiment that cannot run, or whose random numbers are no array.
      ValueError: no ego, an unknown event, or a number out of range; one line.
      ResultsError: `out` holds an estimate that was made differently.
    """
    use_all_cores()
    one = one_experiment(experiment, "estimate")
    episodes = one.episodes(policy, chunk=chunk)
    with count_bar(progress, f"{episodes.scenario} / {episodes.policy}") as tell:
        found = _estimate(
            episodes, event, None if out is None else Path(out), method=method, worlds=worlds, runs=runs,
            least=least, level=level, seed=seed, fresh=fresh, tell=tell,
        )  # fmt: skip
    fields: dict[str, Any] = {name: getattr(found, name) for name in found.__dataclass_fields__}
    return Estimate(**fields)
