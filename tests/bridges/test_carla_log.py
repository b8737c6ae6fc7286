"""Recorder logs of CARLA: bytes, scenes from them, and worlds written as logs."""

import dataclasses
import gzip
import math
import struct
from collections.abc import Sequence

import numpy as np
import pytest
from lane_worlds import lane_world
from log_parser import parse
from paths import REPO, SHARED, needs_shared

from limsim_jax.bridges.carla.log import carla_log, write_log
from limsim_jax.bridges.carla.stage import stage_of, town_of
from limsim_jax.log_replay.scene import load_scene
from limsim_jax.maps.lane_map import VEHICLE_CLASSES
from limsim_jax.maps.map import load_map
from limsim_jax.recordings import RecordingError, read_recording, read_tracks
from limsim_jax.recordings.carla_bodies import BODIES, blueprint_for, body_of
from limsim_jax.recordings.carla_log import (
    RECORDS,
    Actor,
    ActorType,
    Attribute,
    CarlaLog,
    Frame,
    Kind,
    Packet,
    from_carla,
    parse_log,
    read_log,
    save_log,
    to_carla,
)

REAL = SHARED / "carla_logs" / "town01_lane_center.log.gz"
TOWNS = ["carla_town01", "carla_town03", "carla_town04", "carla_town05", "carla_town06"]


@pytest.fixture(scope="module")
def crossing():
    return load_map("intersection")


@pytest.fixture(scope="module")
def world(crossing):
    return lane_world(crossing, vehicles=8)


@pytest.fixture(scope="module")
def written(world) -> bytes:
    return carla_log(world).to_bytes()


@pytest.fixture(scope="module")
def parsed(written):
    return parse(written)


# --- bytes --------------------------------------------------------------------------------------------------


@needs_shared
def test_a_log_of_a_server_comes_back_byte_for_byte(tmp_path):
    data = gzip.decompress(REAL.read_bytes())
    log = read_log(REAL)
    assert log.map == "Town01" and len(log.frames) == 432 and log.frames[-1].duration == -1.0
    assert log.to_bytes() == data
    theirs, ours = parse(data)["frames"], log.frames
    kinds = {"positions": Kind.POSITION, "kinematics": Kind.KINEMATICS, "lights": Kind.TRAFFIC_LIGHT}
    for name, kind in kinds.items():
        for k in (0, 200, 431):
            expected = [tuple(np.hstack(row).tolist()) for row in ours[k].records(kind).tolist()]
            assert np.array(theirs[k].get(name, [])).tolist() == np.array(expected).tolist()
    assert sum(len(f["add"]) for f in theirs) == len(list(log.actors()))
    for name in ("plain.log", "packed.log.gz"):
        save_log(tmp_path / name, log)
        assert read_log(tmp_path / name).to_bytes() == data
    assert (tmp_path / "plain.log").read_bytes() == data


def test_every_kind_of_packet_comes_back():
    def records(kind, count):
        size = RECORDS[kind].itemsize
        return np.frombuffer(bytes(range(1, 1 + size)) * count, RECORDS[kind])

    actor = Actor(7, 1, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 26, "vehicle.ä", (Attribute(4, "color", "1,2,3"),))
    packets = [Packet(kind, records(kind, k)) for k, kind in enumerate(RECORDS)]
    packets += [Packet(Kind.ADD, (actor,)), Packet(Kind.PLATFORM_TIME, 1.25), Packet(200, b"custom")]
    log = CarlaLog(map="Town", date=-5, frames=(Frame(1, -1.0, 0.0, tuple(packets)),))
    again = parse_log("x", log.to_bytes())
    assert again.to_bytes() == log.to_bytes()
    assert again.frames[0].added == (actor,) and again.date == -5
    assert [p.kind for p in again.frames[0].packets] == [p.kind for p in packets]


def frames_of(data: bytes) -> int:
    """Where the frames begin."""
    place = 4 + struct.unpack_from("<H", data, 2)[0] + 8
    return place + 2 + struct.unpack_from("<H", data, place)[0]


