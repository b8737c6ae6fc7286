"""From fits of single drivers to the population that they come from.

Log-parameters of drivers are taken for draws of one normal distribution with full covariance. Its mean and
covariance maximise the marginal likelihood (EM; Dempster, Laird, Rubin 1977), with what the data of each
driver say as a Gaussian of log-parameters (Laplace). So a driver whose data do not tell a parameter takes it
from the others, instead of the end of the box. The mode is found anew under the population (`refine`), and
the Gaussian taken there.

What the models leave unexplained is a stationary Ornstein-Uhlenbeck process of acceleration, `Residual`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import Segment
from limsim_jax.calibration.fit import Data, Fit, Prior, driver, model_name, refine, rollout, stack
from limsim_jax.calibration.parameters import BOX, PARAMETERS, Box, check_positive
from limsim_jax.calibration.uncertainty import Uncertainty, uncertainty
from limsim_jax.files import write_whole
from limsim_jax.traffic.car_following import CarFollowing
from limsim_jax.traffic.population_file import FORMAT

WIDTH = 0.3
"""Standard deviation of log-parameters that is assumed with the weight of `_WEIGHT` drivers."""

IDENTIFIED = 0.5
"""Share of the drivers whose data tell their desired speed, above which those of a population count."""

FEW = 3
"""Drivers from which on a distribution is estimated."""

_WEIGHT = 4.0
_HARD = 3.0  # m/s^2, more is no noise but a model that does not fit
_LAGS = np.arange(0.5, 3.01, 0.5)  # s

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Residual:
    """Acceleration that the model does not explain: stationary, correlation exp(-t / tau)."""

    sigma: float  # m/s^2
    tau: float  # s


@dataclass(frozen=True, kw_only=True)
class Law:
    """Joint log-normal distribution of parameters, and each driver's part in it."""

    mean: Floats  # [P], of log-parameters
    covariance: Floats  # [P P]
    drivers: tuple[str, ...]
    posterior_mean: Floats  # [D P], of log-parameters
    posterior_covariance: Floats  # [D P P]
    identified: Floats  # [P], share of the drivers
    bound_shares: Floats  # [2 P], of the drivers, see `Uncertainty`
    model: CarFollowing
    objective: str
    residual: Residual
    box: Box = BOX

    @property
    def median(self) -> dict[str, float]:
        """Of every parameter."""
        return dict(zip(PARAMETERS, np.exp(self.mean).tolist(), strict=True))

    @property
    def spread(self) -> dict[str, float]:
        """Standard deviation of the logarithm of every parameter."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def correlation(self) -> Floats:
        """Of log-parameters, [P P]; of those without a spread 0."""
        width = np.sqrt(np.diag(self.covariance))
        scale = np.where(width > 0, width, 1.0)
        return np.where(np.eye(len(width)) > 0, 1.0, self.covariance / np.outer(scale, scale))

    def sample(self, count: int, rng: np.random.Generator) -> Floats:
        """Parameters of new drivers, `[count P]`, within the box."""
        drawn = rng.multivariate_normal(self.mean, self.covariance, count)
        return np.clip(np.exp(drawn), *self.box)


def estimate(fit: Fit, segments: Sequence[Segment], *, rounds: int = 3, samples: int = 0) -> Law:
    """The population that the drivers of a fit come from.

    Args:
      fit: of at least three drivers.
      segments: those of the fit.
      rounds: times that the drivers' modes are found anew under the population.
      samples: see `fit.stack`.

    Raises:
      ValueError: fewer than three drivers.
    """
    if len(fit.drivers) < FEW:
        raise ValueError(f"a population from {len(fit.drivers)} drivers; at least 3 are needed")
    known = found = uncertainty(fit, segments, samples=samples)
    log_p = np.log(fit.parameters)
    information = _censored(found)
    pull = np.einsum("dij,dj->di", information, log_p)
    mean, covariance, posterior, spread = _expectation_maximisation(information, pull, fit.box)
    drivers, data, dt = stack(segments, samples)
    problem = fit.problem(dt)
    for _ in range(rounds):
        parameters = refine(
            problem, data, np.exp(posterior), _prior(mean, covariance, found, data)
        )  # fmt: skip
        found = uncertainty(replace(fit, parameters=parameters), segments, samples=samples)
        log_p = np.log(parameters)
        # At the mode the slope of the likelihood is that of the prior, with the other sign.
        slope = (log_p - mean) @ np.linalg.inv(covariance)
        information = _censored(found)
        pull = np.einsum("dij,dj->di", information, log_p) + np.where(found.at_bound, 0.0, slope)
        mean, covariance, posterior, spread = _expectation_maximisation(information, pull, fit.box)
    parameters = np.clip(np.exp(posterior), *fit.box)
    return Law(
        mean=mean,
        covariance=covariance,
        drivers=drivers,
        posterior_mean=posterior,
        posterior_covariance=spread,
        identified=known.identified.mean(axis=0),
        bound_shares=known.bound_shares,
        model=fit.model,
        objective=fit.objective,
        residual=residual_process(fit.model, parameters, data, dt),
        box=fit.box,
    )


def few_drivers(fit: Fit, known: Uncertainty, segments: Sequence[Segment]) -> Law:
    """The law of one or two drivers: their median and spread, nothing of others.

    Args:
      fit: of the drivers.
      known: how well the data tell their parameters.
      segments: those of the fit.
    """
    log_p = np.log(fit.parameters)
    drivers, data, dt = stack(segments)
    return Law(
        mean=log_p.mean(axis=0),
        covariance=np.diag(log_p.var(axis=0)),
        drivers=drivers,
        posterior_mean=log_p,
        posterior_covariance=np.zeros((*log_p.shape, log_p.shape[1])),
        identified=known.identified.mean(axis=0),
        bound_shares=known.bound_shares,
        model=fit.model,
        objective=fit.objective,
        residual=residual_process(fit.model, fit.parameters, data, dt),
        box=fit.box,
    )


def _censored(found: Uncertainty) -> Floats:
    """Information of what lies inside the box: an estimate at its end tells nothing of that parameter."""
    information = found.information.copy()
    for i, bound in enumerate(found.at_bound):
        if bound.any():
            inside = ~bound
            across = information[i][np.ix_(inside, bound)]
            own = np.linalg.pinv(information[i][np.ix_(bound, bound)], rcond=1e-9, hermitian=True)
            left = information[i][np.ix_(inside, inside)] - across @ own @ across.T
            values, vectors = np.linalg.eigh((left + left.T) / 2)
            information[i] = 0.0
            information[i][np.ix_(inside, inside)] = (vectors * np.maximum(values, 0)) @ vectors.T
    return information


def _prior(mean: Floats, covariance: Floats, found: Uncertainty, data: Data) -> Prior:
    """The population as prior of each driver."""
    count = np.maximum(data.weight.sum(axis=-1), 1)  # pyright: ignore[reportAttributeAccessIssue]
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    inflation = (1 + found.rho) / (1 - found.rho)
    drivers = len(found.rho)
    return Prior(
        mean=np.broadcast_to(mean, (drivers, len(mean))),  # pyright: ignore[reportArgumentType]
        root=np.broadcast_to(root, (drivers, *root.shape)),  # pyright: ignore[reportArgumentType]
        scale=found.sigma**2 * inflation / count,  # pyright: ignore[reportArgumentType]
    )


def _expectation_maximisation(
    information: Floats, pull: Floats, box: Box, iterations: int = 300
) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean and covariance; posterior means `[D P]` and covariances of the drivers.

    A driver's log-likelihood is Gaussian: `-x^T information x / 2 + pull^T x`.
    """
    low, high = np.log(box)
    centre = (low + high) / 2
    mean, covariance = centre, np.diag(((high - low) / 4) ** 2)
    count, size = pull.shape
    posterior = spread = np.zeros(0)
    for _ in range(iterations):
        precision = np.linalg.inv(covariance)
        spread = np.linalg.inv(information + precision)
        posterior = np.einsum("dij,dj->di", spread, pull + precision @ mean)
        posterior = np.clip(posterior, low, high)
        mean = (posterior.sum(axis=0) + _WEIGHT * centre) / (count + _WEIGHT)
        off = posterior - mean
        scatter = spread.sum(axis=0) + off.T @ off
        covariance = (scatter + _WEIGHT * WIDTH**2 * np.eye(size)) / (count + _WEIGHT)
    return mean, covariance, posterior, np.asarray(spread, float)


