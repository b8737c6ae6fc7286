"""A driver that asks a language model what to do.

It is a planner on the host: once per decision it gets the scenes of all worlds, and asks about those in
which a question is due, several at a time. Wall clock changes nothing: the time that an answer takes in the
simulation is a setting.
"""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from limsim_jax.policies.host import HostPolicy, planners
from limsim_jax.policies.language.answers import SILENT, CallStatus, Reply, parse, schema
from limsim_jax.policies.language.chat import Chat, Outcome, Server, load_httpx, message
from limsim_jax.policies.language.describe import (
    PLAIN,
    STYLES,
    Style,
    available,
    description,
    role,
    worked_example,
)
from limsim_jax.policies.language.memory import Memory, features, read_memories, similar
from limsim_jax.policies.language.pictures import png, rig_of
from limsim_jax.policies.language.rules import between, is_due, rule_action
from limsim_jax.policies.language.scene import Facts, LookAround, Scene, facts, facts_of, numbers
from limsim_jax.policies.language.store import Answer, Cache, Log, request_hash
from limsim_jax.sensors.rig import Rig
from limsim_jax.traffic.ego import Meta

GRAPH = {
    "scene": "Describe in two sentences what matters in this scene.",
    "risk": "Which road user or signal is the greatest risk, and in how many seconds?",
    "plan": "State your plan for the next five seconds in one sentence.",
}
"""Questions before that for the action, in order."""

_PAIR = ("user", "assistant")
_SEED = 0  # of the sampling
_MEMORY = 6  # asked before, time of the last question, action, its time, 1 + coming action, its time


@dataclass(frozen=True)
class Caps:
    """Where a run stops to ask; then the rules drive.

    Attributes:
      calls: HTTP requests, retries and repairs included.
      tokens: of prompts and answers. It can be passed by the questions of one decision.
      cost: in the currency of the prices, like `tokens`.
      prompt_price: of a million tokens.
      answer_price: of a million tokens.
    """

    calls: int | None = None
    tokens: int | None = None
    cost: float | None = None
    prompt_price: float = 0.0
    answer_price: float = 0.0

    def price(self, prompt_tokens: int, answer_tokens: int) -> float:
        """Cost of tokens."""
        return (prompt_tokens * self.prompt_price + answer_tokens * self.answer_price) / 1e6


class _Spent:
    """What a run has used."""

    __slots__ = ("answer_tokens", "calls", "prompt_tokens")

    def __init__(self) -> None:
        self.calls = self.prompt_tokens = self.answer_tokens = 0


_T = TypeVar("_T")


class _UnknownReply(Exception):
    """The cache has no reply."""


class _Question(NamedTuple):
    key: str
    told: Facts
    text: str
    messages: list[dict[str, Any]]
    offered: dict[Meta, str]


class _Step(NamedTuple):
    node: str
    status: CallStatus
    text: str
    error: str
    outcome: Outcome


class _Said(NamedTuple):
    status: CallStatus
    action: Meta | None
    steps: list[_Step]


