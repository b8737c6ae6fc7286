"""Traffic: how vehicles follow, change lanes, give way, enter and leave. Pure functions for one world."""
