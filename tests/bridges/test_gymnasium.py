"""Environments of Gymnasium against its own vector environment, checker and spaces."""

import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import limsim_jax as lj
from limsim_jax.bridges import gymnasium as bridge
from limsim_jax.bridges.learning import SAMPLES, environment
from limsim_jax.simulation.rollout import world_key

STEPS = 16


def drive(**changes):
    settings = {
        "horizon": 3.0,
        "slots": 8,
        "vehicles": 4,
        "ego": lj.Ego(start="1-", s=40.0, goal="3+", v=8.0),
    }
    return lj.Experiment(map="roundabout", name="small", **(settings | changes))


@pytest.fixture(scope="module")
def core():
    """Six decisions, and an ego that leaves the road if it steers."""
    return environment(drive(), action="control")


def script(count, seed=0):
    """Actions: the first environment goes straight on, the second steers off, others do either."""
    rng = np.random.default_rng(seed)
    steering = np.where(rng.random((STEPS, count)) < 0.8, 0.0, 0.6)
    steering[:, 0], steering[:, 1] = 0.0, 0.6
    return np.stack([rng.uniform(-1, 1, (STEPS, count)), steering], -1).astype(np.float32)


def played(envs, actions, seed=5):
    """All that a vector environment says."""
    seen, infos = envs.reset(seed=seed)
    said = [(seen, None, None, None, infos)]
    for action in actions:
        said.append(envs.step(action))
    return said


def same(ours, theirs):
    """Whether two infos agree; values that are masked out have no meaning."""
    assert set(ours) == set(theirs)
    for name, x in ours.items():
        if isinstance(x, dict):
            same(x, theirs[name])
        elif x.dtype == object:
            for one, other in zip(x, theirs[name], strict=True):
                assert (one is None) == (other is None)
                if one is not None:
                    np.testing.assert_allclose(one, other, atol=1e-4)
        else:
            there = ours.get(f"_{name}", np.ones(len(x), bool))
            np.testing.assert_allclose(x[there], theirs[name][there], atol=1e-3, rtol=1e-4)


@pytest.mark.engine
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_batch_is_as_gymnasiums_own_vector_of_single_environments(core, mode):
    count, actions = 3, script(3)
    ours = played(bridge.VectorEnv(core, count, autoreset_mode=mode), actions)
    theirs = played(SyncVectorEnv([lambda: bridge.Env(core)] * count, autoreset_mode=mode), actions)
    space = bridge.VectorEnv(core, count).observation_space
    ends = np.zeros(2, int)
    for one, other in zip(ours, theirs, strict=True):
        assert one[0] in space
        np.testing.assert_allclose(one[0], other[0], atol=1e-4)
        same(one[4], other[4])
        if one[1] is not None and other[1] is not None:
            np.testing.assert_allclose(one[1], other[1], atol=1e-4)
            np.testing.assert_array_equal(one[2], other[2])
            np.testing.assert_array_equal(one[3], other[3])
            assert one[2].dtype == bool and one[3].dtype == bool and not (one[2] & one[3]).any()
            ends += one[2].sum(), one[3].sum()
    assert (ends > 0).all(), "the script has to end episodes in both ways"


@pytest.mark.engine
def test_the_step_after_the_end_ignores_the_action(core):
    envs = bridge.VectorEnv(core, 3)
    first, _ = envs.reset(seed=3)
    straight = np.zeros((3, 2), np.float32)
    for _ in range(core.horizon - 1):
        envs.step(straight)
    _, _, over, late, infos = envs.step(straight)
    assert late.any() and infos["_time"].all()
    np.testing.assert_allclose(infos["time"][late], 3.0, atol=1e-5)
    seen, reward, over, late, infos = envs.step(straight + 0.3)
    assert not over.any() and not late.any() and (reward == 0).all() and infos == {}
    assert not np.allclose(seen, first), "another episode"


@pytest.mark.engine
def test_seeds_reproduce_and_are_those_of_sweeps(core):
    envs = bridge.VectorEnv(core, 3)
    actions = script(3, seed=1)
    once, again, other = (played(envs, actions, seed) for seed in (7, 7, 8))
    for one, two in zip(once, again, strict=True):
        np.testing.assert_array_equal(one[0], two[0])
    assert not np.array_equal(once[1][0], other[1][0])
    np.testing.assert_array_equal(once[0][0][1:], other[0][0][:-1])
    listed, _ = envs.reset(seed=[9, None, 7])
    np.testing.assert_array_equal(listed[2], once[0][0][0])
    seen, _ = jax.jit(core.reset)(world_key(7))
    np.testing.assert_allclose(seen[0], once[0][0][0], atol=1e-5)


