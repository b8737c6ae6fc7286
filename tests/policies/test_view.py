"""What a planner may know: nothing that cannot be seen leaks in, and sensors err as they are told to."""

import dataclasses
import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from traffic_worlds import bundled, drivers, scattered, state_of

from limsim_jax.maps.lane_map import NO_LANE, pose
from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic, Policy, Wrapper, knows, named, seeing, sighted
from limsim_jax.policies.limsim_tm import LimSimTM
from limsim_jax.policies.view import View
from limsim_jax.policies.view.drivers import (
    GAP_ERROR,
    INDEPENDENT,
    SPEED_ERROR,
    believed,
    nothing_seen,
    typical,
    watch,
)
from limsim_jax.policies.view.routes import TURN, TURN_WITHIN, believed_goals
from limsim_jax.sweeps.build import doubts, map_of, policy_of
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentError, read_experiments
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.types import Config

CONFIG = Config(dt=0.1)
N = 14
EGO = 3


def world(name="roundabout", seed=0, n=N):
    """Vehicles of unequal sizes and speeds; one of them is the ego, on its lane."""
    state = scattered(name, n, seed)
    rng = np.random.default_rng(seed)
    state = replace(
        state,
        v=jnp.asarray(rng.uniform(0, 15, n), jnp.float32),
        entered=jnp.asarray(rng.uniform(0, 9, n), jnp.float32),
        shape=replace(state.shape, length=jnp.asarray(rng.uniform(3.5, 12, n), jnp.float32)),
        waiting=jnp.arange(n, dtype=jnp.float32),
    )
    lane_map = bundled(name)[1]
    return replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), [EGO], True))


def look(view, state, name="roundabout", key=0):
    lane_map = bundled(name)[1]
    see = jax.jit(lambda s, k: view.look(CONFIG, lane_map, s, view.init(CONFIG, s), k)[0])
    return see(state, jax.random.key(key))


def mine(state):
    return np.arange(state.lane.shape[0]) == EGO


# --- routes ------------------------------------------------------------------------------------------


@functools.cache
def tables(name):
    """The map on the host, and the headings at the end of every lane and 30 m into it."""
    lane_map = bundled(name)[1]
    m = jax.tree.map(np.asarray, lane_map)
    lanes = np.arange(len(m.length))
    ends = np.asarray(pose(lane_map, lanes, m.length)[2])
    within = np.asarray(pose(lane_map, lanes, np.minimum(m.length, TURN_WITHIN))[2])
    return m, ends, within


def expected_lanes(name, state, signals, distance, ego=EGO):
    """By loops: the split ahead of each vehicle, and the lane behind it that a prudent driver expects.

    -2: there is no split. Also how many of these are not the straightest.
    """
    m, ends, within = tables(name)
    own, lane = [], int(state.lane[ego])
    for _ in range(6):
        if lane != NO_LANE:
            own.append(lane)
            lane = int(m.routes.next_lane[lane, int(state.goal[ego])])
    found, bent = [], 0
    for i in range(state.lane.shape[0]):
        lane, goal = int(state.lane[i]), int(state.goal[i])
        room = m.length[lane] - float(state.s[i])
        for _ in range(4):
            after = [x for x in m.successors[lane] if x != NO_LANE]
            if len(after) != 1:
                break
            lane = after[0]
            room += m.length[lane]
        after = [x for x in m.successors[lane] if x != NO_LANE and (m.routes.next_lane[lane] == x).any()]
        if len(after) < 2:
            found.append((lane, -2))
            continue

        def turn(x, lane=lane):
            return (within[x] - ends[lane] + np.pi) % (2 * np.pi) - np.pi

        def side(x, turn=turn):
            return int(turn(x) > TURN) - int(turn(x) < -TURN)

        def meets(x):
            row = m.conflicts.connector[x]
            foes = {int(m.conflicts.lane[f]) for f in m.conflicts.foe[row] if f >= 0} if row >= 0 else set()
            return x in own or bool(foes & set(own))

        true = int(m.routes.next_lane[lane, goal])
        if signals and room < distance and true in after:
            after = [x for x in after if side(x) == side(true)]
        best = max(after, key=lambda x, turn=turn: (meets(x), -abs(turn(x))))
        bent += i != ego and best != min(after, key=lambda x, turn=turn: abs(turn(x)))
        found.append((lane, best))
    return found, bent


