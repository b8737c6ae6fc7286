"""PDM-Closed: its parts against NumPy loops and closed forms, its decisions, and itself in traffic."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, drivers, no_arrivals, shapes, state_of

from limsim_jax.geometry import boxes_overlap
from limsim_jax.maps.lane_map import lane_rows
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.metrics.motion import motion_init, motion_result, motion_update
from limsim_jax.policies.base import policy_name
from limsim_jax.policies.pdm import PDMClosed
from limsim_jax.policies.pdm import proposals as pdm_proposals
from limsim_jax.policies.pdm import road as pdm_road
from limsim_jax.policies.pdm import score as pdm_score
from limsim_jax.policies.pdm import tracker as pdm_tracker
from limsim_jax.policies.pdm.give_way import Way, along_with
from limsim_jax.policies.reference import ReferencePath
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.simulation.trace import trace
from limsim_jax.traffic.ego import Limits, from_lane, step_free, track, with_rows
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
N, K = 8, 6
P = len(pdm_road.OFFSETS) * len(pdm_proposals.FRACTIONS)


# --- parts, on a straight road along x --------------------------------------------------------------


def body(v, d=(0.0, 0.4)) -> pdm_road.Body:
    """Two vehicles of different sizes, the rear axle at x = 0."""
    row = lambda *values: jnp.array(values, jnp.float32)  # noqa: E731
    return pdm_road.Body(
        x=row(0.0, 0.0), y=row(*d), heading=row(0.0, 0.0), v=row(*v), a=row(0.0, 0.0),
        steering=row(0.0, 0.0), length=row(5.0, 4.0), width=row(2.0, 1.6), wheelbase=row(3.0, 2.4),
    )  # fmt: skip


def straight_road(limit=(14.0, 20.0), wall=1e6, d=(0.0, 0.4)) -> pdm_road.Road:
    """A lane of 3.5 m with one to its left, and an oncoming lane beyond that; limits of two vehicles."""
    m = 121
    line = jnp.broadcast_to(2.0 * jnp.arange(m, dtype=jnp.float32), (2, m))
    flat = jnp.zeros((2, m))
    centerline = ReferencePath(
        x=line, y=flat, heading=flat, curvature=flat, limit=flat + jnp.array(limit)[:, None],
        left=flat + 5.25, right=flat + 1.75, lane=flat.astype(jnp.int32), end=jnp.full(2, 1e6), step=2.0,
    )  # fmt: skip
    return pdm_road.Road(
        centerline=centerline, s=jnp.zeros(2), d=jnp.array(d), slope=jnp.zeros(2),
        offset=jnp.broadcast_to(jnp.array(pdm_road.OFFSETS), (2, 3)), wall=jnp.full((2, 3), wall),
        worth=jnp.zeros((2, 3)), half=flat + 1.75, oncoming=flat + 3.5, connector=flat > 0,
    )  # fmt: skip


def others(x, y, v, heading=None, length=4.5, moments=50) -> pdm_road.Others:
    """Others at constant speed along their headings; both vehicles see the same."""
    x, y, v = (np.broadcast_to(np.asarray(values, np.float32), (2, len(x))) for values in (x, y, v))
    heading = (
        np.zeros_like(x) if heading is None else np.broadcast_to(np.asarray(heading, np.float32), x.shape)
    )
    t = 0.1 * np.arange(moments, dtype=np.float32)[:, None, None]
    row = lambda values: jnp.asarray(np.broadcast_to(values, (moments, *x.shape)), jnp.float32)  # noqa: E731
    return pdm_road.Others(
        x=row(x + v * t * np.cos(heading)), y=row(y + v * t * np.sin(heading)), cos=row(np.cos(heading)),
        sin=row(np.sin(heading)), length=jnp.full(x.shape, length), width=jnp.full(x.shape, 1.8),
        v=jnp.asarray(v), there=jnp.ones(x.shape, bool),
    )  # fmt: skip


def loop_idm(v, limit, front, wide, half, seen, wall, strict):
    """The fifteen drivers of one vehicle: s and v, by the book."""
    x, y, u, heading, length = seen
    found, rear, u_lead = [], wall, 0.0
    for offset in (0.0, -1.0, 1.0):
        for fraction in (0.2, 0.4, 0.6, 0.8, 1.0):
            s, speed, path = 0.0, v, [(0.0, v)]
            for k in range(40):
                if k % 2 == 0:
                    rear, u_lead = wall, 0.0
                    for i in range(len(x)):
                        xi = x[i] + u[i] * 0.1 * k * np.cos(heading[i])
                        yi = y[i] + u[i] * 0.1 * k * np.sin(heading[i])
                        c, n = abs(np.cos(heading[i])), abs(np.sin(heading[i]))
                        beside = n * length / 2 + c * 0.9 + wide / 2
                        at = xi - c * length / 2 - n * 0.9
                        if abs(yi - offset) < beside and s + half < xi and 0 < xi < 240 and at < rear:
                            rear, u_lead = at, u[i] * np.cos(heading[i])
                s0, least = (1.0, 1.0) if strict else (2.0, 0.1)
                gap = max(rear - s - front, least)
                wish = s0 + 1.5 * speed + speed * (speed - u_lead) / (2 * np.sqrt(1.5 * 3.0))
                wish = wish if strict else max(wish, 0.0)
                a = 1.5 * (1 - (speed / (fraction * limit)) ** 10 - (wish / gap) ** 2)
                a = -3.0 if strict and k == 0 else min(max(a, -3.0), 1.5)
                if not strict and rear < wall and 1.5 * (1 - (wish / gap) ** 2) < -3.0:
                    a = max(1.5 * (1 - (wish / gap) ** 2), -6.0)
                s, speed = s + speed * 0.1, speed + a * 0.1
                speed = speed if strict else max(speed, 0.0)
                path.append((s, speed))
            found.append(path)
    return np.array(found)


@pytest.mark.parametrize("strict", [False, True])
def test_idm_agrees_with_a_loop(strict):
    x, y, u = [40.0, 25.0, 70.0, -9.0, 60.0, 30.0], [0.2, 2.3, -1.9, 0.0, 14.0, 3.6], [5.0, 9, 2, 20, 6, 9]
    heading = [0.0, 0.05, 0.0, 0.0, -1.4, -0.02]
    me, road = body((12.0, 7.0)), straight_road(wall=95.0)
    along = pdm_proposals.leaders(road, me, others(x, y, u, heading), pdm_road.STEPS)
    found = pdm_proposals.idm(road, me, along, strict)
    for i, (v, limit) in enumerate(((12.0, 14.0), (7.0, 20.0))):
        half, size = float(me.wheelbase[i]) / 2, float(me.length[i])
        wide = float(me.width[i])
        wanted = loop_idm(v, limit, half + size / 2, wide, half, (x, y, u, heading, 4.5), 95.0, strict)
        np.testing.assert_allclose(found.s[i], wanted[..., 0], atol=2e-3)
        np.testing.assert_allclose(found.v[i], wanted[..., 1], atol=2e-3)
    gaps = 40 - 2.25 + 5.0 * 4 - np.asarray(found.s)[0, :5, -1] - 4.0
    assert (gaps > 1).all() and gaps[0] > gaps[4], "no driver hits the leader; slow drivers keep a larger gap"


def test_a_gap_below_the_standstill_gap_means_hard_braking():
    me, road = body((1.5, 1.5), d=(0.0, 0.0)), straight_road(wall=95.0)
    rear = float(me.front[0]) + 1.0  # a standing vehicle 1 m ahead
    seen = others([rear + 2.25], [0.0], [0.0])
    distance = []
    for strict in (False, True):
        found = pdm_proposals.idm(road, me, pdm_proposals.leaders(road, me, seen, pdm_road.STEPS), strict)
        distance.append(np.asarray(found.s)[0, :, -1].max())
    # with 6 m/s^2, in steps of 0.1 s: 0.15 + 0.09 + 0.03 m
    assert distance[0] == pytest.approx(0.27, abs=0.01) and distance[1] > 0.4, distance


def test_lqr_as_nuplan_writes_it():
    rng = np.random.default_rng(0)
    v, v_ahead = rng.uniform(0.5, 20, 7), rng.uniform(0, 20, 7)
    steering, lateral, astray = (rng.uniform(-0.3, 0.3, 7) for _ in range(3))
    bends, wheelbase = rng.uniform(-0.05, 0.05, (10, 7)), rng.uniform(2.4, 3.4, 7)
    as_32 = lambda value: jnp.asarray(value, jnp.float32)  # noqa: E731
    a, rate = pdm_tracker.lqr(
        as_32(v), as_32(steering), as_32(lateral), as_32(astray), as_32(v_ahead),
        [as_32(b) for b in bends], as_32(wheelbase),
    )  # fmt: skip
    for i in range(7):
        wanted = -10 * 1.0 * (v[i] - v_ahead[i]) / (10 * 1.0**2 + 1)
        assert a[i] == pytest.approx(wanted, rel=1e-4)
        state, A, B, g = np.array([lateral[i], astray[i], steering[i]]), np.eye(3), np.zeros(3), np.zeros(3)
        for k in range(10):
            speed = v[i] + 0.1 * k * wanted
            step = np.array([[1, speed * 0.1, 0], [0, 1, speed * 0.1 / wheelbase[i]], [0, 0, 1]])
            A, B = step @ A, step @ B + np.array([0, 0, 0.1])
            g = step @ g + np.array([0, -speed * bends[k, i] * 0.1, 0])
        Q = np.diag([1.0, 10.0, 0.0])
        error = A @ state + g
        error[1:] = np.arctan2(np.sin(error[1:]), np.cos(error[1:]))
        assert rate[i] == pytest.approx(-(B @ Q @ error) / (B @ Q @ B + 1), rel=1e-3, abs=1e-5)
    v, steering, lateral, astray, v_ahead = (jnp.array([x]) for x in (0.1, 0.2, 0.5, 0.1, 0.0))
    stands = pdm_tracker.lqr(v, steering, lateral, astray, v_ahead, [jnp.zeros(1)] * 10, jnp.full(1, 3.0))
    assert float(stands[0][0]) == pytest.approx(-0.05) and float(stands[1][0]) == 0


def arc(v, radius, steps=81):
    """A circle driven by both vehicles at one speed, or at those of the steps; P equal proposals."""
    v = np.broadcast_to(np.asarray(v, float), steps)
    angle = np.concatenate([[0.0], np.cumsum(0.1 * v[:-1])]) / radius
    row = lambda values: jnp.asarray(np.broadcast_to(values, (2, P, steps)), jnp.float32)  # noqa: E731
    return pdm_proposals.Poses(
        x=row(radius * np.sin(angle)), y=row(radius * (1 - np.cos(angle))), heading=row(angle),
        v=row(v), curvature=row(np.full(steps, 1 / radius)),
    )  # fmt: skip


def test_the_tracker_stays_on_a_circle():
    me = body((8.0, 8.0))
    me = me._replace(steering=jnp.arctan(me.wheelbase / 30.0))
    motion = pdm_tracker.drive_along(arc(8.0, 30.0), me, 80)
    off = np.hypot(motion.x, np.asarray(motion.y) - 30.0) - 30.0
    assert np.abs(off[0]).max() < 0.2 and np.abs(off[1, :, 40:]).max() < 0.25
    assert np.abs(off[1, :, 0]).max() > 0.35, "the second one starts beside it"
    np.testing.assert_allclose(motion.v, 8.0, atol=1e-3)
    ackermann = np.arctan(np.asarray(me.wheelbase) / 30.0)
    np.testing.assert_allclose(motion.steering[..., -1], np.repeat(ackermann[:, None], P, 1), rtol=0.05)


def test_the_bicycle_is_that_of_the_egos():
    """A slalom whose wheels turn as fast as they can: each step is one of the simulator's."""
    me = body((9.0, 9.0), d=(0.0, 0.0))
    wave = arc(9.0, 30.0)
    turns = np.where(np.arange(81) % 20 < 10, 4.0, -4.0)
    sharp = wave._replace(curvature=wave.curvature * jnp.asarray(turns, jnp.float32)[None, None])
    motion = jax.tree.map(
        lambda values: np.asarray(values, float)[0, 0], pdm_tracker.drive_along(sharp, me, 80)
    )
    limits, wheelbase = Limits(), float(me.wheelbase[0])
    turned = np.diff(motion.steering)
    assert np.abs(turned).max() == pytest.approx(0.04, abs=1e-5), "0.4 rad/s"
    assert np.abs(motion.steering).max() <= limits.steering + 1e-6
    distance = (motion.v[:-1] + motion.v[1:]) / 2 * 0.1
    bend = np.tan((motion.steering[:-1] + motion.steering[1:]) / 2) / wheelbase
    most = 8.0 / motion.v[:-1] ** 2
    assert (np.abs(bend) > most).any() and (np.abs(bend) < most).any(), "the tyres slide now and then"
    turn = distance * np.clip(bend, -most, most)
    np.testing.assert_allclose(np.diff(motion.heading), turn, atol=1e-5)
    np.testing.assert_allclose(np.diff(motion.v), (motion.a[:-1] + motion.a[1:]) / 2 * 0.1, atol=1e-5)
    np.testing.assert_allclose(np.hypot(np.diff(motion.x), np.diff(motion.y)), distance, atol=1e-4)


