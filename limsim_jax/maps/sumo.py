"""SUMO road networks (`.net.xml`, also gzipped) as a `Network`.

The format is the one of https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html. What has no
place in a `Network` is counted in its import report, elements and attributes alike.

Shapes. SUMO draws a lane as a polyline, and a polyline has no curvature. `fit_polyline` lays a chain
of circular arcs and straight lines over it that is continuous in position and heading.
"""

from __future__ import annotations

import io
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, overload

import numpy as np
from jaxtyping import Float
from lxml import etree
from numpy.typing import NDArray

from limsim_jax.maps.network import (
    Array,
    Control,
    Crosswalk,
    ImportReport,
    Junction,
    Lane,
    LaneSpot,
    LaneType,
    MapError,
    Movement,
    Network,
    Phase,
    Program,
    Road,
    StopLine,
    TrafficLight,
    Turn,
)
from limsim_jax.maps.xml import file_hash, read_bytes

DEFAULT_WIDTH = 3.2  # m, SUMO's lane width where the file has none
RESOLUTION = 0.01  # m, what two decimals resolve: netconvert's default precision
BEND_SHARE = 0.1  # share of the lane width by which our curve may leave the shape of an ordinary lane
MAX_BEND = math.radians(100.0)  # rad, a sharper turn at one vertex is a corner, not a sample of a bend
SPIKE = math.radians(150.0)  # rad, a sharper turn folds the lane back over itself
KINK = 5.0  # degrees between a lane and the next, from which on it is reported
SAMPLE_ERROR = 5e-5  # m, of cubic Hermite interpolation between the samples of a lane
STEP = 1e-3  # m, between two samples that bracket a jump of curvature

VEHICLE_CLASSES = frozenset(
    "private emergency authority army vip pedestrian passenger hov taxi bus coach delivery truck trailer"
    " motorcycle moped bicycle evehicle tram rail_urban rail rail_electric rail_fast ship container"
    " cable_car subway aircraft wheelchair scooter drone custom1 custom2".split()
)
"""Abstract vehicle classes of SUMO 1.28."""

OLD_CLASSES = {
    "public_emergency": "emergency",
    "public_authority": "authority",
    "public_army": "army",
    "public_transport": "bus",
    "transport": "truck",
    "lightrail": "tram",
    "cityrail": "rail_urban",
    "rail_slow": "rail",
}
"""Names of vehicle classes in nets of old versions."""

ENGINE_CLASS = {
    "passenger": "car",
    "evehicle": "car",
    "private": "car",
    "vip": "car",
    "hov": "car",
    "taxi": "car",
    "authority": "car",
    "custom1": "car",
    "custom2": "car",
    "ignoring": "car",
    "delivery": "van",
    "truck": "truck",
    "trailer": "truck",
    "army": "truck",
    "bus": "bus",
    "coach": "bus",
    "motorcycle": "motorcycle",
    "moped": "motorcycle",
    "emergency": "emergency",
}
"""Vehicle class of the engine for a vehicle of a SUMO class; the others are no motor traffic on roads."""

DEMAND_ROOTS = tuple("additional additionals add routes route-alternatives trips vtypes flows".split())
"""Root elements of additional and route files; SUMO itself does not look at them."""

_SPECIAL_RIGHTS = frozenset({"emergency", "authority", "army", "vip"})
_MOTOR = frozenset("passenger private evehicle delivery truck trailer motorcycle".split())
_FOOT = frozenset({"pedestrian", "wheelchair"})
_RAIL = frozenset({"rail_urban", "rail", "rail_electric", "rail_fast", "subway"})

_TYPE_OF_CLASSES = (
    (frozenset({"bus", "coach"}), LaneType.BUS),
    (frozenset({"taxi"}), LaneType.TAXI),
    (frozenset({"hov"}), LaneType.HOV),
    (frozenset({"tram"}), LaneType.TRAM),
    (_RAIL, LaneType.RAIL),
    (frozenset({"bicycle", "moped", "scooter"}), LaneType.BIKING),
    (_FOOT, LaneType.SIDEWALK),
    (_SPECIAL_RIGHTS | {"custom1", "custom2"}, LaneType.RESTRICTED),
)
"""Lane type by the first group of classes of which one is allowed, on lanes without general motor traffic."""

_DRIVEN = frozenset({"normal", "internal"})
"""Functions of edges whose lanes are ways for vehicles."""

_UNUSED_TYPES = frozenset("shoulder border stop restricted parking median curb sidewalk".split())

_TURNS = {
    "s": Turn.STRAIGHT,
    "t": Turn.U_TURN,
    "T": Turn.U_TURN,
    "l": Turn.LEFT,
    "r": Turn.RIGHT,
    "L": Turn.SLIGHT_LEFT,
    "R": Turn.SLIGHT_RIGHT,
}

_CONTROLS = {
    "M": Control.PRIORITY,
    "m": Control.YIELD,
    "s": Control.STOP,
    "w": Control.ALL_WAY_STOP,
    "=": Control.NONE,
    "Z": Control.ZIPPER,
    "-": Control.NONE,  # dead end
    "O": Control.PRIORITY,  # lights switched off
    "o": Control.YIELD,  # lights blinking
}

# ---------------------------------------------------------------------------------------------- XML


_PARSER: dict[str, Any] = dict(
    resolve_entities=False,
    no_network=True,
    load_dtd=False,
    huge_tree=False,  # so libxml2 bounds depth, attribute size and entity expansion
    remove_comments=True,
    remove_pis=True,
)


_REQUIRED: Any = object()  # in place of a default


@dataclass
class XmlFile:
    """Typed access to the attributes of an XML file; remembers which ones were asked for."""

    path: str
    report: ImportReport
    known: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    unused: Counter[tuple[str, str]] = field(default_factory=Counter)
    first: dict[tuple[str, str], int | None] = field(default_factory=dict)

    def error(self, element: Any, reason: str) -> MapError:
        """`MapError` that names the place of an element."""
        name = " ".join(str(x) for x in (element.tag, element.get("id")) if x)
        return MapError(reason, file=self.path, line=element.sourceline, element=name)

    def syntax_error(self, error: etree.XMLSyntaxError) -> MapError:
        """`MapError` for what the parser could not read."""
        return MapError(f"not well-formed XML ({error.msg})", file=self.path, line=error.lineno or None)

    def check_document(self, root: Any, names: tuple[str, ...]) -> None:
        """Raise `MapError` for a document type definition or a root element other than `names`."""
        if root.getroottree().docinfo.internalDTD is not None:
            raise MapError("document types are not accepted; delete the <!DOCTYPE ...>", file=self.path)
        if root.tag not in names:
            wanted = " or ".join(f"<{name}>" for name in names)
            reason = f"the root element is <{root.tag}>, not {wanted}"
            raise MapError(reason, file=self.path, line=root.sourceline)

    @overload
    def text(self, element: Any, name: str) -> str: ...
    @overload
    def text(self, element: Any, name: str, default: str) -> str: ...
    @overload
    def text(self, element: Any, name: str, default: None) -> str | None: ...
    def text(self, element: Any, name: str, default: Any = _REQUIRED) -> str | None:
        """An attribute as it stands; `MapError` if it is missing and there is no default."""
        self.known[element.tag].add(name)
        value = element.get(name)
        if value is None:
            if default is _REQUIRED:
                raise self.error(element, f"attribute '{name}' is missing")
            return default
        return value

    @overload
    def number(self, element: Any, name: str, *, minimum: float = ...) -> float: ...
    @overload
    def number(self, element: Any, name: str, default: float, *, minimum: float = ...) -> float: ...
    @overload
    def number(self, element: Any, name: str, default: None, *, minimum: float = ...) -> float | None: ...
    def number(
        self, element: Any, name: str, default: Any = _REQUIRED, *, minimum: float = -math.inf
    ) -> float | None:
        """A finite number not below `minimum`; `MapError` for anything else."""
        value = self.text(element, name) if default is _REQUIRED else self.text(element, name, None)
        if value is None:
            return default
        return self.parse_number(element, name, value, minimum)

    def parse_number(self, element: Any, name: str, value: str, minimum: float = -math.inf) -> float:
        """`value` of attribute `name` as a finite number not below `minimum`."""
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            raise self.error(element, f"{name}='{value[:40]}' is not a finite number")
        if number < minimum:
            raise self.error(element, f"{name}='{value[:40]}' is below {minimum:g}")
        return number

    @overload
    def integer(self, element: Any, name: str) -> int: ...
    @overload
    def integer(self, element: Any, name: str, default: int) -> int: ...
    @overload
    def integer(self, element: Any, name: str, default: None) -> int | None: ...
    def integer(self, element: Any, name: str, default: Any = _REQUIRED) -> int | None:
        """An integer; `MapError` for anything else."""
        number = self.number(element, name, default)
        if number is None:
            return None
        if number != int(number):
            raise self.error(element, f"{name}='{element.get(name)}' is not an integer")
        return int(number)

    def flag(self, element: Any, name: str, default: bool = False) -> bool:
        """A truth value in any of SUMO's spellings; `MapError` for anything else."""
        value = self.text(element, name, None)
        if value is None:
            return default
        lower = value.lower()
        if lower in {"1", "true", "yes", "on", "x", "t"}:
            return True
        if lower in {"0", "false", "no", "off", "-", "f"}:
            return False
        raise self.error(element, f"{name}='{value[:40]}' is not a truth value")

    def choice(self, element: Any, name: str, choices: dict[str, Any]) -> Any:
        """The value of `choices` for an attribute; `MapError` if it is none of them."""
        value = self.text(element, name)
        if value not in choices:
            raise self.error(element, f"{name}='{value[:40]}' is none of {' '.join(choices)}")
        return choices[value]

    def shape(self, element: Any, name: str) -> Float[Array, "K 3"]:
        """A polyline `x,y[,z] x,y[,z] ...`; z is 0 where the file has none. Empty if the attribute is."""
        points = []
        for item in (self.text(element, name, "") or "").split():
            parts = item.split(",")
            if len(parts) not in (2, 3):
                raise self.error(element, f"{name}: '{item[:40]}' is not x,y or x,y,z")
            xyz = [self.parse_number(element, name, part) for part in parts]
            if max(map(abs, xyz)) > 1e9:
                raise self.error(element, f"{name}: '{item[:40]}' lies more than 1e9 m away")
            points.append(xyz if len(xyz) == 3 else [*xyz, 0.0])
        return np.array(points, float).reshape(-1, 3)

    def ignore(self, element: Any, message: str) -> None:
        """Count an element, with all that is in it, as ignored; `summarise` writes the line."""
        self._count(f"{element.tag}", message, element)

    def count_unused(self, element: Any) -> None:
        """Count the attributes of an element that nobody asked for; call it after reading the element."""
        for name in element.attrib:
            if name not in self.known[element.tag] and not name.startswith("{"):
                self._count(f"{element.tag}@{name}", "attribute not used", element)

    def _count(self, kind: str, message: str, element: Any) -> None:
        self.unused[kind, message] += 1
        self.first.setdefault((kind, message), element.sourceline)

    def summarise(self) -> None:
        """Write one line of the report per kind of thing that was ignored."""
        for (kind, message), count in self.unused.items():
            times = "once" if count == 1 else f"{count} times"
            self.report.ignored(kind, f"{times}, first here", message, self.first[kind, message])
            self.report.counts[kind, self.report.notes[-1].action] += count - 1


