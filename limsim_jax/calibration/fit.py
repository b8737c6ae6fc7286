"""Parameters of car-following models from recorded followers, all drivers at once.

The follower drives behind the *recorded* leader from its recorded start, with the models and the ballistic
step of the simulator itself (`traffic.car_following`), and its gap is compared with the recorded one
(Kesting, Treiber 2008, arXiv 0803.4063). Parameters live in a box (`parameters.BOUNDS`), and the
derivatives of a rollout by them are five forward-mode products, with no tape over its steps.

Methods, behind one function `fit`:

- `lm`: Levenberg-Marquardt, projected on the box: a parameter at its bound stays out of the step until the
  gradient points inside. From the best of quasi-random points. The default.
- `lbfgs`, `adam`: optax, from the same starts, without bounds on theta in p = lo + (hi - lo) sigmoid(theta).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.stats import qmc

from limsim_jax.calibration.cleaning import Segment, by_driver
from limsim_jax.calibration.parameters import BOX, PARAMETERS, Box
from limsim_jax.traffic.car_following import ACC, IDM, IIDM, CarFollowing, ballistic
from limsim_jax.types import Driver

MODELS: dict[str, CarFollowing] = {"idm": IDM(), "iidm": IIDM(), "acc": ACC()}
"""By the names that files and the command line have for them."""

OBJECTIVES = ("gap", "speed", "mixed", "log", "relative", "absolute")
METHODS = ("lm", "lbfgs", "adam")

STANDING = 0.1
"""m/s, a slower vehicle stands; of a stop only the first `STANDING_TIME` s count."""

STANDING_TIME = 2.0
FLOOR = 1.0
"""m, least gap in objectives that divide by it or take its logarithm."""

_FIXED = {"delta": 4.0, "b_max": 9.0, "coolness": 0.99}
_BROKEN = 1e9  # cost of a rollout that is not finite
_REACH = 7.0  # of theta: within 0.1 % of the bounds
_PAD = 128  # numbers of samples are multiples, so that few shapes are compiled


class Data(NamedTuple):
    """Recorded followers, padded to one length: `[D, T]`, or `[T]` of one driver."""

    gap: Float[Array, "*D T"]  # m
    v: Float[Array, "*D T"]  # m/s
    v_lead: Float[Array, "*D T"]  # m/s
    a_lead: Float[Array, "*D T"]  # m/s^2, of the step before
    start: Float[Array, "*D T"]  # 1 where a segment begins and the follower is put where it was
    weight: Float[Array, "*D T"]  # 1 where samples count


def model_name(model: CarFollowing) -> str:
    """The name of a model in files; of one that is not in `MODELS`, that of its class."""
    return next((name for name, known in MODELS.items() if known == model), type(model).__name__)


def stack(segments: Sequence[Segment], samples: int = 0) -> tuple[tuple[str, ...], Data, float]:
    """Drivers, their segments one after another, and the time step.

    Args:
      segments: of all drivers.
      samples: at least so long; equal shapes share compiled programs.

    Raises:
      ValueError: there are no segments, one has a single sample, or their time steps differ.
    """
    if not segments:
        raise ValueError("no segments; at least one recorded follower is needed")
    for part in segments:
        if len(part) < 2:
            raise ValueError(
                f"segment of driver '{part.driver}': {len(part)} samples; 2 or more are expected"
            )
    drivers = by_driver(segments)
    steps = {round(segment.dt, 6) for segment in segments}
    if len(steps) > 1:
        raise ValueError(
            f"segments in steps of {', '.join(f'{dt:g}' for dt in sorted(steps))} s; one is needed"
        )
    dt = segments[0].dt
    longest = max(sum(len(part) for part in parts) for parts in drivers.values())
    shape = (len(drivers), math.ceil(max(longest, samples) / _PAD) * _PAD)
    # Padding: a follower at rest 10 m behind a leader at rest.
    arrays = {name: np.zeros(shape, np.float32) for name in Data._fields}
    arrays["gap"] += 10
    for i, parts in enumerate(drivers.values()):
        at = 0
        for part in parts:
            rows = slice(at, at + len(part))
            arrays["gap"][i, rows] = part.gap
            arrays["v"][i, rows] = part.v
            arrays["v_lead"][i, rows] = part.v_lead
            arrays["a_lead"][i, rows] = np.diff(part.v_lead, prepend=2 * part.v_lead[0] - part.v_lead[1]) / dt
            arrays["weight"][i, rows] = _counts(part.v, dt)
            arrays["start"][i, at] = 1
            at += len(part)
        if at < shape[1]:
            arrays["start"][i, at] = 1
    return tuple(drivers), Data(**arrays), dt  # pyright: ignore[reportArgumentType]


def _counts(v: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """1, and 0 for what of a stop is later than `STANDING_TIME`."""
    stands = v < STANDING
    index = np.arange(len(v))
    since = index - np.maximum.accumulate(np.where(stands, -1, index))
    return np.where(stands & (since * dt > STANDING_TIME), 0.0, 1.0)


# --- rollouts ----------------------------------------------------------------------------------------


def driver(parameters: Float[Array, " P *b"]) -> tuple[Driver, Float[Array, "*b"]]:
    """A driver with these parameters, and its desired speed v0."""
    v0, time_gap, s0, a, b = parameters
    values = dict.fromkeys((field.name for field in fields(Driver)), jnp.zeros_like(v0))
    values |= {name: jnp.full_like(v0, value) for name, value in _FIXED.items()}
    return Driver(**values | {"T": time_gap, "s0": s0, "a": a, "b": b}), v0


def rollout(
    model: CarFollowing,
    parameters: Float[Array, " P"],
    data: Data,
    dt: float,
    noise: Float[Array, " T"] | None = None,
) -> tuple[Float[Array, " T"], Float[Array, " T"]]:
    """Gap, m, and speed, m/s, of a follower behind the recorded leader.

    Args:
      model: of car following.
      parameters: in the order of `PARAMETERS`.
      data: of one driver.
      dt: s.
      noise: acceleration that is added to that of the model, m/s^2.
    """
    who, v0 = driver(parameters)
    following = jnp.concatenate([data.v_lead[1:], data.v_lead[-1:]])
    noise = jnp.zeros_like(data.gap) if noise is None else noise

    def step(carry: tuple[Array, Array], now: tuple[Data, Array, Array]) -> tuple[Any, Any]:
        at, v_lead_next, extra = now
        gap = jnp.where(at.start > 0, at.gap, carry[0])
        v = jnp.where(at.start > 0, at.v, carry[1])
        a = model(who, gap=gap, v=v, v_lead=at.v_lead, a_lead=at.a_lead, v0=v0) + extra
        v_new, distance = ballistic(v, a, dt)
        gap_new = gap + 0.5 * dt * (at.v_lead + v_lead_next) - distance
        return (gap_new, v_new), (gap, v)

    first = (data.gap[0] + 0 * v0, data.v[0] + 0 * v0)
    return jax.lax.scan(step, first, (data, following, noise))[1]


def residuals(
    objective: str, gap: Float[Array, " T"], v: Float[Array, " T"], data: Data
) -> Float[Array, " T"]:
    """What the objective is the root mean square of, weighted; `absolute`, `mixed` also by the mean gap."""
    weight = data.weight
    recorded = jnp.maximum(data.gap, FLOOR)
    if objective == "speed":
        error = v - data.v
    elif objective == "log":
        error = jnp.log(jnp.maximum(gap, FLOOR) / recorded)
    elif objective == "relative":
        error = (gap - data.gap) / recorded
    elif objective in ("mixed", "absolute"):
        mean = jnp.sum(weight * recorded) / jnp.maximum(jnp.sum(weight), 1)
        error = (gap - data.gap) / (jnp.sqrt(recorded * mean) if objective == "mixed" else mean)
    else:
        error = gap - data.gap
    return jnp.where(weight > 0, error * jnp.sqrt(weight), 0)


def _mean_square(r: Array, data: Data) -> Array:
    return jnp.sum(r * r) / jnp.maximum(jnp.sum(data.weight), 1)


@partial(jax.jit, static_argnames=("model", "dt"))
def errors(
    model: CarFollowing, parameters: Float[Array, "D P"], data: Data, dt: float
) -> dict[str, Float[Array, " D"]]:
    """All objectives of each driver, and `collision` (1 or 0)."""

    def one(p: Array, data: Data) -> dict[str, Array]:
        gap, v = rollout(model, p, data, dt)
        found = {name: jnp.sqrt(_mean_square(residuals(name, gap, v, data), data)) for name in OBJECTIVES}
        hit = jnp.any((gap <= 0) & (data.weight > 0))
        return found | {"collision": hit.astype(gap.dtype)}

    return jax.vmap(one)(parameters, data)


# --- methods -----------------------------------------------------------------------------------------


class Problem(NamedTuple):
    """What is the same for all drivers; hashable."""

    model: CarFollowing
    objective: str
    dt: float  # s
    box: Box = BOX


class Prior(NamedTuple):
    """Normal distribution of the log-parameters of one driver; adds a mean square to the objective's."""

    mean: Float[Array, " P"]
    root: Float[Array, "P P"]  # of the precision: precision = root^T root
    scale: Float[Array, ""]  # mean square of the objective that is worth a log-likelihood of 1/2


