"""Files of OpenSCENARIO as values, and what is refused."""

import random
import re
from pathlib import Path

import pytest
import xosc
from paths import REPO, SHARED, needs_shared

from limsim_jax.scenarios.openscenario.coverage import COVERAGE, page
from limsim_jax.scenarios.openscenario.scenario import openscenario
from limsim_jax.scenarios.openscenario.source import OpenScenarioError
from limsim_jax.scenarios.openscenario.storyboard import (
    FollowTrajectoryAction,
    LaneChangeAction,
    LanePosition,
    Nurbs,
    RelativeLanePosition,
    RouteAction,
    RoutePosition,
    SimulationTime,
    SpeedAction,
    TeleportAction,
    TrajectoryPosition,
    WorldPosition,
)

FILES = SHARED / "openscenario"
LANE_CHANGE = (
    "<PrivateAction><LateralAction><LaneChangeAction>"
    '<LaneChangeActionDynamics dynamicsShape="sinusoidal" dynamicsDimension="rate" value="1.5"/>'
    '<LaneChangeTarget><RelativeTargetLane entityRef="Ego" value="1"/></LaneChangeTarget>'
    "</LaneChangeAction></LateralAction></PrivateAction>"
)
WALKER = (
    '<Pedestrian name="p" mass="80" pedestrianCategory="pedestrian"><BoundingBox>'
    '<Center x="0" y="0" z="1"/><Dimensions length="0" width="0.6" height="1.8"/></BoundingBox></Pedestrian>'
)
BARRIER = (
    '<MiscObject name="b" mass="1" miscObjectCategory="barrier"><BoundingBox>'
    '<Center x="0" y="0" z="1"/><Dimensions length="2" width="0.6" height="1"/></BoundingBox></MiscObject>'
)


def read(tmp_path: Path, text: str, **options):
    return openscenario(xosc.write(tmp_path, text), **options)


def refuse(tmp_path: Path, text: str, said: str, **options) -> None:
    with pytest.raises(OpenScenarioError, match=said) as raised:
        read(tmp_path, text, **options)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 600


def test_a_scenario_reads_as_values(tmp_path):
    when = xosc.trigger(xosc.time_condition(2.5, edge="rising", delay=0.5))
    text = xosc.scenario(
        init=xosc.start("Ego", xosc.lane(-1, 50), 20),
        story=xosc.act(xosc.event("change", LANE_CHANGE, when)),
        stop=xosc.trigger(xosc.time_condition(30), tag="StopTrigger"),
    )
    found = read(tmp_path, text).scenario()
    assert found.version == (1, 3)
    assert found.map_file == "road.xodr"
    assert found.ego == "Ego"
    (_, first), (_, second) = found.storyboard.start
    assert first.does == TeleportAction(position=LanePosition(road="1", lane=-1, s=50.0))
    assert isinstance(second.does, SpeedAction)
    assert second.does.value == 20
    event = found.storyboard.stories[0].acts[0].groups[0].maneuvers[0].events[0]
    change = event.actions[0].does
    assert isinstance(change, LaneChangeAction)
    assert (change.lane, change.entity, change.dynamics.value) == (1, "Ego", 1.5)
    assert event.start is not None
    condition = event.start[0][0]
    assert condition.test == SimulationTime(rule="greaterOrEqual", value=2.5)
    assert (condition.edge, condition.delay) == ("rising", 0.5)
    assert "Ego (car)" in repr(read(tmp_path, text))


def test_other_versions(tmp_path):
    assert read(tmp_path, xosc.scenario(minor=0)).scenario().version == (1, 0)
    assert any("read as 1.3" in note for note in read(tmp_path, xosc.scenario(minor=4)).notes)
    refuse(tmp_path, xosc.scenario().replace('revMajor="1"', 'revMajor="2"'), "version 2.3; 1.0 to 1.3")
    refuse(tmp_path, xosc.catalog("c", xosc.CAR), "a catalog is no scenario")


