"""A client, for programs and tests in Python."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from limsim_jax.bridges.traffic_service.log import EGO
from limsim_jax.bridges.traffic_service.messages import METHODS, SERVICE, grpc, message
from limsim_jax.bridges.traffic_service.server import LONGEST, write_pose


class TrafficClient:
    """Calls a traffic server, ours or another one of the same protocol. A context manager.

    Args:
      address: host and port, as in 127.0.0.1:6003.
      timeout: s, of each call; the first session of a size compiles.
    """

    def __init__(self, address: str, timeout: float = 300.0) -> None:
        options = [
            ("grpc.max_receive_message_length", LONGEST),
            ("grpc.max_send_message_length", LONGEST),
        ]
        self._channel = grpc().insecure_channel(address, options=options)
        self._timeout = timeout
        self._calls = {
            name: self._channel.unary_unary(
                f"/{SERVICE}/{name}",
                request_serializer=message(asked).SerializeToString,
                response_deserializer=message(given).FromString,
            )
            for name, (asked, given) in METHODS.items()
        }

    def __enter__(self) -> TrafficClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the channel."""
        self._channel.close()

    def call(self, method: str, request: Any) -> Any:
        """Any method with its message. Raises `grpc.RpcError`."""
        return self._calls[method](request, timeout=self._timeout)

    def scenes(self) -> list[str]:
        """Ids of the scenes."""
        return list(self.call("get_available_scenes", message("common.Empty")()).scene_ids)

    def start(
        self, session: str, scene: str, objects: Mapping[str, Mapping[str, Any]], handover: float
    ) -> None:
        """Start a session.

        Args:
          session: id.
          scene: id of the map.
          objects: by id, EGO among them: time (s, `[K]`), x, y (m, `[K]`), heading (rad, `[K]`), length and
            width (m); optional: still (it is static), label (its class).
          handover: s, when the traffic begins to react.
        """
        request = message("traffic.TrafficSessionRequest")(
            session_uuid=session, scene_id=scene, handover_time_us=_us(handover)
        )
        for name, one in objects.items():
            added = request.logged_object_trajectories.add(
                object_id=name, is_static=bool(one.get("still", False)), label_class=one.get("label", "car")
            )
            added.aabb.size_x, added.aabb.size_y, added.aabb.size_z = one["length"], one["width"], 1.5
            _write(added.trajectory, one)
        self.call("start_session", request)

    def simulate(self, session: str, time: float, ego: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Where all objects are at a time.

        Args:
          session: id.
          time: s.
          ego: time (s, `[K]`), x, y (m), heading (rad) of the ego, up to `time` or beyond.

        Returns:
          x, y (m) and heading (rad) by object.
        """
        request = message("traffic.TrafficRequest")(session_uuid=session, time_query_us=_us(time))
        if ego is not None:
            _write(request.object_trajectory_updates.add(object_id=EGO).trajectory, ego)
        found = {}
        for one in self.call("simulate", request).object_trajectory_updates:
            pose = one.trajectory.poses[0].pose
            found[one.object_id] = pose.vec.x, pose.vec.y, 2 * float(np.arctan2(pose.quat.z, pose.quat.w))
        return found

    def end(self, session: str) -> None:
        """Close a session."""
        self.call("close_session", message("traffic.TrafficSessionCloseRequest")(session_uuid=session))


def _us(time: float) -> int:
    return round(time * 1e6)


def _write(trajectory: Any, one: Mapping[str, Any]) -> None:
    columns = np.broadcast_arrays(*(np.atleast_1d(one[name]) for name in ("time", "x", "y", "heading")))
    for time, x, y, heading in zip(*columns, strict=True):
        turn = (0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2))
        write_pose(trajectory.poses.add(), _us(time), (x, y, 0.0), turn)


__all__ = ["TrafficClient"]
