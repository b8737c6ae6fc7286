"""Drivers of UN R157: against stopping distances by formula and fine integration, and without danger."""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from traffic_worlds import bundled, motorway, shapes, state_of

from limsim_jax.maps.lane_map import width
from limsim_jax.metrics.safety import Rss, rss_lateral, rss_longitudinal
from limsim_jax.policies.base import policy_name
from limsim_jax.policies.r157 import (
    GRAVITY,
    CarefulDriver,
    EmergencyBrake,
    FuzzyDriver,
    Regulation,
    RssDriver,
)
from limsim_jax.policies.registry import POLICIES
from limsim_jax.traffic.ego import Limits, from_lane, step_free
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config

H = 0.1
CONFIG = Config(dt=H, decision_every=1)
BEGIN = 60.0  # m, front of the ego on its lane
LENGTH, WIDTH = 5.0, 1.9
NAMES = ("r157_careful", "r157_aeb", "r157_regulation", "r157_fsm", "r157_rss")


@functools.cache
def program(policy, egos):
    """`[T, N]` motions of others in, motion of the egos out."""
    lane_map = bundled("highway")[1]

    def run(state, gap, d, v, a):
        memory = policy.init(CONFIG, lane_map, state)

        def tick(carry, now):
            state, memory = carry
            there, aside, speed, braking = now

            def put(old, new):
                return jnp.concatenate([old[:egos], new])

            state = replace(
                state,
                s=put(state.s, there),
                d=put(state.d, aside),
                v=put(state.v, speed),
                a=put(state.a, braking),
            )
            command, memory = policy(CONFIG, lane_map, state, memory, jax.random.key(0))
            after = step_free(CONFIG, lane_map, Limits(), state, command.control)
            slot = state.egos.slot
            return (after, memory), (state.s[slot], state.v[slot], after.a[slot])

        return lax.scan(tick, (state, memory), (gap, d, v, a))[1]

    return jax.jit(run)


OTHERS = 4
SECONDS = 10.0
T = np.arange(round(SECONDS / H)) * H


def drive(policy, speed, gap, v, d: Any = 0.0, a: Any = 0.0, egos=1):
    """Front (m from the start), speed and acceleration `[T, E]` of egos on a motorway.

    Of each other vehicle `[T]` or `[T, K]`: its rear before the front of the first ego at the start, m."""
    lane, goal = motorway()
    given = [np.asarray(x, float) for x in (gap, v, d, a)]
    given = [x if x.ndim == 2 else x[..., None] for x in given]
    known = max(x.shape[-1] for x in given)
    rear, v, d, a = (np.broadcast_to(x, (len(T), known)) for x in given)
    rear, v, d, a = (np.pad(x, ((0, 0), (0, OTHERS - known))) for x in (rear, v, d, a))
    count = egos + OTHERS
    first = BEGIN - 50.0 * np.arange(egos)
    state = state_of(
        "highway", [lane] * count, [*first, *(BEGIN + rear[0] + LENGTH)],
        [*np.broadcast_to(speed, egos), *v[0]], [goal] * count,
        active=jnp.arange(count) < egos + known, shape=shapes(count, LENGTH),
    )  # fmt: skip
    lane_map = bundled("highway")[1]
    rows = from_lane(lane_map, state, boxes(lane_map, state), range(egos), True)
    given = [jnp.asarray(x, jnp.float32) for x in (BEGIN + rear + LENGTH, d, v, a)]
    s, speeds, accelerations = map(np.asarray, program(policy, egos)(replace(state, egos=rows), *given))
    return s - first, speeds, accelerations


def stop(v, wait, release, jerk, most):
    """Distance (m) to a standstill by integration in steps of 0.1 ms."""
    dt, t, s = 1e-4, 0.0, 0.0
    while v > 0:
        a = release if t < wait else min(max(release, jerk * (t - wait)), most)
        s += v * dt - a * dt * dt / 2
        v -= a * dt
        t += dt
    return s


def formula(v, wait, jerk, most):
    """The same without release: reaction, ramp, constant braking."""
    built = most / jerk
    after = v - most * built / 2
    return v * wait + v * built - jerk * built**3 / 6 + after * after / (2 * most)


