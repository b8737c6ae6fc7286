"""The server: sessions by id, each for itself, and errors in one line."""

from __future__ import annotations

import errno
import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from limsim_jax import __version__
from limsim_jax.bridges.traffic_service.log import EGO, RequestError, read_logged, read_poses
from limsim_jax.bridges.traffic_service.messages import METHODS, SERVICE, grpc, message
from limsim_jax.bridges.traffic_service.scenes import Scenes
from limsim_jax.bridges.traffic_service.session import HISTORY_US, Session
from limsim_jax.maps.network import MapError
from limsim_jax.recordings.recording import RecordingError

LONGEST = 64 * 2**20
"""Bytes of a message: the logs of a session come in one."""

_GRACE = 1.0  # s that calls have to end in when the server stops


class _Held:
    """A session, its lock, and when it was last used; None: it is being made."""

    def __init__(self) -> None:
        self.lock, self.used = threading.Lock(), time.monotonic()
        self.session: Session | None = None


class TrafficServer:
    """Serves traffic to other simulators. A context manager: it starts on entering and stops on leaving.

    Args:
      scenes: maps by scene id, or the places of `Scenes`: folders, files, names of bundled maps.
      host: address to listen at.
      port: 0: any free one.
      sessions: open at once, at most.
      idle: s without a call after which a session is closed.
      workers: calls that are answered at once.

    Attributes:
      port: that it listens at, once it has started.
    """

    def __init__(
        self,
        scenes: Scenes | Iterable[str | Path],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        sessions: int = 16,
        idle: float = 600.0,
        workers: int = 4,
    ) -> None:
        for name, value in {"sessions": sessions, "idle": idle, "workers": workers}.items():
            if not value > 0:
                raise ValueError(f"{name}: {value:g}; more than 0 is expected")
        if not 0 <= port < 2**16:
            raise ValueError(f"port: {port}; 0 to {2**16 - 1} is expected")
        self.scenes = scenes if isinstance(scenes, Scenes) else Scenes(scenes)
        self.host, self.port = host, port
        self.most, self.idle, self.workers = sessions, idle, workers
        self._held: dict[str, _Held] = {}
        self._registry = threading.Lock()
        self._stopped = threading.Event()
        self._server: Any = None
        self._reaper: threading.Thread | None = None

    def __enter__(self) -> TrafficServer:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Listen.

        Raises:
          ModuleNotFoundError: grpcio is not installed.
          ValueError: the port is in use, or the host has no such address.
        """
        rpc = grpc()
        check_port(self.host, self.port)
        handlers = {
            name: rpc.unary_unary_rpc_method_handler(
                self._guarded(getattr(self, f"_{name}"), message(given)),
                request_deserializer=message(asked).FromString,
                response_serializer=message(given).SerializeToString,
            )
            for name, (asked, given) in METHODS.items()
        }
        options = [
            ("grpc.so_reuseport", 0),
            ("grpc.max_receive_message_length", LONGEST),
            ("grpc.max_send_message_length", LONGEST),
        ]
        self._server = rpc.server(ThreadPoolExecutor(self.workers), options=options)
        self._server.add_generic_rpc_handlers((rpc.method_handlers_generic_handler(SERVICE, handlers),))
        try:
            self.port = self._server.add_insecure_port(f"{self.host}:{self.port}")
        except RuntimeError as error:
            raise ValueError(f"{self.host}:{self.port}: {error}") from None
        self._server.start()
        self._reaper = threading.Thread(target=self._reap, name="idle sessions", daemon=True)
        self._reaper.start()

    def stop(self) -> None:
        """Answer no more calls, and forget all sessions."""
        self._stopped.set()
        if self._server is not None:
            self._server.stop(_GRACE).wait()
        if self._reaper is not None:
            self._reaper.join()
        self._held.clear()

    def wait(self) -> None:
        """Until the server is stopped."""
        self._stopped.wait()

    @property
    def open_sessions(self) -> list[str]:
        """Ids of the sessions."""
        with self._registry:
            return list(self._held)

    # --- calls

    def _start_session(self, request: Any) -> Any:
        name = request.session_uuid
        if not name:
            raise RequestError("INVALID_ARGUMENT", "no session_uuid; an id of the session is expected")
        if request.scene_id not in self.scenes.ids:
            raise RequestError(
                "NOT_FOUND", f"no scene '{request.scene_id}'; there are {', '.join(self.scenes.ids)[:300]}"
            )
        if not 0 < request.handover_time_us < 2**62:
            raise RequestError("INVALID_ARGUMENT", "handover_time_us: a time in us, above 0, is expected")
        held = _Held()
        with self._registry:
            if name in self._held:
                raise RequestError("ALREADY_EXISTS", f"session '{name}' is open; another id is expected")
            if len(self._held) >= self.most:
                raise RequestError(
                    "RESOURCE_EXHAUSTED", f"{self.most} sessions are open, the most of this server; close one"
                )
            self._held[name] = held
        try:
            with held.lock:
                logged = read_logged(request.logged_object_trajectories)
                held.session = Session(self._map(request.scene_id), logged, request.handover_time_us)
                held.used = time.monotonic()
        except BaseException:
            with self._registry:
                self._held.pop(name, None)
            raise
        return message("common.SessionRequestStatus")()

    def _close_session(self, request: Any) -> Any:
        with self._registry:
            if self._held.pop(request.session_uuid, None) is None:
                raise _unknown(request.session_uuid)
        return message("common.Empty")()

    def _simulate(self, request: Any) -> Any:
        name = request.session_uuid
        with self._registry:
            held = self._held.get(name)
        if held is None:
            raise _unknown(name)
        with held.lock:
            if held.session is None or name not in self.open_sessions:
                raise _unknown(name)
            update = None
            for one in request.object_trajectory_updates:
                if one.object_id != EGO:
                    raise RequestError(
                        "INVALID_ARGUMENT",
                        f"update of object '{one.object_id}': the traffic model drives it; updates of {EGO} "
                        "are expected",
                    )
                if update is not None:
                    raise RequestError("INVALID_ARGUMENT", f"two updates of {EGO}; one is expected")
                update = read_poses(EGO, one.trajectory)
            try:
                found = held.session.simulate(request.time_query_us, update)
            finally:
                held.used = time.monotonic()
        answer = message("traffic.TrafficReturn")()
        for object_id, place, turn in found:
            pose = answer.object_trajectory_updates.add(object_id=object_id).trajectory.poses.add()
            write_pose(pose, request.time_query_us, place, turn)
        return answer

    def _get_metadata(self, request: Any) -> Any:
        del request
        answer = message("traffic.TrafficModuleMetadata")(minimum_history_length_us=HISTORY_US)
        answer.version_id.version_id = f"limsim_jax {__version__}"
        return answer

    def _get_available_scenes(self, request: Any) -> Any:
        del request
        return message("common.AvailableScenesReturn")(scene_ids=self.scenes.ids)

    # --- helpers

    def _map(self, scene_id: str) -> Any:
        try:
            return self.scenes.map(scene_id)
        except (MapError, RecordingError, OSError) as error:
            raise RequestError("FAILED_PRECONDITION", f"scene '{scene_id}': {error}") from None

    def _guarded(self, call: Callable[[Any], Any], empty: Any) -> Callable[[Any, Any], Any]:
        """The call with a status and one line for whatever goes wrong."""
        codes = grpc().StatusCode

        def answer(request: Any, context: Any) -> Any:
            try:
                return call(request)
            except RequestError as error:
                context.set_code(getattr(codes, error.status))
                context.set_details(str(error))
            except Exception as error:
                traceback.print_exc(file=sys.stderr)
                context.set_code(codes.INTERNAL)
                context.set_details(" ".join(f"{type(error).__name__}: {error}".split())[:500])
            return empty()

        return answer

    def _reap(self) -> None:
        """Close sessions whose clients have gone."""
        while not self._stopped.wait(min(self.idle / 4, 10.0)):
            before = time.monotonic() - self.idle
            with self._registry:
                for name, held in list(self._held.items()):
                    if held.used < before and not held.lock.locked():
                        del self._held[name]


def write_pose(pose: Any, time_us: int, place: Any, turn: Any) -> None:
    """Fill a `common.PoseAtTime`.

    Args:
      pose: the message.
      time_us: us.
      place: x, y, z, m.
      turn: quaternion x, y, z, w.
    """
    pose.timestamp_us = int(time_us)
    vec, quat = pose.pose.vec, pose.pose.quat
    vec.x, vec.y, vec.z = (float(value) for value in np.asarray(place))
    quat.x, quat.y, quat.z, quat.w = (float(value) for value in np.asarray(turn))


def _unknown(name: str) -> RequestError:
    return RequestError("NOT_FOUND", f"no session '{name}': never started, closed, or idle for too long")


def check_port(host: str, port: int) -> None:
    """Refuse a port that is in use: gRPC's own message is several lines on standard error."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(f"port {port} of {host} is in use; another one, or 0, is expected") from None
        reason = error.strerror or os.strerror(error.errno or 0)
        raise ValueError(f"{host}:{port}: cannot listen there: {reason}") from None


__all__ = ["TrafficServer", "write_pose"]
