"""OpenSCENARIO XML 1.2: every vehicle follows a polyline with times."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

import numpy as np

from limsim_jax.bridges.formats.motion import Body, Motion

_CATEGORIES = {
    "car": "car", "van": "van", "truck": "truck", "bus": "bus", "motorcycle": "motorbike", "emergency": "car",
}  # fmt: skip
_HEIGHTS = {"car": 1.5, "van": 2.6, "truck": 3.8, "bus": 3.4, "motorcycle": 1.5, "emergency": 2.6}
"""m, of SUMO's vehicle classes: passenger, delivery, truck, bus, motorcycle, emergency."""
_WHEEL = 0.6  # m, diameter: for pictures only
_STEERING = 0.7  # rad, most of the front wheels: for pictures only


def openscenario(motion: Motion) -> str:
    """A scenario in which every vehicle is told its whole motion.

    Positions are those of the middle of the rear axle, as the standard says; the bounding box tells where
    the body lies about it. Vehicles that come in later are added by events, and those that leave deleted.
    The file of the map is named as the experiment names it. Time starts with the episode.

    Args:
      motion: of the world.
    """
    bodies = [body for body in motion.bodies if len(body.x) > 1]
    start = [body for body in bodies if body.first == 0]
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0, tzinfo=None).isoformat()
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>\n<OpenSCENARIO>\n',
        f'<FileHeader revMajor="1" revMinor="2" date="{now}" author="limsim_jax" '
        f"description={quoteattr(motion.title)}/>\n<CatalogLocations/>\n<RoadNetwork>"
        f"<LogicFile filepath={quoteattr(motion.network.source)}/></RoadNetwork>\n<Entities>\n",
        *map(_entity, bodies),
        "</Entities>\n<Storyboard>\n<Init><Actions>\n",
        *map(_init, start),
        "</Actions></Init>\n",
        '<Story name="recorded"><Act name="recorded">\n',
        *(part for body in bodies for part in _group(motion, body)),
        f"{_at('StartTrigger', 'act', 0.0)}</Act></Story>\n",
        _at("StopTrigger", "end", float(motion.time[-1])),
        "</Storyboard>\n</OpenSCENARIO>\n",
    ]
    return "".join(parts)


def _entity(body: Body) -> str:
    name, height, track = quoteattr(body.name), _HEIGHTS[body.vehicle_class], 0.9 * body.width
    axles = "".join(
        f'<{axle} maxSteering="{steering}" wheelDiameter="{_WHEEL}" trackWidth="{track:.4f}" '
        f'positionX="{x:.4f}" positionZ="{_WHEEL / 2}"/>'
        for axle, steering, x in (("FrontAxle", _STEERING, body.wheelbase), ("RearAxle", 0.0, 0.0))
    )
    fastest = math.ceil(max(float(body.speed.max()), 1.0))
    hardest = math.ceil(max(float(np.abs(body.acceleration).max()), 1.0))
    return (
        f"<ScenarioObject name={name}><Vehicle name={name} "
        f'vehicleCategory="{_CATEGORIES[body.vehicle_class]}">'
        f'<BoundingBox><Center x="{body.wheelbase / 2:.4f}" y="0" z="{height / 2:.4f}"/>'
        f'<Dimensions width="{body.width:.4f}" length="{body.length:.4f}" height="{height:.4f}"/>'
        f'</BoundingBox><Performance maxSpeed="{fastest}" maxAcceleration="{hardest}" '
        f'maxDeceleration="{hardest}"/><Axles>{axles}</Axles><Properties>'
        f'<Property name="ego" value="{str(body.ego).lower()}"/></Properties></Vehicle></ScenarioObject>\n'
    )


def _init(body: Body) -> str:
    return (
        f"<Private entityRef={quoteattr(body.name)}><PrivateAction><TeleportAction>"
        f"{next(iter(_positions(body)))}</TeleportAction></PrivateAction></Private>\n"
    )


def _group(motion: Motion, body: Body) -> Iterable[str]:
    """What a vehicle is told: to come in, to follow its way, to leave."""
    name, entity = body.name, quoteattr(body.name)
    begin = float(motion.time[body.first]) if body.first else 0.0
    end = float(motion.time[body.last])
    yield (
        f'<ManeuverGroup name={entity} maximumExecutionCount="1"><Actors selectTriggeringEntities="false">'
        f"<EntityRef entityRef={entity}/></Actors><Maneuver name={entity}>\n"
        f'<Event name={quoteattr(f"{name} drives")} priority="parallel">'
    )
    if body.first > 0:
        yield (
            f"<Action name={quoteattr(f'{name} comes in')}><GlobalAction><EntityAction entityRef={entity}>"
            f"<AddEntityAction>{next(iter(_positions(body)))}</AddEntityAction></EntityAction></GlobalAction>"
            "</Action>\n"
        )
    yield (
        f"<Action name={quoteattr(f'{name} follows')}><PrivateAction><RoutingAction><FollowTrajectoryAction>"
        f'<TimeReference><Timing domainAbsoluteRelative="absolute" scale="1" offset="0"/></TimeReference>'
        f'<TrajectoryFollowingMode followingMode="position"/><TrajectoryRef><Trajectory name={entity} '
        'closed="false"><Shape><Polyline>\n'
    )
    times = motion.time[body.first : body.last + 1].tolist()
    for time, position in zip(times, _positions(body), strict=True):
        yield f'<Vertex time="{time:.3f}">{position}</Vertex>\n'
    yield (
        "</Polyline></Shape></Trajectory></TrajectoryRef></FollowTrajectoryAction></RoutingAction>"
        f"</PrivateAction></Action>{_at('StartTrigger', f'{name} drives', begin)}</Event>\n"
    )
    if body.last < len(motion.time) - 1:
        yield (
            f'<Event name={quoteattr(f"{name} leaves")} priority="parallel"><Action '
            f"name={quoteattr(f'{name} leaves')}><GlobalAction><EntityAction entityRef={entity}>"
            "<DeleteEntityAction/></EntityAction></GlobalAction></Action>"
            f"{_at('StartTrigger', f'{name} leaves', end)}</Event>\n"
        )
    yield "</Maneuver></ManeuverGroup>\n"


def _positions(body: Body) -> Iterable[str]:
    back = body.wheelbase / 2
    heading = (body.heading + math.pi) % (2 * math.pi) - math.pi
    x, y = body.x - back * np.cos(heading), body.y - back * np.sin(heading)
    for px, py, h in np.stack([x, y, heading], -1).tolist():
        yield f'<Position><WorldPosition x="{px:.4f}" y="{py:.4f}" h="{h:.6f}"/></Position>'


def _at(trigger: str, name: str, time: float) -> str:
    """A trigger at a time of the simulation, s."""
    return (
        f'<{trigger}><ConditionGroup><Condition name={quoteattr(name)} delay="0" conditionEdge="none">'
        f'<ByValueCondition><SimulationTimeCondition value="{time:.3f}" rule="greaterOrEqual"/>'
        f"</ByValueCondition></Condition></ConditionGroup></{trigger}>\n"
    )


__all__ = ["openscenario"]
