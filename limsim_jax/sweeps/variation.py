"""The least change of random numbers that makes an event go away.

The change goes towards the middle of the distributions: numbers of one vehicle become those of a typical one.
The search runs three batches: all vehicles one by one, then the numbers of those that matter, then how far.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.numbered import Numbered, vehicles_of

Columns = Mapping[str, NDArray[np.float64]]
Happened = Callable[[Columns], NDArray[np.bool_]]
"""Of the rows of worlds: whether the event happened there."""

STEPS = 10
"""Steps between a world and the typical value of a number."""

VEHICLES = 3
"""Vehicles, those that make the event go away, whose numbers are looked at one by one."""


class Change(NamedTuple):
    """A change of random numbers after which the event does not happen."""

    what: str  # of which number, or "all numbers"
    where: str  # of which vehicle
    before: float  # standard deviations from the middle; of several numbers the root of their squares
    after: float
    numbers: NDArray[np.int64]  # places in the array

    @property
    def size(self) -> float:
        """Standard deviations."""
        return abs(self.before - self.after)

    def __str__(self) -> str:
        return (
            f"{self.what} of {self.where}: from {self.before:+.2f} to {self.after:+.2f} standard deviations"
        )


class Variation(NamedTuple):
    """What a search for a change found."""

    again: bool  # the event happens in the world as it is, run from its numbers
    change: Change | None  # the least one; None: no change of one vehicle makes the event go away
    vehicles: tuple[str, ...]  # those of which a typical one instead makes it go away
    worlds: int  # that ran


def least_change(episodes: Episodes, seed: int, happened: Happened, *, until: float = np.inf) -> Variation:
    """The least change of one vehicle that makes an event go away.

    Args:
      episodes: whose world it is.
      seed: of the world.
      happened: the event.
      until: s, when it happened: vehicles that enter later do not count.
    """
    layout = episodes.layout
    base = layout.to_normals(episodes.numbers([seed]))[0]
    runner, count = Numbered(episodes), 0

    def happens(worlds: list[NDArray[np.float64]]) -> NDArray[np.bool_]:
        nonlocal count
        count += len(worlds)
        # the policy draws what it drew in the world of the seed
        metrics = runner.run(layout.from_normals(np.array(worlds)), np.full(len(worlds), seed, np.int32))
        return np.asarray(happened(metrics).reshape(-1, runner.each).any(1))

    groups = _vehicles(episodes, seed, until)
    names = list(groups)
    worlds = [base, *(_towards(base, groups[name], 0.0) for name in names)]
    found = happens(worlds)
    if not found[0]:
        return Variation(False, None, (), count)
    helps = [name for name, still in zip(names, found[1:], strict=True) if not still]
    if not helps:
        return Variation(True, None, (), count)
    # the nearer a vehicle is to a typical one, the less is changed
    helps.sort(key=lambda name: float(np.linalg.norm(base[groups[name]])))
    tries = [(name, np.array([k])) for name in helps[:VEHICLES] for k in groups[name]]
    single = happens([_towards(base, numbers, 0.0) for _, numbers in tries])
    able = [one for one, still in zip(tries, single, strict=True) if not still]
    able += [(name, groups[name]) for name in helps[:VEHICLES]]
    able.sort(key=lambda one: float(np.linalg.norm(base[one[1]])))
    able = able[: 2 * VEHICLES]
    shares = np.arange(1, STEPS) / STEPS  # of the way that is left: 0 is the typical value
    grid = [(one, share) for one in able for share in shares]
    ends = happens([_towards(base, numbers, share) for (_, numbers), share in grid])
    changes = []
    for (name, numbers), still in zip(able, ends.reshape(len(able), -1), strict=True):
        share = max(shares[~still], default=0.0)
        what = layout.numbers[int(numbers[0])].what if len(numbers) == 1 else "all numbers"
        size = float(base[numbers[0]]) if len(numbers) == 1 else float(np.linalg.norm(base[numbers]))
        changes.append(Change(what, name, size, size * float(share), numbers))
    return Variation(True, min(changes, key=lambda x: x.size), tuple(helps), count)


def _towards(base: NDArray[np.float64], numbers: NDArray[np.int64], share: float) -> NDArray[np.float64]:
    """Some numbers with only a share of their distance to the middle."""
    world = base.copy()
    world[numbers] *= share
    return world


def _vehicles(episodes: Episodes, seed: int, until: float) -> dict[str, NDArray[np.int64]]:
    """Numbers of each vehicle that is there by then, and of gaps."""
    layout, due = episodes.layout, np.asarray(episodes.scenario_of(seed).schedule.time)

    def there(vehicle: int) -> bool:
        return not 0 <= vehicle < layout.rows or bool(due[vehicle] <= until)

    return {
        name: numbers
        for name, numbers in vehicles_of(episodes).items()
        if there(layout.numbers[int(numbers[0])].vehicle)
    }
