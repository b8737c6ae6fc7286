"""Scenes that are remembered, as examples for questions about similar scenes.

Seeds of training and of tests are disjoint by construction: even seeds teach, odd seeds test.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from limsim_jax.files import write_whole
from limsim_jax.policies.language.scene import TTC_LIMIT, Facts, time_to_collision

_FAR, _FAST = 100.0, 30.0  # m and m/s: scales of the features


def train_seeds(count: int) -> list[int]:
    """The first even numbers."""
    return list(range(0, 2 * count, 2))


def test_seeds(count: int) -> list[int]:
    """The first odd numbers."""
    return list(range(1, 2 * count, 2))


test_seeds.__test__ = False  # pyright: ignore[reportFunctionMemberAccess]


def features(told: Facts) -> np.ndarray:
    """Numbers by which scenes are compared, between -1 and 1 or so; `[19]`.

    Args:
      told: facts of one ego, as numbers.
    """
    around = told.ahead, told.left_ahead, told.left_behind, told.right_ahead, told.right_behind
    numbers = [told.v / _FAST, told.limit / _FAST, np.sign(told.to_go), float(told.left), float(told.right)]
    for other in around:
        there = other.gap < _FAR
        numbers += [1 - other.gap / _FAR if there else 0.0, (other.v - told.v) / _FAST if there else 0.0]
    ttc = time_to_collision(told.ahead.gap, told.v - told.ahead.v)
    light = max(1 - told.light_distance / _FAR, 0.0)
    numbers += [1 - float(ttc) / TTC_LIMIT, light, light * float(told.light), told.to_go_within / 1e3]
    return np.clip(np.asarray(numbers, np.float64), -2, 2)


@dataclass(frozen=True)
class Memory:
    """One remembered scene.

    Attributes:
      seed: of the world, an even number.
      features: see `features`.
      scene: its description.
      answer: what is right.
    """

    seed: int
    features: tuple[float, ...]
    scene: str
    answer: str

    def __post_init__(self) -> None:
        if self.seed % 2:
            raise ValueError(f"seed {self.seed}: odd seeds are for tests; a memory learns from even ones")


def similar(memories: Sequence[Memory], told: Facts, count: int) -> list[Memory]:
    """The most similar scenes by cosine, the best one last.

    Args:
      memories: to look in.
      told: facts of one ego, as numbers.
      count: most memories.
    """
    if not memories or count < 1:
        return []
    table, wanted = np.asarray([x.features for x in memories]), features(told)
    norms = np.linalg.norm(table, axis=1) * np.linalg.norm(wanted)
    order = np.argsort(-(table @ wanted) / np.maximum(norms, 1e-9), kind="stable")[:count]
    return [memories[k] for k in order[::-1]]


def write_memories(path: str | Path, memories: Sequence[Memory]) -> None:
    """Write a file of JSON Lines.

    Raises:
      OSError: it cannot be written.
    """
    write_whole(path, "".join(json.dumps(asdict(x), ensure_ascii=False) + "\n" for x in memories))


def read_memories(path: str | Path) -> tuple[Memory, ...]:
    """The memories of a file.

    Raises:
      ValueError: a line that is none, by its number; a seed that is for tests.
      OSError: it cannot be read.
    """
    found = []
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines(), 1):
        try:
            row = json.loads(line)
            row = {**row, "features": tuple(map(float, row["features"])), "seed": int(row["seed"])}
        except (KeyError, TypeError, ValueError):
            raise ValueError(f"{path}: line {number} is no memory") from None
        found.append(Memory(**row))
    return tuple(found)
