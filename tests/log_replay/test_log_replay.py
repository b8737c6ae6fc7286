"""Log replay: recorded scenes, and what the traffic model does once an ego leaves its log."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import SHARED, needs_shared

from limsim_jax.log_replay.arrays import GRID, SceneArrays, build_arrays, pose, sight, sight_of
from limsim_jax.log_replay.pilot import PolicyPilot
from limsim_jax.log_replay.takeover import Mode, Takeover, as_logged, braking, replay, replay_many
from limsim_jax.maps import build_lane_map
from limsim_jax.maps.lane_map import LaneMap, absolute, lane_rows
from limsim_jax.policies.base import LikeTraffic
from limsim_jax.policies.simple import ConstantSpeed
from limsim_jax.recordings import Lanelet, Tracks, lanelet_network, read_tracks

pytestmark = pytest.mark.engine

TRAJECTORIES = SHARED / "trajectories"
DT, STEPS, CARS = 0.1, 400, 5
LATE, ENDING = CARS, CARS + 1
STOP, START, OUT = 5.0, 20.0, 9.0  # s: the ego brakes; one enters; the log of one ends


def strip(name: str, y: float, *, wide: float = 3.5, end: float = 1000.0, **links) -> Lanelet:
    x = np.linspace(0, end, 101)
    return Lanelet(
        name, np.stack([x, 0 * x + y + wide / 2], -1), np.stack([x, 0 * x + y - wide / 2], -1), **links
    )


@functools.cache
def platoon() -> tuple[Tracks, LaneMap, SceneArrays]:
    """Five cars of different lengths behind one another; one enters later, the log of another one ends."""
    t = np.arange(STEPS) * DT
    v = 15 + 2 * np.sin(2 * np.pi * t / 25)
    way = np.append(0, np.cumsum((v[1:] + v[:-1]) / 2)) * DT
    length = 4.0 + 0.3 * np.arange(CARS + 2)
    start = 130 - np.append(0, np.cumsum(length[1:CARS] + 15 * (0.9 + 0.1 * np.arange(CARS - 1))))
    x = np.full((STEPS, CARS + 2), np.nan)
    y, speed = x.copy(), x.copy()
    x[:, :CARS], y[:, :CARS], speed[:, :CARS] = start + way[:, None], 0.1, v[:, None]
    late = t >= START
    x[late, LATE], y[late, LATE], speed[late, LATE] = 225 + 15 * (t[late] - START), 0.0, 15.0
    there = t <= OUT
    x[there, ENDING], y[there, ENDING], speed[there, ENDING] = 120 + way[there], 3.4, v[there]
    network = lanelet_network(
        [strip("right", 0, left="left"), strip("left", 3.5, right="right")], "road", "road"
    )
    recorded = Tracks(
        name="road", source="road", dt=DT, vehicles=tuple("abcdefg"), x=x, y=y,
        heading=np.where(np.isfinite(x), 0.0, np.nan), v=speed, length=length, width=np.full(CARS + 2, 1.8),
        network=network,
    )  # fmt: skip
    lane_map = build_lane_map(network)
    return recorded, lane_map, build_arrays(recorded, lane_map)


@functools.cache
def variants():
    """The ego as logged; brakes for a moment; stands for a while; stops for good; rams the one ahead."""
    scene = platoon()[2]

    @jax.jit
    def run(scene):
        slot = jnp.array([0, 0, 0, 0, 1])
        deceleration = jnp.array([0.0, 6.0, 6.0, 8.0, -3.0])
        duration = jnp.array([0.0, 1.0, 20.0, 1e6, 6.0])
        egos = jax.vmap(lambda k, b, d: braking(scene, k, STOP, b, d))(slot, deceleration, duration)
        return jax.vmap(lambda ego: replay(scene, ego, record=True))(egos)

    return jax.tree.map(np.asarray, run(scene))


def overlaps(moments, scene, t: int) -> list[tuple[int, int]]:
    """Pairs whose boxes share a point, by their corners and the directions of their sides."""
    length, width = np.asarray(scene.log.length), np.asarray(scene.log.width)
    here = np.flatnonzero(moments.active[t])
    corners = {}
    for i in here:
        c, s = np.cos(moments.heading[t, i]), np.sin(moments.heading[t, i])
        local = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length[i] / 2, width[i] / 2]
        corners[i] = local @ np.array([[c, s], [-s, c]]) + [moments.x[t, i], moments.y[t, i]]
    found = []
    for i in here:
        for j in here[here > i]:
            sides = np.concatenate([np.diff(corners[k][:3], axis=0) for k in (i, j)])
            shadows = [[corners[k] @ side for k in (i, j)] for side in sides]
            if all(a.max() >= b.min() and b.max() >= a.min() for a, b in shadows):
                found.append((int(i), int(j)))
    return found


def one(tree, k: int):
    return jax.tree.map(lambda x: x[k], tree)


# --- replay ------------------------------------------------------------------------------------------


def test_an_ego_on_its_log_changes_nothing():
    recorded, lane_map, scene = platoon()
    counts, moments = one(variants(), 0)
    valid = np.asarray(scene.log.valid)
    np.testing.assert_array_equal(moments.active, valid)
    for name in ("x", "y", "heading", "v"):
        logged = np.asarray(getattr(scene.log, name))
        assert (getattr(moments, name)[valid] == logged[valid]).all(), name
    x, y = absolute(lane_map, moments.x, moments.y)
    np.testing.assert_allclose(x[valid], recorded.x[valid], atol=1e-4)
    np.testing.assert_allclose(y[valid], recorded.y[valid], atol=1e-4)
    assert counts.takeovers.sum() == counts.struck.sum() == counts.delayed.sum() == 0


def test_an_ego_that_brakes_is_followed_by_a_chain_of_takeovers_and_returns():
    _, _, scene = platoon()
    counts, moments = one(variants(), 1)
    followers = slice(1, CARS)
    assert (counts.takeovers[followers] == 1).all()
    first = (moments.mode[:, followers] != Mode.LOG).argmax(0) * DT
    assert (np.diff(first) >= 0).all() and first[0] >= STOP and first[-1] > first[0]
    assert (counts.in_time[followers] == 1).all() and counts.late.sum() == 0
    assert counts.displacement[1] > 5
    # back is back: the log to the bit
    valid = np.asarray(scene.log.valid)
    for name in ("x", "y", "heading", "v"):
        assert (getattr(moments, name)[-1] == np.asarray(getattr(scene.log, name))[-1])[valid[-1]].all()


@pytest.mark.parametrize("variant", [1, 2, 3])
def test_no_bodies_touch_and_positions_are_continuous(variant):
    _, _, scene = platoon()
    counts, moments = one(variants(), variant)
    assert not any(overlaps(moments, scene, t) for t in range(STEPS))
    assert counts.struck.sum() == 0
    both = moments.active[1:] & moments.active[:-1]
    step = np.hypot(np.diff(moments.x, axis=0), np.diff(moments.y, axis=0))
    fastest = np.maximum(moments.v[1:], moments.v[:-1]) * DT
    assert (step - fastest)[both].max() < 0.1  # half a metre fades over ten steps
    assert counts.jump.max() < 0.1
    assert counts.hardest.max() <= 8.001


def test_contacts_are_recorded():
    _, _, scene = platoon()
    counts, moments = one(variants(), 4)
    met = {pair for t in range(STEPS) for pair in overlaps(moments, scene, t)}
    assert (0, 1) in met
    assert {(int(i), int(j)) for i, j in np.argwhere(counts.struck) if i < j} == met
    assert (counts.struck == counts.struck.T).all()


def test_a_vehicle_that_is_late_stays_under_control():
    counts, moments = one(variants(), 3)
    followers = slice(1, CARS)
    assert (moments.v[-1, followers] < 0.1).all()
    assert counts.handed_back.sum() == 0 and (counts.late[followers] == 1).all()
    assert counts.under_control[followers].all()
    assert (moments.mode[-1, followers] == Mode.CTRL).all()
    # not even once the way is free again
    counts, moments = one(variants(), 2)
    assert (moments.v[-1, followers] > 10).all() and (counts.late[followers] == 1).all()
    assert (moments.mode[-1, followers] == Mode.CTRL).all()


def test_a_vehicle_waits_outside_where_another_one_stands():
    _, _, scene = platoon()
    counts, moments = one(variants(), 2)
    due = round(START / DT)
    stands = moments.x[due, 0]
    assert abs(stands - float(scene.log.x[due, LATE])) < 20, "the ego stands where the log begins"
    assert not moments.active[due, LATE] and counts.delayed[LATE] > 1
    entered = moments.active[:, LATE].argmax()
    assert entered > due and entered * DT == pytest.approx(START + counts.delayed[LATE], abs=0.11)
    assert counts.takeovers[LATE] == 1
    for variant in (0, 1):
        assert one(variants(), variant)[1].active[due, LATE]


def test_a_log_that_ends_beside_a_strayed_ego_is_carried_on():
    counts, moments = one(variants(), 2)
    end = round(OUT / DT)
    assert moments.active[end + 50, ENDING]
    assert counts.ended[ENDING] == 1 and counts.takeovers[ENDING] == counts.late[ENDING] == 0
    assert moments.y[end + 50, ENDING] == pytest.approx(moments.y[end, ENDING], abs=0.01)
    assert moments.x[end + 50, ENDING] > moments.x[end, ENDING] + 50
    assert not one(variants(), 0)[1].active[end + 1, ENDING]


def test_many_at_once_are_each_alone():
    scene = platoon()[2]
    egos = jax.vmap(lambda b, d: braking(scene, 0, STOP, b, d))(
        jnp.array([0.0, 6.0, 6.0]), jnp.array([0.0, 1.0, 20.0])
    )
    many = jax.jit(functools.partial(replay_many, at_once=2))(scene, egos)
    expected = jax.tree.map(lambda x: x[:3], variants()[0])
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-3), many, expected)


def test_a_policy_drives_the_ego_in_the_plane():
    _, lane_map, scene = platoon()
    run = jax.jit(lambda scene, pilot: replay(scene, braking(scene, 0, STOP, 0.0), pilot=pilot, record=True))
    counts, moments = run(scene, PolicyPilot(lane_map=lane_map, policy=ConstantSpeed(speed=7.0)))
    before = round(STOP / DT)
    assert (moments.x[: before + 1, 0] == scene.log.x[: before + 1, 0]).all()
    assert moments.v[-1, 0] == pytest.approx(7.0, abs=0.1)
    assert np.abs(moments.y[-1, 0] - moments.y[0, 1]) < 0.5
    assert (np.asarray(counts.takeovers)[1:CARS] >= 1).all() and counts.struck.sum() == 0
    step = np.hypot(np.diff(moments.x[:, 0]), np.diff(moments.y[:, 0]))
    np.testing.assert_allclose(step[before + 1 :], moments.v[before + 1 : -1, 0] * DT, atol=0.05)
    moments = jax.tree.map(np.asarray, moments)
    assert not any(overlaps(moments, scene, t) for t in range(0, STEPS, 5))


def test_policies_that_cannot_fly_are_refused():
    with pytest.raises(ValueError, match="keeps to lanes"):
        PolicyPilot(lane_map=platoon()[1], policy=LikeTraffic())
    with pytest.raises(ValueError, match=r"patience: 0; it has to be above 0"):
        Takeover(patience=0)


# --- scenes ------------------------------------------------------------------------------------------


def test_paths_seen_from_one_another():
    """Two lanes of a ring, 40 m and 43.5 m from its centre, and a body crossing both."""
    angle = np.linspace(-0.2, 2.2, 200)
    ring = lambda r, a: np.stack([r * np.cos(a), r * np.sin(a)], -1)  # noqa: E731
    lanelets = [
        Lanelet("inner", ring(38.25, angle), ring(41.75, angle), right="outer"),
        Lanelet("outer", ring(41.75, angle), ring(45.25, angle), left="inner"),
    ]
    t = np.arange(60)[:, None] * DT
    a = 0.1 + t * np.array([[0.25, 0.2]]) + np.array([[0.3, 0.0]])
    radius = np.array([[40.0, 43.5]])
    v = np.broadcast_to(radius * [[0.25, 0.2]], a.shape)
    recorded = Tracks(
        name="ring", source="ring", dt=DT, vehicles=("in", "out"), x=radius * np.cos(a), y=radius * np.sin(a),
        heading=a + np.pi / 2, v=v, length=np.array([4.0, 5.0]), width=np.array([1.8, 2.0]),
        network=lanelet_network(lanelets, "ring", "ring"),
    )  # fmt: skip
    lane_map = build_lane_map(recorded.network)
    scene = build_arrays(recorded, lane_map)
    origin = np.asarray(lane_map.origin)
    # the path is the arc, and goes on along the lane
    for k, p in enumerate((5.3, 30.0)):
        x, y, heading, v = np.asarray(pose(scene, jnp.full(2, p, jnp.float32)))[k]
        turn = a[0, k] + p / radius[0, k]
        assert np.hypot(*(np.array([x, y]) + origin - ring(radius[0, k], turn))) < 0.02
        assert abs(heading - turn - np.pi / 2) < 0.02
        assert v == pytest.approx(recorded.v[0, k], abs=0.01)
    # places on each other's paths, by angles
    p = np.array([4.2, 17.7], np.float32)
    seen = sight(scene, jnp.asarray(p))
    turn = a[0] + p / radius[0]
    assert float(seen.along[0, 1]) == pytest.approx((turn[0] - a[0, 1]) * 43.5, abs=0.05)
    assert float(seen.along[1, 0]) == pytest.approx((turn[1] - a[0, 0]) * 40.0, abs=0.1)
    assert float(seen.beside[0, 1]) == pytest.approx(3.5, abs=0.02)
    assert float(seen.beside[1, 0]) == pytest.approx(-3.5, abs=0.02)
    x, y = ring(44.0, a[0, 1] + 0.5) - origin
    along, beside, cos, sin = sight_of(scene, jnp.float32(x), jnp.float32(y), jnp.float32(0.3))
    assert float(along[1]) == pytest.approx(0.5 * 43.5, abs=0.05)
    assert float(beside[1]) == pytest.approx(-0.5, abs=0.02)
    slant = 0.3 - (a[0, 1] + 0.5 + np.pi / 2)
    assert float(cos[1]) == pytest.approx(np.cos(slant), abs=0.02)
    assert float(sin[1]) == pytest.approx(np.sin(slant), abs=0.02)
    # lanes of the log
    rows = lane_rows(recorded.network)
    assert (np.asarray(scene.log.lane) == [rows["inner"], rows["outer"]]).all()
    assert np.abs(scene.log.d).max() < 0.03
    assert GRID == 1.0


# --- recorded scenes ---------------------------------------------------------------------------------


@needs_shared
def test_a_recorded_scene_with_egos_that_brake():
    recorded = read_tracks(TRAJECTORIES / "commonroad" / "USA_US101-4_1_T-1.xml.gz")
    scene = build_arrays(recorded, build_lane_map(recorded.network))
    egos = jax.vmap(lambda slot, hard: braking(scene, slot, 1.0, hard))(
        jnp.arange(8, dtype=jnp.int32), jnp.array([0.0, 4.0, 6.0, 8.0, 6.0, 6.0, 6.0, 6.0])
    )
    idle = as_logged(scene, 0)
    egos = jax.tree.map(lambda many, first: many.at[0].set(first), egos, idle)
    run = jax.jit(lambda scene, egos: jax.vmap(lambda ego: replay(scene, ego, record=True))(egos))
    counts, moments = jax.tree.map(np.asarray, run(scene, egos))
    valid = np.asarray(scene.log.valid)
    np.testing.assert_array_equal(moments.active[0], valid)
    for name in ("x", "y", "heading", "v"):
        assert (getattr(moments, name)[0][valid] == np.asarray(getattr(scene.log, name))[valid]).all()
    assert counts.takeovers[0].sum() == 0
    assert counts.takeovers[1:].sum() > 5
    assert counts.struck.sum() == 0 and not any(
        overlaps(one(moments, k), scene, t) for k in range(1, 8) for t in range(0, len(valid), 10)
    )
    assert counts.jump.max() < 0.1
