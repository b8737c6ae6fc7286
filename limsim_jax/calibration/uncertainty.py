"""How well data determine the parameters: standard errors, intervals, and what cannot be identified.

Errors of a car-following model are correlated in time; taking them for independent gives intervals that are
far too short. Here residuals are taken for an AR(1) process R, estimated per driver, and the covariance of
the least-squares estimate is

    H^-1 (J^T R J) H^-1,    H = J^T J,    J = d residuals / d log p

Parameters are positive, so intervals are those of their logarithms. The box counts as a wide prior, normal
with two standard deviations on either side: it bounds what the data leave open, and keeps one parameter that
they do not tell from making the others look unknown too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import t as student

from limsim_jax.calibration.cleaning import Segment
from limsim_jax.calibration.fit import Data, Fit, Problem, residuals, rollout, stack
from limsim_jax.calibration.parameters import PARAMETERS

IDENTIFIED = 2.0
"""A parameter counts as identified if its 95 % interval reaches at most from p / 2 to 2 p."""

MEMORY = 5.0
"""s, longest correlation time of residuals; as long as found by Zhang, Sun (2024, arXiv 2210.03571)."""

_NO_INFORMATION = 1e-9  # of the largest eigenvalue
_DEGREES = 4.0  # of freedom, at least

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """Per driver `D`; all but `information` under the wide prior."""

    drivers: tuple[str, ...]
    standard_error: Floats  # [D P], in units of the parameters
    interval: Floats  # [D 2 P], 95 %, within the box
    identified: NDArray[np.bool_]  # [D P]
    side: NDArray[np.int64]  # [D P], -1 and 1: the estimate is at its lower and upper bound; otherwise 0
    correlation: Floats  # [D P P], of estimates of log-parameters
    information: Floats  # [D P P], of the data alone: inverse covariance of log-parameters
    condition: Floats  # [D], of H
    sigma: Floats  # [D], standard deviation of the residuals
    rho: Floats  # [D], their correlation from one sample to the next

    @property
    def at_bound(self) -> NDArray[np.bool_]:
        """Estimates at a bound, `[D P]`."""
        return self.side != 0

    @property
    def bound_shares(self) -> Floats:
        """Shares of the drivers at lower and upper bounds, `[2 P]`."""
        return np.stack([(self.side == end).mean(axis=0) for end in (-1, 1)])


def uncertainty(fit: Fit, segments: Sequence[Segment], *, samples: int = 0) -> Uncertainty:
    """Standard errors of a fit.

    Args:
      fit: of the drivers.
      segments: those of the fit.
      samples: see `fit.stack`.

    Raises:
      ValueError: other drivers than those of the fit.
    """
    drivers, data, dt = stack(segments, samples)
    if drivers != fit.drivers:
        raise ValueError("these are not the segments of the fit: other drivers")
    # Nearly singular matrices: double precision for the derivatives.
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), data)
        r, jacobian = _sensitivity(fit.problem(dt), jnp.asarray(fit.parameters), wide)
        r, jacobian = np.asarray(r), np.asarray(jacobian)
    counts, starts = np.asarray(data.weight) > 0, np.asarray(data.start) > 0
    rows = [
        _one(r[i], jacobian[i], counts[i], starts[i], dt) for i in range(len(drivers))
    ]  # fmt: skip
    information, condition, sigma, rho, degrees = (np.stack([row[k] for row in rows]) for k in range(5))
    low, high = np.log(fit.box)
    covariance = np.linalg.inv(information + np.diag((4 / (high - low)) ** 2))
    log_error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    side = fit.box.side(fit.parameters)
    reach = np.exp(student.ppf(0.975, degrees)[:, None] * log_error)
    interval = np.stack([fit.parameters / reach, fit.parameters * reach], axis=1)
    correlation = covariance / (log_error[:, :, None] * log_error[:, None])
    return Uncertainty(
        drivers=drivers,
        standard_error=fit.parameters * log_error,
        interval=np.clip(interval, *fit.box),
        identified=(reach <= IDENTIFIED) & (side == 0),
        side=side,
        correlation=correlation,
        information=information,
        condition=condition,
        sigma=sigma,
        rho=rho,
    )


@partial(jax.jit, static_argnames=("problem",))
def _sensitivity(problem: Problem, parameters: Array, data: Data) -> tuple[Array, Array]:
    """Residuals `[D, T]` and their derivatives by log-parameters `[D, T, P]`."""

    def one(p: Array, data: Data) -> tuple[Array, Array]:
        def f(log_p: Array) -> tuple[Array, Array]:
            gap, v = rollout(problem.model, jnp.exp(log_p), data, problem.dt)
            r = residuals(problem.objective, gap, v, data)
            return r, r

        jacobian, r = jax.jacfwd(f, has_aux=True)(jnp.log(p))
        return r, jacobian

    return jax.vmap(one)(parameters, data)


def _one(
    r: Floats, jacobian: Floats, counts: NDArray[np.bool_], start: NDArray[np.bool_], dt: float
) -> tuple[Floats, float, float, float, float]:
    """Information, condition, sigma, rho and degrees of freedom of one driver."""
    size = len(PARAMETERS)
    r, jacobian = r[counts], jacobian[counts]
    begins = np.flatnonzero(start[counts])
    parts = np.split(np.arange(len(r)), begins[begins > 0])
    pairs = np.concatenate([part[1:] for part in parts])
    n = len(r)
    rho = float(np.sum(r[pairs] * r[pairs - 1]) / max(np.sum(r[pairs - 1] ** 2), 1e-12))
    # Fitted parameters take slow errors away (Kendall 1954 for the mean; one such loss per parameter).
    rho = min(max(rho + (1 + 3 * rho + size * (1 + rho) / 2) / n, 0.0), math.exp(-dt / MEMORY))
    effective = n * (1 - rho) / (1 + rho)
    degrees = max(effective - size, _DEGREES)
    variance = float(np.mean(r**2)) * max(effective, size + _DEGREES) / degrees
    h = jacobian.T @ jacobian
    k = h.copy()
    for part in parts:
        past = lfilter([0.0, rho], [1.0, -rho], jacobian[part], axis=0)
        cross = jacobian[part].T @ past
        k += cross + cross.T
    k *= variance
    # Eigenvectors of H in units of its diagonal; in directions that it does not see there is no information.
    scale = np.sqrt(np.diag(h))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    seen = values > _NO_INFORMATION * values.max()
    across = vectors[:, seen] / scale[:, None]
    along = vectors[:, seen] * scale[:, None] * values[seen]
    information = along @ np.linalg.pinv(across.T @ k @ across, hermitian=True) @ along.T
    condition = float(values.max() / max(values.min(), 1e-300))
    return (information + information.T) / 2, condition, float(np.sqrt(variance)), rho, degrees


__all__ = ["IDENTIFIED", "Uncertainty", "uncertainty"]
