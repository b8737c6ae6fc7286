"""A recorded scene and its replays: the front door of log replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Key
from numpy.typing import NDArray

from limsim_jax.log_replay.arrays import SceneArrays, build_arrays
from limsim_jax.log_replay.pilot import PolicyPilot
from limsim_jax.log_replay.replay import Replay
from limsim_jax.log_replay.takeover import Ego, Moment, Record, Takeover, braking, replay, replay_many
from limsim_jax.maps.map import Map, load_map
from limsim_jax.maps.network import Network
from limsim_jax.policies.base import Policy, with_scenery
from limsim_jax.recordings import Tracks, read_tracks
from limsim_jax.recordings.lanelets import SPEED_LIMIT

AFTER = 1.0
"""s from the first moment of an ego to its start, where none is told."""

_FOREVER = 1e6  # s


@dataclass(frozen=True, eq=False)
class Scene:
    """Recorded vehicles on the map that they drove on.

    Attributes:
      tracks: the recording, on the host.
    """

    tracks: Tracks

    @property
    def name(self) -> str:
        """Of the scene in its file."""
        return self.tracks.name

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Ids in the file; the number of a vehicle is its place here."""
        return self.tracks.vehicles

    @property
    def dt(self) -> float:
        """Time step, s."""
        return self.tracks.dt

    @property
    def duration(self) -> float:
        """s."""
        return (len(self.tracks.x) - 1) * self.dt

    @cached_property
    def map(self) -> Map:
        """The lanes of the recording."""
        return Map(self.tracks.network)

    @cached_property
    def arrays(self) -> SceneArrays:
        """The scene on the device, for `takeover.replay`."""
        return build_arrays(self.tracks, self.map.lanes)

    def __repr__(self) -> str:
        return (
            f"Scene '{self.name}': {len(self.vehicles)} vehicles, {self.duration:g} s in steps of "
            f"{self.dt:g} s, {len(self.tracks.network.lanes)} lanes"
        )

    def replay(
        self,
        ego: int | str | Sequence[int | str],
        *,
        policy: Policy | None = None,
        braking: ArrayLike | Sequence[float] | None = None,
        start: float | None = None,
        duration: float | None = None,
        takeover: Takeover | None = None,
        seed: int = 0,
        at_once: int = 64,
    ) -> Replay:
        """Replay the scene with a vehicle that leaves its log; the traffic model reacts.

        Without `policy` and `braking` the ego stays on its log, and nothing changes.

        Args:
          ego: number of a vehicle or its id as text; or several, one variant each.
          policy: drives the ego from `start` on; one that moves egos in the plane (`free`).
          braking: m/s^2, constant deceleration of the ego instead; an array makes one variant of each value.
          start: s from the beginning of the scene; None: 1 s after the first moment of the ego.
          duration: s from then until the ego returns to its log; None: it never does.
          takeover: when vehicles leave their logs, and return.
          seed: of the policy.
          at_once: variants that run side by side.

        Returns:
          The replay, of one or of many variants.

        Raises:
          ValueError: an unknown ego, a start outside its record, or a policy that cannot drive here.
        """
        if policy is not None and braking is not None:
            raise ValueError("policy and braking: one of them is expected")
        chosen = [ego] if isinstance(ego, (str, int, np.integer)) else list(ego)
        slots = np.array([self._slot(one) for one in chosen])
        rates = np.atleast_1d(np.asarray(0.0 if braking is None else braking, float))
        if len(slots) > 1 and rates.size > 1 and len(slots) != rates.size:
            raise ValueError(f"{len(slots)} egos and {rates.size} values of braking; as many are expected")
        slots, rates = np.broadcast_arrays(slots, rates)
        if rates.ndim != 1 or not np.isfinite(rates).all():
            raise ValueError("braking: one finite number or one axis of them is expected")
        starts = self._starts(slots, start)
        told = 0.0 if policy is None and braking is None else duration or _FOREVER
        egos = _egos(self.arrays, jnp.asarray(slots), jnp.asarray(starts), jnp.asarray(rates), told)
        pilot = (
            None if policy is None else PolicyPilot(lane_map=with_scenery(policy, self.map), policy=policy)
        )
        keys = jax.random.split(jax.random.key(seed), len(slots))
        options = takeover or Takeover()

        def run(variant: int) -> tuple[Record, Moment]:
            one = jax.tree.map(lambda x: x[variant], (egos, keys))
            return jax.device_get(_one(self.arrays, one[0], options, pilot, one[1]))

        if len(slots) == 1:
            first = run(0)
            record = jax.tree.map(lambda x: x[None], first[0])
        else:
            first = None
            record = jax.device_get(_many(self.arrays, egos, options, pilot, keys, at_once))
        return Replay(
            scene=self,
            ego=slots,
            braking=None if braking is None else rates,
            policy=policy,
            start=starts,
            told=np.asarray(egos.told),
            record=record,
            _run=run,
            _kept={} if first is None else {0: first[1]},
        )

    def _slot(self, ego: int | str) -> int:
        if isinstance(ego, str):
            if ego not in self.vehicles:
                raise ValueError(
                    f"{self.name}: no vehicle '{ego}'; known are {', '.join(self.vehicles)[:200]}"
                )
            return self.vehicles.index(ego)
        if not 0 <= int(ego) < len(self.vehicles):
            raise ValueError(
                f"{self.name}: no vehicle {ego}; numbers from 0 to {len(self.vehicles) - 1} are expected"
            )
        return int(ego)

    def _starts(self, slots: NDArray[np.int64], start: float | None) -> NDArray[np.float64]:
        """s, of each variant."""
        valid = self.tracks.valid[:, slots]
        first = valid.argmax(0) * self.dt
        last = (len(valid) - 1 - valid[::-1].argmax(0)) * self.dt
        starts = first + AFTER if start is None else np.full(len(slots), float(start))
        for k in np.flatnonzero((starts < first - 1e-6) | (starts > last))[:1]:
            raise ValueError(
                f"{self.name}: vehicle {self.vehicles[slots[k]]}: start at {starts[k]:g} s; its record goes "
                f"from {first[k]:g} to {last[k]:g} s"
            )
        return starts