@pytest.mark.engine
def test_the_careful_driver_stops_as_by_the_formula():
    plain = CarefulDriver(follows=False, emergency=False, release=0.0)
    v = 7.0
    assert stop(v, 1.15, 0.0, plain.jerk, plain.deceleration) == pytest.approx(
        formula(v, 1.15, plain.jerk, plain.deceleration), abs=0.01
    )
    for policy in (plain, CarefulDriver(follows=False, emergency=False)):
        s, speed, _ = drive(policy, v, 40.0, 0.0)
        # the danger begins at the first decision with less than 2 s to contact
        begin = (np.floor((40 - 2 * v) / v / H) + 1) * H * v
        wait = 0.4 + 0.75
        expected = begin + stop(v, wait, policy.release, policy.jerk, policy.deceleration)
        assert speed[-1, 0] < 1e-3
        assert s[-1, 0] == pytest.approx(expected, abs=0.35)


@pytest.mark.engine
def test_a_leader_that_brakes_hard():
    policy = CarefulDriver(follows=False, emergency=False)
    v, t = 15.0, T
    braked = np.maximum(t - 2.0, 0)
    lead = np.maximum(v - 6.0 * braked, 0)
    way = v * np.minimum(t, 2.0) + np.where(lead > 0, v * braked - 3 * braked**2, v * v / 12)
    a = np.where((braked > 0) & (lead > 0), -6.0, 0.0)
    s, speed, _ = drive(policy, v, 25.0 + way, lead, a=a)
    begin = (np.flatnonzero(a)[0]) * H * v
    expected = begin + stop(v, 1.15, policy.release, policy.jerk, policy.deceleration)
    assert speed[-1, 0] < 1e-3
    assert s[-1, 0] == pytest.approx(expected, abs=0.35)
    # braking with 4 m/s^2 is not hard
    mild = np.where(a < 0, -4.0, 0.0)
    speed = drive(policy, v, 25.0 + v * t, v, a=mild)[1]
    np.testing.assert_allclose(speed, v, atol=0.01)


@pytest.mark.engine
@pytest.mark.parametrize("sideways", [0.5, 1.0, 1.8])
def test_a_cut_in_is_perceived_by_its_way_sideways(sideways):
    policy = CarefulDriver(follows=False, emergency=False)
    v, lead, t = 16.0, 10.0, T
    d = np.maximum(3.5 - sideways * np.maximum(t - 0.5, 0), 0)
    perceived = 0.5 + (0.375 + 0.72) / sideways
    gap = 10.0 + perceived * (v - lead)  # so that it is 1.7 s away then
    _, speed, a = drive(policy, v, gap + lead * t, lead, d=d)
    braking = t[np.flatnonzero(a[:, 0] < -1.0)[0]]
    assert braking == pytest.approx(perceived + 0.75 + 1.0 / policy.jerk, abs=0.11)
    assert -a.min() == pytest.approx(policy.deceleration, abs=0.3)
    # from another lane than the next one it is none
    speed = drive(policy, v, gap + lead * t, lead, d=d + 3.5)[1]
    np.testing.assert_allclose(speed, v, atol=0.01)


@pytest.mark.engine
def test_what_is_behind_the_leader_is_seen_once_that_leaves():
    policy = CarefulDriver(follows=False, emergency=False)
    v, t = 10.0, T
    d = np.clip(1.0 * (t - 4.0), 0, 3.5)  # the leader leaves at 1 m/s
    rear = np.stack([15 + v * t, np.full_like(t, 70.0)], -1)
    _, _, a = drive(policy, v, rear, [[v, 0.0]] * len(T), d=np.stack([d, 0 * d], -1))
    braking = t[np.flatnonzero(a[:, 0] < -1.0)[0]]
    # 2 s before the obstacle it is hidden no more; seen from a decision after 0.375 m sideways
    assert braking == pytest.approx(max((70 - 2 * v) / v, 4.375) + 1.15 + 1 / policy.jerk, abs=0.21)
    hidden = drive(policy, v, rear, [[v, 0.0]] * len(T))[1]
    np.testing.assert_allclose(hidden[: round(5.4 / H)], v, atol=0.01)


