"""What a policy is: once per decision it looks at the world and commands the egos."""

from __future__ import annotations

import inspect
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Key

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.maps.map import Map
from limsim_jax.maps.scenery import Scenery
from limsim_jax.policies.predict import Predictor
from limsim_jax.policies.view import View, view_of
from limsim_jax.sensors.rig import Rig
from limsim_jax.traffic.command import Command
from limsim_jax.types import Config, State

_NAME = re.compile(r"[A-Za-z0-9_-]+")


@runtime_checkable
class PolicyLike(Protocol):
    """What the simulator asks of a policy; `Policy` is a base class with defaults."""

    @property
    def free(self) -> bool:
        """Whether its egos move in the plane (by trajectories or controls); otherwise they keep to lanes."""
        ...

    @property
    def others(self) -> int:
        """Vehicles that it can drive at a time beside the egos: more rows of `State.egos`."""
        ...

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The memory at the start: any pytree of arrays, whose shapes stay the same."""
        ...

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: Key[Array, ""]
    ) -> tuple[Command, Any]:
        """What the egos do until the next decision, and the new memory."""
        ...


@dataclass(frozen=True, eq=False)
class Policy(ABC):
    """Base class of policies: a pure function of one world, with a memory of its own.

    A policy of one's own needs `__call__` alone. Settings are fields of a frozen dataclass:

        @dataclass(frozen=True)
        class Cautious(Policy):
            share: float = 0.8

            def __call__(self, config, lane_map, state, memory, key):
                ...
                return Command(trajectory=trajectory), memory

    Class attributes: `free`, whether egos move in the plane (otherwise they keep to lanes); `others`, the
    number of vehicles that it can drive beside the egos; and `needs_scenery`, whether it looks at
    `lane_map.scenery`, what sensors see of the map.

    Attributes:
      name: of the policy in results; None: that of the class, see `policy_name`.
      view: what it can see; drivers and routes of other vehicles are beliefs.
      privileged: whether it gets the true state of the simulation instead of the view.
    """

    name: str | None = field(default=None, kw_only=True)
    view: View = field(default=View(), kw_only=True)
    privileged: bool = field(default=False, kw_only=True)

    free = True
    others = 0
    needs_scenery = False
    default_name: ClassVar[str | None] = None

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The memory at the start: a pytree of arrays of constant shapes.

        By default there is none.
        """
        del config, lane_map, state

    @abstractmethod
    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: Key[Array, ""]
    ) -> tuple[Command, Any]:
        """What the egos do until the next decision, and the new memory.

        Args:
          config: steps and times of the simulation.
          lane_map: the map.
          state: the world now, as the planner sees it. Row k of `state.egos` is the k-th ego,
            `state.egos.slot[k]` its vehicle.
          memory: what `init` or the call before returned.
          key: random key of this decision.
        """

    def memory_rows(self, memory: Any) -> Any:
        """Whether arrays of the memory have one row per ego: a tree of bools.

        Rows are the first axis. `AreaOfInterest` starts a row anew when it gets another vehicle. By default
        these are all arrays that have an axis; scalars are shared by all egos.
        """
        return rows_by_axis(memory)


def rows_by_axis(memory: Any) -> Any:
    """`Policy.memory_rows` by default: every array with at least one axis."""
    return jax.tree.map(lambda x: jnp.ndim(x) > 0, memory)


@dataclass(frozen=True)
class LikeTraffic(Policy):
    """The egos drive as all traffic does: car following, lane changes, right of way."""

    free = False
    privileged: bool = field(default=True, kw_only=True)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """No command."""
        del config, lane_map, state, key
        return Command(), memory


# --- policies around policies ------------------------------------------------------------------------


@dataclass(frozen=True)
class Wrapper(Policy):
    """A policy around another one, with its memory."""

    policy: PolicyLike

    @property
    def free(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the policy."""
        return self.policy.free

    @property
    def others(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Those of the policy."""
        return getattr(self.policy, "others", 0)

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Any:
        """The memory of the policy."""
        return self.policy.init(config, lane_map, state)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Any, key: jax.Array
    ) -> tuple[Command, Any]:
        """The command of the policy."""
        return self.policy(config, lane_map, state, memory, key)

    def memory_rows(self, memory: Any) -> Any:
        """Those of the policy."""
        return memory_rows(self.policy, memory)

    def variants(self, seen: Predictor) -> dict[str, PolicyLike]:
        """Those of the policy."""
        return variants(self.policy, seen)


