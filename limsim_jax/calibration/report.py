"""A recording in, calibrated drivers out: what `limsim-jax calibrate` does and prints."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import SHORTEST, Quality, Segment, segments, split_in_time
from limsim_jax.calibration.fit import (
    LOWER,
    PARAMETERS,
    UPPER,
    Fit,
    errors,
    fit,
    model_name,
    stack,
)
from limsim_jax.calibration.population import Law, estimate, predictive_check, write_population
from limsim_jax.calibration.uncertainty import Uncertainty, uncertainty
from limsim_jax.recordings import Recording, RecordingError, Source, as_recording
from limsim_jax.traffic.car_following import IDM, CarFollowing

PUBLISHED = (0.11, 0.29)
"""Errors of calibrated car-following models, the IDM among them (Kesting, Treiber 2008)."""

UNITS = {"v0": "m/s", "T": "s", "s0": "m", "a": "m/s^2", "b": "m/s^2"}

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Result of `calibrate`. Errors are those of the mixed objective, 0.2 for 20 %, and of gaps in m."""

    quality: tuple[Quality, ...]  # per file
    segments: tuple[Segment, ...]
    fit: Fit  # to all data
    uncertainty: Uncertainty
    calibrated: dict[str, Floats]  # objectives per driver, fit to the first part of its time, there
    validated: dict[str, Floats]  # in the rest of its time
    shrunk: dict[str, Floats]  # there, of the drivers' posterior modes under the population of all
    of_others: dict[str, Floats]  # of the median driver of the other half of the drivers, all the time
    collisions: int  # fitted followers that run into their leaders
    law: Law | None  # of three drivers or more
    predictive: dict[str, float]  # check of a law from the first part of the time, in the rest of it
    seconds: float

    @property
    def population(self) -> Law:
        """The drivers' law. Raises `ValueError` where there are too few of them."""
        if self.law is None:
            raise ValueError(f"a population from {len(self.fit.drivers)} drivers; at least 3 are needed")
        return self.law

    def write_population(
        self, path: str | Path, *, classes: Sequence[str] = ("car",), speed_limit: float | None = None
    ) -> None:
        """The population as a file for scenarios. Raises `ValueError` where there are too few drivers."""
        sources = [quality.source for quality in self.quality]
        write_population(self.population, path, sources=sources, classes=classes, speed_limit=speed_limit)

    def as_json(self) -> dict[str, Any]:
        """Everything but the segments, as plain values."""
        found, law = self.uncertainty, self.law
        drivers = [
            {
                "driver": name,
                "error": float(self.fit.error[i]),
                "parameters": {
                    p: {
                        "value": float(self.fit.parameters[i, k]),
                        "standard_error": float(found.standard_error[i, k]),
                        "interval": found.interval[i, :, k].tolist(),
                        "identified": bool(found.identified[i, k]),
                        "at_bound": bool(found.at_bound[i, k]),
                    }
                    for k, p in enumerate(PARAMETERS)
                },
                "condition": float(found.condition[i]),
                "residual_correlation": float(found.rho[i]),
            }
            for i, name in enumerate(self.fit.drivers)
        ]
        parts = {
            "calibration": self.calibrated,
            "validation": self.validated,
            "validation_shrunk": self.shrunk,
            "median_of_others": self.of_others,
        }
        return {
            "model": model_name(self.fit.model),
            "objective": self.fit.objective,
            "method": self.fit.method,
            "files": [quality.as_json() for quality in self.quality],
            "errors": {
                name: {objective: _summary(values) for objective, values in part.items()}
                for name, part in parts.items()
            },
            "published_band": list(PUBLISHED),
            "collisions": self.collisions,
            "drivers": drivers,
            "population": None
            if law is None
            else {
                "median": law.median,
                "spread": law.spread,
                "correlation": law.correlation.tolist(),
                "identified": dict(zip(PARAMETERS, law.identified.tolist(), strict=True)),
                "residual_acceleration": vars(law.residual),
                "predictive_check": self.predictive,
            },
            "seconds": self.seconds,
        }

    def text(self) -> str:
        """For the terminal."""
        lines = []
        for quality in self.quality:
            lines.append(
                f"{quality.source}: {quality.kind}, {quality.drivers} drivers in {quality.segments} "
                f"segments, {quality.kept:.0f} of {quality.recorded:.0f} s behind leaders kept"
            )
            lines += [f"  left out: {s:.0f} s {reason}" for reason, s in quality.dropped.items()]
            lines += [f"  {finding}" for finding in quality.findings[:5]]
            if len(quality.findings) > 5:
                lines.append(f"  and {len(quality.findings) - 5} more")
        lines += [
            "",
            f"{model_name(self.fit.model).upper()}, objective {self.fit.objective}, {self.fit.method}",
        ]
        lines.append(f"{'':34}{'median':>8}{'quartiles':>16}{'gap, m':>10}")
        for name, part in (
            ("calibration, first part of the time", self.calibrated),
            ("validation, rest of the time", self.validated),
            ("the same, drawn to the population", self.shrunk),
            ("median driver of the others", self.of_others),
        ):
            low, middle, high = np.percentile(part["mixed"], [25, 50, 75])
            lines.append(
                f"{name:36}{middle:>6.1%}{f'{low:.1%} to {high:.1%}':>17}{np.median(part['gap']):>9.2f}"
            )
        lines += [f"published: {PUBLISHED[0]:.0%} to {PUBLISHED[1]:.0%}", ""]
        lines.append(
            f"{'':14}{'median':>9}{'quartiles':>18}{'rel. s.e.':>11}{'identified':>12}{'at bound':>10}"
        )
        found = self.uncertainty
        for k, name in enumerate(PARAMETERS):
            values = self.fit.parameters[:, k]
            low, middle, high = np.percentile(values, [25, 50, 75])
            relative = float(np.median(found.standard_error[:, k] / values))
            lines.append(
                f"{f'{name}, {UNITS[name]}':14}{middle:>9.2f}{f'{low:.2f} to {high:.2f}':>18}"
                f"{relative:>11.0%}{found.identified[:, k].mean():>12.0%}{found.at_bound[:, k].mean():>10.0%}"
            )
        if self.law is not None:
            law = self.law
            values = ", ".join(
                f"{name} {law.median[name]:.2f} x/ {np.exp(law.spread[name]):.2f}" for name in PARAMETERS
            )
            lines += ["", f"population: {values}"]
            lines.append(
                f"residual acceleration: {law.residual.sigma:.2f} m/s^2, {law.residual.tau:.1f} s; "
                f"predictions of the rest of the time hold {self.predictive['inside_50']:.0%} and "
                f"{self.predictive['inside_90']:.0%} of gaps within their 50 and 90 %"
            )
        return "\n".join(lines)


