"""Answers of a language model in a replay, each at its moment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from limsim_jax.policies.language.store import Answer


def answer_rows(answers: Iterable[Answer]) -> list[dict[str, Any]]:
    """What the viewer shows of answers: one row per decision, with the steps of a graph before it."""
    rows: list[dict[str, Any]] = []
    steps: list[dict[str, str]] = []
    for answer in answers:
        if not answer.decides:
            steps.append({"node": answer.node, "text": answer.text or answer.error})
            continue
        spent = [
            "known already" if answer.cached else f"{answer.calls} call{'s' if answer.calls != 1 else ''}",
            f"{answer.latency:.2f} s",
            f"{answer.prompt_tokens} + {answer.answer_tokens} tokens",
        ]
        rows.append(
            {
                "time": answer.time,
                "action": answer.action,
                "status": answer.status.value,
                "good": answer.status in ("ok", "repaired"),
                "text": answer.text or answer.error,
                "scene": answer.scene,
                "spent": ", ".join(spent[: 1 if not answer.calls else 3]),
                "prompt": answer.prompt[:12],
                "steps": steps,
            }
        )
        steps = []
    return rows
