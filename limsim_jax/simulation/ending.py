"""Where the episode of an ego ends: it arrives, or it leaves the road."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from limsim_jax.simulation.trace import Trace

AFTER = 2.0
"""s of traffic to show after the ego has gone."""


class Ending(NamedTuple):
    """The last step of an ego, and how it ends."""

    step: int  # the last one at which the ego is there
    arrived: bool  # it leaves in the next step at its goal


def ending(trace: Trace, ego: int) -> Ending | None:
    """The end of the first vehicle in a slot.

    It has arrived if it has 0 m to go in the step in which it is gone.

    Args:
      trace: `[T, ...]`.
      ego: slot.

    Returns:
      None if no vehicle is ever in the slot.
    """
    active, vehicle = np.asarray(trace.active)[:, ego], np.asarray(trace.vehicle)[:, ego]
    there = np.flatnonzero(active)
    if not there.size:
        return None
    first = int(there[0])
    stays = active[first:] & (vehicle[first:] == vehicle[first])
    last = first + (int(np.argmin(stays)) - 1 if not stays.all() else len(stays) - 1)
    if trace.to_go is None or trace.driven is None or np.asarray(trace.driven)[first, :1].tolist() != [ego]:
        return Ending(last, False)
    return Ending(last, bool((np.asarray(trace.to_go)[last + 1 : last + 2] <= 0).any()))


def shown_steps(time: NDArray[Any], end: Ending | None, moments: NDArray[Any] | None = None) -> int:
    """How many steps to show: until `AFTER` s after the end, and at least until the last moment (s)."""
    if end is None:
        return len(time)
    until = float(time[end.step]) + AFTER
    if moments is not None and moments.size:
        until = max(until, float(np.max(moments)) + AFTER)
    return int(np.searchsorted(time, until + 1e-6, side="right"))


class Watch:
    """Tells when all egos have been gone for some time.

    Args:
      egos: slot of the ego of each world.
      after: s that a world goes on without its ego.
    """

    def __init__(self, egos: Sequence[int], after: float) -> None:
        self.egos, self.after = egos, after
        self._seen: list[list[Trace]] = [[] for _ in egos]

    def __call__(self, records: Trace) -> bool:
        """Whether it is so. Without egos it never is.

        Args:
          records: the next steps of all worlds, `[W, T, ...]`.
        """
        if records.driven is None or records.to_go is None:
            return False
        gone = True
        for k, (ego, seen) in enumerate(zip(self.egos, self._seen, strict=True)):
            fields: dict[str, Any] = dict.fromkeys(Trace._fields)
            fields |= {name: getattr(records, name)[k] for name in ("time", "to_go", "driven")}
            fields |= {name: getattr(records, name)[k, :, : ego + 1] for name in ("active", "vehicle")}
            seen.append(Trace(**fields))
            seen[:] = [jax.tree.map(lambda *x: np.concatenate(x), *seen)]
            end = ending(seen[0], ego)
            gone &= end is not None and bool(seen[0].time[-1] > seen[0].time[end.step] + self.after)
        return gone