def _summary(values: Floats) -> dict[str, float]:
    low, middle, high = np.percentile(values, [25, 50, 75])
    return {"median": float(middle), "lower": float(low), "upper": float(high), "mean": float(values.mean())}


def gather(
    sources: Source | Sequence[Source], *, shortest: float = SHORTEST, dt: float = 0.1
) -> tuple[list[Segment], list[Quality]]:
    """Segments of all recordings; drivers of several have the file in their names.

    A recording in which nobody follows long enough is left out if there are others.

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


def calibrate(
    sources: Source | Sequence[Source],
    *,
    model: CarFollowing = IDM(),
    objective: str = "mixed",
    method: str = "lm",
    shortest: float = SHORTEST,
    first: float = 0.6,
    starts: int | None = None,
    seed: int = 0,
) -> Calibration:
    """Calibrate the drivers of recordings, validate them, and estimate their population.

    Args:
      sources: one or more recordings, or their files.
      model: of car following.
      objective: what to make least, see `fit.residuals`.
      method: "lm", "lbfgs" or "adam".
      shortest: s, segments of less are left out.
      first: share of every driver's time that is calibrated with where the rest validates.
      starts: descents per driver, see `fit`.
      seed: of all that is random.

    Raises:
      RecordingError: a file cannot be used; one line.
      ValueError: an argument is not as it should be.
    """
    begin = time.perf_counter()
    if not 0.1 <= first <= 0.9:
        raise ValueError(f"first = {first:g}; a share from 0.1 to 0.9 is needed")
    found, quality = gather(sources, shortest=shortest)
    early, late = split_in_time(found, first)
    both = {part.driver for part in early} & {part.driver for part in late}
    early, late = ([part for part in parts if part.driver in both] for parts in (early, late))
    if not both:
        raise ValueError(
            f"no driver is recorded for long enough to validate on {1 - first:.0%} of its time; "
            "a larger 'shortest' leaves out who is not"
        )
    samples = stack(found)[1].gap.shape[1]
    options: dict[str, Any] = {"objective": objective, "method": method, "starts": starts, "seed": seed}
    options["samples"] = samples
    part = fit(early, model, **options)
    whole = fit(found, model, **options)
    known = uncertainty(whole, found, samples=samples)
    calibrated, validated = (_errors(part, parts, samples) for parts in (early, late))
    law = estimate(whole, found) if len(whole.drivers) >= 3 else None
    predictive, shrunk = {}, validated
    if len(part.drivers) >= 3:
        then = estimate(part, early, samples=samples)
        predictive = predictive_check(then, late, known=True, seed=seed)
        modes = np.clip(np.exp(then.posterior_mean), LOWER, UPPER)
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
        collisions=int(everywhere["collision"].sum()),
        law=law,
        predictive=predictive,
        seconds=time.perf_counter() - begin,
    )


def _errors(found: Fit, parts: Sequence[Segment], samples: int = 0) -> dict[str, Floats]:
    """Objectives of every driver of `parts`, with its fitted parameters."""
    drivers, data, dt = stack(parts, samples)
    parameters = found.parameters[[found.drivers.index(name) for name in drivers]]
    result = errors(found.model, jnp.asarray(parameters, jnp.float32), data, dt)
    return {name: np.asarray(values, float) for name, values in result.items()}


def _of_others(whole: Fit) -> Floats:
    """For each driver the median parameters of that half of the drivers which it is not of."""
    parameters = whole.parameters.copy()
    even = np.arange(len(parameters)) % 2 == 0
    for half in (even, ~even):
        if (~half).any():
            parameters[half] = np.median(whole.parameters[~half], axis=0)
    return parameters


__all__ = ["PUBLISHED", "Calibration", "calibrate", "gather"]
