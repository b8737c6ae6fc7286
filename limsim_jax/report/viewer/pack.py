"""Numbers of a replay as bytes that deflate well."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from limsim_jax.maps.lane_map import LaneMap


class Pack:
    """Columns of whole numbers: differences along rows, signs in the last bit.

    The four bytes of the numbers lie in four planes: the upper ones are almost all 0 and vanish in
    deflate.
    """

    def __init__(self) -> None:
        self.columns: dict[str, list[int]] = {}  # offset (bytes), numbers, numbers per row, scale
        self.blocks: dict[str, list[int]] = {}  # offset, bytes
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, name: str, values: ArrayLike, scale: int) -> None:
        """Add `[..., K]`, rounded to 1 / `scale`."""
        values = np.atleast_1d(np.asarray(values, np.float64))
        whole = np.round(np.clip(values * scale, -(2**30), 2**30)).astype(np.int64)
        delta = np.diff(whole, axis=-1, prepend=0)
        unsigned = ((delta << 1) ^ (delta >> 63)).astype("<u4").reshape(-1)
        self.columns[name] = [self.size, unsigned.size, whole.shape[-1], scale]
        self.parts.append(unsigned.view(np.uint8).reshape(-1, 4).T.tobytes())
        self.size += len(self.parts[-1])

    def add_bytes(self, name: str, values: NDArray[Any]) -> None:
        """Add numbers of one byte as they are."""
        part = np.ascontiguousarray(values, np.uint8).tobytes()
        self.blocks[name] = [self.size, len(part)]
        self.parts.append(part)
        self.size += len(part)

    def add_points(self, name: str, xy: NDArray[np.float64], shift: NDArray[np.float64]) -> None:
        """Add points `[K, 2]` (file coordinates) to the centimetre, as `name`_x, `name`_y."""
        for axis, letter in enumerate("xy"):
            self.add(f"{name}_{letter}", xy[:, axis] - shift[axis], 100)


def origin(lane_map: LaneMap) -> NDArray[np.float64]:
    """The origin of a lane map in file coordinates, `[2]`, m."""
    return np.asarray(lane_map.origin, np.float64)


def held(x: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
    """`x [T, N]` where it is valid; elsewhere the last valid value, which costs no bytes."""
    steps = np.arange(len(x))[:, None]
    last = np.maximum.accumulate(np.where(valid, steps, -1))
    return np.where(last >= 0, np.take_along_axis(x, np.maximum(last, 0), 0), 0)
