"""A session: the log until the hand-over, then traffic that reacts to the ego."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from limsim_jax.api.map import Map
from limsim_jax.bridges.traffic_service.log import EGO, Logged, RequestError, yaw_of
from limsim_jax.log_replay.arrays import FAR, SceneArrays, build_arrays
from limsim_jax.log_replay.pilot import PLANNED
from limsim_jax.log_replay.takeover import Ego, Flight, Going, Mode, Moment, Takeover, advance, begin
from limsim_jax.maps.lane_map import absolute, relative
from limsim_jax.recordings.tracks import Tracks

STEP_US = 100_000
"""us between two moments of the traffic model."""

HISTORY_US = STEP_US
"""us of log that an object needs: two moments tell its speed."""

_PLAN = 0.3  # s between the moments of an ego's plan, as in `takeover`
_SIZES = {"T": 128, "N": 16, "P": 128}  # what sizes are rounded up to, so that sessions share programs
_ENDLESS = 1e9  # m


class _World(NamedTuple):
    """Where the traffic model is."""

    k: int  # number of the moment
    going: Going  # after it
    moment: Moment  # NumPy
    pure: np.ndarray  # [N], on its log, and not fading


class Session:
    """The traffic of one scene around one ego. Not for several threads at once.

    Until the hand-over all objects follow their logs. After it a vehicle follows its log as long as the ego
    leaves that possible; then car following drives it along the path of its log. Static objects, pedestrians
    and cyclists keep to their logs. Nothing is random.

    Args:
      town: the map.
      logged: objects, the ego among them.
      handover_us: us, when the traffic begins to react.
      options: when vehicles leave their logs and return.

    Raises:
      RequestError: no log at the hand-over, no vehicle on the map, or a scene that is too large.
    """

    def __init__(
        self, town: Map, logged: Sequence[Logged], handover_us: int, options: Takeover | None = None
    ) -> None:
        self.options = Takeover() if options is None else options
        self.logged, self.handover = list(logged), handover_us
        self._town = town
        ego = next(one for one in logged if one.id == EGO)
        moving = [one for one in logged if not one.still]
        self.begin = min(int(one.time[0]) for one in moving)
        self.end = max(int(one.time[-1]) for one in moving)
        if not ego.time[0] + HISTORY_US <= handover_us <= ego.time[-1]:
            raise RequestError(
                "INVALID_ARGUMENT",
                f"handover_time_us {handover_us}: the log of {EGO} goes from {ego.time[0]} to {ego.time[-1]} "
                f"us; a time within it, after {HISTORY_US} us of history, is expected",
            )
        self.last = 0  # us, of the last query
        self._broken: str | None = None
        count = (handover_us - self.begin) // STEP_US
        self._zero = handover_us - count * STEP_US  # us, of moment 0
        known = ego.time < handover_us
        here = ego.pose(handover_us)
        self._times = [*ego.time[known].tolist(), handover_us]
        self._poses = [*zip(ego.xyz[known], yaw_of(ego.turn[known]), strict=True), (here[0], yaw_of(here[1]))]
        self._scene, self._slots = self._arrays()
        slot = self._slots[EGO]
        told = jnp.arange(self._scene.log.x.shape[0]) >= count
        zeros = jnp.zeros(told.shape, jnp.float32)
        self._ego = Ego(slot=jnp.int32(slot), told=told, acceleration=zeros)
        self._world = self._next(None)
        for _ in range(count):
            self._world = self._next(self._world)

    def simulate(self, time: int, update: tuple[np.ndarray, np.ndarray, np.ndarray] | None) -> list[Any]:
        """Where all objects but the ego are.

        Args:
          time: us, of the query; not before the last one.
          update: times (us), positions and quaternions of the ego, up to the time of the query or beyond.

        Returns:
          Per object that is there, in the order of the session: id, position (m), quaternion x, y, z, w.

        Raises:
          RequestError: a time before the last query or beyond the logs, no pose of the ego up to it, or
            numbers of the traffic model that are not finite.
        """
        if self._broken is not None:
            raise RequestError("FAILED_PRECONDITION", self._broken)
        if time < self.last:
            raise RequestError(
                "INVALID_ARGUMENT",
                f"time_query_us {time}: the last query was at {self.last}; time goes on only",
            )
        if not self.begin <= time <= self.end:
            raise RequestError(
                "FAILED_PRECONDITION",
                f"time_query_us {time}: the logs go from {self.begin} to {self.end} us; nothing is known of "
                "other times",
            )
        times, poses = self._merged(update)
        if time > self.handover and times[-1] < time:
            raise RequestError(
                "INVALID_ARGUMENT",
                f"the poses of {EGO} end at {times[-1]} us; poses up to time_query_us {time} are expected",
            )
        self._times, self._poses = times, poses
        self.last = time
        world, ahead = self._world, None
        if time > self.handover:
            while self._time(world.k + 1) <= time:
                world = self._next(world)
            self._world = world
            # between two moments: what will come if the ego goes on as it does
            ahead = self._next(world) if self._time(world.k) < time else None
        return [
            (one.id, *pose)
            for one in self.logged
            if one.id != EGO and (pose := self._pose(one, time, world, ahead)) is not None
        ]

    def off_log(self) -> list[str]:
        """Ids of the vehicles that the traffic model drives."""
        mode, active = self._world.moment.mode, self._world.moment.active
        return [
            name
            for name, slot in self._slots.items()
            if name != EGO and active[slot] and mode[slot] != Mode.LOG
        ]

    # --- the scene

    def _arrays(self) -> tuple[SceneArrays, dict[str, int]]:
        """The logs as a scene, and slots of objects with two moments."""
        count = (self.end - self._zero) // STEP_US + 2
        grid = self._zero + STEP_US * np.arange(count)
        columns, chosen = [], []
        for one in self.logged:
            there = (grid >= one.time[0]) & (grid <= one.time[-1]) | one.still
            if there.sum() < 2:
                continue
            x, y, yaw = (
                np.interp(grid, one.time, values) for values in (one.xyz[:, 0], one.xyz[:, 1], one.yaw)
            )
            v = np.hypot(np.gradient(x), np.gradient(y)) / (STEP_US / 1e6)
            columns.append(np.where(there, np.stack([x, y, yaw, v]), np.nan))
            chosen.append(one)
        x, y, heading, v = np.stack(columns, -1)
        tracks = Tracks(
            name="session", source="logged_object_trajectories", dt=STEP_US / 1e6,
            vehicles=tuple(one.id for one in chosen), x=x, y=y, heading=heading, v=v,
            length=np.array([one.size[0] for one in chosen]),
            width=np.array([one.size[1] for one in chosen]), network=self._town.network,
        )  # fmt: skip
        try:
            scene = build_arrays(tracks, self._town.lanes)
        except ValueError as error:
            raise RequestError("INVALID_ARGUMENT", str(error)) from None
        keeps = np.array([one.keeps for one in chosen])
        if not (np.asarray(scene.log.lane)[:, ~keeps] >= 0).any():
            box = ", ".join(f"{value:.0f}" for value in self._town.network.bounds())
            raise RequestError(
                "INVALID_ARGUMENT",
                f"no logged vehicle is on a lane; positions in the coordinates of the map, whose lanes lie "
                f"within {box} (x0, y0, x1, y1, m), are expected",
            )
        slots = {one.id: k for k, one in enumerate(chosen)}
        limit = scene.limit.at[slots[EGO]].set(_ENDLESS)  # the ego goes where it likes
        return _padded(replace(scene, keeps=jnp.asarray(keeps), limit=limit)), slots

    # --- the ego

    def _merged(
        self, update: tuple[np.ndarray, np.ndarray, np.ndarray] | None
    ) -> tuple[list[int], list[Any]]:
        """Times and poses of the ego with those of an update; what has been simulated stays."""
        if update is None or not len(update[0]):
            return self._times, self._poses
        time, xyz, turn = update
        fresh = time > max(self.last, self.handover)
        if not fresh.any():
            return self._times, self._poses
        first = time[fresh][0]
        keep = [k for k, at in enumerate(self._times) if at < first]
        times = [self._times[k] for k in keep] + time[fresh].tolist()
        poses = [self._poses[k] for k in keep]
        return times, poses + list(zip(xyz[fresh], yaw_of(turn[fresh]), strict=True))

    def _ego_at(self, time: float) -> np.ndarray:
        """x, y (m) and heading of the ego; beyond its poses straight on."""
        times = self._times
        k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        (p, h), (q, g) = self._poses[k], self._poses[k + 1]
        share = (time - times[k]) / (times[k + 1] - times[k])
        turn = (g - h + np.pi) % (2 * np.pi) - np.pi
        place = p[:2] + share * (q[:2] - p[:2])
        return np.array([*place, h + min(share, 1.0) * turn])

    def _flight(self, k: int) -> Flight:
        """The ego in the plane at moment `k`: after the hand-over its poses count."""
        time, dt = self._time(k), STEP_US / 1e6
        now, before, earlier = (self._ego_at(max(time - j * STEP_US, self._times[0])) for j in range(3))
        ahead = np.stack([self._ego_at(time + _PLAN * 1e6 * j) for j in range(1, PLANNED + 1)])

        def speed(a: np.ndarray, b: np.ndarray) -> float:
            way = a[:2] - b[:2]
            return float(max(way @ [np.cos(a[2]), np.sin(a[2])], 0.0) / dt)

        v = speed(now, before)
        places = np.concatenate([now[None], ahead])
        x, y = relative(self._town.lanes, places[:, 0], places[:, 1])
        plan = np.stack([x, y, places[:, 2]], -1).astype(np.float32)
        return Flight(
            flying=jnp.asarray(time > self.handover), x=jnp.float32(plan[0, 0]), y=jnp.float32(plan[0, 1]),
            heading=jnp.float32(plan[0, 2]), v=jnp.float32(v),
            a=jnp.float32((v - speed(before, earlier)) / dt), plan=jnp.asarray(plan[1:]), memory=None,
        )  # fmt: skip

    # --- the clock

    def _time(self, k: int) -> int:
        return self._zero + k * STEP_US

    def _next(self, world: _World | None) -> _World:
        """The world one moment later."""
        k = 0 if world is None else world.k + 1
        before = begin(self._scene) if world is None else world.going
        going, moment = _advance(
            self._scene, self._ego, self.options, before, self._flight(k), jnp.asarray(k, jnp.int32)
        )
        moment = jax.device_get(moment)
        active = moment.active
        if not all(np.isfinite(values[active]).all() for values in moment[:4]):
            names = {slot: name for name, slot in self._slots.items()}
            bad = next(n for n in np.flatnonzero(active) if not np.isfinite([v[n] for v in moment[:4]]).all())
            self._broken = f"the traffic model gave no finite pose for '{names.get(int(bad))}'; start anew"
            raise RequestError("FAILED_PRECONDITION", self._broken)
        faded = np.asarray(going.switched) > self.options.fade + 2 * STEP_US / 1e6
        return _World(k, going, moment, (moment.mode == Mode.LOG) & faded)

    def _pose(
        self, one: Logged, time: int, world: _World, ahead: _World | None
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Position and quaternion of an object; None: it is not there."""
        slot = self._slots.get(one.id)
        if time <= self.handover or slot is None or one.keeps:
            return one.pose(time) if one.there(time) else None
        if not world.moment.active[slot]:
            return None
        if world.pure[slot] and (ahead is None or ahead.pure[slot]):
            return one.pose(time) if one.there(time) else None
        share = 0.0
        places = [np.array([values[slot] for values in world.moment[:3]], float)]
        if ahead is not None and ahead.moment.active[slot]:
            places.append(np.array([values[slot] for values in ahead.moment[:3]], float))
            share = (time - self._time(world.k)) / STEP_US
        x, y, heading = places[0] + share * (places[-1] - places[0])
        at = np.array([float(value) for value in absolute(self._town.lanes, x, y)])
        z = one.xyz[np.hypot(*(one.xyz[:, :2] - at).T).argmin(), 2]
        return np.append(at, z), np.array([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])