def test_parameters(tmp_path):
    parameters = (
        '<ParameterDeclaration name="kph" parameterType="double" value="36"/>'
        '<ParameterDeclaration name="v" parameterType="double" value="${$kph / 3.6}"/>'
        '<ParameterDeclaration name="lane" parameterType="int" value="-1"/>'
    )
    init = xosc.start("Ego", xosc.lane("$lane", 50), "${$v + 1}")
    found = read(tmp_path, xosc.scenario(init=init, parameters=parameters)).scenario()
    assert found.parameters == {"kph": 36.0, "v": 10.0, "lane": -1}
    second = found.storyboard.start[1][1].does
    assert isinstance(second, SpeedAction)
    assert second.value == 11.0
    wrong = parameters.replace('value="-1"', 'value="1.5"')
    refuse(tmp_path, xosc.scenario(init=init, parameters=wrong), "parameter 'lane': '1.5' is no int")
    refuse(tmp_path, xosc.scenario(init=init), "parameter \\$lane is not declared")
    twice = xosc.scenario(parameters=parameters * 2)
    refuse(tmp_path, twice, "'kph' is declared twice")


def test_constraints(tmp_path):
    def text(value: float) -> str:
        return xosc.scenario(
            parameters='<ParameterDeclaration name="limit" parameterType="double" value="5"/>'
            f'<ParameterDeclaration name="x" parameterType="double" value="{value}">'
            '<ConstraintGroup><ValueConstraint rule="greaterThan" value="0"/>'
            '<ValueConstraint rule="lessOrEqual" value="${2 * $limit}"/></ConstraintGroup>'
            '<ConstraintGroup><ValueConstraint rule="equalTo" value="-1"/></ConstraintGroup>'
            "</ParameterDeclaration>"
        )

    for good in (10, 0.1, -1):
        read(tmp_path, text(good))
    refuse(tmp_path, text(11), "x = 11 is not lessOrEqual")
    refuse(tmp_path, text(0), "x = 0 is not greaterThan 0 or equalTo -1")


def test_entities(tmp_path):
    controller = '<ObjectController><Controller name="c"><Properties/></Controller></ObjectController>'
    entities = (
        xosc.entity("Other")
        + xosc.entity("Mine", controller + xosc.CAR)
        + xosc.entity("Walker", WALKER)
        + xosc.entity("Wall", BARRIER)
        + '<EntitySelection name="cars"><Members><ByType objectType="vehicle"/></Members></EntitySelection>'
    )
    found = read(
        tmp_path, xosc.scenario(entities, story=xosc.act(xosc.event("e", xosc.speed(1)), ("cars",)))
    ).scenario()
    assert [x.kind for x in found.entities] == ["vehicle", "vehicle", "pedestrian", "miscellaneous"]
    assert found.ego == "Mine"  # the one with a controller
    car, walker = found.entity("Mine"), found.entity("Walker")
    assert (car.box.length, car.box.x, car.wheelbase, car.max_speed) == (5, 1.4, 2.8, 70)
    assert walker.box.length == 0.5  # not 0
    assert found.storyboard.stories[0].acts[0].groups[0].actors == ("Other", "Mine")
    refuse(tmp_path, xosc.scenario(xosc.entity("A") * 2), "'A' is there twice")
    refuse(tmp_path, xosc.scenario(init=xosc.start("Ghost", xosc.lane())), "unknown entity 'Ghost'")


def place(text: str):
    return xosc.scenario(
        xosc.entity("Ego") + xosc.entity("B"),
        f'<Private entityRef="Ego">{xosc.teleport(f"<Position>{text}</Position>")}</Private>',
    )