@pytest.mark.engine
def test_ended_environments_wait_for_a_reset_with_a_mask(core):
    envs = bridge.VectorEnv(core, 3, autoreset_mode="Disabled")
    envs.reset(seed=0)
    straight = np.zeros((3, 2), np.float32)
    steered = straight.copy()
    steered[1, 1] = 0.6
    over, before = np.zeros(3, bool), np.zeros(0)
    while not over.any():
        before, _, over, late, _ = envs.step(steered)
        assert not late.any()
    assert over.tolist() == [False, True, False]
    with pytest.raises(ValueError, match="environment 1 has ended; reset it with options="):
        envs.step(straight)
    after, _ = envs.reset(options={"reset_mask": over})
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert not np.array_equal(after[1], before[1])
    envs.step(straight)
    for mask in (np.zeros(3, bool), np.ones(2, bool), [True, False, False]):
        with pytest.raises(ValueError, match="reset_mask: "):
            envs.reset(options={"reset_mask": mask})


@pytest.mark.engine
def test_the_checker_of_gymnasium_passes(core):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Using `env.unwrapped|.*different Box|.*symmetric", UserWarning)
        env = bridge.Env(core, render_mode="rgb_array")
        check_env(env, skip_render_check=True)
    env.reset(seed=1)
    picture = env.render()
    assert picture.dtype == np.uint8 and picture.shape == (540, 960, 3)
    moved = [env.step(np.array([2.0, 0.0], np.float32)) for _ in range(2)]
    assert (env.render() != picture).mean() > 0.01 and moved[0][4]["reward_completion"] > 0


@pytest.mark.engine
def test_wrong_actions_and_seeds_are_one_line(core):
    env = bridge.Env(core)
    with pytest.raises(ValueError, match="step: call reset first"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action: shape \(3,\); expected \(2,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"action: nan at \[1\]; expected finite numbers"):
        env.step(np.array([0.0, np.nan]))
    with pytest.raises(ValueError, match="action: 'left'; expected finite numbers"):
        env.step("left")
    with pytest.raises(ValueError, match="seed: -1; seeds are whole numbers from 0"):
        env.reset(seed=-1)


def test_names_are_registered():
    with pytest.raises(gymnasium.error.NameNotFound):
        gymnasium.make("limsim_jax/Motorway-v0")
    env = gymnasium.make("limsim_jax/Roundabout-v0", action="trajectory", render_mode="rgb_array")
    assert env.action_space.shape == (4, SAMPLES) and env.observation_space.shape == (
        lj.ObserveVector().size,
    )
    envs = gymnasium.make_vec("limsim_jax/Traffic-v0", num_envs=2, experiment=drive(slots=16))
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert envs.action_space == gymnasium.spaces.MultiDiscrete([5, 5])
    assert set(bridge.IDS.values()) - {None} == set(lj.bundled_experiments()) - {"paper", "town"}


def test_wrong_options_are_one_line():
    with pytest.raises(ValueError, match="experiment: none; expected a name"):
        gymnasium.make("limsim_jax/Traffic-v0")
    with pytest.raises(lj.ExperimentError, match="motorway"):
        bridge.Env("motorway")
    with pytest.raises(lj.ExperimentError, match="ego: an environment needs at least one"):
        bridge.VectorEnv(drive(ego=None), 2)
    two = [lj.Ego(start="1-", s=s, goal="3+") for s in (40.0, 20.0)]
    with pytest.raises(lj.ExperimentError, match="ego: 2 egos; Gymnasium knows one agent"):
        bridge.Env(drive(ego=two))
    with pytest.raises(ValueError, match="action: 'wheel'; known are"):
        bridge.Env(drive(), action="wheel")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="num_envs: 0; expected"):
        bridge.VectorEnv(drive(), 0)
    with pytest.raises(ValueError, match="autoreset_mode: 'later'; known are NextStep"):
        bridge.VectorEnv(drive(), 2, autoreset_mode="later")
    with pytest.raises(ValueError, match="render_mode: 'human'; known are rgb_array"):
        bridge.Env(drive(), render_mode="human")
    with pytest.raises(ValueError, match="observe: makes Observation"):
        bridge.Env(lj.Env(drive()))
