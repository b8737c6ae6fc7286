"""What a page says: the verdict, the worst episodes in words, key moments, responsibility."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from limsim_jax.metrics.moments import ORDER, RESPONSIBLE, value_text, words
from limsim_jax.report.formats import number
from limsim_jax.report.tables import CAUSES, Group, causes, columns, failed_policies, metrics_of, worst
from limsim_jax.statistics import zero_event_bound

if TYPE_CHECKING:
    from limsim_jax.sweeps.store import Results

Key = tuple[str, str, int]
"""Scenario, policy and seed."""

NOTABLE_TTC = 5.0
"""s: an episode in which nothing went wrong and the TTC stayed above this is not listed among the worst."""

WAITING = 0.1
"""Share of vehicles that never found room to enter from which the page says so."""

_GOOD, _BAD = 0.95, 0.5  # shares of success from which the verdict is good, and below which it is bad


class Names(NamedTuple):
    """How scenario and policy are written, and which flags tell them apart."""

    scenarios: tuple[str, ...]
    policies: tuple[str, ...]
    path: str

    @classmethod
    def of(cls, parts: Mapping[Group, Any], results: Results) -> Names:
        """Names in the order of the groups."""
        scenarios, policies = (tuple({group[k]: None for group in parts}) for k in (0, 1))
        return cls(scenarios, policies, str(results.path))

    @property
    def title(self) -> str:
        """Experiments and policies, or how many there are of them."""
        scenarios, policies = (
            ", ".join(names) if len(names) <= 3 else f"{len(names)} {kind}"
            for names, kind in ((self.scenarios, "scenarios"), (self.policies, "policies"))
        )
        return f"{scenarios}: {policies}"

    def label(self, group: Group) -> str:
        """One name of a scenario under a policy."""
        return f"{group[0]} / {group[1]}" if len(self.policies) > 1 else group[0]

    def head(self, group: Group) -> tuple[str, str]:
        """Scenario, and the policy if there are several."""
        return group[0], group[1] if len(self.policies) > 1 else ""

    def command(self, group: Group, seed: int | str) -> str:
        """The command that shows an episode."""
        command = ["limsim-jax", "replay", self.path]
        command += ["--scenario", group[0]] if len(self.scenarios) > 1 else []
        command += ["--policy", group[1]] if len(self.policies) > 1 else []
        return f"{shlex.join(command)} --seed {seed}"


def key_of(row: Mapping[str, Any]) -> Key:
    """Scenario, policy and seed of a row."""
    return row["scenario"], row["policy"], row["seed"]


def file_name(name: str) -> str:
    """A name that is safe in files and addresses."""
    return re.sub(r"[^A-Za-z0-9_]+", "_", name) or "_"


def anchor(row: Mapping[str, Any]) -> str:
    """The id of an episode's card."""
    return f"{file_name(row['scenario'])}-{file_name(row['policy'])}-{int(row['seed'])}"


def worst_crash(results: Results) -> dict[str, Any] | None:
    """The episode with the highest delta-v as a row of `tables.worst`."""
    if "max_delta_v" not in metrics_of(results.episodes):
        return None
    rows = worst(results, "max_delta_v", k=1).to_pylist()
    return rows[0] if rows and rows[0]["contact"] else None


def notable(row: Mapping[str, Any]) -> bool:
    """Whether a row of `tables.worst` is worth a line: something went wrong, or nearly did."""
    wrong = (
        row["policy_failed"] or row["contact"] or row["left_road"] or row["failed"] or row["kind"] is not None
    )
    return wrong or (row["min_ttc"] is not None and row["min_ttc"] < NOTABLE_TTC)


# --- what happened


def verdict(
    results: Results, parts: Mapping[Group, pa.Table], shown: set[Key], names: Names, level: float
) -> dict[str, Any]:
    """Success, contacts, the worst crash, demand that found no room.

    `mood` is "good" where nearly all episodes succeed without a contact, "bad" where the policy failed, the
    ego is at fault or most episodes are without success, and "mixed" otherwise.
    """
    episodes = sum(part.num_rows for part in parts.values())
    distance = sum(_total(part, "distance") for part in parts.values()) / 1000
    about = [
        count(len(names.scenarios), "scenario"),
        f"policy {names.policies[0]}"
        if len(names.policies) == 1
        else count(len(names.policies), "policy", "policies"),
        count(episodes, "episode"),
    ]
    if distance >= 1:
        about.append(f"{distance:,.0f} km driven by the ego")
    contacts = sum(_episodes_with(part, "contacts") for part in parts.values())
    faults = sum(_episodes_with(part, "at_fault_contacts") for part in parts.values())
    successes = _successes(parts, names)
    least = min((share for _, share in successes), default=math.nan)
    mood = "mixed"
    broken = failed_policies(results, parts)
    if faults or broken or least < _BAD:
        mood = "bad"
    elif not contacts and least >= _GOOD:
        mood = "good"
    hardest = worst_crash(results)
    crash = None
    if hardest is not None:
        name = f"{names.label((hardest['scenario'], hardest['policy']))}, seed {hardest['seed']}"
        link = anchor(hardest) if key_of(hardest) in shown else None
        crash = {"name": name, "anchor": link, "what": what(hardest), "badge": badge(hardest)}
    measured = any("contacts" in part.column_names for part in parts.values())
    bound = number(100 * zero_event_bound(episodes, level), 2)
    return {
        "mood": mood,
        "broken": [failure.text for failure in broken],
        "about": ", ".join(about),
        "successes": [(name, _percent(share)) for name, share in successes],
        "episodes": count(episodes, "episode"),
        "contacts": f"{contacts:,}" if measured else None,
        "faults": f"{faults:,}",
        "bound": None if contacts or not measured else f"{bound} %",
        "parties": _party_words(results),
        "crash": crash,
        "waiting": _waiting(parts, names),
    }


