"""Every fault of real chat servers, as models for `ChatServer`.

Those of llama.cpp are as it was seen to answer; others are of the official client's retry rules and of
gateways.
"""

from __future__ import annotations

import email.utils
import json
import threading
import time
from collections.abc import Callable
from typing import Any

from limsim_jax.bridges.chat.replies import Sent, completion, decision, error

Script = Callable[[dict[str, Any], int], Any]
"""A request and the number of those before it -> what is sent, see `server.Model`."""

FINE = decision("DECELERATE", "fine")
"""The answer of faults that pass."""

HANGS = 2.0
"""s without an answer."""


class Scripted:
    """A model that answers by a script.

    Args:
      script: see `Script`.
      takes_images: whether questions may have pictures.
    """

    def __init__(self, script: Script, *, takes_images: bool = False) -> None:
        self.takes_images = takes_images
        self._script, self._number, self._lock = script, 0, threading.Lock()

    def __call__(self, request: dict[str, Any]) -> Any:
        """The next answer."""
        with self._lock:
            number, self._number = self._number, self._number + 1
        return self._script(request, number)


def always(answer: Any) -> Script:
    """The same answer to every question."""
    return lambda request, number: answer


def first(answer: Any, then: Any) -> Script:
    """One answer, then another."""
    return lambda request, number: answer if number == 0 else then


def _limited(after: str) -> Sent:
    return Sent(429, {"error": {"message": "slow down"}}, {"Retry-After": after})


def _limited_by_date(request: dict[str, Any], number: int) -> Any:
    del request
    return FINE if number else _limited(email.utils.formatdate(usegmt=True))


def hang(handler: Any) -> None:
    """No answer for `HANGS` s."""
    time.sleep(HANGS)
    handler.close_connection = True


def hang_up(handler: Any) -> None:
    """The connection ends without an answer."""
    handler.connection.close()
    handler.close_connection = True


def in_pieces(body: dict[str, Any]) -> Callable[[Any], None]:
    """The answer byte by byte, so that characters are split."""

    def write(handler: Any) -> None:
        data = json.dumps(body, ensure_ascii=False).encode()
        handler.send_response(200)
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        for k in range(len(data)):
            handler.wfile.write(data[k : k + 1])
            handler.wfile.flush()

    return write


def _unless_text(request: dict[str, Any], number: int) -> Any:
    del number
    return error(400, "response_format type must be one of text") if "response_format" in request else FINE


def _only_object(request: dict[str, Any], number: int) -> Any:
    del number
    fine = request["response_format"]["type"] == "json_object"
    return FINE if fine else error(400, "Unable to generate parser for this template")


def _only_max_tokens(request: dict[str, Any], number: int) -> Any:
    del number
    return FINE if "max_tokens" in request else error(400, "unknown field max_completion_tokens")


_TRUNCATED = completion('{"reason": "the car ahe', finish="length")

FAULTS: dict[str, Script] = {
    "fine": always(FINE),
    "image to a text model": always(error(500, "image input is not supported, mmproj")),
    "no response_format": _unless_text,
    "only json_object": _only_object,
    "only max_tokens": _only_max_tokens,
    "prompt too long": always(error(400, "long", type="exceed_context_size_error", n_ctx=512)),
    "bad request": always(error(400, "n must be 1")),
    "not supported": always(error(501, "off", type="not_supported_error")),
    "truncated": always(_TRUNCATED),
    "truncated, then fine": first(_TRUNCATED, FINE),
    "illegal, then fine": first(completion("hm"), FINE),
    "lane that is not there": always(decision("RIGHT")),
    "hang": always(hang),
    "hang up": first(hang_up, FINE),
    "429 in seconds": first(_limited("0"), FINE),
    "429 by a date": _limited_by_date,
    "429 for long": always(_limited("60")),
    "no retry": always(Sent(503, {}, {"x-should-retry": "false"})),
    "HTML 502": always(Sent(502, "<html>bad gateway</html>", {"retry-after-ms": "1"})),
    "HTML 200": always(Sent(200, "<html>hello</html>")),
    "no choices": always({"choices": []}),
    "refusal": always(completion(None, refusal="I will not drive")),
    "filter": always(completion("", finish="content_filter")),
    "tool": always(completion(None, "tool_calls", tool_calls=[{"id": "1"}])),
    "split UTF-8": always(in_pieces(completion("Übermäßig → STOP"))),
    "wrong key": always(error(401, "Incorrect API key")),
    "no model": always(error(404, "model not found")),
}  # fmt: skip
"""Scripts by the name of the fault; a client that retries and repairs well gets an action from some."""


class Faults:
    """A model that serves every fault, one after the other: each as often as a client asks within it.

    A fault lasts until it has been asked `times`.

    Args:
      times: questions, retries and repairs included, that each fault gets.
    """

    def __init__(self, times: int = 3) -> None:
        self._scripts, self._times = list(FAULTS.values()), times
        self._number, self._lock = 0, threading.Lock()

    def __call__(self, request: dict[str, Any]) -> Any:
        """The next answer."""
        with self._lock:
            number, self._number = self._number, self._number + 1
        script = self._scripts[number // self._times % len(self._scripts)]
        try:
            return script(request, number % self._times)
        except KeyError:  # a fault about a field that this request does not have
            return FINE
