"""How plausible a world is, and the nearest plausible one.

The numbers of a world are independent standard normals: 0 is the median of its distribution, and the density
falls with the distance from there. Three shares say how far a world is out. Each is the share of random
worlds that are at least as unusual in one respect:

- all numbers together: the squared distance, chi-squared with as many degrees of freedom as numbers;
- the most unusual vehicle: the same for its numbers, of all vehicles the least (Sidak 1967);
- the most unusual number: its distance from 0, two-sided, of all numbers the least (Sidak 1967).

The first alone says little: among a thousand numbers a driver at 6 standard deviations is not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

Floats = NDArray[np.float64]

_ROUNDING = 1e-6
"""Part by which a share may miss the bound: worlds on the bound count."""


class Plausibility(NamedTuple):
    """How unusual a world is. Shares are of random worlds, and say nothing about how often an event is."""

    world: float  # share of random worlds whose numbers lie farther from the middle, 0 to 1
    vehicle: float  # share in which a vehicle is as unusual as the most unusual one here
    number: float  # share in which a number is as unusual as the most unusual one here
    distance: float  # from the middle, standard deviations: the root of the sum of squares
    most: str  # the most unusual vehicle
    largest: float  # standard deviations of the most unusual number

    @property
    def least(self) -> float:
        """The least of the three shares."""
        return min(self.world, self.vehicle, self.number)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**self._asdict(), "least": self.least}


class Plausible:
    """Worlds that are plausible enough.

    Args:
      groups: places in the array of the numbers of each vehicle; only these numbers count.
      least: of the three shares, between 0 and 1.
    """

    def __init__(self, groups: Mapping[str, NDArray[np.int64]], least: float) -> None:
        self.names, self.groups, self.bound = tuple(groups), tuple(groups.values()), least
        self.numbers = np.sort(np.concatenate(self.groups))
        """Places in the array of the numbers that count."""
        self._sizes = np.array([len(group) for group in self.groups])
        self._far = float(norm.isf(_each(least, len(self.numbers)) / 2))
        self._radius = np.sqrt(chi2.isf(_each(least, len(self.groups)), self._sizes))
        self._whole = float(np.sqrt(chi2.isf(least, len(self.numbers))))

    def of(self, z: Floats) -> Plausibility:
        """Of a world, `z` `[D]`."""
        x = z[self.numbers]
        squares = np.array([np.sum(z[group] ** 2) for group in self.groups])
        shares = chi2.sf(squares, self._sizes)
        largest = float(x[np.abs(x).argmax()])
        k = int(shares.argmin())
        return Plausibility(
            world=float(chi2.sf(np.sum(x**2), len(x))),
            vehicle=_any(float(shares[k]), len(shares)),
            number=_any(float(2 * norm.sf(abs(largest))), len(x)),
            distance=float(np.linalg.norm(x)),
            most=self.names[k],
            largest=largest,
        )

    def holds(self, z: Floats) -> bool:
        """Whether a world `[D]` is plausible enough."""
        return self.of(z).least >= self.bound * (1 - _ROUNDING)

    def nearest(self, z: Floats) -> Floats:
        """Plausible worlds near these ones, `[B, D]`; those that are plausible stay.

        Numbers, then vehicles, then the whole world, move towards the middle until each is on its bound."""
        found = z.copy()
        found[:, self.numbers] = np.clip(found[:, self.numbers], -self._far, self._far)
        for group, radius in zip(self.groups, self._radius, strict=True):
            found[:, group] *= _within(found[:, group], radius)
        found[:, self.numbers] *= _within(found[:, self.numbers], self._whole)
        return found


class Unusual(NamedTuple):
    """A number of a world that is not in the middle."""

    what: str
    z: float  # standard deviations from the middle

    def __str__(self) -> str:
        return f"{self.what}: {self.z:+.1f}"


def unusual(z: Floats, names: Sequence[str], numbers: NDArray[np.int64], most: int) -> tuple[Unusual, ...]:
    """The numbers of a world `[D]` that are farthest from the middle.

    Args:
      z: standard normals.
      names: of all numbers.
      numbers: places of those that count.
      most: how many are told; those in the middle are not.
    """
    order = numbers[np.argsort(-np.abs(z[numbers]), kind="stable")][:most]
    return tuple(Unusual(names[int(k)], float(z[k])) for k in order if z[k] != 0)


def _any(p: float, count: int) -> float:
    """Share of worlds with an unusual part.

    `p` is the share of parts that are as unusual; a world has `count` independent ones."""
    return 1.0 if p >= 1 else float(-np.expm1(count * np.log1p(-p)))


def _each(p: float, count: int) -> float:
    """The inverse of `_any`."""
    return float(-np.expm1(np.log1p(-p) / count))


def _within(x: Floats, radius: float) -> Floats:
    """Factors `[B, 1]` that bring rows within a radius."""
    size = np.linalg.norm(x, axis=1, keepdims=True)
    return np.minimum(1, radius / np.maximum(size, 1e-12))
