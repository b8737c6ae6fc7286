"""Actions of OpenSCENARIO against their formulas: within 1 cm and 1 cm/s at several moments."""

import math
from typing import Any

import numpy as np
import pytest
import xosc
from osc_worlds import PIECE, SIZES, play, run, straight

from limsim_jax.maps.map import load_map
from limsim_jax.scenarios.openscenario.build import as_device, build
from limsim_jax.scenarios.openscenario.player import Bodies
from limsim_jax.scenarios.openscenario.roads import Roads
from limsim_jax.scenarios.openscenario.scenario import openscenario

CM = 0.01

pytestmark = pytest.mark.engine


def when(seconds=1.0):
    return xosc.trigger(xosc.time_condition(seconds, edge="rising"))


def one(action, *, v=20, s=50, lane=-1, others="", entities="", actors=("Ego",), **options):
    """A scenario in which Ego starts an action at 1 s."""
    entities = xosc.entity("Ego") + entities
    init = xosc.start("Ego", xosc.lane(lane, s), v) + others
    return xosc.scenario(entities, init, xosc.act(xosc.event("e", action, when()), actors), **options)


def other(name="B", lane=-1, s=100, v=20) -> dict[str, Any]:
    return {"entities": xosc.entity(name), "others": xosc.start(name, xosc.lane(lane, s), v)}


def shape_of(shape, u):
    u = np.clip(u, 0, 1)
    return {
        "linear": u,
        "sinusoidal": (1 - np.cos(np.pi * u)) / 2,
        "cubic": 3 * u**2 - 2 * u**3,
        "step": np.ones_like(u),
    }[shape]


def integral(v, times):
    """m travelled, by the trapezoidal rule on a fine grid."""
    fine = np.linspace(0, times[-1], 20001)
    way = np.concatenate([[0], np.cumsum((v(fine)[1:] + v(fine)[:-1]) / 2 * np.diff(fine))])
    return np.interp(times, fine, way)


PEAK = {"linear": 1.0, "sinusoidal": math.pi / 2, "cubic": 1.5}


@pytest.mark.parametrize(
    ("shape", "dimension", "over", "target"),
    [
        ("step", "time", 0, 30),
        ("linear", "time", 4, 30),
        ("sinusoidal", "time", 4, 30),
        ("cubic", "time", 3, 5),
        ("linear", "rate", 2.5, 10),
        ("linear", "rate", -2.5, 10),
        ("sinusoidal", "rate", 3, 28),
        ("cubic", "rate", 3, 0),
        ("linear", "distance", 100, 30),
    ],
)
def test_speed(tmp_path_factory, shape, dimension, over, target):
    text = one(xosc.speed(target, shape, dimension, over))
    found = play(tmp_path_factory.getbasetemp(), text)["Ego"]
    change = target - 20
    span = {
        "time": over,
        "rate": PEAK.get(shape, 0) * abs(change) / max(abs(over), 1e-9),
        "distance": 2 * over / (20 + target),
    }[dimension]

    def v(time):
        u = np.where(time <= 1, 0.0, (time - 1) / max(span, 1e-9))
        return 20 + change * np.where(time <= 1, 0, shape_of(shape, u))

    times = np.arange(len(found["v"])) * 0.05
    np.testing.assert_allclose(found["v"][times > 1], v(times)[times > 1], atol=CM)
    np.testing.assert_allclose(found["x"], 50 + integral(v, times), atol=CM)


def relative(value, kind="delta", continuous="false"):
    return (
        f'<RelativeTargetSpeed entityRef="B" value="{value}" speedTargetValueType="{kind}" '
        f'continuous="{continuous}"/>'
    )


