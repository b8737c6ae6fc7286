"""Egos: the bicycle model, its lane, trajectories and meta-actions."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, no_arrivals, state_of

from limsim_jax.maps.lane_map import NO_LANE, pose, to_frenet, width
from limsim_jax.policies.simple import FollowLane
from limsim_jax.simulation.rollout import Rollout
from limsim_jax.simulation.trace import trace
from limsim_jax.traffic import ego
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.ego import Control, Limits, Meta, Trajectory
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.motion import advance, boxes
from limsim_jax.types import Config, Scenario, State

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
N, STEPS = 8, 120
WHEELBASE = 2.8
INSTANT = Limits(
    jerk=1e9, acceleration_lag=0.0, steering_rate=1e9, steering_lag=0.0, lateral_acceleration=1e9
)


def observe(lane_map, state: State) -> dict:
    """Both kinds of coordinates of all egos."""
    e = state.egos
    lane, s, d = state.lane[e.slot], state.s[e.slot], state.d[e.slot]
    body, body_s = body_place(lane_map, state, e.slot)
    x, y, along = pose(lane_map, body, body_s, d)
    s_back, d_back, _ = to_frenet(lane_map, body, body_s, e.x, e.y)
    return {
        "x": e.x, "y": e.y, "heading": e.heading, "steering": e.steering, "drive": e.a,
        "v": state.v[e.slot], "a": state.a[e.slot], "lane": lane, "s": s, "d": d, "body": body,
        "body_s": body_s, "side": state.side[e.slot], "travelled": state.distance[e.slot],
        "half": width(lane_map, body, body_s) / 2, "along": along,
        "apart": jnp.hypot(x - e.x, y - e.y),
        "frenet_error": jnp.maximum(jnp.abs(s_back - body_s), jnp.abs(d_back - d)),
        "arrived": ego.arrived(lane_map, state),
    }  # fmt: skip


@jax.jit
def roll(lane_map, limits, state, control):
    """All egos take `control` [T, E], one physics step each."""

    def step(state, control):
        state = ego.step_free(CONFIG, lane_map, limits, state, control)
        state = dataclasses.replace(state, step=state.step + 1)
        return state, observe(lane_map, state)

    return jax.lax.scan(step, state, control)


@jax.jit
def follow(lane_map, limits, state, trajectory):
    """All egos track their trajectory for `STEPS` steps."""

    def step(state, _):
        t = state.step.astype(jnp.float32) * CONFIG.dt
        control = ego.track(CONFIG, limits, state, trajectory, t)
        state = ego.step_free(CONFIG, lane_map, limits, state, control)
        state = dataclasses.replace(state, step=state.step + 1)
        return state, observe(lane_map, state)

    return jax.lax.scan(step, state, None, length=STEPS)


def run(f, name, *args):
    end, trace = f(bundled(name)[1], *args)
    return end, {key: np.asarray(value) for key, value in trace.items()}


def free_world(name, lane, s, v, goal=None) -> State:
    """`N` free egos on lanes, in slots in reverse order; repeats the last one where too few are given."""
    _, lane_map = bundled(name)
    fill = lambda values: [*values, *[values[-1]] * (N - len(values))]  # noqa: E731
    lane, s, v = fill(lane), fill(s), fill(v)
    reachable = np.asarray(lane_map.routes.reachable)
    goal = [int(np.nonzero(reachable[row])[0][0]) for row in lane] if goal is None else fill(goal)
    back = slice(None, None, -1)
    state = state_of(name, lane[back], s[back], np.array(v[back], float), goal[back])
    slots = list(range(N))[back]
    return dataclasses.replace(
        state, egos=ego.from_lane(lane_map, state, boxes(lane_map, state), slots, True)
    )


def controls(acceleration, steering) -> Control:
    shape = (STEPS, N)
    return Control(
        acceleration=jnp.broadcast_to(jnp.asarray(acceleration, jnp.float32), shape),
        steering=jnp.broadcast_to(jnp.asarray(steering, jnp.float32), shape),
    )


# --- the bicycle model --------------------------------------------------------------------------


def test_the_rear_axle_runs_on_a_circle_of_the_wheelbase_over_the_tangent():
    steering = np.array([0.5, -0.5, 0.3, -0.2, 0.05, 1e-3, 0.0, -0.6])
    state = free_world("roundabout", [0, 1, 2, 3, 4, 5, 6, 7], [40.0 + 5 * i for i in range(N)], [4.0])
    e = dataclasses.replace(state.egos, steering=jnp.asarray(steering, jnp.float32))
    state = dataclasses.replace(state, egos=e)
    _, trace = run(roll, "roundabout", INSTANT, state, controls(0.0, steering))
    x, y, heading = (np.asarray(v, float) for v in (e.x, e.y, e.heading))
    axle = WHEELBASE / 2
    x, y = x - axle * np.cos(heading), y - axle * np.sin(heading)
    distance = 4.0 * CONFIG.dt * np.arange(1, STEPS + 1)[:, None]
    bend = np.tan(steering) / WHEELBASE
    turned = heading + bend * distance
    radius = np.divide(1, bend, out=np.zeros(N), where=bend != 0)
    straight = bend == 0
    x = np.where(straight, x + distance * np.cos(heading), x + radius * (np.sin(turned) - np.sin(heading)))
    y = np.where(straight, y + distance * np.sin(heading), y - radius * (np.cos(turned) - np.cos(heading)))
    np.testing.assert_allclose(trace["x"] - axle * np.cos(trace["heading"]), x, atol=3e-3)
    np.testing.assert_allclose(trace["y"] - axle * np.sin(trace["heading"]), y, atol=3e-3)
    np.testing.assert_allclose(np.exp(1j * trace["heading"]), np.exp(1j * turned), atol=1e-4)
    assert np.abs(turned).max() > 2 * np.pi and np.abs(trace["heading"]).max() <= np.pi + 1e-6
    np.testing.assert_allclose(trace["travelled"], np.broadcast_to(distance, (STEPS, N)), rtol=1e-4)


@pytest.mark.parametrize("bend", [0.0, 1e-9, 0.02, -0.9, 3.0])
def test_an_arc_of_any_curvature_is_exact_and_smooth(bend):
    """Also with many turns within one step, and at curvature 0 its derivative is that of the closed form."""
    heading, distance, wheelbase = jnp.float32(0.7), jnp.float32(2.0), jnp.float32(2.8)

    def arc(bend):
        return jnp.stack(ego._arc(heading, distance, bend, wheelbase))

    def exact(bend):
        start, end, axle = 0.7, 0.7 + 2.0 * bend, 1.4
        u = np.linspace(0, 2.0, 20001)
        dx = np.trapezoid(np.cos(start + bend * u), u) + axle * (np.cos(end) - np.cos(start))
        dy = np.trapezoid(np.sin(start + bend * u), u) + axle * (np.sin(end) - np.sin(start))
        return np.array([dx, dy, end - start])

    np.testing.assert_allclose(arc(jnp.float32(bend)), exact(bend), atol=2e-6)
    slope = (exact(bend + 1e-4) - exact(bend - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.jacfwd(arc)(jnp.float32(bend)), slope, atol=2e-3)


def test_braking_takes_v_squared_over_twice_the_deceleration_and_ends_in_rest():
    v = np.array([1.0, 3.3, 5.0, 7.7, 9.0, 10.0, 0.0, 2.0])
    b = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 0.3])
    state = free_world("intersection", [0], [30.0], v)
    state = dataclasses.replace(state, egos=dataclasses.replace(state.egos, a=jnp.asarray(-b, jnp.float32)))
    _, trace = run(roll, "intersection", INSTANT, state, controls(-b, 0.1))
    np.testing.assert_allclose(trace["travelled"][-1], v * v / (2 * b), rtol=1e-4, atol=1e-5)
    assert (trace["v"] >= 0).all() and not trace["v"][-1].any() and not trace["a"][-1].any()
    assert not trace["drive"][-1].any(), "an ego that stands does not store up its braking"


def test_actuators_keep_their_limits_and_lag():
    rng = np.random.default_rng(0)
    limits = Limits(steering_lag=0.3)
    state = free_world("intersection", [0], [30.0], [3.0])
    hold = (
        np.repeat(rng.uniform(-12, 9, (STEPS // 10, N)), 10, 0),
        np.repeat(rng.uniform(-1, 1, (STEPS // 10, N)), 10, 0),
    )
    _, trace = run(roll, "intersection", limits, state, controls(*hold))
    steering, drive = (np.concatenate([np.zeros((1, N)), trace[name]]) for name in ("steering", "drive"))
    dt = CONFIG.dt
    assert np.abs(steering).max() <= 0.6 + 1e-6 and np.abs(np.diff(steering, axis=0)).max() <= 0.04 + 1e-6
    assert drive.max() <= 4.0 and drive.min() >= -8.0 and (trace["v"] >= 0).all()
    moving = trace["v"] > 0
    assert np.abs(np.diff(drive, axis=0))[moving].max() <= 40 * dt + 1e-5
    assert np.abs(np.diff(steering, axis=0)).max() > 0.039 and np.abs(np.diff(drive, axis=0)).max() > 3.9
    # far from the limits: 1 - exp(-t / lag)
    _, trace = run(roll, "intersection", limits, state, controls(0.5, 0.05))
    t = dt * np.arange(1, STEPS + 1)[:, None]
    np.testing.assert_allclose(trace["steering"], np.tile(0.05 * (1 - np.exp(-t / 0.3)), N), atol=1e-6)
    np.testing.assert_allclose(trace["drive"], np.tile(0.5 * (1 - np.exp(-t / 0.2)), N), atol=1e-6)


def test_turning_wheels_are_integrated_to_second_order():
    """Wheels that turn at a steady rate r: the heading is v / (L r) times -log cos(r t)."""
    limits = dataclasses.replace(INSTANT, steering_rate=0.4)
    state = free_world("intersection", [0], [30.0], [1.0, 2.0, 3.0, 4.0, 5.0])
    _, trace = run(roll, "intersection", limits, state, controls(0.0, 0.6))
    t = CONFIG.dt * np.arange(1, 15)[:, None]
    turned = trace["heading"][:14] - np.asarray(state.egos.heading)
    expected = trace["v"][0] / (WHEELBASE * 0.4) * -np.log(np.cos(0.4 * t))
    np.testing.assert_allclose(turned, expected, atol=4e-4)


def test_no_more_lateral_acceleration_than_the_tyres_give():
    limits = dataclasses.replace(INSTANT, lateral_acceleration=6.0)
    state = free_world("intersection", [0], [30.0], [1.0, 4.0, 8.0, 15.0, 30.0])
    _, trace = run(roll, "intersection", limits, state, controls(0.0, 0.4))
    rate = np.abs(np.angle(np.exp(1j * np.diff(trace["heading"], axis=0)))) / CONFIG.dt
    v = trace["v"][1:]
    expected = np.minimum(v * np.tan(0.4) / WHEELBASE, 6.0 / v)
    np.testing.assert_allclose(rate, expected, rtol=2e-3)
    assert (expected[0] < v[0] * np.tan(0.4) / WHEELBASE).any()


def test_gradients_by_the_control_are_those_of_finite_differences():
    """On a straight and in a bend, with the wheels straight and turned, at rest, and with an empty slot."""
    _, lane_map = bundled("roundabout")
    state = free_world(
        "roundabout", [0, 20, 1, 2, 3, 4], [40.0, 30.0, 35.0, 30.0, 30.0, 30.0], [8.0, 6.0, 7.0, 0.0]
    )
    state = dataclasses.replace(state, active=state.active.at[state.egos.slot[5]].set(False))
    limits = Limits(jerk=200.0, steering_rate=10.0)
    weights = jnp.asarray([1.0, -0.7, 0.3, 2.0, 0.5, 1.3], jnp.float32)
    base = Control(
        acceleration=jnp.full((6, N), 0.5, jnp.float32),
        steering=jnp.broadcast_to(
            jnp.asarray([0.0, 0.1, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0], jnp.float32), (6, N)
        ),
    )

    @jax.jit
    def loss(control):
        def step(state, control):
            return ego.step_free(CONFIG, lane_map, limits, state, control), None

        end, _ = jax.lax.scan(step, state, control)
        e, start = end.egos, state.egos
        parts = (
            e.x - start.x, e.y - start.y, wrap(e.heading - start.heading),
            end.s[e.slot] - state.s[e.slot], end.d[e.slot] - state.d[e.slot], end.v[e.slot],
        )  # fmt: skip
        return sum(w * p for w, p in zip(weights, parts, strict=True))  # [E]

    wrap = lambda angle: angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))  # noqa: E731
    gradient = jax.jit(jax.grad(lambda control: loss(control).sum()))(base)
    for name, h in (("acceleration", 0.2), ("steering", 0.02)):
        slope = np.asarray(getattr(gradient, name))
        assert np.isfinite(slope).all() and not slope[:, 5].any()
        for step in (0, 3):
            up, down = (
                dataclasses.replace(base, **{name: getattr(base, name).at[step].add(sign * h)})
                for sign in (1, -1)
            )
            difference = np.asarray(loss(up) - loss(down)) / (2 * h)
            moving = [0, 1, 2]
            assert np.abs(slope[step, moving]).min() > 1e-3
            np.testing.assert_allclose(slope[step, moving], difference[moving], rtol=0.02, atol=2e-3)


# --- lanes --------------------------------------------------------------------------------------


def path_of(name, lanes, start, speed, offset=lambda way: 0.0 * way, steps=STEPS + 30):
    """Points at `speed` along lanes from `start` m, at a lateral offset that depends on the way driven."""
    _, lane_map = bundled(name)
    way = speed * CONFIG.dt * np.arange(steps)
    length = np.array([float(lane_map.length[lane]) for lane in lanes])
    begin = np.cumsum(length) - length
    index = np.minimum(np.searchsorted(np.cumsum(length), way + start, side="right"), len(lanes) - 1)
    rows = jnp.asarray(np.array(lanes)[index])
    s = jnp.asarray(way + start - begin[index], jnp.float32)
    x, y, _ = (np.asarray(v, float) for v in pose(lane_map, rows, s, jnp.asarray(offset(way), jnp.float32)))
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    return x, y, heading, np.full(steps, float(speed))


def trajectory_of(*paths) -> Trajectory:
    """One path per ego; the last one also for those that have none."""
    paths = [*paths, *[paths[-1]] * (N - len(paths))]
    x, y, heading, v = (jnp.asarray(np.stack(column), jnp.float32) for column in zip(*paths, strict=True))
    return Trajectory(x=x, y=y, heading=heading, v=v, t0=jnp.float32(0))


def route(name, lane, goal, count=4):
    """Lanes from `lane` along the route."""
    after = np.asarray(bundled(name)[1].routes.next_lane)
    lanes = [lane]
    while len(lanes) < count and after[lanes[-1], goal] != NO_LANE:
        lanes.append(int(after[lanes[-1], goal]))
    return lanes


def through(name, count):
    """Rows of lanes with a goal whose route leads over `count` lanes, and the goal."""
    after = np.asarray(bundled(name)[1].routes.next_lane)
    for row, goal in np.argwhere(after[:, :] != NO_LANE):
        if len(route(name, int(row), goal, count)) == count:
            yield int(row), int(goal)


def spread(pairs, count):
    pairs = list(pairs)
    return [pairs[i] for i in np.linspace(0, len(pairs) - 1, count).astype(int)]


@pytest.mark.parametrize("name", ["roundabout", "intersection"])
def test_both_coordinates_stay_consistent_while_steering_along(name):
    # half of them where the route does not take the first of two successors
    parts, cases = np.asarray(bundled(name)[1].successors), list(through(name, 4))
    second = [
        case for case in cases if any(parts[a, 1] == b for a, b in itertools.pairwise(route(name, *case)))
    ]
    cases = [*spread(second, N // 2), *spread(cases, N // 2)]
    weave = lambda way: 0.9 * np.sin(way / 9.0)  # noqa: E731
    starts = [max(float(bundled(name)[1].length[lane]) - 25.0, 5.0) for lane, _ in cases]
    state = free_world(
        name, [lane for lane, _ in cases], [s + 2.5 for s in starts], [7.0], [goal for _, goal in cases]
    )
    paths = [
        path_of(name, route(name, *case, count=9), s, 7.0, weave)
        for case, s in zip(cases, starts, strict=True)
    ]
    _, trace = run(follow, name, Limits(), state, trajectory_of(*paths))
    inside = np.cumsum(trace["arrived"], axis=0) == 0
    assert inside.mean() > 0.5
    assert trace["apart"][inside].max() < 1e-3
    assert trace["frenet_error"][inside].max() < 1e-3
    lanes_seen = 0
    for k, (lane, goal) in enumerate(cases):
        row = [lane, *trace["lane"][inside[:, k], k]]
        seen = [row[0], *[b for a, b in itertools.pairwise(row) if a != b]]
        assert seen == route(name, lane, goal, count=9)[: len(seen)], "by its route"
        lanes_seen += len(seen) - 1
        jumps = np.diff(trace["s"][:, k])[(np.diff(trace["lane"][:, k]) == 0) & inside[1:, k]]
        assert jumps.min() > 0.4 and jumps.max() < 1.0, "the front bumper runs on smoothly"
    assert lanes_seen >= 2 * N and np.abs(trace["d"][inside]).max() > 0.7
    assert (np.abs(trace["d"]) <= trace["half"] + 1e-3)[inside].all()


def test_the_lane_follows_the_place_and_not_the_route():
    """Where two lanes part, the route leads one way and the ego drives the other."""
    _, lane_map = bundled("roundabout")
    parts = np.asarray(lane_map.successors)
    after, is_goal = np.asarray(lane_map.routes.next_lane), np.asarray(lane_map.routes.is_goal)
    cases = []
    for row in np.nonzero((parts >= 0).sum(-1) == 2)[0]:
        for taken, other in (parts[row, :2], parts[row, 1::-1]):
            goal = np.nonzero((after[row] == other) & ~is_goal[row])[0]
            if len(goal):
                cases.append((int(row), int(taken), int(other), int(goal[0])))
    cases = spread(cases, N)
    assert len({taken for _, taken, _, _ in cases}) > 4
    starts = [float(lane_map.length[row]) - 12.0 for row, *_ in cases]
    state = free_world("roundabout", [row for row, *_ in cases], np.array(starts) + 2.5, [7.0],
                       [goal for *_, goal in cases])  # fmt: skip
    paths = [
        path_of("roundabout", [row, taken, *parts[taken][parts[taken] >= 0][:1]], s, 7.0)
        for (row, taken, *_), s in zip(cases, starts, strict=True)
    ]
    _, trace = run(follow, "roundabout", Limits(), state, trajectory_of(*paths))
    for k, (_, taken, other, _) in enumerate(cases):
        seen = trace["lane"][:, k]
        assert (seen == taken).any()
        assert not (seen[np.argmax(seen == taken) :] == other).any()
        assert not (np.abs(trace["d"][:60, k]) > trace["half"][:60, k] + 0.1).any()
        assert (seen != other)[35:].all(), "3.5 s on, it is on the lane that it drives on"


def test_a_lane_change_by_steering():
    _, lane_map = bundled("intersection")
    row = int(np.nonzero((np.asarray(lane_map.left) >= 0) & (np.asarray(lane_map.length) > 80))[0][0])
    left = int(lane_map.left[row])
    move = lambda way: 3.5 * np.clip((way - 10) / 30, 0, 1)  # noqa: E731
    state = free_world("intersection", [row], [8.0], [8.0])
    paths = trajectory_of(path_of("intersection", [row], 5.5, 8.0, move))
    _, trace = run(follow, "intersection", Limits(), state, paths)
    lane, d, side = (trace[key][:80, 0] for key in ("lane", "d", "side"))
    change = int(np.argmax(lane == left))
    assert set(lane) == {row, left} and (np.diff((lane == left).astype(int)) >= 0).all()
    assert 1.4 < d[change - 1] < 1.76 and -1.76 < d[change] < -1.4
    between = sum(float(width(lane_map, lane, 40.0)) for lane in (row, left)) / 2
    np.testing.assert_allclose(d[-1], 3.5 - between, atol=0.1)
    assert trace["apart"][:80, 0].max() < 1e-3
    # seen by both lanes while the body is over the line
    body = np.abs(d) + 0.95 - trace["half"][:80, 0]
    assert (side[body > 0.4] == np.where(d > 0, 1, -1)[body > 0.4]).all() and (side[body < -0.4] == 0).all()
    assert (side == 1).any() and (side == -1).any() and side[0] == side[-1] == 0


def test_an_ego_that_crosses_a_line_at_the_end_of_the_lanes_stays_on_the_route():
    """The lanes beyond the line part there, and overlap: the body is on both, the route goes on along one."""
    _, lane_map = bundled("roundabout")
    after, parts = np.asarray(lane_map.routes.next_lane), np.asarray(lane_map.successors)
    length, is_goal = np.asarray(lane_map.length), np.asarray(lane_map.routes.is_goal)
    cases = {}
    for over, beside in ((1, np.asarray(lane_map.left)), (-1, np.asarray(lane_map.right))):
        for row in np.flatnonzero((beside >= 0) & ((parts[beside] >= 0).sum(-1) == 2)).tolist():
            x, y, _ = pose(lane_map, row, length[row] + 0.5, 2.6 * over)
            own = parts[row][parts[row] >= 0]
            s, d, _ = to_frenet(lane_map, own, np.full(len(own), 0.5), x, y)
            if (np.abs(d) < np.asarray(width(lane_map, own, s)) / 2 + 0.15).any():
                continue  # on a lane that its own leads to
            for goal in np.flatnonzero((after[row] >= 0) & (after[beside[row]] >= 0) & ~is_goal[row]):
                cases[row, over, int(after[beside[row], goal])] = int(goal)
    rows, over, onto = (list(column) for column in zip(*sorted(cases)[:N], strict=True))
    goals = [cases[case] for case in sorted(cases)[:N]]
    assert len(set(rows)) == N / 2, "from each onto two lanes, by the route alone"
    assert len(set(onto)) == N
    state = free_world("roundabout", rows, length[rows] - 0.3 + 2.5, [8.0], goals)
    x, y, heading = pose(lane_map, np.array(rows), length[rows] - 0.3, 2.6 * np.array(over))
    state = dataclasses.replace(state, egos=dataclasses.replace(state.egos, x=x, y=y, heading=heading))
    _, trace = run(roll, "roundabout", INSTANT, state, controls(0.0, 0.0))
    np.testing.assert_array_equal(trace["lane"][0], onto)


def test_off_the_road_and_back():
    _, lane_map = bundled("intersection")
    row = int(np.nonzero((np.asarray(lane_map.right) < 0) & (np.asarray(lane_map.length) > 80))[0][0])
    trip = lambda way: -8.0 * np.sin(np.clip((way - 5) / 60, 0, 1) * np.pi) ** 2  # noqa: E731
    state = free_world("intersection", [row], [8.0], [7.0])
    paths = trajectory_of(path_of("intersection", [row], 5.5, 7.0, trip))
    _, trace = run(follow, "intersection", Limits(), state, paths)
    lane, d = trace["lane"][:105, 0], trace["d"][:105, 0]
    assert d.min() < -7.0 and (lane == row).all(), "off all lanes it stays with the last one"
    np.testing.assert_allclose(d[-1], 0, atol=0.1)
    assert trace["apart"][:105, 0].max() < 1e-3


def test_an_ego_that_turns_round_is_on_the_oncoming_lane():
    _, lane_map = bundled("intersection")
    row = int(np.nonzero(np.asarray(lane_map.opposite) >= 0)[0][0])
    other = int(lane_map.opposite[row])
    state = free_world("intersection", [row], [15.0], [1.0])
    x, y, heading = pose(lane_map, other, float(lane_map.length[other]) - 12.0, 0.4)
    x_on, y_on, along = pose(lane_map, other, float(lane_map.length[other]) - 12.0, -0.3)
    e = state.egos
    e = dataclasses.replace(
        e,
        x=e.x.at[0].set(x).at[1].set(x_on),
        y=e.y.at[0].set(y).at[1].set(y_on),
        heading=e.heading.at[0].set(heading + 0.3).at[1].set(along + np.pi),
    )
    _, trace = run(roll, "intersection", INSTANT, dataclasses.replace(state, egos=e), controls(0.0, 0.0))
    assert trace["lane"][0, 0] == other
    np.testing.assert_allclose(trace["d"][0, 0], 0.4, atol=0.05)
    assert trace["lane"][0, 1] == row, "an ego that overtakes there still has its own lane"
    np.testing.assert_allclose(trace["d"][0, 1], 3.5 + 0.3, atol=0.3)


def test_driving_against_the_lane_leads_to_the_lanes_before():
    _, lane_map = bundled("intersection")
    before = np.asarray(lane_map.predecessors)[:, 0]
    plain = ~np.asarray(lane_map.is_connector) & np.asarray(lane_map.valid)
    row = int(np.nonzero(plain & (before >= 0) & plain[before])[0][0])
    state = free_world("intersection", [row], [9.0, 10.0], [6.0])
    e = state.egos
    reverse = jnp.asarray([True] + [False] * (N - 1))
    e = dataclasses.replace(e, heading=e.heading + jnp.where(reverse, jnp.pi, 0))
    _, trace = run(roll, "intersection", INSTANT, dataclasses.replace(state, egos=e), controls(0.0, 0.0))
    steps = slice(0, 40)
    lane, s, body = (trace[key][steps, 0] for key in ("lane", "s", "body"))
    assert set(body) == {row, before[row]} and body[0] == row and body[-1] == before[row]
    way = np.where(lane == row, s + float(lane_map.length[before[row]]), s)
    np.testing.assert_allclose(np.diff(way), -0.6, atol=0.02)
    assert trace["apart"][steps].max() < 1e-3


def test_beside_the_road_before_its_lane_begins():
    """Where a lane comes out of a junction, and beside all that lead to it: it goes on straight backwards."""
    _, lane_map = bundled("intersection")
    before = np.asarray(lane_map.predecessors)[:, 0]
    rows = np.nonzero((before >= 0) & np.asarray(lane_map.is_connector)[before])[0]
    rows = np.resize(rows, N)
    side = np.where(np.arange(N) < N // 2, 1.0, -1.0)
    x, y, heading = pose(lane_map, rows, jnp.full(N, -3.0), jnp.asarray(9.0 * side, jnp.float32))
    state = free_world("intersection", list(rows), [3.0], [0.5])
    state = dataclasses.replace(state, egos=dataclasses.replace(state.egos, x=x, y=y, heading=heading))
    _, trace = run(roll, "intersection", INSTANT, state, controls(0.0, 0.0))
    assert (trace["body_s"][0] < -2.0).sum() >= 2
    assert trace["apart"].max() < 1e-3


def test_an_ego_that_comes_back_somewhere_else_is_found():
    """Its lane is looked up in the whole map."""
    _, lane_map = bundled("roundabout")
    state = free_world("roundabout", [0], [40.0], [0.5])
    places = [(5, 30.0, 0.5), (9, 60.0, -0.5), (30, 6.0, 0.2), (16, 5.0, 0.0)]
    at = [pose(lane_map, lane, s, d) for lane, s, d in places]
    x, y, heading = (jnp.asarray([float(v) for v in column]) for column in zip(*at, strict=True))
    e = state.egos
    e = dataclasses.replace(
        e, x=e.x.at[:4].set(x), y=e.y.at[:4].set(y), heading=e.heading.at[:4].set(heading)
    )
    state = dataclasses.replace(state, egos=e, step=jnp.int32(1))
    _, trace = run(roll, "roundabout", INSTANT, state, controls(0.0, 0.0))
    overlapping = 30  # starts where its sibling does
    for k, (lane, s, d) in enumerate(places):
        assert trace["body"][0, k] == lane or lane == overlapping
        if lane != overlapping:
            np.testing.assert_allclose(trace["body_s"][0, k], s + 0.05, atol=0.05)
            np.testing.assert_allclose(trace["d"][0, k], d, atol=0.05)
    assert trace["apart"].max() < 1e-3
    assert (trace["lane"][:, 4:] == 0).all(), "the others are where they were"


def test_arrived_once_the_front_bumper_is_beyond_the_goal():
    _, lane_map = bundled("intersection")
    row, goal = (int(i) for i in np.argwhere(np.asarray(lane_map.routes.is_goal))[0])
    length = float(lane_map.length[row])
    state = free_world("intersection", [row], [length - 10.0], [5.0], [goal])
    _, trace = run(roll, "intersection", INSTANT, state, controls(0.0, 0.0))
    np.testing.assert_array_equal(trace["arrived"], trace["s"] > length)
    assert trace["arrived"][20:].all() and (trace["lane"] == row).all()
    np.testing.assert_allclose(trace["s"][-1], length - 10 + 60, atol=0.05)


# --- together with other traffic ----------------------------------------------------------------


def test_other_traffic_moves_as_without_egos():
    _, lane_map = bundled("roundabout")
    state = free_world(
        "roundabout", [0, 1, 2, 3, 4, 5, 6, 7], [40.0, 35.0, 30.0, 25.0, 20.0, 15.0, 12.0, 10.0], [8.0]
    )
    egos = jax.tree.map(lambda x: x[jnp.asarray([6, 1])], state.egos)  # slots 1 and 6
    egos = dataclasses.replace(egos, free=jnp.asarray([True, False]))
    state = dataclasses.replace(state, egos=egos)
    a = jnp.linspace(-2.0, 1.0, N)
    control = Control(acceleration=jnp.asarray([1.0, 9.0]), steering=jnp.asarray([0.3, 0.3]))
    alone, _, _ = advance(CONFIG, lane_map, state, a)
    free = ego.step_free(CONFIG, lane_map, INSTANT, state, control)
    slot = int(egos.slot[0])
    np.testing.assert_array_equal(np.nonzero(np.asarray(ego.is_free(state)))[0], [slot])
    moved, _, _ = advance(CONFIG, lane_map, state, jnp.where(ego.is_free(state), free.a, a))
    both = ego.with_free(moved, free)
    others = np.arange(N) != slot
    for name in ("lane", "previous", "s", "d", "v", "a", "side", "active", "distance", "waiting", "status"):
        np.testing.assert_array_equal(getattr(both, name)[others], getattr(alone, name)[others], err_msg=name)
        expected = getattr(moved if name in ("waiting", "status") else free, name)
        assert getattr(both, name)[slot] == expected[slot], name
    np.testing.assert_allclose(both.v[slot], 8.0 + 0.05, rtol=1e-5)  # the mean of 0 and 1 m/s^2
    box = np.asarray(boxes(lane_map, both))
    over = np.asarray(ego.overlay_boxes(both, boxes(lane_map, both)))
    np.testing.assert_array_equal(over[others], box[others])
    e = both.egos
    np.testing.assert_array_equal(over[slot], [e.x[0], e.y[0], e.heading[0], 5.0, np.float32(1.9)])
    np.testing.assert_allclose(over[slot, :2], box[slot, :2], atol=1e-3)
    assert e.x[1] == state.egos.x[1], "an ego that keeps to lanes is not moved by its control"
    synced = ego.sync(lane_map, both, boxes(lane_map, both)).egos
    np.testing.assert_array_equal([synced.x[1], synced.y[1]], box[int(e.slot[1]), :2])
    assert synced.x[0] == e.x[0] and synced.steering[0] == e.steering[0]


def test_a_lane_bound_ego_can_be_set_free_in_a_bend():
    """Its wheels already point along the lane."""
    _, lane_map = bundled("roundabout")
    ring = np.asarray(lane_map.curvature_max)
    row = int(np.argmax((ring > 0.03) & (ring < 0.04) & (np.asarray(lane_map.length) > 25)))
    state = free_world("roundabout", [row], [10.0], [6.0])
    steering = np.asarray(state.egos.steering)
    np.testing.assert_allclose(np.abs(np.tan(steering)), WHEELBASE * ring[row], rtol=1e-2)
    _, trace = run(roll, "roundabout", Limits(), state, controls(0.0, steering))
    turned = np.angle(np.exp(1j * (trace["heading"] - trace["along"])))[:20]
    assert np.abs(np.diff(trace["heading"][:20, 0])).min() > 0.01 and np.abs(turned).max() < 0.02


def test_slots_that_cannot_be():
    _, lane_map = bundled("roundabout")
    state = free_world("roundabout", [0], [40.0], [8.0])
    box = boxes(lane_map, state)
    with pytest.raises(ValueError, match=r"ego 1 is in slot 8; slots go from 0 to 7"):
        ego.from_lane(lane_map, state, box, [0, 8], True)
    with pytest.raises(ValueError, match="slot 3 has two egos"):
        ego.from_lane(lane_map, state, box, [3, 1, 3], True)


# --- trajectories -------------------------------------------------------------------------------


def circle(state, k, radius, v, along_body=False):
    """A circle that starts where ego k is, turning left (radius > 0) or right."""
    x, y, heading = (float(value[k]) for value in (state.egos.x, state.egos.y, state.egos.heading))
    turned = v / radius * CONFIG.dt * np.arange(STEPS + 10)
    course = heading + turned
    slip = np.arcsin(WHEELBASE / 2 / radius) if along_body else 0.0
    return (
        x + radius * (np.sin(course) - np.sin(heading)),
        y - radius * (np.cos(course) - np.cos(heading)),
        course - slip,
        np.full(STEPS + 10, float(v)),
    )


def shifted(state, k, v, shift, duration, start=1.0):
    """A lane change of `shift` m by the quintic, along the heading of ego k."""
    x, y, heading = (float(value[k]) for value in (state.egos.x, state.egos.y, state.egos.heading))
    t = CONFIG.dt * np.arange(STEPS + 10)
    u = np.clip((t - start) / duration, 0, 1)
    along, across = v * t, shift * u**3 * (10 - 15 * u + 6 * u * u)
    course = np.arctan2(shift * 30 * u**2 * (1 - u) ** 2 / duration, v)
    return (
        x + along * np.cos(heading) - across * np.sin(heading),
        y + along * np.sin(heading) + across * np.cos(heading),
        heading + course,
        np.hypot(np.full_like(t, v), shift * 30 * u**2 * (1 - u) ** 2 / duration),
    )


def lateral_error(trace, path, k):
    """Distance of ego k from the polyline of its path, m, at every step."""
    p = np.stack(path[:2], -1).astype(float)
    a, b = p[:-1], p[1:]
    q = np.stack([trace["x"][:, k], trace["y"][:, k]], -1)[:, None]
    length = np.maximum(((b - a) ** 2).sum(-1), 1e-9)
    u = np.clip(((q - a) * (b - a)).sum(-1) / length, 0, 1)
    return np.linalg.norm(q - (a + u[..., None] * (b - a)), axis=-1).min(-1)


@pytest.mark.parametrize(("lag", "bound"), [(0.05, 0.15), (0.25, 0.2)])
def test_tracking_circles_and_lane_changes(lag, bound):
    """R = 20 m at 8 m/s and a lane change at 20 m/s, within 0.15 m; the wheels are straight at the start.

    With slow steering, too: what is turned in advance makes up for it.
    """
    v = [8.0, 8.0, 8.0, 20.0, 20.0, 30.0, 5.0, 12.0]
    state = free_world("roundabout", [0], [40.0], v)
    paths = [
        circle(state, 0, 20.0, 8.0),
        circle(state, 1, -20.0, 8.0),
        circle(state, 2, 20.0, 8.0, along_body=True),
        shifted(state, 3, 20.0, 3.5, 4.0),
        shifted(state, 4, 20.0, -3.5, 3.0),
        shifted(state, 5, 30.0, 3.5, 4.0),
        circle(state, 6, 15.0, 5.0),
        circle(state, 7, -60.0, 12.0),
    ]
    _, trace = run(follow, "roundabout", Limits(steering_lag=lag), state, trajectory_of(*paths))
    errors = np.stack([lateral_error(trace, path, k) for k, path in enumerate(paths)], -1)
    assert errors.max() < bound and errors[:, [3, 5]].max() < 0.1
    assert errors[60:].max() < 0.05
    goal = np.stack([np.stack(path[:2], -1)[1 : STEPS + 1] for path in paths], 1)
    there = np.stack([trace["x"], trace["y"]], -1)
    assert np.linalg.norm(there - goal, axis=-1)[30:].max() < 0.25, "at the right time, too"


def test_a_creeping_ego_keeps_its_wheels_turned():
    """Circles of 12 m to both sides; a trajectory that does not move says nothing about the wheels."""
    v = [0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.2, 0.4]
    state = free_world("roundabout", [0], [40.0], v)
    radii = np.array([12.0, -12.0, 12.0, -12.0, 12.0, -12.0, -12.0, 12.0])
    wheels = np.arctan(2 * np.tan(np.arcsin(WHEELBASE / 2 / radii)))
    turned = jnp.asarray(np.where(np.arange(N) < 6, wheels, 0.0), jnp.float32)  # 6 and 7 begin straight
    paths = [circle(state, k, radii[k], v[k]) for k in range(N)]
    e = state.egos
    body = e.heading - jnp.asarray(
        np.arcsin(WHEELBASE / 2 / radii), jnp.float32
    )  # the centre moves along them
    state = dataclasses.replace(state, egos=dataclasses.replace(e, steering=turned, heading=body))
    _, trace = run(follow, "roundabout", Limits(), state, trajectory_of(*paths))
    np.testing.assert_allclose(trace["steering"][-1], wheels, atol=0.02)


def test_tracking_keeps_to_the_path_when_it_is_late():
    """An ego that cannot drive as fast as it should is half a circle late, and still on the circle."""
    state = free_world("roundabout", [0], [40.0], [3.0])
    radii = [20.0, -20.0, 30.0, -30.0, 25.0, 40.0, -40.0, 60.0]
    paths = [circle(state, k, radius, 8.0) for k, radius in enumerate(radii)]
    _, trace = run(follow, "roundabout", Limits(acceleration=1.0), state, trajectory_of(*paths))
    goal = np.stack([np.stack(path[:2], -1)[1 : STEPS + 1] for path in paths], 1)
    late = np.linalg.norm(np.stack([trace["x"], trace["y"]], -1) - goal, axis=-1)
    assert late.max(0).min() > 8.0
    errors = np.stack([lateral_error(trace, path, k) for k, path in enumerate(paths)], -1)
    assert errors.max() < 0.1
    assert (trace["v"].max(0) > 9.0).all(), "and it hurries"


def test_tracking_recovers_from_offsets_and_comes_to_rest():
    state = free_world("roundabout", [0], [40.0], [10.0, 10.0, 10.0, 10.0, 6.0, 10.0])
    e = state.egos
    paths = [shifted(state, k, 10.0, 0.0, 1.0) for k in range(N)]
    moved = dataclasses.replace(
        e, y=e.y.at[0].add(1.0).at[1].add(-2.0), x=e.x.at[0].add(0.5), heading=e.heading.at[2].add(0.3)
    )
    # ego 5 is to stop after 5 s of steady braking
    t = CONFIG.dt * np.arange(STEPS + 10)
    way, speed = np.where(t < 5, 10 * t - t * t, 25.0), np.maximum(10 - 2 * t, 0)
    heading = float(e.heading[5])
    x, y = float(e.x[5]) + way * np.cos(heading), float(e.y[5]) + way * np.sin(heading)
    paths[5] = x, y, np.full_like(t, heading), speed
    _, trace = run(
        follow, "roundabout", Limits(), dataclasses.replace(state, egos=moved), trajectory_of(*paths)
    )
    errors = np.stack([lateral_error(trace, path, k) for k, path in enumerate(paths)], -1)
    assert errors[:5, :3].max() > 0.1 and np.delete(errors, 5, 1)[70:].max() < 0.02
    np.testing.assert_allclose(trace["v"][80:, :5], 10.0, atol=0.05)
    ahead = np.hypot(trace["x"][-1, 5] - float(e.x[5]), trace["y"][-1, 5] - float(e.y[5]))
    np.testing.assert_allclose(ahead, 25.0, atol=0.1)
    assert trace["v"][-1, 5] < 0.01
    # overshoot: the offset decays without swinging to the other side by more than a tenth
    side = (trace["y"][:, 1] - float(e.y[1])) * np.cos(float(e.heading[1]))
    side -= (trace["x"][:, 1] - float(e.x[1])) * np.sin(float(e.heading[1]))
    start = -2.0 * np.cos(float(e.heading[1]))
    assert (side / start).min() > -0.1


@pytest.mark.parametrize("dt", [0.05, 0.1, 0.2])
def test_a_bend_that_grows_evenly_is_that_of_each_moment(dt):
    """A clothoid at 10 m/s, however it is sampled, also at the samples; a step of no length says nothing."""
    growth = np.array([0.02, -0.05])[:, None]  # 1/m each second
    t = dt * np.arange(41)
    heading = 10 * growth * t**2 / 2
    course = (heading[:, 1:] + heading[:, :-1]) / 2
    x, y = (np.cumsum(np.pad(10 * dt * f(course), ((0, 0), (1, 0))), -1) for f in (np.cos, np.sin))
    rows = (jnp.asarray(z, jnp.float32) for z in (x, y, heading, np.full_like(x, 10.0), 2.0))
    clothoid = Trajectory(**dict(zip(("x", "y", "heading", "v", "t0"), rows, strict=True)), dt=dt)
    for time in (0.5 * dt, dt, 1.3 * dt, 5 * dt, 39.5 * dt):
        found = ego._sample(clothoid, jnp.full(2, 2.0 + time, jnp.float32)).bend
        np.testing.assert_allclose(found, growth[:, 0] * time, rtol=2e-3, atol=1e-5)
    # a circle of 20 m that begins with a step of standing, whose heading trembles
    still = dataclasses.replace(
        clothoid,
        x=jnp.asarray([[0.0, 0.0, 1.0, 2.0]] * 2),
        y=jnp.zeros((2, 4)),
        heading=jnp.asarray([[0.0, 1e-5, 0.05, 0.1]] * 2),
        v=jnp.ones((2, 4)),
    )
    for place in (0.7, 1.0, 1.4):
        found = ego._sample(still, jnp.full(2, 2.0 + place * dt, jnp.float32)).bend
        np.testing.assert_allclose(found, 0.05, rtol=2e-3)


def test_a_trajectory_goes_on_straight_after_its_end():
    x = jnp.asarray([[0.0, 1.0, 2.0, 2.5]] * 2)
    trajectory = Trajectory(
        x=x, y=0 * x, heading=0 * x, v=jnp.asarray([[10.0, 10.0, 7.5, 4.0]] * 2), t0=jnp.float32(3.0)
    )
    sample = ego._sample(trajectory, jnp.asarray([3.15, 4.3]))
    np.testing.assert_allclose(sample.x, [1.5, 2.5 + 4.0], atol=1e-5)
    np.testing.assert_allclose(sample.v, [8.75, 4.0], atol=1e-5)
    np.testing.assert_allclose(sample.a, [-25.0, 0.0], atol=1e-4)


# --- meta-actions -------------------------------------------------------------------------------


def test_meta_actions():
    _, lane_map = bundled("intersection")
    left, right = np.asarray(lane_map.may_change_left), np.asarray(lane_map.may_change_right)
    both = int(np.nonzero(left & right)[0][0])
    only_left, only_right = int(np.nonzero(left & ~right)[0][0]), int(np.nonzero(right & ~left)[0][0])
    rows = [both, both, only_left, only_left, only_right, only_right, both, both]
    state = free_world("intersection", rows, [20.0], [8.0])
    egos = dataclasses.replace(state.egos, free=jnp.asarray([False] * 7 + [True]))
    changing = state.side.at[state.egos.slot[6]].set(1)
    state = dataclasses.replace(state, egos=egos, side=changing)
    meta = jnp.asarray([Meta.LEFT, Meta.RIGHT] * 4)
    np.testing.assert_array_equal(ego.meta_lane(lane_map, state, meta), [1, -1, 1, 0, 0, -1, 0, 0])
    no_cars = dataclasses.replace(lane_map, access=0 * lane_map.access)
    assert not np.asarray(ego.meta_lane(no_cars, state, meta)).any()
    meta = jnp.asarray([Meta.KEEP, Meta.ACCELERATE, Meta.DECELERATE, Meta.STOP, Meta.LEFT, Meta.RIGHT, 1, 0])
    assert not np.asarray(ego.meta_lane(lane_map, state, meta))[:4].any()
    follow = jnp.asarray([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.6, -3.0])[::-1]  # by slot
    wish = [0.0, 1.5, -2.0, -4.0, 0.0, 0.0, 1.5, 0.0]
    np.testing.assert_allclose(ego.meta_acceleration(meta, state, follow, raw=True), wish)
    np.testing.assert_allclose(
        ego.meta_acceleration(meta, state, follow), np.minimum(wish, [1, 1, 1, 1, 1, 1, 0.6, -3])
    )


def test_optimised_code_follows_a_trajectory_smoothly_too():
    """Other tests compile without optimisation; with it, numbers are rounded otherwise from use to use."""
    lane_map = bundled("ramp")[1]
    goals = np.asarray(lane_map.routes.reachable)
    lanes = np.nonzero(np.asarray(lane_map.length) > 300)[0][:4]
    states = [
        state_of("ramp", [lane], [20.0 + lane], [15.0 + 0.7 * k], [int(np.nonzero(goals[lane])[0][0])])
        for k, lane in enumerate(lanes)
    ]
    start = jax.tree.map(lambda *x: jnp.stack(x), *states)
    run = Rollout(Config(dt=0.1), Traffic(lane_changes=False), 4.0, FollowLane(), record=trace)

    def speeding_up(lane_map, state):
        egos = ego.from_lane(lane_map, state, boxes(lane_map, state), [0], free=True)
        state = dataclasses.replace(state, egos=egos)
        scenario = Scenario(start=state, schedule=no_arrivals(state))
        return run(lane_map, scenario, jax.random.key(0)).trace.a[5:, 0]  # after the start

    options = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False}
    a = jax.jit(jax.vmap(speeding_up, (None, 0)), compiler_options=options)(lane_map, start)
    assert np.abs(np.diff(np.asarray(a), axis=1)).max() < 0.3  # m/s^2 from step to step