def _successes(parts: Mapping[Group, pa.Table], names: Names) -> list[tuple[str, float]]:
    """Share of success of each policy, over all scenarios."""
    found = []
    for policy in names.policies:
        own = [part for group, part in parts.items() if group[1] == policy and "success" in part.column_names]
        values = np.concatenate([columns(part, ["success"])[:, 0] for part in own]) if own else np.empty(0)
        values = values[~np.isnan(values)]
        if values.size:
            found.append((policy if len(names.policies) > 1 else "", float(values.mean())))
    return found


def _percent(share: float) -> str:
    """A share in per cent; 0 and 100 are exact."""
    text = f"{100 * share:.1f}".removesuffix(".0")
    if text == "100" and share < 1:
        text = "99.9"
    return f"{text} %"


def _waiting(parts: Mapping[Group, pa.Table], names: Names) -> list[str]:
    """Scenarios whose demand is beyond what the map takes."""
    said = []
    for group, part in parts.items():
        waiting, entered = _total(part, "traffic_waiting"), _total(part, "traffic_entered")
        if waiting > WAITING * (waiting + entered):
            said.append(f"{names.label(group)}: {waiting:,.0f} of {waiting + entered:,.0f} vehicles")
    return said


def _contacts(results: Results) -> pa.Table:
    return results.moments.filter(pc.field("kind") == "contact")


def _party_words(results: Results) -> list[tuple[str, str, str]]:
    counts = _by_party(_contacts(results))
    told = [(party, text, f"{counts[party]:,}") for party, text in RESPONSIBLE.items() if counts.get(party)]
    return told + ([("", "not told", f"{counts['']:,}")] if told and counts.get("") else [])


def _by_party(contacts: pa.Table) -> dict[str, int]:
    """Episodes by the party responsible for their worst contact; "" where that is not told."""
    first = contacts.sort_by([("rank", "ascending")]).select(["scenario", "policy", "seed", "responsible"])
    worst_of: dict[Key, str] = {}
    for row in first.to_pylist():
        worst_of.setdefault(key_of(row), row["responsible"] or "")
    counts: dict[str, int] = {}
    for party in worst_of.values():
        party = party if party in RESPONSIBLE else ""
        counts[party] = counts.get(party, 0) + 1
    return counts


def count(quantity: int, one: str, many: str = "") -> str:
    """A quantity with its noun."""
    return f"{quantity:,} {one if quantity == 1 else many or one + 's'}"


def _total(part: pa.Table, name: str) -> float:
    return float(np.nansum(columns(part, [name]))) if name in part.column_names else 0.0


def _episodes_with(part: pa.Table, name: str) -> int:
    return int((columns(part, [name]) > 0).sum()) if name in part.column_names else 0


# --- an episode in words


def kind_of_row(row: Mapping[str, Any]) -> str:
    """The kind of the worst moment of a row; a contact or "" where no moment is stored."""
    return row["kind"] or ("contact" if row["contact"] else "")


def badge(row: Mapping[str, Any]) -> dict[str, str] | None:
    """The party responsible: its class and its words."""
    party = row["responsible"]
    if party not in RESPONSIBLE:
        return None
    text = "unavoidable" if party == "unavoidable" else f"responsible: {RESPONSIBLE[party]}"
    return {"party": party, "text": text}


def what(row: Mapping[str, Any]) -> dict[str, str]:
    """What happened, in the parts of a sentence: `before` the `number` and what comes `after` it."""
    kind = kind_of_row(row)
    text = words(kind) if kind else "no success" if row["failed"] else "closest moment"
    text = text[:1].upper() + text[1:]
    if row["other"] is not None:
        text += f" with vehicle {row['other']}"
    if row["time"] is not None:
        text += f" at {row['time']:.1f} s"
    if row["reason"]:
        text += f": {row['reason']}"
    value = ""
    if row["contact"] and row["delta_v"] is not None:
        value = f"delta-v {row['delta_v']:.1f} m/s"
    elif row["value"] is not None:
        value = value_text(kind, row["value"])
    if not value and not row["contact"] and not row["reason"] and row["min_ttc"] is not None:
        text += f", least TTC {row['min_ttc']:.2f} s"
    after = ""
    if row["contact"] and row["at_fault"] and row["responsible"] == "other":
        after = ", at fault by nuPlan's rules"
    return {"before": text, "number": value, "after": after, "module": row["module"] or ""}


