"""A client of chat servers that speak the dialect of OpenAI: llama.cpp, vLLM, Ollama, SGLang and others.

It finds out what a server takes and remembers it: a JSON schema, a JSON object or plain text; and
`max_completion_tokens` or `max_tokens`. Every question ends in a reply or in a status, never in an exception.
"""

from __future__ import annotations

import asyncio
import base64
import email.utils
import json
import os
import random
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from limsim_jax.policies.language.answers import CallStatus, Reply, read_reply

CONNECT_TIMEOUT = 5.0
"""s to connect to a server."""
RUNGS = ("json_schema", "json_object", "text")
"""Forms of structured output, from the strictest."""

_FIRST_DELAY, _LONGEST_DELAY = 0.5, 8.0  # s between retries, those of the official client
_RETRIED = (408, 409, 429)
_NO_IMAGES = ("image input is not supported", "mmproj", "does not support image", "image_url")
_NO_SCHEMA = ("response_format", "json_schema", "json_object", "unable to generate parser", "grammar")
_PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def load_httpx() -> ModuleType:
    """The HTTP library.

    Raises:
      ValueError: it is not installed.
    """
    try:
        import httpx
    except ModuleNotFoundError:
        raise ValueError('the language driver needs httpx: pip install "limsim-jax[language]"') from None
    return httpx


@cache
def _certificates() -> Any:
    """Read once: that takes 20 ms, and there is a client per decision."""
    return load_httpx().create_ssl_context(trust_env=False)


@dataclass(frozen=True)
class Server:
    """Where a model is asked.

    Attributes:
      url: up to `/v1`.
      model: name of the model.
      key_variable: environment variable with the key. It is read for each call and kept nowhere.
      retries: more tries after errors that pass.
      concurrency: questions at a time.
    """

    url: str
    model: str
    key_variable: str = "OPENAI_API_KEY"
    retries: int = 2
    concurrency: int = 8

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"server: '{_bare(self.url)}'; expected a URL such as http://127.0.0.1:8080/v1")
        if parts.username or parts.password or parts.query:
            raise ValueError(
                f"server: {_bare(self.url)}: no key in the URL; put it into ${self.key_variable}"
            )
        if not self.model:
            raise ValueError("model: none; name one, as the server lists it")
        if self.retries < 0 or self.concurrency < 1:
            raise ValueError(f"{self.retries} retries, {self.concurrency} at a time; expected 0, 1 or more")

    def headers(self) -> dict[str, str]:
        """With the key, if there is one."""
        key = os.environ.get(self.key_variable, "").strip()
        return {"Authorization": f"Bearer {key}"} if key else {}

    def clean(self, text: str) -> str:
        """One line of at most 300 characters, without the key."""
        return " ".join(self.without_key(text).split())[:300]

    def without_key(self, text: str) -> str:
        """The text with stars for the key."""
        key = os.environ.get(self.key_variable, "").strip()
        return text.replace(key, "***") if key else text


def _bare(url: str) -> str:
    """A URL without user, password and query."""
    return url.partition("?")[0].rpartition("@")[2]


@dataclass(frozen=True)
class Outcome:
    """How a request ended: a reply, or a status and what went wrong.

    Attributes:
      reply: of the model.
      status: `OK`, `TIMEOUT` or `HTTP`.
      error: one line.
      calls: HTTP requests.
      latency: s of wall clock.
    """

    reply: Reply | None
    status: CallStatus
    error: str = ""
    calls: int = 0
    latency: float = 0.0