def test_a_truncated_log_is_refused_at_any_byte(written):
    begin = frames_of(written)
    whole = {begin}  # where a frame ends, the file may end
    place = begin
    while place < len(written):
        kind, size = struct.unpack_from("<BI", written, place)
        place += 5 + size
        if kind == 1:
            whole.add(place)
    rng = np.random.default_rng(0)
    for cut in [*range(1, 300), *rng.integers(300, len(written), 300).tolist()]:
        if cut in whole - {begin}:
            continue
        with pytest.raises(RecordingError, match=r"^cut\.log: byte \d+: .*expected") as caught:
            parse_log("cut.log", written[:cut])
        assert "\n" not in str(caught.value)


def test_a_hostile_log_ends_in_one_line(written):
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(400):
        data = bytearray(written[:4000])
        for place in rng.integers(0, len(data), 4):
            data[place] = rng.integers(256)
        try:
            parse_log("bad.log", bytes(data))
        except RecordingError as error:
            found += 1
            assert "\n" not in str(error) and "byte" in str(error)
    assert found > 300


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d, b: d[:2] + d[2:].replace(b"CARLA_RECORDER", b"CARLA_RECORDEX", 1), "byte 2: the mark is"),
        (lambda d, b: b"time,x,y\n" * 9, r"byte 2: the mark is ',x,y.*'; CARLA_RECORDER, of a recorder log"),
        (lambda d, b: b"hello\n", r"byte 2: the mark is 'o.*'; CARLA_RECORDER, of a recorder log"),
        (lambda d, b: b"\x02\x00" + d[2:], "byte 0: version 2; version 1 is expected"),
        (lambda d, b: d[:b], "no frames"),
        (lambda d, b: d[:b] + b"\x06" + d[b + 1 :], r"packet 6 of 24 bytes; the start of a frame"),
        (lambda d, b: d[:b] + d[b : b + 29] * 2 + d[b + 29 :], r"byte \d+: frame 1 has no end"),
        (lambda d, b: d[: b + 29] + struct.pack("<BIH", 6, 30, 2) + bytes(28) + d[b + 29 :],
         "packet 6 has 30 bytes for 2 records of 28 bytes; 58 are expected"),
        (lambda d, b: d[: b + 29] + struct.pack("<BI", 6, 2**32 - 1) + d[b + 29 :], "ends within packet 6"),
        (lambda d, b: d[: b + 29] + struct.pack("<BIH", 2, 4, 9) + b"ab" + d[b + 29 :],
         "ends within an actor"),
        (lambda d, b: d[: b + 29] + struct.pack("<BIHB", 2, 3, 0, 0) + d[b + 29 :], "after the last actor"),
        (lambda d, b: d[: b + 29] + struct.pack("<BIB", 1, 1, 0) + d[b + 29 :],
         "the end of frame 1 has 1 bytes"),
        (lambda d, b: d[: b + 29] + struct.pack("<BIB", 14, 1, 0) + d[b + 29 :], "packet 14 has 1 bytes"),
    ],
)  # fmt: skip
def test_errors_name_the_byte(written, change, message):
    with pytest.raises(RecordingError, match=message):
        parse_log("x.log", change(written, frames_of(written)))


def test_other_readers_say_what_a_log_is(tmp_path, world):
    write_log(tmp_path / "w.log", world)
    with pytest.raises(RecordingError, match="recorder log of CARLA; `load_scene`"):
        read_recording(tmp_path / "w.log")
    with pytest.raises(RecordingError, match="map: was recorded in OpenDriveMap; its OpenDRIVE file"):
        load_scene(tmp_path / "w.log")
    (tmp_path / "t.csv").write_text("scenario,step\n")
    with pytest.raises(RecordingError, match="expected of a log of CARLA, and of no other"):
        read_tracks(tmp_path / "t.csv", dt=0.1)


