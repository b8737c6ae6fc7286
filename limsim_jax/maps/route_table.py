"""`RouteTable`: the way from every lane to every goal, as arrays."""

from __future__ import annotations

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array = np.ndarray | jax.Array

FAR = 1e9
"""Distance (m) to a goal out of reach, or to a lane change that is not needed."""


@flax.struct.dataclass(kw_only=True)
class RouteTable:
    """The way from every lane to every goal: `L - 1` lanes and, last, the null lane; `G` goals.

    The null lane reaches no goal. An example: two lanes of 100 m, A on the right and B on the left. Only B
    has a successor: C (50 m), the goal. Lane changes are allowed and cost 30 m:

    ====  ========  =========  ===========  ===============  =======
    lane  distance  next_lane  lanes_to_go  change_distance  is_goal
    ====  ========  =========  ===========  ===============  =======
    A     180       -1         1            100              False
    B     150       C          0            1e9              False
    C     50        -1         0            1e9              True
    ====  ========  =========  ===========  ===============  =======

    A vehicle at s = 80 m on A has one lane to cross to the left and 100 - 80 = 20 m left to do so.
    A lane of 100 m before A, beside one before B, would have the same `lanes_to_go` and `change_distance`
    200: the change can wait until the end of A.
    """

    distance: Float[Array, "L G"]
    """Cost to go, m: from the start of the lane to the end of the goal lane, with `CHANGE_PENALTY`
    for every lane change; lanes side by side count with their mean length. 1e9 if unreachable."""
    next_lane: Int[Array, "L G"]
    """Best successor for a vehicle that stays in this lane to its end; -1 on goal lanes, and where the
    goal cannot be reached without changing lanes before that (or on a lane below `NO_ROOM` only)."""
    lanes_to_go: Int[Array, "L G"]
    """Lanes to cross (+ to the left, - to the right) the next time that the best route must change
    lanes; 0 if it never has to. Changes wait as long as that costs nothing."""
    change_distance: Float[Array, "L G"]
    """From the start of this lane to the end of the last lane on which that change is possible, m;
    1e9 if `lanes_to_go` is 0. Subtract the vehicle's s."""
    reachable: Bool[Array, "L G"]
    is_goal: Bool[Array, "L G"]

    def pad(self, *, lanes: int, goals: int) -> RouteTable:
        """The same table with more rows and goals; new goals are unreachable.

        `lanes` counts the null rows, too. Raises `ValueError` if the table does not fit.
        """
        rows, columns = self.distance.shape
        if lanes < rows or goals < columns:
            raise ValueError(f"a table of {rows} x {columns} does not fit into {lanes} x {goals}")
        fills = {"distance": FAR, "next_lane": -1, "change_distance": FAR}
        return RouteTable(
            **{
                name: np.pad(
                    np.asarray(x),
                    ((0, lanes - rows), (0, goals - columns)),
                    constant_values=fills.get(name, 0),
                )
                for name, x in vars(self).items()
            }
        )
