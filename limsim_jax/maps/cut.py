"""Roads cut into pieces, and lanes that are closed: work zones of an experiment.

A road is cut across all of its lanes, both ways, so that neighbours stay neighbours. The first piece of a
lane in its direction of travel keeps the lane's id; the others are `id/1`, `id/2`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.network import (
    Lane,
    LaneSpot,
    LaneType,
    Network,
)
from limsim_jax.maps.widths import CAR_LENGTH, fits_cars

SHORTEST = 5.0
"""m: a cut nearer to another cut or to the end of its lanes is moved there."""

Cuts = Mapping[tuple[str, int], Iterable[float]]
"""Road and section to coordinates along the road (m)."""


def cut(network: Network, cuts: Cuts) -> Network:
    """The network with roads that are cut.

    Args:
      network: of a map.
      cuts: places by road and section, m along the road.
    """
    sections: dict[tuple[str, int], list[Lane]] = {}
    for lane in network.lanes.values():
        sections.setdefault((lane.road, lane.section), []).append(lane)
    places = {key: found for key, at in cuts.items() if (found := _places(sections.get(key, []), at))}
    if not places:
        return network
    pieces = {
        lane.id: _pieces(lane, places.get((lane.road, lane.section), [])) for lane in network.lanes.values()
    }
    numbers = _sections(network, places)
    first, last = ({name: found[k].id for name, found in pieces.items()} for k in (0, -1))

    def links(lane: Lane, k: int, piece: Lane) -> Lane:
        mine = pieces[lane.id]
        after = tuple(first.get(x, x) for x in lane.successors)
        before = tuple(last.get(x, x) for x in lane.predecessors)
        beside = {
            side: None if other not in pieces else pieces[other][-1 - k if side == "opposite" else k].id
            for side in ("left", "right", "opposite")
            if (other := getattr(lane, side)) is not None
        }
        along = k if lane.road_s[-1] >= lane.road_s[0] else len(mine) - 1 - k
        return replace(
            piece,
            section=numbers[lane.road, lane.section] + along,
            successors=(mine[k + 1].id,) if k + 1 < len(mine) else after,
            predecessors=(mine[k - 1].id,) if k else before,
            **beside,
        )  # fmt: skip

    lanes = {
        piece.id: links(lane, k, piece)
        for lane in network.lanes.values()
        for k, piece in enumerate(pieces[lane.id])
    }

    def spots(found: tuple[LaneSpot, ...]) -> tuple[LaneSpot, ...]:
        return tuple(LaneSpot(lane=lane, s=s) for x in found for lane, s in [piece_at(lanes, x.lane, x.s)])

    return replace(
        network,
        lanes=lanes,
        movements=tuple(
            replace(m, incoming=last.get(m.incoming, m.incoming), outgoing=first.get(m.outgoing, m.outgoing))
            for m in network.movements
        ),
        traffic_lights=tuple(replace(x, spots=spots(x.spots)) for x in network.traffic_lights),
        signs=tuple(replace(x, spots=spots(x.spots)) for x in network.signs),
        stop_lines=tuple(replace(x, spot=spots((x.spot,))[0]) for x in network.stop_lines),
        crosswalks=tuple(
            replace(x, spans=tuple(_span(lanes, *span) for span in x.spans)) for x in network.crosswalks
        ),
    )


def close(network: Network, lanes: Iterable[str], kind: LaneType = LaneType.ROAD_WORKS) -> Network:
    """The network with lanes that are closed, and of this type."""
    closed = set(lanes)
    open_only = lambda names: tuple(x for x in names if x not in closed)  # noqa: E731
    found = {
        lane.id: replace(
            lane,
            type=kind if lane.id in closed else lane.type,
            successors=() if lane.id in closed else open_only(lane.successors),
            predecessors=() if lane.id in closed else open_only(lane.predecessors),
            may_change_left=lane.may_change_left and lane.id not in closed and lane.left not in closed,
            may_change_right=lane.may_change_right and lane.id not in closed and lane.right not in closed,
        )
        for lane in network.lanes.values()
    }
    return replace(network, lanes=found)


def without_gorges(network: Network) -> Network:
    """The network without stretches of lanes on which no car fits.

    Lanes stay as they are inside junctions, where no car fits on any part of them, and where they only begin
    or end so. Notes go to the report of the network.
    """
    sections: dict[tuple[str, int], list[Lane]] = {}
    for lane in network.drivable_lanes():
        sections.setdefault((lane.road, lane.section), []).append(lane)
    cuts: dict[tuple[str, int], list[float]] = {}
    shut: list[tuple[Lane, float, float]] = []
    for key, lanes in sections.items():
        narrow = [(lane, *stretch) for lane in lanes for stretch in _narrow(lane)]
        gorges = [(lane, a, b) for lane, a, b in narrow if a > 0 and b < lane.length]
        if gorges and all(lane.junction is None for lane in lanes):
            cuts[key] = [float(np.interp(s, x.s, x.road_s)) for x, a, b in narrow for s in (a, b)]
            shut += narrow
    if not shut:
        return network
    found = cut(network, cuts)
    for lane, begin, end in shut:
        message = f"no car fits from s = {begin:.1f} to {end:.1f} m: closed there"
        network.report.approximated("lane width", f"lane {lane.id}", message)
    pieces = {name for lane, _, _ in shut for name in pieces_of(found.lanes, lane.id)}
    narrow = (name for name in pieces if not fits_cars(lane := found.lanes[name])[len(lane.s) // 2])
    return close(found, narrow, LaneType.NONE)


def _narrow(lane: Lane) -> list[tuple[float, float]]:
    """Stretches (m) of a lane on which no car fits; those closer than a car are one."""
    fits = fits_cars(lane)
    if not fits.any():
        return []
    edges = np.nonzero(np.diff(np.concatenate([[True], fits, [True]]).astype(int)))[0]
    found: list[tuple[float, float]] = []
    for first, beyond in edges.reshape(-1, 2).tolist():
        begin = 0.0 if first == 0 else float(lane.s[first - 1])
        end = lane.length if beyond == len(fits) else float(lane.s[beyond])
        if found and begin - found[-1][1] < CAR_LENGTH:
            found[-1] = found[-1][0], end
        else:
            found.append((begin, end))
    return found


def pieces_of(lanes: Mapping[str, Lane], name: str) -> list[str]:
    """The pieces of a lane, in its direction of travel."""
    found = [name]
    while (after := f"{name}/{len(found)}") in lanes:
        found.append(after)
    return found


def piece_at(lanes: Mapping[str, Lane], name: str, s: float) -> tuple[str, float]:
    """The piece at `s` (m) of a lane, and m along it."""
    piece, number = name, 0
    while s > lanes[piece].length and (after := f"{name}/{number + 1}") in lanes:
        s, number, piece = s - lanes[piece].length, number + 1, after
    return piece, s


def _span(lanes: Mapping[str, Lane], name: str, enters: float, leaves: float) -> tuple[str, float, float]:
    """A stretch of a lane, on the piece of its middle."""
    piece, middle = piece_at(lanes, name, (enters + leaves) / 2)
    half = (leaves - enters) / 2
    return piece, max(middle - half, 0.0), min(middle + half, lanes[piece].length)


def _places(lanes: list[Lane], at: Iterable[float]) -> list[float]:
    """Where a section is cut, in order, m along the road."""
    if not lanes or any(lane.junction is not None for lane in lanes):
        return []
    low = max(min(lane.road_s[0], lane.road_s[-1]) for lane in lanes)
    high = min(max(lane.road_s[0], lane.road_s[-1]) for lane in lanes)
    found: list[float] = []
    for place in sorted(at):
        if place - (found[-1] if found else low) >= SHORTEST and high - place >= SHORTEST:
            found.append(float(place))
    return found


def _sections(network: Network, places: Mapping[tuple[str, int], list[float]]) -> dict[tuple[str, int], int]:
    """The new numbers of sections, those of their first pieces."""
    found: dict[tuple[str, int], int] = {}
    of_road: dict[str, set[int]] = {}
    for lane in network.lanes.values():
        of_road.setdefault(lane.road, set()).add(lane.section)
    for road, sections in of_road.items():
        more = 0
        for section in sorted(sections):
            found[road, section] = section + more
            more += len(places.get((road, section), []))
    return found


def _pieces(lane: Lane, places: list[float]) -> list[Lane]:
    """A lane in pieces, in its direction of travel."""
    if not places:
        return [lane]
    ends = np.concatenate([[0.0], np.sort(lane.s_at_road(places)), [lane.length]])
    return [_piece(lane, k, a, b) for k, (a, b) in enumerate(pairwise(ends))]


def _piece(lane: Lane, number: int, begin: float, end: float) -> Lane:
    """The stretch of a lane from `begin` to `end` (m)."""
    inside = lane.s[(lane.s > begin + 1e-6) & (lane.s < end - 1e-6)]
    s = np.concatenate([[begin], inside, [end]])
    xyz, heading = lane.pose(s)
    about = np.interp(s, lane.s, lane.heading)
    heading = about + (heading - about + np.pi) % (2 * np.pi) - np.pi  # unwrapped as the lane's

    def along(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(s, lane.s, values)

    share = (end - begin) / lane.length
    return replace(
        lane,
        id=lane.id if number == 0 else f"{lane.id}/{number}",
        s=s - begin,
        xyz=xyz,
        heading=heading,
        curvature=along(lane.curvature),
        width=along(lane.width),
        road_s=along(lane.road_s),
        declared_length=None if lane.declared_length is None else share * lane.declared_length,
    )
