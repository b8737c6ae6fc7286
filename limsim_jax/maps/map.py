"""`Map`: a road network, its device arrays, and the names of its origins and goals, as one host object."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from limsim_jax.maps import build_lane_map, bundled_map, bundled_maps, read_network
from limsim_jax.maps.network import ImportReport, Network

if TYPE_CHECKING:
    from limsim_jax.maps.lane_map import LaneMap
    from limsim_jax.maps.scenery import Scenery


@dataclass(frozen=True, eq=False)
class Map:
    """A road map on the host and on the device.

    Attributes:
      network: what the file says, float64.
      extra_goals: ids of lanes that are goals beside the ways out of the map.
      routes: lists of roads, each a goal as well: the end of its last road, by this way.
      no_exits: ids of lanes that are no ways out, though they end: at a road block.
      no_entries: ids of lanes that are no ways in, though they begin: behind a road block.
    """

    network: Network
    extra_goals: tuple[str, ...] = field(default=())
    routes: tuple[tuple[str, ...], ...] = field(default=())
    no_exits: frozenset[str] = field(default=frozenset())
    no_entries: frozenset[str] = field(default=frozenset())

    @property
    def name(self) -> str:
        """The file's name without its endings."""
        name = Path(self.network.source).name
        for ending in (".gz", ".xodr", ".xml", ".net"):
            name = name.removesuffix(ending)
        return name

    @property
    def source(self) -> str:
        """Path of the file."""
        return self.network.source

    @property
    def report(self) -> ImportReport:
        """What the reader did with every element of the file."""
        return self.network.report

    @cached_property
    def exits(self) -> dict[str, tuple[str, ...]]:
        """The ways out of the map: name to the ids of the lanes there."""
        from limsim_jax.maps.routing import default_goals

        return _without(default_goals(self.network), self.no_exits)

    @cached_property
    def goals(self) -> dict[str, tuple[str, ...]]:
        """Where vehicles can go: name to the ids of the lanes there, in the order of goal indices."""
        from limsim_jax.maps.routing import last_lanes

        lanes = {lane: (lane,) for lane in self.extra_goals}
        routes = {route_name(roads): last_lanes(self.network, roads[-1]) for roads in self.routes}
        return self.exits | lanes | routes

    @cached_property
    def origins(self) -> dict[str, tuple[str, ...]]:
        """Where vehicles can come in: name to the ids of the lanes there, from right to left."""
        from limsim_jax.maps.origins import origins

        return _without(origins(self.network), self.no_entries)

    @cached_property
    def lanes(self) -> LaneMap:
        """The arrays on the device: look-ups such as `pose` and `to_frenet` take them."""
        plain = not (self.extra_goals or self.no_exits or self.routes)
        routes = {route_name(roads): roads for roads in self.routes}
        return build_lane_map(self.network, None if plain else self.goals, routes)

    @cached_property
    def scenery(self) -> Scenery:
        """What sensors see of the map: painted ground and lights."""
        import jax

        from limsim_jax.maps.scenery import build_scenery

        with jax.ensure_compile_time_eval():  # the first to ask may be a function that is being traced
            return build_scenery(self.network, self.lanes)

    @cached_property
    def lane_ids(self) -> list[str]:
        """The id of each row of `lanes`."""
        from limsim_jax.maps.lane_map import lane_ids

        return list(lane_ids(self.network))

    def with_goals(self, lanes: Iterable[str], routes: Iterable[Sequence[str]] = ()) -> Map:
        """The map in which these lanes and routes are goals, too.

        Names of goals and unknown lanes are passed over."""
        new = [x for x in dict.fromkeys(lanes) if x not in self.goals and x in self.network.lanes]
        ways = [x for x in dict.fromkeys(map(tuple, routes)) if x not in self.routes]
        if not new and not ways:
            return self
        return replace(self, extra_goals=(*self.extra_goals, *new), routes=(*self.routes, *ways))

    def __repr__(self) -> str:
        lanes = list(self.network.drivable_lanes())
        km = sum(lane.length for lane in lanes) / 1e3
        return (
            f"Map '{self.name}': {len(lanes)} drivable lanes, {km:.2f} km, {len(self.network.junctions)} "
            f"junctions, origins {_listed(self.origins)}, goals {_listed(self.goals)}"
        )


def route_name(roads: Sequence[str]) -> str:
    """The name of the goal that a route is."""
    return " > ".join(roads)


def _without(ways: Mapping[str, tuple[str, ...]], barred: frozenset[str]) -> dict[str, tuple[str, ...]]:
    """Ways in or out without some lanes."""
    if not barred:
        return dict(ways)
    found = {name: tuple(x for x in lanes if x not in barred) for name, lanes in ways.items()}
    return {name: lanes for name, lanes in found.items() if lanes}


def _listed(names: Iterable[str], most: int = 8) -> str:
    names = list(names)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) or "none") + more


def load_map(source: str | Path | Network | Map, *, cache: bool = True) -> Map:
    """Read a map.

    Args:
      source: an OpenDRIVE (`.xodr`) or SUMO (`.net.xml`) file, also gzipped; the name of a bundled map; or a
        `Network`.
      cache: keep what was read on disk, so that the next load of the same bytes is quick.

    Raises:
      MapError: one line with file, line, element and reason.
    """
    if isinstance(source, Map):
        return source
    if isinstance(source, Network):
        return Map(source)
    if isinstance(source, str) and source in bundled_maps():
        return Map(read_network(bundled_maps()[source], cache=cache))
    path = Path(source)
    named = path if path.exists() or len(path.parts) > 1 or path.suffix else bundled_map(str(source))
    return Map(read_network(named, cache=cache))
