"""SUMO demand against sumolib, SUMO's own defaults, the figures of the shared README, and wrong files."""

import gzip
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
import sumolib
from paths import SHARED, needs_shared

from limsim_jax.maps.network import Action, MapError
from limsim_jax.maps.sumo import VEHICLE_CLASSES, read_demand, read_sumo
from limsim_jax.maps.sumo.config import read_sumocfg
from limsim_jax.maps.sumo.records import Demand, Distribution, SpeedFactor

SUMO = SHARED / "sumo"


@pytest.fixture
def read(tmp_path):
    def reader(content: str, **kwargs) -> Demand:
        path = tmp_path / "demand.rou.xml"
        path.write_text(f"<routes>\n{content}\n</routes>")
        return read_demand(path, **kwargs)

    return reader


@pytest.fixture
def network(tmp_path):
    lanes = "".join(
        f'<edge id="{e}" from="x" to="y">'
        f'<lane id="{e}_0" index="0" speed="9" length="9" shape="0,0 9,0"/></edge>'
        for e in "abc"
    )
    path = tmp_path / "map.net.xml"
    path.write_text(f'<net version="1.20">{lanes}</net>')
    return read_sumo(path)


# ---- against the shared data


def demand_files(folder: Path) -> list[Path]:
    """Vehicle types and other additional files first, as SUMO loads them."""
    routes = sorted(folder.glob("*.rou.xml"), key=lambda path: "vtypes" not in path.name)
    return sorted(folder.glob("*.add.xml")) + routes


def readme_counts() -> dict[str, int]:
    """Column 'vehicles/trips in routes' of the README beside the data."""
    text = (SUMO / "README.md").read_text() if SHARED.is_dir() else ""
    rows = re.findall(r"^\| `(\w+)` \|(.*)\|$", text, re.M)
    return {name: int(cells.split("|")[5]) for name, cells in rows if int(cells.split("|")[5])}


@pytest.mark.engine
@needs_shared
@pytest.mark.parametrize("name", readme_counts())
def test_counts_and_values_equal_sumolib(name):
    files = demand_files(SUMO / name)
    demand = read_demand(files, read_sumo(next((SUMO / name).glob("*.net.xml"))))
    assert len(demand.vehicles) == readme_counts()[name]
    seen = 0
    for file in files:
        for kind in ("vehicle", "trip"):
            for theirs in sumolib.xml.parse(str(file), kind):
                mine = demand.vehicles[theirs.id]
                seen += 1
                assert mine.depart == float(theirs.depart)
                assert mine.type == (theirs.type if theirs.hasAttribute("type") else "DEFAULT_VEHTYPE")
                if kind == "trip":
                    assert (mine.origin, mine.destination) == (theirs.attr_from, theirs.to)
                elif theirs.hasChild("route"):
                    assert demand.routes[mine.route or ""].edges == tuple(theirs.route[0].edges.split())
                else:
                    assert mine.route == theirs.route
                stops = theirs.stop if theirs.hasChild("stop") else []
                assert [(s.place, s.duration) for s in mine.stops] == [
                    (s.busStop, float(s.duration)) for s in stops
                ]
        for theirs in sumolib.xml.parse(str(file), "vType"):
            mine = demand.types[theirs.id]
            for attribute, value in (
                ("length", mine.length),
                ("width", mine.width),
                ("accel", mine.accel),
                ("decel", mine.decel),
                ("minGap", mine.min_gap),
                ("maxSpeed", mine.max_speed),
                ("sigma", mine.sigma),
                ("probability", mine.probability),
            ):
                if theirs.hasAttribute(attribute):
                    assert value == float(theirs.getAttribute(attribute)), (theirs.id, attribute)
    assert seen == len(demand.vehicles)
    assert demand.report.total(Action.APPROXIMATED) == 0


@needs_shared
def test_bologna():
    config = read_sumocfg(SUMO / "bologna_pasubio" / "run.sumocfg")
    assert config.network.name == "pasubio_buslanes.net.xml" and len(config.additional) == 5
    demand = read_demand([*config.additional, *config.routes])
    assert len(demand.stop_places) == 25
    private = demand.type_distributions["private"]
    assert private.members[0] == "passenger1" and sum(private.weights) == pytest.approx(1.15)
    assert demand.report.counts["add/tlLogic", Action.IGNORED] == 8
    assert demand.report.counts["stop", Action.READ] == 499
    bus = demand.vehicles["11_0"]
    assert bus.depart_lane == "best" and bus.depart_pos == 0.0 and bus.arrival_pos == -1.0
    assert demand.types["bus"].parameters["lcCooperative"] == "0.0"