ROUTE = (
    '<Route name="r" closed="false"><Waypoint routeStrategy="shortest"><Position><RoadPosition roadId="1" '
    's="5" t="0"/></Position></Waypoint></Route>'
)
POLYLINE = (
    '<Trajectory name="t" closed="false"><Shape><Polyline>'
    '<Vertex time="0"><Position><WorldPosition x="0" y="0"/></Position></Vertex>'
    '<Vertex time="1"><Position><WorldPosition x="9" y="0"/></Position></Vertex></Polyline></Shape>'
    "</Trajectory>"
)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ('<WorldPosition x="1" y="2" z="3" h="0.5"/>', WorldPosition),
        ('<RelativeWorldPosition entityRef="B" dx="1" dy="2"/>', None),
        ('<RelativeObjectPosition entityRef="B" dx="1" dy="2"/>', None),
        ('<RoadPosition roadId="1" s="5" t="-2"><Orientation h="1" type="relative"/></RoadPosition>', None),
        ('<RelativeRoadPosition entityRef="B" ds="5" dt="-2"/>', None),
        ('<LanePosition roadId="1" laneId="-2" s="5"/>', LanePosition),
        ('<RelativeLanePosition entityRef="B" dLane="1" dsLane="5"/>', RelativeLanePosition),
        (
            f"<RoutePosition><RouteRef>{ROUTE}</RouteRef><InRoutePosition>"
            '<FromLaneCoordinates pathS="7" laneId="-1"/></InRoutePosition></RoutePosition>',
            RoutePosition,
        ),
        (
            f"<RoutePosition><RouteRef>{ROUTE}</RouteRef><InRoutePosition>"
            '<FromRoadCoordinates pathS="7" t="1"/></InRoutePosition></RoutePosition>',
            RoutePosition,
        ),
        (
            f'<TrajectoryPosition s="3"><TrajectoryRef>{POLYLINE}</TrajectoryRef></TrajectoryPosition>',
            TrajectoryPosition,
        ),
    ],
)
def test_positions(tmp_path, text, kind):
    does = read(tmp_path, place(text)).scenario().storyboard.start[0][1].does
    assert isinstance(does, TeleportAction)
    found = does.position
    assert kind is None or isinstance(found, kind)
    assert type(found).__name__ == re.findall(r"<(\w+)", text)[0]


NURBS = (
    "<PrivateAction><RoutingAction><FollowTrajectoryAction><TrajectoryRef>"
    '<Trajectory name="t" closed="false"><Shape><Nurbs order="2">{points}{knots}</Nurbs></Shape></Trajectory>'
    "</TrajectoryRef><TimeReference><None/></TimeReference>"
    '<TrajectoryFollowingMode followingMode="position"/></FollowTrajectoryAction></RoutingAction>'
    "</PrivateAction>"
)


def test_knots_of_splines_fit(tmp_path):
    points = "".join(
        f'<ControlPoint><Position><WorldPosition x="{x}" y="0"/></Position></ControlPoint>' for x in range(3)
    )
    knots = "".join(f'<Knot value="{x}"/>' for x in (0, 0, 1, 2, 2))

    def text(knots: str) -> str:
        return xosc.scenario(story=xosc.act(xosc.event("e", NURBS.format(points=points, knots=knots))))

    story = read(tmp_path, text(knots)).scenario().storyboard.stories[0]
    does = story.acts[0].groups[0].maneuvers[0].events[0].actions[0].does
    assert isinstance(does, FollowTrajectoryAction)
    assert does.trajectory.nurbs == Nurbs(order=2, weights=(1, 1, 1), knots=(0, 0, 1, 2, 2))
    refuse(tmp_path, text(knots + '<Knot value="3"/>'), "3 control points of order 2 need 5 knots, not 6")