def card(
    row: Mapping[str, Any],
    names: Names,
    *,
    views: list[dict[str, str]],
    fault: str,
    replay: str | None,
) -> dict[str, Any]:
    """A card of one of the worst episodes."""
    group = (row["scenario"], row["policy"])
    able = [
        f"by {party}: {'yes' if row[name] else 'no'}"
        for party, name in (("the ego", "avoidable_by_ego"), ("the other vehicle", "avoidable_by_other"))
        if row[name] is not None
    ]
    return {
        "anchor": anchor(row),
        "views": views,
        "fault": fault,
        "name": f"{names.label(group)}, seed {row['seed']}",
        "badge": badge(row),
        "what": what(row),
        "avoidable": "; ".join(able),
        "replay": replay,
        "command": names.command(group, row["seed"]),
    }


def worst_row(row: Mapping[str, Any], replay: str | None, names: Names) -> dict[str, Any]:
    """A row of the table of worst episodes."""
    kind = kind_of_row(row)
    return {
        "place": row["place"],
        "name": names.label((row["scenario"], row["policy"])),
        "seed": row["seed"],
        "replay": replay,
        "kind": words(kind) if kind else "no success" if row["failed"] else "",
        "numbers": [
            (None, "") if row[name] is None else (f"{row[name]:.9g}", f"{row[name]:.{digits}f}")
            for name, digits in (("time", 1), ("delta_v", 1), ("min_ttc", 2))
        ],
        "party": row["responsible"] if row["responsible"] in RESPONSIBLE else "",
        "at_fault": row["at_fault"],
        "module": row["module"] or "",
    }


# --- why episodes fail

FIRST = 6
"""Seeds of a cause that a page names."""


def failures(parts: Mapping[Group, pa.Table], replays: Mapping[Key, str]) -> list[dict[str, Any]]:
    """Episodes without success by cause: number, share, and the first seeds with their replays."""
    found = {group: causes(part) for group, part in parts.items()}
    rows = []
    for name, text in CAUSES.items():
        cells = []
        for group, part in parts.items():
            which = np.flatnonzero(found[group] == name)
            seeds = list(dict.fromkeys(part["seed"].take(which).to_pylist()))
            # those with a replay first
            seeds.sort(key=lambda seed: (*group, seed) not in replays)
            share = f"{number(100 * which.size / part.num_rows, 2)} %" if which.size else ""
            links = [(seed, replays.get((*group, seed))) for seed in seeds[:FIRST]]
            cells.append({"number": f"{which.size:,}", "share": share, "seeds": links})
        if any(cell["seeds"] for cell in cells):
            rows.append({"label": text, "cells": cells})
    return rows


# --- key moments


def moments(results: Results, parts: Mapping[Group, pa.Table]) -> list[dict[str, Any]]:
    """Episodes with a moment of each kind: number and share in every column."""
    keys = ["scenario", "policy", "seed", "kind"]
    episodes = results.moments.select(keys).group_by(keys).aggregate([])
    counted = episodes.group_by(["scenario", "policy", "kind"]).aggregate([("seed", "count")]).to_pylist()
    counts = {((r["scenario"], r["policy"]), r["kind"]): r["seed_count"] for r in counted}
    kinds = [kind for kind in ORDER if any(k == kind for _, k in counts)]
    kinds += sorted({kind for _, kind in counts} - set(kinds))
    rows = []
    for kind in kinds:
        numbers = [(counts.get((group, kind), 0), part.num_rows) for group, part in parts.items()]
        cells = [(f"{n:,}", f"{number(100 * n / total, 2)} %") for n, total in numbers]
        rows.append({"label": words(kind), "cells": cells})
    return rows


def responsible_counts(results: Results, parts: Mapping[Group, pa.Table], names: Names) -> dict[str, Any]:
    """Contacts by responsible party, a row for each column of the page; and modules of the policy."""
    contacts, rows = _contacts(results), []
    parties = (*RESPONSIBLE, "")
    for group in parts:
        own = contacts.filter((pc.field("scenario") == group[0]) & (pc.field("policy") == group[1]))
        counts = _by_party(own)
        if counts:
            numbers = [(party, counts.get(party, 0)) for party in parties]
            rows.append({"label": names.label(group), "numbers": numbers, "total": sum(counts.values())})
    modules = results.moments.filter(pc.field("module").is_valid())
    counted = modules.group_by(["kind", "module"]).aggregate([("seed", "count")])
    ranked = counted.sort_by([("seed_count", "descending")]).to_pylist()
    found = [(str(row["module"]), f"{row['seed_count']:,}", words(str(row["kind"]))) for row in ranked]
    return {"parties": list(RESPONSIBLE), "rows": rows, "modules": found if rows else []}