@needs_shared
def test_configurations():
    config = read_sumocfg(SUMO / "ingolstadt1" / "ingolstadt1.sumocfg")
    assert (config.begin, config.end) == (57600.0, 61200.0)
    with pytest.raises(MapError, match=r"do not exist: .*net/Town01\.net\.xml, .*rou/Town01\.rou\.xml"):
        read_sumocfg(SUMO / "limsim_town01" / "Town01.sumocfg")
    town05 = read_sumocfg(SUMO / "limsim_town05" / "Town05.sumocfg")
    assert [p.name for p in town05.routes] == ["carlavtypes.rou.xml", "Town05.rou.xml"]
    assert town05.report.counts["gui_only/gui-settings-file", Action.IGNORED] == 1


# ---- against SUMO itself


@pytest.mark.engine
def test_defaults_of_vehicle_classes_are_sumos(read, tmp_path, network):
    pytest.importorskip("libsumo")
    classes = sorted(VEHICLE_CLASSES | {"ignoring"})
    types = "".join(f'<vType id="{c}_" vClass="{c}"/>' for c in classes)
    types += '<vType id="strong" decel="9.5"/><vType id="spread" speedFactor="1.2"/>'
    types += '<vType id="normc" speedFactor="normc(1.1,0.3,0.5,1.5)"/>'
    types += '<vType id="norm" speedFactor="norm(1.3,0.2)"/>'
    types += '<vType id="dev" speedDev="0.7"/>'
    demand = read(types)
    code = """
import sys, libsumo
libsumo.start(["sumo", "-n", sys.argv[1], "-r", sys.argv[2], "--no-step-log", "--no-warnings"])
v = libsumo.vehicletype
for i in v.getIDList():
    print(">", i, v.getLength(i), v.getWidth(i), v.getHeight(i), v.getMinGap(i), v.getAccel(i), v.getDecel(i),
          v.getEmergencyDecel(i), v.getApparentDecel(i), v.getMaxSpeed(i), v.getTau(i), v.getImperfection(i),
          v.getSpeedFactor(i), v.getSpeedDeviation(i))
"""
    net = tmp_path / "grid.net.xml"
    net.write_text(
        '<net version="1.20"><location netOffset="0,0" convBoundary="0,0,9,9" origBoundary="0,0,9,9"'
        ' projParameter="!"/><edge id="e" from="a" to="b"><lane id="e_0" index="0" speed="9" length="90"'
        ' shape="0,0 90,0"/></edge><junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes=""'
        ' shape="0,0 0,1"/><junction id="b" type="dead_end" x="90" y="0" incLanes="e_0" intLanes=""'
        ' shape="90,0 90,1"/></net>'
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(net), str(tmp_path / "demand.rou.xml")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    rows = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith(">")]
    theirs = {name: [float(x) for x in values] for name, *values in rows}
    assert set(demand.types) <= set(theirs)
    for name, t in demand.types.items():
        factor = t.speed_factor
        mine = [t.length, t.width, t.height, t.min_gap, t.accel, t.decel, t.emergency_decel, t.apparent_decel]
        mine += [t.max_speed, t.tau, t.sigma, factor.mean, factor.deviation]
        assert mine == pytest.approx(theirs[name], abs=2e-3), name


# ---- what elements mean


