"""The live bridge to CARLA, with the real client library and a double of the server."""

import dataclasses
import math
import sys
import types

import numpy as np
import pytest
from carla_double import Actor, Double, Faults, Light
from lane_worlds import lane_world
from paths import REPO

from limsim_jax.bridges.carla.camera import Camera, Mount, decoded
from limsim_jax.bridges.carla.live import between
from limsim_jax.bridges.carla.server import CarlaError, CarlaServer, Pose, Show, play
from limsim_jax.bridges.carla.stage import lanes_showing, set_stage, signal_heads, stage_of
from limsim_jax.maps.map import load_map
from limsim_jax.recordings.carla_bodies import BODIES

TOWN = REPO / "maps" / "intersection.xodr"


@pytest.fixture(scope="module")
def carla():
    return pytest.importorskip("carla")


@pytest.fixture(scope="module")
def crossing():
    return load_map("intersection")


@pytest.fixture(scope="module")
def world(crossing):
    return lane_world(crossing, vehicles=6, seconds=2.0)


@pytest.fixture(scope="module")
def their_town(carla):
    return carla.Map("intersection", TOWN.read_text())


@pytest.fixture
def make(carla, crossing, their_town):
    def make(**faults):
        double = Double(their_town, carla, faults=Faults(**faults))
        return double, CarlaServer(crossing, client=double, timeout=0.2)

    return make


def left_as_found(double: Double) -> None:
    assert not double.settings.synchronous_mode and double.settings.fixed_delta_seconds is None
    assert not [a for a in double.actors.values() if a.type_id.startswith(("vehicle.", "sensor."))]


# --- what works -------------------------------------------------------------------------------------------


def test_a_recorded_world_is_shown_at_its_places(make, world):
    double, server = make()
    seen = []
    stage = stage_of(world)

    def look(frame, time):
        here = np.flatnonzero(stage.present[len(seen)])
        middle = []
        for actor in double.vehicles:
            transform, ahead = actor.get_transform(), BODIES[actor.type_id].ahead
            # the middle of the body, by CARLA's own matrix
            p = transform.transform(double.carla.Location(x=ahead, y=0.0, z=0.0))
            middle.append((p.x, -p.y))
            assert not actor.physics
        ours = [(stage.x[len(seen), k], stage.y[len(seen), k]) for k in here]
        assert len(middle) == len(ours)
        for o in ours:
            assert min(math.dist(o, m) for m in middle) < 1e-3
        turned = sorted(
            -math.radians(a.get_transform().rotation.yaw) % (2 * math.pi) for a in double.vehicles
        )
        expected = sorted(stage.heading[len(seen), here] % (2 * math.pi))
        assert np.cos(np.subtract(turned, expected)) == pytest.approx(1.0, abs=1e-5)
        seen.append((frame, time))

    with server:
        assert double.settings.synchronous_mode and double.settings.fixed_delta_seconds == 0.1
        assert play(world, server, on_tick=look) == len(stage.time) == double.ticks
    assert [t for _, t in seen] == pytest.approx(stage.time.tolist())
    assert [f for f, _ in seen] == list(range(101, 101 + len(seen)))
    left_as_found(double)


def test_physics_is_off_before_the_server_ticks(make, world):
    double, server = make()
    with server:
        play(world, server)
    spawned = [c for c in double.calls if c[0] == "spawn"]
    off = [c for c in double.calls if c[0] == "physics"]
    assert len(spawned) == len(off) == world.trace.active.shape[1] and not any(c[2] for c in off)
    order = [c[0] for c in double.calls if c[0] in ("spawn", "physics")]
    assert order == ["spawn", "physics"] * len(off)
    assert all(height > 50 for _, _, height in spawned)  # where there is room


def test_brake_lights_and_kinds_of_vehicles(make, world):
    double, server = make()
    braking = dataclasses.replace(world, trace=world.trace._replace(a=np.full_like(world.trace.a, -3.0)))
    lamps, kinds = set(), set()

    def look(frame, time):
        lamps.update(a.lamps for a in double.vehicles)
        kinds.update(BODIES[a.type_id].vehicle_class for a in double.vehicles)

    with server:
        play(braking, server, on_tick=look)
    assert lamps == {9} and kinds == {"car", "truck", "bus", "motorcycle"}


