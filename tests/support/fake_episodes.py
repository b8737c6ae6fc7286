"""Episodes without a simulator: rows from hashes of seeds. As a script: a sweep of them, to be killed.

python fake_episodes.py OUT SEEDS [--delay S] [--shard I/N]
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.sweeps.runner import sweep
from limsim_jax.sweeps.store import Outcome


@dataclass
class FakeEpisodes:
    """Every metric is a fixed function of the seed; some are not measured in some worlds."""

    scenario: str = "flat"
    policy: str = "still"
    chunk: int = 8
    horizon: float = 60.0
    delay: float = 0.0  # s per chunk
    columns: int = 4  # metrics besides the named ones
    failures: float = 0.1  # share of worlds
    version: str = "1"
    device: str = "abacus"
    breaks: tuple[int, ...] = ()  # seeds in which the policy fails
    note: Path | None = None  # where to write the id of the process for each chunk
    ran: list[int] = field(default_factory=list)
    compiled: int = 0

    @property
    def units(self) -> dict[str, str]:
        named = {
            "success": "1 if all went well",
            "contacts": "bodies touched",
            "distance": "m driven",
            "min_ttc": "s",
        }
        return named | {f"metric_{i}": "1" for i in range(self.columns)}

    def provenance(self) -> dict[str, Any]:
        text = f"scenario = '{self.scenario}'\nfailures = {self.failures}\n"
        made = {"experiment": text, "code": self.version, "packages": {"numpy": "2"}, "chunk": self.chunk}
        return {**made, "device": self.device}

    def compile(self) -> None:
        self.compiled += 1

    def run(self, seeds: Sequence[int]) -> Outcome:
        assert 1 <= len(seeds) <= self.chunk
        if self.note:
            with open(self.note, "a") as file:
                file.write(f"{os.getpid()} {seeds[0]}\n")
        time.sleep(self.delay)
        self.ran.extend(seeds)
        worlds = np.array(seeds, np.int64)
        u = np.stack([uniform(worlds, self.salt + i) for i in range(4 + self.columns)])
        failed = u[0] < self.failures
        metrics = {
            "success": (~failed).astype(np.float64),
            "contacts": failed * np.ceil(3 * u[1]),
            "distance": 500 + 500 * u[2],
            "min_ttc": np.where(u[3] < 0.3, np.nan, 5 * u[3]),
        }
        metrics |= {f"metric_{i}": u[4 + i] for i in range(self.columns)}
        n = failed.sum()
        moments = {
            "seed": np.repeat(worlds[failed], 2),
            "ego": np.zeros(2 * n, np.int32),
            "rank": np.tile([1, 2], n),
            "kind": np.tile(np.array(["contact", "near_miss"], object), n),
            "time": np.repeat(60 * u[1][failed], 2),
            "other": np.tile([3, -1], n),
            "value": np.repeat(u[2][failed], 2),
            "responsible": np.tile(np.array(["ego", None], object), n),
            "avoidable_by_ego": np.tile(np.array([True, None], object), n),
        }
        broken = worlds[np.isin(worlds, self.breaks)]
        if broken.size:
            own = {
                "kind": "policy_failed",
                "rank": 1,
                "time": 2.5,
                "other": -1,
                "reason": "my.py:3 in f: boom",
            }
            moments = {
                name: np.concatenate([moments.get(name, np.full(2 * n, None)), values])
                for name, values in {
                    **{name: np.full(broken.size, x, object) for name, x in own.items()},
                    "seed": broken, "ego": np.zeros(broken.size, np.int32),
                    **{x: np.full(broken.size, None) for x in ("value", "responsible", "avoidable_by_ego")},
                }.items()
            }  # fmt: skip
        egos = np.zeros(len(worlds), np.int32)
        return Outcome(worlds, egos, metrics, moments, mixed(worlds + 1000003 * self.salt))

    @property
    def salt(self) -> int:
        return sum(f"{self.scenario}/{self.policy}".encode())


def mixed(x: NDArray[np.int64]) -> NDArray[np.uint64]:
    """splitmix64 of each number."""
    z = x.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def uniform(x: NDArray[np.int64], salt: int) -> NDArray[np.float64]:
    """In [0, 1), from number and salt."""
    return (mixed(x + 7919 * salt) >> np.uint64(11)) / 2.0**53


def both(**options: Any) -> list[FakeEpisodes]:
    """Two scenarios, the second one with another policy."""
    return [FakeEpisodes(**options), FakeEpisodes("hilly", "bold", **options)]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("seeds", type=int)
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--shard")
    parser.add_argument("--device", default="abacus")
    options = parser.parse_args()
    shard = tuple(int(x) for x in options.shard.split("/")) if options.shard else None
    episodes = both(delay=options.delay, device=options.device)
    sweep(episodes, range(options.seeds), options.out, shard=shard)  # pyright: ignore[reportArgumentType]


if __name__ == "__main__":
    main()
