"""Planners on the host: called once for all worlds, inside scan, vmap, shard_map and jit."""

import dataclasses
import functools
import re
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, no_arrivals, state_of

from limsim_jax.maps.lane_map import pose
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies import host
from limsim_jax.policies.base import named
from limsim_jax.policies.host import HostPolicy, Observe, failure_reasons
from limsim_jax.simulation.rollout import Rollout, decision_key
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentFile
from limsim_jax.traffic.ego import Meta, from_lane
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, Scenario, Status

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
N = 4
calls: list[tuple[int, ...]] = []


def example():
    """The function of the module's docstring."""
    code = re.search(r"( {4}def follow.*?)\n\n", host.__doc__ or "", re.DOTALL)
    assert code is not None
    names = {"np": np, "SignalState": SignalState}
    exec(textwrap.dedent(code[1]), names)
    return names["follow"]


def follow(seen):
    """The same, which records for how many worlds it was called."""
    calls.append(seen.v.shape)
    return example()(seen)


def follower() -> HostPolicy:
    """The factory that an experiment file names."""
    return HostPolicy(follow)


def broken() -> HostPolicy:
    return HostPolicy(lambda seen: {"acceleration": seen.v[0], "steering": seen.v})


def world(gap: float, v: float, free: bool = True):
    """An ego `gap` m behind a vehicle at 15 m/s."""
    lane, goal = motorway()
    state = state_of(
        "highway", [lane] * N, [60.0, 65.0 + gap, 10.0, 10.0], [v, 15.0, 0.0, 0.0], [goal] * N,
        active=jnp.array([True, True, False, False]),
    )  # fmt: skip
    lane_map = bundled("highway")[1]
    return dataclasses.replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), [0], free))


def scenario(key):
    """Worlds that differ: the gap to the leader."""
    state = world(20.0, 20.0)
    gap = jax.random.uniform(key, (), minval=15.0, maxval=45.0)
    return Scenario(start=dataclasses.replace(state, s=state.s.at[1].add(gap)), schedule=no_arrivals(state))


def rollout(policy, horizon=10.0):
    return Rollout(CONFIG, Traffic(), horizon=horizon, policy=policy)


def run_one(run, state):
    lane_map = bundled("highway")[1]
    return run.advance(lane_map, no_arrivals(state), jax.random.key(0), run.init(lane_map, state))


def stack(states):
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


def test_one_call_per_decision_for_all_worlds():
    run = rollout(follower())
    states = [world(15.0, 20.0), world(30.0, 12.0), world(45.0, 25.0)]
    many = jax.jit(jax.vmap(lambda state: run_one(run, state)[0].state))
    together = many.lower(stack(states)).compile()
    calls.clear()
    end = jax.block_until_ready(together(stack(states)))
    assert calls == [(3, 1)] * run.decisions
    shuffled = together(stack([states[2], states[2], states[0]]))
    for k, row in enumerate((2, 2, 0)):
        np.testing.assert_array_equal(shuffled.s[k], end.s[row])
        np.testing.assert_array_equal(shuffled.egos.y[k], end.egos.y[row])
    assert len(np.unique(np.asarray(end.v[:, 0]).round(2))) == 3, "the worlds are not alike"
    gap = np.asarray(end.s[:, 1] - end.s[:, 0]) - 5
    assert (gap > 2).all() and (np.asarray(end.status)[:, 0] == 0).all()
    assert np.abs(end.d[:, 0]).max() < 0.3


