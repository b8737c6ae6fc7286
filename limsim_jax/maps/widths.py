"""Where a lane is wide enough to drive on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from limsim_jax.maps.network import Lane

MIN_WIDTH = 2.7
"""Least width of a lane for all vehicles, m: a bus is 2.55 m wide."""

TOO_NARROW = 1.85
"""Width (m) below which no car fits into a straight lane."""

CAR_LENGTH = 5.0
"""m: in a bend of curvature kappa the ends of a car of length l stand out by kappa l^2 / 8 on one side."""

NARROW_SHARE = 0.9
"""Share of its greatest width at which a lane counts as wide, where it nowhere has `MIN_WIDTH`."""


def wide_width(lane: Lane) -> float:
    """Width (m) at which a lane counts as wide: of a narrow lane most of its own."""
    return min(MIN_WIDTH, NARROW_SHARE * float(lane.width.max()))


def wide_until(lane: Lane) -> float:
    """Where a lane without successors becomes too narrow, m from its start.

    For all other lanes it is their length.
    """
    wide = np.nonzero(lane.width >= wide_width(lane))[0]
    if lane.successors or not len(wide) or wide[-1] == len(lane.width) - 1:
        return lane.length
    return float(lane.s[wide[-1]])


def wide_from(lane: Lane) -> float:
    """Where a lane without predecessors becomes wide enough, m from its start; 0 for all others."""
    wide = np.nonzero(lane.width >= wide_width(lane))[0]
    return 0.0 if lane.predecessors or not len(wide) else float(lane.s[wide[0]])


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
    return bool(lane.width[0] < min(TOO_NARROW, wide_width(lane)))


def ends_narrow(lane: Lane) -> bool:
    """Whether no car fits where the lane ends; lanes that are narrow as a whole are driven as they are."""
    return bool(lane.width[-1] < min(TOO_NARROW, wide_width(lane)))
