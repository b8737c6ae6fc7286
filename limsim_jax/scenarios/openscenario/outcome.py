"""How the variants of scenarios ended, and which collisions were preventable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from limsim_jax.scenarios.openscenario.episodes import PASSED
from limsim_jax.sweeps.store import Results

CAREFUL = "r157_careful"
"""The policy that tells what is preventable: the careful driver of UN R157."""

PREFIX = "parameter_"
"""Of columns that hold parameters."""


class Variants(NamedTuple):
    """Variants of a scenario under a policy, by their seeds."""

    seed: NDArray[np.int64]
    passed: NDArray[np.bool_]
    collided: NDArray[np.bool_]
    preventable: NDArray[np.bool_] | None  # collisions that the careful driver avoids; None: it was not run
    parameters: Mapping[str, NDArray[np.float64]]
    words: Mapping[str, list[str]]  # texts for which values stand, by parameter


class Tally(NamedTuple):
    """How many variants of a scenario ended how, under a policy."""

    scenario: str
    policy: str
    variants: int
    passed: int
    collided: int
    preventable: int | None  # collisions that the careful driver avoids; None: it was not run


def variants(results: Results) -> dict[tuple[str, str], Variants]:
    """Variants of scenario files by scenario and policy; results of other sweeps have none."""
    if PASSED not in results.episodes.column_names:
        return {}
    found = {group: _variants(results, group) for group in results.provenance if _is_file(results, group)}
    for (scenario, policy), mine in found.items():
        careful = found.get((scenario, CAREFUL))
        if careful is not None and _alike(results, scenario, policy):
            safe = careful.seed[~careful.collided]
            known = mine._replace(preventable=mine.collided & np.isin(mine.seed, safe))
            found[scenario, policy] = known
    return found


def outcome(results: Results) -> list[Tally]:
    """How many variants of each scenario ended how, by policy."""
    tallies = []
    for (scenario, policy), one in variants(results).items():
        prevented = None if one.preventable is None else int(one.preventable.sum())
        passed, collided = (int(x.sum()) for x in (one.passed, one.collided))
        tallies.append(Tally(scenario, policy, len(one.seed), passed, collided, prevented))
    return tallies


def totals(tallies: list[Tally]) -> list[Tally]:
    """The sums over all scenarios, by policy."""
    found = []
    for policy in dict.fromkeys(x.policy for x in tallies):
        mine = [x for x in tallies if x.policy == policy]
        prevented = [x.preventable for x in mine if x.preventable is not None]
        known = sum(prevented) if len(prevented) == len(mine) else None
        count, passed, collided = (sum(getattr(x, name) for x in mine) for name in Tally._fields[2:5])
        found.append(Tally("all", policy, count, passed, collided, known))
    return found


def _is_file(results: Results, group: tuple[str, str]) -> bool:
    return "openscenario" in results.provenance[group]


def _variants(results: Results, group: tuple[str, str]) -> Variants:
    rows = results.episodes
    mine = (pc.field("scenario") == group[0]) & (pc.field("policy") == group[1])
    rows = rows.filter(mine).sort_by("seed")
    names = [x for x in rows.column_names if x.startswith(PREFIX) and rows[x].null_count < len(rows)]
    wanted = ("seed", PASSED, "contacts", *names)
    columns = {name: rows[name].to_numpy(zero_copy_only=False) for name in wanted}
    return Variants(
        seed=columns["seed"],
        passed=columns[PASSED] > 0.5,
        collided=columns["contacts"] > 0,
        preventable=None,
        parameters={name.removeprefix(PREFIX): columns[name].astype(float) for name in names},
        words=results.provenance[group].get("words", {}),
    )


def _alike(results: Results, scenario: str, policy: str) -> bool:
    """Whether a seed is the same variant under the careful driver."""
    mine, other = (results.provenance[scenario, name] for name in (policy, CAREFUL))
    return all(mine.get(name) == other.get(name) for name in ("openscenario", "asked", "variants"))