def test_it_runs_with_batches_spread_over_devices():
    lane_map = bundled("highway")[1]
    worlds = Worlds(rollout(follower(), 2.0), lane_map, scenario, chunk=3)
    worlds.run_totals([5])
    calls.clear()
    totals = worlds.run_totals(range(3))
    assert calls and all(shape == (worlds.chunk // jax.local_device_count(), 1) for shape in calls)
    assert (totals.distance > 0).all() and not totals.collided.any()


def test_the_observation_agrees_with_the_state():
    lane_map = bundled("highway")[1]
    state = world(25.0, 18.0)
    seen = jax.jit(lambda state: Observe(nearest=3, points=10)(CONFIG, lane_map, state))(state)
    assert float(seen.v[0]) == 18.0 and float(seen.limit[0]) == float(lane_map.speed_limit[motorway()[0]])
    np.testing.assert_array_equal(seen.there[0], [True, False, False])
    np.testing.assert_allclose([seen.other_x[0, 0], seen.other_y[0, 0]], [30.0, 0.0], atol=0.2)
    assert float(seen.other_v[0, 0]) == 15.0 and float(seen.light_distance[0]) == host.FAR
    lane, _ = motorway()
    x, y, heading = pose(lane_map, jnp.full(10, lane), 57.5 + 2.0 * jnp.arange(10.0))
    x0, y0, h0 = (float(np.asarray(values)[0]) for values in (x, y, heading))
    np.testing.assert_allclose(seen.way_x[0], np.cos(h0) * (x - x0) + np.sin(h0) * (y - y0), atol=1e-2)
    np.testing.assert_allclose(seen.way_y[0], np.cos(h0) * (y - y0) - np.sin(h0) * (x - x0), atol=1e-2)


def ask(policy, state, memory=None):
    """One decision."""
    lane_map = bundled("highway")[1]
    memory = policy.init(CONFIG, lane_map, state) if memory is None else memory
    return jax.jit(lambda state, memory: policy(CONFIG, lane_map, state, memory, jax.random.key(0)))(
        state, memory
    )


def test_memory_and_trajectories():
    def remember(seen, memory):
        memory = memory + np.array([1.0, 0.0], np.float32)
        memory[..., 1] = seen.v
        t = 0.1 * np.arange(21)
        line = seen.v[..., None] * t
        zero = np.zeros_like(line)
        return {"x": line, "y": zero + 1.0, "heading": zero, "v": zero + seen.v[..., None]}, memory

    policy = HostPolicy(remember, command="trajectory", memory=2, samples=21)
    state = world(60.0, 17.0)
    command, memory = ask(policy, state)
    command, memory = ask(policy, state, memory)
    np.testing.assert_allclose(memory, [[2.0, 17.0]])
    found, egos = command.trajectory, state.egos
    cos, sin = np.cos(egos.heading[0]), np.sin(egos.heading[0])
    np.testing.assert_allclose(found.x[0], egos.x[0] + cos * 1.7 * np.arange(21) - sin, atol=1e-3)
    np.testing.assert_allclose(found.y[0], egos.y[0] + sin * 1.7 * np.arange(21) + cos, atol=1e-3)
    np.testing.assert_allclose(found.v, 17.0)
    assert policy.free and found.dt == 0.1


def test_meta_actions():
    policy = HostPolicy(lambda seen: {"meta": np.full(seen.v.shape, Meta.DECELERATE)}, command="meta")
    command, _ = ask(policy, world(60.0, 17.0, free=False))
    assert policy.free is False and command.trajectory is None and command.control is None
    np.testing.assert_array_equal(command.meta, [Meta.DECELERATE])


def gives(found, **more):
    return HostPolicy(lambda *seen: found, **more)


@pytest.mark.parametrize(
    "policy, message",
    [
        (gives(None), "returns NoneType, not a mapping of acceleration, steering"),
        (gives({"steering": 0}), "returns a mapping of steering, not a mapping of acceleration, steering"),
        (gives({"acceleration": 0.0, "steering": 0.0}), r"acceleration has shape \[\], not .* \[1, 1\]"),
        (
            gives({"meta": np.zeros((1, 1))}, command="meta"),
            "meta is ndarray of float64, not .* whole numbers",
        ),
        (
            gives({"acceleration": "fast", "steering": 0}),
            "acceleration is str of .*, not an array of numbers",
        ),
        (gives({}, memory=1), "returns a mapping of , not a mapping and the new memory"),
        (
            HostPolicy(lambda seen: 1 / 0),
            r"^test_host_policy.py:\d+ in <lambda>: ZeroDivisionError: division by zero$",
        ),
        (
            HostPolicy(lambda seen: np.linalg.inv(np.zeros((2, 3)))),
            r"^test_host_policy.py:\d+ in <lambda>: LinAlg",
        ),
    ],
)
def test_errors_are_reported_before_anything_is_compiled(policy, message):
    with pytest.raises(ValueError, match=message) as caught:
        policy.init(CONFIG, bundled("highway")[1], world(20.0, 10.0))
    assert "\n" not in str(caught.value)


def test_an_exception_names_the_line_of_the_planner_that_raised_it():
    def helper(seen):
        raise RuntimeError("no plan")

    line = helper.__code__.co_firstlineno + 1
    with pytest.raises(
        ValueError, match=f"^test_host_policy.py:{line} in helper: RuntimeError: no plan$"
    ) as caught:
        HostPolicy(lambda seen: helper(seen)).init(CONFIG, bundled("highway")[1], world(20.0, 10.0))
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_bad_options_are_named():
    with pytest.raises(ValueError, match="command: 'steer'; known are control, trajectory, meta"):
        HostPolicy(follow, command="steer")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="memory: -1 numbers"):
        HostPolicy(follow, memory=-1)
    with pytest.raises(ValueError, match="1 samples every"):
        HostPolicy(follow, samples=1)


def failing(how: str):
    """A planner that fails from 1 s on where the leader drives at less than 12 m/s."""
    asked: list[int] = []

    def plan(seen):
        asked.append(len(seen.v))
        bad = (seen.time[:, None] >= 1.0) & (seen.other_v[..., 0] < 12.0) & seen.there[..., 0]
        if bad.any() and how == "raises":
            raise RuntimeError("no plan")
        a = np.where(bad & (how == "nan"), np.nan, 0.1 * seen.v)
        return {"acceleration": a, "steering": 0 * seen.v} if how != "shape" or not bad.any() else {}

    return HostPolicy(plan), asked


def ends(policy):
    """Three worlds at the end; in the second one a failing planner fails."""
    states = [world(40.0, v) for v in (8.0, 9.0, 10.0)]
    states[1] = dataclasses.replace(states[1], v=states[1].v.at[1].set(7.0))
    run = rollout(policy, 4.0)
    return jax.jit(jax.vmap(lambda state: run_one(run, state)[0].state))(stack(states))


@functools.cache
def the_sound_one():
    sound, _ = failing("not at all")
    return sound, ends(sound)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("nan", None),
        ("raises", r"test_host_policy.py:\d+ in plan: RuntimeError: no plan"),
        ("shape", "failing.<locals>.plan: returns a mapping of , not a mapping of acceleration, steering"),
    ],
)
def test_a_world_in_which_the_planner_fails_is_lost_alone(how, said):
    (sound, whole), (broken, asked) = the_sound_one(), failing(how)
    end = ends(broken)
    flagged = np.asarray(end.status & int(Status.NOT_FINITE)) != 0
    np.testing.assert_array_equal(flagged, [[False] * N, [True, False, False, False], [False] * N])
    for k in (0, 2):
        assert float(end.egos.x[k, 0]) == float(whole.egos.x[k, 0])
    assert float(end.v[1, 0]) == 0.0 and float(whole.v[1, 0]) > 5.0  # it brakes to a standstill
    assert all(bool(jnp.isfinite(x).all()) for x in (end.v, end.s, end.egos.x, end.egos.heading))
    reasons = failure_reasons(broken)
    if said is None:
        assert not reasons
    else:
        (key,) = reasons  # once: after that the function is not shown this world any more
        assert re.fullmatch(said, reasons[key])
        expected = jax.random.fold_in(jax.random.key(0), 10)  # the decision at 1 s, in this world's key
        assert key == np.asarray(jax.random.key_data(expected)).tobytes()
        assert asked.count(1) == 3 + 1 and set(asked) == {1, 3}  # the trial, and each world alone once
    assert not failure_reasons(sound) and failure_reasons(named("other", broken)) == {}