def load_scene(
    path: str | Path,
    scenario: str | None = None,
    *,
    map: str | Path | Network | Map | None = None,
    span: tuple[float, float] | None = None,
    speed_limit: float = SPEED_LIMIT,
    dt: float | None = None,
) -> Scene:
    """Read a recorded scene: vehicles and the lanes that they drove on.

    Args:
      path: a CommonRoad XML file, the table `scenes_vehicles.csv` with those of its lanelets beside it, an
        OpenACC platoon, or a recorder log of CARLA; also gzipped.
      scenario: which one of the table; not needed if it has only one.
      map: of a log of CARLA: that of its town, as for `load_map`.
      span: s, begin and end of the stretch of an OpenACC recording, see `recordings.read_tracks`.
      speed_limit: m/s, of the lanes: no recording tells it for all of them.
      dt: s per step, of a log of CARLA; None: as in the log, or 0.025 s if its frames are not evenly spaced.

    Raises:
      RecordingError: one line that names file, line and column or element, and what is expected.
      MapError: the map cannot be read.
    """
    network = None if map is None else load_map(map).network
    options = {"span": span, "speed_limit": speed_limit, "network": network, "dt": dt}
    return Scene(read_tracks(path, scenario, **options))


@jax.jit
def _egos(
    scene: SceneArrays,
    slot: Int[Array, " B"],
    start: Float[Array, " B"],
    rate: Float[Array, " B"],
    duration: float,
) -> Ego:
    """Egos that brake, `[B, ...]`."""
    start, rate = start.astype(scene.p.dtype), rate.astype(scene.p.dtype)
    one = lambda k, begin, b: braking(scene, k.astype(jnp.int32), begin, b, duration)  # noqa: E731
    return jax.vmap(one)(slot, start, rate)


@partial(jax.jit, static_argnames="options")
def _one(
    scene: SceneArrays, ego: Ego, options: Takeover, pilot: PolicyPilot | None, key: Key[Array, ""]
) -> tuple[Record, Moment]:
    record, moments = replay(scene, ego, options, pilot=pilot, key=key, record=True)
    assert moments is not None
    return record, moments


@partial(jax.jit, static_argnames=("options", "at_once"))
def _many(
    scene: SceneArrays,
    egos: Ego,
    options: Takeover,
    pilot: PolicyPilot | None,
    keys: Key[Array, " B"],
    at_once: int,
) -> Record:
    return replay_many(scene, egos, options, pilot=pilot, keys=keys, at_once=at_once)


__all__ = ["Scene", "load_scene"]
