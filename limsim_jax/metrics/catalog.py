"""All metrics of an episode, described: `catalog` lists the columns, `DERIVED` what reports make of them.

Names, units, the sections and the short list of a report, and the page of metrics in the documentation all
come from here. Each built-in metric is described beside its computation, in `metrics.measures` and
`metrics.traffic`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from limsim_jax.metrics import ego, traffic
from limsim_jax.metrics.answers import LANGUAGE
from limsim_jax.metrics.description import Better, Description, Headline, Kind
from limsim_jax.metrics.measure import Metric


def _total(name: str, meaning: str, better: Better, kind: Kind = "mean", label: str = "") -> Description:
    headline = Headline(15, label) if label else None
    return Description(f"traffic_{name}", meaning, "Traffic", better, kind, headline=headline)


TOTALS = (
    _total("entered", "vehicles, those of the start included", "neither"),
    _total("left", "vehicles that reached their goals", "higher"),
    _total("waiting", "vehicles still outside for want of room", "lower"),
    _total("full", "decisions at which a vehicle could not enter for want of a slot", "lower"),
    _total(
        "collided", "vehicles that touched another, the ego included", "lower",
        label="vehicles that collided, per episode",
    ),
    _total("ran_red", "vehicles that crossed a stop line on red", "lower"),
    _total("missed", "vehicles that took another goal for want of a gap to change lanes", "lower"),
    _total("gridlock", "1 if a vehicle got on less than 5 m in two minutes", "lower", "proportion"),
)  # fmt: skip
"""Columns from the totals of a world, each named as its field of `Totals` with `traffic_` in front."""

EGO = ego.DESCRIPTIONS
"""Columns of an ego."""

TRAFFIC = traffic.DESCRIPTIONS
"""Columns of the traffic."""


def catalog(own: Sequence[Metric] = ()) -> tuple[Description, ...]:
    """Every column of an episode, in order.

    Of the ego, the traffic, a language model that drives, then metrics of one's own."""
    return (*EGO, *TRAFFIC, *TOTALS, *LANGUAGE, *(metric.description for metric in own))


_PERCENT = {"unit": "%", "scale": 100.0}

DERIVED = (
    Description(
        "had_contact", "1 if the ego touched another body", "Safety", "lower", "proportion",
        formula="contacts > 0.",
        headline=Headline(4, "episodes with a contact", **_PERCENT),
        of="contacts",
    ),
    Description(
        "had_at_fault_contact", "1 if it did by its own fault by nuPlan's rules", "Safety", "lower",
        "proportion",
        formula="at_fault_contacts > 0.",
        headline=Headline(5, "contacts at fault (nuPlan)", **_PERCENT),
        of="at_fault_contacts",
    ),
    Description(
        "had_near_miss", "1 if the TTC fell below 1.5 s and no contact came of it", "Safety", "lower",
        "proportion",
        formula="near_misses > 0.",
        headline=Headline(7, "episodes with a near miss", **_PERCENT),
        of="near_misses",
    ),
    Description(
        "left_road", "1 if the ego was off the drivable area", "Drive and rules", "lower", "proportion",
        formula="off_road > 0.",
        headline=Headline(8, "episodes off the road", **_PERCENT),
        of="off_road",
    ),
    Description(
        "ran_red_light", "1 if the ego crossed a stop line on red", "Drive and rules", "lower", "proportion",
        formula="red_lights > 0.",
        headline=Headline(9, "episodes with a red light run", **_PERCENT),
        of="red_lights",
    ),
    Description(
        "crashes_per_1000_km", "episodes with a contact, per 1,000 km that the ego drove", "Safety", "lower",
        "rate",
        formula="Episodes with contacts > 0 / sum of distance.",
        headline=Headline(6, "crashes per 1,000 km"),
        of="contacts",
    ),
    Description(
        "at_fault_crashes_per_1000_km", "those by the ego's fault by nuPlan's rules, per 1,000 km", "Safety",
        "lower",
        "rate",
        formula="Episodes with at_fault_contacts > 0 / sum of distance.",
        of="at_fault_contacts",
    ),
)  # fmt: skip
"""Shares and rates of a set of episodes, from the columns `of` which they are."""

_KNOWN = {column.name: column for column in (*catalog(), *DERIVED)}


def describe(name: str, meaning: str = "") -> Description:
    """The description of a metric by its name; of an unknown one, what its meaning tells.

    Results on disk keep names and meanings, also of metrics that this version does not have.
    """
    if name in _KNOWN:
        return _KNOWN[name]
    kind: Kind = "mean"
    if meaning.startswith(("1 if", "0 or 1")):
        kind = "proportion"
    elif meaning.startswith(("blame.", "slot")):
        kind = "label"
    told = re.search(r"; (higher|lower) is better$", meaning)
    better: Any = told[1] if told else "neither"
    section = "Traffic" if name.startswith("traffic_") else "Own metrics"
    return Description(name, meaning, section, better, kind)


def headlines() -> tuple[Description, ...]:
    """The metrics of the short list, in its order."""
    chosen = [(column.headline.place, column) for column in _KNOWN.values() if column.headline is not None]
    return tuple(column for _, column in sorted(chosen, key=lambda row: row[0]))