def test_a_meta_action_that_does_not_exist_is_broken():
    policy = HostPolicy(lambda seen: {"meta": np.full(seen.v.shape, len(Meta))}, command="meta")
    end = run_one(rollout(policy, 1.0), world(60.0, 17.0, free=False))[0].state
    assert int(end.status[0]) & int(Status.NOT_FINITE)


def experiment(policy) -> ExperimentFile:
    told = {
        "name": "host", "map": "highway", "horizon": 2.0, "slots": 8,
        "ego": {"start": "1-", "s": 60.0, "goal": "2-", "policy": f"{__name__}:{policy}"},
        "traffic": {"vehicles": 3},
    }  # fmt: skip
    return ExperimentFile.model_validate(told)


def test_an_experiment_names_it():
    assert Episodes(experiment("follower"), chunk=2).policy == "follower"
    with pytest.raises(ValueError, match=r"acceleration has shape \[1\], not"):
        Episodes(experiment("broken"), chunk=2).run([0])


def test_a_reason_belongs_to_its_own_world_and_decision():
    """Of three failures at 1.1 s two have raised, one within a part of another policy."""
    episodes = Episodes(experiment("follower"), chunk=2)
    keys = [decision_key(4, 10), decision_key(5, 9), jax.random.fold_in(decision_key(6, 10), 1)]
    for k, key in enumerate(keys):
        episodes._policy.failures[np.asarray(jax.random.key_data(key)).tobytes()] = f"reason {k}"  # pyright: ignore[reportAttributeAccessIssue]
    metrics = {"policy_failed": np.array([1.0, 1.0, 1.0, 0.0]), "policy_failed_time": np.full(4, 1.1)}
    assert episodes._reasons(np.array([4, 5, 6, 7]), metrics) == {4: "reason 0", 6: "reason 2"}
    episodes._policy.failures.popitem()  # pyright: ignore[reportAttributeAccessIssue]
    episodes._policy.failures.popitem()  # pyright: ignore[reportAttributeAccessIssue]
    assert episodes._reasons(np.array([4, 5, 6, 7]), metrics) == {4: "reason 0"}  # not that of the only one


@pytest.mark.slow
def test_episodes_run_with_it():
    episodes = Episodes(experiment("follower"), chunk=2)
    calls.clear()
    found = episodes.run([0, 1])
    assert calls and (found.metrics["distance"] > 20).all() and (found.metrics["contacts"] == 0).all()
