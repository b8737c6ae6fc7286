"""`exposure`: how long egos are in each cell of their operational design domain."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from limsim_jax.api.experiment import Experiment, one_experiment
from limsim_jax.api.progress import count_bar
from limsim_jax.api.world import World
from limsim_jax.files import write_whole
from limsim_jax.metrics.domain import domain_of
from limsim_jax.report.exposure import write_page
from limsim_jax.sweeps.coverage import greedy_cover
from limsim_jax.sweeps.exposure import WAYS, Counter, Exposure
from limsim_jax.sweeps.exposure import exposure as _exposure
from limsim_jax.xla import use_all_cores

if TYPE_CHECKING:
    from limsim_jax.policies.base import PolicyLike


def exposure(
    experiment: Experiment | str | Path,
    *,
    policy: PolicyLike | str | None = None,
    seeds: int | Sequence[int] = 50,
    dimensions: Sequence[str] | None = None,
    edges: Mapping[str, Sequence[float]] | None = None,
    search: int = 0,
    chunk: int | None = None,
    out: str | Path | None = None,
    replays: int = 0,
    progress: bool = True,
) -> Exposure:
    """How long egos are in each cell of their operational design domain.

        found = lj.exposure("highway", policy=lj.PDMClosed(), seeds=200)
        found.over("speed", "gap").uncovered()

    A cell is a bin of speed, gap to the leader, TTC with the leader, manoeuvre and kind of road; see
    `metrics.domain`. Steps are counted while the worlds run. No other metric is measured, so that worlds are
    cheap.

    Args:
      experiment: an `Experiment`, the name of a bundled one, or a TOML file.
      policy: a value or a name; None: that of the experiment.
      seeds: how many, or which.
      dimensions: of "speed", "gap", "ttc", "manoeuvre", "road"; None: all.
      edges: of bins, by dimension, in m/s, m and s; None: those of `metrics.domain`.
      search: further seeds, at most, that run to reach cells not covered. They do not count as exposure.
      chunk: worlds per call; None: as memory allows.
      out: folder for `exposure.json` and the page `exposure.html`; None: none.
      replays: worlds whose replays are written to `out`: those with the most rare cells.
      progress: show a progress bar.

    Raises:
      ExperimentError: an experiment that cannot run; one line.
      ValueError: unknown dimensions, edges that do not rise, seeds out of range, or no ego; one line.
    """
    domain = domain_of(dimensions, edges)
    chosen = _seeds(seeds)
    for name, value in (("search", search), ("replays", replays)):
        if value < 0:
            raise ValueError(f"{name}: {value}; at least 0")
    one = one_experiment(experiment, "look at")
    use_all_cores()
    episodes = one.episodes(policy, chunk=chunk)
    with count_bar(progress, f"{episodes.scenario} / {episodes.policy}") as tell:
        found, counter = _exposure(episodes, domain, chosen, search=search, tell=tell)

    def again(seed: int, ego: int) -> World:
        return _world(counter, seed, ego)

    found = replace(found, again=again)
    if out is not None:
        write(found, out, replays=replays)
    return found


def _seeds(seeds: int | Sequence[int]) -> list[int]:
    if isinstance(seeds, int) and not 1 <= seeds <= 2**31:
        raise ValueError(f"seeds: {seeds}; between 1 and 2^31")
    chosen = list(range(seeds)) if isinstance(seeds, int) else [int(seed) for seed in seeds]
    if not chosen:
        raise ValueError("seeds: none; at least one is needed")
    if min(chosen) < 0 or max(chosen) >= 2**31:
        raise ValueError(f"seeds: from {min(chosen)} to {max(chosen)}; they must be within 0 and 2^31 - 1")
    if len(set(chosen)) < len(chosen):
        raise ValueError("seeds: one is there twice; every world counts once")
    return chosen


def _world(counter: Counter, seed: int, ego: int) -> World:
    """A world of an exposure, every step of it."""
    episodes = counter.episodes
    if not 0 <= ego < episodes.egos:
        raise ValueError(f"ego {ego}: the experiment has egos 0 to {episodes.egos - 1}")
    trace = counter.trace(seed)
    return World(episodes.scenario, episodes.policy, seed, ego, episodes.town, trace, {}, [])


def write(found: Exposure, out: str | Path, *, replays: int = 0) -> Path:
    """Write `exposure.json`, replays and the page `exposure.html`.

    Args:
      found: what is written.
      out: the folder; made where it is not there.
      replays: how many worlds are written, those with the most rare cells first.

    Returns:
      The page.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / "exposure.json", (json.dumps(found.as_json()) + "\n").encode())
    links = {}
    for seed in _telling(found)[:replays]:
        name = f"replays/{found.scenario}-{found.policy}-{seed}.html"
        found.replay(seed).save(out / name)
        links[seed] = quote(name)
    return write_page(out / "exposure.html", found, links)


def _telling(found: Exposure) -> list[int]:
    """Seeds that together reach all rare cells of pairs, the best first."""
    import numpy as np

    pairs = [
        (visit.seed, (*part.domain.names, *cell.values()))
        for part in found.parts(WAYS)
        for cell, visits in part.rare()
        for visit in visits
    ]
    numbers = {cell: k for k, cell in enumerate(dict.fromkeys(cell for _, cell in pairs))}
    world = np.array([seed for seed, _ in pairs], np.int64)
    return [seed for seed, _ in greedy_cover(world, np.array([numbers[x] for _, x in pairs], np.int64))]
