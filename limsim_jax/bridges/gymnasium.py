"""Environments of Gymnasium: one world, or many worlds as one batch.

    import gymnasium
    import limsim_jax.bridges.gymnasium  # registers the names

    env = gymnasium.make("limsim_jax/Highway-v0")
    envs = gymnasium.make_vec("limsim_jax/Traffic-v0", num_envs=128, experiment="my.toml")

Gymnasium 1.1 or later. Observations and actions are those of `limsim_jax.bridges.learning`. The pure core is
`limsim_jax.Env`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from limsim_jax.api.env import Env as PureEnv
from limsim_jax.api.env import EnvState, Reward
from limsim_jax.api.experiment import Experiment
from limsim_jax.bridges.learning import (
    Observer,
    Programs,
    action_bounds,
    environment,
    only_ego,
    programs,
    seen_shape,
)
from limsim_jax.policies.host import Kind
from limsim_jax.simulation.trace import Trace, moment
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import State
from limsim_jax.xla import enable_compilation_cache

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    if error.name is not None and error.name.partition(".")[0] != "gymnasium":
        raise
    raise ModuleNotFoundError(
        'limsim_jax.bridges.gymnasium needs gymnasium: pip install "limsim-jax[gym]"', name="gymnasium"
    ) from None

IDS = {
    "limsim_jax/Highway-v0": "highway",
    "limsim_jax/Ramp-v0": "ramp",
    "limsim_jax/Intersection-v0": "intersection",
    "limsim_jax/Roundabout-v0": "roundabout",
    "limsim_jax/LongRoute-v0": "long_route",
    "limsim_jax/Traffic-v0": None,
}
"""Registered environments, and the experiment of each; the last one needs `experiment=`."""

RENDER_MODES = ("rgb_array",)

Source = PureEnv | Experiment | str | Path


def register() -> None:
    """Make the names of `IDS` known to Gymnasium."""
    for name, experiment in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="limsim_jax.bridges.gymnasium:Env",
                vector_entry_point="limsim_jax.bridges.gymnasium:VectorEnv",
                kwargs={} if experiment is None else {"experiment": experiment},
            )


class _Worlds:
    """The worlds behind an environment, with their seeds."""

    def __init__(self, env: PureEnv, count: int) -> None:
        self.env, self.programs = env, _programs(env, count)
        self.seeds, self.episodes = np.zeros(count, np.int32), np.zeros(count, np.int32)
        self.states: Any = None
        self.seen: Any = None

    def restart(self, which: NDArray[np.intp]) -> None:
        """Begin the episode `episodes` of the worlds `which`."""
        few, count = self.programs.few, self.programs.count
        for first in range(0, len(which), few):
            some = which[first : first + few]
            rows = np.resize(some, few)
            fresh = self.programs.start(self.seeds[rows], self.episodes[rows])
            if self.states is None:  # any arrays of the right shape
                self.states, self.seen = jax.tree.map(functools.partial(_first, count), fresh)
            places = np.full(few, count, np.int32)
            places[: len(some)] = some
            self.states, self.seen = self.programs.put(self.states, self.seen, fresh, places)

    def step(self, action: NDArray[Any]) -> tuple[Any, ...]:
        """One decision: observations, rewards, flags and infos of the only ego of each world."""
        found = self.programs.step(self.states, action[:, None])
        self.states, self.seen = found.states, found.seen
        reward, over, late, info = jax.device_get(found[2:])
        info = {name: x[:, 0] if x.ndim > 1 else x for name, x in info.items()}
        return (
            np.asarray(self.seen)[:, 0],
            reward[:, 0].astype(np.float64),
            over[:, 0],
            late & ~over[:, 0],
            info,
        )


def _first(count: int, x: Any) -> Any:
    """The first row, `count` times."""
    return x[np.zeros(count, np.int32)]


@functools.lru_cache(maxsize=8)
def _programs(env: PureEnv, count: int) -> Programs:
    """Environments of one core share their programs."""
    enable_compilation_cache()
    return programs(env, count)


@functools.lru_cache(maxsize=8)
def _shared(experiment: Source, action: Kind, observe: Observer | None, reward: Reward | None) -> PureEnv:
    return environment(experiment, action=action, observe=observe, reward=reward)


def _core(
    experiment: Source | None, action: Kind, observe: Observer | None, reward: Reward | None
) -> PureEnv:
    if experiment is None:
        raise ValueError("experiment: none; expected a name, a file or an Experiment, such as 'highway'")
    try:
        env = _shared(experiment, action, observe, reward)
    except TypeError as error:  # an option that has no hash
        if "unhashable" not in str(error):
            raise
        env = environment(experiment, action=action, observe=observe, reward=reward)
    only_ego(env, "Gymnasium")
    return env


def _spaces(env: PureEnv) -> tuple[Any, Any]:
    """Spaces of what an ego sees and does."""
    bounds = action_bounds(env)
    seen = gymnasium.spaces.Box(-1.0, 1.0, seen_shape(env), np.float32)
    if isinstance(bounds, int):
        return seen, gymnasium.spaces.Discrete(bounds)
    return seen, gymnasium.spaces.Box(bounds.low, bounds.high, dtype=np.float32)


def _checked_action(action: Any, space: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """The actions as an array of a shape; raises `ValueError` for others."""
    discrete = isinstance(space, gymnasium.spaces.Discrete)
    wanted = f"whole numbers from 0 to {space.n - 1}" if discrete else "finite numbers"
    try:
        found = np.asarray(action)
        if found.dtype.kind not in ("iu" if discrete else "fiu"):
            raise ValueError
    except (ValueError, TypeError):
        raise ValueError(f"action: {action!r}; expected {wanted}") from None
    if found.shape != shape:
        raise ValueError(f"action: shape {found.shape}; expected {shape}")
    bad = (found < 0) | (found >= space.n) if discrete else ~np.isfinite(found)
    if bad.any():
        where = tuple(int(k) for k in np.argwhere(bad)[0])
        place = f" at {list(where)}" if where else ""
        raise ValueError(f"action: {found[where]}{place}; expected {wanted}")
    return found.astype(np.int32 if discrete else np.float32)


def _checked_mode(render_mode: str | None) -> str | None:
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode: '{render_mode}'; known are {', '.join(RENDER_MODES)}, None")
    return render_mode


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**31:
        raise ValueError(f"seed: {seed!r}; seeds are whole numbers from 0 to 2^31 - 1")
    return int(seed)


class Env(gymnasium.Env[NDArray[np.float32], Any]):
    """One world with one ego.

    The first episode after `reset(seed=k)` is the world of seed `k` in a sweep. Later resets without a seed
    begin other episodes, the same ones for the same seed. `terminated`: the ego has arrived, or made an
    infraction; `truncated`: the horizon came first. `info` holds the fields of `limsim_jax.api.env.Info` and
    the terms of the reward.

    Args:
      experiment: with one ego; an `Experiment`, a name, a file, or a `limsim_jax.Env`.
      action: "meta" (Discrete: keep, accelerate, decelerate, left, right), "control" (Box: acceleration in
        m/s^2, steering in rad) or "trajectory" (Box of x, y (m), heading (rad), v (m/s): 21 samples of
        0.1 s).
      observe: makes an array `[E, ...]` within -1 and 1; `ObserveVector` by default.
      reward: `RouteReward` by default.
      render_mode: "rgb_array", or None.

    Raises:
      ExperimentError: an experiment that cannot run, or that has not exactly one ego.
      ValueError: an unknown option, a seed out of range, or an action of another shape or not finite.
    """

    metadata = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012 - as Gymnasium has it, and asks for it

    def __init__(
        self,
        experiment: Source | None = None,
        *,
        action: Kind = "meta",
        observe: Observer | None = None,
        reward: Reward | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.render_mode = _checked_mode(render_mode)
        core = _core(experiment, action, observe, reward)
        self.observation_space, self.action_space = _spaces(core)
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": 1 / core.config.decision_time}
        self._worlds = _Worlds(core, 1)
        self._seeded, self._picture = False, _Pictures(core)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode."""
        if seed is not None:
            _checked_seed(seed)
        super().reset(seed=seed, options=options)
        worlds = self._worlds
        if seed is None and self._seeded:
            worlds.episodes[0] += 1
        else:
            worlds.seeds[0] = int(self.np_random.integers(2**31)) if seed is None else seed
            worlds.episodes[0], self._seeded = 0, True
        worlds.restart(np.arange(1))
        return np.array(worlds.seen)[0, 0], {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One decision further."""
        if self._worlds.states is None:
            raise ValueError("step: call reset first")
        chosen = _checked_action(action, self.action_space, self.action_space.shape or ())
        seen, reward, over, late, info = self._worlds.step(chosen[None])
        told = {name: x[0].item() for name, x in info.items()}
        return seen[0], float(reward[0]), bool(over[0]), bool(late[0]), told

    def render(self) -> Any:
        """The surroundings of the ego, `[H, W, 3]`, uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        if self._worlds.states is None:
            raise ValueError("render: call reset first")
        return self._picture.of(self._worlds.states, 0)


class VectorEnv(gymnasium.vector.VectorEnv[NDArray[np.float32], Any, NDArray[Any]]):
    """Many worlds with one ego each, driven by one compiled program.

    Environment `i` after `reset(seed=k)` is `Env` after `reset(seed=k + i)`, whatever their number.

    After an episode has ended:

    - "NextStep": the next step ignores the action and begins an episode, with reward 0;
    - "SameStep": the same step does, and the last observation is in `infos["final_obs"]`;
    - "Disabled": `reset(options={"reset_mask": mask})` does.

    Args:
      experiment, action, observe, reward, render_mode: as of `Env`.
      num_envs: number of worlds.
      autoreset_mode: a `gymnasium.vector.AutoresetMode`, or its value.

    Raises:
      ExperimentError, ValueError: as `Env`.
    """

    def __init__(
        self,
        experiment: Source | None = None,
        num_envs: int = 1,
        *,
        action: Kind = "meta",
        observe: Observer | None = None,
        reward: Reward | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs: {num_envs!r}; expected a whole number of at least 1")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(f"autoreset_mode: {autoreset_mode!r}; known are {known}") from None
        self.render_mode = _checked_mode(render_mode)
        core = _core(experiment, action, observe, reward)
        self.num_envs = num_envs
        self.metadata = {
            "render_modes": list(RENDER_MODES),
            "render_fps": 1 / core.config.decision_time,
            "autoreset_mode": self._mode,
        }
        self.single_observation_space, self.single_action_space = _spaces(core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._worlds = _Worlds(core, num_envs)
        self._over, self._seeded = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self._pictures: list[_Pictures] = [_Pictures(core) for _ in range(num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin episodes in all environments, or in those of `options["reset_mask"]`."""
        which = np.arange(self.num_envs)
        if options is not None and "reset_mask" in options:
            which = np.flatnonzero(self._checked_mask(options.pop("reset_mask")))
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else seed + k for k in range(self.num_envs)]
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed: {len(seeds)} seeds; expected {self.num_envs}")
        for one in seeds:
            if one is not None:
                _checked_seed(one)
        super().reset(seed=int(seed) if isinstance(seed, int | np.integer) else None)
        worlds = self._worlds
        for k in which:
            one = seeds[k]
            if one is None and self._seeded[k]:
                worlds.episodes[k] += 1
            else:
                worlds.seeds[k] = int(self.np_random.integers(2**31)) if one is None else one
                worlds.episodes[k], self._seeded[k] = 0, True
        worlds.restart(which)
        self._over[which] = False
        return np.array(worlds.seen)[:, 0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One decision further in all environments."""
        if self._worlds.states is None:
            raise ValueError("step: call reset first")
        chosen = _checked_action(actions, self.single_action_space, self.action_space.shape or ())
        if self._mode is AutoresetMode.DISABLED and self._over.any():
            k = int(np.flatnonzero(self._over)[0])
            raise ValueError(f"step: environment {k} has ended; reset it with options={{'reset_mask': ...}}")
        seen, reward, over, late, info = self._worlds.step(chosen)
        if self._mode is AutoresetMode.NEXT_STEP:
            begun = self._over.copy()
            over, late = over & ~begun, late & ~begun
            reward = np.where(begun, 0.0, reward)
            infos = _masked(info, ~begun)
        elif self._mode is AutoresetMode.SAME_STEP:
            begun = over | late
            infos = _masked(info, ~begun)
            if begun.any():
                last = np.full(self.num_envs, None, object)
                for k in np.flatnonzero(begun):
                    last[k] = seen[k].copy()
                infos |= {"final_obs": last, "_final_obs": begun.copy()}
                infos |= {"final_info": _masked(info, begun), "_final_info": begun.copy()}
        else:
            begun, infos = np.zeros(self.num_envs, bool), _masked(info, np.ones(self.num_envs, bool))
        if begun.any():
            self._worlds.episodes[begun] += 1
            self._worlds.restart(np.flatnonzero(begun))
            seen = np.array(self._worlds.seen)[:, 0]
        self._over = over | late if self._mode is not AutoresetMode.SAME_STEP else np.zeros_like(over)
        return seen, reward, over, late, infos

    def render(self) -> tuple[Any, ...] | None:
        """The surroundings of each ego, `[H, W, 3]`, uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        if self._worlds.states is None:
            raise ValueError("render: call reset first")
        return tuple(picture.of(self._worlds.states, k) for k, picture in enumerate(self._pictures))

    def _checked_mask(self, mask: Any) -> NDArray[np.bool_]:
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask: expected a NumPy array of {self.num_envs} bools")
        if not mask.any():
            raise ValueError("reset_mask: all False; expected at least one environment to reset")
        if self._worlds.states is None and not mask.all():
            raise ValueError("reset_mask: call reset without a mask first")
        return mask


def _masked(info: dict[str, NDArray[Any]], there: NDArray[np.bool_]) -> dict[str, Any]:
    """Infos with their masks, zeros where not `there`."""
    if not there.any():
        return {}
    infos: dict[str, Any] = {}
    for name, x in info.items():
        infos[name], infos[f"_{name}"] = np.where(there, x, np.zeros_like(x)), there.copy()
    return infos


class _Pictures:
    """Frames of one world, which share the drawing of the map."""

    def __init__(self, core: PureEnv) -> None:
        self.core = core
        self._camera: Any = None

    def of(self, states: Any, k: int) -> NDArray[np.uint8]:
        """The frame of world `k` now."""
        trace = jax.device_get(_moment(self.core)(states, k))
        if self._camera is None:
            from limsim_jax.report.stills import LiveCamera

            self._camera = LiveCamera(self.core.map.network, self.core.lanes, trace, int(trace.driven[0, 0]))
        return self._camera.frame(trace)


@functools.lru_cache(maxsize=8)
def _moment(core: PureEnv) -> Callable[[Any, int], Trace]:
    """World `k` of a batch now, as a trace of one step."""

    def now(states: EnvState, k: Any) -> Trace:
        state: State = jax.tree.map(lambda x: x[k], states.world)
        seen = moment(state, core.config.time(state.step), boxes(core.lanes, state))
        return jax.tree.map(lambda x: x[None], seen)

    return jax.jit(now)


register()
