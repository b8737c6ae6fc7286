"""Columns of an ego that a language model drives: how its questions ended, and what they took.

A drive by the rules is no drive of the model, so that the shares of each status stand in every table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from limsim_jax.metrics.description import Description, Headline
from limsim_jax.policies.language.answers import CallStatus
from limsim_jax.policies.language.store import Answer, shares

_PLACE = 21  # of the first row in the short list
_MISSING = "no model was asked"
_MEANINGS = {
    CallStatus.OK: "with an offered action at once",
    CallStatus.REPAIRED: "with an offered action after the model was told what was wrong",
    CallStatus.ILLEGAL: "without an offered action; the speed was kept",
    CallStatus.TRUNCATED: "cut at the token limit; the speed was kept",
    CallStatus.REFUSED: "that the model declined; the speed was kept",
    CallStatus.TIMEOUT: "without an answer in time; the rules drove",
    CallStatus.HTTP: "that ended in an error of the server; the rules drove",
    CallStatus.FALLBACK: "beyond the caps; the rules drove",
}


def _status(place: int, status: CallStatus) -> Description:
    rare = status is not CallStatus.OK
    return Description(
        f"language_{status.value}", f"share of the decisions {_MEANINGS[status]}", "Language model",
        "higher" if status is CallStatus.OK else "lower",
        formula=f"Decisions of status {status.value} / language_questions.",
        missing=_MISSING,
        headline=Headline(_PLACE + place, f"answers: {status.value}", unit="%", scale=100.0, rare=rare),
    )  # fmt: skip


def _spent(name: str, meaning: str, formula: str, label: str = "", place: int = 0) -> Description:
    headline = Headline(_PLACE + len(CallStatus) + place, label, rare=True) if label else None
    return Description(
        f"language_{name}", meaning, "Language model", "lower", formula=formula, missing=_MISSING,
        headline=headline,
    )  # fmt: skip


LANGUAGE = (
    Description(
        "language_questions", "decisions for which a model was to be asked", "Language model",
        formula="Decisions.", missing=_MISSING,
    ),
    *(_status(place, status) for place, status in enumerate(CallStatus)),
    Description(
        "language_cached", "share of the decisions for which all replies were known already",
        "Language model",
        formula="Decisions without a call and with a reply / language_questions.", missing=_MISSING,
        headline=Headline(_PLACE + len(CallStatus), "answers: known", unit="%", scale=100.0, rare=True),
    ),
    _spent("calls", "HTTP requests, retries and repairs included", "Sum.", "calls of the model", 1),
    _spent("prompt_tokens", "tokens of the prompts, as the server counts", "Sum over calls."),
    _spent("answer_tokens", "tokens of the answers, as the server counts", "Sum over calls.",
           "tokens of its answers", 2),
    _spent("cost", "in the currency of the prices", "Tokens times prices.", "cost of the calls", 3),
    _spent("latency", "s of wall clock that a call took, retries included", "Mean over calls."),
)  # fmt: skip
"""Columns, in order."""

METERED = frozenset(
    f"language_{name}" for name in ("cached", "calls", "prompt_tokens", "answer_tokens", "cost", "latency")
)
"""Columns that tell of a run, not of a world: a rerun from a cache has others. No digest contains them."""


def language_columns(answers: Sequence[Sequence[Answer]]) -> dict[str, NDArray[np.float64]]:
    """The columns `LANGUAGE` of rows.

    Args:
      answers: of each row.

    Returns:
      Arrays `[R]`; NaN where no model was asked.
    """
    rows = []
    for mine in answers:
        found = shares(mine)
        count = found["questions"]
        for name in ("calls", "prompt_tokens", "answer_tokens", "cost"):  # of the episode, not per decision
            found[name] *= count
        if not found["calls"]:
            found["latency"] = math.nan
        rows.append(found if count else dict.fromkeys(found, math.nan))
    names = (x.name for x in LANGUAGE)
    return {name: np.array([row[name.removeprefix("language_")] for row in rows], float) for name in names}
