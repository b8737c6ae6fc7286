"""Descriptions of the columns of results: meaning, formula, source, place in a report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

Better = Literal["higher", "lower", "neither"]
"""Which values are better."""

Kind = Literal["mean", "proportion", "label", "rate"]
"""How seeds are summed up: a mean, a share of 0 and 1, not at all (a slot, a type), events per distance."""

Section = Literal[
    "Drive and rules", "Safety", "Comfort", "Scores", "Language model", "Traffic", "Own metrics"
]
"""Part of the report."""

SECTIONS: tuple[Section, ...] = (
    "Drive and rules",
    "Safety",
    "Comfort",
    "Scores",
    "Language model",
    "Traffic",
    "Own metrics",
)
"""In the order of the report."""


class Headline(NamedTuple):
    """A row of the short list of results."""

    place: int  # in the list
    label: str
    statistic: Literal["estimate", "median"] = "estimate"
    unit: str = ""
    scale: float = 1.0
    plain: bool = False  # only in the list of plain traffic, which has no ego
    rare: bool = False  # only where it happened


class Plot(NamedTuple):
    """The distribution of a metric in a report."""

    label: str
    unit: str


@dataclass(frozen=True)
class Description:
    """One column of results.

    Attributes:
      name: of the column.
      meaning: unit and meaning; of a share of episodes "1 if ...".
      section: part of the report.
      better: which values are better.
      kind: how seeds are summed up.
      formula: how it is computed.
      source: where the definition comes from; empty where it is this package's own.
      missing: when an episode has no value, besides an ego that was never on the road.
      headline: its row in the short list, or None.
      plot: its distribution in the report, or None.
      of: the column that a derived metric follows from; empty for columns.
    """

    name: str
    meaning: str
    section: Section
    better: Better = "neither"
    kind: Kind = "mean"
    formula: str = ""
    source: str = ""
    missing: str = ""
    headline: Headline | None = None
    plot: Plot | None = None
    of: str = ""

    @property
    def sign(self) -> int:
        """1 if higher values are better, -1 if lower ones, 0 otherwise."""
        return {"higher": 1, "lower": -1, "neither": 0}[self.better]

    @property
    def share(self) -> bool:
        """Whether it is 0 or 1 in every episode."""
        return self.kind == "proportion"
