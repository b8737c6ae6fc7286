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
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.host import Kind, Observation, Observe, command_from
from limsim_jax.policies.view import view_of
from limsim_jax.simulation.rollout import Carry, Rollout
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
    ended: Array  # [E], the ego has collided, left the road or arrived, or its action was broken

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


Reward = Callable[[Info, Info], Float[Array, " E"]]
"""From what the step before said, and this step, to a reward per ego."""


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
    ) -> None:
        if action not in get_args(Kind):
            raise ValueError(f"action: '{action}'; known are {', '.join(get_args(Kind))}")
        self.experiment = experiment if isinstance(experiment, Experiment) else Experiment(experiment)
        if not self.experiment.file.ego:
            raise ExperimentError(f"{self.experiment.name}: ego: an environment needs at least one")
        self.action: Kind = action
        self.sample_time = sample_time
        self.observe = Observe() if observe is None else observe
        self.reward: Reward = ProgressReward() if reward is None else reward
        ego = self.experiment.file.ego[0]
        self._view = None if ego.privileged else view_of(ego.view)
        driver = _Commanded(action != "meta")
        self._episodes: Episodes = self.experiment.episodes(driver, chunk=1)
        self.lanes = self._episodes.lane_map
        self.egos = self._episodes.egos
        self._run: Rollout = replace(self._episodes.rollout, policy=driver, measure=None, record=None)
        self.config = self._run.config
        if self._view is not None:
            self._view.late(self.config)

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
        nothing = jnp.zeros(self.egos, bool)
        state = EnvState(carry=carry, schedule=scenario.schedule, sight=sight, key=own, ended=nothing)
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
        last, now = self._info(before, before), self._info(before, after.state)
        over = state.ended | now.collided | now.off_road | now.arrived | now.broken
        reward = jnp.where(state.ended, 0.0, self.reward(last, now))
        truncated = after.state.step >= self._run.decisions * self.config.decision_every
        seen, sight = self._look(after.state, state.schedule, state.sight, state.key)
        new = EnvState(carry=after, schedule=state.schedule, sight=sight, key=state.key, ended=over)
        return seen, new, reward, over, truncated, now

    def _look(self, state: State, schedule: Schedule, sight: Any, key: Key[Array, ""]) -> tuple[Any, Any]:
        """The observation of the egos, and the memory of their view."""
        lanes = lanes_now(self.config, self.lanes, schedule, state)
        if self._view is not None:
            now = jax.random.fold_in(key, state.step)
            state, sight = self._view.look(self.config, lanes, state, sight, now)
        return self.observe(self.config, lanes, state), sight

    def _info(self, before: State, after: State) -> Info:
        """Of the egos, between two states."""
        slot = before.egos.slot
        status = jnp.where(after.active[slot], after.status[slot], after.status[slot] | before.status[slot])
        gone = before.active[slot] & ~after.active[slot]
        bits = (Status.COLLIDED, Status.OFF_ROAD, Status.NOT_FINITE)
        collided, off_road, broken = ((status & int(bit)) != 0 for bit in bits)
        ahead = self._to_go(before) - jnp.where(gone, 0.0, self._to_go(after))
        return Info(
            progress=jnp.where(jnp.isfinite(ahead), ahead, 0.0),
            collided=collided,
            off_road=off_road,
            arrived=~after.active[slot] & ~collided,
            broken=broken,
            time=self.config.time(after.step),
        )

    def _to_go(self, state: State) -> Float[Array, " E"]:
        """Metres from each ego to its goal along the route; NaN without a way there."""
        slot = state.egos.slot
        lane, goal, routes = state.lane[slot], state.goal[slot], self.lanes.routes
        known = state.active[slot] & (lane >= 0) & routes.reachable[lane, goal]
        return jnp.where(known, routes.distance[lane, goal] - state.s[slot], jnp.nan)


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


__all__ = ["Env", "EnvState", "Info", "Observation", "ProgressReward"]
