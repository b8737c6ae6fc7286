"""A chat server for tests: it answers by a script, with every fault of real servers."""

from __future__ import annotations

import email.utils
import json
import re
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.host import FAR
from limsim_jax.policies.language.rules import rule_action
from limsim_jax.policies.language.scene import NONE, Facts, Neighbour
from limsim_jax.traffic.ego import Meta

KEY = "sk-very-secret"


def chat(content: Any, finish: str = "stop", **fields: Any) -> dict[str, Any]:
    """The body of an answer."""
    return {
        "choices": [{"message": {"role": "assistant", "content": content} | fields, "finish_reason": finish}],
        "usage": {"prompt_tokens": 100, "completion_tokens": 10},
    }


def decision(action: str) -> dict[str, Any]:
    """An answer in form."""
    return chat(json.dumps({"reason": "test", "action": action}))


class ChatServer(ThreadingHTTPServer):
    """Answers by `script(request, number of the request)`.

    The script returns a body, `(status, body, headers)`, or a function that writes to the handler.
    """

    daemon_threads = True

    def __init__(self, script: Callable[[dict[str, Any], int], Any]) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.script, self.requests, self.lock = script, list[dict[str, Any]](), threading.Lock()
        self.models, self.key = ["model"], ""

    @property
    def url(self) -> str:
        """Up to `/v1`."""
        return f"http://127.0.0.1:{self.server_address[1]}/v1"


class _Handler(BaseHTTPRequestHandler):
    server: ChatServer  # pyright: ignore[reportIncompatibleVariableOverride]

    def log_message(self, format: str, *args: Any) -> None:
        """Be quiet."""

    def _allowed(self) -> bool:
        if self.server.key and self.headers["Authorization"] != f"Bearer {self.server.key}":
            self.send(401, {"error": {"message": f"Incorrect key: {self.headers['Authorization']}"}})
            return False
        return True

    def do_GET(self) -> None:
        """The models."""
        if self._allowed():
            self.send(200, {"data": [{"id": name} for name in self.server.models]})

    def do_POST(self) -> None:
        """A question."""
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if not self._allowed():
            return
        with self.server.lock:
            number = len(self.server.requests)
            self.server.requests.append(request)
        found = self.server.script(request, number)
        if callable(found):
            found(self)
        elif isinstance(found, tuple):
            self.send(*found)
        else:
            self.send(200, found)

    def send(self, status: int, body: Any, headers: dict[str, str] | None = None) -> None:
        """An answer; text is sent as HTML."""
        html = isinstance(body, str)
        data = body.encode() if html else json.dumps(body, ensure_ascii=False).encode()
        self.send_response(status)
        self.send_header("Content-Type", "text/html" if html else "application/json")
        self.send_header("Content-Length", str(len(data)))
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)


@contextmanager
def serving(script: Callable[[dict[str, Any], int], Any]):
    """A server in a thread."""
    server = ChatServer(script)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def always(answer: Any) -> Callable[[dict[str, Any], int], Any]:
    """The same answer to every question."""
    return lambda request, number: answer


def first(answer: Any, then: Any) -> Callable[[dict[str, Any], int], Any]:
    """One answer, then another."""
    return lambda request, number: answer if number == 0 else then


def error(status: int, text: str, **fields: Any) -> tuple[int, dict[str, Any], dict[str, str]]:
    """An error as servers write it."""
    return status, {"error": {"message": text, "code": status} | fields}, {}


def limited(after: str) -> tuple[int, dict[str, Any], dict[str, str]]:
    """Too many requests: try again later."""
    return 429, {"error": {"message": "slow down"}}, {"Retry-After": after}


def date_now() -> str:
    """As in a header."""
    return email.utils.formatdate(usegmt=True)


def hang(handler: Any) -> None:
    """No answer."""
    time.sleep(2.0)
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


def read_description(text: str) -> Facts:
    """The facts that a description of the plain style tells, from its words alone."""

    def numbers(pattern: str) -> list[float]:
        found = re.search(pattern, text)
        return [float(x) for x in found.groups()] if found else []

    def vehicle(name: str) -> Neighbour:
        return Neighbour(*(numbers(rf"(?m)^{name}: gap ([\d.]+) m, speed ([\d.]+)") or (NONE, 0.0)))

    v, limit = numbers(r"speed ([\d.]+) m/s, limit ([\d.]+)")
    light, distance = int(SignalState.OFF), FAR
    if shown := re.search(r"Signal: ([a-z ]+), stop line in ([\d.]+) m", text):
        light, distance = int(SignalState[shown[1].replace(" ", "_").upper()]), float(shown[2])
    to_go, within = 0, 0.0
    if route := re.search(r"Route: (\d+) lanes? to the (left|right) within ([\d.]+)", text):
        to_go, within = int(route[1]) * (1 if route[2] == "left" else -1), float(route[3])
    actions = text[text.rindex("Actions:") :]
    return Facts(
        v, limit,
        vehicle("Ahead"), vehicle("Left ahead"), vehicle("Left behind"),
        vehicle("Right ahead"), vehicle("Right behind"),
        light, distance, to_go, within, "LEFT =" in actions, "RIGHT =" in actions,
    )  # fmt: skip


def by_rules(request: dict[str, Any], number: int) -> dict[str, Any]:
    """A "model" that reads the description and answers by the table of rules."""
    del number
    told = read_description(request["messages"][-1]["content"])
    return decision(Meta(int(rule_action(told))).name)
