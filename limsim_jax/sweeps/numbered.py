"""Worlds of an experiment from arrays of random numbers, see `traffic.demand.draws.Layout`."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from limsim_jax.sweeps.episode import Episodes
from limsim_jax.traffic.demand.draws import Number


class Numbered:
    """Runs worlds from their random numbers.

    Args:
      episodes: of the experiment and policy.
    """

    def __init__(self, episodes: Episodes) -> None:
        self._values = np.zeros((1, episodes.layout.size), np.float32)
        self._seeds = np.zeros(1, np.int32)
        self.episodes = episodes.from_numbers(lambda rows: (self._values[rows], self._seeds[rows]))
        self.each = max(episodes.egos, 1)
        """Rows of metrics per world."""

    def show(self, values: NDArray[np.float32], seeds: NDArray[np.int32]) -> Episodes:
        """Episodes whose seed k is row k of these arrays; see `run`."""
        self._values, self._seeds = values, seeds
        return self.episodes

    def run(
        self,
        values: NDArray[np.float32],
        seeds: NDArray[np.int32],
        tell: Callable[[int], None] | None = None,
    ) -> dict[str, NDArray[np.float64]]:
        """Metrics of worlds, `[B each]`.

        Args:
          values: `[B, D]`, random numbers of the worlds.
          seeds: `[B]`, of what the policy draws.
          tell: is told after each chunk how many of the worlds have run.
        """
        size, parts = self.episodes.chunk, []
        self.show(values, seeds)
        for first in range(0, len(values), size):
            last = min(first + size, len(values))
            parts.append(self.episodes.run(range(first, last)).metrics)
            if tell is not None:
                tell(last)
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def lane_of(episodes: Episodes, number: Number) -> str:
    """The lane that a random number is about."""
    ids = episodes.town.lane_ids
    return ids[number.lane] if 0 <= number.lane < len(ids) else "?"


def names_of(episodes: Episodes) -> list[str]:
    """Every random number in words, `[D]`."""
    found = []
    for number in episodes.layout.numbers:
        lane = lane_of(episodes, number)
        if number.what == "gap":
            found.append(f"gap before arrival {number.place + 1} on lane {lane}")
        elif number.vehicle < episodes.layout.rows:
            found.append(f"{number.what} of vehicle {number.place + 1} that enters on lane {lane}")
        else:
            found.append(f"{number.what} of a vehicle that starts on lane {lane}")
    return found


def vehicles_of(episodes: Episodes) -> dict[str, NDArray[np.int64]]:
    """Places in the array of the numbers of each vehicle.

    The gaps of a lane count as one more."""
    layout, groups = episodes.layout, dict[str, list[int]]()
    for k, number in enumerate(layout.numbers):
        lane = lane_of(episodes, number)
        if number.what == "gap":
            name = f"arrivals on lane {lane}"
        elif number.vehicle >= layout.rows:
            name = f"the vehicle in place {number.vehicle - layout.rows + 1}, lane {lane}"
        else:
            name = f"vehicle {number.place + 1} that enters on lane {lane}"
        groups.setdefault(name, []).append(k)
    return {name: np.array(numbers) for name, numbers in groups.items()}


def policy_seeds(values: NDArray[np.float32]) -> NDArray[np.int32]:
    """Seeds of policies `[B]`: a function of the random numbers `[B, D]` of a world."""
    return np.array([zlib.crc32(row.tobytes()) & 0x7FFFFFFF for row in values], np.int32)