def test_late_braking_keeps_to_the_bend():
    """The tracker brakes later than the proposal, and is then farther along the bend."""
    me = body((8.0, 8.0), d=(0.0, 0.0))
    me = me._replace(steering=jnp.arctan(me.wheelbase / 15.0))
    late = arc(np.maximum(8.0 - 3.0 * 0.1 * np.arange(81), 3.0), 15.0)
    off = []
    for strict in (False, True):
        motion = pdm_tracker.drive_along(late, me, 80, strict)
        off.append(np.abs(np.hypot(motion.x, np.asarray(motion.y) - 15.0) - 15.0)[0, 0].max())
    assert off[0] < 0.04 and off[1] > 0.5, off


def test_the_bicycle_drives_a_circle():
    """With the right steering it stays on the circle; nuPlan's Euler steps drift outwards."""
    me = body((20.0, 20.0), d=(0.0, 0.0))
    me = me._replace(steering=jnp.arctan(me.wheelbase / 300.0))
    off = []
    for strict in (False, True):
        motion = pdm_tracker.drive_along(arc(20.0, 300.0), me, 80, strict)
        off.append((np.hypot(motion.x, np.asarray(motion.y) - 300.0) - 300.0)[0, 0])
    assert np.abs(off[0]).max() < 0.005
    assert off[1].max() > 0.05


