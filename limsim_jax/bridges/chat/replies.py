"""What a chat server sends: answers of models, and errors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple


class Sent(NamedTuple):
    """An HTTP answer; text is sent as HTML."""

    status: int
    body: Any
    headers: Mapping[str, str] = {}


def completion(
    content: Any, finish: str = "stop", *, tokens: tuple[int, int] = (0, 0), **fields: Any
) -> dict[str, Any]:
    """The body of an answer.

    Args:
      content: text of the message, or None.
      finish: why it ended.
      tokens: of prompt and answer.
      fields: more of the message, such as `refusal`.
    """
    return {
        "object": "chat.completion",
        "choices": [
            {
                "index": 0,
                "message": {"role": "assistant", "content": content} | fields,
                "finish_reason": finish,
            }
        ],
        "usage": {
            "prompt_tokens": tokens[0], "completion_tokens": tokens[1], "total_tokens": sum(tokens),
        },
    }  # fmt: skip


def decision(action: str, reason: str = "by the rules") -> str:
    """The text of an answer in form."""
    return json.dumps({"reason": reason, "action": action})


def error(status: int, text: str, **fields: Any) -> Sent:
    """An error as servers write it."""
    return Sent(status, {"error": {"message": text, "code": status} | fields})