@pytest.mark.parametrize(
    ("value", "kind", "continuous", "after"),
    [(5, "delta", "false", 20), (1.5, "factor", "false", 22.5), (5, "delta", "true", 9)],
)
def test_relative_speed(tmp_path_factory, value, kind, continuous, after):
    """Once: the other's speed of the start. Continuous: what it is then, without an end."""
    target = relative(value, kind, continuous)
    mine = xosc.event("e", xosc.speed(0, "linear", "time", 2, target), when())
    slows = xosc.event("slows", xosc.speed(4), when(5))
    text = xosc.scenario(
        xosc.entity("Ego") + xosc.entity("B"),
        xosc.start("Ego", xosc.lane(-1, 50), 20) + xosc.start("B", xosc.lane(-2, 50), 15),
        xosc.act(mine, name="one") + xosc.act(slows, ("B",), name="two"),
    )
    found = play(tmp_path_factory.getbasetemp(), text)
    v, at = found["Ego"]["v"], found.at
    first = 15 * value if kind == "factor" else 15 + value
    assert v[at(2)] == pytest.approx((20 + first) / 2, abs=CM)
    assert v[at(4.5)] == pytest.approx(first, abs=CM)
    assert v[at(8)] == pytest.approx(after, abs=CM)
    running = np.asarray(found.memory.longitudinal[:, 0]) >= 0
    assert running[at(9)] == (continuous == "true")


def test_speed_profile(tmp_path_factory):
    entries = "".join(f'<SpeedProfileEntry speed="{v}" time="{t}"/>' for v, t in ((10, 2), (10, 1), (25, 3)))
    action = (
        '<PrivateAction><LongitudinalAction><SpeedProfileAction followingMode="position">'
        f"{entries}</SpeedProfileAction></LongitudinalAction></PrivateAction>"
    )
    found = play(tmp_path_factory.getbasetemp(), one(action))["Ego"]
    times = np.arange(len(found["v"])) * 0.05

    def v(time):
        return np.interp(time, [0, 1, 3, 4, 7], [20, 20, 10, 10, 25])

    np.testing.assert_allclose(found["v"], v(times), atol=CM)
    np.testing.assert_allclose(found["x"], 50 + integral(v, times), atol=CM)


def gap_action(inside="", continuous="false", gap='distance="30"', displacement="trailing", free="true"):
    return (
        f'<PrivateAction><LongitudinalAction><LongitudinalDistanceAction entityRef="B" {gap} '
        f'freespace="{free}" continuous="{continuous}" displacement="{displacement}ReferencedEntity" '
        f'coordinateSystem="entity">{inside}</LongitudinalDistanceAction></LongitudinalAction></PrivateAction>'
    )


@pytest.mark.parametrize(
    ("action", "x"),
    [
        (gap_action(), -35.0),  # 30 m and a length of 5 m
        (gap_action(free="false"), -30.0),
        (gap_action(displacement="leading"), 35.0),
        (gap_action(gap='timeGap="2"'), -45.0),  # of the follower, at 20 m/s
    ],
)
def test_longitudinal_distance(tmp_path_factory, action, x):
    found = play(tmp_path_factory.getbasetemp(), one(action, **other(v=20)))
    ego, b = found["Ego"], found["B"]
    after = found.at(1.05)
    np.testing.assert_allclose(ego["x"][after:] - b["x"][after:], x, atol=CM)
    assert ego["v"][-1] == pytest.approx(20, abs=CM)


def test_longitudinal_distance_within_limits(tmp_path_factory):
    limits = '<DynamicConstraints maxAcceleration="2" maxDeceleration="3" maxSpeed="30"/>'
    action = gap_action(limits, continuous="true")
    found = play(tmp_path_factory.getbasetemp(), one(action, **other(s=200, v=20)), 60.0)
    ego, b = found["Ego"], found["B"]
    assert np.diff(ego["v"]).max() / 0.05 < 2.001
    assert np.diff(ego["v"]).min() / 0.05 > -3.001
    assert ego["v"].max() < 30.001
    assert ego["x"][-1] - b["x"][-1] == pytest.approx(-35, abs=CM)
    assert ego["v"][-1] == pytest.approx(20, abs=CM)


def lane_change(target, shape="sinusoidal", dimension="time", over=4.0, offset=0.0):
    return (
        f'<PrivateAction><LateralAction><LaneChangeAction targetLaneOffset="{offset}">'
        f'<LaneChangeActionDynamics dynamicsShape="{shape}" dynamicsDimension="{dimension}" value="{over}"/>'
        f"<LaneChangeTarget>{target}</LaneChangeTarget></LaneChangeAction></LateralAction></PrivateAction>"
    )


def absolute(number):
    return f'<AbsoluteTargetLane value="{number}"/>'


def beside(value, entity="Ego"):
    return f'<RelativeTargetLane entityRef="{entity}" value="{value}"/>'