class _Sight(NamedTuple):
    sight: Any  # memory of the view
    policy: Any  # memory of the policy


@dataclass(frozen=True)
class _Sighted(Wrapper):
    """A policy that gets its view instead of the state."""

    def init(self, config: Config, lane_map: LaneMap, state: State) -> _Sight:
        return _Sight(self.view.init(config, state), self.policy.init(config, lane_map, state))

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: _Sight, key: jax.Array
    ) -> tuple[Command, _Sight]:
        seen, sight = self.view.look(config, lane_map, state, memory.sight, key)
        command, inner = self.policy(config, lane_map, seen, memory.policy, key)
        return command, _Sight(sight, inner)

    def memory_rows(self, memory: _Sight) -> Any:
        rows = memory_rows(self.policy, memory.policy)
        return _Sight(jax.tree.map(lambda _: False, memory.sight), rows)


def sighted(policy: PolicyLike) -> PolicyLike:
    """The policy as it is to be called: with its view of the world, unless it is privileged.

    A policy without a `view` gets the default one.
    """
    if getattr(policy, "privileged", False):
        return policy
    return _Sighted(policy, view=getattr(policy, "view", View()), privileged=True)


def views(policy: Any) -> list[View]:
    """The views of a policy and of the policies in it.

    Raises:
      ValueError: a view that is none.
    """
    found = [view for one in _inner(policy) for view in views(one)]
    if getattr(policy, "privileged", False):
        return found
    view = getattr(policy, "view", View())
    if not isinstance(view, View):
        raise ValueError(f"view is {view!r}; expected a limsim_jax.View, or a table in a file")
    return [*found, view]


def _inner(policy: Any) -> list[Any]:
    """The policies in a policy."""
    inner = [getattr(policy, name, None) for name in ("policy", "around", "ego")]
    return [one for one in (*inner, *getattr(policy, "policies", ())) if isinstance(one, PolicyLike)]


def needs_scenery(policy: Any) -> bool:
    """Whether a policy, or one in it, looks at `lane_map.scenery`."""
    return bool(getattr(policy, "needs_scenery", False)) or any(map(needs_scenery, _inner(policy)))


def with_scenery(policy: Any, town: Map, lane_map: LaneMap | None = None) -> LaneMap:
    """The arrays of a map as a policy needs them: with `scenery` if it needs that.

    Args:
      policy: that drives on the map.
      town: the map.
      lane_map: its arrays; None: those of the map.
    """
    lanes = town.lanes if lane_map is None else lane_map
    return replace(lanes, scenery=town.scenery) if needs_scenery(policy) else lanes


def scenery_of(lane_map: LaneMap) -> Scenery:
    """The scenery of a map.

    Raises:
      ValueError: the map comes without.
    """
    if lane_map.scenery is None:
        raise ValueError("lane_map: no scenery; limsim_jax.policies.base.with_scenery adds it")
    return lane_map.scenery


def sensors_of(policy: Any) -> Rig | None:
    """The rig that a policy declares as `sensors` or `rig`.

    `sensors` may also be an object with a `rig`, and the policy one within another. None: there is none."""
    for name in ("sensors", "rig"):
        found = getattr(policy, name, None)
        if isinstance(found := getattr(found, "rig", found), Rig):
            return found
    for one in _inner(policy):
        if (found := sensors_of(one)) is not None:
            return found
    return None


def knows(policy: Any) -> str:
    """What a policy knows of other vehicles: "state", "view" or "sensors"."""
    told = getattr(policy, "knows", None)
    return told or ("state" if getattr(policy, "privileged", False) else "view")


# --- names -------------------------------------------------------------------------------------------


def policy_name(policy: Any) -> str:
    """The name of a policy in tables and result folders.

    Its attribute `name`; without one its class in snake case, such as `pdm_closed` for `PDMClosed`, or the
    function of a `HostPolicy`.

    Raises:
      ValueError: a name with other characters than letters, digits, `_` and `-`.
    """
    kind = type(policy)
    for name in (
        getattr(policy, "name", None),
        getattr(kind, "name", None),
        getattr(policy, "default_name", None),
    ):
        if isinstance(name, str) and name:
            return _checked_name(name)
    return _checked_name(snake_case(kind.__name__))


