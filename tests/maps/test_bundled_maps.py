"""The bundled maps: what the script writes, clean in every importer, continuous, and drivable."""

import importlib.util
import itertools
import json
import math
import subprocess
import sys
import types
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from mapbuilder import curves
from paths import REPO

from limsim_jax.maps.network import Action, Control, Lane, Network
from limsim_jax.maps.opendrive import read_opendrive

FOLDER = REPO / "maps"
CLOSED = 1e-6  # m: a lane this narrow has ended
NAMES = ("highway", "ramp", "intersection", "roundabout", "long_route")

# which roads traffic must be able to reach from each road at the edge of the map
TOWN = {"first north", "first south", "start out", "ring north", "ring south"}
LAST = {"finish", "last right", "last across"}
RINGS = {"north", "east", "south", "west"}
REACH: dict[str, dict[str, set[str]]] = {
    "highway": {"motorway west": {"motorway east"}, "motorway east": {"motorway west"}},
    "ramp": {
        "motorway west": {"motorway east", "off-ramp"},
        "on-ramp": {"motorway east", "off-ramp"},
        "motorway opposite": {"motorway opposite"},
    },
    "intersection": {
        "west in": {"east out", "north", "south"},
        "east in": {"west out", "north", "south"},
        "north": {"east out", "west out", "south"},
        "south": {"east out", "west out", "north"},
    },
    "roundabout": {name: RINGS for name in RINGS},
    "long_route": {
        **{name: TOWN | LAST | {"motorway east"} for name in ("start in", *(TOWN - {"start out"}))},
        "motorway west": LAST | {"motorway east"},
        "motorway opposite": {"motorway opposite"},
        **{name: LAST - {name} for name in LAST},
    },
}


