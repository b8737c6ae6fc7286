"""Failures of a sweep grouped by what happened, one representative of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.metrics.blame import ContactType, Responsibility
from limsim_jax.metrics.moments import RESPONSIBLE
from limsim_jax.report.templates import read, render
from limsim_jax.statistics import Interval, wilson
from limsim_jax.sweeps.store import Results

KINDS: Mapping[str, str] = {
    "policy_failed": "the policy failed",
    "contact": "contact",
    "off_road": "off the road",
    "red_light": "ran a red light",
    "out_of_time": "out of time",
    "criteria": "missed the criteria of success",
}
"""What happened in an episode, the first that holds, in words."""

CONTACTS: Mapping[int, str] = {
    ContactType.STOPPED_EGO: "the ego stood and was hit",
    ContactType.STOPPED_OTHER: "the ego hit a vehicle that stood",
    ContactType.FRONT: "the ego hit a moving vehicle with its front",
    ContactType.REAR: "the ego was hit from behind",
    ContactType.LATERAL: "side to side",
}
"""Types of contacts in words."""

_TIMES = {"contact": "contact_time", "off_road": "off_road_time", "red_light": "red_light_time",
          "policy_failed": "policy_failed_time"}  # fmt: skip
_FEATURES = ("max_delta_v", "min_ttc", "mean_speed", "distance", "completion")


class Member(NamedTuple):
    """An episode of a group."""

    seed: int
    ego: int
    time: float  # s, when it happened; NaN where it has no moment


@dataclass(frozen=True)
class Cluster:
    """Episodes in which the same happened.

    Attributes:
      scenario, policy: of the sweep.
      kind: of `KINDS`.
      words: what happened.
      members: episodes, by seed.
      typical: the one in the middle of the others.
      share: of all episodes.
    """

    scenario: str
    policy: str
    kind: str
    words: str
    members: tuple[Member, ...]
    typical: Member
    share: Interval


def clusters_of(stored: Results, scenario: str, policy: str) -> list[Cluster]:
    """Failures of a scenario under a policy in groups, the largest first."""
    table = stored.episodes
    rows = [row for row in table.to_pylist() if row["scenario"] == scenario and row["policy"] == policy]
    if not rows or "contacts" not in rows[0]:
        return []
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        kind = _kind(row)
        if kind is not None:
            groups.setdefault((kind, _words(kind, row)), []).append(row)
    found = []
    for (kind, words), some in groups.items():
        members = [Member(row["seed"], row["ego"], _number(row, _TIMES.get(kind, ""))) for row in some]
        typical = members[_middle(some, _TIMES.get(kind))]
        share = wilson(len(some), len(rows))
        found.append(Cluster(scenario, policy, kind, words, tuple(members), typical, share))
    return sorted(found, key=lambda x: (-len(x.members), list(KINDS).index(x.kind), x.words))


def _number(row: Mapping[str, Any], name: str) -> float:
    value = row.get(name)
    return float("nan") if value is None else float(value)


def _kind(row: Mapping[str, Any]) -> str | None:
    """What happened, or None where nothing failed."""
    if _number(row, "policy_failed") > 0:
        return "policy_failed"
    for name, column in (("contact", "contacts"), ("off_road", "off_road"), ("red_light", "red_lights")):
        if _number(row, column) > 0:
            return name
    if _number(row, "success") == 0:
        return "out_of_time" if _number(row, "out_of_time") > 0 else "criteria"
    return None


def _words(kind: str, row: Mapping[str, Any]) -> str:
    if kind != "contact":
        return KINDS[kind]
    how = CONTACTS.get(int(np.nan_to_num(_number(row, "contact_type"))), KINDS["contact"])
    party = int(np.nan_to_num(_number(row, "contact_responsibility")))
    known = party in list(Responsibility) and party != Responsibility.NONE
    return f"{how}; responsible: {RESPONSIBLE[Responsibility(party).name.lower()]}" if known else how


def _middle(rows: Sequence[Mapping[str, Any]], time: str | None) -> int:
    """The row nearest to all others, each feature by its spread."""
    names = [*_FEATURES, *([time] if time else [])]
    x = np.array([[_number(row, name) for name in names] for row in rows])
    x = x[:, ~np.isnan(x).all(0)]
    x = np.where(np.isnan(x), np.nanmedian(x, 0) if x.size else 0.0, x)
    spread = x.std(0)
    x = (x / np.where(spread > 0, spread, 1))[:2000]
    apart: NDArray[np.float64] = np.abs(x[:, None] - x[None]).sum((1, 2))
    return int(apart.argmin())


class Finding(NamedTuple):
    """A group, and what was found about its representative."""

    cluster: Cluster
    change: str  # the least change that makes it go away, in words
    replay: str  # path of the replay from the page; "": none


def rows_of(findings: Sequence[Finding]) -> list[tuple[str, ...]]:
    """The table of a triage: episodes, what happened, the representative, what makes it go away."""
    found = []
    for cluster, change, _ in findings:
        share = cluster.share
        middle, low, high = (100 * x for x in share)
        many = f"{len(cluster.members)}  ({middle:.2g} % [{low:.2g}, {high:.2g}])"
        at = "" if np.isnan(cluster.typical.time) else f" at {cluster.typical.time:.1f} s"
        found.append((many, cluster.words, f"seed {cluster.typical.seed}{at}", change))
    return found


HEAD = ("episodes", "what happened", "representative", "goes away with")
"""Columns of the table."""


def write_page(path: Path, title: str, about: str, sections: Sequence[Mapping[str, Any]]) -> Path:
    """Write a page of tables.

    Args:
      path: of the page.
      title: its heading.
      about: a line below that.
      sections: each with `title`, `notes`, `head` and `rows` of cells; a cell is text, or text and a link.
    """
    text = render(
        "page/tables.html.j2", title=title, about=about, sections=sections, style=read("page/page.css")
    )
    write_whole(path, text.encode())
    return path
