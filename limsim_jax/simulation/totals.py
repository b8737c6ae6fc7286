"""What happened in a world: counts and sums that are kept up while it runs."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.types import Config, State, Status

GRIDLOCK = 120.0
"""s after which a vehicle that did not get on is stuck and its world gridlocked; longer than a red."""
GOT_ON = 5.0
"""m that a vehicle has to get on in that time, less than a place in a queue."""


@struct.dataclass(frozen=True, kw_only=True)
class Totals:
    """What happened in a world, kept up while it runs. Vehicles count once per kind of event."""

    entered: Int[Array, ""]  # those of the start included
    left: Int[Array, ""]  # at their goals
    waiting: Int[Array, ""]  # outside, for room to enter
    full: Int[Array, ""]  # decisions at which a vehicle could not enter for want of a slot
    collided: Int[Array, ""]
    off_road: Int[Array, ""]
    wrong_way: Int[Array, ""]
    ran_red: Int[Array, ""]
    missed: Int[Array, ""]  # took another goal for want of a gap to change lanes
    hard: Int[Array, ""]  # braked harder than `b_max`
    broken: Int[Array, ""]  # numbers that are not finite
    gridlock: Bool[Array, ""]
    deceleration: Float[Array, ""]  # m/s^2, the hardest
    longest_wait: Float[Array, ""]  # s
    distance: Float[Array, ""]  # m, of all vehicles
    time: Float[Array, ""]  # s, of all vehicles on the road
    travel_time: Float[Array, ""]  # s, sum over vehicles that left


class Stood(NamedTuple):
    """Where and when each vehicle had last got on, for `N` slots."""

    at: Float[Array, " N"]  # m, of `State.distance`
    since: Float[Array, " N"]  # s


def no_totals(state: State) -> Totals:
    """Totals at the start."""
    zero, nothing = jnp.int32(0), jnp.float32(0)
    return Totals(
        entered=jnp.sum(state.active, dtype=jnp.int32),
        left=zero, waiting=zero, full=zero, collided=zero, off_road=zero, wrong_way=zero, ran_red=zero,
        missed=zero, hard=zero, broken=zero, gridlock=jnp.bool_(False), deceleration=nothing,
        longest_wait=nothing, distance=nothing, time=nothing, travel_time=nothing,
    )  # fmt: skip


@jax.named_scope("count")
def count(config: Config, totals: Totals, stood: Stood, before: State, after: State) -> tuple[Totals, Stood]:
    """Totals and progress after one more decision, all but `waiting`."""
    now = config.time(after.step)
    same = (before.vehicle == after.vehicle) & (before.entered == after.entered) & before.active
    entered = jnp.sum(after.queues.next - before.queues.next, dtype=jnp.int32)
    fresh = ~same & ((after.entered > before.entered) | (after.vehicle != before.vehicle))
    was = before.active | fresh  # on the road at some time of this decision
    left = was & ~after.active
    new = jnp.where(was, after.status & ~jnp.where(same, before.status, 0), 0)
    driven = after.distance - jnp.where(fresh, 0, before.distance)

    scripted = (after.status & int(Status.SCRIPTED)) != 0  # may stand for good, as an obstacle
    got_on = ~(same & after.active) | (after.distance - stood.at >= GOT_ON) | scripted
    stood = Stood(jnp.where(got_on, after.distance, stood.at), jnp.where(got_on, now, stood.since))

    def events(bit: Status) -> Int[Array, ""]:
        return jnp.sum((new & int(bit)) != 0, dtype=jnp.int32)

    totals = Totals(
        entered=totals.entered + entered,
        left=totals.left + jnp.sum(left, dtype=jnp.int32),
        waiting=totals.waiting,
        full=after.queues.full,
        collided=totals.collided + events(Status.COLLIDED),
        off_road=totals.off_road + events(Status.OFF_ROAD),
        wrong_way=totals.wrong_way + events(Status.WRONG_WAY),
        ran_red=totals.ran_red + events(Status.RED_LIGHT),
        missed=totals.missed + events(Status.MISSED_ROUTE),
        hard=totals.hard + events(Status.HARD_BRAKE),
        broken=totals.broken + events(Status.NOT_FINITE),
        gridlock=totals.gridlock | (now - stood.since > GRIDLOCK).any(),
        deceleration=jnp.maximum(totals.deceleration, jnp.max(jnp.where(after.active, -after.a, 0))),
        longest_wait=jnp.maximum(totals.longest_wait, jnp.max(jnp.where(after.active, after.waiting, 0))),
        distance=totals.distance + jnp.sum(jnp.where(was, driven, 0)),
        time=totals.time + config.decision_time * jnp.sum(after.active, dtype=jnp.float32),
        travel_time=totals.travel_time + jnp.sum(jnp.where(left, now - after.entered, 0)),
    )
    return totals, stood