def test_the_frame_is_mirrored_and_turned():
    location, yaw = to_carla(1.0, 2.0, 3.0, math.radians(30))
    assert location.tolist() == [100.0, -200.0, 300.0] and yaw == pytest.approx(-30)
    x, y, z, heading = from_carla(location, yaw)
    assert (x, y, z) == (1.0, 2.0, 3.0) and heading == pytest.approx(math.radians(30))
    carla = pytest.importorskip("carla")
    ahead = carla.Transform(carla.Location(), carla.Rotation(yaw=float(yaw))).get_forward_vector()
    assert (ahead.x, -ahead.y) == pytest.approx((math.cos(heading), math.sin(heading)), abs=1e-6)


# --- logs of worlds -----------------------------------------------------------------------------------------


def test_a_world_comes_out_as_carla_reads_it(world, parsed):
    trace, frames = world.trace, parsed["frames"]
    assert parsed["version"] == 1 and parsed["magic"] == "CARLA_RECORDER" and parsed["map"] == "OpenDriveMap"
    assert [f["number"] for f in frames] == list(range(1, len(trace.time) + 1))
    assert [f["elapsed"] for f in frames] == pytest.approx(trace.time - trace.time[0], abs=1e-6)
    following = [f["elapsed"] + f["duration"] for f in frames[:-1]]
    assert following == pytest.approx([f["elapsed"] for f in frames[1:]]) and frames[-1]["duration"] == -1
    added = {a[0]: a for f in frames for a in f["add"] if a[1] == 1}
    assert len(added) == trace.active.shape[1]
    x0, y0 = np.asarray(world.map.lanes.origin, float)
    present: set[int] = set()
    for k, frame in enumerate(frames):
        present |= {a[0] for a in frame["add"] if a[1] == 1}
        gone = {i for (i,) in frame["delete"]}
        assert gone <= present
        present -= gone
        for name in ("positions", "animations", "lamps", "kinematics"):
            assert {row[0] for row in frame[name]} == present
        assert len(present) == trace.active[k].sum()
        bodies = {i: BODIES[added[i][4]] for i in present}
        middle = []
        for ident, x, y, _, roll, _, yaw in frame["positions"]:
            ahead = bodies[ident].ahead
            h = math.radians(-yaw)
            middle.append((x / 100 + ahead * math.cos(h), -y / 100 + ahead * math.sin(h)))
            assert roll == 0
        ours = trace.box[k, trace.active[k], :2] + [x0, y0]
        nearest = [min(math.dist(m, o) for m in middle) for o in ours]
        assert max(nearest, default=0) < 1e-3


def test_bodies_and_roles(world, parsed):
    boxes = {row[0]: row for frame in parsed["frames"] for row in frame["boxes"]}
    heroes = []
    for frame in parsed["frames"]:
        for ident, sort, _, uid, blueprint, attributes in frame["add"]:
            if sort != 1:
                continue
            assert uid > 0 and attributes["number_of_wheels"] == str(BODIES[blueprint].wheels)
            if attributes["role_name"] == "hero":
                heroes.append((ident, blueprint))
            size = 2 * boxes[ident][4] / 100, 2 * boxes[ident][5] / 100
            kinds = [k for k, s in ((0, (4.6, 1.85)), (2, (9.0, 2.5)), (3, (11.0, 2.55)), (4, (2.2, 0.8)))
                     if size == pytest.approx(s, abs=1e-3)]  # fmt: skip
            assert BODIES[blueprint].vehicle_class == VEHICLE_CLASSES[kinds[0]]
    assert len(heroes) == 1


