"""Fitted parameters of car following, and the box of their search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PARAMETERS = ("v0", "T", "s0", "a", "b")
"""In the order of axis `P`."""

UNITS = {"v0": "m/s", "T": "s", "s0": "m", "a": "m/s^2", "b": "m/s^2"}

MEANING = {
    "v0": "desired speed",
    "T": "time gap",
    "s0": "gap at rest",
    "a": "acceleration",
    "b": "comfortable braking",
}

BOUNDS = {"v0": (5.0, 45.0), "T": (0.3, 4.0), "s0": (0.5, 8.0), "a": (0.3, 4.0), "b": (0.5, 5.0)}
"""Default bounds in `UNITS`: our choice of what human drivers have, not a finding of the literature.

They keep parameters that the data do not tell plausible, and cost accuracy where a driver lies outside.
"""

_AT_BOUND = 1e-3  # of the width of the box


class Box(NamedTuple):
    """Bounds of the parameters, in their order and units."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @classmethod
    def of(cls, bounds: Mapping[str, Sequence[float]] | None = None) -> Box:
        """The default box with some other bounds.

        Args:
          bounds: low and high end of some parameters, in `UNITS`, as in `{"T": (0.1, 4.0)}`.

        Raises:
          ValueError: an unknown parameter, or ends that are not 0 < low < high.
        """
        for name, ends in (bounds or {}).items():
            if name not in PARAMETERS:
                raise ValueError(f"bounds: no parameter '{name}'; known are {', '.join(PARAMETERS)}")
            try:
                low, high = map(float, ends)
                good = 0 < low < high < math.inf
            except (TypeError, ValueError):
                good = False
            if not good:
                raise ValueError(
                    f"bounds: {name} within {ends!r}; finite numbers of {UNITS[name]} with 0 < low < high "
                    f"are expected, such as {BOUNDS[name]}"
                )
        chosen = BOUNDS | dict(bounds or {})
        ends = [tuple(map(float, chosen[name])) for name in PARAMETERS]
        return cls(*(tuple(column) for column in zip(*ends, strict=True)))

    def parameters(self, u: Any) -> Any:
        """Parameters `[*B P]` of points of the unit box; arrays of NumPy or JAX."""
        low, high = (np.broadcast_to(np.asarray(end, u.dtype), u.shape) for end in self)
        return low + (high - low) * u

    def unit(self, parameters: NDArray[Any]) -> NDArray[np.float64]:
        """Points of the unit box; parameters outside are put on its bounds."""
        low, high = map(np.asarray, self)
        return np.clip((np.asarray(parameters, float) - low) / (high - low), 0, 1)

    def side(self, parameters: NDArray[Any]) -> NDArray[np.int64]:
        """-1 at a lower bound, 1 at an upper one, otherwise 0."""
        u = self.unit(parameters)
        return np.where(u < _AT_BOUND, -1, np.where(u > 1 - _AT_BOUND, 1, 0))


def check_positive(**values: float | None) -> None:
    """Refuse arguments that are neither None nor finite and above 0.

    Raises:
      ValueError: one line that names the first of them.
    """
    for name, value in values.items():
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"{name} = {value:g}; a finite number above 0 is expected")


BOX = Box.of()
"""That of `BOUNDS`."""

__all__ = ["BOUNDS", "BOX", "MEANING", "PARAMETERS", "UNITS", "Box", "check_positive"]
