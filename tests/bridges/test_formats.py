"""Exports: every format read back by the reader of another project, against the arrays of the trace."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_replays import AGAIN, CLASSES, LEAD, LENGTH, SELF, SWAP, WIDTH, T, intersection_trace
from lxml import etree
from paths import REPO

import limsim_jax as lj
from limsim_jax import cli
from limsim_jax.api.world import World
from limsim_jax.bridges.formats import FORMATS
from limsim_jax.bridges.formats.table import COLUMNS
from limsim_jax.maps.lane_map import VEHICLE_CLASSES, absolute
from limsim_jax.recordings import read_tracks
from limsim_jax.recordings.carla_log import Kind

READERS = Path(os.environ.get("LIMSIM_READERS", "/nowhere"))
needs_readers = pytest.mark.skipif(
    not (READERS / "commonroad").is_dir(),
    reason="LIMSIM_READERS names no folder with commonroad-io and asam-qc-openscenarioxml, installed by "
    "pip --no-deps --target",
)
CM = 0.01  # m
NAMES = {(SELF, -1): "ego", (LEAD, -1): "start_1", (AGAIN, 43): "vehicle_43", (AGAIN, 77): "vehicle_77"}


@pytest.fixture(scope="module")
def world():
    network, _, trace = intersection_trace()
    return World("a crossing", "mine", 3, SELF, lj.Map(network), trace, {}, [])


@pytest.fixture(scope="module")
def expected(world):
    """By moment and slot: name, x, y, heading, v; a loop over the trace."""
    trace = world.trace
    x, y = absolute(world.map.lanes, trace.box[..., 0], trace.box[..., 1])
    rows = {}
    for t in range(T):
        for slot in np.flatnonzero(trace.active[t]).tolist():
            number = int(trace.vehicle[t, slot])
            name = "ego" if slot == SELF else f"vehicle_{number}" if number >= 0 else f"start_{slot}"
            assert NAMES.get((slot, number), name) == name
            rows[t, name] = (x[t, slot], y[t, slot], trace.box[t, slot, 2], trace.v[t, slot], slot)
    return rows


def turned(a, b):
    return np.abs((np.asarray(a) - b + np.pi) % (2 * np.pi) - np.pi)


# --- Parquet


def test_parquet_has_every_vehicle_at_every_moment(world, expected, tmp_path):
    found = pq.read_table(lj.export(world, tmp_path / "x.parquet"))
    assert found.column_names == list(COLUMNS)
    units = {f.name: f.metadata[b"unit"].decode() for f in found.schema}
    assert units["x"] == "m" and units["speed"] == "m/s" and units["heading"] == "rad"
    rows = found.to_pylist()
    assert {(round(row["time"] / 0.1) - 1, row["vehicle"]) for row in rows} == set(expected)
    assert len(rows) == len(expected)
    ids = [lane.id for lane in world.map.network.drivable_lanes()]
    for row in rows:
        t = round(row["time"] / 0.1) - 1
        x, y, heading, v, slot = expected[t, row["vehicle"]]
        assert np.hypot(row["x"] - x, row["y"] - y) < 1e-4 and row["speed"] == pytest.approx(v)
        assert turned(row["heading"], heading) < 1e-5 and -np.pi <= row["heading"] <= np.pi
        assert row["ego"] == (slot == SELF) and row["class"] == VEHICLE_CLASSES[CLASSES[slot]]
        assert row["lane"] == ids[world.trace.lane[t, slot]]
        assert row["s"] == pytest.approx(world.trace.s[t, slot]) and row["d"] == pytest.approx(0.125)
        assert (row["length"], row["width"]) == pytest.approx((LENGTH[slot], WIDTH[slot]))


def test_moments_are_thinned_to_whole_multiples(world, tmp_path):
    every = pq.read_table(lj.export(world, tmp_path / "x.parquet"))
    half = pq.read_table(lj.export(world, tmp_path / "y.parquet", every=0.5))
    assert np.unique(half["time"]) == pytest.approx(0.5 * np.arange(1, 13), abs=1e-6)
    keep = np.isclose(np.asarray(every["time"]) / 0.5 % 1, 0) | np.isclose(
        np.asarray(every["time"]) / 0.5 % 1, 1
    )
    assert every.filter(keep).equals(half)


# --- SUMO


def test_sumo_reads_what_was_driven(world, expected, tmp_path):
    import sumolib

    path = lj.export(world, tmp_path / "x.fcd.xml")
    seen = set()
    for step, car in sumolib.xml.parse_fast_nested(
        str(path), "timestep", ["time"], "vehicle", ["id", "x", "y", "angle", "type", "speed"]
    ):
        t = round(float(step.time) / 0.1) - 1
        x, y, heading, v, slot = expected[t, car.id]
        seen.add((t, car.id))
        angle = np.radians(90.0 - float(car.angle))  # SUMO: degrees from north, clockwise
        front = x + LENGTH[slot] / 2 * np.cos(heading), y + LENGTH[slot] / 2 * np.sin(heading)
        assert np.hypot(float(car.x) - front[0], float(car.y) - front[1]) < CM
        assert turned(angle, heading) < 1e-4 and 0 <= float(car.angle) < 360
        assert float(car.speed) == pytest.approx(v, abs=1e-3)
        assert car.type == VEHICLE_CLASSES[CLASSES[slot]]
    assert seen == set(expected)


def test_fcd_fits_the_schema_and_the_tools_of_sumo(world, expected, tmp_path):
    sumo = pytest.importorskip("sumo")
    home = Path(sumo.SUMO_HOME)
    path = lj.export(world, tmp_path / "x.fcd.xml")
    schema = etree.XMLSchema(etree.parse(str(home / "data/xsd/fcd_file.xsd")))
    assert schema.validate(etree.parse(str(path))), schema.error_log
    out = tmp_path / "omnet.txt"
    tool = [sys.executable, home / "tools/traceExporter.py", "--fcd-input", path, "--omnet-output", out]
    subprocess.run([*map(str, tool), "--orig-ids"], check=True, capture_output=True)
    assert len(out.read_text().splitlines()) >= len(expected)


@pytest.mark.filterwarnings("ignore:Module 'rtree'")
def test_fcd_lies_on_the_lanes_of_the_network_that_sumo_makes_of_the_map(world, tmp_path):
    """The frame, and that x and y are those of the front bumper: netconvert reads the same map file."""
    sumo = pytest.importorskip("sumo")
    import sumolib

    net_file = tmp_path / "crossing.net.xml"
    tool = [Path(sumo.SUMO_HOME) / "bin/netconvert", "--opendrive", world.map.source, "-o", net_file]
    options = ["--offset.disable-normalization", "--no-warnings"]
    subprocess.run([*map(str, tool), *options], check=True, capture_output=True)
    net = sumolib.net.readNet(str(net_file))
    path = lj.export(world, tmp_path / "x.fcd.xml")
    checked = 0
    for _, car in sumolib.xml.parse_fast_nested(
        str(path), "timestep", ["time"], "vehicle", ["id", "x", "y", "angle", "pos", "lane"]
    ):
        lane = world.map.network.lanes[car.lane]
        if lane.junction is not None or not 2 < float(car.pos) < lane.length - 8:
            continue  # netconvert cuts roads at junctions and makes its own ways across
        at = float(car.x), float(car.y)
        near = sorted(net.getNeighboringLanes(*at, r=2.0), key=lambda pair: pair[1])
        assert near and near[0][1] < 0.05
        shape = np.array(near[0][0].getShape())
        offset = near[0][0].getClosestLanePosAndDist(at)[0]
        along = np.diff(shape, axis=0)
        ends = np.cumsum(np.linalg.norm(along, axis=-1))
        along = along[min(np.searchsorted(ends, offset), len(along) - 1)]
        assert turned(np.radians(90 - float(car.angle)), np.arctan2(along[1], along[0])) < 0.03
        checked += 1
    assert checked > 40


# --- CommonRoad


@needs_readers
def test_commonroad_io_reads_what_was_driven(world, expected, tmp_path):
    path = lj.export(world, tmp_path / "x.xml", "commonroad")
    environment = os.environ | {
        "PYTHONPATH": str(READERS),
        # its generated code is older than our protobuf
        "PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION": "python",
    }
    script = REPO / "tests/support/read_commonroad.py"
    ran = subprocess.run(
        [sys.executable, str(script), str(path)], capture_output=True, text=True, env=environment, check=False
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    found = json.loads(ran.stdout.splitlines()[-1])
    names = re.findall(r"<!-- (\w+) -->\s*<dynamicObstacle id=\"(\d+)\"", path.read_text())
    assert names[0][0] == "ego" and names[0][1] == min(found["obstacles"], key=int)
    seen = set()
    for name, number in names:
        obstacle, slot = found["obstacles"][number], -1
        for state, on in zip(obstacle["states"], obstacle["on"], strict=True):
            t = state[0]
            x, y, heading, v, slot = expected[t, name]
            seen.add((t, name))
            assert np.hypot(state[1] - x, state[2] - y) < CM and turned(state[3], heading) < 1e-4
            assert state[4] == pytest.approx(v, abs=1e-3)
            lane = world.trace.lane[t, slot]
            if 3 < world.trace.s[t, slot] < world.map.lanes.length[lane]:
                rows = [lane.id for lane in world.map.network.drivable_lanes()]
                assert lane + 1 in on and rows[lane]  # lanelets are numbered as the rows of lanes
        assert obstacle["size"] == pytest.approx([LENGTH[slot], WIDTH[slot]], abs=1e-4)
        assert (obstacle["type"] == "motorcycle") == (CLASSES[slot] == 4)
    assert seen == set(expected)
    assert found["dt"] == 0.1 and found["id"] == "ZAM_acrossing-1_4_T-1"
    (goal,) = found["goals"].values()
    assert goal[0] == 0 and goal[1] == pytest.approx(expected[0, "ego"][:2], abs=CM)
    assert goal[2]["0"] == [int(world.trace.lane[-1, SELF]) + 1]
    lanes = list(world.map.network.drivable_lanes())
    for k, lane in enumerate(lanes, 1):
        read = found["lanelets"][str(k)]
        middle = np.array(read["centre"])
        s = np.append(0, np.cumsum(np.linalg.norm(np.diff(middle, axis=0), axis=-1)))
        error = middle - lane.pose(s * lane.length / s[-1])[0][:, :2]
        assert np.abs(error).max() < 0.02
        assert [lanes[j - 1].id for j in read["successors"]] == list(lane.successors)
        left = lane.left if lane.left in {one.id for one in lanes} else None
        same = lanes[read["left"] - 1].id if read["left"] and read["left_same"] else None
        assert same == left
        (sign,) = read["signs"]
        name, limit = found["signs"][str(sign)]
        assert name == "MAX_SPEED" and float(limit) == pytest.approx(lane.speed_limit, abs=1e-3)


@needs_readers
def test_only_vehicles_that_come_in_later_are_beyond_the_schema_of_commonroad(world, tmp_path):
    """The schema knows initial states at step 0 only; commonroad-io reads and writes others."""
    path = lj.export(world, tmp_path / "x.xml")
    folder = READERS / "commonroad/common/xml_definition_files"
    schema = etree.XMLSchema(etree.parse(str(folder / "XML_commonRoad_XSD.xsd")))
    schema.validate(etree.parse(str(path)))
    errors: Any = schema.error_log
    assert [f"The value '{SWAP}' is greater" in error.message for error in errors] == [True]


def test_our_own_reader_finds_the_same_tracks(world, expected, tmp_path):
    path = lj.export(world, tmp_path / "x.xml")
    tracks = read_tracks(path)
    assert tracks.dt == 0.1 and int(tracks.valid.sum()) == len(expected)
    x, y, heading, _, _ = np.array([expected[t, "ego"] for t in range(T)]).T
    assert np.hypot(tracks.x[:, 0] - x, tracks.y[:, 0] - y).max() < CM
    assert turned(tracks.heading[:, 0], heading).max() < 1e-4
    assert len(tracks.network.lanes) == len(list(world.map.network.drivable_lanes()))


# --- OpenSCENARIO


@needs_readers
@pytest.mark.parametrize("every", [None, 0.5])
def test_openscenario_is_valid_by_the_schema_of_asam(world, every, tmp_path):
    path = lj.export(world, tmp_path / "x.xosc", every=every)
    schema = etree.XMLSchema(etree.parse(str(READERS / "qc_openscenario/schema/1.2.0/OpenSCENARIO.xsd")))
    assert schema.validate(etree.parse(str(path))), schema.error_log


def test_openscenario_puts_bodies_where_they_were(world, expected, tmp_path):
    root: Any = etree.parse(str(lj.export(world, tmp_path / "x.xosc"))).getroot()
    assert root.find("RoadNetwork/LogicFile").get("filepath") == world.map.source
    centre = {
        one.get("name"): float(one.find("Vehicle/BoundingBox/Center").get("x"))
        for one in root.iter("ScenarioObject")
    }
    axles = {one.get("name"): one.find("Vehicle/Axles") for one in root.iter("ScenarioObject")}
    seen = set()
    for one in root.iter("Trajectory"):
        name = one.get("name")
        assert float(axles[name].find("RearAxle").get("positionX")) == 0
        for vertex in one.iter("Vertex"):
            t = round(float(vertex.get("time")) / 0.1) - 1
            px, py, h = (float(vertex.find("Position/WorldPosition").get(key)) for key in ("x", "y", "h"))
            x, y, heading, _, _ = expected[t, name]
            seen.add((t, name))
            middle = px + centre[name] * np.cos(h), py + centre[name] * np.sin(h)
            assert np.hypot(middle[0] - x, middle[1] - y) < CM and turned(h, heading) < 1e-4
    assert seen == set(expected)
    added = {one.getparent().get("entityRef") for one in root.iter("AddEntityAction")}
    deleted = {one.getparent().get("entityRef") for one in root.iter("DeleteEntityAction")}
    assert added == {"vehicle_77"} and deleted == {"vehicle_43", "start_1"}


# --- CARLA


def test_a_log_of_carla_has_every_vehicle_at_every_moment(world, expected, tmp_path):
    log = lj.carla.read_log(lj.export(world, tmp_path / "x.log"))
    assert len(log.frames) == T
    places = [frame.records(Kind.POSITION) for frame in log.frames]
    assert [len(x) for x in places] == [sum(t == k for k, _ in expected) for t in range(T)]
    with pytest.raises(ValueError, match="a log of CARLA has every step"):
        lj.export(world, tmp_path / "x.log", every=0.5)


# --- what cannot be written


def test_what_is_asked_wrongly_is_told_in_a_line(world, tmp_path):
    with pytest.raises(ValueError, match=r"^format 'csv': one of parquet, fcd, .* is expected$"):
        lj.export(world, tmp_path / "x.csv", "csv")
    with pytest.raises(
        ValueError, match=r"x.csv': .parquet, .fcd.xml, .xml, .xosc, .log, or the name of a format"
    ):
        lj.export(world, tmp_path / "x.csv")
    for every in (0.25, 0.04, -1.0):
        with pytest.raises(ValueError, match=r"a multiple of the time step, 0.1 s, is expected"):
            lj.export(world, tmp_path / "x.xosc", every=every)
    with pytest.raises(ValueError, match="moments with vehicles; at least two are expected"):
        lj.export(world, tmp_path / "x.xosc", every=6.0)
    with pytest.raises(FileNotFoundError, match=r"nowhere/x\.xosc"):
        lj.export(world, tmp_path / "nowhere/x.xosc")
    assert list(tmp_path.iterdir()) == []


def test_a_write_that_fails_leaves_what_was_there(world, tmp_path, monkeypatch):
    path = tmp_path / "x.xosc"
    path.write_text("before")
    monkeypatch.setattr(os, "replace", lambda *names: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        lj.export(world, path)
    assert path.read_text() == "before" and [p.name for p in tmp_path.iterdir()] == ["x.xosc"]


REFUSALS = {
    "no format": ("export results --seed 0", "--to: name one of parquet, fcd"),
    "an unknown format": ("export results --seed 0 --to csv", "format 'csv': one of parquet, fcd"),
    "an unknown suffix": ("export results --seed 0 --out x.csv", "'x.csv': .parquet, .fcd.xml"),
    "no results": ("export folder --seed 0 --to fcd", "folder"),
    "a seed that is none": ("export results --seed -1 --to fcd", "--seed: -1; it has to be within"),
    "no time": ("export results --seed 0 --to fcd --every 0", "--every: 0 s; more than 0"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_the_command_refuses_in_one_line(case, tmp_path, monkeypatch, capsys):
    command, clue = REFUSALS[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    assert cli.main(command.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("limsim-jax: ") and error.count("\n") == 1 and clue in error.replace("'--", "--")


# --- a real world


@pytest.mark.engine
def test_a_sweep_is_exported_by_the_command(tmp_path, capsys, monkeypatch):
    """Two egos among traffic on a roundabout: the FCD of the command is the table of the replay."""
    import sumolib

    egos = [lj.Ego(start="1-", s=40.0, goal="3+"), lj.Ego(start="2-", s=30.0, goal="4+")]
    drive = lj.Experiment(map="roundabout", name="pair", horizon=6.0, slots=8, vehicles=4, ego=egos)
    folder = tmp_path / "results"
    lj.sweep(drive, policies=["constant_speed"], seeds=2, out=folder, chunk=2, progress=False)
    arguments = ["export", str(folder), "--seed", "1", "--to", "fcd", "--every", "0.5"]
    made = []
    run = World.run
    monkeypatch.setattr(World, "run", lambda *given, **how: made.append(run(*given, **how)) or made[-1])
    assert cli.main(arguments) == 0
    path = folder / "exports/pair-constant_speed-1.fcd.xml"
    assert f"wrote {path}" in capsys.readouterr().out
    table = made[0].trajectories().to_pylist()
    rows = {(round(row["time"], 2), row["slot"]): row for row in table if round(row["time"] * 10) % 5 == 0}
    cars = list(
        sumolib.xml.parse_fast_nested(
            str(path), "timestep", ["time"], "vehicle", ["id", "x", "y", "pos", "lane"]
        )
    )
    assert len(cars) == len(rows) and {"ego", "ego_1"} < {car.id for _, car in cars}
    for step, car in cars:
        front = [
            np.hypot(
                row["x"] + row["length"] / 2 * np.cos(row["heading"]) - float(car.x),
                row["y"] + row["length"] / 2 * np.sin(row["heading"]) - float(car.y),
            )
            for (time, _), row in rows.items()
            if time == round(float(step.time), 2)
        ]
        assert min(front) < CM
    for name, suffix in FORMATS.items():
        assert lj.export(made[0], tmp_path / f"x{suffix}", name).stat().st_size > 1000
