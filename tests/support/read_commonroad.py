"""Prints a CommonRoad scenario as commonroad-io reads it, in JSON: run with that package in the path."""

import json
import sys

from commonroad.common.file_reader import (  # pyright: ignore[reportMissingImports]
    CommonRoadFileReader,
)

scenario, problems = CommonRoadFileReader(sys.argv[1]).open()
obstacles = {}
for one in scenario.dynamic_obstacles:
    states = [one.initial_state, *one.prediction.trajectory.state_list]
    obstacles[one.obstacle_id] = {
        "type": one.obstacle_type.value,
        "size": [one.obstacle_shape.length, one.obstacle_shape.width],
        "states": [
            [s.time_step, *s.position.tolist(), s.orientation, s.velocity, s.acceleration] for s in states
        ],
        # lanelets on which commonroad-io's own geometry finds the middle of the body
        "on": scenario.lanelet_network.find_lanelet_by_position([s.position for s in states]),
    }
lanelets = {}
for one in scenario.lanelet_network.lanelets:
    links = {
        "predecessors": one.predecessor, "successors": one.successor,
        "left": one.adj_left, "left_same": one.adj_left_same_direction,
        "right": one.adj_right, "right_same": one.adj_right_same_direction,
    }  # fmt: skip
    lanelets[one.lanelet_id] = links | {
        "centre": one.center_vertices.tolist(),
        "signs": sorted(one.traffic_signs),
        "types": [kind.value for kind in one.lanelet_type],
    }
signs = {}
for one in scenario.lanelet_network.traffic_signs:
    element = one.traffic_sign_elements[0]
    signs[one.traffic_sign_id] = [element.traffic_sign_element_id.name, *element.additional_values]
goals = {
    number: [p.initial_state.time_step, p.initial_state.position.tolist(), p.goal.lanelets_of_goal_position]
    for number, p in problems.planning_problem_dict.items()
}
print(
    json.dumps(
        {
            "dt": scenario.dt, "id": str(scenario.scenario_id), "obstacles": obstacles, "lanelets": lanelets,
            "signs": signs, "goals": goals,
        }
    )
)  # fmt: skip
