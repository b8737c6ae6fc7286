"""From what a model says to an action.

`parse` climbs down a ladder: why the answer ended, JSON, the last word that is an action, synonyms.
"""

from __future__ import annotations

import enum
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from limsim_jax.traffic.ego import Meta


class CallStatus(enum.StrEnum):
    """How a question ended."""

    OK = "ok"  # an offered action
    REPAIRED = "repaired"  # an offered action, after the model was told what was wrong
    ILLEGAL = "illegal"  # no action, or one that is not offered
    TRUNCATED = "truncated"  # cut at the token limit before an action
    REFUSED = "refused"  # the model declines
    TIMEOUT = "timeout"  # no answer in time
    HTTP = "http"  # an error of the server or of the connection, or an answer that is no chat answer
    FALLBACK = "fallback"  # not asked: a cap was reached


ANSWERED = frozenset({CallStatus.OK, CallStatus.REPAIRED})
SILENT = frozenset({CallStatus.TIMEOUT, CallStatus.HTTP, CallStatus.FALLBACK})
"""Without an answer: the rules drive. After other failures the speed is kept."""

SYNONYMS: dict[str, Meta] = {
    **dict.fromkeys(("keep", "idle", "maintain", "hold", "cruise", "continue", "stay"), Meta.KEEP),
    **dict.fromkeys(("accelerate", "acceleration", "faster", "speed up", "ac"), Meta.ACCELERATE),
    **dict.fromkeys(
        ("decelerate", "deceleration", "slower", "slow down", "brake", "dc", "reduce speed"), Meta.DECELERATE
    ),
    **dict.fromkeys(("left", "turn-left", "lcl", "change left", "lane change left", "left lane"), Meta.LEFT),
    **dict.fromkeys(
        ("right", "turn-right", "lcr", "change right", "lane change right", "right lane"), Meta.RIGHT
    ),
    **dict.fromkeys(("stop", "halt", "standstill", "full stop"), Meta.STOP),
}
"""Other words for actions, in small letters."""


@dataclass(frozen=True)
class Reply:
    """What a chat server answered, without its envelope.

    Attributes:
      text: of the message.
      finish: its `finish_reason`.
      refused: the server says that the model declines.
      prompt_tokens: as the server counts.
      answer_tokens: as the server counts.
    """

    text: str
    finish: str = "stop"
    refused: bool = False
    prompt_tokens: int = 0
    answer_tokens: int = 0


def read_reply(body: Any) -> Reply | None:
    """The reply in the body of a chat answer; None if it is none.

    A call of a tool is a reply without text.
    """
    try:
        choice = body["choices"][0]
        message = choice["message"]
        content, refusal = message.get("content"), message.get("refusal")
    except (AttributeError, IndexError, KeyError, TypeError):
        return None
    if isinstance(content, list):  # parts of text
        content = "".join(str(x.get("text", "")) for x in content if isinstance(x, Mapping))
    finish = choice.get("finish_reason") or "stop"
    usage = body.get("usage")
    usage = usage if isinstance(usage, Mapping) else {}
    return Reply(
        text=content if isinstance(content, str) else "",
        finish=str(finish),
        refused=bool(refusal) or finish == "content_filter",
        prompt_tokens=_count(usage.get("prompt_tokens")),
        answer_tokens=_count(usage.get("completion_tokens")),
    )


def _count(value: Any) -> int:
    return int(value) if isinstance(value, int | float) and 0 <= value < 1e12 else 0


def parse(reply: Reply, offered: Mapping[Meta, str]) -> tuple[CallStatus, Meta | None]:
    """The action that a reply names.

    Args:
      reply: of the model.
      offered: labels of the actions that can be taken.

    Returns:
      `OK` and an offered action; or `ILLEGAL`, `TRUNCATED` or `REFUSED`, and None.
    """
    if reply.refused:
        return CallStatus.REFUSED, None
    found = None
    if reply.finish != "length":  # what was cut has not come to its decision
        found = _from_json(reply.text, offered)
        found = found if found is not None else _from_text(reply.text, offered)
    if found in offered:
        return CallStatus.OK, found
    return CallStatus.TRUNCATED if reply.finish == "length" else CallStatus.ILLEGAL, None


def _from_json(text: str, offered: Mapping[Meta, str]) -> Meta | None:
    """The field `action` of the first JSON object in the text."""
    start = text.find("{")
    while start >= 0:
        try:
            value, _ = json.JSONDecoder().raw_decode(text, start)
        except (ValueError, RecursionError):
            start = text.find("{", start + 1)
            continue
        action = value.get("action") if isinstance(value, dict) else None
        return _word(str(action), offered) if isinstance(action, str | int) else None
    return None


def _from_text(text: str, offered: Mapping[Meta, str]) -> Meta | None:
    """The action after the last `####` or `## Decision`; otherwise the last word that is one.

    Numbers are actions only after such a mark.
    """
    if text.lstrip().startswith("{"):  # JSON that is broken or has no action: no guesses from its reason
        return None
    marks = list(re.finditer(r"####|##\s*decision\b[:\s]*", text, re.IGNORECASE))
    if marks:
        tail = text[marks[-1].end() :].strip().splitlines()
        return _word(tail[0], offered) if tail else None
    words = [label for label in offered.values() if not label.isdigit()]
    for vocabulary, flags in ((words, 0), (list(SYNONYMS), re.IGNORECASE)):
        choice = "|".join(re.escape(x) for x in sorted(vocabulary, key=len, reverse=True))
        found = re.findall(rf"(?<![\w-])(?:{choice})(?![\w-])", text, flags) if choice else []
        if found:
            return _word(found[-1], offered)
    return None


def _word(text: str, offered: Mapping[Meta, str]) -> Meta | None:
    """The action of one word or number."""
    word = re.sub(r"^[\W_]+|[\W_]+$", "", text.strip().lower())
    labels = {label.lower(): action for action, label in offered.items()}
    return labels.get(word, SYNONYMS.get(word))


def schema(offered: Mapping[Meta, str]) -> dict[str, Any]:
    """The JSON schema of an answer: a reason, then one of the offered actions."""
    return {
        "type": "object",
        "additionalProperties": False,
        "required": ["reason", "action"],
        "properties": {
            "reason": {"type": "string", "maxLength": 80},
            "action": {"type": "string", "enum": list(offered.values())},
        },
    }