def _residuals(problem: Problem, u: Array, data: Data, prior: Prior | None) -> Array:
    """Residuals whose sum of squares is the cost."""
    p = problem.box.parameters(u)
    gap, v = rollout(problem.model, p, data, problem.dt)
    r = residuals(problem.objective, gap, v, data) / jnp.sqrt(jnp.maximum(jnp.sum(data.weight), 1))
    if prior is None:
        return r
    off = prior.root @ (jnp.log(p) - prior.mean) * jnp.sqrt(prior.scale)
    return jnp.concatenate([r, off])


def cost(problem: Problem, u: Array, data: Data, prior: Prior | None = None) -> Array:
    """Mean square error of one driver, plus what a prior adds.

    Args:
      problem: model and objective.
      u: point `[P]` of the unit box.
      data: of one driver.
      prior: of its parameters, or None.
    """
    r = _residuals(problem, u, data, prior)
    return _finite(jnp.sum(r * r))


def _finite(cost: Array) -> Array:
    return jnp.where(jnp.isfinite(cost), cost, _BROKEN)


def _normal_equations(
    problem: Problem, u: Array, data: Data, prior: Prior | None = None
) -> tuple[Array, Array, Array]:
    """Cost, J^T r and J^T J, with J by forward-mode products."""

    def both(u: Array) -> tuple[Array, Array]:
        r = _residuals(problem, u, data, prior)
        return r, r

    found: tuple[Array, Array] = jax.jacfwd(both, has_aux=True)(u)
    jacobian, r = found
    good = jnp.all(jnp.isfinite(jacobian)) & jnp.all(jnp.isfinite(r))
    jacobian, r = jnp.where(good, jacobian, 0), jnp.where(good, r, 0)
    return jnp.where(good, jnp.sum(r * r), _BROKEN), jacobian.T @ r, jacobian.T @ jacobian