@pytest.mark.parametrize(
    ("action", "shape", "span", "target"),
    [
        (lane_change(absolute(-2)), "sinusoidal", 4, -5.25),
        (lane_change(beside(-1)), "sinusoidal", 4, -5.25),
        (lane_change(beside(1)), "sinusoidal", 4, 1.75),  # lane 0 is no lane
        (lane_change(absolute(-2), "linear"), "linear", 4, -5.25),
        (lane_change(absolute(-2), "cubic"), "cubic", 4, -5.25),
        (lane_change(absolute(-2), "step"), "step", 0, -5.25),
        (lane_change(absolute(-2), "sinusoidal", "rate", 1.4), "sinusoidal", math.pi * 3.5 / 2.8, -5.25),
        (lane_change(absolute(-2), "cubic", "rate", 1.5), "cubic", 3.5, -5.25),
        (lane_change(absolute(-2), "linear", "rate", 1.0), "linear", 3.5, -5.25),
        (lane_change(absolute(-2), "cubic", "distance", 60), "cubic", 3, -5.25),
        (lane_change(absolute(-2), offset=0.5), "sinusoidal", 4, -4.75),
    ],
)
def test_lane_change(tmp_path_factory, action, shape, span, target):
    found = play(tmp_path_factory.getbasetemp(), one(action))["Ego"]
    times = np.arange(len(found["y"])) * 0.05
    u = (times - 1) / max(span, 1e-9)
    share = np.where(times > 1, shape_of(shape, u), 0)
    np.testing.assert_allclose(found["y"], -1.75 + (target + 1.75) * share, atol=CM)
    np.testing.assert_allclose(found["x"], 50 + 20 * times, atol=CM)


@pytest.mark.parametrize(("value", "y"), [(1, 1.75), (-1, 5.25)])
def test_left_and_right_on_the_other_carriageway(tmp_path_factory, value, y):
    """Left of an entity that drives west is south: the lane next to the middle."""
    start_lane = 2 if value == 1 else 1
    text = one(lane_change(beside(value)), lane=start_lane, s=900)
    found = play(tmp_path_factory.getbasetemp(), text)["Ego"]
    assert found["x"][-1] < found["x"][0]
    assert found["y"][-1] == pytest.approx(y, abs=CM)


def offset_action(target, shape="sinusoidal", most='maxLateralAcc="0.8"', continuous="false"):
    return (
        f'<PrivateAction><LateralAction><LaneOffsetAction continuous="{continuous}">'
        f'<LaneOffsetActionDynamics dynamicsShape="{shape}" {most}/><LaneOffsetTarget>{target}'
        "</LaneOffsetTarget></LaneOffsetAction></LateralAction></PrivateAction>"
    )


ABSOLUTE = '<AbsoluteTargetLaneOffset value="{}"/>'


@pytest.mark.parametrize(
    ("action", "shape", "span", "target"),
    [
        (offset_action(ABSOLUTE.format(0.9)), "sinusoidal", math.pi * math.sqrt(0.9 / 1.6), 0.9),
        (offset_action(ABSOLUTE.format(-0.9), "cubic"), "cubic", math.sqrt(6 * 0.9 / 0.8), -0.9),
        (offset_action(ABSOLUTE.format(0.6), "linear"), "linear", 2 * math.sqrt(0.6 / 0.8), 0.6),
        (offset_action(ABSOLUTE.format(0.6), "step", ""), "step", 0, 0.6),
        (
            offset_action('<RelativeTargetLaneOffset entityRef="B" value="0.5"/>'),
            "sinusoidal",
            math.pi * math.sqrt(0.9 / 1.6),
            0.9,
        ),
    ],
)
def test_lane_offset(tmp_path_factory, action, shape, span, target):
    place = xosc.lane(-2, 100, offset=0.4)
    text = one(action, entities=xosc.entity("B"), others=xosc.start("B", place, 20))
    found = play(tmp_path_factory.getbasetemp(), text)["Ego"]
    times = np.arange(len(found["y"])) * 0.05
    share = np.where(times > 1, shape_of(shape, (times - 1) / max(span, 1e-9)), 0)
    np.testing.assert_allclose(found["y"], -1.75 + target * share, atol=CM)
    if shape in ("sinusoidal", "cubic"):  # the peak of its lateral acceleration is as asked for
        pull = np.abs(np.diff(found["y"], 2)).max() / 0.05**2
        assert pull == pytest.approx(0.8, rel=0.1)