@partial(jax.jit, static_argnames="options")
def _advance(
    scene: SceneArrays, ego: Ego, options: Takeover, going: Going, flight: Flight, t: Int[Array, ""]
) -> tuple[Going, Moment]:
    return advance(scene, ego, options, going, flight, t)


def _padded(scene: SceneArrays) -> SceneArrays:
    """The scene with sizes rounded up: vehicles that never come, empty moments."""
    count, number = scene.log.x.shape
    sizes = {"T": count, "N": number, "P": scene.path.shape[1]}
    more = {name: -size % _SIZES[name] for name, size in sizes.items()}

    def pad(array: Any, axes: str, value: Any = 0, mode: str = "constant") -> Any:
        widths = [(0, more.get(axis, 0)) for axis in axes]
        values = {} if mode == "edge" else {"constant_values": value}
        return jnp.pad(jnp.asarray(array), widths, mode=mode, **values)

    def moments(array: Any) -> Any:
        return pad(pad(array, "T.", mode="edge"), ".N")

    log = scene.log
    rows = {name: moments(getattr(log, name)) for name in ("x", "y", "heading", "v", "s", "d")}
    log = replace(
        log, **rows, lane=pad(log.lane, "TN", -1), valid=pad(log.valid, "TN", False),
        length=pad(log.length, "N", 1), width=pad(log.width, "N", 1),
    )  # fmt: skip
    seen = jnp.stack([pad(scene.seen[:, :, k], "NPN", (0, FAR, 1, 0)[k]) for k in range(4)], 2)
    return replace(
        scene, log=log, first=pad(scene.first, "N", 2**30), last=pad(scene.last, "N", -1),
        p=moments(scene.p), path=pad(pad(scene.path, ".P.", mode="edge"), "N.."),
        limit=pad(scene.limit, "N"), lane=pad(scene.lane, "NP", -1), lane_s=pad(scene.lane_s, "NP"),
        goal=pad(scene.goal, "N"), seen=seen, clearance=pad(scene.clearance, "TNN", FAR),
        touched=pad(scene.touched, "NN", False), v0=pad(scene.v0, "N", 1),
        driver=jax.tree.map(lambda x: pad(x, "N", mode="edge"), scene.driver),
        keeps=None if scene.keeps is None else pad(scene.keeps, "N", True),
    )  # fmt: skip


__all__ = ["HISTORY_US", "STEP_US", "Session"]