@pytest.mark.parametrize("name", ["roundabout", "intersection"])
def test_routes_are_those_of_a_prudent_driver(name):
    lane_map = bundled(name)[1]
    ask = jax.jit(
        lambda s, on: believed_goals(lane_map, s, jnp.arange(N) == EGO, jnp.full(N, on), 40.0),
    )
    next_lane = tables(name)[0].routes.next_lane
    splits = differ = 0
    for seed in range(4):
        state = world(name, seed)
        for on in (True, False):
            goal = np.asarray(ask(state, on))
            assert goal[EGO] == state.goal[EGO]
            for i, (lane, wanted) in enumerate(expected_lanes(name, state, on, 40.0)[0]):
                if i != EGO and wanted != -2:
                    assert next_lane[lane, goal[i]] == wanted, (seed, on, i)
                    splits += 1
                    differ += next_lane[lane, int(state.goal[i])] != wanted
    assert splits > 20 and differ > 5  # it is a belief, not the truth


def test_prudence_expects_the_branch_that_meets_the_ego():
    states = at_entries()[0]
    lane_map, next_lane = bundled("roundabout")[1], tables("roundabout")[0].routes.next_lane
    mine, off = jnp.asarray([True, False]), jnp.zeros(2, bool)
    goals = jax.jit(jax.vmap(lambda s: believed_goals(lane_map, s, mine, off, 40.0)))(states)
    bent = 0
    for k, goal in enumerate(np.asarray(goals)):
        state = jax.tree.map(lambda x: x[k], states)  # noqa: B023
        found, more = expected_lanes("roundabout", state, False, 40.0, ego=0)
        lane, wanted = found[1]
        assert next_lane[lane, goal[1]] == wanted
        bent += more
    assert bent > 3


# --- drivers -----------------------------------------------------------------------------------------


def highway_pair(v, gap, speed_factor=1.0):
    """A follower at `gap` m (bumper to bumper) behind a leader on a straight motorway lane."""
    from traffic_worlds import motorway

    lane, goal = motorway()
    return state_of(
        "highway", [lane, lane], [100.0, 100.0 + gap + 5.0], [v, v], [goal, goal],
        driver=drivers(2, speed_factor=speed_factor, T=9.0),
    )  # fmt: skip


def posterior(mean, spread, value, error, looks):
    """The normal update in closed form."""
    weight = looks * CONFIG.decision_time / INDEPENDENT / error**2
    return (mean / spread**2 + weight * value) / (1 / spread**2 + weight)


def test_drivers_are_learned_from_speed_and_gap():
    lane_map = bundled("highway")[1]
    state = highway_pair(20.0, 40.0)
    limit = float(lane_map.speed_limit[state.lane[0]])
    prior = typical(state.shape.vehicle_class)
    see = jax.jit(lambda seen, state: watch(CONFIG, lane_map, state, seen))
    seen = nothing_seen(state)
    for _ in range(30):
        seen = see(seen, state)
    found = believed(seen, state.shape.vehicle_class)
    # the leader drives freely, the follower in equilibrium: both at 20 m/s
    share = posterior(1.0, 0.1, 20.0 / limit, SPEED_ERROR, 30)
    np.testing.assert_allclose(found.speed_factor, [1.0, share], rtol=1e-5)
    stretch = np.sqrt(1 - (20.0 / limit) ** 4)
    time_gap = (40.0 * stretch - prior.s0[0]) / 20.0
    T = float(prior.T[0])
    wanted = posterior(T, 0.25 * T, time_gap, GAP_ERROR, 30)
    np.testing.assert_allclose(found.T, [wanted, T], rtol=1e-4)
    # nothing is learned from a vehicle that brakes, changes lanes or stands
    for odd in ({"a": jnp.full(2, -1.0)}, {"side": jnp.ones(2, jnp.int32)}, {"v": jnp.zeros(2)}):
        same = see(nothing_seen(state), replace(state, **odd))
        np.testing.assert_array_equal(believed(same, state.shape.vehicle_class).T, prior.T)
    # another vehicle in the slot starts anew
    fresh = see(seen, replace(state, entered=state.entered + 5.0))
    assert float(fresh.gap_weight[0]) == pytest.approx(float(seen.gap_weight[0]) / 30, rel=1e-4)


# --- the whole view ----------------------------------------------------------------------------------