@pytest.mark.parametrize(
    ("side", "free", "y"), [("right", "true", -4.25), ("left", "false", 0.75), ("any", "false", -4.25)]
)
def test_lateral_distance(tmp_path_factory, side, free, y):
    """2.5 m beside the other, or 0.5 m between bodies of 2 m."""
    side = side if side == "any" else f"{side}ToReferencedEntity"
    distance = 0.5 if free == "true" else 2.5
    action = (
        f'<PrivateAction><LateralAction><LateralDistanceAction entityRef="B" distance="{distance}" '
        f'freespace="{free}" continuous="false" displacement="{side}"/></LateralAction></PrivateAction>'
    )
    found = play(tmp_path_factory.getbasetemp(), one(action, lane=-2, **other()))["Ego"]
    assert found["y"][0] == pytest.approx(-5.25, abs=CM)
    assert found["y"][-1] == pytest.approx(y, abs=CM)


@pytest.mark.parametrize(
    ("place", "x", "y"),
    [
        (xosc.lane(-2, 300), 300, -5.25),
        ('<Position><WorldPosition x="250" y="-1.5" h="0"/></Position>', 250, -1.5),
        ('<Position><RelativeLanePosition entityRef="B" dLane="-1" ds="12"/></Position>', 132, -5.25),
        ('<Position><RelativeObjectPosition entityRef="B" dx="-12" dy="-3.5"/></Position>', 108, -5.25),
        ('<Position><RelativeRoadPosition entityRef="B" ds="7" dt="-1"/></Position>', 127, -2.75),
        ('<Position><RoadPosition roadId="1" s="333" t="-2"/></Position>', 333, -2),
    ],
)
def test_teleport(tmp_path_factory, place, x, y):
    """B is 100 m along at the start and drives 20 m/s."""
    found = play(tmp_path_factory.getbasetemp(), one(xosc.teleport(place), **other()))
    ego, at = found["Ego"], found.at
    assert ego["x"][at(1)] == pytest.approx(70, abs=CM)
    assert ego["x"][at(1.05)] == pytest.approx(x + 1, abs=CM)  # and on at 20 m/s
    assert ego["y"][at(1.05)] == pytest.approx(y, abs=CM)
    assert ego["x"][at(5)] == pytest.approx(x + 80, abs=CM)
    assert ego["y"][at(5)] == pytest.approx(y, abs=CM)


def follow(shape, reference="<None/>", offset="0"):
    return (
        f'<PrivateAction><RoutingAction><FollowTrajectoryAction initialDistanceOffset="{offset}">'
        "<TrajectoryRef>"
        f'<Trajectory name="t" closed="false"><Shape>{shape}</Shape></Trajectory></TrajectoryRef>'
        f'<TimeReference>{reference}</TimeReference><TrajectoryFollowingMode followingMode="position"/>'
        "</FollowTrajectoryAction></RoutingAction></PrivateAction>"
    )


def polyline(points):
    vertices = "".join(
        (f'<Vertex time="{t}">' if t is not None else "<Vertex>")
        + f'<Position><WorldPosition x="{x}" y="{y}"/></Position></Vertex>'
        for x, y, t in points
    )
    return f"<Polyline>{vertices}</Polyline>"


TIMING = '<Timing domainAbsoluteRelative="{}" scale="{}" offset="{}"/>'


@pytest.mark.parametrize(
    ("kind", "scale", "offset"), [("relative", 1, 0), ("relative", 2, 0.5), ("absolute", 1, 2)]
)
def test_trajectory(tmp_path_factory, kind, scale, offset):
    """By times: relative to the start of the action, or of the scenario."""
    points = [(60, 0, 0), (90, 3, 2), (90, 13, 4)]
    action = follow(polyline(points), TIMING.format(kind, scale, offset))
    found = play(tmp_path_factory.getbasetemp(), one(action))["Ego"]
    times = np.arange(len(found["x"])) * 0.05
    own = (times - (1 if kind == "relative" else 0) - offset) / scale
    inside = (times > 1.01) & (own < 3.99)
    np.testing.assert_allclose(found["x"][inside], np.interp(own, [0, 2, 4], [60, 90, 90])[inside], atol=CM)
    np.testing.assert_allclose(found["y"][inside], np.interp(own, [0, 2, 4], [0, 3, 13])[inside], atol=CM)
    steady = inside & (own > 2.1)
    np.testing.assert_allclose(found["v"][steady], 5 / scale, atol=CM)
    np.testing.assert_allclose(found["h"][steady], math.pi / 2, atol=1e-3)