@dataclass(frozen=True)
class LanguageDriver:
    """The function of a `HostPolicy`, which asks a model.

    Attributes:
      server: where the model is asked.
      style: protocol.
      period: s between questions; None: that of the style.
      latency: s after which an answer counts, for one period, and until which the speed is kept; None: the
        world waits for it.
      graph: whether `GRAPH` is asked before the action.
      memories: examples; the `shots` most similar ones are shown.
      shots: most examples.
      cameras: names of those whose pictures are sent.
      caps: of calls, tokens and cost.
      asked_of: server and model, of which rows depend.
      cache: of replies.
      log: of answers.
      notes: answers by the key of the decision, for results.
      told: answers that are taken again if the question is the same, by key and ego.
    """

    server: Server
    style: Style = PLAIN
    period: float | None = None
    latency: float | None = None
    graph: bool = False
    memories: tuple[Memory, ...] = ()
    shots: int = 3
    cameras: tuple[str, ...] = ()
    caps: Caps = Caps()
    cache: Cache = field(default_factory=lambda: Cache(None), compare=False, repr=False)
    log: Log = field(default_factory=lambda: Log(None), compare=False, repr=False)
    notes: dict[bytes, list[Answer]] = field(default_factory=dict, init=False, compare=False, repr=False)
    told: dict[tuple[bytes, int], list[Answer]] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )
    asked_of: tuple[str, ...] = field(init=False, repr=False)
    _chat: Chat = field(init=False, compare=False, repr=False)
    _spent: _Spent = field(default_factory=_Spent, init=False, compare=False, repr=False)
    _lock: Any = field(default_factory=threading.Lock, init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        if not (self.latency is None or self.latency >= 0) or not (self.period is None or self.period > 0):
            raise ValueError(
                f"latency {self.latency} s, period {self.period} s; expected 0 or more, and more than 0"
            )
        object.__setattr__(self, "asked_of", (self.server.url, self.server.model))
        object.__setattr__(self, "_chat", Chat(self.server, self.style.timeout))

    @property
    def chat(self) -> Chat:
        """The client of the server."""
        return self._chat

    def __call__(
        self, scene: Scene, memory: np.ndarray, keys: np.ndarray | None = None
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Actions `[B, E]` and the new memory, see `HostPolicy`."""
        before, last, held, since, coming, arrival = np.moveaxis(np.array(memory), -1, 0)
        time = np.broadcast_to(np.asarray(scene.seen.time)[:, None], last.shape)
        period = self.style.period if self.period is None else self.period
        held = np.where(is_due(time, since, period), int(Meta.KEEP), between(held))

        def arrive() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            now = (coming > 0) & (time >= arrival - 1e-3)
            return np.where(now, coming - 1, held), np.where(now, time, since), np.where(now, 0, coming)

        held, since, coming = arrive()
        there = np.asarray(scene.seen.length) > 0  # not in the trial of `HostPolicy`
        due = there & (coming == 0) & ((before == 0) | is_due(time, last, period))
        if due.any():
            actions = self._decide(scene, due, time, keys)
            before, last = np.where(due, 1, before), np.where(due, time, last)
            if self.latency is None:
                held, since = np.where(due, actions, held), np.where(due, time, since)
            else:
                coming = np.where(due, 1 + actions, coming)
                arrival = np.where(due, time + self.latency, arrival)
                held, since, coming = arrive()
        kept = np.stack([before, last, held, since, coming, arrival], -1).astype(np.float32)
        return {"meta": held.astype(np.int32)}, kept

    # --- questions

    def _decide(self, scene: Scene, due: np.ndarray, time: np.ndarray, keys: np.ndarray | None) -> np.ndarray:
        """The actions of egos whose question is due; equal questions are asked once."""
        told = facts(scene)
        rules = rule_action(told)
        names = [b"" if keys is None else key.tobytes() for key in (due if keys is None else keys)]
        rows: dict[str, list[tuple[int, int]]] = {}
        questions: dict[str, _Question] = {}
        actions = np.zeros(due.shape, int)
        answers: dict[tuple[int, int], list[Answer]] = {}
        for world, ego in map(tuple, np.argwhere(due).tolist()):
            question = self._question(scene, jax.tree.map(lambda x: x[world, ego].item(), told), world, ego)  # noqa: B023
            before = self.told.get((names[world], ego), [])
            if before and before[-1].prompt == question.key:
                answers[world, ego] = [replace(x, world=world) for x in before]
                actions[world, ego] = Meta[before[-1].action]
                continue
            rows.setdefault(question.key, []).append((world, ego))
            questions.setdefault(question.key, question)
        with self._lock:
            for key, found in self._answers(list(questions.values())).items():
                for k, (world, ego) in enumerate(rows[key]):
                    action = found.action
                    if action is None:
                        action = Meta(int(rules[world, ego])) if found.status in SILENT else Meta.KEEP
                    actions[world, ego] = action
                    moment = world, ego, round(float(time[world, ego]), 3)
                    steps = [self._answer(questions[key], moment, x, action, k == 0) for x in found.steps]
                    answers[world, ego] = steps
            self.log.add(x for row in sorted(answers) for x in answers[row])
            if keys is not None:
                self.notes.update({names[world]: [] for world, _ in answers})
                for (world, ego), steps in sorted(answers.items()):
                    mine = self.notes[names[world]]
                    mine += steps if all(x.ego != ego for x in mine) else []
        return actions

    def _answer(
        self, question: _Question, moment: tuple[int, int, float], step: _Step, action: Meta, first: bool
    ) -> Answer:
        """How a step ended; calls count for the first of equal questions."""
        outcome, asked = step.outcome, first and step.outcome.calls > 0
        reply = outcome.reply if asked and outcome.reply is not None else Reply("")
        decides = step.node == "action"
        return Answer(
            *moment, step.node, question.key, step.status, action.name, step.text, step.error,
            latency=round(outcome.latency, 4) if asked else 0.0,
            calls=outcome.calls if asked else 0,
            prompt_tokens=reply.prompt_tokens,
            answer_tokens=reply.answer_tokens,
            cost=self.caps.price(reply.prompt_tokens, reply.answer_tokens),
            scene=question.text if decides else "",
            facts=numbers(question.told) if decides else (),
        )  # fmt: skip

    def _question(self, scene: Scene, told: Facts, world: int, ego: int) -> _Question:
        text, offered = description(self.style, told), available(self.style, told)
        pictures = () if scene.pictures is None else scene.pictures[world, ego]
        images = [png(np.asarray(picture)) for picture in pictures]
        pairs = [worked_example(self.style)] if self.style.example else []
        pairs += [(x.scene, x.answer) for x in similar(self.memories, told, self.shots)]
        shown = [message(who, said) for pair in pairs for who, said in zip(_PAIR, pair, strict=True)]
        if self.style.images:  # one message that holds all
            cameras = f"The next {len(images)} pictures are of these cameras: {', '.join(self.cameras)}."
            messages = [*shown, message("user", text, images, before=(role(self.style), cameras))]
        else:
            messages = [message("system", role(self.style)), *shown, message("user", text, images)]
        key = request_hash({"messages": messages, **self._settings()})
        return _Question(key, told, text, messages, offered)

    def _settings(self) -> dict[str, Any]:
        return {
            "model": self.server.model,
            "temperature": self.style.temperature,
            "seed": _SEED,
            "max_tokens": self.style.max_tokens,
        }

    def _answers(self, questions: list[_Question]) -> dict[str, _Said]:
        """What the model says: from the cache, otherwise from the server within the caps."""

        async def all_of_them() -> dict[str, _Said]:
            found: dict[str, _Said] = {}
            for question in questions:
                try:
                    found[question.key] = await self._discuss(question, None)
                except _UnknownReply:
                    found[question.key] = _Said(CallStatus.FALLBACK, None, [])
            unknown = [x for x in questions if found[x.key].status is CallStatus.FALLBACK]
            allowed = unknown[: self._allowed()]
            gate = asyncio.Semaphore(self.server.concurrency)

            async def one(question: _Question, client: Any) -> _Said:
                async with gate:
                    return await self._discuss(question, client)

            if allowed:
                async with self._chat.client() as client:
                    replies = await asyncio.gather(*(one(x, client) for x in allowed))
                found |= {x.key: said for x, said in zip(allowed, replies, strict=True)}
            for question in unknown[len(allowed) :]:
                none = Outcome(None, CallStatus.FALLBACK)
                step = _Step("action", CallStatus.FALLBACK, "", "a cap is reached", none)
                found[question.key] = _Said(CallStatus.FALLBACK, None, [step])
            return found

        return self._in_thread(all_of_them)

    def _in_thread(self, work: Callable[[], Coroutine[Any, Any, _T]]) -> _T:
        """Do it in a thread of its own: the caller's may run an event loop already, as in a notebook."""
        try:
            with ThreadPoolExecutor(1) as thread:
                return thread.submit(lambda: asyncio.run(work())).result()
        finally:
            self.cache.save()

    def _allowed(self) -> int:
        """Questions that the caps allow now."""
        caps, spent = self.caps, self._spent
        cost = caps.price(spent.prompt_tokens, spent.answer_tokens)
        over = caps.tokens is not None and spent.prompt_tokens + spent.answer_tokens >= caps.tokens
        if over or (caps.cost is not None and cost >= caps.cost):
            return 0
        most = (len(GRAPH) * self.graph + 2) * (self.server.retries + 1)  # calls of one question
        return 1_000_000 if caps.calls is None else max(caps.calls - spent.calls, 0) // most

    async def _discuss(self, question: _Question, client: Any) -> _Said:
        """The graph, the action and at most one repair. Without a client the cache must know all replies."""
        steps: list[_Step] = []
        messages = list(question.messages)
        if self.graph:
            for node, asked in GRAPH.items():
                await self._step(node, asked, messages, steps, client)
            messages.append(message("user", f"Now decide. {role(self.style)}"))
        form = {"schema": schema(question.offered)} if self.style.form == "json" else {}
        outcome = await self._reply({"messages": messages, **self._settings(), **form}, client)
        if outcome.reply is None:
            steps.append(_Step("action", outcome.status, "", outcome.error, outcome))
            return _Said(outcome.status, None, steps)
        status, action = parse(outcome.reply, question.offered)
        last = outcome
        if status in (CallStatus.ILLEGAL, CallStatus.TRUNCATED):
            offered = ", ".join(question.offered.values())
            wrong = f"That is not one of the offered actions. Offered: {offered}. Answer briefly."
            repair = [*messages, message("assistant", outcome.reply.text or "-"), message("user", wrong)]
            last = await self._reply({"messages": repair, **self._settings(), **form}, client)
            action = parse(last.reply, question.offered)[1] if last.reply is not None else None
            status = status if action is None else CallStatus.REPAIRED
            last = _both(outcome, last)
        text = last.reply.text if last.reply is not None else outcome.reply.text
        steps.append(_Step("action", status, text, last.error, last))
        return _Said(status, action, steps)

    async def _step(
        self, node: str, asked: str, messages: list[dict[str, Any]], steps: list[_Step], client: Any
    ) -> None:
        messages.append(message("user", asked))
        outcome = await self._reply({"messages": list(messages), **self._settings()}, client)
        if outcome.reply is None or not outcome.reply.text:  # the discussion goes on without it
            messages.pop()
            steps.append(_Step(node, outcome.status, "", outcome.error, outcome))
            return
        messages.append(message("assistant", outcome.reply.text))
        steps.append(_Step(node, outcome.status, outcome.reply.text, "", outcome))

    async def _reply(self, request: dict[str, Any], client: Any) -> Outcome:
        key = request_hash(request)
        known = self.cache.get(key)
        if known is not None:
            return Outcome(known, CallStatus.OK)
        if client is None:
            raise _UnknownReply
        outcome = await self._chat.ask(client, request)
        self._spent.calls += outcome.calls
        if outcome.reply is not None:
            self._spent.prompt_tokens += outcome.reply.prompt_tokens
            self._spent.answer_tokens += outcome.reply.answer_tokens
            self.cache.put(key, outcome.reply)
        return outcome

    # --- learning from failures

    def reflect(self, answers: Sequence[Answer], seed: int) -> list[Memory]:
        """Ask what was wrong in the last decisions before a failure.

        Args:
          answers: the decisions, with their facts.
          seed: of the world that failed, an even number.

        Returns:
          Corrected examples; decisions for which no offered action is found have none.

        Raises:
          ValueError: the seed is for tests.
        """
        Memory(seed, (), "", "")

        async def all_of_them() -> list[Memory]:
            found = []
            async with self._chat.client() as client:
                for answer in answers:
                    told = facts_of(answer.facts)
                    offered = available(self.style, told)
                    messages = mistake(self.style, answer.scene, answer.action)
                    form = {"schema": schema(offered)} if self.style.form == "json" else {}
                    outcome = await self._reply({"messages": messages, **self._settings(), **form}, client)
                    reply = outcome.reply
                    if reply is not None and parse(reply, offered)[1] is not None:
                        row = tuple(map(float, features(told)))
                        found.append(Memory(seed, row, answer.scene, reply.text))
            return found

        with self._lock:
            return self._in_thread(all_of_them)


def mistake(style: Style, scene: str, action: str) -> list[dict[str, Any]]:
    """Messages that ask for the mistake in a decision before a failure."""
    label = style.labels.get(Meta[action], action)
    wrong = (
        f"This drive ended in a failure soon after. The answer was {label}. "
        "Find the mistake, and give the action that would have been safe."
    )
    return [message("system", role(style)), message("user", f"{scene}\n{wrong}")]


def _both(first: Outcome, second: Outcome) -> Outcome:
    """A question and its repair: calls, time and tokens of both."""
    replies = [x.reply for x in (first, second) if x.reply is not None]
    shown = replies[-1] if replies else Reply("")
    tokens = {name: sum(getattr(x, name) for x in replies) for name in ("prompt_tokens", "answer_tokens")}
    return replace(
        second,
        reply=replace(shown, **tokens),
        calls=first.calls + second.calls,
        latency=first.latency + second.latency,
    )


def language(
    server: str | None = None,
    model: str | None = None,
    key_variable: str = "OPENAI_API_KEY",
    style: str = "plain",
    period: float | None = None,
    latency: float | None = None,
    graph: bool = False,
    memory: str | None = None,
    shots: int = 3,
    cache: str | None = None,
    log: str | None = None,
    timeout: float | None = None,
    retries: int = 2,
    concurrency: int = 8,
    max_calls: int | None = None,
    max_tokens: int | None = None,
    max_cost: float | None = None,
    prompt_price: float = 0.0,
    answer_price: float = 0.0,
    cameras: Rig | str | None = None,
    check: bool = True,
) -> HostPolicy:
    """Egos driven by a language model behind a chat server.

    Args:
      server: URL up to `/v1`; None: `$OPENAI_BASE_URL`, otherwise that of OpenAI.
      model: as the server names it; None: `$LIMSIM_MODEL`.
      key_variable: environment variable with the key.
      style: protocol, see `STYLES`.
      period: s between questions; None: that of the style.
      latency: s after which an answer counts; None: the world waits for it.
      graph: whether scene, risk and plan are asked for before the action.
      memory: file of examples, see `write_memories`.
      shots: most examples in a question.
      cache: file of replies, which makes reruns equal.
      log: file to which every answer is added, a line of JSON each.
      timeout: s of a question, retries included; None: that of the style.
      retries: more tries after errors that pass.
      concurrency: questions at a time.
      max_calls: HTTP requests.
      max_tokens: of prompts and answers.
      max_cost: in the currency of the prices.
      prompt_price: of a million tokens.
      answer_price: of a million tokens.
      cameras: whose pictures are sent, a rig or "front", "three", "six" or "driver"; None: "three" with a
        style for vision, otherwise no pictures.
      check: whether the server is asked now for its models.

    Raises:
      ValueError: no server, a wrong key, an unknown model, pictures for a model of text, or another value
        that makes no sense.
    """
    load_httpx()
    url = server or os.environ.get("OPENAI_BASE_URL") or "https://api.openai.com/v1"
    name = model or os.environ.get("LIMSIM_MODEL", "")
    if not name:
        raise ValueError("model: none; set the option model or $LIMSIM_MODEL")
    if style not in STYLES:
        raise ValueError(f"style: '{style}'; known are {', '.join(STYLES)}")
    protocol = STYLES[style] if timeout is None else replace(STYLES[style], timeout=timeout)
    try:
        memories = read_memories(memory) if memory else ()
    except OSError as error:
        raise ValueError(f"memory: {memory}: {error.strerror}") from None
    if cameras is None and protocol.images:
        cameras = "three"
    rig = None if cameras is None else rig_of(cameras)
    driver = LanguageDriver(
        Server(url, name, key_variable, retries, concurrency),
        style=protocol,
        period=period,
        latency=latency,
        graph=graph,
        memories=memories,
        shots=shots,
        cameras=() if rig is None else rig.names,
        caps=Caps(max_calls, max_tokens, max_cost, prompt_price, answer_price),
        cache=Cache(Path(cache) if cache else None),
        log=Log(Path(log) if log else None),
    )
    look = LookAround(rig=rig)
    if check and not _OFFLINE.get():
        driver.chat.check(images=cameras is not None)
    return HostPolicy(driver, command="meta", memory=_MEMORY, observe=look, keyed=True, name="language")


_OFFLINE: ContextVar[bool] = ContextVar("offline", default=False)


@contextmanager
def offline() -> Iterator[None]:
    """Within it `language` asks no server: for worlds whose answers are known."""
    token = _OFFLINE.set(True)
    try:
        yield
    finally:
        _OFFLINE.reset(token)


def language_drivers(policy: Any) -> list[LanguageDriver]:
    """The drivers within a policy that ask a model."""
    return [x.function for x in planners(policy) if isinstance(x.function, LanguageDriver)]