def hidden_changed(state, seed=1):
    """The same world to look at: other drivers, other goals, another past."""
    rng = np.random.default_rng(seed)
    keep = jnp.asarray(mine(state))
    lane_map = bundled("roundabout")[1]
    reachable = np.asarray(lane_map.routes.reachable)
    goal = np.asarray([rng.choice(np.nonzero(reachable[row])[0]) for row in np.asarray(state.lane)])

    def other(x, low, high):
        return jnp.where(keep, x, jnp.asarray(rng.uniform(low, high, x.shape), x.dtype))

    return replace(
        state,
        driver=jax.tree.map(lambda x: other(x, 0.5, 2.0), state.driver),
        goal=jnp.where(keep, state.goal, jnp.asarray(goal, state.goal.dtype)),
        status=other(state.status, 0, 60),
        distance=other(state.distance, 0, 900),
        vehicle=other(state.vehicle, 0, 50),
        rest=other(state.rest, 0, 9),
        lights=replace(state.lights, elapsed=state.lights.elapsed + 3),
    )


def test_what_cannot_be_seen_does_not_matter():
    state = world()
    view = View(range=1e4, signal_distance=0.0)
    other = hidden_changed(state)
    one, two = look(view, state), look(view, other)
    for (path, a), (_, b) in zip(
        *(jax.tree_util.tree_flatten_with_path(x)[0] for x in (one, two)), strict=True
    ):
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))
    assert not np.array_equal(state.goal, other.goal)
    # what can be seen is there, and the ego knows itself
    np.testing.assert_allclose(boxes(bundled("roundabout")[1], one), boxes(bundled("roundabout")[1], state))
    np.testing.assert_array_equal(one.waiting, state.waiting)
    for name in ("driver", "goal", "status", "distance"):
        jax.tree.map(
            lambda a, b: np.testing.assert_array_equal(a[EGO], b[EGO]),
            getattr(one, name),
            getattr(state, name),
        )


