"""Scenarios of OpenSCENARIO XML as text, for tests."""

from __future__ import annotations

from pathlib import Path

HEADER = '<FileHeader revMajor="1" revMinor="{minor}" date="2024-01-01T00:00:00" description="" author=""/>'

CAR = """<Vehicle name="car" vehicleCategory="car">
  <BoundingBox><Center x="1.4" y="0" z="0.7"/><Dimensions length="5" width="2" height="1.5"/></BoundingBox>
  <Performance maxSpeed="70" maxAcceleration="10" maxDeceleration="10"/>
  <Axles><FrontAxle positionX="2.8" maxSteering="0.5" wheelDiameter="0.6" trackWidth="1.6" positionZ="0.3"/>
  <RearAxle positionX="0" maxSteering="0" wheelDiameter="0.6" trackWidth="1.6" positionZ="0.3"/></Axles>
</Vehicle>"""


def entity(name: str, body: str = CAR) -> str:
    return f'<ScenarioObject name="{name}">{body}</ScenarioObject>'


def lane(lane: int | str = -1, s: float | str = 50, road: int | str = 1, offset: float | str = 0) -> str:
    return f'<Position><LanePosition roadId="{road}" laneId="{lane}" s="{s}" offset="{offset}"/></Position>'


def teleport(where: str) -> str:
    return f"<PrivateAction><TeleportAction>{where}</TeleportAction></PrivateAction>"


def speed(
    value: float | str,
    shape: str = "step",
    dimension: str = "time",
    over: float | str = 0,
    relative: str = "",
) -> str:
    target = relative or f'<AbsoluteTargetSpeed value="{value}"/>'
    return (
        f'<PrivateAction><LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape="{shape}" '
        f'dynamicsDimension="{dimension}" value="{over}"/><SpeedActionTarget>{target}</SpeedActionTarget>'
        "</SpeedAction></LongitudinalAction></PrivateAction>"
    )


def start(name: str, where: str, v: float | str = 20) -> str:
    """The start of an entity: a place and a speed."""
    return f'<Private entityRef="{name}">{teleport(where)}{speed(v)}</Private>'


def time_condition(value: float, rule: str = "greaterOrEqual", edge: str = "none", delay: float = 0) -> str:
    return condition(
        f'<ByValueCondition><SimulationTimeCondition value="{value}" rule="{rule}"/></ByValueCondition>',
        edge,
        delay,
    )


def condition(test: str, edge: str = "none", delay: float = 0, name: str = "c") -> str:
    return f'<Condition name="{name}" delay="{delay}" conditionEdge="{edge}">{test}</Condition>'


def by_entity(test: str, who: tuple[str, ...] = ("Ego",), rule: str = "any") -> str:
    names = "".join(f'<EntityRef entityRef="{x}"/>' for x in who)
    return (
        f'<ByEntityCondition><TriggeringEntities triggeringEntitiesRule="{rule}">{names}'
        f"</TriggeringEntities><EntityCondition>{test}</EntityCondition></ByEntityCondition>"
    )


def trigger(*groups: str, tag: str = "StartTrigger") -> str:
    return f"<{tag}>" + "".join(f"<ConditionGroup>{x}</ConditionGroup>" for x in groups) + f"</{tag}>"


def event(name: str, action: str, when: str | None = None, priority: str = "override", most: int = 1) -> str:
    when = trigger(time_condition(0)) if when is None else when
    return (
        f'<Event name="{name}" priority="{priority}" maximumExecutionCount="{most}">'
        f'<Action name="{name}Action">{action}</Action>{when}</Event>'
    )


def act(
    events: str, actors: tuple[str, ...] = ("Ego",), name: str = "act", when: str | None = None,
    most: int = 1, triggering: str = "false", stop: str = "",
) -> str:  # fmt: skip
    names = "".join(f'<EntityRef entityRef="{x}"/>' for x in actors)
    when = trigger(time_condition(0)) if when is None else when
    return (
        f'<Act name="{name}"><ManeuverGroup name="{name}Group" maximumExecutionCount="{most}">'
        f'<Actors selectTriggeringEntities="{triggering}">{names}</Actors>'
        f'<Maneuver name="{name}Maneuver">{events}</Maneuver></ManeuverGroup>{when}{stop}</Act>'
    )


def scenario(
    entities: str = "", init: str = "", story: str = "", stop: str = "", *, parameters: str = "",
    variables: str = "", catalogs: str = "", road: str = "road.xodr", minor: int = 3, extra: str = "",
) -> str:  # fmt: skip
    entities = entities or entity("Ego")
    variables = f"<VariableDeclarations>{variables}</VariableDeclarations>" if variables else ""
    story = f'<Story name="story">{story}</Story>' if story else ""
    return f"""<?xml version="1.0"?>
<OpenSCENARIO>{HEADER.format(minor=minor)}
<ParameterDeclarations>{parameters}</ParameterDeclarations>{variables}
<CatalogLocations>{catalogs}</CatalogLocations>
<RoadNetwork><LogicFile filepath="{road}"/></RoadNetwork>
<Entities>{entities}</Entities>
<Storyboard><Init><Actions>{init}</Actions></Init>{story}{stop}</Storyboard>{extra}
</OpenSCENARIO>"""


def distribution(template: str, body: str) -> str:
    return f"""<?xml version="1.0"?>
<OpenSCENARIO>{HEADER.format(minor=3)}
<ParameterValueDistribution><ScenarioFile filepath="{template}"/>{body}</ParameterValueDistribution>
</OpenSCENARIO>"""


def catalog(name: str, entries: str) -> str:
    return f"""<?xml version="1.0"?>
<OpenSCENARIO>{HEADER.format(minor=3)}<Catalog name="{name}">{entries}</Catalog></OpenSCENARIO>"""


def write(folder: Path, text: str, name: str = "scenario.xosc") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path
