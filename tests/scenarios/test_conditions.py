"""Conditions of OpenSCENARIO, at the exact step, and the order of the storyboard."""

import math
from typing import Any

import numpy as np
import pytest
import xosc
from osc_worlds import play

DT = 0.05

pytestmark = pytest.mark.engine
COUNT = '<VariableDeclaration name="n" variableType="double" value="0"/>'
ADD = (
    '<GlobalAction><VariableAction variableRef="n"><ModifyAction><Rule><AddValue value="1"/></Rule>'
    "</ModifyAction></VariableAction></GlobalAction>"
)


def counted(found):
    """Times at which the variable was raised."""
    values = np.asarray(found.memory.values)[:, 0]
    return [round(k * DT, 6) for k in np.flatnonzero(np.diff(values))]


def fires(folder, test, *, edge="none", delay=0.0, most=1, init="", entities="", story="", parameters=""):
    """Times at which an event with this condition starts."""
    when = xosc.trigger(xosc.condition(test, edge, delay))
    text = xosc.scenario(
        xosc.entity("Ego") + entities,
        init or xosc.start("Ego", xosc.lane(-1, 50), 20),
        story + xosc.act(xosc.event("probe", ADD, when, "parallel", most), name="probeAct"),
        variables=COUNT,
        parameters=parameters,
    )
    return counted(play(folder, text))


