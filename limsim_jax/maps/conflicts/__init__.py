"""Where the paths of vehicles meet, and the right of way there.

Two lanes conflict where vehicles centred on them come too close: the centre lines are nearer to each other
than the width of a vehicle and a margin. The package works once per map, on the host in float64:

- `overlaps` finds the stretches where that holds;
- `priority` decides which of the two lanes has the right of way;
- `waiting` finds where a vehicle can wait inside a junction, and how far before another;
- `build` writes all of it into a `table` of fixed size for the device.
"""

from limsim_jax.maps.conflicts.build import build_conflicts
from limsim_jax.maps.conflicts.overlaps import Overlap, connectors, find_overlaps
from limsim_jax.maps.conflicts.priority import priority_cycles, roundabout_lanes
from limsim_jax.maps.conflicts.table import ConflictTable, ConflictType
from limsim_jax.maps.conflicts.waiting import stand_back

__all__ = [
    "ConflictTable",
    "ConflictType",
    "Overlap",
    "build_conflicts",
    "connectors",
    "find_overlaps",
    "priority_cycles",
    "roundabout_lanes",
    "stand_back",
]
