"""What all environments for learning share: their worlds, spaces and actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int
from numpy.typing import NDArray

from limsim_jax.api.env import Env, EnvState, Reward, RouteReward
from limsim_jax.api.experiment import Experiment
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.host import Kind
from limsim_jax.policies.vector import ObserveVector
from limsim_jax.simulation.rollout import world_key
from limsim_jax.sweeps.experiment import ExperimentError
from limsim_jax.traffic.ego import Limits, Meta
from limsim_jax.types import Config, State, Status

ACTIONS = (Meta.KEEP, Meta.ACCELERATE, Meta.DECELERATE, Meta.LEFT, Meta.RIGHT)
"""Meta-actions of environments, by their number."""

SAMPLES = 21
"""Samples of a trajectory as an action: 2 s at 0.1 s each."""

INFRACTIONS = Status.COLLIDED | Status.OFF_ROAD | Status.RED_LIGHT
"""What ends an episode beside the arrival and the horizon."""

_LIMITS = Limits()
_BOUNDS: dict[str, tuple[float, float]] = {
    "acceleration": (-float(_LIMITS.deceleration), float(_LIMITS.acceleration)),  # m/s^2
    "steering": (-float(_LIMITS.steering), float(_LIMITS.steering)),  # rad
    "x": (-20.0, 200.0),  # m, 2 s at any speed
    "y": (-100.0, 100.0),  # m
    "heading": (-np.pi, np.pi),  # rad
    "v": (0.0, 70.0),  # m/s
}

_NAMES: dict[Kind, tuple[str, ...]] = {
    "meta": ("meta",),
    "control": ("acceleration", "steering"),
    "trajectory": ("x", "y", "heading", "v"),
}

Observer = Callable[[Config, LaneMap, State], Any]


class Bounds(NamedTuple):
    """A box of numbers: least and greatest values of one shape."""

    low: NDArray[np.float32]
    high: NDArray[np.float32]


def environment(
    experiment: Env | Experiment | str | Path,
    *,
    action: Kind = "meta",
    observe: Observer | None = None,
    reward: Reward | None = None,
) -> Env:
    """The environment that a bridge shows, with the defaults of learning.

    Args:
      experiment: with at least one ego; an `Env` is taken as it is.
      action: kind of the actions.
      observe: makes an array `[E, ...]` within -1 and 1; `ObserveVector` by default.
      reward: `RouteReward` by default.

    Raises:
      ExperimentError: an experiment that cannot run or has no ego.
      ValueError: an unknown kind of action, or options beside an `Env`.
    """
    if isinstance(experiment, Env):
        if action != "meta" or observe is not None or reward is not None:
            raise ValueError("an Env has its own action, observe and reward; pass them to Env")
        return experiment
    return Env(
        experiment,
        action=action,
        observe=ObserveVector() if observe is None else observe,
        reward=RouteReward() if reward is None else reward,
        ends=INFRACTIONS,
    )


def only_ego(env: Env, library: str) -> None:
    """Raise `ExperimentError` unless there is exactly one ego."""
    if env.egos != 1:
        raise ExperimentError(
            f"{env.experiment.name}: ego: {env.egos} egos; {library} knows one agent, so name one, "
            "or use limsim_jax.bridges.jaxmarl"
        )


def seen_shape(env: Env) -> tuple[int, ...]:
    """Shape of what one ego sees.

    Raises:
      ValueError: `observe` makes something other than one array with a row per ego.
    """
    seen, _ = jax.eval_shape(env.reset, jax.random.key(0))
    if not isinstance(seen, jax.ShapeDtypeStruct) or seen.shape[:1] != (env.egos,):
        found = seen.shape if isinstance(seen, jax.ShapeDtypeStruct) else type(seen).__name__
        raise ValueError(f"observe: makes {found}; expected one array with a row for each of {env.egos} egos")
    return seen.shape[1:]


def action_bounds(env: Env) -> Bounds | int:
    """Bounds of the action of an ego; the number of meta-actions."""
    if env.action == "meta":
        return len(ACTIONS)
    rows = np.asarray([_BOUNDS[name] for name in _NAMES[env.action]], np.float32)
    if env.action == "trajectory":
        rows = np.repeat(rows[:, None], SAMPLES, 1)
    return Bounds(rows[..., 0], rows[..., 1])


def named_action(env: Env, action: Array) -> dict[str, Array]:
    """The action of `Env` from an array `[E]` or `[E, ...]`."""
    if env.action == "meta":
        return {"meta": jnp.asarray([int(x) for x in ACTIONS], jnp.int32)[action]}
    return {name: action[:, k] for k, name in enumerate(_NAMES[env.action])}


def episode_key(seed: Int[Array, ""], episode: Int[Array, ""]) -> Array:
    """The key of an episode of a seed; the first one is the world of that seed in a sweep."""
    key = world_key(seed)
    later = jax.random.fold_in(key, episode)
    pick = jnp.where(episode == 0, jax.random.key_data(key), jax.random.key_data(later))
    return jax.random.wrap_key_data(pick)


class Stepped(NamedTuple):
    """`n` worlds after a decision; `[n, E]` where not said otherwise."""

    states: EnvState
    seen: Any  # [n, E, ...]
    reward: Any
    terminated: Any
    truncated: Any  # [n]
    info: dict[str, Any]


@dataclass(frozen=True)
class Programs:
    """The compiled programs of `count` worlds. `few` of them start at a time.

    Attributes:
      start: seeds and episodes `[few]` to states and observations.
      put: states and observations of `count` worlds, those of a few, and their places; a place of `count`
        is none.
      step: states and actions `[count, E, ...]` to `Stepped`.
    """

    count: int
    few: int
    start: Callable[..., Any]
    put: Callable[..., Any]
    step: Callable[..., Any]


def programs(env: Env, count: int, few: int = 16) -> Programs:
    """Programs of `count` worlds; worlds that need a reset get one `few` at a time."""
    few = min(few, count)

    def start(seed: Array, episode: Array) -> tuple[EnvState, Any]:
        seen, state = env.reset(episode_key(seed, episode))
        return state, seen

    def put(states: EnvState, seen: Any, fresh: tuple[EnvState, Any], places: Array) -> Any:
        return jax.tree.map(lambda x, y: x.at[places].set(y, mode="drop"), (states, seen), fresh)

    def step(state: EnvState, action: Array) -> Stepped:
        seen, state, reward, over, late, info = env.step(state.key, state, named_action(env, action))
        return Stepped(state, seen, reward, over, late, info_fields(info))

    return Programs(
        count=count,
        few=few,
        start=jax.jit(jax.vmap(start)),
        put=jax.jit(put, donate_argnums=(0,)),
        step=jax.jit(jax.vmap(step), donate_argnums=(0,)),
    )


def info_fields(info: Any) -> dict[str, Any]:
    """`Info` by name; terms of the reward as `reward_...`."""
    told = info._asdict()
    terms = {f"reward_{name}": x for name, x in told.pop("terms").items()}
    return told | terms
