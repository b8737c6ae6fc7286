"""Real worlds for workers of a cluster; a module of its own, so that they need no set-up of the tests."""

import os
from pathlib import Path

from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentFile


class Noted(Episodes):
    """A few vehicles for a few seconds; prints which process runs them."""

    def __init__(self, note: Path) -> None:
        ego = {"start": "1-", "s": 40.0, "goal": "3+", "policy": "constant_speed"}
        told = {"name": "small", "map": "roundabout", "horizon": 3.0, "slots": 8}
        super().__init__(
            ExperimentFile.model_validate(told | {"ego": ego, "traffic": {"vehicles": 6}}), chunk=2
        )
        self.note = note

    def compile(self):
        """The first chunk does: lowering with types checked, as in tests, is not possible."""

    def run(self, seeds):
        with open(self.note, "a") as file:
            file.write(f"{os.getpid()} {seeds[0]}\n")
        return super().run(seeds)


def noted(note: Path) -> list[Noted]:
    return [Noted(note)]