def lit(double: Double, world) -> list[Light]:
    """A light of CARLA 0.3 m beside each of ours, and one far away."""
    carla, lights = double.carla, []
    for k, light in enumerate(stage_of(world).lights):
        x, y, z = light.position
        at = carla.Transform(carla.Location(x=x + 0.3, y=-y, z=z))
        lights.append(double.add(Light(double, 2 + k, at)))
    double.add(Light(double, 40, carla.Transform(carla.Location(x=5000.0))))
    return lights


def test_our_lights_are_shown_and_given_back(make, world):
    double, server = make()
    lights = lit(double, world)
    stage, shown = stage_of(world), []
    with server:
        play(world, server, on_tick=lambda *_: shown.append([str(x.state) for x in lights]))
    names = np.array(["Red", "Yellow", "Green", "Off"])
    assert len(lights) > 3 and shown == names[stage.states].tolist()
    assert [c for c in double.calls if c[0] == "freeze"] == [("freeze", True), ("freeze", False)]
    switched = [c for c in double.calls if c[0] == "light"]
    assert len(switched) < len(shown) * len(lights) and not [c for c in switched if c[1] == 40]


def test_carlas_lights_are_read(make, world, crossing):
    double, server = make()
    lights = lit(double, world)
    heads = signal_heads(crossing.network, crossing.lanes)
    names = ["Green", "Yellow", "Red", "Off", "Unknown"]
    for k, light in enumerate(lights):
        light.state = getattr(double.carla.TrafficLightState, names[k % 5])
    with server:
        shown = server.read_lights([head.light for head in heads])
    assert list(shown.values()) == [names[k % 5].lower() for k in range(len(heads))]
    seen = lanes_showing(crossing.lanes, heads, shown).signals
    programs = list(crossing.network.programs.values())
    meant = {"yellow": "y", "red": "r", "off": "o"}
    for head in heads:
        lanes = {spot.lane for spot in head.light.spots}
        own = [m for m in crossing.network.movements if {m.incoming, *m.via} & lanes and m.program]
        assert {m.link for m in own} == set(head.links)
        for m in own:
            letters = ["rygGusoO"[int(seen.state[head.program, p, m.link])] for p in range(6)]
            before = [phase.state[m.link] for phase in programs[head.program].phases[:6]]
            name = shown[head.light.id]
            own_green = (
                "G" if any("G" in phase.state[m.link] for phase in programs[head.program].phases) else "g"
            )
            expected = own_green if name == "green" else meant.get(name)
            assert letters == (before if expected is None else [expected] * 6)


def test_vehicles_of_others_are_seen_and_left_alone(make, world, carla):
    double, server = make()
    place = carla.Transform(carla.Location(x=5.0, y=-7.0, z=0.5), carla.Rotation(yaw=-90.0))
    hero = double.add(Actor(double, 7, "vehicle.tesla.model3", place, "hero"))
    hero.velocity = carla.Vector3D(3.0, 4.0, 0.0)
    with server:
        shown = []
        play(world, server, on_tick=lambda *_: shown.append((len(double.vehicles), server.foreign())))
    assert min(count for count, _ in shown) > 3 and all(len(others) == 1 for _, others in shown)
    (found,) = shown[-1][1]
    assert (found.id, found.blueprint, found.role, found.v) == (7, "vehicle.tesla.model3", "hero", 5.0)
    assert found.pose.heading == pytest.approx(math.pi / 2)
    assert (found.pose.x, found.pose.y) == pytest.approx((5.0, 7.1), abs=1e-6)  # its box is 0.1 m ahead
    assert (found.length, found.width) == pytest.approx((4.8, 2.0))
    assert hero.is_alive and hero.transform is place and double.vehicles == [hero]