def parse_xml(path: str | Path, roots: tuple[str, ...], report: ImportReport) -> tuple[XmlFile, Any, str]:
    """Parse a whole file: attribute access, root element, SHA-256. Raises `MapError`."""
    data = read_bytes(path)
    xml = XmlFile(str(path), report)
    try:
        root = etree.parse(io.BytesIO(data), etree.XMLParser(**_PARSER)).getroot()
    except etree.XMLSyntaxError as error:
        raise xml.syntax_error(error) from error
    xml.check_document(root, roots)
    return xml, root, file_hash(data)


def stream_xml(
    path: str | Path, roots: tuple[str, ...], report: ImportReport
) -> Iterator[tuple[XmlFile, Any]]:
    """Children of the root element one at a time, forgotten after use: for files of any size."""
    xml = XmlFile(str(path), report)
    root = None
    try:
        for event, element in etree.iterparse(
            io.BytesIO(read_bytes(path)), events=("start", "end"), **_PARSER
        ):
            if root is None:
                root = element
                xml.check_document(root, roots)
            elif event == "end" and element.getparent() is root:
                yield xml, element
                element.clear()
                while element.getprevious() is not None:
                    del root[0]
    except etree.XMLSyntaxError as error:
        raise xml.syntax_error(error) from error
    xml.summarise()


# -------------------------------------------------------------------------------------------- shapes


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A chain of `A` circular arcs (curvature 0: straight lines), continuous in position and heading."""

    xy: Float[Array, "A 2"]  # m, where each arc starts
    heading: Float[Array, " A"]  # rad, there, unwrapped
    curvature: Float[Array, " A"]  # 1/m
    length: Float[Array, " A"]  # m
    vertex_s: Float[Array, " K"]  # m, arc length abreast of each vertex of the polyline
    deviation: float  # m, how far it leaves the polyline
    spikes: int  # vertices left out because the polyline folds back there

    @property
    def total(self) -> float:
        """Arc length of the whole curve, m."""
        return float(self.length.sum())

    def heading_at(self, s: float) -> float:
        """Heading (rad, unwrapped) at arc length `s` (m)."""
        return float(self.at(np.array([s]))[1][0])

    def at(self, s: Float[Array, " M"]) -> tuple[Float[Array, "M 2"], Float[Array, " M"], Float[Array, " M"]]:
        """Position (m), heading (rad, unwrapped) and curvature (1/m) at arc length `s` (m)."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        i = np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(self.length) - 1)
        half = 0.5 * self.curvature[i] * (s - start[i])
        chord = (s - start[i]) * np.sinc(half / np.pi)
        direction = self.heading[i] + half
        xy = self.xy[i] + chord[:, None] * np.stack([np.cos(direction), np.sin(direction)], -1)
        return xy, self.heading[i] + 2 * half, self.curvature[i]

    def samples(self, lo: float = 0.0, hi: float = math.inf) -> Float[Array, " M"]:
        """Arc lengths (m) from `lo` to `hi` between which cubic Hermite interpolation is good.

        Its error is at most `SAMPLE_ERROR`. A jump of curvature lies between two samples 1 mm apart, so
        that linear interpolation keeps it.
        """
        kappa = np.abs(self.curvature)
        # Over an arc of angle t and radius R the cubic is off by R t^4 / 384.
        angle = np.minimum((384 * SAMPLE_ERROR * np.maximum(kappa, 1e-12)) ** 0.25, 0.5)
        count = np.maximum(np.ceil(kappa * self.length / angle), 1).astype(int)
        end = np.cumsum(self.length)
        step = self.length / count
        arc = np.repeat(np.arange(len(count)), count)
        nth = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        jump = np.append(np.abs(np.diff(self.curvature)) > 1e-6, False) & (step > 1.5 * STEP)
        s = np.sort(np.concatenate([(end - self.length)[arc] + nth * step[arc], end[jump] - STEP]))
        hi = min(hi, float(end[-1]))
        return np.concatenate([[lo], s[(s > lo + STEP / 2) & (s < hi - STEP / 2)], [hi]])


