"""`Results.triage` and `sensitivity`: what failures have in common, and what results hang on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from limsim_jax.api.experiment import Experiment, one_experiment
from limsim_jax.api.progress import count_bar
from limsim_jax.api.results import Results
from limsim_jax.report.triage import HEAD, Cluster, Finding, clusters_of, rows_of, write_page
from limsim_jax.sweeps.sensitivity import TRAFFIC, Sensitivity, slope_text
from limsim_jax.sweeps.sensitivity import sensitivity as _sensitivity
from limsim_jax.sweeps.store import ResultsError
from limsim_jax.xla import use_all_cores

if TYPE_CHECKING:
    from limsim_jax.policies.base import PolicyLike

EVENTS = {
    "contact": "contacts",
    "off_road": "off_road",
    "red_light": "red_lights",
    "policy_failed": "policy_failed",
    "out_of_time": "out_of_time",
}
"""Kinds of failures and the metric that is above 0 then; the others are told by `success`."""

METRICS = ("contacts", "min_ttc", "mean_speed", "max_drac", "duration", "traffic_left")
"""Metrics whose sensitivity is looked at, unless told."""

STRONGEST = 8
"""Parameters of a metric on the page."""


def triage(
    results: Results,
    *,
    scenario: str | None = None,
    policy: str | None = None,
    most: int = 8,
    change: bool = True,
    page: str | Path | None = None,
) -> list[Finding]:
    """Failures of a sweep grouped by what happened, the largest group first.

    Of each group one episode is in the middle of the others. Its world is changed until the failure is gone:
    the least change of one vehicle's random numbers is what it hangs on.

    Args:
      results: of the sweep.
      scenario, policy: names; None: all.
      most: groups whose representative is changed and shown, the largest ones.
      change: look for changes, and write replays beside the page. Results whose worlds a folder cannot make
        again (values from Python) have groups only.
      page: HTML page to write; None: none.
    """
    findings: list[Finding] = []
    for group in results.stored.provenance:
        if scenario not in (None, group[0]) or policy not in (None, group[1]):
            continue
        found = clusters_of(results.stored, *group)
        try:
            worlds = results.worlds_of(*group) if change and found else None
            said = ""
        except ResultsError:
            worlds, said = None, "not looked for: the folder cannot make its worlds again"
        for k, cluster in enumerate(found):
            if worlds is None or k >= most:
                findings.append(Finding(cluster, said, ""))
                continue
            replay = ""
            if page is not None:
                seed = cluster.typical.seed
                name = f"replays/{cluster.scenario}-{cluster.policy}-{seed}.html"
                results.replay(seed, scenario=group[0], policy=group[1]).save(Path(page).parent / name)
                replay = quote(name)
            findings.append(Finding(cluster, _change(worlds, cluster), replay))
    if page is not None:
        _write_triage(Path(page), results, findings)
    return findings


def _change(worlds: Any, cluster: Cluster) -> str:
    """The least change that makes a representative's failure go away, in words."""
    from limsim_jax.sweeps.experiment import ExperimentError
    from limsim_jax.sweeps.variation import least_change

    column = EVENTS.get(cluster.kind)

    def happened(metrics: Any) -> Any:
        return metrics["success"] == 0 if column is None else metrics[column] > 0

    until = cluster.typical.time
    try:
        found = least_change(
            worlds, cluster.typical.seed, happened, until=np.inf if np.isnan(until) else until
        )
    except ExperimentError:
        return "not looked for: random numbers of SUMO's demand"
    if not found.again:
        return "any change: it hangs on the last bits of its numbers"
    if found.change is None:
        return "no change of one vehicle"
    return str(found.change)


def _write_triage(path: Path, results: Results, findings: Sequence[Finding]) -> None:
    sections = []
    for group in results.stored.provenance:
        mine = [x for x in findings if (x.cluster.scenario, x.cluster.policy) == group]
        rows = []
        for finding, (many, words, typical, change) in zip(mine, rows_of(mine), strict=True):
            shown: Any = (typical, finding.replay) if finding.replay else typical
            rows.append([many, words, shown, change])
        notes = [] if mine else ["No episode failed."]
        sections.append({"title": ", ".join(group), "notes": notes, "head": HEAD, "rows": rows})
    about = f"{len(results):,} episodes, failures grouped by what happened. Shares with 95 % intervals."
    write_page(path, f"Triage of {path.parent.name}", about, sections)


def sensitivity(
    experiment: Experiment | str | Path,
    *,
    policy: PolicyLike | str | None = None,
    metrics: Sequence[str] | None = None,
    seeds: int = 40,
    seed: int = 0,
    chunk: int | None = None,
    page: str | Path | None = None,
    progress: bool = True,
) -> Sensitivity:
    """On which assumption about the other drivers a result hangs.

    Each parameter of the population (time gap, acceleration, politeness, and so on) is shifted by up to one
    standard deviation for all vehicles at once; see `sweeps.sensitivity`. Nothing is compiled anew for it.

    Args:
      experiment: an `Experiment`, the name of a bundled one, or a TOML file.
      policy: a value or a name; None: that of the experiment.
      metrics: columns; None: the main ones.
      seeds: of the traffic; each costs a world per parameter, and two.
      seed: of the shifts.
      chunk: worlds per call; None: as memory allows.
      page: HTML page to write; None: none.
      progress: show a progress bar.

    Raises:
      ExperimentError: an experiment that cannot run, or whose random numbers are no array.
      ValueError: too few seeds, or an unknown metric; one line.
    """
    use_all_cores()
    episodes = one_experiment(experiment, "look at").episodes(policy, chunk=chunk)
    wanted = [x for x in METRICS if x in episodes.units] if metrics is None else list(metrics)
    with count_bar(progress, f"{episodes.scenario} / {episodes.policy}") as tell:
        found = _sensitivity(episodes, wanted, seeds=seeds, seed=seed, tell=tell)
    if page is not None:
        _write_sensitivity(Path(page), found, episodes.units)
    return found


def _write_sensitivity(path: Path, found: Sensitivity, units: Any) -> None:
    sections = []
    for metric, mean in found.means.items():
        effects = found.of(metric)
        chance = next(x for x in effects if x.parameter == TRAFFIC)
        rows = [[x.parameter, slope_text(x), _total(x)] for x in effects if x.parameter != TRAFFIC][
            :STRONGEST
        ]
        notes = [f"{units[metric]}. Mean {mean:.4g}. Total index of another seed: {_total(chance)}."]
        head = ("parameter", "slope", "total index")
        sections.append({"title": metric, "notes": notes, "head": head, "rows": rows})
    about = (
        f"{found.worlds:,} worlds of {found.seeds} seeds. A slope is the change of the metric if all drivers "
        "shift by a standard deviation of their population. A total index is the share of the variance that "
        "a parameter takes part in; that of another seed says how much is chance."
    )
    write_page(path, f"Sensitivity of {found.scenario}, {found.policy}", about, sections)


def _total(effect: Any) -> str:
    return f"{effect.total.estimate:.2f} [{effect.total.low:.2f}, {effect.total.high:.2f}]"
