"""Random road networks: a map from a whole number, always the same.

    write_map(17, folder)

The kind of a map is its seed modulo the number of kinds. A drawing that makes no sensible map, such as roads
that overlap, is drawn anew from the next number of the same seed.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "maps"))  # of `mapbuilder`

from limsim_jax.files import write_whole
from random_roads import motorways, roundabouts, streets, sumo_nets
from random_roads.junctions import Map, Unfit
from random_roads.writer import footprint, write

TRIES = 200
"""Drawings of one seed, at most."""

OVERLAP = 1.0
"""m^2, by which two roads may overlap."""

DRAWN: dict[str, Callable[[np.random.Generator], Map]] = {
    "crossing": streets.one_crossing,
    "chain": streets.chain,
    "blocks": streets.blocks,
    "motorway": motorways.motorway,
    "road": motorways.plain_road,
    "roundabout": roundabouts.roundabout,
}
"""OpenDRIVE maps of our own."""

GENERATED: dict[str, Callable[[np.random.Generator, Path], None]] = {
    "sumo grid": sumo_nets.grid,
    "sumo random": sumo_nets.random_net,
    "sumo spider": sumo_nets.spider,
}
"""SUMO networks."""

KINDS = (
    "crossing", "sumo grid", "chain", "motorway", "sumo random",
    "blocks", "sumo spider", "road", "exported", "roundabout", "imported",
)  # fmt: skip
"""Kinds of maps by seed modulo 11; `exported` and `imported` are conversions."""


class RandomMap(NamedTuple):
    """A map file, and what it is."""

    seed: int
    kind: str
    path: Path
    of: str
    """Kind of the map that was converted, or the kind itself."""


def kind_of(seed: int) -> str:
    """Kind of the map of a seed."""
    return KINDS[seed % len(KINDS)]


def write_map(seed: int, folder: Path) -> RandomMap:
    """Write the map of a seed into a folder.

    Raises:
      Unfit: none of `TRIES` drawings makes a sensible map.
    """
    kind = kind_of(seed)
    folder.mkdir(parents=True, exist_ok=True)
    why = ""
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, attempt])
        name = f"{kind.replace(' ', '_')}_{seed}"
        try:
            match kind:
                case "exported":
                    of = str(rng.choice(list(GENERATED)))
                    source = folder / f"{name}_source.net.xml"
                    GENERATED[of](rng, source)
                    sumo_nets.refuse_overlaps(source)
                    sumo_nets.as_opendrive(source, path := folder / f"{name}.xodr")
                case "imported":
                    of = str(rng.choice(list(DRAWN)))
                    source = folder / f"{name}_source.xodr"
                    _draw(of, rng, source)
                    sumo_nets.as_sumo(source, path := folder / f"{name}.net.xml")
                case _ if kind in GENERATED:
                    of = kind
                    GENERATED[kind](rng, path := folder / f"{name}.net.xml")
                    sumo_nets.refuse_overlaps(path)
                case _:
                    of = kind
                    _draw(kind, rng, path := folder / f"{name}.xodr")
            return RandomMap(seed, kind, path, of)
        except Unfit as reason:
            why = str(reason)
    raise Unfit(f"map {seed}: none of {TRIES} drawings is a sensible map, the last for {why}")


def kept_map(seed: int, folder: Path) -> RandomMap:
    """The map of a seed, drawn unless the folder has it.

    Raises:
      Unfit: as `write_map`.
    """
    note = folder / f"{seed}.json"
    sources = sorted(Path(__file__).parent.glob("*.py"))
    code = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:12]
    if note.exists() and (kept := json.loads(note.read_text()))["code"] == code:
        return RandomMap(seed, kind_of(seed), folder / kept["file"], kept["of"])
    made = write_map(seed, folder)
    write_whole(note, json.dumps({"code": code, "file": made.path.name, "of": made.of}))
    return made


def _draw(kind: str, rng: np.random.Generator, path: Path) -> None:
    m = DRAWN[kind](rng)
    _refuse_overlaps(m)
    write(m, path)


def _refuse_overlaps(m: Map) -> None:
    """`Unfit` if two roads overlap outside junctions, or one crosses itself."""
    from shapely import STRtree
    from shapely.geometry import LineString, Polygon

    outlines = []
    for road in m.roads:
        line = road.line
        points = [line.pose(line.length * k / 40) for k in range(41)]
        if not LineString([(p.x, p.y) for p in points]).is_simple:
            raise Unfit("a road that crosses itself")
        outline = Polygon(footprint(road))
        outlines.append(outline if outline.is_valid else outline.buffer(0))
    tree = STRtree(outlines)
    for a, b in zip(*tree.query(outlines), strict=True):
        if a < b and outlines[a].intersection(outlines[b]).area > OVERLAP:
            raise Unfit(f"roads {m.roads[a].name} and {m.roads[b].name} overlap")


__all__ = ["DRAWN", "GENERATED", "KINDS", "RandomMap", "Unfit", "kept_map", "kind_of", "write_map"]