@pytest.mark.engine
def test_the_emergency_brake_acts_at_once_and_straight_ahead_only():
    policy = EmergencyBrake(follows=False, deceleration=7.5, jerk=12.5)
    v = 12.0
    s, speed, _ = drive(policy, v, 40.0, 0.0)
    begin = (np.floor((40 - 1.5 * v) / v / H) + 1) * H * v
    assert speed[-1, 0] < 1e-3
    assert s[-1, 0] == pytest.approx(begin + formula(v, 0.0, 12.5, 7.5), abs=0.35)
    speed = drive(policy, v, 40.0, 0.0, d=1.0)[1]
    np.testing.assert_allclose(speed, v, atol=0.01)  # it reaches only half before the ego
    # the careful driver has it: without, it is too late at this speed
    late = CarefulDriver(follows=False, perception=5.0, emergency=True)
    assert drive(late, v, 40.0, 0.0)[1][-1, 0] < 1e-3
    never = drive(CarefulDriver(follows=False, perception=50.0, emergency=False), v, 40.0, 0.0)[1]
    assert never[-1, 0] > 6


@pytest.mark.engine
def test_the_bound_of_the_regulation():
    policy = Regulation(follows=False)
    v, lead, t = 16.0, 8.0, T
    lane_map, (lane, _) = bundled("highway")[1], motorway()
    half = float(width(lane_map, jnp.asarray(lane), jnp.asarray(BEGIN))) / 2
    intrudes = 1.0
    d = np.maximum(3.5 - (3.5 + 0.3 - half - WIDTH / 2) / intrudes * np.minimum(t, intrudes), 0)
    d = np.where(t > intrudes, np.maximum(d - 1.0 * (t - intrudes), 0), d)
    for more, contact in ((0.25, False), (-0.5, True)):
        bound = (v - lead) / (2 * policy.deceleration) + policy.delay
        gap = (bound + more) * (v - lead) + (v - lead) * intrudes
        s, _, a = drive(policy, v, gap + lead * t, lead, d=d)
        left = gap + lead * t - s[:, 0]
        assert (left.min() < 0) == contact
        assert -a.min() == pytest.approx(6.0, abs=0.05)


@pytest.mark.engine
@pytest.mark.parametrize("name", NAMES)
def test_nothing_happens_without_danger(name):
    policy = POLICIES[name](follows=False)
    v, t = 14.0, T
    wanders = 3.6 - 0.3 * np.sin(np.pi * np.minimum(t, 0.5))
    rear = np.stack([8 + 0 * t, 60 + 18 * t, -40 + 14 * t, 6 + 6 * t], -1)
    d = np.stack([3.6 + 0 * t, 0 * t, 0 * t, wanders], -1)
    speeds = [[0.0, 18.0, 14.0, 6.0]] * len(T)
    s, speed, _ = drive(policy, v, rear, speeds, d=d)
    if name == "r157_rss":
        assert speed[-1, 0] < v  # RSS fears the vehicle that wanders
        speed = drive(policy, v, rear[:, :3], [x[:3] for x in speeds], d=d[:, :3])[1]
    np.testing.assert_allclose(speed, v, atol=0.01)
    assert s[-1, 0] > 0
    assert policy_name(policy) == name


@pytest.mark.engine
@pytest.mark.parametrize("name", ["r157_careful", "r157_fsm"])
def test_rows_do_not_matter_to_each_other(name):
    policy = POLICIES[name]()
    one = drive(policy, 15.0, 45.0, 0.0)
    # a second ego behind the first, which nothing worries, and which is slower
    s, speed, _ = drive(policy, [15.0, 3.0], 45.0, 0.0, egos=2)
    np.testing.assert_allclose(speed[:, 0], one[1][:, 0], atol=1e-4)
    assert one[1][-1, 0] < 3 and s.shape == (len(T), 2)
    np.testing.assert_allclose(speed[:20, 1], 3.0, atol=0.01)


