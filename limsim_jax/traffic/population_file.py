"""Drivers from a file that `limsim_jax.calibration` writes: a `Population` for scenarios.

JSON: for each parameter of `vehicles.PARAMETERS` in `parameters` its median, spread, and bounds, in the units
and with the meaning of `vehicles.Population`, and in `correlation` the matrix of the correlations of their
scores, in the order of `parameters`. They hold for the vehicle classes in `classes`; other classes, and other
parameters of these, stay as `vehicles.DEFAULTS` say. Anything else in the file is ignored.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from limsim_jax.maps.lane_map import VEHICLE_CLASSES
from limsim_jax.traffic.vehicles import CUT, NORMAL, PARAMETERS, URBAN, Population, default_population, refit

FORMAT = "limsim_jax drivers 1"


def read_population(path: str | Path, shares: Mapping[str, float] = URBAN) -> Population:
    """The default population with the drivers of a file.

    Args:
      path: of the file.
      shares: weight per vehicle class.

    Raises:
      ValueError: one line that names the file and what is wrong with it.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: not valid JSON: {error}") from None
    return population_of(content, shares, str(path))


def population_of(content: Any, shares: Mapping[str, float] = URBAN, source: str = "drivers") -> Population:
    """The default population with the drivers of the content of a file.

    Args:
      content: see the module.
      shares: weight per vehicle class.
      source: name of the file, for errors.

    Raises:
      ValueError: one line that says what is wrong with it.
    """

    def refuse(message: str) -> ValueError:
        return ValueError(f"{source}: {message}")

    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise refuse(f"no file of drivers; its 'format' has to be '{FORMAT}'")
    table, classes = content.get("parameters"), content.get("classes")
    if not isinstance(table, dict) or not table:
        raise refuse("parameters: a table of at least one parameter is needed")
    rows = {name: _row(refuse, name, row) for name, row in table.items()}
    if not isinstance(classes, list) or not classes or any(name not in VEHICLE_CLASSES for name in classes):
        raise refuse(f"classes: {classes!r}; a list of {', '.join(VEHICLE_CLASSES)} is needed")
    try:
        correlation = np.asarray(content["correlation"], float)
        good = correlation.shape == (len(rows),) * 2 and bool(np.isfinite(correlation).all())
        good = good and np.allclose(np.diag(correlation), 1) and np.allclose(correlation, correlation.T)
        factor = np.linalg.cholesky(correlation + 1e-9 * np.eye(len(rows))) if good else np.eye(0)
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError):
        good, factor = False, np.eye(0)
    if not good:
        raise refuse(
            f"correlation: a positive definite matrix of {len(rows)} rows with ones on its diagonal is needed"
        )
    return refit(default_population(shares), classes, rows, np.asarray(factor, float))


def _row(refuse: Any, name: str, row: Any) -> tuple[float, float, float, float]:
    """Median, spread, and bounds of one parameter."""
    if name not in PARAMETERS:
        raise refuse(f"parameters.{name}: no such parameter; known are {', '.join(PARAMETERS)}")
    values = []
    for field in ("median", "spread", "lower", "upper"):
        value = row.get(field) if isinstance(row, dict) else None
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise refuse(f"parameters.{name}.{field}: {value!r}; a finite number is needed")
        values.append(float(value))
    median, spread, lower, upper = values
    if not (0 < lower <= median <= upper and spread >= 0):
        raise refuse(
            f"parameters.{name}: median {median:g}, spread {spread:g}, bounds {lower:g} to {upper:g}; "
            "0 < lower <= median <= upper and a spread of 0 or more are needed"
        )
    if name in NORMAL:
        low, high = median - CUT * spread, median + CUT * spread
    else:
        low, high = median * math.exp(-CUT * spread), median * math.exp(CUT * spread)
    return median, spread, max(low, lower), min(high, upper)


__all__ = ["FORMAT", "population_of", "read_population"]
