"""Worlds that a search asks for by their random numbers: run once, and kept on disk."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limsim_jax.files import write_whole
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.events import Event, event_of
from limsim_jax.sweeps.numbered import Numbered, policy_seeds
from limsim_jax.sweeps.store import NOT_COMPARED, ResultsError

Tell = Callable[[int, int], None]
"""Is told how many worlds have run, and how many will at most."""

KINDS = {"results.json": "a sweep", "estimate.json": "an estimate", "adversary.json": "an adversary"}
"""Files that say what a folder holds."""


def event_in(episodes: Episodes, event: str) -> Event:
    """The event that is looked for in worlds with random numbers.

    Raises:
      ValueError: no ego, an unknown event, or nothing random; one line.
    """
    if not episodes.egos:
        raise ValueError(f"{episodes.scenario}: ego: there is none, so no event of one; add an [ego]")
    wanted = event_of(event, episodes.units)
    if not episodes.layout.size:
        raise ValueError(f"{episodes.scenario}: nothing is random in its worlds; one run says it all")
    return wanted


class Log:
    """Metrics of batches on disk, in the order of their calls.

    Args:
      folder: where; None: nothing is kept.
      name: of the file that says how the worlds came about, one of `KINDS`.
      about: how they came about; a folder that says otherwise is refused.
      fresh: remove what the folder holds of the same kind.

    Raises:
      ResultsError: the folder holds something else; one line.
    """

    def __init__(self, folder: Path | None, name: str, about: Mapping[str, Any], fresh: bool) -> None:
        self.folder, self._next, self._name = folder, 0, name
        if folder is None:
            return
        for other, kind in KINDS.items():
            if other != name and (folder / other).exists():
                raise ResultsError(f"{folder}: holds the results of {kind}; name another folder with --out")
        index = folder / name
        if fresh and index.exists():
            shutil.rmtree(folder / "worlds", ignore_errors=True)
            (folder / "failures.npz").unlink(missing_ok=True)
            index.unlink()
        (folder / "worlds").mkdir(parents=True, exist_ok=True)
        self._about = json.loads(json.dumps(about))
        if index.exists():
            try:
                there = json.loads(index.read_text(encoding="utf-8"))["made_by"]
            except (ValueError, KeyError, TypeError):
                raise ResultsError(
                    f"{index}: damaged; remove the folder, or start anew with --fresh"
                ) from None
            if (differs := _difference(there, self._about)) is not None:
                raise ResultsError(f"{folder}: made with {differs}; use another folder, or --fresh")
        self.write({})

    def write(self, found: Mapping[str, Any]) -> None:
        """Put down how it is made, and what was found."""
        if self.folder is not None:
            text = json.dumps({"made_by": self._about, **found}, indent=1)
            write_whole(self.folder / self._name, (text + "\n").encode())

    def failures(
        self,
        values: NDArray[np.float32],
        metrics: Sequence[Mapping[str, float]],
        names: Sequence[str],
        **more: Any,
    ) -> None:
        """Keep worlds with the event, if there are any: random numbers `[M, D]`, and metrics by name."""
        if self.folder is None or not len(values):
            return
        data, table = io.BytesIO(), np.array([[row[name] for name in names] for row in metrics])
        np.savez_compressed(data, values=values, names=names, metrics=table, **more)
        write_whole(self.folder / "failures.npz", data.getvalue())

    def batch(
        self, values: NDArray[np.float32], run: Callable[[], tuple[list[str], NDArray[np.float64]]]
    ) -> tuple[list[str], NDArray[np.float64]]:
        """Metrics of worlds: those on disk, or those of a run."""
        number, self._next = self._next, self._next + 1
        if self.folder is None:
            return run()
        path = self.folder / "worlds" / f"{number:06d}.npz"
        mark = hashlib.blake2b(values.tobytes(), digest_size=16).hexdigest()
        try:
            with np.load(path) as kept:
                if str(kept["mark"]) == mark:
                    return kept["names"].tolist(), kept["metrics"]
        except FileNotFoundError:
            pass
        except Exception:  # a damaged file is run again
            path.unlink(missing_ok=True)
        names, metrics = run()
        data = io.BytesIO()
        np.savez_compressed(data, mark=mark, names=names, metrics=metrics)
        write_whole(path, data.getvalue())
        return names, metrics


def _difference(there: Mapping[str, Any], here: Mapping[str, Any]) -> str | None:
    for name in sorted({*there, *here} - NOT_COMPARED):
        if there.get(name) != here.get(name):
            if isinstance(there.get(name), dict) and isinstance(here.get(name), dict):
                return _difference(there[name], here[name]) or name
            if name == "source":
                return "another version of limsim_jax"
            return f"{name} = {str(there.get(name))[:60]}, now {str(here.get(name))[:60]}"
    return None


class Asked:
    """The limit state of worlds, from their random numbers."""

    def __init__(self, episodes: Episodes, event: Event, log: Log, tell: Tell | None, most: int) -> None:
        self.layout = episodes.layout
        self.event, self._log, self._tell, self._most = event, log, tell, most
        self._worlds = Numbered(episodes)
        self.count, self.ran = 0, 0
        self.exposure: tuple[float, float] | None = None  # hours and km per episode
        self.found: dict[bytes, dict[str, float]] = {}  # metrics of worlds with the event

    def show(self, values: NDArray[np.float32]) -> Episodes:
        """Episodes whose seed k is row k of these random numbers."""
        return self._worlds.show(values, policy_seeds(values))

    def __call__(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Limit states `[B]` of worlds from standard normals `[B, D]`."""
        values = self.layout.from_normals(z)
        names, metrics = self._log.batch(values, lambda: self._run(values))
        columns = dict(zip(names, metrics, strict=True))
        g = self.event.limit(columns).reshape(len(z), -1)
        if self.exposure is None:  # the first batch of every method is of plain worlds
            hours, km = (np.nansum(columns[x]) / len(z) for x in ("duration", "distance"))
            self.exposure = float(hours) / 3600, float(km) / 1e3
        worst = g.argmin(1)
        for k in np.flatnonzero(g.min(1) <= 0):
            row = int(k) * self._worlds.each + int(worst[k])
            self.found[values[k].tobytes()] = {name: float(x[row]) for name, x in columns.items()}
        self.count += len(z)
        if self._tell is not None:
            self._tell(self.count, self._most)
        return g.min(1)

    def _run(self, values: NDArray[np.float32]) -> tuple[list[str], NDArray[np.float64]]:
        tell = self._tell
        metrics = self._worlds.run(
            values, policy_seeds(values), tell and (lambda done: tell(self.count + done, self._most))
        )
        self.ran += len(values)
        return list(metrics), np.stack(list(metrics.values()))