def test_range_and_occlusion_against_shapely():
    name = "intersection"
    lane_map = bundled(name)[1]
    hidden = 0
    for seed in range(3):
        state = world(name, seed, 30)
        box = np.asarray(boxes(lane_map, state), float)

        def body(row):
            x, y, h, length, width = row
            at = [(a * length / 2, b * width / 2) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
            return [(x + a * np.cos(h) - b * np.sin(h), y + a * np.sin(h) + b * np.cos(h)) for a, b in at]

        eye = box[EGO, :2]
        seen = np.asarray(look(View(range=150.0, occlusion=True), state, name).active)
        for i in range(30):
            near = np.hypot(*(box[i, :2] - eye)) <= 150.0
            inner = body([*box[i, :3], 0.95 * box[i, 3], 0.95 * box[i, 4]])
            bodies = [shapely.Polygon(body(box[j])) for j in range(30) if j not in (i, EGO)]
            blocked = [
                any(shapely.LineString([eye, p]).intersects(b) for b in bodies)
                for p in (tuple(box[i, :2]), *inner)
            ]
            assert seen[i] == (i == EGO or (near and not all(blocked))), (seed, i)
            hidden += near and all(blocked)
    assert hidden > 5
    # far beyond everything, and nothing in the way
    state = world(name, 0, 30)
    assert np.asarray(look(View(range=1e5), state, name).active).all()
    unseen = look(View(range=1.0), state, name)
    assert np.asarray(unseen.active).sum() == 1 and (np.asarray(unseen.lane)[~mine(state)] == NO_LANE).all()


def test_errors_have_the_size_that_was_asked_for():
    state = world("highway", 2, 40)
    view = View(range=1e6, position_noise=0.5, speed_noise=0.4, misses=0.2)
    lane_map = bundled("highway")[1]
    see = jax.jit(
        jax.vmap(lambda k: view.look(CONFIG, lane_map, state, view.init(CONFIG, state), k)[0]),
    )
    found = see(jax.random.split(jax.random.key(5), 400))
    others = ~mine(state)
    there = np.asarray(found.active)[:, others]
    assert there.mean() == pytest.approx(0.8, abs=0.02) and np.asarray(found.active)[:, EGO].all()
    inside = (np.asarray(state.s) > 5) & (np.asarray(lane_map.length[state.lane] - state.s) > 5)
    moving = (np.asarray(state.v) > 3)[others]
    for name, error, counts in (("s", 0.5, inside[others]), ("d", 0.5, moving | True), ("v", 0.4, moving)):
        off = (np.asarray(getattr(found, name)) - np.asarray(getattr(state, name)))[:, others]
        off = off[there & counts[None]]
        assert abs(off.mean()) < 0.02 and off.std() == pytest.approx(error, rel=0.03), name
        assert (np.asarray(getattr(found, name))[:, EGO] == getattr(state, name)[EGO]).all()
    # equal keys are equal pictures
    again = see(jax.random.split(jax.random.key(5), 400))
    np.testing.assert_array_equal(found.s, again.s)


def test_latency_shows_the_others_as_they_were():
    lane_map = bundled("highway")[1]
    state = world("highway", 2)
    view = View(range=1e6, latency=1.0)
    see = jax.jit(lambda s, sight: view.look(CONFIG, lane_map, s, sight, jax.random.key(0)))
    sight, shown = view.init(CONFIG, state), []
    for k in range(5):
        now = replace(state, s=state.s + 0.5 * k, entered=state.entered.at[5].set(7.7 if k == 4 else 1.0))
        seen, sight = see(now, sight)
        shown.append(seen)
    others = ~mine(state)
    for k in range(5):
        late = max(k - 2, 0)
        wanted = np.asarray(state.s) + 0.5 * np.where(others, late, k)
        counts = np.asarray(shown[k].active)
        np.testing.assert_allclose(np.asarray(shown[k].s)[counts], wanted[counts], rtol=1e-5)
        assert counts[EGO] and counts.sum() == (N - 1 if k in (0, 1, 4) else N)  # 5 entered at 0 and at 4
    with pytest.raises(ValueError, match=r"multiple of 0\.5 s"):
        View(latency=0.7).init(CONFIG, state)


# --- policies ----------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Looks(Policy):
    """Remembers what it gets."""

    free = False

    def init(self, config, lane_map, state):
        return state.driver.T

    def __call__(self, config, lane_map, state, memory, key):
        return Command(), state.driver.T


class Bare:
    """A policy that is not derived from the base class."""

    free = False
    others = 0

    def init(self, config, lane_map, state):
        return state.driver.T

    def __call__(self, config, lane_map, state, memory, key):
        return Command(), state.driver.T


def test_policies_get_their_view():
    lane_map = bundled("roundabout")[1]
    state = hidden_changed(world())

    def got(policy):
        policy = sighted(policy)
        memory = policy.init(CONFIG, lane_map, state)
        memory = policy(CONFIG, lane_map, state, memory, jax.random.key(0))[1]
        return np.asarray(getattr(memory, "policy", memory))

    others = ~mine(state)
    for policy in (Looks(), Bare(), named("bare", Bare()), Looks(view=View(range=50.0))):
        assert knows(policy) == "view"
        assert len(np.unique(got(policy)[others])) == 1, policy
        for true in (seeing(policy, privileged=True),):
            assert knows(true) == "state"
            np.testing.assert_array_equal(got(true), state.driver.T)
    assert sighted(sighted(Looks())) == sighted(Looks()) != Looks()
    assert knows(LikeTraffic()) == "state"
    wide = seeing(Bare(), view=View(range=9.0))
    assert isinstance(wide, Wrapper) and wide.view.range == 9.0 and not wide.privileged


def at_entries():
    """An ego at every entry of the roundabout, a vehicle before every split, and goals for its branches."""
    lane_map = bundled("roundabout")[1]
    m = jax.tree.map(np.asarray, lane_map)
    entries = [i for i in range(len(m.length)) if m.length[i] > 100 and (m.successors[i] >= 0).sum() == 1]
    splits = [i for i in range(len(m.length)) if len(set(m.routes.next_lane[i]) - {NO_LANE}) == 2]
    egos, others, goals = [], [], []
    for entry in entries:
        for split in splits:
            if entry != split:
                egos.append(entry)
                others.append(split)
                branches = sorted(set(m.routes.next_lane[split]) - {NO_LANE})
                goals.append([int(np.argmax(m.routes.next_lane[split] == x)) for x in branches])
    states = []
    for pick in (0, 1):
        worlds = []
        for ego, other, goal in zip(egos, others, goals, strict=True):
            place = [m.length[ego] - 12.0, m.length[other] - 1.0]
            own = int(np.argmax(m.routes.next_lane[ego] >= 0))
            state = state_of("roundabout", [ego, other], place, [4.0, 8.0], [own, goal[pick]])
            worlds.append(replace(state, egos=from_lane(lane_map, state, boxes(lane_map, state), [0], True)))
        states.append(jax.tree.map(lambda *x: jnp.stack(x), *worlds))
    return states


def test_errors_of_position_do_not_tell_the_route():
    """A vehicle that is seen beyond the end of its lane is seen on the expected branch, not the true one."""
    lane_map = bundled("roundabout")[1]
    view = View(signal_distance=0.0, position_noise=4.0)

    def lanes(state):
        return view.look(CONFIG, lane_map, state, view.init(CONFIG, state), jax.random.key(3))[0].lane[1]

    see = jax.jit(jax.vmap(lanes))
    first, second = at_entries()
    one, other = np.asarray(see(first)), np.asarray(see(second))
    np.testing.assert_array_equal(one, other)
    assert (one != np.asarray(first.lane)[:, 1]).sum() > 5


@pytest.mark.engine
def test_limsim_tm_decides_by_what_it_sees():
    lane_map = bundled("roundabout")[1]
    first, second = at_entries()
    for privileged in (False, True):
        policy = sighted(LimSimTM(view=View(signal_distance=0.0), privileged=privileged))

        def decide(state, policy=policy):
            memory = policy.init(CONFIG, lane_map, state)
            return policy(CONFIG, lane_map, state, memory, jax.random.key(1))[0].trajectory

        command = jax.jit(jax.vmap(decide))
        same = [np.array_equal(*pair) for pair in zip(command(first).v, command(second).v, strict=True)]
        assert len(same) > 8
        assert all(same) != privileged


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("view = { range = -3 }", "ego.view: view.range: -3 m; expected more than 0"),
        ("view = { rnge = 3 }", "ego.view: rnge: no such field; known are range, occlusion"),
        ("view = { misses = 1.5 }", "view.misses: 1.5; expected a share within 0 and 1"),
        ("view = { latency = -1 }", "view.latency: -1 s; expected 0 or more"),
        ("view = { misses = true }", "view.misses: True; expected a number"),
        ('view = { range = "80 m" }', "ego.view: view.range: '80 m'; expected a number"),
        ("view = { occlusion = 1.0 }", "view.occlusion: 1.0; expected true or false"),
        ("privileged = 3", "ego.privileged"),
    ],
)
def test_bad_views_are_one_line(tmp_path, table, words):
    file = tmp_path / "mine.toml"
    file.write_text(f'map = "ramp"\nhorizon = 20\n[ego]\n{table}\n')
    with pytest.raises(ExperimentError) as caught:
        read_experiments(file)
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_says_what_its_policy_sees(tmp_path):
    file = tmp_path / "mine.toml"
    text = (
        'map = "ramp"\nhorizon = 20\n[ego]\npolicy = "limsim_tm"\nview = { range = 60, occlusion = true }\n'
    )
    file.write_text(text)
    policy = policy_of(read_experiments(file)[0])
    assert isinstance(policy, LimSimTM) and policy.view == View(range=60, occlusion=True)
    file.write_text(text.replace('"limsim_tm"', '"area_of_interest"') + "privileged = true\n")
    area = policy_of(read_experiments(file)[0])
    assert isinstance(area, AreaOfInterest) and isinstance(area.around, LimSimTM)
    assert area.around.view.occlusion and area.around.privileged and knows(area) == "state"