def test_vehicle_types(read):
    demand = read(
        """<vType id="a" vClass="truck" length="9" carFollowModel="IDM" tau="1.4" delta="5" lcStrategic="2"
             color="red">
             <param key="device.fcd" value="1"/></vType>
           <vType id="b"><carFollowing-Krauss sigma="0.2" tau="0.9"/></vType>
           <vType id="c" vClass="coach"/><vType id="d" vClass="tram"/>
           <vType id="e" vClass="public_transport"/>"""
    )
    a, b, c, d, e = (demand.types[i] for i in "abcde")
    assert (a.engine_class, a.length, a.model, a.tau) == ("truck", 9.0, "IDM", 1.4)
    assert a.parameters == {"delta": "5", "lcStrategic": "2", "color": "red", "device.fcd": "1"}
    assert (b.model, b.sigma, b.tau) == ("Krauss", 0.2, 0.9)
    assert (c.engine_class, d.engine_class, e.vehicle_class) == ("bus", None, "bus")


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        ('speedFactor="1.2" speedDev="0"', SpeedFactor(mean=1.2, deviation=0.0)),
        (
            'speedFactor="normc(1, 0.2, 0.3, 1.2)"',
            SpeedFactor(mean=1, deviation=0.2, minimum=0.3, maximum=1.2),
        ),
        ('speedFactor="normc(1,0.2)"', SpeedFactor(mean=1, deviation=0.2)),
        (
            'speedFactor="norm(1,0.2)"',
            SpeedFactor(mean=1, deviation=0.2, minimum=-math.inf, maximum=math.inf),
        ),
    ],
)
def test_speed_factors(read, text, factor):
    assert read(f'<vType id="a" {text}/>').types["a"].speed_factor == factor


def test_distributions(read):
    demand = read(
        """<vType id="a" probability="3"/><vType id="b"/>
           <vTypeDistribution id="t" vTypes="a b"/>
           <vTypeDistribution id="u" vTypes="a b" probabilities="0.25 0.75"/>
           <vTypeDistribution id="v">
             <vType id="c" probability="2"/><vType refId="a" probability="5"/></vTypeDistribution>
           <route id="r" edges="x y"/>
           <routeDistribution id="s">
             <route id="q" edges="x z" probability="4"/><route refId="r"/></routeDistribution>
           <vehicle id="1" depart="0" route="s" type="u"/>
           <vehicle id="2" depart="1"><routeDistribution>
             <route edges="x y" probability="1"/><route edges="x z" probability="2"/>
             </routeDistribution></vehicle>"""
    )

    def members(distribution: Distribution) -> dict[str, float]:
        return dict(zip(distribution.members, distribution.weights, strict=True))

    assert members(demand.type_distributions["t"]) == {"a": 3.0, "b": 1.0}
    assert members(demand.type_distributions["u"]) == {"a": 0.25, "b": 0.75}
    assert members(demand.type_distributions["v"]) == {"c": 2.0, "a": 5.0}
    assert members(demand.route_distributions["s"]) == {"q": 4.0, "r": 1.0}
    inline = demand.route_distributions[demand.vehicles["2"].route]
    assert [demand.routes[m].edges for m in inline.members] == [("x", "y"), ("x", "z")]
    assert inline.weights == (1.0, 2.0)


def test_vehicles_trips_and_stops(read):
    demand = read(
        """<route id="r" edges="x y"><stop lane="x_0" endPos="5" duration="3"/></route>
           <vehicle id="1" depart="1:02:03" route="r" departLane="2" departSpeed="max" departPos="random"
             arrivalLane="first" speedFactor="1.1" color="red">
             <stop lane="y_0" startPos="1" endPos="-2" until="0:01:00" parking="true"/>
             <stop busStop="s" duration="20"/></vehicle>
           <trip id="2" depart="triggered" from="x" to="z" via="y w"/>
           <busStop id="s" lane="y_0" startPos="10" endPos="20" lines="4"/>"""
    )
    one, two = demand.vehicles.values()
    assert (one.depart, one.depart_lane, one.depart_speed, one.depart_pos) == (3723.0, 2, "max", "random")
    assert (one.arrival_lane, one.speed_factor, one.type) == ("first", 1.1, "DEFAULT_VEHTYPE")
    assert one.parameters == {"color": "red"}
    lane, bus = one.stops
    assert (lane.lane, lane.start_pos, lane.end_pos, lane.until) == ("y_0", 1.0, -2.0, 60.0)
    assert lane.parameters == {"parking": "true"} and (bus.place, bus.duration) == ("s", 20.0)
    assert demand.routes["r"].stops[0].duration == 3.0
    assert (two.depart, two.origin, two.destination, two.via) == ("triggered", "x", "z", ("y", "w"))
    assert demand.stop_places["s"].end_pos == 20.0 and demand.stop_places["s"].kind == "busStop"
    assert demand.types["DEFAULT_VEHTYPE"].length == 5.0