def residual_process(model: CarFollowing, parameters: Floats, data: Data, dt: float) -> Residual:
    """Ornstein-Uhlenbeck process of recorded minus modelled accelerations, over all drivers.

    Its autocovariance at lags of 0.5 to 3 s, beyond the smoothing of the data, is fitted with
    sigma^2 exp(-lag / tau).
    """
    off = np.asarray(_unexplained(model, jnp.asarray(parameters, jnp.float32), data, dt), float)
    off = np.clip(off, -_HARD, _HARD)
    counts = np.asarray(data.weight) > 0
    # The last sample of a segment has no acceleration of its own.
    last = np.concatenate([np.asarray(data.start)[:, 1:] > 0, np.ones((len(off), 1), bool)], axis=1)
    counts &= ~last
    segment = np.cumsum(np.asarray(data.start), axis=1)
    centre = [np.mean(row[there]) if there.any() else 0.0 for row, there in zip(off, counts, strict=True)]
    off = off - np.asarray(centre)[:, None]
    covariances = []
    for lag in _LAGS:
        k = round(lag / dt)
        both = counts[:, k:] & counts[:, :-k] & (segment[:, k:] == segment[:, :-k])
        covariances.append(np.sum(off[:, k:] * off[:, :-k] * both) / max(both.sum(), 1))
    variance = float(np.sum(off**2 * counts) / max(counts.sum(), 1))
    positive = np.asarray(covariances) > 0.02 * variance
    use = int(np.argmin(positive)) if not positive.all() else len(positive)
    if use < 2:
        return Residual(sigma=math.sqrt(variance), tau=dt)
    slope, level = np.polyfit(_LAGS[:use], np.log(covariances[:use]), 1)
    return Residual(sigma=float(math.exp(level / 2)), tau=float(-1 / min(slope, -0.01)))


