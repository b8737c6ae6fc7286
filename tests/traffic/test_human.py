"""Human drivers against a NumPy loop of the paper's formulas, closed forms, and linear theory on a ring."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from human_driver import EXACT, wave
from traffic_worlds import bundled, drivers, motorway, shapes, state_of

from limsim_jax.simulation.rollout import Rollout, started
from limsim_jax.sweeps.build import plain_demand
from limsim_jax.traffic.car_following import IDM, NO_GAP
from limsim_jax.traffic.demand import sample_scenario
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.traffic.human import (
    HumanDriver,
    first_memory,
    human_accelerations,
    perceive,
    vehicles_beyond,
)
from limsim_jax.traffic.motion import Decision
from limsim_jax.traffic.neighbors import Obstacles, Pair
from limsim_jax.types import Config, HumanMemory

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)


def idm(a, b, T, s0, delta, v0, b_max, s, v, lead):
    """The formula, for one vehicle."""
    star = s0 + max(0.0, v * T + v * (v - lead) / (2 * math.sqrt(a * b)))
    return max(a * (1 - (v / v0) ** delta - (star / s) ** 2), -b_max)


def platoon(n, seed, human):
    """A platoon on a motorway lane, the first vehicle in front, its decision, and what drivers see."""
    rng = np.random.default_rng(seed)
    lane, goal = motorway()
    gap, v = rng.uniform(8, 40, n), rng.uniform(8, 20, n)
    driver = drivers(n, coolness=0.0)
    driver = dataclasses.replace(
        driver, T=jnp.asarray(rng.uniform(0.8, 1.6, n), jnp.float32),
        a=jnp.asarray(rng.uniform(1, 2, n), jnp.float32),
    )  # fmt: skip
    place = 480 - np.cumsum(np.append(0, gap[1:] + 5))
    state = state_of("highway", [lane] * n, place, v, [goal] * n, driver=driver, shape=shapes(n, 5.0))
    kept = math.ceil(human.reaction / CONFIG.dt - 1e-6)
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    memory = HumanMemory(
        gap=f32(rng.normal(size=n)), speed=f32(rng.normal(size=n)), noise=f32(rng.normal(size=n)),
        a=f32(rng.uniform(-2, 1, (n, kept))),
    )  # fmt: skip
    state = dataclasses.replace(state, a=f32(rng.uniform(-2, 1, n)), human=memory, step=jnp.int32(200))
    gap[0] = NO_GAP
    own = Pair(
        lead=jnp.arange(n, dtype=jnp.int32) - 1, lead_gap=f32(gap), lag=jnp.full(n, -1), lag_gap=f32(gap)
    )
    nobody, none = jnp.full((n, 1), -1), jnp.full((n, 1), NO_GAP)
    decision = Decision(
        obstacles=Obstacles(
            jnp.concatenate([own.lead[:, None], nobody], -1),
            jnp.concatenate([own.lead_gap[:, None], none], -1),
        ),
        v0=jnp.full(n, 30.0), v_ahead=jnp.full(n, 60.0), ahead=jnp.full(n, 500.0),
        courtesy=Obstacles(nobody, none), lanes=jnp.full((n, 1), lane),
        beyond=vehicles_beyond(human, state, own, jnp.full((n, 1), lane)),
    )  # fmt: skip
    return state, decision, gap


@pytest.mark.parametrize(
    "human",
    [
        HumanDriver(),
        HumanDriver(reaction=0.0, vehicles_ahead=4),
        HumanDriver(reaction=0.65, vehicles_ahead=3, anticipates=False, gap_error=0.2),
        HumanDriver(reaction=1.2, vehicles_ahead=2, approach_error=0.0, noise=0.1),
    ],
)
def test_accelerations_are_those_of_the_paper(human):
    n, x = 6, np.random.default_rng(3).uniform(3, 6, 6)
    state, decision, gap = platoon(n, 1, human)
    found, memory = jax.jit(
        lambda state, decision, x: human_accelerations(human, CONFIG, IDM(), state, decision, x)
    )(state, decision, jnp.asarray(x, jnp.float32))
    d, v, a = (jax.tree.map(np.asarray, z) for z in (state.driver, state.v, state.a))
    seen = jax.tree.map(np.asarray, state.human)
    delay, ahead = human.reaction, human.reaction if human.anticipates else 0.0
    wanted = []
    for i in range(n):
        count = min(i, human.vehicles_ahead)
        root = math.sqrt(sum(1 / m**2 for m in range(1, count + 1)) or 1.0)
        own = v[i] + ahead * a[i]
        free = idm(d.a[i], d.b[i], d.T[i], d.s0[i], 4.0, 30.0, 99.0, NO_GAP, own, own)
        total = free
        for m in range(1, count + 1):
            s = gap[i - m + 1 : i + 1].sum() + x[i - m] - x[i]
            lead = v[i - m] + s * human.approach_error * seen.speed[i]
            s = s * math.exp(human.gap_error * seen.gap[i])
            s, lead = s + ahead * (lead - v[i]), lead + ahead * a[i]
            total += idm(
                d.a[i], d.b[i], d.T[i] / root, d.s0[i] / root, 4.0, 30.0, d.b_max[i], s, own, lead
            ) - free  # fmt: skip
        wanted.append(total)
    steps = delay / CONFIG.dt
    past = np.concatenate([np.array(wanted)[:, None], seen.a], -1)
    low, part = math.floor(steps + 1e-9), steps - math.floor(steps + 1e-9)
    late = past[:, low] * (1 - part) + (past[:, low + 1] * part if part > 1e-9 else 0)
    if human.noise:
        late = np.clip(late + math.sqrt(human.noise / 0.5) * seen.noise, -d.b_max, d.a)
    np.testing.assert_allclose(found, late, atol=2e-4, rtol=2e-4)
    np.testing.assert_allclose(
        memory.a, past[:, :-1] if memory.a.shape[1] else memory.a, atol=2e-4, rtol=2e-4
    )


def test_a_vehicle_that_has_just_entered_does_not_drive_by_the_past_of_its_slot():
    state, decision, _ = platoon(4, 2, HumanDriver())
    state = dataclasses.replace(state, entered=jnp.array([0.0, 19.5, 19.0, 20.0]))  # it is 20 s
    x = jnp.zeros(4)
    late, memory = human_accelerations(HumanDriver(), CONFIG, IDM(), state, decision, x)
    new = np.array([False, True, False, True])
    np.testing.assert_allclose(late[new], np.asarray(memory.a)[new, 0], atol=1e-6)
    assert state.human is not None
    np.testing.assert_allclose(late[~new], np.asarray(state.human.a)[~new, 6], atol=1e-6)


def test_places_to_stop_are_not_seen_late():
    human = HumanDriver(reaction=1.0)
    state, decision, _ = platoon(3, 3, human)
    line = decision.obstacles._replace(gap=decision.obstacles.gap.at[:, 1].set(9.0))
    still, _ = human_accelerations(human, CONFIG, IDM(), state, decision, jnp.zeros(3))
    stops, _ = human_accelerations(
        human, CONFIG, IDM(), state, decision._replace(obstacles=line), jnp.zeros(3)
    )
    v, a = np.asarray(state.v), np.asarray(state.driver.a)
    T = np.asarray(state.driver.T)
    now = [idm(a[i], 2.0, T[i], 2.0, 4.0, 30.0, 8.0, 9.0, v[i], 0.0) for i in range(3)]
    np.testing.assert_allclose(stops, now, rtol=1e-4)
    assert (np.asarray(stops) < np.asarray(still) - 2).all()


def test_errors_are_ornstein_uhlenbeck_processes():
    human = HumanDriver(error_time=10.0)
    n, steps = 500, 200
    state = state_of("highway", [0] * n, [0.0] * n, [0.0] * n, [0] * n)
    state = dataclasses.replace(state, human=first_memory(human, CONFIG, n))

    def go_on(state, k):
        state = perceive(human, CONFIG, state, jax.random.fold_in(jax.random.key(4), k))
        assert state.human is not None
        return dataclasses.replace(state, step=state.step + 5), (state.human.gap, state.human.speed)

    gap, speed = (np.asarray(x) for x in jax.lax.scan(go_on, state, jnp.arange(steps))[1])
    for x in (gap, speed):
        assert abs(x[0].std() - 1) < 0.1 and abs(x.std() - 1) < 0.05 and abs(x.mean()) < 0.1
        for lag in (1, 10, 40):
            expected = math.exp(-0.5 * lag / 10)
            assert np.mean(x[lag:] * x[:-lag]) == pytest.approx(expected, abs=0.06)
    assert abs(np.mean(gap * speed)) < 0.05


def test_vehicles_beyond_the_leader_end_where_ways_part():
    state = state_of("highway", [0, 0, 1, 2], [10.0, 30.0, 5.0, 5.0], [9.0] * 4, [0] * 4)
    own = Pair(
        lead=jnp.array([1, 2, 3, -1]), lead_gap=jnp.array([15.0, 20.0, 30.0, NO_GAP]),
        lag=jnp.full(4, -1), lag_gap=jnp.full(4, NO_GAP),
    )  # fmt: skip
    lanes = jnp.array([[0, 1], [0, 1], [1, 2], [2, 3]])
    found = vehicles_beyond(HumanDriver(vehicles_ahead=4), state, own, lanes)
    assert found is not None and vehicles_beyond(HumanDriver(), state, own, lanes) is None
    np.testing.assert_array_equal(found.other[0], [2, -1, -1])  # 3 is on a lane that 0 does not come to
    np.testing.assert_allclose(found.gap[0], [35.0, NO_GAP, NO_GAP])
    np.testing.assert_array_equal(found.other[1], [-1, -1, -1])


def test_waves_on_a_ring_grow_as_linear_theory_says():
    late = dataclasses.replace(EXACT, reaction=0.65)
    found = wave(late, 6.0, cars=12, seconds=40.0)
    assert found["theory"] > 0.1 and found["driven"] == pytest.approx(found["theory"], rel=0.06)
    calm = wave(None, 6.0, cars=12, seconds=40.0)
    assert calm["theory"] < -0.01 and calm["driven"] == pytest.approx(calm["theory"], rel=0.02)


def test_worlds_depend_on_their_seed_alone_and_the_errors_are_their_own():
    network, lane_map = bundled("roundabout")
    demand, _ = plain_demand(network, lane_map, rate=400.0, vehicles=8, seconds=20.0)
    run = Rollout(CONFIG, Traffic(human=HumanDriver()), 10.0)
    draw = lambda key: sample_scenario(demand, lane_map, key, 24)  # noqa: E731

    @jax.jit
    def end(seed):
        schedule, key, carry = started(run, lane_map, draw, seed)
        return run.advance(lane_map, schedule, key, carry)[0].state

    seeds = jnp.array([3, 7])
    both = jax.jit(jax.vmap(lambda seed: end(seed)))(seeds)
    one = end(jnp.int32(7))
    np.testing.assert_allclose(both.s[1], one.s, atol=1e-3)
    assert not np.allclose(both.human.gap[0], both.human.gap[1])
    with pytest.raises(ValueError, match="needs a key"):
        drive(CONFIG, Traffic(human=HumanDriver()), lane_map, one)
    with pytest.raises(ValueError, match="first_memory"):
        drive(
            CONFIG, Traffic(human=HumanDriver()), lane_map, dataclasses.replace(one, human=None),
            key=jax.random.key(0),
        )  # fmt: skip


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"reaction": 9.0}, "reaction = 9.0: must be 0 to 5.0"),
        ({"vehicles_ahead": 0}, "vehicles_ahead = 0: must be 1 to 10"),
        ({"error_time": 0.0}, "error_time = 0.0: must be 0.001 or more"),
        ({"noise": -1.0}, "noise = -1.0: must be 0 or more"),
        ({"gap_error": float("nan")}, "gap_error = nan: must be 0 to 1"),
        ({"reaction": "fast"}, "reaction = 'fast': must be a number"),
        ({"vehicles_ahead": 2.5}, "vehicles_ahead = 2.5: must be a whole number"),
    ],
)
def test_numbers_out_of_range_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        HumanDriver(**values)
