"""A search for worlds in which an event happens: plausible ones, and what they hang on.

It shows that a policy can fail and how, never how often: it picks its worlds on purpose, so its counts are
no probability. `sweeps.estimate` has probabilities. The random numbers of a world are one array of standard
normals (`traffic.demand.draws.Layout`), and every array is a world that the program of a sweep runs.

1. Plain worlds run, those of seeds. The ones nearest to the event are starts.
2. Several searches go on side by side, each from a start of its own: a separable CMA-ES (Ros and Hansen 2008)
   in the numbers of the vehicles that come in before the end. Its first worlds are `WIDTH` away from the
   start and as plausible as plain ones. Every world is brought into the plausible ones before it runs
   (`sweeps.plausible`). A search ends with a failure, or after `PATIENCE` generations without a nearer world;
   the next start takes its place.
3. Numbers of each failure go to the middle of their distributions while the event stays: body and driver of
   each vehicle, then where it is and goes, then single numbers, then the distance of the rest. What is left
   is what the failure hangs on.
4. A reference driver gets the failures that were found. A failure that happens to it, too, need not be the
   fault of the policy.

    DIR/adversary.json           how it is made, and what was found
    DIR/worlds/000012.npz        metrics of a batch of worlds: an interrupted search goes on from these
    DIR/failures.npz             worlds with the event: random numbers, metrics
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cmaes import SepCMA
from numpy.typing import NDArray

from limsim_jax.sweeps.asked import Asked, Log, Tell, event_in
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.events import Event, event_of
from limsim_jax.sweeps.numbered import names_of, vehicles_of
from limsim_jax.sweeps.plausible import Floats, Plausibility, Plausible, Unusual, unusual

STARTS = 4
"""Searches side by side."""

MOST = 5
"""Failures after which the search ends, unless told."""

LEAST_PLAUSIBLE = 0.01
"""Least plausibility of a failure, unless told: share of random worlds that are as unusual."""

WIDTH = 0.5
"""Standard deviation of the first worlds of a search around its start; that of random worlds is 1."""

PATIENCE = 8
"""Generations of a search without a world that is nearer to the event."""

PLAIN = 0.2
"""Share of the worlds that are plain ones, at most."""

LESS = 0.25
"""Share of the worlds that is kept for changing less."""

GENERATIONS = 20
"""Generations that larger populations leave of the worlds, at least."""

CUTS = 6
"""Worlds per failure in a round of changing less."""

STEPS = 10
"""Steps between what is left of a failure and the middle."""

ENOUGH = 100
"""Worlds in which a failure of a thousand numbers is narrowed down to a few; measured on linear events."""

PLACES = ("gap", "goal", "type", "seat", "place")
"""Numbers that tell where and when vehicles are: any change of one makes another world."""

SHOWN = 5
"""Numbers of a failure that are told."""

Ask = Callable[[Floats], Floats]
"""Limit states `[B]` of worlds `[B, D]`."""

NO_PROBABILITY = (
    "these worlds were looked for: they show that failures exist, not how often they happen; "
    "an estimate says that"
)
"""What a table of failures has to say."""


class Failure(NamedTuple):
    """A world with the event."""

    number: int  # among the failures
    seed: int  # of the plain world that the search started from
    searched: bool  # whether that was changed; otherwise it has the event as it is
    plausibility: Plausibility
    avoided: bool | None  # by the reference; None: there is none
    unusual: tuple[Unusual, ...]  # numbers that the event hangs on, the most unusual first
    changed: int  # numbers that are not in the middle, of those that count
    narrowed: bool  # whether every number was tried; otherwise the worlds were too few, and some do nothing
    metrics: dict[str, float]  # of its ego that is nearest to the event, or beyond it farthest


class Ran(NamedTuple):
    """How many worlds ran, or were on disk."""

    plain: int
    search: int
    less: int  # to change less
    reference: int

    @property
    def total(self) -> int:
        """All of them."""
        return sum(self)


@dataclass(frozen=True, eq=False)
class Adversary:
    """Worlds in which a policy fails. Their number is no probability: they were looked for.

    Attributes:
      scenario, policy: names.
      event: what was looked for.
      reference: name of the driver that drove the failures as well; None: there is none.
      least_plausible: plausibility of a failure, at least.
      failures: those that the reference avoids first, then the most plausible.
      starts: plain worlds from which a search began.
      hits: starts of these that led to the event.
      plain: failures among plain worlds, without a search.
      worlds: that ran, or were on disk.
    """

    scenario: str
    policy: str
    event: Event
    reference: str | None
    least_plausible: float
    failures: tuple[Failure, ...]
    starts: int
    hits: int
    plain: int
    worlds: Ran
    values: NDArray[np.float32] = field(repr=False)  # [M, D] random numbers of the failures
    episodes: Episodes = field(repr=False)  # of the failures: seed k is failure k

    def rows(self) -> list[tuple[str, str]]:
        """The table in two columns."""
        ran = self.worlds
        rows = [
            ("event", self.event.meaning),
            ("no probability", NO_PROBABILITY),
            (
                "worlds",
                f"{ran.total:,}: {ran.plain:,} plain, {ran.search:,} of the search, {ran.less:,} to change "
                f"less, {ran.reference:,} of the reference",
            ),
            ("starts", f"{self.hits} of {self.starts} searches found one; {self.plain} without a search"),
            ("plausibility", f"share of random worlds as unusual; at least {_percent(self.least_plausible)}"),
        ]
        for failure in self.failures:
            rows += self._rows_of(failure)
        if not self.failures:
            rows.append(("failures", "none found, which does not mean that there is none"))
        return rows

    def _rows_of(self, failure: Failure) -> list[tuple[str, str]]:
        source = f"from seed {failure.seed}" if failure.searched else f"seed {failure.seed} without a search"
        said = "" if failure.avoided is None else f"; {self.solved(failure)}"
        what = self.event.columns[-1]
        p = failure.plausibility
        return [
            (f"failure {failure.number}", f"{what} {failure.metrics[what]:.3g}, {source}{said}"),
            ("  plausibility", f"{_percent(p.least)}; {p.most}"),
            ("  hangs on", _hangs_on(failure)),
        ]

    def solved(self, failure: Failure) -> str:
        """Whether the reference avoids a failure, in words."""
        if failure.avoided is None:
            return "no reference"
        return f"avoided by {self.reference}" if failure.avoided else f"unsolved by {self.reference}, too"

    def __str__(self) -> str:
        rows = self.rows()
        width = max(len(name) for name, _ in rows)
        lines = [f"  {name:<{width}}  {text}" for name, text in rows]
        return "\n".join([f"{self.scenario}, {self.policy}", *lines])

    def as_json(self) -> dict[str, Any]:
        """Plain values; numbers that were not measured are None."""
        return {
            "scenario": self.scenario,
            "policy": self.policy,
            "event": self.event.name,
            "meaning": self.event.meaning,
            "note": NO_PROBABILITY,
            "reference": self.reference,
            "least_plausible": self.least_plausible,
            "worlds": {**self.worlds._asdict(), "total": self.worlds.total},
            "starts": self.starts,
            "hits": self.hits,
            "plain": self.plain,
            "failures": [
                {
                    **failure._asdict(),
                    "plausibility": failure.plausibility.as_json(),
                    "unusual": [one._asdict() for one in failure.unusual],
                    "metrics": {k: x if math.isfinite(x) else None for k, x in failure.metrics.items()},
                }
                for failure in self.failures
            ],
        }


def _hangs_on(failure: Failure) -> str:
    """What a failure hangs on, in words."""
    if not failure.changed:
        return "nothing: every number is in the middle"
    if not failure.narrowed:
        return f"not narrowed down: some of {failure.changed:,} numbers; more worlds would tell"
    words = "; ".join(map(str, failure.unusual[:3]))
    more = failure.changed - len(failure.unusual[:3])
    return words + (f"; and {more:,} more numbers" if more > 0 else "")


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


# --- the search --------------------------------------------------------------------------------------


class Hit(NamedTuple):
    """A world with the event."""

    z: Floats  # [D]
    seed: int  # of the start
    searched: bool
    plausible: Plausible
    narrowed: bool = False


class Plain(NamedTuple):
    """A plain world."""

    seed: int
    z: Floats  # [D]
    limit: float  # limit state


class _Search:
    """One CMA-ES from a start."""

    def __init__(self, start: Plain, plausible: Plausible, members: int, seed: int) -> None:
        self.start, self.plausible, self.members = start, plausible, members
        self.best, self.waited, self.begun = start.limit, 0, False
        x = start.z[plausible.numbers]
        mean = np.sqrt(1 - WIDTH**2) * x  # with the width: random numbers again, of a random start
        self._size = len(x)  # CMA-ES wants two; the second of one means nothing
        mean = np.append(mean, np.zeros(max(2 - len(x), 0)))
        self._cma = SepCMA(mean, WIDTH, population_size=members, seed=seed)
        self._extra = np.zeros((members, len(mean) - len(x)))

    def ask(self) -> Floats:
        """Worlds `[M, D]`."""
        self.begun = True
        worlds = np.repeat(self.start.z[None], self.members, 0)
        points = np.array([self._cma.ask() for _ in range(self.members)])
        self._extra = points[:, self._size :]
        worlds[:, self.plausible.numbers] = points[:, : self._size]
        return self.plausible.nearest(worlds)

    def tell(self, worlds: Floats, limits: Floats) -> Hit | None:
        """The failure nearest to the middle, if there is one; otherwise the search learns."""
        hits = np.flatnonzero(limits <= 0)
        if len(hits):
            k = hits[np.linalg.norm(worlds[hits], axis=1).argmin()]
            return Hit(worlds[k], self.start.seed, True, self.plausible)
        # it is told the worlds that ran, not those it asked for, so that it stays among plausible ones
        points = np.concatenate([worlds[:, self.plausible.numbers], self._extra], 1)
        self._cma.tell(list(zip(points, limits.tolist(), strict=True)))
        nearer = limits.min() < self.best
        self.best = min(self.best, float(limits.min()))
        self.waited = 0 if nearer else self.waited + 1
        return None

    @property
    def ended(self) -> bool:
        """Whether it leads nowhere."""
        return self.waited >= PATIENCE or self._cma.should_stop()


def search(
    ask: Ask,
    pool: Sequence[Plain],
    plausible_of: Callable[[Plain], Plausible],
    *,
    starts: int,
    members: int,
    worlds: int,
    most: int,
    seed: int,
) -> tuple[list[Hit], int]:
    """Worlds with the event, by searches side by side.

    Args:
      ask: limit states; gets the worlds of all searches at once.
      pool: starts, the first first.
      plausible_of: the plausible worlds of a start.
      starts: searches side by side.
      members: worlds of a search per generation.
      worlds: that may run.
      most: failures after which it ends.
      seed: of the searches.

    Returns:
      What was found, one per start, and how many starts were made.
    """
    waiting, running, found = list(pool), list[_Search](), list[Hit]()
    begun = 0
    while len(found) < most:
        while waiting and len(running) < starts:
            start = waiting.pop(0)
            seed_of = int(np.random.default_rng((seed, start.seed)).integers(2**31))
            running.append(_Search(start, plausible_of(start), members, seed_of))
        running = running[: worlds // members]  # the last worlds
        begun += sum(not one.begun for one in running)
        if not running:
            break
        batches = [one.ask() for one in running]
        worlds -= len(running) * members
        limits = ask(np.concatenate(batches)).reshape(len(running), members)
        going = []
        for one, batch, g in zip(running, batches, limits, strict=True):
            hit = one.tell(batch, g)
            if hit is not None:
                found.append(hit)
            elif not one.ended:
                going.append(one)
        running = going
    return found[:most], begun


# --- changing less -----------------------------------------------------------------------------------


class _Less:
    """A failure whose numbers go to the middle while the event stays."""

    def __init__(self, hit: Hit, drivers: NDArray[np.bool_], seed: int) -> None:
        self.hit, self.z, self._drivers = hit, hit.z, drivers
        self.rounds = self._rounds(np.random.default_rng(seed))
        self.wanted: Floats | None = next(self.rounds, None)

    def tell(self, still: NDArray[np.bool_]) -> None:
        """Whether the event stays in each of the worlds that are wanted."""
        try:
            self.wanted = self.rounds.send(still)
        except StopIteration:
            self.wanted = None

    def _rounds(self, rng: np.random.Generator) -> Generator[Floats, NDArray[np.bool_], None]:
        groups = [np.asarray(group) for group in self.hit.plausible.groups]
        late = np.setdiff1d(np.arange(len(self.z)), self.hit.plausible.numbers)
        parts = [late] if len(late) else []  # vehicles that do not come in unless the gaps change
        for numbers in (self._drivers, ~self._drivers):
            some = [groups[k][numbers[groups[k]]] for k in rng.permutation(len(groups))]
            yield from self._restore(parts + [part for part in some if len(part)])
            parts = []
        numbers = self._left()
        yield from self._restore([np.array([k]) for k in numbers[np.argsort(np.abs(self.z[numbers]))]])
        numbers = self._left()
        if len(numbers):
            shares = np.arange(STEPS) / STEPS
            worlds = np.repeat(self.z[None], STEPS, 0)
            worlds[:, numbers] *= shares[:, None]
            still = yield worlds
            if still.any():
                self.z = worlds[np.flatnonzero(still)[0]]

    def _left(self) -> NDArray[np.int64]:
        """Numbers that count and are not in the middle."""
        numbers = self.hit.plausible.numbers
        return numbers[self.z[numbers] != 0]

    def _restore(self, parts: list[NDArray[np.int64]]) -> Generator[Floats, NDArray[np.bool_], None]:
        """Move parts to the middle, as many as the event stands.

        Each round tries the first 1, 2, ... of those that are left. A part without which the event is gone is
        left alone; parts of a group that has one wait until the others are through."""
        while parts:
            cuts = np.unique(np.geomspace(1, len(parts), CUTS).round().astype(int))
            worlds = np.repeat(self.z[None], len(cuts), 0)
            for world, cut in zip(worlds, cuts, strict=True):
                world[np.concatenate(parts[:cut])] = 0
            still = yield worlds
            best = int(np.flatnonzero(still)[-1]) if still.any() else -1
            if best >= 0:
                self.z = worlds[best]
            done = int(cuts[best]) if best >= 0 else 0
            if best + 1 < len(cuts):
                doubtful = parts[done : int(cuts[best + 1])]
                parts = parts[int(cuts[best + 1]) :] + (doubtful if len(doubtful) > 1 else [])
            else:
                parts = []


def change_less(
    ask: Ask, hits: Sequence[Hit], drivers: NDArray[np.bool_], worlds: int, seed: int
) -> list[Hit]:
    """The same failures with fewer numbers that are not in the middle.

    Args:
      ask: limit states; gets the worlds of several failures at once.
      hits: the failures; where worlds are few, the first are narrowed down first.
      drivers: which numbers are of bodies and drivers, `[D]`; the others, of places and ways, go last.
      worlds: that may run.
      seed: of the order in which vehicles go to the middle.
    """
    less, together = [_Less(hit, drivers, seed) for hit in hits], max(1, worlds // ENOUGH)
    while True:
        going, batches = [], []
        for one in less:
            if len(going) < together and one.wanted is not None and len(one.wanted) <= worlds:
                worlds -= len(one.wanted)
                going.append(one)
                batches.append(one.wanted)
        if not going:
            return [one.hit._replace(z=one.z, narrowed=one.wanted is None) for one in less]
        limits = ask(np.concatenate(batches))
        ends = np.cumsum([len(batch) for batch in batches])[:-1]
        for one, g in zip(going, np.split(limits, ends), strict=True):
            one.tell(g <= 0)


# --- in the worlds of an experiment ------------------------------------------------------------------


def least_worlds(dimensions: int, starts: int, most: int) -> int:
    """Worlds that a search needs: a generation of all starts.

    Args:
      dimensions: random numbers of a world.
      starts: searches side by side.
      most: failures after which it ends; the reference drives them.
    """
    return math.ceil((starts * _members(dimensions) + most) / (1 - PLAIN - LESS))


def _members(dimensions: int) -> int:
    """Population of CMA-ES by default (Hansen 2016, arXiv 1604.00772)."""
    return 4 + math.floor(3 * math.log(max(dimensions, 2)))


def _checked(layout_size: int, worlds: int, starts: int, most: int, least_plausible: float) -> None:
    if starts < 1:
        raise ValueError(f"starts: {starts}; at least 1")
    if most < 1:
        raise ValueError(f"most: {most}; at least 1 failure")
    if not 0 < least_plausible < 1:
        raise ValueError(
            f"least_plausible: {least_plausible:g}; a share of random worlds between 0 and 1, "
            f"such as {LEAST_PLAUSIBLE:g}"
        )
    needed = least_worlds(layout_size, starts, most)
    if worlds < needed:
        raise ValueError(
            f"worlds: {worlds} are too few for {starts} starts with {layout_size:,} random numbers; "
            f"at least {needed}"
        )


def adversary(
    episodes: Episodes,
    event: str,
    out: Path | None,
    *,
    reference: Episodes | None = None,
    worlds: int = 2000,
    starts: int = STARTS,
    most: int = MOST,
    least_plausible: float = LEAST_PLAUSIBLE,
    seed: int = 0,
    fresh: bool = False,
    tell: Tell | None = None,
) -> Adversary:
    """Search for worlds in which an event happens; see `api.adversary.adversary`."""
    wanted, layout = event_in(episodes, event), episodes.layout
    _checked(layout.size, worlds, starts, most, least_plausible)
    if not 0 <= seed < 2**31 - worlds:
        raise ValueError(f"seed: {seed}; at least 0, and below 2^31")
    settings: dict[str, Any] = {
        "event": wanted.name, "worlds": worlds, "starts": starts, "most": most,
        "least_plausible": least_plausible, "seed": seed,
    }  # fmt: skip
    if reference is not None:
        if reference.policy == episodes.policy:
            raise ValueError(f"reference: '{reference.policy}' is the policy under test; name another")
        event_of(event, reference.units)
        settings["reference"] = reference.policy
        settings["reference_made_by"] = reference.provenance()
    log = Log(out, "adversary.json", {**episodes.provenance(), "adversary": settings}, fresh)
    ask = Asked(episodes, wanted, log, tell, worlds)
    begin = time.perf_counter()
    kept = 0 if reference is None else most
    groups = vehicles_of(episodes)

    def plausible_of(start: Plain) -> Plausible:
        return Plausible(_coming(episodes, groups, start.seed), least_plausible)

    hits, pool = _plain(ask, episodes, plausible_of, int(PLAIN * worlds), most, seed)
    plain, ran = len(hits), ask.count
    started = 0
    if plain < most:
        left = worlds - ran - int(LESS * worlds) - kept
        found, started = search(
            ask, pool, plausible_of, starts=starts, members=_population(episodes, starts, left),
            worlds=left, most=most - plain, seed=seed,
        )  # fmt: skip
        hits += found
    searched = ask.count - ran
    drivers = np.array([number.what not in PLACES for number in layout.numbers])
    hits = change_less(ask, hits, drivers, worlds - ask.count - kept, seed)
    found = len(hits) - plain
    hits = list({hit.z.tobytes(): hit for hit in reversed(hits)}.values())[::-1]  # equal ones once
    less = ask.count - ran - searched
    avoided = _driven(hits, reference, wanted, log, tell, ask.count, worlds)
    done = _told(hits, avoided, ask, episodes, wanted)
    result = Adversary(
        scenario=episodes.scenario,
        policy=episodes.policy,
        event=wanted,
        reference=None if reference is None else reference.policy,
        least_plausible=least_plausible,
        failures=tuple(failure for failure, _ in done),
        starts=started,
        hits=found,
        plain=plain,
        worlds=Ran(ran, searched, less, 0 if reference is None else len(hits)),
        values=(values := np.array([x for _, x in done], np.float32).reshape(-1, layout.size)),
        episodes=ask.show(values),
    )
    log.write({**result.as_json(), "ran_now": ask.ran, "seconds": round(time.perf_counter() - begin, 1)})
    log.failures(values, [failure.metrics for failure in result.failures], list(episodes.units))
    return result


def _population(episodes: Episodes, starts: int, worlds: int) -> int:
    """Worlds per search and generation: those of CMA-ES, and more where calls have room for them."""
    members = _members(episodes.layout.size)
    full = math.ceil(starts * members / episodes.chunk) * episodes.chunk // starts
    return max(members, min(full, worlds // (starts * GENERATIONS)))


def _coming(
    episodes: Episodes, groups: dict[str, NDArray[np.int64]], seed: int
) -> dict[str, NDArray[np.int64]]:
    """Numbers that count in a plain world, by vehicle.

    They are those of the vehicles that come in before its end, and the gaps until then."""
    layout, due = episodes.layout, np.asarray(episodes.scenario_of(seed).schedule.time)
    horizon, queue = episodes.experiment.horizon, dict[int, int]()
    for lane, vehicle in {(x.lane, x.vehicle) for x in layout.numbers if 0 <= x.vehicle < layout.rows}:
        queue[lane] = queue.get(lane, 0) + int(due[vehicle] <= horizon)

    def there(k: int) -> bool:
        number = layout.numbers[k]
        if number.what == "gap":
            return number.place <= queue.get(number.lane, number.place)  # one more may come
        return not 0 <= number.vehicle < layout.rows or bool(due[number.vehicle] <= horizon)

    found = {name: np.array([k for k in group if there(int(k))], int) for name, group in groups.items()}
    return {name: group for name, group in found.items() if len(group)}


def _plain(
    ask: Asked,
    episodes: Episodes,
    plausible_of: Callable[[Plain], Plausible],
    worlds: int,
    most: int,
    seed: int,
) -> tuple[list[Hit], list[Plain]]:
    """Failures among plain worlds, and the others by their limit state."""
    hits, pool = list[Hit](), list[Plain]()
    chunk = min(episodes.chunk, worlds)
    for first in range(seed, seed + worlds, chunk):
        seeds = range(first, min(first + chunk, seed + worlds))
        z = ask.layout.to_normals(episodes.numbers(range(first, first + chunk)))[: len(seeds)]
        for one in map(Plain, seeds, z, ask(z).tolist()):
            if one.limit > 0:
                pool.append(one)
            elif len(hits) < most and (plausible := plausible_of(one)).holds(one.z):
                hits.append(Hit(one.z, one.seed, False, plausible))
        if len(hits) >= most:
            break
    return hits, sorted(pool, key=lambda x: x.limit)


def _driven(
    hits: Sequence[Hit],
    reference: Episodes | None,
    event: Event,
    log: Log,
    tell: Tell | None,
    count: int,
    worlds: int,
) -> list[bool | None]:
    """Whether the reference avoids the event in each world."""
    if reference is None or not hits:
        return [None] * len(hits)
    again = Asked(reference, event, log, tell and (lambda done, _: tell(count + done, worlds)), worlds)
    return [bool(g > 0) for g in again(np.array([hit.z for hit in hits]))]


def _told(
    hits: Sequence[Hit], avoided: Sequence[bool | None], ask: Asked, episodes: Episodes, event: Event
) -> list[tuple[Failure, NDArray[np.float32]]]:
    """Failures with their random numbers, in their order."""
    names, found = names_of(episodes), []
    for hit, solved in zip(hits, avoided, strict=True):
        values = ask.layout.from_normals(hit.z)
        numbers = hit.plausible.numbers
        failure = Failure(
            number=0,
            seed=hit.seed,
            searched=hit.searched,
            plausibility=hit.plausible.of(hit.z),
            avoided=solved,
            unusual=unusual(hit.z, names, numbers, SHOWN),
            changed=int((hit.z[numbers] != 0).sum()),
            narrowed=hit.narrowed,
            metrics=ask.found[values.tobytes()],
        )
        found.append((failure, values))
    found.sort(key=lambda x: (x[0].avoided is False, -x[0].plausibility.least))
    return [(failure._replace(number=k), values) for k, (failure, values) in enumerate(found)]
