"""What the recordings of leveLXData (highD, inD and relatives) share: meta files beside the tracks."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from limsim_jax.recordings.recording import CLASSES, Ints, RecordingError
from limsim_jax.recordings.table import Table, read_bytes


@dataclass(frozen=True)
class Meta:
    """`..._tracksMeta.csv` by track, and the row of `..._recordingMeta.csv`."""

    tracks: Mapping[int, Mapping[str, str]]
    frame_rate: float  # 1/s
    speed_limit: float  # m/s, NaN: none

    def per_track(self, table: Table, ident: Ints, column: str) -> NDArray[np.str_]:
        """A column of the tracks' meta file, per row, in small letters.

        Raises:
          RecordingError: a track is not in the meta file.
        """
        known, index = np.unique(ident, return_inverse=True)
        values = []
        for k, track in enumerate(known.tolist()):
            if column not in self.tracks.get(track, {}):
                row = int(np.argmax(index == k))
                key = "id" if "id" in table else "trackId"
                table.refuse(key, row, f"{track} has no {column} in tracksMeta")
            values.append(self.tracks[track][column].strip().lower())
        return np.array(values)[index]


def read_meta(source: str, key: str) -> Meta:
    """The meta files beside `..._tracks.csv`.

    Args:
      source: file of the tracks.
      key: column of the tracks' ids.

    Raises:
      RecordingError: a file or column is missing, or a value is no number.
    """
    path = Path(source)
    if "_tracks" not in path.name:
        raise RecordingError(f"{path}: is expected to be named ..._tracks.csv, with its meta files beside it")
    found: list[list[dict[str, str]]] = []
    for kind in ("tracksMeta", "recordingMeta"):
        other = path.with_name(path.name.replace("_tracks", f"_{kind}", 1))
        rows = list(csv.DictReader(read_bytes(other).decode("utf-8-sig", "replace").splitlines()))
        if not rows:
            raise RecordingError(f"{other}: line 2: no rows; the file ends after its header")
        needed = (key, "class") if kind == "tracksMeta" else ("frameRate",)
        for column in needed:
            if column not in rows[0]:
                raise RecordingError(
                    f"{other}: line 1: column {column} is missing; found are {', '.join(rows[0])}"
                )
        found.append(rows)
    tracks, (meta, *_) = found
    try:
        rate = float(meta["frameRate"])
        if not 1 <= rate <= 100:
            raise ValueError
        limit = float(meta.get("speedLimit") or "nan")
        by_track = {int(float(row[key])): row for row in tracks}
    except ValueError:
        other = path.with_name(path.name.replace("_tracks", "_recordingMeta", 1))
        raise RecordingError(
            f"{other}: line 2, column frameRate: '{meta['frameRate']}'; 1 to 100 frames a second, and "
            f"numbers for {key}, are expected"
        ) from None
    return Meta(by_track, rate, limit if limit > 0 else math.nan)


def classes_of(table: Table, kinds: NDArray[np.str_]) -> Ints:
    """Vehicle class of each row. Raises `RecordingError` for an unknown kind."""
    known, index = np.unique(kinds, return_inverse=True)
    for k, kind in enumerate(known.tolist()):
        if kind not in CLASSES:
            row = int(np.argmax(index == k))
            raise RecordingError(
                f"{table.source}: line {table.lines[row]}: class '{kind}' in tracksMeta; one of "
                f"{', '.join(CLASSES)} is expected"
            )
    return np.array([CLASSES[kind] for kind in known.tolist()])[index]


__all__ = ["Meta", "classes_of", "read_meta"]