def test_passive_elements(tmp_path):
    controller = (
        "<PrivateAction><ControllerAction><OverrideControllerValueAction>"
        '<Throttle value="0" active="false"/></OverrideControllerValueAction></ControllerAction>'
        "</PrivateAction>"
    )
    lights = (
        "<PrivateAction><AppearanceAction><LightStateAction><LightType/></LightStateAction>"
        "</AppearanceAction></PrivateAction>"
    )
    weather = (
        '<GlobalAction><EnvironmentAction><Environment name="e"><Weather cloudState="free">'
        '<Fog visualRange="100"/></Weather></Environment></EnvironmentAction></GlobalAction>'
        '<GlobalAction><SetMonitorAction monitorRef="m" value="true"/></GlobalAction>'
        '<UserDefinedAction><CustomCommandAction type="x"/></UserDefinedAction>'
    )
    seen = (
        '<PrivateAction><VisibilityAction graphics="true" sensors="true" traffic="true"><SensorReferenceSet>'
        '<SensorReference name="s"/></SensorReferenceSet></VisibilityAction></PrivateAction>'
    )
    user = (
        '<ByValueCondition><UserDefinedValueCondition name="x" value="1" rule="equalTo"/></ByValueCondition>'
    )
    trailing = xosc.CAR.replace(
        "</Axles>",
        '<AdditionalAxle positionX="1"/></Axles><Properties><Property name="a" value="b"/></Properties>'
        '<TrailerHitch dx="1"/><TrailerCoupler dx="1"/>',
    )
    text = xosc.scenario(
        xosc.entity("Ego", trailing),
        init=weather + f'<Private entityRef="Ego">{controller}{lights}{seen}</Private>',
        story=xosc.act(xosc.event("e", xosc.speed(3), xosc.trigger(xosc.condition(user)))),
    )
    text = text.replace(
        "</RoadNetwork>",
        '<SceneGraphFile filepath="x"/><TrafficSignals><TrafficSignalController name="c"/></TrafficSignals>'
        "<UsedArea/></RoadNetwork>",
    ).replace("<ParameterDeclarations>", "<MonitorDeclarations/><ParameterDeclarations>")
    text = text.replace('author=""/>', 'author=""><License name="x"/></FileHeader>')
    notes = "\n".join(read(tmp_path, text).notes)
    for element in ("EnvironmentAction", "AppearanceAction", "UserDefinedAction", "SetMonitorAction"):
        assert f"<{element}>: ignored" in notes
    assert "<UserDefinedValueCondition>: never true" in notes
    assert "<TrafficSignals>: ignored" in notes


def private(action: str) -> str:
    return xosc.scenario(init=f'<Private entityRef="Ego"><PrivateAction>{action}</PrivateAction></Private>')


def by_entity(test: str) -> str:
    when = xosc.trigger(xosc.condition(xosc.by_entity(test)))
    return xosc.scenario(story=xosc.act(xosc.event("e", xosc.speed(1), when)))


def by_value(test: str) -> str:
    when = xosc.trigger(xosc.condition(f"<ByValueCondition>{test}</ByValueCondition>"))
    return xosc.scenario(story=xosc.act(xosc.event("e", xosc.speed(1), when)))


def world(action: str) -> str:
    return xosc.scenario(init=f"<GlobalAction>{action}</GlobalAction>")


