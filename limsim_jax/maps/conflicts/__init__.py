"""Where paths meet, and which of two vehicles goes first: geometry and right of way, once per map.

Two lanes conflict where vehicles centred on them come too close: the distance between the centre lines is
below the width of a vehicle and a margin. `overlaps` finds these stretches, `priority` orders them, `waiting`
says where a vehicle can wait inside a junction, `build` writes all of it into a `table`: arrays of fixed size
for the device. Everything but the table itself runs on the host in float64.
"""

from limsim_jax.maps.conflicts.build import build_conflicts
from limsim_jax.maps.conflicts.overlaps import Overlap, connectors, find_overlaps
from limsim_jax.maps.conflicts.priority import priority_cycles, ring_lanes
from limsim_jax.maps.conflicts.table import ConflictTable, ConflictType

__all__ = [
    "ConflictTable",
    "ConflictType",
    "Overlap",
    "build_conflicts",
    "connectors",
    "find_overlaps",
    "priority_cycles",
    "ring_lanes",
]
