"""Chat servers for tests: they answer by a script."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any

from limsim_jax.bridges.chat.faults import Script, Scripted
from limsim_jax.bridges.chat.replies import completion
from limsim_jax.bridges.chat.rules import rules
from limsim_jax.bridges.chat.server import ChatServer

KEY = "sk-very-secret"


def chat(content: Any, finish: str = "stop", **fields: Any) -> dict[str, Any]:
    """The body of an answer of 10 tokens to a prompt of 100."""
    return completion(content, finish, tokens=(100, 10), **fields)


@contextmanager
def serving(script: Script):
    """A server of one model, `model`, that answers by a script."""
    with ChatServer({"model": Scripted(script, takes_images=True)}) as server:
        yield server


def by_rules(request: dict[str, Any], number: int) -> dict[str, Any]:
    """A "model" that reads the description and answers by the table of rules."""
    del number
    return chat(rules(request))