def test_lights_show_what_the_signals_show(world, parsed):
    frames = parsed["frames"]
    lights = [a for a in frames[0]["add"] if a[1] == 3]
    assert lights and all(a[4] == "traffic.traffic_light" for a in lights)
    places = {tuple(light.position[:2]) for light in world.map.network.traffic_lights}
    for _, _, pose, *_ in lights:
        assert min(math.dist((pose[0] / 100, -pose[1] / 100), p) for p in places) < 1e-3
    table = [[row[3] for row in frame["lights"]] for frame in frames]
    assert all(row[1] is True for frame in frames for row in frame["lights"])  # CARLA does not switch them
    # as the programs of the network say, light by light
    network = world.map.network
    letters = {"r": 0, "y": 1, "g": 2, "G": 2, "u": 0, "s": 0, "o": 3, "O": 3}
    programs = list(network.programs)
    for column, light in enumerate(stage_of(world).lights):
        lanes = {spot.lane for spot in light.spots}
        own = next(m for m in network.movements if m.program and {m.incoming, *m.via} & lanes
                   and (not light.turns or m.turn in light.turns))  # fmt: skip
        phases = world.trace.phase[:, programs.index(own.program)]
        expected = [letters[network.programs[own.program].phases[p].state[own.link]] for p in phases]
        assert [row[column] for row in table] == expected
    assert len({tuple(row) for row in table}) > 1
    elapsed = np.array([[row[2] for row in frame["lights"]] for frame in frames])
    changed = np.diff(np.array(table), axis=0) != 0
    assert (elapsed[1:][changed] == 0).all() and (elapsed[1:][~changed] > 0).all()


def test_brakes_steering_and_slopes(crossing):
    world = lane_world(crossing, vehicles=2)
    trace = world.trace._replace(a=np.full_like(world.trace.a, -4.0))
    turn = np.array(trace.box)
    turn[..., 2] = 0.3 * trace.time[:, None]  # to the left
    frames = parse(carla_log(dataclasses.replace(world, trace=trace._replace(box=turn))).to_bytes())["frames"]
    for _, steer, throttle, brake, hand, gear in frames[3]["animations"]:
        assert -0.3 < steer < -0.01 and throttle == 0 and brake == pytest.approx(0.5)
        assert not hand and gear == 1
    assert all(state == 9 for _, state in frames[3]["lamps"])  # position and brake lights
    for _, vx, vy, vz, *angular in frames[3]["kinematics"]:
        heading = 0.3 * float(trace.time[3])
        assert (vx, vy, vz) == pytest.approx((9 * math.cos(heading), -9 * math.sin(heading), 0), abs=1e-3)
        assert angular[2] == pytest.approx(-math.degrees(0.3), rel=1e-3)


def test_what_a_log_of_the_server_adds(world, tmp_path):
    """Numbers of blueprints and places of lights come from a log of the server."""
    light = stage_of(world).lights[0]
    at, _ = to_carla(light.position[0] + 0.3, light.position[1], 7.0, 0.0)
    lamp = ActorType.TRAFFIC_LIGHT
    theirs = (
        Actor(4, lamp, tuple(at.tolist()), (0, 0, 0), 0, "traffic.traffic_light"),
        Actor(5, lamp, (9e6, 0, 0), (0, 0, 0), 0, "traffic.traffic_light"),
        Actor(2000, ActorType.VEHICLE, (0, 0, 0), (0, 0, 0), 31, "vehicle.audi.tt"),
        Actor(2001, ActorType.VEHICLE, (0, 0, 0), (0, 0, 0), 12, "vehicle.yamaha.yzf"),
    )  # fmt: skip
    like = CarlaLog(map="T", date=0, frames=(Frame(1, -1.0, 0.0, (Packet(Kind.ADD, theirs),)),))
    save_log(tmp_path / "server.log", like)
    path = write_log(tmp_path / "w.log", world, like=tmp_path / "server.log", town="Town99", date=8)
    found = parse(path.read_bytes())
    assert (found["map"], found["date"]) == ("Town99", 8)
    added = [a for frame in found["frames"] for a in frame["add"]]
    assert [(a[0], a[2][:3]) for a in added if a[1] == 3] == [
        (4, pytest.approx(theirs[0].location, rel=1e-6))
    ]
    vehicles = [a for a in added if a[1] == 1]
    assert min(a[0] for a in vehicles) > 2001
    assert {(a[3], a[4]) for a in vehicles} == {(31, "vehicle.audi.tt"), (12, "vehicle.yamaha.yzf")}
    with pytest.raises(ValueError, match="has no vehicle of a known blueprint"):
        carla_log(world, like=CarlaLog(map="T", date=0, frames=(Frame(1, -1.0, 0.0, ()),)))