_DAMPINGS = (0.1, 1.0, 16.0)


class _Descent(NamedTuple):
    u: Array  # [D, S, P]
    cost: Array  # [D, S], of `u`; huge before the first step
    damping: Array  # [D, S]
    still: Array  # [D, S], steps without a gain


@partial(jax.jit, static_argnames=("problem",))
def _levenberg_marquardt(
    problem: Problem,
    u: Array,
    data: Data,
    prior: Prior | None,
    iterations: int | Array,
    tolerance: float | Array,
) -> tuple[Array, Array]:
    """Points `[D, S, P]` and costs `[D, S]` of all starts; several dampings at once."""

    def normal(u: Array, data: Data, prior: Prior | None) -> tuple[Array, Array, Array]:
        return _normal_equations(problem, u, data, prior)

    def cost_at(u: Array, data: Data, prior: Prior | None) -> Array:
        return cost(problem, u, data, prior)

    def over_starts(f: Any) -> Any:
        return jax.vmap(jax.vmap(f, in_axes=(0, None, None)))

    def propose(u: Array, g: Array, h: Array, damping: Array) -> Array:
        # At a bound that the descent direction would cross, a parameter is no unknown.
        free = ~(((u <= 0) & (g > 0)) | ((u >= 1) & (g < 0)))
        g = jnp.where(free, g, 0)
        h = jnp.where(free[:, None] & free[None, :], h, 0)
        scale = jnp.diag(h) + 1e-4 * jnp.max(jnp.diag(h)) + 1e-12

        def one(factor: Array) -> Array:
            step: Any = jnp.linalg.solve(h + factor * damping * jnp.diag(scale), -g)
            step = jnp.nan_to_num(step, nan=0.0, posinf=0.0, neginf=0.0)
            step = step * jnp.minimum(1, 0.3 / jnp.maximum(jnp.sqrt(jnp.sum(step * step)), 1e-9))
            return jnp.clip(u + step, 0, 1)

        return jax.vmap(one)(jnp.asarray(_DAMPINGS, u.dtype))

    def step(carry: tuple[Array, _Descent]) -> tuple[Array, _Descent]:
        count, now = carry
        here, g, h = over_starts(normal)(now.u, data, prior)
        tried = jax.vmap(jax.vmap(propose))(now.u, g, h, now.damping)  # [D, S, K, P]
        found = over_starts(jax.vmap(cost_at, in_axes=(0, None, None)))(tried, data, prior)  # [D, S, K]
        best, least = jnp.argmin(found, axis=-1), jnp.min(found, axis=-1)
        better = least < here
        u = jnp.take_along_axis(tried, best[..., None, None], axis=2)[:, :, 0]
        factor = jnp.where(better, jnp.asarray(_DAMPINGS, least.dtype)[best], 64)
        gains = better & (here - least > tolerance * here)
        return count + 1, _Descent(
            u=jnp.where(better[..., None], u, now.u),
            cost=jnp.minimum(least, here),
            damping=jnp.clip(now.damping * factor, 1e-7, 1e7),
            still=jnp.where(gains, 0, now.still + 1),
        )

    def goes_on(carry: tuple[Array, _Descent]) -> Array:
        count, now = carry
        return (count < iterations) & jnp.any(now.still < 3)

    zero = jnp.zeros(u.shape[:2], u.dtype)
    start = _Descent(u, zero + _BROKEN, zero + 0.1, zero)
    end = jax.lax.while_loop(goes_on, step, (jnp.zeros((), jnp.int32), start))[1]
    return end.u, end.cost