def test_trajectory_by_its_own_speed(tmp_path_factory):
    action = follow(polyline([(70, -1.75, None), (100, -1.75, None), (100, 28.25, None)]), offset="10")
    found = play(tmp_path_factory.getbasetemp(), one(action), 4.0)
    ego, at = found["Ego"], found.at
    assert (ego["x"][at(1.5)], ego["y"][at(1.5)]) == pytest.approx((90, -1.75), abs=CM)
    assert (ego["x"][at(2.5)], ego["y"][at(2.5)]) == pytest.approx((100, 8.25), abs=CM)


def test_clothoids(tmp_path_factory):
    """An arc of 90 degrees with a radius of 20 m, from the place where the entity is."""
    arc = math.pi * 10
    segment = f'<ClothoidSplineSegment curvatureStart="0.05" curvatureEnd="0.05" length="{arc}"/>'
    found = play(
        tmp_path_factory.getbasetemp(), one(follow(f"<ClothoidSpline>{segment}</ClothoidSpline>")), 4.0
    )
    ego, at = found["Ego"], found.at
    turn = 20 * 0.5 / 20
    assert ego["x"][at(1.5)] == pytest.approx(70 + 20 * math.sin(turn), abs=CM)
    assert ego["y"][at(1.5)] == pytest.approx(-1.75 + 20 * (1 - math.cos(turn)), abs=CM)
    assert ego["h"][at(1.5)] == pytest.approx(turn, abs=1e-3)
    spiral = '<Clothoid curvature="0" curvaturePrime="0.002" length="25">{}</Clothoid>'
    place = '<Position><WorldPosition x="70" y="-1.75" h="0"/></Position>'
    found = play(tmp_path_factory.getbasetemp(), one(follow(spiral.format(place))), 4.0)
    fine = np.linspace(0, 20, 100001)
    heading = 0.001 * fine**2
    ego = found["Ego"]
    assert ego["x"][found.at(2)] == pytest.approx(70 + np.cos(heading).mean() * 20, abs=CM)
    assert ego["y"][found.at(2)] == pytest.approx(-1.75 + np.sin(heading).mean() * 20, abs=CM)


def test_nurbs(tmp_path_factory):
    """A quarter of a circle is a rational spline of order 3."""
    corners = [(70, 0, 1), (90, 0, math.sqrt(0.5)), (90, 20, 1)]
    points = "".join(
        f'<ControlPoint weight="{w}"><Position><WorldPosition x="{x}" y="{y}"/></Position></ControlPoint>'
        for x, y, w in corners
    )
    knots = "".join(f'<Knot value="{x}"/>' for x in (0, 0, 0, 1, 1, 1))
    found = play(
        tmp_path_factory.getbasetemp(), one(follow(f'<Nurbs order="3">{points}{knots}</Nurbs>')), 4.0
    )
    ego, inside = found["Ego"], slice(found.at(1.05), found.at(2.5))
    np.testing.assert_allclose(np.hypot(ego["x"][inside] - 70, ego["y"][inside] - 20), 20, atol=CM)
    turn = 0.5 * 20 / 20
    assert ego["x"][found.at(1.5)] == pytest.approx(70 + 20 * math.sin(turn), abs=CM)


