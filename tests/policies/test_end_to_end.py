"""The end-to-end driver without the traffic engine: inputs, network, controller, filter, bad input."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, state_of

from limsim_jax.maps.scenery import TILE, Scenery
from limsim_jax.policies.base import check_policy, knows, needs_scenery
from limsim_jax.policies.end_to_end import EndToEnd, ObserveSensors, network
from limsim_jax.policies.end_to_end.control import (
    BRAKING,
    MARGIN,
    PASS,
    SAMPLES,
    UNBLOCK,
    Way,
    arc_through,
    filtered,
    free_distances,
    objects_of,
    pursue,
    safe_speed,
    way_through,
)
from limsim_jax.policies.end_to_end.inputs import BANDS, LIDAR_RANGE, RASTER, Sensors, _nearest, _raster
from limsim_jax.policies.end_to_end.network import (
    CHANGES,
    DENSITY_GRID,
    Design,
    Network,
    Outputs,
    Trained,
    blank_inputs,
    fresh_weights,
    load_weights,
    parameters,
    path_places,
    save_weights,
    target_speed,
    two_hot,
)
from limsim_jax.policies.end_to_end.policy import WEIGHTS
from limsim_jax.policies.host import HostPolicy
from limsim_jax.sensors.faults import Faults
from limsim_jax.sensors.rig import LAYERS_1, Camera, Rig, six_cameras
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.training.hybrid import SCENARIOS
from limsim_jax.types import Config

CONFIG = Config(dt=0.1)


@functools.cache
def weights():
    return jax.device_get(fresh_weights())


@jax.jit
def say(values, inputs):
    """What the network says of two samples: one program for all tests."""
    return Network().apply({"params": values}, inputs)


# --- network


def test_two_classes_have_the_mean_of_a_change():
    change = np.array([-9.0, -7.0, -5.5, -0.25, 0.0, 0.5, 2.9, 3.0, 8.0], np.float32)
    share = np.asarray(two_hot(jnp.asarray(change)))
    np.testing.assert_allclose(share.sum(-1), 1, atol=1e-6)
    np.testing.assert_allclose(share @ np.array(CHANGES), np.clip(change, -7, 3), atol=1e-5)
    assert ((share > 0).sum(-1) <= 2).all() and share[4, CHANGES.index(0.0)] == 1


def test_the_target_speed_is_the_mean_but_a_standing_vehicle_stays_if_that_is_likelier():
    logits = jnp.log(two_hot(jnp.array([1.5, -2.0, -7.0])) + 1e-9)
    np.testing.assert_allclose(
        target_speed(jnp.array([10.0, 10.0, 3.0]), logits), [11.5, 8.0, 0.0], atol=1e-3
    )
    doubt = jnp.log(0.6 * two_hot(jnp.zeros(1)) + 0.4 * two_hot(jnp.full(1, 2.0)) + 1e-9)
    assert target_speed(jnp.zeros(1), doubt)[0] == 0
    assert target_speed(jnp.ones(1), doubt)[0] == pytest.approx(1.8, abs=1e-3)


def test_path_points_are_two_metres_apart_and_farther_at_speed():
    places = np.asarray(path_places(jnp.array([0.0, 5.0, 20.0])))
    np.testing.assert_allclose(places[:, 0], [2, 2, 6])
    np.testing.assert_allclose(np.diff(places, axis=-1), np.repeat([[2], [2], [6]], 9, 1), rtol=1e-6)


@pytest.mark.parametrize("changes", [{}, {"cameras": False}, {"lidar": False}, {"waypoints": True}])
def test_shapes_of_all_designs(changes):
    design = Design(**changes)
    made = jax.eval_shape(lambda: fresh_weights(design))
    said = jax.eval_shape(lambda w: Network(design).apply({"params": w}, blank_inputs(3)), made)
    rows, columns = DENSITY_GRID.shape
    shapes = [x.shape for x in said]
    assert shapes == [(3, 10), (3, len(CHANGES)), (3, 8, 2), (3, rows, columns, 8), (3, 3)]
    assert ("pictures" in made) == design.cameras and ("window" in made) == design.lidar
    assert ("waypoints" in made) == design.waypoints
    assert sum(math.prod(x.shape) for x in jax.tree.leaves(made)) < 600_000


def test_the_density_map_lies_where_the_raster_does():
    blind = dict(weights())
    blind["context"] = jax.tree.map(np.zeros_like, blind["context"])  # each cell by its own window only
    rows, columns = RASTER.shape
    plain = blank_inputs(2)
    before = say(blind, plain).density
    for row, column in ((0, 0), (9, 5), (rows - 1, columns - 1)):
        changed = np.zeros(plain.raster.shape, np.uint8)
        changed[0, 0, row, column] = 1
        moved = (
            np.abs(np.asarray(say(blind, plain._replace(raster=jnp.asarray(changed))).density - before)).max(
                -1
            )[0]
            > 0
        )
        where = np.argwhere(moved)
        # the window of the point and, by its context of two cells, the next ones
        assert moved[row // 2, column // 2]
        assert np.abs(where - (row / 2, column / 2)).max() <= 4


def test_pictures_and_points_change_what_the_network_says():
    plain = blank_inputs(2)
    base = say(weights(), plain)
    red = np.array(plain.cameras)
    red[0, 1, 10, 30] = 255, 0, 0
    seen = say(weights(), plain._replace(cameras=jnp.asarray(red)))
    assert float(jnp.abs(seen.speed - base.speed).max()) > 1e-4
    near = say(weights(), plain._replace(bands=plain.bands.at[0, 0, 5, 0].set(5.0)))
    assert float(jnp.abs(near.speed - base.speed).max()) > 1e-4


# --- inputs


def test_the_raster_holds_points_where_they_are():
    x = jnp.array([[0.5, 47.9, -16.0, 48.0, 5.0]])
    y = jnp.array([[0.5, 23.9, -24.0, 0.0, 5.0]])
    there = jnp.array([[True, True, True, True, False]])
    raster = np.asarray(_raster(x, y, there))[0]
    rows, columns = RASTER.shape
    assert (rows, columns) == (32, 24)
    assert set(map(tuple, np.argwhere(raster))) == {(8, 12), (rows - 1, columns - 1), (0, 0)}


def test_bands_tell_the_nearest_point_ahead_and_behind():
    s, d = jnp.array([[12.0, 7.0, -4.0, 30.0, 3.0]]), jnp.array([[0.0, 0.1, 0.2, 4.0, 0.0]])
    found = np.asarray(_nearest(s, d, jnp.array([[True, True, True, True, False]])))[0]
    own, left = BANDS.index(-0.9), BANDS.index(3.5)
    np.testing.assert_allclose(found[own], [7, 4])
    np.testing.assert_allclose(found[left], [30, LIDAR_RANGE])
    assert (np.delete(found, [own, left], 0) == LIDAR_RANGE).all()


# --- controller


def test_the_arc_through_a_point_of_a_circle_is_that_circle():
    for radius, angle in ((20.0, 0.3), (-35.0, 0.2), (8.0, 1.0)):
        x, y = abs(radius) * math.sin(angle), radius * (1 - math.cos(angle))
        turned = 0.7  # all of it turned and moved
        c, s = math.cos(turned), math.sin(turned)
        bend = arc_through(*map(jnp.float32, (3, -2, turned, 3 + c * x - s * y, -2 + s * x + c * y)))
        assert float(bend) == pytest.approx(1 / radius, rel=1e-4)


def straight(count=64, step=1.0, egos=1):
    x = jnp.broadcast_to(step * jnp.arange(count, dtype=jnp.float32), (egos, count))
    return way_through(x, jnp.zeros_like(x), jnp.full(egos, step))


def test_on_a_straight_way_the_vehicle_goes_straight_and_reaches_its_speed():
    way = straight(egos=3)
    v, target = jnp.array([10.0, 10.0, 5.0]), jnp.array([11.0, 0.0, 5.0])
    motion = pursue(way, v, target, jnp.full(3, 2.8))
    assert motion.x.shape == (3, SAMPLES)
    np.testing.assert_allclose(motion.y, 0, atol=1e-6)
    np.testing.assert_allclose(motion.v[0, :11], 10 + 0.1 * np.arange(11), atol=1e-4)
    np.testing.assert_allclose(motion.v[0, 11:], 11, atol=1e-5)
    np.testing.assert_allclose(motion.v[1, :17], 10 - BRAKING * 0.1 * np.arange(17), atol=1e-4)  # 1.67 s to 0
    np.testing.assert_allclose(motion.v[1, 17:], 0, atol=1e-5)
    np.testing.assert_allclose(motion.x[2], 0.5 * np.arange(SAMPLES), atol=1e-4)


def test_on_a_circle_the_vehicle_follows_it():
    radius, step = 25.0, 0.5
    angle = step * np.arange(64) / radius
    x, y = radius * np.sin(angle), radius * (1 - np.cos(angle))
    x, y, heading = (jnp.asarray(values[None], jnp.float32) for values in (x, y, angle))
    way = Way(x, y, heading, jnp.full(1, step))
    motion = pursue(way, jnp.full(1, 8.0), jnp.full(1, 8.0), jnp.full(1, 2.8))
    off = np.hypot(motion.x, motion.y - radius) - radius
    assert np.abs(off).max() < 0.25
    # the body is level with the path at its rear axle, half a wheelbase behind its middle
    assert float(motion.heading[0, -1]) == pytest.approx((8.0 * 2.0 - 1.4) / radius, abs=0.02)


def test_from_beside_the_way_the_vehicle_comes_back():
    way = straight()
    aside = way._replace(y=way.y - 1.0)
    motion = pursue(aside, jnp.full(1, 8.0), jnp.full(1, 8.0), jnp.full(1, 2.8))
    assert float(motion.y[0, -1]) < -0.7 and (np.diff(np.asarray(motion.y[0])) < 1e-3).all()


# --- filter


def density_with(*boxes):
    """A density map with objects x, y, heading, length, width, v."""
    rows, columns = DENSITY_GRID.shape
    density = np.zeros((1, rows, columns, 8), np.float32)
    density[..., 0] = -5
    middle_x, middle_y = (m.ravel() for m in DENSITY_GRID.middles())
    for x, y, heading, length, width, v in boxes:
        row, column = np.argmin(np.abs(middle_x - x)), np.argmin(np.abs(middle_y - y))
        density[0, row, column] = (
            5, (x - middle_x[row]) / 4, (y - middle_y[column]) / 4, math.cos(heading), math.sin(heading),
            length / 5, width / 2, v / 10,
        )  # fmt: skip
    return jnp.asarray(density)


def test_objects_come_out_of_the_density_map_as_they_went_in():
    boxes_in = [(20.5, -3.2, 0.4, 4.6, 1.8, 7.0), (-7.0, 10.0, -2.5, 12.0, 2.5, 0.0)]
    found = objects_of(density_with(*boxes_in))
    there = np.asarray(found.there[0])
    assert there.sum() == 2
    got = np.stack([np.asarray(x[0])[there] for x in found[:6]], -1)
    np.testing.assert_allclose(got[np.argsort(-got[:, 0])], boxes_in, atol=1e-4)


def test_free_distances_are_those_to_the_boxes():
    way, size = straight(), (jnp.full(1, 5.0), jnp.full(1, 2.0))
    free = np.asarray(free_distances(way, objects_of(density_with((30.0, 0.0, 0.0, 4.0, 2.0, 0.0))), *size))
    # bumper to bumper 30 - 2 - 2.5 m; the next place that is tried hits
    assert (free >= 25.5).all() and (free <= 25.5 + 2.0).all()
    free = np.asarray(free_distances(way, objects_of(density_with((30.0, 0.0, 0.0, 4.0, 2.0, 8.0))), *size))[
        0
    ]
    np.testing.assert_allclose(np.diff(free), 4.0, atol=2.0)  # it moves on by 4 m in half a second
    aside = free_distances(way, objects_of(density_with((30.0, 4.0, 0.0, 4.0, 2.0, 0.0))), *size)
    assert (np.asarray(aside) > 500).all()
    here = free_distances(way, objects_of(density_with((1.0, 0.0, 0.0, 4.0, 2.0, 0.0))), *size)
    assert (np.asarray(here) > 500).all()  # an object on the ego itself is an error of the map


def test_a_follower_does_not_hold_the_ego():
    """Standing still does not avoid it, so it is no reason to stand."""
    way, size = straight(), (jnp.full(1, 5.0), jnp.full(1, 2.0))
    for back, v in ((12.0, 13.0), (9.0, 5.0), (14.0, 14.0)):
        behind = free_distances(way, objects_of(density_with((-back, 0.0, 0.0, 4.0, 2.0, v))), *size)
        assert (np.asarray(behind) > 500).all(), (back, v)
    # from the right, across the path ahead of the ego: it counts
    across = free_distances(way, objects_of(density_with((8.0, -8.0, np.pi / 2, 4.0, 2.0, 8.0))), *size)
    assert np.asarray(across)[0, 2] < 8.0
    # a fast one on the lane beside, as a density map has its heading: it stays there
    beside = density_with((-6.0, -3.5, 0.15, 4.0, 2.0, 30.0), (-6.0, 3.5, -0.15, 4.0, 2.0, 25.0))
    assert (np.asarray(free_distances(way, objects_of(beside), *size)) > 500).all()
    turns = free_distances(way, objects_of(density_with((6.0, -5.0, 0.4, 4.0, 2.0, 10.0))), *size)
    assert np.asarray(turns)[0, 2:].min() < 30.0
    # into the side of the ego: it does not, from then on
    into = free_distances(way, objects_of(density_with((0.0, -8.0, np.pi / 2, 4.0, 2.0, 8.0))), *size)
    assert (np.asarray(into)[0, 2:] > 500).all()


def test_the_safe_speed_ends_the_way_before_the_object():
    v = jnp.array([10.0, 10.0, 3.0, 10.0])
    free = jnp.array([[1e3] * 5, [12.0] * 5, [12.0] * 5, [1.0, 1e3, 1e3, 1e3, 1e3]])
    safe = np.asarray(safe_speed(v, free))
    assert safe[0] > 400
    assert safe[1] == pytest.approx(max(2 * (12 - MARGIN) / 2.0 - 10, 0))
    assert safe[2] == pytest.approx(2 * (12 - MARGIN) / 2.0 - 3)  # (3 + 7) / 2 m/s for 2 s are 10 m
    assert safe[3] == 0


def test_the_filter_lowers_speeds_holds_at_red_and_lets_go_in_the_end():
    clear, near, no = jnp.full((1, 5), 1e3), jnp.full((1, 5), 1.0), jnp.full((1, 3), -9.0)
    zero = jnp.zeros(1)
    target, held = filtered(jnp.full(1, 9.0), jnp.full(1, 10.0), clear, no, zero, 0.5)
    assert (float(target[0]), float(held[0])) == (10, 0)
    target, held = filtered(zero, jnp.full(1, 2.0), near, no, zero, 0.5)
    assert (float(target[0]), float(held[0])) == (0, 0.5)
    held = jnp.full(1, UNBLOCK)
    for _ in range(round(PASS / 0.5)):  # it is let go for a while, however fast it is by then
        target, held = filtered(jnp.full(1, 1.5), jnp.full(1, 2.0), near, no, held, 0.5)
        assert float(target[0]) == 2
    target, held = filtered(jnp.full(1, 1.5), jnp.full(1, 2.0), near, no, held, 0.5)
    assert (float(target[0]), float(held[0])) == (0, 0)
    red = jnp.array([[3.0, 3.0, 0.0]])
    target, held = filtered(zero, jnp.full(1, 2.0), clear, red, jnp.full(1, UNBLOCK), 0.5)
    assert (float(target[0]), float(held[0])) == (0, 0)  # at a red light it waits as long as it takes
    target, _ = filtered(jnp.full(1, 9.0), jnp.full(1, 9.5), clear, red, zero, 0.5)
    assert float(target[0]) == 0  # and it brakes for one
    for doubt in ([3.0, 0.5, 0.0], [-0.5, 3.0, 0.0]):  # perhaps red, perhaps not at a junction
        target, _ = filtered(jnp.full(1, 9.0), jnp.full(1, 9.5), clear, jnp.array([doubt]), zero, 0.5)
        assert float(target[0]) == 9.5


# --- weights and bad input


def test_weights_come_back_from_the_disk(tmp_path):
    file = tmp_path / "w.npz"
    save_weights(file, Trained(Design(hidden=24), fresh_weights(Design(hidden=24), 3), {"seeds": [1, 2]}))
    back = load_weights(str(file))
    assert back.design == Design(hidden=24) and back.about == {"seeds": [1, 2]}
    wanted = fresh_weights(Design(hidden=24), 3)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-4), back.weights, dict(wanted)
    )
    assert parameters(back.weights) == parameters(wanted)
    policy = EndToEnd(str(file))
    assert policy.trained.about == back.about
    save_weights(file, Trained(Design(hidden=24), fresh_weights(Design(hidden=24), 4), {}))
    again = EndToEnd(str(file))  # other weights under the same name are another policy
    assert again.content != policy.content == EndToEnd(network=back).content


def refused(match, **options):
    with pytest.raises(ValueError, match=match) as error:
        EndToEnd(**options)
    assert "\n" not in str(error.value)


def test_bad_weights_are_refused_in_one_line(tmp_path):
    refused("nowhere.npz: no weights: No such file", weights=str(tmp_path / "nowhere.npz"))
    text = tmp_path / "text.npz"
    for content in ("", "hello"):
        text.write_text(content)
        refused("text.npz: no weights of an end-to-end driver", weights=str(text))
    other = tmp_path / "other.npz"
    np.savez(other, kernel=np.zeros(3))
    refused("other.npz: no weights of an end-to-end driver", weights=str(other))
    wrong = dict(weights())
    wrong["path"] = {"kernel": np.zeros((7, 10)), "bias": np.zeros(10)}
    save_weights(tmp_path / "wrong.npz", Trained(Design(), wrong, {}))
    refused(
        r"wrong.npz: path/kernel is of shape \[7, 10\]; this network has \[192, 10\]",
        weights=str(tmp_path / "wrong.npz"),
    )
    save_weights(tmp_path / "less.npz", Trained(Design(), {"path": wrong["path"]}, {}))
    refused("less.npz: .* is missing", weights=str(tmp_path / "less.npz"))


def test_the_weights_of_the_package_have_a_card():
    assert WEIGHTS.stat().st_size < 1e6
    trained = EndToEnd().trained
    assert trained.design == Design()
    about = trained.about
    assert set(about["seeds"]) == set(about["samples"]) == set(SCENARIOS)
    assert all(first >= 2_000_000 for first, _ in about["seeds"].values())
    assert about["seconds"] < 20 * 60 and len(about["source"]) == 16
    first, last = about["curve"][0], about["curve"][-1]
    assert last["loss"] < first["loss"]


def test_planners_on_the_host_may_have_the_same_sensors():
    planner = HostPolicy(lambda seen: {}, observe=ObserveSensors())
    assert planner.privileged and needs_scenery(planner) and knows(planner) == "sensors"
    assert not HostPolicy(lambda seen: {}).privileged and knows(HostPolicy(lambda seen: {})) == "view"
    six = ObserveSensors(six_cameras(32, 18, lidar=LAYERS_1))  # any rig, unlike our own network
    assert len(six.rig.cameras) == 6
    with pytest.raises(ValueError, match="rig: cameras and a lidar are needed"):
        ObserveSensors(Rig(lidar=LAYERS_1))


def test_rigs_and_faults_that_do_not_fit_are_refused():
    known = Trained(Design(), weights(), {})
    refused("rig: no camera; the driver needs three", network=known, rig=Rig(lidar=LAYERS_1))
    refused("rig: no lidar", network=known, rig=Rig(cameras=Sensors().rig.cameras))
    refused("rig: 1 cameras of 64 x 36", network=known, rig=Rig(cameras=(Camera(),), lidar=LAYERS_1))
    refused("faults: .*'colour'", network=known, faults={"colour": 1})
    refused("no camera 'roof'", network=known, faults={"dropped": ["roof"]})
    refused("faults: delay", network=known, faults={"delay": 0.1})
    refused("privileged", network=known, privileged=False)
    assert EndToEnd(network=known, faults={"dropped": ["front"]}).faults == Faults(dropped=("front",))


@functools.cache
def moment():
    """A map without scenery, and a vehicle under test behind another one."""
    lane_map = bundled("highway")[1]
    row, goal = motorway()
    state = state_of("highway", [row] * 2, [60.0, 100.0], [20.0, 15.0], [goal] * 2)
    egos = from_lane(lane_map, state, boxes(lane_map, state), [0], True)
    return lane_map, dataclasses.replace(state, egos=egos)


def bare_ground(lane_map):
    """The map with open country around."""
    lanes = lane_map.length.shape[0]
    scenery = Scenery(
        corner=jnp.zeros(2),
        tile=jnp.zeros((8, 8), jnp.int32),
        paint=jnp.ones((1, TILE, TILE), jnp.uint8),
        light=jnp.zeros((16, 3)),
        light_lane=jnp.full(16, -1),
        turn=jnp.zeros(lanes, jnp.int32),
    )
    return dataclasses.replace(lane_map, scenery=scenery)


@pytest.mark.parametrize("faults", [None, {"freeze_rate": 0.1, "position_drift": 0.05}])
@pytest.mark.parametrize("design", [Design(), Design(waypoints=True)])
def test_a_decision_is_a_sound_command(faults, design):
    lane_map, state = moment()
    known = Trained(design, fresh_weights(design), {})
    check_policy(EndToEnd(network=known, faults=faults), CONFIG, bare_ground(lane_map), state)


def test_a_planner_on_the_host_gets_the_arrays_of_the_sensors():
    lane_map, state = moment()
    found = jax.eval_shape(lambda lanes: ObserveSensors()(CONFIG, lanes, state), bare_ground(lane_map))
    assert found.cameras.shape == (1, 3, 36, 64, 3) and found.lidar.shape == (1, 3, 360)
    assert found.route_x.shape == (1, 48) and found.v.shape == (1,)


def test_without_scenery_it_says_what_is_missing():
    lane_map, state = moment()
    policy = EndToEnd(network=Trained(Design(), weights(), {}))
    assert policy.needs_scenery and policy.free and policy.knows == "sensors"
    memory = policy.init(CONFIG, lane_map, state)
    with pytest.raises(ValueError, match="lane_map: no scenery"):
        policy(CONFIG, lane_map, state, memory, jax.random.key(0))


def test_outputs_of_a_batch_are_those_of_its_members():
    draw = np.random.default_rng(0)
    many = jax.tree.map(
        lambda x: jnp.asarray(
            draw.integers(0, 2, x.shape) if x.dtype == jnp.uint8 else draw.random(x.shape), x.dtype
        ),
        blank_inputs(2),
    )
    both = say(weights(), many)
    assert isinstance(both, Outputs)
    other = say(weights(), jax.tree.map(lambda x: x[::-1], many))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y[::-1], rtol=1e-4, atol=1e-5), both, other)
    assert network.WAYPOINTS == both.waypoints.shape[1]
