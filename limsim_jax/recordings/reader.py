"""Which reader a file is for.

The kind of a file is told by its columns. Whatever makes a number mean something else (columns or values
missing, wrong units, a time twice) refuses the file with a `RecordingError`. Defects that real recordings
have here and there (time missing, bodies that overlap, a leader behind its follower) are listed in
`Recording.defects`, and calibration leaves these stretches out. A file is refused if more than
`checks.TOLERATED` of its rows have some.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from limsim_jax.maps.network import MapError, Network
from limsim_jax.recordings.carla_log import is_carla_log, parse_log
from limsim_jax.recordings.carla_tracks import read_carla_tracks
from limsim_jax.recordings.checks import TOLERATED, checked
from limsim_jax.recordings.columns import example, has_fields, read_columns
from limsim_jax.recordings.commonroad import read_commonroad, read_commonroad_tracks
from limsim_jax.recordings.highd import read_highd
from limsim_jax.recordings.ind import read_ind
from limsim_jax.recordings.lanelets import SPEED_LIMIT
from limsim_jax.recordings.ngsim import read_ngsim, read_pairs
from limsim_jax.recordings.openacc import read_openacc, read_platoon
from limsim_jax.recordings.recording import Recording, RecordingError, Source
from limsim_jax.recordings.scene_tables import read_scene_tables
from limsim_jax.recordings.table import Table, header_of, read_bytes
from limsim_jax.recordings.tgsim import read_tgsim
from limsim_jax.recordings.tracks import Tracks

# Columns that tell the kinds apart; readers name the others that they miss.
_READERS = (
    ({"pair_id", "frame_id"}, read_pairs),
    ({"xleaderreal", "xfollowerreal"}, read_tgsim),
    ({"trackid", "xcenter"}, read_ind),
    ({"laneid", "precedingid"}, read_highd),
    ({"vehicle_id", "frame_id", "local_y"}, read_ngsim),
)

KINDS = "NGSIM, TGSIM pairs, OpenACC, highD, inD, CommonRoad"


def read_recording(path: str | Path, *, tolerated: float = TOLERATED) -> Recording:
    """Read followers and leaders; of highD and inD the `..._tracks.csv`, with its meta files beside it.

    Args:
      path: of a file of NGSIM (feet, or the metric table of pairs), TGSIM pairs, OpenACC, highD, inD and
        its relatives (rounD, exiD, uniD), or CommonRoad; also gzipped.
      tolerated: share of the rows of followers that may have a leader behind or an overlap.

    Raises:
      RecordingError: what is wrong and where, in one line.
    """
    path = Path(path)
    data = read_bytes(path)
    if is_carla_log(data):
        raise RecordingError(
            f"{path}: is a recorder log of CARLA; `load_scene` replays it on the map of its town"
        )
    if _is_xml(data):
        try:
            return checked(read_commonroad(path, data), tolerated)
        except MapError as error:
            raise RecordingError(str(error)) from None
    columns = header_of(data)
    if columns[0] in ("Date", "Vehicle_order"):
        return checked(read_openacc(path, data), tolerated)
    known = {name.lower() for name in columns}
    for signs, reader in _READERS:
        if signs <= known:
            return checked(reader(Table.read(path, data)), tolerated)
    near = max(_READERS, key=lambda reader: len(reader[0] & known))[0]
    if near & known:
        missing = ", ".join(sorted(near - known))
        raise RecordingError(f"{path}: line 1: column {missing} is missing; found are {', '.join(columns)}")
    if has_fields(columns):
        return read_columns(path, tolerated=tolerated)
    raise RecordingError(
        f"{path}: line 1: no recording of a known kind ({KINDS}); found are {', '.join(columns)[:200]}; "
        f"{example(columns)}"
    )


def read_recordings(
    data: Any,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    length: float | None = None,
    tolerated: float = TOLERATED,
) -> list[Recording]:
    """Recordings of anything that holds followers and leaders.

    Args:
      data: a file of a known kind, a `Recording`, a table of one's own (see `columns`), or a sequence.
      columns: of a table of one's own, see `read_columns`.
      units: likewise.
      length: likewise, m.
      tolerated: share of the rows of followers that may have a leader behind or an overlap.

    Raises:
      RecordingError: what is wrong and where, in one line.
    """
    several = isinstance(data, Sequence) and not isinstance(data, (str, bytes))
    own = columns is not None or units is not None or length is not None

    def read(one: Any) -> Recording:
        if isinstance(one, Recording):
            return one
        if own or not isinstance(one, (str, Path)) or Path(one).suffix.lower() in (".parquet", ".pq"):
            return read_columns(one, columns=columns, units=units, length=length, tolerated=tolerated)
        return read_recording(one, tolerated=tolerated)

    found = [read(one) for one in (data if several else [data])]
    if several:  # tables have no names that tell their drivers apart
        found = [
            replace(one, source=f"data {k}") if one.source == "data" else one for k, one in enumerate(found)
        ]
    if not found:
        raise RecordingError("no recordings; at least one file or table is expected")
    return found


def as_recording(source: Source) -> Recording:
    """The recording itself, or the file read, with the errors of `read_recording`."""
    return source if isinstance(source, Recording) else read_recording(source)


def read_tracks(
    path: str | Path,
    scenario: str | None = None,
    *,
    span: tuple[float, float] | None = None,
    speed_limit: float = SPEED_LIMIT,
    network: Network | None = None,
    dt: float | None = None,
) -> Tracks:
    """Read the tracks of a recorded scene with its lanes.

    Args:
      path: a CommonRoad XML file, the table `scenes_vehicles.csv`, an OpenACC platoon, or a recorder log of
        CARLA; also gzipped.
      scenario: which one of the table; not needed if it has only one.
      span: s, begin and end of the stretch of an OpenACC recording: one in which no car comes by the same
        place twice. Other recordings are read whole.
      speed_limit: m/s, of the lanes: no recording tells it for all of them.
      network: of the town, for a log of CARLA, and for no other.
      dt: s per step, of a log of CARLA; None: as in the log, or 0.025 s if its frames are not evenly spaced.

    Raises:
      RecordingError: one line that names file, line and column or element, and what is expected.
    """
    path = Path(path)
    data = read_bytes(path)
    if is_carla_log(data):
        if network is None:
            town = parse_log(path, data).map
            raise RecordingError(f"{path}: map: was recorded in {town}; its OpenDRIVE file is expected")
        if span is not None or scenario is not None:
            raise RecordingError(f"{path}: a log of CARLA has neither `scenario` nor `span`")
        return read_carla_tracks(path, data, network, dt)
    if network is not None or dt is not None:
        message = "map, dt: expected of a log of CARLA, and of no other recording; it is none"
        raise RecordingError(f"{path}: {message}")
    platoon = not _is_xml(data) and header_of(data)[0] in ("Date", "Vehicle_order")
    if platoon != (span is not None):
        raise RecordingError(
            f"{path}: span: a stretch of s such as (60, 120) is expected of an OpenACC recording"
            + ("" if platoon else ", and of no other")
        )
    try:
        if span is not None:
            return read_platoon(path, span[0], span[1] - span[0], speed_limit=speed_limit)
        if _is_xml(data):
            return read_commonroad_tracks(path, data, speed_limit)
        return read_scene_tables(path, data, scenario, speed_limit)
    except MapError as error:
        raise RecordingError(str(error)) from None


def _is_xml(data: bytes) -> bool:
    return data[:200].lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


__all__ = ["KINDS", "as_recording", "read_recording", "read_recordings", "read_tracks"]
