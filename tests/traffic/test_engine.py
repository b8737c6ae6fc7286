"""The engine on roads without junctions: traffic that follows, changes lanes, and leaves."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import network, straight
from traffic_worlds import bundled, drivers, scattered, shapes, state_of

from limsim_jax.geometry import box_separation
from limsim_jax.maps.lane_map import curvature, lane_rows, width
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.traffic.car_following import ACC, IDM
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.engine import Traffic, _give_up, drive
from limsim_jax.traffic.lane_change import closing, incentive, urgency
from limsim_jax.traffic.motion import boxes, smooth, smooth_step
from limsim_jax.traffic.parameters import DRIVING
from limsim_jax.types import Config, Status

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
separations = jax.vmap(jax.vmap(box_separation, (None, 0)), (0, None))


@functools.cache
def runner(name: str, traffic: Traffic, decisions: int):
    """A jitted run of one world that records what tests look at."""
    _, lane_map = bundled(name)

    @jax.jit
    def run(state):
        def record(tick):
            box = boxes(lane_map, tick.state)
            n = box.shape[0]
            both = tick.state.active[:, None] & tick.state.active[None, :] & ~jnp.eye(n, dtype=bool)
            apart = jnp.where(both, separations(box, box), 99.0).min()
            state = tick.state
            return {
                "apart": apart, "a": state.a, "v": state.v, "d": state.d, "lane": state.lane, "s": state.s,
                "active": state.active, "side": state.side, "x": box[:, 0], "y": box[:, 1], "left": tick.left,
            }  # fmt: skip

        def decision(state, _):
            return drive(CONFIG, traffic, lane_map, state, record=record)

        state, records = jax.lax.scan(decision, state, None, length=decisions)
        return state, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), records)

    return run


def mixed(n, seed):
    """Drivers of different temper."""
    rng = np.random.default_rng(seed)
    factor = jnp.asarray(rng.uniform(0.75, 1.1, n), jnp.float32)
    return dataclasses.replace(
        drivers(n), speed_factor=factor, T=jnp.asarray(rng.uniform(0.9, 1.8, n), jnp.float32)
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_random_traffic_on_a_highway_is_sound(seed):
    n = 64
    network, lane_map = bundled("highway")
    shape = dataclasses.replace(
        shapes(n), length=jnp.asarray(np.random.default_rng(seed).uniform(4, 12, n), jnp.float32)
    )
    start = dataclasses.replace(scattered("highway", n, seed), driver=mixed(n, seed), shape=shape)
    end, trace = runner("highway", Traffic(), 400)(start)
    trace = {name: np.asarray(value) for name, value in trace.items()}
    active = trace["active"]
    assert trace["apart"].min() > 0, "bodies overlap"
    assert trace["a"].min() > -4.0, "no vehicle has to brake hard"
    assert np.isfinite(trace["v"]).all() and (trace["v"] >= 0).all()
    # no vehicle leaves the road: the centre stays within the lane, but for lane changes to a neighbour
    half = np.asarray(width(lane_map, jnp.asarray(trace["lane"]), jnp.asarray(trace["s"]))) / 2
    assert (np.abs(trace["d"])[active] <= half[active] + 0.01).all()
    # bodies move by what their speed says: none jumps
    step = np.hypot(np.diff(trace["x"], axis=0), np.diff(trace["y"], axis=0))
    both = active[1:] & active[:-1]
    assert (step[both] < trace["v"][:-1][both] * CONFIG.dt + 0.35).all()
    assert (trace["side"][active] != 0).mean() > 0.005, "some vehicles change lanes"
    assert trace["left"].sum() == n - int(end.active.sum()) > n // 2, "a vehicle leaves once"
    assert not int(np.bitwise_or.reduce(np.asarray(end.status))) & int(Status.HARD_BRAKE)
    assert network.lanes


def test_lane_ends_and_exits_are_reached_without_overlap():
    """On-ramp and off-ramp: all get through, those that could not change in time too."""
    n = 64
    start = dataclasses.replace(scattered("ramp", n, 3), driver=mixed(n, 3))
    end, trace = runner("ramp", Traffic(), 500)(start)
    assert float(trace["apart"].min()) > 0
    assert int(end.active.sum()) == 0
    assert float(trace["a"].min()) >= -8.001


def test_a_bend_ahead_is_reached_at_the_speed_that_it_allows():
    """On a free road, at 50 km/h towards the roundabout, whose entry bends with 12 m radius."""
    network, lane_map = bundled("roundabout")
    row = lane_rows(network)["1_0_-3"]
    goal = int(np.nonzero(np.asarray(lane_map.routes.reachable)[row])[0][-1])
    driver = drivers(1, a_lat=2.5, b=2.0)
    start = float(lane_map.length[row]) - 80.0
    _, trace = runner("roundabout", Traffic(), 30)(
        state_of("roundabout", [row], [start], [13.9], [goal], driver=driver)
    )
    lane, s, v = (trace[name][:, 0] for name in ("lane", "s", "v"))
    bend = jax.jit(jax.vmap(lambda lane, s: curvature(lane_map, lane, s)))(lane, s)
    lateral = np.asarray(v * v * jnp.abs(bend))
    assert (np.asarray(lane) != row).any() and lateral.max() > 2.0
    assert lateral.max() < 2.5 * 1.15
    assert float(trace["a"].min()) > -2.1


def test_a_fast_vehicle_brakes_in_time_for_a_stopped_one():
    """At 140 km/h towards a stopped vehicle: the whole braking distance is seen, so braking is not hard."""
    network, lane_map = bundled("highway")
    row = lane_rows(network)["1_0_-3"]
    goal = int(np.nonzero(np.asarray(lane_map.routes.reachable)[row])[0][0])
    driver = dataclasses.replace(drivers(2, speed_factor=1.2), v_max=jnp.asarray([0.0, 60.0], jnp.float32))
    _, trace = runner("highway", Traffic(lane_changes=False), 60)(
        state_of("highway", [row] * 2, [600.0, 50.0], [0.0, 39.0], [goal] * 2, driver=driver)
    )
    assert float(trace["v"][-1, 1]) < 0.5 and float(trace["s"][-1, 1]) > 570
    assert float(trace["a"].min()) > -4.5


def platoon(model, n=6, v=20.0):
    """Vehicles one behind the other on one lane of the highway; the first one holds them up."""
    network, lane_map = bundled("highway")
    rows = lane_rows(network)
    row = rows["1_0_-3"]
    goal = int(np.nonzero(np.asarray(lane_map.routes.reachable)[row])[0][0])
    driver = dataclasses.replace(
        drivers(n, T=1.5, b=2.0, a=1.4), v_max=jnp.asarray([v] + [60.0] * (n - 1), jnp.float32)
    )
    state = state_of(
        "highway", [row] * n, [600.0 - 40.0 * i for i in range(n)], [v] * n, [goal] * n, driver=driver
    )
    return state, Traffic(model=model, lane_changes=False)


@pytest.mark.parametrize(("model", "exact"), [(ACC(), True), (IDM(), False)])
def test_a_platoon_settles_at_the_equilibrium_gap(model, exact):
    state, traffic = platoon(model)
    _, trace = runner("highway", traffic, 160)(state)
    gap = np.asarray(trace["s"][-1, :-1] - trace["s"][-1, 1:]) - 5.0
    v = np.asarray(trace["v"][-1])
    np.testing.assert_allclose(v, 20.0, atol=0.02)
    free = np.asarray(state.driver.speed_factor * 120 / 3.6)[1:]
    expected = 2.0 + 1.5 * 20.0
    if not exact:  # IDM: (s0 + v T) / sqrt(1 - (v / v0)^4)
        expected = expected / np.sqrt(1 - (20.0 / free) ** 4)
    np.testing.assert_allclose(gap, expected, atol=0.15)


def test_worlds_without_free_egos_need_no_bicycle_model():
    """Left out, it changes nothing: not a bit."""
    _, lane_map = bundled("intersection")
    state = scattered("intersection", 12, 5, v=8.0)
    state = dataclasses.replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), [3], False))

    def run(free, state):
        step = lambda state, _: drive(CONFIG, Traffic(), lane_map, state, free=free)  # noqa: E731
        return jax.lax.scan(step, state, None, length=8)[0]

    # the older generator of fused loops rounds the two programs differently
    options = {"xla_cpu_use_fusion_emitters": True}
    ends = [jax.jit(run, static_argnums=0, compiler_options=options)(free, state) for free in (True, False)]
    for one, other in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_array_equal(one, other)
    assert float(ends[0].distance[3]) > float(state.distance[3]) + 1


def test_slots_may_be_permuted():
    n = 24
    order = np.random.default_rng(0).permutation(n)
    start = dataclasses.replace(scattered("highway", n, 5), driver=mixed(n, 5))
    shuffled = jax.tree.map(lambda x: x[order] if jnp.shape(x) == (n,) else x, start)
    run = runner("highway", Traffic(), 40)
    end, _ = run(start)
    other, _ = run(shuffled)
    for name in ("lane", "s", "v", "d", "side"):
        np.testing.assert_array_equal(getattr(end, name)[order], getattr(other, name), err_msg=name)


def test_a_world_does_not_depend_on_its_companions():
    n = 24
    _, lane_map = bundled("highway")
    states = [dataclasses.replace(scattered("highway", n, seed), driver=mixed(n, 5)) for seed in (5, 6, 7)]

    @jax.jit
    def run(state):
        step = lambda s: jax.lax.scan(  # noqa: E731
            lambda c, _: drive(CONFIG, Traffic(), lane_map, c), s, None, length=20
        )[0]
        return jax.vmap(step)(state)

    stack = lambda worlds: jax.tree.map(lambda *x: jnp.stack(x), *worlds)  # noqa: E731
    one, two = run(stack(states)), run(stack([states[0], states[0], states[0]]))
    for name in ("lane", "s", "v", "d"):
        np.testing.assert_array_equal(getattr(one, name)[0], getattr(two, name)[0], err_msg=name)


def test_gradients_are_those_of_finite_differences():
    state, traffic = platoon(ACC(), n=4)
    _, lane_map = bundled("highway")
    empty = dataclasses.replace(state, active=jnp.asarray([True, True, True, False]))

    def loss(T):
        def decision(state, _):
            return drive(CONFIG, traffic, lane_map, state)

        start = dataclasses.replace(empty, driver=dataclasses.replace(state.driver, T=T))
        end, _ = jax.lax.scan(decision, start, None, length=20)
        return jnp.sum(jnp.where(end.active, end.s, 0.0))

    T = state.driver.T
    gradient = jax.jit(jax.grad(loss))(T)
    assert np.isfinite(np.asarray(gradient)).all() and float(gradient[3]) == 0.0
    run = jax.jit(loss)
    for i in (1, 2):
        h = 0.05
        difference = (run(T.at[i].add(h)) - run(T.at[i].add(-h))) / (2 * h)
        assert float(difference) != 0
        np.testing.assert_allclose(float(gradient[i]), float(difference), rtol=0.03)


# --- the parts ----------------------------------------------------------------------------------


def test_mobil_incentive():
    values = {
        "own_now": 0.2,
        "own_then": 1.0,
        "new_now": 0.5,
        "new_then": -0.3,
        "old_now": -0.1,
        "old_then": 0.4,
    }
    arrays = {name: jnp.full(2, value) for name, value in values.items()}
    # egoist: own gain alone; altruist: + (-0.3 - 0.5) + (0.4 + 0.1)
    np.testing.assert_allclose(incentive(**arrays, politeness=jnp.array([0.0, 1.0])), [0.8, 0.5], rtol=1e-6)


@pytest.mark.parametrize("a_lead", [0.0, -2.7, 1.5])
def test_braking_for_a_leader_that_brakes_on(a_lead):
    """Step by step, both are as fast when the gap is used up; a leader that speeds up counts as steady."""
    v, v_lead, gap = (np.asarray(x) for x in ([25.0, 18.0, 9.0], [17.0, 16.0, 12.0], [20.0, 6.0, 5.0]))
    seen = (v, v_lead, np.full(3, a_lead), gap)
    need = np.asarray(closing(*(jnp.asarray(x, jnp.float32) for x in seen)), float)
    for k in range(2):
        dt, left, mine, lead = 1e-4, gap[k], v[k], v_lead[k]
        while mine > lead:
            left += dt * (lead - mine)
            mine, lead = mine - dt * need[k], lead + dt * min(a_lead, 0)
        assert left == pytest.approx(0, abs=0.01)
    assert need[2] == 0  # slower than the leader


def test_urgency_grows_towards_the_last_place_and_with_the_lanes_to_cross():
    room = jnp.asarray([1e9, 450.0, 290.0, 220.0, 0.0], jnp.float32)
    v, time = jnp.full(5, 20.0), jnp.full(5, 4.5)
    one = np.asarray(urgency(jnp.full(5, -1), room, v, time))
    two = np.asarray(urgency(jnp.full(5, 2), room, v, time))
    # way of a change v T + 12, and before the end the distance to stop from v with 1 m/s^2, per lane
    np.testing.assert_allclose(one, [0, 0, (302 - 290) / 102, (302 - 220) / 102, 1], rtol=1e-5)
    np.testing.assert_allclose(two, [0, (604 - 450) / 204, 1, 1, 1], rtol=1e-5)
    assert not np.asarray(urgency(jnp.zeros(5, int), room, v, time)).any()
    slow = urgency(jnp.full(1, 2), jnp.full(1, 90.0), jnp.full(1, 5.0), time[:1])  # 40 m before the end
    np.testing.assert_allclose(slow, (2 * 34.5 + 40 - 90) / 69, rtol=1e-5)


def test_accelerations_change_as_fast_as_pedals_move():
    """Braking of emergencies begins at once; a vehicle that enters in this step has no pedal pressed yet."""
    wish = jnp.array([1.9, -3.0, 1.9, 0.5, -6.5, -3.0])
    before = jnp.array([0.0, 1.0, -3.0, 0.2, 1.0, 0.0])
    state = state_of("highway", [0] * 6, [0.0] * 6, [9.0] * 6, [0] * 6)
    entered = jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 20.0])
    state = dataclasses.replace(state, a=before, entered=entered, step=jnp.int32(200))
    most = DRIVING.jerk * CONFIG.dt
    expected = [most, 1.0 - most, -3.0 + most, 0.5, -6.5, -3.0]
    np.testing.assert_allclose(smooth(CONFIG, state, wish), expected, atol=1e-6)


def test_lateral_motion_is_the_quintic():
    """Peaks of the quintic over time T and width w: 1.875 w / T and 5.7735 w / T^2."""
    u = jnp.linspace(0, 1, 2001)
    f = np.asarray(smooth_step(u), float)
    slope, bend = np.gradient(f, 1 / 2000), np.diff(f[::50], 2) * 40**2
    assert f[0] == 0 and f[-1] == 1 and np.diff(f).min() > -1e-6
    np.testing.assert_allclose(slope.max(), 1.875, rtol=1e-3)
    np.testing.assert_allclose(np.abs(bend).max(), 5.7735, rtol=2e-2)


def test_a_lane_change_that_the_lanes_ahead_cut_off_is_taken_back():
    """The off-ramp parts from the motorway while a vehicle is on its way over."""
    _, lane_map = bundled("ramp")
    after, right = np.asarray(lane_map.routes.next_lane), np.asarray(lane_map.right)
    cut_off = np.asarray(lane_map.may_change_right)[:, None] & (after >= 0) & (right[after] < 0)
    row, goal = np.argwhere(cut_off)[0]
    end = float(lane_map.length[row])
    state = state_of("ramp", [row], [end - 3.0], [6.0], [goal])
    state = dataclasses.replace(
        state, side=jnp.asarray([-1]), progress=jnp.asarray([0.2]), shift=jnp.asarray([3.5])
    )
    _, trace = runner("ramp", Traffic(lane_changes=False), 24)(state)
    assert int(trace["lane"][-1, 0]) == after[row, goal], "it stays on its own way"
    assert int(trace["side"][-1, 0]) == 0 and abs(float(trace["d"][-1, 0])) < 1e-3
    assert np.abs(np.diff(np.asarray(trace["d"])[:, 0])).max() < 0.2, "and glides back"


@pytest.mark.parametrize("lead", [-7.0, -1.5, 0.0, 2.0])
def test_two_vehicles_abreast_swap_lanes(lead):
    """Each needs the lane of the other: one falls back, and neither gives up its goal."""
    network, lane_map = bundled("intersection")
    rows = lane_rows(network)
    right, left = rows["6_0_-2"], rows["6_0_-1"]
    to_go = np.asarray(lane_map.routes.lanes_to_go)
    lane = [right, left]
    goal = [int(np.argmax(to_go[right] == 1)), int(np.argmax(to_go[left] == -1))]
    end, trace = runner("intersection", Traffic(), 120)(
        state_of("intersection", lane, [60.0, 60.0 + lead], [13.9, 14.4], goal)
    )
    changed = {int(x) for x in np.unique(np.asarray(trace["lane"])[:, 0])}
    assert left in changed and right in {int(x) for x in np.unique(np.asarray(trace["lane"])[:, 1])}
    assert not (np.asarray(end.status) & int(Status.MISSED_ROUTE)).any()
    assert float(trace["apart"].min()) > 0 and float(trace["a"].min()) > -3.5
    standing = (np.asarray(trace["v"]) < 0.1) & (np.asarray(trace["lane"]) == np.asarray(lane))
    assert standing.sum(0).max() < 100  # of 600 steps of 0.1 s: no patience is tried


def test_a_merging_vehicle_takes_the_pace_of_the_other_lane():
    """On an acceleration lane, abreast of a leader that is too near to cut in behind."""
    network, lane_map = bundled("ramp")
    rows = lane_rows(network)
    merging, beside = rows["2_0_-5"], rows["2_0_-4"]
    goal = int(np.argmax(np.asarray(lane_map.routes.lanes_to_go)[merging] == 1))
    free = state_of("ramp", [merging], [60.0], [22.0], [goal])
    s = 60.0 + 1.0 + float(free.shape.length[0])  # its rear is 1 m ahead
    _, alone = runner("ramp", Traffic(), 2)(free)
    end, trace = runner("ramp", Traffic(), 30)(
        state_of("ramp", [merging, beside], [60.0, s], [22.0, 10.0], [goal] * 2)
    )
    assert float(alone["a"][0, 0]) > -0.5
    a = np.asarray(trace["a"])[:, 0]
    assert a[0] < -1.5
    assert a.min() > -2.5, "as for courtesy, not harder"
    assert int(end.lane[0]) != merging and not int(end.status[0])
    assert float(trace["v"][:, 0].min()) > 5, "in motion"


def test_a_vehicle_before_a_short_wrong_lane_takes_another_goal():
    """One lane, then 4 m of two, of which the left one leads to the goal."""
    beside = {"road": "p", "successors": ("right",), "left": "p1", "may_change_left": True}
    map_ = network([
        straight("a", (0.0, 0.0), 0.0, 200.0, successors=("p0",)),
        straight("p0", (200.0, 0.0), 0.0, 4.0, **beside),
        straight("p1", (200.0, 3.5), 0.0, 4.0, road="p", number=1, successors=("left",), right="p0"),
        straight("right", (204.0, 0.0), 0.0, 50.0),
        straight("left", (204.0, 3.5), 0.0, 50.0),
    ])  # fmt: skip
    rows, lane_map = lane_rows(map_), build_lane_map(map_, goals=[["left"], ["right"]])
    s = [199.5, 180.0, 199.5, 1.0, 3.0, 3.0]
    state = state_of("ramp", [rows["a"]] * 3 + [rows["p0"]] * 3, s, [0.0] * 6, [0] * 6)
    # the last two have stopped while they change lanes; one of them has only just
    long, short = DRIVING.patience + 1, DRIVING.patience - 1
    waiting = jnp.asarray([long, long, short, long, long, short], jnp.float32)
    side = jnp.asarray([0, 0, 0, 0, 1, 1])
    after = _give_up(lane_map, dataclasses.replace(state, waiting=waiting, side=side))
    gives_up = [True, False, False, True, True, False]
    np.testing.assert_array_equal(after.goal, gives_up)
    np.testing.assert_array_equal((after.status & int(Status.MISSED_ROUTE)) > 0, gives_up)
    np.testing.assert_array_equal(after.side, [0, 0, 0, 0, 0, 1])


@pytest.mark.parametrize("opens", [0.0, 16.0, 20.0])
def test_a_vehicle_reaches_a_lane_that_opens_late(opens):
    """The lane on the left, which alone leads on, is wide enough after `opens` m of 34 m."""
    map_ = network([
        straight("a", (0.0, 0.0), 0.0, 100.0, successors=("right",)),
        straight("right", (100.0, 0.0), 0.0, 34.0, road="p", left="left", may_change_left=True),
        straight("left", (100.0, 3.5), 0.0, 34.0, road="p", number=1, successors=("out",), right="right"),
        straight("out", (134.0, 3.5), 0.0, 400.0),
    ])  # fmt: skip
    rows, lane_map = lane_rows(map_), build_lane_map(map_, goals=[["out"]])
    lane_map = dataclasses.replace(
        lane_map, start_s=jnp.asarray(lane_map.start_s).at[rows["left"]].set(opens)
    )
    state = state_of("ramp", [rows["a"]], [60.0], [8.0], [0])

    def decision(state, _):
        return drive(CONFIG, Traffic(), lane_map, state)[0], None

    end, _ = jax.jit(lambda x: jax.lax.scan(decision, x, None, length=38))(state)
    assert int(end.lane[0]) in (rows["left"], rows["out"])
    assert not int(end.status[0])
