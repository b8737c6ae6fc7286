"""Records of steps, against loops in NumPy over one vehicle and one lane at a time.

The worlds are those of `observed_worlds`. Results of other modules about bodies and lanes are taken as given.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observed_worlds import (
    CONFIG,
    STEPS,
    STORIES,
    N,
    centre,
    crossing,
    each,
    given,
    host,
    i32,
    random_tick,
    records_of,
    seen,
    stacked,
)

from limsim_jax.maps.conflicts import ConflictType
from limsim_jax.maps.lane_map import NO_LANE, LaneMap
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.metrics.observer import EvaluateEgo
from limsim_jax.metrics.record import meets_ego
from limsim_jax.metrics.safety import NO_GAP
from limsim_jax.metrics.step import EgoStep
from limsim_jax.metrics.traffic import TrafficMetrics, TrafficStep
from limsim_jax.simulation.rollout import measured_start
from limsim_jax.types import Config, Status


@pytest.mark.engine
def test_plain_columns_are_those_of_the_state():
    for i, (tick, record) in enumerate(seen()):
        state, slot = tick.state, int(tick.state.egos.slot[0])
        ego, traffic = record.ego, record.traffic
        assert ego.t == tick.time == traffic.t
        assert ego.slot == slot and ego.v == state.v[slot] and ego.a == state.a[slot]
        assert ego.moved == tick.dx[slot] and record.goal == state.goal[slot]
        assert ego.broken == (Status.NOT_FINITE in Status(int(state.status[slot])))
        assert ego.rear_axle == pytest.approx(0.5 * state.shape.wheelbase[slot])
        np.testing.assert_array_equal(ego.b_max, state.driver.b_max)
        for name in ("active", "lane", "s", "v", "entered"):
            np.testing.assert_array_equal(getattr(traffic, name), getattr(state, name))
        np.testing.assert_array_equal(traffic.dx, tick.dx)
        np.testing.assert_array_equal(traffic.v_free, tick.decision.v0)
        np.testing.assert_array_equal(traffic.left, tick.left)
        assert traffic.inside.all() and not traffic.changed.any()
        np.testing.assert_array_equal(record.way, tick.decision.lanes)
        np.testing.assert_array_equal(record.other, given()[i][3])
        assert record.stopped == state.stopped[slot] and ego.off_road == np.asarray(tick.off_road)[slot]


@pytest.mark.engine
def test_bodies_and_vehicles_on_the_same_level():
    there = 0
    for i, (tick, record) in enumerate(seen()):
        box, z, *_ = given()[i]
        state, slot = tick.state, int(tick.state.egos.slot[0])
        np.testing.assert_allclose(record.ego.box, box, atol=1e-4)
        for k in range(N):
            v = state.v[k] * np.array([np.cos(box[k, 2]), np.sin(box[k, 2])])
            np.testing.assert_allclose(record.ego.velocity[k], v, atol=1e-4)
            assert record.ego.active[k] == (state.active[k] and abs(z[k] - z[slot]) < 3.0)
            there += state.active[k] and not record.ego.active[k]
    assert there > 100


def test_vehicles_that_drive_where_others_have_priority():
    for _, state, _, _, found in each("violation"):
        for k in range(N):
            inside = state.lane[k] != NO_LANE and host().junction[state.lane[k]] >= 0
            red = Status.RED_LIGHT in Status(int(state.status[k]))
            assert found[k] == ((red and inside) or Status.WRONG_WAY in Status(int(state.status[k])))


def test_vehicles_in_several_lanes():
    for i, state, tick, _, found in each("changing"):
        for k in range(N):
            left, right = state.d[k] + state.shape.width[k] / 2, state.d[k] - state.shape.width[k] / 2
            half = given()[i][2][k] / 2
            assert found[k] == (
                state.side[k] != 0 or left > half or right < -half or np.asarray(tick.off_road)[k]
            )


def test_the_leader_has_moved_since_the_decision():
    ahead = 0
    for i, state, tick, slot, found in each("lead"):
        other, gap = (x[slot, 0] for x in tick.decision.obstacles)
        if other < 0 or not state.active[other]:
            assert found == -1 and seen()[i][1].ego.lead_gap == NO_GAP
        else:
            expected = max(gap + tick.x[other] - tick.x[slot], 0)
            assert found == other and seen()[i][1].ego.lead_gap == pytest.approx(expected, abs=1e-5)
            ahead += expected > 0
    assert ahead > 50


def test_the_road_under_the_ego():
    for i, state, _, slot, found in each("lane_heading"):
        lane, _ = centre(state, slot)
        ego = seen()[i][1].ego
        assert found == pytest.approx(given()[i][4], abs=1e-4)
        on = state.lane[slot] != NO_LANE
        assert ego.on_lane == on == ego.on_route
        assert ego.in_junction == (lane != NO_LANE and host().junction[lane] >= 0)
        if on:
            assert ego.speed_limit == host().speed_limit[state.lane[slot]]
            goal = host().routes.is_goal[state.lane[slot], state.goal[slot]]
            beyond = state.s[slot] > host().length[state.lane[slot]]
            assert ego.arrived == (goal and beyond and state.active[slot])
    assert sum(found for *_, found in each("arrived")) > 3


def entered(state, tick, slot):
    return state.active[slot] and state.previous[slot] != NO_LANE and 0 < tick.dx[slot] >= state.s[slot]


def shows(state):
    return np.asarray(lane_states(crossing().signals, jnp.asarray(state.lights.phase)))


def test_crossing_a_stop_line_on_red():
    told = []
    for _, state, tick, slot, found in each("red_light"):
        lane, onto, front = state.lane[slot], NO_LANE, state.s[slot]
        if lane == NO_LANE or not state.active[slot]:
            assert not found
            continue
        if state.previous[slot] != NO_LANE and state.s[slot] <= tick.dx[slot]:  # entered in this step
            lane, onto = state.previous[slot], lane
            front = host().length[lane] + front
        else:
            onto = host().routes.next_lane[lane, state.goal[slot]]
        line = min(host().stop_s[lane] + 0.5, host().length[lane])
        crossed = front - tick.dx[slot] <= line < front
        expected = crossed and onto != NO_LANE and shows(state)[onto] == SignalState.RED
        told.append((expected, crossed))
        assert found == expected
    assert 3 < sum(red for red, _ in told) < sum(crossed for _, crossed in told) < len(told)


def test_passing_a_stop_sign():
    passed = 0
    for _, state, tick, slot, found in each("stop_sign"):
        row = host().conflicts.connector[state.lane[slot]]
        assert found == (entered(state, tick, slot) and row >= 0 and host().conflicts.must_stop[row])
        passed += found
    assert passed > 5


def test_waiting_at_red():
    waits = []
    for _, state, _, slot, found in each("waits_at_red"):
        lane = state.lane[slot]
        following = host().routes.next_lane[lane, state.goal[slot]] if lane != NO_LANE else NO_LANE
        red = following != NO_LANE and shows(state)[following] == SignalState.RED
        near = host().stop_s[lane] - state.s[slot] < 15
        assert found == (red and near and state.v[slot] < 0.5)
        waits += [(found, red and near and state.v[slot] < 1.8, red and state.v[slot] < 0.5)]
    found, slower, further = (sum(x) for x in zip(*waits, strict=True))
    assert found > 5 and slower > found and further > found


def test_the_speed_of_the_vehicles_around_the_ego():
    several = 0
    for i, state, _, slot, found in each("v_others"):
        m, z = host(), given()[i][1]
        lane = state.lane[slot]
        near = set()
        if lane != NO_LANE:
            left, right = m.left[lane], m.right[lane]
            near = {lane, left, right, m.routes.next_lane[lane, state.goal[slot]]}
            near |= {m.left[left] if left != NO_LANE else NO_LANE}
            near |= {m.right[right] if right != NO_LANE else NO_LANE}
        speeds = [
            state.v[k]
            for k in range(N)
            if k != slot and state.active[k] and state.lane[k] in near - {NO_LANE} and abs(z[k] - z[slot]) < 3
        ]
        assert seen()[i][1].ego.others == bool(speeds)
        assert found == pytest.approx(np.mean(speeds) if speeds else 0.0, abs=1e-5)
        several += len(speeds) > 1
    assert several > 100


def parts(state, k):
    """The two lanes that a vehicle may be on, and its front bumper along each.

    The lanes behind those are long, or no connectors; for others see test_short_lanes.
    """
    before = state.previous[k]
    there = before != NO_LANE and state.s[k] < state.shape.length[k]
    tail = [(before, state.s[k] + host().length[before])] if there else []
    return [*([(state.lane[k], state.s[k])] if state.lane[k] != NO_LANE else []), *tail]


def test_conflict_zones_and_their_occupants():
    table = host().conflicts
    count = table.foe.shape[1]
    totals = np.zeros(3, int)
    for _, state, _, slot, found in each("zones"):
        lane = state.lane[slot]
        following = host().routes.next_lane[lane, state.goal[slot]] if lane != NO_LANE else NO_LANE
        expected = {}
        for at in {state.previous[slot], lane, following} - {NO_LANE}:
            row = table.connector[at]
            for c in range(count) if row >= 0 else ():
                foe = table.foe[row, c]
                if foe < 0 or table.type[row, c] == ConflictType.SWEEP:
                    continue
                front = dict(parts(state, slot)).get(at, -1.0)
                long = state.shape.length[slot]
                mine = front > table.s_in[row, c] and front - long < table.s_out[row, c]
                theirs = any(
                    on == table.lane[foe]
                    and front > table.f_in[row, c]
                    and front - state.shape.length[k] < table.f_out[row, c]
                    for k in range(N)
                    if k != slot and state.active[k]
                    for on, front in parts(state, k)
                )
                expected[row * count + c] = (mine, theirs)
        got = {int(z): (bool(e), bool(o)) for z, e, o in zip(*found, strict=True) if z >= 0}
        if len({state.previous[slot], lane, following} - {NO_LANE}) == 3:  # not twice the same
            assert got == expected
            totals += [len(got), sum(e for e, _ in got.values()), sum(o for _, o in got.values())]
        absent = found.id < 0
        assert (found.id[absent] == -1).all()
        assert not found.ego[absent].any() and not found.other[absent].any()
    assert (totals > [300, 30, 30]).all()


def with_foes(count: int) -> LaneMap:
    """The map with no more than so many conflicts of each connector."""
    table = crossing().conflicts
    names = "foe s_in s_out f_in f_out type prio tie sweep f_sweep".split()
    table = dataclasses.replace(table, **{name: getattr(table, name)[:, :count] for name in names})
    return dataclasses.replace(crossing(), conflicts=table)


def test_maps_where_paths_hardly_or_never_meet():
    record = jax.jit(lambda lane_map, tick: EvaluateEgo().record(CONFIG, lane_map, tick).ego.zones)
    never = jax.tree.map(np.asarray, record(with_foes(0), seen()[0][0]))
    assert never.id.tolist() == [-1] and not never.ego.any() and not never.other.any()
    assert never.id.shape == never.ego.shape == never.other.shape
    met = 0
    for tick, all_of_them in seen()[:60]:
        one = jax.tree.map(np.asarray, record(with_foes(1), tick))
        first = jax.tree.map(lambda x: x.reshape(3, -1)[:, 0], all_of_them.ego.zones)
        np.testing.assert_array_equal(one.id >= 0, first.id >= 0)
        np.testing.assert_array_equal(one.ego, first.ego)
        np.testing.assert_array_equal(one.other, first.other)
        met += one.ego.sum()
    assert met > 3


@pytest.mark.engine
def test_vehicles_off_the_road_are_found_where_the_engine_has_not_looked():
    record = jax.jit(lambda tick: EvaluateEgo().record(CONFIG, crossing(), tick._replace(off_road=None)))
    found = []
    for (tick, _), (*_, off) in zip(seen()[:25], given()[:25], strict=True):
        ego = record(tick).ego
        found += [bool(ego.off_road)]
        assert ego.off_road == off[tick.state.egos.slot[0]]
        assert np.asarray(ego.changing)[off].all()
    assert 0 < sum(found) < 25


# --- with a memory -----------------------------------------------------------------------------------


def test_vehicles_whose_path_may_meet_that_of_the_ego():
    rng = np.random.default_rng(4)
    table = host().conflicts
    meets = jax.jit(meets_ego)
    shares = []
    for _ in range(60):
        slot = int(rng.integers(N))
        tick = random_tick(rng, slot)
        way = np.array(tick.decision.lanes)
        other = np.where(rng.random(N) < 0.3, rng.choice(way.ravel(), N), NO_LANE)
        found = np.asarray(
            meets(crossing(), jnp.int32(slot), jnp.asarray(way), jnp.asarray(other, jnp.int32))
        )
        mine = {*way[slot], other[slot]} - {NO_LANE}
        rows = [table.connector[lane] for lane in mine if table.connector[lane] >= 0]
        foes = {table.lane[foe] for row in rows for foe in table.foe[row] if foe >= 0}
        for k in range(N):
            assert found[k] == bool(({*way[k], other[k]} - {NO_LANE}) & (mine | foes))
        shares.append(found.mean())
    assert 0.2 < np.mean(shares) < 0.95


class Recorder:
    """Keeps the steps that metrics get."""

    def __init__(self, metrics: Any = None) -> None:
        self.metrics, self.shown = metrics, []

    def init(self, *sizes: int):
        self.sizes = sizes
        return self.metrics and self.metrics.init(*sizes)

    def update(self, carry, *shown):
        steps = [x for x in shown if isinstance(x, EgoStep | TrafficStep)]
        self.shown.append(jax.tree.map(np.asarray, steps[0]))
        return self.metrics and self.metrics.update(carry, *shown)

    def result(self, carry, *area) -> Any:
        return self.metrics.result(carry, *area) if self.metrics else {"told": carry}


class Seats:
    """Remembers the places of vehicles, which is all that the traffic metrics are asked for."""

    def init(self, slots: int, _: int) -> TrafficStep:
        return self.update(None, None, stories()[0][2][0].traffic._replace(active=np.zeros(slots, bool)))

    def update(self, _, __, step: TrafficStep) -> TrafficStep:
        return step


class Watched(EvaluateEgo):
    pair: Any = None

    def watch(self, ego, traffic):
        object.__setattr__(self, "pair", (ego, traffic))
        return self

    def _metrics(self, config):
        return self.pair


@functools.cache
def stories():
    """Steps of one ego in a row: it stays, goes on, changes lanes, gets lost, and another takes its slot."""
    rng = np.random.default_rng(11)
    told = []
    for _ in range(STORIES):
        m, slot = host(), int(rng.integers(N))
        lane, ticks = None, []
        ends = np.nonzero(m.routes.is_goal.any(1))[0]
        lane = int(rng.choice(ends)) if rng.random() < 0.5 else None
        for _ in range(STEPS):
            tick = random_tick(rng, slot, lane)
            state = tick.state
            at = int(state.lane[slot])
            if ticks:
                # most keep their goal and lane
                goal = np.where(rng.random(N) < 0.8, ticks[-1].state.goal, state.goal)
                lanes = np.where(rng.random(N) < 0.6, ticks[-1].state.lane, state.lane)
                lanes[slot] = at
                state = dataclasses.replace(state, goal=i32(goal), lane=i32(lanes))
                tick = tick._replace(state=state)
            ticks.append(tick)
            if at != NO_LANE:
                following = int(m.routes.next_lane[at, int(state.goal[slot])])
                goes_on = following if following != NO_LANE else at
                lane = [at, at, goes_on, None][rng.integers(4)]
        told.append((slot, ticks, records_of(ticks)))
    return told


def play(slot, ticks, records, metrics):
    """What the metrics got: at the start, and over two decisions of the rest."""
    ego, traffic = Recorder(), Recorder(metrics)
    watch = Watched().watch(ego, traffic)
    with jax.disable_jit():
        carry = measured_start(watch, CONFIG, crossing(), jax.tree.map(jnp.asarray, ticks[0].state))
        carries = [carry]
        half = len(records) // 2
        for part in (records[:half], records[half:]):
            together = jax.tree.map(jnp.asarray, stacked(part))
            carry = watch.update(CONFIG, crossing(), carry, together)
            carries.append(carry)
    return carries, ego, traffic


@pytest.mark.engine
def test_progress_arrival_and_signs_over_time():
    m = host()
    totals = dict.fromkeys(("arrived", "left", "lost", "signs", "pardoned", "changed", "new goal"), 0)
    for slot, ticks, records in stories():
        carries, ego, traffic = play(slot, ticks, records, Seats())
        start = ticks[0].state
        goal = start.goal[slot]
        was, stopped, to_go = start.lane[slot], False, 0.0
        half = len(records) // 2
        before: Any = None
        record: Any = None
        assert len(ego.shown) == len(records) + 1
        for t, step in enumerate(ego.shown):
            flow = traffic.shown[t]
            if t == 0:  # the start: no vehicle has moved or left
                state, left, dx = start, np.zeros(N, bool), np.zeros(N)
                assert step.t == 0 and not step.red_light and not step.off_road and not flow.left.any()
                assert not step.stop_sign and step.lead == -1 and step.lead_gap == NO_GAP
                np.testing.assert_array_equal(step.relevant, True)
            else:
                tick, record = ticks[t - 1], records[t - 1]
                state, left, dx = tick.state, tick.left, tick.dx
            lane, s = state.lane[slot], state.s[slot]
            on_route = bool(m.routes.reachable[lane, goal]) if lane != NO_LANE else False
            at_goal = state.goal[slot] == goal or (was != NO_LANE and m.routes.is_goal[was, goal])
            leaves = bool(left[slot] and at_goal)
            passed = lane != NO_LANE and s > m.length[lane] and state.active[slot]
            passed = passed and m.routes.is_goal[lane, state.goal[slot]]
            reached = bool(passed and m.routes.is_goal[lane, goal])
            if on_route:
                to_go = m.routes.distance[lane, goal] - s
            if leaves or reached:
                to_go = 0.0
            assert step.on_route == on_route and step.arrived == (leaves or reached)
            assert step.to_go == pytest.approx(to_go, rel=1e-5, abs=1e-4)
            if t:
                assert step.stop_sign == (record.ego.stop_sign and not stopped)
                totals["signs"] += bool(step.stop_sign)
                totals["pardoned"] += bool(record.ego.stop_sign and stopped)
            stopped = bool(state.stopped[slot]) or (stopped and lane == was)
            for k in range(N) if t else ():
                both = state.active[k] and before.active[k] and state.lane[k] != before.lane[k]
                assert flow.changed[k] == (both and state.s[k] > dx[k])
                totals["changed"] += bool(flow.changed[k])
            totals["arrived"] += reached
            totals["left"] += leaves
            totals["lost"] += lane == NO_LANE
            totals["new goal"] += bool(passed and not reached)
            if lane != NO_LANE:
                was = lane
            before = state
            index = {0: 0, half: 1, len(records): 2}.get(t)
            if index is not None:
                found = carries[index].ego
                assert found.goal == goal and found.lane == was and bool(found.stopped) == stopped
                assert found.to_go == pytest.approx(to_go, rel=1e-5, abs=1e-4)
        for number, begin in ((1, 1), (2, half + 1)):
            first = records[begin - 1]
            end = half if number == 1 else len(records)
            other = np.max([record.other for record in records[begin - 1 : end]], 0)
            expected = meets_ego(
                crossing(), jnp.int32(slot), jnp.asarray(first.way), jnp.asarray(other, jnp.int32)
            )
            for t in range(begin, end + 1):
                np.testing.assert_array_equal(ego.shown[t].relevant, expected)
    assert min(totals.values()) > 0, totals


@pytest.mark.engine
def test_metrics_get_the_time_step_and_the_number_of_slots():
    slot, ticks, records = stories()[0]
    _, ego, traffic = play(slot, ticks, records, Seats())
    assert ego.sizes == (N, records[0].ego.zones.id.size) and traffic.sizes == (N, 0)
    metrics = EvaluateEgo()._metrics(Config(dt=0.05))
    assert [one.dt for one in metrics] == [0.05, 0.05]


@pytest.mark.engine
def test_density_is_over_the_length_of_all_lanes():
    slot, ticks, records = stories()[0]
    carries, _, traffic = play(slot, ticks, records, TrafficMetrics(CONFIG.dt))
    found = Watched().watch(Recorder(), traffic).result(CONFIG, crossing(), carries[-1])
    total = sum(float(x) for x, valid in zip(host().length, host().valid, strict=True) if valid)
    given = traffic.result(carries[-1].traffic, jnp.float32(total))
    assert set(found) == {"told"} | {f"traffic_{name}" for name in given}
    assert float(found["traffic_density_per_km"].value) > 0
    for name, value in given.items():
        assert float(found[f"traffic_{name}"].value) == pytest.approx(float(value.value), rel=1e-5), name
