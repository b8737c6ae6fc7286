"""Traffic as a service: a real server on this machine, and clients that do right and wrong."""

import gzip
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_replays import intersection_trace
from paths import REPO

import limsim_jax as lj
from limsim_jax import cli
from limsim_jax.api.world import World
from limsim_jax.log_replay.arrays import build_arrays
from limsim_jax.log_replay.takeover import Ego, Mode, Takeover, replay
from limsim_jax.maps.lane_map import absolute, relative
from limsim_jax.recordings.tracks import Tracks

grpc = pytest.importorskip("grpc")
from limsim_jax.bridges.traffic_service import messages  # noqa: E402
from limsim_jax.bridges.traffic_service.client import TrafficClient  # noqa: E402
from limsim_jax.bridges.traffic_service.log import FOLLOWERS  # noqa: E402
from limsim_jax.bridges.traffic_service.messages import message  # noqa: E402
from limsim_jax.bridges.traffic_service.scenes import Scenes  # noqa: E402
from limsim_jax.bridges.traffic_service.server import TrafficServer  # noqa: E402

LANE = "1_0_-6"  # 1.5 km of motorway, straight at the begin
LENGTH, V, HANDOVER, BRAKING = 4.8, 20.0, 2.0, 5.0  # m, m/s, s, m/s^2
TIME = np.arange(0, 10.05, 0.1)
STARTS = {"EGO": 100.0, "behind": 75.0, "far behind": 50.0, "ahead": 150.0}
PARKED = {"time": [0.0], "length": 4.0, "width": 1.8, "still": True}


@pytest.fixture(scope="module")
def lane():
    return lj.load_map("highway").network.lanes[LANE]


def place(lane, s):
    """x, y, heading of the middle of a body whose front bumper is at s."""
    xyz, heading = lane.pose(np.asarray(s) - LENGTH / 2)
    return {"x": xyz[..., 0], "y": xyz[..., 1], "heading": heading}


@pytest.fixture(scope="module")
def objects(lane):
    found = {
        name: {"time": TIME, "length": LENGTH, "width": 1.8} | place(lane, s + V * TIME)
        for name, s in STARTS.items()
    }
    beside = place(lane, 140.0)
    found["parked"] = PARKED | {"x": float(beside["x"]), "y": float(beside["y"]) - 12.0, "heading": 0.3}
    found["on foot"] = found["ahead"] | {"y": found["ahead"]["y"] - 15.0, "label": "pedestrian"}
    found["short visit"] = found["ahead"] | {"time": TIME[:30]} | {
        name: found["ahead"][name][:30] for name in ("x", "heading")
    } | {"y": found["ahead"]["y"][:30] + 11.0}  # fmt: skip
    return found


def braked(time):
    """Way of the ego's front bumper, m: it brakes from the hand-over on."""
    after = np.clip(time - HANDOVER, 0, V / BRAKING)
    return STARTS["EGO"] + V * np.minimum(time, HANDOVER) + V * after - BRAKING * after**2 / 2


def ego_at(lane, time, way=braked):
    return {"time": np.atleast_1d(time)} | {k: np.atleast_1d(v) for k, v in place(lane, way(time)).items()}


@pytest.fixture(scope="module")
def server():
    with TrafficServer(Scenes(["highway", "roundabout"]), sessions=4) as server:
        yield server


@pytest.fixture
def client(server):
    with TrafficClient(f"127.0.0.1:{server.port}") as client:
        yield client
        for session in server.open_sessions:
            client.end(session)


def drive(client, session, lane, times, way=braked):
    return [client.simulate(session, t, ego_at(lane, t, way)) for t in times]


def refused(call, status, clue):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    error = caught.value
    assert error.code() == getattr(grpc.StatusCode, status), error.details()
    assert "\n" not in error.details() and re.search(clue, error.details()), error.details()


# --- the protocol


