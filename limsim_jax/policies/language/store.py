"""Answers that are kept: a cache that makes reruns equal, and a log of every question."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from limsim_jax.policies.language.answers import CallStatus, Reply


def request_hash(request: Mapping[str, Any]) -> str:
    """A hash of what a model is asked: of its name, the messages and the settings, not of server or key."""
    text = json.dumps(request, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


class Cache:
    """Replies by the hash of the request, in memory or SQLite.

    Only replies are kept: a question that met an error is asked again.

    Args:
      path: of the file; None: this process only.
    """

    __slots__ = ("_known", "_path")

    def __init__(self, path: Path | None) -> None:
        self._path, self._known = path, dict[str, Reply]()
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with closing(sqlite3.connect(path)) as base, base:
                base.execute("create table if not exists replies (hash text primary key, reply text)")

    def get(self, key: str) -> Reply | None:
        """The reply, if it is known."""
        if key not in self._known and self._path is not None:
            with closing(sqlite3.connect(self._path)) as base:
                row = base.execute("select reply from replies where hash = ?", (key,)).fetchone()
            if row is not None:
                self._known[key] = Reply(**json.loads(row[0]))
        return self._known.get(key)

    def put(self, key: str, reply: Reply) -> None:
        """Keep a reply; the first one of a request stays."""
        if self._known.setdefault(key, reply) is reply and self._path is not None:
            with closing(sqlite3.connect(self._path)) as base, base:
                row = key, json.dumps(asdict(reply), ensure_ascii=False)
                base.execute("insert or ignore into replies values (?, ?)", row)


@dataclass(frozen=True)
class Answer:
    """One question and how it ended.

    Attributes:
      world: row in the batch of the call.
      ego: row of the ego.
      time: s since the start of the episode.
      node: of the graph of questions.
      prompt: hash of the request.
      status: how the question ended.
      action: name of the action that was taken.
      text: of the reply.
      error: what went wrong, in one line.
      latency: s of wall clock that the calls took; 0 from the cache.
      calls: HTTP requests, retries and repairs included; 0 from the cache.
      prompt_tokens: of all calls.
      answer_tokens: of all calls.
    """

    world: int
    ego: int
    time: float
    node: str
    prompt: str
    status: CallStatus
    action: str
    text: str = ""
    error: str = ""
    latency: float = 0.0
    calls: int = 0
    prompt_tokens: int = 0
    answer_tokens: int = 0


class Log:
    """Answers in order, in memory and as JSON Lines.

    Args:
      path: of the file, which is continued; None: none.
    """

    __slots__ = ("_path", "answers")

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.answers: list[Answer] = []
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, answers: Iterable[Answer]) -> None:
        """Keep the answers of one decision."""
        answers = list(answers)
        self.answers += answers
        if self._path is not None:
            lines = "".join(json.dumps(asdict(x), ensure_ascii=False) + "\n" for x in answers)
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(lines)


def read_answers(path: str | Path) -> list[Answer]:
    """The answers of a log.

    Raises:
      ValueError: a line that is none, by its number.
      OSError: the file cannot be read.
    """
    found = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines(), 1):
        try:
            row = json.loads(line)
            found.append(Answer(**row | {"status": CallStatus(row["status"])}))
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"{path}: line {number} is no answer of a language driver") from None
    return found


def shares(answers: Iterable[Answer]) -> dict[str, float]:
    """Shares of each status; calls, tokens and latency of questions.

    Calls and tokens are per question, latency is the mean in s of those that the server was asked.

    Steps of a graph before the action count as calls only.
    """
    answers = list(answers)
    decided = [x for x in answers if x.node == "action"]
    counts, total = Counter(x.status for x in decided), max(len(decided), 1)
    found: dict[str, float] = {status.value: counts[status] / total for status in CallStatus}
    asked = [x for x in answers if x.calls]
    return found | {
        "questions": float(len(decided)),
        "calls": sum(x.calls for x in answers) / total,
        "prompt_tokens": sum(x.prompt_tokens for x in answers) / total,
        "answer_tokens": sum(x.answer_tokens for x in answers) / total,
        "latency": sum(x.latency for x in asked) / max(len(asked), 1),
    }


def answer_table(answers: Iterable[Answer]) -> str:
    """Answers as lines of text: time, world, status, action and the reply."""
    lines = ["time (s)  world  ego  question  status     action      reply"]
    for x in answers:
        said = " ".join((x.text or x.error).split())[:80]
        lines.append(
            f"{x.time:8.1f}  {x.world:5d}  {x.ego:3d}  {x.node:<8}  {x.status:<9}  {x.action:<10}  {said}"
        )
    return "\n".join(lines)
