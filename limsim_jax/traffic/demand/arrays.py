"""Demand and egos as the device gets them."""

from __future__ import annotations

from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt

from limsim_jax.traffic.vehicles import Population
from limsim_jax.types import Driver, Shape

LEAST_ROWS = 512
"""Rows of a schedule, at least: small demands share compiled programs."""

LEAST_ORIGINS = 8
"""Lanes on which vehicles come in, at least."""

LEAST = {
    "streams": 4,
    "origins": LEAST_ORIGINS,
    "rows": LEAST_ROWS,
    "arrivals": 8,  # of a stream
    "seats": 0,
    "vehicles": 0,  # at the start
}
"""Least sizes of tables of a demand."""

NEVER = 1e9
"""s, time of unused rows of a schedule."""

FLOW_BITS = 16  # of the number that keys a draw: the flow or the place in the queue; above: the lane


@struct.dataclass(frozen=True, kw_only=True)
class Demand:
    """Flows as streams, and seats for the traffic at the start.

    `K` streams, one per flow and departure lane; `O` origins, one per departure lane; `V` rows of the
    schedule; `S` seats; `G` goals; `Y` types of the population. All padded but `S`. Shares are cumulative
    and end in 1. Rates may be changed on the device (`idle`, `headway`); `overflow` tells if the rows
    still suffice.
    """

    population: Population
    # a stream: groups of `size` arrivals `headway` apart, and after each an exponential time
    stream: UInt[Array, " K"]  # number that keys its draws
    begin: Float[Array, " K"]  # s
    end: Float[Array, " K"]  # s
    headway: Float[Array, " K"]  # s
    size: Int[Array, " K"]
    idle: Float[Array, " K"]  # s, mean of the exponential time
    speed: Float[Array, " K"]  # m/s, wanted at entry
    goals: Float[Array, "K G"]  # cumulative shares
    types: Float[Array, "K Y"]  # cumulative shares
    capacity: Int[Array, " K"]  # rows
    # rows, before they are put in order of time within their origin
    row_origin: Int[Array, " V"]
    row_stream: Int[Array, " V"]
    row_arrival: Int[Array, " V"]  # which arrival of its stream
    start: Int[Array, " O1"]  # rows start[o] .. start[o + 1] - 1 belong to origin o
    lane: Int[Array, " O"]
    # seats
    seat_lane: Int[Array, " S"]
    seat_s: Float[Array, " S"]  # m, hindmost place of the front bumper
    seat_slack: Float[Array, " S"]  # m to the foremost
    seat_weight: Float[Array, " S"]  # logarithm of the share of vehicles that may use the lane
    seat_goals: Float[Array, "S G"]  # cumulative shares
    seat_types: Float[Array, "S Y"]  # cumulative shares
    initial: int = struct.field(pytree_node=False)  # vehicles at the start
    arrivals: int = struct.field(pytree_node=False)  # drawn per stream


@struct.dataclass(frozen=True, kw_only=True)
class EgoStart:
    """Start of the vehicles under test, `E` of them; they take the first slots.

    Without a lane they take the places, goals and speeds of other vehicles at the start, so that they start
    elsewhere in every world.
    """

    lane: Int[Array, " E"] | None = None
    s: Float[Array, " E"] | None = None  # m, front bumper
    goal: Int[Array, " E"] | None = None  # column of the route table
    v: Float[Array, " E"] | None = None  # m/s, at most what road and leader allow; None: just that
    driver: Driver  # [E]
    shape: Shape  # [E]
    free: Bool[Array, " E"]  # moves in the plane, not on lanes

    @property
    def count(self) -> int:
        """How many there are."""
        return self.free.shape[0]


def draw_number(row: int, part: int) -> int:
    """Number that keys draws: of a flow or a place (`part`) on a lane (`row`)."""
    return (row << FLOW_BITS) + part