def test_messages_are_those_of_the_proto_files(tmp_path):
    """`protoc` makes the same descriptors, and the same bytes, of the files as we do of our table."""
    protoc = pytest.importorskip("grpc_tools.protoc")
    from google.protobuf import descriptor_pb2

    folder = REPO / "limsim_jax/bridges/traffic_service"
    out = tmp_path / "set.bin"
    names = ["common.proto", "traffic.proto", "driver.proto"]
    assert protoc.main(["protoc", f"-I{folder}", f"--descriptor_set_out={out}", *names]) == 0
    compiled = descriptor_pb2.FileDescriptorSet.FromString(out.read_bytes())
    for file, name in zip(compiled.file, ("common", "traffic", "driver"), strict=True):
        ours = messages.file_descriptor(name)
        for one in (*file.message_type, *(n for m in file.message_type for n in m.nested_type)):
            for field in one.field:
                field.json_name = ""
        for one in (*ours.message_type, *(n for m in ours.message_type for n in m.nested_type)):
            for field in one.field:
                field.json_name = ""
        assert ours == file


# --- what it does


@pytest.mark.engine
def test_until_the_hand_over_and_beside_an_ego_on_its_log_the_log_is_replayed(client, lane, objects):
    """Also between the moments of the log, and in the order of the request."""
    client.start("a", "highway", objects, HANDOVER)
    for t in (0.0, 0.05, 1.3, 2.0, 2.1, 2.95, 3.0, 5.55, 9.9):
        found = client.simulate("a", t, ego_at(lane, t, lambda t: STARTS["EGO"] + V * t))
        there = [name for name in objects if name != "EGO" and (name != "short visit" or t <= TIME[29])]
        assert list(found) == there
        for name in there:
            one = objects[name]
            x, y = (np.interp(t, one["time"], np.broadcast_to(one[k], len(one["time"]))) for k in "xy")
            assert np.hypot(found[name][0] - x, found[name][1] - y) < 1e-3


@pytest.mark.engine
def test_traffic_reacts_to_an_ego_that_brakes(client, server, lane, objects):
    client.start("a", "highway", objects, HANDOVER)
    times = np.arange(0.1, 9.95, 0.1)
    before: Any = None
    found: Any = {}
    log: Any = {}
    for t, found in zip(times, drive(client, "a", lane, times), strict=True):
        ego = ego_at(lane, t)
        at = np.array([ego["x"][0], ego["y"][0]])
        gap = np.linalg.norm(at - found["behind"][:2]) - LENGTH
        assert gap > 0.5
        assert np.hypot(*np.subtract(found["behind"][:2], found["far behind"][:2])) > LENGTH + 0.5
        if t > HANDOVER:
            log = {name: np.array([np.interp(t, TIME, objects[name][k]) for k in "xy"]) for name in STARTS}
            assert np.linalg.norm(log["ahead"] - found["ahead"][:2]) < 1e-3
        if before is not None:
            moved = [np.hypot(*np.subtract(found[n][:2], before[n][:2])) for n in STARTS if n in found]
            assert max(moved) < 0.1 * V + 0.05
        before = found
    assert set(server._held["a"].session.off_log()) == {"behind", "far behind"}
    assert np.linalg.norm(log["behind"] - found["behind"][:2]) > 50
    parked = objects["parked"]
    assert found["parked"][:2] == pytest.approx((parked["x"], parked["y"]), abs=1e-3)
    assert found["parked"][2] == pytest.approx(0.3, abs=1e-5)


