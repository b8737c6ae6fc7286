"""Where a lane is wide enough to drive on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from limsim_jax.maps.network import Lane, Network

MIN_WIDTH = 2.7
"""Least width of a lane for all vehicles, m: a bus is 2.55 m wide."""

TOO_NARROW = 1.85
"""Width (m) below which no car fits into a straight lane."""

CAR_LENGTH = 5.0
"""m: in a bend of curvature kappa the ends of a car of length l stand out by kappa l^2 / 8 on one side."""

NARROW_SHARE = 0.9
"""Share of its greatest width at which a lane counts as wide, where it nowhere has `MIN_WIDTH`."""


def usable(network: Network) -> dict[str, tuple[float, float]]:
    """Where drivable lanes are wide enough: from and to, m along them.

    A lane counts from its start if traffic comes in there: from a lane before it that is wide at its end. In
    the same way it counts to its end if a lane after it is wide at its start. Of a lane that is narrow as a
    whole most of its own width is enough.
    """
    lanes = {lane.id: lane for lane in network.drivable_lanes()}
    wide = {name: np.nonzero(lane.width >= wide_width(lane))[0] for name, lane in lanes.items()}
    # a lane section within a taper: nowhere wide enough for a car, and it goes on as one that is
    never = {
        name
        for name, lane in lanes.items()
        if lane.width.max() < TOO_NARROW
        and any(
            other in lanes and lanes[other].road == lane.road and lanes[other].width.max() >= TOO_NARROW
            for other in (*lane.predecessors, *lane.successors)
        )
    }

    def opened(names: tuple[str, ...]) -> bool:
        return any(name in lanes and name not in never for name in names)

    found: dict[str, tuple[float, float]] = {}
    for name, lane in lanes.items():
        if name in never:
            found[name] = lane.length, 0.0
            continue
        first, last = (float(lane.s[wide[name][k]]) for k in (0, -1))
        found[name] = (
            0.0 if opened(lane.predecessors) else first,
            lane.length if opened(lane.successors) else last,
        )
    return found


def without_blind_changes(network: Network) -> Network:
    """The network without lane changes that no vehicle can make.

    A lane beside opens where the own lane has already ended.
    """
    wide = usable(network)

    def possible(lane: Lane, beside: str | None) -> bool:
        if lane.id not in wide or beside not in wide:
            return True
        other = network.lanes[beside]
        return wide[beside][0] / other.length <= wide[lane.id][1] / lane.length

    found = {
        lane.id: replace(
            lane,
            may_change_left=lane.may_change_left and possible(lane, lane.left),
            may_change_right=lane.may_change_right and possible(lane, lane.right),
        )
        for lane in network.lanes.values()
    }
    return replace(network, lanes=found)


def wide_width(lane: Lane) -> float:
    """Width (m) at which a lane counts as wide: of a narrow lane most of its own."""
    return min(MIN_WIDTH, NARROW_SHARE * float(lane.width.max()))


def fits_cars(lane: Lane) -> Bool[NDArray[np.bool_], " M"]:
    """Whether a car fits, at the samples of a lane.

    Bends count over the length of a car: a polyline bends nowhere but at its kinks.
    """
    ends = np.clip(lane.s[:, None] + [-CAR_LENGTH / 2, CAR_LENGTH / 2], 0.0, lane.length)
    turn = np.abs(np.diff(np.interp(ends, lane.s, lane.heading), axis=1)[:, 0])
    stands_out = turn * CAR_LENGTH / 8  # on each side
    return (lane.width >= MIN_WIDTH) | (lane.width - 2 * stands_out >= TOO_NARROW)


def begins_narrow(lane: Lane) -> bool:
    """Whether no car fits where the lane begins; lanes that are narrow as a whole are driven as they are."""
    return _narrow_at(lane, 0)


def ends_narrow(lane: Lane) -> bool:
    """Whether no car fits where the lane ends; lanes that are narrow as a whole are driven as they are."""
    return _narrow_at(lane, -1)


def _narrow_at(lane: Lane, sample: int) -> bool:
    return bool(lane.width[sample] < min(TOO_NARROW, wide_width(lane)))