def test_fitted_profiles_are_those_of_a_smooth_path():
    t = 0.1 * np.arange(41)
    v = 5 + 0.8 * t
    s = 5 * t + 0.4 * t * t
    row = lambda values: jnp.asarray(np.broadcast_to(values, (2, P, 41)), jnp.float32)  # noqa: E731
    angle = s / 40.0
    given = pdm_proposals.Poses(
        row(40 * np.sin(angle)), row(40 * (1 - np.cos(angle))), row(angle), row(0 * t), row(0 * t)
    )
    found = pdm_tracker.fitted(given)
    # a step's speed is the mean over it; the penalty on the rate pulls the first curvatures towards 0
    np.testing.assert_allclose(found.v[0, 3, :-1], v[:-1] + 0.04, rtol=0.01)
    np.testing.assert_allclose(found.curvature[1, 7, 5:-5], 1 / 40.0, rtol=0.03)


# --- scorer -----------------------------------------------------------------------------------------


def paths(v: Any, y: Any = 0.0, y_rate: Any = 0.0, a: Any = None, steps: int = 41) -> pdm_tracker.Motion:
    """Straight motions of proposals: speeds, offsets and drifts `[P]`, the rear axle at x = 0."""
    t = 0.1 * np.arange(steps)
    v, y, y_rate = (np.broadcast_to(np.asarray(x, float), P)[:, None] for x in (v, y, y_rate))
    a = np.zeros((P, steps)) if a is None else a
    row = lambda values: jnp.asarray(np.broadcast_to(values, (2, P, steps)), jnp.float32)  # noqa: E731
    return pdm_tracker.Motion(
        x=row(v * t), y=row(y + y_rate * t), heading=row(0 * t), v=row(v + 0 * t), a=row(a),
        steering=row(0 * t),
    )  # fmt: skip


