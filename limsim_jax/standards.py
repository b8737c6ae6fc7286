"""Published bounds that planners and metrics share."""

from __future__ import annotations

COMFORT = {
    "acceleration": (-4.05, 2.40),  # m/s^2
    "lateral_acceleration": (-4.89, 4.89),
    "jerk": (-8.37, 8.37),  # m/s^3
    "longitudinal_jerk": (-4.13, 4.13),
    "yaw_acceleration": (-1.93, 1.93),  # rad/s^2
    "yaw_rate": (-0.95, 0.95),  # rad/s
}
"""Bounds of comfort of nuPlan (`ego_*.yaml` of nuplan-devkit), lowest and highest value of each quantity."""