def test_synchronize(tmp_path_factory):
    """At its place when the other is at its own, at the speed that is asked for."""
    place = '<{}><WorldPosition x="{}" y="{}"/></{}>'
    final = '<FinalSpeed><AbsoluteSpeed value="12">{}</AbsoluteSpeed></FinalSpeed>'

    def action(final):
        return (
            '<PrivateAction><SynchronizeAction masterEntityRef="B">'
            + place.format("TargetPositionMaster", 200, -1.75, "TargetPositionMaster")
            + place.format("TargetPosition", 170, -5.25, "TargetPosition")
            + final
            + "</SynchronizeAction></PrivateAction>"
        )

    def synchronized(final):
        return play(tmp_path_factory.getbasetemp(), one(action(final), lane=-2, v=15, **other()))

    found = synchronized(final.format(""))
    ego, b = found["Ego"], found["B"]
    there = np.interp(200, b["x"], found.time)
    assert there == pytest.approx(5, abs=1e-6)
    assert np.interp(there, found.time, ego["x"]) == pytest.approx(170, abs=0.05)
    assert np.interp(there, found.time, ego["v"]) == pytest.approx(12, abs=0.05)
    plain = synchronized("")
    assert np.interp(5, plain.time, plain["Ego"]["x"]) == pytest.approx(170, abs=0.05)
    relative_ = synchronized(
        '<FinalSpeed><RelativeSpeedToMaster value="-8" speedTargetValueType="delta"/></FinalSpeed>'
    )
    assert np.interp(5, relative_.time, relative_["Ego"]["v"]) == pytest.approx(12, abs=0.05)
    for steady, last in (
        ('<TargetDistanceSteadyState distance="24"/>', 24),
        ('<TargetTimeSteadyState time="1"/>', 12),
    ):
        found = synchronized(final.format(steady))
        ego = found["Ego"]
        assert np.interp(5, found.time, ego["x"]) == pytest.approx(170, abs=0.1)
        inside = (ego["x"] > 170 - last + 2) & (ego["x"] < 170)
        np.testing.assert_allclose(ego["v"][inside], 12, atol=0.1)