@partial(jax.jit, static_argnames=("problem",))
def _screen(problem: Problem, u: Array, data: Data) -> Array:
    """Costs `[D, S]` of the same points `[S, P]` for all drivers."""
    return jax.vmap(lambda data: jax.vmap(lambda one: cost(problem, one, data))(u))(data)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _loss(problem: Problem, theta: Array, data: Data) -> Array:
    """Logarithm of the error at a `theta`; its gradient is by forward mode."""
    return 0.5 * jnp.log(cost(problem, jax.nn.sigmoid(theta), data) + 1e-8)


def _loss_forward(problem: Problem, theta: Array, data: Data) -> tuple[Array, tuple[Array, Data]]:
    u = jax.nn.sigmoid(theta)
    cost, g, _ = _normal_equations(problem, u, data)
    return 0.5 * jnp.log(cost + 1e-8), (g * u * (1 - u) / (cost + 1e-8), data)


def _loss_backward(problem: Problem, kept: tuple[Array, Data], cotangent: Array) -> tuple[Array, Data]:
    del problem
    g, data = kept
    return cotangent * g, jax.tree.map(jnp.zeros_like, data)


_loss.defvjp(_loss_forward, _loss_backward)


@partial(jax.jit, static_argnames=("problem", "iterations", "method"))
def _descend(problem: Problem, theta: Array, data: Data, iterations: int, method: str) -> tuple[Array, Array]:
    """Adam or L-BFGS from each start `[D, S, P]`; the best point passed and its cost."""

    def rate(count: Any) -> Any:
        return 0.05 * (1 + jnp.cos(jnp.pi / iterations * count.astype(theta.dtype)))

    optimizer = (
        optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate)) if method == "adam" else optax.lbfgs()
    )

    def one(theta: Array, data: Data) -> tuple[Array, Array]:
        def value(theta: Array) -> Array:
            return _loss(problem, theta, data)

        def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
            theta, state, best, least = carry
            if method == "lbfgs":
                cost, g = optax.value_and_grad_from_state(value)(theta, state=state)
                updates, state = optimizer.update(g, state, theta, value=cost, grad=g, value_fn=value)
            else:
                cost, g = jax.value_and_grad(value)(theta)
                updates, state = optimizer.update(g, state, theta)
            better = cost < least
            best, least = jnp.where(better, theta, best), jnp.where(better, cost, least)
            moved = jnp.clip(theta + updates, -_REACH, _REACH)
            theta = jnp.where(jnp.all(jnp.isfinite(moved)), moved, best)
            return (theta, state, best, least), None

        first = (theta, optimizer.init(theta), theta, jnp.asarray(jnp.inf, theta.dtype))
        theta, _, best, least = jax.lax.scan(step, first, None, length=iterations)[0]
        last = value(theta)
        best = best + jnp.where(last < least, theta - best, 0)
        return best, jnp.exp(2 * jnp.minimum(last, least))

    with jax.numpy_dtype_promotion("standard"):  # optax counts in integers
        return jax.vmap(jax.vmap(one, in_axes=(0, None)))(theta, data)


