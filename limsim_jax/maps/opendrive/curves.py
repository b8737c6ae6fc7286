"""Geometry of an OpenDRIVE road: piecewise cubics and the reference line.

ASAM OpenDRIVE 1.8, chapters 7 (coordinate systems) and 9 (geometry). All functions are vectorised
over `s` and take, besides `s`, the place `at` by which the record is chosen: at a border of two
records this decides between the left and the right limit.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Cubics:
    """Piecewise cubics `a + b ds + c ds^2 + d ds^3`.

    Each holds from its own `s` on; before the first the value is zero.
    """

    def __init__(
        self, records: list[tuple[float, float, float, float, float]], *, backwards: bool = False
    ) -> None:
        """Take `(s, a, b, c, d)` records; the last of equal `s` holds.

        With `backwards` the first record holds before its own `s` too.
        """
        table = np.array(sorted(records, key=lambda r: r[0]) or [(0.0, 0.0, 0.0, 0.0, 0.0)])
        if not backwards and table[0, 0] > 0:
            table = np.concatenate([np.zeros((1, 5)), table])
        self.s: Float[Array, " R"] = table[:, 0]
        self.coefficients: Float[Array, "R 4"] = table[:, 1:]

    def _local(self, s: Array, at: Array) -> tuple[Array, Array]:
        i = np.maximum(np.searchsorted(self.s, at, side="right") - 1, 0)
        return self.coefficients[i].T, s - self.s[i]

    def __call__(self, s: Array, at: Array) -> Array:
        """Values at `s`."""
        (a, b, c, d), u = self._local(s, at)
        return a + u * (b + u * (c + u * d))

    def jet(self, s: Array, at: Array) -> Float[Array, "3 M"]:
        """Values and first two derivatives at `s`."""
        (a, b, c, d), u = self._local(s, at)
        ud = u * d
        return np.stack([a + u * (b + u * (c + ud)), b + u * (2 * c + 3 * ud), 2 * c + 6 * ud])

    @property
    def constant(self) -> bool:
        """Whether no record changes along s."""
        return not self.coefficients[:, 1:].any()


class Kind(enum.IntEnum):
    """Kinds of plan view records."""

    CLOTHOID = 0  # line, arc and spiral: curvature linear in s
    PARAMETRIC = 1  # paramPoly3, and poly3 as u = p


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """One plan view record."""

    s: float  # m
    x: float  # m
    y: float  # m
    heading: float  # rad
    length: float  # m
    kind: Kind
    curvature: float = 0.0  # 1/m at the start
    sharpness: float = 0.0  # 1/m^2
    u: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # cubics over p
    v: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    p_end: float | None = None  # parameter at the end; None: where the arc length is `length`
    line: int | None = None


# Gauss-Legendre on [0, 1]
_X, _W = np.polynomial.legendre.leggauss(16)
_X, _W = (_X + 1) / 2, _W / 2

_STOPS = 1e-3  # share of its mean speed, below which the point of a parametric curve stops
_BESIDE = 1e-4  # m beside a cusp, where the direction is looked up


class ReferenceLine:
    """The plan view of a road: position, heading and curvature at any `s`.

    For parametric records `s` is arc length as the standard defines it, found by measuring the
    curve; where the curve is longer or shorter than the record says, the difference is spread evenly
    (`stretch`).
    """

    def __init__(self, records: list[Geometry]) -> None:
        self.records = sorted(records, key=lambda g: g.s)
        self.s = np.array([g.s for g in self.records])
        self._kind = np.array([g.kind for g in self.records])
        self._start = np.array([(g.x, g.y, g.heading) for g in self.records])
        self._curvature = np.array([g.curvature for g in self.records])
        self._sharpness = np.array([g.sharpness for g in self.records])
        self._parametric = {
            i: _Parametric(g) for i, g in enumerate(self.records) if g.kind is Kind.PARAMETRIC
        }
        # clothoid quadrature: panels that turn by less than a radian keep 16 nodes exact to 1e-15
        turn = max(
            (
                abs(g.curvature * g.length) + abs(g.sharpness) * g.length**2
                for g in self.records
                if g.sharpness
            ),
            default=0.0,
        )
        self._panels = min(int(turn) + 1, 1024)

    def _index(self, at: Array) -> NDArray[np.int64]:
        return np.maximum(np.searchsorted(self.s, at, side="right") - 1, 0)

    def frame(self, s: Array, at: Array) -> tuple[Array, Array, Array, Array, Array]:
        """`x, y, heading, curvature, d(curvature)/ds` at `s`."""
        i = self._index(at)
        u = s - self.s[i]
        x0, y0, heading0 = self._start[i].T
        k, c = self._curvature[i], self._sharpness[i]
        angle = heading0 + k * u / 2
        chord = u * np.sinc(k * u / (2 * np.pi))
        x, y = x0 + chord * np.cos(angle), y0 + chord * np.sin(angle)
        heading = heading0 + u * (k + c * u / 2)
        spiral = np.nonzero(c != 0.0)[0]
        if spiral.size:
            dx, dy = self._clothoid(u[spiral], heading0[spiral], k[spiral], c[spiral])
            x[spiral], y[spiral] = x0[spiral] + dx, y0[spiral] + dy
        curvature, rate = k + c * u, c.copy()
        for record, parametric in self._parametric.items():
            here = np.nonzero(i == record)[0]
            if here.size:
                found = parametric.frame(u[here], at[here] - self.s[record])
                x[here], y[here], heading[here], curvature[here], rate[here] = found
        return x, y, heading, curvature, rate

    def curvature(self, s: Array, at: Array) -> Array:
        """Curvature at `s`, 1/m."""
        i = self._index(at)
        curvature = self._curvature[i] + self._sharpness[i] * (s - self.s[i])
        for record, parametric in self._parametric.items():
            here = np.nonzero(i == record)[0]
            if here.size:
                curvature[here] = parametric.frame(s[here] - self.s[record], at[here] - self.s[record])[3]
        return curvature

    def cusps(self) -> Array:
        """Where a curve turns round on the spot, s in m."""
        return np.array(
            [self.s[record] + x for record, curve in self._parametric.items() for x in curve.cusps]
        )

    def stretch(self, at: Array) -> Array:
        """True length of the curve per metre of `s`: 1 except for parametric records."""
        stretch = np.ones(len(self.records))
        for record, parametric in self._parametric.items():
            stretch[record] = parametric.stretch
        return stretch[self._index(at)]

    def is_parametric(self, at: Array) -> NDArray[np.bool_]:
        """Whether a parametric record holds here."""
        return self._kind[self._index(at)] == Kind.PARAMETRIC

    def _clothoid(self, u: Array, heading: Array, k: Array, c: Array) -> tuple[Array, Array]:
        """Point of a clothoid: the integral of (cos, sin) of its heading.

        The heading is `heading + k w + c w^2 / 2` for w in [0, u]. Gauss-Legendre quadrature replaces
        Fresnel functions, which lose all digits as the sharpness approaches zero.
        """
        edges = np.arange(self._panels) / self._panels
        nodes = (edges[:, None] + _X / self._panels).ravel()
        weights = np.tile(_W / self._panels, self._panels)
        w = u[:, None] * nodes
        angle = heading[:, None] + w * (k[:, None] + c[:, None] * w / 2)
        return u * (np.cos(angle) @ weights), u * (np.sin(angle) @ weights)


class _Parametric:
    """A curve `u(p), v(p)` by cubics, re-parameterised by arc length."""

    def __init__(self, geometry: Geometry) -> None:
        self.g = geometry
        self._u, self._v = np.array(geometry.u), np.array(geometry.v)
        p_end = geometry.p_end if geometry.p_end is not None else self._p_of_length(geometry.length)
        intervals = max(16, min(4096, int(geometry.length)))
        self._p = np.linspace(0.0, p_end, intervals + 1)
        self._arc = np.concatenate([[0.0], np.cumsum(self._measure(self._p[:-1], self._p[1:]))])
        total = self._arc[-1]
        self.stretch = total / geometry.length if total > 0 else 1.0
        self.cusps = self._cusps()

    def _cusps(self) -> Array:
        """Where the curve stops and turns round, m from its start."""
        du, dv = (np.polynomial.Polynomial(cubic).deriv() for cubic in (self._u, self._v))
        speed2 = du**2 + dv**2
        roots = np.asarray(speed2.deriv().roots(), complex)
        p: Array = np.unique(np.real(roots)[np.abs(np.imag(roots)) <= 1e-6 * np.abs(roots)])
        p = p[(p > 0) & (p < self._p[-1])]
        p = p[self._speed(p) < _STOPS * self._arc[-1] / self._p[-1]]
        before = np.searchsorted(self._p, p, side="right") - 1
        return (self._arc[before] + self._measure(self._p[before], p)) / self.stretch

    def _speed(self, p: Array) -> Array:
        return np.hypot(_derivative(self._u, p, 1), _derivative(self._v, p, 1))

    def _measure(self, p0: Array, p1: Array) -> Array:
        nodes = p0[:, None] + (p1 - p0)[:, None] * _X
        return (p1 - p0) * (self._speed(nodes) @ _W)

    def _p_of_length(self, length: float) -> float:
        """Where the arc length from p = 0 is `length` (poly3: u as far as it takes)."""
        p = length
        for _ in range(50):
            grid = np.linspace(0.0, p, 65)
            excess = float(self._measure(grid[:-1], grid[1:]).sum()) - length
            step = excess / max(float(self._speed(np.array([p]))[0]), 1e-9)
            p = max(p - step, 1e-9)
            if abs(step) < 1e-12 * max(1.0, length):
                break
        return p

    def frame(self, s: Array, at: Array) -> tuple[Array, Array, Array, Array, Array]:
        """As `ReferenceLine.frame`, from the start of the curve."""
        for cusp in self.cusps:  # it has no direction there
            s = np.where(at < cusp, np.minimum(s, cusp - _BESIDE), np.maximum(s, cusp + _BESIDE))
        arc = s * self.stretch
        p = np.interp(arc, self._arc, self._p)
        outside = np.where(arc > self._arc[-1], arc - self._arc[-1], np.minimum(arc, 0.0))
        for _ in range(3):
            i = np.clip(np.searchsorted(self._p, p, side="right") - 1, 0, len(self._p) - 2)
            excess = self._arc[i] + self._measure(self._p[i], p) - (arc - outside)
            p = p - excess / np.maximum(self._speed(p), 1e-9)
        du, dv = _derivative(self._u, p, 1), _derivative(self._v, p, 1)
        ddu, ddv = _derivative(self._u, p, 2), _derivative(self._v, p, 2)
        dddu, dddv = _derivative(self._u, p, 3), _derivative(self._v, p, 3)
        speed2 = np.maximum(du**2 + dv**2, 1e-18)
        speed = np.sqrt(speed2)
        cross = du * ddv - dv * ddu
        curvature = cross / speed**3
        rate = (du * dddv - dv * dddu) / speed**3 - 3 * cross * (du * ddu + dv * ddv) / speed**5
        rate = rate / speed * self.stretch  # per p -> per s
        cos, sin = np.cos(self.g.heading), np.sin(self.g.heading)
        u = _derivative(self._u, p, 0) + outside * du / speed
        v = _derivative(self._v, p, 0) + outside * dv / speed
        x = self.g.x + cos * u - sin * v
        y = self.g.y + sin * u + cos * v
        return x, y, self.g.heading + np.arctan2(dv, du), curvature, rate


def _derivative(cubic: Array, p: Array, order: int) -> Array:
    a, b, c, d = cubic
    match order:
        case 0:
            return a + p * (b + p * (c + p * d))
        case 1:
            return b + p * (2 * c + p * 3 * d)
        case 2:
            return 2 * c + 6 * d * p
        case _:
            return np.full_like(p, 6 * d)
