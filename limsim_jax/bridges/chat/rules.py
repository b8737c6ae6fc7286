"""A "model" that reads descriptions, and answers by the table of rules.

It knows nothing else. Side by side with the same rules in JAX it shows that descriptions and actions lose
nothing.
"""

from __future__ import annotations

from typing import Any

from limsim_jax.bridges.chat.replies import decision
from limsim_jax.policies.language.reading import read_description
from limsim_jax.policies.language.rules import rule_action
from limsim_jax.traffic.ego import Meta


def rules(request: dict[str, Any]) -> str:
    """The answer to a question.

    Args:
      request: its last description counts. A question that comes after it and asks for no action, as in a
        graph, gets a sentence.

    Raises:
      ValueError: no message describes a scene.
    """
    messages = request["messages"]
    texts = [x["content"] for x in messages if x["role"] == "user" and isinstance(x["content"], str)]
    scenes = [text for text in texts if "Ego: speed" in text]
    if not scenes:
        raise ValueError("no message describes a scene; expected a line 'Ego: speed ...'")
    told, offered = read_description(scenes[-1])
    action = Meta(int(rule_action(told)))
    if action not in offered:  # protocols without a stop brake
        action = Meta.DECELERATE if action is Meta.STOP else Meta.KEEP
    after = "" if texts[-1] is scenes[-1] else texts[-1]
    if after and not any(word in after.lower() for word in ("action", "decide", "offered")):
        return f"The rules would {action.name.lower()}."
    label = offered[action]
    return f"By the rules.\n#### {label}" if label.isdigit() else decision(label)