def scored(motion, *seen, strict=False, **more) -> dict[str, np.ndarray]:
    road, me = straight_road(d=(0.0, 0.0)), body((10.0, 10.0), d=(0.0, 0.0))
    proposals = pdm_proposals.Proposals(motion.x, motion.v)
    found = pdm_score.score(road, me, others(*seen, **more), proposals, motion, strict)
    return {name: np.asarray(value) for name, value in found._asdict().items()}


FAR_AWAY = ([0.0], [500.0], [0.0])


def test_a_free_road_is_scored_by_progress_alone():
    speeds = np.linspace(2, 12, P)
    found = scored(paths(speeds), *FAR_AWAY)
    for name in ("no_fault", "drivable", "direction", "ttc", "comfort"):
        assert (found[name] == 1).all(), name
    np.testing.assert_allclose(found["progress"][0], speeds / 12, rtol=1e-4)
    np.testing.assert_allclose(found["total"][0], (5 * speeds / 12 + 5 + 2) / 12, rtol=1e-4)
    still = scored(paths(0.01), *FAR_AWAY)
    assert (still["progress"] == 1).all(), "without progress all proposals are equal"


def test_edges_of_the_road():
    # the first vehicle is 2 m wide: 0.75 m aside it touches the right edge, 4.25 m the left lane's
    y = np.zeros(P)
    y[:8] = [0, -0.7, -0.83, -0.9, 4.2, 7.7, 7.83, 7.9]
    found = scored(paths(10.0, y), *FAR_AWAY)
    np.testing.assert_array_equal(found["drivable"][0, :8], [1, 1, 1, 0, 1, 1, 1, 0])
    exact = scored(paths(10.0, y), *FAR_AWAY, strict=True)
    np.testing.assert_array_equal(exact["drivable"][0, :8], [1, 1, 0, 0, 1, 1, 0, 0])
    # 10 m/s in the oncoming lane: 10 m within a second; with a short visit, 4 m or less
    np.testing.assert_array_equal(found["direction"][0, :6], [1, 1, 1, 1, 1, 0])
    drifts = scored(
        paths(10.0, 4.0, np.where(np.arange(P) == 1, 0.33, np.where(np.arange(P) == 2, 0.39, 0))), *FAR_AWAY
    )
    np.testing.assert_array_equal(drifts["direction"][0, :3], [1.0, 0.5, 0.0])


def test_contacts_and_fault():
    lanes = np.zeros(P)
    lanes[3], lanes[4] = 1.0, 3.5
    motion = paths(np.where(np.arange(P) == 2, 0.0, 10.0), lanes)
    # a standing vehicle 30 m ahead in the lane; 3 touches it, too; 4 passes in the lane beside
    found = scored(motion, [30.0], [0.0], [0.0])
    np.testing.assert_array_equal(found["no_fault"][0, :5], [0, 0, 1, 0, 1])
    # front at 4 m, rear at 27.75 m, 10 m/s: contact after 2.375 s, seen every 0.2 s
    assert found["contact"][0, 0] == pytest.approx(2.4) and found["contact"][0, 4] > 1e5
    assert (found["total"][0, [0, 1, 3]] == 0).all()
    # from behind and faster: not at fault, driving or standing
    found = scored(motion, [-12.0], [0.0], [18.0])
    np.testing.assert_array_equal(found["no_fault"][0], np.ones(P))
    # a standing vehicle is not at fault, even if it is hit in the front
    found = scored(motion, [20.0], [0.0], [6.0], heading=[np.pi])
    np.testing.assert_array_equal(found["no_fault"][0, :4], [0, 0, 1, 0])
    # from the side, level with the ego: at fault only over the lane line
    side = [0.5], [-4.3], [2.0]
    found = scored(paths(2.0, lanes), *side, heading=[0.3])
    assert found["no_fault"][0, 0] == 1 and found["contact"][0, 0] > 1e5
    over = np.where(np.arange(P) == 1, -1.0, 0.0)
    found = scored(paths(2.0, over), *side, heading=[0.3])
    np.testing.assert_array_equal(found["no_fault"][0, :2], [1, 0])
    # a vehicle that overlaps from the start does not count
    found = scored(paths(3.0), [3.0], [1.0], [3.0])
    assert (found["no_fault"][0] == 1).all() and (found["ttc"][0] == 1).all()


