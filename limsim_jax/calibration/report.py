"""Recordings in, calibrated drivers out: `calibrate`, which the command line has as well."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import SHORTEST, Quality, Segment, segments, split_in_time
from limsim_jax.calibration.fit import Fit, errors, fit, stack
from limsim_jax.calibration.parameters import Box, check_positive
from limsim_jax.calibration.population import estimate, few_drivers, predictive_check
from limsim_jax.calibration.result import PUBLISHED, Calibration, common_limit
from limsim_jax.calibration.uncertainty import uncertainty
from limsim_jax.recordings import Recording, RecordingError, Source, as_recording, read_recordings
from limsim_jax.recordings.checks import TOLERATED
from limsim_jax.traffic.car_following import IDM, CarFollowing

Floats = NDArray[np.float64]


def calibrate(
    data: Any,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    length: float | None = None,
    tolerated: float = TOLERATED,
    model: CarFollowing = IDM(),
    objective: str = "mixed",
    method: str = "lm",
    shortest: float = SHORTEST,
    first: float = 0.6,
    starts: int | None = None,
    bounds: Mapping[str, Sequence[float]] | None = None,
    speed_limit: float | None = None,
    seed: int = 0,
) -> Calibration:
    """Calibrate the drivers of recordings, validate them, and estimate their population.

    `data` is one recording or a sequence of them, each one of

    - a file of NGSIM, TGSIM pairs, OpenACC, highD, inD or CommonRoad: its kind is told by its columns;
    - a CSV or Parquet file, a pandas or pyarrow table, or a mapping of arrays, with these columns:

    | field | what | unit |
    |---|---|---|
    | `time` | time; steps of 0.01 to 0.5 s | s |
    | `x`, `x_lead` | position of follower and leader along the road, of the same point of both | m |
    | `gap` | from bumper to bumper; instead of `x_lead`, or of both positions together with speeds | m |
    | `v`, `v_lead` | speeds; where they are missing, those of the positions | m/s |
    | `length_lead` | length of the leader; or one number, `length`, for all | m |
    | `id`, `id_lead` | names of follower and leader; without them all rows are of one pair | |

    Args:
      data: see above.
      columns: column of each field, as in `{"time": "t", "x_lead": "leader", "x": "follower"}`; fields whose
        columns are named like them may be left out.
      units: of fields in other units, as in `{"x": "km", "v": "km/h"}`: km, cm, ft, mi; km/h, mph, ft/s; ms,
        min, h. That of `x` holds for `x_lead` and that of `v` for `v_lead` as well.
      length: m, of the leaders.
      tolerated: share of the rows of a file that may have a leader behind or an overlap; they are left out.
      model: of car following.
      objective: what is minimised, see `fit.residuals`.
      method: "lm", "lbfgs" or "adam".
      shortest: s, shorter segments are left out.
      first: share of every driver's time that is calibrated with; the rest validates.
      starts: descents per driver, see `fit`.
      bounds: of fitted parameters, as in `{"T": (0.1, 4.0)}`; others keep theirs, which are v0 5 to 45 m/s,
        T 0.3 to 4 s, s0 0.5 to 8 m, a 0.3 to 4 m/s^2, b 0.5 to 5 m/s^2. The result tells which bounds bind.
      speed_limit: m/s, of the recorded road, to which desired speeds of the population are related; None: the
        limit in the recordings, if they tell one.
      seed: of all that is random.

    Raises:
      RecordingError: the data cannot be used: a file is none, a column is missing, a value is no finite
        number or impossible; one line that names it.
      ValueError: an argument is not as it should be.
    """
    begin = time.perf_counter()
    if not 0.1 <= first <= 0.9:
        raise ValueError(f"first = {first:g}; a share from 0.1 to 0.9 is needed")
    check_positive(shortest=shortest, starts=starts, speed_limit=speed_limit)
    Box.of(bounds)  # refuses what is impossible before the data are read
    recordings = read_recordings(data, columns=columns, units=units, length=length, tolerated=tolerated)
    found, quality = gather(recordings, shortest=shortest)
    early, late = split_in_time(found, first)
    both = {part.driver for part in early} & {part.driver for part in late}
    early, late = ([part for part in parts if part.driver in both] for parts in (early, late))
    if not both:
        raise ValueError(
            f"no driver is recorded for long enough to validate on {1 - first:.0%} of its time; "
            "a larger 'shortest' leaves out the shorter records"
        )
    samples = stack(found)[1].gap.shape[1]
    options: dict[str, Any] = {"objective": objective, "method": method, "starts": starts, "seed": seed}
    options |= {"bounds": bounds, "samples": samples}
    part = fit(early, model, **options)
    whole = fit(found, model, **options)
    known = uncertainty(whole, found, samples=samples)
    calibrated, validated = (_errors(part, parts, samples) for parts in (early, late))
    predictive, shrunk = {}, validated
    if len(part.drivers) >= 3:
        then = estimate(part, early, samples=samples)
        predictive = predictive_check(then, late, known=True, seed=seed)
        modes = np.clip(np.exp(then.posterior_mean), *then.box)
        shrunk = _errors(replace(part, parameters=modes), late, samples)
    everywhere = _errors(whole, found)
    return Calibration(
        quality=tuple(quality),
        segments=tuple(found),
        fit=whole,
        uncertainty=known,
        calibrated=calibrated,
        validated=validated,
        shrunk=shrunk,
        of_others=_errors(replace(whole, parameters=_of_others(whole)), found),
        everywhere=everywhere,
        collisions=int(everywhere["collision"].sum()),
        law=estimate(whole, found) if len(whole.drivers) >= 3 else few_drivers(whole, known, found),
        predictive=predictive,
        speed_limit=common_limit([recording.speed_limit for recording in recordings], speed_limit),
        seconds=time.perf_counter() - begin,
    )


def gather(
    sources: Source | Sequence[Source], *, shortest: float = SHORTEST, dt: float = 0.1
) -> tuple[list[Segment], list[Quality]]:
    """Segments of all recordings; drivers of several have the file in their names.

    A recording without a follower for long enough is left out if there are others.

    Args:
      sources: recordings or their files.
      shortest: s, shorter segments are left out.
      dt: s, time step of the segments.

    Raises:
      RecordingError: a file cannot be used, or nothing is left.
    """
    sources = [sources] if isinstance(sources, (str, Path, Recording)) else list(sources)
    found: list[Segment] = []
    qualities: list[Quality] = []
    refused: list[RecordingError] = []
    for source in sources:
        recording = as_recording(source)
        try:
            some, quality = segments(recording, dt=dt, shortest=shortest)
        except RecordingError as error:
            refused.append(error)
            continue
        if len(sources) > 1:
            stem = Path(recording.source).name.split(".")[0]
            some = [replace(segment, driver=f"{stem}: {segment.driver}") for segment in some]
        found += some
        qualities.append(quality)
    if not found:
        raise refused[0] if refused else RecordingError("no recordings; at least one file is needed")
    qualities[0].findings += [f"left out: {error}" for error in refused]
    return found, qualities


def _errors(found: Fit, parts: Sequence[Segment], samples: int = 0) -> dict[str, Floats]:
    """Objectives of every driver of `parts`, with its fitted parameters."""
    drivers, data, dt = stack(parts, samples)
    parameters = found.parameters[[found.drivers.index(name) for name in drivers]]
    result = errors(found.model, jnp.asarray(parameters, jnp.float32), data, dt)
    return {name: np.asarray(values, float) for name, values in result.items()}


def _of_others(whole: Fit) -> Floats:
    """Median parameters of the half of the drivers without this driver."""
    parameters = whole.parameters.copy()
    even = np.arange(len(parameters)) % 2 == 0
    for half in (even, ~even):
        if (~half).any():
            parameters[half] = np.median(whole.parameters[~half], axis=0)
    return parameters


__all__ = ["PUBLISHED", "Calibration", "calibrate", "gather"]