@partial(jax.jit, static_argnames=("model", "dt"))
def _unexplained(model: CarFollowing, parameters: Array, data: Data, dt: float) -> Array:
    def one(p: Array, data: Data) -> Array:
        who, v0 = driver(p)

        def at(now: Data) -> Array:
            return model(who, gap=now.gap, v=now.v, v_lead=now.v_lead, a_lead=now.a_lead, v0=v0)

        recorded = jnp.diff(data.v, append=data.v[-1:]) / dt
        return recorded - jax.vmap(at)(data)

    return jax.vmap(one)(parameters, jax.tree.map(jnp.asarray, data))


# --- the check ---------------------------------------------------------------------------------------


def predictive_check(
    law: Law, segments: Sequence[Segment], *, known: bool = False, draws: int = 64, seed: int = 0
) -> dict[str, float]:
    """How often recorded gaps lie within what the population predicts: shares of the time.

    Args:
      law: from other segments than these.
      segments: to predict.
      known: the drivers are those of the law: draw from their posteriors; otherwise new drivers are drawn.
      draws: per driver, each with a residual acceleration of its own.
      seed: of the draws.

    Returns:
      `inside_50`, `inside_90`: shares within the central 50 and 90 % of the predictions; near 0.5 and 0.9
      if all is well. `width_90`: m, mean width of the latter.
    """
    drivers, data, dt = stack(segments)
    rng = np.random.default_rng(seed)
    if known:
        at = [law.drivers.index(name) for name in drivers]
        drawn = np.stack(
            [
                rng.multivariate_normal(law.posterior_mean[i], law.posterior_covariance[i], draws)
                for i in at
            ]
        )  # fmt: skip
        parameters = np.clip(np.exp(drawn), *law.box)
    else:
        parameters = law.sample(len(drivers) * draws, rng).reshape(len(drivers), draws, -1)
    gaps = np.asarray(
        _predictions(
            law.model,
            jnp.asarray(parameters, jnp.float32),
            jax.tree.map(jnp.asarray, data),
            dt,
            jnp.asarray([law.residual.sigma, law.residual.tau], jnp.float32),
            jax.random.key(seed),
        )
    )
    counts = np.asarray(data.weight) > 0
    # Just after the start all vehicles are where the recording was.
    since = _since(np.asarray(data.start))
    counts &= since * dt > 5.0
    found: dict[str, float] = {}
    for level in (50, 90):
        low, high = np.percentile(gaps, [50 - level / 2, 50 + level / 2], axis=1)
        inside = (np.asarray(data.gap) >= low) & (np.asarray(data.gap) <= high)
        found[f"inside_{level}"] = float(np.sum(inside & counts) / max(counts.sum(), 1))
        if level == 90:
            found["width_90"] = float(np.sum((high - low) * counts) / max(counts.sum(), 1))
    return found


def _since(start: NDArray[Any]) -> NDArray[np.int64]:
    """Samples since the last start."""
    index = np.arange(start.shape[1])[None]
    return index - np.maximum.accumulate(np.where(start > 0, index, 0), axis=1)