@pytest.mark.parametrize(
    ("attributes", "field", "value"),
    [
        ('number="7"', "number", 7),
        ('period="2.5"', "period", 2.5),
        ('period="exp(0.5)"', "poisson_rate", 0.5),
        ('vehsPerHour="900"', "vehicles_per_hour", 900.0),
        ('perHour="900"', "vehicles_per_hour", 900.0),
        ('probability="0.3"', "probability", 0.3),
    ],
)
def test_flows(read, attributes, field, value):
    flow = read(
        f'<flow id="f" begin="10" end="0:10:00" from="x" to="y" departSpeed="5" {attributes}/>'
    ).flows["f"]
    names = ("number", "period", "poisson_rate", "vehicles_per_hour", "probability")
    rates = {name: getattr(flow, name) for name in names}
    assert {name for name, v in rates.items() if v is not None} == {field} and rates[field] == value
    assert (flow.begin, flow.end, flow.vehicle.depart, flow.vehicle.depart_speed) == (10.0, 600.0, 10.0, 5.0)
    assert flow.vehicle.parameters == {}


def test_intervals_and_included_files(read, tmp_path):
    (tmp_path / "more.rou.xml").write_text('<routes><route id="r" edges="x"/></routes>')
    demand = read(
        '<include href="more.rou.xml"/>'
        '<interval begin="5" end="9"><flow id="f" route="r" number="2"/></interval>'
    )
    assert (demand.flows["f"].begin, demand.flows["f"].end) == (5.0, 9.0) and "r" in demand.routes
    with pytest.raises(MapError, match="includes itself"):
        read('<include href="demand.rou.xml"/>')


def test_unknown_things_are_reported(read):
    demand = read(
        """<person id="p" depart="0"/><person id="q" depart="0"/><odd/><vType id="a"><odd/></vType>
           <vehicle id="1" depart="0" type="none"><route edges="x"/></vehicle>
           <trip id="2" depart="0" fromTaz="t" toTaz="u"/>"""
    )
    counts = demand.report.counts
    assert counts["routes/person", Action.IGNORED] == 2
    assert counts["routes/odd", Action.IGNORED] == counts["vType/odd", Action.IGNORED] == 1
    notes = [str(n) for n in demand.report.notes]
    assert any("vType none: used 1 times" in n for n in notes)
    assert any("trip 2: origin or destination is no edge" in n for n in notes)
    assert demand.vehicles["2"].parameters == {"fromTaz": "t", "toTaz": "u"}
    assert len([n for n in notes if " routes/person " in n]) == 1


def test_several_files_refer_to_one_another(tmp_path):
    (tmp_path / "t.add.xml").write_text('<additional><vType id="a" length="7"/></additional>')
    packed = tmp_path / "d.rou.xml.gz"
    vehicle = '<vehicle id="1" type="a" depart="0"><route edges="x"/></vehicle>'
    packed.write_bytes(gzip.compress(f"<routes>{vehicle}</routes>".encode()))
    demand = read_demand([tmp_path / "t.add.xml", packed])
    assert demand.types["a"].length == 7.0 and demand.vehicles["1"].type == "a" and not demand.report.notes
    assert demand.vehicles["1"].file == str(packed)


# ---- edges against the network


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            '<vehicle id="v7" depart="0"><route edges="a q b"/></vehicle>',
            "vehicle v7: edge 'q' of route '!v7'",
        ),
        ('<trip id="v7" depart="0" from="a" to="q"/>', "vehicle v7: edge 'q'"),
        ('<trip id="v7" depart="0" from="a" to="b" via="q"/>', "vehicle v7: edge 'q'"),
        ('<route id="r" edges="a q"/><flow id="f" route="r" number="1"/>', "flow f: edge 'q' of route 'r'"),
        ('<route id="r" edges="a q"/>', "route r: edge 'q'"),
        ('<trip id="v7" depart="0" from="a" to="b"><stop lane="a_9"/></trip>', "vehicle v7: lane 'a_9'"),
        ('<busStop id="s" lane="q_0"/>', "busStop s: its lane 'q_0'"),
    ],
)
def test_missing_edges_are_named(read, network, content, message):
    with pytest.raises(MapError) as caught:
        read(content, network=network)
    assert message in str(caught.value) and network.source in str(caught.value)
    assert caught.value.line is not None
    assert read(content)  # without a network it cannot be checked


