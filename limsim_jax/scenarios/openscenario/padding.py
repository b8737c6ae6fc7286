"""Rows of a scenario as arrays of padded sizes."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from limsim_jax.maps.lane_map import bucket
from limsim_jax.scenarios.openscenario.arrays import Corridors, Dimension, Kind, Shape, Trajectories
from limsim_jax.scenarios.openscenario.roads import Corridor


class Sizes(NamedTuple):
    """Lengths of padded axes. Scenarios of equal sizes share a program.

    The least sizes hold all public scenarios of UN R157, so that all of them share one.
    """

    entities: int = 4
    corridors: int = 2
    points: int = 896
    places: int = 2
    trajectories: int = 1
    vertices: int = 2
    actions: int = 6
    profile: int = 3
    elements: int = 24
    conditions: int = 8
    groups: int = 8
    triggers: int = 8
    values: int = 12
    ring: int = 256

    def __or__(self, other: Sizes) -> Sizes:
        """Sizes that hold both."""
        return Sizes(*(max(a, b) for a, b in zip(self, other, strict=True)))


def sizes_of(*, points: int, delays: list[int], vertices: int, **counts: int) -> Sizes:
    """Sizes that hold so many rows, rounded up."""
    least = Sizes()
    rounded = {name: bucket(count, getattr(least, name)) for name, count in counts.items()}
    return Sizes(
        points=max(least.points, 128 * math.ceil(points / 128)),
        ring=max(least.ring, 1 << max([0, *delays]).bit_length()),
        vertices=bucket(vertices, least.vertices),
        **rounded,
    )


def no_action() -> dict[str, Any]:
    """A row that asks for nothing."""
    return {
        "kind": Kind.NOTHING, "element": -1, "entity": -1, "only_triggering": False, "shape": Shape.STEP,
        "dimension": Dimension.TIME, "over": 0.0, "value": 0.0, "other": -1, "lane": 0, "factor": False,
        "time_gap": False, "freespace": False, "side": 0, "continuous": False,
        "limits": (math.inf, math.inf, math.inf), "place": -1, "place_other": -1, "steady": (0.0, 0.0),
        "corridor": -1, "trajectory": -1, "timed": False, "absolute": False, "offset": 0.0, "speeds": [],
        "times": [], "variable": -1, "how": 0,
    }  # fmt: skip


def no_condition() -> dict[str, Any]:
    """A row that is never true."""
    return {
        "test": 0, "group": -1, "owner": -1, "edge": 0, "delay": 0, "who": [], "every": False, "rule": 0,
        "value": 0.0, "entity": -1, "place": -1, "frame": 0, "along": 0, "freespace": False,
        "tolerance": 0.0, "kind": -1, "elements": [], "phase": -1, "change": 0, "variable": -1,
    }  # fmt: skip


NO_PLACE = {
    "kind": 0, "pose": (0.0, 0.0, 0.0), "corridor": -1, "entity": -1, "along": 0.0, "beside": 0.0, "lanes": 0,
    "turned": 0,
}  # fmt: skip
NO_ELEMENT = {"level": -1, "parent": -1, "start": -1, "stop": -1, "most": 1, "priority": 0}


def padded(values: list[Any], count: int, fill: Any, kind: Any = None) -> Any:
    """An array of some length, filled up."""
    kind = (np.int32 if isinstance(fill, int) else np.float32) if kind is None else kind
    return np.array([*values, *[fill] * (count - len(values))], kind)


def columns(kind: Any, rows: list[dict[str, Any]], empty: dict[str, Any], count: int) -> Any:
    """Rows as arrays of a type, padded."""
    rows = [*rows, *[empty] * (count - len(rows))]
    found = {}
    for name in empty:
        values = np.array([row[name] for row in rows])
        exact = np.int32 if values.dtype.kind in "iu" else bool if values.dtype.kind == "b" else np.float32
        found[name] = values.astype(exact)
    return kind(**found)


def corridors_rows(made: list[Corridor], origin: tuple[float, float], sizes: Sizes) -> Corridors:
    """Corridors of equal length."""
    count, points = sizes.corridors, sizes.points
    made = [*made, *[made[-1]] * (count - len(made))]

    def pad(values: Any) -> Any:
        rest = points - len(values)
        return np.concatenate([values, np.repeat(values[-1:], rest, 0)]) if rest else values

    lines = []
    for one in made:
        line = np.stack([one.x - origin[0], one.y - origin[1], one.h], -1)
        lines.append(pad(line))
    fields: dict[str, Any] = dict(
        line=np.stack(lines).astype(np.float32),
        center=np.stack([pad(x.center) for x in made]).astype(np.float32),
        half=np.stack([pad(x.half) for x in made]).astype(np.float32),
        number=np.stack([pad(x.number) for x in made]).astype(np.int32),
        sign=np.stack([pad(x.sign) for x in made]).astype(np.float32),
        start=np.array([x.start for x in made], np.float32),
        last=np.array([len(x.x) - 1 for x in made], np.int32),
        free=np.array([not x.roads for x in made]),
    )
    return Corridors(**fields)


def trajectories_rows(paths: list[Any], sizes: Sizes) -> Trajectories:
    """Trajectories of equal length."""
    count, points = sizes.trajectories, sizes.vertices
    point_, way, time, last, local = [], [], [], [], []
    for xyz, metres, times, from_there in paths:
        rest = points - len(xyz)
        point_.append(np.concatenate([xyz, np.repeat(xyz[-1:], rest, 0)]))
        way.append(np.concatenate([metres, np.full(rest, metres[-1])]))
        time.append(np.nan_to_num(np.concatenate([times, np.full(rest, times[-1])])))
        last.append(len(xyz) - 1)
        local.append(from_there)
    empty = count - len(paths)
    fields: dict[str, Any] = dict(
        points=np.array(point_ + [np.zeros((points, 3))] * empty, np.float32),
        way=np.array(way + [np.zeros(points)] * empty, np.float32),
        time=np.array(time + [np.zeros(points)] * empty, np.float32),
        last=np.array(last + [1] * empty, np.int32),
        local=np.array(local + [False] * empty, bool),
    )
    return Trajectories(**fields)
