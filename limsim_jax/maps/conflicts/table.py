"""The conflicts of a map as arrays of fixed size."""

from __future__ import annotations

import enum

import flax.struct
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array = np.ndarray | jax.Array

ABSENT = 1e6
"""Arc length (m) of a free slot: far ahead of everything."""


class ConflictType(enum.IntEnum):
    """How two paths meet."""

    NONE = 0  # padding
    CROSS = 1
    MERGE = 2  # they end in the same lane
    DIVERGE = 3  # they start in the same lane
    SWEEP = 4  # only the ends of long bodies in bends meet


@flax.struct.dataclass(kw_only=True)
class ConflictTable:
    """Conflicts of every connector: where they lie, and which vehicle yields.

    Rows are the `K - 1` connectors and, last, an inert null connector, so that -1 is a safe index.
    Connectors are the lanes inside junctions, and lanes elsewhere that share a successor or a
    predecessor with another lane.

    The `C` slots of a row hold its conflicts by ascending `s_in`. Free slots have `foe` -1, type
    `NONE` and arc lengths `ABSENT`. Two lanes that meet in several separate stretches have several
    entries. Every entry has a mirror image in the row of its foe, with `prio` and `tie` negated.

    All arc lengths are in metres from the start of the lane that they belong to.
    """

    lane: Int[Array, " K"]  # lane row of each connector, -1 in the null row
    connector: Int[Array, " L"]  # connector of each lane row, -1 for other lanes and the null lane
    movement: Int[Array, " K"]  # the movement through the connector; -1 if there is none or several
    length: Float[Array, " K"]  # m
    wait_s: Float[Array, " K"]  # m ahead along the movement, where to wait for foes inside; 0: nowhere
    clear_s: Float[Array, " K"]  # m, end of the last crossing or merging stretch; 0 without any
    cross_s: Float[Array, " K"]  # m, end of the last crossing stretch, to be kept clear; 0 without any
    must_stop: Bool[Array, " K"]  # begins at a stop sign
    approach: Float[Array, " K"]  # rad, heading of the traffic that comes to it
    foe: Int[Array, "K C"]  # connector
    s_in: Float[Array, "K C"]  # m, the stretch on the connector itself
    s_out: Float[Array, "K C"]
    f_in: Float[Array, "K C"]  # m, the stretch on the foe
    f_out: Float[Array, "K C"]
    hold: Float[Array, "K C"]  # m, where to wait for the foe without a body in the way of one with priority
    type: Int[Array, "K C"]  # ConflictType
    prio: Int[Array, "K C"]  # +1 goes before the foe, 0 equal, -1 yields
    tie: Int[Array, "K C"]  # the same between equals that arrive together (right before left), or 0
    # 1/m^2: two bodies of lengths l and l_foe meet in a sweep where l^2 sweep + l_foe^2 f_sweep > 1
    sweep: Float[Array, "K C"]
    f_sweep: Float[Array, "K C"]

    def pad(self, *, lanes: int, connectors: int, foes: int) -> ConflictTable:
        """The same table with more rows and slots; the null row stays last.

        `lanes` and `connectors` count the null rows, too. Raises `ValueError` if the table does not fit.
        """

        def null_last(x: Array, rows: int, fill: float) -> np.ndarray:
            x = np.asarray(x)
            shape = (rows, *x.shape[1:2]) if x.ndim == 1 else (rows, foes)
            if rows < x.shape[0] or (x.ndim == 2 and foes < x.shape[1]):
                raise ValueError(f"table of shape {x.shape} does not fit into {shape}")
            out = np.full(shape, fill, x.dtype)
            out[tuple(slice(n) for n in (x.shape[0] - 1, *x.shape[1:]))] = x[:-1]
            return out

        fills = {"foe": -1, "lane": -1, "connector": -1, "movement": -1, "length": 1.0}
        fills |= dict.fromkeys(("s_in", "s_out", "f_in", "f_out", "hold"), ABSENT)
        return ConflictTable(
            **{
                name: null_last(x, lanes if name == "connector" else connectors, fills.get(name, 0))
                for name, x in vars(self).items()
            }
        )