@pytest.fixture
def folder(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


def first(times):
    return times[0] if times else math.inf


def step_after(exact, *, strict=False):
    """The first step at or after a time; `strict`: after it."""
    k = math.ceil(exact / DT - 1e-6)
    return round((k + 1 if strict and abs(k * DT - exact) < 1e-6 else k) * DT, 6)


def by_value(inside):
    return f"<ByValueCondition>{inside}</ByValueCondition>"


def time_test(value, rule="greaterOrEqual"):
    return by_value(f'<SimulationTimeCondition value="{value}" rule="{rule}"/>')


@pytest.mark.parametrize(
    ("value", "rule", "at"),
    [
        (2, "greaterOrEqual", 2),
        (2, "greaterThan", 2.05),
        (2.02, "greaterOrEqual", 2.05),
        (3, "equalTo", 3),
        (3, "lessThan", 0),
        (0, "greaterOrEqual", 0),
        (0, "notEqualTo", 0.05),
    ],
)
def test_simulation_time(folder, value, rule, at):
    assert fires(folder, time_test(value, rule)) == [at]


def test_edges_and_delays(folder):
    """Rising and falling are false at the first look; a delay shows what was so long ago."""
    above, below = time_test(2), time_test(2, "lessThan")
    assert fires(folder, above, edge="rising") == [2]
    assert fires(folder, above, edge="rising", delay=1.5) == [3.5]
    assert fires(folder, above, delay=1.5) == [3.5]
    assert fires(folder, below, edge="rising") == []  # true from the first look on
    assert fires(folder, below, edge="falling") == [2]
    assert fires(folder, below, edge="falling", delay=0.3) == [2.3]
    assert fires(folder, below, edge="risingOrFalling") == [2]
    assert fires(folder, below, delay=1.0) == [1]


SPEED = '<SpeedCondition value="{}" rule="{}"/>'
FASTER = xosc.act(
    xosc.event("faster", xosc.speed(30, "linear", "rate", 2.0), xosc.trigger(xosc.time_condition(1))),
    name="fasterAct",
)


def test_speed(folder):
    """20 m/s, from 1 s on 2 m/s^2."""
    test = xosc.by_entity(SPEED.format(25, "greaterOrEqual"))
    assert fires(folder, test, story=FASTER) == [3.5]
    across = '<SpeedCondition value="1.0" rule="greaterThan" direction="lateral"/>'
    assert fires(folder, xosc.by_entity(across), story=FASTER) == []


def b_at(s, v, lane=-1):
    return xosc.start("B", xosc.lane(lane, s), v)


def with_b(s=150, v=10, lane=-1) -> dict[str, Any]:
    init = xosc.start("Ego", xosc.lane(-1, 50), 20) + b_at(s, v, lane)
    return {"init": init, "entities": xosc.entity("B")}


def test_relative_speed(folder):
    """Own speed minus the other's: 10 m/s, and 2 m/s more each second from 1 s on."""
    test = '<RelativeSpeedCondition entityRef="B" value="15" rule="greaterOrEqual"/>'
    assert fires(folder, xosc.by_entity(test), story=FASTER, **with_b()) == [3.5]


def test_acceleration(folder):
    """The acceleration of the last step."""
    test = '<AccelerationCondition value="1.9" rule="greaterThan"/>'
    assert fires(folder, xosc.by_entity(test), story=FASTER) == [1.05]


def test_stand_still(folder):
    """20 m/s, from 1 s on -10 m/s^2: it stands from 3 s on."""
    story = xosc.act(
        xosc.event("stop", xosc.speed(0, "linear", "rate", 10), xosc.trigger(xosc.time_condition(1)))
    )
    test = xosc.by_entity('<StandStillCondition duration="1.5"/>')
    found = fires(folder, test, story=story)
    assert first(found) == pytest.approx(4.5, abs=DT + 1e-6)
    assert first(found) >= 4.5
    stands = xosc.start("Ego", xosc.lane(-1, 50), 0)
    assert fires(folder, test, init=stands) == [1.5]


def test_traveled_distance(folder):
    assert fires(folder, xosc.by_entity('<TraveledDistanceCondition value="45"/>')) == [2.25]


def test_reach_position(folder):
    place = '<Position><WorldPosition x="130" y="-1.75"/></Position>'
    test = f'<ReachPositionCondition tolerance="1.5">{place}</ReachPositionCondition>'
    assert fires(folder, xosc.by_entity(test)) == [step_after((80 - 1.5) / 20)]
    relative = '<Position><RelativeLanePosition entityRef="B" dLane="0" ds="-20"/></Position>'
    test = f'<ReachPositionCondition tolerance="1.5">{relative}</ReachPositionCondition>'
    assert fires(folder, xosc.by_entity(test), **with_b()) == [step_after((80 - 1.5) / 10)]


def relative_distance(value, rule="lessThan", kind="longitudinal", free="false", system="entity"):
    return xosc.by_entity(
        f'<RelativeDistanceCondition entityRef="B" relativeDistanceType="{kind}" value="{value}" '
        f'freespace="{free}" rule="{rule}" coordinateSystem="{system}"/>'
    )


@pytest.mark.parametrize(
    ("test", "gap"),
    [
        (relative_distance(40), 60),
        (relative_distance(40, free="true"), 55),  # a length of 5 m less
        (relative_distance(40, system="road"), 60),
        (relative_distance(40, system="road", free="true"), 55),
        (relative_distance(40, system="lane"), 60),
        (relative_distance(40, kind="euclidianDistance"), 100 - math.sqrt(40**2 - 3.5**2)),
        (relative_distance(40, kind="cartesianDistance", free="true"), 95 - math.sqrt(40**2 - 1.5**2)),
        (relative_distance(40, kind="longitudinal", system="world"), 60),
    ],
)
def test_relative_distance(folder, test, gap):
    """100 m to B in the lane beside, 10 m/s less each second."""
    setup = with_b(lane=-2)
    assert fires(folder, test, **setup) == [step_after(gap / 10, strict=True)]


def test_lateral_distance(folder):
    for test, at in (
        (relative_distance(3.4, "greaterThan", "lateral"), [0]),
        (relative_distance(1.4, "greaterThan", "lateral", "true"), [0]),
        (relative_distance(1.6, "greaterThan", "lateral", "true", "road"), []),
        (relative_distance(3.6, "greaterThan", "lateral", system="road"), []),
    ):
        assert fires(folder, test, **with_b(lane=-2)) == at


def test_distance(folder):
    place = '<Position><WorldPosition x="250" y="-1.75"/></Position>'

    def test(value, more=""):
        return xosc.by_entity(
            f'<DistanceCondition value="{value}" freespace="false" rule="lessOrEqual" {more}>{place}'
            "</DistanceCondition>"
        )

    assert fires(folder, test(100)) == [5]
    assert fires(folder, test(100, 'alongRoute="true"')) == [5]
    free = test(100).replace('freespace="false"', 'freespace="true"')
    assert fires(folder, free) == [step_after((200 - 100 - 1.4 - 2.5) / 20)]  # from the front of the body
    far = xosc.by_entity(
        f'<DistanceCondition value="30" freespace="false" rule="greaterThan">{place}</DistanceCondition>'
    )
    assert fires(folder, far) == [0]


def headway(value, free="false"):
    return xosc.by_entity(
        f'<TimeHeadwayCondition entityRef="B" value="{value}" freespace="{free}" rule="lessThan" '
        'coordinateSystem="road" relativeDistanceType="longitudinal"/>'
    )


def test_time_headway(folder):
    """Distance over the own speed of 20 m/s."""
    assert fires(folder, headway(2), **with_b()) == [step_after(6, strict=True)]
    assert fires(folder, headway(2, "true"), **with_b()) == [step_after(5.5, strict=True)]
    stands = xosc.start("Ego", xosc.lane(-1, 50), 0) + b_at(60, 0)
    assert fires(folder, headway(100), init=stands, entities=xosc.entity("B")) == []


def test_time_to_collision(folder):
    """Distance over the closing speed of 10 m/s; never where the gap opens."""

    def test(value, target='<EntityRef entityRef="B"/>', free="false"):
        return xosc.by_entity(
            f'<TimeToCollisionCondition value="{value}" freespace="{free}" rule="lessThan" '
            'relativeDistanceType="longitudinal" coordinateSystem="entity"><TimeToCollisionConditionTarget>'
            f"{target}</TimeToCollisionConditionTarget></TimeToCollisionCondition>"
        )

    assert fires(folder, test(4), **with_b()) == [step_after(6, strict=True)]
    assert fires(folder, test(4, free="true"), **with_b()) == [step_after(5.5, strict=True)]
    assert fires(folder, test(1e6), **with_b(v=25)) == []
    place = '<Position><WorldPosition x="250" y="-1.75"/></Position>'
    assert fires(folder, test(5, place)) == [step_after(5, strict=True)]


def test_end_of_road(folder):
    """The road ends at 2,000 m."""
    init = xosc.start("Ego", xosc.lane(-1, 1960), 20)
    test = xosc.by_entity('<EndOfRoadCondition duration="{}"/>')
    assert fires(folder, test.format(0), init=init) == [2]
    assert fires(folder, test.format(1.5), init=init) == [3.5]


def test_offroad(folder):
    """It leaves the outer lane, 7 m from the middle, at 1.75 m/s from 1 s on."""
    leave = (
        '<PrivateAction><LateralAction><LaneOffsetAction continuous="false"><LaneOffsetActionDynamics '
        'dynamicsShape="step"/><LaneOffsetTarget><AbsoluteTargetLaneOffset value="-2"/></LaneOffsetTarget>'
        "</LaneOffsetAction></LateralAction></PrivateAction>"
    )
    story = xosc.act(xosc.event("leave", leave, xosc.trigger(xosc.time_condition(1))))
    init = xosc.start("Ego", xosc.lane(-2, 50), 20)
    test = xosc.by_entity('<OffroadCondition duration="{}"/>')
    assert fires(folder, test.format(0), init=init, story=story) == [1.05]
    assert fires(folder, test.format(2), init=init, story=story) == [pytest.approx(3.0, abs=DT + 1e-6)]


def test_collision(folder):
    """95 m between the bodies, 10 m/s."""
    by_name = xosc.by_entity('<CollisionCondition><EntityRef entityRef="B"/></CollisionCondition>')
    by_type = '<CollisionCondition><ByType type="{}"/></CollisionCondition>'
    assert fires(folder, by_name, **with_b()) == [9.5]
    assert fires(folder, xosc.by_entity(by_type.format("vehicle")), **with_b()) == [9.5]
    assert fires(folder, xosc.by_entity(by_type.format("pedestrian")), **with_b()) == []
    assert fires(folder, by_name, **with_b(lane=-2)) == []


def test_angle(folder):
    init = xosc.start("Ego", xosc.lane(-1, 50), 20) + b_at(900, 20, 1)
    setup: dict[str, Any] = {"init": init, "entities": xosc.entity("B")}
    relative = '<RelativeAngleCondition entityRef="B" angleType="heading" angle="{}" angleTolerance="0.1"/>'
    assert fires(folder, xosc.by_entity(relative.format(3.14)), **setup) == [0]
    assert fires(folder, xosc.by_entity(relative.format(0)), **setup) == []
    own = '<AngleCondition angleType="heading" angle="{}" angleTolerance="0.1" coordinateSystem="{}"/>'
    assert fires(folder, xosc.by_entity(own.format(0, "world"), ("B",)), **setup) == []
    assert fires(folder, xosc.by_entity(own.format(-3.14, "world"), ("B",)), **setup) == [0]
    assert fires(folder, xosc.by_entity(own.format(0, "lane"), ("B",)), **setup) == [0]


def test_any_and_all(folder):
    """B drives 10 m/s, and faster than 19 m/s from 4.6 s on."""
    story = xosc.act(
        xosc.event("f", xosc.speed(25, "linear", "rate", 2.5), xosc.trigger(xosc.time_condition(1))), ("B",)
    )
    test = SPEED.format(19, "greaterOrEqual")
    assert fires(folder, xosc.by_entity(test, ("Ego", "B")), story=story, **with_b(s=500)) == [0]
    every = xosc.by_entity(test, ("Ego", "B"), "all")
    assert fires(folder, every, story=story, **with_b(s=500)) == [4.6]


def test_values(folder):
    """Parameters and variables are set, added to, multiplied, and compared."""
    action = (
        '<GlobalAction><{0}Action {1}Ref="{2}"><ModifyAction><Rule><{3} value="3"/></Rule></ModifyAction>'
        "</{0}Action></GlobalAction>"
    )
    put = '<ParameterAction parameterRef="p"><SetAction value="{}"/></ParameterAction>'
    put = f"<GlobalAction>{put}</GlobalAction>"
    parameters = (
        '<ParameterDeclaration name="p" parameterType="double" value="2"/>'
        '<ParameterDeclaration name="word" parameterType="string" value="red"/>'
    )

    def at(seconds):
        return xosc.trigger(xosc.time_condition(seconds))

    multiply = action.format("Parameter", "parameter", "p", "MultiplyByValue")
    story = xosc.act(
        xosc.event("a", multiply, at(1), "parallel") + xosc.event("b", put.format(9), at(2), "parallel")
    )
    equal = by_value('<ParameterCondition parameterRef="{}" rule="equalTo" value="{}"/>')
    # a change is seen at the next step; the probe counts in variable n, the third value
    when = {6: 1.05, 9: 2.05, 2: 0}
    for value, time in when.items():
        test = equal.format("p", value)
        text = xosc.scenario(
            init=xosc.start("Ego", xosc.lane(-1, 50), 20),
            story=story
            + xosc.act(xosc.event("probe", ADD, xosc.trigger(xosc.condition(test)), "parallel"), name="pa"),
            variables=COUNT,
            parameters=parameters,
        )
        values = np.asarray(play(folder, text).memory.values)[:, 2]
        assert [round(k * DT, 6) for k in np.flatnonzero(np.diff(values))] == [time]
    for word, times in (("red", [0]), ("blue", [])):
        same = xosc.condition(equal.format("word", word))
        text = xosc.scenario(
            init=xosc.start("Ego", xosc.lane(-1, 50), 20),
            story=xosc.act(xosc.event("probe", ADD, xosc.trigger(same))),
            variables=COUNT,
            parameters=parameters,
        )
        values = np.asarray(play(folder, text).memory.values)[:, 2]
        assert [round(k * DT, 6) for k in np.flatnonzero(np.diff(values))] == times
    variable = by_value('<VariableCondition variableRef="n" rule="greaterOrEqual" value="0"/>')
    assert fires(folder, variable) == [0]


def state(kind, name, what):
    return by_value(
        f'<StoryboardElementStateCondition storyboardElementType="{kind}" storyboardElementRef="{name}" '
        f'state="{what}"/>'
    )


@pytest.mark.parametrize(
    ("kind", "name", "what", "at"),
    [
        ("action", "fasterAction", "runningState", 1.05),
        ("action", "fasterAction", "startTransition", 1.05),
        ("action", "fasterAction", "endTransition", 6),  # 10 m/s at 2 m/s^2
        ("action", "fasterAction", "completeState", 6),
        ("event", "faster", "completeState", 6),
        ("event", "faster", "standbyState", 0),
        ("maneuver", "fasterActManeuver", "completeState", 6),
        ("maneuverGroup", "fasterActGroup", "completeState", 6),
        ("act", "fasterAct", "completeState", 6),
        ("act", "fasterAct", "runningState", 0.05),
        ("story", "story", "runningState", 0.05),
        ("event", "fasterAct::fasterActGroup::fasterActManeuver::faster", "endTransition", 6),
    ],
)
def test_element_states(folder, kind, name, what, at):
    """What starts in a step is seen at the next one; what ends is seen at once."""
    assert fires(folder, state(kind, name, what), story=FASTER) == [at]


def test_groups(folder):
    """A trigger is true where all conditions of any group are."""
    one, two = xosc.time_condition(2), xosc.time_condition(3)
    late = xosc.time_condition(9)
    for groups, at in (((one + two,), 3), ((one, two), 2), ((one + late, two), 3)):
        text = xosc.scenario(
            init=xosc.start("Ego", xosc.lane(-1, 50), 20),
            story=xosc.act(xosc.event("probe", ADD, xosc.trigger(*groups))),
            variables=COUNT,
        )
        assert counted(play(folder, text)) == [at]


def played(folder, story, stop="", seconds=12.0, entities=""):
    text = xosc.scenario(
        xosc.entity("Ego") + entities,
        xosc.start("Ego", xosc.lane(-1, 50), 20),
        story,
        stop,
        variables=COUNT,
    )
    return play(folder, text, seconds)


def test_storyboard_order(folder):
    """An event waits for its act; one without a trigger starts with it; the stop of an act ends it."""
    later = xosc.act(
        xosc.event("probe", ADD, xosc.trigger(xosc.time_condition(1))),
        when=xosc.trigger(xosc.time_condition(4)),
    )
    assert counted(played(folder, later)) == [4]
    plain = xosc.act(xosc.event("probe", ADD, ""), when=xosc.trigger(xosc.time_condition(2)))
    assert counted(played(folder, plain)) == [2]
    stop = xosc.trigger(xosc.time_condition(3), tag="StopTrigger")
    stopped = xosc.act(
        xosc.event("probe", ADD, xosc.trigger(xosc.time_condition(5)))
        + xosc.event(
            "slow", xosc.speed(0, "linear", "rate", 1), xosc.trigger(xosc.time_condition(1)), "parallel"
        ),
        stop=stop,
    )
    found = played(folder, stopped)
    assert counted(found) == []
    v = found["Ego"]["v"]
    assert v[found.at(3)] == pytest.approx(18, abs=0.01)
    assert v[found.at(6)] == pytest.approx(18, abs=0.01)  # the action has stopped with its act


def test_repeats(folder):
    """An event is executed so many times, a group starts anew after its maneuvers."""
    even = time_test(0)
    thrice = xosc.event("probe", ADD, xosc.trigger(xosc.condition(even)), "parallel", 3)
    found = counted(played(folder, xosc.act(thrice)))
    assert found == [0, 0.05, 0.1]
    again = xosc.event("probe", ADD, xosc.trigger(xosc.condition(even)), "parallel", 2)
    assert len(counted(played(folder, xosc.act(again, most=3)))) == 6


def test_priorities(folder):
    """Override stops what runs, parallel does not, skip gives way."""
    slow = xosc.event(
        "slow", xosc.speed(0, "linear", "rate", 1), xosc.trigger(xosc.time_condition(1)), "parallel"
    )
    at = xosc.trigger(xosc.time_condition(3))
    speeds = {}
    for priority in ("override", "parallel", "skip", "overwrite"):
        found = played(folder, xosc.act(slow + xosc.event("probe", ADD, at, priority)))
        speeds[priority] = found["Ego"]["v"][found.at(6)], counted(found)
    assert speeds["override"] == (pytest.approx(18, abs=0.01), [3])
    assert speeds["overwrite"] == speeds["override"]
    assert speeds["parallel"] == (pytest.approx(15, abs=0.01), [3])
    assert speeds["skip"] == (pytest.approx(15, abs=0.01), [])


def test_triggering_entities_act(folder):
    """Actors are the entities that meet the condition: B, which is slow."""
    test = xosc.by_entity(SPEED.format(12, "lessThan"), ("Ego", "B"))
    brakes = xosc.event("e", xosc.speed(3), xosc.trigger(xosc.condition(test)))
    text = xosc.scenario(
        xosc.entity("Ego") + xosc.entity("B"),
        xosc.start("Ego", xosc.lane(-1, 50), 20) + b_at(100, 10),
        xosc.act(brakes, (), triggering="true"),
    )
    found = play(folder, text, 12.0)
    assert found["B"]["v"][-1] == pytest.approx(3)
    assert found["Ego"]["v"][-1] == pytest.approx(20)


def test_stop(folder):
    stop = xosc.trigger(xosc.time_condition(4), tag="StopTrigger")
    over = np.asarray(played(folder, FASTER, stop).memory.over)
    assert not over[round(4 / DT)]
    assert over[round(4 / DT) + 1]
    assert not np.asarray(played(folder, FASTER).memory.over).any()
