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

from limsim_jax.policies.language.answers import SILENT, CallStatus, Reply


def request_hash(request: Mapping[str, Any]) -> str:
    """A hash of what a model is asked: of its name, the messages and the settings, not of server or key."""
    text = json.dumps(request, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


class Cache:
    """Replies by the hash of the request, in memory or SQLite.

    Only replies are kept: a question that met an error is asked again. The file is written by `save`, for
    many replies at once: each time waits for the disk.

    Args:
      path: of the file; None: this process only.
    """

    __slots__ = ("_known", "_new", "_path")

    def __init__(self, path: Path | None) -> None:
        self._path, self._known, self._new = path, dict[str, Reply](), dict[str, Reply]()
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
            self._new[key] = reply

    def save(self) -> None:
        """Write what is new."""
        if self._path is None or not self._new:
            return
        rows = [(key, json.dumps(asdict(reply), ensure_ascii=False)) for key, reply in self._new.items()]
        with closing(sqlite3.connect(self._path)) as base, base:
            base.executemany("insert or ignore into replies values (?, ?)", rows)
        self._new.clear()


@dataclass(frozen=True)
class Answer:
    """One question and how it ended.

    Attributes:
      world: its seed in results, otherwise its row in the batch of the call.
      ego: number of the ego.
      time: s since the start of the episode.
      node: of the graph of questions.
      prompt: hash of what was asked about the scene.
      status: how the question ended.
      action: name of the action that was taken.
      text: of the reply.
      error: what went wrong, in one line.
      latency: s of wall clock that the calls took; 0 where the reply was known.
      calls: HTTP requests, retries and repairs included; 0 where the reply was known.
      prompt_tokens: of all calls.
      answer_tokens: of all calls.
      cost: of all calls, in the currency of the prices.
      scene: text that the model read, at the node of the action.
      facts: of which that text tells, see `scene.numbers`.
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
    cost: float = 0.0
    scene: str = ""
    facts: tuple[float, ...] = ()

    @property
    def cached(self) -> bool:
        """Whether there is a reply, and no call was made for it."""
        return not self.calls and self.status not in SILENT

    @property
    def decides(self) -> bool:
        """Whether the action follows from it; others of a graph come before."""
        return self.node == "action"


def lines_of(answers: Iterable[Answer]) -> str:
    """JSON Lines."""
    return "".join(json.dumps(asdict(x), ensure_ascii=False) + "\n" for x in answers)


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
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(lines_of(answers))


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
            status, told = CallStatus(row["status"]), tuple(map(float, row.get("facts", ())))
            found.append(Answer(**row | {"status": status, "facts": told}))
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"{path}: line {number} is no answer of a language driver") from None
    return found


def shares(answers: Iterable[Answer]) -> dict[str, float]:
    """Shares of each status among decisions; what they took per decision.

    Beside them: `questions`, their number; `cached`, the share for which no call was made; `calls`,
    `prompt_tokens`, `answer_tokens` and `cost` per decision, those of earlier steps of a graph included; and
    `latency`, the mean time (s) of steps for which the server was asked, 0 if there are none.
    """
    answers = list(answers)
    decided = [x for x in answers if x.decides]
    counts, total = Counter(x.status for x in decided), max(len(decided), 1)
    found: dict[str, float] = {status.value: counts[status] / total for status in CallStatus}
    asked = [x for x in answers if x.calls]
    called = {(x.world, x.ego, x.time) for x in asked}
    known = sum(x.cached and (x.world, x.ego, x.time) not in called for x in decided)
    spent = ("calls", "prompt_tokens", "answer_tokens", "cost")
    return (
        found
        | {"questions": float(len(decided)), "cached": known / total}
        | {name: sum(getattr(x, name) for x in answers) / total for name in spent}
        | {"latency": sum(x.latency for x in asked) / max(len(asked), 1)}
    )


def answer_table(answers: Iterable[Answer]) -> str:
    """Answers as lines of text: time, world, status, action and the reply."""
    lines = ["time (s)  world  ego  question  status     action      reply"]
    for x in answers:
        said = " ".join((x.text or x.error).split())[:80]
        lines.append(
            f"{x.time:8.1f}  {x.world:5d}  {x.ego:3d}  {x.node:<8}  {x.status:<9}  {x.action:<10}  {said}"
        )
    return "\n".join(lines)