def _wrap(angle: Any) -> Any:
    """Angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _simplify(points: Float[Array, "K 3"], tolerance: float) -> NDArray[np.int64]:
    """Indices of the vertices that the Douglas-Peucker algorithm keeps."""
    keep = {0, len(points) - 1}
    stack = [(0, len(points) - 1)]
    while stack:
        i, j = stack.pop()
        if j - i < 2:
            continue
        chord, inner = points[j] - points[i], points[i + 1 : j] - points[i]
        u = np.clip(inner @ chord / max(chord @ chord, 1e-300), 0.0, 1.0)
        distance = np.linalg.norm(inner - u[:, None] * chord, axis=1)
        k = int(distance.argmax())
        if distance[k] > tolerance:
            middle = i + 1 + k
            keep.add(middle)
            stack += [(i, middle), (middle, j)]
    return np.array(sorted(keep))


def _biarc(p0: Array, h0: float, p1: Array, h1: float) -> list[tuple[Array, float, float, float]]:
    """Two arcs (start, heading, curvature, length) from pose to pose, or one line.

    The two distances from the ends to the control points are equal (Bolton 1975, 'Biarc curves').
    """
    v = p1 - p0
    t0 = np.array([math.cos(h0), math.sin(h0)])
    t1 = np.array([math.cos(h1), math.sin(h1)])
    if abs(t0[0] * v[1] - t0[1] * v[0]) < 1e-9 and abs(_wrap(h1 - h0)) < 1e-9:
        return [(p0, h0, 0.0, float(np.hypot(*v)))]
    a, b, c = 2 * (1 - float(t0 @ t1)), float(v @ (t0 + t1)), float(v @ v)
    # a d^2 + 2 b d - c = 0 in the form that does not cancel as a goes to 0
    d = c / (b + math.sqrt(b * b + a * c))
    joint = 0.5 * (p0 + p1 + d * (t0 - t1))
    arcs = []
    for start, end, heading, at_start in ((p0, joint, h0, True), (joint, p1, h1, False)):
        chord = end - start
        c = float(np.hypot(*chord))
        half = float(_wrap(math.atan2(chord[1], chord[0]) - heading))  # chord against tangent
        if not at_start:
            half = -half
        length = c / float(np.sinc(half / np.pi))
        arcs.append((start, heading if at_start else heading - 2 * half, 2 * half / length, length))
    return arcs


def fit_polyline(
    points: Float[Array, "K 3"],
    *,
    tolerance: float = math.inf,
    start_heading: float | None = None,
    end_heading: float | None = None,
) -> Curve:
    """Curve of arcs and lines over a polyline; starts and ends where the polyline does.

    1. Vertices that are within 1 cm of the line through the others are left out (Douglas-Peucker): at
       the usual two decimals they tell of rounding, not of the road.
    2. A vertex where the polyline turns is a sample of a bend: the curve goes through it, in the
       direction of the circle through it and its neighbours, and bulges over the segments as the
       bend did that was sampled. On a segment more than twice as long as the one beyond the vertex the
       bend takes only that much of it.
    3. If that would leave the polyline by more than `tolerance` (m), or the turn is beyond 100 degrees,
       the vertex is a corner: an arc rounds it off that leaves the vertex by `tolerance` or takes half
       of the shorter segment.
    4. Headings at the ends are those of the first and last segment. Where a heading (rad) is given and
       differs from the segment by no more than the turn at the next vertex, the segment is the
       first chord of a bend and the given heading is taken.

    `points` are at least two, with no two equal in a row.
    """
    kept = _simplify(points, RESOLUTION)
    spikes = 0
    while True:
        vertices = points[kept, :2]
        segment = np.diff(vertices, axis=0)
        size = np.hypot(segment[:, 0], segment[:, 1])
        direction = np.arctan2(segment[:, 1], segment[:, 0])
        turn = _wrap(np.diff(direction))
        folds = np.flatnonzero((np.abs(turn) > SPIKE) | (size[1:] == 0))
        if not len(folds) or len(kept) == 2:
            break
        kept, spikes = np.delete(kept, folds[0] + 1), spikes + 1

    before, after = size[:-1], size[1:]
    reach = np.stack([np.minimum(before, 2 * after), np.minimum(after, 2 * before)])  # of bends
    turn_in = turn * reach[0] / reach.sum(0)
    turn_out = turn - turn_in
    bend = np.abs(turn) <= MAX_BEND
    while bend.any():
        # Over each segment: the part that a bend takes, or all of it if there is one at either end.
        at_start, at_end = np.where(bend, np.abs(turn_out), 0.0), np.where(bend, np.abs(turn_in), 0.0)
        a, b = np.append(0.0, at_start), np.append(at_end, 0.0)
        ra, rb = np.append(0.0, reach[1] * bend), np.append(reach[0] * bend, 0.0)
        # Largest distance from its chord of an arc that meets it at angles a and b: that of the cubic.
        whole = size * (0.148 * np.maximum(a, b) + 0.102 * np.minimum(a, b))
        bulge = np.where(ra + rb < size, 0.148 * np.maximum(ra * a, rb * b), whole)
        i = int(bulge.argmax())
        if bulge[i] <= tolerance:
            break
        bend[i if i < len(turn) and b[i] >= a[i] else i - 1] = False
    with np.errstate(divide="ignore"):
        cut = np.minimum(np.minimum(before, after) / 2, tolerance / np.tan(np.abs(turn) / 4))

    # Poses that the curve goes through, and the two of them that bracket each vertex.
    start = _end_heading(float(direction[0]), start_heading, turn[:1])
    end = _end_heading(float(direction[-1]), end_heading, turn[-1:])
    nodes = [(vertices[0], start)]
    brackets = [(0, 0)]
    reach = np.where(bend, reach, cut)
    taken = size[0] if start != direction[0] else 0.0  # of the segment, by the vertex behind
    for i, p in enumerate(vertices[1:-1]):
        h0, h1 = float(direction[i]), float(direction[i + 1])
        u0, u1 = segment[i] / size[i], segment[i + 1] / size[i + 1]
        if not bend[i]:
            nodes += [(p - cut[i] * u0, h0), (p + cut[i] * u1, h1)]
            brackets.append((len(nodes) - 2, len(nodes) - 1))
        else:
            if taken + reach[0, i] < size[i] - RESOLUTION:
                nodes.append((p - reach[0, i] * u0, h0))
            nodes.append((p, h0 + float(turn_in[i])))
            brackets.append((len(nodes) - 1, len(nodes) - 1))
            last = i + 1 == len(turn)
            ahead = (size[-1] if end != direction[-1] else 0.0) if last else reach[0, i + 1]
            if reach[1, i] + ahead < size[i + 1] - RESOLUTION:
                nodes.append((p + reach[1, i] * u1, h1))
        taken = reach[1, i]
    nodes.append((vertices[-1], end))
    brackets.append((len(nodes) - 1, len(nodes) - 1))

    arcs: list[tuple[Array, float, float, float]] = []
    node_s = [0.0]
    for (p0, h0), (p1, h1) in pairwise(nodes):
        new = _biarc(p0, h0, p1, h1) if np.hypot(*(p1 - p0)) > 1e-6 else []
        arcs += new
        node_s.append(node_s[-1] + sum(arc[3] for arc in new))
    curvature = np.array([arc[2] for arc in arcs])
    length = np.array([arc[3] for arc in arcs])
    turned = np.concatenate([[0.0], np.cumsum(curvature * length)[:-1]])

    # Vertices that were left out lie between their neighbours as they do on the polyline.
    polyline_s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])
    at_kept = np.array([0.5 * (node_s[a] + node_s[b]) for a, b in brackets])
    curve = Curve(
        xy=np.array([arc[0] for arc in arcs]),
        heading=arcs[0][1] + turned,
        curvature=curvature,
        length=length,
        vertex_s=np.interp(polyline_s, polyline_s[kept], at_kept),
        deviation=0.0,
        spikes=spikes,
    )
    half_way = np.cumsum(length) - 0.5 * length
    probes = np.concatenate([curve.xy, curve.at(half_way)[0]])
    return replace(curve, deviation=float(distance_to_polyline(probes, points[:, :2]).max()))


def _end_heading(segment: float, given: float | None, turn: Float[Array, " J"]) -> float:
    """The given heading if the end segment can be a chord of a bend that has it, else the segment's."""
    if given is None or not len(turn):
        return segment
    return given if abs(_wrap(given - segment)) <= abs(float(turn[0])) else segment


def distance_to_polyline(xy: Float[Array, "M 2"], points: Float[Array, "K 2"]) -> Float[Array, " M"]:
    """Distance (m) of each point from the nearest place on a polyline."""
    p, vertices = xy @ (1, 1j), points @ (1, 1j)
    start, chord = vertices[:-1], np.diff(vertices)
    offset = p[:, None] - start
    u = (offset * (chord.conj() / np.maximum(np.abs(chord) ** 2, 1e-300))).real
    return np.abs(offset - np.clip(u, 0.0, 1.0) * chord).min(1)


# -------------------------------------------------------------------------------------------- reader


def read_sumo(path: str | Path, additional: Iterable[str | Path] = ()) -> Network:
    """Read a SUMO network (`.net.xml` or `.net.xml.gz`).

    Args:
      path: the network file.
      additional: additional files whose `<tlLogic>` programs join those of the network.

    Returns:
      The network. Of several programs of a traffic light the one loaded last is in use, as in SUMO, and
      has the light's id; the others are kept under `light:program`.

    Raises:
      MapError: the file cannot be used; names file, line, element and reason.
    """
    report = ImportReport()
    xml, root, digest = parse_xml(path, ("net",), report)
    reader = _Reader(xml, root)
    reader.read_elements()
    for extra in additional:
        reader.read_additional(extra)
    return reader.network(digest)


@dataclass(kw_only=True)
class _Edge:
    id: str
    function: str
    element: Any
    lanes: list[_Lane]
    junction: str | None = None


