"""An experiment that runs beside CARLA, decision by decision.

Our vehicles appear in CARLA. The other way round, the ego may be a vehicle of CARLA, driven there by another
client: then our traffic sees it and reacts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from limsim_jax.api.env import Env, EnvState
from limsim_jax.api.experiment import Experiment
from limsim_jax.bridges.carla.server import Backend, CarlaError, Foreign, Show, check_step
from limsim_jax.bridges.carla.stage import Stage, lanes_showing, set_stage, signal_heads
from limsim_jax.maps.lane_map import NO_LANE, LaneMap, project, relative
from limsim_jax.policies.base import PolicyLike
from limsim_jax.simulation.rollout import Rollout, started
from limsim_jax.simulation.trace import Trace, moment, trace
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, State

Lights = Literal["ours", "carla"]


class Live:
    """An experiment beside CARLA, or beside a stand-in for it.

        experiment = lj.Experiment(map="Town05.xodr", ego=lj.Ego(), flows=[lj.Flow(rate=400)])
        with CarlaServer(experiment.map, dt=0.1) as server:
            live = Live(experiment, server, policy=lj.PDMClosed())
            for _ in range(100):
                live.step()

    Args:
      experiment: a value, a name or a file.
      backend: a `CarlaServer` whose `dt` is the step of the experiment, or a stand-in.
      policy: drives the egos; None: that of the experiment.
      seed: of the world.
      hero: role name of a vehicle of CARLA that is our first ego; None: our egos are ours. It is read at each
        decision and rolls on straight in between.
      lights: whose traffic lights count; of "carla", our lights show what CARLA's show.

    Raises:
      ExperimentError: an experiment that cannot run.
      ValueError: a step that differs from the server's, a hero with a policy or without an ego, other lights.
    """

    def __init__(
        self,
        experiment: Experiment | str,
        backend: Backend,
        *,
        policy: PolicyLike | str | None = None,
        seed: int = 0,
        hero: str | None = None,
        lights: Lights = "ours",
    ) -> None:
        self.experiment = experiment if isinstance(experiment, Experiment) else Experiment(experiment)
        if hero is not None and policy is not None:
            raise ValueError(f"hero, policy: '{hero}' drives in CARLA; one of them is expected")
        if hero is not None and not self.experiment.file.ego:
            raise ValueError(f"hero: experiment '{self.experiment.name}' has no ego that it could be")
        if lights not in get_args(Lights):
            raise ValueError(f"lights: '{lights}'; known are {', '.join(get_args(Lights))}")
        check_step(backend, self.experiment.file.dt)
        self.backend, self.hero, self.lights = backend, hero, lights
        episodes = self.experiment.episodes(_Rolling() if hero is not None else policy, chunk=1)
        self.town, self.lanes = episodes.town, episodes.lane_map
        self._own_lanes = self.lanes
        run: Rollout = replace(episodes.rollout, record=trace, measure=None)
        self.config = run.config
        begun = started(run, self.lanes, episodes.sample, seed)
        self._schedule, self._key, self._carry = begun.schedule, begun.key, begun.carry
        self._advance = jax.jit(partial(run.advance, decisions=1))
        self._heads = signal_heads(self.town.network, self.lanes)
        slot = np.asarray(self.state.egos.slot)
        self._ego = int(slot[0]) if len(slot) else -1
        without = frozenset() if hero is None else frozenset({-1 - self._ego})
        self._show = Show(backend, without, lights == "ours")

    @property
    def state(self) -> State:
        """Of all vehicles."""
        return self._carry.state

    @property
    def ego(self) -> int | None:
        """Number of the first ego in CARLA, None without one."""
        return None if self._ego < 0 else -1 - self._ego

    @property
    def time(self) -> float:
        """s since the start."""
        return float(self.config.time(self.state.step))

    def step(self) -> Stage:
        """One decision: read CARLA, drive, show every physics step; returns what was shown.

        Raises:
          CarlaError: what went wrong, in one line.
        """
        state = self.state
        if self.lights == "carla":
            self.lanes = lanes_showing(self._own_lanes, self._heads, self._shown())
        if self.hero is not None:
            state = place_ego(self.lanes, state, self._foreign_hero())
        self._carry = self._carry._replace(state=state)
        result, self._carry = self._advance(self.lanes, self._schedule, self._key, self._carry)
        shown: Trace = jax.device_get(result.trace)
        stage = set_stage(self.town, shown, self._ego, lanes=self.lanes)
        for t in range(len(stage.time)):
            self._show.moment(stage, t)
        return stage

    def clear(self) -> None:
        """Take our vehicles out of CARLA."""
        self._show.clear()

    def _foreign_hero(self) -> Foreign:
        vehicles: list[Foreign] = self.backend.foreign()  # pyright: ignore[reportAttributeAccessIssue]
        found = [one for one in vehicles if one.role == self.hero]
        if len(found) != 1:
            roles = ", ".join(sorted({one.role for one in vehicles})) or "none"
            raise CarlaError(
                f"hero: {len(found)} vehicles with the role '{self.hero}'; one is expected, roles are {roles}"
            )
        return found[0]

    def _shown(self) -> dict[str, str]:
        lights = [head.light for head in self._heads]
        return self.backend.read_lights(lights)  # pyright: ignore[reportAttributeAccessIssue]


def place_ego(lanes: LaneMap, state: State, vehicle: Foreign) -> State:
    """The state with the first ego where a vehicle of CARLA is.

    It has its speed and size, too."""
    x, y = relative(lanes, vehicle.pose.x, vehicle.pose.y)
    heading = math.remainder(vehicle.pose.heading, 2 * math.pi)
    body = jnp.array([x, y, heading, vehicle.v, vehicle.length, vehicle.width], jnp.float32)
    return _placed(lanes, state, body)


@jax.jit
def _placed(lanes: LaneMap, state: State, body: Float[Array, " 6"]) -> State:
    x, y, heading, v, length, width = body
    egos, slot = state.egos, state.egos.slot[0]
    lane, s, d, _ = project(lanes, x, y, heading)
    known = lane != NO_LANE

    def put(column: Array, value: Array) -> Array:
        return column.at[slot].set(value.astype(column.dtype))

    def put_if(column: Array, value: Array) -> Array:
        return column.at[slot].set(jnp.where(known, value.astype(column.dtype), column[slot]))

    return replace(
        state,
        lane=put_if(state.lane, lane),
        s=put_if(state.s, s + length / 2),
        d=put_if(state.d, d),
        v=put(state.v, v),
        shape=replace(
            state.shape, length=put(state.shape.length, length), width=put(state.shape.width, width)
        ),
        egos=replace(
            egos,
            x=egos.x.at[0].set(x),
            y=egos.y.at[0].set(y),
            heading=egos.heading.at[0].set(heading),
        ),
    )


@dataclass(frozen=True)
class _Rolling:
    """A policy that leaves its ego rolling: CARLA says where it is."""

    free = True
    name = "carla"
    others = 0
    privileged = True

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        del config, lane_map, state

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        del config, lane_map, state, key
        return Command(), memory


# --- environments -------------------------------------------------------------------------------------------


class EnvShow:
    """Shows the states of an `Env`; between two decisions vehicles move evenly.

        with CarlaServer(env.experiment.map, dt=env.config.dt) as server:
            show = EnvShow(env, server)
            obs, state = env.reset(key)
            show.state(state)
            obs, state, *_ = env.step(key, state, action)
            show.state(state)

    Args:
      env: whose states are shown.
      backend: a `CarlaServer` whose `dt` is the physics step of the environment, or a stand-in.

    Raises:
      ValueError: a step that differs from the server's.
    """

    def __init__(self, env: Env, backend: Backend) -> None:
        check_step(backend, env.config.dt)
        self.env, self._show = env, Show(backend)
        self._last: Trace | None = None
        self._snapshot = jax.jit(
            lambda lanes, state: moment(state, env.config.time(state.step), boxes(lanes, state))
        )

    def state(self, state: EnvState) -> int:
        """Show the way from the state before to this one; returns the number of ticks.

        After a reset there is no way: call `clear` first.
        """
        now: Trace = jax.device_get(self._snapshot(self.env.lanes, state.world))
        before, self._last = self._last, now
        moments = [now] if before is None else between(before, now, self.env.config.decision_every)
        town, ego = self.env.experiment.map, int(state.world.egos.slot[0])
        stage = set_stage(town, jax.tree.map(lambda *x: np.stack(x), *moments), ego)
        for t in range(len(moments)):
            self._show.moment(stage, t)
        return len(moments)

    def clear(self) -> None:
        """Take all vehicles out."""
        self._show.clear()
        self._last = None


def between(before: Trace, now: Trace, count: int) -> list[Trace]:
    """`count` moments that lead evenly from one moment to the next.

    The last of them is the next itself."""
    stays = before.active & now.active & (before.vehicle == now.vehicle)
    turned = (now.box[:, 2] - before.box[:, 2] + np.pi) % (2 * np.pi) - np.pi
    found = []
    for k in range(1, count):
        share = np.float32(k / count)
        box = before.box + share * (now.box - before.box)
        box[:, 2] = before.box[:, 2] + share * turned
        time = before.time + share * (now.time - before.time)
        found.append(before._replace(time=time, active=stays, box=box))
    return [*found, now]


__all__ = ["EnvShow", "Live", "between", "place_ego"]