def test_names_of_towns(crossing):
    names = {"carla_town05.xodr": "Town05", "/x/Town10HD_Opt.xodr": "Town10HD_Opt", "my.xodr": "OpenDriveMap"}
    for file, expected in names.items():
        assert town_of(dataclasses.replace(crossing.network, source=file)) == expected


def test_blueprints_are_chosen_by_class_and_size():
    assert blueprint_for("bus", 12.0, 2.55) == "vehicle.mitsubishi.fusorosa"
    assert blueprint_for("car", 3.7, 1.8) == "vehicle.audi.a2"
    assert blueprint_for("motorcycle", 2.2, 0.9) == "vehicle.yamaha.yzf"
    for kind in VEHICLE_CLASSES:
        assert BODIES[blueprint_for(kind, 5.0, 2.0)].vehicle_class == kind
    with pytest.raises(ValueError, match="class 'tram': CARLA has vehicles of"):
        blueprint_for("tram", 30.0, 2.4)
    assert body_of("vehicle.new.car").wheels == 4 and body_of("vehicle.new.bike", 2).wheels == 2


# --- scenes from logs ---------------------------------------------------------------------------------------


@needs_shared
def test_the_box_of_the_table_is_that_of_the_server():
    log = read_log(REAL)
    car = next(a for a in log.actors() if a.type == ActorType.VEHICLE)
    box = next(b for b in log.frames[0].records(Kind.BOX) if b["id"] == car.id)
    body = BODIES[car.blueprint]
    assert (2 * box["extent"] / 100).tolist() == pytest.approx(body[1:4], abs=1e-3)
    assert box["origin"][0] / 100 == pytest.approx(body.ahead, abs=1e-3)


def recorded_car(log: CarlaLog) -> tuple[np.ndarray, np.ndarray]:
    """Times (s) and x, y (m) of the only car, from an independent parser."""
    frames = parse(log.to_bytes())["frames"]
    car = next(a[0] for f in frames for a in f["add"] if a[1] == 1)
    rows = [(f["elapsed"], p[1] / 100, -p[2] / 100) for f in frames for p in f["positions"] if p[0] == car]
    return np.array(rows)[:, 0], np.array(rows)[:, 1:]


@needs_shared
def test_tracks_of_a_log_of_a_server():
    town = load_map(SHARED / "opendrive" / "carla_town01.xodr")
    tracks = read_tracks(REAL, network=town.network)
    assert tracks.vehicles == ("hero",) and tracks.dt == 0.025
    assert (tracks.length[0], tracks.width[0]) == pytest.approx((4.902, 2.128), abs=1e-3)
    time, place = recorded_car(read_log(REAL))
    moments = np.arange(len(tracks.x)) * tracks.dt
    for t, xy in zip(time, place, strict=True):
        if t <= moments[-1]:
            ours = np.interp(t, moments, tracks.x[:, 0]), np.interp(t, moments, tracks.y[:, 0])
            assert math.dist(ours, xy) < 0.01
    with pytest.raises(RecordingError, match=r"0 of \d+ places .* the map of Town01, where it was recorded"):
        read_tracks(REAL, network=load_map("highway").network)
    with pytest.raises(RecordingError, match="dt: -1 s"):
        read_tracks(REAL, network=town.network, dt=-1.0)


@pytest.mark.engine
@needs_shared
def test_a_recorded_car_is_within_a_centimetre_of_its_log():
    scene = load_scene(REAL, map=SHARED / "opendrive" / "carla_town01.xodr")
    table = scene.replay(ego="hero").trajectories().to_pandas()
    time, place = recorded_car(read_log(REAL))
    expected = [np.interp(table["time"], time, place[:, axis]) for axis in (0, 1)]
    assert np.hypot(table["x"] - expected[0], table["y"] - expected[1]).max() < 0.01
    assert len(table) > 450 and table["lane"].notna().all()
    run = scene.replay(ego="hero", braking=4.0, start=8.0)
    braked = run.trajectories().to_pandas()
    assert braked["v"].iloc[-1] < 1.0 < table["v"].iloc[-1]
    # and back again, with what the log of the server knows of it
    log = parse(carla_log(run, like=REAL).to_bytes())
    (car,) = [a for frame in log["frames"] for a in frame["add"]]
    assert log["map"] == "Town01" and car[3:5] == (26, "vehicle.lincoln.mkz_2017")
    assert car[5]["role_name"] == "hero"
    places = np.array([frame["positions"][0][1:3] for frame in log["frames"]]) / 100 * [1, -1]
    assert np.hypot(*(places - braked[["x", "y"]].to_numpy()).T).max() < 0.005  # 4 mm behind the middle


