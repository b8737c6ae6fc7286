"""`SignalTable`: signal programs as arrays, and what a light shows."""

from __future__ import annotations

import enum

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array = np.ndarray | jax.Array


class SignalState(enum.IntEnum):
    """What a light shows to one link.

    The comments give the letter in SUMO's state strings.
    """

    RED = 0  # r
    YELLOW = 1  # y
    GREEN_MINOR = 2  # g: go, but yield to those with priority
    GREEN_MAJOR = 3  # G: go, others yield
    RED_YELLOW = 4  # u: about to turn green
    STOP = 5  # s: stop, then go as at a stop sign (green arrow)
    OFF_BLINKING = 6  # o: out of order, yield
    OFF = 7  # O: out of order, has right of way; also where there is no light


@flax.struct.dataclass(kw_only=True)
class SignalTable:
    """Signal programs as arrays.

    There are `G - 1` programs and, last, one that is off, with `P` phases and `S` links each. Lanes and
    movements without a light have program -1 and link -1, which read as `OFF`.
    """

    duration: Float[Array, "G P"]  # s, 0 beyond the last phase
    min_duration: Float[Array, "G P"]  # s, equal to `duration` where phases are fixed
    max_duration: Float[Array, "G P"]  # s
    next_phase: Int[Array, "G P"]  # the one that follows, or the first of those that may
    state: Int[Array, "G P S"]  # SignalState
    offset: Float[Array, " G"]  # s
    cycle: Float[Array, " G"]  # s
    num_phases: Int[Array, " G"]
    actuated: Bool[Array, " G"]
    lane_program: Int[Array, " L"]  # light at the entry of each lane: the first connector of movements
    lane_link: Int[Array, " L"]
    movement_program: Int[Array, " M"]  # the same by movement; null movement last
    movement_link: Int[Array, " M"]

    def pad(self, *, programs: int, phases: int, links: int, lanes: int, movements: int) -> SignalTable:
        """The same table with these sizes, null rows included.

        Raises `ValueError` if it does not fit.
        """
        sizes = {"G": programs, "P": phases, "S": links, "L": lanes, "M": movements}
        off = {"duration": 1.0, "min_duration": 1.0, "max_duration": 1.0, "state": SignalState.OFF}
        off |= {"cycle": 1.0, "num_phases": 1}

        def grow(name: str, x: np.ndarray, axes: str) -> np.ndarray:
            shape = tuple(sizes[axis] for axis in axes)
            if any(n > m for n, m in zip(x.shape, shape, strict=True)):
                raise ValueError(f"{name} of shape {x.shape} does not fit into {shape}")
            out = np.full(shape, -1 if axes in "LM" else 0, x.dtype)
            out[tuple(slice(n) for n in (x.shape[0] - 1, *x.shape[1:]))] = x[:-1]
            if axes[0] == "G":  # new programs are off, like the null program
                out[x.shape[0] - 1 :] = 0
                first = (
                    slice(x.shape[0] - 1, None),
                    *(slice(0, 1) if a == "P" else slice(None) for a in axes[1:]),
                )
                out[first] = off.get(name, 0)
            return out

        axes = {"state": "GPS", "offset": "G", "cycle": "G", "num_phases": "G", "actuated": "G"}
        axes |= {"lane_program": "L", "lane_link": "L", "movement_program": "M", "movement_link": "M"}
        return SignalTable(
            **{name: grow(name, np.asarray(x), axes.get(name, "GP")) for name, x in vars(self).items()}
        )