CROSSING = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"/>{roads}
<junction id="9" name="">
<connection id="0" incomingRoad="1" connectingRoad="3" contactPoint="start">
<laneLink from="-1" to="-1"/></connection>
<connection id="1" incomingRoad="1" connectingRoad="4" contactPoint="start">
<laneLink from="-1" to="-1"/></connection>
</junction></OpenDRIVE>"""


def crossing():
    """Road 1 east, then straight on to road 2 or to the right on road 5, by an arc of 20 m."""

    def piece(name, length, place, shape="<line/>", junction="-1", before="", after=""):
        link = (
            f'<predecessor elementType="road" elementId="{before}" contactPoint="end"/>' if before else ""
        ) + after
        lane_link = '<predecessor id="-1"/>' if before else ""
        lane_link += '<successor id="-1"/>' if "road" in after else ""
        return (
            f'<road name="" length="{length}" id="{name}" junction="{junction}"><link>{link}</link><planView>'
            f'<geometry s="0" {place} length="{length}">{shape}</geometry></planView><lanes>'
            '<laneSection s="0"><center><lane id="0" type="none"/></center>'
            '<right><lane id="-1" type="driving" level="false">'
            f"<link>{lane_link}</link>"
            '<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right></laneSection></lanes></road>'
        )

    into = '<successor elementType="junction" elementId="9"/>'

    def to(name):
        return f'<successor elementType="road" elementId="{name}" contactPoint="start"/>'

    arc = math.pi * 10
    roads = (
        piece("1", 100, 'x="0" y="0" hdg="0"', after=into)
        + piece("2", 300, 'x="120" y="0" hdg="0"', before="3")
        + piece("3", 20, 'x="100" y="0" hdg="0"', junction="9", before="1", after=to("2"))
        + piece("4", arc, 'x="100" y="0" hdg="0"', '<arc curvature="-0.05"/>', "9", "1", to("5"))
        + piece("5", 300, f'x="120" y="-20" hdg="{-math.pi / 2}"', before="4")
    )
    return CROSSING.format(roads=roads)


@pytest.mark.parametrize("acquire", [False, True])
def test_route(tmp_path, acquire):
    """Along a route to the right; straight on without one. In the bend the lane is 1.75 m inside."""
    path = tmp_path / "crossing.xodr"
    path.write_text(crossing())
    roads = Roads(load_map(path, cache=False))
    goal = xosc.lane(-1, 200, road=5)
    if acquire:
        inside = f"<AcquirePositionAction>{goal}</AcquirePositionAction>"
    else:
        stop = '<Waypoint routeStrategy="shortest">{}</Waypoint>'
        stops = stop.format(xosc.lane(-1, 20, road=1)) + stop.format(goal)
        inside = f'<AssignRouteAction><Route name="r" closed="false">{stops}</Route></AssignRouteAction>'
    action = f"<PrivateAction><RoutingAction>{inside}</RoutingAction></PrivateAction>"
    found = play(tmp_path, one(action, s=30, v=10), 14.0, roads=roads)
    ego, at = found["Ego"], found.at
    bend = (20 - 1.75) * math.pi / 2
    # 7 s to the junction, then the bend, then south on road 5, whose lane is west of its line
    after = 14 * 10 - 70 - bend
    assert ego["x"][at(7)] == pytest.approx(100, abs=CM)
    assert ego["x"][-1] == pytest.approx(118.25, abs=CM)
    assert ego["y"][-1] == pytest.approx(-20 - after, abs=0.05)
    plain = play(tmp_path, one(xosc.speed(10), s=30, v=10), 14.0, roads=roads)["Ego"]
    assert plain["x"][-1] == pytest.approx(170, abs=CM)
    assert plain["y"][-1] == pytest.approx(-1.75, abs=CM)


def test_entities_come_and_go(tmp_path_factory):
    inside = f"<AddEntityAction>{xosc.lane(-2, 200)}</AddEntityAction>"
    add = f'<GlobalAction><EntityAction entityRef="B">{inside}</EntityAction></GlobalAction>'
    delete = '<GlobalAction><EntityAction entityRef="B"><DeleteEntityAction/></EntityAction></GlobalAction>'
    hide = '<PrivateAction><VisibilityAction graphics="true" sensors="true" traffic="false"/></PrivateAction>'
    events = xosc.event("a", add, when(1)) + xosc.event("b", delete, when(3)) + xosc.event("c", hide, when(2))
    text = xosc.scenario(
        xosc.entity("Ego") + xosc.entity("B"), xosc.start("Ego", xosc.lane(-1, 50), 20), xosc.act(events)
    )
    found = play(tmp_path_factory.getbasetemp(), text)
    b, at = found["B"], found.at
    assert [bool(b["there"][at(t)]) for t in (0, 0.95, 1.05, 2.95, 3.05, 8)] == [0, 0, 1, 1, 0, 0]
    assert b["x"][at(2)] == pytest.approx(200, abs=CM)
    seen = np.asarray(found.memory.seen)[:, 0]
    assert seen[at(1.95)]
    assert not seen[at(2.05)]


def test_controller(tmp_path_factory):
    """The ego is handed over and taken back; others have no policy."""
    folder = tmp_path_factory.getbasetemp()
    activate = '<PrivateAction><ControllerAction><ActivateControllerAction longitudinal="{0}" lateral="{0}"/>'
    activate += "</ControllerAction></PrivateAction>"
    assign = (
        '<PrivateAction><ControllerAction><AssignControllerAction activateLongitudinal="{0}" '
        'activateLateral="{0}"><Controller name="c"><Properties/></Controller></AssignControllerAction>'
        "</ControllerAction></PrivateAction>"
    )
    events = (
        xosc.event("a", activate.format("true"), when(0.1))
        + xosc.event("b", activate.format("false"), when(0.3))
        + xosc.event("c", assign.format("true"), when(0.4))
    )
    text = xosc.scenario(
        xosc.entity("Ego") + xosc.entity("B"),
        xosc.start("Ego", xosc.lane(-1, 50), 20) + xosc.start("B", xosc.lane(-1, 90), 20),
        xosc.act(events, ("Ego", "B")),
    )
    built = build(openscenario(xosc.write(folder, text)).scenario(), straight(folder), 0.05, sizes=SIZES)
    board, memory = as_device((built.board, built.memory))
    k = np.arange(PIECE, dtype=np.float32)
    count = len(memory.v)
    pose = np.zeros((PIECE, count, 3), np.float32)
    pose[:, 0, 0] = 100 + 5 * k  # where a policy would have put it
    flat = np.zeros((PIECE, count), np.float32)
    bodies = Bodies(*as_device((pose, flat + 7, flat, flat == 0)))
    after = run(board, memory, 12, 0.05, bodies)
    held = after.held[:, :2].tolist()
    assert [x for x, _ in held] == [True] * 2 + [False] * 4 + [True] * 2 + [False] * 4
    assert all(x for _, x in held)
    assert after.pose[11, 0, 0] == pytest.approx(100 + 5 * 11, abs=CM)
    assert after.v[11, 0] == pytest.approx(7)
