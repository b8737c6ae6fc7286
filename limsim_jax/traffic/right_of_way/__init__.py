"""Right of way where paths meet: lights, signs, priority, gap acceptance.

Every vehicle looks at the next connectors on its route: the one that it is on, and those it comes to. For
every conflict of a connector it looks at the vehicles on the other path that have not passed yet. Of two
vehicles exactly one goes first, and both see it alike, because both evaluate the same function of the
same state with the roles swapped:

1. A vehicle inside the conflict area goes before one outside; one that can no longer stop before one
   that can; one that pulls out from the line before one that can wait.
2. Otherwise a vehicle that stands where other paths cross goes first, then the one with priority: by the
   light, by the map, between equals the one in the junction, right before left, the longer waiting
   time, the earlier arrival. At a four-way stop the first that has come goes first.
   A vehicle without priority may pass first if it finds a gap of `gap_lead` seconds, longer before one
   from the side and shorter in a merge. A vehicle that stands and is delayed by others leaves a longer gap.
3. A vehicle that does not go first waits at the stop line, or lets the other clear the conflict area, or
   where paths merge follows the other as its leader.

Gap acceptance follows the windows of entry and exit times of Krajzewicz & Erdmann, SUMO's junction model
(2013), with the driver's `gap_factor`. Impatience shrinks gaps by up to 60 % within a minute of waiting.
The gaps give the capacities of the Highway Capacity Manual, 6th ed., ch. 20 to 22. The numbers are in
`parameters`.
"""

from limsim_jax.traffic.right_of_way.approaches import Approaches, approaches_ahead
from limsim_jax.traffic.right_of_way.passage import travel_time
from limsim_jax.traffic.right_of_way.rules import RightOfWay, give_way

__all__ = ["Approaches", "RightOfWay", "approaches_ahead", "give_way", "travel_time"]
