"""What a language model answered in worlds of a sweep: from the driver to results, and back to a replay.

OUT/answers/<scenario>/<policy>/<seed>.jsonl    a line for each question, see `Answer`
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.policies.area import PARTS
from limsim_jax.policies.language.driver import language_drivers
from limsim_jax.policies.language.store import Answer, read_answers
from limsim_jax.policies.several import Several
from limsim_jax.simulation.rollout import decision_key
from limsim_jax.sweeps.store import answers_file


class Notes:
    """Finds what the drivers within a policy have noted about worlds.

    Args:
      policy: that drives.
      dt: s of a physics step.
    """

    def __init__(self, policy: Any, dt: float) -> None:
        self.drivers = language_drivers(policy)
        self._dt = dt
        self._several = isinstance(policy, Several)
        self._parts = len(policy.policies) if isinstance(policy, Several) else PARTS

        def keys(seed: Any, step: Any) -> Any:
            key = decision_key(seed, step)
            inner = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(self._parts))
            return jax.random.key_data(jnp.concatenate([key[None], inner]))

        self._keys = jax.jit(jax.vmap(jax.vmap(keys, (None, 0)), (0, None)))

    def forget(self) -> None:
        """Drop what was noted so far."""
        for driver in self.drivers:
            driver.notes.clear()

    def take(self, seeds: Sequence[int]) -> dict[int, list[Answer]]:
        """The answers in worlds that just ran, by seed; in order."""
        noted: dict[bytes, list[Answer]] = {}
        for driver in self.drivers:
            noted |= driver.notes
        self.forget()
        if not noted:
            return {}
        times = sorted({answer.time for some in noted.values() for answer in some})
        found: dict[int, list[Answer]] = {}
        for seed, rows in zip(seeds, self._names(seeds, times), strict=True):
            mine = [
                replace(answer, world=seed, ego=part - 1 if self._several else answer.ego)
                for row in rows
                for part, name in enumerate(row)
                for answer in noted.get(name, ())
            ]
            found[seed] = mine
        return found

    def recall(self, answers: Iterable[Answer]) -> None:
        """Let drivers take answers again where the question is the same.

        Args:
          answers: of worlds that run next; `world` is the seed.
        """
        by_world: dict[tuple[int, float], list[Answer]] = {}
        for answer in answers:
            by_world.setdefault((answer.world, answer.time), []).append(answer)
        if not by_world:
            return
        seeds, times = (sorted({key[k] for key in by_world}) for k in (0, 1))
        table = self._names([int(seed) for seed in seeds], times)
        for (seed, time), some in by_world.items():
            row = table[seeds.index(seed)][times.index(time)]
            for answer in some:
                for part, name in enumerate(row):
                    ego = 0 if self._several else answer.ego
                    if not self._several or part == answer.ego + 1:
                        for driver in self.drivers:
                            mine = driver.told.setdefault((name, ego), [])
                            if answer not in mine:
                                mine.append(answer)

    def _names(self, seeds: Sequence[int], times: Sequence[float]) -> list[list[list[bytes]]]:
        """Keys of decisions as bytes, `[seeds][times][1 + parts]`."""
        steps = np.round(np.asarray(times) / self._dt).astype(np.int32)
        keys = np.asarray(self._keys(np.asarray(seeds, np.int32), steps))
        return [[[key.tobytes() for key in row] for row in rows] for rows in keys]


def of_rows(
    answers: Mapping[int, Sequence[Answer]], seeds: NDArray[np.int64], egos: NDArray[np.int32]
) -> list[list[Answer]]:
    """The answers of each row of results."""
    rows = zip(seeds.tolist(), egos.tolist(), strict=True)
    return [[x for x in answers.get(seed, ()) if x.ego == ego] for seed, ego in rows]


def stored_answers(path: Path, scenario: str, policy: str, seed: int) -> list[Answer]:
    """The answers in a world of results; none where no model drove.

    Raises:
      ValueError: the file is damaged; the line.
    """
    file = answers_file(path, scenario, policy, seed)
    return read_answers(file) if file.is_file() else []


def recall(episodes: Any, path: Path, seeds: Iterable[int]) -> None:
    """Let a language model say again what results have of it.

    Args:
      episodes: of which some worlds run next.
      path: the results.
      seeds: of these worlds.
    """
    notes = getattr(episodes, "notes", None)
    if notes is not None and notes.drivers:
        for seed in seeds:
            notes.recall(stored_answers(path, episodes.scenario, episodes.policy, seed))


def check_seeds(episodes: Any, seeds: Sequence[int]) -> None:
    """Refuse to test a language model on seeds that taught its memory.

    Raises:
      ValueError: such a seed; one line.
    """
    notes = getattr(episodes, "notes", None)
    taught = {x.seed for driver in (notes.drivers if notes else ()) for x in driver.memories}
    if both := taught & set(seeds):
        label = f"{episodes.scenario}/{episodes.policy}"
        raise ValueError(f"{label}: seed {min(both)} taught the memory; test on others (--odd-seeds)")
