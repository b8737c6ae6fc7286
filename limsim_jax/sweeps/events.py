"""Events of an episode, with a limit state: how far a world is from the event.

The limit state is 0 or less where the event happened, and otherwise leads there: the nearer, the smaller. It
orders the worlds of a search; the probability hangs on the event alone.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Columns = Mapping[str, NDArray[np.float64]]

FAR = 10.0
"""s, time to collision from which on the distance to others alone counts."""

PACE = 10.0
"""m/s, what turns the least distance to others into s."""

FARTHEST = 1e3
"""Limit state of a world in which nothing leads to the event."""

_TOUCHED = 1e-3
"""m/s, added to the impact of a contact, which may be 0."""

_BLAMELESS = 1.0
"""s, least limit state of a contact that is not at fault. Such worlds lead nowhere: those nearer to a contact
of their own must come before them."""

_CONDITION = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_]*)\s*(<=|>=|<|>)\s*(\S+)\s*")


@dataclass(frozen=True)
class Event:
    """An event of an episode.

    Attributes:
      name: as the user writes it.
      meaning: in words.
      limit: the limit state `[R]` of the rows of columns.
      columns: that it reads.
    """

    name: str
    meaning: str
    limit: Callable[[Columns], NDArray[np.float64]]
    columns: tuple[str, ...]


def _urgency(columns: Columns) -> NDArray[np.float64]:
    """s: least time to collision, and the least distance on top.

    Vehicles that pass side by side have a time to collision of 0 for long; the distance tells them apart.
    """
    ttc, distance = columns["min_ttc"], columns["min_distance"]
    ttc = np.where(ttc < FAR, ttc, FAR)  # absent: nothing ever came near
    distance = np.where(np.isnan(distance), FARTHEST, distance)
    return np.maximum(ttc + distance / PACE, 1e-6)


def _contact(columns: Columns) -> NDArray[np.float64]:
    hit = columns["contacts"] > 0
    impact = np.nan_to_num(columns["max_delta_v"])
    return np.where(hit, -impact - _TOUCHED, _urgency(columns))


def _fault(columns: Columns) -> NDArray[np.float64]:
    at_fault = columns["at_fault_contacts"] > 0
    impact = np.nan_to_num(columns["max_delta_v"])
    return np.where(at_fault, -impact - _TOUCHED, np.maximum(_urgency(columns), _BLAMELESS))


_NAMED = {
    "contact": ("the ego touches another body", _contact, "contacts"),
    "fault": ("the ego touches another body by its own fault (nuPlan's rules)", _fault, "at_fault_contacts"),
}
_URGENT = ("min_ttc", "min_distance", "max_delta_v")


def event_of(name: str, units: Mapping[str, str]) -> Event:
    """The event of a name, or of a condition such as "min_ttc<1".

    Args:
      name: "contact", "fault", or a metric, `<`, `<=`, `>` or `>=`, and a number.
      units: what the metrics mean.

    Raises:
      ValueError: an unknown name or metric, or what is no number; one line.
    """
    known = ", ".join(_NAMED)
    if name in _NAMED:
        meaning, limit, column = _NAMED[name]
        missing = [x for x in (column, *_URGENT) if x not in units]
        if missing:
            raise ValueError(f"event: '{name}' is of an ego, and the experiment has none")
        return Event(name, meaning, limit, (column, *_URGENT))
    found = _CONDITION.fullmatch(name)
    if found is None:
        raise ValueError(f"event: '{name}'; known are {known}, and conditions such as min_ttc<1")
    metric, sign, text = found.groups()
    if metric not in units:
        close = difflib.get_close_matches(metric, list(units), 3, 0.5)
        hint = f"did you mean {' or '.join(close)}?" if close else "the page of metrics lists all"
        raise ValueError(f"event: no metric '{metric}'; {hint}")
    try:
        bound = float(text)
    except ValueError:
        bound = np.nan
    if not np.isfinite(bound):
        raise ValueError(f"event: '{text}' in '{name}' is no number")
    strict, side = len(sign) == 1, 1.0 if "<" in sign else -1.0

    def limit(columns: Columns) -> NDArray[np.float64]:
        value = side * (columns[metric] - bound)
        value = np.where(strict & (value == 0), np.finfo(float).tiny, value)
        return np.where(np.isnan(value), FARTHEST, value)

    return Event(f"{metric}{sign}{text}", f"{metric} {sign} {bound:g}: {units[metric]}", limit, (metric,))