@pytest.fixture(scope="module", params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def network(name: str) -> Network:
    return read_opendrive(FOLDER / f"{name}.xodr")


@pytest.fixture(scope="module")
def root(name: str) -> etree._Element:
    return etree.parse(FOLDER / f"{name}.xodr").getroot()


def generator() -> types.ModuleType:
    spec = importlib.util.spec_from_file_location("bundled_map_generator", FOLDER / "generate.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_files_are_what_the_script_writes():
    done = subprocess.run(
        [sys.executable, FOLDER / "generate.py", "--check"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_check_notices_a_changed_and_a_missing_file(tmp_path, monkeypatch, capsys):
    module = generator()
    for file in FOLDER.glob("*.xodr"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.setattr(module, "FOLDER", tmp_path)
    assert module.main(["--check"]) == 0
    (tmp_path / "ramp.xodr").write_bytes((tmp_path / "ramp.xodr").read_bytes().replace(b"3.75", b"3.76"))
    (tmp_path / "highway.xodr").unlink()
    assert module.main(["--check"]) == 1
    assert capsys.readouterr().err == "not what generate.py writes: highway.xodr, ramp.xodr\n"


def test_join_meets_any_pose():
    """Both shapes of connecting curve, against the pose that was asked for."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        a = curves.Pose(rng.uniform(-50, 50), rng.uniform(-50, 50), rng.uniform(-4, 4))
        b = a.move(rng.uniform(15, 60), rng.uniform(-10, 10), rng.uniform(-1.2, 1.2))
        end = curves.join(a, b).end
        assert math.hypot(end.x - b.x, end.y - b.y) < 3e-4  # pieces below 0.1 mm are left out
        assert abs(curves.wrap(end.heading - b.heading)) < 1e-5


# ------------------------------------------------------------------------------ as our reader sees it


def test_report_is_clean(network: Network):
    assert network.report.counts
    # OpenDRIVE has no signal timing: that alone is made up
    unclean = [str(n) for n in network.report.notes if n.action is not Action.ADDED]
    assert unclean == []
    assert len(network.report.notes) == sum(program.generated for program in network.programs.values())


def wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def test_lanes_continue_at_every_link(network: Network):
    """Centre lines and widths of all lanes, also of sidewalks and shoulders."""
    links = 0
    for lane in network.lanes.values():
        for successor in map(network.lanes.__getitem__, lane.successors):
            (p, heading), (q, onward) = lane.pose(lane.length), successor.pose(0.0)
            assert np.linalg.norm(p - q) < 1e-4, (lane.id, successor.id)
            assert abs(math.degrees(wrapped(float(heading) - float(onward)))) < 1e-3, (lane.id, successor.id)
            assert abs(lane.width[-1] - successor.width[0]) < 1e-6, (lane.id, successor.id)
            assert lane.id in successor.predecessors
            links += 1
    assert links >= 8


def test_lanes_are_wide_long_and_gentle_enough(network: Network, root: etree._Element):
    for lane in network.drivable_lanes():
        assert lane.length >= 5.0, lane.id
        assert np.abs(lane.curvature).max() < 1 / (10.0 if lane.junction else 25.0), lane.id
        assert (lane.width[1:-1] > 0).all(), lane.id
        for end, links in ((0, lane.predecessors), (-1, lane.successors)):
            assert lane.width[end] >= 3.0 or (lane.width[end] < CLOSED and not links), lane.id
        rise = np.abs(np.diff(lane.xyz[:, 2])) / np.hypot(*np.diff(lane.xyz[:, :2], axis=0).T)
        assert rise.max() < 0.06, lane.id
    for road in root.iter("road"):
        starts = [float(s.get("s", "")) for s in road.iter("laneSection")]
        assert min(np.diff([*starts, float(road.get("length", ""))])) >= 5.0, road.get("name")


def test_bends_to_both_sides_and_unequal_widths(network: Network):
    through = [lane for lane in network.drivable_lanes() if not lane.junction and lane.number < 0]
    curvature = np.concatenate([lane.curvature for lane in through])
    if network.name != "intersection":  # its arms are straight but for one
        assert curvature.max() > 5e-4 and curvature.min() < -5e-4
    assert len({round(float(lane.width.max()), 2) for lane in through}) >= 2


def reachable(network: Network, lane: Lane) -> set[str]:
    """Lanes that traffic can get to by driving on and by permitted lane changes."""
    seen, todo = {lane.id}, [lane]
    while todo:
        at = todo.pop()
        onward = [
            *at.successors,
            *([at.left] if at.left and at.may_change_left else []),
            *([at.right] if at.right and at.may_change_right else []),
        ]
        todo += [network.lanes[i] for i in onward if i not in seen and network.lanes[i].drivable]
        seen.update(lane.id for lane in todo)
    return seen


def test_every_entry_lane_reaches_every_exit(name: str, network: Network):
    drivable = list(network.drivable_lanes())
    exits = {lane.id for lane in drivable if not lane.successors and lane.width[-1] > CLOSED}
    found: dict[str, set[str]] = {}
    for lane in drivable:
        reached = {network.roads[network.lanes[i].road].name for i in reachable(network, lane) & exits}
        assert reached, f"{lane.id} leads nowhere"
        if not lane.predecessors and lane.width[0] > CLOSED:
            road = network.roads[lane.road].name
            assert found.setdefault(road, reached) == reached, f"lanes of {road} differ"
    assert found == REACH[name]


def test_stop_lines_lights_and_crosswalks(name: str, network: Network):
    lit = Counter(spot.lane for light in network.traffic_lights for spot in light.spots)
    stops = {line.spot.lane: line.spot.s for line in network.stop_lines}
    held = {Control.SIGNAL: lit, Control.STOP: stops}
    for movement in network.movements:
        if movement.control in held:
            assert movement.incoming in held[movement.control] and movement.incoming in stops
    assert set(lit.values()) <= {1}
    assert all(light.controller for light in network.traffic_lights)
    for light in network.traffic_lights:
        for spot in light.spots:
            assert abs(spot.s - stops[spot.lane]) < 0.5
    walks = {lane: (s_in, s_out) for walk in network.crosswalks for lane, s_in, s_out in walk.spans}
    for lane, s in stops.items():
        s_in, s_out = walks[lane]
        assert s + 0.5 < s_in < s + 2.0 and s_out < network.lanes[lane].length
        assert s_out - s_in == pytest.approx(4.0, abs=0.1)
    has_lights = name in ("intersection", "long_route")
    assert bool(network.traffic_lights) == has_lights and bool(stops) == has_lights


def test_no_lane_changes_just_before_a_stop_line(network: Network):
    for line in network.stop_lines:
        lane = network.lanes[line.spot.lane]
        assert not lane.may_change_left and not lane.may_change_right, lane.id


def test_priority(name: str, network: Network):
    """Entries of a roundabout and stop-controlled arms let the others go first."""
    yields = [m for m in network.movements if m.control in (Control.YIELD, Control.STOP)]
    assert bool(yields) == (name in ("ramp", "roundabout", "long_route"))
    for movement in yields:
        assert movement.yields_to
        others = {network.movements[i].control for i in movement.yields_to}
        assert others == {Control.PRIORITY}


def test_long_route_climbs_and_descends():
    network = read_opendrive(FOLDER / "long_route.xodr")
    z = np.concatenate([lane.xyz[:, 2] for lane in network.drivable_lanes()])
    assert np.ptp(z) > 10.0


# --------------------------------------------------------------------------------- SUMO's netconvert


@pytest.fixture(scope="module")
def sumo_tools() -> Path:
    sumo = pytest.importorskip("sumo", reason="eclipse-sumo is not installed")
    return Path(sumo.SUMO_HOME) / "bin"


@pytest.fixture(scope="module")
def converted(name: str, sumo_tools: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    net = tmp_path_factory.mktemp("sumo") / f"{name}.net.xml"
    command = [sumo_tools / "netconvert", "--opendrive-files", FOLDER / f"{name}.xodr", "-o", net]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "Success.", "")
    return net


def test_netconvert_sees_the_same_lanes(converted: Path, network: Network):
    """Widths (of lanes that do not taper) and limits, per road and direction."""
    theirs, ours, limits = set(), set(), set()
    for edge in etree.parse(converted).getroot().iter("edge"):
        if not edge.get("function"):
            road = edge.get("id", "").split("#")[0]
            lanes = [(lane.get("width", ""), lane.get("speed", "")) for lane in edge.iter("lane")]
            theirs |= {(road, float(width), float(speed)) for width, speed in lanes}
    for lane in network.drivable_lanes():
        if lane.junction is None:
            road = f"-{lane.road}" if lane.number < 0 else lane.road
            limits.add((road, round(lane.speed_limit, 2)))
            if np.ptp(lane.width) < 1e-6:
                ours.add((road, round(float(lane.width[0]), 2), round(lane.speed_limit, 2)))
    assert ours and ours <= theirs
    assert {(road, speed) for road, _, speed in theirs} == limits


def test_traffic_runs_in_sumo(name: str, converted: Path, sumo_tools: Path):
    """Trips from everywhere to everywhere: all arrive, no warning, no teleport, no collision."""
    sumolib = pytest.importorskip("sumolib")
    net = sumolib.net.readNet(str(converted))
    road_of = {
        r.get("id"): r.get("name") for r in etree.parse(FOLDER / f"{name}.xodr").getroot().iter("road")
    }
    ends: dict[str, dict[str, str]] = {"in": {}, "out": {}}
    for edge in net.getEdges():
        road = road_of[edge.getID().lstrip("-").split("#")[0]]
        assert road
        if not any(e.getFromNode() != edge.getToNode() for e in edge.getIncoming()):
            ends["in"][road] = edge.getID()
        if not any(e.getToNode() != edge.getFromNode() for e in edge.getOutgoing()):
            ends["out"][road] = edge.getID()
    pairs = [(ends["in"][a], ends["out"][b]) for a, exits in REACH[name].items() for b in sorted(exits)]
    trips = [
        f'<trip id="{i}" depart="{2 * i}" from="{a}" to="{b}" departLane="random" departSpeed="max"/>'
        for i, (a, b) in enumerate(pair for _ in range(3) for pair in pairs)
    ]
    demand, arrivals = converted.with_suffix(".trips.xml"), converted.with_suffix(".tripinfo.xml")
    demand.write_text(f"<routes>{''.join(trips)}</routes>")
    command = [sumo_tools / "sumo", "-n", converted, "-r", demand, "--tripinfo-output", arrivals]
    command += ["--no-step-log", "--collision.action", "warn", "--seed", "1", "--end", "3000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(list(etree.parse(arrivals).getroot().iter("tripinfo"))) == len(trips)


# ------------------------------------------------------------------------------------- CARLA's parser

CARLA = """
import json, math, sys, carla
m = carla.Map("map", open(sys.argv[1]).read())
points = m.generate_waypoints(5.0)
finite = all(
    math.isfinite(v)
    for w in points
    for v in (w.transform.location.x, w.transform.location.y, w.transform.location.z,
              w.transform.rotation.yaw, w.lane_width)
)
steps = {(a.road_id, a.lane_id, b.road_id, b.lane_id) for a, b in m.get_topology()}
print(json.dumps({"count": len(points), "finite": finite, "steps": sorted(steps),
                  "crosswalks": [(p.x, -p.y) for p in m.get_crosswalks()]}))
"""


@pytest.fixture(scope="module")
def carla_map(name: str) -> dict:
    if importlib.util.find_spec("carla") is None:
        pytest.skip("carla is not installed")
    command = [sys.executable, "-c", CARLA, FOLDER / f"{name}.xodr"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1, "CARLA printed a warning"
    return json.loads(done.stdout)


def test_carla_loads_it_and_finds_every_movement(carla_map: dict, root: etree._Element):
    assert carla_map["count"] > 500 and carla_map["finite"]
    roads = {road.get("id"): road for road in root.iter("road")}
    expected = set()
    for connection in root.iterfind("junction/connection"):
        road = roads[connection.get("connectingRoad")]
        successor = road.find("link/successor")
        assert successor is not None
        for link in connection.iterfind("laneLink"):
            a, number = int(link.get("from", "")), int(link.get("to", ""))
            lane = road.find(f"lanes/laneSection/right/lane[@id='{number}']")
            assert lane is not None
            onward = lane.find("link/successor")
            if lane.get("type") == "driving" and onward is not None:
                via = (int(road.get("id", "")), number)
                expected.add((int(connection.get("incomingRoad", "")), a, *via))
                expected.add((*via, int(successor.get("elementId", "")), int(onward.get("id", ""))))
    inside = {int(id) for id, road in roads.items() if id and road.get("junction") != "-1"}
    found = {tuple(step) for step in carla_map["steps"] if (step[0] in inside) != (step[2] in inside)}
    assert found == expected


def test_carla_places_crosswalks_where_we_do(carla_map: dict, network: Network):
    ours = list(itertools.chain.from_iterable(walk.outline for walk in network.crosswalks))
    assert bool(ours) == bool(carla_map["crosswalks"])
    for corner in ours:
        distance = min(math.dist(corner.tolist(), point) for point in carla_map["crosswalks"])
        assert distance < 0.05
