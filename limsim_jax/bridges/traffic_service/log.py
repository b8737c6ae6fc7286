"""Logged trajectories of a request: checked, interpolated, and put on a clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

EGO = "EGO"
"""Id of the vehicle under test, as in AlpaSim."""

FOLLOWERS = frozenset({"pedestrian", "person", "cyclist", "bicycle", "rider", "stroller", "animal", "others"})
"""Classes without a model here: these keep to their logs."""


class RequestError(ValueError):
    """A request that cannot be answered: one line, and gRPC's name of the status."""

    def __init__(self, status: str, text: str) -> None:
        self.status = status
        super().__init__(" ".join(text.split()))


@dataclass(frozen=True, kw_only=True)
class Logged:
    """Poses of one object, `K` of them, at times that grow."""

    id: str
    still: bool  # stands all the time
    keeps: bool  # never leaves its log
    size: tuple[float, float, float]  # m
    time: Int[np.ndarray, " K"]  # us
    xyz: Float[np.ndarray, "K 3"]  # m, middle of the body
    turn: Float[np.ndarray, "K 4"]  # quaternion x, y, z, w

    @property
    def yaw(self) -> Float[np.ndarray, " K"]:
        """rad, without jumps."""
        return np.unwrap(yaw_of(self.turn))

    def there(self, time: int) -> bool:
        """Whether it is there at a time, us."""
        return self.still or bool(self.time[0] <= time <= self.time[-1])

    def pose(self, time: int) -> tuple[np.ndarray, np.ndarray]:
        """Position (m) and quaternion at a time (us)."""
        if len(self.time) == 1:
            return self.xyz[0], self.turn[0]
        at = int(np.clip(time, self.time[0], self.time[-1]))
        k = int(np.clip(np.searchsorted(self.time, at, side="right") - 1, 0, len(self.time) - 2))
        share = (at - self.time[k]) / (self.time[k + 1] - self.time[k])
        turn = Slerp([0.0, 1.0], Rotation.from_quat(self.turn[k : k + 2]))(share).as_quat()
        return self.xyz[k] + share * (self.xyz[k + 1] - self.xyz[k]), turn


def yaw_of(turn: Any) -> Any:
    """Angle from the x axis (rad) of quaternions `[..., 4]`."""
    x, y, z, w = np.moveaxis(np.asarray(turn), -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def read_poses(name: str, trajectory: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (us), positions and quaternions of a `common.Trajectory`.

    Raises:
      RequestError: numbers that are not finite, no rotation, or times that do not grow.
    """
    poses = trajectory.poses
    time = np.array([pose.timestamp_us for pose in poses], np.int64)
    xyz = np.array([(p.pose.vec.x, p.pose.vec.y, p.pose.vec.z) for p in poses], float).reshape(-1, 3)
    turn = np.array([(p.pose.quat.x, p.pose.quat.y, p.pose.quat.z, p.pose.quat.w) for p in poses], float)
    turn = turn.reshape(-1, 4)
    norm = np.linalg.norm(turn, axis=-1)
    bad = ~np.isfinite(xyz).all(-1) | ~np.isfinite(turn).all(-1) | ~(norm > 1e-3)
    for k in np.flatnonzero(bad)[:1]:
        raise RequestError(
            "INVALID_ARGUMENT",
            f"object '{name}': pose {k} at {time[k]} us is no place with a rotation; finite numbers and a "
            "quaternion of length 1 are expected",
        )
    for k in np.flatnonzero(np.diff(time) <= 0)[:1]:
        raise RequestError(
            "INVALID_ARGUMENT",
            f"object '{name}': pose {k + 1} at {time[k + 1]} us follows one at {time[k]} us; times that grow "
            "are expected",
        )
    return time, xyz, turn / np.maximum(norm, 1e-3)[:, None]


def read_logged(objects: Any) -> list[Logged]:
    """The logged objects of a session.

    Raises:
      RequestError: an id that is missing or there twice, no size, too few poses, or bad numbers.
    """
    found: list[Logged] = []
    seen: set[str] = set()
    for k, one in enumerate(objects):
        name = one.object_id
        if not name or name in seen:
            what = f"object_id '{name}' is there twice" if name else f"object {k} has no object_id"
            raise RequestError("INVALID_ARGUMENT", f"{what}; ids that differ are expected")
        seen.add(name)
        size = one.aabb.size_x, one.aabb.size_y, one.aabb.size_z
        if not (np.isfinite(size).all() and size[0] > 0 and size[1] > 0):
            raise RequestError(
                "INVALID_ARGUMENT", f"object '{name}': size {size[0]:g} x {size[1]:g} m; metres are expected"
            )
        time, xyz, turn = read_poses(name, one.trajectory)
        least = 1 if one.is_static else 2
        if len(time) < least:
            raise RequestError(
                "INVALID_ARGUMENT",
                f"object '{name}': {len(time)} logged poses; at least {least} are expected",
            )
        keeps = one.is_static or one.label_class.lower() in FOLLOWERS
        found.append(
            Logged(id=name, still=one.is_static, keeps=keeps, size=size, time=time, xyz=xyz, turn=turn)
        )
    if EGO not in seen:
        raise RequestError(
            "INVALID_ARGUMENT", f"no object '{EGO}'; the log of the vehicle under test is expected"
        )
    return found


__all__ = ["EGO", "Logged", "RequestError", "read_logged", "read_poses", "yaw_of"]
