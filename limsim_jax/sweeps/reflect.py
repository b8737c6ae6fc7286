"""Lessons from failures: a language model looks back at its last decisions in worlds that went wrong.

Even seeds teach, odd seeds test (`policies.language.memory`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow.compute as pc

from limsim_jax.policies.language.driver import LanguageDriver
from limsim_jax.policies.language.memory import Memory, read_memories, write_memories
from limsim_jax.policies.language.store import Answer
from limsim_jax.sweeps.answers import stored_answers
from limsim_jax.sweeps.store import Results, ResultsError

LAST = 3
"""Decisions before a failure that are looked at."""

_FAILURES = ("contact", "off_road", "red_light")


def failed_decisions(
    results: Results, scenario: str, policy: str, last: int = LAST
) -> Iterator[tuple[int, list[Answer]]]:
    """Even seeds that went wrong, with the last decisions before that.

    An episode goes wrong by a contact, off the road, by a red light, or at its end without success.

    Args:
      results: of sweeps.
      scenario, policy: names.
      last: most decisions of an episode.
    """
    here = (pc.field("scenario") == scenario) & (pc.field("policy") == policy)
    rows = results.episodes.filter(here).to_pylist()
    moments = results.moments.filter(here & pc.field("kind").isin(_FAILURES)).to_pylist()
    first: dict[tuple[int, int], float] = {}
    for moment in moments:
        key, time = (moment["seed"], moment["ego"]), float(moment["time"])
        first[key] = min(time, first.get(key, time))
    for row in rows:
        key = row["seed"], row["ego"]
        if row["seed"] % 2 or (row.get("success") == 1 and key not in first):
            continue
        until = first.get(key, float("inf"))
        said = stored_answers(results.path, scenario, policy, row["seed"])
        mine = [x for x in said if x.ego == row["ego"] and x.decides and x.time <= until]
        if mine:
            yield row["seed"], mine[-last:]


def reflect(
    results: Results,
    driver: LanguageDriver,
    memory: str | Path,
    *,
    scenario: str,
    policy: str,
    last: int = LAST,
    say: Callable[[str], None] | None = None,
) -> list[Memory]:
    """Ask a model for its mistakes, and keep what it learns.

    A scene that is there already is learnt anew.

    Args:
      results: of a sweep with a language model.
      driver: asks the model.
      memory: file, made or added to.
      scenario, policy: names.
      last: most decisions of an episode.
      say: called with a line for each episode.

    Returns:
      All memories of the file.

    Raises:
      ResultsError: no model drove there on even seeds.
      ValueError: `memory` is no file of memories.
      OSError: it cannot be written.
    """
    known: dict[str, Memory] = {}
    if Path(memory).exists():
        known = {x.scene: x for x in read_memories(memory)}
    if not any(results.path.glob(f"answers/{scenario}/{policy}/*[02468].jsonl")):
        raise ResultsError(
            f"{results.path}: no answers of a language model on even seeds of {scenario} ({policy}); "
            "even seeds teach, odd ones test"
        )
    for seed, answers in failed_decisions(results, scenario, policy, last):
        learnt = driver.reflect(answers, seed)
        known |= {x.scene: x for x in learnt}
        if say is not None:
            say(f"seed {seed}: {len(learnt)} of {len(answers)} decisions corrected")
    write_memories(memory, list(known.values()))
    return list(known.values())
