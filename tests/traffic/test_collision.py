"""Contacts, the road's edge, wrong ways: against loops and polygons in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError
from synthetic import network, straight
from traffic_worlds import bundled, state_of

from limsim_jax.maps.lane_map import lane_rows, pose
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.traffic import collision, ego
from limsim_jax.traffic.car_following import ballistic
from limsim_jax.traffic.collision import OVERHANG, REACH, contacts
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config, Status

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
many_contacts = jax.jit(jax.vmap(contacts))


# --- contacts -----------------------------------------------------------------------------------


def corners(box):
    """Corners of boxes [..., 5] in float64, counter-clockwise: [..., 4, 2]."""
    x, y, heading, length, breadth = np.moveaxis(np.asarray(box, float), -1, 0)
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1) * length[..., None] / 2
    left = np.stack([-np.sin(heading), np.cos(heading)], -1) * breadth[..., None] / 2
    center = np.stack([x, y], -1)
    return np.stack(
        [center + ahead + left, center - ahead + left, center - ahead - left, center + ahead - left], -2
    )


def separations(box, active):
    """Largest gap of all pairs along the normals of their sides, from projected corners: [B, N, N]."""
    p = corners(box)  # [B, N, 4, 2]
    sides = np.diff(p[..., :3, :], axis=-2)  # two directions
    normals = sides / np.linalg.norm(sides, axis=-1, keepdims=True)
    n = box.shape[1]
    largest = np.full((box.shape[0], n, n), 1e9)
    for i in range(n):
        for j in range(n):
            if i == j:
                continue
            axes = np.concatenate([normals[:, i], normals[:, j]], 1)  # [B, 4, 2]
            a, b = (np.einsum("bka,bca->bkc", axes, p[:, k]) for k in (i, j))
            gap = np.maximum(a.min(-1) - b.max(-1), b.min(-1) - a.max(-1)).max(-1)
            largest[:, i, j] = np.where(active[:, i] & active[:, j], gap, 1e9)
    return largest


def check(box, active, tolerance=1e-3):
    """Every contact is found, and none that is not there; how many there were."""
    box = np.asarray(box, np.float32)
    found = many_contacts(jnp.asarray(box), jnp.asarray(active))
    other, nearest, separation = (np.asarray(x) for x in found)
    truth = separations(box, active)
    least = truth.min(-1)
    np.testing.assert_allclose(separation, np.minimum(least, REACH), atol=tolerance)
    assert (other[least < -tolerance] >= 0).all(), "missed"
    assert (other[least > tolerance] == -1).all(), "not there"
    within = least < REACH - tolerance
    assert (nearest[within] >= 0).all() and (nearest[least > REACH + tolerance] == -1).all()
    there = np.take_along_axis(truth, np.maximum(nearest, 0)[..., None], -1)[..., 0]
    assert (there[within] < least[within] + tolerance).all()
    np.testing.assert_array_equal(other[other >= 0], nearest[other >= 0])
    return int((least < 0).sum())


def clouds(worlds, n, rng, side):
    """Unequal boxes at random, from crowded to sparse; one in six slots is empty."""
    side = rng.choice(side, (worlds, 1))
    heading = rng.choice([1.0, 0.0], (worlds, 1)) * rng.uniform(-4, 4, (worlds, n))
    heading += rng.uniform(-3, 3, (worlds, 1))  # some worlds have one direction for all
    box = [
        rng.uniform(-1, 1, (worlds, n)) * side, rng.uniform(-1, 1, (worlds, n)) * side, heading,
        rng.uniform(0.5, 18.0, (worlds, n)), rng.uniform(0.4, 2.6, (worlds, n)),
    ]  # fmt: skip
    return np.stack(box, -1), rng.uniform(size=(worlds, n)) < 5 / 6


def test_no_contact_is_missed_in_ten_thousand_worlds():
    rng = np.random.default_rng(0)
    box, active = clouds(10_000, 12, rng, [4.0, 12.0, 40.0, 150.0])
    touching = check(box, active)
    assert 10_000 < touching < 0.7 * active.sum()


@pytest.mark.parametrize("n", [1, 2, 3, 40])
def test_contacts_of_few_and_of_many(n):
    rng = np.random.default_rng(n)
    check(*clouds(200 if n < 40 else 30, n, rng, [3.0, 30.0, 100.0]))


def test_contacts_in_a_jam_across_the_sweep():
    """Long straight columns at every angle, and far from the origin: the worst order to sort by."""
    rng = np.random.default_rng(7)
    worlds, n = 30, 40
    angle = np.linspace(0, 2 * np.pi, worlds)[:, None]
    along = 6.0 * np.arange(n) + rng.uniform(-0.8, 0.8, (worlds, n))
    across = rng.choice([0.0, 2.0], (worlds, n))
    x = along * np.cos(angle) - across * np.sin(angle) + 4000
    y = along * np.sin(angle) + across * np.cos(angle) - 3000
    shape = [np.full((worlds, n), 5.0), np.full((worlds, n), 1.9)]
    assert (
        check(np.stack([x, y, np.broadcast_to(angle, x.shape), *shape], -1), np.ones((worlds, n), bool), 3e-3)
        > 50
    )


def test_touching_does_not_depend_on_the_order_of_slots():
    rng = np.random.default_rng(3)
    box, active = clouds(20, 40, rng, [30.0])
    order = rng.permutation(40)
    a = many_contacts(jnp.asarray(box, jnp.float32), jnp.asarray(active))
    b = many_contacts(jnp.asarray(box[:, order], jnp.float32), jnp.asarray(active[:, order]))
    np.testing.assert_array_equal(a.separation[:, order], b.separation)
    back = np.asarray(b.other)
    np.testing.assert_array_equal(a.other[:, order], np.where(back >= 0, order[back], -1))


def test_broken_numbers_stay_with_their_vehicle():
    rng = np.random.default_rng(4)
    box, active = clouds(6, 12, rng, [12.0])
    active[:, 5] = True
    clean = many_contacts(jnp.asarray(box, jnp.float32), jnp.asarray(active).at[:, 5].set(False))
    for k, value in enumerate([np.nan, np.nan, np.nan, np.inf, np.nan]):
        box[k, 5, k] = value
    box[5, 5, 0] = -np.inf
    broken = many_contacts(jnp.asarray(box, jnp.float32), jnp.asarray(active))
    for name in clean._fields:
        np.testing.assert_array_equal(getattr(broken, name), getattr(clean, name))


# --- what is recorded ---------------------------------------------------------------------------


def row_on(name, index=0):
    network, _ = bundled(name)
    rows = [row for lane, row in lane_rows(network).items() if network.lanes[lane].length > 60]
    return rows[index]


def test_contacts_are_recorded_once_and_no_vehicle_is_removed():
    _, lane_map = bundled("intersection")
    row = row_on("intersection")
    # 0 and 1 overlap by 1 m, 2 is clear of them, 3 stands on 0 but is not there, 4 is broken
    state = state_of("intersection", [row] * 5, [30.0, 34.0, 50.0, 30.0, 20.0], [5.0] * 5, [0] * 5)
    state = dataclasses.replace(
        state, active=state.active.at[3].set(False), v=state.v.at[4].set(jnp.nan), step=jnp.int32(7)
    )
    record = jax.jit(lambda state: collision.record(CONFIG, lane_map, state, boxes(lane_map, state))[0])
    once = record(state)
    hit = int(Status.COLLIDED)
    np.testing.assert_array_equal(once.status, [hit, hit, 0, 0, int(Status.NOT_FINITE)])
    np.testing.assert_array_equal(once.struck, [1, 0, -1, -1, -1])
    np.testing.assert_allclose(once.struck_at, [0.7, 0.7, 0, 0, 0], rtol=1e-6)
    assert bool(collision.collided(once)) and not bool(collision.collided(state))
    untouched = dataclasses.replace(once, status=state.status, struck=state.struck, struck_at=state.struck_at)
    jax.tree.map(np.testing.assert_array_equal, untouched, state)
    # 2 comes into both later: only its own contact is new
    later = dataclasses.replace(once, s=once.s.at[2].set(25.5), step=jnp.int32(9))
    twice = record(later)
    np.testing.assert_array_equal(twice.struck[:3], [1, 0, 0])
    np.testing.assert_allclose(twice.struck_at[:3], [0.7, 0.7, 0.9], rtol=1e-6)
    apart = record(dataclasses.replace(twice, s=jnp.asarray([5.0, 20.0, 35.0, 60.0, 50.0])))
    np.testing.assert_array_equal(apart.status[:3], [hit] * 3)


def test_what_happens_after_a_collision():
    state = state_of("intersection", [row_on("intersection")] * 3, [30.0, 45.0, 60.0], [12.0] * 3, [0] * 3)
    driver = dataclasses.replace(state.driver, b_max=jnp.asarray([6.0, 7.0, 8.0]))
    state = dataclasses.replace(state, driver=driver, status=jnp.asarray([int(Status.COLLIDED), 0, 65]))
    a = jnp.asarray([1.0, 1.5, -9.0])
    np.testing.assert_allclose(collision.after_collision(state, a, "stop"), [-6, 1.5, -8])
    for option in ("continue", "end"):
        np.testing.assert_array_equal(collision.after_collision(state, a, option), a)
    slot = jnp.asarray([2, 1])
    np.testing.assert_allclose(collision.after_collision(state, a[:2], "stop", slot), [-8, 1.5])
    with pytest.raises((ValueError, TypeCheckError), match="vanish"):
        collision.after_collision(state, a, "vanish")  # pyright: ignore[reportArgumentType]
    v, way = state.v, 0.0
    for _ in range(40):
        v, dx = ballistic(v, collision.after_collision(state, a, "stop"), CONFIG.dt)
        way = way + dx
    np.testing.assert_allclose(np.asarray(way)[[0, 2]], [12**2 / 12, 12**2 / 16], rtol=1e-4)
    assert not np.asarray(v)[[0, 2]].any()


def test_gradients_pass_by_the_record():
    _, lane_map = bundled("intersection")
    state = state_of("intersection", [row_on("intersection")] * 2, [30.0, 33.0], [5.0] * 2, [0] * 2)

    def loss(s):
        there = dataclasses.replace(state, s=s)
        after, _ = collision.record(CONFIG, lane_map, there, boxes(lane_map, there))
        return (after.s * jnp.arange(1.0, 3.0)).sum()

    np.testing.assert_array_equal(jax.grad(loss)(state.s), [1.0, 2.0])
    box = boxes(lane_map, state)
    assert not np.asarray(jax.grad(lambda box: contacts(box, state.active).separation.sum())(box)).any()


# --- the road -----------------------------------------------------------------------------------


def test_traffic_that_keeps_to_lanes_is_off_the_road_where_no_lane_is_beside_it():
    network, lane_map = bundled("intersection")
    right, left = np.asarray(lane_map.right), np.asarray(lane_map.left)
    row = next(r for r in lane_rows(network).values() if right[r] < 0 <= left[r] and lane_map.length[r] > 60)
    half = (float(lane_map.rows[lane_map.first[row], 8]) - 1.9) / 2  # free space beside a car in the middle
    d = [0.0, -half, -half - OVERHANG - 0.05, -half - OVERHANG + 0.05, 2.5, half + 3.0, 0.0, -9.0]
    state = state_of("intersection", [row] * 8, [20.0 + 5 * k for k in range(8)], [5.0] * 8, [0] * 8)
    shape = dataclasses.replace(state.shape, width=state.shape.width.at[6].set(4.5))
    state = dataclasses.replace(state, d=jnp.asarray(d), shape=shape, active=state.active.at[7].set(False))
    off = collision.off_road(lane_map, state, boxes(lane_map, state))
    np.testing.assert_array_equal(off, [False, False, True, False, False, False, False, False])


def test_a_lane_change_may_end_where_the_road_enters_a_junction():
    """Two lanes, of which the right one leads on: a body that comes over from the left one is on the road."""
    beside = {"road": "p", "junction": None}
    map_ = network([
        straight("p0", (0.0, 0.0), 0.0, 40.0, successors=("c",), left="p1", **beside),
        straight("p1", (0.0, 3.5), 0.0, 40.0, number=-2, right="p0", **beside),
        straight("c", (40.0, 0.0), 0.0, 20.0, junction="J", successors=("out",)),
        straight("out", (60.0, 0.0), 0.0, 50.0),
    ])  # fmt: skip
    rows, lane_map = lane_rows(map_), build_lane_map(map_)
    state = state_of("ramp", [rows["c"]] * 4, [1.0, 8.0, 1.0, 1.0], [5.0] * 4, [0] * 4)
    d = jnp.asarray([2.0, 2.0, -2.0, 5.0])
    previous = jnp.full(4, rows["p0"])
    state = dataclasses.replace(state, d=d, previous=previous)
    off = collision.off_road(lane_map, state, boxes(lane_map, state))
    np.testing.assert_array_equal(off, [False, True, True, True])


def excess_of(network, points):
    """How far points are from the nearest lane for motor traffic, m (0 on it), and how far inside: [P]."""
    best = np.full(len(points), np.inf)
    for lane in network.drivable_lanes():
        s = np.arange(0, lane.length, 0.1)
        xy = np.stack([np.interp(s, lane.s, lane.xyz[:, k]) for k in range(2)], -1)
        half = np.interp(s, lane.s, lane.width) / 2
        away = np.linalg.norm(points[:, None] - xy, axis=-1)
        best = np.minimum(best, (away - half).min(-1))
    return best


EGOS = 96


@jax.jit
def settle(lane_map, state):
    """Egos find their lane where they stand; whether they are off the road or on the wrong way."""
    still = ego.Control(acceleration=jnp.zeros(EGOS), steering=jnp.zeros(EGOS))
    state = ego.step_free(CONFIG, lane_map, ego.Limits(), state, still)
    box = ego.overlay_boxes(state, boxes(lane_map, state))
    return collision.off_road(lane_map, state, box), collision.wrong_way(lane_map, state, box), box


def standing(name, rows, s, x, y, heading, free: list[bool] | bool = True, length: float | np.ndarray = 5.0):
    """`EGOS` free egos that stand at x, y, and were on lanes at `s` (m, centre) before."""
    _, lane_map = bundled(name)
    state = state_of(name, rows, np.asarray(s) + 2.5, np.zeros(EGOS), np.zeros(EGOS, int))
    shape = dataclasses.replace(state.shape, length=jnp.broadcast_to(jnp.asarray(length, jnp.float32), EGOS))
    egos = ego.from_lane(lane_map, state, boxes(lane_map, state), list(range(EGOS)), free)
    return dataclasses.replace(state, shape=shape, egos=dataclasses.replace(egos, x=x, y=y, heading=heading))


@pytest.mark.parametrize("name", ["roundabout", "intersection"])
def test_free_egos_are_off_the_road_with_a_corner_beyond_all_lanes(name):
    """Anywhere and in any direction, against distances to the lanes of the map."""
    network, lane_map = bundled(name)
    rng = np.random.default_rng(5)
    rows = rng.choice(list(lane_rows(network).values()), EGOS)
    # not at the edge of the map
    links = lane_map.predecessors, lane_map.successors
    first, last = (np.where(np.asarray(link)[rows, 0] < 0, 15.0, 0.0) for link in links)
    s = first + rng.uniform(0, 1, EGOS) * (np.asarray(lane_map.length)[rows] - last - first)
    d = rng.choice([0.0, 1.0, 3.0], EGOS) * rng.normal(size=EGOS)
    x, y, heading = pose(lane_map, rows, jnp.asarray(s, jnp.float32), jnp.asarray(d, jnp.float32))
    heading = heading + jnp.asarray(rng.choice([0.1, 0.5, 2.0], EGOS) * rng.normal(size=EGOS), jnp.float32)
    length = rng.choice([4.0, 5.0, 12.0], EGOS, p=[0.4, 0.5, 0.1])
    off, _, box = settle(lane_map, standing(name, rows, s, x, y, heading, length=length))
    points = corners(np.asarray(box)) + np.asarray(lane_map.origin, float)
    excess = excess_of(network, points.reshape(-1, 2)).reshape(EGOS, 4).max(-1)
    clear = np.abs(excess - OVERHANG) > 0.05
    assert 0.2 < (excess > OVERHANG).mean() < 0.8 and clear.mean() > 0.9
    np.testing.assert_array_equal(np.asarray(off)[clear], excess[clear] > OVERHANG)


def test_wrong_way():
    _, lane_map = bundled("intersection")
    opposite = np.asarray(lane_map.opposite)
    row = int(np.nonzero(opposite >= 0)[0][0])
    other = int(opposite[row])
    end = float(lane_map.length[other])
    # own lane ahead and reversed, oncoming lane ahead (as lanes go) and against it, off the road, lane-bound
    lanes = jnp.asarray([row, row, other, other, row, row])
    s = jnp.asarray([12.5, 12.5, end - 12.5, end - 12.5, 12.5, 12.5])
    x, y, along = pose(lane_map, lanes, s, jnp.asarray([0.3, 0.3, 0.2, 0.2, -9.0, 0.0]))
    heading = along + jnp.asarray([0.4, jnp.pi - 0.4, -0.3, jnp.pi + 0.5, 2.0, jnp.pi])
    fill = lambda values: jnp.pad(values, (0, EGOS - 6), mode="edge")  # noqa: E731
    free = [True] * 5 + [False] * (EGOS - 5)
    state = standing("intersection", [row] * EGOS, [12.5] * EGOS, fill(x), fill(y), fill(heading), free)
    off, wrong, _ = settle(lane_map, state)
    np.testing.assert_array_equal(wrong[:6], [False, True, False, True, False, False])
    np.testing.assert_array_equal(off[:6], [False, False, False, False, True, False])
