"""`adversary`: a search for plausible worlds in which a policy fails."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from limsim_jax.api.experiment import Experiment, one_experiment
from limsim_jax.api.progress import count_bar
from limsim_jax.api.searched import Searched
from limsim_jax.sweeps.adversary import LEAST_PLAUSIBLE, MOST, STARTS
from limsim_jax.sweeps.adversary import Adversary as _Adversary
from limsim_jax.sweeps.adversary import adversary as _adversary
from limsim_jax.sweeps.experiment import ExperimentError
from limsim_jax.xla import use_all_cores

if TYPE_CHECKING:
    from limsim_jax.policies.base import PolicyLike

REFERENCE = "pdm_closed_rules"
"""Policy that drives the failures as well, unless told."""


class Adversary(Searched, _Adversary):
    """Worlds in which a policy fails, no probability; it can replay them."""


def adversary(
    experiment: Experiment | str | Path,
    event: str = "contact",
    *,
    policy: PolicyLike | str | None = None,
    reference: PolicyLike | str | None = REFERENCE,
    worlds: int = 2000,
    starts: int = STARTS,
    most: int = MOST,
    least_plausible: float = LEAST_PLAUSIBLE,
    seed: int = 0,
    out: str | Path | None = None,
    chunk: int | None = None,
    fresh: bool = False,
    progress: bool = True,
) -> Adversary:
    """Search for plausible worlds in which an event happens. It gives no probability.

        found = lj.adversary("roundabout", "contact", policy=lj.PDMClosed(), worlds=2000)

    CMA-ES changes the random numbers of the worlds that are nearest to the event: arrivals, goals, bodies and
    drivers. Each failure is changed back as far as the event stands, and told with what is left; a reference
    driver gets it, too. How often the event happens is what `estimate` tells.

    Args:
      experiment: an `Experiment`, the name of a bundled one, or a TOML file, with an ego.
      event: "contact", "fault" (a contact by the ego's own fault by nuPlan's rules), or a metric and a bound,
        such as "min_ttc<1".
      policy: a value or a name; None: that of the experiment.
      reference: a value or a name; None: failures are not driven again.
      worlds: how many may run in all. Fewer do where failures are easily found.
      starts: searches side by side.
      most: failures after which it ends.
      least_plausible: share of random worlds that are as unusual as a failure, at least, 0 to 1.
      seed: the first plain world, and the seed of the searches.
      out: folder. It is made, or resumed: worlds that ran do not run again. None: nothing is kept.
      chunk: worlds per call; None: as memory allows.
      fresh: remove what `out` holds, and start anew.
      progress: show a progress bar.

    Raises:
      ExperimentError: an experiment that cannot run, an unknown policy, or random numbers that are no array.
      ValueError: no ego, an unknown event, or a number out of range; one line.
      ResultsError: `out` holds something else, or a search that was made differently.
    """
    use_all_cores()
    one = one_experiment(experiment, "search")
    episodes = one.episodes(policy, chunk=chunk)
    other = None
    if reference is not None and episodes.egos:
        try:
            other = one.episodes(reference, chunk=episodes.chunk)
        except ExperimentError as error:
            raise ExperimentError(f"reference: {error}") from None
    with count_bar(progress, f"{episodes.scenario} / {episodes.policy}") as tell:
        found = _adversary(
            episodes, event, None if out is None else Path(out), reference=other, worlds=worlds,
            starts=starts, most=most, least_plausible=least_plausible, seed=seed, fresh=fresh, tell=tell,
        )  # fmt: skip
    fields: dict[str, Any] = {name: getattr(found, name) for name in found.__dataclass_fields__}
    return Adversary(**fields)
