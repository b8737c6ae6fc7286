"""Area of Interest: planners for the vehicles that matter to the egos, traffic models for all others.

The number of planned vehicles, and so the cost of a world, is fixed. As the egos drive, a vehicle that comes
near gets a place, and a vehicle that is far gives it up. In both cases it continues from its position, at its
speed and acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import Policy, PolicyLike, knows, renew_rows, seeing, sighted, variants
from limsim_jax.policies.limsim_tm import LimSimTM
from limsim_jax.policies.predict import Predictor
from limsim_jax.policies.several import joined
from limsim_jax.policies.view import View
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import assign
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, State, Status

PARTS = 2
"""Policies within an `AreaOfInterest`; each decides with the key folded by its number."""

_ASIDE = 0.6  # m off the middle of its lane, beyond which a vehicle is between two lanes


class Places(NamedTuple):
    """Memory: `K` places, and the memories of the inner policies."""

    slot: Int[Array, " K"]  # vehicle in the place, -1: none
    entered: Float[Array, " K"]  # s, when that vehicle entered the world: a slot may get another vehicle
    since: Float[Array, " K"]  # s, when the vehicle got the place
    switches: Int[Array, ""]  # changes of places so far
    inner: Any


@dataclass(frozen=True)
class AreaOfInterest(Policy):
    """Drives the egos and the most relevant vehicles around them by planners.

    Attributes:
      around: planner of the vehicles around; it moves them in the plane.
      ego: planner of the egos; None: `around`.
      slots: vehicles beside the egos that can be planned for at a time.
      radius: m from the nearest ego, within which a vehicle gets a place.
      leave: m, beyond which it gives up its place; None: 1.3 times the radius.
      dwell: s that it keeps its place at least. Between two lanes it always keeps it.
      privileged: it chooses the vehicles by the state; each planner sees by its own view.

    Raises:
      ValueError: a value out of range, or a planner `around` that keeps to lanes.
    """

    around: PolicyLike = field(default_factory=LimSimTM)
    ego: PolicyLike | None = None
    slots: int = 8
    radius: float = 50.0
    leave: float | None = None
    dwell: float = 3.0
    privileged: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        if self.slots < 1:
            raise ValueError(f"slots: {self.slots}; expected at least 1")
        if not self.radius > 0:
            raise ValueError(f"radius: {self.radius} m; expected more than 0")
        if self.leave is not None and self.leave < self.radius:
            raise ValueError(f"leave: {self.leave} m; expected at least the radius of {self.radius} m")
        for name in ("around", "ego"):
            if isinstance(getattr(self, name), str):
                raise ValueError(f"{name}: expected a policy, such as LimSimTM(), not a name")
        if not self.around.free:
            raise ValueError("around: this policy keeps to lanes; expected one that moves in the plane")

    @property
    def free(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the egos move in the plane; the vehicles around always do."""
        return self.ego is None or self.ego.free

    @property
    def knows(self) -> str:
        """What the planner of the egos knows."""
        return knows(self.around if self.ego is None else self.ego)

    def seeing(self, view: View | None, privileged: bool | None) -> AreaOfInterest:
        """The same with another view of all planners."""
        around = seeing(self.around, view=view, privileged=privileged)
        ego = None if self.ego is None else seeing(self.ego, view=view, privileged=privileged)
        return replace(self, around=around, ego=ego)

    def variants(self, seen: Predictor) -> dict[str, PolicyLike]:
        """The variants of the egos' planner; vehicles around keep theirs."""
        policy = self.around if self.ego is None else self.ego
        found = variants(_with_others(policy, 0), seen)
        return {name: replace(self, ego=other) for name, other in found.items()}

    @property
    def others(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Vehicles beside the egos that can be planned for."""
        return self.slots

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Places:
        """No place is taken."""
        none = jnp.full(self.slots, -1, state.egos.slot.dtype)
        zero = jnp.zeros(self.slots, jnp.float32)
        return Places(none, zero, zero, jnp.int32(0), self._begin(config, lane_map, state))

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Places, key: jax.Array
    ) -> tuple[Command, Places]:
        """Assign the places, then plan."""
        now = config.time(state.step)
        places = self._choose(lane_map, state, memory, now)
        count = state.egos.slot.shape[0] - self.slots
        slot = jnp.concatenate([state.egos.slot[:count], places.slot])
        fresh = slot != state.egos.slot
        state = assign(lane_map, state, boxes(lane_map, state), slot)
        # a vehicle that is new in a place has no memory
        begin, rows = self._begin(config, lane_map, state), self._split(fresh)
        inner = tuple(
            renew_rows(policy, mine, new, old)
            for policy, mine, new, old in zip(self._policies(), rows, begin, places.inner, strict=True)
        )
        command, inner = self._drive(config, lane_map, state, inner, key)
        return replace(command, slot=slot), places._replace(inner=inner)

    def _parts(self, state: State) -> list[tuple[Any, State]]:
        """The policies, each with the rows of egos that it drives."""
        rows = self._split(state.egos)
        return [(p, replace(state, egos=egos)) for p, egos in zip(self._policies(), rows, strict=True)]

    def _policies(self) -> list[Any]:
        around = _with_others(self.around, self.slots)  # its last rows are not egos
        return [sighted(policy) for policy in ([around] if self.ego is None else [self.ego, around])]

    def _split(self, rows: Any) -> list[Any]:
        """Arrays of all rows, split by policy."""
        if self.ego is None:
            return [rows]
        egos = jax.tree.map(lambda x: x[: x.shape[0] - self.slots], rows)
        return [egos, jax.tree.map(lambda x: x[x.shape[0] - self.slots :], rows)]

    def _begin(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        return tuple(policy.init(config, lane_map, some) for policy, some in self._parts(state))

    def _drive(
        self, config: Config, lane_map: LaneMap, state: State, inner: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        found = [
            policy(config, lane_map, some, memory, jax.random.fold_in(key, k))
            for k, ((policy, some), memory) in enumerate(zip(self._parts(state), inner, strict=True))
        ]
        commands, inner = zip(*found, strict=True)
        if len(commands) == 1:
            return commands[0], inner
        if commands[-1].trajectory is None:
            raise ValueError("around: this planner returns no trajectories")
        count = state.egos.slot.shape[0] - self.slots
        return joined([(commands[0], count), (commands[1], self.slots)]), inner

    def _choose(self, lane_map: LaneMap, state: State, memory: Places, now: Float[Array, ""]) -> Places:
        """The places from now on; a vehicle that keeps its place keeps its row."""
        number = state.lane.shape[0]
        egos = state.egos
        count = egos.slot.shape[0] - self.slots
        here = boxes(lane_map, state)[:, :2]
        mine = egos.slot[:count]
        away = jnp.sqrt(jnp.min(jnp.sum((here[:, None] - here[mine][None]) ** 2, -1), -1))  # [N]
        is_ego = (jnp.arange(number)[:, None] == mine[None]).any(-1)
        has = jnp.arange(number)[:, None] == memory.slot[None]  # [N K]
        same = (memory.slot >= 0) & state.active[memory.slot] & (state.entered[memory.slot] == memory.entered)
        stays = (has & same[None]).any(-1)
        young = (has & (same & (now - memory.since < self.dwell))[None]).any(-1)

        # a planner finishes the lane change that it began; near its goal a vehicle leaves by itself
        midway = stays & ((state.side != 0) | (jnp.abs(state.d) > _ASIDE))
        last = lane_map.routes.is_goal[state.lane, state.goal]
        leaving = last & (lane_map.length[state.lane] - state.s < 3.0 * state.v + 10.0)
        fit = state.active & ~is_ego & (~leaving | midway)
        fit &= (state.status & int(Status.COLLIDED | Status.SCRIPTED)) == 0
        fit &= ~(has & ~same[None]).any(-1)  # a slot whose vehicle has changed is free for one decision
        fit &= stays | ((state.side == 0) & (state.s > state.shape.length))
        leave = 1.3 * self.radius if self.leave is None else self.leave
        bound = young | midway
        near = (away < self.radius) | (stays & (away < leave)) | bound
        relevance = jnp.exp(-away / 30.0) + jnp.where(stays, 0.5, 0.0) + jnp.where(bound, 10.0, 0.0)
        relevance = jnp.where(fit & near, relevance, -1.0)
        best, who = lax.top_k(relevance, min(self.slots, number))
        chosen = ((jnp.arange(number)[:, None] == who[None]) & (best > 0)[None]).any(-1)

        keeps = same & chosen[memory.slot]
        new = chosen & ~(has & keeps[None]).any(-1)
        order = lax.top_k(jnp.where(new, relevance, -1.0), min(self.slots, number))
        arrivals = jnp.where(order[0] > 0, order[1], -1)
        rank = jnp.cumsum(~keeps, dtype=jnp.int32) - 1
        arrivals = jnp.pad(arrivals, (0, max(0, self.slots - number)), constant_values=-1)
        slot = jnp.where(keeps, memory.slot, arrivals[jnp.clip(rank, 0, self.slots - 1)]).astype(
            memory.slot.dtype
        )
        switched = jnp.sum(~keeps & ((slot >= 0) | (memory.slot >= 0)), dtype=jnp.int32)
        return memory._replace(
            slot=slot,
            entered=jnp.where(keeps, memory.entered, state.entered[slot]),
            since=jnp.where(keeps, memory.since, now),
            switches=memory.switches + switched,
        )


def _with_others(policy: PolicyLike, count: int) -> PolicyLike:
    """The policy for `count` vehicles beside the egos, if it can."""
    if is_dataclass(policy) and any(f.name == "others" for f in fields(policy)):
        return replace(policy, others=count)
    return policy