@pytest.mark.engine
def test_distance_to_a_slower_vehicle():
    s, speed, _ = drive(POLICIES["r157_careful"](), 13.0, 25 + 10 * T, 10.0)
    assert speed[-1, 0] == pytest.approx(10.0, abs=0.2)
    assert 25 + 10 * T[-1] - s[-1, 0] == pytest.approx(2 + 10 * (1 + 36 / 100), abs=0.8)


def test_distances_of_rss_are_those_of_the_metrics():
    policy = RssDriver()
    rss = Rss(
        response=0.75, accelerate=3.0, brake=0.774 * GRAVITY, brake_hardest=0.774 * GRAVITY,
        lateral_accelerate=1.0, lateral_brake=1.0, margin=0.3,
    )  # fmt: skip
    v, lead = (jnp.asarray(x, jnp.float32) for x in np.meshgrid(np.linspace(0, 30, 7), np.linspace(0, 30, 5)))
    np.testing.assert_allclose(policy.along(v, lead), rss_longitudinal(v, lead, rss), rtol=1e-5, atol=1e-4)
    w = jnp.linspace(-2, 2, 9)
    np.testing.assert_allclose(policy.sideways(w), rss_lateral(0 * w, w, rss), rtol=1e-5, atol=1e-5)


def worst_case_gap(v, lead, wait, brake, leader):
    """m that a driver loses on a leader that brakes to a standstill, by integration."""
    dt, t, lost = 1e-3, 0.0, 0.0
    while v > 0 or lead > 0:
        lost += (v - lead) * dt
        v = max(v - (brake if t >= wait else 0) * dt, 0)
        lead = max(lead - leader * dt, 0)
        t += dt
    return lost


@pytest.mark.parametrize(("v", "lead"), [(20.0, 20.0), (15.0, 8.0), (12.0, 0.0)])
def test_the_proactive_measure_is_between_two_stops(v, lead):
    policy = FuzzyDriver()
    safe = worst_case_gap(v, lead, 0.75, 4.0, 7.0) + 2 * policy.margin
    unsafe = worst_case_gap(v, lead, 0.75, 6.0, 7.0) + policy.margin
    args = jnp.float32(v), jnp.float32(lead)
    for gap, value in ((safe + 0.2, 0.0), (unsafe - 0.2, 1.0), ((safe + unsafe) / 2, 0.5)):
        assert float(policy.proactive(jnp.float32(gap), *args)) == pytest.approx(value, abs=0.01)


@pytest.mark.parametrize(("v", "lead", "a"), [(20.0, 10.0, 0.0), (15.0, 8.0, -2.0), (12.0, 0.0, 1.0)])
def test_the_critical_measure_is_between_two_brakings(v, lead, a):
    policy = FuzzyDriver()

    def lost(brake):
        dt, t, gap, speed = 1e-3, 0.0, 0.0, v
        while speed > lead:
            gap += (speed - lead) * dt
            speed += (a if t < 0.75 else -brake) * dt
            t += dt
        return gap

    safe, unsafe = lost(4.0), lost(6.0)
    args = (jnp.float32(x) for x in (v, lead, a))
    args = tuple(args)
    for gap, value in ((safe + 0.2, 0.0), (unsafe - 0.2, 1.0), ((safe + unsafe) / 2, 0.5)):
        assert float(policy.critical(jnp.float32(gap), *args)) == pytest.approx(value, abs=0.02)
    # it is slower than the other before its reaction: only then, and by its present braking
    args = jnp.float32(10.5), jnp.float32(10.0), jnp.float32(-1.0)
    assert [float(policy.critical(jnp.float32(x), *args)) for x in (0.1, 0.2)] == [1.0, 0.0]
    assert float(policy.critical(jnp.float32(1.0), *(jnp.float32(x) for x in (9.0, 10.0, 0.0)))) == 0.0


def test_numbers_that_make_no_sense():
    with pytest.raises(ValueError, match=r"reaction: -1.0; expected 0 or more"):
        CarefulDriver(reaction=-1.0)
    with pytest.raises(ValueError, match=r"range: nan; expected more than 0"):
        RssDriver(range=float("nan"))
    with pytest.raises(ValueError, match=r"comfortable: 0; expected more than 0"):
        FuzzyDriver(comfortable=0)
