"""From recordings to car-following data that fit together: position, speed and gap of one motion.

Only positions are smoothed (Savitzky-Golay, 1 s, cubic); speeds are their derivative, and positions are
integrated from these again with the trapezoid rule, which is what the ballistic step of the simulator does.
So gap, speed and the leader's speed of a `Segment` obey

    gap[k+1] - gap[k] = dt / 2 (v_lead[k] + v_lead[k+1] - v[k] - v[k+1])

A segment has one follower and one leader. It is cut where the leader changes, where time is missing, at
defects, and around lane changes. What is cut and why stands in the `Quality` of the file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from limsim_jax.recordings import Recording, RecordingError
from limsim_jax.recordings.checks import check_rows, impossible
from limsim_jax.recordings.recording import FASTEST

SMOOTHING = 1.0
"""s, width of the window."""

LEADER_CHANGE, LANE_CHANGE = 1.0, 2.0
"""s, how much is dropped on either side."""

CONSISTENT = 0.4
"""m/s, least agreement (root mean square) of speeds from smoothed positions with recorded ones."""

SHORTEST = 20.0
"""s, of a segment."""

STANDING_SHARE = 0.8
"""Of a segment, from which on it tells nothing but a gap at rest."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A follower behind one leader, `T` samples in steps of `dt`.

    Raises:
      ValueError: series of unequal length, or a value that cannot be; one line that names it.
    """

    driver: str  # unique over the files
    leader: str
    source: str
    line: int  # of the file, where it begins
    dt: float  # s
    time: float  # s, of the first sample
    vehicle_class: int
    gap: Floats  # m, bumper to bumper
    v: Floats  # m/s
    v_lead: Floats  # m/s
    length_lead: float = 4.5  # m

    def __post_init__(self) -> None:
        """Refuse what cannot be."""

        def refuse(what: str) -> NoReturn:
            raise ValueError(f"segment of driver '{self.driver}': {what} is expected")

        for name in ("dt", "length_lead"):
            if not 0 < getattr(self, name) < math.inf:
                refuse(f"{name} = {getattr(self, name):g}; a finite number above 0")
        for name in ("gap", "v", "v_lead"):
            values = np.asarray(getattr(self, name), float)
            if values.shape != (np.size(self.gap),):
                refuse(f"{name} has shape {values.shape}, gap {np.shape(self.gap)}; one axis of equal length")
            if name == "gap":
                good, usual = (values > 0) & (values < math.inf), "a finite gap above 0 m"
            else:
                good, usual = (values >= 0) & (values <= FASTEST), f"a speed from 0 to {FASTEST:g} m/s"
            if not good.all():
                k = int(np.argmin(good))
                refuse(f"{name}[{k}] = {values[k]:g}; {usual}")
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.gap)

    @property
    def duration(self) -> float:
        """s."""
        return len(self) * self.dt

    def part(self, begin: int, end: int) -> Segment:
        """Samples `begin` to `end`."""
        values = {name: getattr(self, name)[begin:end] for name in ("gap", "v", "v_lead")}
        return replace(self, **values, time=self.time + begin * self.dt)


@dataclass(kw_only=True)
class Quality:
    """What a file holds, and how much of it is kept."""

    source: str
    kind: str
    human: bool
    rows: int
    followers: int
    dt: float  # s, of the file
    recorded: float  # s, of followers behind leaders
    kept: float = 0.0  # s
    segments: int = 0
    drivers: int = 0
    speed_rms: float = float("nan")  # m/s, recorded speeds against those of smoothed positions
    moved_rms: float = float("nan")  # m, what smoothing changed of the gap
    dropped: dict[str, float] = field(default_factory=dict)  # reason: s
    findings: list[str] = field(default_factory=list)  # defects with line and column, files left out

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return dict(vars(self))


def segments(
    recording: Recording,
    *,
    dt: float = 0.1,
    shortest: float = SHORTEST,
    smoothing: float = SMOOTHING,
    margins: bool = True,
) -> tuple[list[Segment], Quality]:
    """Car-following segments of a recording, and how good it is.

    Args:
      recording: of any kind.
      dt: s, time step of the result; recordings in coarser or finer steps are interpolated.
      shortest: s, shorter segments are dropped.
      smoothing: s, window of the smoothing of positions; 0: none.
      margins: drop what is next to changes of the leader or the lane.

    Raises:
      RecordingError: a row of a follower is broken, or nothing is left.
    """
    check_rows(recording)
    r = recording
    following = r.leader >= 0
    quality = Quality(
        source=r.source,
        kind=r.kind,
        human=r.human,
        rows=len(r),
        followers=len(np.unique(r.vehicle[following])),
        dt=r.dt,
        recorded=float(following.sum() * r.dt),
        findings=[defect.message for defect in r.defects],
    )
    bad = _bad(r, quality, margins)
    found: list[Segment] = []
    errors: list[tuple[Floats, Floats]] = []
    starts, ends = _stretches(r, bad)
    for begin, end in zip(starts.tolist(), ends.tolist(), strict=True):
        rows = slice(begin, end)
        if (r.time[end - 1] - r.time[begin]) < shortest - 1.5 * r.dt:
            _drop(quality, f"shorter than {shortest:g} s", (end - begin) * r.dt)
            continue
        made = _segment(r, rows, dt, smoothing)
        if made is None:
            _drop(quality, "bodies that touch once smoothed", (end - begin) * r.dt)
            continue
        segment, off, moved = made
        if np.mean(segment.v < 0.1) > STANDING_SHARE:
            _drop(quality, "the follower hardly moves", (end - begin) * r.dt)
            continue
        rms = max(_rms(off[0]), _rms(off[1]))
        if rms > CONSISTENT:
            _drop(quality, "speeds and positions disagree", (end - begin) * r.dt)
            place = f"{r.row} {r.line[begin]}, column {r.columns.get('v', 'v')}"
            quality.findings.append(
                f"{place}: speeds of {_name(r, begin)} behind {r.names[r.leader[begin]]} and their spacing "
                f"disagree by {rms:.2f} m/s; less than {CONSISTENT:g} m/s is expected"
            )
            continue
        found.append(segment)
        errors.append((np.concatenate(off), moved))
    if not found:
        why = ", ".join(f"{reason}: {seconds:.0f} s" for reason, seconds in quality.dropped.items())
        raise RecordingError(
            f"{r.source}: {r.row} {r.line[0]}: no vehicle follows a leader for {shortest:g} s; of "
            f"{quality.recorded:.0f} s recorded were dropped: {why or 'none'}; a smaller `shortest` "
            "(--shortest) admits short stretches"
        )
    quality.kept = sum(segment.duration for segment in found)
    quality.segments = len(found)
    quality.drivers = len({segment.driver for segment in found})
    off, moved = (np.concatenate(column) for column in zip(*errors, strict=True))
    quality.speed_rms, quality.moved_rms = _rms(off), _rms(moved)
    return found, quality


def _drop(quality: Quality, reason: str, seconds: float) -> None:
    if seconds > 0:
        quality.dropped[reason] = quality.dropped.get(reason, 0.0) + seconds


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x[np.isfinite(x)] ** 2))) if np.isfinite(x).any() else 0.0


def _name(r: Recording, row: int) -> str:
    return r.names[r.vehicle[row]]


def _bad(r: Recording, quality: Quality, margins: bool) -> NDArray[np.bool_]:
    """Rows that are not used, with the reasons counted."""
    none = r.leader < 0
    overlap = ~none & ~(r.gap > 0)
    _drop(quality, "overlapping bodies or a leader behind", float(overlap.sum() * r.dt))
    speeds = ~none & ~overlap & (impossible(r, "v") | impossible(r, "v_lead"))
    _drop(quality, "impossible speeds", float(speeds.sum() * r.dt))
    new = np.diff(r.vehicle, prepend=-1) != 0
    # Around changes of the own lane, and where the leader has changed or time is missing.
    changes = {"a lane change": (LANE_CHANGE, (np.diff(r.lane, prepend=r.lane[:1]) != 0) & ~new)}
    leader = np.diff(r.leader, prepend=r.leader[:1]) != 0
    changes["a change of the leader"] = (LEADER_CHANGE, leader & ~new)
    bad = none | overlap | speeds
    if not margins:
        changes.clear()
    # With the defects of a pair goes what is next to them.
    changes["a defect"] = (LEADER_CHANGE, overlap | speeds)
    for reason, (margin, at) in changes.items():
        near = _around(r, at, margin) & ~bad
        _drop(quality, f"near {reason}", float(near.sum() * r.dt))
        bad |= near
    return bad


def _around(r: Recording, at: NDArray[np.bool_], margin: float) -> NDArray[np.bool_]:
    """Rows of the same vehicle within `margin` seconds of marked ones."""
    near = np.zeros(len(at), bool)
    for k in np.flatnonzero(at):
        first = k
        while first > 0 and r.vehicle[first - 1] == r.vehicle[k] and r.time[k] - r.time[first - 1] <= margin:
            first -= 1
        last = k
        while (
            last + 1 < len(at)
            and r.vehicle[last + 1] == r.vehicle[k]
            and r.time[last + 1] - r.time[k] <= margin
        ):
            last += 1
        near[first : last + 1] = True
    return near


def _stretches(r: Recording, bad: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows without a break: begin and end of each stretch."""
    same = (
        (np.diff(r.vehicle) == 0)
        & (np.diff(r.leader) == 0)
        & (np.diff(r.time) < 1.5 * r.dt)
        & ~bad[1:]
        & ~bad[:-1]
    )
    good = ~bad
    starts = np.flatnonzero(good & np.concatenate([[True], ~same]))
    ends = np.flatnonzero(good & np.concatenate([~same, [True]])) + 1
    return starts, ends