def test_good_edges_pass(read, network):
    demand = read(
        '<trip id="1" depart="0" from="a" to="c" via="b"><stop lane="c_0" duration="1"/></trip>',
        network=network,
    )
    assert len(demand.vehicles) == 1


# ---- files that are wrong

VEHICLE = '<vehicle id="1" depart="0"><route edges="x"/></vehicle>'
BAD = {
    "no id": (VEHICLE.replace('id="1"', ""), "'id' is missing"),
    "no depart": (VEHICLE.replace('depart="0"', ""), "'depart' is missing"),
    "depart": (VEHICLE.replace('depart="0"', 'depart="1:2"'), "neither seconds nor"),
    "depart 2": (VEHICLE.replace('depart="0"', 'depart="0:nan:0"'), "not a finite number"),
    "twice": (VEHICLE + VEHICLE.replace('edges="x"', 'edges="y"'), "taken"),
    "no route": ('<vehicle id="1" depart="0"/>', "neither a route"),
    "two routes": (VEHICLE.replace("<route", '<route edges="y"/><route'), "more than one route"),
    "unknown route": ('<vehicle id="1" depart="0" route="q"/>', "no route 'q'"),
    "empty route": (VEHICLE.replace('edges="x"', 'edges=""'), "no edges"),
    "lane": (VEHICLE.replace("depart=", 'departLane="1.5" depart='), "not a whole number"),
    "pos": (VEHICLE.replace("depart=", 'departPos="nan" depart='), "not a finite number"),
    "type twice": ('<vType id="a"/><vType id="a"/>', "taken"),
    "class": ('<vType id="a" vClass="ufo"/>', "vClass='ufo'"),
    "length": ('<vType id="a" length="0"/>', "below"),
    "accel": ('<vType id="a" accel="x"/>', "'accel' is 'x'"),
    "factor": ('<vType id="a" speedFactor="normc(1)"/>', "1 parameters"),
    "factor 2": ('<vType id="a" speedFactor="normc(1,0.1,2,1)"/>', "wrong way round"),
    "empty distribution": ('<vTypeDistribution id="a"/>', "empty"),
    "distribution": ('<vTypeDistribution id="a" vTypes="q"/>', "names 'q'"),
    "weights": (
        '<vType id="b"/><vTypeDistribution id="a" vTypes="b" probabilities="1 2"/>',
        "2 probabilities for 1",
    ),
    "no weight": ('<vType id="b"/><vTypeDistribution id="a" vTypes="b" probabilities="0"/>', "add up to 0"),
    "no rate": ('<flow id="f" from="x" to="y"/>', "none of number"),
    "two rates": ('<flow id="f" from="x" to="y" period="1" vehsPerHour="2"/>', "more than one"),
    "probability": ('<flow id="f" from="x" to="y" probability="1.2"/>', "above 1"),
    "backwards": ('<flow id="f" begin="9" end="3" from="x" to="y" number="1"/>', "ends at 3 s"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_content(read, tmp_path, name):
    content, message = BAD[name]
    with pytest.raises(MapError) as caught:
        read(content)
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "demand.rou.xml:2")) and message in text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (bytes(range(200)), "not well-formed"),
        (b"<routes><vehicle id='1' depart='0'><route edges='x'/></vehicle>", "not well-formed"),
        (b"<net/>", "root element"),
        (b'<!DOCTYPE r [<!ENTITY a "b">]><routes><vType id="&a;"/></routes>', "DOCTYPE"),
        (gzip.compress(b"<routes/>" * 50, mtime=0)[:30], "damaged gzip"),
    ],
)
def test_bad_files(tmp_path, content, message):
    path = tmp_path / "demand.rou.xml"
    path.write_bytes(content)
    with pytest.raises(MapError) as caught:
        read_demand(path)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value)


def test_bad_configurations(tmp_path):
    path = tmp_path / "run.sumocfg"
    for content, message in (
        ("<configuration/>", "0 networks"),
        ('<configuration><net-file value="q.net.xml"/></configuration>', r"do not exist: .*q\.net\.xml"),
        ("<routes/>", "root element"),
        ('<configuration><begin value="x"/><n value="run.sumocfg"/></configuration>', "'begin' is 'x'"),
    ):
        path.write_text(content)
        with pytest.raises(MapError, match=message):
            read_sumocfg(path)
