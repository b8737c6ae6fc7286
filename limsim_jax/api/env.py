"""`Env`: an experiment step by step, as a pure function for `jit` and `vmap`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Key

from limsim_jax.api.experiment import Experiment
from limsim_jax.geometry import boxes_overlap
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.map import Map
from limsim_jax.metrics.scores import NUPLAN_OVERSPEED, NUPLAN_TTC
from limsim_jax.policies.base import needs_scenery, with_scenery
from limsim_jax.policies.host import Kind, Observation, Observe, command_from
from limsim_jax.policies.predict import constant_velocity, nearest
from limsim_jax.policies.view import view_of
from limsim_jax.simulation.rollout import Carry, Rollout
from limsim_jax.standards import COMFORT
from limsim_jax.sweeps.experiment import ExperimentError
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.script import lanes_now
from limsim_jax.types import Config, Schedule, State, Status

if TYPE_CHECKING:
    from limsim_jax.sweeps.episode import Episodes


@struct.dataclass(frozen=True, kw_only=True)
class EnvState:
    """A world between two steps."""

    carry: Carry
    schedule: Schedule
    sight: Any  # what the view of the egos remembers, None without one
    key: Key[Array, ""]  # of the world
    ended: Array  # [E], the ego has arrived, its action was broken, or something of `ends` has happened to it
    route: Float[Array, " E"]  # m from its start to its goal; NaN without a way there
    seen: Any  # the last observation of the egos

    @property
    def world(self) -> State:
        """The state of all vehicles."""
        return self.carry.state


class Info(NamedTuple):
    """What a step says beside the reward, `[E]` each."""

    progress: Float[Array, " E"]  # m nearer to the goal
    collided: Array  # bool, so far
    off_road: Array  # bool, so far
    arrived: Array  # bool
    broken: Array  # bool, an action so far was not finite
    time: Float[Array, ""]  # s
    red_light: Array  # bool, crossed a stop line on red so far
    route: Float[Array, " E"]  # m from the start to the goal; NaN without a way there
    speed: Float[Array, " E"]  # m/s
    limit: Float[Array, " E"]  # m/s, of the lane
    acceleration: Float[Array, " E"]  # m/s^2 along the road, mean of the step
    closing: Array  # bool, in contact with another within `CLOSING` s if both keep speed and heading
    terms: dict[str, Array] = {}  # noqa: RUF012 - of the reward, [E] each


Reward = Callable[[Info, Info], Float[Array, " E"] | tuple[Float[Array, " E"], dict[str, Array]]]
"""From what the step before said, and this step, to a reward per ego.