@pytest.mark.engine
@pytest.mark.parametrize("label, keeps", [("car", False), ("Pedestrian", True), ("still", True)])
def test_only_vehicles_leave_their_logs(label, keeps, client, server, lane, objects):
    """What follows the ego closely, or stands where it backs to, is taken over if it is a vehicle."""
    other: Any = objects["behind"] | {"label": label} | place(lane, 85.0 + V * TIME)
    if label == "still":
        other = PARKED | {name: float(value) for name, value in place(lane, 150.0).items()}
    client.start("a", "highway", {"EGO": objects["EGO"], "other": other}, HANDOVER)

    def back(time):
        return braked(time) - np.maximum(time - 7.0, 0) ** 2

    found = drive(client, "a", lane, TIME[1:90], back)[-1]["other"]
    at = [np.broadcast_to(other[name], len(other["time"]))[min(89, len(other["time"]) - 1)] for name in "xy"]
    assert (np.hypot(*np.subtract(found[:2], at)) < 1e-3) == keeps
    assert server._held["a"].session.off_log() == ([] if keeps else ["other"])


class Told:
    """A pilot that puts the ego where the test says."""

    def __init__(self, rows):
        self.rows = rows  # of flights, one per moment

    def init(self, scene, ego):
        return jax.tree.map(lambda x: x[0], self.rows)

    def step(self, scene, ego, flight, moment, a, t, key):
        del scene, ego, flight, moment, a, key
        return jax.tree.map(lambda x: x[jnp.minimum(t + 1, len(self.rows.x) - 1)], self.rows)


@pytest.mark.engine
def test_a_session_is_a_log_replay_with_the_same_ego(client, server, lane, objects):
    """The whole scan over the scene as it is, against steps on padded arrays."""
    town = lj.load_map("highway")
    client.start("a", "highway", objects, HANDOVER)
    drive(client, "a", lane, TIME[1:90])
    session = server._held["a"].session
    rows = jax.tree.map(lambda *x: jnp.stack(x), *(session._flight(k) for k in range(90)))
    names = ["EGO", "behind", "far behind", "ahead"]
    stack = {k: np.stack([np.asarray(objects[n][k]) for n in names], -1) for k in ("x", "y", "heading")}
    size = {"length": np.full(4, LENGTH), "width": np.full(4, 1.8)}
    tracks = Tracks(
        name="", source="", dt=0.1, vehicles=tuple(names), v=np.full((len(TIME), 4), V),
        network=town.network, **stack, **size,
    )  # fmt: skip
    scene = build_arrays(tracks, town.lanes)
    scene = replace(scene, limit=scene.limit.at[0].set(1e9))
    told = jnp.arange(len(TIME)) >= 20
    ego = Ego(slot=jnp.int32(0), told=told, acceleration=jnp.zeros(len(TIME)))
    _, moments = jax.jit(lambda s, r: replay(s, ego, Takeover(), pilot=Told(r), record=True))(scene, rows)
    assert moments is not None and (np.asarray(moments.mode)[88, 1:3] == Mode.CTRL).all()
    x, y = absolute(town.lanes, moments.x[89], moments.y[89])
    found = client.simulate("a", TIME[89], None)
    for k, name in enumerate(names[1:], 1):
        assert found[name][:2] == pytest.approx((x[k], y[k]), abs=0.02)  # float32 on the wire
    assert np.allclose(relative(town.lanes, x, y), (moments.x[89], moments.y[89]), atol=1e-3)