def _segment(
    r: Recording, rows: slice, dt: float, smoothing: float
) -> tuple[Segment, tuple[Floats, Floats], Floats] | None:
    """A segment, and its differences from recorded speeds and gaps; None if bodies touch."""
    time = r.time[rows]
    x_lead, v_lead = _motion(r.x_lead[rows], r.dt, smoothing)
    x, v = _motion(r.x[rows], r.dt, smoothing)
    gap = x_lead - x - np.median(r.length_lead[rows])
    speeds = (v - r.v[rows], v_lead - r.v_lead[rows])
    moved = gap - r.gap[rows]
    if abs(r.dt - dt) > 1e-6:
        grid = np.arange(time[0], time[-1] + 1e-6, dt)
        v, v_lead, first = np.interp(grid, time, v), np.interp(grid, time, v_lead), gap[0]
        gap = first + _integral(v_lead - v, dt)
    if gap.min() <= 0:
        return None
    where = f"{r.names[r.vehicle[rows.start]]}"
    return (
        Segment(
            driver=where,
            leader=r.names[r.leader[rows.start]],
            source=r.source,
            line=int(r.line[rows.start]),
            dt=dt,
            time=float(time[0]),
            vehicle_class=int(r.vehicle_class[rows.start]),
            gap=gap,
            v=v,
            v_lead=v_lead,
            length_lead=float(np.median(r.length_lead[rows])),
        ),
        speeds,
        moved,
    )


