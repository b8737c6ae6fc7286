"""Cells of the operational design domain: dimensions, their bins, and which cells can be reached.

A cell is a bin of each dimension. `Domain` numbers the cells, the last dimension fastest. Every edge of a bin
is a constant here, with its unit and its reason; a user may give other edges, or fewer dimensions.
"""

from __future__ import annotations

import difflib
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.maps.lane_map import LANE_TYPES, LaneMap, lane_rows
from limsim_jax.maps.network import LaneType, Network, Turn

STANDS = 0.5
"""m/s: an ego below this stands. The same bound as for waiting at a red light; creeping is slower."""

SPEED_EDGES = (STANDS, *(x / 3.6 for x in (30.0, 50.0, 70.0, 100.0, 130.0)))
"""m/s: standing, then the usual speed limits of Europe, 30 to 130 km/h (Vienna Convention states; StVO)."""

GAP_EDGES = (2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
"""m, bumper to bumper: 2 is the usual gap of a standing queue (IDM, Treiber et al. 2000), 50 the least gap of
heavy vehicles on motorways (StVO, section 4), in between and beyond about a factor of 2."""

TTC_EDGES = (1.5, 3.0, 5.0, 10.0)
"""s: below 1.5 a near miss begins (Hayward 1972; `safety.NEAR_MISS`), below 3 is time exposed (Minderhoud and
Bovy 2001; `safety.EXPOSED`), 5 is how far lanes are looked ahead for a TTC, 10 twice that."""

TOWN = 17.0
"""m/s, highest speed limit of a town road: 50 km/h, on main streets 60 (16.7 m/s)."""

RURAL = 28.0
"""m/s, highest speed limit of a rural road: 100 km/h (27.8 m/s). Limits above are those of motorways."""

SIDEWAYS = 0.2
"""m/s: a free ego over the line between two lanes changes lanes if it moves sideways at least this fast. A
change of 3.5 m in 4 to 8 s is on average 0.4 m/s or faster; a drift within a lane is slower. Chosen."""

MOST_CELLS = 250_000
"""Cells of a domain, at most: each takes 8 bytes in every world that runs."""

RAMPS = frozenset(
    {LaneType.ENTRY, LaneType.EXIT, LaneType.ON_RAMP, LaneType.OFF_RAMP, LaneType.CONNECTING_RAMP}
)
"""Lane types that are a ramp where the map tells; others are told by the speed limit."""

MANOEUVRES = (
    "stands", "keeps lane", "changes left", "changes right", "turns left", "turns right", "crosses straight",
)  # fmt: skip
"""What an ego does: the first that holds. Turns are those of lanes in a junction, a U-turn is to the left."""

STAND, KEEP, CHANGE_LEFT, CHANGE_RIGHT, TURN_LEFT, TURN_RIGHT, STRAIGHT = range(len(MANOEUVRES))

ROADS = ("town", "rural", "motorway", "ramp", "junction", "off lanes")
"""Kinds of road, by speed limit; lanes in a junction are "junction"."""

IN_TOWN, ON_RURAL, ON_MOTORWAY, ON_RAMP, IN_JUNCTION, OFF_LANES = range(len(ROADS))

_TURNS = {Turn.LEFT: TURN_LEFT, Turn.SLIGHT_LEFT: TURN_LEFT, Turn.U_TURN: TURN_LEFT, Turn.RIGHT: TURN_RIGHT,
          Turn.SLIGHT_RIGHT: TURN_RIGHT, Turn.STRAIGHT: STRAIGHT}  # fmt: skip


@dataclass(frozen=True)
class Dimension:
    """A quantity in bins.

    Attributes:
      name: "speed", "gap", "ttc", "manoeuvre" or "road".
      unit: of the edges; "": the bins are kinds.
      edges: rising. A bin includes its lower edge. The first begins below, the last has no upper edge.
      kinds: names of bins without edges, behind those with edges.
    """

    name: str
    unit: str = ""
    edges: tuple[float, ...] = ()
    kinds: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of bins."""
        return len(self.bins)

    @cached_property
    def bins(self) -> tuple[str, ...]:
        """Names of all bins."""
        if not self.edges:
            return self.kinds
        texts = [f"{x:.3g}" for x in self.edges]
        if len(set(texts)) < len(texts):
            texts = [f"{x!r}" for x in self.edges]
        middle = (f"{a} to {b}" for a, b in itertools.pairwise(texts))
        return (f"below {texts[0]}", *middle, f"{texts[-1]} and more", *self.kinds)

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def bounds(self, k: int) -> tuple[float, float]:
        """Lower and upper edge of bin `k`, in `unit`; 0 or infinite at the ends."""
        edges = (0.0, *self.edges, math.inf)
        return edges[k], edges[k + 1]

    def bin(self, value: str | float) -> int:
        """The bin of a number or of this name.

        Raises:
          ValueError: no such bin; one line.
        """
        if not isinstance(value, str) and self.edges:
            return int(np.sum(np.float32(value) >= np.asarray(self.edges, np.float32)))
        if value not in self.bins:
            raise ValueError(f"{self.name}: no bin '{value}'; there are {', '.join(self.bins)}")
        return self.bins.index(str(value))


DIMENSIONS = (
    Dimension("speed", "m/s", SPEED_EDGES),
    Dimension("gap", "m", GAP_EDGES, ("no leader",)),
    Dimension("ttc", "s", TTC_EDGES, ("not closing",)),
    Dimension("manoeuvre", kinds=MANOEUVRES),
    Dimension("road", kinds=ROADS),
)
"""All dimensions, in the order of cells."""

NAMES = tuple(x.name for x in DIMENSIONS)


@dataclass(frozen=True)
class Domain:
    """Cells of some dimensions.

    Attributes:
      dimensions: in the order of `DIMENSIONS`.
    """

    dimensions: tuple[Dimension, ...] = DIMENSIONS

    @property
    def names(self) -> tuple[str, ...]:
        """Of the dimensions."""
        return tuple(x.name for x in self.dimensions)

    @property
    def shape(self) -> tuple[int, ...]:
        """Bins of each dimension."""
        return tuple(x.size for x in self.dimensions)

    @property
    def size(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)

    def cell(self, number: int | np.integer) -> dict[str, str]:
        """Bins of a cell by dimension."""
        places = np.unravel_index(int(number), self.shape)
        return {x.name: x.bins[int(k)] for x, k in zip(self.dimensions, places, strict=True)}

    def matching(self, where: Mapping[str, str | float]) -> NDArray[np.bool_]:
        """Cells with these bins, `[cells]`; a dimension that is not named may have any.

        Raises:
          ValueError: an unknown dimension or bin; one line.
        """
        self.axes(where)
        there = np.ones(self.shape, bool)
        for axis, dimension in enumerate(self.dimensions):
            if dimension.name in where:
                wanted = np.arange(dimension.size) == dimension.bin(where[dimension.name])
                there &= np.expand_dims(wanted, tuple(k for k in range(len(self.shape)) if k != axis))
        return there.ravel()

    def axes(self, names: Iterable[str]) -> list[int]:
        """Places of dimensions, in the order of the domain.

        Raises:
          ValueError: an unknown dimension; one line.
        """
        names = list(names)
        for name in names:
            if name not in self.names:
                raise ValueError(_unknown(name, self.names))
        return [axis for axis, name in enumerate(self.names) if name in names]

    def over(self, names: Iterable[str]) -> tuple[Domain, NDArray[np.int64]]:
        """The domain of fewer dimensions, and its cell for each cell, `[cells]`."""
        axes = self.axes(names)
        less = Domain(tuple(self.dimensions[axis] for axis in axes))
        places = np.unravel_index(np.arange(self.size), self.shape)
        found = np.zeros(self.size, np.int64)
        for axis in axes:
            found = found * self.shape[axis] + places[axis]
        return less, found


def domain_of(
    dimensions: Sequence[str] | None = None, edges: Mapping[str, Sequence[float]] | None = None
) -> Domain:
    """The domain of some dimensions, with edges of one's own.

    Args:
      dimensions: names; None: all.
      edges: of bins, by dimension, in its unit.

    Raises:
      ValueError: an unknown dimension, or one without edges; edges that do not rise; too many cells; one
        line.
    """
    if isinstance(dimensions, str):
        raise ValueError(f"dimensions: '{dimensions}' is text; a list is expected, as ['{dimensions}']")
    names = NAMES if dimensions is None else tuple(dimensions)
    if not names:
        raise ValueError(f"dimensions: the list is empty; there are {', '.join(NAMES)}")
    for name in (*names, *(edges or ())):
        if name not in NAMES:
            raise ValueError(f"dimensions: {_unknown(name, NAMES)}")
    twice = next((name for name in names if list(names).count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"dimensions: '{twice}' stands twice")
    found = []
    for dimension in DIMENSIONS:
        given = (edges or {}).get(dimension.name)
        if given is not None:
            dimension = replace(dimension, edges=_checked(dimension, given))
        if dimension.name in names:
            found.append(dimension)
    domain = Domain(tuple(found))
    if domain.size > MOST_CELLS:
        raise ValueError(f"edges: {domain.size:,} cells; at most {MOST_CELLS:,}")
    return domain


def _checked(dimension: Dimension, edges: Sequence[float]) -> tuple[float, ...]:
    name = dimension.name
    if not dimension.edges:
        raise ValueError(f"edges: '{name}' has kinds, no edges")
    try:
        found = tuple(float(x) for x in edges)
    except (TypeError, ValueError):
        raise ValueError(f"edges: {name}: {edges!r}; numbers are expected") from None
    low = [x for x in found if not (math.isfinite(x) and x > 0)]
    if not found or low:
        raise ValueError(f"edges: {name}: {f'{low[0]:g}' if low else 'none'}; numbers above 0 are expected")
    if any(np.float32(a) >= np.float32(b) for a, b in itertools.pairwise(found)):
        raise ValueError(f"edges: {name}: {', '.join(f'{x:g}' for x in found)}; they have to rise")
    return found


def _unknown(name: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(str(name), known, 1)
    return f"no dimension '{name}'; " + (f"did you mean '{close[0]}'?" if close else f"not of {list(known)}")


# --- what a map has


class Places(NamedTuple):
    """What lanes are, `L` rows of a lane map; the last is the null lane."""

    road: NDArray[np.int32]  # [L], index into `ROADS`
    turn: NDArray[np.int32]  # [L], manoeuvre of an ego in a junction, index into `MANOEUVRES`


def places_of(network: Network, lane_map: LaneMap) -> Places:
    """Road kinds and turns of all lanes. Speed limits are those of the map, whatever zones say."""
    limit, valid = np.asarray(lane_map.speed_limit), np.asarray(lane_map.valid)
    ramp = np.isin(np.asarray(lane_map.lane_type), [k for k, x in enumerate(LANE_TYPES) if x in RAMPS])
    road = np.where(limit <= TOWN, IN_TOWN, np.where(limit <= RURAL, ON_RURAL, ON_MOTORWAY))
    road = np.where(ramp, ON_RAMP, road)
    road = np.where(np.asarray(lane_map.junction) >= 0, IN_JUNCTION, road)
    turn, rows = np.full(limit.shape, STRAIGHT, np.int32), lane_rows(network)
    for movement in network.movements:
        for lane in movement.via:
            if lane in rows:
                turn[rows[lane]] = _TURNS[movement.turn]
    return Places(np.where(valid, road, OFF_LANES).astype(np.int32), turn)


def possible(domain: Domain, places: Places, lane_map: LaneMap) -> NDArray[np.bool_]:
    """Cells that can be reached on a map, `[cells]`.

    Impossible by construction are:

    - a TTC without a leader;
    - a TTC shorter than the gap takes at the speed of the ego, as leaders do not reverse;
    - an ego that stands at a speed of more than `STANDS`, or does something else below;
    - turns outside of junctions, lane changes and plain lanes within;
    - roads, turns and lane changes that the map does not have;
    - an ego off all lanes: no part of the domain, though it is counted.
    """
    given = {x.name: x for x in domain.dimensions}
    speed, gap, ttc, manoeuvre, road = whole = [given.get(x.name, x) for x in DIMENSIONS]
    leads = np.ones((speed.size, gap.size, ttc.size), bool)
    for k, g, t in np.ndindex(leads.shape):
        none, closing = g == gap.size - 1, t < ttc.size - 1
        if closing:
            fast, near, late = speed.bounds(k)[1], gap.bounds(g)[0] if not none else 0, ttc.bounds(t)[1]
            leads[k, g, t] = not none and near < fast * late
    does = np.zeros((speed.size, manoeuvre.size, road.size), bool)
    ways = _ways(places, lane_map)
    for k in range(speed.size):
        low, high = speed.bounds(k)
        does[k] = ways
        does[k, STAND] &= low < STANDS
        does[k, STAND + 1 :] &= high > STANDS
    cells = leads[:, :, :, None, None] & does[:, None, None]
    dropped = tuple(axis for axis, x in enumerate(whole) if x.name not in given)
    return cells.any(dropped).ravel()


def _ways(places: Places, lane_map: LaneMap) -> NDArray[np.bool_]:
    """Manoeuvres on road kinds that a map has, `[manoeuvres, roads]`."""
    found = np.zeros((len(MANOEUVRES), len(ROADS)), bool)
    valid = np.asarray(lane_map.valid)
    beside = (np.asarray(lane_map.left) >= 0) | (np.asarray(lane_map.right) >= 0)
    for kind in range(OFF_LANES):
        here = valid & (places.road == kind)
        found[STAND, kind] = here.any()
        if kind == IN_JUNCTION:
            found[places.turn[here], kind] = True
        else:
            found[KEEP, kind] = here.any()
            # a change begins on one of two lanes side by side and ends on the other
            found[[CHANGE_LEFT, CHANGE_RIGHT], kind] = (here & beside).any()
    return found
