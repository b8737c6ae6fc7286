"""Trajectories of LimSim-TM: boundary conditions, bounds, and what lies ahead."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BPoly
from traffic_worlds import drivers

from limsim_jax.policies.limsim_tm.plan import (
    Lattice,
    Merge,
    Others,
    Task,
    leaders,
    plan,
    quartic,
    quintic,
    sample,
    speed_envelope,
)
from limsim_jax.policies.reference import Frenet, ReferencePath
from limsim_jax.traffic.car_following import ACC, NO_GAP

pytestmark = pytest.mark.engine

POINTS, STEP = 80, 2.0
LATTICE = Lattice()
K = 3


def path(bends, limit=15.0):
    """Arcs of one curvature each, from the origin to the east; roadways of unequal sides."""
    at = STEP * np.arange(POINTS)
    rows = {name: [] for name in ("x", "y", "heading", "curvature")}
    for bend in bends:
        turn = bend * at
        near = abs(bend) < 1e-9
        rows["x"].append(at if near else np.sin(turn) / bend)
        rows["y"].append(0 * at if near else (1 - np.cos(turn)) / bend)
        rows["heading"].append(turn)
        rows["curvature"].append(0 * at + bend)
    full = np.ones((len(bends), POINTS))
    fields = {name: np.array(row) for name, row in rows.items()}
    fields |= {"limit": full * limit, "left": full * 5.0, "right": full * 1.9, "lane": full.astype(np.int32)}
    fields = {name: jnp.asarray(x, None if name == "lane" else jnp.float32) for name, x in fields.items()}
    return ReferencePath(**fields, end=jnp.full(len(bends), 1e6), step=STEP)


def task(
    bends=(0.0,), v: Any = 10.0, a: Any = 0.0, d: Any = 0.0, slope: Any = 0.0, lead=(NO_GAP, 0.0),
    wall: Any = NO_GAP, others=None, limit=15.0,
):  # fmt: skip
    """Vehicles on their ways; a number counts for all of them."""
    count = len(bends)

    def each(value):
        return jnp.broadcast_to(jnp.asarray(value, jnp.float32), (count,))

    zero, none = each(0.0), jnp.zeros((count, K))
    start = Frenet(zero, each(v), each(a), each(d), each(slope) * each(v), zero, each(slope), zero)
    h = LATTICE.moments
    if others is None:
        shape = (count, K, h)
        away, unit = jnp.full(shape, 1e4), jnp.ones((count, K))
        others = Others(away, away, jnp.zeros(shape), unit, unit, jnp.zeros((count, K), bool))
    return Task(
        path=path(bends, limit), start=start, length=each(4.8), width=each(1.9), driver=drivers(count),
        lead_gap=each(lead[0])[:, None], lead_v=each(lead[1])[:, None],
        lead_a=each(lead[2] if len(lead) > 2 else 0.0)[:, None], wall=each(wall), other=others,
        merge=Merge(none, none, none, none > 0, zero),
        wanted=jnp.full((count, h), 1e3), steering=each(0.5), wheelbase=each(2.8),
    )  # fmt: skip


planned = jax.jit(functools.partial(plan, LATTICE, ACC()))
sampled = jax.jit(functools.partial(sample, LATTICE, ACC()))


def at(curve: Any, numbers, t):
    return curve(*(jnp.float32(x) for x in numbers), jnp.asarray(t, jnp.float32))


quintic_at, quartic_at = functools.partial(at, quintic), functools.partial(at, quartic)


def test_quintic_and_quartic_meet_their_boundary_conditions():
    rng = np.random.default_rng(0)
    for _ in range(20):
        x0, v0, a0, x1, v1, a1 = rng.uniform(-3, 12, 6)
        end = rng.uniform(1.5, 6.0)
        t = np.linspace(0, end, 7)
        reference = BPoly.from_derivatives([0, end], [[x0, v0, a0], [x1, v1, a1]])
        wanted = [reference.derivative(k)(t) if k else reference(t) for k in range(4)]
        got = quintic_at([x0, v0, a0, x1, v1, a1, end], t)
        for one, other in zip(got[:1], wanted[:1], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-4 * max(1, np.abs(other).max()))
        for one, other in zip(got[1:], wanted[1:], strict=True):  # at the end derivatives of rest count
            np.testing.assert_allclose(one[:-1], other[:-1], atol=2e-4 * max(1, np.abs(other).max()))
        s, v, a, _ = quartic_at([v0, a0, v1, end], [0, end, end + 2])
        np.testing.assert_allclose([s[0], v[0], a[0]], [0, v0, a0], atol=1e-5)
        np.testing.assert_allclose([v[1], a[1]], [v1, 0], atol=1e-4)
        np.testing.assert_allclose(s[2] - s[1], 2 * v1, atol=1e-4)
        # distance is a polynomial of the fourth degree
        five = np.linspace(0, end, 5)
        power = np.polynomial.polynomial.polyfit(five, quartic_at([v0, a0, v1, end], five)[0], 4)
        np.testing.assert_allclose(power[1], v0, atol=5e-3)


def test_samples_differ_along_and_across():
    found = sampled(task(bends=(0.0, 0.02)))
    ends = np.asarray(found.v[0, :, -1])
    lasts = np.asarray(found.d[0, :, -1])
    assert len(np.unique(ends.round(2))) > 2 * LATTICE.speeds
    assert {round(float(x), 2) for x in lasts} >= {round(x, 2) for x in LATTICE.offsets}
    # all start where the vehicle is
    np.testing.assert_allclose(found.d[:, :, 0], 0, atol=1e-4)
    np.testing.assert_allclose(found.v[:, :, 0], 10, atol=1e-4)


@pytest.mark.parametrize("d, slope", [(0.0, 0.0), (0.6, -0.05), (-1.4, 0.02)])
def test_the_chosen_sample_keeps_its_bounds(d, slope):
    bends = (0.0, 0.015, -0.03, 0.06)
    v = np.array([14.0, 11.0, 8.0, 5.5])
    case = task(bends, v=v, d=d, slope=slope)
    chosen = planned(case)
    assert chosen.safe.all()
    x, y, t = np.asarray(chosen.x, float), np.asarray(chosen.y, float), LATTICE.dt
    speed = np.hypot(np.diff(x), np.diff(y)) / t
    np.testing.assert_allclose(speed, (chosen.v[:, 1:] + chosen.v[:, :-1]) / 2, atol=0.15)
    course = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    bend = np.diff(course) / (speed[:, 1:] * t)
    assert np.abs(bend).max() < np.tan(0.5) / 2.8
    assert (np.abs(bend) * speed[:, 1:] ** 2).max() < 2.5 + 1.2
    a = np.diff(chosen.v) / t
    assert a.max() < 4.0 and a.min() > -8.5
    # the lane ends 1.9 m to the right of the path: the body stays inside
    heading = np.asarray(chosen.heading)
    np.testing.assert_allclose(np.cos(course - (heading[:, 1:] + heading[:, :-1]) / 2), 1, atol=2e-3)


@pytest.mark.parametrize(
    "bend, d, slope", [(0.0, -1.0, -0.14), (0.0, -0.9, -0.2), (-0.14, 0.4, 0.17), (-0.14, 0.5, 0.32)]
)
def test_a_vehicle_at_rest_and_askew_turns_the_wheels_and_drives_on(bend, d, slope):
    """With the right corner over the edge, or straight on in a bend nearly as tight as the wheels allow."""
    case = task((bend, -bend), v=0.0, d=np.array([d, 0.0]), slope=np.array([slope, 0.0]))
    start = case.start._replace(bend=jnp.asarray([-bend, 0.0], jnp.float32))  # the wheels are straight
    chosen = planned(case._replace(start=start))
    assert chosen.safe.all()
    went = np.hypot(*(np.diff(np.asarray(x)[:, [0, -1]])[:, 0] for x in (chosen.x, chosen.y)))
    assert (went > 3.0).all(), "staying at rest breaks no bound, and would last for ever"


def test_envelope_slows_for_bends_limits_and_walls():
    case = task(bends=(0.0, 0.05), wall=np.array([60.0, NO_GAP]))
    envelope = np.asarray(speed_envelope(case))
    at = STEP * np.arange(POINTS)
    b = 0.8 * 2.0
    np.testing.assert_allclose(
        envelope[0], np.minimum(15.0, np.sqrt(2 * b * np.maximum(60 - at, 0))), rtol=1e-4
    )
    np.testing.assert_allclose(envelope[1], np.sqrt(2.5 / 0.05), rtol=1e-4)


def test_a_line_far_ahead_does_not_slow_and_a_near_one_stops():
    free, far, near = (planned(task(v=10.0, wall=wall)) for wall in (NO_GAP, 140.0, 30.0))
    # car following would brake a little already; another sample does not
    assert (np.diff(far.v[0]) > -0.01).all() and far.x[0, -1] > 0.95 * free.x[0, -1]
    assert free.v[0, -1] > 12
    distance = np.asarray(near.x[0, -1])
    assert distance <= 30.3 and near.v[0, -1] < 4
    blocked = planned(task(v=10.0, wall=3.0))
    np.testing.assert_allclose(np.diff(blocked.v[0, :5]), -8 * LATTICE.dt, atol=0.01)
    assert not blocked.safe[0]


def test_a_vehicle_at_rest_moves_up_to_the_line_without_delay():
    """7 m from rest to rest take 5.2 s at 1.5 m/s^2 at most; replanned every 0.4 s, a little more."""
    wall, v, a, decisions = 7.0, 0.0, 0.0, 0
    while wall > 0.5 and decisions < 40:
        chosen = planned(task(v=v, a=a, wall=wall))
        assert chosen.safe.all() and chosen.x[0, -1] < wall + 0.3
        wall, v = wall - float(chosen.x[0, 2]), float(chosen.v[0, 2])
        a, decisions = float(chosen.v[0, 3] - chosen.v[0, 2]) / LATTICE.dt, decisions + 1
    assert 0.4 * decisions < 7.0


def test_follows_a_slower_leader_without_coming_too_near():
    chosen = planned(task(v=14.0, lead=(45.0, 6.0)))
    gap = 45.0 + 6.0 * np.asarray(LATTICE.times()) - np.asarray(chosen.x[0])
    assert gap.min() > 6.0 and chosen.v[0, -1] < 11.0 and chosen.safe[0]
    stands = planned(task(v=0.0, lead=(2.2, 0.0)))
    assert stands.x[0, -1] < 0.5


def test_leaders_go_on_braking_to_a_standstill():
    case = task(lead=(20.0, 10.0, -2.0))
    far, v = leaders(case, jnp.array([[0.0, 2.0, 10.0]]))
    np.testing.assert_allclose(far[0, :, 0], [20.0, 20 + 20 - 4, 20 + 25], rtol=1e-5)
    np.testing.assert_allclose(v[0, :, 0], [10.0, 6.0, 0.0], atol=1e-5)
    far, v = leaders(
        task(lead=(20.0, 10.0, 1.0)), jnp.array([[5.0]])
    )  # a leader is not assumed to accelerate
    assert (float(far[0, 0, 0]), float(v[0, 0, 0])) == (70.0, 10.0)


def test_braking_behind_a_leader_that_brakes_hard():
    """Where its present speed alone would allow to brake mildly."""
    mild, hard = (planned(task(v=18.7, lead=(13.0, 12.5, a))) for a in (0.0, -3.9))
    assert mild.v[0, 5] > 14.5
    assert hard.v[0, 5] < 11.5
    stop = 13.0 + 12.5**2 / (2 * 3.9)
    assert float(hard.x[0].max()) < stop


@pytest.mark.parametrize("urgency", [0.0, 1.0])
def test_braking_in_time_behind_a_queue_far_ahead(urgency):
    """From 27 m/s to a vehicle at rest 140 m ahead, planned twice a second; also with a lane change."""
    gap, v, a, hardest = 140.0, 27.0, 0.0, 0.0
    for _ in range(30):
        queue = task(v=v, a=a, lead=(gap, 0.0), limit=33.0)
        queue = queue._replace(merge=queue.merge._replace(urgency=jnp.full(1, urgency)))
        x, speed = (np.asarray(z[0], float) for z in planned(queue)[0:4:3])
        hardest = max(hardest, -np.diff(speed)[:3].min() / LATTICE.dt)
        a = (speed[3] - speed[2]) / LATTICE.dt
        gap, v = gap - np.interp(0.5, LATTICE.times(), x), np.interp(0.5, LATTICE.times(), speed)
    assert 27.0**2 / (2 * 138) < hardest < 4.4, "6.7 if only what comes within the horizon counted"
    assert v < 1.0 and 1.5 < gap < 12


def test_a_merging_vehicle_keeps_its_speed_until_it_has_to_stop():
    """Braking late and firmly at the end of its lane, against early and mildly at a line."""
    case = task(v=20.0, limit=25.0, wall=150.0)
    pressed = case._replace(merge=case.merge._replace(urgency=jnp.full(1, 0.2)))
    line, lane_end = planned(case), planned(pressed)
    assert float(lane_end.v[0, 10]) > 19.8 > 19.2 > float(line.v[0, 10])
    late = sampled(pressed._replace(wall=jnp.full(1, 130.0)))
    v, s = np.asarray(late.v[0]), np.asarray(late.s[0])
    firmly = (np.abs(v[:, :13] - 20) < 1e-3).all(1) & (np.abs(v[:, -1] - v[:, -2] + 3.0 * LATTICE.dt) < 1e-3)
    assert firmly.sum() == len(LATTICE.offsets), "from 2.7 s on"
    np.testing.assert_allclose(s[firmly, -1] + v[firmly, -1] ** 2 / 6, 130, atol=0.2)
    room, v = 150.0 - np.asarray(lane_end.x[0]), np.asarray(lane_end.v[0])
    assert (v * v / (2 * np.maximum(room, 0.1))).max() < 4.5, "and it can still stop"


def crossing(arrival):
    """A vehicle from the right at 9 m/s that reaches (40, 0) `arrival` s from now."""
    t = np.asarray(LATTICE.times())
    shape = (1, K, LATTICE.moments)
    x, y = np.full(shape, 1e4), np.full(shape, 1e4)
    x[0, 1], y[0, 1] = 40.0, 9.0 * (t - arrival)
    counts = np.zeros((1, K), bool)
    counts[0, 1] = True
    float32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    return Others(
        float32(x), float32(y), jnp.full(shape, np.pi / 2, jnp.float32), jnp.full((1, K), 5.0),
        jnp.full((1, K), 2.0), jnp.asarray(counts),
    )  # fmt: skip


def test_crossing_traffic_that_is_still_far_away_counts():
    alone = planned(task(v=12.0))
    at = float(np.interp(40.0, alone.x[0], LATTICE.times()))
    others = crossing(at)  # would meet there and then, 30 m away now
    assert np.hypot(others.x[0, 1, 0], others.y[0, 1, 0]) > 40
    chosen = planned(task(v=12.0, others=others))
    dx = np.abs(np.asarray(chosen.x[0] - others.x[0, 1]))
    dy = np.abs(np.asarray(chosen.y[0] - others.y[0, 1]))
    assert ((dx > (4.8 + 2) / 2) | (dy > (5.0 + 1.9) / 2)).all()
    assert chosen.safe[0]
    # one that has long passed changes nothing
    same = planned(task(v=12.0, others=crossing(-3.0)))
    np.testing.assert_allclose(same.v, alone.v, atol=1e-5)


def test_vehicles_do_not_influence_each_other():
    bends = (0.0, 0.02, -0.04)
    together = planned(task(bends, v=np.array([12.0, 9.0, 6.0]), wall=np.array([NO_GAP, 35.0, 12.0])))
    alone = planned(task(bends[1:2], v=9.0, wall=35.0))
    np.testing.assert_allclose(together.x[1], alone.x[0], atol=1e-4)
