"""`ChatServer`: serves models that are functions, as an OpenAI-compatible server would."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from limsim_jax.bridges.chat.replies import Sent, completion, error
from limsim_jax.bridges.chat.rules import rules
from limsim_jax.policies.language.describe import token_bound

Model = Callable[[dict[str, Any]], Any]
"""A request as JSON -> the text of the answer, its whole body (a mapping), a `Sent`, or a function that
writes to the HTTP handler."""

FORMATS = ("text", "json_object", "json_schema")
"""Types of `response_format`."""


class ChatServer:
    """A chat server on this machine, for models that are functions.

        with lj.ChatServer() as server:
            lj.sweep("highway", policies=lj.language(server.url, "rules"), seeds=4)

    Paths are `/v1/models`, `/v1/chat/completions` and `/health`. A model is a function of a request. One that
    takes pictures has an attribute `takes_images = True`; others answer a picture with an error, as
    llama.cpp does.

    Args:
      models: by name; None: `rules`, which reads descriptions and answers by the table of rules.
      host: address to listen at.
      port: 0: any free one.
      key: that requests must bring; empty: none.

    Raises:
      ValueError: no model, or an address that is not free.
    """

    def __init__(
        self,
        models: Mapping[str, Model] | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        key: str = "",
    ) -> None:
        self.models = {"rules": rules} if models is None else dict(models)
        if not self.models:
            raise ValueError("models: none; expected at least one, by its name")
        self.key = key
        self.requests: list[dict[str, Any]] = []
        """Questions so far."""
        try:
            self._http = _Http((host, port), self)
        except (OSError, OverflowError) as problem:
            reason = getattr(problem, "strerror", None) or problem
            raise ValueError(f"cannot listen on {host}:{port}: {reason}") from None
        self.host, self.port = host, self._http.server_address[1]
        self._thread: threading.Thread | None = None
        self.lock = threading.Lock()

    @property
    def url(self) -> str:
        """Up to `/v1`."""
        return f"http://{self.host}:{self.port}/v1"

    def start(self) -> ChatServer:
        """Serve in a thread."""
        serve = self._http.serve_forever
        self._thread = threading.Thread(target=serve, kwargs={"poll_interval": 0.02}, daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """End the thread and close the port."""
        if self._thread is not None:
            self._http.shutdown()
            self._thread.join()
            self._thread = None
        self._http.server_close()

    def wait(self) -> None:
        """Serve here until Ctrl-C."""
        self._http.serve_forever()

    __enter__ = start

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        return f"ChatServer {self.url}: {', '.join(self.models)}"

    def answer(self, request: Any) -> Any:
        """What is sent for a question: see `Model`, with errors for requests that make no sense."""
        try:
            name, messages = request["model"], request["messages"]
            parts = [x["content"] for x in messages]
            images = any(p["type"] == "image_url" for x in parts if isinstance(x, list) for p in x)
        except (KeyError, TypeError):
            return error(400, "a request has 'model' and 'messages'")
        if name not in self.models:
            return error(404, f"model '{name}' not found; there are {', '.join(self.models)}")
        model, form = self.models[name], request.get("response_format")
        kind = "text" if form is None else form.get("type") if isinstance(form, dict) else form
        if kind not in FORMATS:
            return error(400, f"response_format type must be one of {', '.join(FORMATS)}; got '{kind}'")
        if images and not getattr(model, "takes_images", False):
            return error(500, "image input is not supported; hint: a model with an mmproj is needed")
        with self.lock:
            self.requests.append(request)
        found = model(request)
        if not isinstance(found, str):
            return found
        read = sum(token_bound(text) for part in parts for text in _texts(part))
        return completion(found, tokens=(read, token_bound(found)))


def _texts(content: Any) -> list[str]:
    """The texts of a message."""
    if isinstance(content, str):
        return [content]
    return [part["text"] for part in content or () if part.get("type") == "text"]


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128  # egos ask at once; with five, as is usual, the sixth waits a second

    def __init__(self, address: tuple[str, int], owner: ChatServer) -> None:
        self.owner = owner
        super().__init__(address, _Handler)


class _Handler(BaseHTTPRequestHandler):
    server: _Http  # pyright: ignore[reportIncompatibleVariableOverride]
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # or the body waits 40 ms for the headers to be acknowledged

    def log_message(self, format: str, *args: Any) -> None:
        """Be quiet."""

    def _allowed(self) -> bool:
        key = self.server.owner.key
        if key and self.headers["Authorization"] != f"Bearer {key}":
            self.send(error(401, f"Incorrect API key: {self.headers['Authorization']}"))
            return False
        return True

    def do_GET(self) -> None:
        """Models and health."""
        if not self._allowed():
            return
        path = self.path.removeprefix("/v1").rstrip("/")
        if path == "/models":
            models = [{"id": name, "object": "model"} for name in self.server.owner.models]
            self.send(Sent(200, {"object": "list", "data": models}))
        elif path == "/health":
            self.send(Sent(200, {"status": "ok"}))
        else:
            self.send(error(404, f"no {self.path}"))

    def do_POST(self) -> None:
        """A question."""
        text = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if not self._allowed():
            return
        if self.path.removeprefix("/v1").rstrip("/") != "/chat/completions":
            self.send(error(501, f"{self.path} is not supported", type="not_supported_error"))
            return
        try:
            request = json.loads(text)
        except ValueError:
            self.send(error(400, "the request is no JSON"))
            return
        try:
            found = self.server.owner.answer(request)
        except Exception as problem:  # of a model: the server lives on
            found = error(500, f"{type(problem).__name__}: {problem}")
        if callable(found):
            found(self)
        else:
            self.send(found if isinstance(found, Sent) else Sent(200, found))

    def send(self, sent: Sent) -> None:
        """Write an answer."""
        html = isinstance(sent.body, str)
        data = sent.body.encode() if html else json.dumps(sent.body, ensure_ascii=False).encode()
        self.send_response(sent.status)
        self.send_header("Content-Type", "text/html" if html else "application/json")
        self.send_header("Content-Length", str(len(data)))
        for name, value in sent.headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)