def test_pictures_of_cameras(make, world):
    double, server = make()
    with server:
        show, stage = Show(server), stage_of(world)
        show.moment(stage, 0)
        first, second = sorted(show.present)[:2]
        with pytest.raises(CarlaError, match="no picture of kind 'rgb'"):
            server.images()
        for vehicle in (first, second):
            server.camera(vehicle, width=8, height=4, mount=Mount(x=1.0, y=0.5, yaw=0.1))
        server.camera(first, "depth", width=6, height=5)
        frame = show.moment(stage, 1)
        pictures = server.images()
        assert pictures.shape == (2, 4, 8, 3) and pictures.dtype == np.uint8
        assert pictures[1, 2, 3].tolist() == [frame % 256, 2, 1]
        depth = server.images("depth")
        assert depth.shape == (1, 5, 6, 1) and depth.dtype == np.float32
        server.camera(first, "rgb", width=2, height=2)
        show.moment(stage, 2)
        with pytest.raises(CarlaError, match="of several sizes"):
            server.images()
        sensors = [a for a in double.actors.values() if a.type_id.startswith("sensor.")]
        at = sensors[0].transform
        assert (at.location.y, at.rotation.yaw) == pytest.approx((-0.5, -math.degrees(0.1)))
        server.destroy([second])
        assert len(server.images("depth")) == 1 and len(server._cameras) == 3
    left_as_found(double)


def test_depth_and_classes_are_decoded():
    def pixel(r, g, b):
        return bytes([b, g, r, 255])

    raw = pixel(0, 0, 0) + pixel(255, 255, 255) + pixel(0, 0, 128) + pixel(10, 20, 30)
    depth = decoded("depth", raw, 2, 2)[..., 0]
    expected = [0.0, 1000.0, 1000 * 128 * 65536 / 16777215, 1000 * (10 + 256 * 20 + 65536 * 30) / 16777215]
    assert depth.ravel().tolist() == pytest.approx(expected, rel=1e-6)
    assert decoded("rgb", raw, 2, 2)[1, 1].tolist() == [10, 20, 30]
    assert decoded("semantic", raw, 2, 2).ravel().tolist() == [0, 255, 0, 10]
    with pytest.raises(ValueError, match="12 bytes; 16 are expected of 2 x 2 pixels"):
        decoded("rgb", raw[:12], 2, 2)
    with pytest.raises(ValueError, match="camera: 'x-ray'; known are rgb"):
        Camera(0, "x-ray", 2, 2)  # pyright: ignore
    camera = Camera(0, "rgb", 2, 2)
    for frame in (3, 4):
        camera.put(types.SimpleNamespace(frame=frame, raw_data=raw, height=2, width=2))
    assert camera.wait(4, 0.1) and not camera.wait(5, 0.01)


def test_moments_between_two_states(world):
    t = world.trace
    one, two = (type(t)(*(None if x is None else x[k] for x in t)) for k in (3, 8))
    found = between(one, two, 5)
    assert len(found) == 5 and found[-1] is two
    both = one.active & two.active
    assert np.abs(found[1].box[both, :2] - t.box[5, both, :2]).max() < 0.2
    assert [m.time for m in found] == pytest.approx([float(x) for x in t.time[4:9]], abs=1e-6)
    gone = two._replace(active=np.zeros_like(two.active))
    assert not between(one, gone, 5)[0].active.any()


# --- what goes wrong --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ({"spawn_returns_none": True}, "vehicle -?[0-9]+: vehicle[.a-z_0-9]+ was not spawned, 3 tries"),
        ({"tick_times_out_at": 4}, "tick: time-out of 10000ms while waiting for the simulator, make sure"),
        ({"actor_dies_at": 3}, r"vehicle -?\d+: actor 50 not found"),
        ({"physics_fails": True}, r"vehicle -?\d+: .*: time-out"),
    ],
)
def test_faults_end_in_one_line_and_nothing_is_left(make, world, faults, message):
    double, server = make(**faults)
    with pytest.raises(CarlaError, match=f"^CARLA at 127.0.0.1:2000: {message}") as caught, server:
        play(world, server)
    assert "\n" not in str(caught.value)
    left_as_found(double)


def test_a_place_that_is_taken_is_tried_higher(make, world):
    double, server = make(spawn_blocked=2)
    with server:
        play(world, server)
    heights = [z for call, _, z in (c for c in double.calls if c[0] == "spawn")][:3]
    assert np.diff(heights) == pytest.approx([20.0, 20.0])


