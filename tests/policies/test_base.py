"""Policies as values: the base class, names, rows of the memory, and what a policy must return."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, scattered

from limsim_jax.maps.map import load_map
from limsim_jax.policies import POLICIES
from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import (
    LikeTraffic,
    Policy,
    PolicyLike,
    check_policy,
    memory_rows,
    named,
    needs_scenery,
    policy_name,
    renew_rows,
    with_scenery,
)
from limsim_jax.policies.host import HostPolicy
from limsim_jax.policies.limsim_tm import LimSimTM
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.policies.reference import reference_path
from limsim_jax.policies.several import Several
from limsim_jax.policies.simple import FollowLane
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control, from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config

CONFIG = Config(dt=0.1)


@dataclass(frozen=True)
class Cautious(Policy):
    share: float = 0.8

    def __call__(self, config, lane_map, state, memory, key):
        path = reference_path(lane_map, state)
        v = jnp.minimum(state.v[state.egos.slot], self.share * path.limit[:, 0])[:, None]
        s = v * 0.2 * jnp.arange(16.0)[None]
        return Command(trajectory=path.trajectory(s, v, t0=config.time(state.step), dt=0.2)), memory


class Ducky:
    """A policy without the base class: it brakes, and counts its decisions."""

    free = True
    others = 0

    def init(self, config, lane_map, state):
        return jnp.int32(0)

    def __call__(self, config, lane_map, state, memory, key):
        zero = jnp.zeros_like(state.egos.x)
        return Command(control=Control(acceleration=zero - 1, steering=zero)), memory + 1


def world():
    lane_map = bundled("roundabout")[1]
    state = scattered("roundabout", 20, seed=3)
    return lane_map, dataclasses.replace(
        state, egos=from_lane(lane_map, state, boxes(lane_map, state), [2], True)
    )


def follow(seen):
    return {"acceleration": 0 * seen.v, "steering": 0 * seen.v}


@pytest.mark.engine
def test_a_policy_needs_only_the_call():
    lane_map, state = world()
    mine = Cautious()
    assert mine.free and mine.others == 0 and mine.init(CONFIG, lane_map, state) is None
    assert mine == Cautious(0.8) and mine != Cautious(0.6) and hash(mine) == hash(Cautious())
    check_policy(mine, CONFIG, lane_map, state)
    command, _ = mine(CONFIG, lane_map, state, None, jax.random.key(0))
    assert command.trajectory is not None and command.trajectory.x.shape == (1, 16)
    with pytest.raises(TypeError, match="abstract"):
        Policy()  # pyright: ignore[reportAbstractUsage]


@pytest.mark.engine
def test_policies_without_the_base_class_are_policies():
    lane_map, state = world()
    assert isinstance(Ducky(), PolicyLike) and isinstance(Cautious(), PolicyLike)
    check_policy(Ducky(), CONFIG, lane_map, state)


def test_an_undecorated_class_can_set_attributes_and_is_equal_to_itself_alone():
    class Plain(Policy):
        def __init__(self, gain):
            self.gain = gain

        def __call__(self, config, lane_map, state, memory, key):
            return Command(), memory

    first = Plain(0.8)
    assert first.gain == 0.8 and first != Plain(0.6) and policy_name(first) == "plain"


@pytest.mark.parametrize(
    ("name", "factory"),
    [x for x in POLICIES.items() if x[0] != "language"],  # that one needs a server
)
def test_registered_policies_have_the_names_of_the_registry(name, factory):
    assert policy_name(factory()) == name


def test_names():
    class ABTest(Ducky):
        pass

    class Own(Ducky):
        name = "own-1"

    assert policy_name(Cautious()) == "cautious" and policy_name(ABTest()) == "ab_test"
    assert policy_name(Own()) == "own-1"
    assert policy_name(HostPolicy(follow)) == "follow"
    assert policy_name(LimSimTM(simulations=50, name="tm50")) == "tm50"
    assert policy_name(named("fast", Cautious())) == policy_name(named("fast", Ducky())) == "fast"
    for bad in ("", "a b", "../x", "a/b", "é"):
        with pytest.raises(ValueError, match="only letters, digits, _ and -"):
            named(bad, PDMClosed())
    with pytest.raises(ValueError, match="only letters"):
        policy_name(Cautious(name="a b"))


@pytest.mark.parametrize("policy", [Cautious(), Ducky(), HostPolicy(follow), LikeTraffic()], ids=policy_name)
def test_the_same_policy_under_another_name_does_the_same(policy):
    lane_map, state = world()
    other = named("other", policy)
    assert policy_name(other) == "other" and other.free == policy.free and other.others == policy.others
    memory = other.init(CONFIG, lane_map, state)

    def call(policy):
        return jax.make_jaxpr(
            lambda state, memory: policy(CONFIG, lane_map, state, memory, jax.random.key(0))
        )(state, memory)

    if not isinstance(policy, HostPolicy):  # whose program holds the address of its function
        assert str(call(policy)) == str(call(other))
    check_policy(other, CONFIG, lane_map, state)


def test_simulations_are_those_of_the_search():
    assert LimSimTM(simulations=7).settings == dataclasses.replace(LimSimTM().settings, simulations=7)  # pyright: ignore[reportArgumentType]
    assert LimSimTM(search=None, simulations=7).settings is None
    with pytest.raises(ValueError, match="simulations: 0; expected at least 1"):
        LimSimTM(simulations=0)


def test_area_of_interest_takes_planners_or_their_names():
    policy = POLICIES["area_of_interest"](
        around="limsim_tm", options={"simulations": 5}, slots=3, radius=20.0
    )
    assert policy == AreaOfInterest(LimSimTM(simulations=5), slots=3, radius=20.0)
    assert policy.others == 3 and policy.free
    assert not AreaOfInterest(FollowLane(), ego=LikeTraffic()).free
    with pytest.raises(ValueError, match="around: expected a policy"):
        AreaOfInterest("limsim_tm")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="depth: no such option"):
        POLICIES["area_of_interest"](options={"depth": 3})


class Table(Ducky):
    """Its memory has a row per ego, and a table that happens to have as many rows."""

    def init(self, config, lane_map, state):
        return {"row": jnp.zeros((2, 3)), "table": jnp.zeros((2, 5)), "count": jnp.int32(0)}

    def memory_rows(self, memory):
        return {"row": True, "table": False, "count": False}


def test_rows_of_the_memory_that_start_anew():
    fresh = jnp.array([False, True])
    old = jax.tree.map(lambda x: x + 1, Table().init(None, None, None))
    new = Table().init(None, None, None)
    found = renew_rows(Table(), fresh, new, old)
    np.testing.assert_array_equal(found["row"][:, 0], [1, 0])
    assert (found["table"] == 1).all() and int(found["count"]) == 1
    # by default: every array that has an axis
    found = renew_rows(Ducky(), fresh, new, old)
    np.testing.assert_array_equal(found["table"][:, 0], [1, 0])
    assert memory_rows(Ducky(), old) == {"row": True, "table": True, "count": False}
    with pytest.raises(ValueError, match=r"ducky: memory of shape \[2, 3\] has no row for each of 3 egos"):
        renew_rows(Ducky(), jnp.array([True] * 3), new, old)
    assert renew_rows(LikeTraffic(), fresh, None, None) is None


class Wrong(Policy):
    def __init__(self, found: Any, memory: Any = None):
        super().__init__()
        object.__setattr__(self, "found", found)
        object.__setattr__(self, "memory", memory)

    def init(self, config, lane_map, state):
        return self.memory  # pyright: ignore[reportAttributeAccessIssue]

    def __call__(self, config, lane_map, state, memory, key):
        return self.found(state)  # pyright: ignore[reportAttributeAccessIssue]


def steer(count: int):
    return lambda state: (
        Command(control=Control(acceleration=jnp.zeros(count), steering=jnp.zeros(1))),
        None,
    )


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Wrong(lambda state: 3.0), "Wrong: a policy returns (Command, memory), not float"),
        (Wrong(lambda state: Command()), "Wrong: a policy returns (Command, memory), not Command"),
        (Wrong(lambda state: (1.0, None)), "a policy returns (Command, memory), not (float, NoneType)"),
        (Wrong(lambda state: None), "Wrong: a policy returns (Command, memory), not NoneType"),
        (Wrong(lambda state: (Command(), None), "x"), "Wrong: init returns a memory with a str"),
        (Wrong(lambda state: (Command(), jnp.zeros(2)), jnp.zeros(1)), "from float32[1] to float32[2]"),
        (Wrong(lambda state: (Command(), jnp.zeros(2))), "Wrong: memory changes its structure"),
        (Wrong(steer(2)), "Wrong: control.acceleration is float32[2]; expected [1 egos]"),
        (Cautious, "Cautious: a class, not a policy; expected Cautious()"),
        (lambda state: None, "a policy has methods init and __call__"),
    ],
)  # fmt: skip
def test_a_wrong_policy_gets_a_message_of_one_line(policy, message):
    lane_map, state = world()
    with pytest.raises(ValueError) as caught:
        check_policy(policy, CONFIG, lane_map, state)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_exceptions_of_a_policy_pass_unchanged():
    def fails(state):
        raise RuntimeError("no plan")

    with pytest.raises(RuntimeError, match="no plan"):
        check_policy(Wrong(fails), CONFIG, *world())


@dataclass(frozen=True)
class Looks(LikeTraffic):
    needs_scenery = True


def test_a_policy_that_looks_gets_the_scenery_however_deep_it_is():
    town = load_map("highway")
    for policy in (
        Looks(),
        AreaOfInterest(ego=Looks()),
        Several((LikeTraffic(), Looks())),
        named("x", Looks()),
    ):
        assert needs_scenery(policy)
        lanes = with_scenery(policy, town)
        assert lanes.scenery is town.scenery and lanes.length is town.lanes.length
    assert with_scenery(AreaOfInterest(), town) is town.lanes and town.lanes.scenery is None
    assert needs_scenery(HostPolicy(lambda seen: {}, observe=Looks()))  # pyright: ignore[reportArgumentType]
