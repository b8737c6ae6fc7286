"""Egos driven by a planner in another process, over gRPC: one call per decision."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from limsim_jax.bridges.traffic_service.messages import DRIVER, DRIVER_METHODS, grpc, message
from limsim_jax.bridges.traffic_service.server import LONGEST, check_port
from limsim_jax.policies.host import HostPolicy, Observation

_OPTIONS = [("grpc.max_receive_message_length", LONGEST), ("grpc.max_send_message_length", LONGEST)]
_WHOLE = ("light", "to_go")
"""Fields of an observation that are whole numbers."""


@dataclass(frozen=True)
class RemoteDriver:
    """The function of a `HostPolicy` that asks a `DriverServer`.

    Attributes:
      address: host and port.
      timeout: s, of each call. A planner that takes longer has failed.
    """

    address: str
    timeout: float = 10.0
    _open: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.timeout > 0:
            raise ValueError(f"timeout: {self.timeout:g} s; more than 0 is expected")

    def __call__(self, seen: Observation) -> dict[str, np.ndarray]:
        """What the planner commands.

        Raises:
          RuntimeError: no answer in time, no server, or an error of the planner; one line.
        """
        rpc = grpc()
        asked, given = DRIVER_METHODS["drive"]
        if not self._open:
            self._open["channel"] = channel = rpc.insecure_channel(self.address, options=_OPTIONS)
            self._open["drive"] = channel.unary_unary(
                f"/{DRIVER}/drive",
                request_serializer=message(asked).SerializeToString,
                response_deserializer=message(given).FromString,
            )
        request = message(asked)()
        _write(request.seen, seen._asdict())
        try:
            answer = self._open["drive"](request, timeout=self.timeout)
        except rpc.RpcError as error:
            late = error.code() == rpc.StatusCode.DEADLINE_EXCEEDED
            text = f"no answer within {self.timeout:g} s" if late else " ".join(error.details().split())
            raise RuntimeError(f"driver at {self.address}: {text}") from None
        return _read(answer.command)


def remote_driver(address: str, *, timeout: float = 10.0, **options: Any) -> HostPolicy:
    """A policy that asks a planner in another process.

    A planner that breaks or is late fails its episode, as any `HostPolicy` does.

    Args:
      address: host and port of a `DriverServer`, as in 127.0.0.1:6004.
      timeout: s, of each call.
      options: of `HostPolicy`: the kind of command, samples, dt.
    """
    return HostPolicy(RemoteDriver(address, timeout), **options)


class DriverServer:
    """Serves a planner to simulators in other processes. A context manager.

    Args:
      function: as of `HostPolicy`: of an `Observation`, `[B, E]`, it makes a mapping of arrays.
      host: address to listen at.
      port: 0: any free one.

    Attributes:
      port: that it listens at, once it has started.
    """

    def __init__(
        self, function: Callable[[Any], Mapping[str, Any]], *, host: str = "127.0.0.1", port: int = 0
    ) -> None:
        self.function, self.host, self.port = function, host, port
        self._server: Any = None

    def __enter__(self) -> DriverServer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Listen.

        Raises:
          ModuleNotFoundError: grpcio is not installed.
          ValueError: the port is in use.
        """
        rpc = grpc()
        check_port(self.host, self.port)
        asked, given = DRIVER_METHODS["drive"]
        handler = rpc.unary_unary_rpc_method_handler(
            self._drive,
            request_deserializer=message(asked).FromString,
            response_serializer=message(given).SerializeToString,
        )
        # one at a time: planners are rarely made for several threads
        self._server = rpc.server(ThreadPoolExecutor(1), options=[("grpc.so_reuseport", 0), *_OPTIONS])
        self._server.add_generic_rpc_handlers(
            (rpc.method_handlers_generic_handler(DRIVER, {"drive": handler}),)
        )
        self.port = self._server.add_insecure_port(f"{self.host}:{self.port}")
        self._server.start()

    def stop(self) -> None:
        """Answer no more calls."""
        if self._server is not None:
            self._server.stop(0).wait()

    def _drive(self, request: Any, context: Any) -> Any:
        answer = message(DRIVER_METHODS["drive"][1])()
        try:
            _write(answer.command, self.function(_observation(_read(request.seen))))
        except Exception as error:
            context.set_code(grpc().StatusCode.FAILED_PRECONDITION)
            context.set_details(" ".join(f"{type(error).__name__}: {error}".split())[:500])
        return answer


def _observation(arrays: dict[str, np.ndarray]) -> Any:
    whole = {name: arrays[name].astype(int) for name in _WHOLE if name in arrays}
    there = {"there": arrays["there"].astype(bool)} if "there" in arrays else {}
    found = arrays | whole | there
    return Observation(**found) if set(found) == set(Observation._fields) else SimpleNamespace(**found)


def _write(fields: Any, arrays: Mapping[str, Any]) -> None:
    for name, value in arrays.items():
        array = np.asarray(value, np.float32)
        fields.add(name=name, shape=array.shape, values=array.ravel().tolist())


def _read(fields: Any) -> dict[str, np.ndarray]:
    return {one.name: np.array(one.values, np.float32).reshape(tuple(one.shape)) for one in fields}


__all__ = ["DriverServer", "RemoteDriver", "remote_driver"]