def named(name: str, policy: Any) -> Any:
    """The same policy under another name.

    One sweep can then have two settings of a planner.

    Raises:
      ValueError: a name with other characters than letters, digits, `_` and `-`.
    """
    _checked_name(name)
    if is_dataclass(policy) and any(f.name == "name" and f.init for f in fields(policy)):
        return replace(policy, name=name)  # pyright: ignore[reportArgumentType]
    return _wrapped(policy, name)


def _wrapped(policy: Any, name: str) -> Wrapper:
    """The policy with fields `name`, `view` and `privileged`."""
    view, privileged = getattr(policy, "view", View()), getattr(policy, "privileged", False)
    return Wrapper(policy, name=name, view=view, privileged=privileged)


def seeing(policy: Any, *, view: View | None = None, privileged: bool | None = None) -> Any:
    """The same policy with another view, or with the state.

    Args:
      policy: any policy.
      view: what it sees; None: as now.
      privileged: whether it gets the state; None: as now.
    """
    if callable(own := getattr(policy, "seeing", None)):
        return own(view, privileged)
    if not isinstance(policy, Policy):
        policy = _wrapped(policy, policy_name(policy))
    return replace(
        policy,  # pyright: ignore[reportArgumentType]
        view=policy.view if view is None else view,
        privileged=policy.privileged if privileged is None else privileged,
    )


def snake_case(name: str) -> str:
    """`PDMClosed` as `pdm_closed`."""
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_").lower() or "policy"


def _checked_name(name: str) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(f"policy name {name!r}: only letters, digits, _ and -")
    return name


# --- what a policy offers, and whether it keeps to the rules -----------------------------------------


def build_policy(factory: Callable[..., PolicyLike], options: Mapping[str, Any]) -> PolicyLike:
    """The policy that an experiment file describes.

    Raises:
      ValueError: an unknown option, or a value that makes no sense.
    """
    takes = inspect.signature(factory).parameters
    anything = any(x.kind is inspect.Parameter.VAR_KEYWORD for x in takes.values())
    for name in options:
        if name not in takes and not anything:
            raise ValueError(f"{name}: no such option; there are {', '.join(takes) or 'none'}")
    ours = isinstance(factory, type) and issubclass(factory, Policy)
    if ours and isinstance(options.get("view"), Mapping):  # as a file has it
        options = {**options, "view": view_of(options["view"])}
    return factory(**options)


def variants(policy: Any, seen: Predictor) -> dict[str, PolicyLike]:
    """The policy with one module replaced by a reference, by module.

    After a failure each is asked for: a module is to blame if its reference would have avoided the failure. A
    policy made of modules has a method `variants`; of others there are none. `seen` predicts what happened.
    A view that errs is a module, too: `perception`, whose reference sees the same without errors. References
    of other modules see with its errors.
    """
    own = getattr(policy, "variants", None)
    found = {} if own is None else own(seen)
    view = getattr(policy, "view", None)
    if getattr(policy, "privileged", False) or not isinstance(view, View) or view == view.without_errors():
        return found
    found = {name: seeing(other, view=view, privileged=False) for name, other in found.items()}
    return {"perception": seeing(policy, view=view.without_errors())} | found


def memory_rows(policy: Any, memory: Any) -> Any:
    """Whether arrays of a memory have one row per ego, see `Policy.memory_rows`."""
    found = getattr(policy, "memory_rows", rows_by_axis)(memory)
    return jax.tree.map(lambda mine, part: jax.tree.map(lambda _: mine, part), found, memory)