def test_time_to_collision():
    speeds = np.full(P, 10.0)
    speeds[1] = 6.0
    # 10 m/s behind 6 m/s: within 4 s the gap of 20 m shrinks to 4 m, 1 s: never below 0.9 s ...
    front = 4.0
    found = scored(paths(speeds), [front + 20.0 + 2.25], [0.0], [6.0])
    np.testing.assert_array_equal(found["ttc"][0, :2], [1, 1])
    # ... but from 19 m on it is, and without any contact
    found = scored(paths(speeds), [front + 19.0 + 2.25], [0.0], [6.0])
    np.testing.assert_array_equal(found["ttc"][0, :2], [0, 1])
    assert found["no_fault"][0, 0] == 1
    # a follower that comes nearer does not count
    found = scored(paths(speeds), [-19.0], [0.0], [14.0])
    np.testing.assert_array_equal(found["ttc"][0, :2], [1, 1])


def test_meetings_agree_with_overlapping_boxes():
    rng = np.random.default_rng(3)
    x, y, v = rng.uniform(-20, 40, K), rng.uniform(-12, 12, K), rng.uniform(0, 10, K)
    heading = rng.uniform(-3, 3, K)
    motion = paths(rng.uniform(0.5, 12, P), rng.uniform(-2, 2, P), rng.uniform(-1, 1, P))
    me, seen = body((5.0, 5.0)), others(x, y, v, heading)
    found = pdm_score._meetings(me, motion, seen)
    overlap = jax.jit(jax.vmap(boxes_overlap))
    contact, first = np.full((P, K), 1e6), np.full((P, K), 1e6)
    for i in (1,):
        for k in range(21):
            for n, ahead in enumerate(pdm_score.TTC):
                pairs = [(p, j) for p in range(P) for j in range(K)]
                mine = np.array([
                    (motion.x[i, p, 2 * k] + me.wheelbase[i] / 2 + motion.v[i, p, 2 * k] * ahead,
                     motion.y[i, p, 2 * k], 0.0, me.length[i], me.width[i]) for p, _ in pairs
                ], np.float32)  # fmt: skip
                m = 2 * k + 3 * n
                theirs = np.array([
                    (seen.x[m, i, j], seen.y[m, i, j], heading[j], 4.5, 1.8) for _, j in pairs
                ], np.float32)  # fmt: skip
                meet = np.asarray(overlap(mine, theirs)).reshape(P, K)
                if n == 0:
                    contact = np.where(meet & (contact > 1e5), k, contact)
                first = np.where(meet & (contact > 1e5) & (first > 1e5), 4 * k + n, first)
        assert (contact < 1e5).any() and (first < 1e5).sum() > 5
        np.testing.assert_array_equal(found.contact[i], contact)
        np.testing.assert_array_equal(found.overlap[i], first)


def test_comfort_is_nuplans():
    t = 0.1 * np.arange(41)
    a = np.zeros((P, 41))
    a[1], a[2], a[3] = 2.0 * np.sin(2 * t), 2.0 * np.sin(4 * t), 3.0
    a[4], a[5] = np.where(t > 2, -3.0, 0.0), 4.5 * (np.exp(-t) - 1)
    heading = np.zeros((P, 41))
    heading[6], heading[7] = 0.03 * t * t, 0.4 * t
    steering = np.arctan(0.3 * np.asarray(np.gradient(heading, 0.1, axis=1)))
    row = lambda values: jnp.asarray(np.broadcast_to(values, (2, P, 41)), jnp.float32)  # noqa: E731
    motion = paths(10.0, a=a)._replace(heading=row(heading), steering=row(steering))
    found = np.asarray(pdm_score._comfort(body((10.0, 10.0)), motion))[0]
    wanted = []
    for p in range(8):
        carry = motion_init(0.1)
        for k in range(41):
            carry, _ = update(carry, t[k], a[p, k], heading[p, k])
        wanted.append(float(motion_result(0.1, carry)[0]["comfortable"].value))
    np.testing.assert_array_equal(found[:8], wanted)
    assert 0 < sum(wanted) < 8


@jax.jit
def update(carry, t, a, heading):
    return motion_update(0.1, carry, t=t, v=jnp.float32(10.0), a=a, heading=heading)


# --- decisions on a map -----------------------------------------------------------------------------


