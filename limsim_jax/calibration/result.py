"""What a calibration found: tables, the population of drivers, and its file."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import Quality, Segment
from limsim_jax.calibration.fit import Fit, model_name, rollout, stack
from limsim_jax.calibration.parameters import MEANING, PARAMETERS, UNITS
from limsim_jax.calibration.population import (
    FEW,
    IDENTIFIED,
    Law,
    population_content,
    write_population,
)
from limsim_jax.calibration.uncertainty import Uncertainty
from limsim_jax.traffic.population_file import population_of
from limsim_jax.traffic.vehicles import Population

PUBLISHED = (0.11, 0.29)
"""Errors of calibrated car-following models, the IDM among them (Kesting, Treiber 2008)."""

Floats = NDArray[np.float64]


_SIDES = {-1: "lower", 0: None, 1: "upper"}
"""Names of `Uncertainty.side`."""


class _Table(NamedTuple):
    head: list[str]
    rows: list[list[str]]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Result of `calibrate`; prints as tables of parameters and errors.

    Errors of the gap are those of the mixed objective, 0.2 for 20 %.
    """

    quality: tuple[Quality, ...]  # per file
    segments: tuple[Segment, ...]
    fit: Fit  # to all data
    uncertainty: Uncertainty
    calibrated: dict[str, Floats]  # objectives per driver, fit to the first part of its time, there
    validated: dict[str, Floats]  # in the rest of its time
    shrunk: dict[str, Floats]  # there, of the drivers' posterior modes under the population of all
    of_others: dict[str, Floats]  # of the median driver of the other half of the drivers, all the time
    everywhere: dict[str, Floats]  # objectives per driver, fit to all its time, there
    collisions: int  # fitted followers that run into their leaders
    law: Law  # of less than three drivers: see `population.few_drivers`
    predictive: dict[str, float]  # check of a law from the first part of the time, in the rest of it
    speed_limit: float | None  # m/s, of the recorded road
    seconds: float

    # --- in traffic

    @property
    def population(self) -> Population:
        """The drivers as a population of vehicles, for `Experiment(drivers=...)`.

        They are cars; other classes keep their default drivers. Of one driver all cars are copies, of two
        the spread is that of the two. Parameters that the data of so few do not tell keep their defaults.

        Raises:
          ValueError: the data of one or two drivers tell no parameter.
        """
        return population_of(population_content(self.law, speed_limit=self.speed_limit))

    def write_population(
        self, path: str | Path, *, classes: Sequence[str] = ("car",), speed_limit: float | None = None
    ) -> None:
        """Write the population as a file for `[traffic] drivers = "FILE"`.

        Args:
          path: of the JSON file.
          classes: vehicle classes that drive like this.
          speed_limit: m/s, of the recorded road; None: as it was told to `calibrate`.

        Raises:
          ValueError: see `population`.
        """
        sources = [quality.source for quality in self.quality]
        limit = self.speed_limit if speed_limit is None else speed_limit
        write_population(self.law, path, sources=sources, classes=classes, speed_limit=limit)

    # --- numbers

    @property
    def drivers(self) -> pa.Table:
        """One row per driver.

        Columns: driver, each parameter with the ends of its 95 % interval (`T`, `T_low`, `T_high`), whether
        the data identify it (`T_identified`) and the bound at which it ends (`T_bound`: "lower", "upper" or
        null), and the root mean square errors of gap (m) and speed (m/s) over all its time.
        """
        found = self.uncertainty
        columns: dict[str, Any] = {"driver": list(self.fit.drivers)}
        for k, name in enumerate(PARAMETERS):
            columns |= {
                name: self.fit.parameters[:, k],
                f"{name}_low": found.interval[:, 0, k],
                f"{name}_high": found.interval[:, 1, k],
                f"{name}_identified": found.identified[:, k],
                f"{name}_bound": pa.array([_SIDES[side] for side in found.side[:, k]], pa.string()),
            }
        columns["gap_rmse"], columns["speed_rmse"] = self.everywhere["gap"], self.everywhere["speed"]
        return pa.table(columns)

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
                        "at_bound": _SIDES[found.side[i, k]],
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
            "bounds": {
                p: {
                    "lower": self.fit.box.lower[k],
                    "upper": self.fit.box.upper[k],
                    "at_lower": float(found.bound_shares[0, k]),
                    "at_upper": float(found.bound_shares[1, k]),
                }
                for k, p in enumerate(PARAMETERS)
            },
            "drivers": drivers,
            "population": {
                "median": law.median,
                "spread": law.spread,
                "correlation": law.correlation.tolist(),
                "identified": dict(zip(PARAMETERS, law.identified.tolist(), strict=True)),
                "residual_acceleration": vars(law.residual),
                "predictive_check": self.predictive,
            },
            "seconds": self.seconds,
        }

    # --- tables

    def _files(self) -> Iterator[str]:
        for quality in self.quality:
            yield (
                f"{quality.source}: {quality.kind}, {quality.drivers} drivers in {quality.segments} "
                f"segments, {quality.kept:.0f} of {quality.recorded:.0f} s behind leaders kept"
            )
            yield from (f"  left out: {s:.0f} s {reason}" for reason, s in quality.dropped.items())
            yield from (f"  {finding}" for finding in quality.findings[:5])
            if len(quality.findings) > 5:
                yield f"  and {len(quality.findings) - 5} more"

    def _parameters(self) -> _Table:
        found, values = self.uncertainty, self.fit.parameters
        bounds = [f"{low:g} to {high:g}" for low, high in zip(*self.fit.box, strict=True)]
        rows = []
        if len(values) == 1:
            for k, name in enumerate(PARAMETERS):
                low, high = found.interval[0, :, k]
                told = "yes" if found.identified[0, k] else "no"
                cells = [f"{values[0, k]:.2f}", f"[{low:.2f}, {high:.2f}]", told, bounds[k]]
                rows.append([f"{name}, {UNITS[name]}", *cells, MEANING[name]])
            return _Table(["parameter", "value", "95 % interval", "identified", "bounds", ""], rows)
        for k, name in enumerate(PARAMETERS):
            low, middle, high = np.percentile(values[:, k], [25, 50, 75])
            relative = float(np.median(found.standard_error[:, k] / values[:, k]))
            cells = [f"{middle:.2f}", f"{low:.2f} to {high:.2f}", f"{relative:.0%}"]
            lower, upper = found.bound_shares[:, k]
            cells += [f"{found.identified[:, k].mean():.0%}", bounds[k], f"{lower:.0%}, {upper:.0%}"]
            rows.append([f"{name}, {UNITS[name]}", *cells, MEANING[name]])
        head = ["parameter", "median driver", "quartiles", "standard error", "identified"]
        head += ["bounds", "at lower, upper", ""]
        return _Table(head, rows)

    def _errors(self) -> _Table:
        parts = [
            ("calibration, first part of the time", self.calibrated),
            ("validation, rest of the time", self.validated),
        ]
        if len(self.fit.drivers) >= FEW:
            parts.append(("validation, drawn to the population", self.shrunk))
        if len(self.fit.drivers) >= 2:
            parts.append(("median driver of the others", self.of_others))
        rows = []
        for name, part in parts:
            low, middle, high = np.percentile(part["mixed"], [25, 50, 75])
            rmse = [f"{np.median(part[name]):.2f}" for name in ("gap", "speed")]
            rows.append([name, f"{middle:.1%}", f"{low:.1%} to {high:.1%}", *rmse])
        table = _Table(["error, median driver", "gap", "quartiles", "RMSE gap, m", "RMSE speed, m/s"], rows)
        if len(self.fit.drivers) == 1:
            table = _Table(["error", *table.head[1:2], *table.head[3:]], [[*r[:2], *r[3:]] for r in rows])
        return table

    def _notes(self) -> Iterator[str]:
        yield f"published errors of the gap: {PUBLISHED[0]:.0%} to {PUBLISHED[1]:.0%}"
        if self.collisions:
            yield f"fitted followers that run into their leaders: {self.collisions}"
        yield from self._binding()
        law = self.law
        if (count := len(self.fit.drivers)) < FEW:
            known = zip(PARAMETERS, law.identified, strict=True)
            told = ", ".join(name for name, share in known if share > IDENTIFIED)
            like = "copies of this driver" if count == 1 else "spread like these two"
            yield f"population of {count} driver{'s' if count > 1 else ''}: " + (
                f"cars are {like} in {told}; other parameters keep their defaults"
                if told
                else "none, for the data tell no parameter"
            )
        if count >= FEW:
            values = ", ".join(
                f"{name} {law.median[name]:.2f} x/ {np.exp(law.spread[name]):.2f}" for name in PARAMETERS
            )
            yield f"population: {values}"
            yield (
                f"residual acceleration: {law.residual.sigma:.2f} m/s^2, {law.residual.tau:.1f} s; "
                f"predictions of the rest of the time hold {self.predictive['inside_50']:.0%} and "
                f"{self.predictive['inside_90']:.0%} of gaps within their 50 and 90 %"
            )

    def _binding(self) -> Iterator[str]:
        """Which bounds bind, and for how many of the drivers."""
        shares, box = self.uncertainty.bound_shares, self.fit.box
        found = [
            f"{name} at {box[end][k]:g} {UNITS[name]}"
            + (f" for {shares[end, k]:.0%}" if len(self.fit.drivers) > 1 else "")
            for k, name in enumerate(PARAMETERS)
            for end in (0, 1)
            if shares[end, k] > 0
        ]
        if found:
            of = " of the drivers" if len(self.fit.drivers) > 1 else ""
            yield (
                f"bounds that bind: {', '.join(found)}{of}; wider ones (bounds, --bounds) may fit better, or "
                "the data do not tell the parameter"
            )

    def _title(self) -> str:
        count = len(self.fit.drivers)
        drivers = f"{count} driver{'s' if count > 1 else ''}"
        return (
            f"{model_name(self.fit.model).upper()}, {drivers}, objective {self.fit.objective}, "
            f"{self.fit.method}"
        )

    def text(self) -> str:
        """For the terminal."""
        tables = (line for table in (self._parameters(), self._errors()) for line in ("", *_lines(table)))
        return "\n".join([*self._files(), "", self._title(), *tables, "", *self._notes()])

    __str__ = text

    def _repr_html_(self) -> str:
        """For a notebook."""
        files = "".join(f"<li>{html.escape(line.strip())}</li>" for line in self._files())
        notes = "".join(f"<p>{html.escape(note)}</p>" for note in self._notes())
        tables = "".join(_html(table) for table in (self._parameters(), self._errors()))
        return f"<p><b>{html.escape(self._title())}</b></p>{tables}{notes}<ul>{files}</ul>"

    def __repr__(self) -> str:
        return f"<Calibration: {self._title()}>"

    # --- picture

    def plot(self, driver: str | None = None) -> Any:
        """Recorded and simulated gap and speed of one driver; returns the Matplotlib figure.

        Args:
          driver: name; None: the driver whose error is the median.

        Raises:
          ValueError: there is no such driver.
        """
        import matplotlib.pyplot as plt

        names = self.fit.drivers
        if driver is None:
            driver = names[int(np.argsort(self.fit.error)[(len(names) - 1) // 2])]
        if driver not in names:
            raise ValueError(f"no driver '{driver}'; known are {', '.join(names)[:300]}")
        parameters = jnp.asarray(self.fit.parameters[names.index(driver)], jnp.float32)
        figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(9, 5), layout="constrained")
        for part in (part for part in self.segments if part.driver == driver):
            _, data, dt = stack([part])
            one = jax.tree.map(lambda x: jnp.asarray(x[0]), data)
            gap, v = rollout(self.fit.model, parameters, one, dt)
            time = part.time + dt * np.arange(len(part))
            above.plot(time, part.gap, "k", lw=3, alpha=0.3)
            above.plot(time, gap[: len(part)], "C0")
            below.plot(time, part.v_lead, "k:", lw=1)
            below.plot(time, part.v, "k", lw=3, alpha=0.3)
            below.plot(time, v[: len(part)], "C0")
        above.set(ylabel="gap, m", title=f"driver {driver}", ylim=(0, None))
        above.legend(above.lines[:2], ["recorded", model_name(self.fit.model).upper()])
        below.set(xlabel="time, s", ylabel="speed, m/s", ylim=(0, None))
        below.legend(below.lines[:1], ["leader"])
        return figure


def _summary(values: Floats) -> dict[str, float]:
    low, middle, high = np.percentile(values, [25, 50, 75])
    return {"median": float(middle), "lower": float(low), "upper": float(high), "mean": float(values.mean())}


def _lines(table: _Table) -> list[str]:
    """Lines of a table; the first column and one without a name stand left."""
    columns = [[head, *cells] for head, cells in zip(table.head, zip(*table.rows, strict=True), strict=True)]
    wide = [max(map(len, column)) for column in columns]

    def line(cells: Sequence[str]) -> str:
        padded = [
            f"{cell:{'<' if k == 0 or not table.head[k] else '>'}{wide[k]}}" for k, cell in enumerate(cells)
        ]
        return "  ".join(padded).rstrip()

    return [line(table.head), *map(line, table.rows)]


def _html(table: _Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return (
        f"<table><thead>{row(table.head, 'th')}</thead>"
        f"<tbody>{''.join(row(cells, 'td') for cells in table.rows)}</tbody></table>"
    )


def common_limit(limits: Sequence[float], told: float | None) -> float | None:
    """Speed limit of the recorded roads, m/s: what was told, or what all recordings have; None if neither."""
    if told is not None:
        return told
    known = set(limits)
    return known.pop() if len(known) == 1 and np.isfinite(next(iter(known))) else None


__all__ = ["PUBLISHED", "Calibration", "common_limit"]
