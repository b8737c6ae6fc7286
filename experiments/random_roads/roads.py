"""Roads in the making: reference lines, lanes of changing width, ends.

Everything is built for right-hand traffic; `writer` mirrors the whole file for the other side.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from mapbuilder.curves import Curve, Pose

if TYPE_CHECKING:
    from random_roads.junctions import Junction

Cubic = tuple[float, float, float, float]

DRIVABLE = frozenset({"driving", "entry", "exit", "onRamp", "offRamp"})
"""Types of lanes for motor traffic."""


class Cubics:
    """A reference line of parametric cubics from pose to pose.

    It is `split` into equal shares of its parameter. `by_length`: records count the parameter in metres.
    """

    def __init__(self, start: Pose, end: Pose, *, tension: float, split: int, by_length: bool) -> None:
        self.start, self.end, self.by_length = start, end, by_length
        ahead, left = start.local(end)
        turn = math.remainder(end.heading - start.heading, 2 * math.pi)
        chord = math.hypot(ahead, left)
        # the tangents of a cubic that is close to the arc with this chord
        pull = tension * chord * 2 / (1 + math.cos(min(abs(turn), 2.6) / 2))
        x = np.array(
            [0, pull, 3 * ahead - pull * (2 + math.cos(turn)), pull * (1 + math.cos(turn)) - 2 * ahead]
        )
        y = np.array([0, 0, 3 * left - pull * math.sin(turn), pull * math.sin(turn) - 2 * left])
        self.parts: list[tuple[Pose, float, np.ndarray, np.ndarray]] = []
        for k in range(split):
            p0, p1 = k / split, (k + 1) / split
            cx, cy = (_restricted(c, p0, p1 - p0) for c in (x, y))
            at = start.move(ahead=float(cx[0]), left=float(cy[0]))
            heading = math.atan2(cy[1], cx[1])
            u, v = _turned(cx, cy, -heading)
            u[0] = v[0] = v[1] = 0.0
            pose = Pose(at.x, at.y, at.heading + heading)
            self.parts.append((pose, _length(u, v), u, v))
        self.length = round(sum(part[1] for part in self.parts), 6)

    def pose(self, s: float) -> Pose:
        """The pose near arc length `s`; exact at both ends."""
        if s >= self.length - 1e-6:
            return self.end
        for pose, length, u, v in self.parts:
            if s <= length:
                p = s / length
                slope = math.atan2(_value(_slope(v), p), _value(_slope(u), p))
                return pose.move(ahead=_value(u, p), left=_value(v, p), turn=slope)
            s -= length
        return self.end

    def sharpest(self) -> tuple[float, float]:
        """Least and largest curvature, 1/m, positive to the left."""
        found = []
        for _, _, u, v in self.parts:
            p = np.linspace(0, 1, 33)
            slopes = _slope(u), _slope(v)
            du, dv = (np.polynomial.Polynomial(c)(p) for c in slopes)
            ddu, ddv = (np.polynomial.Polynomial(_slope(c))(p) for c in slopes)
            found.append((du * ddv - dv * ddu) / np.maximum(np.hypot(du, dv), 1e-6) ** 3)
        return float(np.min(found)), float(np.max(found))


def _restricted(c: np.ndarray, begin: float, share: float) -> np.ndarray:
    """Coefficients of a cubic on a part of its parameter.

    The parameter runs from 0 to 1 there.
    """
    part = np.polynomial.Polynomial(c)(np.polynomial.Polynomial([begin, share])).coef
    return np.pad(part, (0, 4 - len(part)))


def _turned(u: np.ndarray, v: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    c, s = math.cos(angle), math.sin(angle)
    return u * c - v * s, u * s + v * c


def _slope(c: np.ndarray) -> np.ndarray:
    return c[1:] * np.arange(1, len(c))


def _value(c: np.ndarray, p: float) -> float:
    return float(np.polynomial.Polynomial(c)(p))


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def _length(u: np.ndarray, v: np.ndarray) -> float:
    p = (_NODES + 1) / 2
    speed = np.hypot(np.polynomial.Polynomial(_slope(u))(p), np.polynomial.Polynomial(_slope(v))(p))
    return float(_WEIGHTS @ speed / 2)


Line = Curve | Cubics


class Steps:
    """A quantity along a road: constant but for linear or cubic tapers between knots `(s, value)`."""

    def __init__(self, *knots: tuple[float, float], smooth: bool = True) -> None:
        self.knots = tuple((round(s, 6), v) for s, v in sorted(knots))
        self.smooth = smooth

    def cubic(self, s: float) -> Cubic:
        """Coefficients of the cubic that holds from `s` on."""
        for (s0, v0), (s1, v1) in zip(self.knots, self.knots[1:], strict=False):
            if s0 <= s < s1:
                length, rise, u = s1 - s0, v1 - v0, (s - s0) / (s1 - s0)
                if not self.smooth:
                    return v0 + rise * u, rise / length, 0.0, 0.0
                return (
                    v0 + rise * u * u * (3 - 2 * u),
                    6 * rise * u * (1 - u) / length,
                    3 * rise * (1 - 2 * u) / length**2,
                    -2 * rise / length**3,
                )
        return (self.knots[0][1] if s < self.knots[0][0] else self.knots[-1][1]), 0.0, 0.0, 0.0

    def __call__(self, s: float) -> float:
        """The value at `s`."""
        return self.cubic(s)[0]

    def records(self, begin: float, end: float) -> Iterator[tuple[float, Cubic]]:
        """(s, cubic) from `begin` up to `end`."""
        for s in [begin, *(k for k, _ in self.knots if begin + 1e-6 < k < end - 1e-6)]:
            yield s, self.cubic(s)

    def mirrored(self, length: float) -> Steps:
        """The same, measured from the other end."""
        return Steps(*((length - s, v) for s, v in self.knots), smooth=self.smooth)

    def borders(self) -> list[float]:
        """Places at which the value becomes or leaves zero."""
        pairs = zip(self.knots, self.knots[1:], strict=False)
        return [(s0 if v0 == 0 else s1) for (s0, v0), (s1, v1) in pairs if (v0 == 0) != (v1 == 0)]


class Strip(NamedTuple):
    """A lane along a whole road; it is there where its width is above zero."""

    width: Steps
    kind: str = "driving"
    speed: float | None = None  # km/h; None: that of the road


@dataclass(eq=False)
class Road:
    """A road. Strips are listed from the middle outwards."""

    id: int
    name: str
    line: Line
    right: list[Strip]
    left: list[Strip] = field(default_factory=list)
    kind: str = "town"
    speed: float = 50.0  # km/h
    offset: Steps = field(default_factory=lambda: Steps((0, 0)))
    height: Steps = field(default_factory=lambda: Steps((0, 0)))
    breaks: Sequence[float] = ()  # further borders of lane sections
    marks: str = "broken"  # between lanes of a direction
    junction: Junction | None = None
    ends: dict[str, Contact | Junction] = field(default_factory=dict)
    joined: dict[tuple[str, int], int] = field(default_factory=dict)  # lanes beyond, of connecting roads
    signals: list[dict[str, str]] = field(default_factory=list)

    @property
    def length(self) -> float:
        """Of the reference line, m."""
        return self.line.length

    @property
    def start(self) -> Contact:
        """Its first end."""
        return Contact(self, "start")

    @property
    def end(self) -> Contact:
        """Its last end."""
        return Contact(self, "end")

    def sections(self) -> list[tuple[float, float]]:
        """Begin and end of each lane section."""
        cuts = {0.0, *self.breaks, *(s for x in self.right + self.left for s in x.width.borders())}
        kept = sorted(round(s, 6) for s in cuts if 0 <= s < self.length - 1e-3)
        return list(zip(kept, [*kept[1:], self.length], strict=True))

    def numbers(self, section: int) -> dict[int, Strip]:
        """Strips of a lane section by lane number."""
        begin, end = self.sections()[section]
        middle = (begin + end) / 2
        found = {}
        for sign, strips in ((-1, self.right), (1, self.left)):
            there = [x for x in strips if x.width(middle) > 0]
            found |= {sign * (i + 1): x for i, x in enumerate(there)}
        return found

    def reach(self, s: float) -> tuple[float, float]:
        """Lateral places of the right and the left border, m."""
        shift = self.offset(s)
        return shift - sum(x.width(s) for x in self.right), shift + sum(x.width(s) for x in self.left)


class Contact(NamedTuple):
    """One end of a road."""

    road: Road
    at: str  # start or end

    @property
    def s(self) -> float:
        """Where it is."""
        return 0.0 if self.at == "start" else self.road.length

    def lanes(self) -> dict[int, Strip]:
        """All lanes there by number."""
        return self.road.numbers(0 if self.at == "start" else -1)

    def leaving(self) -> list[int]:
        """Lanes of traffic that leaves the road here, from the middle outwards."""
        sign = -1 if self.at == "end" else 1
        return sorted((n for n, x in self.lanes().items() if n * sign > 0 and x.kind in DRIVABLE), key=abs)

    def entering(self) -> list[int]:
        """Lanes of traffic that comes in here, from the middle outwards."""
        sign = 1 if self.at == "end" else -1
        return sorted((n for n, x in self.lanes().items() if n * sign > 0 and x.kind in DRIVABLE), key=abs)

    def width(self, number: int) -> float:
        """Of a lane, m."""
        return self.lanes()[number].width(self.s)

    def inner_edge(self, number: int) -> Pose:
        """The inner edge of a lane, heading with its traffic."""
        inside = sum(self.width(n) for n in self.lanes() if n * number > 0 and abs(n) < abs(number))
        t = self.road.offset(self.s) + math.copysign(inside, number)
        pose = self.road.line.pose(self.s).move(left=t)
        return pose if number < 0 else pose.move(turn=math.pi)

    def outwards(self) -> Pose:
        """The end, heading away from the road."""
        pose = self.road.line.pose(self.s)
        return pose if self.at == "end" else pose.move(turn=math.pi)