def world(name, lane, s, v, goal, free=(0,)):
    """Vehicles on a bundled map, `N` slots; those in `free` are egos."""
    fill = N - len(lane)
    state = state_of(
        name, [*lane, *[0] * fill], [*s, *[10.0] * fill], [*v, *[0.0] * fill], [*goal, *[0] * fill],
        active=jnp.arange(N) < len(lane), driver=drivers(N), shape=shapes(N),
    )  # fmt: skip
    lane_map = bundled(name)[1]
    return dataclasses.replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), free, True))


@functools.cache
def planner(strict: bool):
    policy = PDMClosed(seen=K, strict_tuplan=strict)
    return jax.jit(lambda lane_map, state: policy.plan(CONFIG, lane_map, state))


def planned(name, state, strict=False):
    plan = planner(strict)(bundled(name)[1], state)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(plan))
    return plan


def before_light(shown, room):
    """Lane and arc length so many metres before a stop line, a goal behind it, and lights that show that."""
    network, lane_map = bundled("intersection")
    routes, signals = lane_map.routes, lane_map.signals
    for row in lane_rows(network).values():
        for goal in np.nonzero(
            np.asarray(routes.reachable)[row] & (np.asarray(routes.lanes_to_go)[row] == 0)
        )[0]:
            after = int(routes.next_lane[row, goal])
            program = int(signals.lane_program[after])
            if after < 0 or program < 0 or float(lane_map.curvature_max[after]) > 0.01:
                continue
            lane, s = row, float(lane_map.stop_s[row]) - room
            while s < 6:
                before = [
                    int(k) for k in lane_map.predecessors[lane] if int(routes.next_lane[k, goal]) == lane
                ]
                if not before or before[0] < 0:
                    break
                lane, s = before[0], s + float(lane_map.length[before[0]])
            for phase in range(int(signals.num_phases[program])):
                phases = jnp.zeros(signals.offset.shape, jnp.int32).at[program].set(phase)
                if s >= 6 and int(lane_states(signals, phases)[after]) == shown:
                    return lane, s, int(goal), phases
    raise AssertionError("no such light")


def at_light(shown, room, v):
    """An ego so many metres before the stop line."""
    lane, s, goal, phases = before_light(shown, room)
    state = world("intersection", [lane], [s], [v], [goal])
    return dataclasses.replace(state, lights=dataclasses.replace(state.lights, phase=phases))


def test_red_stops_and_red_far_ahead_does_not_slow_now():
    near = planned("intersection", at_light(SignalState.RED, 30.0, 12.0))
    v, x, y = (np.asarray(values)[0] for values in (near.trajectory.v, near.trajectory.x, near.trajectory.y))
    assert v[-1] < 4.0 and np.hypot(x[-1] - x[0], y[-1] - y[0]) < 30.0
    green = planned("intersection", at_light(SignalState.GREEN_MAJOR, 30.0, 12.0))
    assert np.asarray(green.trajectory.v)[0, 10] > 11.5
    far = planned("intersection", at_light(SignalState.RED, 90.0, 8.0))
    assert np.asarray(far.trajectory.v)[0, 10] > 8.5
    late = planned("intersection", at_light(SignalState.RED, 5.0, 12.0))
    assert np.asarray(late.trajectory.v)[0, 10] > 10, "a vehicle that can no longer stop drives on"


def test_yellow_stops_a_vehicle_that_can_stop():
    can = planned("intersection", at_light(SignalState.YELLOW, 40.0, 12.0))
    cannot = planned("intersection", at_light(SignalState.YELLOW, 15.0, 12.0))
    assert np.asarray(can.trajectory.v)[0, -1] < 6 < 11 < np.asarray(cannot.trajectory.v)[0, -1]


def behind(gap, v, v_lead):
    """An ego behind another vehicle on the right lane of the motorway, bumper to bumper."""
    network, lane_map = bundled("highway")
    rows = lane_rows(network)
    routes = lane_map.routes
    row = next(
        row for row in rows.values()
        if int(lane_map.right[row]) == -1 and float(lane_map.length[row]) > 500
        and (routes.lanes_to_go[row] == 0).any()
    )  # fmt: skip
    goal = int(np.nonzero(np.asarray(routes.reachable[row] & (routes.lanes_to_go[row] == 0)))[0][0])
    return world("highway", [row, row], [60.0, 60.0 + gap + 5.0], [v, v_lead], [goal, goal])


def test_emergency_brake():
    plan = planned("highway", behind(1.2, 4.9, 0.0))
    assert bool(plan.brakes[0]) and float(plan.scores.contact[0, int(plan.best[0])]) <= 2.0
    v = np.asarray(plan.trajectory.v)[0]
    np.testing.assert_allclose(v, np.maximum(4.9 - 7.0 * 0.1 * np.arange(41), 0), atol=1e-4)
    distance = np.hypot(
        plan.trajectory.x - plan.trajectory.x[:, :1], plan.trajectory.y - plan.trajectory.y[:, :1]
    )
    assert distance[0, -1] == pytest.approx(4.9**2 / 14, abs=0.05)
    assert not bool(planned("highway", behind(30.0, 4.9, 0.0)).brakes[0])
    assert bool(planned("highway", behind(1.2, 8.0, 0.0)).brakes[0])
    strict = planned("highway", behind(1.2, 8.0, 0.0), strict=True)
    assert not bool(strict.brakes[0]), "not above 5 m/s"
    strict = planned("highway", behind(1.2, 4.9, 0.0), strict=True)
    assert bool(strict.brakes[0])
    np.testing.assert_allclose(np.asarray(strict.trajectory.v)[0, 1:], 1.1 * (4.9 - 4.05), atol=1e-3)


