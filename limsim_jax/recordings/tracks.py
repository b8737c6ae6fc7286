"""Recorded vehicles in the plane on a common clock, with their lanes.

Positions are those of the middle of the body. Nothing is repaired: what cannot be replayed is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from limsim_jax.maps.network import Network
from limsim_jax.recordings.recording import FASTEST, Floats, Ints, RecordingError

_JUMP = 2.0  # m by which a step may be longer than the speeds at its ends allow


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Tracks on a common clock, `T` moments and `N` vehicles; NaN where a vehicle is not there."""

    name: str
    source: str  # file
    dt: float  # s
    vehicles: tuple[str, ...]  # ids in the file
    x: Float[np.ndarray, "T N"]  # m, middle of the body, in coordinates of the file
    y: Float[np.ndarray, "T N"]
    heading: Float[np.ndarray, "T N"]  # rad
    v: Float[np.ndarray, "T N"]  # m/s
    length: Float[np.ndarray, " N"]  # m
    width: Float[np.ndarray, " N"]  # m
    network: Network

    @property
    def valid(self) -> Bool[np.ndarray, "T N"]:
        """Where there is something recorded."""
        return np.isfinite(self.x)


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows `R` of a file, one per vehicle and time."""

    line: Ints  # of the file
    vehicle: NDArray[np.str_]  # id
    step: Floats  # whole numbers
    x: Floats  # m, middle of the body
    y: Floats
    heading: Floats  # rad
    v: Floats  # m/s
    length: Floats  # m
    width: Floats  # m

    def where(self, rows: NDArray[np.bool_] | Ints) -> Rows:
        """Some of the rows: a mask, or their numbers in order."""
        return Rows(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def tracks_from_rows(source: str | Path, name: str, dt: float, rows: Rows, network: Network) -> Tracks:
    """Tracks of checked rows, vehicles in the order of the file.

    Args:
      source: file, for errors.
      name: of the scene.
      dt: s per step.
      rows: of all vehicles.
      network: that they drive on.

    Raises:
      RecordingError: no rows, a step twice or missing, or values that are no metres, seconds or radians.
    """
    if not len(rows.line):
        raise RecordingError(f"{source}: no recorded vehicles; tracks of cars or trucks are expected")
    _, first, index = np.unique(rows.vehicle, return_index=True, return_inverse=True)
    order = np.argsort(first)
    of_each = []
    for k in order:
        own = np.flatnonzero(index == k)
        of_each.append(rows.where(own[np.argsort(rows.step[own], kind="stable")]))
        _check(source, of_each[-1], dt)
    start = min(one.step[0] for one in of_each)
    count = int(max(one.step[-1] for one in of_each) - start) + 1
    table = np.full((4, count, len(of_each)), np.nan)
    for k, one in enumerate(of_each):
        table[:, (one.step - start).astype(int), k] = one.x, one.y, one.heading, one.v
    x, y, heading, v = table
    return Tracks(
        name=name, source=str(source), dt=dt, vehicles=tuple(str(one.vehicle[0]) for one in of_each),
        network=network, x=x, y=y, heading=heading, v=v,
        length=np.array([one.length[0] for one in of_each]),
        width=np.array([one.width[0] for one in of_each]),
    )  # fmt: skip


def _check(source: str | Path, rows: Rows, dt: float) -> None:
    """Refuse the sorted rows of one vehicle where they make no track."""
    step, v, length, width, heading = rows.step, rows.v, rows.length, rows.width, rows.heading
    chord = np.hypot(np.diff(rows.x), np.diff(rows.y))
    after = np.diff(step, prepend=step[0] - 1)

    def refuse(bad: NDArray[np.bool_], message: str) -> None:
        if bad.any():
            k = int(np.argmax(bad))
            raise RecordingError(
                f"{source}: line {int(rows.line[k])}: vehicle {rows.vehicle[k]}: "
                + message.format(
                    step=step[k], v=v[k], length=length[k], width=width[k], before=step[max(k - 1, 0)],
                    jump=chord[max(k - 1, 0)] if len(chord) else 0.0, heading=heading[k],
                )
            )  # fmt: skip

    refuse(step != np.round(step), "step {step:g}; a whole number is expected")
    refuse(after == 0, "step {step:g} twice; each step is expected once")
    refuse(after > 1, "step {step:g} follows step {before:g}; no gap in time is expected")
    refuse(
        (length < 1) | (length > 30) | (width < 0.4) | (width > 4),
        "length {length:g} m, width {width:g} m; metres, 1 to 30 and 0.4 to 4, are expected",
    )
    refuse((v < 0) | (v > FASTEST), "v is {v:g} m/s; metres per second, 0 to 70, are expected")
    far = chord > (np.maximum(v[1:], v[:-1]) * dt + _JUMP)
    refuse(
        np.append(False, far),
        "moves {jump:.1f} m in one step at v {v:g} m/s; metres and seconds are expected",
    )
    refuse(np.abs(heading) > 4 * math.pi, "heading {heading:g}; radians are expected")


__all__ = ["Rows", "Tracks", "tracks_from_rows"]