def test_an_exception_of_the_user_comes_through_and_all_is_undone(make, world):
    double, server = make(destroy_fails=True)
    with pytest.raises(ZeroDivisionError), server:
        play(world, server, on_tick=lambda *_: 1 // 0)
    assert not double.settings.synchronous_mode  # although the vehicles could not be destroyed
    double, server = make()
    with pytest.raises(KeyboardInterrupt), server:
        server.spawn(stage_of(world).cast[0], Pose(0, 0, 0, 0))
        raise KeyboardInterrupt
    left_as_found(double)
    double, server = make(destroy_fails=True)
    with pytest.raises(CarlaError, match="not all was undone: vehicles: time-out"), server:
        server.spawn(stage_of(world).cast[0], Pose(0, 0, 0, 0))
    assert not double.settings.synchronous_mode


def test_a_camera_without_pictures(make, world):
    double, server = make(no_images=True)
    with pytest.raises(CarlaError, match=r"camera 'rgb' has no picture of frame 102 after 0.2 s"), server:
        show = Show(server)
        show.moment(stage_of(world), 0)
        server.camera(min(show.present), width=4, height=4)
        show.moment(stage_of(world), 1)
    left_as_found(double)


def test_a_server_that_does_not_fit(make, world, carla, crossing):
    double, server = make(server="0.9.15")
    with pytest.raises(
        CarlaError, match=r"version 0\.9\.15, and the client library is 0\.9\.16; one .*==0\.9\.15"
    ):
        server.__enter__()
    double, server = make(settings_fail=True)
    with pytest.raises(CarlaError, match="synchronous mode: time-out"):
        server.__enter__()
    left_as_found(double)
    other = Double(carla.Map("highway", (REPO / "maps" / "highway.xodr").read_text()), carla)
    with pytest.raises(CarlaError, match=r"its map highway differs from .*: \d+ of \d+ lanes are not there"):
        CarlaServer(crossing, client=other).__enter__()
    assert not other.settings.synchronous_mode
    bare = Double(carla.Map("x", TOWN.read_text()), carla, blueprints=("vehicle.own.car",))
    with pytest.raises(CarlaError, match="has none of the known vehicles"):
        CarlaServer(crossing, client=bare).__enter__()
    with pytest.raises(ValueError, match=r"dt: 0\.5 s; ticks of more than 0 and at most 0\.1 s"):
        CarlaServer(crossing, client=double, dt=0.5)
    double, server = make()
    server.dt = 0.05
    with pytest.raises(ValueError, match=r"ticks by 0\.05 s and the world by 0\.1 s"), server:
        play(world, server)
    with pytest.raises(CarlaError, match="no vehicle 77 of ours"):
        server.move({77: Pose(0, 0, 0, 0)}, {})


def test_no_server_answers(carla, crossing):
    """The real client library, and no server."""
    server = CarlaServer(crossing, host="127.0.0.1", port=2998, timeout=0.3)
    with pytest.raises(
        CarlaError, match=r"^CARLA at 127.0.0.1:2998: the version: time-out of 300ms"
    ) as caught:
        server.__enter__()
    assert "\n" not in str(caught.value)


def test_without_the_client_library(crossing, monkeypatch):
    monkeypatch.setitem(sys.modules, "carla", None)
    with pytest.raises(ImportError, match=r'pip install "limsim-jax\[carla\]"'):
        CarlaServer(crossing)


def test_the_real_commands_take_what_we_give(carla, crossing):
    """Transforms of the real library: matrix, mirrored axes and order of angles."""
    server = CarlaServer(crossing, client=object())
    pose = Pose(10.0, 20.0, 3.0, math.radians(30), math.radians(10))
    made = server._transform(pose, "vehicle.ford.ambulance")
    command = carla.command.ApplyTransform(5, made)
    assert command.actor_id == 5
    middle = command.transform.transform(carla.Location(x=BODIES["vehicle.ford.ambulance"].ahead))
    assert (middle.x, -middle.y, middle.z) == pytest.approx(pose[:3], abs=1e-4)
    ahead = command.transform.get_forward_vector()
    level = math.cos(pose.pitch)
    expected = level * math.cos(pose.heading), -level * math.sin(pose.heading), math.sin(pose.pitch)
    assert (ahead.x, ahead.y, ahead.z) == pytest.approx(expected, abs=1e-5)


def test_a_stage_of_nothing(crossing, world):
    empty = world.trace._replace(active=np.zeros_like(world.trace.active))
    stage = set_stage(crossing, empty)
    assert stage.cast == () and stage.x.shape == (len(empty.time), 0)


# --- experiments and environments, step by step -----------------------------------------------------------


@pytest.mark.engine
def test_an_experiment_beside_carla(carla, crossing, their_town):
    """Our traffic appears in CARLA; the ego is a hero of CARLA, and lights are CARLA's."""
    import limsim_jax as lj
    from limsim_jax.bridges.carla.live import EnvShow, Live

    experiment = lj.Experiment("intersection", horizon=20.0)
    double = Double(their_town, carla)
    with CarlaServer(crossing, client=double, dt=experiment.file.dt) as server:
        live = Live(experiment, server, hero="hero", lights="carla")
        lights = [head.light for head in signal_heads(crossing.network, crossing.lanes)]
        for k, light in enumerate(lights):
            at = carla.Transform(carla.Location(x=light.position[0], y=-light.position[1]))
            double.add(Light(double, 2 + k, at))
        with pytest.raises(CarlaError, match="0 vehicles with the role 'hero'"):
            live.step()
        lane = next(lane for lane in crossing.network.drivable_lanes() if lane.length > 100)
        hero = double.add(Actor(double, 40, "vehicle.tesla.model3", carla.Transform(), "hero"))
        for k in range(3):
            (xyz,), (heading,) = lane.pose([60.0 + 2 * k])
            hero.transform = carla.Transform(
                carla.Location(x=xyz[0], y=-xyz[1]), carla.Rotation(yaw=-math.degrees(heading))
            )
            hero.velocity = carla.Vector3D(4.0 * math.cos(heading), -4.0 * math.sin(heading), 0.0)
            stage = live.step()
            assert len(stage.time) == live.config.decision_every
            ours = [a for a in double.vehicles if a is not hero]
            (ego,) = [j for j, one in enumerate(stage.cast) if one.ego]
            assert len(ours) == stage.present[-1].sum() - 1  # the hero is there anyway
            # from where it was, straight on at its speed; the body is 0.1 m ahead of the actor
            steps = len(stage.time) * live.config.dt
            there = lane.pose(60.1 + 2 * k + 4.0 * steps)[0]
            assert math.dist((stage.x[-1, ego], stage.y[-1, ego]), there[:2]) < 0.05
            assert stage.v[-1, ego] == pytest.approx(4.0, abs=0.2)
            assert stage.cast[ego].length == pytest.approx(4.8)
            assert (stage.states[-1] == 0).all()  # all of CARLA's lights are red
        assert not [c for c in double.calls if c[0] in ("light", "freeze")]
        live.clear()
        assert double.vehicles == [hero] and live.time == pytest.approx(1.5)
    with pytest.raises(ValueError, match="hero, policy"):
        Live(experiment, server, hero="hero", policy=lj.FollowLane())

    env = lj.Env(experiment)
    import jax
    import jax.numpy as jnp

    double = Double(their_town, carla)
    with CarlaServer(crossing, client=double, dt=env.config.dt) as server:
        show = EnvShow(env, server)
        _, state = env.reset(jax.random.key(0))
        assert show.state(state) == 1
        before = len(double.moves)
        action = {"acceleration": jnp.zeros(1), "steering": jnp.zeros(1)}
        _, state, *_ = env.step(jax.random.key(1), state, action)
        assert show.state(state) == env.config.decision_every
        ego = next(a for a in double.vehicles if a.attributes["role_name"] == "limsim_ego")
        x0, y0 = np.asarray(env.lanes.origin, float)
        at = ego.transform.transform(carla.Location(x=BODIES[ego.type_id].ahead))
        egos = state.world.egos
        assert (at.x, -at.y) == pytest.approx((egos.x[0] + x0, egos.y[0] + y0), abs=1e-2)
        path = [moves[ego.id].location.x for moves in double.moves[before:] if ego.id in moves]
        assert np.std(np.diff(path)) < 1e-3 + 0.05 * abs(np.mean(np.diff(path)))
        show.clear()
        assert not double.vehicles