def test_it_returns_to_its_lane_however_often_it_plans():
    """Planned anew ten times a second, as the public implementation is, an ego 0.8 m off its lane."""
    state, lane_map = behind(150.0, 15.0, 15.0), bundled("highway")[1]
    egos = state.egos
    x, y = egos.x - 0.8 * jnp.sin(egos.heading), egos.y + 0.8 * jnp.cos(egos.heading)
    state = dataclasses.replace(state, d=state.d.at[0].set(0.8), egos=dataclasses.replace(egos, x=x, y=y))

    @jax.jit
    def drive(state, trajectory):
        control = track(CONFIG, Limits(), state, trajectory, CONFIG.time(state.step))
        moved = step_free(CONFIG, lane_map, Limits(), state, control)
        return dataclasses.replace(moved, step=state.step + 1)

    turned = False
    for _ in range(50):
        path = planned("highway", state).trajectory
        state = drive(state, path)
        # as the bend in the middle of the first two steps asks for, the first time that the wheels turn
        bend = float(path.heading[0, 2] - path.heading[0, 0]) / (15.0 * 0.2)
        wanted = bend * float(state.shape.wheelbase[0])
        if not turned and abs(wanted) > 0.003:
            assert float(state.egos.steering[0]) == pytest.approx(wanted, rel=0.25)
            turned = True
    assert turned
    assert abs(float(state.d[0])) < 0.15


def test_conventions_of_the_public_implementation():
    """No leader at the first step: all brake hard for 0.1 s; and no lane changes."""
    state = behind(60.0, 15.0, 15.0)
    ours, theirs = planned("highway", state), planned("highway", state, strict=True)
    assert np.asarray(ours.trajectory.v)[0, -1] > 15.5
    apart = np.asarray(ours.trajectory.v - theirs.trajectory.v)[0]
    assert 0.05 < apart[10] < 0.6
    x, y = (np.asarray(getattr(ours.trajectory, k) - getattr(theirs.trajectory, k)) for k in "xy")
    assert np.hypot(x, y).max() < 2.0


def test_a_lane_change_is_signalled_and_keeps_the_body_on_the_road():
    """On the entrance lane of the ramp, which ends, and on a lane at the right edge of the road behind it."""
    lane_map = bundled("ramp")[1]
    goal = 0
    to_go, edge = np.asarray(lane_map.routes.lanes_to_go)[:, goal], np.asarray(lane_map.right) < 0
    beside = edge & (np.asarray(lane_map.left) >= 0) & ~np.asarray(lane_map.is_connector)
    entrance, straight_on = (int(np.nonzero(beside & (to_go == n))[0][i]) for n, i in ((1, 0), (0, -1)))
    lanes = [entrance, straight_on]
    state = world("ramp", lanes, [100.0, 100.0], [20.0, 20.0], [goal, goal], free=(0, 1))
    assert np.asarray(planned("ramp", state).signal).tolist() == [1, 0]
    assert np.asarray(planned("ramp", state, strict=True).signal).tolist() == [0, 0]
    state = dataclasses.replace(state, shape=dataclasses.replace(state.shape, width=state.shape.width + 0.6))
    half = float(state.shape.width[1]) / 2
    body, slot = pdm_road.bodies(state, jnp.arange(2)), jnp.arange(2)
    ours, theirs = (
        np.asarray(pdm_road.road_ahead(lane_map, state, slot, body, strict).offset[1])
        for strict in (False, True)
    )
    np.testing.assert_allclose(theirs, pdm_road.OFFSETS)
    free = 3.75 / 2 - half - pdm_road.EDGE_MARGIN
    assert free < 0.9
    np.testing.assert_allclose(ours, [0, -free, 1], atol=0.01)


def test_unused_rows_and_empty_slots_are_harmless():
    state = behind(25.0, 15.0, 10.0)
    alone = planned("highway", state)
    policy = PDMClosed(seen=K)
    more = dataclasses.replace(state, egos=with_rows(state.egos, 1))
    found = jax.jit(lambda state: policy.plan(CONFIG, bundled("highway")[1], state))(more)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    np.testing.assert_allclose(found.trajectory.x[0], alone.trajectory.x[0], atol=1e-3)
    with pytest.raises(ValueError, match="seen: 0 others"):
        PDMClosed(seen=0)


# --- in traffic -------------------------------------------------------------------------------------