def renew_rows(policy: Any, fresh: Bool[Array, " E"], new: Any, old: Any) -> Any:
    """The memory of a policy, `new` in the rows that are `fresh`.

    Raises:
      ValueError: an array that should have one row per ego has another number of them.
    """
    count = fresh.shape[0]

    def one(by_row: bool, new: Array, old: Array) -> Array:
        if not by_row:
            return old
        if new.shape[:1] != (count,):
            raise ValueError(
                f"{policy_name(policy)}: memory of shape {list(new.shape)} has no row for each of {count} "
                "egos; memory_rows says which arrays have"
            )
        return jnp.where(fresh.reshape((-1,) + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(one, memory_rows(policy, new), new, old)


def check_policy(policy: Any, config: Config, lane_map: LaneMap, state: State) -> tuple[Any, Any]:
    """Whether a policy keeps to the rules, found by tracing it once; nothing is compiled or run.

    Exceptions of the policy itself pass unchanged.

    Args:
      policy: the policy.
      config: of the experiment.
      lane_map: arrays, or their shapes (`jax.ShapeDtypeStruct`).
      state: of one world, with the rows of `egos` that the policy drives.

    Returns:
      The jaxprs of `init` and of a decision.

    Raises:
      ValueError: one line that names the class of the policy, what it returned and what is expected.
    """
    label = type(policy).__name__
    if isinstance(policy, type):
        raise ValueError(f"{policy.__name__}: a class, not a policy; expected {policy.__name__}()")
    start = getattr(policy, "init", None)
    if not (callable(policy) and callable(start)):
        raise ValueError(f"{label}: a policy has methods init and __call__; derive it from limsim_jax.Policy")
    if not isinstance(getattr(policy, "free", None), bool):
        raise ValueError(f"{label}: free is {getattr(policy, 'free', None)!r}; a policy says True or False")

    def begin(lane_map: LaneMap, state: State) -> Any:
        memory = start(config, lane_map, state)
        _check_arrays(label, "init", memory)
        return memory

    def decide(lane_map: LaneMap, state: State, memory: Any, key: Key[Array, ""]) -> Any:
        found = policy(config, lane_map, state, memory, key)
        if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], Command)):
            raise ValueError(f"{label}: a policy returns (Command, memory), not {_kind(found)}")
        _check_arrays(label, "the policy", found[1])
        return found

    first, memory = jax.make_jaxpr(begin, return_shape=True)(lane_map, state)
    each, found = jax.make_jaxpr(decide, return_shape=True)(lane_map, state, memory, jax.random.key(0))
    command, after = found
    before, now = (jax.tree_util.tree_flatten_with_path(x) for x in (memory, after))
    if before[1] != now[1]:
        raise ValueError(f"{label}: memory changes its structure, from {before[1]} to {now[1]}")
    for (path, old), (_, new) in zip(before[0], now[0], strict=True):
        if (old.shape, old.dtype) != (new.shape, new.dtype):
            place = jax.tree_util.keystr(path)
            raise ValueError(f"{label}: memory{place} changes from {_shape(old)} to {_shape(new)}")
    _check_command(label, command, state.egos.slot.shape[0])
    return first, each


def _check_command(label: str, command: Command, count: int) -> None:
    """Raise `ValueError` if arrays lack one row per ego."""
    if command.trajectory is not None:
        x = command.trajectory.x
        for name in ("x", "y", "heading", "v"):
            value = getattr(command.trajectory, name)
            if value.shape != x.shape or x.ndim != 2 or x.shape[0] != count or x.shape[1] < 2:
                wanted = f"[{count} egos, 2 or more samples]"
                raise ValueError(f"{label}: trajectory.{name} is {_shape(value)}; expected {wanted}")
    parts = {"meta": command.meta, "signal": command.signal}
    if command.control is not None:
        parts |= {f"control.{x}": getattr(command.control, x) for x in ("acceleration", "steering")}
    for name, value in parts.items():
        if value is not None and value.shape != (count,):
            raise ValueError(f"{label}: {name} is {_shape(value)}; expected [{count} egos]")


def _check_arrays(label: str, where: str, memory: Any) -> None:
    for leaf in jax.tree.leaves(memory):
        if not hasattr(leaf, "dtype") and not isinstance(leaf, bool | int | float):
            raise ValueError(f"{label}: {where} returns a memory with a {_kind(leaf)}; expected arrays")


def _kind(found: Any) -> str:
    if isinstance(found, tuple) and not hasattr(found, "_fields"):
        return f"({', '.join(type(x).__name__ for x in found)})"
    return type(found).__name__


def _shape(x: Any) -> str:
    return f"{x.dtype}{list(x.shape)}"
