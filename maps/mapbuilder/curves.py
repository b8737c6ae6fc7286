"""Curves and profiles of roads: lines, arcs, clothoids, smoothsteps."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

# A lane that opens or closes gets a section border where it is this wide: narrower is paint, not a
# lane to drive on. It is also where SUMO's netconvert begins a lane (its default `min-width`).
NARROWEST = 1.8


class Pose(NamedTuple):
    """A point with a heading."""

    x: float
    y: float
    heading: float

    def move(self, ahead: float = 0.0, left: float = 0.0, turn: float = 0.0) -> Pose:
        """The pose this far ahead and to the left, then turned counter-clockwise."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose(self.x + ahead * c - left * s, self.y + ahead * s + left * c, self.heading + turn)

    def local(self, other: Pose) -> tuple[float, float]:
        """Where `other` lies: (ahead, left)."""
        dx, dy = other.x - self.x, other.y - self.y
        c, s = math.cos(self.heading), math.sin(self.heading)
        return dx * c + dy * s, dy * c - dx * s


class Piece(NamedTuple):
    """Line, arc or clothoid: curvature runs linearly from `k0` to `k1`."""

    length: float
    k0: float = 0.0
    k1: float = 0.0


NODES, WEIGHTS = (tuple(float(v) for v in a) for a in np.polynomial.legendre.leggauss(12))


def advance(pose: Pose, piece: Piece) -> Pose:
    """The end of a piece that starts at `pose`."""
    length, k0, k1 = piece
    turn = 0.5 * (k0 + k1) * length
    if k0 == k1:
        # chord of the arc; its direction is the mean heading
        chord = length if k0 == 0 else 2 * math.sin(turn / 2) / k0
        end = pose.move(turn=turn / 2).move(ahead=chord)
        return Pose(end.x, end.y, pose.heading + turn)
    panels = 1 + math.ceil(max(abs(k0), abs(k1)) * length)
    x, y = pose.x, pose.y
    for i in range(panels):
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            s = (i + 0.5 + 0.5 * node) * length / panels
            heading = pose.heading + k0 * s + 0.5 * (k1 - k0) * s * s / length
            x += 0.5 * weight * length / panels * math.cos(heading)
            y += 0.5 * weight * length / panels * math.sin(heading)
    return Pose(x, y, pose.heading + turn)


class Curve:
    """A reference line: pieces one after another."""

    def __init__(self, start: Pose, pieces: Sequence[Piece]) -> None:
        kept: list[Piece] = []
        for length, k0, k1 in pieces:
            if kept and k0 == k1 == kept[-1].k0 == kept[-1].k1:
                kept[-1] = Piece(round(kept[-1].length + length, 6), k0, k1)
            elif length > 1e-4:
                kept.append(Piece(round(length, 6), k0, k1))
        self.start = start
        self.pieces = tuple(kept)
        self.length = round(sum(p.length for p in self.pieces), 6)

    def records(self) -> Iterator[tuple[float, Pose, Piece]]:
        """Start along the curve, first pose and piece, for each piece."""
        s, pose = 0.0, self.start
        for piece in self.pieces:
            yield round(s, 6), pose, piece
            s, pose = s + piece.length, advance(pose, piece)

    def pose(self, s: float) -> Pose:
        """The pose at arc length `s`."""
        last = None
        for last in self.records():
            if s <= last[0] + last[2].length:
                break
        assert last is not None
        at, pose, (length, k0, k1) = last
        u = s - at
        return advance(pose, Piece(u, k0, k0 + (k1 - k0) * u / length)) if u else pose

    @property
    def end(self) -> Pose:
        """The last pose."""
        return self.pose(self.length)

    def cut(self, s0: float, s1: float) -> Curve:
        """The stretch between two arc lengths."""
        pieces = []
        for at, _, (length, k0, k1) in self.records():
            a, b = max(s0 - at, 0.0), min(s1 - at, length)
            if b > a:
                slope = (k1 - k0) / length
                pieces.append(Piece(b - a, k0 + slope * a, k0 + slope * b))
        return Curve(self.pose(s0), pieces)

    def reversed(self) -> Curve:
        """The same line, run the other way."""
        back = [Piece(p.length, -p.k1, -p.k0) for p in reversed(self.pieces)]
        return Curve(self.end.move(turn=math.pi), back)