def _motion(x: Floats, dt: float, smoothing: float) -> tuple[Floats, Floats]:
    """Smoothed positions and speeds; positions are the trapezoid integral of speeds."""
    window = max(2 * round(smoothing / dt / 2) + 1, 5) if smoothing > 0 else 3
    if len(x) < window:
        window = 3
    origin = x[0]
    if smoothing > 0 and window > 3:
        smooth = np.asarray(savgol_filter(x - origin, window, 3))
        v = np.asarray(savgol_filter(x - origin, window, 3, deriv=1, delta=dt))
    else:
        smooth, v = x - origin, np.gradient(x, dt)
    v = np.maximum(v, 0.0)
    integrated = _integral(v, dt)
    return origin + integrated + np.mean(smooth - integrated), v


def _integral(v: Floats, dt: float) -> Floats:
    return np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * dt)])


def by_driver(found: Iterable[Segment]) -> dict[str, list[Segment]]:
    """Segments of each driver."""
    drivers: dict[str, list[Segment]] = {}
    for segment in found:
        drivers.setdefault(segment.driver, []).append(segment)
    return drivers


def split_in_time(
    found: Sequence[Segment], share: float = 0.6, shortest: float = 5.0
) -> tuple[list[Segment], list[Segment]]:
    """The first `share` of every driver's time, and the rest; without pieces shorter than `shortest` s."""
    first, second = [], []
    for parts in by_driver(found).values():
        ordered = sorted(parts, key=lambda segment: segment.time)
        left = share * sum(len(segment) for segment in ordered)
        for segment in ordered:
            cut = int(min(max(left, 0), len(segment)))
            left -= len(segment)
            least = shortest / segment.dt
            if len(segment) - cut < least and cut > least:
                cut = len(segment)
            elif cut < least and len(segment) - cut > least:
                cut = 0
            if cut >= least:
                first.append(segment.part(0, cut))
            if len(segment) - cut >= least:
                second.append(segment.part(cut, len(segment)))
    return first, second


__all__ = [
    "CONSISTENT",
    "LANE_CHANGE",
    "LEADER_CHANGE",
    "SHORTEST",
    "SMOOTHING",
    "STANDING_SHARE",
    "Quality",
    "Segment",
    "by_driver",
    "segments",
    "split_in_time",
]
