"""Commands that take effect late."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import Policy, build_policy, knows, policy_name, variants
from limsim_jax.policies.delayed import Delayed
from limsim_jax.policies.predict import constant_velocity
from limsim_jax.policies.registry import POLICIES
from limsim_jax.policies.simple import ConstantSpeed
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control
from limsim_jax.types import Config

CONFIG = Config(dt=0.1, decision_every=5)


@dataclass(frozen=True)
class Counts(Policy):
    """Commands the number of the decision, and remembers it."""

    privileged: bool = True

    def init(self, config, lane_map, state):
        return jnp.zeros(2, jnp.float32)

    def __call__(self, config, lane_map, state: Any, memory, key):
        now = memory + 1
        return Command(control=Control(acceleration=now + state.ego, steering=-now)), now


class World(NamedTuple):
    """All that the policy looks at."""

    ego: Any


STATE: Any = World(jnp.asarray([0.0, 100.0]))


def commanded(policy, count):
    memory = policy.init(CONFIG, None, STATE)
    found = []
    for _ in range(count):
        command, memory = policy(CONFIG, None, STATE, memory, jax.random.key(0))
        found.append(np.stack([command.control.acceleration, command.control.steering]))
    return np.array(found), memory


@pytest.mark.parametrize(("delay", "steps"), [(0.0, 0), (0.5, 1), (1.5, 3)])
def test_a_command_comes_as_many_decisions_later(delay, steps):
    found, memory = commanded(Delayed(Counts(), delay), 6)
    expected = np.maximum(np.arange(1, 7) - steps, 1)  # the first one holds from the start on
    np.testing.assert_array_equal(found[:, 0, 0], expected)
    np.testing.assert_array_equal(found[:, 0, 1], expected + 100)
    np.testing.assert_array_equal(found[:, 1, 0], -expected)
    np.testing.assert_array_equal(memory.policy, 6)  # the policy itself is not late


def test_delays_are_whole_decisions_of_egos():
    with pytest.raises(ValueError, match=r"delay: 0.3 s; expected a multiple of 0.5 s"):
        Delayed(Counts(), 0.3).init(CONFIG, None, STATE)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="delay: -1 s; expected 0 or more"):
        Delayed(Counts(), -1)
    with pytest.raises(ValueError, match="drives vehicles around the egos"):
        Delayed(AreaOfInterest(slots=2), 0.5)


def test_files_name_it_and_its_planner():
    policy = build_policy(
        POLICIES["delayed"], {"of": "constant_speed", "delay": 1.0, "options": {"speed": 8}}
    )
    assert policy == Delayed(ConstantSpeed(speed=8), 1.0) and policy_name(policy) == "delayed"
    assert knows(policy) == "view" and knows(Delayed(Counts(), 1.0)) == "state"
    with pytest.raises(ValueError, match="unknown policy 'nothing'"):
        build_policy(POLICIES["delayed"], {"of": "nothing"})


def test_being_late_is_a_module_to_blame():
    late = build_policy(POLICIES["delayed"], {"of": "pdm_closed"})
    found = variants(late, constant_velocity)
    assert list(found) == ["actuation", "prediction", "planning"]
    assert not isinstance(found["actuation"], Delayed) and isinstance(found["planning"], Delayed)
    assert variants(Delayed(ConstantSpeed(), 0.0), constant_velocity) == {}