@partial(jax.jit, static_argnames=("model", "dt"))
def _predictions(
    model: CarFollowing,
    parameters: Float[Array, "D K P"],
    data: Data,
    dt: float,
    residual: Float[Array, " 2"],
    key: Key[Array, ""],
) -> Float[Array, "D K T"]:
    sigma, tau = residual
    keep = jnp.exp(-dt / tau)

    def one(p: Array, key: Array, data: Data) -> Array:
        white = jax.random.normal(key, data.gap.shape)
        first = sigma * white[0]

        def step(x: Array, w: Array) -> tuple[Array, Array]:
            x = keep * x + sigma * jnp.sqrt(1 - keep * keep) * w
            return x, x

        noise = jax.lax.scan(step, first, white)[1]
        return rollout(model, p, data, dt, noise)[0]

    def several(p: Array, key: Array, data: Data) -> Array:
        return jax.vmap(lambda p, key: one(p, key, data))(p, jax.random.split(key, p.shape[0]))

    return jax.vmap(several)(parameters, jax.random.split(key, parameters.shape[0]), data)


# --- the file ----------------------------------------------------------------------------------------


def write_population(
    law: Law,
    path: str | Path,
    *,
    sources: Sequence[str] = (),
    classes: Sequence[str] = ("car",),
    speed_limit: float | None = None,
) -> None:
    """Write the population as a file for scenarios: `traffic.drivers = "FILE"`.

    Args:
      law: of the drivers.
      path: of the JSON file.
      sources: names of the recordings.
      classes: vehicle classes that drive like this.
      speed_limit: m/s, of the road of the recordings.

    Raises:
      ValueError: see `population_content`.
    """
    content = population_content(law, sources=sources, classes=classes, speed_limit=speed_limit)
    write_whole(path, json.dumps(content, indent=1) + "\n")


def population_content(
    law: Law,
    *,
    sources: Sequence[str] = (),
    classes: Sequence[str] = ("car",),
    speed_limit: float | None = None,
) -> dict[str, Any]:
    """The content of a file of drivers; arguments as of `write_population`.

    v0 is there only if the data of most drivers tell it: relative to the speed limit as `speed_factor` if
    that is known, otherwise as `v_max`. Without it the drivers of scenarios keep their default desired
    speeds. Of one or two drivers all parameters are treated like this.

    Raises:
      ValueError: the data of one or two drivers tell no parameter, or the speed limit is impossible.
    """
    check_positive(speed_limit=speed_limit)
    few = len(law.drivers) < FEW
    names = [
        name
        for name, share in zip(PARAMETERS, law.identified, strict=True)
        if share > IDENTIFIED or (name != "v0" and not few)
    ]
    if not names:
        raise ValueError(
            f"the data of {len(law.drivers)} driver(s) tell none of {', '.join(PARAMETERS)}; longer records, "
            "with free driving, approaches and stops, are needed"
        )
    at = [PARAMETERS.index(name) for name in names]
    table = {}
    for name, k in zip(names, at, strict=True):
        median, spread = law.median[name], law.spread[name]
        low, high = law.box.lower[k], law.box.upper[k]
        key = name
        if name == "v0":
            key = "speed_factor" if speed_limit else "v_max"
        if name == "v0" and speed_limit:
            # speed_factor has a normal distribution: that of the same median and relative width
            median, low, high = (x / speed_limit for x in (median, low, high))
            spread *= median
        table[key] = {
            "median": median,
            "spread": spread,
            "lower": low,
            "upper": high,
            "identified": float(law.identified[k]),
            "at_lower": float(law.bound_shares[0, k]),
            "at_upper": float(law.bound_shares[1, k]),
        }
    return {
        "format": FORMAT,
        "sources": [Path(source).name for source in sources],
        "model": model_name(law.model),
        "objective": law.objective,
        "drivers": len(law.drivers),
        "classes": list(classes),
        "parameters": table,
        "correlation": law.correlation[np.ix_(at, at)].tolist(),
        "residual_acceleration": {"sigma": law.residual.sigma, "tau": law.residual.tau},
        "speed_limit": speed_limit,
        "desired_speed": {"median": law.median["v0"], "spread": law.spread["v0"]},
    }


__all__ = [
    "Law",
    "Residual",
    "estimate",
    "few_drivers",
    "population_content",
    "predictive_check",
    "residual_process",
    "write_population",
]
