"""Numbers for readers: as many digits as the interval is wide, one interval each, no powers of ten."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_FINEST = 4  # decimals


def number(value: float, digits: int = 3) -> str:
    """A number with significant `digits`, commas, and at most 4 decimals."""
    if value == 0 or not math.isfinite(value):
        return f"{value + 0.0:.0f}"
    size = math.floor(math.log10(abs(value)))
    text = f"{value:,.{min(max(digits - 1 - size, 0), _FINEST)}f}"
    if float(text.replace(",", "")) == 0:
        return f"< {10.0**-_FINEST:.{_FINEST}f}" if value > 0 else f"> -{10.0**-_FINEST:.{_FINEST}f}"
    return text


def with_bounds(value: float, low: float | None, high: float | None, scale: float = 1.0) -> tuple[str, str]:
    """A number and its bounds, `[low, high]`; the bounds are empty where they are not known or equal."""
    if low is None or high is None:
        return number(scale * value), ""
    width = scale * (high - low)
    if not width > 0:
        text = number(scale * value, 4)
        return (text.rstrip("0").rstrip(".") if "." in text else text), ""
    digits = min(max(1 - math.floor(math.log10(width)), 0), _FINEST)
    texts = [f"{round(scale * x, digits) + 0.0:,.{digits}f}" for x in (value, low, high)]
    return texts[0], f"[{texts[1]}, {texts[2]}]"


def number_text(value: float, low: float | None, high: float | None, scale: float = 1.0) -> str:
    """A number with its bounds in one text."""
    return " ".join(filter(None, with_bounds(value, low, high, scale)))


def estimate_text(row: Mapping[str, Any], statistic: str = "estimate", scale: float = 1.0) -> tuple[str, str]:
    """The estimate of a row of the summary, and its one interval.

    The interval is one-sided where something happened in no episode, or in all of them.

    Args:
      row: of `tables.summary`, with a value.
      statistic: "estimate" or "median".
      scale: factor of all numbers.
    """
    if statistic == "median":
        return with_bounds(row["median"], row["median_lower"], row["median_upper"], scale)
    if row["bound"] is None:
        return with_bounds(row["estimate"], row["lower"], row["upper"], scale)
    value = number(scale * row["estimate"])
    if row["kind"] == "mean":
        return value, f"(above 0 in at most {number(100 * row['bound'], 2)} %)"
    side = "at least" if row["kind"] == "proportion" and row["estimate"] else "at most"
    return value, f"({side} {number(scale * row['bound'], 2)})"


def p_text(p: float) -> str:
    """A p-value."""
    return "< 0.0001" if p < 1e-4 else f"{p:.4f}"
