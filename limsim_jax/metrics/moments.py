"""Key moments of an episode: their kinds, words, units and order of severity.

The one table that episodes, reports and replays share.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Moment(NamedTuple):
    """A kind of key moment."""

    words: str
    value: str = ""
    """Format of its value with the unit; empty where the number says nothing by itself."""


KINDS: Mapping[str, Moment] = MappingProxyType(
    {
        "policy_failed": Moment("policy failed"),
        "contact": Moment("contact", "delta-v {:.1f} m/s"),
        "off_road": Moment("off the road"),
        "red_light": Moment("red light run"),
        "near_miss": Moment("near miss", "TTC {:.2f} s"),
        "hard_brake": Moment("hard braking", "{:.1f} m/s²"),
        "unsafe": Moment("unsafe distance (RSS)"),
        "score_drop": Moment("drop of the score", "{:.0f} of 100"),
    }
)
"""Kinds of key moments, the most severe first."""

ORDER = tuple(KINDS)
"""Names of the kinds, the most severe first."""

RESPONSIBLE: Mapping[str, str] = MappingProxyType(
    {
        "ego": "the ego",
        "other": "the other vehicle",
        "shared": "both",
        "unavoidable": "neither (unavoidable)",
    }
)
"""Parties responsible for a contact (`blame.Responsibility`, in lower case), in words."""


def words(kind: str) -> str:
    """A kind in words; a kind that is not in the table is its own name."""
    known = KINDS.get(kind)
    return kind.replace("_", " ") if known is None else known.words


def value_text(kind: str, value: float) -> str:
    """The value of a moment with its unit; empty where the number says nothing by itself."""
    known = KINDS.get(kind)
    return (Moment(kind, "{:.3g}") if known is None else known).value.format(value)