def test_a_latency_between_decisions_and_a_speed_in_km_h_are_told(tmp_path):
    file = tmp_path / "mine.toml"
    text = 'map = "ramp"\nhorizon = 20\nego = { policy = "POLICY", view = { latency = 0.7 } }\n'
    text += "[traffic]\nvehicles = 4\n"
    for policy in ("limsim_tm", "area_of_interest"):
        file.write_text(text.replace("POLICY", policy))
        with pytest.raises(ExperimentError, match=r"ego\.view: view\.latency: 0\.7 s; expected a mult"):
            Episodes(read_experiments(file)[0])
    file.write_text(
        text.replace("POLICY", "limsim_tm").replace("view = { latency = 0.7 }", "options = { view = 80 }")
    )
    with pytest.raises(ExperimentError, match=r"ego\.view: view is 80; expected a limsim_jax\.View"):
        Episodes(read_experiments(file)[0])
    town = map_of(read_experiments("ramp")[0])
    file.write_text('map = "ramp"\nhorizon = 20\n[ego]\nv = 120\n[[traffic.flow]]\nrate = 400\nspeed = 30\n')
    told = doubts(read_experiments(file)[0], town)
    assert told == [
        "mine: ego.v: 120 m/s, but the highest limit of the map is 33.3 m/s; 120 km/h are 33.3 m/s"
    ]
