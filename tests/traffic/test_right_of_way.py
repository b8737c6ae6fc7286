"""Right of way: lights, signs, priority, gaps."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit
from synthetic import arc, curve, intersection, network, straight
from traffic_worlds import bundled, drivers, shapes, state_of

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, lane_rows
from limsim_jax.maps.network import Control
from limsim_jax.maps.rasterise import build_lane_map
from limsim_jax.maps.routing import default_goals
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states, phase_at
from limsim_jax.simulation.rollout import Rollout, world_key
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.demand import Flow, build_demand, sample_scenario
from limsim_jax.traffic.engine import Traffic, decide, drive
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.neighbors import Pair, look_ahead
from limsim_jax.traffic.right_of_way import Approaches, approaches_ahead, passage, travel_time
from limsim_jax.traffic.right_of_way.stops import keeps_clear, stop_signs, stops_at_lights
from limsim_jax.traffic.signals import DETECTOR, GAP, crosses_on_red, switch
from limsim_jax.traffic.state import start_state
from limsim_jax.traffic.vehicles import default_population
from limsim_jax.types import Config, Lights, Status

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)


def test_travel_time_is_that_of_the_motion():
    rng = np.random.default_rng(0)
    for _ in range(20):
        distance, v, more, a = rng.uniform([0.1, 0, 0.1, 0.3], [80, 20, 10, 3])
        v_end = v + more
        arrives: Any = lambda t, y: y[0] - distance  # noqa: B023, E731
        arrives.terminal = True
        motion = solve_ivp(
            lambda t, y: [y[1], a if y[1] < v_end else 0.0],  # noqa: B023
            (0, 500), [0, v], events=arrives, max_step=0.02,
        )  # fmt: skip
        found = float(travel_time(*(jnp.float32(x) for x in (distance, v, v_end, a))))
        assert found == pytest.approx(motion.t[-1], rel=5e-3, abs=0.02)
    assert float(travel_time(jnp.float32(-3), jnp.float32(5), jnp.float32(5), jnp.float32(1))) == 0


def random_vehicles(n, seed):
    """Vehicles in all situations: before, in, behind the conflict area, waiting, yielding, under lights."""
    rng = np.random.default_rng(seed)
    v = rng.choice([0.0, 0.5, 4.0, 12.0], n) * rng.uniform(0.5, 1, n)
    slow = rng.uniform(3, 14, n)
    values = {
        "front": rng.uniform(-40, 25, n), "length": rng.uniform(3, 12, n), "v": v, "turn_speed": slow,
        "top_speed": np.maximum(v, slow), "a": rng.uniform(0.8, 2.5, n), "brake": v * v / 8,
        "waiting": rng.choice([0.0, 2.0, 10.0, 40.0], n), "line": rng.uniform(-20, 40, n),
        "blocked": rng.integers(0, 2, n) * 1.0, "yielding": rng.integers(0, 2, n) * 1.0,
        "slowing": rng.integers(0, 2, n) * 1.0, "starts": rng.integers(0, 2, n) * 1.0,
        "light": rng.choice([-1.0, 0.0, 1.0, 2.0], n), "slot": np.arange(n) * 1.0 + 1000 * seed,
        "soonest": rng.uniform(0, 8, n),
    }  # fmt: skip
    return passage.Observed(**{name: jnp.asarray(x, jnp.float32) for name, x in values.items()})


@pytest.mark.parametrize("merges", [False, True])
def test_of_two_vehicles_exactly_one_goes_first(merges):
    n = 20000
    rng = np.random.default_rng(7)
    me, foe = random_vehicles(n, 1), random_vehicles(n, 2)
    start, length = rng.uniform(0, 15, (2, n)), rng.uniform(1, 12, (2, n))
    mine, theirs = (
        passage.Stretch(jnp.asarray(start[i], jnp.float32), jnp.asarray(start[i] + length[i], jnp.float32))
        for i in range(2)
    )
    gap = jnp.asarray(rng.uniform(0.5, 2, (2, n)), jnp.float32)
    prio, tie = (jnp.asarray(rng.integers(-1, 2, n), jnp.int32) for _ in range(2))
    kind, stops = jnp.full(n, merges), jnp.asarray(rng.random(n) < 0.5)
    one = passage.compare(me, mine, gap[0], foe, theirs, gap[1], prio, tie, kind, stops)
    other = passage.compare(foe, theirs, gap[1], me, mine, gap[0], -prio, -tie, kind, stops)
    free = jnp.zeros(n, bool)
    a, b = (jnp.asarray(rng.random(n) < 0.3) for _ in range(2))
    later, sooner = (jnp.asarray(rng.choice([0.0, 3.0, 1e3], n), jnp.float32) for _ in range(2))
    for x, y, delay in ((free, free, None), (a, b, None), (a, b, (later, sooner))):
        first = passage.goes_first(one, (x, y), delay)
        second = passage.goes_first(other, (y, x), delay and (delay[1], delay[0]))
        np.testing.assert_array_equal(np.asarray(first), ~np.asarray(second))
    one = passage.goes_first(one, (free, free))
    assert 0.3 < np.asarray(one).mean() < 0.7
    # a vehicle inside the conflict area goes before one outside
    on, off = (
        np.asarray(mine.start - me.front) <= -0.5,
        np.asarray(theirs.start - foe.front) > np.asarray(foe.brake),
    )
    assert np.asarray(one)[on & off].all() and (on & off).sum() > 100


def meeting(me, foe, *, prio=1, **same):
    """Two vehicles before a crossing of their paths; whether the first goes first."""
    usual = {
        "front": 0.0, "length": 4.5, "v": 0.0, "top_speed": 10.0, "turn_speed": 10.0, "a": 1.5, "brake": 0.0,
        "waiting": 0.0, "line": 0.5, "blocked": 0.0, "yielding": 0.0, "slowing": 0.0, "starts": 0.0,
        "light": 0.0,
        "soonest": 0.0,
    }  # fmt: skip
    both = [
        passage.Observed(**{k: jnp.float32(x) for k, x in (usual | own | {"slot": k}).items()})
        for k, own in enumerate((me, foe))
    ]
    both = [x._replace(brake=x.v * x.v / 8) for x in both]
    way = passage.Stretch(jnp.float32(8.0), jnp.float32(16.0))
    encounter = passage.compare(
        both[0], way, jnp.float32(1.5), both[1], way, jnp.float32(1.5), jnp.int32(prio), jnp.int32(0),
        jnp.bool_(False), jnp.bool_(False),
    )  # fmt: skip

    def first(obstructing=(False, False), delay=None):
        delay = None if delay is None else (jnp.float32(delay[0]), jnp.float32(delay[1]))
        return bool(
            passage.goes_first(encounter, (jnp.bool_(obstructing[0]), jnp.bool_(obstructing[1])), delay)
        )

    return first


def test_a_stopped_vehicle_with_priority_is_passed_only_by_vehicles_gone_before_it_can_start():
    """A vehicle that yields to some must not wait for others that could only come later."""
    stands = {"yielding": 1.0, "waiting": 30.0}
    far, near = {"front": -60.0, "v": 12.0, "top_speed": 12.0, "turn_speed": 12.0}, {"front": -2.0, "v": 7.0}
    # without delay it goes before all that can still stop, though it yields at the moment
    assert meeting(stands, far)() and meeting(stands, near)(delay=(0.0, 0.0))
    # delayed by 3 s: the near vehicle is gone by then, the far one is not
    assert not meeting(stands, near)(delay=(3.0, 0.0)) and meeting(stands, far)(delay=(3.0, 0.0))
    # delayed by a stopped vehicle, for an unknown time: all vehicles that do not yield may pass
    assert not meeting(stands, far)(delay=(1e3, 0.0))
    assert meeting(stands, near | {"yielding": 1.0, "v": 0.0})(delay=(1e3, 0.0))


def test_a_vehicle_stopped_on_a_crossing_goes_before_vehicles_that_can_wait():
    inside, comes = {"line": -5.0, "yielding": 1.0}, {"front": -25.0, "v": 9.0}
    assert not meeting(inside, comes, prio=-1)() and meeting(inside, comes, prio=-1)(
        obstructing=(True, False)
    )
    assert not meeting(inside, comes, prio=-1)(obstructing=(True, True))
    # but not before a vehicle that can no longer stop, or only in haste
    assert not meeting(inside, comes | {"front": 4.0, "v": 4.0}, prio=-1)(obstructing=(True, False))
    assert not meeting(inside, comes | {"front": 7.0}, prio=-1)(obstructing=(True, False))


def test_a_vehicle_that_pulls_out_does_not_stop_again_for_one_that_can_wait():
    """Else two at their lines side by side would start and stop by turns."""
    starts, stands = {"front": 6.5, "v": 0.4, "starts": 1.0}, {"front": 6.6}
    assert meeting(starts, stands, prio=-1)() and not meeting(stands, starts)()
    # but for one that comes and cannot stop, and where it is not at the conflict area yet
    assert not meeting(starts, {"front": 4.0, "v": 8.0, "turn_speed": 8.0}, prio=-1)()
    assert not meeting(starts | {"front": 5.5}, stands, prio=-1)()
    assert not meeting(starts | {"starts": 0.0}, stands, prio=-1)()


def clear_rows(n, line, start, goes_on, connector):
    """Approaches `[n, R]` with the same rows for all vehicles."""
    tile = lambda x, dtype: jnp.tile(jnp.asarray(x, dtype), (n, 1))  # noqa: E731
    return Approaches(
        connector=tile(connector, jnp.int32), lane=tile([0] * len(line), jnp.int32),
        x=-tile(start, jnp.float32), line=tile(line, jnp.float32), soonest=tile([0] * len(line), jnp.float32),
        goes_on=tile(goes_on, bool),
    )  # fmt: skip


def test_vehicles_keep_a_junction_clear_that_they_could_not_leave():
    """Two junctions, the first with two connectors; paths cross until 6 m into its second one.

    With a car of 4.5 m the front has to stop at 25 + 6 + 4.5 = 35.5 m or further on.
    """
    _, lane_map = bundled("intersection")
    cross = jnp.zeros_like(lane_map.conflicts.cross_s).at[1].set(6.0).at[2].set(9.0)
    lane_map = dataclasses.replace(lane_map, conflicts=dataclasses.replace(lane_map.conflicts, cross_s=cross))
    none = NO_GAP
    rows = clear_rows(4, [10.0, 10.0, 35.0], [11.0, 25.0, 36.0], [False, True, False], [0, 1, 2])
    stop = jnp.array([
        [none, none, 34.5],  # has to stop for the second junction
        [none, none, 35.6],  # there would be room
        [none, none, none],  # behind the first vehicle, which leaves it 30 + 34.5 - 2 m
        [none, none, none],  # behind the third, which leaves it 62.5 - 28 - 2 m
    ])  # fmt: skip
    n = 4
    state = dataclasses.replace(
        state_of("highway", [0] * n, [0.0] * n, [8.0] * n, [0] * n), shape=shapes(n, 4.5)
    )
    own = Pair(
        lead=jnp.array([-1, -1, 0, 2], jnp.int32), lead_gap=jnp.array([none, none, 30.0, -28.0]),
        lag=jnp.full(n, -1), lag_gap=jnp.full(n, none),
    )  # fmt: skip
    brake = jnp.full((n, 3), 5.0)
    found, waits = keeps_clear(lane_map, state, rows, own, brake, stop)
    np.testing.assert_array_equal(waits, [[False, True, False]] + [[False] * 3] * 2 + [[False, True, False]])
    np.testing.assert_allclose(found[:, 1], [9.5, none, none, 9.5])
    # one that cannot stop before it any more goes on
    assert not keeps_clear(lane_map, state, rows, own, brake * 3, stop)[1].any()


def test_circulating_traffic_does_not_brake_hard_for_vehicles_that_are_gone_in_time():
    """A ring whose lanes pass exits and entries: a vehicle enters 30 m ahead, in a gap of 4 s."""
    network, lane_map = bundled("roundabout")
    rows = lane_rows(network)
    routes = lane_map.routes
    lane, then = [rows["8_0_-1"], rows["104_0_-1"]], [rows["101_0_-1"], rows["5_0_-1"]]
    goal = [int(jnp.argmax(routes.next_lane[one] == two)) for one, two in zip(lane, then, strict=True)]
    state = state_of("roundabout", lane, [3.1, 3.8], [7.2, 6.2], goal)

    def decision(state, _):
        return drive(CONFIG, Traffic(), lane_map, state, record=lambda tick: (tick.state.a, tick.state.lane))

    a, where = jax.jit(lambda state: jax.lax.scan(decision, state, None, length=14))(state)[1]
    assert (np.asarray(where[..., 0]) == rows["5_0_-1"]).any(), "they meet"
    assert float(a.min()) > -2.5


def rows_of(line, n):
    one = lambda x, dtype: jnp.asarray(np.stack([x, np.full(n, -1)], -1), dtype)  # noqa: E731
    zero = np.zeros(n)
    return Approaches(
        one(zero, jnp.int32), one(zero, jnp.int32), one(-line - 1, jnp.float32), one(line, jnp.float32),
        one(zero, jnp.float32), jnp.zeros((n, 2), bool),
    )  # fmt: skip


def test_yellow_is_a_dilemma_that_the_braking_decides():
    """Vehicles stop at yellow if 3 m/s^2 were enough when it began; others drive on."""
    n = 300
    rng = np.random.default_rng(0)
    v, line, since = rng.uniform(3, 16, n), rng.uniform(1, 60, n), rng.uniform(0, 3, n)
    state = state_of("highway", [0] * n, [0.0] * n, v, [0] * n)
    rows = rows_of(line, n)
    speed = jnp.full((n, 2), 20.0)  # straight on

    shown = jnp.asarray(np.stack([since, since], -1), jnp.float32)

    def stops(light, state=state):
        where, _ = stops_at_lights(state, rows, speed, jnp.full(4, int(light)), shown)
        return np.asarray(where)[:, 0] < 1e5

    then = line + v * since
    late = 2 * then > 2.5 * (v + 20)
    could = v * v / (2 * then) <= np.where(late, 4.5, 3.0)
    needed = v * v / (2 * line)
    # a vehicle that has come near without braking for the light drives on
    np.testing.assert_array_equal(stops(SignalState.YELLOW), could & (needed <= 5.0))
    assert (could & (needed > 5.0)).any()
    np.testing.assert_array_equal(stops(SignalState.RED), needed <= 0.9 * 8)
    assert not stops(SignalState.GREEN_MAJOR).any() and not stops(SignalState.OFF).any()
    assert stops(SignalState.RED_YELLOW)[v < 4].any()
    # a braking vehicle was faster: what it could do then counts; it goes on braking while its b is enough
    b = rng.uniform(2, 8, n).astype(np.float32)
    driver = dataclasses.replace(state.driver, b=jnp.asarray(b))
    braking = dataclasses.replace(state, a=jnp.full(n, -1.5), driver=driver)
    v_then = v + 1.5 * since
    then = line + (v + v_then) / 2 * since
    late = 2 * then > 2.5 * (v_then + 20)
    could = (v_then**2 / (2 * then) <= np.where(late, 4.5, 3.0)) & (needed <= 5.0)
    np.testing.assert_array_equal(stops(SignalState.YELLOW, braking), could | (needed <= b))
    assert (could & (needed > b)).any() and (~could & (needed <= b)).any()
    # a vehicle that clears the junction goes before those with green from the side, but only at red
    inside = rows._replace(line=jnp.full((n, 2), -3.0))
    for light, priority in ((SignalState.YELLOW, 0), (SignalState.RED, 2)):
        _, major = stops_at_lights(state, inside, speed, jnp.full(4, int(light)), shown)
        assert (np.asarray(major) == priority).all()


def test_a_light_counts_for_all_connectors_of_a_movement():
    """Three connectors: two of one junction, the first with a light, and one of the next junction."""
    state = state_of("highway", [0, 0], [0.0, 0.0], [0.0, 0.0], [0, 0])
    lights = jnp.array([SignalState.RED, SignalState.OFF, SignalState.GREEN_MINOR], jnp.int32)
    rows = Approaches(
        connector=jnp.zeros((2, 3), jnp.int32), lane=jnp.array([[0, 1, 1], [2, 1, 1]]),
        x=jnp.tile(jnp.array([-1.5, -9.0, -30.0]), (2, 1)),
        line=jnp.tile(jnp.array([1.5, 1.5, 25.0]), (2, 1)),
        soonest=jnp.zeros((2, 3)), goes_on=jnp.tile(jnp.array([False, True, False]), (2, 1)),
    )  # fmt: skip
    where, major = stops_at_lights(state, rows, jnp.full((2, 3), 8.0), lights, jnp.zeros((2, 3)))
    np.testing.assert_array_equal(np.asarray(where) < NO_GAP, [[True, True, False], [False, False, False]])
    np.testing.assert_array_equal(major, [[0, 0, 0], [-1, -1, 0]])


def test_traffic_waits_further_back_where_its_line_lies_over_a_path():
    """A vehicle that has passed that place waits at the line."""
    _, lane_map = bundled("intersection")
    lane, goal = straight_on(lane_map)[0]
    line = float(lane_map.stop_s[lane])
    lane_map = dataclasses.replace(lane_map, stand_back=lane_map.stand_back.at[lane].set(8.0))
    for before, expected in ((30.0, 22.0), (8.5, 0.5), (7.0, 7.0), (2.0, 2.0)):
        state = state_of("intersection", [lane], [line - before], [3.0], [goal])
        found = approaches_ahead(CONFIG, lane_map, state, look_ahead(CONFIG, lane_map, state))
        assert float(found.line[0, 0]) == pytest.approx(expected, abs=1e-3)


def test_a_vehicle_that_stops_at_yellow_goes_on_stopping():
    """Braking evenly, however fast it was, however slow it has become, and late in a long yellow."""
    v, line = (x.ravel() for x in np.meshgrid(np.linspace(5, 30, 26), np.linspace(5, 160, 32)))
    brake = v * v / (2 * line)
    v, line, brake = (x[brake <= 3.0] for x in (v, line, brake))
    n, speed = len(v), jnp.full((len(v), 2), 29.0)
    for share in (0.0, 0.2, 0.5, 0.8, 0.95):
        since = share * v / brake
        state = state_of("highway", [0] * n, [0.0] * n, v - brake * since, [0] * n)
        state = dataclasses.replace(state, a=jnp.asarray(-brake if share else 0 * v, jnp.float32))
        left = line - v * since + brake * since**2 / 2
        shown = jnp.asarray(np.stack([since, since], -1), jnp.float32)
        yellow = jnp.full(4, int(SignalState.YELLOW))
        where, _ = stops_at_lights(state, rows_of(left + 1e-3, n), speed, yellow, shown)
        assert (np.asarray(where)[:, 0] < 1e5).all(), share


def approaches(turn, foe):
    """Two connectors of one junction, each behind 40 m of lane that leads straight into it."""
    lanes = []
    for lane in (turn, foe):
        at, heading = lane.pose(np.zeros(1))[:2]
        before = at[0, :2] - 40.0 * np.array([np.cos(heading[0]), np.sin(heading[0])])
        after = (lane.id,)
        lanes += [straight("to_" + lane.id, before, float(heading[0]), 40.0, successors=after), lane]
    return network(lanes)


def obstacles_of(net, places, length):
    """The obstacles of vehicles at (lane, s, v), in their order, `[N, K]`: slots and gaps."""
    lane_map, row = build_lane_map(net), lane_rows(net)
    lane, s, v = zip(*places, strict=True)
    lane = np.array([row[name] for name in lane])
    state = start_state(
        lane_map, drivers(len(lane)), shapes(len(lane), length), lane=jnp.asarray(lane), s=jnp.asarray(s),
        v=jnp.asarray(v), goal=jnp.argmax(lane_map.routes.reachable[lane], -1),
    )  # fmt: skip
    return jax.jit(functools.partial(decide, CONFIG, Traffic()))(lane_map, state, Command())[1].obstacles


def test_only_long_vehicles_wait_for_each_other_where_turns_pass_back_to_back():
    one, two = (
        arc(name, (x, 0.0), 9.0, at - 0.9, 1.8, junction="J")
        for name, x, at in (("l", 0, 0), ("r", 21.4, np.pi))
    )
    net = approaches(one, two)
    for length, waits in ((4.5, 0), (6.8, 0), (7.4, 1), (11.0, 1)):  # sqrt(1.4 m * 4 * 9 m) = 7.1 m
        gap = obstacles_of(net, [("to_l", 37.0, 4.0), ("to_r", 36.0, 4.0)], length).gap
        assert int((np.asarray(gap)[:, 3] < 1e5).sum()) == waits, length


def test_a_queue_on_a_merge_does_not_hide_vehicles_behind_it():
    into = {"junction": "J", "successors": ("out",)}
    lanes = [
        straight("a", (-160, 0), 0.0, 40.0, successors=("main",)),
        straight("b", (-159, -9), 0.0, 40.0, successors=("ramp",)),
        straight("main", (-120, 0), 0.0, 120.0, road="m", **into),
        curve("ramp", (-119, -9), 0.0, (0, 0), 0.0, road="r", **into),
        straight("out", (0, 0), 0.0, 99.0),
    ]
    net = network(lanes)
    table = build_lane_map(net).conflicts
    k = int(table.connector[lane_rows(net)["ramp"]])
    s_in, s_out, f_in, f_out = (float(x[k, 0]) for x in (table.s_in, table.s_out, table.f_in, table.f_out))
    assert f_out - f_in > 30
    ahead = [("main", f_in + 6.5 + 6.5 * i, 4.0) for i in range(4)]
    for last, waits in ((("main", f_in - 3.0, 7.0), True), (("out", 60.0, 7.0), False)):
        found = obstacles_of(net, [("ramp", s_in - 0.3, 0.0), last, *ahead], 4.5)
        assert (float(found.gap[0, 3]) < 5) == waits
    # and the one that it follows is the last of them
    assert int(found.other[0, 2]) == 2
    assert float(found.gap[0, 2]) == pytest.approx(s_out - s_in + 0.3 - (f_out - f_in) + 2.0, abs=0.01)


def test_a_vehicle_held_inside_a_junction_is_not_taken_to_clear_it():
    """`a` would cross behind `b`, which has to wait for `c`, which stands further on in its way."""
    lanes = []
    for name, start, heading in (("a", (0, -20), 90.0), ("b", (-20, 0), 0.0), ("c", (12, -20), 90.0)):
        h = np.deg2rad(heading)
        before = np.array(start) - 40.0 * np.array([np.cos(h), np.sin(h)])
        lanes += [straight("to_" + name, before, h, 40.0, successors=(name,))]
        lanes += [straight(name, start, h, 60.0, road=name, junction="J")]
    net = network(lanes)
    comes = [("to_a", 39.0, 3.0), ("b", 21.5, 4.0)]
    for stands, waits in ((("c", 21.0, 0.0), True), (("c", 50.0, 0.0), False)):
        gap = np.asarray(obstacles_of(net, [*comes, stands], 4.5).gap)
        assert (gap[0, 3] < 50) == waits
        assert (gap[1, 3] < 50) == waits, "`b` itself waits for `c`"


def test_a_stop_sign_behind_another_connector_counts_for_a_vehicle_that_stands_before_it():
    """A road of 0.2 m between two junctions: vehicles stand before it, on a connector."""
    lane_map = build_lane_map(intersection())
    must_stop = jnp.zeros_like(lane_map.conflicts.must_stop).at[1].set(True)
    lane_map = dataclasses.replace(
        lane_map, conflicts=dataclasses.replace(lane_map.conflicts, must_stop=must_stop)
    )
    n = 3
    found = Approaches(
        connector=jnp.tile(jnp.array([0, 1], jnp.int32), (n, 1)), lane=jnp.zeros((n, 2), jnp.int32),
        x=jnp.array([[6.0, -0.7], [6.0, -0.7], [-20.0, -30.0]]),
        line=jnp.array([[-NO_GAP, 0.5], [-NO_GAP, 0.5], [20.0, 30.0]]), soonest=jnp.zeros((n, 2)),
        goes_on=jnp.zeros((n, 2), bool),
    )  # fmt: skip
    nothing = jnp.zeros(n, jnp.int32)
    state = start_state(
        lane_map,
        drivers(n),
        shapes(n),
        lane=nothing,
        s=jnp.zeros(n),
        v=jnp.array([0.0, 3.0, 0.0]),
        goal=nothing,
    )
    sign, stopped = stop_signs(lane_map, state, found)
    np.testing.assert_array_equal(stopped, [True, False, False])
    np.testing.assert_array_equal(sign, [[False, False], [False, True], [False, True]])


def test_a_vehicle_at_its_goal_does_not_run_into_one_that_has_just_left():
    lanes = [straight("in", (0, 0), 0.0, 50.0, successors=("left", "right"))]
    lanes += [curve(name, (50, 0), 0.0, (80, y), 0.0) for name, y in (("left", 12), ("right", -12))]
    net = network(lanes)
    for beyond, seen in ((1.0, True), (4.0, False)):
        lane_map, row = build_lane_map(net, goals=[["in"], ["right"]]), lane_rows(net)
        state = start_state(
            lane_map, drivers(2), shapes(2, 4.0), lane=jnp.asarray([row["in"], row["right"]]),
            s=jnp.asarray([35.0, 4.0 + beyond]), v=jnp.asarray([5.0, 0.0]), goal=jnp.asarray([0, 1]),
        )  # fmt: skip
        state = dataclasses.replace(state, previous=jnp.asarray([-1, row["in"]], state.previous.dtype))
        found = decide(CONFIG, Traffic(), lane_map, state, Command())[1].obstacles
        assert (int(found.other[0, 0]) == 1) == seen
        assert not seen or float(found.gap[0, 0]) == pytest.approx(16.0)


def test_fixed_programs_follow_the_clock():
    _, lane_map = bundled("intersection")
    state = state_of("intersection", [0], [5.0], [5.0], [0])
    none = jnp.full((1, 1), -1)
    for step in (0, 100, 345, 1111):
        lights = switch(CONFIG, lane_map, dataclasses.replace(state, step=jnp.int32(step)), none, 0.0 * none)
        np.testing.assert_array_equal(lights.phase, phase_at(lane_map.signals, step * 0.1))


def test_lights_know_how_long_they_have_shown_what_they_show():
    _, lane_map = bundled("intersection")
    state = state_of("intersection", [0], [5.0], [5.0], [0])
    jitted, none = jax.jit(functools.partial(switch, CONFIG, lane_map)), jnp.full((1, 1), -1)
    since, before, longest = np.zeros(state.lights.phase.shape), np.asarray(state.lights.phase), 0
    for k in range(300):
        lights = jitted(dataclasses.replace(state, step=jnp.int32(5 * k)), none, 0.0 * none)
        phase = np.asarray(lights.phase)
        since = np.where((phase != before) | (k == 0), 0, since + 0.5)
        np.testing.assert_allclose(lights.elapsed, since)
        state, before = dataclasses.replace(state, lights=lights), phase
        longest = max(longest, since[0])
    assert 10 < longest < 60, "the lights of the map"


def test_actuated_green_lasts_while_vehicles_come():
    _, lane_map = bundled("intersection")
    signals = dataclasses.replace(
        lane_map.signals,
        actuated=jnp.ones_like(lane_map.signals.actuated),
        min_duration=jnp.asarray(lane_map.signals.duration).at[0, 0].set(5.0),
        max_duration=jnp.asarray(lane_map.signals.duration).at[0, 0].set(30.0),
    )
    lane_map = dataclasses.replace(lane_map, signals=signals)
    green = np.asarray(signals.state[0, 0])[np.asarray(signals.lane_link)] >= int(SignalState.GREEN_MINOR)
    green &= np.asarray(signals.lane_program) == 0
    lane = jnp.asarray([[int(np.nonzero(green)[0][0])]])

    def length(seen_until):
        """s of the first phase with a vehicle at the detector up to then."""
        state = state_of("intersection", [0], [5.0], [5.0], [0])
        for k in range(200):
            here = jnp.full((1, 1), 10.0 if k * 0.5 <= seen_until else DETECTOR + 1)
            lights: Lights = jitted(dataclasses.replace(state, step=jnp.int32(5 * k)), lane, here)
            if int(lights.phase[0]) != 0:
                return 0.5 * k
            state = dataclasses.replace(state, lights=lights)
        raise AssertionError("the phase never ends")

    jitted = jax.jit(functools.partial(switch, CONFIG, lane_map))
    assert length(-1) == pytest.approx(5.0, abs=0.51)  # no vehicle: the least
    assert length(12.0) == pytest.approx(12.0 + GAP, abs=1.01)
    assert length(1e9) == pytest.approx(30.0, abs=0.51)  # always a vehicle: the most


@functools.cache
def without_lights() -> tuple[LaneMap, dict[str, int]]:
    """The bundled intersection with its lights out: right before left."""
    network, _ = bundled("intersection")
    movements = tuple(
        dataclasses.replace(m, control=Control.NONE, program=None, link=None) for m in network.movements
    )
    network = dataclasses.replace(network, movements=movements, programs={})
    return build_lane_map(network), lane_rows(network)


@functools.cache
def runner(lights: bool, decisions: int):
    lane_map = bundled("intersection")[1] if lights else without_lights()[0]

    @jax.jit
    def run(state):
        def record(tick):
            return tick.state.lane, tick.state.s, tick.state.v, boxes(lane_map, tick.state), tick.left

        def decision(state, _):
            return drive(CONFIG, Traffic(lane_changes=False), lane_map, state, record=record)

        end, records = jax.lax.scan(decision, state, None, length=decisions)
        return end, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), records)

    return run


def straight_on(lane_map):
    """For every goal: the lane before the junction from which it lies straight ahead, and the goal."""
    bend, connector = np.asarray(lane_map.curvature_max), np.asarray(lane_map.is_connector)
    after, before = np.asarray(lane_map.routes.next_lane), np.asarray(lane_map.predecessors)[:, 0]
    found = {}
    for lane in np.nonzero(connector)[0]:
        for goal in np.nonzero(after[before[lane]] == lane)[0]:
            if goal not in found or bend[lane] < bend[found[goal]]:
                found[int(goal)] = lane
    return [(int(before[lane]), goal) for goal, lane in found.items()]


def test_four_vehicles_that_arrive_together_all_get_across():
    """Right before left is a circle of four: one has to begin, and all are through in 20 s."""
    lane_map, _ = without_lights()
    ways = straight_on(lane_map)
    assert len(ways) == 4
    lanes, goals = zip(*ways, strict=True)
    s = [float(lane_map.length[lane]) - 30.0 for lane in lanes]
    state = state_of("intersection", lanes, s, [9.0] * 4, goals, driver=drivers(4))
    end, (lane, _, v, box, _) = runner(False, 44)(state)
    inside = np.asarray(lane_map.is_connector)[np.asarray(lane)]
    assert inside.any(0).all(), "all enter"
    gone = ~inside[-1] & inside.any(0)
    assert gone.all(), "and are through"
    assert int(np.asarray(end.status).max()) == 0
    assert np.asarray(v).min() < 6.0, "some had to slow down for the others"
    assert np.isfinite(np.asarray(box)).all()


def test_red_lights_are_obeyed_and_green_discharges_the_queue():
    """A queue before a red light waits behind the line and then leaves as car following has it."""
    _, lane_map = bundled("intersection")
    shown = np.asarray(lane_map.signals.lane_program) >= 0
    ways = [
        (lane, goal)
        for lane, goal in straight_on(lane_map)
        if shown[int(lane_map.routes.next_lane[lane, goal])]
    ]
    lane, goal = ways[0]
    length, stop = float(lane_map.length[lane]), float(lane_map.stop_s[lane])
    before = int(lane_map.predecessors[lane, 0])
    n = 8
    front = [stop - 2.0 - 7.0 * i for i in range(n)]
    rows = [lane if s > 6 else before for s in front]
    front = [s if s > 6 else s + float(lane_map.length[before]) for s in front]
    state = state_of(
        "intersection", rows, front, [0.0] * n, [goal] * n, driver=drivers(n, T=1.2, a=1.5, b=2.0)
    )
    end, (at, s, v, _, _) = runner(True, 240)(state)
    at, s, v = np.asarray(at), np.asarray(s), np.asarray(v)
    assert not (np.asarray(end.status) & 8).any(), "no vehicle runs the red light"
    crossed = np.asarray(lane_map.is_connector)[at]
    times = np.array([np.argmax(crossed[:, i]) for i in range(n)]) * 0.1
    assert crossed.any(0).all() and (np.diff(times) > 0).all()
    # algorithms: IDM with (T, a, b) = (1.2, 1.5, 2.0) discharges 1655 veh/h, the triangular bound is 1775
    headway = np.diff(times)[3:]
    headway = headway[headway < 10]
    assert 3600 / headway.mean() == pytest.approx(1700, rel=0.12)
    assert s[at == lane].max() <= length + 0.01


def test_running_a_red_light_is_told_where_the_line_stands_well_before_the_junction():
    """One vehicle cannot stop any more, one is beyond the line when the world begins, one stands on it."""
    _, lane_map = bundled("intersection")
    shown = np.asarray(lane_map.signals.lane_program) >= 0
    ways = [way for way in straight_on(lane_map) if shown[int(lane_map.routes.next_lane[way])]][:3]
    lanes, goals = zip(*ways, strict=True)
    line = np.asarray(lane_map.stop_s)[list(lanes)]
    assert (np.asarray(lane_map.length)[list(lanes)] - line > 5).all(), "otherwise this tests little"
    state = state_of("intersection", lanes, list(line + np.array([-2.0, 2.0, 0.3])), [13.0, 13.0, 0.0], goals)
    end, _ = runner(True, 10)(state)
    assert [(int(x) & int(Status.RED_LIGHT)) > 0 for x in np.asarray(end.status)[:3]] == [True, False, False]


@pytest.mark.parametrize("setback", [0.0, 0.3, 0.8, 5.75])
def test_a_red_light_is_run_once_wherever_its_line_stands(setback):
    """The vehicle drives over the line and through the junction in steps of unequal length."""
    _, lane_map = bundled("intersection")
    lit = np.asarray(lane_map.signals.lane_program) >= 0
    lane, goal = next(x for x in straight_on(lane_map) if lit[int(lane_map.routes.next_lane[x])])
    onto, length = int(lane_map.routes.next_lane[lane, goal]), float(lane_map.length[lane])
    lane_map = dataclasses.replace(lane_map, stop_s=lane_map.stop_s.at[lane].set(length - setback))
    start = state_of("intersection", [lane], [0.0], [9.0], [goal])
    steps = np.random.default_rng(3).uniform(0.05, 1.2, 60)
    for phase in range(int(lane_map.signals.num_phases[0])):
        lights = dataclasses.replace(start.lights, phase=start.lights.phase.at[0].set(phase))
        red = int(lane_states(lane_map.signals, lights.phase)[onto]) == SignalState.RED
        told = []
        for x, dx in zip(length - 15 + np.cumsum(steps), steps, strict=True):
            beyond = bool(x > length)
            state = dataclasses.replace(
                start, lights=lights, s=jnp.array([x - length if beyond else x], jnp.float32),
                lane=jnp.array([onto if beyond else lane]),
                previous=jnp.array([lane if beyond else NO_LANE]),
            )  # fmt: skip
            if crosses_on_red(lane_map, state, jnp.array([dx], jnp.float32))[0]:
                told.append(x)
        line = length - setback
        assert len(told) == red and all(line < x <= min(line + 0.5, length) + 1.2 for x in told)


def test_capacity_of_a_minor_stream_falls_with_the_major_flow_as_siegloch_has_it():
    """A queue on a minor road that never ends, across a major one: follow-up time, critical gap, capacity.

    Siegloch (1973): C = 3600 / t_f exp(-q (t_c - t_f / 2)). HCM 6th ed., ch. 20: t_c of 4 to 7 s.
    """
    priority = {0: Control.PRIORITY, 2: Control.PRIORITY, 1: Control.YIELD, 3: Control.YIELD}
    net = intersection(length=200.0, control=priority)
    goals = default_goals(net)
    lane_map = build_lane_map(net, goals)
    horizon, warm = 400.0, 100.0
    flows = [Flow(origin="in0", goal="out2", rate=1200.0), Flow(origin="in1", goal="out3", rate=1700.0)]
    demand = build_demand(
        net, lane_map, goals, flows, default_population({"car": 1.0}), horizon=horizon
    )  # fmt: skip
    minor = list(goals).index("out3")

    def crossed(_):
        return lambda tick: jnp.sum(tick.left & (tick.state.goal == minor))

    run = Rollout(CONFIG, Traffic(), horizon, record=crossed)

    def capacity(major, seed):
        idle = demand.idle.at[0].set(3600 / major - demand.headway[0])
        scenario_key, key = jax.random.split(world_key(seed))
        scenario = sample_scenario(dataclasses.replace(demand, idle=idle), lane_map, scenario_key, 64)
        result = run(lane_map, scenario, key)
        return result.trace.reshape(-1)[round(warm / CONFIG.dt) :].sum(), result.totals.collided

    q = np.array([1.0, 300.0, 600.0, 900.0])
    many = jax.jit(jax.vmap(jax.vmap(capacity, (None, 0)), (0, None)))
    found, collided = (np.asarray(x) for x in many(jnp.asarray(q, jnp.float32), jnp.arange(4)))
    found = 3600 / (horizon - warm) * found.mean(1)
    assert not collided.any() and (np.diff(found) < 0).all()
    follow_up = 3600 / found[0]
    assert 1.8 < follow_up < 3.0
    siegloch = lambda q, gap: 3600 / follow_up * np.exp(-q / 3600 * (gap - follow_up / 2))  # noqa: E731
    (gap,), _ = curve_fit(siegloch, q, found, p0=[5.0])
    assert 4.0 < gap < 7.0
    np.testing.assert_allclose(found, siegloch(q, gap), rtol=0.2)


def test_at_a_four_way_stop_every_way_gets_its_turn():
    """Queues on two roads that cross: vehicles go in turns, at the flow of real ones.

    HCM 6th ed., ch. 21: headways of 3.9 s where no other way is used, and 5.8 s on each of two roads.
    """
    net = intersection(length=200.0, control=dict.fromkeys(range(4), Control.ALL_WAY_STOP))
    goals = default_goals(net)
    lane_map = build_lane_map(net, goals)
    horizon, warm = 400.0, 100.0
    flows = [Flow(origin="in0", goal="out2", rate=1500.0), Flow(origin="in1", goal="out3", rate=1500.0)]
    demand = build_demand(net, lane_map, goals, flows, default_population({"car": 1.0}), horizon=horizon)

    def leaves(tick):
        return jnp.zeros(len(goals), int).at[tick.state.goal].add(tick.left.astype(int))

    run = Rollout(CONFIG, Traffic(), horizon, record=lambda _: leaves)

    @jax.jit
    def left(seed):
        scenario_key, key = jax.random.split(world_key(seed))
        result = run(lane_map, sample_scenario(demand, lane_map, scenario_key, 64), key)
        return result.trace.reshape(-1, len(goals))[round(warm / CONFIG.dt) :].sum(0), result.totals.collided

    found, collided = left(0)
    served = np.array([found[list(goals).index(name)] for name in ("out2", "out3")])
    assert not int(collided)
    assert served.min() > 0.7 * served.max()
    assert 900 < 3600 / (horizon - warm) * served.sum() < 1600