def test_a_world_comes_back_as_a_scene(world, crossing, tmp_path):
    write_log(tmp_path / "w.log.gz", world)
    tracks = read_tracks(tmp_path / "w.log.gz", network=crossing.network)
    trace, origin = world.trace, np.asarray(crossing.lanes.origin, float)
    assert tracks.dt == pytest.approx(0.1) and tracks.valid.sum() == trace.active.sum()
    assert "hero" in tracks.vehicles
    stage = stage_of(world)
    sizes = sorted((one.length, one.width) for one in stage.cast)
    found = sorted(zip(tracks.length, tracks.width, strict=True))
    assert found == [pytest.approx(size, abs=1e-4) for size in sizes]
    for t in range(0, len(trace.time), 7):
        ours = trace.box[t, trace.active[t], :2] + origin
        theirs = np.stack([tracks.x[t], tracks.y[t]], -1)[tracks.valid[t]]
        assert max(np.hypot(*(theirs - o).T).min() for o in ours) < 1e-3
    hero = tracks.vehicles.index("hero")
    turned = tracks.heading[0, hero] - trace.box[0, 0, 2]
    assert math.cos(turned) == pytest.approx(1.0, abs=1e-6)
    assert tracks.v[3, hero] == pytest.approx(9.0, abs=0.05)


def moved_log(places: Sequence[tuple[float, ...] | None], dt: float = 0.05) -> CarlaLog:
    """A car at places (m, ours), frame by frame; None: it is not there."""
    car = Actor(9, ActorType.VEHICLE, (0, 0, 0), (0, 0, 0), 26, "vehicle.audi.tt")
    frames = []
    for k, place in enumerate(places):
        rows = np.zeros(0 if place is None else 1, RECORDS[Kind.POSITION])
        if place is not None:
            rows["id"], rows["location"] = 9, to_carla(place[0], place[1], place[2], 0.0)[0]
        packets = [Packet(Kind.ADD, (car,))] if k == 0 else []
        frames.append(Frame(k + 1, dt, k * dt, (*packets, Packet(Kind.POSITION, rows))))
    return CarlaLog(map="T", date=0, frames=tuple(frames))


def test_a_car_that_is_put_elsewhere_is_another_one(tmp_path):
    town = load_map("highway")
    xyz = next(town.network.drivable_lanes()).pose(np.arange(100.0, 160.0, 1.0))[0]
    below = [(x, y, z - 500) for x, y, z in xyz[:10]]
    places = [*below, *map(tuple, xyz[:20]), *map(tuple, xyz[40:])]
    save_log(tmp_path / "m.log", moved_log(places))
    tracks = read_tracks(tmp_path / "m.log", network=town.network)
    assert tracks.vehicles == ("9", "9#2") and tracks.dt == 0.05
    assert tracks.valid.sum(0).tolist() == [20, 20]
    save_log(tmp_path / "m.log", moved_log(below))
    with pytest.raises(RecordingError, match="above or below the road"):
        read_tracks(tmp_path / "m.log", network=town.network)
    save_log(tmp_path / "m.log", moved_log([None, None, None]))
    with pytest.raises(RecordingError, match="no vehicles that move"):
        read_tracks(tmp_path / "m.log", network=town.network)
    save_log(tmp_path / "m.log", moved_log([(math.nan, 0.0, 0.0)] * 3))
    with pytest.raises(RecordingError, match="frame 1: vehicle 9: a place that is not finite"):
        read_tracks(tmp_path / "m.log", network=town.network)
    save_log(tmp_path / "m.log", moved_log([(0.0, 0.0, 0.0)] * 3, dt=0.0))
    with pytest.raises(RecordingError, match="frame 2: 0 s elapsed; seconds that grow"):
        read_tracks(tmp_path / "m.log", network=town.network)
    save_log(tmp_path / "m.log", moved_log([(0.0, 0.0, 0.0)] * 3, dt=1e12))
    with pytest.raises(RecordingError, match="lasts 2e\\+12 s; at most 100,000 steps"):
        read_tracks(tmp_path / "m.log", network=town.network)