# --- the interface -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Best parameters of every driver."""

    model: CarFollowing
    objective: str
    method: str
    drivers: tuple[str, ...]
    parameters: NDArray[np.float64]  # [D, P]
    error: NDArray[np.float64]  # [D], the objective
    starts: NDArray[np.float64]  # [D, S], the objective that each start came to
    seconds: float  # compilation included
    box: Box = BOX  # in which the parameters were searched

    def problem(self, dt: float) -> Problem:
        """The problem that this solves, with a time step in s."""
        return Problem(self.model, self.objective, dt, self.box)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """One parameter, `[D]`."""
        return self.parameters[:, PARAMETERS.index(name)]


def fit(
    segments: Sequence[Segment],
    model: CarFollowing = IDM(),
    *,
    objective: str = "mixed",
    method: str = "lm",
    starts: int | None = None,
    iterations: int | None = None,
    bounds: Mapping[str, Sequence[float]] | None = None,
    seed: int = 0,
    samples: int = 0,
) -> Fit:
    """Fit a model to every driver on its own.

    Args:
      segments: of all drivers, from `cleaning.segments`.
      model: of car following.
      objective: what to make least; `residuals` says what they are.
      method: see the module.
      starts: descents per driver, each from the best of 32 quasi-random points. Default: 8
        with the IDM, 16 with the others, whose kinks give them more local minima.
      iterations: at most, from the best start. Default: 80 (lm), 60 (lbfgs), 300 (adam).
      bounds: of some parameters, instead of those in `parameters.BOUNDS`; see `parameters.Box.of`.
      seed: of the random points.
      samples: see `stack`.

    Raises:
      ValueError: no segments, an unknown objective or method, impossible bounds, or a model that gives no
        finite gaps.
    """
    for what, value, known in (
        ("objective", objective, OBJECTIVES),
        ("method", method, METHODS),
    ):
        if value not in known:
            raise ValueError(f"{what} '{value}' is unknown; known are {', '.join(known)}")
    box = Box.of(bounds)
    begin = time.perf_counter()
    drivers, data, dt = stack(segments, samples)
    u, costs = solve(Problem(model, objective, dt, box), data, method, starts, iterations, seed)
    best = np.argmin(costs, axis=-1)
    rows = np.arange(len(drivers))
    for name, least in zip(drivers, costs[rows, best], strict=True):
        if least > _BROKEN / 2:
            raise ValueError(f"driver '{name}': {model_name(model)} gives no finite gaps for any parameters")
    return Fit(
        model=model,
        objective=objective,
        method=method,
        drivers=drivers,
        parameters=box.parameters(u[rows, best]),
        error=np.sqrt(costs[rows, best]),
        starts=np.sqrt(costs),
        seconds=time.perf_counter() - begin,
        box=box,
    )


