"""What of OpenSCENARIO XML is supported, element by element.

The reader refuses by this table, `docs/reference/openscenario.md` is written from it, and a test checks that
the tests that it names exist.
"""

from __future__ import annotations

import difflib
from typing import Literal, NamedTuple


class Support(NamedTuple):
    """How an element is treated.

    Attributes:
      state: "yes" as the standard says; "partly" with what `note` says; "passive" is read and changes
        nothing; "no" is refused.
      note: what is missing, or why.
      test: `file::name` of the test that proves it, within `tests/scenarios`.
    """

    state: Literal["yes", "partly", "passive", "no"]
    note: str
    test: str


_READER = "test_reader.py"
_ACTIONS = "test_actions.py"
_CONDITIONS = "test_conditions.py"
_DISTRIBUTIONS = "test_distributions.py"

_ROWS = f"""
# structure
OpenSCENARIO | yes | | {_READER}::test_a_scenario_reads_as_values
FileHeader | yes | versions 1.0 to 1.3 | {_READER}::test_other_versions
License | passive | | {_READER}::test_passive_elements
ParameterDeclarations | yes | | {_READER}::test_parameters
ParameterDeclaration | yes | | {_READER}::test_parameters
ConstraintGroup | yes | groups are alternatives | {_READER}::test_constraints
ValueConstraint | yes | | {_READER}::test_constraints
VariableDeclarations | yes | | {_CONDITIONS}::test_values
VariableDeclaration | yes | | {_CONDITIONS}::test_values
MonitorDeclarations | passive | | {_READER}::test_passive_elements
CatalogLocations | partly | folders within that of the scenario | {_READER}::test_catalogs
VehicleCatalog | yes | | {_READER}::test_catalogs
PedestrianCatalog | yes | | {_READER}::test_catalogs
MiscObjectCatalog | yes | | {_READER}::test_catalogs
ControllerCatalog | yes | | {_READER}::test_catalogs
EnvironmentCatalog | yes | | {_READER}::test_catalogs
ManeuverCatalog | yes | | {_READER}::test_catalogs
TrajectoryCatalog | yes | | {_READER}::test_catalogs
RouteCatalog | yes | | {_READER}::test_catalogs
Directory | yes | | {_READER}::test_catalogs
CatalogReference | yes | | {_READER}::test_catalogs
ParameterAssignments | yes | | {_READER}::test_catalogs
ParameterAssignment | yes | | {_READER}::test_catalogs
RoadNetwork | yes | | {_READER}::test_a_scenario_reads_as_values
LogicFile | yes | OpenDRIVE and SUMO maps | {_READER}::test_a_scenario_reads_as_values
SceneGraphFile | passive | | {_READER}::test_passive_elements
TrafficSignals | passive | the lights of the map run by their own programs | {_READER}::test_passive_elements
UsedArea | passive | | {_READER}::test_passive_elements
# entities
Entities | yes | | {_READER}::test_entities
ScenarioObject | yes | | {_READER}::test_entities
EntitySelection | yes | | {_READER}::test_entities
Members | yes | | {_READER}::test_entities
ByType | yes | | {_READER}::test_entities
EntityRef | yes | | {_READER}::test_entities
ExternalObjectReference | no | the body of an external object is not known | {_READER}::test_refused_by_name
Vehicle | yes | | {_READER}::test_entities
Pedestrian | yes | | {_READER}::test_entities
MiscObject | yes | | {_READER}::test_entities
BoundingBox | partly | boxes without heights | {_READER}::test_entities
Center | partly | x | {_READER}::test_entities
Dimensions | partly | length and width | {_READER}::test_entities
Performance | partly | read, but vehicles have the bounds of their class | {_READER}::test_entities
Axles | partly | the wheelbase | {_READER}::test_entities
FrontAxle | partly | its place | {_READER}::test_entities
RearAxle | partly | its place | {_READER}::test_entities
AdditionalAxle | passive | | {_READER}::test_passive_elements
Properties | passive | | {_READER}::test_passive_elements
TrailerHitch | passive | | {_READER}::test_passive_elements
TrailerCoupler | passive | | {_READER}::test_passive_elements
TrailerRef | no | vehicles have no trailers | {_READER}::test_refused_by_name
Trailer | no | vehicles have no trailers | {_READER}::test_refused_by_name
ObjectController | partly | that there is one | {_READER}::test_entities
Controller | partly | that there is one | {_READER}::test_entities
# positions
Position | yes | | {_READER}::test_positions
WorldPosition | partly | x, y, h | {_READER}::test_positions
RelativeWorldPosition | yes | | {_READER}::test_positions
RelativeObjectPosition | yes | | {_READER}::test_positions
RoadPosition | yes | | {_READER}::test_positions
RelativeRoadPosition | yes | | {_READER}::test_positions
LanePosition | yes | | {_READER}::test_positions
RelativeLanePosition | yes | dsLane is measured as ds | {_READER}::test_positions
RoutePosition | partly | by road and lane coordinates | {_READER}::test_positions
RouteRef | yes | | {_READER}::test_positions
InRoutePosition | partly | by road and lane coordinates | {_READER}::test_positions
FromRoadCoordinates | yes | | {_READER}::test_positions
FromLaneCoordinates | yes | | {_READER}::test_positions
FromCurrentEntity | no | give road or lane coordinates | {_READER}::test_refused_by_name
TrajectoryPosition | yes | | {_READER}::test_positions
GeoPosition | no | give a WorldPosition | {_READER}::test_refused_by_name
Orientation | partly | h | {_READER}::test_positions
Route | partly | the shortest way through its waypoints | {_ACTIONS}::test_route
Waypoint | partly | the shortest way | {_ACTIONS}::test_route
Trajectory | yes | | {_ACTIONS}::test_trajectory
TrajectoryRef | yes | | {_ACTIONS}::test_trajectory
Shape | yes | | {_ACTIONS}::test_trajectory
Polyline | yes | | {_ACTIONS}::test_trajectory
Vertex | yes | | {_ACTIONS}::test_trajectory
Clothoid | yes | | {_ACTIONS}::test_clothoids
ClothoidSpline | yes | | {_ACTIONS}::test_clothoids
ClothoidSplineSegment | yes | | {_ACTIONS}::test_clothoids
PositionStart | yes | | {_ACTIONS}::test_clothoids
Nurbs | yes | | {_ACTIONS}::test_nurbs
ControlPoint | yes | | {_ACTIONS}::test_nurbs
Knot | yes | | {_ACTIONS}::test_nurbs
# storyboard
Storyboard | yes | | {_CONDITIONS}::test_storyboard_order
Init | yes | | {_CONDITIONS}::test_storyboard_order
Actions | yes | | {_CONDITIONS}::test_storyboard_order
Private | yes | | {_CONDITIONS}::test_storyboard_order
Story | yes | | {_CONDITIONS}::test_storyboard_order
Act | yes | | {_CONDITIONS}::test_storyboard_order
ManeuverGroup | yes | | {_CONDITIONS}::test_repeats
Actors | yes | | {_CONDITIONS}::test_triggering_entities_act
Maneuver | yes | | {_CONDITIONS}::test_storyboard_order
Event | yes | | {_CONDITIONS}::test_priorities
Action | yes | | {_CONDITIONS}::test_storyboard_order
StartTrigger | yes | | {_CONDITIONS}::test_groups
StopTrigger | yes | | {_CONDITIONS}::test_stop
ConditionGroup | yes | | {_CONDITIONS}::test_groups
Condition | yes | | {_CONDITIONS}::test_edges_and_delays
# actions
GlobalAction | yes | | {_ACTIONS}::test_entities_come_and_go
PrivateAction | yes | | {_ACTIONS}::test_speed
UserDefinedAction | passive | what it asks for is not known | {_READER}::test_passive_elements
CustomCommandAction | passive | what it asks for is not known | {_READER}::test_passive_elements
LongitudinalAction | yes | | {_ACTIONS}::test_speed
SpeedAction | yes | | {_ACTIONS}::test_speed
SpeedActionDynamics | yes | followingMode is position | {_ACTIONS}::test_speed
SpeedActionTarget | yes | | {_ACTIONS}::test_speed
AbsoluteTargetSpeed | yes | | {_ACTIONS}::test_speed
RelativeTargetSpeed | yes | | {_ACTIONS}::test_relative_speed
SpeedProfileAction | partly | entries with times | {_ACTIONS}::test_speed_profile
SpeedProfileEntry | partly | with a time | {_ACTIONS}::test_speed_profile
LongitudinalDistanceAction | yes | | {_ACTIONS}::test_longitudinal_distance
DynamicConstraints | partly | of distances, without rates | {_ACTIONS}::test_longitudinal_distance
LateralAction | yes | | {_ACTIONS}::test_lane_change
LaneChangeAction | yes | | {_ACTIONS}::test_lane_change
LaneChangeActionDynamics | yes | | {_ACTIONS}::test_lane_change
LaneChangeTarget | yes | | {_ACTIONS}::test_lane_change
AbsoluteTargetLane | yes | | {_ACTIONS}::test_lane_change
RelativeTargetLane | yes | | {_ACTIONS}::test_lane_change
LaneOffsetAction | yes | | {_ACTIONS}::test_lane_offset
LaneOffsetActionDynamics | yes | | {_ACTIONS}::test_lane_offset
LaneOffsetTarget | yes | | {_ACTIONS}::test_lane_offset
AbsoluteTargetLaneOffset | yes | | {_ACTIONS}::test_lane_offset
RelativeTargetLaneOffset | yes | | {_ACTIONS}::test_lane_offset
LateralDistanceAction | partly | at most at the speed of its constraints | {_ACTIONS}::test_lateral_distance
VisibilityAction | partly | the traffic flag | {_ACTIONS}::test_entities_come_and_go
SensorReferenceSet | passive | no single sensor is switched off | {_READER}::test_passive_elements
SynchronizeAction | partly | without tolerances | {_ACTIONS}::test_synchronize
TargetPositionMaster | yes | | {_ACTIONS}::test_synchronize
TargetPosition | yes | | {_ACTIONS}::test_synchronize
FinalSpeed | yes | | {_ACTIONS}::test_synchronize
AbsoluteSpeed | yes | | {_ACTIONS}::test_synchronize
RelativeSpeedToMaster | yes | | {_ACTIONS}::test_synchronize
TargetDistanceSteadyState | yes | | {_ACTIONS}::test_synchronize
TargetTimeSteadyState | yes | | {_ACTIONS}::test_synchronize
ControllerAction | partly | hands the ego to our policy, or back | {_ACTIONS}::test_controller
ActivateControllerAction | partly | hands the ego to our policy, or back | {_ACTIONS}::test_controller
AssignControllerAction | partly | hands the ego to our policy if it activates | {_ACTIONS}::test_controller
OverrideControllerValueAction | passive | pedals belong to the policy | {_READER}::test_passive_elements
TeleportAction | yes | | {_ACTIONS}::test_teleport
RoutingAction | yes | | {_ACTIONS}::test_route
AssignRouteAction | partly | the shortest way | {_ACTIONS}::test_route
AcquirePositionAction | partly | the shortest way | {_ACTIONS}::test_route
FollowTrajectoryAction | partly | followingMode is position | {_ACTIONS}::test_trajectory
TimeReference | yes | | {_ACTIONS}::test_trajectory
Timing | yes | | {_ACTIONS}::test_trajectory
None | yes | | {_ACTIONS}::test_trajectory
TrajectoryFollowingMode | partly | position | {_ACTIONS}::test_trajectory
RandomRouteAction | no | name a route | {_READER}::test_refused_by_name
AppearanceAction | passive | lights and gestures change nothing | {_READER}::test_passive_elements
LightStateAction | passive | lights change nothing | {_READER}::test_passive_elements
AnimationAction | passive | gestures change nothing | {_READER}::test_passive_elements
TrailerAction | no | vehicles have no trailers | {_READER}::test_refused_by_name
EnvironmentAction | passive | weather and wet roads change nothing | {_READER}::test_passive_elements
Environment | passive | weather and wet roads change nothing | {_READER}::test_passive_elements
EntityAction | yes | | {_ACTIONS}::test_entities_come_and_go
AddEntityAction | yes | | {_ACTIONS}::test_entities_come_and_go
DeleteEntityAction | yes | | {_ACTIONS}::test_entities_come_and_go
ParameterAction | yes | | {_CONDITIONS}::test_values
VariableAction | yes | | {_CONDITIONS}::test_values
SetAction | yes | | {_CONDITIONS}::test_values
ModifyAction | yes | | {_CONDITIONS}::test_values
Rule | yes | | {_CONDITIONS}::test_values
AddValue | yes | | {_CONDITIONS}::test_values
MultiplyByValue | yes | | {_CONDITIONS}::test_values
SetMonitorAction | passive | | {_READER}::test_passive_elements
InfrastructureAction | no | lights run by the programs of the map | {_READER}::test_refused_by_name
TrafficSignalAction | no | lights run by the programs of the map | {_READER}::test_refused_by_name
TrafficAction | no | traffic around comes from an experiment | {_READER}::test_refused_by_name
TrafficSourceAction | no | traffic around comes from an experiment | {_READER}::test_refused_by_name
TrafficSinkAction | no | traffic around comes from an experiment | {_READER}::test_refused_by_name
TrafficSwarmAction | no | traffic around comes from an experiment | {_READER}::test_refused_by_name
TrafficAreaAction | no | traffic around comes from an experiment | {_READER}::test_refused_by_name
TrafficStopAction | no | traffic around comes from an experiment | {_READER}::test_refused_by_name
# conditions
ByEntityCondition | yes | | {_CONDITIONS}::test_speed
TriggeringEntities | yes | | {_CONDITIONS}::test_any_and_all
EntityCondition | yes | | {_CONDITIONS}::test_speed
EndOfRoadCondition | yes | | {_CONDITIONS}::test_end_of_road
CollisionCondition | yes | | {_CONDITIONS}::test_collision
OffroadCondition | yes | | {_CONDITIONS}::test_offroad
TimeHeadwayCondition | partly | without routing algorithms | {_CONDITIONS}::test_time_headway
TimeToCollisionCondition | partly | without routing algorithms | {_CONDITIONS}::test_time_to_collision
TimeToCollisionConditionTarget | yes | | {_CONDITIONS}::test_time_to_collision
AccelerationCondition | yes | | {_CONDITIONS}::test_acceleration
StandStillCondition | yes | | {_CONDITIONS}::test_stand_still
SpeedCondition | yes | | {_CONDITIONS}::test_speed
RelativeSpeedCondition | yes | | {_CONDITIONS}::test_relative_speed
TraveledDistanceCondition | yes | | {_CONDITIONS}::test_traveled_distance
ReachPositionCondition | yes | | {_CONDITIONS}::test_reach_position
DistanceCondition | partly | without routing algorithms | {_CONDITIONS}::test_distance
RelativeDistanceCondition | partly | without routing algorithms | {_CONDITIONS}::test_relative_distance
RelativeClearanceCondition | no | use distances | {_READER}::test_refused_by_name
AngleCondition | partly | of the heading | {_CONDITIONS}::test_angle
RelativeAngleCondition | partly | of the heading | {_CONDITIONS}::test_angle
ByValueCondition | yes | | {_CONDITIONS}::test_simulation_time
ParameterCondition | yes | | {_CONDITIONS}::test_values
VariableCondition | yes | | {_CONDITIONS}::test_values
SimulationTimeCondition | yes | | {_CONDITIONS}::test_simulation_time
StoryboardElementStateCondition | yes | | {_CONDITIONS}::test_element_states
UserDefinedValueCondition | passive | never true | {_READER}::test_passive_elements
TimeOfDayCondition | no | use the simulation time | {_READER}::test_refused_by_name
TrafficSignalCondition | no | lights run by the programs of the map | {_READER}::test_refused_by_name
TrafficSignalControllerCondition | no | lights run by their programs | {_READER}::test_refused_by_name
# distributions
ParameterValueDistribution | yes | | {_DISTRIBUTIONS}::test_product
ScenarioFile | yes | | {_DISTRIBUTIONS}::test_product
Deterministic | yes | | {_DISTRIBUTIONS}::test_product
DeterministicSingleParameterDistribution | yes | | {_DISTRIBUTIONS}::test_product
DeterministicMultiParameterDistribution | yes | | {_DISTRIBUTIONS}::test_value_sets
DistributionSet | yes | | {_DISTRIBUTIONS}::test_product
DistributionRange | yes | | {_DISTRIBUTIONS}::test_ranges
Range | yes | | {_DISTRIBUTIONS}::test_ranges
Element | yes | | {_DISTRIBUTIONS}::test_product
ValueSetDistribution | yes | | {_DISTRIBUTIONS}::test_value_sets
ParameterValueSet | yes | | {_DISTRIBUTIONS}::test_value_sets
Stochastic | yes | | {_DISTRIBUTIONS}::test_stochastic
StochasticDistribution | yes | | {_DISTRIBUTIONS}::test_stochastic
NormalDistribution | yes | | {_DISTRIBUTIONS}::test_stochastic
LogNormalDistribution | yes | moments of the variable itself | {_DISTRIBUTIONS}::test_stochastic
UniformDistribution | yes | | {_DISTRIBUTIONS}::test_stochastic
PoissonDistribution | yes | | {_DISTRIBUTIONS}::test_stochastic
Histogram | yes | | {_DISTRIBUTIONS}::test_stochastic
Bin | yes | | {_DISTRIBUTIONS}::test_stochastic
ProbabilityDistributionSet | yes | | {_DISTRIBUTIONS}::test_stochastic
UserDefinedDistribution | no | a distribution of the standard is expected | {_READER}::test_refused_by_name
"""


