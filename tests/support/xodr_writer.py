"""Random OpenDRIVE files: hypothesis strategies that draw elements, and what must come of them.

Geometry is chained by the formulas in `experiments/opendrive_formulas.py`, so that reference lines are
continuous whatever is drawn.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
from opendrive_formulas import Geometry

Element = Any  # lxml's element type has no stubs

LANE_TYPES = ("driving", "driving", "driving", "shoulder", "sidewalk", "biking", "parking", "exit", "entry")
TO_MS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}


def node(tag: str, *children: Element, **attributes: object) -> Element:
    """An element; floats are written with all their digits."""
    element = etree.Element(tag)
    for name, value in attributes.items():
        element.set(name, repr(value) if isinstance(value, float) else str(value))
    element.extend(children)
    return element


def opendrive(*elements: Element, revision: int = 6) -> bytes:
    """A whole file."""
    header = node("header", revMajor=1, revMinor=revision, name="drawn", date="2024-01-01T00:00:00")
    return etree.tostring(
        node("OpenDRIVE", header, *elements), xml_declaration=True, encoding="UTF-8", pretty_print=True
    )


def number(low: float, high: float) -> st.SearchStrategy[float]:
    """Floats of few digits, which shrink well."""
    return st.integers(round(low * 1000), round(high * 1000)).map(lambda i: i / 1000)


def cubic(v0: float, m0: float, v1: float, m1: float, length: float) -> dict[str, float]:
    """Coefficients of the cubic with these values and slopes at 0 and `length`."""
    rise = (v1 - v0) / length
    return {
        "a": v0,
        "b": m0,
        "c": (3 * rise - 2 * m0 - m1) / length,
        "d": (m0 + m1 - 2 * rise) / length**2,
    }


@st.composite
def profile(
    draw: st.DrawFn, tag: str, start: str, length: float, low: float, high: float, base: float = 0.0
) -> list[Element]:
    """Continuous cubic records over `[base, base + length]` with values about `low` to `high`."""
    breaks = sorted({0.0, *(k / 10 for k in draw(st.sets(st.integers(1, 9), max_size=2)))})
    value, records = draw(number(low, high)), []
    for at, following in itertools.pairwise([*breaks, 1.0]):
        span = (following - at) * length
        reach = min(high - low, 0.15 * span)  # no steeper than lanes are built
        after = min(max(value + draw(number(-1, 1)) * reach, low), high)
        slopes = draw(number(-0.04, 0.04)), draw(number(-0.04, 0.04))
        records.append(
            node(tag, **{start: base + at * length}, **cubic(value, slopes[0], after, slopes[1], span))
        )
        value = after
    return records


@st.composite
def shape(draw: st.DrawFn, length: float, kinds: Sequence[str]) -> Element:
    """A geometry primitive whose curvature stays below about 0.02 1/m."""
    kind = draw(st.sampled_from(kinds))
    if kind == "line":
        return node("line")
    if kind == "arc":
        return node("arc", curvature=draw(number(-0.02, 0.02)))
    if kind == "spiral":
        return node("spiral", curvStart=draw(number(-0.02, 0.02)), curvEnd=draw(number(-0.02, 0.02)))
    bend, twist = draw(number(-0.008, 0.008)), draw(number(-0.2, 0.2)) * 0.02 / length
    if kind == "poly3":
        return node("poly3", a=0.0, b=draw(number(-0.1, 0.1)), c=bend, d=twist)
    along = draw(number(-0.05, 0.05)) / length
    u, v = (0.0, 1.0, along, -along / length), (0.0, draw(number(-0.1, 0.1)), bend, twist)
    scale, attributes = 1.0, {"pRange": "arcLength"}
    if kind == "normalized":
        scale, attributes = length, {"pRange": "normalized"} if draw(st.booleans()) else {}
    coefficients = {
        name + axis: c * scale**power
        for axis, cs in (("U", u), ("V", v))
        for power, (name, c) in enumerate(zip("abcd", cs, strict=True))
    }
    return node("paramPoly3", **coefficients, **attributes)


EXACT = ("line", "arc", "spiral")
ALL = (*EXACT, "poly3", "arcLength", "normalized")


@st.composite
def plan_view(draw: st.DrawFn, kinds: Sequence[str] = ALL) -> tuple[Element, float]:
    """<planView> of up to four records without gaps or kinks, and its length."""
    x, y, heading = draw(number(-500, 500)), draw(number(-500, 500)), draw(number(-3.2, 3.2))
    s, records = 0.0, []
    for _ in range(draw(st.integers(1, 4))):
        length = draw(number(8, 60))
        primitive = draw(shape(length, kinds))
        # poly3 and paramPoly3 may start with a slope: turned back, so that the line has no kink.
        heading -= float(Geometry(s, x, y, 0.0, length, primitive)(np.array([s]))[2][0])
        records.append(node("geometry", primitive, s=s, x=x, y=y, hdg=heading, length=length))
        end = Geometry(s, x, y, heading, length, primitive)(np.array([s + length]))
        x, y, heading = (float(v[0]) for v in end[:3])
        s += length
    return node("planView", *records), s


@dataclass(frozen=True)
class Speed:
    """A speed limit as written."""

    value: float
    unit: str

    @property
    def ms(self) -> float:
        """In m/s."""
        return self.value * TO_MS[self.unit]


speeds = st.builds(Speed, number(5, 130), st.sampled_from(sorted(TO_MS)))


@st.composite
def lane(draw: st.DrawFn, id_: int, length: float, border: float | None = None) -> Element:
    """<lane> with width records, or border records when the (unsigned) inner border is given."""
    if border is None:
        records = draw(profile("width", "sOffset", length, 1.6, 4.6))
    else:  # borders are t: negative right of the reference line
        low, high = sorted(math.copysign(border + by, id_) for by in (1.0, 4.0))
        records = draw(profile("border", "sOffset", length, low, high))
    element = node(
        "lane", node("link"), *records, id=id_, type=draw(st.sampled_from(LANE_TYPES)), level="false"
    )
    for share in sorted(set(draw(st.lists(number(0.0, 0.8), max_size=1)))):
        speed = draw(speeds)
        element.append(node("speed", sOffset=share * length, max=speed.value, unit=speed.unit))
    return element


@st.composite
def road(draw: st.DrawFn, id_: str = "1", kinds: Sequence[str] = ALL) -> Element:
    """<road> with everything that shapes its lanes."""
    plan, length = draw(plan_view(kinds))
    starts = [0.0, *sorted({length * share for share in draw(st.lists(number(0.15, 0.85), max_size=2))})]
    lanes = node("lanes")
    borders = draw(st.integers(0, 5)) == 0
    if not borders and draw(st.booleans()):
        lanes.extend(draw(profile("laneOffset", "s", length, -3.0, 3.0)))
    for start, end in zip(starts, [*starts[1:], length], strict=True):
        section = node("laneSection", s=start)
        counts = draw(st.sampled_from([(0, 1), (1, 0), (1, 1), (2, 3), (0, 2), (3, 1), (2, 0)]))
        for side, sign, count in (("left", 1, counts[0]), ("center", 0, 1), ("right", -1, counts[1])):
            group = node(side)
            if not sign:
                group.append(node("lane", id=0, type="none", level="false"))
            for i in range(1, count + 1) if sign else ():
                inner = 4.6 * (i - 1) if borders else None
                group.append(draw(lane(sign * i, end - start, inner)))
            if sign > 0:
                group[:] = list(group)[::-1]  # from left to right, as the standard has it
            if len(group):
                section.append(group)
        lanes.append(section)
    limit = draw(speeds)
    element = node(
        "road",
        node("link"),
        node("type", node("speed", max=limit.value, unit=limit.unit), s=0.0, type="town"),
        plan,
        node("elevationProfile", *draw(profile("elevation", "s", length, -4.0, 4.0))),
        lanes,
        name="",
        length=length,
        id=id_,
        junction=-1,
    )
    rule = draw(st.sampled_from([None, "RHT", "LHT"]))
    if rule:
        element.set("rule", rule)
    return element


# --- Roads that meet ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """A road of a chain: where it lies on the path, and which way its reference line runs."""

    road: str
    length: float
    curvature: float
    reversed: bool
    junction: bool
    right: int  # lanes right of the path
    left: int

    def number(self, slot: int) -> int:
        """Lane number of a lane in path slots: 1, 2, ... left of the path, -1, -2, ... right of it."""
        return -slot if self.reversed else slot

    def end(self, at_path_end: bool) -> str:
        """Contact point of the road at one end of its stretch of the path."""
        return "end" if at_path_end != self.reversed else "start"


@dataclass(frozen=True)
class Chain:
    """Roads one after the other along a path, some of them crossing junctions."""

    pieces: tuple[Piece, ...]
    left_hand: bool
    xml: bytes

    def expected_links(self) -> set[tuple[tuple[str, int], tuple[str, int]]]:
        """(road, lane) -> (road, lane) pairs that traffic drives."""
        links = set()
        for a, b in zip(self.pieces, self.pieces[1:], strict=False):
            for slot in _shared_slots(a, b):
                pair = (a.road, a.number(slot)), (b.road, b.number(slot))
                along_path = (slot < 0) != self.left_hand
                links.add(pair if along_path else pair[::-1])
        return links


def _shared_slots(a: Piece, b: Piece) -> list[int]:
    return [s for s in range(-4, 5) if s and all(-p.right <= s <= p.left for p in (a, b))]


WIDTH = 3.5


@st.composite
def chains(draw: st.DrawFn) -> Chain:
    """Two to six roads that meet end to end with contact points of all kinds."""
    count = draw(st.integers(2, 6))
    left_hand = draw(st.booleans())
    pieces: list[Piece] = []
    for i in range(count):
        # A junction has a road before and after it, and no neighbour junction: ids are those of the file.
        crossing = 0 < i < count - 1 and not pieces[-1].junction and draw(st.booleans())
        pieces.append(
            Piece(
                road=str(10 + i),
                length=draw(number(10, 80)),
                curvature=draw(number(-0.02, 0.02)),
                reversed=draw(st.booleans()),
                junction=crossing,
                right=draw(st.integers(1, 3)),
                left=draw(st.integers(0, 3)),
            )
        )
    elements = _chain_elements(pieces, left_hand)
    junctions = [_junction(pieces, i, left_hand) for i, piece in enumerate(pieces) if piece.junction]
    order = draw(st.permutations(range(len(elements))))
    return Chain(tuple(pieces), left_hand, opendrive(*(elements[i] for i in order), *junctions))


def _chain_elements(pieces: Sequence[Piece], left_hand: bool) -> list[Element]:
    x = y = heading = 0.0
    elements = []
    for i, piece in enumerate(pieces):
        curvature = -piece.curvature if piece.reversed else piece.curvature
        primitive = node("arc", curvature=curvature) if curvature else node("line")
        path = node("arc", curvature=piece.curvature) if curvature else node("line")
        end = Geometry(0.0, x, y, heading, piece.length, path)(np.array([piece.length]))
        after = tuple(float(v[0]) for v in end[:3])
        at = (after[0], after[1], after[2] + math.pi) if piece.reversed else (x, y, heading)
        plan = node(
            "planView",
            node("geometry", primitive, s=0.0, x=at[0], y=at[1], hdg=at[2], length=piece.length),
        )
        link = node("link")
        for tag, other in (("predecessor", i + (1 if piece.reversed else -1)),
                           ("successor", i + (-1 if piece.reversed else 1))):  # fmt: skip
            if 0 <= other < len(pieces):
                if pieces[other].junction:
                    link.append(node(tag, elementType="junction", elementId=f"{pieces[other].road}9"))
                else:
                    contact = pieces[other].end(at_path_end=other < i)
                    link.append(
                        node(tag, elementType="road", elementId=pieces[other].road, contactPoint=contact)
                    )
        section = node("laneSection", s=0.0)
        for side in ("left", "center", "right"):
            group = node(side)
            for id_ in (3, 2, 1, 0, -1, -2, -3):
                if (id_ > 0) - (id_ < 0) != {"left": 1, "center": 0, "right": -1}[side]:
                    continue
                slot = piece.number(id_)
                if id_ and not -piece.right <= slot <= piece.left:
                    continue
                group.append(_linked_lane(pieces, i, id_))
            if len(group):
                section.append(group)
        elements.append(
            node(
                "road",
                link,
                plan,
                node("lanes", section),
                name="",
                length=piece.length,
                id=piece.road,
                junction=f"{piece.road}9" if piece.junction else "-1",
                rule="LHT" if left_hand else "RHT",
            )
        )
        x, y, heading = after
    return elements


def _linked_lane(pieces: Sequence[Piece], i: int, id_: int) -> Element:
    piece, link = pieces[i], node("link")
    if id_:
        for tag, other in (("predecessor", i + (1 if piece.reversed else -1)),
                           ("successor", i + (-1 if piece.reversed else 1))):  # fmt: skip
            # Towards a junction the connections say which lanes meet.
            if 0 <= other < len(pieces) and not pieces[other].junction:
                slot = piece.number(id_)
                if slot in _shared_slots(piece, pieces[other]):
                    link.append(node(tag, id=pieces[other].number(slot)))
    lane_node = node("lane", link, id=id_, type="driving" if id_ else "none", level="false")
    if id_:
        lane_node.append(node("width", sOffset=0.0, a=WIDTH, b=0.0, c=0.0, d=0.0))
    return lane_node


def _junction(pieces: Sequence[Piece], i: int, left_hand: bool) -> Element:
    """Connections into road `i` from both its sides: traffic comes from both."""
    connecting = pieces[i]
    junction = node("junction", id=f"{connecting.road}9", name="")
    for k, other in enumerate((i - 1, i + 1)):
        incoming = pieces[other]
        connection = node(
            "connection",
            id=k,
            incomingRoad=incoming.road,
            connectingRoad=connecting.road,
            contactPoint=connecting.end(at_path_end=other > i),
        )
        for slot in _shared_slots(incoming, connecting):
            if ((slot < 0) != left_hand) == (other < i):  # traffic on it comes into the junction here
                connection.append(
                    node("laneLink", **{"from": incoming.number(slot), "to": connecting.number(slot)})
                )
        junction.append(connection)
    return junction
