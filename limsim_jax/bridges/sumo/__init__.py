"""SUMO co-simulation: our planners in SUMO's traffic, SUMO's signals and referee for ours."""