REFUSED = {
    "ExternalObjectReference": xosc.scenario(xosc.entity("Ego", "<ExternalObjectReference/>")),
    "Trailer": xosc.scenario(
        xosc.entity("Ego", xosc.CAR.replace("</Axles>", "</Axles><Trailer><Trailer/></Trailer>"))
    ),
    "TrailerRef": xosc.scenario(
        xosc.entity(
            "Ego",
            xosc.CAR.replace("</Axles>", '</Axles><Trailer><TrailerRef entityRef="x"/></Trailer>'),
        )
    ),
    "GeoPosition": place('<GeoPosition latitude="1" longitude="1"/>'),
    "FromCurrentEntity": place(
        f"<RoutePosition><RouteRef>{ROUTE}</RouteRef><InRoutePosition>"
        '<FromCurrentEntity entityRef="B"/></InRoutePosition></RoutePosition>'
    ),
    "RandomRouteAction": private("<RoutingAction><RandomRouteAction/></RoutingAction>"),
    "TrailerAction": private("<TrailerAction/>"),
    "InfrastructureAction": world("<InfrastructureAction><TrafficSignalAction/></InfrastructureAction>"),
    "TrafficAction": world("<TrafficAction><TrafficSwarmAction/></TrafficAction>"),
    "RelativeClearanceCondition": by_entity('<RelativeClearanceCondition freeSpace="true"/>'),
    "TimeOfDayCondition": by_value('<TimeOfDayCondition dateTime="x" rule="lessThan"/>'),
    "TrafficSignalCondition": by_value('<TrafficSignalCondition state="b"/>'),
    "TrafficSignalControllerCondition": by_value('<TrafficSignalControllerCondition phase="b"/>'),
}
WITHIN_THOSE = {
    "TrafficSignalAction", "TrafficSwarmAction", "TrafficSourceAction", "TrafficSinkAction",
    "TrafficAreaAction", "TrafficStopAction", "UserDefinedDistribution",
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(tmp_path, name):
    shown = "Trailer" if name == "TrailerRef" else name
    refuse(tmp_path, REFUSED[name], f"scenario.xosc:\\d+: <{shown}>: not supported")


def test_every_refused_element_is_tried():
    assert {name for name, x in COVERAGE.items() if x.state == "no"} == {*REFUSED, *WITHIN_THOSE}


def test_unknown_elements(tmp_path):
    text = xosc.scenario(extra="<Surprise/>")
    refuse(tmp_path, text, "<Surprise>: unknown element \\(within <OpenSCENARIO>\\)")
    refuse(tmp_path, private("<LateralActions/>"), "<LateralActions>: unknown element; did you mean <Lateral")
    assert any("<Surprise>" in note for note in read(tmp_path, text, lenient=True).notes)
    lenient = read(tmp_path, REFUSED["TrafficSignalCondition"], lenient=True)
    assert any("TrafficSignalCondition" in note for note in lenient.notes)


def test_catalogs(tmp_path):
    folders = "".join(
        f'<{kind}Catalog><Directory path="catalogs"/></{kind}Catalog>'
        for kind in (
            "Vehicle",
            "Pedestrian",
            "MiscObject",
            "Controller",
            "Environment",
            "Maneuver",
            "Trajectory",
            "Route",
        )
    )
    wide = xosc.CAR.replace('width="2"', 'width="$w"').replace(
        "<BoundingBox>",
        '<ParameterDeclarations><ParameterDeclaration name="w" parameterType="double" value="1.9"/>'
        "</ParameterDeclarations><BoundingBox>",
    )
    entries = {
        "Vehicles": wide,
        "People": WALKER,
        "Things": BARRIER,
        "Controllers": '<Controller name="c"><Properties/></Controller>',
        "Weather": '<Environment name="e"><Weather/></Environment>',
        "Maneuvers": f'<Maneuver name="m">{xosc.event("e", xosc.speed(3))}</Maneuver>',
        "Ways": ROUTE,
        "Paths": POLYLINE,
    }
    for name, entry in entries.items():
        xosc.write(tmp_path / "catalogs", xosc.catalog(name, entry), f"{name}.xosc")

    def reference(name: str, entry: str, inside: str = "") -> str:
        return f'<CatalogReference catalogName="{name}" entryName="{entry}">{inside}</CatalogReference>'

    assigned = (
        '<ParameterAssignments><ParameterAssignment parameterRef="w" value="2.2"/></ParameterAssignments>'
    )
    ego = reference("Vehicles", "car", assigned)
    ego += f"<ObjectController>{reference('Controllers', 'c')}</ObjectController>"
    routing = (
        f"<PrivateAction><RoutingAction><AssignRouteAction>{reference('Ways', 'r')}</AssignRouteAction>"
        "</RoutingAction></PrivateAction><PrivateAction><RoutingAction><FollowTrajectoryAction><TrajectoryRef>"
        f"{reference('Paths', 't')}</TrajectoryRef><TimeReference><None/></TimeReference>"
        '<TrajectoryFollowingMode followingMode="position"/></FollowTrajectoryAction></RoutingAction>'
        "</PrivateAction>"
    )
    weather = (
        f"<GlobalAction><EnvironmentAction>{reference('Weather', 'e')}</EnvironmentAction></GlobalAction>"
    )
    entities = (
        xosc.entity("Ego", ego)
        + xosc.entity("W", reference("People", "p"))
        + xosc.entity("B", reference("Things", "b"))
    )
    group = xosc.act("").replace('<Maneuver name="actManeuver"></Maneuver>', reference("Maneuvers", "m"))
    text = xosc.scenario(
        entities, weather + f'<Private entityRef="Ego">{routing}</Private>', group, catalogs=folders
    )
    found = read(tmp_path, text).scenario()
    assert [x.box.width for x in found.entities] == [2.2, 0.6, 0.6]
    assert found.storyboard.stories[0].acts[0].groups[0].maneuvers[0].name == "m"
    way = found.storyboard.start[1][1].does
    assert isinstance(way, RouteAction)
    assert way.route.name == "r"
    refuse(tmp_path, text.replace('entryName="p"', 'entryName="q"'), "'People' has no entry 'q'; known are p")
    refuse(tmp_path, text.replace('"Ways"', '"Roads"'), "unknown catalog 'Roads'")
    outside = text.replace('path="catalogs"', 'path="../catalogs"')
    below = tmp_path / "below"
    with pytest.raises(OpenScenarioError, match="is outside the folder of the scenario; allow it by a root"):
        openscenario(xosc.write(below, outside))
    assert len(openscenario(below / "scenario.xosc", root=tmp_path)) == 1
    with pytest.raises(OpenScenarioError, match="leads out of"):
        openscenario(below / "scenario.xosc", root=below)
    refuse(tmp_path, text.replace('path="catalogs"', 'path="/etc"'), "'/etc' is absolute")


def test_states_name_elements(tmp_path):
    state = (
        '<ByValueCondition><StoryboardElementStateCondition storyboardElementType="action" '
        'storyboardElementRef="{}" state="completeState"/></ByValueCondition>'
    )

    def text(name: str) -> str:
        when = xosc.trigger(xosc.condition(state.format(name)))
        return xosc.scenario(story=xosc.act(xosc.event("e", xosc.speed(1), when)))

    read(tmp_path, text("eAction"))
    read(tmp_path, text("actManeuver::e::eAction"))
    refuse(tmp_path, text("fAction"), "there is no action 'fAction'")


# --- hostile files


def test_hostile_files_end_in_one_line(tmp_path):
    laughs = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
    entities = f'<!DOCTYPE OpenSCENARIO [<!ENTITY l0 "lol">{laughs}]>'
    outside = '<!DOCTYPE OpenSCENARIO [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    plain = xosc.scenario()
    for declaration, use in ((entities, "&l9;"), (outside, "&x;")):
        text = plain.replace("<OpenSCENARIO>", f"{declaration}<OpenSCENARIO>", 1)
        refuse(tmp_path, text.replace('name="Ego"', f'name="{use}"'), "scenario.xosc")
    nested = "${" + "(" * 1_000_000 + "1" + ")" * 1_000_000 + "}"
    init = xosc.start("Ego", xosc.lane(-1, nested))
    refuse(tmp_path, xosc.scenario(init=init), "attribute 's': an expression of 2000001 characters")
    deep = "${" + "(" * 5000 + "1}"
    refuse(tmp_path, xosc.scenario(init=xosc.start("Ego", xosc.lane(-1, deep))), "nested more than 64")
    refuse(tmp_path, xosc.scenario(extra="<a>" * 5000 + "</a>" * 5000), "scenario.xosc")
    refuse(tmp_path, xosc.scenario(extra="<a>" * 150 + "</a>" * 150), "nested more than 100 levels")
    for text in ("", "no xml", "<OpenSCENARIO>", "<OpenSCENARIO/>", "\0\0", "<a/>"):
        refuse(tmp_path, text, "scenario.xosc")
    catalogs = '<VehicleCatalog><Directory path="../../../../etc"/></VehicleCatalog>'
    body = '<CatalogReference catalogName="passwd" entryName="root"/>'
    text = xosc.scenario(xosc.entity("Ego", body), catalogs=catalogs)
    refuse(tmp_path, text, "'../../../../etc' is outside the folder")
    refuse(tmp_path, xosc.distribution("/etc/passwd", "<Deterministic/>"), "is absolute")
    with pytest.raises(OpenScenarioError, match="no such file"):
        openscenario(tmp_path / "nothing.xosc")
    with pytest.raises(OpenScenarioError, match="folder"):
        openscenario(tmp_path)


def broken(text: str, chance: random.Random) -> str:
    """A file with one thing changed at random: a byte, a value, a tag, a piece."""
    kind = chance.randrange(5)
    at = chance.randrange(len(text))
    if kind == 0:
        return text[:at] + chr(chance.randrange(32, 127)) + text[at + 1 :]
    if kind == 1:
        values = list(re.finditer(r'="([^"]*)"', text))
        one = chance.choice(values)
        new = chance.choice(["", "nan", "-1", "1e400", "$x", "${1/0}", "none", "INF", "true", "0"])
        return text[: one.start(1)] + new + text[one.end(1) :]
    if kind == 2:
        tags = list(re.finditer(r"</?([A-Z]\w+)", text))
        one = chance.choice(tags)
        return text[: one.start(1)] + chance.choice(tags).group(1) + text[one.end(1) :]
    length = chance.randrange(1, 400)
    if kind == 3:
        return text[:at] + text[at + length :]
    lines = text.splitlines()
    one = chance.randrange(len(lines))
    return "\n".join([*lines[:one], *lines[one + 1 :]])


@needs_shared
@pytest.mark.slow
def test_mutations_end_in_a_value_or_one_line(tmp_path):
    chance = random.Random(0)
    files = sorted(x for x in FILES.rglob("*.xosc") if "catalogs" not in x.parts)
    refused = 0
    for path in files:
        for folder in path.parent.iterdir():
            link = tmp_path / folder.name
            if folder.is_dir() and not link.exists():
                link.symlink_to(folder)
    for _ in range(1000):
        path = chance.choice(files)
        text = broken(path.read_text(encoding="utf-8-sig"), chance)
        try:
            openscenario(xosc.write(tmp_path, text), root="/")
        except OpenScenarioError as error:
            refused += 1
            assert "\n" not in str(error)
            assert len(str(error)) < 600
    assert 200 < refused < 1000


# --- the files that are public


@needs_shared
def test_every_shared_file_reads():
    files = sorted(x for x in FILES.rglob("*.xosc") if "catalogs" not in x.parts)
    assert len(files) >= 38
    for path in files:
        found = openscenario(path)
        assert found.scenario().ego is not None
        assert all("not supported" not in note for note in found.notes), path


# --- the page


def test_tests_of_the_table_exist():
    here = Path(__file__).parent
    for name, support in COVERAGE.items():
        file, _, test = support.test.partition("::")
        path = here / file
        assert path.exists(), name
        assert f"def {test}(" in path.read_text(), f"{name}: no {test} in {file}"


def test_the_page_is_of_this_table():
    assert (REPO / "docs" / "reference" / "openscenario.md").read_text() == page()


def test_the_table_knows_what_readers_ask_for():
    """Every element that a reader names is in the table."""
    folder = REPO / "limsim_jax" / "scenarios" / "openscenario"
    asked: set[str] = set()
    for path in folder.glob("reading*.py"):
        text = path.read_text()
        for call in re.findall(r"\.(?:child|optional|children|only)\(([^)]*)\)", text):
            asked |= set(re.findall(r'"([A-Z]\w+)"', call))
    assert len(asked) > 60
    assert asked - set(COVERAGE) - {"RoadCoordinates", "LaneCoordinates"} == set()