def wrap(angle: float) -> float:
    """The angle in [-pi, pi]."""
    return math.remainder(angle, 2 * math.pi)


def arc(radius: float, degrees: float, clothoid: float) -> list[Piece]:
    """Clothoid, arc, clothoid that turn by `degrees` (left positive) in all."""
    k = math.copysign(1 / radius, degrees)
    length = abs(math.radians(degrees)) * radius - clothoid
    return [Piece(clothoid, 0, k), Piece(length, k, k), Piece(clothoid, k, 0)]


def bend(angle: float, tangent: float) -> list[Piece]:
    """A clothoid-arc-clothoid turn by `angle`.

    Its legs to the corner are `tangent` long. A quarter of the angle falls to the clothoids. All such
    turns are similar: the unit one is scaled.
    """
    if abs(angle) < 1e-9:
        return [Piece(2 * tangent)]
    k, quarter = math.copysign(1.0, angle), abs(angle) / 4
    unit = [Piece(quarter, 0, k), Piece(3 * quarter, k, k), Piece(quarter, k, 0)]
    end = functools.reduce(advance, unit, Pose(0, 0, 0))
    radius = tangent / (end.x - end.y / math.tan(angle))
    return [Piece(p.length * radius, p.k0 / radius, p.k1 / radius) for p in unit]


def join(a: Pose, b: Pose) -> Curve:
    """A smooth curve from `a` to `b`.

    It has one bend if the legs allow it, otherwise two of opposite sense.
    """
    ahead, left = a.local(b)
    angle = wrap(b.heading - a.heading)
    if abs(math.sin(angle)) > 1e-6:
        second = left / math.sin(angle)
        first = ahead - second * math.cos(angle)
        leg = min(first, second)
        if leg > 0.2 * max(first, second):
            return Curve(a, [Piece(first - leg), *bend(angle, leg), Piece(second - leg)])
    # two bends with equal legs `d` that meet in the middle of the line between their corners
    c, s = math.cos(angle), math.sin(angle)
    p, q, r = 2 * (c - 1), -2 * (ahead * (1 + c) + left * s), ahead**2 + left**2
    d = 2 * r / (-q + math.sqrt(q * q - 4 * p * r))
    middle = math.atan2(left - d * s, ahead - d * (1 + c))
    return Curve(a, [*bend(middle, d), *bend(wrap(angle - middle), d)])


class Profile:
    """A quantity along a road: smoothsteps between knots, constant outside."""

    def __init__(self, *knots: tuple[float, float]) -> None:
        self.knots = tuple((round(s, 6), v) for s, v in knots)

    def cubic(self, s: float) -> tuple[float, float, float, float]:
        """Coefficients in ds of the cubic that holds from `s` on."""
        for (s0, v0), (s1, v1) in zip(self.knots, self.knots[1:], strict=False):
            if s0 <= s < s1:
                length, rise, u = s1 - s0, v1 - v0, (s - s0) / (s1 - s0)
                return (
                    v0 + rise * u * u * (3 - 2 * u),
                    6 * rise * u * (1 - u) / length,
                    3 * rise * (1 - 2 * u) / length**2,
                    -2 * rise / length**3,
                )
        return (self.knots[0][1] if s < self.knots[0][0] else self.knots[-1][1], 0, 0, 0)

    def __call__(self, s: float) -> float:
        """The value at `s`."""
        return self.cubic(s)[0]

    def records(self, s0: float, s1: float) -> Iterator[tuple[float, tuple[float, float, float, float]]]:
        """(s, cubic) from `s0` up to `s1`, without repeated constants."""
        last = None
        for s in [s0, *(k for k, _ in self.knots if s0 < k < s1)]:
            cubic = self.cubic(s)
            if cubic != last or any(cubic[1:]):
                yield s, cubic
            last = cubic

    def narrow_at(self) -> float | None:
        """Place where a width passes `NARROWEST`, on its wider side."""
        for (s0, v0), (s1, v1) in zip(self.knots, self.knots[1:], strict=False):
            if (v0 == 0) != (v1 == 0):
                u = 0.5 - math.sin(math.asin(1 - 2 * NARROWEST / max(v0, v1)) / 3)
                cut = u * (s1 - s0)
                return math.ceil(1e3 * (s0 + cut)) / 1e3 if v0 == 0 else math.floor(1e3 * (s1 - cut)) / 1e3
        return None