def _table() -> tuple[dict[str, Support], dict[str, list[str]]]:
    found: dict[str, Support] = {}
    chapters: dict[str, list[str]] = {}
    chapter = ""
    for line in _ROWS.strip().splitlines():
        if line.startswith("# "):
            chapter = line[2:]
            chapters[chapter] = []
            continue
        name, state, note, test = (part.strip() for part in line.split("|"))
        assert state in ("yes", "partly", "passive", "no") and name not in found, line
        found[name] = Support(state, note, test)  # pyright: ignore[reportArgumentType]
        chapters[chapter].append(name)
    return found, chapters


COVERAGE, CHAPTERS = _table()
"""Every element that is known, and the chapters of the page."""


def why_not(name: str) -> str:
    """Why an element is refused."""
    support = COVERAGE.get(name)
    if support is not None and support.state == "no":
        return f"not supported: {support.note}"
    if support is not None:
        return "is not expected here"
    close = difflib.get_close_matches(name, list(COVERAGE), 1, 0.8)
    return "unknown element" + (f"; did you mean <{close[0]}>?" if close else "")


_TITLES = {"yes": "yes", "partly": "partly", "passive": "read, changes nothing", "no": "no"}


def page() -> str:
    """The coverage page, in Markdown."""
    lines = [
        "# OpenSCENARIO: what is supported",
        "",
        "The page is written from `limsim_jax/scenarios/openscenario/coverage.py`, the table by which the",
        "reader refuses. An element that is not in it is unknown. `lenient=True` lists what is refused",
        "otherwise.",
        "",
    ]
    counts = {state: sum(x.state == state for x in COVERAGE.values()) for state in _TITLES}
    lines.append(
        f"{len(COVERAGE)} elements: {counts['yes']} as the standard says, {counts['partly']} partly, "
        f"{counts['passive']} read without effect, {counts['no']} refused."
    )
    for chapter, names in CHAPTERS.items():
        lines += [
            "",
            f"## {chapter.capitalize()}",
            "",
            "| element | supported | note | test |",
            "|---|---|---|---|",
        ]
        for name in names:
            support = COVERAGE[name]
            test = support.test.partition("::")[2]
            lines.append(f"| `{name}` | {_TITLES[support.state]} | {support.note} | `{test}` |")
    return "\n".join(lines) + "\n"