def solve(
    problem: Problem,
    data: Data,
    method: str,
    starts: int | None,
    iterations: int | None,
    seed: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of the unit box `[D, S, P]` and costs `[D, S]`."""
    data = jax.tree.map(jnp.asarray, data)
    count, size = data.gap.shape[0], len(PARAMETERS)
    starts = (8 if isinstance(problem.model, IDM) else 16) if starts is None else starts
    # The best of each of several sets of points that cover the box; the best of all would lie together.
    points = qmc.Sobol(size, rng=seed).random_base2(max(32 * starts - 1, 1).bit_length())
    points = jnp.asarray(np.clip(points[: 32 * starts], 0.02, 0.98), jnp.float32)
    costs = _screen(problem, points, data).reshape(count, starts, 32)
    u = points.reshape(starts, 32, size)[jnp.arange(starts)[None], jnp.argmin(costs, axis=-1)]
    if method == "lm":
        # All starts a little way, the best few of them further, the best alone to the end: valleys are long
        # and narrow where parameters are hardly identified. In parts of one shape.
        few = max(starts // 4, 2)
        parts = [u[:, k : k + few] for k in range(0, starts, few) if k + few <= starts or k == 0]
        parts = [_levenberg_marquardt(problem, part, data, None, 5, 1e-3) for part in parts]
        u, costs = (jnp.concatenate(leaves, axis=1) for leaves in zip(*parts, strict=True))
        best = jnp.argsort(costs, axis=-1)[:, :few]
        u = jnp.take_along_axis(u, best[..., None], axis=1)
        u, costs = _levenberg_marquardt(problem, u, data, None, min(iterations or 15, 15), 1e-5)
        row, best = jnp.arange(count), jnp.argmin(costs, axis=-1)
        alone, least = _levenberg_marquardt(
            problem, u[row, best][:, None], data, None, iterations or 80, 1e-5
        )
        u, costs = u.at[row, best].set(alone[:, 0]), costs.at[row, best].set(least[:, 0])
    else:
        theta, costs = _descend(
            problem, jnp.log(u / (1 - u)), data, iterations or (60 if method == "lbfgs" else 300), method
        )
        u = jax.nn.sigmoid(theta)
    return np.asarray(u, float), np.asarray(costs, float)


def refine(
    problem: Problem, data: Data, parameters: NDArray[Any], prior: Prior, iterations: int = 25
) -> NDArray[np.float64]:
    """Parameters `[D, P]` of greatest posterior density near the given ones."""
    u = jnp.asarray(problem.box.unit(parameters), jnp.float32)[:, None]
    prior = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), prior)
    u, _ = _levenberg_marquardt(problem, u, jax.tree.map(jnp.asarray, data), prior, iterations, 1e-5)
    return problem.box.parameters(np.asarray(u[:, 0], float))


__all__ = [
    "METHODS",
    "MODELS",
    "OBJECTIVES",
    "Data",
    "Fit",
    "Prior",
    "Problem",
    "cost",
    "driver",
    "errors",
    "fit",
    "model_name",
    "refine",
    "residuals",
    "rollout",
    "solve",
    "stack",
]