@pytest.mark.engine
def test_sessions_are_independent_and_repeat_to_the_last_bit(client, lane, objects):
    times = np.arange(0.1, 6.0, 0.25)  # also between the moments of the traffic model
    client.start("alone", "highway", objects, HANDOVER)
    alone = drive(client, "alone", lane, times)
    for name in ("a", "b"):
        client.start(name, "highway", objects, HANDOVER)
    results = {}

    def work(name, way):
        results[name] = drive(client, name, lane, times, way)

    ways = {"a": braked, "b": lambda t: STARTS["EGO"] + V * t}
    threads = [threading.Thread(target=work, args=item) for item in ways.items()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results["a"] == alone
    assert results["b"] != alone


@pytest.mark.engine
def test_a_query_between_moments_lies_between_them(client, lane, objects):
    client.start("a", "highway", objects, HANDOVER)
    client.start("b", "highway", objects, HANDOVER)
    drive(client, "a", lane, TIME[1:41])
    drive(client, "b", lane, TIME[1:41])
    half = client.simulate("a", 4.05, ego_at(lane, 4.05))["behind"]
    first = client.simulate("b", 4.0, None)["behind"]
    then = client.simulate("b", 4.1, ego_at(lane, 4.1))["behind"]
    assert half[:2] == pytest.approx(np.add(first[:2], then[:2]) / 2, abs=0.02)


# --- what is refused


@pytest.mark.engine
def test_requests_that_cannot_be_answered_are_refused_in_one_line(client, server, lane, objects):
    def start(session="x", scene="highway", handover=HANDOVER, **changes):
        return lambda: client.start(session, scene, objects | changes, handover)

    car = objects["ahead"]
    one_pose = {
        k: (np.atleast_1d(v)[:1] if k in ("time", "x", "y", "heading") else v) for k, v in car.items()
    }
    refused(start(session=""), "INVALID_ARGUMENT", "no session_uuid")
    refused(start(scene="moon"), "NOT_FOUND", "no scene 'moon'; there are highway, roundabout")
    refused(start(handover=0), "INVALID_ARGUMENT", "handover_time_us")
    refused(start(handover=99), "INVALID_ARGUMENT", "the log of EGO goes from 0 to 10000000")
    refused(start(ahead=one_pose), "INVALID_ARGUMENT", "object 'ahead': 1 logged poses; at least 2")
    refused(
        start(ahead=car | {"x": car["x"] * np.nan}), "INVALID_ARGUMENT", "'ahead': pose 0 at 0 us is no place"
    )
    refused(start(ahead=car | {"time": TIME[::-1]}), "INVALID_ARGUMENT", "times that grow")
    refused(start(ahead=car | {"length": 0.0}), "INVALID_ARGUMENT", "'ahead': size 0 x 1.8 m")
    refused(lambda: client.start("x", "highway", {"a": car}, 2.0), "INVALID_ARGUMENT", "no object 'EGO'")
    moved = {name: one | {"x": np.asarray(one["x"]) + 1e5} for name, one in objects.items()}
    refused(
        lambda: client.start("x", "highway", moved, 2.0), "INVALID_ARGUMENT", "no logged vehicle is on a lane"
    )
    assert server.open_sessions == []

    refused(lambda: client.simulate("x", 1.0), "NOT_FOUND", "no session 'x'")
    refused(lambda: client.end("x"), "NOT_FOUND", "no session 'x'")
    start()()
    refused(start(), "ALREADY_EXISTS", "session 'x' is open")
    for k in range(3):
        start(session=f"more {k}")()
    refused(start(session="one too many"), "RESOURCE_EXHAUSTED", "4 sessions are open")
    drive(client, "x", lane, TIME[1:31])
    refused(lambda: client.simulate("x", 2.5), "INVALID_ARGUMENT", "the last query was at 3000000")
    refused(lambda: client.simulate("x", 3.5), "INVALID_ARGUMENT", "poses of EGO end at 3000000 us")
    refused(lambda: client.simulate("x", 99.0), "FAILED_PRECONDITION", "logs go from 0 to 10000000")
    other = message("traffic.TrafficRequest")(session_uuid="x", time_query_us=3_100_000)
    other.object_trajectory_updates.add(object_id="ahead")
    refused(lambda: client.call("simulate", other), "INVALID_ARGUMENT", "update of object 'ahead'")
    bad = ego_at(lane, 3.1) | {"x": np.array([np.inf])}
    refused(lambda: client.simulate("x", 3.1, bad), "INVALID_ARGUMENT", "object 'EGO': pose 0")
    assert client.simulate("x", 3.1, ego_at(lane, 3.1))  # none of these has done harm


@pytest.mark.engine
def test_a_traffic_model_that_breaks_is_told_and_made_up_for_by_nothing(client, server, lane, objects):
    client.start("a", "highway", objects, HANDOVER)
    drive(client, "a", lane, TIME[1:31])
    session = server._held["a"].session
    session._scene = replace(session._scene, path=session._scene.path * jnp.nan)
    clue = "gave no finite pose for 'behind'"
    refused(lambda: client.simulate("a", 3.1, ego_at(lane, 3.1)), "FAILED_PRECONDITION", clue)
    refused(lambda: client.simulate("a", 3.2, ego_at(lane, 3.2)), "FAILED_PRECONDITION", clue)


@pytest.mark.engine
def test_sessions_of_clients_that_have_gone_are_closed(objects):
    with (
        TrafficServer(Scenes(["highway"]), idle=0.4) as server,
        TrafficClient(f"127.0.0.1:{server.port}") as client,
    ):
        client.start("lost", "highway", objects, HANDOVER)
        assert server.open_sessions == ["lost"]
        client.close()
        end = time.monotonic() + 20
        while server.open_sessions and time.monotonic() < end:
            time.sleep(0.05)
        assert server.open_sessions == []


def test_metadata_and_scenes(tmp_path):
    (tmp_path / "town.xodr").write_text("<OpenDRIVE/>")
    with (
        TrafficServer(Scenes([tmp_path, "ramp"])) as server,
        TrafficClient(f"127.0.0.1:{server.port}") as client,
    ):
        about = client.call("get_metadata", message("common.Empty")())
        assert about.minimum_history_length_us == 100_000 and lj.__version__ in about.version_id.version_id
        assert client.scenes() == ["ramp", "town"]
        objects = {"EGO": {"time": [0, 9], "x": [0, 9], "y": 0, "heading": 0, "length": 4.0, "width": 2.0}}
        refused(
            lambda: client.start("x", "town", objects, 1.0), "FAILED_PRECONDITION", "scene 'town': .*xodr"
        )


@pytest.mark.parametrize("gzipped", [False, True])
def test_a_recording_is_a_scene(gzipped, tmp_path):
    network, _, trace = intersection_trace()
    path = lj.export(World("", "", 0, 0, lj.Map(network), trace, {}, []), tmp_path / "USA_a-1_2.T.xml")
    if gzipped:
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    scenes = Scenes([tmp_path])
    assert scenes.ids == ["USA_a-1_2.T"]
    assert len(scenes.map("USA_a-1_2.T").network.lanes) == len(list(network.drivable_lanes()))


# --- the command


def test_the_command_refuses_in_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        used = other.getsockname()[1]
        for command, clue in {
            "serve traffic": "--maps",
            "serve traffic --maps empty": "empty: no map in this folder",
            "serve traffic --maps nowhere": "nowhere: no such folder, file or bundled map",
            f"serve traffic --maps ramp --port {used}": f"port {used} of 127.0.0.1 is in use",
            "serve traffic --maps ramp --port 70000": "port: 70000; 0 to 65535 is expected",
            "serve traffic --maps ramp --sessions 0": "sessions: 0; more than 0",
            "serve traffic --maps ramp --host 203.0.113.1": "203.0.113.1:0: cannot listen there",
        }.items():
            assert cli.main(command.split()) == 2
            error = capsys.readouterr().err
            assert error.startswith("limsim-jax: ") and error.count("\n") == 1 and clue in error


def test_nothing_is_left_after_an_interrupt():
    command = [sys.executable, "-m", "limsim_jax.cli", "serve", "traffic", "--maps", "ramp"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    ) as running:
        assert running.stdout is not None
        line = running.stdout.readline()
        found = re.match(r"listening on 127.0.0.1:(\d+), 1 scenes: ramp$", line)
        assert found is not None, line
        with TrafficClient(f"127.0.0.1:{found[1]}") as client:
            assert client.scenes() == ["ramp"]
        running.send_signal(signal.SIGINT)
        assert running.wait(20) == 130
        assert running.stderr is not None and running.stderr.read().strip() == ""
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", int(found[1]))) != 0


def test_classes_that_keep_to_their_logs_are_lower_case():
    assert all(name == name.lower() for name in FOLLOWERS)