def test_it_follows_a_leader_to_a_red_light_and_waits():
    lane_map = bundled("intersection")[1]
    (lane, s, goal, phases), (lead, lead_s, _, _) = (
        before_light(SignalState.RED, room) for room in (70.0, 40.0)
    )
    state = world("intersection", [lane, lead], [s, lead_s], [12.0, 8.0], [goal, goal])
    state = dataclasses.replace(state, lights=dataclasses.replace(state.lights, phase=phases))
    run = Rollout(CONFIG, Traffic(lane_changes=False), horizon=14.0, policy=PDMClosed(seen=K), record=trace)

    @jax.jit
    def go(state):
        return run.advance(lane_map, no_arrivals(state), jax.random.key(0), run.init(lane_map, state))[0]

    # the lights are those of the clock: begin when the one ahead has just turned red
    duration = np.asarray(lane_map.signals.duration)
    program = int(np.argmax(lane_map.signals.num_phases))
    start = duration[program, : int(phases[program])].sum() + float(lane_map.signals.offset[program])
    result = go(dataclasses.replace(state, step=jnp.int32(round(start / CONFIG.dt))))
    for name in ("collided", "off_road", "ran_red", "wrong_way"):
        assert int(getattr(result.totals, name)) == 0, name
    seen = jax.tree.map(np.asarray, result.trace)
    gap = np.hypot(*(seen.box[:, 0, :2] - seen.box[:, 1, :2]).T) - 5.0
    assert gap.min() > 0.3 and seen.v[-1].max() < 3.0 and seen.active[-1, :2].all()
    assert np.abs(seen.a[:, 0]).max() < 4.5 and np.abs(seen.d[:, 0]).max() < 1.5


# --- with the rules of the road ----------------------------------------------------------------------


def test_the_vehicle_that_goes_first_is_one_more_leader():
    road, planned = straight_road(), body((10.0, 8.0))
    moments = 5
    along = pdm_proposals.Leaders(
        rear=jnp.full((moments, 2, 3, 4), 50.0), centre=jnp.full((moments, 2, 4), 52.0),
        v=jnp.full((moments, 2, 4), 3.0),
    )  # fmt: skip
    first = Way(
        wall=jnp.array([30.0, 1e6]), gap=jnp.array([20.0, pdm_road.FAR]), v=jnp.array([4.0, 9.0]),
        stop=jnp.zeros(2),
    )  # fmt: skip
    found = along_with(along, first, road, planned)
    front = float(road.s[0] + planned.wheelbase[0] / 2 + planned.length[0] / 2)
    for moment in range(moments):
        t = moment * pdm_road.LOOK_EVERY * pdm_road.DT
        np.testing.assert_allclose(found.rear[moment, 0, :, -1], front + 20.0 + 4.0 * t, rtol=1e-6)
        np.testing.assert_allclose(found.v[moment, :, -1], [4.0, 9.0])
        assert (np.asarray(found.rear[moment, 1, :, -1]) >= pdm_road.FAR).all()
        np.testing.assert_array_equal(found.rear[moment, ..., :-1], along.rear[moment])
    walls = np.asarray(first.stopping(road, planned).wall)
    np.testing.assert_allclose(walls[0], front + 30.0)
    np.testing.assert_array_equal(walls[1], road.wall[1])
    # towards another lane the road has walls of its own
    other = road._replace(worth=jnp.asarray([[0.0, 0.0, 15.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(first.stopping(other, planned).wall, road.wall)


def test_rules_wait_where_the_map_demands():
    """Before a vehicle that comes round a roundabout PDM-Closed goes, and with rules it waits."""
    lane_map = bundled("roundabout")[1]
    m = jax.tree.map(np.asarray, lane_map)
    entries = [i for i in range(len(m.length)) if m.length[i] > 100 and (m.successors[i] >= 0).sum() == 1]
    ring = [i for i in range(len(m.length)) if 5 < m.length[i] < 60 and (m.successors[i] >= 0).any()]
    worlds = []
    for entry in entries:
        for place in ring:
            goal = [int(np.argmax(m.routes.next_lane[x] >= 0)) for x in (entry, place)]
            seats = [m.length[entry] - 20.0, m.length[place] - 1.0]
            state = state_of("roundabout", [entry, place], seats, [7.0, 11.0], goal)
            egos = from_lane(lane_map, state, boxes(lane_map, state), [0], True)
            worlds.append(dataclasses.replace(state, egos=egos))
    worlds = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    alone = dataclasses.replace(worlds, active=worlds.active.at[:, 1].set(False))

    def crosses(policy, states):
        """Whether the front passes the end of the lane within the plan."""

        def one(state):
            path = policy.plan(CONFIG, lane_map, state).trajectory
            steps = jnp.hypot(jnp.diff(path.x[0]), jnp.diff(path.y[0])).sum()
            return steps > 20.0

        return np.asarray(jax.jit(jax.vmap(one))(states))

    rules = PDMClosed(rules=True)
    waits = crosses(rules, alone) & ~crosses(rules, worlds)
    goes = crosses(PDMClosed(), worlds)
    assert waits.sum() >= 10
    assert (waits & goes).sum() >= 10


def test_the_public_implementation_has_no_rules():
    with pytest.raises(ValueError, match="expected rules or strict_tuplan"):
        PDMClosed(rules=True, strict_tuplan=True)
    assert policy_name(PDMClosed(rules=True)) == "pdm_closed_rules"
    assert policy_name(PDMClosed()) == "pdm_closed"