class Chat:
    """Asks one server, and remembers what it takes.

    Args:
      server: where the model is asked.
      timeout: s of a question, retries included.
    """

    __slots__ = ("_rung", "_tokens_field", "server", "timeout")

    def __init__(self, server: Server, timeout: float) -> None:
        self.server, self.timeout = server, timeout
        self._rung, self._tokens_field = 0, "max_completion_tokens"

    def client(self) -> Any:
        """An `httpx.AsyncClient`; use it as `async with`."""
        httpx = load_httpx()
        timeout = httpx.Timeout(self.timeout, connect=min(CONNECT_TIMEOUT, self.timeout))
        headers = self.server.headers()
        return httpx.AsyncClient(timeout=timeout, headers=headers, trust_env=False, verify=_certificates())

    async def ask(self, client: Any, request: Mapping[str, Any]) -> Outcome:
        """One question.

        Args:
          client: of `client()`.
          request: `model`, `messages`, `temperature`, `seed`, `max_tokens` and, for JSON, `schema`.
        """
        start, calls = time.monotonic(), [0]
        try:
            async with asyncio.timeout(self.timeout):
                reply, error = await self._tried(client, request, calls)
            status = CallStatus.OK if reply is not None else CallStatus.HTTP
        except TimeoutError:
            reply, status, error = None, CallStatus.TIMEOUT, f"no answer in {self.timeout:g} s"
        return Outcome(reply, status, self.server.clean(error), calls[0], time.monotonic() - start)

    async def _tried(
        self, client: Any, request: Mapping[str, Any], calls: list[int]
    ) -> tuple[Reply | None, str]:
        httpx = load_httpx()
        left, tries = self.server.retries, 0
        end = time.monotonic() + self.timeout
        while True:
            rung, field = self._rung, self._tokens_field
            calls[0] += 1
            try:
                answer = await client.post(
                    f"{self.server.url.rstrip('/')}/chat/completions", json=self._body(request, rung, field)
                )
            except httpx.TimeoutException:
                raise TimeoutError from None
            except httpx.HTTPError as error:
                delay, problem = _backoff(tries), f"{type(error).__name__}: {error}"
            else:
                if answer.status_code < 300:
                    return self._read(answer)
                problem = f"HTTP {answer.status_code}: {answer.text}"
                if answer.status_code in (400, 422) and self._lowered(request, answer.text, rung, field):
                    continue
                delay = _retry_delay(answer, tries)
            if delay is None or not left or time.monotonic() + delay >= end:
                return None, problem
            left, tries = left - 1, tries + 1
            await asyncio.sleep(delay)

    def _body(self, request: Mapping[str, Any], rung: int, field: str) -> dict[str, Any]:
        body = {name: request[name] for name in ("model", "messages", "temperature", "seed")}
        body[field] = request["max_tokens"]
        schema = request.get("schema")
        if schema and RUNGS[rung] == "json_schema":
            described = {"name": "decision", "strict": True, "schema": schema}
            body["response_format"] = {"type": "json_schema", "json_schema": described}
        elif schema and RUNGS[rung] == "json_object":
            body["response_format"] = {"type": "json_object"}
        return body

    def _lowered(self, request: Mapping[str, Any], said: str, rung: int, field: str) -> bool:
        """Whether the server dislikes a form for which there is another one.

        Questions in flight may have found that out already.
        """
        said = said.lower()
        if "max_completion_tokens" in said and field == "max_completion_tokens":
            self._tokens_field = "max_tokens"
            return True
        if request.get("schema") and rung + 1 < len(RUNGS) and any(word in said for word in _NO_SCHEMA):
            self._rung = max(self._rung, rung + 1)
            return True
        return False

    def _read(self, answer: Any) -> tuple[Reply | None, str]:
        try:
            reply = read_reply(json.loads(self.server.without_key(answer.content.decode())))
        except (ValueError, RecursionError):
            return None, f"HTTP {answer.status_code}: no JSON"
        return reply, "" if reply is not None else "an answer without a message"

    def check(self, images: bool = False) -> None:
        """Ask the server for its models, and whether it takes a picture.

        Raises:
          ValueError: no server, a wrong key, an unknown model, or no pictures; one line.
        """
        httpx, server = load_httpx(), self.server
        base = server.url.rstrip("/")
        limit = httpx.Timeout(self.timeout, connect=CONNECT_TIMEOUT)
        with httpx.Client(timeout=limit, headers=server.headers(), trust_env=False) as client:
            try:
                answer = client.get(f"{base}/models")
                self._check_models(answer)
                if images:
                    content = [image_part(_PIXEL), {"type": "text", "text": "Answer: yes."}]
                    asked = {"model": server.model, "messages": [{"role": "user", "content": content}]}
                    answer = client.post(f"{base}/chat/completions", json=asked | {"max_tokens": 1})
                    if answer.status_code >= 400 and "image" in answer.text.lower():
                        raise ValueError(f"model: '{server.model}' takes no images; use a style of text")
            except httpx.HTTPError as error:
                reason = server.clean(str(error)) or type(error).__name__
                raise ValueError(f"server: no answer from {server.url}: {reason}") from None

    def _check_models(self, answer: Any) -> None:
        server = self.server
        if answer.status_code in (401, 403):
            raise ValueError(f"server: {server.url} refuses the key in ${server.key_variable}")
        if answer.status_code >= 400:  # a server without a list of models
            return
        try:
            models = [str(x["id"]) for x in answer.json()["data"]]
        except (ValueError, KeyError, TypeError):
            raise ValueError(f"server: {server.url} is no chat server: /models is no list") from None
        if models and server.model not in models:
            known = ", ".join(models[:8]) + (", ..." if len(models) > 8 else "")
            raise ValueError(f"model: '{server.model}' is unknown to {server.url}; it has {known}")


def image_part(png: bytes) -> dict[str, Any]:
    """A picture as a part of a message."""
    data = base64.b64encode(png).decode()
    return {"type": "image_url", "image_url": {"url": f"data:image/png;base64,{data}", "detail": "low"}}


def message(role: str, text: str, images: Sequence[bytes] = (), before: Sequence[str] = ()) -> dict[str, Any]:
    """A message; with pictures, its content is a list of parts.

    Args:
      role: "system", "user" or "assistant".
      text: the last part.
      images: PNG pictures.
      before: texts ahead of them.
    """
    if not images and not before:
        return {"role": role, "content": text}
    first, last = ([{"type": "text", "text": x} for x in texts] for texts in (before, (text,)))
    return {"role": role, "content": [*first, *map(image_part, images), *last]}


def _backoff(tries: int) -> float:
    return min(_FIRST_DELAY * 2**tries, _LONGEST_DELAY) * random.uniform(0.75, 1.0)


def _retry_delay(answer: Any, tries: int) -> float | None:
    """Seconds until the next try; None if another try would end in the same way."""
    said, status = answer.text.lower(), answer.status_code
    if any(word in said for word in _NO_IMAGES):
        return None
    wish = answer.headers.get("x-should-retry", "").lower()
    again = wish == "true" or (wish != "false" and (status in _RETRIED or status >= 500) and status != 501)
    if not again:
        return None
    asked = _asked_delay(answer.headers)
    return _backoff(tries) if asked is None else asked


def _asked_delay(headers: Mapping[str, str]) -> float | None:
    """What `retry-after-ms` or `retry-after` (s, or a date) ask for, in s."""
    for name, unit in (("retry-after-ms", 1e-3), ("retry-after", 1.0)):
        try:
            value = float(headers.get(name, "")) * unit
        except ValueError:
            continue
        if value >= 0:  # not for NaN
            return value
    try:
        date = email.utils.parsedate_to_datetime(headers.get("retry-after", ""))
        return max(date.timestamp() - time.time(), 0.0)
    except (TypeError, ValueError, OverflowError):
        return None
