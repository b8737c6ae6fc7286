"""Worlds through time: totals, batches, resuming, branching."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled

from limsim_jax.maps.lane_map import VEHICLE_CLASSES
from limsim_jax.maps.origins import origins
from limsim_jax.maps.routing import default_goals
from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic
from limsim_jax.policies.simple import FollowLane
from limsim_jax.simulation.checkpoint import fork, load, save
from limsim_jax.simulation.rollout import Kept, Rollout, world_key
from limsim_jax.simulation.table import write_trace
from limsim_jax.simulation.totals import count
from limsim_jax.simulation.trace import trace
from limsim_jax.simulation.worlds import Worlds
from limsim_jax.traffic.demand import EgoStart, Flow, build_demand, sample_scenario
from limsim_jax.traffic.engine import Traffic
from limsim_jax.traffic.vehicles import (
    default_population,
    restrict_to_map,
    sample_vehicles,
    uniform_population,
)
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

SLOTS = 24
RUN = Rollout(Config(dt=0.1), Traffic(), horizon=30.0)


@functools.cache
def sampler():
    """Scenarios on the bundled roundabout."""
    network, lane_map = bundled("roundabout")
    flows = [Flow(origin=name, rate=350.0) for name in origins(network)]
    population = restrict_to_map(default_population(), lane_map)
    demand = build_demand(
        network, lane_map, default_goals(network), flows, population, horizon=RUN.horizon, density=4.0
    )
    return lambda key: sample_scenario(demand, lane_map, key, SLOTS)


@functools.cache
def worlds():
    """Compiled once for this module: four worlds at a time."""
    return Worlds(RUN, bundled("roundabout")[1], sampler(), chunk=4, devices=jax.local_devices()[:1])


@functools.cache
def part():
    """A quarter of the run of one world."""
    lane_map = bundled("roundabout")[1]
    run = dataclasses.replace(RUN, record=trace)
    return jax.jit(lambda schedule, key, carry: run.advance(lane_map, schedule, key, carry, 15))


def test_totals_add_up_and_nothing_goes_wrong():
    totals = worlds().run_totals(range(6))
    assert totals.entered.shape == (6,)
    ends = [result.state for _, result in worlds().chunks(range(6))]
    on_the_road = np.concatenate([state.active.sum(-1) for state in ends])
    np.testing.assert_array_equal(totals.entered - totals.left, on_the_road)
    assert (totals.left > 0).all() and (totals.distance > 0).all()
    for name in ("collided", "off_road", "wrong_way", "ran_red", "hard", "broken"):
        assert not getattr(totals, name).any(), name
    assert (totals.deceleration < 9).all()
    assert (totals.distance / totals.time < 25).all()


@pytest.mark.parametrize(
    "speed, gridlocked",
    [
        (lambda now: 0.0, True),
        (lambda now: 0.03, True),  # 3.6 m in two minutes
        (lambda now: 0.05, False),
        (lambda now: 1.0, False),  # a queue that moves
        (lambda now: 2.0 * (now % 90 > 86), False),  # one place at every green
        (lambda now: 2.0 * (now % 90 > 88.5), True),  # 3 m
        (lambda now: 8.0 * (now < 70), True),
        (lambda now: 8.0 * (now < 90), False),
    ],
)
def test_a_vehicle_that_gets_on_by_less_than_five_metres_in_two_minutes_is_stuck(speed, gridlocked):
    """200 s: half of the vehicles drive on, half leave after 100 s, and one does what it is told."""
    config = RUN.config
    before = jax.jit(sampler())(jax.random.key(0)).start
    carry = RUN.init(bundled("roundabout")[1], before)
    totals, stood, me = carry.totals, carry.stood, int(np.flatnonzero(before.active)[0])
    counted = jax.jit(functools.partial(count, config))
    leave = np.arange(SLOTS) % 2 == (me + 1) % 2
    for step in range(round(200 / config.decision_time)):
        now = config.decision_time * step
        v = np.where(leave & (now >= 50), 0.0, 5.0)
        v[me] = speed(now)
        after = dataclasses.replace(
            before,
            step=before.step + config.decision_every,
            distance=before.distance + jnp.asarray(v * config.decision_time, jnp.float32),
            active=before.active & ~(leave & (now >= 100)),
        )
        totals, stood = counted(totals, stood, before, after)
        before = after
    assert bool(totals.gridlock) == gridlocked


def test_a_world_is_the_same_in_any_company():
    alone = worlds().run_totals([3])
    among = worlds().run_totals([7, 1, 3, 5])
    for name, x in vars(alone).items():
        np.testing.assert_array_equal(np.asarray(x)[0], np.asarray(getattr(among, name))[2], err_msg=name)
    assert float(among.distance[0]) != float(among.distance[2]), "other seeds are other worlds"


def test_saved_and_resumed_ends_as_run_through(tmp_path):
    scenario = jax.jit(sampler())(world_key(1))
    key = jax.random.key(5)
    start = RUN.init(bundled("roundabout")[1], scenario.start)
    _, carry = part()(scenario.schedule, key, start)
    save(tmp_path / "world.npz", carry)
    through, _ = part()(scenario.schedule, key, carry)
    resumed, _ = part()(scenario.schedule, key, load(tmp_path / "world.npz", start))
    for one, two in zip(jax.tree.leaves(through), jax.tree.leaves(resumed), strict=True):
        np.testing.assert_array_equal(one, two)
    assert int(through.state.step) == 150 and through.trace.time.shape == (75,)
    np.testing.assert_allclose(np.asarray(through.trace.time)[[0, -1]], [7.6, 15.0], rtol=1e-5)
    assert list(tmp_path.iterdir()) == [tmp_path / "world.npz"], "no half-written file is left"
    other = jax.tree.map(lambda x: jnp.zeros((3, *jnp.shape(x)), jnp.result_type(x)), start)
    with pytest.raises(ValueError, match=r"world\.npz: .* is .*, not"):
        load(tmp_path / "world.npz", other)


@functools.cache
def area():
    """5 s of a world in which the policy plans for those around the ego, which keeps to its lane."""
    network, lane_map = bundled("roundabout")
    typical = uniform_population("car")
    kind = jnp.argmax(typical.share)[None].astype(jnp.int32)
    driver, shape = sample_vehicles(typical, jax.random.key(0), jnp.zeros(1, jnp.int32), kind)
    egos = EgoStart(driver=driver, shape=shape, free=jnp.asarray([False]))
    population = restrict_to_map(default_population({"car": 0.4, "van": 0.3, "motorcycle": 0.3}), lane_map)
    demand = build_demand(
        network, lane_map, default_goals(network), [], population, horizon=5.0, density=6.0, egos=egos
    )
    policy = AreaOfInterest(FollowLane(), ego=LikeTraffic(), slots=3, radius=70.0)
    run = Rollout(Config(dt=0.1), Traffic(), horizon=5.0, policy=policy, record=trace)

    def one(key):
        scenario = sample_scenario(demand, lane_map, key, SLOTS, egos)
        return scenario.start, run(lane_map, scenario, key)

    return jax.device_get(jax.jit(one)(world_key(4)))


def test_a_trace_tells_whom_the_policy_drives_and_what_it_plans():
    end, _, seen, _ = area()[1]
    assert seen.driven.shape == (50, 4) and (seen.driven[:, 0] == 0).all()
    np.testing.assert_array_equal(seen.driven[-1], end.egos.slot)
    others = seen.driven[:, 1:]
    assert (others >= 0).any() and (others != 0).all()
    assert np.isnan(seen.plan[:, 0]).all()  # it keeps to its lane, as the traffic does
    np.testing.assert_array_equal(np.isnan(seen.plan[:, 1:]).any((-1, -2)), others < 0)
    rows = [set(row[row >= 0]) for row in others]
    assert all(len(found) == (row >= 0).sum() for found, row in zip(rows, others, strict=True))
    # plans begin where the vehicle is, when the decision falls, and stay until the next one
    every, started = 5, 0
    for k in range(every, 50):
        decided = k // every * every
        assert seen.plan_time[k, 0] == pytest.approx(seen.time[decided - 1], abs=1e-5)
        np.testing.assert_array_equal(seen.plan[k], seen.plan[decided])
        for row in np.flatnonzero(seen.driven[k] > 0):
            here = seen.box[decided - 1, seen.driven[k, row], :2]
            # plans are ways of the middle of the lane; in a bend a body lies a little inside
            np.testing.assert_allclose(seen.plan[k, row, 0], here, atol=0.1)
            started += 1
    assert started > 20
    np.testing.assert_allclose(np.diff(seen.plan_time, axis=-1), 0.2, atol=1e-5)


def test_a_trace_tells_classes_and_the_way_to_go():
    lane_map = bundled("roundabout")[1]
    start, (end, _, seen, _) = area()
    np.testing.assert_array_equal(seen.vehicle_class[-1], end.shape.vehicle_class)
    names = {VEHICLE_CLASSES[kind] for kind in seen.vehicle_class[0][seen.active[0]]}
    assert {"van", "motorcycle"} <= names <= {"car", "van", "motorcycle"}
    # of the ego to the end of its goal: along the route it gets less as it drives
    goal = int(start.goal[0])
    assert seen.active[:, 0].all() and (seen.v[:, 0] > 0.5).any()
    here = np.asarray(lane_map.routes.distance)[seen.lane[:, 0], goal] - seen.s[:, 0]
    np.testing.assert_allclose(seen.to_go, here, atol=1e-3)
    stays = np.diff(seen.lane[:, 0]) == 0  # lanes side by side count with their mean length
    assert stays.sum() > 40
    np.testing.assert_allclose(-np.diff(seen.to_go)[stays], 0.1 * seen.v[1:, 0][stays], atol=0.02)


def test_tables_of_a_trace_tell_it_too(tmp_path):
    network, lane_map = bundled("roundabout")
    seen = area()[1].trace
    write_trace(tmp_path / "a.npz", network, lane_map, seen)
    with np.load(tmp_path / "a.npz") as file:
        arrays = {name: file[name] for name in file.files}
    for k in (0, 20, 49):
        assert set(np.flatnonzero(arrays["driven"][k])) == set(seen.driven[k][seen.driven[k] >= 0])
    assert arrays["vehicle_class_ids"][arrays["vehicle_class"][0, 0]] == "car"
    np.testing.assert_array_equal(arrays["to_go"][:, 0], seen.to_go)
    assert np.isnan(arrays["to_go"][:, 1:]).all()
    np.testing.assert_array_equal(arrays["plan_slot"], seen.driven)
    x, y = lane_map.origin
    np.testing.assert_allclose(arrays["plan_x"], seen.plan[..., 0] + float(x), atol=1e-3)
    np.testing.assert_allclose(arrays["plan_y"], seen.plan[..., 1] + float(y), atol=1e-3)

    parquet = pytest.importorskip("pyarrow.parquet")
    write_trace(tmp_path / "a.parquet", network, lane_map, seen)
    rows = parquet.read_table(tmp_path / "a.parquet").to_pydict()
    on = seen.active
    assert rows["vehicle_class"] == [VEHICLE_CLASSES[kind] for kind in seen.vehicle_class[on]]
    assert sum(rows["driven"]) == (seen.driven >= 0).sum() and len(rows["driven"]) == on.sum()
    known = ~np.isnan(rows["to_go"])
    np.testing.assert_allclose(np.asarray(rows["to_go"])[known], seen.to_go)
    assert set(np.asarray(rows["slot"])[known]) == {0}


def test_a_trace_of_traffic_alone_knows_of_no_egos():
    scenario = jax.jit(sampler())(world_key(1))
    start = RUN.init(bundled("roundabout")[1], scenario.start)
    seen = part()(scenario.schedule, jax.random.key(5), start)[0].trace
    assert seen.driven is seen.to_go is seen.plan is seen.plan_time is None
    assert seen.vehicle_class.shape == (75, SLOTS)


def test_branches_of_a_world_begin_alike():
    scenario = jax.jit(sampler())(world_key(2))
    branches = fork(scenario.start, 3)
    for x, y in zip(jax.tree.leaves(branches), jax.tree.leaves(scenario.start), strict=True):
        assert x.shape == (3, *y.shape)
        np.testing.assert_array_equal(x[2], y)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="horizon of 0"):
        Rollout(Config(dt=0.1), Traffic(), horizon=0)
    with pytest.raises(ValueError, match="no seeds"):
        next(worlds().chunks([]))
    with pytest.raises(ValueError, match="seeds from -1"):
        next(worlds().chunks([-1]))
    with pytest.raises(ValueError, match="chunk of 0"):
        Worlds(RUN, bundled("roundabout")[1], sampler(), chunk=0)


def test_arrays_that_records_share_are_held_once():
    box, speed = jnp.ones((2, 5)), jnp.zeros(2)
    kept = Kept.of({"trace": (box, speed), "metrics": {"box": box, "same": jnp.zeros(2), "none": None}})
    assert len(kept.arrays) == 3, "equal values are not the same array"
    whole = jax.tree.map(lambda x: x + 1, kept).tree
    assert whole["trace"][0] is whole["metrics"]["box"] and whole["metrics"]["none"] is None
    np.testing.assert_array_equal(whole["trace"][1], [1, 1])
