"""Environments of JaxMARL and of gymnax: pure functions for `jit` and `vmap`.

    from limsim_jax.bridges.jaxmarl import gymnax_env, multi_agent_env

    env = multi_agent_env(experiment)  # agents agent_0, agent_1, ...: the egos in their order
    obs, state = env.reset(key)
    obs, state, rewards, dones, infos = env.step(key, state, actions)

Both libraries reset inside of `step`, so each step draws a new world and throws it away unless the episode is
over: about the cost of two decisions. `step_env` leaves that out; a training loop of one's own resets a world
when it is due.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from limsim_jax.api.env import Env, EnvState, Reward
from limsim_jax.api.experiment import Experiment
from limsim_jax.bridges.learning import (
    ACTIONS,
    Observer,
    action_bounds,
    environment,
    info_fields,
    named_action,
    only_ego,
    seen_shape,
)
from limsim_jax.policies.host import Kind
from limsim_jax.policies.vector import may_change
from limsim_jax.traffic.ego import Meta

Source = Env | Experiment | str | Path


def multi_agent_env(
    experiment: Source,
    *,
    action: Kind = "meta",
    observe: Observer | None = None,
    reward: Reward | None = None,
) -> Any:
    """An experiment as a `jaxmarl.environments.MultiAgentEnv`; its egos are the agents.

    An agent is done when it has arrived or made an infraction; its later rewards are 0. `dones["__all__"]`:
    all are done, or the horizon has come, which is in `infos["truncated"]`. `infos` has an array `[agents]`
    per field of `limsim_jax.api.env.Info`.

    `step_env` gives the last observation of an episode; `step` resets, and loses it, as in all of JaxMARL.

    Args:
      experiment: with at least one ego; an `Experiment`, a name, a file, or a `limsim_jax.Env`.
      action, observe, reward: as of `limsim_jax.bridges.gymnasium.Env`.

    Raises:
      ModuleNotFoundError: JaxMARL is not installed.
      ExperimentError, ValueError: as `limsim_jax.bridges.learning.environment`.
    """
    try:
        from jaxmarl.environments import spaces
        from jaxmarl.environments.multi_agent_env import MultiAgentEnv
    except ModuleNotFoundError as error:
        raise _missing(error, "jaxmarl") from None
    core = environment(experiment, action=action, observe=observe, reward=reward)
    seen, bounds = spaces.Box(-1.0, 1.0, seen_shape(core)), action_bounds(core)
    acts = (
        spaces.Discrete(bounds)
        if isinstance(bounds, int)
        else spaces.Box(jnp.asarray(bounds.low), jnp.asarray(bounds.high), bounds.low.shape)
    )

    class Traffic(MultiAgentEnv):
        """The egos of an experiment."""

        def __init__(self) -> None:
            super().__init__(core.egos)
            self.core = core
            self.observation_spaces = dict.fromkeys(self.agents, seen)
            self.action_spaces = dict.fromkeys(self.agents, acts)

        def by_agent(self, rows: Any) -> dict[str, Any]:
            return {name: rows[k] for k, name in enumerate(self.agents)}

        def reset(self, key: Any) -> Any:  # pyright: ignore
            obs, state = core.reset(key)
            return self.by_agent(obs), state

        def step_env(self, key: Any, state: EnvState, actions: Any) -> Any:  # pyright: ignore
            rows = jnp.stack([jnp.asarray(actions[name]) for name in self.agents])
            obs, state, reward, over, late, info = core.step(key, state, named_action(core, rows))
            dones = {**self.by_agent(over | late), "__all__": over.all() | late}
            infos = info_fields(info)
            every = jnp.ones(core.egos, bool)
            infos |= {"time": every * info.time, "truncated": every & late}
            return self.by_agent(obs), state, self.by_agent(reward), dones, infos

        def get_obs(self, state: EnvState) -> Any:  # pyright: ignore
            return self.by_agent(state.seen)

        def get_avail_actions(self, state: EnvState) -> Any:  # pyright: ignore
            if not isinstance(bounds, int):
                return self.by_agent(jnp.ones((core.egos, 1), bool))
            return self.by_agent(available(core, state))

        @property
        def name(self) -> str:
            return core.experiment.name

        @property
        def agent_classes(self) -> dict[str, list[str]]:
            return {"ego": list(self.agents)}

    return Traffic()


def gymnax_env(
    experiment: Source,
    *,
    action: Kind = "meta",
    observe: Observer | None = None,
    reward: Reward | None = None,
) -> Any:
    """An experiment with one ego as a `gymnax` environment.

    `step` returns six values, as in gymnax 1.0: observation, state, reward, terminated, truncated, info, with
    the last observation of an episode in `info["final_observation"]`. For code that expects five, join the
    flags: `done = terminated | truncated`.

    Args:
      experiment: with one ego; an `Experiment`, a name, a file, or a `limsim_jax.Env`.
      action, observe, reward: as of `limsim_jax.bridges.gymnasium.Env`.

    Raises:
      ModuleNotFoundError: gymnax is not installed.
      ExperimentError, ValueError: as `limsim_jax.bridges.learning.environment`, or more than one ego.
    """
    try:
        from gymnax.environments import environment as gymnax
        from gymnax.environments import spaces
    except ModuleNotFoundError as error:
        raise _missing(error, "gymnax") from None
    core = environment(experiment, action=action, observe=observe, reward=reward)
    only_ego(core, "gymnax")
    shape, bounds = seen_shape(core), action_bounds(core)

    class Traffic(gymnax.Environment[Any, Any]):
        """The only ego of an experiment."""

        core: Env

        @property
        def default_params(self) -> Any:
            return gymnax.EnvParams(max_steps_in_episode=core.horizon)

        def reset_env(self, key: Any, params: Any) -> Any:
            del params
            obs, state = core.reset(key)
            return obs[0], state

        def step_env(self, key: Any, state: EnvState, action: Any, params: Any) -> Any:
            del params
            rows = jnp.asarray(action)[None]
            obs, state, reward, over, _, info = core.step(key, state, named_action(core, rows))
            told = {name: x[0] if x.ndim else x for name, x in info_fields(info).items()}
            return obs[0], state, reward[0], over[0], told | {"discount": 1.0 - over[0]}

        def is_truncated(self, state: EnvState, params: Any) -> Any:
            most = jnp.minimum(params.max_steps_in_episode, core.horizon)
            return (state.world.step >= most * core.config.decision_every) & ~state.ended[0]

        def is_terminated(self, state: EnvState, params: Any) -> Any:
            del params
            return state.ended[0]

        def observe(self, key: Any, state: EnvState, action: Any, params: Any) -> Any:
            del key, action, params
            return state.seen[0]

        def get_obs(self, state: EnvState, params: Any = None, key: Any = None) -> Any:
            del params, key
            return state.seen[0]

        @property
        def name(self) -> str:
            return core.experiment.name

        @property
        def num_actions(self) -> int:
            return bounds if isinstance(bounds, int) else bounds.low.size

        def action_space(self, params: Any = None) -> Any:
            del params
            if isinstance(bounds, int):
                return spaces.Discrete(bounds)
            return spaces.Box(jnp.asarray(bounds.low), jnp.asarray(bounds.high), bounds.low.shape)

        def observation_space(self, params: Any = None) -> Any:
            del params
            return spaces.Box(-1.0, 1.0, shape)

    env = Traffic()
    env.core = core
    return env


def available(core: Env, state: EnvState) -> jax.Array:
    """Whether a meta-action has an effect now, `[E, 5]`: marks and lanes forbid some lane changes."""
    room = may_change(core.lanes, state.world)
    always = jnp.ones(core.egos, bool)
    sides = {Meta.LEFT: room[:, 0], Meta.RIGHT: room[:, 1]}
    return jnp.stack([sides.get(meta, always) for meta in ACTIONS], -1)


def _missing(error: ModuleNotFoundError, library: str) -> ModuleNotFoundError:
    """What to say where a library is not installed; other failures as they are."""
    if error.name is None or error.name.partition(".")[0] not in ("jaxmarl", "gymnax", "six"):
        return error
    return ModuleNotFoundError(f'this needs {library}: pip install "limsim-jax[jaxmarl]"', name=error.name)