@dataclass(kw_only=True)
class _Lane:
    id: str
    index: int
    edge: _Edge
    element: Any
    speed: float
    length: float
    width: float
    allowed: frozenset[str]
    change_left: frozenset[str]
    change_right: frozenset[str]
    points: Float[Array, "K 3"]
    stop_offset: float = 0.0
    opposite: str | None = None
    outgoing: list[_Connection] = field(default_factory=list)


@dataclass(kw_only=True, eq=False)
class _Connection:
    source: _Lane
    target: _Lane
    element: Any
    turn: Turn
    state: str
    via: _Lane | None
    light: str | None
    link: int | None
    keep_clear: bool
    allowed: frozenset[str]


def _short(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


class _Reader:
    """Elements of the file first, then what follows from them."""

    def __init__(self, xml: XmlFile, root: Any) -> None:
        self.xml, self.root, self.report = xml, root, xml.report
        self.left_hand = xml.flag(root, "lefthand")
        self.version = xml.text(root, "version", "")
        self.edges: dict[str, _Edge] = {}
        self.lanes: dict[str, _Lane] = {}
        self.junction_elements: dict[str, Any] = {}
        self.programs: dict[str, dict[str, tuple[XmlFile, Any, Program]]] = {}  # light -> program id
        self.roundabouts: set[str] = set()
        self.geo_reference = ""

    # ---- elements

    def read_elements(self) -> None:
        by_tag: dict[str, list[Any]] = defaultdict(list)
        for element in self.root:
            by_tag[element.tag].append(element)
        for element in by_tag.pop("location", []):
            self._location(element)
        for element in by_tag.pop("edge", []):
            self._edge(element)
        for element in by_tag.pop("junction", []):
            if self.xml.text(element, "id") in self.junction_elements:
                raise self.xml.error(element, "second junction of this id")
            self.junction_elements[element.get("id")] = element
        for element in by_tag.pop("connection", []):
            self._connection(element)
        for element in by_tag.pop("tlLogic", []):
            self._program(self.xml, element)
        for element in by_tag.pop("roundabout", []):
            nodes = self.xml.text(element, "nodes").split()
            self.xml.text(element, "edges", "")
            if missing := [n for n in nodes if n not in self.junction_elements]:
                raise self.xml.error(element, f"there is no junction '{missing[0]}'")
            self.roundabouts.update(nodes)
            self._done(element)
        messages = {
            "type": "edge types are defaults for building a net; the lanes carry their own values",
            "prohibition": "for building a net; the request matrices carry the outcome",
            "taz": "districts are demand",
            "district": "districts are demand",
        }
        for tag, elements in by_tag.items():
            for element in elements:
                self.xml.ignore(element, messages.get(tag, "not part of the road network"))
        if not self.edges:
            raise MapError("the net has no edges", file=self.xml.path)
        self.xml.count_unused(self.root)

    def _done(self, element: Any, count: bool = True) -> None:
        """Count an element as read, and what nobody asked for in it as ignored."""
        if count:
            self.report.read(element.tag)
        self.xml.count_unused(element)

    def _ignore_children(self, element: Any, *used: str) -> None:
        for child in element:
            if child.tag not in used:
                self.xml.ignore(child, f"not used within <{element.tag}>")

    def _location(self, element: Any) -> None:
        offset = self.xml.text(element, "netOffset", "0,0")
        projection = self.xml.text(element, "projParameter", "!")
        for name in ("convBoundary", "origBoundary"):
            self.xml.text(element, name, "")
        if projection not in ("!", "", "-"):
            self.geo_reference = projection
            if any(float(x) for x in re.findall(r"[-+.\deE]+", offset) if _is_number(x)):
                message = f"coordinates are those of the projection shifted by netOffset {offset}"
                self.report.approximated("location", "", message, element.sourceline)
                self._done(element, count=False)
                return
        self._done(element)

    def _classes(self, element: Any, allow: str | None, disallow: str | None) -> frozenset[str]:
        def names(value: str) -> set[str]:
            found = set()
            for name in re.split(r"[\s|]+", value.strip()):
                name = OLD_CLASSES.get(name, name)
                if name == "all":
                    return set(VEHICLE_CLASSES)
                if name in VEHICLE_CLASSES:
                    found.add(name)
                elif name and name != "ignoring":  # vehicles of that class are bound by nothing
                    self.xml.ignore(element, f"vehicle class '{name}' is unknown")
            return found

        if allow is not None and allow.strip():
            return frozenset(names(allow))
        if disallow is not None:
            return VEHICLE_CLASSES - names(disallow)
        return VEHICLE_CLASSES

    def _permissions(self, element: Any) -> frozenset[str]:
        allow, disallow = (self.xml.text(element, name, None) for name in ("allow", "disallow"))
        return self._classes(element, allow, disallow)

    def _edge(self, element: Any) -> None:
        xml = self.xml
        edge = _Edge(
            id=xml.text(element, "id"),
            function=xml.text(element, "function", "normal"),
            element=element,
            lanes=[],
        )
        if edge.function not in {"normal", "internal", "connector", "crossing", "walkingarea"}:
            raise xml.error(element, f"function='{edge.function}' is unknown")
        if edge.id in self.edges:
            raise xml.error(element, "second edge of this id")
        self.edges[edge.id] = edge
        for name in ("from", "to"):
            if edge.function == "normal":
                xml.text(element, name)
        for name in ("priority", "name", "type", "crossingEdges", "shape", "spreadType"):
            xml.text(element, name, None)  # the shape of the edge is what the lane shapes were built from
        if bidi := xml.text(element, "bidi", None):
            message = f"shares its track with edge '{bidi}'; the two are independent here"
            self.report.approximated("edge", edge.id, message, element.sourceline)
        offset = self._stop_offset(element, 0.0)
        for child in element:
            if child.tag == "lane":
                self._lane(child, edge, offset)
        if not edge.lanes:
            raise xml.error(element, "the edge has no lanes")
        for position, lane in enumerate(edge.lanes):
            # SUMO goes by the order; netconvert writes index 0 for all lanes behind a place to wait.
            if lane.index != position:
                message = f"index {lane.index} taken as {position}, its place in the edge"
                self.report.repaired("lane", lane.id, message, lane.element.sourceline)
                lane.index = position
        fastest = max(lane.speed for lane in edge.lanes)
        for lane in edge.lanes:
            if lane.speed <= 0.0:
                if fastest <= 0.0:
                    message = (
                        f"speed='{lane.speed:g}' is not above 0, nor is that of another lane of its edge"
                    )
                    raise xml.error(lane.element, message)
                message = (
                    f"speed {lane.speed:g} m/s, taken as the {fastest:g} m/s of another lane of its edge"
                )
                self.report.repaired("lane", lane.id, message, lane.element.sourceline)
                lane.speed = fastest
        self._ignore_children(element, "lane", "stopOffset")
        self._done(element, count=not bidi)

    def _stop_offset(self, element: Any, inherited: float) -> float:
        """Distance (m) of the stop position from the end of a lane, for ordinary cars."""
        offset = inherited
        for child in element.findall("stopOffset"):
            value = self.xml.number(child, "value", minimum=0.0)
            chosen, spared = self.xml.text(child, "vClasses", None), self.xml.text(child, "exceptions", None)
            if chosen is not None or spared is not None:
                message = "for some vehicle classes; here for all of them if passenger cars are among them"
                self.report.approximated("stopOffset", element.get("id"), message, child.sourceline)
                if "passenger" not in self._classes(child, chosen, spared):
                    continue
            else:
                self.report.read("stopOffset")
            offset = value
        return offset

    def _lane(self, element: Any, edge: _Edge, stop_offset: float) -> None:
        xml = self.xml
        lane = _Lane(
            id=xml.text(element, "id"),
            index=xml.integer(element, "index"),
            edge=edge,
            element=element,
            speed=xml.number(element, "speed"),
            length=xml.number(element, "length", minimum=0.0),
            width=xml.number(element, "width", DEFAULT_WIDTH),
            allowed=self._permissions(element),
            change_left=self._classes(element, xml.text(element, "changeLeft", None), None),
            change_right=self._classes(element, xml.text(element, "changeRight", None), None),
            points=xml.shape(element, "shape"),
            stop_offset=self._stop_offset(element, stop_offset),
        )
        if lane.id in self.lanes:
            raise xml.error(element, "second lane of this id")
        if lane.width <= 0.0:
            message = f"width {lane.width:g} m, taken as the default of {DEFAULT_WIDTH} m"
            self.report.repaired("lane", lane.id, message, element.sourceline)
            lane.width = DEFAULT_WIDTH
        for name in ("type", "acceleration", "customShape"):
            xml.text(element, name, None)
        if edge.function == "crossing":
            xml.shape(element, "outlineShape")
        for child in element.findall("neigh"):
            lane.opposite = xml.text(child, "lane")
            self._done(child)
        self._ignore_children(element, "neigh", "stopOffset")
        edge.lanes.append(lane)
        self.lanes[lane.id] = lane
        self._done(element, count=False)

    def _lane_of(self, element: Any, edge_name: str, lane_name: str) -> _Lane:
        edge = self.edges.get(self.xml.text(element, edge_name))
        if edge is None:
            raise self.xml.error(element, f"there is no edge {edge_name}='{element.get(edge_name)}'")
        index = self.xml.integer(element, lane_name)
        if not 0 <= index < len(edge.lanes):
            raise self.xml.error(element, f"edge '{edge.id}' has no lane {lane_name}='{index}'")
        return edge.lanes[index]

    def _connection(self, element: Any) -> None:
        xml = self.xml
        via = xml.text(element, "via", None) or None
        if via is not None and via not in self.lanes:
            raise xml.error(element, f"there is no lane via='{via}'")
        light = xml.text(element, "tl", None) or None
        connection = _Connection(
            source=self._lane_of(element, "from", "fromLane"),
            target=self._lane_of(element, "to", "toLane"),
            element=element,
            turn=xml.choice(element, "dir", _TURNS),
            state=xml.text(element, "state"),
            via=self.lanes[via] if via else None,
            light=light,
            link=xml.integer(element, "linkIndex") if light else None,
            keep_clear=xml.flag(element, "keepClear", True),
            allowed=self._permissions(element),
        )
        if connection.state not in _CONTROLS:
            raise xml.error(element, f"state='{connection.state[:40]}' is none of {' '.join(_CONTROLS)}")
        if connection.link is not None and connection.link < 0:
            raise xml.error(element, "linkIndex is negative")
        xml.text(element, "uncontrolled", None)  # the light of the junction leaves it alone: it has no tl
        if connection.via is None and connection.allowed != VEHICLE_CLASSES:
            message = "no lane inside the junction that could carry its permissions"
            self.report.approximated("connection", _name(element), message, element.sourceline)
            self._done(element, count=False)
        else:
            self._done(element)
        connection.source.outgoing.append(connection)
        self._ignore_children(element)

    # ---- signal programs

    def read_additional(self, path: str | Path) -> None:
        """Take the signal programs of an additional file."""
        for xml, element in stream_xml(path, DEMAND_ROOTS, self.report):
            if element.tag == "tlLogic":
                self._program(xml, element)
            else:
                xml.ignore(element, "not part of the road network; `read_demand` reads demand")

    def _program(self, xml: XmlFile, element: Any) -> None:
        light = xml.text(element, "id")
        name = xml.text(element, "programID", "")
        kind = xml.text(element, "type", "static")
        phases = tuple(self._phase(xml, child) for child in element if child.tag == "phase")
        for child in element:
            if child.tag != "phase":
                xml.ignore(child, "not used within <tlLogic>")
        offset_text = xml.text(element, "offset", "0")
        offset = 0.0 if offset_text == "begin" else xml.parse_number(element, "offset", offset_text)
        xml.count_unused(element)
        if not phases:
            if name in self.programs.get(light, {}):
                xml.ignore(element, "parameters for a program that is defined elsewhere")
                return
            raise xml.error(element, "the program has no phases")
        if len({len(phase.state) for phase in phases}) > 1:
            raise xml.error(element, "the states of its phases have different lengths")
        if any(i >= len(phases) or i < 0 for phase in phases for i in phase.next):
            raise xml.error(element, "a phase has a 'next' beyond the last phase")
        where = f"{light} program {name}"
        if offset_text == "begin":
            self.report.approximated("tlLogic", where, "offset 'begin' taken as 0", element.sourceline)
        elif kind not in {"static", "actuated"}:
            message = f"type '{kind}' is kept by name; its rule and parameters are not read"
            self.report.approximated("tlLogic", where, message, element.sourceline)
        else:
            self.report.read("tlLogic")
        known = self.programs.setdefault(light, {})
        if name in known:
            self.report.repaired("tlLogic", where, "defined twice; the later one is kept", element.sourceline)
            del known[name]
        program = Program(id=light, name=name, type=kind, offset=offset, phases=phases)
        known[name] = (xml, element, program)

    def _phase(self, xml: XmlFile, element: Any) -> Phase:
        state = xml.text(element, "state")
        if not state or set(state) - set("ryYGguosO"):
            raise xml.error(element, f"state='{state[:40]}' has letters other than r y Y G g u s o O")
        state = state.replace("Y", "y")  # yellow for a stream with priority: as yellow as the other

        def bound(name: str) -> float | None:  # SUMO writes -1 for 'none'
            value = xml.number(element, name, None)
            return value if value is not None and value >= 0 else None

        try:
            following = tuple(int(i) for i in xml.text(element, "next", "").split())
        except ValueError:
            raise xml.error(element, f"next='{element.get('next')[:40]}' is no list of phases") from None
        phase = Phase(
            duration=xml.number(element, "duration", minimum=0.0),
            state=state,
            min_duration=bound("minDur"),
            max_duration=bound("maxDur"),
            next=following,
            name=xml.text(element, "name", ""),
        )
        xml.count_unused(element)
        self.report.read("phase")
        return phase

    # ---- what follows from the elements

    def network(self, digest: str) -> Network:
        """Put the network together."""
        links = {
            junction: self._links(junction, element)
            for junction, element in self.junction_elements.items()
            if self.xml.text(element, "type") != "internal"
        }
        chains = {id(c): self._chain(c) for found in links.values() for c in found}
        self._place_inside(links, chains)
        lanes = self._lanes(chains)
        movements, junctions = self._movements(links, chains)
        programs = self._programs(movements)
        stop_lines, lights = self._stop_positions(movements, lanes)
        crosswalks = self._crosswalks(lanes)
        self._report_kinks(lanes)
        noted = {note.where for note in self.report.notes if note.element == "lane"}
        self.report.read("lane", len(lanes) - len(noted))
        self.xml.summarise()
        path = Path(self.xml.path)
        return Network(
            name=re.sub(r"(\.net)?\.xml(\.gz)?$", "", path.name),
            source=self.xml.path,
            file_hash=digest,
            format=f"SUMO {self.version}".strip(),
            geo_reference=self.geo_reference,
            lanes=lanes,
            roads={edge.id: self._road(edge) for edge in self.edges.values()},
            movements=movements,
            junctions=junctions,
            programs=programs,
            traffic_lights=lights,
            stop_lines=stop_lines,
            crosswalks=crosswalks,
            report=self.report,
        )

    def _road(self, edge: _Edge) -> Road:
        return Road(
            id=edge.id,
            name=edge.element.get("name", ""),
            type=edge.element.get("type", ""),
            length=edge.lanes[0].length,
            junction=edge.junction,
            left_hand=self.left_hand,
            priority=self.xml.integer(edge.element, "priority", -1),
            line=edge.element.sourceline,
        )

    def _links(self, junction: str, element: Any) -> list[_Connection]:
        """Connections across a junction in the order of its request indices: SUMO counts the connections
        of its incoming lanes one after the other, leaving out ways on and off walking areas."""
        links = []
        for lane_id in self.xml.text(element, "incLanes").split():
            lane = self.lanes.get(lane_id)
            if lane is None:
                raise self.xml.error(element, f"there is no incoming lane '{lane_id}'")
            if lane.edge.function == "internal":
                message = (
                    f"incoming lane '{lane_id}' is inside a junction: only for junctions of type 'internal'"
                )
                raise self.xml.error(element, message)
            from_area = lane.edge.function == "walkingarea"
            for connection in lane.outgoing:
                to = connection.target.edge.function
                if to == "internal":
                    message = f"leads to lane '{connection.target.id}' inside a junction: name it as 'via'"
                    raise self.xml.error(connection.element, message)
                if to != "walkingarea" and (not from_area or to == "crossing"):
                    links.append(connection)
        return links

    def _chain(self, connection: _Connection) -> tuple[_Lane, ...]:
        """The lanes inside the junction, in order: more than one where a vehicle may wait inside."""
        if connection.target.edge.function == "crossing":
            return (connection.target,)
        chain: list[_Lane] = []
        via = connection.via
        while via is not None:
            if via in chain:
                raise self.xml.error(connection.element, f"its via lanes run in a circle at '{via.id}'")
            chain.append(via)
            onward = [c for c in via.outgoing if c.target is connection.target]
            if not onward:
                message = f"lane '{via.id}' has no connection on to '{connection.target.id}'"
                raise self.xml.error(connection.element, message)
            via = onward[0].via
        return tuple(chain)

    def _place_inside(
        self, links: dict[str, list[_Connection]], chains: dict[int, tuple[_Lane, ...]]
    ) -> None:
        """Find the junction of every edge inside one."""
        for junction, found in links.items():
            for connection in found:
                for lane in chains[id(connection)]:
                    lane.edge.junction = junction
            element = self.junction_elements[junction]
            for lane_id in self.xml.text(element, "intLanes", "").split():
                if lane_id not in self.lanes:
                    raise self.xml.error(element, f"there is no internal lane '{lane_id}'")
                self.lanes[lane_id].edge.junction = junction
        for edge in self.edges.values():
            if edge.function in {"internal", "crossing", "walkingarea"} and edge.junction is None:
                stem = edge.id.removeprefix(":").rpartition("_")[0]
                if stem in links:
                    edge.junction = stem
                else:
                    message = "inside a junction, but no junction names it"
                    self.report.approximated("edge", edge.id, message, edge.element.sourceline)

    # ---- lanes

    def _lanes(self, chains: dict[int, tuple[_Lane, ...]]) -> dict[str, Lane]:
        curves = self._curves(chains)
        onward = {
            lane.id: tuple(dict.fromkeys((c.via or c.target).id for c in lane.outgoing))
            for lane in self.lanes.values()
        }
        back: dict[str, list[str]] = defaultdict(list)
        for lane_id, targets in onward.items():
            for target in targets:
                back[target].append(lane_id)
        result = {}
        for edge in self.edges.values():
            sampled = []
            for curve, lo, hi, _ in (curves[lane.id] for lane in edge.lanes):
                at = curve.samples(lo, hi)
                sampled.append((at - lo, *curve.at(at)))
            middle = sampled[len(sampled) // 2][:3]
            for lane, (s, xy, heading, curvature) in zip(edge.lanes, sampled, strict=True):
                z = np.interp(s, curves[lane.id][3], lane.points[:, 2])
                road_s = self._along_road(edge, middle, s, xy)
                left, right = self._neighbours(lane)
                result[lane.id] = Lane(
                    id=lane.id,
                    road=edge.id,
                    number=lane.index,
                    type=self._lane_type(lane),
                    s=s,
                    xyz=np.column_stack([xy, z]),
                    heading=heading,
                    curvature=curvature,
                    width=np.full(len(s), lane.width),
                    road_s=road_s,
                    declared_length=lane.length,
                    speed_limit=lane.speed,
                    access=self._access(lane),
                    successors=onward[lane.id],
                    predecessors=tuple(back[lane.id]),
                    left=left.id if left else None,
                    right=right.id if right else None,
                    may_change_left=self._may_change(lane, left, lane.change_left),
                    may_change_right=self._may_change(lane, right, lane.change_right),
                    opposite=self._opposite(lane),
                    junction=edge.junction,
                )
        return result

    def _report_kinks(self, lanes: dict[str, Lane]) -> None:
        """Report where lanes that meet do so at an angle: the file has them so, and no lane can mend it."""
        kinks = []
        for lane in lanes.values():
            for other in (lanes[target] for target in lane.successors):
                if self.edges[lane.road].function in _DRIVEN and self.edges[other.road].function in _DRIVEN:
                    meet = np.hypot(*(other.xyz[0] - lane.xyz[-1])[:2]) < 0.1
                    angle = abs(math.degrees(_wrap(other.heading[0] - lane.heading[-1])))
                    if meet and angle > KINK:
                        kinks.append((angle, lane.id, other.id))
        if kinks:
            angle, lane_id, other_id = max(kinks)
            message = f"{len(kinks)} joints have kinks of more than {KINK:g} degrees, up to {angle:.1f}"
            self.report.approximated("lane@joint", f"{lane_id} to {other_id}", message)

    def _access(self, lane: _Lane) -> frozenset[str]:
        """Classes of SUMO by their names, and those of the engine that go by other names."""
        extra = {ENGINE_CLASS[c] for c in ("passenger", "delivery") if c in lane.allowed}
        return lane.allowed | extra

    def _lane_type(self, lane: _Lane) -> LaneType:
        allowed = lane.allowed
        if lane.edge.function in {"crossing", "walkingarea"}:
            return LaneType.SIDEWALK
        if lane.edge.function == "connector":
            return LaneType.NONE  # joins a district to the net; nobody drives on it
        if not allowed:  # nets made from OpenDRIVE still say what it was
            kind = lane.element.get("type", "")
            return LaneType(kind) if kind in _UNUSED_TYPES else LaneType.NONE
        if allowed & _MOTOR:
            entry = self.xml.flag(lane.element, "acceleration")
            return LaneType.ENTRY if entry else LaneType.DRIVING
        for classes, kind in _TYPE_OF_CLASSES:
            if allowed & classes:
                return kind
        return LaneType.SPECIAL

    def _neighbours(self, lane: _Lane) -> tuple[_Lane | None, _Lane | None]:
        """Left and right. Index 0 lies at the edge of the road: on the left with left-hand traffic."""
        if lane.edge.function not in _DRIVEN:
            return None, None
        lanes = lane.edge.lanes
        inner = lanes[lane.index + 1] if lane.index + 1 < len(lanes) else None
        outer = lanes[lane.index - 1] if lane.index else None
        return (outer, inner) if self.left_hand else (inner, outer)

    def _may_change(self, lane: _Lane, other: _Lane | None, granted: frozenset[str]) -> bool:
        """Whether ordinary motor vehicles may change to a neighbour; `granted`: whom `lane` lets do so."""
        if other is None:
            return False
        common = lane.allowed & other.allowed & ENGINE_CLASS.keys()
        ordinary = common - _SPECIAL_RIGHTS
        if granted & ordinary and ordinary - granted:
            message = f"only {_short(sorted(granted & ordinary))} may change to {other.id}; here all may"
            self.report.approximated("lane", lane.id, message, lane.element.sourceline)
        return bool(granted & (ordinary or common))  # lanes for those with special rights are theirs

    def _opposite(self, lane: _Lane) -> str | None:
        if lane.opposite is not None and lane.opposite not in self.lanes:
            raise self.xml.error(lane.element, f"there is no lane '{lane.opposite}' to be its neighbour")
        return lane.opposite

    def _curves(
        self, chains: dict[int, tuple[_Lane, ...]]
    ) -> dict[str, tuple[Curve, float, float, Float[Array, " K"]]]:
        """Per lane: a curve, the part of it that is the lane, and where on the lane its vertices are (m)."""
        curves: dict[str, tuple[Curve, float, float, Any]] = {}
        worst: dict[str, tuple[float, int, str]] = {}

        def add(lane: _Lane, curve: Curve, lo: float, hi: float, vertex_s: Any) -> None:
            curves[lane.id] = curve, lo, hi, np.clip(vertex_s - lo, 0.0, hi - lo)

        def note(lanes: tuple[_Lane, ...], curve: Curve) -> None:
            if curve.spikes:
                for lane in lanes:
                    message = f"the shape folds back on itself; {curve.spikes} points left out"
                    self.report.repaired("lane", lane.id, message, lane.element.sourceline)
            if curve.deviation > RESOLUTION:
                kind = lanes[0].edge.function
                deviation, count, where = worst.get(kind, (0.0, 0, ""))
                if curve.deviation > deviation:
                    deviation, where = curve.deviation, lanes[0].id
                worst[kind] = deviation, count + len(lanes), where

        self._compare_lengths()
        for lane in self.lanes.values():
            lane.points = self._clean(lane)
        for lane in self.lanes.values():
            if lane.edge.function != "internal":
                share = RESOLUTION if lane.edge.function == "walkingarea" else BEND_SHARE * lane.width
                curve = fit_polyline(lane.points, tolerance=share)
                add(lane, curve, 0.0, curve.total, curve.vertex_s)
                note((lane,), curve)
        # Inside junctions netconvert samples a curve that is tangent to the lanes at both ends, and cuts it
        # where vehicles wait: so the lanes of a movement are one curve.
        for connection in (c for lane in self.lanes.values() for c in lane.outgoing if id(c) in chains):
            chain = chains[id(connection)]
            if not chain or any(lane.edge.function != "internal" or lane.id in curves for lane in chain):
                continue
            gaps = [np.hypot(*(b.points[0] - a.points[-1])[:2]) for a, b in pairwise(chain)]
            joined = max(gaps, default=0.0) < 1.5 * RESOLUTION
            for lanes in [chain] if joined else [(lane,) for lane in chain]:
                parts = [lane.points if i == 0 else lane.points[1:] for i, lane in enumerate(lanes)]
                before, after = curves[connection.source.id], curves[connection.target.id]
                curve = fit_polyline(
                    np.concatenate(parts),
                    start_heading=float(before[0].heading_at(before[2])) if lanes[0] is chain[0] else None,
                    end_heading=float(after[0].heading_at(after[1])) if lanes[-1] is chain[-1] else None,
                )
                note(lanes, curve)
                first = 0
                for lane in lanes:
                    vertex_s = curve.vertex_s[first : first + len(lane.points)]
                    add(lane, curve, float(vertex_s[0]), float(vertex_s[-1]), vertex_s)
                    first += len(lane.points) - 1
        for lane in self.lanes.values():  # internal lanes that no movement uses
            if lane.id not in curves:
                curve = fit_polyline(lane.points)
                add(lane, curve, 0.0, curve.total, curve.vertex_s)
                note((lane,), curve)
        for kind, (deviation, count, where) in worst.items():
            message = f"arcs and lines for {count} polylines, which they leave by up to {deviation:.3f} m"
            self.report.approximated("lane@shape", f"{kind} lanes, worst {where}", message)
        return curves

    def _compare_lengths(self) -> None:
        """Report declared lengths that differ from those of the shapes by more than 1 % and 0.1 m.

        The lanes of an edge share one length: netconvert writes the mean of their shapes.
        """
        parallel: list[tuple[float, str]] = []
        for edge in self.edges.values():
            if edge.function == "walkingarea":
                continue
            sizes = [float(np.linalg.norm(np.diff(lane.points, axis=0), axis=1).sum()) for lane in edge.lanes]
            mean = sum(sizes) / len(sizes)
            for lane, size in zip(edge.lanes, sizes, strict=True):
                limit = max(0.01 * lane.length, 0.1)
                if abs(mean - lane.length) > limit:
                    message = f"declared length {lane.length:.2f} m, but the shape is {size:.2f} m long"
                    self.report.approximated("lane@length", lane.id, message, lane.element.sourceline)
                elif abs(size - lane.length) > limit:
                    parallel.append((abs(size - lane.length), lane.id))
        if parallel:
            worst, where = max(parallel)
            message = f"{len(parallel)} lanes in bends differ from their edge's length by up to {worst:.2f} m"
            self.report.approximated("lane@length", f"lane {where}", message)

    def _clean(self, lane: _Lane) -> Float[Array, "K 3"]:
        """The shape without repeated points; a shape without extent becomes 1 cm long."""
        line = lane.element.sourceline
        points = lane.points
        if not len(points):
            raise self.xml.error(lane.element, "the shape is empty")
        step = np.hypot(*np.diff(points[:, :2], axis=0).T)
        keep = np.append(True, step > 1e-6)
        if not keep.all():
            message = f"{(~keep).sum()} repeated points in its shape left out"
            self.report.repaired("lane", lane.id, message, line)
            points = points[keep]
        if len(points) == 1:
            heading = self._heading_around(lane)
            self.report.repaired("lane", lane.id, "the shape has no extent; made 1 cm long", line)
            step_on = RESOLUTION * np.array([np.cos(heading), np.sin(heading), 0.0])
            points = np.stack([points[0], points[0] + step_on])
        return points

    def _heading_around(self, lane: _Lane) -> float:
        """Direction of the lanes before or after a lane whose own shape has none."""
        lanes = self.lanes.values()
        sources = [other.points[-2:] for other in lanes for c in other.outgoing if c.via is lane]
        targets = [(c.via or c.target).points[:2] for c in lane.outgoing]
        for points in sources + targets:
            if len(points) == 2 and np.hypot(*(points[1] - points[0])[:2]) > 1e-6:
                return float(np.arctan2(*(points[1] - points[0])[1::-1]))
        return 0.0

    def _along_road(
        self, edge: _Edge, middle: tuple[Array, Array, Array], s: Array, xy: Array
    ) -> Float[Array, " M"]:
        """Coordinate along the edge (m) of the samples of a lane: that of the middle lane abreast of them.

        `middle` is its s, xy and heading. Where a lane reaches beyond the ends of the middle one, the
        coordinate goes on below 0 or above the length of the edge.
        """
        s_ref, xy_ref, heading_ref = middle
        scale = edge.lanes[0].length / s_ref[-1]
        if s is s_ref:
            return s * scale
        p, start = xy @ (1, 1j), xy_ref[:-1] @ (1, 1j)
        chord = np.diff(xy_ref @ (1, 1j))
        offset = p[:, None] - start
        u = (offset * (chord.conj() / np.abs(chord) ** 2)).real
        inside = np.clip(u, 0.0, 1.0)
        s_near = s_ref[:-1] + inside * np.diff(s_ref)
        # Where the edge runs past itself the nearest point may be on another stretch of it.
        expected = s * (s_ref[-1] / s[-1])
        far = np.abs(s_near - expected[:, None]) > 20.0 + 0.1 * s_ref[-1]
        distance = np.where(far, np.inf, np.abs(offset - inside * chord))
        found = s_near[np.arange(len(p)), distance.argmin(1)]
        for end, beyond in ((0, -1.0), (-1, 1.0)):  # tangents carry the middle lane on at both ends
            tangent = np.exp(1j * heading_ref[end])
            ahead = ((p - xy_ref[end] @ (1, 1j)) * tangent.conjugate()).real
            outside = (found == s_ref[end]) & (beyond * ahead > 0)
            found = np.where(outside, found + ahead, found)
        rising = np.maximum.accumulate(found)
        return rising * scale

    # ---- junctions

    def _movements(
        self, links: dict[str, list[_Connection]], chains: dict[int, tuple[_Lane, ...]]
    ) -> tuple[tuple[Movement, ...], dict[str, Junction]]:
        movements: list[Movement] = []
        junctions = {}
        dark: set[str] = set()
        inside: dict[str, list[str]] = defaultdict(list)
        for edge in self.edges.values():
            if edge.junction is not None:
                inside[edge.junction] += [lane.id for lane in edge.lanes]
        for element in self.junction_elements.values():
            if element.get("type") == "internal":  # where vehicles wait: the chains of via lanes say so
                for name in ("type", "x", "y", "z", "incLanes", "intLanes", "shape"):
                    self.xml.text(element, name, "")
                self._ignore_children(element)
                self._done(element)
        for junction, found in links.items():
            element = self.junction_elements[junction]
            requests = self._requests(element, len(found))
            base = len(movements)
            for i, connection in enumerate(found):
                response, foes, cont = requests[i] if requests else ("", "", False)
                chain = chains[id(connection)]
                outgoing = connection.target
                if outgoing.edge.function == "crossing":  # pedestrians: on to the far side
                    onward = [c.target for c in outgoing.outgoing]
                    outgoing = onward[0] if onward else outgoing
                light = connection.light
                if light is not None and light not in self.programs:
                    if light not in dark:
                        dark.add(light)
                        message = "has no program; its links are controlled as if the light were off"
                        self.report.approximated("tlLogic", light, message, connection.element.sourceline)
                    light = None
                movements.append(
                    Movement(
                        index=base + i,
                        junction=junction,
                        incoming=connection.source.id,
                        outgoing=outgoing.id,
                        via=tuple(lane.id for lane in chain if lane is not outgoing),
                        turn=connection.turn,
                        control=Control.SIGNAL if light is not None else _CONTROLS[connection.state],
                        program=light,
                        link=connection.link if light is not None else None,
                        yields_to=frozenset(base + j for j in _bits(response)),
                        foes=frozenset(base + j for j in _bits(foes)),
                        waits_inside=cont,
                        keep_clear=connection.keep_clear,
                    )
                )
            outline = self.xml.shape(element, "shape")
            self.xml.number(element, "z", 0.0)
            junctions[junction] = Junction(
                id=junction,
                name=self.xml.text(element, "name", ""),
                type=self.xml.text(element, "type"),
                movements=tuple(range(base, len(movements))),
                connectors=tuple(inside[junction]),
                center=(self.xml.number(element, "x"), self.xml.number(element, "y")),
                outline=tuple((float(x), float(y)) for x, y, _ in outline),
                roundabout=junction in self.roundabouts,
            )
            self._ignore_children(element, "request")
            self._done(element)
        self._count_left_out(links)
        return tuple(movements), junctions

    def _count_left_out(self, links: dict[str, list[_Connection]]) -> None:
        """Report connections between lanes outside junctions that no junction lists."""
        listed = {id(c) for found in links.values() for c in found}
        for lane in self.lanes.values():
            for c in lane.outgoing:
                if id(c) not in listed and lane.edge.function == c.target.edge.function == "normal":
                    message = "from a lane that is incoming to no junction; kept as a successor only"
                    self.report.approximated("connection", _name(c.element), message, c.element.sourceline)

    def _requests(self, element: Any, count: int) -> list[tuple[str, str, bool]]:
        """Response bits, foe bits and `cont` per link; empty if the junction has none."""
        rows: dict[int, tuple[str, str, bool]] = {}
        for child in element.findall("request"):
            index = self.xml.integer(child, "index")
            response, foes = self.xml.text(child, "response"), self.xml.text(child, "foes")
            if index in rows:
                raise self.xml.error(child, f"junction '{element.get('id')}' has a second request {index}")
            for name, bits in (("response", response), ("foes", foes)):
                if set(bits) - {"0", "1"}:
                    raise self.xml.error(child, f"{name}='{bits[:40]}' has letters other than 0 and 1")
                if len(bits) != count:
                    message = (
                        f"{len(bits)} bits of {name}, but junction '{element.get('id')}' has {count} links"
                    )
                    raise self.xml.error(child, message)
            itself = index in _bits(response) or index in _bits(foes)
            if itself:
                message = f"link {index} was its own foe; left out"
                self.report.repaired("request", element.get("id"), message, child.sourceline)
                at = count - 1 - index  # the last letter is index 0
                response, foes = (f"{bits[:at]}0{bits[at + 1 :]}" for bits in (response, foes))
            rows[index] = response, foes, self.xml.flag(child, "cont")
            self._done(child, count=not itself)
        if not rows:
            if count and element.get("type") not in {"dead_end", "unregulated", "district", "rail_signal"}:
                message = f"no requests for its {count} links: nobody has to yield"
                self.report.approximated("junction", element.get("id"), message, element.sourceline)
            return []
        if sorted(rows) != list(range(count)):
            raise self.xml.error(element, f"{len(rows)} requests for {count} links")
        return [rows[i] for i in range(count)]

    def _programs(self, movements: tuple[Movement, ...]) -> dict[str, Program]:
        links: dict[str, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
        for movement in movements:
            if movement.program is not None and movement.link is not None:
                links[movement.program][movement.link].append(movement.index)
        result = {}
        for light, known in self.programs.items():
            in_use = next(reversed(known))
            for name, (xml, element, program) in known.items():
                size = len(program.phases[0].state)
                if links[light] and max(links[light]) >= size:
                    message = f"its states have {size} letters, but it controls link {max(links[light])}"
                    raise xml.error(element, message)
                controlled = tuple(tuple(links[light][i]) for i in range(size))
                key = light if name == in_use else f"{light}:{name}"
                result[key] = replace(program, id=key, movements=controlled)
            if len(known) > 1:
                others = _short(f"'{name}'" for name in known if name != in_use)
                message = f"program '{in_use}', loaded last, is in use; kept beside it: {others}"
                self.report.approximated("tlLogic", light, message, known[in_use][1].sourceline)
        return result

    def _stop_positions(
        self, movements: tuple[Movement, ...], lanes: dict[str, Lane]
    ) -> tuple[tuple[StopLine, ...], tuple[TrafficLight, ...]]:
        """Stop lines and light heads at the ends of lanes, where SUMO has them."""
        regulated = {Control.SIGNAL, Control.STOP, Control.ALL_WAY_STOP, Control.YIELD}
        stop_lines: dict[str, StopLine] = {}
        lights: dict[tuple[str, str], TrafficLight] = {}
        for movement in movements:
            source, lane = self.lanes[movement.incoming], lanes[movement.incoming]
            if source.edge.function == "walkingarea":
                continue
            offset = source.stop_offset * (lane.length / source.length if source.length > 0 else 1.0)
            spot = LaneSpot(lane=lane.id, s=max(lane.length - offset, 0.0))
            if movement.control in regulated or offset > 0:
                stop_lines[lane.id] = StopLine(id=lane.id, spot=spot, line=source.element.sourceline)
            if movement.program is not None:
                xyz, heading = lane.pose(spot.s)
                lights[movement.program, lane.id] = TrafficLight(
                    id=f"{movement.program}:{lane.id}",
                    position=(float(xyz[0]), float(xyz[1]), float(xyz[2])),
                    heading=float(heading),
                    spots=(spot,),
                    controller=movement.program,
                    line=source.element.sourceline,
                )
        return tuple(stop_lines.values()), tuple(lights.values())

    def _crosswalks(self, lanes: dict[str, Lane]) -> tuple[Crosswalk, ...]:
        crosswalks = []
        inside: dict[str | None, list[Lane]] = defaultdict(list)
        for lane in lanes.values():
            if self.edges[lane.road].function == "internal":
                inside[lane.junction].append(lane)
        for edge in self.edges.values():
            if edge.function != "crossing":
                continue
            source, lane = edge.lanes[0], lanes[edge.lanes[0].id]
            outline = self.xml.shape(source.element, "outlineShape")[:, :2]
            if len(outline) < 3:
                side = np.stack([-np.sin(lane.heading), np.cos(lane.heading)], -1) * lane.width[:, None] / 2
                outline = np.concatenate([lane.xyz[:, :2] + side, (lane.xyz[:, :2] - side)[::-1]])
            crossed = self.xml.text(edge.element, "crossingEdges", "").split()
            near = inside[edge.junction] + [
                lanes[x.id] for road in crossed if road in self.edges for x in self.edges[road].lanes
            ]
            spans = [(other.id, lo, hi) for other in near for lo, hi in _spans(other, outline)]
            crosswalks.append(
                Crosswalk(id=edge.id, outline=outline, spans=tuple(spans), line=edge.element.sourceline)
            )
        return tuple(crosswalks)


def _name(connection: Any) -> str:
    get = connection.get
    return f"from {get('from')}_{get('fromLane')} to {get('to')}_{get('toLane')}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _bits(text: str) -> Iterator[int]:
    """Indices of the ones in a bit string whose last letter is index 0."""
    return (i for i, bit in enumerate(reversed(text)) if bit == "1")


def _spans(lane: Lane, outline: Float[Array, "K 2"]) -> list[tuple[float, float]]:
    """Arc lengths (m) between which the centre line of a lane is inside a polygon."""
    s = np.union1d(lane.s, np.linspace(0.0, lane.length, max(2, math.ceil(lane.length / 0.5) + 1)))
    xy = lane.pose(s)[0][:, :2]
    a, da = xy[:-1, None], np.diff(xy, axis=0)[:, None]
    b = outline[None]
    db = np.roll(outline, -1, axis=0)[None] - b
    cross = da[..., 0] * db[..., 1] - da[..., 1] * db[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = b - a
        u = (offset[..., 0] * db[..., 1] - offset[..., 1] * db[..., 0]) / cross  # along the lane
        v = (offset[..., 0] * da[..., 1] - offset[..., 1] * da[..., 0]) / cross  # along the outline
        hit = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    i, j = np.nonzero(hit)
    cuts = np.concatenate([[0.0], np.sort(s[i] + u[i, j] * (s[i + 1] - s[i])), [lane.length]])
    middle = lane.pose((cuts[1:] + cuts[:-1]) / 2)[0][:, :2]
    border = np.concatenate([outline, outline[:1]])
    spans: list[tuple[float, float]] = []
    for lo, hi, point in zip(cuts[:-1], cuts[1:], middle, strict=True):
        grazing = distance_to_polyline(point[None], border)[0] < 0.05  # along the border, not across it
        if hi - lo > 1e-6 and not grazing and _inside(point, outline):
            if spans and abs(spans[-1][1] - lo) < 1e-6:
                lo = spans.pop()[0]
            spans.append((float(lo), float(hi)))
    return spans


def _inside(point: Float[Array, " 2"], outline: Float[Array, "K 2"]) -> bool:
    """Whether a point is in a polygon: an odd number of its edges lie to the right of it."""
    a, b = outline, np.roll(outline, -1, axis=0)
    straddles = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    a, b = a[straddles], b[straddles]
    x = a[:, 0] + (point[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool(np.count_nonzero(x > point[0]) % 2)