# --- the lane check -----------------------------------------------------------------------------------------


def check_lanes(town_file, vehicles: int = 40):
    """Vehicles in the middle of our lanes are in the middle of CARLA's, by its own map."""
    carla = pytest.importorskip("carla")
    town = load_map(town_file)
    frames = parse(carla_log(lane_world(town, vehicles=vehicles, seconds=3.0)).to_bytes())["frames"]
    theirs = carla.Map("town", town_file.read_text())
    added = {a[0]: BODIES[a[4]] for f in frames for a in f["add"] if a[1] == 1}
    off, turned, level = [], [], []
    for frame in frames[::5]:
        for ident, x, y, z, _, _, yaw in frame["positions"]:
            h, ahead = math.radians(yaw), added[ident].ahead
            at = x / 100 + ahead * math.cos(h), y / 100 + ahead * math.sin(h)
            spot = carla.Location(x=at[0], y=at[1], z=z / 100)
            way = theirs.get_waypoint(spot, lane_type=carla.LaneType.Any)
            middle, turn = way.transform.location, math.radians(way.transform.rotation.yaw)
            # across the lane: along it, CARLA finds the nearest point to some cm only
            off.append(abs((at[1] - middle.y) * math.cos(turn) - (at[0] - middle.x) * math.sin(turn)))
            level.append(abs(middle.z - z / 100))
            turned.append(abs((yaw - way.transform.rotation.yaw + 180) % 360 - 180))
    assert len(off) > 100
    return np.array(off), np.array(turned), np.array(level)


def assert_on_lanes(town_file):
    off, turned, level = check_lanes(town_file)
    assert np.median(off) < 0.002 and np.quantile(off, 0.99) < 0.05
    assert np.median(turned) < 0.05 and np.quantile(turned, 0.95) < 1.0
    assert np.median(level) < 0.02 and np.quantile(level, 0.95) < 0.2


def test_a_world_lies_on_carlas_lanes():
    assert_on_lanes(REPO / "maps" / "intersection.xodr")


@needs_shared
def test_heights_and_slopes_are_those_of_carlas_road():
    carla = pytest.importorskip("carla")
    file = SHARED / "opendrive" / "curves_elevation.xodr"
    town = load_map(file)
    frames = parse(carla_log(lane_world(town, vehicles=2, seconds=12.0, speed=20.0)).to_bytes())["frames"]
    theirs, heights, slopes = carla.Map("hills", file.read_text()), [], []
    for frame in frames[::4]:
        for _, x, y, z, roll, pitch, _ in frame["positions"]:
            spot = carla.Location(x=x / 100, y=y / 100, z=z / 100)
            road = theirs.get_waypoint(spot, lane_type=carla.LaneType.Any).transform
            assert abs(road.location.z - z / 100) < 0.02 and roll == 0
            assert abs((road.rotation.pitch - pitch + 180) % 360 - 180) < 0.3  # over 2 m, and at a point
            heights.append(z / 100)
            slopes.append(pitch)
    assert np.ptp(heights) > 5 and np.ptp(slopes) > 4


@pytest.mark.slow
@needs_shared
@pytest.mark.parametrize("name", TOWNS)
def test_worlds_lie_on_the_lanes_of_carlas_towns(name):
    assert_on_lanes(SHARED / "opendrive" / f"{name}.xodr")
