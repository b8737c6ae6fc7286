"""Environments of JaxMARL and gymnax, under the wrappers of these libraries."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import limsim_jax as lj
from limsim_jax.bridges.jaxmarl import gymnax_env, multi_agent_env
from limsim_jax.bridges.learning import ACTIONS, environment

STEPS = 1000
HORIZON = 6
"""Decisions of an episode."""


@pytest.fixture(autouse=True)
def usual_promotion():
    """These libraries rely on it."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def drive(egos):
    return lj.Experiment(map="roundabout", name="small", horizon=HORIZON / 2, slots=8, vehicles=3, ego=egos)


def two():
    return drive([lj.Ego(start="1-", s=s, goal="3+", v=8.0) for s in (45.0, 20.0)])


def test_agents_and_spaces_are_those_of_the_egos():
    pytest.importorskip("jaxmarl")
    env = multi_agent_env(two())
    assert env.agents == ["agent_0", "agent_1"] and env.num_agents == 2
    assert env.agent_classes == {"ego": env.agents} and env.name == "small"
    assert env.observation_space("agent_1").shape == (lj.ObserveVector().size,)
    assert env.action_space("agent_0").n == len(ACTIONS) == 5
    assert multi_agent_env(two(), action="control").action_space("agent_0").shape == (2,)


@pytest.mark.engine
def test_jaxmarls_own_wrapper_runs():
    pytest.importorskip("jaxmarl")
    from jaxmarl.wrappers.baselines import LogWrapper

    env = multi_agent_env(two())
    wrapped = LogWrapper(env)
    obs, state = wrapped.reset(jax.random.key(1))

    def step(carry, key):
        obs, state = carry
        keys = jax.random.split(key, 3)
        actions = {
            name: env.action_space(name).sample(k) for name, k in zip(env.agents, keys[1:], strict=True)
        }
        can = env.get_avail_actions(state.env_state)
        obs, state, reward, done, info = wrapped.step(keys[0], state, actions)
        fine = jnp.stack([env.observation_space(name).contains(obs[name]) for name in env.agents])
        told = reward["agent_0"], done, info["returned_episode_lengths"], fine, can["agent_0"]
        return (obs, state), told

    _, (reward, done, length, fine, can) = jax.jit(lambda c, k: jax.lax.scan(step, c, k))(
        (obs, state), jax.random.split(jax.random.key(2), STEPS)
    )
    over = np.asarray(done["__all__"])
    assert np.asarray(fine).all() and np.isfinite(reward).all() and np.ptp(reward) > 0
    assert over.sum() >= STEPS // HORIZON and np.asarray(length)[-1, 0] <= HORIZON
    both = np.asarray(done["agent_0"]) & np.asarray(done["agent_1"])
    np.testing.assert_array_equal(over, both)
    assert np.asarray(can)[:, :3].all() and not np.asarray(can)[:, 3:].all()


@pytest.mark.engine
def test_gymnaxs_own_wrappers_run():
    pytest.importorskip("gymnax")
    from gymnax.wrappers.purerl import FlattenObservationWrapper, LogWrapper

    core = environment(drive([lj.Ego(start="1-", s=40.0, goal="3+", v=8.0)]), action="control")
    env = gymnax_env(core)
    wrapped = LogWrapper(FlattenObservationWrapper(env))
    space = env.observation_space(env.default_params)
    obs, state = wrapped.reset(jax.random.key(1))

    def step(carry, key):
        action = env.action_space(env.default_params).sample(key)
        obs, state, reward, over, late, info = wrapped.step(key, carry[1], action)
        last = info["final_observation"]
        told = reward, over, late, space.contains(obs) & space.contains(last), (obs != last).any()
        return (obs, state), told

    _, (reward, over, late, fine, other) = jax.jit(lambda c, k: jax.lax.scan(step, c, k))(
        (obs, state), jax.random.split(jax.random.key(2), STEPS)
    )
    over, late = np.asarray(over), np.asarray(late)
    assert np.asarray(fine).all() and np.isfinite(reward).all()
    assert over.any() and late.any() and not (over & late).any()
    np.testing.assert_array_equal(np.asarray(other), over | late)


def test_bad_input_is_one_line(monkeypatch):
    pytest.importorskip("jaxmarl")
    with pytest.raises(lj.ExperimentError, match="ego: 2 egos; gymnax knows one agent"):
        gymnax_env(two())
    with pytest.raises(lj.ExperimentError, match="ego: an environment needs at least one"):
        multi_agent_env(drive(None))
    with pytest.raises(ValueError, match="an Env has its own action"):
        multi_agent_env(lj.Env(two()), action="control")
    monkeypatch.setitem(sys.modules, "jaxmarl.environments", None)
    with pytest.raises(ModuleNotFoundError, match=r'needs jaxmarl: pip install "limsim-jax\[jaxmarl\]"'):
        multi_agent_env(two())