With a dictionary of its terms beside it, they stand in `Info.terms`.
"""

CLOSING = NUPLAN_TTC[0]
"""s, least time to collision."""

_MOMENTS = 4  # at which bodies are compared within that time
_OTHERS = 8  # nearest vehicles that are compared


@dataclass(frozen=True)
class ProgressReward:
    """Scaled progress to the goal, less a penalty for collisions.

    Departures from the road and broken actions count as collisions do; the arrival earns a bonus.

    Attributes:
      scale: m per unit of reward.
      penalty: for a new collision, departure or broken action.
      bonus: for the arrival.
    """

    scale: float = 10.0
    penalty: float = 10.0
    bonus: float = 10.0

    def __call__(self, before: Info, now: Info) -> Float[Array, " E"]:
        """The reward of a step, `[E]`."""
        fresh = (now.collided & ~before.collided) | (now.off_road & ~before.off_road)
        fresh |= now.broken & ~before.broken
        arrived = now.arrived & ~before.arrived
        return (
            now.progress / self.scale
            - jnp.where(fresh, self.penalty, 0.0)
            + jnp.where(arrived, self.bonus, 0.0)
        )


@dataclass(frozen=True)
class RouteReward:
    """Route completion times soft penalties, less a penalty for infractions.

    After CaRL (Jaeger et al., 2025, arXiv 2504.17838): one term to maximise. The share of the route that is
    driven in a step is multiplied by a factor for each of three soft penalties; all are 1 while the driving
    is sound. A collision, a departure from the road, a red light and a broken action cost `penalty` once.

    The terms are `completion` (share of the route), `speeding`, `comfort`, `closing` (factors) and
    `infraction` (0 or 1).

    Attributes:
      scale: reward of a whole route.
      penalty: of an infraction.
      over: m/s above the limit at which nothing is left (that of nuPlan's score).
      soft: factor of a step that is uncomfortable, by nuPlan's bounds of the acceleration, or in which the
        ego closes in on another vehicle, `Info.closing`.
    """

    scale: float = 10.0
    penalty: float = 5.0
    over: float = NUPLAN_OVERSPEED
    soft: float = 0.5

    def __call__(self, before: Info, now: Info) -> tuple[Float[Array, " E"], dict[str, Array]]:
        """The reward of a step `[E]`, and its terms."""
        known = jnp.isfinite(now.route) & (now.route > 0)
        completion = jnp.where(known, now.progress / jnp.where(known, now.route, 1.0), 0.0)
        speeding = 1.0 - jnp.clip((now.speed - now.limit) / self.over, 0.0, 1.0)
        least, most = COMFORT["acceleration"]
        rough = (now.acceleration < least) | (now.acceleration > most)
        comfort = jnp.where(rough, self.soft, 1.0)
        closing = jnp.where(now.closing, self.soft, 1.0)
        infraction = jnp.zeros_like(now.collided)
        for name in ("collided", "off_road", "red_light", "broken"):
            infraction |= getattr(now, name) & ~getattr(before, name)
        terms = {"completion": completion, "speeding": speeding, "comfort": comfort, "closing": closing}
        terms["infraction"] = infraction.astype(completion.dtype)
        # standing still or rolling back earns no more for being rough
        good = jnp.where(completion > 0, speeding * comfort * closing, 1.0)
        return self.scale * completion * good - self.penalty * terms["infraction"], terms


class Env:
    """An experiment as reset and step; the egos do what the actions say, all others drive as traffic.

        env = lj.Env("highway")
        obs, state = env.reset(jax.random.key(0))
        action = {"acceleration": jnp.zeros(env.egos), "steering": jnp.zeros(env.egos)}
        obs, state, reward, terminated, truncated, info = env.step(key, state, action)

    Both are pure: `jax.jit` and `jax.vmap` them at will. A step is one decision of the experiment (0.5 s by
    default). There is no reset on its own: `terminated` and `truncated` say when one is due. After an ego has
    ended, its reward is 0.

    Observations are those of `policies.host.Observation`, actions those of `HostPolicy`, for one world:
    leaves `[E, ...]` for `E` egos. The egos see by the `view` of the experiment unless it says `privileged`.
    Sensors (`lj.ObserveScaled`, `lj.ObserveSensors`) look at the world itself.

    - "control": `acceleration` (m/s^2) and `steering` (rad), `[E]`;
    - "trajectory": `x`, `y` (m), `heading` (rad), `v` (m/s), `[E, samples]`, in the frame of the ego, every
      `sample_time` s from now on;
    - "meta": `meta`, `[E]`, of `traffic.ego.Meta`; -1 drives like the traffic.

    An action that is not finite ends the episode of its ego, which brakes.

    Args:
      experiment: with at least one ego; an `Experiment`, a name or a file.
      action: kind of the actions.
      observe: makes the observation of what the egos see; any `(config, lane_map, state) -> pytree`.
      reward: from two `Info`s to a reward per ego.
      sample_time: s between samples of trajectories.
      ends: bits of `Status` that end the episode of an ego.

    Raises:
      ExperimentError: an experiment that cannot run or has no ego.
      ValueError: an unknown kind of action, or a latency that is not a whole number of decisions.
    """

    def __init__(
        self,
        experiment: Experiment | str | Path,
        *,
        action: Kind = "control",
        observe: Callable[[Config, LaneMap, State], Any] | None = None,
        reward: Reward | None = None,
        sample_time: float = 0.1,
        ends: Status = Status.COLLIDED | Status.OFF_ROAD,
    ) -> None:
        if action not in get_args(Kind):
            raise ValueError(f"action: '{action}'; known are {', '.join(get_args(Kind))}")
        self.experiment = experiment if isinstance(experiment, Experiment) else Experiment(experiment)
        if not self.experiment.file.ego:
            raise ExperimentError(f"{self.experiment.name}: ego: an environment needs at least one")
        self.action: Kind = action
        self.sample_time = sample_time
        self.ends = ends
        self.observe = Observe() if observe is None else observe
        self.reward: Reward = ProgressReward() if reward is None else reward
        ego = self.experiment.file.ego[0]
        self._view = None if ego.privileged else view_of(ego.view)
        driver = _Commanded(action != "meta")
        self._episodes: Episodes = self.experiment.episodes(driver, chunk=1)
        self.lanes = with_scenery(self.observe, self._episodes.town, self._episodes.lane_map)
        self.egos = self._episodes.egos
        self._run: Rollout = replace(self._episodes.rollout, policy=driver, measure=None, record=None)
        self.config = self._run.config
        if self._view is not None:
            self._view.late(self.config)

    @property
    def map(self) -> Map:
        """Where it happens."""
        return self._episodes.town

    @property
    def horizon(self) -> int:
        """Steps until `truncated`."""
        return self._run.decisions

    def reset(self, key: Key[Array, ""]) -> tuple[Any, EnvState]:
        """A new world.

        Args:
          key: draws the traffic and the start of the egos.

        Returns:
          The observation of the egos, and the state.
        """
        scenario_key, own = jax.random.split(key)
        scenario = self._episodes.sample(scenario_key)
        start = scenario.start
        empty = Command()
        carry = self._run.init(self.lanes, start)._replace(memory=empty)
        sight = None if self._view is None else self._view.init(self.config, carry.state)
        seen, sight = self._look(carry.state, scenario.schedule, sight, own)
        state = EnvState(
            carry=carry,
            schedule=scenario.schedule,
            sight=sight,
            key=own,
            ended=jnp.zeros(self.egos, bool),
            route=self._to_go(carry.state),
            seen=seen,
        )
        return seen, state

    def step(
        self, key: Key[Array, ""], state: EnvState, action: dict[str, Any]
    ) -> tuple[Any, EnvState, Array, Array, Array, Info]:
        """One decision further.

        Args:
          key: of this step; nothing in the traffic is drawn from it today.
          state: of the world.
          action: by name; see the class.

        Returns:
          observation, state, reward `[E]`, terminated `[E]`, truncated (scalar), info.
        """
        del key
        before = state.carry.state
        command = command_from(self.action, action, self.config, before, self.sample_time)
        carry = state.carry._replace(memory=command)
        _, after = self._run.advance(self.lanes, state.schedule, state.key, carry, 1)
        after = after._replace(memory=Command())
        last = self._info(before, before, state.route)
        now = self._info(before, after.state, state.route)
        ends = (_status(before, after.state) & int(self.ends)) != 0
        over = state.ended | ends | now.arrived | now.broken
        found = self.reward(last, now)
        reward, terms = found if isinstance(found, tuple) else (found, {})
        now = now._replace(terms=terms)
        reward = jnp.where(state.ended, 0.0, reward)
        truncated = after.state.step >= self._run.decisions * self.config.decision_every
        seen, sight = self._look(after.state, state.schedule, state.sight, state.key)
        new = replace(state, carry=after, sight=sight, ended=over, seen=seen)
        return seen, new, reward, over, truncated, now

    def _look(self, state: State, schedule: Schedule, sight: Any, key: Key[Array, ""]) -> tuple[Any, Any]:
        """The observation of the egos, and the memory of their view."""
        lanes = lanes_now(self.config, self.lanes, schedule, state.step)
        if self._view is not None:
            now = jax.random.fold_in(key, state.step)
            seen, sight = self._view.look(self.config, lanes, state, sight, now)
            if not needs_scenery(self.observe):
                state = seen
        return self.observe(self.config, lanes, state), sight

    def _info(self, before: State, after: State, route: Float[Array, " E"]) -> Info:
        """Of the egos, between two states."""
        slot = before.egos.slot
        status = _status(before, after)
        gone = before.active[slot] & ~after.active[slot]
        bits = (Status.COLLIDED, Status.OFF_ROAD, Status.NOT_FINITE, Status.RED_LIGHT)
        collided, off_road, broken, red_light = ((status & int(bit)) != 0 for bit in bits)
        ahead = self._to_go(before) - jnp.where(gone, 0.0, self._to_go(after))
        # another goal, for a vehicle that missed its way, is no progress
        ahead = jnp.where(gone | (before.goal[slot] == after.goal[slot]), ahead, 0.0)
        there = after.active[slot]
        speed = jnp.where(there, after.v[slot], before.v[slot])
        lasted = jnp.maximum(self.config.time(after.step - before.step), self.config.dt)
        return Info(
            progress=jnp.where(jnp.isfinite(ahead), ahead, 0.0),
            collided=collided,
            off_road=off_road,
            arrived=~there & ~collided,
            broken=broken,
            time=self.config.time(after.step),
            red_light=red_light,
            route=route,
            speed=speed,
            limit=self.lanes.speed_limit[jnp.where(there, after.lane[slot], before.lane[slot])],
            acceleration=(speed - before.v[slot]) / lasted,
            closing=_closing(self.lanes, after) & there,
        )

    def _to_go(self, state: State) -> Float[Array, " E"]:
        """Metres from each ego to its goal along the route; NaN without a way there."""
        slot = state.egos.slot
        lane, goal, routes = state.lane[slot], state.goal[slot], self.lanes.routes
        known = state.active[slot] & (lane >= 0) & routes.reachable[lane, goal]
        return jnp.where(known, routes.distance[lane, goal] - state.s[slot], jnp.nan)


def _status(before: State, after: State) -> Array:
    """Bits of `Status` of the egos `[E]`, gone or not."""
    slot = before.egos.slot
    return jnp.where(after.active[slot], after.status[slot], after.status[slot] | before.status[slot])


def _closing(lane_map: LaneMap, state: State) -> Array:
    """Whether egos `[E]` touch another body within `CLOSING` s, going straight on."""
    slot = state.egos.slot
    times = CLOSING * jnp.arange(1, _MOMENTS + 1, dtype=state.v.dtype) / _MOMENTS
    ahead = constant_velocity(lane_map, state, times)
    near = nearest(lane_map, state, ahead, slot, _OTHERS)  # [E, K]

    def boxes(slots: Array) -> Array:  # [*slots, H, 5]
        size = jnp.stack([ahead.length[slots], ahead.width[slots]], -1)
        pose = jnp.stack([ahead.x[slots], ahead.y[slots], ahead.heading[slots]], -1)
        return jnp.concatenate([pose, jnp.broadcast_to(size[..., None, :], (*pose.shape[:-1], 2))], -1)

    others = boxes(near)
    own = jnp.broadcast_to(boxes(slot)[:, None], others.shape)
    touch = jax.vmap(boxes_overlap)(own.reshape(-1, 5), others.reshape(-1, 5)).reshape(others.shape[:-1])
    return (touch & (near >= 0)[..., None]).any((-1, -2))


@dataclass(frozen=True)
class _Commanded:
    """A policy that does what its memory says."""

    free: bool
    name = "env"
    others = 0
    privileged = True  # it does not look

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        del config, lane_map, state
        return Command()

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        del config, lane_map, state, key
        return memory, memory


__all__ = ["Env", "EnvState", "Info", "Observation", "ProgressReward", "RouteReward"]
